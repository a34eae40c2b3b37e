//! What is wrong with a text, and where: problems, their places, what may help, and how people are
//! shown them.
//!
//! Knows texts and byte ranges, and nothing of scenes: every room above reports by it.

mod printable;
mod problem;
mod render;
mod suggest;

pub use printable::unprintable;
pub use problem::{Problem, Span};
pub use render::ScenarioErrors;
pub(crate) use render::position;
pub use suggest::did_you_mean;
#[cfg(test)]
pub(crate) use suggest::nearest;

/// At most 40 characters of `text`.
pub fn shorten(text: &str) -> String {
    match text.char_indices().nth(40) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text.to_owned(),
    }
}
