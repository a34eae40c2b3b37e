//! What a run does with its result: it fits laws, simulates them, and looks for the smallest level
//! of attenuation.

use super::RunError;
use super::fit::{FittedFiles, LawFiles, fit_stored};
use super::parts::write_attenuation;
use super::sources::sources;
use crate::attenuation::Attenuated;
use crate::closed_loop::dissipation::Dissipation;
use crate::closed_loop::{Available, Evaluation, Laws};
use crate::files::Draft;
use crate::hdf5::ResultFile;
use crate::model::Model;
use crate::result::{ATTENUATION_GROUPS, CLOSED_LOOP_GROUPS, DISSIPATION_GROUPS, Stored};
use crate::scene::Scene;
use crate::session::{Finished, LoopOptions, Session, SessionError};
use std::cell::Cell;

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
pub(super) fn perform(session: &Session<'_>, draft: &Draft) -> Result<LawsDone, RunError> {
    let model = &session.scene().model;
    let progress = session.progress();
    let mut done = LawsDone::default();
    let stopped = Cell::new(false);
    let is_over = |what: &str| {
        if session.is_over() {
            progress.note(&format!("no {what}: the run was ended before"));
            stopped.set(true);
        }
        session.is_over()
    };
    // What was begun and could not be done.
    let failed = |what: &str, error: &dyn std::fmt::Display| {
        stopped.set(stopped.get() || session.is_over());
        progress.note(&format!("{what}: {error}"));
    };

    if !model.feedback.is_empty() && !is_over("law was fitted") {
        let stored = Stored::open(draft.hidden())?;
        let files = LawFiles::new(draft.path(), None);
        let going = (progress, session.deadline());
        match fit_stored(&stored, model, &model.feedback, &files, going) {
            Ok(fitted) => {
                progress.finished(Finished::Fitted(&fitted.fitted, &fitted.exports));
                done.feedback = Some(fitted);
            }
            Err(e) => failed("no law was fitted", &e),
        }
    }

    let loops = model.closed_loop.is_some() || model.dissipation.is_some();
    let kind = match model.closed_loop.is_some() {
        true => "closed loop was simulated",
        false => "dissipation inequality was checked",
    };
    if loops && !is_over(kind) {
        let stored = Stored::open(draft.hidden())?;
        let from = sources(Some(&stored), model, Vec::new(), progress)?;
        let options = LoopOptions::default();
        if model.closed_loop.is_some() {
            match session.closed_loop(&from, &options) {
                Ok(evaluation) => {
                    let mut file = ResultFile::extend(draft.hidden(), &CLOSED_LOOP_GROUPS)?;
                    evaluation.write(model, &mut file)?;
                    file.finish()?;
                    done.closed_loop = Some(evaluation);
                }
                Err(e) => failed("no closed loop was simulated", &e),
            }
        }
        if model.dissipation.is_some() && !is_over("dissipation inequality was checked") {
            match session.dissipation(&from, &options) {
                Ok(check) => {
                    let mut file = ResultFile::extend(draft.hidden(), &DISSIPATION_GROUPS)?;
                    check.write(model, &mut file)?;
                    file.finish()?;
                    done.dissipation = Some(check);
                }
                Err(e) => failed("the dissipation inequality was not checked", &e),
            }
        }
    }

    if model.attenuation.is_some() && !is_over("level of attenuation was looked for") {
        match session.attenuation() {
            Ok(found) => {
                let mut file = ResultFile::extend(draft.hidden(), &ATTENUATION_GROUPS)?;
                write_attenuation(&mut file, model, &found)?;
                file.finish()?;
                done.attenuation = Some(found);
            }
            Err(e) => failed("no smallest level of attenuation was found", &e),
        }
    }
    done.stopped = stopped.get();
    Ok(done)
}
