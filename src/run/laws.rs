//! What a run does with its result: it fits laws, simulates them, and looks for the smallest level
//! of attenuation.

use super::RunError;
use super::fit::{FittedFiles, LawFiles, fit_into};
use super::parts::write_attenuation;
use super::sources::sources;
use crate::attenuation::Attenuated;
use crate::closed_loop::dissipation::Dissipation;
use crate::closed_loop::{Available, Evaluation, Laws};
use crate::feedback::Exports;
use crate::files::Draft;
use crate::hdf5::ResultFile;
use crate::model::Model;
use crate::result::{ATTENUATION_GROUPS, CLOSED_LOOP_GROUPS, DISSIPATION_GROUPS, Stored};
use crate::scene::Scene;
use crate::session::{Finished, LoopOptions, Session, SessionError};
use std::path::Path;

/// What came of it; `None` where the scene does not ask for it, or it could not be done.
#[derive(Default)]
pub struct LawsDone {
    /// The laws of `[feedback]`.
    pub feedback: Option<FittedFiles>,
    /// The loops of `[closed_loop]`.
    pub closed_loop: Option<Evaluation>,
    /// The check of `[dissipation]`.
    pub dissipation: Option<Dissipation>,
    /// The levels of `[attenuation]`.
    pub attenuation: Option<Attenuated>,
    /// Whether the session's deadline came before some of these.
    pub stopped: bool,
}

/// Whether anything is left to do when a scene has been swept and solved.
pub(super) fn wanted(model: &Model) -> bool {
    let loops = model.closed_loop.is_some() || model.dissipation.is_some();
    loops || !model.feedback.is_empty() || model.attenuation.is_some()
}

/// Finds mistakes in the scene's laws before a long run does.
///
/// # Errors
/// What is wrong with them.
pub fn check(scene: &Scene) -> Result<(), SessionError> {
    let Scene {
        model, hamiltonian, ..
    } = scene;
    if let Some(scene) = &model.closed_loop {
        let laws = Laws::new(model, hamiltonian, scene.track);
        let available = Available {
            map: true,
            fitted: Vec::new(),
            added: Vec::new(),
        };
        available.choose(&laws, scene, None)?;
    }
    Ok(())
}

/// Fits and simulates the scene's laws, in the draft. What cannot be done is a note and is left
/// out: the sweep is not lost for it.
///
/// # Errors
/// Those of reading and writing the draft.
pub(super) fn perform(session: &Session<'_>, draft: &Draft) -> Result<LawsDone, RunError> {
    let mut doing = Doing {
        session,
        model: &session.scene().model,
        draft,
        done: LawsDone::default(),
    };
    doing.fit()?;
    doing.fly()?;
    doing.attenuate()?;
    Ok(doing.done)
}

/// Writes the files of the laws that were fitted: last, when it is known whether the run was ended
/// early, and what its result file at `path` is called. What cannot be written is a note.
pub(super) fn export(session: &Session<'_>, done: &mut LawsDone, path: &Path) {
    let (model, progress) = (&session.scene().model, session.progress());
    let Some(FittedFiles { fitted, exports }) = &mut done.feedback else {
        return;
    };
    let files = match done.stopped {
        true => LawFiles::of_stopped(path, &model.feedback),
        false => LawFiles::new(path, None),
    };
    let written = (files.check(model, &model.feedback)).and_then(|()| files.write(fitted, model));
    match written {
        Ok(all) => {
            *exports = all;
            progress.finished(Finished::Exported(fitted, exports));
        }
        Err(e) => {
            exports.resize(fitted.laws.len(), Exports::default());
            progress.note(&format!("no files of the laws beside the result file: {e}"));
        }
    }
}

/// What is done so far.
struct Doing<'d> {
    session: &'d Session<'d>,
    model: &'d Model,
    draft: &'d Draft,
    done: LawsDone,
}

impl Doing<'_> {
    /// Whether the time is over, which is noted.
    fn is_over(&mut self, what: &str) -> bool {
        let is_over = self.session.is_over();
        if is_over {
            let progress = self.session.progress();
            progress.note(&format!("no {what}: the run was ended before"));
            self.done.stopped = true;
        }
        is_over
    }

    /// What was begun and could not be done.
    fn failed(&mut self, what: &str, error: &dyn std::fmt::Display) {
        self.done.stopped = self.done.stopped || self.session.is_over();
        self.session.progress().note(&format!("{what}: {error}"));
    }

    /// The laws of `[feedback]`.
    fn fit(&mut self) -> Result<(), RunError> {
        let (model, progress) = (self.model, self.session.progress());
        if model.feedback.is_empty() || self.is_over("law was fitted") {
            return Ok(());
        }
        let stored = Stored::open_draft(self.draft)?;
        let going = (progress, self.session.deadline());
        let files = LawFiles::new(self.draft.path(), None);
        let fitted = (files.check(model, &model.feedback))
            .and_then(|()| fit_into(&stored, model, &model.feedback, going));
        match fitted {
            Ok(fitted) => {
                progress.finished(Finished::Fitted(&fitted));
                if !fitted.left_out.is_empty() {
                    let names = fitted.left_out.join(", ");
                    self.failed(
                        &format!("law {names} was not fitted"),
                        &"the time given is over",
                    );
                }
                let exports = Vec::new();
                self.done.feedback = Some(FittedFiles { fitted, exports });
            }
            Err(e) => self.failed("no law was fitted", &e),
        }
        Ok(())
    }

    /// The loops of `[closed_loop]`, and the check of `[dissipation]`.
    fn fly(&mut self) -> Result<(), RunError> {
        let model = self.model;
        let simulates = model.closed_loop.is_some();
        let kind = match simulates {
            true => "closed loop was simulated",
            false => "dissipation inequality was checked",
        };
        if !(simulates || model.dissipation.is_some()) || self.is_over(kind) {
            return Ok(());
        }
        let stored = Stored::open_draft(self.draft)?;
        let progress = self.session.progress();
        let from = sources(Some(&stored), model, Vec::new(), progress)?;
        let options = LoopOptions::default();
        if simulates {
            match self.session.closed_loop(&from, &options) {
                Ok(evaluation) => {
                    let mut file = ResultFile::extend(self.draft.hidden(), &CLOSED_LOOP_GROUPS)?;
                    evaluation.write(model, &mut file)?;
                    file.finish()?;
                    self.done.closed_loop = Some(evaluation);
                }
                Err(e) => self.failed("no closed loop was simulated", &e),
            }
        }
        if model.dissipation.is_some() && !self.is_over("dissipation inequality was checked") {
            match self.session.dissipation(&from, &options) {
                Ok(check) => {
                    let mut file = ResultFile::extend(self.draft.hidden(), &DISSIPATION_GROUPS)?;
                    check.write(model, &mut file)?;
                    file.finish()?;
                    self.done.dissipation = Some(check);
                }
                Err(e) => self.failed("the dissipation inequality was not checked", &e),
            }
        }
        Ok(())
    }

    /// The levels of `[attenuation]`.
    fn attenuate(&mut self) -> Result<(), RunError> {
        let model = self.model;
        if model.attenuation.is_none() || self.is_over("level of attenuation was looked for") {
            return Ok(());
        }
        match self.session.attenuation() {
            Ok(found) => {
                let mut file = ResultFile::extend(self.draft.hidden(), &ATTENUATION_GROUPS)?;
                write_attenuation(&mut file, model, &found)?;
                file.finish()?;
                self.done.attenuation = Some(found);
            }
            Err(e) => self.failed("no smallest level of attenuation was found", &e),
        }
        Ok(())
    }
}
