//! `costate evaluate`: laws simulated side by side.

use super::check::loaded;
use super::columns::columns;
use super::report::Terminal;
use super::run::output_of;
use super::{CliError, EvaluateArgs, dissipation};
use costate::backend::Backend;
use costate::closed_loop::{
    self, Available, Chart, Evaluation, GROUPS, Initial, LQR, Law, Laws, MAP, Setting, Weights,
    solved_values,
};
use costate::hdf5::ResultFile;
use costate::map::ValueMap;
use costate::model::{ClosedLoop, Model, Outside};
use costate::result::{RunRecord, Stored};
use costate::scene::Scene;
use costate::sweep::Choices;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::time::{Instant, SystemTime};

/// What the command line, or a run that ends with an evaluation, asks for beside the scene.
#[derive(Default)]
pub(super) struct Wanted {
    pub choices: Choices,
    pub laws: Option<Vec<String>>,
    pub weights: Vec<Weights>,
    pub random: Option<usize>,
    /// V at the initial states is solved for.
    pub solve: bool,
}

pub(super) fn evaluate(args: &EvaluateArgs) -> Result<(), CliError> {
    let (started, clock) = (SystemTime::now(), Instant::now());
    let inputs: Vec<&Path> = [&args.file]
        .into_iter()
        .chain(&args.scene)
        .chain(&args.weights)
        .map(PathBuf::as_path)
        .collect();
    super::check_out(args.out.as_deref(), &[super::Kind::Result], &inputs)?;
    let stored = match args.file.extension() {
        Some(end) if end.eq_ignore_ascii_case("toml") => None,
        _ => Some(Stored::open(&args.file)?),
    };
    if stored.is_some() && args.scene.is_none() && !args.set.is_empty() {
        return Err(CliError::SetOfResult);
    }
    let other = match (&stored, &args.scene) {
        (Some(_), None) => None,
        (Some(stored), Some(scene)) => Some(other_scene(stored, scene, &args.set)?),
        (None, _) => Some(loaded(&args.file, &args.set)?),
    };
    let scene = match (&other, &stored) {
        (Some(scene), _) => scene,
        (None, Some(stored)) => &stored.scene,
        (None, None) => return Err(CliError::NoClosedLoop),
    };
    let model = &scene.model;
    if model.closed_loop.is_none() && model.dissipation.is_none() {
        return Err(CliError::NoClosedLoop);
    }
    let backend = args.numerics.open(model)?;
    let wanted = Wanted {
        choices: args.numerics.choices(args.seed),
        laws: (!args.laws.is_empty()).then(|| args.laws.clone()),
        weights: args.weights.iter().map(weights).collect::<Result<_, _>>()?,
        random: args.random,
        solve: args.solve,
    };
    let terminal = Terminal::with(args.quiet, args.json);
    let mut file = match (&stored, &args.out) {
        (Some(_), None) => {
            // Of what is simulated again nothing old is left.
            let parts = [
                (model.closed_loop.is_some(), GROUPS.as_slice()),
                (
                    model.dissipation.is_some(),
                    &closed_loop::dissipation::GROUPS,
                ),
            ];
            let replaced: Vec<&str> = (parts.iter().filter(|(there, _)| *there))
                .flat_map(|(_, groups)| groups.iter().copied())
                .collect();
            ResultFile::extend(&args.file, &replaced)?
        }
        (Some(_), Some(out)) => ResultFile::create(out)?,
        (None, out) => ResultFile::create(
            out.clone()
                .unwrap_or_else(|| output_of(&args.file, "_closed_loop")),
        )?,
    };
    let from = Sources::new(stored.as_ref(), &wanted, &terminal)?;
    let mut summary = serde_json::json!({});
    let mut numerics = None;
    if model.closed_loop.is_some() {
        let (evaluation, own) = perform(
            &from,
            scene,
            &wanted,
            backend.as_ref(),
            &terminal,
            &mut file,
        )?;
        (summary, numerics) = (as_json(&evaluation, file.path()), Some(own));
    }
    if model.dissipation.is_some() {
        let check = dissipation::perform(
            &from,
            scene,
            &wanted,
            backend.as_ref(),
            &terminal,
            &mut file,
        )?;
        summary["file"] = serde_json::json!(file.path().display().to_string());
        summary["dissipation"] = dissipation::as_json(&check);
        numerics = numerics.or(Some(check.numerics));
    }
    let Some(numerics) = numerics else {
        return Err(CliError::NoClosedLoop);
    };
    if stored.is_none() || args.out.is_some() {
        let record = RunRecord {
            backend: backend.name().to_owned(),
            adapter: backend.adapter(),
            precision: numerics.precision.name().to_owned(),
            method: numerics.method.name().to_owned(),
            rtol: numerics.rtol,
            atol: numerics.atol,
            wall_seconds: clock.elapsed().as_secs_f64(),
            ..super::begun(model, started)
        };
        record.write(&file)?;
    }
    let path = file.finish()?;
    if args.json {
        writeln!(std::io::stdout(), "{summary:#}")?;
    }
    terminal.say(&format!(
        "{:.2} s, written to {}",
        clock.elapsed().as_secs_f64(),
        path.display()
    ))?;
    Ok(())
}

