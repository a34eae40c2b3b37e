//! Closed loops and checks of the dissipation inequality.

use super::{
    Along, CONTROLS, DISTURBANCES, Dimension, Group, STATES, Unit, When, along, code, integer,
    real, text,
};

const LAW: Dimension = along("law", Along::Names, "feedback law");
/// What integrated.
const BACKEND: (&str, &str) = ("backend", "what integrated");
const ADAPTER: (&str, &str) = ("adapter", "its device");
const PRECISION: (&str, &str) = ("precision", "arithmetic");
const METHOD: (&str, &str) = ("method", "integration method");
const RTOL: (&str, &str) = ("rtol", "relative tolerance of a step");
const FINAL_TIME: (&str, &str) = ("final_time", "time that a closed loop is simulated to");

/// A closed loop from each initial state under each law.
pub static CLOSED_LOOP: Group = Group {
    name: "closed_loop",
    title: "closed loops of feedback laws from many initial states",
    dimensions: &[LAW, along("initial", Along::Index, "initial state"), STATES],
    variables: &[
        real("x0", &["initial", "state"], Unit::State, "initial state"),
        real(
            "V",
            &["initial"],
            Unit::Cost,
            "value function at the initial state",
        ),
        real("J", BOTH, Unit::Cost, "cost of the closed loop"),
        real("suboptimality", BOTH, Unit::One, "J/V - 1"),
        code(
            "converged",
            BOTH,
            "whether the closed loop ends near the equilibrium",
        ),
        code("status", BOTH, "how the closed loop ended"),
        real(
            "t_end",
            BOTH,
            Unit::Time,
            "time at the end of the trajectory",
        ),
        integer(
            "fallback",
            BOTH,
            "updates of the map's law without an answer of the map",
        ),
        real("<quantity>", BOTH, Unit::One, "each recorded quantity"),
    ],
    attributes: &[
        (
            "outside",
            "what the map's law does where the map does not know V",
        ),
        FINAL_TIME,
        (
            "converged_metric",
            "what `converged_below` is a quadratic form of: the local solution, or widths of the region",
        ),
        (
            "converged_below",
            "closed loops that end below it have converged",
        ),
        BACKEND,
        ADAPTER,
        PRECISION,
        METHOD,
        (
            "method_of_map",
            "integration method between updates of the map's law",
        ),
        RTOL,
        (
            "axes",
            "of a grid of initial states: its axes, the last one fastest",
        ),
        (
            "counts",
            "of a grid of initial states: how many along each axis",
        ),
    ],
};
const BOTH: &[&str] = &["law", "initial"];

/// A row for each law.
pub static CLOSED_LOOP_LAWS: Group = Group {
    name: "closed_loop_laws",
    title: "feedback laws over all initial states of /closed_loop",
    dimensions: &[LAW],
    variables: &[
        text("source", &["law"], "where the law comes from"),
        text(
            "statuses",
            &["law"],
            "how closed loops ended, with their number",
        ),
        real(
            "share_converged",
            &["law"],
            Unit::One,
            "share of initial states from which the law converges",
        ),
        real(
            "suboptimality_median",
            &["law"],
            Unit::One,
            "median of J/V - 1",
        ),
        real(
            "suboptimality_p99",
            &["law"],
            Unit::One,
            "99 % quantile of J/V - 1",
        ),
        real("suboptimality_max", &["law"], Unit::One, "largest J/V - 1"),
        real(
            "suboptimality_count",
            &["law"],
            Unit::One,
            "initial states with J/V - 1",
        ),
        real(
            "seconds",
            &["law"],
            Unit::Fixed("s"),
            "time of the simulation",
        ),
        real(
            "rate",
            &["law"],
            Unit::Fixed("1/s"),
            "initial states a second",
        ),
        real(
            "failed",
            &["law"],
            Unit::One,
            "trajectories that ended early",
        ),
        real(
            "updates",
            &["law"],
            Unit::One,
            "updates of the map's law in all",
        ),
        real(
            "held",
            &["law"],
            Unit::One,
            "share of the map law's updates without an answer of the map",
        ),
        real(
            "fell_back",
            &["law"],
            Unit::One,
            "trajectories with such updates",
        ),
        real(
            "worst_<quantity>",
            &["law"],
            Unit::One,
            "each recorded quantity at its worst",
        ),
    ],
    attributes: &[BACKEND, ADAPTER],
};

/// Boundaries of sets of initial states.
pub static OPERATING_SETS: Group = Group {
    name: "operating_sets",
    title: "sets of initial states from which a condition holds",
    dimensions: &[LAW, along("set", Along::Names, "set name")],
    variables: &[
        text("condition", &["set"], "the condition"),
        real(
            "share",
            &["law", "set"],
            Unit::One,
            "share of initial states inside",
        ),
        real(
            "area",
            &["law", "set"],
            Unit::State,
            "area inside; its unit is the product of those of the grid's axes",
        ),
    ],
    attributes: &[],
};

/// Their boundaries.
pub static OPERATING_CONTOURS: Group = Group {
    name: "operating_contours",
    title: "boundaries of the sets of /operating_sets",
    dimensions: &[
        along("vertex", Along::Index, "vertex index"),
        along("axis", Along::Names, "axis name"),
    ],
    variables: &[
        code("law", &["vertex"], "feedback law"),
        code("set", &["vertex"], "set"),
        integer("line", &["vertex"], "number of the polyline"),
        integer("place", &["vertex"], "place on the polyline"),
        text("axis_units", &["axis"], "unit of each axis"),
        real("x", &["vertex", "axis"], Unit::State, "boundary of the set"),
    ],
    attributes: &[],
};

