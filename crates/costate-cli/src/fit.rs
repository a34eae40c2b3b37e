//! `costate fit`: laws from the trajectories of a result file.

use super::evaluate::other_scene;
use super::report::{Bar, Terminal};
use super::{CliError, FitArgs};
use costate::feedback::{Data, Exports, Fitted, FittedLaw, GROUP, Samples, Step, fit};
use costate::files::can_hold;
use costate::hdf5::ResultFile;
use costate::map::ValueMap;
use costate::model::{Feedback, Model};
use costate::result::Stored;
use serde_json::{Value, json};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// Why laws were not fitted.
#[derive(Debug, thiserror::Error)]
pub(super) enum FitCommandError {
    #[error("{path} asks for no law: it has no [feedback] (or take one from another scenario with --scene)", path = path.display())]
    NoFeedback { path: PathBuf },
    #[error("{path} holds neither trajectories, solved states nor a map to an error to fit a law to", path = path.display())]
    NoData { path: PathBuf },
}

/// Laws of a scene as fitted, with what was written of each.
pub(super) struct Done {
    pub fitted: Fitted,
    pub exports: Vec<Exports>,
}

pub(super) fn command(args: &FitArgs) -> Result<(), CliError> {
    let stored = Stored::open(&args.file)?;
    let terminal = Terminal::with(args.quiet, args.json);
    let other = (args.scene.as_deref()).map(|scene| other_scene(&stored, scene, &[]));
    let other = other.transpose()?;
    let scene = other
        .as_ref()
        .map_or(&stored.scene.model, |scene| &scene.model);
    if scene.feedback.is_empty() {
        let path = args.scene.clone().unwrap_or_else(|| args.file.clone());
        return Err(FitCommandError::NoFeedback { path }.into());
    }
    let mut laws = scene.feedback.clone();
    for law in &mut laws {
        law.seed = args.seed.unwrap_or(law.seed);
        law.starts = args.starts.unwrap_or(law.starts);
    }
    let done = fit_laws(
        &stored,
        scene,
        &laws,
        &Beside::of(&args.file, args.out_dir.as_deref()),
        &terminal,
    )?;
    if args.json {
        let summary = json!({ "file": args.file.display().to_string(), "laws": laws_json(&done) });
        writeln!(std::io::stdout(), "{summary:#}")?;
    }
    terminal.say(&done.text())?;
    Ok(())
}

/// States of a map to an error that are looked at for each sample wanted: conditions leave some
/// out.
const LOOKED_AT: usize = 8;
/// The most of them.
const MOST_LOOKED_AT: usize = 1 << 20;

/// Who knows which samples are optimal: the value map, where solutions of several sheets may be in
/// the file, or samples are the map's own. Where it has no objection, neighbouring samples decide.
fn judge(stored: &Stored, mapped: bool) -> Option<ValueMap> {
    let periodic = stored.scene.model.states.iter().any(|s| s.period.is_some());
    let asked = periodic || stored.has("points_sheets") || mapped;
    asked.then(|| stored.value_map().ok())?
}

/// Whether a file has a map to an error to draw samples from; on a finite horizon laws are fitted
/// along trajectories.
fn is_mapped(stored: &Stored) -> bool {
    stored.has("map_pieces") && stored.scene.model.final_time().is_none()
}

/// Where the laws' files go, and what their names begin with.
pub(super) struct Beside {
    directory: PathBuf,
    stem: String,
}

impl Beside {
    /// Beside a result file, unless a directory is given.
    pub fn of(path: &Path, directory: Option<&Path>) -> Self {
        Self {
            directory: directory
                .or(path.parent())
                .unwrap_or(Path::new(""))
                .to_owned(),
            stem: path
                .file_stem()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned(),
        }
    }

    /// Whether the files can be written there, as far as can be told before: fitting takes long.
    fn check(&self, scene: &Model, laws: &[Feedback]) -> Result<(), CliError> {
        // What is not there yet is made in what is.
        let place = (self.directory.ancestors().find(|d| d.exists())).unwrap_or(Path::new("."));
        let holds = match place.is_dir() {
            true => can_hold(place),
            false => Err(std::io::Error::other(format!(
                "{} is not a directory",
                place.display()
            ))),
        };
        holds.map_err(|source| CliError::OutDir {
            path: self.directory.clone(),
            source,
        })?;
        let scene = std::fs::canonicalize(&scene.file_name).ok();
        for law in laws {
            let weights = self
                .directory
                .join(format!("{}_{}.toml", self.stem, law.name));
            if scene.is_some() && scene == std::fs::canonicalize(&weights).ok() {
                return Err(CliError::OverScene {
                    name: law.name.clone(),
                    path: weights,
                });
            }
        }
        Ok(())
    }
}