/// What laws and V are taken from besides the scene.
pub(super) struct Sources<'s> {
    pub stored: Option<&'s Stored>,
    pub map: Option<ValueMap>,
    available: Available,
}

impl<'s> Sources<'s> {
    /// A result file's map and fitted laws, and those of the command line.
    pub fn new(
        stored: Option<&'s Stored>,
        wanted: &Wanted,
        terminal: &Terminal,
    ) -> Result<Self, CliError> {
        // Without a law that asks for it the map still tells V.
        let map = stored.filter(|s| s.has_any(&["trajectories", "points", "map", "map_pieces"]));
        let map = map.and_then(|s| {
            let unknown = |e| terminal.note(&format!("no value map: {e}"));
            s.value_map().map_err(unknown).ok()
        });
        let available = Available {
            map: map.is_some(),
            fitted: stored.map(fitted).transpose()?.unwrap_or_default(),
            added: wanted.weights.clone(),
        };
        Ok(Self {
            stored,
            map,
            available,
        })
    }

    pub fn chart(&self) -> Option<&dyn Chart> {
        self.map.as_ref().map(|m| m as &dyn Chart)
    }

    /// The laws that a section asks for; `map` says whether the law of V is there.
    pub fn choose(
        &self,
        laws: &Laws<'_>,
        scene: &ClosedLoop,
        (wanted, map): (&Wanted, bool),
        terminal: &Terminal,
    ) -> Result<Vec<Law>, CliError> {
        let available = Available {
            map,
            ..self.available.clone()
        };
        if let Some(twice) = (available.added.iter()).find(|w| {
            [LQR, MAP].contains(&w.name.as_str())
                || available.fitted.iter().any(|f| f.name == w.name)
                || scene.given.iter().any(|g| g.name == w.name)
        }) {
            return Err(CliError::SameLaw {
                name: twice.name.clone(),
            });
        }
        let chosen = available.choose(laws, scene, wanted.laws.as_deref())?;
        for name in &chosen.missing {
            terminal.note(&format!(
                "law `{name}` is left out: there is none in the result file (yet)"
            ));
        }
        if chosen.laws.is_empty() {
            return Err(CliError::NoLaws);
        }
        Ok(chosen.laws)
    }
}

/// Simulates the laws of a scene's `[closed_loop]` and writes what came of it.
pub(super) fn perform(
    from: &Sources<'_>,
    given: &Scene,
    wanted: &Wanted,
    backend: &dyn Backend,
    terminal: &Terminal,
    file: &mut ResultFile,
) -> Result<(Evaluation, costate::sweep::Numerics), CliError> {
    let Scene {
        model, hamiltonian, ..
    } = given;
    let scene = model.closed_loop.as_ref().ok_or(CliError::NoClosedLoop)?;
    let laws = Laws::new(model, hamiltonian, scene.track);
    let setting = Setting::new(&laws, scene, backend, wanted.choices)?;
    let chart = from.chart();
    let chosen = from.choose(&laws, scene, (wanted, chart.is_some()), terminal)?;
    if let (Some(map), Some(_)) = (&from.map, model.final_time())
        && map.time().is_none()
        && chosen
            .iter()
            .any(|law| law.name == costate::closed_loop::MAP)
    {
        terminal.note(
            "law `map`: the file knows V at the initial time alone, and the law takes it for V at all times ([map] with error = ..., without \
             time = false, makes V(x, t))",
        );
    }
    let initial = Initial::new(model, scene, wanted.random, wanted.choices.seed)?;
    let bar = terminal.progress();
    let values = if wanted.solve {
        let mut told = |what: &str, done: usize, of: usize| {
            bar.say(&format!("{done} of {of} states solved, {what}"))
        };
        Some(solved_values(
            model,
            hamiltonian,
            backend,
            wanted.choices,
            &initial.x,
            &mut told,
        )?)
    } else {
        Some(known_values(from, model, &initial, terminal)?)
    };
    let evaluation = setting.evaluate(&chosen, initial, chart, values, backend, &mut |law| {
        bar.say(&format!("closed loop of {law}"));
    })?;
    bar.clear();
    evaluation.write(&setting, file)?;
    for law in evaluation.laws.iter().filter(|l| l.held > 0.0) {
        terminal.note(&format!(
            "law `{}`: along {} of {} closed loops ({:.2} % of all updates) the map had no answer somewhere: {}",
            law.name,
            law.fell_back(),
            law.status.len(),
            100.0 * law.held,
            match scene.outside {
                Outside::Stop => "they end there",
                Outside::Hold => "the law held its last p = q + H s",
                Outside::Nearest => "the law took p of the nearest state known",
                Outside::Search => "the law took p of the nearest state known, or held a control at its bound, as a search for a way back said",
                Outside::Local => "the law was that of the Riccati solution",
            }
        ));
    }
    terminal.say(&as_text(&evaluation, &setting, scene))?;
    Ok((evaluation, setting.numerics))
}

