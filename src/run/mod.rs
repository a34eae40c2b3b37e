//! A run with a result file: all that a scene asks for, in the order that one thing needs another.
//!
//! ```no_run
//! use costate::run::Provenance;
//! use costate::session::Wanted;
//! use costate::{Scene, Session};
//!
//! let scene = Scene::load("pendulum.toml")?;
//! let provenance = Provenance::now();
//! let done = Session::new(&scene).run(&Wanted::all(), "out/pendulum.h5", &provenance)?;
//! println!("{} trajectories", done.summary.trajectories);
//!
//! // And back: the grid of [map], and V anywhere.
//! let stored = costate::Stored::open(&done.path)?;
//! if let Some(grid) = stored.map()? {
//!     println!("{} values on axes of {:?}", grid.v.len(), grid.axes);
//! }
//! println!("{:?}", stored.value_map()?.at(&[0.5, 0.0]).lowest);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod claims;
mod error;
mod evaluate;
mod fit;
mod laws;
mod parts;
mod shard;
mod sources;

pub use claims::claims;
pub use error::RunError;
pub use evaluate::{Evaluated, evaluate, evaluate_shard};
pub use fit::{FittedFiles, LawFiles, fit_stored};
pub use laws::{LawsDone, check as check_laws};
pub use parts::write_attenuation;
use parts::write_study;
use shard::PartOfSweep;
pub use shard::{
    Asked, Kind, LevelsDone, Loops, LoopsDone, Manifest, MergeError, MergeOptions, Merged,
    StudyDone, levels, listed, merge, study,
};
pub use sources::{archive, fitted_laws, other_scene, sources, weights};

use crate::files::{Draft, target};
use crate::hdf5::ResultFile;
use crate::model::Model;
use crate::result::{RunRecord, Stored, TrajectorySchema};
use crate::schema;
use crate::session::summary::{Quantiles, RunSummary};
use crate::session::{
    Finished, Kept, Outcome, Pass, Resume, Session, SessionError, States, Wanted,
};
use crate::sweep::Plan;
use std::path::{Path, PathBuf};
use std::time::{Instant, SystemTime};

/// What the names of unfinished results end in.
const STOPPED: &str = "_stopped";

/// When a run began, and what made it: for the record in its file.
#[derive(Clone, Debug)]
pub struct Provenance {
    /// When, by the calendar.
    pub started: SystemTime,
    /// When, for how long it takes.
    pub clock: Instant,
    /// The commit that the program was built from.
    pub git_revision: String,
}

impl Provenance {
    /// Of a run that begins now, by a program whose commit is not known.
    #[must_use]
    pub fn now() -> Self {
        Self {
            started: SystemTime::now(),
            clock: Instant::now(),
            git_revision: "unknown".to_owned(),
        }
    }

    /// Seconds since the run began.
    #[must_use]
    pub fn seconds(&self) -> f64 {
        self.clock.elapsed().as_secs_f64()
    }

    /// A record of the run so far, without what integrated.
    #[must_use]
    pub fn record(&self, model: &Model) -> RunRecord {
        RunRecord {
            git_revision: self.git_revision.clone(),
            wall_seconds: self.seconds(),
            ..RunRecord::begun(model, self.started)
        }
    }
}

/// What a run has done.
pub struct Done {
    /// The pass, with all it found.
    pub outcome: Outcome,
    /// Laws, closed loops and levels of attenuation.
    pub laws: LawsDone,
    /// Where the numbers come from, as the file has it.
    pub record: RunRecord,
    /// The numbers, as the file and `--json` have them.
    pub summary: RunSummary,
    /// The result file.
    pub path: PathBuf,
}

