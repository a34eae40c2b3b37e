//! Numbers as people read them.

/// The shortest decimal that reads back as the number; a very large or small one with an exponent,
/// not in hundreds of digits.
pub fn plain(number: f64) -> String {
    let size = number.abs();
    if size != 0.0 && size.is_finite() && !(1e-6..1e15).contains(&size) {
        format!("{number:e}")
    } else {
        number.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::plain;

    #[test]
    fn numbers_are_short_and_read_back() {
        let cases = [
            (0.0, "0"),
            (-0.5, "-0.5"),
            (1e-300, "1e-300"),
            (-9.5e299, "-9.5e299"),
            (1e6, "1000000"),
        ];
        for (number, text) in cases {
            assert_eq!(plain(number), text);
            assert_eq!(text.parse::<f64>().unwrap(), number);
        }
        assert_eq!(plain(f64::INFINITY), "inf");
    }
}
