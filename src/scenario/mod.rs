//! The scenario file: TOML text -> [`Model`]. The only room that knows TOML.
//!
//! A file is read as far as it can be read, and everything that is wrong with it is reported at
//! once, each problem with its place in the text. Reading order: the names of all sections, the
//! parameters (each from earlier ones), the definitions, and then the other sections, so that the
//! order of sections in the file does not matter.

mod attenuation;
mod build;
mod closed_loop;
mod declare;
mod dissipation;
mod document;
mod equations;
mod equilibrium;
mod events;
mod feedback;
mod finite;
mod hints;
mod keys;
mod lexer;
mod mechanism;
mod parser;
mod periods;
mod quoted;
mod reader;
mod report_section;
mod scene;
mod scope;
mod settings;
mod stationary;
mod study;
mod syntax_error;
#[cfg(test)]
mod tests;
mod turns;

pub use crate::diagnostics::{Problem, ScenarioErrors};
pub use document::{Document, Given};
pub use keys::{CHAPTERS, Key, PROBLEM_SECTIONS, SectionKeys, markdown as reference};
pub use report_section::{constant, definitions, mechanism};
pub use settings::{DEFAULT_ATOL_SHARE, DEFAULT_RTOL, DEFAULT_SAMPLES, DEFAULT_SPACING};

use crate::files::{beginning, is_hdf5, read_text};
use crate::model::Model;
use std::path::{Path, PathBuf};

/// Whether expressions call a function of this name, so that nothing else can have it.
#[must_use]
pub fn is_function(name: &str) -> bool {
    scope::functions().any(|f| f == name)
}

/// Why a scenario file gave no model.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// The file cannot be read, or is not UTF-8.
    #[error("cannot read {path}: {source}", path = path.display())]
    Read {
        path: PathBuf,
        source: std::io::Error,
    },
    /// A result file in place of its scene.
    #[error("{path} is a result file: give the scene (.toml)", path = path.display())]
    ResultFile { path: PathBuf },
    /// The file's contents are wrong.
    #[error(transparent)]
    Scenario(#[from] ScenarioErrors),
}

/// Reads a scenario file. `overrides` are `--set name=value`: see [`parse`].
///
/// # Errors
/// [`LoadError`] where the file cannot be read or its contents are wrong.
pub fn load(path: &Path, overrides: &[(String, String)]) -> Result<Model, LoadError> {
    let text = text_of(path)?;
    Ok(parse(&text, &path.display().to_string(), overrides)?)
}

/// The text of a scenario file.
///
/// # Errors
/// [`LoadError::Read`] and [`LoadError::ResultFile`].
pub fn text_of(path: &Path) -> Result<String, LoadError> {
    read_text(path).map_err(|source| {
        let path = path.to_owned();
        match beginning(&path).is_ok_and(|bytes| is_hdf5(&bytes)) {
            true => LoadError::ResultFile { path },
            false => LoadError::Read { path, source },
        }
    })
}

/// Reads a scenario's text. Each of `overrides` replaces the definition of a parameter by a number
/// or an expression of earlier parameters; where a name is given twice, the last counts.
/// `file_name` is for messages.
///
/// # Errors
/// [`ScenarioErrors`] with everything that is wrong.
pub fn parse(
    text: &str,
    file_name: &str,
    overrides: &[(String, String)],
) -> Result<Model, ScenarioErrors> {
    Document::parse(text, file_name)?.model(&texts(overrides))
}

/// Overrides as they were typed.
pub fn texts(overrides: &[(String, String)]) -> Vec<(String, Given)> {
    (overrides.iter())
        .map(|(name, text)| (name.clone(), Given::Text(text.clone())))
        .collect()
}
