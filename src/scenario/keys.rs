//! Sections and keys of a scene, with what each is: the reader refuses all others, and the
//! reference of the scene in the guide is printed from this.

use std::fmt::Write;
use std::sync::LazyLock;

/// A section, or the table that each of its entries is.
#[derive(Debug)]
pub struct SectionKeys {
    /// Its name, with dots for a table within.
    pub name: &'static str,
    /// What it is for, in Markdown.
    pub about: &'static str,
    /// Its keys; none where they are names of the scene.
    pub keys: &'static [Key],
}

/// A key.
#[derive(Debug)]
pub struct Key {
    pub name: &'static str,
    /// What it takes, in Markdown.
    pub takes: &'static str,
    pub unit: &'static str,
    pub default: &'static str,
    pub meaning: &'static str,
}

const fn key(
    name: &'static str,
    takes: &'static str,
    unit: &'static str,
    default: &'static str,
    meaning: &'static str,
) -> Key {
    Key {
        name,
        takes,
        unit,
        default,
        meaning,
    }
}

/// The names of all sections.
pub(super) fn sections() -> impl Iterator<Item = &'static str> + Clone {
    let all = CHAPTERS.iter().flat_map(|(_, sections)| sections.iter());
    all.map(|s| s.name).filter(|name| !name.contains('.'))
}

/// Sections that state the problem; the others say what is wanted of it.
pub static PROBLEM_SECTIONS: LazyLock<Vec<&'static str>> =
    LazyLock::new(|| CHAPTERS[0].1.iter().map(|s| s.name).collect());

/// The keys of a section.
#[must_use]
pub(super) fn keys_of(section: &str) -> Vec<&'static str> {
    let all = CHAPTERS.iter().flat_map(|(_, sections)| sections.iter());
    let found = all.into_iter().find(|s| s.name == section);
    found.map_or_else(Vec::new, |s| s.keys.iter().map(|k| k.name).collect())
}

/// All of it in Markdown, for the guide.
#[must_use]
pub fn markdown() -> String {
    let mut page = String::new();
    for (chapter, sections) in CHAPTERS {
        let _ = writeln!(page, "## {chapter}\n");
        for section in *sections {
            let _ = writeln!(page, "### `[{}]`\n", section.name);
            if !section.about.is_empty() {
                let _ = writeln!(page, "{}\n", section.about);
            }
            if section.keys.is_empty() {
                continue;
            }
            page.push_str("| key | type | unit | default | |\n| --- | --- | --- | --- | --- |\n");
            for key in section.keys {
                let cells = [key.takes, key.unit, key.default, key.meaning];
                let cells = cells.map(|cell| match cell {
                    "" => " |".to_owned(),
                    cell => format!(" {cell} |"),
                });
                let _ = writeln!(page, "| `{}` |{}", key.name, cells.concat());
            }
            page.push('\n');
        }
    }
    page
}

