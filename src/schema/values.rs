//! V at states: swept, solved, on a grid, and where its sheets meet.

use super::{
    Along, CONTROLS, DISTURBANCES, Group, STATE_AXES, STATES, Unit, Variable, When, along, code,
    integer, real,
};

const VIRTUAL: When = When::With("`merge --virtual`");

/// Swept trajectories.
pub static TRAJECTORIES: Group = Group {
    name: "trajectories",
    title: "characteristics of the value function",
    dimensions: &[
        along("trajectory", Along::Rows, "trajectory index"),
        along("sample", Along::Index, "sample index"),
        STATES,
        CONTROLS,
        DISTURBANCES,
    ],
    variables: &[
        real(
            "t",
            SAMPLES,
            Unit::Time,
            "time, 0 at the end at the equilibrium",
        ),
        real(
            "x",
            &["trajectory", "sample", "state"],
            Unit::State,
            "state",
        ),
        real(
            "p",
            &["trajectory", "sample", "state"],
            Unit::Costate,
            "costate, the gradient of the value function",
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
        real("V", SAMPLES, Unit::Cost, "value function"),
        real("H", SAMPLES, Unit::CostRate, "Hamiltonian"),
        code("status", &["trajectory"], "how the trajectory ended"),
        integer("sheet", &["trajectory"], "sheet of the value function"),
        integer("steps", &["trajectory"], "accepted integration steps"),
        integer("rejected", &["trajectory"], "rejected integration steps"),
        real(
            "hamiltonian_drift",
            &["trajectory"],
            Unit::CostRate,
            "largest deviation of the Hamiltonian from its invariant value",
        ),
        integer(
            "given",
            &["trajectory"],
            "number of the state that it begins at, in the order in which states were given",
        )
        .when(VIRTUAL),
    ],
    attributes: &[(
        "stored",
        "`values` where the run stored values alone (`--values-only`): `x` and `V` (in f32 where that resolves them), `status` and `sheet`; absent where everything is stored",
    )],
};
const SAMPLES: &[&str] = &["trajectory", "sample"];

/// Ends of swept trajectories in folds.
pub static CAUSTIC: Group = Group {
    name: "caustic",
    title: "where trajectories meet a fold of the manifold: det dx/dseed = 0; in a game the boundary of the region of validity",
    dimensions: &[
        along("vertex", Along::Rows, "vertex index"),
        STATES,
        CONTROLS,
    ],
    variables: &[
        real("x", &["vertex", "state"], Unit::State, "state"),
        real("p", &["vertex", "state"], Unit::Costate, "costate"),
        real(
            "V",
            &["vertex"],
            Unit::Cost,
            "cost along the trajectory, the limit of the value function",
        ),
        real("t", &["vertex"], Unit::Time, "time"),
        integer(
            "trajectory",
            &["vertex"],
            "index of the trajectory that ends there",
        ),
    ],
    attributes: &[],
};

const SOLVED: When = When::With("solved states");
const INTERPOLATED: When = When::With("interpolated values");
const TIMED: When = When::With("interpolated V(x, t)");

/// V, p, u, the sheet and the way round, over `$over`.
macro_rules! solution {
    ($over:literal) => {
        [
            real("V", &[$over], Unit::Cost, "value function"),
            real(
                "p",
                &[$over, "state"],
                Unit::Costate,
                "costate, the gradient of the value function",
            ),
            real("u", &[$over, "control"], Unit::Control, "control").when(When::Controls),
            integer(
                "sheet",
                &[$over],
                "sheet of the value function; -1 where there is none",
            ),
            integer(
                "lifted_sheet",
                &[$over],
                "sheet where copies by whole periods count as one; -1 where there is none",
            )
            .when(SOLVED),
            integer(
                "winding",
                &[$over, "state"],
                "periods by which the solution's state is away from the point",
            )
            .when(SOLVED),
        ]
    };
}

/// What supports that V is the least, and what interpolated values have, over `$over`.
macro_rules! evidence {
    ($over:literal) => {
        [
            code("status", &[$over], "whether V is known there, or why not"),
            code("evidence", &[$over], "what supports that V is the least").when(SOLVED),
            real(
                "covered_to",
                &[$over],
                Unit::Cost,
                "cost below which nothing cheaper than V was left out of the search",
            )
            .when(SOLVED),
            real(
                "bound",
                &[$over],
                Unit::Cost,
                "cost of a simulated control that costs less than V",
            )
            .when(SOLVED),
            integer("starts", &[$over], "first guesses tried").when(SOLVED),
            integer("flights", &[$over], "controls simulated").when(SOLVED),
            real(
                "V_error",
                &[$over],
                Unit::Cost,
                "error of V that leaving data out shows",
            )
            .when(INTERPOLATED),
            real(
                "p_error",
                &[$over],
                Unit::One,
                "error of p that leaving data out shows, relative to p",
            )
            .when(INTERPOLATED),
            real(
                "u_error",
                &[$over],
                Unit::Control,
                "error of u that leaving data out shows",
            )
            .when(INTERPOLATED),
            code(
                "coverage",
                &[$over],
                "what supports that the value is the least, which its error does not include",
            )
            .when(INTERPOLATED),
            real("dV_dt", &[$over], Unit::CostRate, "derivative of V by time").when(TIMED),
        ]
    };
}

/// One array of several.
const fn joined<const A: usize, const B: usize, const C: usize, const N: usize>(
    a: [Variable; A],
    b: [Variable; B],
    c: [Variable; C],
) -> [Variable; N] {
    assert!(A + B + C == N, "the lengths add up");
    const NONE: Variable = integer("", &[], "");
    let mut all = [NONE; N];
    let mut k = 0;
    while k < A {
        all[k] = a[k];
        k += 1;
    }
    while k < A + B {
        all[k] = b[k - A];
        k += 1;
    }
    while k < N {
        all[k] = c[k - A - B];
        k += 1;
    }
    all
}

/// V at chosen states.
pub static POINTS: Group = Group {
    name: "points",
    title: "value function at chosen states",
    dimensions: &[along("point", Along::Rows, "point index"), STATES, CONTROLS],
    variables: &joined::<6, 11, 9, 26>(
        solution!("point"),
        evidence!("point"),
        [
            real("x0", &["point", "state"], Unit::State, "chosen state"),
            real("<time>", &["point"], Unit::Time, "time").when(TIMED),
            integer(
                "iterations",
                &["point"],
                "integrations of the whole trajectory",
            )
            .when(SOLVED),
            real(
                "residual",
                &["point"],
                Unit::One,
                "last Newton correction relative to the trajectory's size",
            )
            .when(SOLVED),
            real("H", &["point"], Unit::CostRate, "Hamiltonian").when(SOLVED),
            integer("sheets", &["point"], "number of solutions found").when(SOLVED),
            real(
                "furthest",
                &["point", "state"],
                Unit::State,
                "the point itself, or the furthest state reached on the way to it",
            )
            .when(SOLVED),
            real(
                "flown",
                &["point"],
                Unit::Cost,
                "cost of a simulated control along the answer, of states that were listed",
            )
            .when(SOLVED),
            integer(
                "given",
                &["point"],
                "number of the state in the order in which states were given; rows are in that order where it is absent",
            )
            .when(VIRTUAL),
        ],
    ),
    attributes: &[],
};

/// All solutions at these states.
pub static POINTS_SHEETS: Group = Group {
    name: "points_sheets",
    title: "all solutions found at the chosen states, optimal or not",
    dimensions: &[along("entry", Along::Rows, "entry index"), STATES, CONTROLS],
    variables: &joined::<6, 3, 0, 9>(
        solution!("entry"),
        [
            integer("point", &["entry"], "index of the point in /points"),
            real("H", &["entry"], Unit::CostRate, "Hamiltonian"),
            real(
                "residual",
                &["entry"],
                Unit::One,
                "last Newton correction relative to the trajectory's size",
            ),
        ],
        [],
    ),
    attributes: &[],
};

/// V on a grid.
pub static MAP: Group = Group {
    name: "map",
    title: "value function on a regular grid: the lowest sheet",
    dimensions: &[STATE_AXES, STATES, CONTROLS],
    variables: &joined::<6, 11, 0, 17>(solution!("<state>"), evidence!("<state>"), []),
    attributes: &[],
};

/// Where two sheets cost the same.
pub static EQUAL_COST: Group = Group {
    name: "equal_cost",
    title: "points where two sheets cost the same and the optimal control jumps",
    dimensions: &[
        along("vertex", Along::Rows, "vertex index"),
        along("side", Along::Index, "side index"),
        STATES,
        CONTROLS,
    ],
    variables: &[
        real("x", &["vertex", "state"], Unit::State, "state"),
        real("V", &["vertex"], Unit::Cost, "value function"),
        real(
            "difference",
            &["vertex"],
            Unit::One,
            "difference of V between the sheets, relative to V",
        ),
        integer("sheet", &["vertex", "side"], "the two sheets"),
        real(
            "p",
            &["vertex", "side", "state"],
            Unit::Costate,
            "costate on each sheet",
        ),
        integer(
            "line",
            &["vertex"],
            "polyline; -1 where the points form none",
        ),
        integer("place", &["vertex"], "place on the polyline"),
        real(
            "u",
            &["vertex", "side", "control"],
            Unit::Control,
            "control on each sheet",
        )
        .when(When::Controls),
        real(
            "jump",
            &["vertex", "control"],
            Unit::Control,
            "control on the second sheet less that on the first",
        )
        .when(When::Controls),
    ],
    attributes: &[],
};

/// Where a sheet ends.
pub static FOLDS: Group = Group {
    name: "folds",
    title: "points where a sheet turns back",
    dimensions: &[
        along("vertex", Along::Rows, "vertex index"),
        STATES,
        CONTROLS,
    ],
    variables: &[
        real("x", &["vertex", "state"], Unit::State, "state"),
        real("p", &["vertex", "state"], Unit::Costate, "costate"),
        real("V", &["vertex"], Unit::Cost, "cost of the extremal"),
    ],
    attributes: &[],
};
