//! The groups `/map_pieces`, `/map_beyond` and `/map_check`.

use super::answers::point_statuses;
use super::table::Table;
use super::{Stored, StoredError, TrajectorySchema};
use crate::hdf5::{OutputError, ResultFile};
use crate::map::pieces::{
    Bend, Cell, Frame, Node, Piece, Pieces, Region, Shape, directions, margin_terms,
};
use crate::map::{Adaptive, Checked, Coverage};
use crate::schema;

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
        axes: &TrajectorySchema,
        time: &str,
        made: &Adaptive,
    ) -> Result<(), OutputError> {
        let n = axes.states.len();
        let time = (made.pieces.states() > n).then_some(time);
        if !made.pieces.pieces.is_empty() {
            let mut table = pieces_table(&schema::MAP_PIECES, axes, time, &made.pieces);
            table.attribute(COVERAGE, made.coverage().name());
            table.write(self)?;
        }
        if let Some(beyond) = &made.beyond {
            pieces_table(&schema::MAP_BEYOND, axes, time, &beyond.pieces).write(self)?;
        }
        if made.check.is_empty() {
            return Ok(());
        }

        let column = |f: &dyn Fn(&Checked) -> f64| made.check.iter().map(f).collect::<Vec<f64>>();
        let x0: Vec<f64> = (made.check.iter())
            .flat_map(|c| c.x[..n].iter().copied())
            .collect();
        let statuses: Vec<i32> = made.check.iter().map(|c| c.status as i32).collect();
        let mut table = Table::new(&schema::MAP_CHECK, axes).length("point", made.check.len());
        table
            .put("x0", x0)
            .put_codes("status", point_statuses(), statuses)
            .put("V_solved", column(&|c| c.solved))
            .put("V_said", column(&|c| c.said))
            .put("V_bound", column(&|c| c.bound));
        if let Some(time) = time {
            table.put_named("<time>", time, None, column(&|c| c.x[n]));
        }
        table.write(self)
    }
}

/// One of the two maps, to be written.
fn pieces_table<'t>(
    group: &'static schema::Group,
    axes: &'t TrajectorySchema,
    time: Option<&str>,
    pieces: &'t Pieces,
) -> Table<'t> {
    let region = &pieces.region;
    let all =
        |f: &dyn Fn(&Piece) -> Vec<f64>| -> Vec<f64> { pieces.pieces.iter().flat_map(f).collect() };
    let coefficients = all(&|p| p.coefficients.clone());
    // Of what V is a function: the states, or these and the time.
    let of = time.map_or("state", |_| "argument");
    let mut table = Table::new(group, axes)
        .length("coordinate", region.lo.len())
        .length("node", pieces.nodes.len())
        .length("way", pieces.directions.len())
        .length("cell", pieces.cells.len())
        .length("piece", pieces.pieces.len())
        .length("coefficient", coefficients.len())
        .stands_for("<argument>", of);
    if let Some(name) = time {
        let arguments = axes.states.iter().map(|s| s.name.as_str()).chain([name]);
        table = table.labels("argument", arguments);
        table.attribute("time", name);
    }
    if let Some(bend) = &pieces.frame.bend {
        table = table.length("monomial", bend.phi.len()).length("end", 2);
        table
            .put("bend_axis", bend.axis as i32)
            .put("bend_range", vec![bend.lowest, bend.lowest + bend.width])
            .put("bend", &bend.phi);
    }

    table
        .put("error", region.error)
        .put("floor", region.floor)
        .put("value_max", region.value_max)
        .put("lower", &region.lo)
        .put("upper", &region.hi)
        .put("origin", &pieces.frame.origin)
        .put("frame", &pieces.frame.matrix);

    put_tree(&mut table, pieces);
    put_cells(&mut table, pieces);
    let margins = pieces.margin_terms();
    if margins > 0 {
        table = table.length("margin_term", margins);
        let clearance = all(&|p| match p.clearance.is_empty() {
            true => vec![f64::NAN; margins],
            false => p.margins(margins),
        });
        table.put("clearance", clearance);
    }
    put_polynomials(&mut table, pieces);
    table.put("coefficients", coefficients);
    table
}

