//! `costate run` and its parts.

use super::afterwards;
use super::check::{load, planned};
use super::estimates::Estimates;
use super::grid::GridRefusal;
use super::report;
use super::{BackendChoice, CliError, Kind, RunArgs, SolveArgs, listed, points};
use costate::backend::cpu::Cpu;
use costate::backend::gpu::{Gpu, Selection};
use costate::backend::{Backend, BackendError, Trajectories};
use costate::dynamic_programming::GridValue;
use costate::files::{Draft, target, write_text};
use costate::hdf5::ResultFile;
use costate::map;
use costate::model::{Method, Model};
use costate::result::{Axis, RunRecord, Stored, TrajectorySchema};
use costate::scene::Scene;
use costate::shooting::Solver;
use costate::sweep::{Choices, Plan, SweepReport, sweep_keeping};
use costate::trajectories::TrajectoryBlock;
use costate::value::{self, Answers, Archive, Grid, Request};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::sync_channel;
use std::time::{Instant, SystemTime};

/// Which parts of a scene to run.
#[derive(Clone, Copy)]
pub(super) enum Parts<'a> {
    All,
    ShootOut,
    Homotopy,
    Solve(&'a SolveArgs),
}

impl Parts<'_> {
    /// Whether the sweep is a result, or only gives first guesses.
    fn sweeps(self) -> bool {
        matches!(self, Parts::All | Parts::ShootOut)
    }
}

