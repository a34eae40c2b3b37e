//! Names that groups of a result file have of their own: a scene's states and recorded quantities
//! that stand beside them there cannot have these.

/// Of `/map`, beside an axis for each state.
pub const MAP: &[&str] = &[
    "V",
    "p",
    "u",
    "w",
    "sheet",
    "lifted_sheet",
    "winding",
    "status",
    "evidence",
    "covered_to",
    "bound",
    "starts",
    "flights",
    "state",
    "control",
    "disturbance",
];
/// Of `/map` with interpolated values.
pub const VALUES: &[&str] = &["V_error", "p_error", "u_error", "dV_dt", "coverage"];
/// Of `/study`, beside the varied parameters and the recorded quantities.
pub const STUDY: &[&str] = &[
    "V",
    "x0",
    "u",
    "status",
    "sheets",
    "duration",
    "variant",
    "state",
    "control",
    "disturbance",
];
/// Of `/closed_loop`, beside the recorded quantities.
pub const CLOSED_LOOP: &[&str] = &[
    "law",
    "initial",
    "state",
    "x0",
    "V",
    "J",
    "suboptimality",
    "converged",
    "status",
    "t_end",
    "fallback",
    "control",
];
/// Of `/attenuation_regions`, beside an axis for each state.
pub const ATTENUATION: &[&str] = &["V", "status", "level"];

/// Whether a name is one of those, or one that every group may have: units and descriptions of the
/// components of an axis.
#[must_use]
pub fn is_reserved(name: &str, names: &[&str]) -> bool {
    const ENDINGS: [&str; 2] = ["_units", "_long_name"];
    names.contains(&name) || ENDINGS.iter().any(|end| name.ends_with(end))
}

/// Whether a name is one of `/map`, of solved states or of interpolated ones.
#[must_use]
pub fn is_of_map(name: &str) -> bool {
    is_reserved(name, MAP) || VALUES.contains(&name)
}