impl Session<'_> {
    /// Computes what is wanted and writes it to a result file.
    ///
    /// The file has a hidden name until it is complete. What cannot be done after the pass (a law
    /// that cannot be fitted, say) is a note and is left out: the pass is not lost for it.
    ///
    /// # Errors
    /// Those of the pass, and of writing.
    pub fn run(
        &self,
        wanted: &Wanted,
        path: impl AsRef<Path>,
        provenance: &Provenance,
    ) -> Result<Done, RunError> {
        let pass = self.prepare(wanted)?;
        if wanted.shard.is_some() || wanted.resume != Resume::Never {
            let pass_alone = !(wanted.study || wanted.laws);
            if wanted.sweep && pass_alone && wanted.states == States::None && !wanted.map {
                return self.run_sweep(wanted, pass, path.as_ref(), provenance);
            }
            if wanted.sweep || !pass_alone {
                return Err(SessionError::StatesAlone.into());
            }
            return shard::run(self, wanted, (pass, path.as_ref()), provenance);
        }
        self.run_whole(wanted, pass, (path.as_ref(), None), provenance)
    }

    /// The same of a sweep alone that is a part, or that is not made again where it is there.
    fn run_sweep(
        &self,
        wanted: &Wanted,
        pass: Pass<'_>,
        path: &Path,
        provenance: &Provenance,
    ) -> Result<Done, RunError> {
        let path = target(path)?;
        let part = PartOfSweep::new(self, wanted, (pass.plan(), &path), provenance)?;
        if let Some(summary) = part.finished(self)? {
            let outcome = pass.nothing();
            return Ok(Done {
                record: self.record_of(&outcome.plan, provenance),
                laws: LawsDone::default(),
                summary,
                outcome,
                path,
            });
        }
        self.run_whole(wanted, pass, (&path, Some(part)), provenance)
    }

    /// The same of a pass of which nothing is kept before it is done.
    fn run_whole(
        &self,
        wanted: &Wanted,
        pass: Pass<'_>,
        (path, part): (&Path, Option<PartOfSweep>),
        provenance: &Provenance,
    ) -> Result<Done, RunError> {
        let model = &self.scene().model;
        if wanted.laws {
            laws::check(self.scene())?;
        }
        self.progress().begun(model, pass.plan(), self.backend());

        let mut output = match part {
            Some(part) => Output::of_part(path, part)?,
            None => Output::begin(path, wanted.laws && laws::wanted(model))?,
        };

        let schema = trajectory_schema(model, pass.plan());
        let swept = TrajectorySchema {
            values_only: (wanted.kept == Kept::Values).then(|| in_single(pass.plan())),
            ..schema.clone()
        };
        let mut writer = (pass.stores_sweep())
            .then(|| output.file.trajectories(&swept))
            .transpose()?;
        let outcome = pass.perform::<RunError>(&mut |block| match &mut writer {
            Some(writer) => Ok(writer.append(block)?),
            None => Ok(()),
        })?;
        drop(writer);
        write_outcome(&mut output.file, &outcome, model, &schema)?;
        output.note(self, &outcome)?;

        let record = self.record_of(&outcome.plan, provenance);
        record.write(&output.file)?;
        let mut summary = self.summary(&outcome, &output.path, provenance.seconds());
        write_errors(&output.file, &summary)?;
        output.file.attribute("summary", in_json(&summary))?;
        let (mut path, draft) = output.finish(outcome.stopped)?;
        self.progress().finished(Finished::Solved(&outcome, model));

        let laws = match draft {
            Some(draft) => self.add_laws(draft, &mut path, &mut summary)?,
            None => LawsDone::default(),
        };
        Ok(Done {
            outcome,
            laws,
            record,
            summary,
            path,
        })
    }
}

impl Session<'_> {
    /// Adds the scene's laws and loops to a result, and puts it in place: at `path`, unless the
    /// time does not suffice.
    fn add_laws(
        &self,
        mut draft: Draft,
        path: &mut PathBuf,
        summary: &mut RunSummary,
    ) -> Result<LawsDone, RunError> {
        let mut laws = laws::perform(self, &draft)?;
        if laws.stopped && !summary.stopped {
            *path = mark_laws_stopped(&mut draft, summary)?;
            note_replaced(self, path);
        }
        draft.publish()?;
        laws::export(self, &mut laws, path);
        Ok(laws)
    }

    /// Puts a file in place with the record of what made it; its path.
    ///
    /// # Errors
    /// Those of writing.
    pub fn finish(&self, file: ResultFile, provenance: &Provenance) -> Result<PathBuf, RunError> {
        self.record(provenance).write(&file)?;
        Ok(file.finish()?)
    }

    /// The record of a run with what a plan integrates by.
    fn record_of(&self, plan: &Plan, provenance: &Provenance) -> RunRecord {
        RunRecord {
            precision: plan.spec.precision.name().to_owned(),
            method: plan.method().name().to_owned(),
            rtol: plan.run.rtol,
            atol: plan.atol,
            ..self.record(provenance)
        }
    }

    /// The record of a run on the session's backend, with the tolerances asked for, without the
    /// precision and the method.
    fn record(&self, provenance: &Provenance) -> RunRecord {
        let integrator = &self.scene().model.integrator;
        RunRecord {
            rtol: self.choices.rtol.unwrap_or(integrator.rtol),
            atol: integrator.atol,
            backend: self.backend().name().to_owned(),
            adapter: self.backend().adapter(),
            ..provenance.record(&self.scene().model)
        }
    }
}

/// A result file while it is written.
struct Output {
    path: PathBuf,
    file: ResultFile,
    /// What holds the file while laws are added to it; without any the file is under its own name
    /// when it is finished.
    draft: Option<Draft>,
    /// What the file is a part of.
    part: Option<PartOfSweep>,
}

impl Output {
    /// Begins the file of a part of a sweep.
    ///
    /// # Errors
    /// Where no file can be written there.
    fn of_part(path: &Path, part: PartOfSweep) -> Result<Self, RunError> {
        Ok(Self {
            path: path.to_owned(),
            file: part.create(path)?,
            draft: None,
            part: Some(part),
        })
    }

