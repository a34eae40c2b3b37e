//! A scene: the file, the model it describes, and the equations derived from it, which belong
//! together.

use crate::diagnostics::ScenarioErrors;
use crate::hamiltonian::Hamiltonian;
use crate::model::Model;
use crate::scenario::{Document, Given, LoadError, text_of, texts};
use std::path::Path;

/// A scene, read from a scenario file or text, with its equations.
///
/// ```
/// use costate::Scene;
/// let text = r#"
///     title = "Double integrator"
///     parameters = { r = 1.0 }
///     states = { x = { unit = "m" }, v = { unit = "m/s" } }
///     controls = { u = {} }
///     dynamics = { x = "v", v = "u" }
///     cost = { running = "0.5*(x^2 + r*u^2)" }
///     equilibrium = { x = 0.0, v = 0.0, u = 0.0 }
///     region = { x = [-1, 1], v = [-1, 1] }
/// "#;
/// let scene = Scene::parse(text, "double_integrator.toml")?;
/// let dearer = scene.with(&[("r", 2.0)])?;
/// assert_eq!(dearer.model.parameter("r"), Some(2.0));
/// # Ok::<(), costate::low_level::diagnostics::ScenarioErrors>(())
/// ```
#[derive(Clone, Debug)]
pub struct Scene {
    /// The scene as data.
    pub model: Model,
    /// Derived from `model`.
    pub hamiltonian: Hamiltonian,
    document: Document,
    overrides: Vec<(String, Given)>,
}

impl Scene {
    /// Reads a scenario file.
    ///
    /// # Errors
    /// [`LoadError`] where the file cannot be read, with all that is wrong with it.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, LoadError> {
        Self::load_with(path, &[])
    }

    /// Reads a scenario file with definitions of parameters in place of the file's: a number or an
    /// expression of earlier parameters each. Where a name is given twice, the last counts.
    ///
    /// # Errors
    /// [`LoadError`].
    pub fn load_with(
        path: impl AsRef<Path>,
        overrides: &[(String, String)],
    ) -> Result<Self, LoadError> {
        let path = path.as_ref();
        let text = text_of(path)?;
        Ok(Self::parse_with(
            &text,
            &path.display().to_string(),
            overrides,
        )?)
    }

    /// Reads a scenario's text; `file_name` is for messages.
    ///
    /// # Errors
    /// [`ScenarioErrors`] with everything that is wrong.
    pub fn parse(text: &str, file_name: &str) -> Result<Self, ScenarioErrors> {
        Self::parse_with(text, file_name, &[])
    }

    /// As [`Scene::parse`], with definitions of parameters in place of the text's.
    ///
    /// # Errors
    /// [`ScenarioErrors`].
    pub fn parse_with(
        text: &str,
        file_name: &str,
        overrides: &[(String, String)],
    ) -> Result<Self, ScenarioErrors> {
        Self::of(Document::parse(text, file_name)?, texts(overrides))
    }

    /// The scene with other values of parameters: what follows from them follows. The file is not
    /// parsed again.
    ///
    /// # Errors
    /// [`ScenarioErrors`] with all that is then wrong, a name that is no parameter included.
    pub fn with(&self, values: &[(&str, f64)]) -> Result<Self, ScenarioErrors> {
        let values = values
            .iter()
            .map(|(name, value)| ((*name).to_owned(), Given::Number(*value)));
        let overrides = self.overrides.iter().cloned().chain(values).collect();
        Self::of(self.document.clone(), overrides)
    }

    fn of(document: Document, overrides: Vec<(String, Given)>) -> Result<Self, ScenarioErrors> {
        let model = document.model(&overrides)?;
        let hamiltonian = Hamiltonian::derive(&model).map_err(|problems| model.errors(problems))?;
        Ok(Self {
            model,
            hamiltonian,
            document,
            overrides,
        })
    }
}