/// Fits `laws` of `scene` to what a result file holds, writes `/feedback` into it, and the laws'
/// files to where they go.
pub(super) fn fit_laws(
    stored: &Stored,
    scene: &Model,
    laws: &[Feedback],
    beside: &Beside,
    terminal: &Terminal,
) -> Result<Done, CliError> {
    beside.check(scene, laws)?;
    let sizes = (
        stored.scene.model.states.len(),
        stored.scene.model.controls.len(),
    );
    let samples = Samples::new(
        sizes,
        stored.trajectories()?.as_ref(),
        stored.points()?.as_ref(),
    );
    let mapped = is_mapped(stored);
    if samples.is_empty() && !mapped {
        return Err(FitCommandError::NoData {
            path: stored.path.clone(),
        }
        .into());
    }
    let bar = terminal.progress();
    bar.say("reading the value map");
    let map = judge(stored, mapped);
    let known = |x: &[f64], v: f64| {
        map.as_ref()
            .filter(|map| !map.is_lowest(x, v))
            .map(|_| false)
    };
    let mut fitted = Fitted::default();
    for law in laws {
        let of_map = (map.as_ref().filter(|_| mapped)).map(|map| {
            samples.with_map(
                map,
                &law.bounds,
                (LOOKED_AT * law.max_samples).min(MOST_LOOKED_AT),
            )
        });
        let data = Data {
            model: &stored.scene.model,
            hamiltonian: &stored.scene.hamiltonian,
            samples: of_map.as_ref().unwrap_or(&samples),
            known: &known,
        };
        let made = fit(data, scene, law, &Shown::new(&bar, law).report());
        fitted.laws.push(made.inspect_err(|_| bar.clear())?);
    }
    bar.clear();
    let mut file = ResultFile::extend(&stored.path, &[GROUP])?;
    fitted.write(&mut file)?;
    file.finish()?;
    let directory = &beside.directory;
    if !directory.as_os_str().is_empty() {
        std::fs::create_dir_all(directory).map_err(|source| CliError::OutDir {
            path: directory.clone(),
            source,
        })?;
    }
    let exports = fitted.export(directory, &beside.stem, &stored.scene.model)?;
    Ok(Done { fitted, exports })
}

/// What the bar says of a fit: the steps of all starts together, and the best of them so far.
struct Shown<'b> {
    bar: &'b Bar,
    law: &'b Feedback,
    /// Steps taken, and the smallest validation residual.
    so_far: Mutex<(usize, f64)>,
}

impl<'b> Shown<'b> {
    fn new(bar: &'b Bar, law: &'b Feedback) -> Self {
        bar.say(&format!("law {}: selecting data", law.name));
        Self {
            bar,
            law,
            so_far: Mutex::new((0, f64::INFINITY)),
        }
    }

    fn report(self) -> impl Fn(Step) + Sync + 'b {
        move |step| {
            // A panic elsewhere is reported there.
            let Ok(mut so_far) = self.so_far.lock() else {
                return;
            };
            so_far.0 += 1;
            so_far.1 = so_far.1.min(step.validation);
            let (steps, best) = *so_far;
            let starts = self.law.starts;
            self.bar.say(&format!(
                "law {}: {steps} steps of {starts} starts, residual on the validation set {best:.2e}",
                self.law.name
            ));
        }
    }
}

impl Done {
    /// For a person, one paragraph a law.
    pub fn text(&self) -> String {
        let laws = self.fitted.laws.iter().zip(&self.exports);
        laws.map(|(law, exports)| law_text(law, exports))
            .collect::<Vec<_>>()
            .join("\n")
    }
}

