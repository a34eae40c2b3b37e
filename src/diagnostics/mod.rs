//! What is wrong with a text, and where: problems, their places, what may help, and how people are
//! shown them.
//!
//! Knows texts and byte ranges, and nothing of scenes: every room above reports by it.

mod printable;
mod problem;
mod render;
mod suggest;

pub use printable::{printable, unprintable};
pub use problem::{Problem, Span};
pub use render::ScenarioErrors;
pub(crate) use render::position;
pub use suggest::did_you_mean;
#[cfg(test)]
pub(crate) use suggest::nearest;

/// At most 40 characters of `text`, for messages: what a terminal would not show as it is is
/// escaped.
pub fn shorten(text: &str) -> String {
    let shown = |text: &str| match unprintable(text) {
        Some(_) => text.escape_debug().to_string(),
        None => text.to_owned(),
    };
    match text.char_indices().nth(40) {
        Some((end, _)) => format!("{}...", shown(&text[..end])),
        None => shown(text),
    }
}
