//! Reading a map in pieces: the columns of its group, and the tree, cells and pieces they make.

use super::map_pieces::LEAF;
use super::stored::StoredGroup;
use super::{Stored, StoredError};
use crate::map::pieces::{
    Bend, Cell, Frame, Node, Piece, Pieces, Region, Shape, directions, margin_terms,
};

/// Reason of an error where columns contradict each other.
const UNFIT: &str = "it does not fit the others";

/// `/map_pieces` or `/map_beyond` of a file.
pub(super) struct PiecesGroup<'s> {
    group: StoredGroup<'s>,
    /// Arguments of V: the states, and on a finite horizon the time where it is an axis.
    n: usize,
}

/// The nodes of the tree of cells.
struct TreeColumns {
    axis: Vec<i32>,
    split: Vec<f64>,
    below: Vec<i32>,
    above: Vec<i32>,
}

/// The corners of the cells.
struct CellColumns {
    count: usize,
    lower: Vec<f64>,
    upper: Vec<f64>,
}

/// The pieces: their cells, places, bounds, and where their coefficients are.
struct PieceColumns {
    count: usize,
    center: Vec<f64>,
    half: Vec<f64>,
    /// Directions of the supports.
    ways: usize,
    support: [Vec<f64>; 2],
    /// Terms of a clearance.
    margins: usize,
    clearance: Vec<f64>,
    bound: Vec<f64>,
    p_bound: Vec<f64>,
    shape: Vec<i32>,
    sheet: Vec<i32>,
    first: Vec<i32>,
    terms: Vec<i32>,
    coefficients: Vec<f64>,
}

impl<'s> PiecesGroup<'s> {
    /// A group of a file.
    ///
    /// # Errors
    /// [`StoredError::Object`] where its arguments are not those of the file's scene.
    pub fn new(stored: &Stored, group: StoredGroup<'s>) -> Result<Self, StoredError> {
        let n = group.f64("lower")?.values.len();
        let states = stored.scene.model.states.len();
        if n != states && !(n == states + 1 && stored.scene.model.final_time().is_some()) {
            return Err(group.error("lower", "it has not one bound a state"));
        }
        Ok(Self { group, n })
    }

    /// The map.
    ///
    /// # Errors
    /// [`StoredError::Object`] where it is not as this program writes it.
    pub fn pieces(&self) -> Result<Pieces, StoredError> {
        let region = self.region()?;
        let frame = self.frame()?;
        let tree = self.tree()?;
        let owners = self.group.i32("of_cell")?.1;
        let cells = self.cells()?;
        let columns = self.columns(owners.len())?;

        let nodes = tree.nodes(self.n, cells.count);
        let nodes = nodes.ok_or_else(|| self.unfit("below"))?;
        let pieces: Option<Vec<Piece>> = (0..columns.count)
            .map(|k| columns.piece(self.n, k))
            .collect();
        let pieces = pieces.ok_or_else(|| self.unfit("coefficients"))?;
        let cells = cells.owning(self.n, &owners);
        let cells = cells
            .filter(|_| !nodes.is_empty())
            .ok_or_else(|| self.unfit("cell"))?;
        Pieces::new(region, frame, nodes, cells, pieces).ok_or_else(|| self.unfit("terms"))
    }

    fn unfit(&self, name: &str) -> StoredError {
        self.group.error(name, UNFIT)
    }

    /// The first number of a column.
    fn number(&self, name: &str) -> Result<f64, StoredError> {
        let found = self.group.f64(name)?.values;
        let first = found
            .first()
            .ok_or_else(|| self.group.error(name, "it is empty"))?;
        match first.is_nan() {
            true => Err(self.group.error(name, "it is no number")),
            false => Ok(*first),
        }
    }

    /// Bounds of errors.
    fn bounds(&self, name: &str, count: usize) -> Result<Vec<f64>, StoredError> {
        let all = self.group.shaped(name, &[count])?;
        match all.iter().all(|b| *b >= 0.0) {
            true => Ok(all),
            false => Err(self
                .group
                .error(name, "a bound of an error is below 0 or no number")),
        }
    }

    fn region(&self) -> Result<Region, StoredError> {
        Ok(Region {
            lo: self.group.shaped("lower", &[self.n])?,
            hi: self.group.shaped("upper", &[self.n])?,
            error: self.number("error")?,
            equal_cost: f64::INFINITY,
            floor: self.number("floor")?,
            value_max: self.number("value_max")?,
            beyond: 0.0,
            game: false,
        })
    }

    fn frame(&self) -> Result<Frame, StoredError> {
        let (group, n) = (&self.group, self.n);
        let bend = match group.has("bend") {
            true => Some(self.bend()?),
            false => None,
        };
        let origin = group.shaped("origin", &[n])?;
        let matrix = group.shaped("frame", &[n, n])?;
        Frame::new(origin, matrix, bend).ok_or_else(|| group.error("frame", "it has no inverse"))
    }

    fn bend(&self) -> Result<Bend, StoredError> {
        let group = &self.group;
        let place = group.shaped("bend_range", &[2])?;
        let axis = usize::try_from(group.i32("bend_axis")?.1.first().copied().unwrap_or(-1)).ok();
        let phi = group.f64("bend")?.values;
        axis.and_then(|axis| Bend::new(self.n, axis, place[0], place[1] - place[0], phi))
            .ok_or_else(|| self.unfit("bend"))
    }