fn law_text(l: &FittedLaw, exports: &Exports) -> String {
    let sizes = l
        .law
        .network
        .layers
        .iter()
        .map(|layer| layer.bias.len().to_string());
    let sizes = [
        vec![l.law.network.inputs.len().to_string()],
        sizes.collect(),
    ]
    .concat()
    .join("-");
    let what = match l.form.value {
        Some(_) => "V; u = u*(x, dV/dx)".to_owned(),
        None => l.form.outputs.join(", "),
    };
    let base = if l.law.base.is_some() {
        " beside the local solution"
    } else {
        ""
    };
    let q = &l.quality;
    let mut lines = vec![
        format!(
            "law {}: {what}: a {sizes} {} network{base}, {} weights, {:.0} flops a call",
            l.name,
            l.law.network.activation.name(),
            l.parameters,
            l.flops
        ),
        format!(
            "  data: {} of {} samples in the box, {} of them not optimal; {} + {} + {} samples of {} + {} + {} trajectories \
             (training, validation, test)",
            l.selection.selected,
            l.selection.offered,
            l.selection.not_optimal,
            l.sets[0],
            l.sets[1],
            l.sets[2],
            l.trajectories[0],
            l.trajectories[1],
            l.trajectories[2]
        ),
        format!(
            "  u on test trajectories: mean error {:.2e}, largest {:.2e} (of mean |u|); mean error {:.2e} of the range",
            q.u.mean, q.u.max, q.u.mean_of_range
        ),
    ];
    if let (Some(v), Some(p), Some(h)) = (&q.v, &q.p, &q.hjb) {
        lines.push(format!(
            "  V: mean error {:.2e}, largest {:.2e} (of mean V); p: mean error {:.2e}, largest {:.2e} (of mean |p|)",
            v.mean, v.max, p.mean, p.max
        ));
        lines.push(format!(
            "  |H(x, dV/dx)| over the mean running cost {:.3e}: median {:.1e}, 90 % {:.1e}, 99 % {:.1e}, largest {:.1e}",
            h.scale, h.median, h.q90, h.q99, h.max
        ));
    }
    if let Some(loss) = &q.loss {
        let named = |values: &mut dyn Iterator<Item = String>| -> String {
            let pairs = l.form.x.iter().zip(values);
            let pairs = pairs.map(|(x, value)| format!("{} {value}", l.form.graph.show(*x)));
            pairs.collect::<Vec<_>>().join(", ")
        };
        lines.push(format!(
            "  loss on test trajectories, H(x, p, u) - H(x, p, u*) over the mean running cost {:.3e}: mean {:.1e}, 99 % {:.1e}, largest {:.1e}",
            loss.scale, loss.mean, loss.q99, loss.max
        ));
        lines.push(format!(
            "    largest at {}; the largest hundredth within {}",
            named(&mut loss.at.iter().map(|x| format!("= {x:.4}"))),
            named(
                &mut loss
                    .worst
                    .iter()
                    .map(|[lower, upper]| format!("[{lower:.4}, {upper:.4}]"))
            )
        ));
    }
    if l.narrow_units > 0 {
        lines.push(format!(
            "  warning: {} hidden unit{} rise over less than the distance between samples: between these nothing holds the law \
             (more samples, fewer units, or another seed)",
            l.narrow_units,
            if l.narrow_units == 1 { "" } else { "s" }
        ));
    }
    let files = exports.files.iter().map(|f| f.display().to_string());
    lines.push(format!(
        "  {:.1} s, {} starts, best after {} steps (seed {}); {}",
        l.seconds,
        l.starts,
        l.iterations,
        l.seed,
        files.collect::<Vec<_>>().join(", ")
    ));
    if let Some(reason) = &exports.without_onnx {
        lines.push(format!("  no ONNX model: {reason}"));
    }
    lines.join("\n")
}

/// All laws, for `--json`.
pub(super) fn laws_json(done: &Done) -> Value {
    let laws = done.fitted.laws.iter().zip(&done.exports);
    laws.map(|(l, e)| as_json(l, e)).collect()
}

fn as_json(l: &FittedLaw, exports: &Exports) -> Value {
    let errors = |e: &costate::feedback::Errors| json!({ "mean": e.mean, "max": e.max, "mean_of_range": e.mean_of_range });
    let q = &l.quality;
    json!({
        "name": l.name,
        "kind": l.law.meaning.name(),
        "outputs": l.form.outputs,
        "parameters": l.parameters,
        "flops": l.flops,
        "samples": l.sets,
        "trajectories": l.trajectories,
        "not_optimal": l.selection.not_optimal,
        "u_error": errors(&q.u),
        "V_error": q.v.as_ref().map(errors),
        "p_error": q.p.as_ref().map(errors),
        "hjb_residual": q.hjb.map(|h| json!({
            "running_cost_scale": h.scale, "median": h.median, "q90": h.q90, "q99": h.q99, "max": h.max,
        })),
        "loss": q.loss.as_ref().map(|e| json!({
            "running_cost_scale": e.scale, "mean": e.mean, "q99": e.q99, "max": e.max, "at": e.at, "worst": e.worst,
        })),
        "narrow_units": l.narrow_units,
        "training_residual": l.residuals[0],
        "validation_residual": l.residuals[1],
        "iterations": l.iterations,
        "starts": l.starts,
        "seed": l.seed,
        "seconds": l.seconds,
        "files": exports.files.iter().map(|f| f.display().to_string()).collect::<Vec<_>>(),
        "without_onnx": exports.without_onnx,
    })
}
