//! Places and labels of an axis's ticks.

use super::text::raised;

/// A tick: its value and its label, empty for a lesser one.
#[derive(Clone, Debug, PartialEq)]
pub struct Tick {
    pub value: f64,
    pub label: String,
}

/// Steps of 1, 2 or 5 times a power of ten, at most `most` ticks (at least 2) from `from` to `to`.
pub fn linear(from: f64, to: f64, most: usize) -> Vec<Tick> {
    let width = to - from;
    if width <= 0.0 || !width.is_finite() {
        return vec![Tick {
            value: from,
            label: number(from, 0.0),
        }];
    }
    let step = step(width, most.max(2));
    // Half a thousandth of a step: rounding must not lose a tick at an end.
    let first = (from / step - 5e-4).ceil();
    let last = (to / step + 5e-4).floor();
    (0..=(last - first).max(0.0) as usize)
        .map(|k| {
            let value = (first + k as f64) * step;
            Tick {
                value,
                label: number(value, step),
            }
        })
        .collect()
}

/// The least step of 1, 2 or 5 times a power of ten of which at most `most` multiples fit.
pub fn step(width: f64, most: usize) -> f64 {
    let least = width / most as f64;
    let power = 10f64.powf(least.log10().floor());
    let factor = [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .find(|f| f * power >= least * (1.0 - 1e-9));
    factor.unwrap_or(10.0) * power
}

/// Powers of ten; where there are few, what lies between them too, and its labels where there are
/// fewer than two.
pub fn logarithmic(from: f64, to: f64, most: usize) -> Vec<Tick> {
    let (low, high) = (from.log10(), to.log10());
    let (first, last) = ((low - 1e-9).ceil() as i64, (high + 1e-9).floor() as i64);
    let decades = (last - first + 1).max(0) as usize;
    if decades < 2 && high - low < 1.0 {
        return between(from, to, most);
    }
    let stride = decades.div_ceil(most.max(2)).max(1) as i64;
    let mut ticks = Vec::new();
    for exponent in first - 1..=last {
        let labelled = exponent >= first && (exponent - first) % stride == 0;
        if exponent >= first {
            ticks.push(Tick {
                value: 10f64.powi(exponent as i32),
                label: if labelled {
                    power(exponent)
                } else {
                    String::new()
                },
            });
        }
        if decades <= 6 {
            for factor in 2..10 {
                let value = f64::from(factor) * 10f64.powi(exponent as i32);
                if value >= from && value <= to {
                    ticks.push(Tick {
                        value,
                        label: String::new(),
                    });
                }
            }
        }
    }
    ticks
}

/// Within a decade or so: 1, 2 and 5, or even steps where these are too far apart.
fn between(from: f64, to: f64, most: usize) -> Vec<Tick> {
    let low = from.log10().floor() as i32;
    let high = to.log10().ceil() as i32;
    let all = (low..=high).flat_map(|e| [1.0, 2.0, 5.0].map(|f| f * 10f64.powi(e)));
    let ticks: Vec<Tick> = all
        .filter(|v| *v >= from * (1.0 - 1e-9) && *v <= to * (1.0 + 1e-9))
        .map(|value| Tick {
            value,
            label: number(value, value),
        })
        .collect();
    if ticks.len() >= 2 {
        ticks
    } else {
        linear(from, to, most.min(4))
    }
}

/// 10 to the `exponent`.
pub fn power(exponent: i64) -> String {
    match exponent {
        0..=3 => 10i64.pow(exponent as u32).to_string(),
        -2..0 => number(10f64.powi(exponent as i32), 10f64.powi(exponent as i32)),
        _ => format!("10{}", raised(exponent)),
    }
}

/// A number as an axis with such steps shows it; `step` 0: to five digits.
pub fn number(value: f64, step: f64) -> String {
    if value == 0.0 || value.abs() < 1e-9 * step.abs() {
        return "0".to_owned();
    }
    let size = value.abs();
    let unit = if step == 0.0 { size * 1e-4 } else { step };
    if !(1e-4..1e6).contains(&size) || !(1e-5..).contains(&unit) {
        let exponent = (size.log10() + 1e-9).floor();
        let scale = 10f64.powf(exponent);
        let digits = decimals(unit / scale);
        let mantissa = trimmed(&format!("{:.digits$}", value / scale), step == 0.0);
        return match trimmed(&mantissa, true).as_str() {
            "1" => format!("10{}", raised(exponent as i64)),
            "-1" => format!("\u{2212}10{}", raised(exponent as i64)),
            _ => minus(&format!("{mantissa}\u{b7}10{}", raised(exponent as i64))),
        };
    }
    minus(&trimmed(
        &format!("{value:.0$}", decimals(unit)),
        step == 0.0,
    ))
}

/// A number to about `digits` significant digits, for a text.
pub fn significant(value: f64, digits: i32) -> String {
    if value == 0.0 || !value.is_finite() {
        return if value.is_nan() {
            "\u{2013}".to_owned()
        } else {
            format!("{value}")
        };
    }
    let size = 10f64.powf(value.abs().log10().floor());
    let unit = size * 10f64.powi(1 - digits);
    let rounded = (value / unit).round() * unit;
    let text = number(rounded, unit);
    match text.split_once('\u{b7}') {
        Some((mantissa, rest)) => match trimmed(mantissa, true).as_str() {
            "1" => rest.to_owned(),
            shorter => format!("{shorter}\u{b7}{rest}"),
        },
        None => trimmed(&text, true),
    }
}

fn decimals(unit: f64) -> usize {
    (-(unit.abs().log10() + 1e-6).floor()).clamp(0.0, 12.0) as usize
}

fn trimmed(text: &str, zeros: bool) -> String {
    if zeros && text.contains('.') {
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        text.to_owned()
    }
}

/// A hyphen is shorter than a minus sign.
fn minus(text: &str) -> String {
    text.replace('-', "\u{2212}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(ticks: &[Tick]) -> Vec<&str> {
        ticks
            .iter()
            .map(|t| t.label.as_str())
            .filter(|l| !l.is_empty())
            .collect()
    }

    #[test]
    fn steps_of_one_two_five() {
        assert_eq!(
            labels(&linear(0.0, 1.0, 6)),
            ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"].map(|s| if s == "0.0" { "0" } else { s })
        );
        assert_eq!(
            labels(&linear(-3.9, 2.4, 7)),
            ["\u{2212}3", "\u{2212}2", "\u{2212}1", "0", "1", "2"]
        );
        assert_eq!(labels(&linear(0.0, 185.0, 5)), ["0", "50", "100", "150"]);
        for most in 2..12 {
            for width in [1e-7, 0.3, 1.0, 7.0, 99.0, 3e8] {
                let ticks = linear(-0.3 * width, 0.7 * width, most);
                assert!(
                    ticks.len() <= most + 1 && !ticks.is_empty(),
                    "{most} {width}: {ticks:?}"
                );
            }
        }
        assert_eq!(linear(1.0, 1.0, 5).len(), 1);
    }

    #[test]
    fn powers_of_ten() {
        assert_eq!(
            labels(&logarithmic(1e-3, 100.0, 10)),
            ["10\u{207b}\u{b3}", "0.01", "0.1", "1", "10", "100"]
        );
        assert!(labels(&logarithmic(1e-16, 1.0, 5)).len() <= 5);
        assert_eq!(labels(&logarithmic(0.9, 6.0, 10)), ["1", "2", "5"]);
    }

    #[test]
    fn numbers() {
        assert_eq!(number(-0.25, 0.05), "\u{2212}0.25");
        assert_eq!(number(2e-7, 1e-7), "2\u{b7}10\u{207b}\u{2077}");
        assert_eq!(number(1e7, 1e6), "10\u{2077}");
        assert_eq!(significant(0.018316, 3), "0.0183");
        assert_eq!(significant(7.389, 3), "7.39");
        assert_eq!(significant(184.0, 3), "184");
        assert_eq!(significant(7.41e-8, 2), "7.4\u{b7}10\u{207b}\u{2078}");
        assert_eq!(significant(1e-6, 2), "10\u{207b}\u{2076}");
        assert_eq!(significant(f64::NAN, 2), "\u{2013}");
    }
}