/// V of the states solved for in a result file and, elsewhere, of its map, as far as that is good;
/// NaN where it is not known.
fn known_values(
    from: &Sources<'_>,
    model: &Model,
    initial: &Initial,
    terminal: &Terminal,
) -> Result<Vec<f64>, CliError> {
    /// Largest estimated error of V, of V.
    const GOOD: f64 = 0.01;
    /// States at which it is estimated, which takes a hundred times longer than V.
    const ESTIMATED: usize = 5000;
    let unknown = vec![f64::NAN; initial.count()];
    let Some(stored) = from.stored else {
        return Ok(unknown);
    };
    if !same_problem(&stored.scene.model, model) {
        terminal.note("V in the file is of another problem (other parameters, equations or cost): J is not compared with it (--solve finds V)");
        return Ok(unknown);
    }
    let mut values = match stored.points()? {
        Some(points) => {
            let widths: Vec<f64> = model.region.iter().map(|[lo, hi]| hi - lo).collect();
            initial.looked_up(&points.x, &points.v, &widths)
        }
        None => unknown,
    };
    let Some(map) = &from.map else {
        return Ok(values);
    };
    let estimated = initial.count() <= ESTIMATED;
    let said: Vec<f64> = if estimated {
        let known = |at: costate::map::At| {
            at.lowest
                .map_or((f64::NAN, 0.0), |here| (here.v, here.v_error))
        };
        let told = map.at_many(&initial.x, true).into_iter().map(known);
        told.map(|(v, error)| {
            if error > GOOD * v.abs() {
                f64::INFINITY
            } else {
                v
            }
        })
        .collect()
    } else {
        map.many(&initial.x).v
    };
    let charted: Vec<Option<f64>> = (said.iter().zip(&values))
        .map(|(said, known)| match known.is_nan() {
            false => Some(*known),
            // Marked: known, but not well enough.
            true => Some(*said).filter(|v| v.is_nan() || v.is_finite()),
        })
        .collect();
    let doubtful = charted.iter().filter(|v| v.is_none()).count();
    if doubtful > 0 {
        terminal.note(&format!(
            "at {doubtful} initial states V's estimated error is above 1 %: J is not compared with it there (--solve finds V)"
        ));
    }
    for (value, charted) in values.iter_mut().zip(charted) {
        *value = charted.unwrap_or(f64::NAN);
    }
    Ok(values)
}

/// Whether two scenes have the same equations, cost and parameters, so that V of one is V of the
/// other.
pub(super) fn same_problem(a: &Model, b: &Model) -> bool {
    let shown = |m: &Model| -> Vec<String> {
        let cost = std::iter::once(m.running.expr);
        let exprs = m.dynamics.iter().map(|f| f.expr).chain(cost);
        let parameters = m
            .parameters
            .iter()
            .map(|p| format!("{} = {:?}", p.name, p.value));
        let controls = m
            .controls
            .iter()
            .map(|c| format!("{:?} {:?}", c.min, c.max));
        exprs
            .map(|e| m.graph.show(e))
            .chain(parameters)
            .chain(controls)
            .collect()
    };
    shown(a) == shown(b) && a.reference() == b.reference()
}

/// Another scene with the states and controls of the stored one, and the parameters that the stored
/// run was given.
pub(super) fn other_scene(
    stored: &Stored,
    path: &Path,
    set: &[(String, String)],
) -> Result<Scene, CliError> {
    let overrides = [stored.scene.model.overrides.as_slice(), set].concat();
    let scene = loaded(path, &overrides)?;
    let model = &scene.model;
    let states = |m: &Model| {
        m.states
            .iter()
            .map(|s| s.variable.name.clone())
            .collect::<Vec<_>>()
    };
    let controls = |m: &Model| {
        m.controls
            .iter()
            .map(|c| c.variable.name.clone())
            .collect::<Vec<_>>()
    };
    if states(model) != states(&stored.scene.model)
        || controls(model) != controls(&stored.scene.model)
    {
        return Err(CliError::OtherScene {
            scene: path.to_owned(),
            file: stored.path.clone(),
        });
    }
    Ok(scene)
}

