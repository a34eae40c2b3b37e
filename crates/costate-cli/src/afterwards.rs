//! What a run does with its result: fits laws, simulates them, makes the report.
//!
//! Until then the result has a hidden name of its own, so that a run which is killed leaves nothing
//! under the final one.

use super::evaluate::{self, Sources, Wanted};
use super::fit::{Beside, fit_laws};
use super::report::Terminal;
use super::{CliError, attenuation, dissipation, fit};
use costate::backend::Backend;
use costate::closed_loop::{self, Available, GROUPS, Laws};
use costate::files::Draft;
use costate::hdf5::ResultFile;
use costate::model::Model;
use costate::result::{ATTENUATION_GROUPS, Stored};
use costate::scene::Scene;
use costate::sweep::Choices;
use costate_report::Options;
use std::path::{Path, PathBuf};

/// Whether anything is left to do when a scene has been swept and solved.
pub(super) fn wanted(model: &Model) -> bool {
    let loops = model.closed_loop.is_some() || model.dissipation.is_some();
    loops || !model.feedback.is_empty() || model.attenuation.is_some()
}

/// Finds mistakes in the scene's laws before a long run does.
pub(super) fn check(scene: &Scene) -> Result<(), CliError> {
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

/// Fits and simulates the scene's laws, in the draft. What cannot be done is said and left out: the
/// sweep is not lost for it.
pub(super) fn laws(
    draft: &Draft,
    scene: &Scene,
    backend: &dyn Backend,
    choices: Choices,
    terminal: &Terminal,
) -> Result<serde_json::Value, CliError> {
    let model = &scene.model;
    let mut done = serde_json::json!({ "feedback": null, "closed_loop": null, "dissipation": null, "attenuation": null });
    if !model.feedback.is_empty() {
        let stored = Stored::open(draft.hidden())?;
        match fit_laws(
            &stored,
            model,
            &model.feedback,
            &Beside::of(draft.path(), None),
            terminal,
        ) {
            Ok(fitted) => {
                terminal.say(&fitted.text())?;
                done["feedback"] = fit::laws_json(&fitted);
            }
            Err(e) => terminal.note(&format!("no law was fitted: {e}")),
        }
    }
    if model.closed_loop.is_some() || model.dissipation.is_some() {
        loops(draft, scene, backend, choices, terminal, &mut done)?;
    }
    if model.attenuation.is_some() {
        let mut file = ResultFile::extend(draft.hidden(), &ATTENUATION_GROUPS)?;
        match attenuation::write(&mut file, scene, backend, choices, terminal) {
            Ok(found) => {
                file.finish()?;
                terminal.say(&attenuation::text(&found))?;
                done["attenuation"] = attenuation::as_json(&found);
            }
            Err(e) => terminal.note(&format!("no smallest level of attenuation was found: {e}")),
        }
    }
    Ok(done)
}

/// Closed loops and the check by simulation; what came of them goes into `done`.
fn loops(
    draft: &Draft,
    scene: &Scene,
    backend: &dyn Backend,
    choices: Choices,
    terminal: &Terminal,
    done: &mut serde_json::Value,
) -> Result<(), CliError> {
    let stored = Stored::open(draft.hidden())?;
    let wanted = Wanted {
        choices,
        ..Wanted::default()
    };
    let from = Sources::new(Some(&stored), &wanted, terminal)?;
    let model = &scene.model;
    if model.closed_loop.is_some() {
        let mut file = ResultFile::extend(draft.hidden(), &GROUPS)?;
        match evaluate::perform(&from, scene, &wanted, backend, terminal, &mut file) {
            Ok((evaluation, _)) => {
                file.finish()?;
                done["closed_loop"] = evaluate::as_json(&evaluation, draft.path());
            }
            Err(e) => terminal.note(&format!("no closed loop was simulated: {e}")),
        }
    }
    if model.dissipation.is_some() {
        let mut file = ResultFile::extend(draft.hidden(), &closed_loop::dissipation::GROUPS)?;
        match dissipation::perform(&from, scene, &wanted, backend, terminal, &mut file) {
            Ok(check) => {
                file.finish()?;
                done["dissipation"] = dissipation::as_json(&check);
            }
            Err(e) => terminal.note(&format!("the dissipation inequality was not checked: {e}")),
        }
    }
    Ok(())
}

/// The report of a finished file; a failure is a note.
pub(super) fn page(path: &Path, terminal: &Terminal) -> Option<PathBuf> {
    let bar = terminal.progress();
    bar.say("report");
    let written = Stored::open(path).map_err(|e| e.to_string());
    let written = written.and_then(|stored| {
        costate_report::write(&stored, &Options::default()).map_err(|e| e.to_string())
    });
    bar.clear();
    match written {
        Ok(written) => Some(written.page),
        Err(reason) => {
            terminal.note(&format!("no report was made: {reason}"));
            None
        }
    }
}
