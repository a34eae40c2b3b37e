//! Scenes.

use crate::args::SceneArgs;
use crate::error::CliError;
use costate::low_level::attenuation;
use costate::scene::Scene;
use std::path::Path;

/// Reads a scene and derives its equations; problems of both are reported with their places.
pub fn load(args: &SceneArgs) -> Result<Scene, CliError> {
    loaded(&args.scenario, &args.set)
}

/// The scene of a file; a game whose level of attenuation its linearization does not allow is
/// refused.
pub fn loaded(path: &Path, set: &[(String, String)]) -> Result<Scene, CliError> {
    let scene = Scene::load_with(path, set)?;
    // Before anything is computed or written, whatever the command.
    attenuation::refuse(&scene)?;
    Ok(scene)
}
