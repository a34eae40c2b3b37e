//! What a shard's file has for `costate merge`, beside its results.

use super::{Along, Group, Unit, along, integer, real, text};

/// The blocks of states that a shard has solved for, or its part of a sweep.
pub static SHARD: Group = Group {
    name: "shard",
    title: "blocks of states, or the part of a sweep, that this part of the whole has, for costate merge",
    dimensions: &[along("block", Along::Rows, "place in this file")],
    variables: &[
        integer(
            "number",
            &["block"],
            "number among all blocks; of a sweep the shard's",
        ),
        integer(
            "done",
            &["block"],
            "1 where it was searched, or swept, to the end",
        ),
        integer(
            "states",
            &["block"],
            "different states in it; of a sweep its trajectories",
        ),
    ],
    attributes: &[],
};

/// Where the rows of `/points` belong.
pub static SHARD_POINTS: Group = Group {
    name: "shard_points",
    title: "where the rows of /points belong in the whole",
    dimensions: &[along("point", Along::Rows, "row of /points")],
    variables: &[
        integer(
            "index",
            &["point"],
            "number of the state among all that were asked for",
        ),
        integer("block", &["point"], "number of its block"),
        integer("sheet", &["point"], "number of the sheet within the block"),
        integer(
            "again",
            &["point"],
            "1 where an earlier row has the same state",
        ),
    ],
    attributes: &[],
};

/// The same of `/points_sheets`.
pub static SHARD_SHEETS: Group = Group {
    name: "shard_sheets",
    title: "sheets of the rows of /points_sheets",
    dimensions: &[along("entry", Along::Rows, "row of /points_sheets")],
    variables: &[integer(
        "sheet",
        &["entry"],
        "number of the sheet within the block",
    )],
    attributes: &[],
};

/// What joins blocks.
pub static SHARD_SEAMS: Group = Group {
    name: "shard_seams",
    title: "solutions at the edges of blocks, by which merge joins sheets: numbers in an order of their own",
    dimensions: &[along("number", Along::Rows, "place in the list")],
    variables: &[real("value", &["number"], Unit::One, "a number")],
    attributes: &[],
};

/// Where the rows of a virtual whole lie.
pub static SHARD_FILES: Group = Group {
    name: "shard_files",
    title: "parts in which the rows of this file lie: they are read from there",
    dimensions: &[along("part", Along::Index, "place in the list")],
    variables: &[
        text(
            "file",
            &["part"],
            "the part: from the folder of this file, or absolute",
        ),
        integer("shard", &["part"], "number of the shard"),
        integer("points", &["part"], "rows of /points that lie in it"),
        integer(
            "entries",
            &["part"],
            "rows of /points_sheets that lie in it",
        ),
        integer(
            "trajectories",
            &["part"],
            "rows of /trajectories that lie in it",
        ),
        real(
            "bytes",
            &["part"],
            Unit::One,
            "how long it was when the whole was made",
        ),
        text(
            "manifest",
            &["part"],
            "its root attribute `manifest`, which says what it is a part of",
        ),
    ],
    attributes: &[],
};
