//! `costate bench`.

use crate::args::{BenchArgs, BenchBackend, PrecisionChoice};
use crate::common::load::load;
use crate::common::open::ALL;
use crate::common::{Kind, check_out, pictures, print_json, provenance};
use crate::error::{AdaptersError, CliError};
use crate::terminal::Terminal;
use crate::text::bench::{self as bench_report, Done};
use costate::backend::{Backend, BackendError};
use costate::low_level::hdf5::ResultFile;
use costate::low_level::model::Precision;
use costate::low_level::result::RunRecord;
use costate::low_level::sweep::{Choices, sweep};
use costate::low_level::trajectories::TrajectoryBlock;
use costate::run::{self, RunError};
use costate::scene::Scene;
use costate::session::{self, Progress, sweep_and_write};
use costate_bench::devices::{self, Which};
use costate_bench::host_share::{HostShare, Metered};
use costate_bench::{Bench, BenchError, Options, Wanted, Work, measure, write};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Largest gap that leaves no edge of a front alone: the cap on seeds ends such a sweep.
const ENDLESS: f64 = 1e-12;

pub fn bench(args: &BenchArgs) -> Result<(), CliError> {
    let provenance = provenance();
    if args.adapter.as_deref() == Some(ALL) {
        return Err(AdaptersError::NotDivided.into());
    }
    let scene = load(&args.scene)?;
    let model = &scene.model;
    // Seeds and levels are those of the scene's own sweep, in f64 for the sake of the references.
    let choices = Choices {
        precision: Some(Precision::F64),
        unasked: true,
        ..Choices::default()
    };
    let cpu = costate::backend::cpu::Cpu::new();
    let plan = session::plan(&scene, &cpu, choices)?;
    let which: Vec<Which> = args.backend.iter().map(|b| which(*b)).collect();
    let (backends, unavailable) = devices::open(&which, args.adapter.as_deref())?;
    let path = out_path(args)?;
    let terminal = Terminal::new(args.scene.print);
    let mut file = ResultFile::create(&path)?;

    let work = Work::new(plan, model, args.trajectories, args.seed, !args.ends)
        .map_err(BenchError::from)?;
    let options = options(args);
    let mut bench = measure(&work, &backends, &options, &mut |what| terminal.step(what))?;
    terminal.step_ended();
    bench.missing.splice(0..0, unavailable);
    let folder = file.path().with_extension("host_share.tmp.h5");
    let shares = host_shares(args, &scene, &backends, &folder)?;

    write::speed_error(&mut file, &bench, model)?;
    record(&bench, &work, &options.wanted, provenance.record(model)).write(&file)?;
    file.attribute("machine", devices::machine())?;
    write::host_shares(&mut file, &bench, &shares)?;
    let path = file.finish()?;
    let picture = pictures::of_speed(&path, &model.title, &terminal)?;
    let done = Done {
        title: &model.title,
        bench: &bench,
        work: &work,
        shares: &shares,
        wanted: &wanted_errors(args),
        path: &path,
        picture: picture.as_deref(),
        seconds: provenance.seconds(),
    };
    if args.scene.print.json {
        print_json(&bench_report::as_json(&done))?;
    }
    terminal.say(&bench_report::as_text(&done))?;
    Ok(())
}

/// The result file, where a picture may stand beside it.
fn out_path(args: &BenchArgs) -> Result<PathBuf, CliError> {
    let path = args
        .out
        .clone()
        .unwrap_or_else(|| run::output_of(&args.scene.scenario, "_bench"));
    if path.extension().is_some_and(|e| e == "svg") {
        return Err(CliError::PictureName { path });
    }
    check_out(Some(&path), &[Kind::Result], &[&args.scene.scenario])?;
    Ok(path)
}

/// How it was measured; all that is not said here is `base`'s.
fn record(bench: &Bench, work: &Work, wanted: &Wanted, base: RunRecord) -> RunRecord {
    let joined = |mut parts: Vec<&str>| {
        parts.dedup();
        parts.join(", ")
    };
    RunRecord {
        backend: joined(bench.devices.iter().map(|d| d.backend).collect()),
        adapter: joined(bench.devices.iter().map(|d| d.adapter.as_str()).collect()),
        precision: joined(wanted.precisions.iter().map(|p| p.name()).collect()),
        method: joined(wanted.methods.iter().map(|m| m.name()).collect()),
        rtol: work.plan.run.rtol,
        atol: work.plan.atol,
        ..base
    }
}

