//! Joining fragments into a module, and checking it before the device sees it.

use crate::backend::BackendError;
use wgpu::naga;

/// A named piece of a module's text.
#[derive(Clone, Debug)]
pub struct Fragment {
    pub name: &'static str,
    pub text: String,
}

/// A module's whole text and where its fragments begin in it.
#[derive(Clone, Debug)]
pub struct Source {
    pub text: String,
    /// Name and first line (from 0).
    starts: Vec<(&'static str, usize)>,
}

impl Source {
    pub fn new(fragments: &[Fragment]) -> Self {
        let mut text = String::new();
        let mut starts = Vec::new();
        let mut line = 0;
        for fragment in fragments {
            starts.push((fragment.name, line));
            text.push_str(&fragment.text);
            if !fragment.text.ends_with('\n') {
                text.push('\n');
            }
            line = text.lines().count();
        }
        Self { text, starts }
    }

    /// Parses and validates with no more capabilities than the device has.
    ///
    /// # Errors
    /// The first error, with the fragment and its line.
    pub fn validate(&self, f64_arithmetic: bool) -> Result<(), BackendError> {
        let module = naga::front::wgsl::parse_str(&self.text).map_err(|e| {
            self.error(
                e.location(&self.text).map(|l| l.line_number),
                describe(&e, e.message()),
            )
        })?;
        let capabilities = if f64_arithmetic {
            naga::valid::Capabilities::FLOAT64 | naga::valid::Capabilities::SHADER_INT64
        } else {
            naga::valid::Capabilities::empty()
        };
        naga::valid::Validator::new(naga::valid::ValidationFlags::all(), capabilities)
            .validate(&module)
            .map_err(|e| {
                let line = e.location(&self.text).map(|l| l.line_number);
                self.error(line, describe(e.as_inner(), &e.as_inner().to_string()))
            })?;
        Ok(())
    }

    /// An error at a line (from 1) of the whole text.
    fn error(&self, line: Option<u32>, message: String) -> BackendError {
        let line = line.map_or(0, |l| l.saturating_sub(1) as usize);
        let (name, first) = self
            .starts
            .iter()
            .rev()
            .find(|(_, first)| *first <= line)
            .copied()
            .unwrap_or(("module", 0));
        BackendError::Shader {
            fragment: name.to_owned(),
            line: line - first + 1,
            message,
        }
    }
}

/// A message with its causes.
fn describe(error: &dyn std::error::Error, message: &str) -> String {
    let mut text = message.to_owned();
    let mut source = error.source();
    while let Some(cause) = source {
        text.push_str(": ");
        text.push_str(&cause.to_string());
        source = cause.source();
    }
    text
}

/// Keeps what lies between `//if NAMES` and `//end` where all NAMES are among the conditions;
/// dropped lines stay as empty ones, so that line numbers are the file's.
pub fn conditional(text: &str, conditions: &[&str]) -> String {
    let mut keep = true;
    let mut out = String::with_capacity(text.len());
    for line in text.lines() {
        if let Some(names) = line.strip_prefix("//if ") {
            keep = names
                .split_whitespace()
                .all(|name| conditions.contains(&name));
        } else if line == "//end" {
            keep = true;
        } else if keep {
            out.push_str(line);
        }
        out.push('\n');
    }
    out
}