pub(super) fn run(args: &RunArgs, parts: Parts<'_>) -> Result<(), CliError> {
    let (started, clock) = (SystemTime::now(), Instant::now());
    let solve = match parts {
        Parts::Solve(solve) => Some(solve),
        _ => None,
    };
    let table = solve.is_some_and(listed::is_table);
    let inputs: Vec<&Path> = [&args.scene.scenario]
        .into_iter()
        .chain(solve.map(|s| &s.points))
        .map(PathBuf::as_path)
        .collect();
    let kinds: &[Kind] = match parts {
        Parts::Solve(_) => &[Kind::Result, Kind::Table],
        _ => &[Kind::Result],
    };
    super::check_out(args.out.as_deref(), kinds, &inputs)?;
    let scene = load(&args.scene)?;
    let model = &scene.model;
    if let Some(solve) = solve.filter(|_| table) {
        listed::check_table(solve, model)?;
    }
    let mut wanted = wanted(model, parts)?;
    if args.grid_guesses {
        super::grid::refuse(model, "--grid-guesses")?;
        if wanted.is_none() {
            return Err(GridRefusal::Nothing.into());
        }
    }
    let all = matches!(parts, Parts::All);
    let aim = model
        .map_aim
        .as_ref()
        .filter(|_| all || matches!(parts, Parts::Homotopy));
    let solves = wanted.is_some() || aim.is_some();
    let backend = args.numerics.open(model)?;
    let stored = parts.sweeps() && model.shoot_out.is_some();
    let choices = Choices {
        inner_levels: solves,
        dispensable: solves && !stored,
        max_seeds: (solves && !parts.sweeps()).then(|| {
            let count = wanted.as_ref().map_or(0, WantedStates::count);
            value::guess_seeds(model.states.len(), count)
        }),
        unasked: solves,
        ..args.numerics.choices(args.seed)
    };
    let plan = planned(&scene, backend.as_ref(), choices)?;
    if all {
        afterwards::check(&scene)?;
    }
    let (path, beside) = match &args.out {
        Some(path) => (path.clone(), None),
        None => own_output(&args.scene.scenario, solve.is_some()),
    };
    let mut terminal = report::Terminal::new(&args.scene);
    if let Some(other) = beside {
        terminal.note(&format!(
            "{} holds other results and stays as it is; the answers go to {}",
            other.display(),
            path.display()
        ));
    }
    terminal.heading(model, &plan, backend.as_ref());
    if let Some(solve) = solve
        && points::has_published(&solve.points, model)
    {
        terminal.note(&format!(
            "column {} of the points is not read",
            points::PUBLISHED
        ));
    }

    // The final name first: what is wrong with it is said before the work is done.
    let path = target(&path)?;
    let draft = (all && afterwards::wanted(model))
        .then(|| Draft::begin(&path))
        .transpose()?;
    // None for a table.
    let mut file = match &draft {
        _ if table => None,
        Some(draft) => Some(ResultFile::create(draft.hidden())?),
        None => Some(ResultFile::create(&path)?),
    };
    let schema = schema(model, &plan);
    let mut writer = match &mut file {
        Some(file) if stored => Some(file.trajectories(&schema)?),
        _ => None,
    };
    let mut archive = solves.then(|| Archive::new(&plan));
    let mut swept = SweepReport::default();
    let direct = !stored && value::goes_without_sweep(&plan);
    if !direct {
        swept = swept_for(
            &plan,
            backend.as_ref(),
            &mut terminal,
            archive.as_mut(),
            &mut |block| {
                writer
                    .as_mut()
                    .map_or(Ok(()), |writer| Ok(writer.append(&block)?))
            },
        )?;
    }
    drop(writer);
    if let Some(file) = file.as_mut().filter(|_| stored) {
        file.caustic(&schema, &swept.folds)?;
    }
    let mut answers = None;
    if let (Some(wanted), Some(archive)) = (&mut wanted, &mut archive) {
        if args.grid_guesses {
            wanted.request.grid = Some(wanted.grid(&scene, &plan, backend.as_ref(), &terminal)?);
        }
        let mut solver = value::solver(&plan, backend.as_ref())?;
        let mut found = wanted.solve(&plan, model, &mut solver, archive, &terminal)?;
        // What nothing has led to may have a swept trajectory near it.
        if direct && value::may_need_sweep(&plan) && found.lacks_guesses() {
            swept = swept_for(
                &plan,
                backend.as_ref(),
                &mut terminal,
                Some(archive),
                &mut |_| Ok(()),
            )?;
            found = wanted.solve(&plan, model, &mut solver, archive, &terminal)?;
        }
        if let Some(file) = &mut file {
            wanted.write(file, &schema, model, &found)?;
        }
        if let (Some(solve), Some(file)) = (solve, &mut file)
            && solve.trajectories
        {
            let entries: Vec<_> = (0..wanted.points())
                .filter_map(|k| found.answer(found.targets.of_given[k]))
                .collect();
            let block = value::sampled(&plan, &mut solver, &entries, solve.samples)?;
            let schema = TrajectorySchema {
                samples: solve.samples,
                ..schema.clone()
            };
            file.trajectories(&schema)?.append(&block)?;
        }
        answers = Some(found);
    }
    let mut mapped = None;
    if let (Some(aim), Some(archive)) = (aim, &archive) {
        let mut solver = value::solver(&plan, backend.as_ref())?;
        let bar = terminal.progress();
        let mut told = |what: &str, done: usize, of: usize| {
            bar.say(&format!("{done} of {of} states solved, {what}"))
        };
        let made = map::adaptive(&plan, model, &mut solver, archive, aim, &mut told)?;
        bar.clear();
        if let Some(file) = &mut file {
            file.map_pieces(&schema, model.time_name(), &made)?;
        }
        mapped = Some(made);
    }
    let variants = match &mut file {
        Some(file) if all => {
            super::study::write(file, &scene, backend.as_ref(), choices, &terminal)?
        }
        _ => Vec::new(),
    };
    let estimates = Estimates::of(&plan, &swept, stored, answers.as_ref())?;
    let record = RunRecord {
        backend: backend.name().to_owned(),
        adapter: backend.adapter(),
        precision: plan.spec.precision.name().to_owned(),
        method: plan.method().name().to_owned(),
        rtol: plan.run.rtol,
        atol: plan.atol,
        wall_seconds: clock.elapsed().as_secs_f64(),
        ..super::begun(model, started)
    };
    if let Some(file) = &file {
        record.write(file)?;
        estimates.write(file)?;
    }
    let names: Vec<String> = model
        .states
        .iter()
        .map(|s| s.variable.name.clone())
        .collect();
    let done = report::Done {
        plan: &plan,
        names: &names,
        swept: &swept,
        stored,
        answers: answers.as_ref(),
        mapped: mapped.as_ref(),
        listed: (solve.and(wanted.as_ref())).map_or(0, WantedStates::points),
        estimates: &estimates,
        record: &record,
        variants: &variants,
        model,
        path: &path,
        seconds: clock.elapsed().as_secs_f64(),
    };
    let mut summary = report::as_json(&done);
    if let Some(file) = &file {
        file.attribute("summary", summary.to_string())?;
    }
    // Not in the attribute: the file has them in /points, and an attribute holds 64 KiB.
    if done.listed > 0 {
        summary["points"] = listed::as_json(&done);
    }
    match file {
        Some(file) => drop(file.finish()?),
        None => write_text(&path, &listed::table(&done)?)?,
    }
    terminal.summary(&done)?;
    if let Some(draft) = draft {
        let laws = afterwards::laws(&draft, &scene, backend.as_ref(), choices, &terminal)?;
        for key in ["feedback", "closed_loop", "dissipation", "attenuation"] {
            summary[key] = laws[key].clone();
        }
        draft.publish()?;
    }
    let page = (all && !args.no_report)
        .then(|| afterwards::page(&path, &terminal))
        .flatten();
    summary["report"] = serde_json::json!(page.as_ref().map(|p| p.display().to_string()));
    if args.scene.json {
        super::print(&format!("{summary:#}\n"))?;
    }
    let report = page.map_or_else(String::new, |p| format!("; report: {}", p.display()));
    let seconds = clock.elapsed().as_secs_f64();
    terminal.say(&format!(
        "{seconds:.2} s, written to {}{report}",
        path.display()
    ))?;
    Ok(())
}

