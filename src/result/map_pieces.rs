//! The groups `/map_pieces`, `/map_beyond` and `/map_check`.

use super::answers::{Names, status};
use super::{Stored, StoredError, TrajectorySchema};
use crate::hdf5::{Dimension, Group, OutputError, ResultFile, Variable};
use crate::map::pieces::{
    Bend, Cell, Frame, Node, Piece, Pieces, Region, Shape, directions, margin_terms,
};
use crate::map::{Adaptive, Coverage};

const PIECES: &str = "map_pieces";
const BEYOND: &str = "map_beyond";
const CHECK: &str = "map_check";
/// Axis of a node that is a cell.
const LEAF: i32 = -1;

/// Attribute of `/map_pieces`: how well its states were searched for cheaper sheets.
const COVERAGE: &str = "coverage";

impl ResultFile {
    /// Writes a map in pieces, and what fresh states say of it.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    ///
    /// Where time is an axis it is the last of the pieces' arguments, and called `time`.
    pub fn map_pieces(
        &mut self,
        schema: &TrajectorySchema,
        time: &str,
        made: &Adaptive,
    ) -> Result<(), OutputError> {
        let names = Names::new(schema);
        let n = schema.states.len();
        let timed = made.pieces.states() > n;
        if !made.pieces.pieces.is_empty() {
            let title = "value function in pieces: cells of a region with a polynomial each";
            self.write_pieces(
                &names,
                timed.then_some((schema, time)),
                (PIECES, title, Some(made.coverage())),
                &made.pieces,
            )?;
        }
        if let Some(beyond) = &made.beyond {
            let title =
                "the same where solutions from the region lead, of use outside the region only";
            self.write_pieces(
                &names,
                timed.then_some((schema, time)),
                (BEYOND, title, None),
                &beyond.pieces,
            )?;
        }
        if made.check.is_empty() {
            return Ok(());
        }
        let group = Group::new(CHECK)
            .attribute(
                "title",
                "fresh states, solved and never used in the map, and what the map says of them",
            )
            .dimension(Dimension::index("point", made.check.len()));
        let group = names
            .axes(group)
            .variable(names.state("x0", &["point", "state"], "fresh state"))
            .variable(status(["point"]));
        let value = |name: &str, what: &str| {
            Variable::f64(name, ["point"])
                .unit(names.cost())
                .long_name(what)
        };
        let group = group
            .variable(value("V_solved", "V solved for"))
            .variable(value("V_said", "V that the map says"))
            .variable(value("V_bound", "bound of its error that the map says"));
        let group = if timed {
            let unit = schema.time();
            group.variable(Variable::f64(time, ["point"]).unit(unit).long_name("time"))
        } else {
            group
        };
        let mut writer = self.group(&group)?;
        let column = |f: &dyn Fn(&crate::map::Checked) -> f64| -> Vec<f64> {
            made.check.iter().map(f).collect()
        };
        let x0: Vec<f64> = made
            .check
            .iter()
            .flat_map(|c| c.x[..n].iter().copied())
            .collect();
        writer.write("x0", &x0)?;
        if timed {
            writer.write(time, &column(&|c| c.x[n]))?;
        }
        let statuses: Vec<i32> = made.check.iter().map(|c| c.status as i32).collect();
        writer.write("status", &statuses)?;
        writer.write("V_solved", &column(&|c| c.solved))?;
        writer.write("V_said", &column(&|c| c.said))?;
        writer.write("V_bound", &column(&|c| c.bound))
    }

