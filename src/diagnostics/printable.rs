//! What of a text could mislead where it is printed.

/// The first character of a text that is not shown as it is: a control character (a terminal obeys
/// it), or one that changes the direction of what follows or breaks lines where none is seen (a
/// source file then reads otherwise than it is compiled).
#[must_use]
pub fn unprintable(text: &str) -> Option<char> {
    let misleads = |c: &char| {
        c.is_control()
            || matches!(*c, '\u{061c}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}')
            || matches!(*c, '\u{2060}'..='\u{206f}' | '\u{feff}' | '\u{fff9}'..='\u{fffb}')
    };
    text.chars().find(misleads)
}

#[cfg(test)]
mod tests {
    use super::unprintable;

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