/// The states that a run solves for, and where their answers go.
struct WantedStates {
    states: usize,
    request: Request,
    /// The grid of `/map` is the last one.
    map: bool,
}

impl WantedStates {
    fn count(&self) -> usize {
        self.request.grids.iter().map(Grid::len).sum::<usize>()
            + self.request.points.len() / self.states
    }

    /// How many of the states given, from the first on, belong to `/points`. Single states and a
    /// map never come together.
    fn points(&self) -> usize {
        let map = self.request.grids.last().filter(|_| self.map);
        self.count() - map.map_or(0, Grid::len)
    }

    /// V on a grid over the states.
    fn grid(
        &self,
        scene: &Scene,
        plan: &Plan,
        backend: &dyn Backend,
        terminal: &report::Terminal,
    ) -> Result<Arc<GridValue>, CliError> {
        let bar = terminal.progress();
        bar.say("V on a grid");
        let grids = self.request.grids.iter().flat_map(Grid::points);
        let states: Vec<f64> = grids.chain(self.request.points.iter().copied()).collect();
        let grid = super::grid::for_guesses(scene, plan, backend, &states)?;
        bar.clear();
        Ok(Arc::new(grid))
    }

    /// Solves for the states, with first guesses from an archive.
    fn solve(
        &self,
        plan: &Plan,
        model: &Model,
        solver: &mut Solver,
        archive: &Archive,
        terminal: &report::Terminal,
    ) -> Result<Answers, CliError> {
        let bar = terminal.progress();
        let mut told = |what: &str, done: usize, of: usize| {
            bar.say(&format!("{done} of {of} states solved, {what}"))
        };
        let found = value::solve(plan, model, solver, archive, &self.request, &mut told)?;
        bar.clear();
        Ok(found)
    }

    fn write(
        &self,
        file: &mut ResultFile,
        schema: &TrajectorySchema,
        model: &Model,
        answers: &Answers,
    ) -> Result<(), CliError> {
        let points = self.points();
        file.points(schema, answers, 0, points)?;
        if let (true, Some(grid)) = (self.map, self.request.grids.last()) {
            let value_max = model.map.as_ref().and_then(|m| m.value_max);
            file.map(schema, answers, grid, points, value_max)?;
        }
        file.sheet_edges(schema, answers)?;
        Ok(())
    }
}

/// What a run solves for; `None` where nothing.
fn wanted(model: &Model, parts: Parts<'_>) -> Result<Option<WantedStates>, CliError> {
    match parts {
        Parts::ShootOut => Ok(None),
        Parts::Solve(solve) => Ok(Some(WantedStates {
            states: model.states.len(),
            request: Request {
                points: points::read(&solve.points, model)?,
                one_sheet: solve.one_sheet,
                ..Request::default()
            },
            map: false,
        })),
        Parts::All | Parts::Homotopy => {
            let homotopy = model.homotopy.as_ref().map(Grid::homotopy);
            let map = model.map.as_ref().map(|m| Grid::map(m, model));
            // Each state is an axis of the map, under its own name.
            const TAKEN: [&str; 14] = [
                "V",
                "p",
                "u",
                "sheet",
                "lifted_sheet",
                "winding",
                "status",
                "evidence",
                "covered_to",
                "bound",
                "starts",
                "flights",
                "state",
                "control",
            ];
            let clash = model
                .states
                .iter()
                .find(|s| TAKEN.contains(&s.variable.name.as_str()));
            if let (Some(state), true) = (clash, map.is_some()) {
                return Err(CliError::MapName {
                    name: state.variable.name.clone(),
                });
            }
            if homotopy.is_none() && map.is_none() {
                return match parts {
                    Parts::Homotopy if model.map_aim.is_none() => Err(CliError::NoTargets),
                    _ => Ok(None),
                };
            }
            Ok(Some(WantedStates {
                states: model.states.len(),
                map: map.is_some(),
                request: Request {
                    limits: (homotopy.iter().map(|_| f64::INFINITY))
                        .chain(
                            model
                                .map
                                .iter()
                                .map(|m| m.value_max.unwrap_or(f64::INFINITY)),
                        )
                        .collect(),
                    grids: homotopy.into_iter().chain(map).collect(),
                    ..Request::default()
                },
            }))
        }
    }
}