    fn write_pieces(
        &mut self,
        names: &Names<'_>,
        time: Option<(&TrajectorySchema, &str)>,
        (group, title, coverage): (&'static str, &str, Option<Coverage>),
        pieces: &Pieces,
    ) -> Result<(), OutputError> {
        // Of what V is a function: the states, or these and the time.
        let of = time.map_or("state", |_| "argument");
        let region = &pieces.region;
        let coefficients: Vec<f64> = pieces
            .pieces
            .iter()
            .flat_map(|p| p.coefficients.iter().copied())
            .collect();
        let group = Group::new(group).attribute("title", title);
        let group = match coverage {
            Some(coverage) => group.attribute(COVERAGE, coverage.name()),
            None => group,
        };
        let group = group
            .dimension(Dimension::index("coordinate", region.lo.len()))
            .dimension(Dimension::index("node", pieces.nodes.len()))
            .dimension(Dimension::index("way", pieces.directions.len()))
            .dimension(Dimension::index("cell", pieces.cells.len()))
            .dimension(Dimension::index("piece", pieces.pieces.len()))
            .dimension(Dimension::index("coefficient", coefficients.len()));
        let group = names
            .axes(group)
            .variable(Variable::f64("error", []).long_name("error of V asked for, relative to max(V, floor)"))
            .variable(
                Variable::f64("floor", [])
                    .unit(names.cost())
                    .long_name("least V that errors are relative to"),
            )
            .variable(
                Variable::f64("value_max", [])
                    .unit(names.cost())
                    .long_name("nothing is said of larger V; infinite: no limit"),
            )
            .variable(names.state("lower", &[of], "lower bound of the region"))
            .variable(names.state("upper", &[of], "upper bound of the region"))
            .variable(names.state("origin", &[of], "origin of the coordinates"))
            .variable(Variable::f64("frame", ["coordinate", of]).long_name("coordinates are frame (x - origin)"))
            .variable(
                Variable::i32("axis", ["node"]).long_name("coordinate along which a node is split; -1: it is a cell"),
            )
            .variable(Variable::f64("split", ["node"]).long_name("where it is split"))
            .variable(Variable::i32("below", ["node"]).long_name("node below the split; of a cell its number"))
            .variable(Variable::i32("above", ["node"]).long_name("node above the split"))
            .variable(Variable::f64("cell_lower", ["cell", "coordinate"]).long_name("coordinate"))
            .variable(Variable::f64("cell_upper", ["cell", "coordinate"]).long_name("coordinate"))
            .variable(Variable::i32("of_cell", ["piece"]).long_name("cell of each piece"))
            .variable(Variable::f64("center", ["piece", "coordinate"]).long_name("coordinate"))
            .variable(
                Variable::f64("half", ["piece", "coordinate"])
                    .long_name("half width: monomials are of (coordinate - center) / half"),
            )
            .variable(Variable::f64("direction", ["way", "coordinate"]).long_name("along which supports are given"))
            .variable(
                Variable::f64("support_lower", ["piece", "way"])
                    .long_name("extent of the points fitted to, in the monomials' variables; NaN: all around"),
            )
            .variable(Variable::f64("support_upper", ["piece", "way"]).long_name("the same"))
            .variable(
                Variable::i32("shape", ["piece"])
                    .long_name("the function of V that is a polynomial")
                    .flags(Shape::ALL.map(|(s, name)| (s as i32, name))),
            )
            .variable(Variable::i32("sheet", ["piece"]).long_name("sheet of the value function"))
            .variable(Variable::f64("V_bound", ["piece"]).long_name("bound of V's error, relative to max(V, floor)"))
            .variable(Variable::f64("p_bound", ["piece"]).long_name(
                "bound of the error of V's derivatives by the monomials' variables, relative to max(V, floor)",
            ))
            .variable(Variable::i32("first", ["piece"]).long_name("first coefficient"))
            .variable(Variable::i32("terms", ["piece"]).long_name("number of coefficients"))
            .variable(Variable::f64("coefficients", ["coefficient"]).long_name(
                "of monomials by rising total degree, those of a degree in lexicographic order of their factors",
            ));
        let group = match &pieces.frame.bend {
            Some(bend) => group
                .dimension(Dimension::index("monomial", bend.phi.len()))
                .dimension(Dimension::index("end", 2))
                .variable(Variable::i32("bend_axis", []).long_name("coordinate that is sheared"))
                .variable(
                    Variable::f64("bend_range", ["end"]).long_name(
                        "what the sheared coordinate plus the polynomial is where the coordinate is 0 and 1",
                    ),
                )
                .variable(
                    Variable::f64("bend", ["monomial"])
                        .long_name("polynomial of the other coordinates, monomials in the order of the coefficients"),
                ),
            None => group,
        };
        let margins = pieces.margin_terms();
        let group = match margins {
            0 => group,
            _ => group
                .dimension(Dimension::index("margin_term", margins))
                .variable(Variable::f64("clearance", ["piece", "margin_term"]).long_name(
                    "polynomial of the least margin of the guards along trajectories, in the monomials' variables: nothing is said \
                     where it is negative; NaN: all of them stay inside",
                )),
        };
        let group = match time {
            Some((schema, name)) => {
                let arguments = schema.states.iter().map(|s| s.name.as_str()).chain([name]);
                group
                    .attribute("time", name)
                    .dimension(Dimension::names("argument", arguments))
            }
            None => group,
        };
        let mut writer = self.group(&group)?;
        if let Some(bend) = &pieces.frame.bend {
            writer.write("bend_axis", &[bend.axis as i32])?;
            writer.write("bend_range", &[bend.lowest, bend.lowest + bend.width])?;
            writer.write("bend", &bend.phi)?;
        }
        writer.write("error", &[region.error])?;
        writer.write("floor", &[region.floor])?;
        writer.write("value_max", &[region.value_max])?;
        writer.write("lower", &region.lo)?;
        writer.write("upper", &region.hi)?;
        writer.write("origin", &pieces.frame.origin)?;
        writer.write("frame", &pieces.frame.matrix)?;
        let node = |f: &dyn Fn(&Node) -> i32| -> Vec<i32> { pieces.nodes.iter().map(f).collect() };
        writer.write(
            "axis",
            &node(&|n| match n {
                Node::Cell(_) => LEAF,
                Node::Split { axis, .. } => *axis as i32,
            }),
        )?;
        let split = |n: &Node| match n {
            Node::Cell(_) => f64::NAN,
            Node::Split { at, .. } => *at,
        };
        writer.write(
            "split",
            &pieces.nodes.iter().map(split).collect::<Vec<f64>>(),
        )?;
        writer.write(
            "below",
            &node(&|n| match n {
                Node::Cell(cell) => *cell as i32,
                Node::Split { below, .. } => *below as i32,
            }),
        )?;
        writer.write(
            "above",
            &node(&|n| match n {
                Node::Cell(_) => LEAF,
                Node::Split { above, .. } => *above as i32,
            }),
        )?;
        let flat = |f: &dyn Fn(&Cell) -> &[f64]| -> Vec<f64> {
            pieces
                .cells
                .iter()
                .flat_map(|c| f(c).iter().copied())
                .collect()
        };
        writer.write("cell_lower", &flat(&|c| &c.lo))?;
        writer.write("cell_upper", &flat(&|c| &c.hi))?;
        let owners: Vec<i32> = (pieces.cells.iter().enumerate())
            .flat_map(|(k, c)| std::iter::repeat_n(k as i32, c.pieces.len()))
            .collect();
        writer.write("of_cell", &owners)?;
        let all = |f: &dyn Fn(&Piece) -> Vec<f64>| -> Vec<f64> {
            pieces.pieces.iter().flat_map(f).collect()
        };
        writer.write("center", &all(&|p| p.center.clone()))?;
        writer.write("half", &all(&|p| p.half.clone()))?;
        writer.write("direction", &pieces.directions.concat())?;
        let ways = pieces.directions.len();
        let support = |side: usize| {
            all(&|p| {
                if p.support.is_empty() {
                    return vec![f64::NAN; ways];
                }
                p.support.iter().map(|s| s[side]).collect()
            })
        };
        writer.write("support_lower", &support(0))?;
        writer.write("support_upper", &support(1))?;
        if margins > 0 {
            writer.write(
                "clearance",
                &all(&|p| match p.clearance.is_empty() {
                    true => vec![f64::NAN; margins],
                    false => p.margins(margins),
                }),
            )?;
        }
        writer.write("V_bound", &all(&|p| vec![p.bound]))?;
        writer.write("p_bound", &all(&|p| vec![p.p_bound]))?;
        let whole =
            |f: &dyn Fn(&Piece) -> i32| -> Vec<i32> { pieces.pieces.iter().map(f).collect() };
        writer.write("shape", &whole(&|p| p.shape as i32))?;
        writer.write("sheet", &whole(&|p| p.sheet))?;
        writer.write("terms", &whole(&|p| p.coefficients.len() as i32))?;
        let first: Vec<i32> = (pieces.pieces.iter())
            .scan(0, |next, p| {
                let here = *next;
                *next += p.coefficients.len() as i32;
                Some(here)
            })
            .collect();
        writer.write("first", &first)?;
        writer.write("coefficients", &coefficients)
    }
}

impl Stored {
    /// The map in pieces.
    ///
    /// # Errors
    /// [`StoredError::Object`] where it is not as this program writes it.
    pub fn map_pieces(&self) -> Result<Option<Pieces>, StoredError> {
        self.read_pieces(PIECES)
    }

