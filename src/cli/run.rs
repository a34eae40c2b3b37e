//! `costate run` and its parts.

use super::check::{at_equilibrium, load};
use super::report;
use super::{BackendChoice, CliError, RunArgs};
use crate::backend::cpu::Cpu;
use crate::backend::gpu::{Gpu, Selection};
use crate::backend::{Backend, BackendError};
use crate::model::Model;
use crate::output::{Axis, ResultFile, RunRecord, TrajectoryBlock, TrajectorySchema, utc_timestamp};
use crate::sweep::{Choices, Plan, PlanError, SweepReport, sweep};
use std::path::{Path, PathBuf};
use std::sync::mpsc::sync_channel;
use std::time::{Instant, SystemTime};

/// Which parts of a scene to run.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Parts {
    All,
    ShootOut,
}

pub(super) fn run(args: &RunArgs, parts: Parts) -> Result<(), CliError> {
    let (started, clock) = (SystemTime::now(), Instant::now());
    let (model, hamiltonian) = load(&args.scene)?;
    let backend = open_backend(args)?;
    let choices = Choices {
        precision: args.precision.and_then(|p| p.precision()),
        rtol: args.rtol,
        ..Choices::default()
    };
    let plan = Plan::new(&model, &hamiltonian, backend.as_ref(), choices).map_err(|e| match e {
        PlanError::Local(e) => at_equilibrium(&model, &e),
        other => other.into(),
    })?;
    let path = args.out.clone().unwrap_or_else(|| default_output(&args.scene.scenario));
    let mut terminal = report::Terminal::new(&args.scene);
    terminal.heading(&model, &plan, backend.as_ref(), args);
    if parts == Parts::All && model.homotopy.is_some() {
        terminal.note("[homotopy] is not available in this version and is left out");
    }

    let mut file = ResultFile::create(&path)?;
    let mut writer = file.trajectories(&schema(&model, &plan))?;
    let swept = sweep_into(&plan, backend.as_ref(), &mut terminal, &mut |block| {
        Ok(writer.append(&block)?)
    })?;
    drop(writer);
    if swept.trajectories == 0 {
        return Err(CliError::NothingSwept {
            outside: swept.coverage.outside_guards,
        });
    }
    let record = RunRecord {
        title: model.title.clone(),
        scenario: model.text.clone(),
        costate_version: env!("CARGO_PKG_VERSION").to_owned(),
        git_revision: env!("COSTATE_GIT_REVISION").to_owned(),
        command: std::env::args_os()
            .map(|a| a.to_string_lossy().into_owned())
            .collect::<Vec<_>>()
            .join(" "),
        created: utc_timestamp(started),
        backend: backend.name().to_owned(),
        adapter: backend.adapter(),
        precision: plan.spec.precision.name().to_owned(),
        method: plan.method().name().to_owned(),
        rtol: plan.run.rtol,
        atol: plan.atol,
        wall_seconds: clock.elapsed().as_secs_f64(),
    };
    record.write(&file)?;
    let path = file.finish()?;
    terminal.summary(&plan, &swept, &record, &path, clock.elapsed().as_secs_f64())?;
    Ok(())
}

fn open_backend(args: &RunArgs) -> Result<Box<dyn Backend>, CliError> {
    let selection = match (&args.adapter, args.backend) {
        (_, BackendChoice::Cpu) => return Ok(Box::new(Cpu::new())),
        (Some(name), _) => Selection::Named(name.clone()),
        (None, BackendChoice::Gpu) => Selection::Any,
        (None, BackendChoice::Auto) => Selection::Hardware,
    };
    match Gpu::open(&selection)? {
        Some(gpu) => Ok(Box::new(gpu)),
        // Only a search for hardware comes back empty.
        None => Ok(Box::new(Cpu::new())),
    }
}

fn default_output(scenario: &Path) -> PathBuf {
    let stem = scenario.file_stem().unwrap_or_else(|| "result".as_ref());
    Path::new("out").join(stem).with_extension("h5")
}

fn schema(model: &Model, plan: &Plan) -> TrajectorySchema {
    let axis = |v: &crate::model::Variable| Axis {
        name: v.name.clone(),
        unit: v.unit.clone(),
        long_name: v.long_name.clone(),
    };
    TrajectorySchema {
        states: model.states.iter().map(|s| axis(&s.variable)).collect(),
        controls: model.controls.iter().map(|c| axis(&c.variable)).collect(),
        disturbances: model.disturbances.iter().map(axis).collect(),
        samples: plan.samples(),
        status_flags: plan.status_flags(),
        ..TrajectorySchema::default()
    }
}

/// Sweeps on a thread of its own while this one writes, so that writing costs no time of the sweep's.
fn sweep_into(
    plan: &Plan,
    backend: &dyn Backend,
    terminal: &mut report::Terminal,
    write: &mut dyn FnMut(TrajectoryBlock) -> Result<(), CliError>,
) -> Result<SweepReport, CliError> {
    /// The writing side has stopped; its own error says why.
    enum Stop {
        Backend(BackendError),
        Gone,
    }
    impl From<BackendError> for Stop {
        fn from(e: BackendError) -> Self {
            Stop::Backend(e)
        }
    }
    let bar = terminal.progress();
    std::thread::scope(|scope| {
        // One block waits while one is written: memory stays bounded when writing is slower.
        let (send, receive) = sync_channel::<TrajectoryBlock>(1);
        let worker = scope.spawn(move || {
            let mut told = |done: usize, waiting: usize| bar.update(done, waiting);
            let result = sweep(plan, backend, &mut told, &mut |block| {
                send.send(block).map_err(|_| Stop::Gone)
            });
            bar.clear();
            result
        });
        let mut written = Ok(());
        for block in receive {
            written = write(block);
            if written.is_err() {
                break;
            }
        }
        let swept = worker.join().map_err(|_| CliError::Thread)?;
        written?;
        swept.map_err(|e| match e {
            Stop::Backend(e) => e.into(),
            Stop::Gone => CliError::Thread,
        })
    })
}
