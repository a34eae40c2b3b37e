//! What laws and V are taken from: result files, other scenes, weights files.

use super::RunError;
use crate::closed_loop::{LawError, Weights};
use crate::model::Model;
use crate::result::{Stored, StoredError};
use crate::scene::Scene;
use crate::schema;
use crate::session::{GivenSweep, Progress, Sources, same_problem};
use std::path::Path;

/// The map, solved states and fitted laws of a result file, for closed loops of `model`; `added`
/// are further laws.
///
/// # Errors
/// [`StoredError`] where the file is not as this program writes it.
pub fn sources(
    stored: Option<&Stored>,
    model: &Model,
    added: Vec<Weights>,
    progress: &dyn Progress,
) -> Result<Sources, RunError> {
    let Some(stored) = stored else {
        return Ok(Sources {
            added,
            ..Sources::default()
        });
    };
    // Without a law that asks for it the map still gives V.
    let has_values = stored.has_any(&[
        &schema::TRAJECTORIES,
        &schema::POINTS,
        &schema::MAP,
        &schema::MAP_PIECES,
    ]);
    let unknown = |e| progress.note(&format!("no value map: {e}"));
    let map = has_values.then(|| stored.value_map().map_err(unknown).ok());
    let same = same_problem(&stored.scene.model, model);
    Ok(Sources {
        map: map.flatten(),
        solved: if same { stored.points()? } else { None },
        fitted: fitted_laws(stored)?,
        added,
        other_problem: !same,
    })
}

/// What tells a result from others, in a word: two of one scene differ in when they were made at
/// least.
pub(super) fn told_apart(stored: &Stored) -> String {
    let of = |name: &str| stored.attribute(name).unwrap_or_default();
    let text = [
        of("created"),
        of("summary"),
        of("git_revision"),
        stored.scene.model.text.clone(),
    ];
    super::shard::hash_of(text.concat().bytes())
}

/// The trajectories of a result file as first guesses for states of `model`.
///
/// # Errors
/// [`RunError::NoSweep`] where it has none of these equations, with costates and times.
pub fn archive(stored: &Stored, model: &Model) -> Result<GivenSweep, RunError> {
    let refused = |why: &'static str| RunError::NoSweep {
        file: stored.path.clone(),
        why,
    };
    if !same_problem(&stored.scene.model, model) {
        return Err(refused(
            "it is of other equations, another cost or other parameters",
        ));
    }
    let swept = stored.trajectories()?;
    let swept =
        swept.ok_or_else(|| refused("it has no trajectories (costate shoot-out makes them)"))?;
    if !swept.is_full() {
        return Err(refused("it has values alone (--values-only)"));
    }
    if stored.has_attribute("shards_missing") {
        return Err(refused(
            "shards of it are missing: put all of them together (costate merge)",
        ));
    }
    if stored.has_attribute("stopped") {
        return Err(refused("its sweep was ended before it was done"));
    }
    if stored.shard().is_some() {
        return Err(refused(
            "it is one shard's part: put all parts together first (costate merge)",
        ));
    }
    Ok(GivenSweep {
        swept,
        of: told_apart(stored),
    })
}

/// The laws fitted into a result file.
///
/// # Errors
/// [`StoredError`] where the group is not as this program writes it.
pub fn fitted_laws(stored: &Stored) -> Result<Vec<Weights>, StoredError> {
    let Some(group) = stored.group(&schema::FEEDBACK) else {
        return Ok(Vec::new());
    };
    let (names, texts) = (group.texts("law")?, group.texts("toml")?);
    let laws = names.into_iter().zip(texts);
    Ok(laws
        .map(|(name, text)| Weights {
            file: format!("/feedback, law {name}"),
            name,
            text,
        })
        .collect())
}

/// The law of a weights file, by the file's name.
///
/// # Errors
/// [`LawError::Read`].
pub fn weights(path: &Path) -> Result<Weights, LawError> {
    let text = crate::files::read_text(path).map_err(|source| LawError::Read {
        path: path.to_owned(),
        source,
    })?;
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    Ok(Weights {
        name: stem.into_owned(),
        text,
        file: path.display().to_string(),
    })
}

/// Another scene with the states and controls of the stored one, and the parameters that the stored
/// run was given.
///
/// # Errors
/// What is wrong with the scene; [`RunError::OtherScene`].
pub fn other_scene(
    stored: &Stored,
    path: &Path,
    set: &[(String, String)],
) -> Result<Scene, RunError> {
    let overrides = [stored.scene.model.overrides.as_slice(), set].concat();
    let scene = Scene::load_with(path, &overrides)?;
    crate::attenuation::refuse(&scene)?;
    let names = |m: &Model| -> (Vec<String>, Vec<String>) {
        let states = m.states.iter().map(|s| s.variable.name.clone());
        let controls = m.controls.iter().map(|c| c.variable.name.clone());
        (states.collect(), controls.collect())
    };
    if names(&scene.model) != names(&stored.scene.model) {
        return Err(RunError::OtherScene {
            scene: path.to_owned(),
            file: stored.path.clone(),
        });
    }
    Ok(scene)
}
