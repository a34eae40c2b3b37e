//! Problems found in a scenario, each with its place; all of a file are reported together.

/// A byte range of a scenario's text.
pub type Span = std::ops::Range<usize>;

/// One problem: what is wrong, where, and what may help.
#[derive(Clone, Debug, PartialEq)]
pub struct Problem {
    /// What is wrong, in one sentence without a full stop.
    pub message: String,
    /// The text to underline; `None` where no text is at fault (a missing section).
    pub span: Option<Span>,
    /// Short text at the underline.
    pub label: String,
    /// What may help: "did you mean ...".
    pub help: Option<String>,
}

impl Problem {
    /// A problem of the text at `span`.
    pub fn at(span: Span, message: impl Into<String>, label: impl Into<String>) -> Self {
        Self {
            message: message.into(),
            span: Some(span),
            label: label.into(),
            help: None,
        }
    }

    /// The same with a hint.
    pub fn with_help(mut self, help: impl Into<String>) -> Self {
        self.help = Some(help.into());
        self
    }
}
