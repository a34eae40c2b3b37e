//! A scenario's text, parsed once: the scene at other values of its parameters is read from it
//! again without another parse.

use super::mechanism::Generated;
use super::reader::Reader;
use crate::diagnostics::ScenarioErrors;
use crate::model::Model;
use std::sync::Arc;
use toml::Spanned;
use toml::de::DeTable;

type Table<'t> = Spanned<DeTable<'t>>;

self_cell::self_cell!(
    struct Parsed {
        owner: String,
        #[covariant]
        dependent: Table,
    }
);

/// What a parameter is replaced by.
#[derive(Clone, Debug, PartialEq)]
pub enum Given {
    /// An expression of earlier parameters, as typed.
    Text(String),
    Number(f64),
}

impl Given {
    /// As it would be typed.
    pub(super) fn text(&self) -> String {
        match self {
            Self::Text(text) => text.clone(),
            Self::Number(number) => format!("{number:?}"),
        }
    }
}

/// A scenario file whose TOML is good; copies share it.
#[derive(Clone)]
pub struct Document {
    parsed: Arc<Parsed>,
    file_name: String,
}

impl std::fmt::Debug for Document {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Document")
            .field("file_name", &self.file_name)
            .finish_non_exhaustive()
    }
}

impl Document {
    /// Parses a scenario's text as TOML. `file_name` is for messages.
    ///
    /// # Errors
    /// [`ScenarioErrors`] with everything that is wrong with the TOML, and with the syntax of
    /// expressions then.
    pub fn parse(text: &str, file_name: &str) -> Result<Self, ScenarioErrors> {
        let parsed = Parsed::try_new(text.to_owned(), |text| {
            let (document, errors) = DeTable::parse_recoverable(text);
            if errors.is_empty() {
                return Ok(document);
            }
            let mut reader = Reader::new(text);
            reader.toml_problems(&errors);
            reader.expression_syntax(document.get_ref());
            Err(ScenarioErrors::new(file_name, text, reader.problems))
        })?;
        Ok(Self {
            parsed: Arc::new(parsed),
            file_name: file_name.to_owned(),
        })
    }

    /// The whole text.
    pub fn text(&self) -> &str {
        self.parsed.borrow_owner()
    }

    /// The scene. Each of `overrides` replaces the definition of a parameter; where a name is given
    /// twice, the last counts.
    ///
    /// # Errors
    /// [`ScenarioErrors`] with everything that is wrong.
    pub fn model(&self, overrides: &[(String, Given)]) -> Result<Model, ScenarioErrors> {
        self.parsed.with_dependent(|text, table| {
            let generated = Generated::of(table.get_ref());
            let mut reader = Reader::new(text);
            let model = reader.model(table.get_ref(), &generated, &self.file_name, overrides);
            match model {
                Some(model) if reader.problems.is_empty() => Ok(Model {
                    graph: reader.graph,
                    ..model
                }),
                _ => Err(ScenarioErrors::new(&self.file_name, text, reader.problems)),
            }
        })
    }
}