/// A handful of closed loops.
pub static CLOSED_LOOP_TRAJECTORIES: Group = Group {
    name: "closed_loop_trajectories",
    title: "some closed loops of /closed_loop",
    dimensions: &[
        LAW,
        along("trajectory", Along::Index, "trajectory index"),
        along("sample", Along::Index, "sample index"),
        STATES,
        CONTROLS,
    ],
    variables: &[
        integer(
            "initial",
            &["trajectory"],
            "index of the initial state in /closed_loop",
        ),
        real("t", &["law", "trajectory", "sample"], Unit::Time, "time"),
        real(
            "x",
            &["law", "trajectory", "sample", "state"],
            Unit::State,
            "state",
        ),
        real(
            "u",
            &["law", "trajectory", "sample", "control"],
            Unit::Control,
            "control",
        )
        .when(When::Controls),
    ],
    attributes: &[],
};

/// Each disturbance under each law.
pub static DISSIPATION: Group = Group {
    name: "dissipation",
    title: "the dissipation inequality under disturbances",
    dimensions: &[
        LAW,
        along("case", Along::Index, "disturbance"),
        STATES,
        DISTURBANCES,
    ],
    variables: &[
        code("kind", &["case"], "kind of the disturbance"),
        real("x0", &["case", "state"], Unit::State, "initial state"),
        real(
            "V0",
            &["case"],
            Unit::Cost,
            "value function at the initial state",
        ),
        code("V0_from", &["case"], "where V0 comes from"),
        real(
            "amplitude",
            &["case", "disturbance"],
            Unit::Disturbance,
            "amplitude of the disturbance",
        ),
        code("status", &["law", "case"], "how the closed loop ended"),
        real(
            "E_z",
            &["law", "case"],
            Unit::Cost,
            "integral of L(x, u, 0) up to t_end",
        ),
        real(
            "W",
            &["law", "case"],
            Unit::Cost,
            "integral of L(x, u, 0) - L(x, u, w) up to t_end",
        ),
        real(
            "V_end",
            &["law", "case"],
            Unit::Cost,
            "value function at t_end",
        ),
        real(
            "ratio",
            &["law", "case"],
            Unit::One,
            "largest E_z/(W + V0) over the stored times",
        ),
        real(
            "violation",
            &["law", "case"],
            Unit::One,
            "largest (E_z + V - W - V0)/(W + V0) over the stored times",
        ),
        real(
            "explained",
            &["law", "case"],
            Unit::One,
            "what V's estimated errors explain of a violation beyond the tolerance",
        ),
        real(
            "t_end",
            &["law", "case"],
            Unit::Time,
            "last time at which V was known",
        ),
    ],
    attributes: &[
        ("value_function", "what V was taken from"),
        FINAL_TIME,
        ("lowest_frequency", "of periodic disturbances"),
        ("highest_frequency", "of periodic disturbances"),
        ("tolerance", "what ratios may exceed 1 by, and violations 0"),
        BACKEND,
        ADAPTER,
        PRECISION,
        METHOD,
        RTOL,
    ],
};

/// A row for each law and kind.
pub static DISSIPATION_KINDS: Group = Group {
    name: "dissipation_kinds",
    title: "the dissipation inequality by law and kind of disturbance",
    dimensions: &[along("row", Along::Index, "row index")],
    variables: &[
        text("law", &["row"], "feedback law"),
        text("kind", &["row"], "kind of the disturbance"),
        real("count", &["row"], Unit::One, "disturbances"),
        real(
            "judged",
            &["row"],
            Unit::One,
            "disturbances from states where V is known",
        ),
        real(
            "left",
            &["row"],
            Unit::One,
            "of these, trajectories that ended early and are judged up to there",
        ),
        real(
            "median_ratio",
            &["row"],
            Unit::One,
            "median of E_z/(W + V0)",
        ),
        real("worst_ratio", &["row"], Unit::One, "largest E_z/(W + V0)"),
        real(
            "exceeded",
            &["row"],
            Unit::One,
            "ratios above 1 beyond the tolerance",
        ),
        real(
            "worst_violation",
            &["row"],
            Unit::One,
            "largest relative violation of the inequality",
        ),
        real(
            "violated",
            &["row"],
            Unit::One,
            "violations beyond the tolerance",
        ),
        real(
            "unexplained",
            &["row"],
            Unit::One,
            "violations beyond the tolerance and what V's estimated errors explain",
        ),
    ],
    attributes: &[],
};

/// Those that came nearest to the bound.
pub static DISSIPATION_TRAJECTORIES: Group = Group {
    name: "dissipation_trajectories",
    title: "the closed loops of each kind that came nearest to the bound",
    dimensions: &[
        along("trajectory", Along::Index, "trajectory index"),
        along("sample", Along::Index, "sample index"),
        STATES,
        CONTROLS,
        DISTURBANCES,
    ],
    variables: &[
        code("law", &["trajectory"], "feedback law"),
        integer(
            "case",
            &["trajectory"],
            "index of the disturbance in /dissipation",
        ),
        real("t", PATH, Unit::Time, "time"),
        real(
            "x",
            &["trajectory", "sample", "state"],
            Unit::State,
            "state",
        ),
        real(
            "u",
            &["trajectory", "sample", "control"],
            Unit::Control,
            "control",
        )
        .when(When::Controls),
        real(
            "w",
            &["trajectory", "sample", "disturbance"],
            Unit::Disturbance,
            "disturbance",
        )
        .when(When::Disturbances),
        real("V", PATH, Unit::Cost, "value function"),
        real("E_z", PATH, Unit::Cost, "integral of L(x, u, 0)"),
        real("W", PATH, Unit::Cost, "integral of L(x, u, 0) - L(x, u, w)"),
    ],
    attributes: &[],
};
const PATH: &[&str] = &["trajectory", "sample"];
