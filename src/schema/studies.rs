//! Parameter studies and levels of attenuation.

use super::{Along, CONTROLS, Group, STATE_AXES, STATES, Unit, When, along, code, integer, real};

/// A row for each variant.
pub static STUDY: Group = Group {
    name: "study",
    title: "the optimal trajectory from one state, for several values of parameters",
    dimensions: &[
        along("variant", Along::Index, "variant index"),
        STATES,
        CONTROLS,
    ],
    variables: &[
        real("<parameter>", &["variant"], Unit::One, "parameter"),
        real(
            "x0",
            &["variant", "state"],
            Unit::State,
            "state started from",
        ),
        real("V", &["variant"], Unit::Cost, "value function"),
        code(
            "status",
            &["variant"],
            "whether V is known there, or why not",
        ),
        integer("sheets", &["variant"], "number of solutions found"),
        real(
            "duration",
            &["variant"],
            Unit::Time,
            "time to near the equilibrium",
        ),
        real(
            "u",
            &["variant", "control"],
            Unit::Control,
            "control at the beginning",
        )
        .when(When::Controls),
        real(
            "<quantity>",
            &["variant"],
            Unit::One,
            "each recorded quantity",
        ),
    ],
    attributes: &[],
};

/// Its trajectories.
pub static STUDY_TRAJECTORIES: Group = Group {
    name: "study_trajectories",
    title: "the trajectories of /study",
    dimensions: &[
        along("variant", Along::Index, "variant index"),
        along("sample", Along::Index, "sample index"),
        STATES,
        CONTROLS,
    ],
    variables: &[
        real(
            "t",
            &["variant", "sample"],
            Unit::Time,
            "time, 0 at the state started from",
        ),
        real("x", &["variant", "sample", "state"], Unit::State, "state"),
        real("V", &["variant", "sample"], Unit::Cost, "value function"),
        real(
            "u",
            &["variant", "sample", "control"],
            Unit::Control,
            "control",
        )
        .when(When::Controls),
    ],
    attributes: &[],
};

const PARAMETER: (&str, &str) = ("parameter", "the parameter that is the level");

/// Coverage against the level.
pub static ATTENUATION: Group = Group {
    name: "attenuation",
    title: "coverage against the level of attenuation",
    dimensions: &[
        along("row", Along::Index, "row index"),
        along("status", Along::Names, "status name"),
    ],
    variables: &[
        real("value", &["row"], Unit::One, "level"),
        real(
            "coverage",
            &["row"],
            Unit::One,
            "share of the wanted states at which V is valid",
        ),
        integer("valid", &["row"], "states at which V is valid"),
        integer("wanted", &["row"], "states inside the guards"),
        integer("states", &["row", "status"], "number of states by status"),
        integer("swept", &["row"], "1 where the scene could be swept at all"),
        real("own", &[], Unit::One, "the scene's own level"),
        real(
            "star",
            &[],
            Unit::One,
            "smallest level that the linearization allows, by the game Riccati equation",
        ),
        real(
            "star_hamiltonian",
            &[],
            Unit::One,
            "the same by the Hamiltonian matrix alone",
        ),
        real(
            "smallest_covering",
            &[],
            Unit::One,
            "smallest level whose region of validity covers the states",
        ),
        real(
            "bracket_lower",
            &[],
            Unit::One,
            "largest value looked at that does not cover",
        ),
        real(
            "bracket_upper",
            &[],
            Unit::One,
            "smallest value from which on all that were looked at cover",
        ),
    ],
    attributes: &[
        PARAMETER,
        ("cause", "what bounds the level of the linearization"),
        (
            "monotone",
            "1 where coverage grew with the level at all that were looked at",
        ),
    ],
};

/// Regions of validity at some levels.
pub static ATTENUATION_REGIONS: Group = Group {
    name: "attenuation_regions",
    title: "regions of validity: where V solves the Isaacs equation at a level of attenuation",
    dimensions: &[
        along("level", Along::Values(Unit::One), "level"),
        STATE_AXES,
    ],
    variables: &[
        code(
            "status",
            &["level", "<state>"],
            "whether V is known there, or why not",
        ),
        real(
            "V",
            &["level", "<state>"],
            Unit::Cost,
            "value function, where it is valid",
        ),
    ],
    attributes: &[PARAMETER],
};

/// Folds at these levels.
pub static ATTENUATION_CAUSTIC: Group = Group {
    name: "attenuation_caustic",
    title: "where trajectories meet folds, at the levels of /attenuation_regions",
    dimensions: &[
        along("vertex", Along::Rows, "vertex index"),
        along("level", Along::Values(Unit::One), "level"),
        STATES,
        CONTROLS,
    ],
    variables: &[
        integer(
            "level_index",
            &["vertex"],
            "index of the level in /attenuation_regions",
        ),
        real("x", &["vertex", "state"], Unit::State, "state"),
    ],
    attributes: &[],
};
