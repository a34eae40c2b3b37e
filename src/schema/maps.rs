//! A map of V over a region, in pieces.

use super::{
    Along, CONTROLS, Dimension, Group, STATES, Unit, Variable, When, along, code, integer, real,
};

const BENT: When = When::With("a sheared coordinate");
const GUARDED: When = When::With("guards that pieces come near");

static DIMENSIONS: [Dimension; 13] = [
    along("coordinate", Along::Index, "coordinate index"),
    along("node", Along::Index, "node index"),
    along("way", Along::Index, "way index"),
    along("cell", Along::Index, "cell index"),
    along("piece", Along::Index, "piece index"),
    along("coefficient", Along::Index, "coefficient index"),
    STATES,
    CONTROLS,
    along("monomial", Along::Index, "monomial index"),
    along("end", Along::Index, "end index"),
    along("margin_term", Along::Index, "margin_term index"),
    along("argument", Along::Names, "the states, and the time"),
    along(
        "<argument>",
        Along::Names,
        "`state`, or `argument` where time is an axis",
    ),
];

static VARIABLES: [Variable; 30] = [
    real(
        "error",
        &[],
        Unit::One,
        "error of V asked for, relative to max(V, floor)",
    ),
    real(
        "floor",
        &[],
        Unit::Cost,
        "least V that errors are relative to",
    ),
    real(
        "value_max",
        &[],
        Unit::Cost,
        "the map knows no larger V; infinite: no limit",
    ),
    real(
        "lower",
        &["<argument>"],
        Unit::State,
        "lower bound of the region",
    ),
    real(
        "upper",
        &["<argument>"],
        Unit::State,
        "upper bound of the region",
    ),
    real(
        "origin",
        &["<argument>"],
        Unit::State,
        "origin of the coordinates",
    ),
    real(
        "frame",
        &["coordinate", "<argument>"],
        Unit::One,
        "coordinates are frame (x - origin)",
    ),
    integer(
        "axis",
        &["node"],
        "coordinate along which a node is split; -1: it is a cell",
    ),
    real("split", &["node"], Unit::One, "where it is split"),
    integer(
        "below",
        &["node"],
        "node below the split; of a cell its number",
    ),
    integer("above", &["node"], "node above the split"),
    real("cell_lower", &["cell", "coordinate"], Unit::One, "coordinate"),
    real("cell_upper", &["cell", "coordinate"], Unit::One, "coordinate"),
    integer("of_cell", &["piece"], "cell of each piece"),
    real("center", &["piece", "coordinate"], Unit::One, "coordinate"),
    real(
        "half",
        &["piece", "coordinate"],
        Unit::One,
        "half width: monomials are of (coordinate - center) / half",
    ),
    real(
        "direction",
        &["way", "coordinate"],
        Unit::One,
        "along which supports are given",
    ),
    real(
        "support_lower",
        &["piece", "way"],
        Unit::One,
        "extent of the points fitted to, in the monomials' variables; NaN: all around",
    ),
    real("support_upper", &["piece", "way"], Unit::One, "the same"),
    code(
        "shape",
        &["piece"],
        "the function of V that is a polynomial",
    ),
    integer("sheet", &["piece"], "sheet of the value function"),
    real(
        "V_bound",
        &["piece"],
        Unit::One,
        "bound of V's error, relative to max(V, floor)",
    ),
    real(
        "p_bound",
        &["piece"],
        Unit::One,
        "bound of the error of V's derivatives by the monomials' variables, relative to max(V, floor)",
    ),
    integer("first", &["piece"], "first coefficient"),
    integer("terms", &["piece"], "number of coefficients"),
    real(
        "coefficients",
        &["coefficient"],
        Unit::One,
        "of monomials by rising total degree, those of a degree in lexicographic order of their factors",
    ),
    integer("bend_axis", &[], "coordinate that is sheared").when(BENT),
    real(
        "bend_range",
        &["end"],
        Unit::One,
        "what the sheared coordinate plus the polynomial is where the coordinate is 0 and 1",
    )
    .when(BENT),
    real(
        "bend",
        &["monomial"],
        Unit::One,
        "polynomial of the other coordinates, monomials in the order of the coefficients",
    )
    .when(BENT),
    real(
        "clearance",
        &["piece", "margin_term"],
        Unit::One,
        "polynomial of the least margin of the guards along trajectories, in the monomials' variables: V is unknown where it is negative; NaN: all of them stay inside",
    )
    .when(GUARDED),
];

/// The map to an error.
pub static MAP_PIECES: Group = Group {
    name: "map_pieces",
    title: "value function in pieces: cells of a region with a polynomial each",
    dimensions: &DIMENSIONS,
    variables: &VARIABLES,
    attributes: &[
        (
            "coverage",
            "how well the states of the map were searched for cheaper sheets",
        ),
        ("time", "name of the time where it is an axis"),
    ],
};

/// The map round it.
pub static MAP_BEYOND: Group = Group {
    name: "map_beyond",
    title: "the same where solutions from the region lead, of use outside the region only",
    dimensions: &DIMENSIONS,
    variables: &VARIABLES,
    attributes: &[("time", "name of the time where it is an axis")],
};

/// What was kept to check the map with.
pub static MAP_CHECK: Group = Group {
    name: "map_check",
    title: "fresh states, solved and never used in the map, and what the map returns there",
    dimensions: &[
        along("point", Along::Index, "point index"),
        STATES,
        CONTROLS,
    ],
    variables: &[
        real("x0", &["point", "state"], Unit::State, "fresh state"),
        real("<time>", &["point"], Unit::Time, "time").when(When::With("time as an axis")),
        code("status", &["point"], "whether V is known there, or why not"),
        real("V_solved", &["point"], Unit::Cost, "V solved for"),
        real("V_said", &["point"], Unit::Cost, "V that the map returns"),
        real(
            "V_bound",
            &["point"],
            Unit::Cost,
            "bound of its error that the map returns",
        ),
    ],
    attributes: &[],
};