    fn tree(&self) -> Result<TreeColumns, StoredError> {
        let group = &self.group;
        let (axis, below, above) = (
            group.i32("axis")?.1,
            group.i32("below")?.1,
            group.i32("above")?.1,
        );
        let children = [("below", &below), ("above", &above)];
        if let Some((name, _)) = children.into_iter().find(|(_, v)| v.len() != axis.len()) {
            return Err(self.unfit(name));
        }
        Ok(TreeColumns {
            split: group.shaped("split", &[axis.len()])?,
            axis,
            below,
            above,
        })
    }

    fn cells(&self) -> Result<CellColumns, StoredError> {
        let lower = self.group.f64("cell_lower")?.values;
        let count = lower.len() / self.n;
        Ok(CellColumns {
            upper: self.group.shaped("cell_upper", &[count, self.n])?,
            count,
            lower,
        })
    }

    /// The columns of so many pieces.
    fn columns(&self, count: usize) -> Result<PieceColumns, StoredError> {
        let (group, n) = (&self.group, self.n);
        let rows = |name: &str| group.shaped(name, &[count, n]);
        let (ways, margins) = (directions(n).len(), margin_terms(n));
        let supports = |name: &str| group.shaped(name, &[count, ways]);
        let whole = |name: &str| -> Result<Vec<i32>, StoredError> { Ok(group.i32(name)?.1) };
        let columns = PieceColumns {
            count,
            center: rows("center")?,
            half: rows("half")?,
            ways,
            support: [supports("support_lower")?, supports("support_upper")?],
            margins,
            clearance: match group.has("clearance") {
                true => group.shaped("clearance", &[count, margins])?,
                false => vec![f64::NAN; count * margins],
            },
            bound: self.bounds("V_bound", count)?,
            p_bound: self.bounds("p_bound", count)?,
            shape: whole("shape")?,
            sheet: whole("sheet")?,
            first: whole("first")?,
            terms: whole("terms")?,
            coefficients: group.f64("coefficients")?.values,
        };
        let PieceColumns {
            shape,
            sheet,
            first,
            terms,
            ..
        } = &columns;
        if [shape, sheet, first, terms]
            .iter()
            .any(|v| v.len() != count)
        {
            return Err(self.unfit("first"));
        }
        Ok(columns)
    }
}

impl TreeColumns {
    /// The nodes over so many cells; `None` where one has a child that is not there.
    fn nodes(&self, n: usize, cells: usize) -> Option<Vec<Node>> {
        let child = |c: i32, most: usize| usize::try_from(c).ok().filter(|c| *c < most);
        let nodes = (0..self.axis.len()).map(|k| {
            if self.axis[k] == LEAF {
                return Some(Node::Cell(child(self.below[k], cells)?));
            }
            // A child comes after its parent: no circles.
            let later = |c: i32| child(c, self.axis.len()).filter(|c| *c > k);
            Some(Node::Split {
                axis: child(self.axis[k], n)?,
                at: self.split[k],
                below: later(self.below[k])?,
                above: later(self.above[k])?,
                reach: [self.split[k]; 2],
            })
        });
        nodes.collect()
    }
}

impl CellColumns {
    /// The cells, each with the run of pieces whose owner it is; `None` where a piece is in no such
    /// run.
    fn owning(&self, n: usize, owners: &[i32]) -> Option<Vec<Cell>> {
        let mut cells = Vec::with_capacity(self.count);
        let mut next = 0;
        for k in 0..self.count {
            let from = next;
            while owners.get(next).is_some_and(|o| *o == k as i32) {
                next += 1;
            }
            cells.push(Cell {
                lo: row(&self.lower, n, k),
                hi: row(&self.upper, n, k),
                pieces: from..next,
            });
        }
        (next == owners.len()).then_some(cells)
    }
}

impl PieceColumns {
    /// A piece; `None` where its shape is unknown, or its coefficients are not there.
    fn piece(&self, n: usize, k: usize) -> Option<Piece> {
        let (first, terms) = (
            usize::try_from(self.first[k]).ok()?,
            usize::try_from(self.terms[k]).ok()?,
        );
        let [lower, upper] = &self.support;
        let (ways, margins) = (self.ways, self.margins);
        Some(Piece {
            center: row(&self.center, n, k),
            half: row(&self.half, n, k),
            shape: (Shape::ALL.iter())
                .find(|(s, _)| *s as i32 == self.shape[k])?
                .0,
            coefficients: (self.coefficients)
                .get(first..first.checked_add(terms)?)?
                .to_vec(),
            bound: self.bound[k],
            p_bound: self.p_bound[k],
            sheet: self.sheet[k],
            support: (0..ways)
                .map(|i| [lower[k * ways + i], upper[k * ways + i]])
                .filter(|s| !s[0].is_nan())
                .collect(),
            clearance: (self.clearance[k * margins..][..margins].iter().copied())
                .filter(|c| !c.is_nan())
                .collect(),
        })
    }
}

/// A row of n numbers.
fn row(all: &[f64], n: usize, k: usize) -> Vec<f64> {
    all[k * n..][..n].to_vec()
}
