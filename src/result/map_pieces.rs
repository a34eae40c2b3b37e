//! The groups `/map_pieces`, `/map_beyond` and `/map_check`.

use super::answers::point_statuses;
use super::pieces_group::PiecesGroup;
use super::table::Table;
use super::{Stored, StoredError, TrajectorySchema};
use crate::hdf5::{OutputError, ResultFile};
use crate::map::pieces::{Cell, Node, Piece, Pieces, Shape};
use crate::map::{Adaptive, Checked, Coverage};
use crate::schema;

/// Axis of a node that is a cell.
pub(super) const LEAF: i32 = -1;

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
        PiecesGroup::new(self, group)?.pieces().map(Some)
    }
}
