//! How states and controls are named in pictures.

use super::ticks::significant;
use costate::low_level::model::{State, Variable};

const GREEK: [(&str, char); 48] = [
    ("alpha", 'α'),
    ("beta", 'β'),
    ("gamma", 'γ'),
    ("delta", 'δ'),
    ("epsilon", 'ε'),
    ("zeta", 'ζ'),
    ("eta", 'η'),
    ("theta", 'θ'),
    ("iota", 'ι'),
    ("kappa", 'κ'),
    ("lambda", 'λ'),
    ("mu", 'μ'),
    ("nu", 'ν'),
    ("xi", 'ξ'),
    ("omicron", 'ο'),
    ("pi", 'π'),
    ("rho", 'ρ'),
    ("sigma", 'σ'),
    ("tau", 'τ'),
    ("upsilon", 'υ'),
    ("phi", 'φ'),
    ("chi", 'χ'),
    ("psi", 'ψ'),
    ("omega", 'ω'),
    ("Alpha", 'Α'),
    ("Beta", 'Β'),
    ("Gamma", 'Γ'),
    ("Delta", 'Δ'),
    ("Epsilon", 'Ε'),
    ("Zeta", 'Ζ'),
    ("Eta", 'Η'),
    ("Theta", 'Θ'),
    ("Iota", 'Ι'),
    ("Kappa", 'Κ'),
    ("Lambda", 'Λ'),
    ("Mu", 'Μ'),
    ("Nu", 'Ν'),
    ("Xi", 'Ξ'),
    ("Omicron", 'Ο'),
    ("Pi", 'Π'),
    ("Rho", 'Ρ'),
    ("Sigma", 'Σ'),
    ("Tau", 'Τ'),
    ("Upsilon", 'Υ'),
    ("Phi", 'Φ'),
    ("Chi", 'Χ'),
    ("Psi", 'Ψ'),
    ("Omega", 'Ω'),
];

/// A name with the Greek letter that it spells, and its number lowered: `Phi0` is Φ₀.
pub fn symbol(name: &str) -> String {
    let letters = name.trim_end_matches(|c: char| c.is_ascii_digit());
    let number = &name[letters.len()..];
    let (letters, lone) = (
        letters.strip_suffix('_').unwrap_or(letters),
        letters.ends_with('_'),
    );
    let Some((_, greek)) = GREEK.iter().find(|(spelled, _)| *spelled == letters) else {
        return name.to_owned();
    };
    if lone && number.is_empty() {
        return name.to_owned();
    }
    let lowered = number
        .bytes()
        .filter_map(|b| char::from_u32(0x2080 + u32::from(b - b'0')));
    std::iter::once(*greek).chain(lowered).collect()
}

/// ` (unit)`; nothing for a pure number.
pub fn unit(unit: Option<&str>) -> String {
    match unit {
        None | Some("1" | "") => String::new(),
        Some(unit) => format!(" ({unit})"),
    }
}

/// What an axis says: long name, symbol and unit.
pub fn label(variable: &Variable) -> String {
    let symbol = symbol(&variable.name);
    let unit = unit(variable.unit.as_deref());
    match variable.long_name.as_deref() {
        Some(long) if long != variable.name => format!("{long} {symbol}{unit}"),
        _ => format!("{symbol}{unit}"),
    }
}

/// `θ = 0.12`, of each state that is not shown: what it is held at.
pub fn held(states: &[State], shown: &[usize], value: impl Fn(usize) -> f64) -> Vec<String> {
    (states.iter().enumerate())
        .filter(|(k, _)| !shown.contains(k))
        .map(|(k, s)| {
            let value = significant(value(k), 4);
            format!("{} = {value}", symbol(&s.variable.name))
        })
        .collect()
}

/// ` at θ = 0.12, γ = 1.5`: what is held fixed, if anything is.
pub fn at(fixed: &[String]) -> String {
    if fixed.is_empty() {
        String::new()
    } else {
        format!(" at {}", fixed.join(", "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn greek() {
        assert_eq!(symbol("theta"), "θ");
        assert_eq!(symbol("Phi0"), "Φ₀");
        assert_eq!(symbol("omega_12"), "ω₁₂");
        assert_eq!(symbol("x1"), "x1");
        assert_eq!(symbol("theta_"), "theta_");
        assert_eq!(symbol("psi_c0"), "psi_c0");
        assert_eq!(unit(Some("1")), "");
        assert_eq!(unit(Some("rad/s")), " (rad/s)");
    }
}