/// Chapters of the reference, with their sections.
pub static CHAPTERS: &[(&str, &[SectionKeys])] = &[
    (
        "The problem",
        &[
            SectionKeys {
                name: "parameters",
                about: "One entry for each parameter: a number, or an expression of the parameters above it.\n\
                    `--set NAME=VALUE` replaces it.",
                keys: &[],
            },
            SectionKeys {
                name: "states",
                about: "Required. One table for each state, `{}` at least.",
                keys: &[
                    key("unit", "text", "", "none", "of the state, for output"),
                    key("long_name", "text", "", "none", "for output"),
                    key(
                        "period",
                        "number > 0",
                        "the state's",
                        "none",
                        "x and x + period are one state (ignored in games); states are at most 1e5 periods from 0",
                    ),
                ],
            },
            SectionKeys {
                name: "controls",
                about: "Required. One table for each control.",
                keys: &[
                    key("unit", "text", "", "none", "of the control, for output"),
                    key("long_name", "text", "", "none", "for output"),
                    key("min", "number", "the control's", "no bound", ""),
                    key(
                        "max",
                        "number, above `min`",
                        "the control's",
                        "no bound",
                        "",
                    ),
                ],
            },
            SectionKeys {
                name: "disturbances",
                about: "One table for each disturbance. A scene with a disturbance is a game.",
                keys: &[
                    key("unit", "text", "", "none", "of the disturbance, for output"),
                    key("long_name", "text", "", "none", "for output"),
                ],
            },
            SectionKeys {
                name: "definitions",
                about: "One entry for each name: an expression of anything but the definitions below it.",
                keys: &[],
            },
            SectionKeys {
                name: "dynamics",
                about: "Required. One entry for each state (but those that a `[mechanism]` makes): its time derivative, an\n\
                    expression of parameters, states, controls, disturbances and definitions. It must be affine in controls\n\
                    and disturbances.",
                keys: &[],
            },
            SectionKeys {
                name: "mechanism",
                about: "Bodies and joints, in place of `[dynamics]`: the guide's chapter Mechanisms. Each coordinate makes\n\
                    a state of its name and one of its rate, NAME`_rate`; `[states]` may describe them (`unit`,\n\
                    `long_name`, `period`) and, with `[dynamics]`, add others. Expressions may have `kinetic`,\n\
                    `potential` and `energy`.",
                keys: &[
                    key(
                        "gravity",
                        "two or three numbers",
                        "acceleration",
                        "required",
                        "two: the mechanism is planar; zeros for none",
                    ),
                    key("bodies", "a table a body", "", "required", ""),
                    key("points", "a table a point", "", "none", ""),
                    key("forces", "an entry a joint or body", "", "none", ""),
                    key(
                        "contacts",
                        "a table a point",
                        "",
                        "none",
                        "points that are held",
                    ),
                    key(
                        "dependent",
                        "an expression a coordinate",
                        "",
                        "none",
                        "coordinates that follow from the others while points are held: they make no states",
                    ),
                ],
            },
            SectionKeys {
                name: "mechanism.bodies",
                about: "One table for each body. Their order is that of the coordinates. Vectors have two numbers in a\n\
                    planar mechanism, else three. Numbers may be expressions of parameters. In a chain each value\n\
                    may be a list of values, one a link.",
                keys: &[
                    key(
                        "joint",
                        "`\"revolute\"`, `\"prismatic\"`, `\"planar\"`, `\"spherical\"`, `\"floating\"` or `\"fixed\"`",
                        "",
                        "required",
                        "how it moves against its parent. Coordinates: NAME; NAME; NAME`_x`, NAME`_y`, NAME; NAME`_yaw`, NAME`_pitch`, NAME`_roll` (turns about z, y, x in this order); NAME`_x`, `_y`, `_z` and the three angles; none",
                    ),
                    key(
                        "parent",
                        "a body's name, or `\"world\"`",
                        "",
                        "`\"world\"`",
                        "",
                    ),
                    key(
                        "at",
                        "vector",
                        "length",
                        "0",
                        "place of the joint in the parent's frame; in a chain of all links after the first",
                    ),
                    key(
                        "start",
                        "vector",
                        "length",
                        "0",
                        "of a chain: place of the first link's joint",
                    ),
                    key(
                        "rotation",
                        "angle; in space three rows",
                        "rad",
                        "none",
                        "the joint's frame in the parent's: columns are its axes",
                    ),
                    key(
                        "rpy",
                        "[roll, pitch, yaw]",
                        "rad",
                        "none",
                        "the same as angles about x, y and z (fixed axes, in this order)",
                    ),
                    key(
                        "axis",
                        "`\"x\"`, `\"y\"`, `\"z\"` or vector",
                        "",
                        "`\"z\"`; prismatic: required",
                        "of a revolute or prismatic joint, in the joint's frame",
                    ),
                    key("mass", "number from 0", "mass", "0", ""),
                    key(
                        "com",
                        "vector",
                        "length",
                        "0, or the shape's",
                        "centre of mass, in the body's frame (the joint's, moved)",
                    ),
                    key(
                        "inertia",
                        "planar: number; else [xx, yy, zz], [xx, xy, xz, yy, yz, zz] or three rows",
                        "mass length^2",
                        "0",
                        "about the centre of mass, along the body's axes",
                    ),
                    key(
                        "shape",
                        "a table",
                        "",
                        "none",
                        "com and inertia of a solid of uniform density",
                    ),
                    key(
                        "damping",
                        "number from 0",
                        "force by rate",
                        "0",
                        "at the joint: -damping times the rate",
                    ),
                    key(
                        "spring",
                        "number",
                        "force by coordinate",
                        "0",
                        "at the joint: -spring times (the coordinate - rest)",
                    ),
                    key(
                        "rest",
                        "number",
                        "the coordinate's",
                        "0",
                        "where the spring has no force",
                    ),
                    key(
                        "rotor",
                        "number from 0",
                        "inertia of the coordinate",
                        "0",
                        "inertia of a motor as the joint feels it (by the gear ratio squared)",
                    ),
                    key(
                        "chain",
                        "whole number from 1 to 200",
                        "1",
                        "none",
                        "so many links NAME1, NAME2, ..., each on the one before",
                    ),
                ],
            },
            SectionKeys {
                name: "mechanism.bodies.shape",
                about: "One of these. All but the sphere begin at the joint and lie along the body's x axis.",
                keys: &[
                    key("rod", "number > 0", "length", "", "thin, of this length"),
                    key("cylinder", "[length, radius]", "length", "", ""),
                    key(
                        "ellipsoid",
                        "[length, radius] or [x, y, z]",
                        "length",
                        "",
                        "its axes from end to end",
                    ),
                    key("box", "[x, y, z]", "length", "", "its edges"),
                    key(
                        "sphere",
                        "number > 0",
                        "length",
                        "",
                        "of this radius, about the joint",
                    ),
                ],
            },
            SectionKeys {
                name: "mechanism.points",
                about: "One table for each point. Expressions may have its place and velocity in the world: NAME`.x`,\n\
                    NAME`.y`, NAME`.vx`, NAME`.vy`, in space NAME`.z`, NAME`.vz`.",
                keys: &[
                    key(
                        "body",
                        "a body's name, or `\"world\"`",
                        "",
                        "`\"world\"`",
                        "",
                    ),
                    key("at", "vector", "length", "0", "in the body's frame"),
                ],
            },
            SectionKeys {
                name: "mechanism.forces",
                about: "One entry for each joint or body. A joint (by its coordinate): its force or torque, an expression of\n\
                    parameters, states, controls, disturbances and definitions, affine in controls and disturbances. A body:\n\
                    a table of what acts on it. Both: a list of such.",
                keys: &[],
            },
            SectionKeys {
                name: "mechanism.forces.body",
                about: "What acts on a body, each an expression as above.",
                keys: &[
                    key("moment", "expression; in space three", "", "none", ""),
                    key("force", "two or three expressions", "", "none", ""),
                    key(
                        "point",
                        "a point's name",
                        "",
                        "none",
                        "where the force acts: a point of this body",
                    ),
                    key(
                        "at",
                        "vector",
                        "length",
                        "0",
                        "the same as a place in the body's frame",
                    ),
                    key(
                        "axes",
                        "`\"world\"` or `\"body\"`",
                        "",
                        "`\"world\"`",
                        "that moment and force are written in",
                    ),
                ],
            },
            SectionKeys {
                name: "mechanism.contacts",
                about: "One table, `{}` at least, for each point that is held where it is. Expressions may have the force that\n\
                    holds it, as it acts on the point's body: NAME`.fx`, NAME`.fy`, in space NAME`.fz`, with `along`\n\
                    NAME`.f` (not in `[mechanism.forces]`).",
                keys: &[
                    key(
                        "with",
                        "a point's name",
                        "",
                        "the world",
                        "the point of another body that it is held to (a closed chain)",
                    ),
                    key(
                        "along",
                        "`\"x\"`, `\"y\"`, `\"z\"` or vector",
                        "",
                        "all directions",
                        "held in this direction of the world alone",
                    ),
                ],
            },
            SectionKeys {
                name: "cost",
                about: "Required. `terminal` and `final_time` together make the horizon finite.",
                keys: &[
                    key(
                        "running",
                        "expression",
                        "V over time",
                        "required",
                        "quadratic in the controls; concave and quadratic in the disturbances",
                    ),
                    key(
                        "terminal",
                        "expression of states",
                        "V",
                        "none",
                        "cost of the final state",
                    ),
                    key("final_time", "number > 0", "time", "none", ""),
                    key(
                        "unit",
                        "text",
                        "",
                        "none",
                        "of the cost, and so of V, for output",
                    ),
                ],
            },
            SectionKeys {
                name: "equilibrium",
                about: "Required on an infinite horizon: a number for each state and control. On a finite horizon it may be\n\
                    left out; if it is given, deviations are taken from it (else from the region's middle). Disturbances\n\
                    are 0 there.",
                keys: &[],
            },
            SectionKeys {
                name: "region",
                about: "Required. `[lower, upper]` for each state, in its unit.",
                keys: &[],
            },
            SectionKeys {
                name: "time",
                about: "",
                keys: &[key("unit", "text", "", "none", "of the time, for output")],
            },
            SectionKeys {
                name: "guards",
                about: "One entry for each guard: a condition of states that a trajectory must meet from beginning to end,\n\
                    and the equilibrium too.",
                keys: &[],
            },
        ],
    ),
    (
        "What is solved for",
        &[
            SectionKeys {
                name: "shoot_out",
                about: "The sweep outward from the equilibrium, or backward from the terminal cost.",
                keys: &[
                    key(
                        "value_max",
                        "number from 1e-200",
                        "V",
                        "required on an infinite horizon",
                        "largest V of interest",
                    ),
                    key(
                        "spacing",
                        "number, to 1",
                        "widths",
                        "0.05",
                        "largest distance between neighbours on a front",
                    ),
                    key(
                        "seed_value",
                        "number below `value_max`, or `\"auto\"`",
                        "V",
                        "`\"auto\"`",
                        "V where seeds lie; infinite horizon",
                    ),
                    key(
                        "samples",
                        "whole number from 2",
                        "1",
                        "200",
                        "stored points a trajectory",
                    ),
                    key(
                        "max_seeds",
                        "whole number from 1 to 10000000",
                        "1",
                        "100000",
                        "a sweep ends with so many trajectories, whatever gaps are left (with those of its first seeds where it begins with more)",
                    ),
                    key(
                        "margin",
                        "number from 0",
                        "widths",
                        "1",
                        "how far outside the region trajectories are followed",
                    ),
                    key(
                        "sample_by",
                        "`\"value\"`, `\"arc_length\"` or `\"auto\"`",
                        "",
                        "`\"auto\"`",
                        "what stored points are levels of, on an infinite horizon: V, in games arc length",
                    ),
                    key(
                        "arc_length",
                        "number > 0, to 1000",
                        "widths",
                        "8",
                        "longest trajectory where points are levels of arc length",
                    ),
                    key(
                        "folds",
                        "true or false",
                        "",
                        "false; games: always true",
                        "trajectories end where the manifold folds",
                    ),
                ],
            },
            SectionKeys {
                name: "homotopy",
                about: "One entry for each state: an axis. V is solved for at the grid's states (at most 2e6). States not\n\
                    named: the equilibrium.",
                keys: &[],
            },
            SectionKeys {
                name: "map",
                about: "Without `error` the section asks for a regular grid over the region; with `error` for a map in\n\
                    pieces to that error (up to 6 states); with `error` and `resolution` for both. The keys from\n\
                    `error_max` on belong to `error`.",
                keys: &[
                    key(
                        "resolution",
                        "whole number from 2, or a table with one from 1 a state",
                        "points",
                        "some 4096 points in all, 2 to 101 an axis",
                        "states that the table does not name: one point, the equilibrium",
                    ),
                    key(
                        "value_max",
                        "number > 0",
                        "V",
                        "none",
                        "no value is given where V is larger",
                    ),
                    key(
                        "equal_cost",
                        "number > 0",
                        "widths of the region",
                        "any",
                        "distance of the surface where two sheets cost the same from the true one",
                    ),
                    key(
                        "error",
                        "number from 1e-8 to 0.1",
                        "1",
                        "none",
                        "of V, relative to the larger one of V and `floor`",
                    ),
                    key(
                        "error_max",
                        "number from `error`",
                        "1",
                        "0.02, or 10 `error` if that is more",
                        "no value is given where the bound is above this",
                    ),
                    key(
                        "floor",
                        "number > 0",
                        "V",
                        "a thousandth of the median of abs(V) of the first states, or of a hundredth of the largest if that is more; a tenth where V is negative at some",
                        "",
                    ),
                    key(
                        "region",
                        "table of `[lower, upper]`, inside `[region]`",
                        "the states'",
                        "`[region]`",
                        "states not named: all of their range",
                    ),
                    key(
                        "states",
                        "whole number from 1",
                        "1",
                        "100000",
                        "it stops after so many states",
                    ),
                    key(
                        "seconds",
                        "number > 0",
                        "s",
                        "none",
                        "it stops after about so many seconds",
                    ),
                    key(
                        "check",
                        "whole number from 1",
                        "1",
                        "200",
                        "fresh states of the check",
                    ),
                    key(
                        "time",
                        "true or false",
                        "",
                        "true where it can be had",
                        "finite horizon: V(x, t) instead of V(x, 0); not of games and 6 states",
                    ),
                ],
            },
            SectionKeys {
                name: "sheets",
                about: "",
                keys: &[key(
                    "value_max",
                    "number > 0",
                    "V",
                    "twice the sweep's `value_max`, and no more than twice the map's where there is only a map",
                    "V up to which further sheets are looked for",
                )],
            },
        ],
    ),
    (
        "What is computed from it",
        &[
            SectionKeys {
                name: "feedback",
                about: "A law to fit, called `network`; or a table `[feedback.NAME]` with these keys for each of several\n\
                    laws. Infinite horizon.",
                keys: &[
                    key(
                        "fit",
                        "`\"u\"` or `\"V\"`",
                        "",
                        "required",
                        "the law itself, or the value function",
                    ),
                    key(
                        "output",
                        "name, or list of names",
                        "",
                        "all controls",
                        "with `fit = \"u\"`: controls, or states to be commanded",
                    ),
                    key(
                        "inputs",
                        "name, or list of names",
                        "",
                        "all states that are not commanded",
                        "with `fit = \"V\"` all states",
                    ),
                    key(
                        "hidden",
                        "list of whole numbers from 1 to 1000, at most 8",
                        "units",
                        "`[10]`",
                        "of each hidden layer; `[]`: an affine law",
                    ),
                    key(
                        "activation",
                        "`\"logistic\"` or `\"tanh\"`",
                        "",
                        "`\"logistic\"`",
                        "",
                    ),
                    key(
                        "base",
                        "`\"none\"` or `\"local\"`",
                        "",
                        "`\"none\"`; of V `\"local\"`",
                        "what the network is added to",
                    ),
                    key(
                        "box",
                        "table of `[lower, upper]`",
                        "the states'",
                        "`[region]`",
                        "where data are taken",
                    ),
                    key(
                        "where",
                        "condition, or list of them",
                        "",
                        "none",
                        "further conditions of the data",
                    ),
                    key("value_max", "number > 0", "V", "none", "data up to this V"),
                    key(
                        "starts",
                        "whole number from 1 to 1000",
                        "1",
                        "5",
                        "trainings from different first weights",
                    ),
                    key("seed", "whole number from 0", "", "0", ""),
                    key(
                        "iterations",
                        "whole number from 1",
                        "1",
                        "500",
                        "most steps of a training",
                    ),
                    key(
                        "patience",
                        "whole number from 1",
                        "1",
                        "30",
                        "it ends after so many steps without an improvement",
                    ),
                    key("max_samples", "whole number from 10", "1", "20000", ""),
                    key(
                        "gradient",
                        "true or false",
                        "",
                        "true",
                        "with `fit = \"V\"` alone: p is fitted as well",
                    ),
                    key(
                        "validation",
                        "number between 0 and 1",
                        "1",
                        "0.15",
                        "share of the trajectories; with `test` at most 0.9",
                    ),
                    key(
                        "test",
                        "number between 0 and 1",
                        "1",
                        "0.15",
                        "share of the trajectories",
                    ),
                ],
            },
            SectionKeys {
                name: "closed_loop",
                about: "",
                keys: &[
                    key(
                        "final_time",
                        "number > 0",
                        "time",
                        "required on an infinite horizon; a finite one has its own",
                        "",
                    ),
                    key(
                        "samples",
                        "whole number from 2 to 100000",
                        "1",
                        "200",
                        "points at which quantities are looked at",
                    ),
                    key(
                        "initial",
                        "table of axes",
                        "the states'",
                        "required without `random`; with it `[region]`",
                        "initial states; with `random` `[first, last]` will do. States not named: the equilibrium",
                    ),
                    key(
                        "random",
                        "whole number from 1 to 10000000",
                        "1",
                        "none",
                        "so many initial states, uniform in the ranges, instead of the grid",
                    ),
                    key(
                        "laws",
                        "list of names",
                        "",
                        "all there are",
                        "`\"map\"`, `\"lqr\"`, fitted laws, and those of `law`",
                    ),
                    key(
                        "law",
                        "table",
                        "",
                        "none",
                        "laws of your own: [see below](#closed_looplaw)",
                    ),
                    key(
                        "record",
                        "table",
                        "",
                        "none",
                        "one entry for each quantity: `\"min(E)\"`, `\"max(E)\"` or `\"final(E)\"` of an expression E of states and controls",
                    ),
                    key(
                        "sets",
                        "table",
                        "",
                        "none",
                        "one entry for each set: a recorded quantity compared with a number, in quotes",
                    ),
                    key(
                        "track",
                        "number > 0",
                        "1/time",
                        "5 times the fastest linear mode",
                        "rate at which a commanded state is followed",
                    ),
                    key(
                        "converged",
                        "number > 0",
                        "1",
                        "1e-3",
                        "largest 1/2 d'Pd at the end, of its mean over the region",
                    ),
                    key(
                        "margin",
                        "number > 0",
                        "widths",
                        "5",
                        "how far outside the region trajectories are followed",
                    ),
                    key(
                        "period",
                        "number > 0",
                        "time",
                        "as the law asks for; a sample's interval on finite horizons, for `rk4`, and on GPUs that ask the map themselves",
                        "between updates of the map's law, at most a sample's interval",
                    ),
                    key(
                        "outside",
                        "`\"stop\"`, `\"hold\"`, `\"nearest\"`, `\"search\"` or `\"lqr\"`",
                        "",
                        "`\"search\"`",
                        "what the map's law does where V is not known",
                    ),
                ],
            },
            SectionKeys {
                name: "closed_loop.law",
                about: "One table for each law: an expression of states for each control (or for a state to be commanded),\n\
                    or a file of weights alone.",
                keys: &[key(
                    "weights",
                    "text",
                    "",
                    "none",
                    "a file in the folder of the scene's",
                )],
            },
            SectionKeys {
                name: "dissipation",
                about: "For scenes with disturbances, on an infinite horizon. Laws of your own are those of\n\
                    `[closed_loop.law]`.",
                keys: &[
                    key(
                        "disturbances",
                        "whole number from 1 to 1e7",
                        "1",
                        "10000",
                        "under each law",
                    ),
                    key(
                        "final_time",
                        "number > 0, or `\"auto\"`",
                        "time",
                        "`\"auto\"`: 8 time constants of the closed loop's slowest mode",
                        "",
                    ),
                    key(
                        "amplitude",
                        "number > 0, table of one a disturbance, or `\"auto\"`",
                        "the disturbances'",
                        "`\"auto\"`: the largest w* over the initial states",
                        "largest amplitude",
                    ),
                    key(
                        "frequencies",
                        "`[lowest, highest]`, or `\"auto\"`",
                        "rad/time",
                        "`\"auto\"`: 0.1 to 5 times the closed loop's slowest and fastest eigenvalue",
                        "",
                    ),
                    key("laws", "list of names", "", "the optimal one", ""),
                    key(
                        "initial",
                        "table of axes",
                        "the states'",
                        "the equilibrium and random states where V is known",
                        "",
                    ),
                    key(
                        "samples",
                        "whole number from 2 to 100000",
                        "1",
                        "200",
                        "times at which the inequality is looked at",
                    ),
                    key(
                        "period",
                        "number > 0",
                        "time",
                        "a sample's interval",
                        "between updates of p from the value map",
                    ),
                ],
            },
            SectionKeys {
                name: "study",
                about: "",
                keys: &[
                    key(
                        "vary",
                        "table of lists of numbers",
                        "the parameters'",
                        "none: one variant",
                        "parameters; every combination of their values, at most 10000",
                    ),
                    key(
                        "from",
                        "table of numbers",
                        "the states'",
                        "required",
                        "initial state; states not named: the equilibrium of each variant",
                    ),
                    key("record", "table", "", "none", "as in `[closed_loop]`"),
                    key(
                        "samples",
                        "whole number from 2 to 100000",
                        "1",
                        "200",
                        "stored points a trajectory",
                    ),
                ],
            },
            SectionKeys {
                name: "events",
                about: "What a simulation forward in time (`costate simulate`) meets: one table for each event. The state\n\
                    jumps when the event's condition comes true: a collision changes rates first, then states are\n\
                    relabelled, and what is set is set at last. A condition that is true from the beginning must\n\
                    become false first. V, p and u know nothing of events.",
                keys: &[
                    key(
                        "when",
                        "a comparison",
                        "",
                        "required",
                        "of states: the event's condition",
                    ),
                    key(
                        "where",
                        "a comparison",
                        "",
                        "everywhere",
                        "of states: elsewhere the event is passed by",
                    ),
                    key(
                        "collision",
                        "list of points, or of tables",
                        "",
                        "none",
                        "points of the mechanism that come to rest, plastically, or along one direction; held ones that are not named let go",
                    ),
                    key(
                        "relabel",
                        "table of names of states",
                        "",
                        "none",
                        "`a = \"b\"`: a becomes what b was, and the rate of a coordinate with it",
                    ),
                    key(
                        "set",
                        "table of expressions",
                        "the states'",
                        "none",
                        "states after the event, of those before it",
                    ),
                    key(
                        "ends",
                        "true or false",
                        "",
                        "false",
                        "the simulation ends there",
                    ),
                ],
            },
            SectionKeys {
                name: "events.collision",
                about: "A table in the list of an event's collision: a point that comes to rest along one direction.",
                keys: &[
                    key("point", "a point's name", "", "required", "the point"),
                    key(
                        "along",
                        "`\"x\"`, `\"y\"`, `\"z\"` or vector",
                        "",
                        "all directions",
                        "it stops in this direction of the world alone",
                    ),
                ],
            },
            SectionKeys {
                name: "simulation",
                about: "What `costate simulate` does unless it is told otherwise.",
                keys: &[
                    key(
                        "initial",
                        "table of numbers or `[first, last, count]`",
                        "the states'",
                        "the equilibrium, or the middle of the region",
                        "where flights begin; states not named: the same",
                    ),
                    key(
                        "time",
                        "number > 0",
                        "time",
                        "the final time of a finite horizon; else required",
                        "how long a flight lasts",
                    ),
                    key(
                        "events",
                        "whole number from 1 to 1000000",
                        "1",
                        "1000",
                        "a flight ends with so many",
                    ),
                    key(
                        "samples",
                        "whole number from 0 to 100000",
                        "1",
                        "50",
                        "stored points of each phase (the way from event to event) after its first",
                    ),
                    key(
                        "law",
                        "`\"lqr\"` or a name in `[closed_loop.law]`",
                        "",
                        "none: controls stay as they are at the equilibrium, or 0",
                        "what controls",
                    ),
                    key(
                        "cycle",
                        "whole number from 1 to 1000",
                        "1",
                        "none",
                        "an orbit is looked for that comes back to itself after so many events",
                    ),
                ],
            },
            SectionKeys {
                name: "attenuation",
                about: "For scenes with disturbances, on an infinite horizon.",
                keys: &[
                    key(
                        "parameter",
                        "name of a parameter that is a number",
                        "",
                        "required",
                        "the level of attenuation",
                    ),
                    key(
                        "range",
                        "`[lowest, highest]`, above 0",
                        "the parameter's",
                        "from the scene's value, by factors of two",
                        "values tried",
                    ),
                    key(
                        "tolerance",
                        "number from 1e-6 to 0.5",
                        "1",
                        "1e-3",
                        "relative, of the smallest value that covers",
                    ),
                    key(
                        "states",
                        "table of axes",
                        "the states'",
                        "a grid of the region, at most about 1000 states",
                        "where coverage is judged; states not named: all of their range",
                    ),
                    key(
                        "levels",
                        "list of 1 to 12 numbers > 0",
                        "the parameter's",
                        "two between gamma* and the answer, and the scene's own",
                        "values whose regions are stored and drawn",
                    ),
                ],
            },
        ],
    ),
    (
        "Pictures, method and precision",
        &[
            SectionKeys {
                name: "report",
                about: "",
                keys: &[
                    key(
                        "axes",
                        "list of two states",
                        "",
                        "the first two that `slice` does not name",
                        "the plane of pictures",
                    ),
                    key(
                        "slice",
                        "table of numbers, inside `[region]`",
                        "the states'",
                        "the equilibrium",
                        "where the plane lies",
                    ),
                    key(
                        "levels",
                        "number, or list of numbers",
                        "V",
                        "chosen",
                        "of the contours of V",
                    ),
                ],
            },
            SectionKeys {
                name: "integrator",
                about: "",
                keys: &[
                    key(
                        "method",
                        "`\"rk4\"`, `\"tsit5\"`, `\"dop853\"`, `\"taylor\"` or `\"auto\"`",
                        "",
                        "`\"auto\"`",
                        "",
                    ),
                    key("rtol", "number > 0, to 0.1", "1", "1e-6", "of a step"),
                    key(
                        "atol",
                        "number from 0",
                        "each quantity's size in the scene",
                        "`rtol`/1000",
                        "",
                    ),
                    key(
                        "step",
                        "number > 0",
                        "time",
                        "required with `method = \"rk4\"`, else not allowed",
                        "",
                    ),
                    key(
                        "precision",
                        "`\"f32\"`, `\"f64\"` or `\"auto\"`",
                        "",
                        "`\"auto\"`",
                        "",
                    ),
                    key(
                        "max_steps",
                        "whole number from 1",
                        "1",
                        "100000",
                        "steps of a trajectory",
                    ),
                ],
            },
        ],
    ),
];