    /// Begins a file; `extended`: laws will be added to it.
    ///
    /// # Errors
    /// Where no file can be written there.
    fn begin(path: &Path, extended: bool) -> Result<Self, RunError> {
        // The final name first: what is wrong with it is told before the work is done.
        let path = target(path)?;
        let draft = extended.then(|| Draft::begin(&path)).transpose()?;
        let file = match &draft {
            Some(draft) => ResultFile::create(draft.hidden())?,
            None => ResultFile::create(&path)?,
        };
        Ok(Self {
            path,
            file,
            draft,
            part: None,
        })
    }

    /// Notes in the file what it is a part of, and where the run was ended before everything was done.
    ///
    /// # Errors
    /// Those of writing.
    fn note(&mut self, session: &Session<'_>, outcome: &Outcome) -> Result<(), RunError> {
        if let Some(part) = &mut self.part {
            let done = (outcome.swept.trajectories, outcome.stopped);
            self.path = part.note(session, &mut self.file, done)?;
            return Ok(());
        }
        if !outcome.stopped {
            return Ok(());
        }
        self.file.attribute("stopped", 1i64)?;
        self.path = path_of_stopped(&self.path);
        note_replaced(session, &self.path);
        match &mut self.draft {
            Some(draft) => draft.rename(self.path.clone()),
            None => self.file.rename(self.path.clone()),
        }
        Ok(())
    }

    /// Finishes the file: its name, and what holds it while laws are added.
    ///
    /// # Errors
    /// Those of writing.
    fn finish(self, stopped: bool) -> Result<(PathBuf, Option<Draft>), RunError> {
        let there = self.file.finish()?;
        let Some(part) = self.part else {
            // (That of a draft is hidden.)
            return Ok((self.path, self.draft));
        };
        if !stopped {
            part.done();
        }
        // Beside its name, where another shard has come there meanwhile.
        Ok((there, None))
    }
}

/// Says that a file of an earlier run that was ended early is replaced by this one's, at `path`.
pub fn note_replaced(session: &Session<'_>, path: &Path) {
    if path.exists() {
        let path = path.display();
        session.progress().note(&format!(
            "{path}, which an earlier run that was ended early has left, is replaced"
        ));
    }
}

/// Notes in the file, and in its summary, that the run was ended before all laws were done. Returns
/// the file's name.
///
/// # Errors
/// Those of writing.
fn mark_laws_stopped(draft: &mut Draft, summary: &mut RunSummary) -> Result<PathBuf, RunError> {
    let path = path_of_stopped(draft.path());
    draft.rename(path.clone());
    summary.laws_stopped = true;
    summary.file = path.display().to_string();
    let file = ResultFile::extend(draft.hidden(), &[])?;
    file.attribute("laws_stopped", 1i64)?;
    file.attribute("summary", in_json(summary))?;
    file.finish()?;
    Ok(path)
}

fn in_json(summary: &RunSummary) -> String {
    serde_json::to_string(summary).unwrap_or_default()
}

/// The name of an unfinished result: that of the finished one, or, where there is a file of that
/// name, which may have more than what was done by now, one beside it: `out/x.h5` ->
/// `out/x_stopped.h5`.
#[must_use]
pub fn path_of_stopped(path: &Path) -> PathBuf {
    match path.exists() {
        true => stopped_beside(path),
        false => path.to_owned(),
    }
}

/// That name beside the finished one's.
fn stopped_beside(path: &Path) -> PathBuf {
    beside(path, STOPPED)
}

/// What the names of the results of shards end in.
#[must_use]
pub fn of_shard(number: usize, of: usize) -> String {
    format!("_{number}_of_{of}")
}

/// A name beside a file's, with an ending.
fn beside(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.file_stem().unwrap_or_default().to_owned();
    name.push(ending);
    if let Some(ending) = path.extension() {
        name.push(".");
        name.push(ending);
    }
    path.with_file_name(name)
}

/// What came of a pass, all but the swept trajectories.
fn write_outcome(
    file: &mut ResultFile,
    outcome: &Outcome,
    model: &Model,
    schema: &TrajectorySchema,
) -> Result<(), RunError> {
    if outcome.stored {
        file.caustic(schema, &outcome.swept.folds)?;
    }
    if let (Some(answers), Some(targets)) = (&outcome.answers, &outcome.targets) {
        let points = targets.points();
        file.points(schema, answers, 0, points)?;
        if let Some(grid) = targets.map_grid() {
            let value_max = model.map.as_ref().and_then(|m| m.value_max);
            file.map(schema, answers, grid, points, value_max)?;
        }
        file.sheet_edges(schema, answers)?;
    }
    write_sampled(file, outcome, schema)?;
    if let Some(made) = &outcome.mapped {
        file.map_pieces(schema, model.time_name(), made)?;
    }
    if let Some(asked) = model
        .study
        .as_ref()
        .filter(|_| !outcome.variants.is_empty())
    {
        file.study(&TrajectorySchema::axes(model), asked, &outcome.variants)?;
    }
    Ok(())
}

