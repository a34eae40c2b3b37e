//! Which laws are simulated: those asked for, or all there are.

use super::law::{Law, LawError, Laws};
use crate::diagnostics::{did_you_mean, shorten};
use crate::feedback::FittedLaw;
use crate::model::ClosedLoop;

/// The value map's law.
pub const MAP: &str = "map";
/// The linear-quadratic law.
pub const LQR: &str = "lqr";

/// A law as a weights file's text.
#[derive(Clone, Debug)]
pub struct Weights {
    pub name: String,
    pub text: String,
    /// The file, for messages.
    pub file: String,
}

impl From<&FittedLaw> for Weights {
    fn from(law: &FittedLaw) -> Self {
        Self {
            name: law.name.clone(),
            text: law.law.to_toml(),
            file: format!("the fitted law {}", law.name),
        }
    }
}

/// What there is besides the scene.
#[derive(Clone, Debug, Default)]
pub struct Available {
    /// Whether there is a value map.
    pub map: bool,
    /// Laws fitted before.
    pub fitted: Vec<Weights>,
    /// Laws added on the command line; always simulated.
    pub added: Vec<Weights>,
}

/// Laws, and names that the scene asks for but of which nothing is there yet (a map, a fitted law).
pub struct Chosen {
    pub laws: Vec<Law>,
    pub missing: Vec<String>,
}

impl Available {
    /// The laws `wanted`, of which each must be there; without that those of the scene, as far as
    /// they are there, or all.
    ///
    /// # Errors
    /// An unknown name; what is wrong with a law.
    pub fn choose(
        &self,
        laws: &Laws<'_>,
        scene: &ClosedLoop,
        wanted: Option<&[String]>,
    ) -> Result<Chosen, LawError> {
        let names: Vec<String> = match (wanted, &scene.laws) {
            (Some(wanted), _) => wanted.to_vec(),
            (None, Some(named)) => named.iter().map(|(n, _)| n.clone()).collect(),
            (None, None) => self.all(laws, scene),
        };
        let mut chosen = Chosen {
            laws: Vec::new(),
            missing: Vec::new(),
        };
        let added = self.added.iter().map(|w| w.name.clone());
        for name in names.into_iter().chain(added) {
            if chosen.laws.iter().any(|l| l.name == name) {
                continue;
            }
            match self.find(laws, scene, &name)? {
                Some(law) => chosen.laws.push(law),
                None if wanted.is_some() => return Err(self.unknown(laws, scene, name)),
                None => chosen.missing.push(name),
            }
        }
        Ok(chosen)
    }

    fn all(&self, laws: &Laws<'_>, scene: &ClosedLoop) -> Vec<String> {
        (self.map.then(|| MAP.to_owned()).into_iter())
            .chain(laws.riccati().map(|_| LQR.to_owned()))
            .chain(self.fitted.iter().map(|w| w.name.clone()))
            .chain(scene.given.iter().map(|g| g.name.clone()))
            .collect()
    }

    fn find(
        &self,
        laws: &Laws<'_>,
        scene: &ClosedLoop,
        name: &str,
    ) -> Result<Option<Law>, LawError> {
        if let Some(weights) = self
            .added
            .iter()
            .chain(&self.fitted)
            .find(|w| w.name == name)
        {
            return laws.weights(name, &weights.text, &weights.file).map(Some);
        }
        if let Some(given) = scene.given.iter().find(|g| g.name == name) {
            return laws.given(given).map(Some);
        }
        match name {
            MAP => Ok(self.map.then(|| laws.chart(MAP))),
            LQR => laws.lqr().map(Some),
            _ => Ok(None),
        }
    }

    fn unknown(&self, laws: &Laws<'_>, scene: &ClosedLoop, name: String) -> LawError {
        let mut known = self.all(laws, scene);
        known.extend(self.added.iter().map(|w| w.name.clone()));
        if name == MAP && !self.map {
            let help = "the result file knows V nowhere, or is not there".to_owned();
            return LawError::Unknown { name, help };
        }
        let help = did_you_mean(&name, known.iter().map(String::as_str));
        let help = help.unwrap_or_else(|| format!("there are: {}", known.join(", ")));
        let name = shorten(&name);
        LawError::Unknown { name, help }
    }
}