/// The tree of cells.
fn put_tree(table: &mut Table<'_>, pieces: &Pieces) {
    let node = |f: fn(&Node) -> i32| pieces.nodes.iter().map(f).collect::<Vec<i32>>();
    let split = |n: &Node| match n {
        Node::Cell(_) => f64::NAN,
        Node::Split { at, .. } => *at,
    };
    table
        .put(
            "axis",
            node(|n| match n {
                Node::Cell(_) => LEAF,
                Node::Split { axis, .. } => *axis as i32,
            }),
        )
        .put(
            "split",
            pieces.nodes.iter().map(split).collect::<Vec<f64>>(),
        )
        .put(
            "below",
            node(|n| match n {
                Node::Cell(cell) => *cell as i32,
                Node::Split { below, .. } => *below as i32,
            }),
        )
        .put(
            "above",
            node(|n| match n {
                Node::Cell(_) => LEAF,
                Node::Split { above, .. } => *above as i32,
            }),
        );
}

/// The cells, and which pieces are theirs.
fn put_cells(table: &mut Table<'_>, pieces: &Pieces) {
    let flat =
        |f: fn(&Cell) -> &[f64]| -> Vec<f64> { pieces.cells.iter().flat_map(f).copied().collect() };
    let owners: Vec<i32> = (pieces.cells.iter().enumerate())
        .flat_map(|(k, c)| std::iter::repeat_n(k as i32, c.pieces.len()))
        .collect();
    table
        .put("cell_lower", flat(|c| &c.lo))
        .put("cell_upper", flat(|c| &c.hi))
        .put("of_cell", owners);
}

/// Each piece's place and bounds, and where its coefficients are.
fn put_polynomials(table: &mut Table<'_>, pieces: &Pieces) {
    let all =
        |f: &dyn Fn(&Piece) -> Vec<f64>| -> Vec<f64> { pieces.pieces.iter().flat_map(f).collect() };
    let ways = pieces.directions.len();
    let support = |side: usize| {
        all(&|p| match p.support.is_empty() {
            true => vec![f64::NAN; ways],
            false => p.support.iter().map(|s| s[side]).collect(),
        })
    };
    let whole = |f: fn(&Piece) -> i32| pieces.pieces.iter().map(f).collect::<Vec<i32>>();
    let first: Vec<i32> = (pieces.pieces.iter())
        .scan(0, |next, p| {
            let here = *next;
            *next += p.coefficients.len() as i32;
            Some(here)
        })
        .collect();
    table
        .put("center", all(&|p| p.center.clone()))
        .put("half", all(&|p| p.half.clone()))
        .put("direction", pieces.directions.concat())
        .put("support_lower", support(0))
        .put("support_upper", support(1))
        .put_codes(
            "shape",
            Shape::ALL.map(|(s, name)| (s as i32, name)),
            whole(|p| p.shape as i32),
        )
        .put("sheet", whole(|p| p.sheet))
        .put("V_bound", all(&|p| vec![p.bound]))
        .put("p_bound", all(&|p| vec![p.p_bound]))
        .put("first", first)
        .put("terms", whole(|p| p.coefficients.len() as i32));
}

impl Stored {
    /// The map in pieces.
    ///
    /// # Errors
    /// [`StoredError::Object`] where it is not as this program writes it.
    pub fn map_pieces(&self) -> Result<Option<Pieces>, StoredError> {
        self.read_pieces(&schema::MAP_PIECES)
    }

    /// The map round it, where solutions from its region lead.
    ///
    /// # Errors
    /// As above.
    pub fn map_beyond(&self) -> Result<Option<Pieces>, StoredError> {
        self.read_pieces(&schema::MAP_BEYOND)
    }

    /// How well the states of the map were searched for cheaper sheets.
    pub fn map_coverage(&self) -> Coverage {
        let told = self
            .group(&schema::MAP_PIECES)
            .and_then(|pieces| pieces.attribute(None, COVERAGE));
        let told = told.and_then(|name| {
            Coverage::ALL
                .iter()
                .find(|(.., own)| *own == name)
                .map(|(c, ..)| *c)
        });
        // Files of before do not tell it.
        told.unwrap_or(match self.has(&schema::MAP_CHECK) {
            true => Coverage::Checked,
            false => Coverage::Searched,
        })
    }

    fn read_pieces(&self, group: &'static schema::Group) -> Result<Option<Pieces>, StoredError> {
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