/// Writes the trajectories from states of a list.
fn write_sampled(
    file: &mut ResultFile,
    outcome: &Outcome,
    schema: &TrajectorySchema,
) -> Result<(), RunError> {
    if let Some((samples, block)) = &outcome.sampled {
        let schema = TrajectorySchema {
            samples: *samples,
            ..schema.clone()
        };
        file.trajectories(&schema)?.append(block)?;
    }
    Ok(())
}

/// Root attributes with the estimated errors, by a summary; those that are not known are left out.
fn write_errors(file: &ResultFile, summary: &RunSummary) -> Result<(), RunError> {
    let write = |before: &str, errors: [&Option<Quantiles>; 3]| -> Result<(), RunError> {
        for (name, of) in ["V", "p", "u"].into_iter().zip(errors) {
            let Some(of) = of else { continue };
            for (ending, number) in [("", of.max), ("_p99", of.p99), ("_median", of.median)] {
                // Where something could not be compared the error is not finite.
                let number = number.unwrap_or(f64::INFINITY);
                file.attribute(&format!("{before}error_estimate_{name}{ending}"), number)?;
            }
        }
        Ok(())
    };
    if let Some(errors) = &summary.error_estimate {
        write("", [&errors.value, &errors.costate, &errors.control])?;
        file.attribute("error_estimate_trajectories", errors.trajectories as i64)?;
        file.attribute("error_asked", errors.asked)?;
    }
    let solved = summary.homotopy.as_ref();
    if let Some(errors) = solved.and_then(|h| h.error_estimate.as_ref()) {
        write("solved_", [&errors.value, &errors.costate, &errors.control])?;
        file.attribute("solved_error_estimate_states", errors.states as i64)?;
        file.attribute("solved_error_asked", errors.asked)?;
    }
    if let Some(met) = summary.error_met {
        file.attribute("error_met", i64::from(met))?;
    }
    Ok(())
}

/// The axes of a scene and the statuses of its sweep.
#[must_use]
pub fn trajectory_schema(model: &Model, plan: &Plan) -> TrajectorySchema {
    TrajectorySchema {
        samples: plan.samples(),
        status_flags: plan.status_flags(),
        ..TrajectorySchema::axes(model)
    }
}

/// Whether f32 resolves states to a small share of their region's widths, and V, which is 0 at an
/// equilibrium (a terminal cost may have a constant of any size).
fn in_single(plan: &Plan) -> [bool; 2] {
    /// Rounding of a state in units of the region's width.
    const MOST_ROUNDING: f64 = 1e-6;
    /// Far enough from the ends of f32's range for what is some orders larger or smaller.
    const RANGE: std::ops::Range<f64> = 1e-20..1e30;
    let state = |i: usize| {
        let reference = plan.system.reference[i];
        let [lo, hi] = plan.region[i].map(|s| (reference + s).abs());
        let (largest, width) = (lo.max(hi), plan.widths[i]);
        RANGE.contains(&width) && largest * f64::from(f32::EPSILON) <= MOST_ROUNDING * width
    };
    let states = (0..plan.system.states).all(state);
    let values = plan.system.terminal.is_none() && RANGE.contains(&plan.value_scale);
    [states, values]
}

/// Where results go that nobody has named a file for: `out/SCENE` and an ending of the name.
#[must_use]
pub fn output_of(scenario: &Path, ending: &str) -> PathBuf {
    let stem = scenario.file_stem();
    let mut name = stem.unwrap_or_else(|| "result".as_ref()).to_owned();
    name.push(ending);
    name.push(".h5");
    Path::new("out").join(name)
}

/// The same for answers at single states, which are not written over the results of a run: then
/// these are the second path.
#[must_use]
pub fn output_of_points(scenario: &Path) -> (PathBuf, Option<PathBuf>) {
    static OTHERS: [&schema::Group; 8] = [
        &schema::MAP_PIECES,
        &schema::MAP,
        &schema::STUDY,
        &schema::FEEDBACK,
        &schema::CLOSED_LOOP,
        &schema::DISSIPATION,
        &schema::ATTENUATION,
        &schema::CAUSTIC,
    ];
    let path = output_of(scenario, "");
    // What cannot be read may be a result all the same.
    let free = !path.exists() || Stored::open(&path).is_ok_and(|stored| !stored.has_any(&OTHERS));
    match free {
        true => (path, None),
        false => (output_of(scenario, "_points"), Some(path)),
    }
}

crate::opaque!(Done);
