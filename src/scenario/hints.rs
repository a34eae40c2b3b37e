//! What to write instead of what this language does not have.

/// Of an unknown key or section (`within` is the section's name as messages have it; "" at the
/// top).
pub(super) fn of_key(within: &str, key: &str) -> Option<&'static str> {
    let state = within.starts_with("state ");
    Some(match (within, key) {
        ("[cost]", "discount" | "discount_rate" | "rate" | "beta") => {
            "a discount: a finite horizon, a state s with ds/dt = 1 for the time, and exp(-r*s) in the cost (the guide's chapter Tasks)"
        }
        ("[cost]", "final_state" | "terminal_state" | "target" | "terminal_constraint") => {
            "a target at the end: terminal = \"w*x^2\" with a large w (the guide's chapter Tasks)"
        }
        (_, "min" | "max" | "lower" | "upper" | "bounds") if state => {
            "bounds of a state are guards, such as [guards] floor = \"x >= -1\", or a steep term in the cost (the guide's chapter Tasks)"
        }
        ("", "constraints" | "bounds" | "limits") => {
            "bounds of states are guards, such as [guards] floor = \"x >= -1\"; those of a control are its min and max"
        }
        ("", "terminal" | "final" | "horizon") => {
            "a finite horizon: [cost] terminal = \"...\" and final_time = ..."
        }
        _ => return None,
    })
}

/// Of an unknown name in an expression.
pub(super) fn of_name(name: &str) -> Option<&'static str> {
    Some(match name {
        "t" | "time" => {
            "there is no name for the time: add a state s with ds/dt = 1, on a finite horizon (the guide's chapter Tasks)"
        }
        "free" => {
            "a free final time: make the duration a state, or compare several horizons with --set (the guide's chapter Tasks)"
        }
        "inf" | "infinity" => {
            "an infinite horizon: [equilibrium] in place of final_time and terminal"
        }
        _ => return None,
    })
}

/// Of what `--set` gives for a parameter, where it is a number of no size.
pub(super) fn of_no_number(text: &str) -> Option<&'static str> {
    let bare = text.trim().trim_start_matches(['+', '-']).to_lowercase();
    match bare.as_str() {
        "inf" | "infinity" => Some(
            "take a number that is large beside the others of the scene, such as 1e6; a bound that is not wanted is left out of the scene",
        ),
        "nan" => Some("give a number, or an expression of the parameters before it"),
        _ => None,
    }
}

/// Of an unknown function.
pub(super) fn of_function(name: &str) -> Option<&'static str> {
    Some(match name {
        "der" | "diff" | "dot" | "ddt" | "derivative" => {
            "a rate: make the control a state, and its rate the control (the guide's chapter Tasks)"
        }
        "sign" | "sgn" => "a smooth step: tanh(x/a) with a small a",
        "atan2" => "an angle: make it a state with a period",
        "if" | "where" | "ite" | "piecewise" => {
            "a smooth step 0.5*(1 + tanh((x - x0)/a)) times what is wanted above x0"
        }
        _ => return None,
    })
}