fn weights(path: &PathBuf) -> Result<Weights, CliError> {
    let text = std::fs::read_to_string(path).map_err(|source| {
        CliError::Law(costate::closed_loop::LawError::Read {
            path: path.clone(),
            source,
        })
    })?;
    let stem = path
        .file_stem()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned();
    Ok(Weights {
        name: stem,
        text,
        file: path.display().to_string(),
    })
}

/// The laws fitted into a result file.
pub(super) fn fitted(stored: &Stored) -> Result<Vec<Weights>, CliError> {
    let Some(group) = stored.group("feedback") else {
        return Ok(Vec::new());
    };
    let (names, texts) = (group.texts("law")?, group.texts("toml")?);
    let file = |name: &str| format!("/feedback, law {name}");
    Ok((names.into_iter().zip(texts))
        .map(|(name, text)| Weights {
            file: file(&name),
            name,
            text,
        })
        .collect())
}

/// Laws side by side.
fn as_text(e: &Evaluation, setting: &Setting<'_>, scene: &ClosedLoop) -> String {
    let numerics = &setting.numerics;
    let known = e.values.iter().filter(|v| !v.is_nan()).count();
    let mapped = e.laws.iter().any(|law| law.name == MAP) && setting.leg_method != numerics.method;
    let legs = if mapped {
        format!(" (law `map`: {})", setting.leg_method.name())
    } else {
        String::new()
    };
    let t = format!(
        "closed loop from {} initial states to t = {}: {} on {}, {} {}{legs}, rtol {:e}; V known at {known}\n",
        e.initial.count(),
        scene.final_time,
        e.backend,
        e.adapter,
        numerics.precision.name(),
        numerics.method.name(),
        numerics.rtol
    );
    let mut rows: Vec<Vec<String>> = vec![
        ["law", "converged", "J/V - 1 median", "99 %"]
            .into_iter()
            .map(str::to_owned)
            .chain(e.records.iter().map(|(name, _)| name.clone()))
            .chain(e.asked.iter().map(|s| s.name.clone()))
            .chain(["states/s", "ended"].map(str::to_owned))
            .collect(),
    ];
    for (law, sets) in e.laws.iter().zip(&e.sets) {
        let spread = e.spread(law);
        let number = |v: Option<f64>| v.map_or_else(|| "-".to_owned(), |v| format!("{v:.2e}"));
        let mut row = vec![
            law.name.clone(),
            format!("{:.2} %", 100.0 * law.share_converged()),
            number(spread.map(|s| s.median)),
            number(spread.map(|s| s.p99)),
        ];
        row.extend((0..e.records.len()).map(|k| format!("{:.5}", e.worst(law, k))));
        row.extend(sets.iter().map(|s| format!("{:.2} %", 100.0 * s.share)));
        row.push(format!("{:.0}", law.rate()));
        row.push(e.status_text(law));
        rows.push(row);
    }
    t + &columns(&rows, &[0, rows[0].len() - 1])
}

pub(super) fn as_json(e: &Evaluation, path: &Path) -> serde_json::Value {
    let laws: Vec<_> = (e.laws.iter().zip(&e.sets))
        .map(|(law, sets)| {
            let spread = e
                .spread(law)
                .map(|s| serde_json::json!({ "median": s.median, "p99": s.p99, "max": s.worst, "count": s.count }));
            let records: serde_json::Map<_, _> = (e.records.iter().enumerate())
                .map(|(k, (name, _))| (name.clone(), serde_json::json!(e.worst(law, k))))
                .collect();
            let sets: serde_json::Map<_, _> = (e.asked.iter().zip(sets))
                .map(|(set, r)| {
                    (
                        set.name.clone(),
                        serde_json::json!({ "share": r.share, "area": r.area }),
                    )
                })
                .collect();
            serde_json::json!({
                "name": law.name, "source": law.source, "share_converged": law.share_converged(),
                "suboptimality": spread, "worst": records, "sets": sets, "statuses": e.statuses(law), "held": law.held,
                "fell_back": law.fell_back(),
                "seconds": law.seconds, "states_per_second": law.rate(),
            })
        })
        .collect();
    serde_json::json!({
        "file": path.display().to_string(), "initial_states": e.initial.count(), "backend": e.backend, "adapter": e.adapter,
        "values_known": e.values.iter().filter(|v| !v.is_nan()).count(), "laws": laws,
    })
}