/// The backend asked for, fit for the method asked for where the choice is ours.
pub(super) fn open_backend(
    choice: BackendChoice,
    adapter: Option<&str>,
    method: Option<Method>,
) -> Result<Box<dyn Backend>, CliError> {
    let selection = match (adapter, choice) {
        (Some(name), BackendChoice::Cpu) => {
            return Err(CliError::AdapterOfCpu {
                name: name.to_owned(),
            });
        }
        (None, BackendChoice::Cpu) => return Ok(Box::new(Cpu::new())),
        (Some(name), _) => Selection::Named(name.to_owned()),
        (None, BackendChoice::Gpu) => Selection::Any,
        (None, BackendChoice::Auto) => Selection::Hardware,
    };
    match Gpu::open(&selection)? {
        // Where the choice is ours, a method asked for counts.
        Some(gpu) if selection == Selection::Hardware && method.is_some_and(|m| !gpu.offers(m)) => {
            Ok(Box::new(Cpu::new()))
        }
        Some(gpu) => Ok(Box::new(gpu)),
        // Only a search for hardware comes back empty.
        None => Ok(Box::new(Cpu::new())),
    }
}

pub(super) fn default_output(scenario: &Path) -> PathBuf {
    output_of(scenario, "")
}

/// The same of a command with a file of its own, whose name ends so.
pub(super) fn output_of(scenario: &Path, ending: &str) -> PathBuf {
    let mut name = scenario
        .file_stem()
        .unwrap_or_else(|| "result".as_ref())
        .to_owned();
    name.push(ending);
    name.push(".h5");
    Path::new("out").join(name)
}

/// Where results go that nobody has named a file for. Answers at some states are not written over
/// the results of a run; then these are the second path.
fn own_output(scenario: &Path, answers: bool) -> (PathBuf, Option<PathBuf>) {
    const OTHERS: [&str; 8] = [
        "map_pieces",
        "map",
        "study",
        "feedback",
        "closed_loop",
        "dissipation",
        "attenuation",
        "caustic",
    ];
    let path = default_output(scenario);
    if !answers || !Stored::open(&path).is_ok_and(|stored| stored.has_any(&OTHERS)) {
        return (path, None);
    }
    (output_of(scenario, "_points"), Some(path))
}

pub(super) fn schema(model: &Model, plan: &Plan) -> TrajectorySchema {
    TrajectorySchema {
        samples: plan.samples(),
        status_flags: plan.status_flags(),
        ..axes(model)
    }
}

/// The axes alone.
pub(super) fn axes(model: &Model) -> TrajectorySchema {
    let axis = |v: &costate::model::Variable| Axis {
        name: v.name.clone(),
        unit: v.unit.clone(),
        long_name: v.long_name.clone(),
    };
    TrajectorySchema {
        states: model.states.iter().map(|s| axis(&s.variable)).collect(),
        controls: model.controls.iter().map(|c| axis(&c.variable)).collect(),
        disturbances: model.disturbances.iter().map(axis).collect(),
        ..TrajectorySchema::default()
    }
}

/// Sweeps for a run: trajectories go to `write`, and into the archive where there is one.
fn swept_for(
    plan: &Plan,
    backend: &dyn Backend,
    terminal: &mut report::Terminal,
    mut archive: Option<&mut Archive>,
    write: &mut dyn FnMut(TrajectoryBlock) -> Result<(), CliError>,
) -> Result<SweepReport, CliError> {
    let mut keep = |seeds: &[f64], batch: &Trajectories| {
        if let Some(archive) = &mut archive {
            archive.keep(seeds, batch);
        }
    };
    let swept = sweep_into(plan, backend, terminal, &mut keep, write)?;
    if swept.trajectories == 0 {
        return Err(CliError::NothingSwept {
            outside: swept.coverage.outside_guards,
        });
    }
    Ok(swept)
}

/// Sweeps on a thread of its own while this one writes, so that writing costs no time of the
/// sweep's.
pub(super) fn sweep_into(
    plan: &Plan,
    backend: &dyn Backend,
    terminal: &mut report::Terminal,
    keep: &mut (dyn FnMut(&[f64], &Trajectories) + Send),
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
            let result = sweep_keeping(
                plan,
                backend,
                &mut told,
                &mut |seeds, batch| keep(seeds, batch),
                &mut |block| send.send(block).map_err(|_| Stop::Gone),
            );
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