fn which(choice: BenchBackend) -> Which {
    match choice {
        BenchBackend::All => Which::All,
        BenchBackend::Auto => Which::Auto,
        BenchBackend::Gpu => Which::Gpu,
        BenchBackend::Cpu => Which::Cpu,
    }
}

fn options(args: &BenchArgs) -> Options {
    let mut wanted = Wanted::default();
    if args.precision != PrecisionChoice::Auto {
        wanted.precisions = args.precision.precision().into_iter().collect();
    }
    if !args.method.is_empty() {
        wanted.methods.retain(|m| args.method.contains(m));
    }
    if !args.rtol.is_empty() {
        wanted.tolerances = args.rtol.clone();
        wanted.tolerances.sort_by(|a, b| b.total_cmp(a));
        wanted.tolerances.dedup();
    }
    Options {
        wanted,
        repeats: args.repeats as usize,
        budget: args.budget,
    }
}

/// Errors to recommend settings for, the largest first.
fn wanted_errors(args: &BenchArgs) -> Vec<f64> {
    let mut wanted = vec![1e-3, 1e-4, 1e-6, 1e-8, 1e-10];
    wanted.extend(&args.error);
    wanted.sort_by(|a, b| b.total_cmp(a));
    wanted.dedup();
    wanted
}

/// Whole sweeps of each number of trajectories asked for, on each backend.
fn host_shares(
    args: &BenchArgs,
    scene: &Scene,
    backends: &[Box<dyn Backend>],
    path: &Path,
) -> Result<Vec<HostShare>, CliError> {
    let mut shares = Vec::new();
    for &count in &args.host_share {
        for (device, backend) in backends.iter().enumerate() {
            let backend = backend.as_ref();
            shares.push(host_share(args, scene, device, backend, count, path)?);
        }
    }
    Ok(shares)
}

/// Sweeps the scene with its own settings until `count` trajectories are done, and writes them to a
/// file that is removed again: everything that `run` does for a sweep but reading and deriving the
/// scene.
fn host_share(
    args: &BenchArgs,
    scene: &Scene,
    device: usize,
    backend: &dyn Backend,
    count: usize,
    path: &Path,
) -> Result<HostShare, CliError> {
    let choices = Choices {
        precision: args.precision.precision(),
        unasked: true,
        ..Choices::default()
    };
    let plan = || {
        session::plan(scene, backend, choices).map(|mut plan| {
            plan.shoot_out.spacing = ENDLESS;
            plan.shoot_out.max_seeds = count;
            plan
        })
    };
    let begin = Instant::now();
    sweep::<BackendError>(&plan()?, backend, &mut |_, _| {}, &mut |_| Ok(()))?;
    let sweep_seconds = begin.elapsed().as_secs_f64();

    let begin = Instant::now();
    let metered = Metered::new(backend);
    let plan = plan()?;
    let terminal = Terminal::new(args.scene.print);
    let mut file = ResultFile::create(path)?;
    let mut writer = file.trajectories(&run::trajectory_schema(&scene.model, &plan))?;
    let mut writing_seconds = 0.0;
    let mut write = |block: &TrajectoryBlock| {
        let begin = Instant::now();
        writer.append(block)?;
        writing_seconds += begin.elapsed().as_secs_f64();
        Ok::<(), RunError>(())
    };
    let swept = sweep_and_write(&plan, &metered, &terminal, &mut |_, _| {}, Some(&mut write))?;
    drop(writer);
    let ending = Instant::now();
    let path = file.finish()?;
    let finishing_seconds = ending.elapsed().as_secs_f64();
    let wall_seconds = begin.elapsed().as_secs_f64();
    let bytes = std::fs::metadata(&path).map_or(0, |m| m.len());
    // It has served its purpose; where it cannot be removed it does no harm.
    let _ = std::fs::remove_file(&path);
    Ok(HostShare {
        device,
        precision: plan.spec.precision,
        trajectories: swept.trajectories,
        wall_seconds,
        sweep_seconds,
        writing_seconds,
        finishing_seconds,
        times: metered.times(),
        bytes,
    })
}
