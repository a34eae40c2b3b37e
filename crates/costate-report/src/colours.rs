//! Colours: classes that the colour-blind tell apart, and a map of values whose lightness is even.

/// A colour, red, green and blue.
pub type Rgb = [u8; 3];

/// M. Okabe, K. Ito, Color Universal Design (2008), without the yellow, which is too light for
/// lines.
pub const CLASSES: [Rgb; 7] = [
    [0, 114, 178],
    [213, 94, 0],
    [0, 158, 115],
    [204, 121, 167],
    [230, 159, 0],
    [86, 180, 233],
    [110, 110, 110],
];

/// The colour of class `k`; they repeat after seven.
pub fn class(k: usize) -> Rgb {
    CLASSES[k % CLASSES.len()]
}

/// Viridis (N. Smith, S. van der Walt, 2015) at seventeen even places.
const VALUES: [Rgb; 17] = [
    [68, 1, 84],
    [72, 24, 106],
    [71, 45, 123],
    [66, 64, 134],
    [59, 82, 139],
    [51, 99, 141],
    [44, 114, 142],
    [38, 130, 142],
    [33, 145, 140],
    [31, 160, 136],
    [40, 174, 128],
    [63, 188, 115],
    [94, 201, 98],
    [132, 212, 75],
    [173, 220, 48],
    [216, 226, 25],
    [253, 231, 37],
];

/// The colour at `share` (0 to 1, else the nearer end) of the range of values.
pub fn value(share: f64) -> Rgb {
    let last = VALUES.len() - 1;
    let place = if share.is_finite() {
        share.clamp(0.0, 1.0)
    } else {
        0.0
    } * last as f64;
    let below = (place as usize).min(last - 1);
    mixed(VALUES[below], VALUES[below + 1], place - below as f64)
}

/// A colour between two, `share` of the way to the second.
pub fn mixed(a: Rgb, b: Rgb, share: f64) -> Rgb {
    [0, 1, 2].map(|k| {
        let (a, b) = (f64::from(a[k]), f64::from(b[k]));
        (a + (b - a) * share).round().clamp(0.0, 255.0) as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Relative luminance (WCAG 2.1).
    fn luminance(c: Rgb) -> f64 {
        let linear = |v: u8| {
            let v = f64::from(v) / 255.0;
            if v <= 0.04045 {
                v / 12.92
            } else {
                ((v + 0.055) / 1.055).powf(2.4)
            }
        };
        0.2126 * linear(c[0]) + 0.7152 * linear(c[1]) + 0.0722 * linear(c[2])
    }

    #[test]
    fn values_grow_lighter() {
        let shades: Vec<f64> = (0..=100)
            .map(|k| luminance(value(f64::from(k) / 100.0)))
            .collect();
        assert!(shades.windows(2).all(|w| w[1] > w[0]));
        assert_eq!(value(-1.0), value(0.0));
        assert_eq!(value(f64::NAN), value(0.0));
        assert_eq!(value(2.0), VALUES[16]);
    }
}