    /// The map round it, where solutions from its region lead.
    ///
    /// # Errors
    /// As above.
    pub fn map_beyond(&self) -> Result<Option<Pieces>, StoredError> {
        self.read_pieces(BEYOND)
    }

    /// How well the states of the map were searched for cheaper sheets.
    pub fn map_coverage(&self) -> Coverage {
        let told = self
            .group(PIECES)
            .and_then(|pieces| pieces.attribute(None, COVERAGE));
        let told = told.and_then(|name| {
            Coverage::ALL
                .iter()
                .find(|(.., own)| *own == name)
                .map(|(c, ..)| *c)
        });
        // Files of before do not tell it.
        told.unwrap_or(match self.has(CHECK) {
            true => Coverage::Checked,
            false => Coverage::Searched,
        })
    }

    fn read_pieces(&self, group: &str) -> Result<Option<Pieces>, StoredError> {
        let Some(group) = self.group(group) else {
            return Ok(None);
        };
        // The states, and on a finite horizon the time where it is an axis.
        let n = group.f64("lower")?.values.len();
        let states = self.scene.model.states.len();
        if n != states && !(n == states + 1 && self.scene.model.final_time().is_some()) {
            return Err(group.error("lower", "it has not one bound a state"));
        }
        let number = |name: &str| -> Result<f64, StoredError> {
            let found = group.f64(name)?.values;
            let first = found
                .first()
                .ok_or_else(|| group.error(name, "it is empty"))?;
            match first.is_nan() {
                true => Err(group.error(name, "it is no number")),
                false => Ok(*first),
            }
        };
        let bounds = |name: &str, count: usize| -> Result<Vec<f64>, StoredError> {
            let all = group.shaped(name, &[count])?;
            match all.iter().all(|b| *b >= 0.0) {
                true => Ok(all),
                false => Err(group.error(name, "a bound of an error is below 0 or no number")),
            }
        };
        let region = Region {
            lo: group.shaped("lower", &[n])?,
            hi: group.shaped("upper", &[n])?,
            error: number("error")?,
            equal_cost: f64::INFINITY,
            floor: number("floor")?,
            value_max: number("value_max")?,
            beyond: 0.0,
            game: false,
        };
        let bend = match group.has("bend") {
            true => {
                let place = group.shaped("bend_range", &[2])?;
                let axis =
                    usize::try_from(group.i32("bend_axis")?.1.first().copied().unwrap_or(-1)).ok();
                let phi = group.f64("bend")?.values;
                let bend =
                    axis.and_then(|axis| Bend::new(n, axis, place[0], place[1] - place[0], phi));
                Some(bend.ok_or_else(|| group.error("bend", "it does not fit the others"))?)
            }
            false => None,
        };
        let frame = Frame::new(
            group.shaped("origin", &[n])?,
            group.shaped("frame", &[n, n])?,
            bend,
        )
        .ok_or_else(|| group.error("frame", "it has no inverse"))?;
        let (axis, below, above) = (
            group.i32("axis")?.1,
            group.i32("below")?.1,
            group.i32("above")?.1,
        );
        if let Some((name, _)) = [("below", &below), ("above", &above)]
            .into_iter()
            .find(|(_, v)| v.len() != axis.len())
        {
            return Err(group.error(name, "it does not fit the others"));
        }
        let split = group.shaped("split", &[axis.len()])?;
        let owners = group.i32("of_cell")?.1;
        let count = owners.len();
        let lower = group.f64("cell_lower")?.values;
        let cells_count = lower.len() / n;
        let (lower, upper) = (lower, group.shaped("cell_upper", &[cells_count, n])?);
        let rows = |name: &str| group.shaped(name, &[count, n]);
        let (center, half) = (rows("center")?, rows("half")?);
        let ways = directions(n).len();
        let supports = |name: &str| group.shaped(name, &[count, ways]);
        let support = [supports("support_lower")?, supports("support_upper")?];
        let margins = margin_terms(n);
        let clearance = match group.has("clearance") {
            true => group.shaped("clearance", &[count, margins])?,
            false => vec![f64::NAN; count * margins],
        };
        let (bound, p_bound) = (bounds("V_bound", count)?, bounds("p_bound", count)?);
        let whole = |name: &str| -> Result<Vec<i32>, StoredError> { Ok(group.i32(name)?.1) };
        let (shape, sheet, first, terms) = (
            whole("shape")?,
            whole("sheet")?,
            whole("first")?,
            whole("terms")?,
        );
        let coefficients = group.f64("coefficients")?.values;
        let wrong = |name: &str| group.error(name, "it does not fit the others");
        if [&shape, &sheet, &first, &terms]
            .iter()
            .any(|v| v.len() != count)
        {
            return Err(wrong("first"));
        }
        let nodes = (0..axis.len()).map(|k| {
            let child = |c: i32, most: usize| usize::try_from(c).ok().filter(|c| *c < most);
            if axis[k] == LEAF {
                return Some(Node::Cell(child(below[k], cells_count)?));
            }
            // A child comes after its parent: no circles.
            let later = |c: i32| child(c, axis.len()).filter(|c| *c > k);
            Some(Node::Split {
                axis: child(axis[k], n)?,
                at: split[k],
                below: later(below[k])?,
                above: later(above[k])?,
                reach: [split[k]; 2],
            })
        });
        let nodes: Vec<Node> = nodes.collect::<Option<_>>().ok_or_else(|| wrong("below"))?;
        let row = |all: &[f64], k: usize| all[k * n..][..n].to_vec();
        let pieces = (0..count).map(|k| {
            let (first, terms) = (
                usize::try_from(first[k]).ok()?,
                usize::try_from(terms[k]).ok()?,
            );
            Some(Piece {
                center: row(&center, k),
                half: row(&half, k),
                shape: Shape::ALL.iter().find(|(s, _)| *s as i32 == shape[k])?.0,
                coefficients: coefficients.get(first..first.checked_add(terms)?)?.to_vec(),
                bound: bound[k],
                p_bound: p_bound[k],
                sheet: sheet[k],
                support: (0..ways)
                    .map(|i| [support[0][k * ways + i], support[1][k * ways + i]])
                    .filter(|s| !s[0].is_nan())
                    .collect(),
                clearance: (clearance[k * margins..][..margins].iter().copied())
                    .filter(|c| !c.is_nan())
                    .collect(),
            })
        });
        let pieces: Vec<Piece> = pieces
            .collect::<Option<_>>()
            .ok_or_else(|| wrong("coefficients"))?;
        let mut cells = Vec::with_capacity(cells_count);
        let mut next = 0;
        for k in 0..cells_count {
            let from = next;
            while owners.get(next).is_some_and(|o| *o == k as i32) {
                next += 1;
            }
            cells.push(Cell {
                lo: row(&lower, k),
                hi: row(&upper, k),
                pieces: from..next,
            });
        }
        if next != count || nodes.is_empty() {
            return Err(wrong("cell"));
        }
        Pieces::new(region, frame, nodes, cells, pieces)
            .map(Some)
            .ok_or_else(|| wrong("terms"))
    }
}
