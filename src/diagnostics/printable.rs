//! What of a text could mislead where it is printed.

use std::borrow::Cow;

/// The first character of a text that is not shown as it is: a control character (a terminal obeys
/// it), or one that changes the direction of what follows or breaks lines where none is seen (a
/// source file then reads otherwise than it is compiled).
#[must_use]
pub fn unprintable(text: &str) -> Option<char> {
    text.chars().find(|c| misleads(*c))
}

/// Whether a character is not shown as it is.
pub(super) fn misleads(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{061c}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}')
        || matches!(c, '\u{2060}'..='\u{206f}' | '\u{feff}' | '\u{fff9}'..='\u{fffb}')
}

/// A text for a terminal: such characters as `\u{1b}`, lines and tabs as they are.
#[must_use]
pub fn printable(text: &str) -> Cow<'_, str> {
    let bad = |c: char| misleads(c) && !matches!(c, '\n' | '\t');
    if !text.contains(bad) {
        return text.into();
    }
    let mut shown = String::with_capacity(text.len() + 8);
    for c in text.chars() {
        match bad(c) {
            true => shown.extend(c.escape_unicode()),
            false => shown.push(c),
        }
    }
    shown.into()
}

#[cfg(test)]
mod tests {
    use super::{printable, unprintable};

    #[test]
    fn what_a_terminal_obeys_is_spelled_out() {
        assert_eq!(
            printable("a\u{1b}[31m\n\tb\u{202e}"),
            "a\\u{1b}[31m\n\tb\\u{202e}"
        );
        assert_eq!(printable("\u{3b8}, 100 %"), "\u{3b8}, 100 %");
    }

    #[test]
    fn letters_of_all_languages_are_printable() {
        assert_eq!(unprintable("Pendel \u{3b8}, \u{5d0}\u{5d1}, 100 %"), None);
        for (text, bad) in [
            ("a\u{1b}[31m", '\u{1b}'),
            ("a\nb", '\n'),
            ("\u{202e}abc", '\u{202e}'),
            ("a\u{0}", '\0'),
        ] {
            assert_eq!(unprintable(text), Some(bad));
        }
    }
}
