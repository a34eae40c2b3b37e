//! Pieces from scattered points: cells are halved until a polynomial says in each what points that
//! it was not fitted to say.

mod crossings;
mod faces;
mod flow;
mod groups;
mod made;
mod patch;
mod places;
mod quarters;
mod shadow;
mod tracks;

use super::fit::{Data, Scale, Shape};
use super::terms::Terms;
use super::{
    BLEND, Cell, Frame, Node, Piece, Pieces, Region, directions, highest_degree, quadratic,
};
use crate::value::Clearance;
pub use flow::Flow;
use rayon::join;
use rayon::prelude::*;
use shadow::Edge;
use std::collections::BTreeMap;

/// Points as far outside a cell as this share of its half width are fitted too.
const FIT: f64 = 0.3;
/// The same where these are too few.
const WIDER: [f64; 3] = [0.6, 1.0, 2.0];
/// Equations a coefficient: fewer determine no polynomial.
const LEAST_EQUATIONS: f64 = 2.0;
/// Points in a piece that tell its error.
const LEAST_TESTS: usize = 10;
/// Where a low degree errs by so many times what is asked, no high degree is tried before the block
/// is halved.
const HOPELESS: f64 = 1000.0;
/// Degree that tells what to try.
const LOW: usize = 2;
/// Of several functions of V those are tried whose errors at a low degree are within this factor of
/// the least.
const NEARLY: f64 = 1.5;
/// A corner of a cell is supported where a point lies within this many half widths.
const REACH: f64 = 1.25;
/// The same for a piece whose points lie all around.
const BESIDE: f64 = 0.8;
/// How far beyond their points pieces of several sheets in one cell say something, in half widths.
const BEYOND_OF_SEVERAL: f64 = 0.05;
/// Points of neighbours are fitted where they are nearer to a cell that disagrees with them than
/// this share of its half width.
const ANCHORED: f64 = 2.0;
/// Times that cells which disagree with their neighbours are halved at once.
const HALVINGS_APART: usize = 3;
/// Share of new points at which a cell in error is fitted again.
const WORTH_WHILE: f64 = 0.2;

/// How blocks of so many variables are treated.
struct Habits {
    /// The most equations a coefficient: where they cost little more of them leave fewer holes.
    most_equations: f64,
    /// Share of the points that are fitted to while others test the fit.
    learned: f64,
    /// What points left out show is the largest of a sample; the bound is so many times larger.
    allowance: f64,
    /// Share of the error asked for at which a cell is not halved any more.
    enough: f64,
    /// Halvings of the region along one axis.
    most_halvings: i32,
    /// Longest cells, in their own widths.
    sliver: f64,
}

impl Habits {
    fn of(variables: usize, quarters: bool, is_around: bool) -> Self {
        Self {
            most_equations: match variables {
                1 | 2 => 12.0,
                3 => 8.0,
                _ => 4.0,
            },
            learned: if quarters { quarters::LEARNED } else { 1.0 },
            // Round the region no states are solved for the outermost parts' sake.
            allowance: if quarters && !is_around { 1.5 } else { 2.0 },
            enough: if quarters { 0.6 } else { 0.8 },
            most_halvings: if quarters { 14 } else { 18 },
            sliver: if quarters { 32.0 } else { 256.0 },
        }
    }
}

/// What is known: V and its gradient at scattered points, in coordinates of a frame (0 to 1 over
/// the region).
#[derive(Clone, Debug, Default)]
pub struct Cloud {
    pub variables: usize,
    /// `[point][variable]`.
    pub z: Vec<f64>,
    pub v: Vec<f64>,
    /// `dV/dz`, `[point][variable]`.
    pub q: Vec<f64>,
    /// Trajectory of each point: those of one are not independent of each other.
    pub track: Vec<u32>,
    pub sheet: Vec<i32>,
    /// Whether another solution may be cheaper at each.
    pub doubtful: Vec<bool>,
    /// From each point to the end of its trajectory.
    pub clearance: Vec<Clearance>,
    /// Whether some states have several answers: else labels of sheets tell nothing.
    pub several: bool,
    pub unanswered: Unanswered,
}

/// Places at which a search found no solution.
#[derive(Clone, Debug, Default)]
pub struct Unanswered {
    /// `[place][variable]`, in coordinates of the frame.
    pub z: Vec<f64>,
    /// The least margin of the guards along the solution there, if it leaves one; 0 if it is only
    /// known that it does, and not a number where none was found: it may only have been missed.
    pub clearance: Vec<f64>,
}

impl Cloud {
    pub fn len(&self) -> usize {
        self.v.len()
    }

    /// Adds a point: V, how far its trajectory keeps from the guards, and V's gradient at a state
    /// (absolute), put into coordinates of the frame.
    pub fn add(
        &mut self,
        frame: &Frame,
        (x, p): (&[f64], &[f64]),
        (v, clearance): (f64, Clearance),
        (track, sheet, doubtful): (u32, i32, bool),
    ) {
        let at = self.z.len();
        self.z.resize(at + self.variables, 0.0);
        self.q.resize(at + self.variables, 0.0);
        frame.of(x, &mut self.z[at..]);
        frame.gradient_of(&self.z[at..], p, &mut self.q[at..]);
        self.v.push(v);
        self.clearance.push(clearance);
        self.track.push(track);
        self.sheet.push(sheet);
        self.doubtful.push(doubtful);
    }

    /// Whether a quarter of the tracks is left out at once to tell an error, not each in turn: in a
    /// plane, where tracks run side by side and one alone is not missed, and where several sheets
    /// lie over each other, of which one track tells little.
    pub fn leaves_quarters(&self) -> bool {
        self.variables <= 2 || self.several
    }

    pub fn is_empty(&self) -> bool {
        self.v.is_empty()
    }

    /// Takes out all points.
    pub fn clear(&mut self) {
        *self = Self {
            variables: self.variables,
            several: self.several,
            unanswered: std::mem::take(&mut self.unanswered),
            ..Self::default()
        };
    }

    pub fn z(&self, k: usize) -> &[f64] {
        &self.z[k * self.variables..][..self.variables]
    }

    pub fn q(&self, k: usize) -> &[f64] {
        &self.q[k * self.variables..][..self.variables]
    }
}

/// A cell in which more must be known.
#[derive(Clone, Debug, Default)]
pub struct Want {
    pub lo: Vec<f64>,
    pub hi: Vec<f64>,
    /// Error over the one asked for.
    pub excess: f64,
    /// Places that no point is near to, `[place][variable]`.
    pub bare: Vec<f64>,
    /// Points in the cell and around it, and how many of them are no further away than is usual.
    pub points: Vec<u32>,
    pub near: usize,
    /// Whether it has points enough to be halved, but is as narrow as may be.
    pub is_finest: bool,
    /// Its piece, where a shadow of a guard lies over a part of it.
    pub shaded: Option<Box<Piece>>,
}

impl Want {
    /// Whether a place in it is in the shadow of a guard, as far as its points tell.
    pub fn is_in_shadow(&self, z: &[f64]) -> bool {
        self.margin(z) < 0.0
    }

    /// How far the solution at a place keeps from the guards, as far as its points tell.
    pub fn margin(&self, z: &[f64]) -> f64 {
        self.shaded.as_ref().map_or(f64::INFINITY, |piece| {
            let y = piece.place(z);
            quadratic(&piece.clearance, &y[..z.len()])
        })
    }
}

/// A box while it is looked at.
struct Block {
    lo: Vec<f64>,
    hi: Vec<f64>,
    /// Points in it and around it.
    points: Vec<u32>,
    /// How many of them are no further away than is usual.
    near: usize,
    /// Places in it at which a search found no solution.
    unanswered: Vec<u32>,
}

struct Builder<'c> {
    cloud: &'c Cloud,
    terms: Terms,
    region: &'c Region,
    frame: &'c Frame,
    /// Part of the region of which nothing is wanted.
    without: Option<&'c Region>,
    directions: Vec<Vec<f64>>,
    highest: usize,
    habits: Habits,
    before: Option<Before<'c>>,
    flow: Option<&'c Flow>,
    /// Places whose solutions leave a guard.
    cut: Vec<u32>,
    /// Whether any guard casts a shadow.
    is_shaded: bool,
    /// Whether V is negative at a point.
    is_signed: bool,
}

/// Built pieces of a block.
enum Grown {
    Cell(Vec<Piece>, Want),
    Split(usize, f64, Box<(Grown, Grown)>),
}

/// Pieces made before, of the cloud's first points and first places without a solution.
pub struct Before<'b> {
    pub pieces: &'b Pieces,
    pub points: usize,
    pub unanswered: usize,
}

/// Makes pieces of points; and cells where more points are needed for the error asked for. Cells
/// made before whose pieces are good enough stay, if they say what the new points say.
pub fn build(
    cloud: &Cloud,
    region: &Region,
    frame: &Frame,
    flow: Option<&Flow>,
    before: Option<Before<'_>>,
) -> (Pieces, Vec<Want>) {
    let mut made = Builder::new(cloud, region, (frame, None), flow, before).built(HALVINGS_APART);
    made.wants.retain(|w| w.excess > 1.0 || !w.bare.is_empty());
    (made.pieces, made.wants)
}

/// Makes pieces of a region round another, in which nothing is wanted of them.
pub fn build_around(
    cloud: &Cloud,
    region: &Region,
    frame: &Frame,
    flow: Option<&Flow>,
    inner: &Region,
) -> Pieces {
    // There a law needs no more than the bounds to be true.
    Builder::new(cloud, region, (frame, Some(inner)), flow, None)
        .built(0)
        .pieces
}

/// Pieces, and what is wanted in each of their cells.
struct Built {
    pieces: Pieces,
    wants: Vec<Want>,
}

impl Built {
    /// Adds a block's cells and nodes; the number of its node.
    fn plant(&mut self, grown: Grown) -> usize {
        match grown {
            Grown::Cell(own, want) => self.put(own, want),
            Grown::Split(axis, at, both) => {
                let (below, above) = *both;
                self.fork(axis, at, |this| [below, above].map(|half| this.plant(half)))
            }
        }
    }

    /// Moves what lies below a node of another here; what has grown in a cell of it instead of that
    /// cell.
    fn replant(&mut self, other: &mut Self, node: usize, regrown: &mut [Option<Grown>]) -> usize {
        match other.pieces.nodes[node] {
            Node::Cell(cell) => {
                if let Some(grown) = regrown[cell].take() {
                    return self.plant(grown);
                }
                let range = other.pieces.cells[cell].pieces.clone();
                let own = other.pieces.pieces[range]
                    .iter_mut()
                    .map(std::mem::take)
                    .collect();
                self.put(own, std::mem::take(&mut other.wants[cell]))
            }
            Node::Split {
                axis,
                at,
                below,
                above,
                ..
            } => self.fork(axis, at, |this| {
                [below, above].map(|half| this.replant(other, half, regrown))
            }),
        }
    }

    fn put(&mut self, own: Vec<Piece>, want: Want) -> usize {
        let pieces = &mut self.pieces;
        let first = pieces.pieces.len();
        pieces.pieces.extend(own);
        pieces.nodes.push(Node::Cell(pieces.cells.len()));
        pieces.cells.push(Cell {
            lo: want.lo.clone(),
            hi: want.hi.clone(),
            pieces: first..pieces.pieces.len(),
        });
        self.wants.push(want);
        self.pieces.nodes.len() - 1
    }

    fn fork(
        &mut self,
        axis: usize,
        at: f64,
        halves: impl FnOnce(&mut Self) -> [usize; 2],
    ) -> usize {
        let here = self.pieces.nodes.len();
        self.pieces.nodes.push(Node::Cell(0));
        let [below, above] = halves(self);
        self.pieces.nodes[here] = Node::Split {
            axis,
            at,
            below,
            above,
            reach: [at, at],
        };
        here
    }
}

impl<'c> Builder<'c> {
    fn new(
        cloud: &'c Cloud,
        region: &'c Region,
        (frame, without): (&'c Frame, Option<&'c Region>),
        flow: Option<&'c Flow>,
        before: Option<Before<'c>>,
    ) -> Self {
        let n = cloud.variables;
        let highest = highest_degree(n);
        let holes = &cloud.unanswered.clearance;
        let cut: Vec<u32> = (0..holes.len() as u32)
            .filter(|k| holes[*k as usize] < 0.0)
            .collect();
        Self {
            is_shaded: !cut.is_empty() || cloud.clearance.iter().any(|c| c.margin.is_finite()),
            cut,
            is_signed: cloud.v.iter().any(|v| *v < 0.0),
            cloud,
            terms: Terms::new(n, highest),
            region,
            frame,
            without,
            directions: directions(n),
            highest,
            habits: Habits::of(n, cloud.leaves_quarters(), without.is_some()),
            before,
            flow,
        }
    }

    /// Pieces that agree with their neighbours: of those that do not cells with points enough are
    /// halved, so many times, and the others' bounds are raised.
    fn built(&self, halvings: usize) -> Built {
        let n = self.cloud.variables;
        let whole = Block {
            lo: vec![0.0; n],
            hi: vec![1.0; n],
            points: (0..self.cloud.len() as u32).collect(),
            near: self.cloud.len(),
            unanswered: (0..self.cloud.unanswered.clearance.len() as u32).collect(),
        };
        let mut made = self.nothing();
        made.plant(self.grow(whole, self.before.as_ref().map(|_| 0)));
        made.pieces.finish();
        if self.leaves_quarters() {
            made.pieces.label();
            if self.cloud.several {
                self.ask_at_cliffs(&mut made);
            }
            return made;
        }
        for _ in 0..halvings {
            let mut apart: Vec<usize> = self.blamed(&made).iter().map(|(cell, _)| *cell).collect();
            apart.sort_unstable();
            apart.dedup();
            match self.halved(made, &apart) {
                (halved, true) => made = halved,
                (same, false) => {
                    made = same;
                    break;
                }
            }
        }
        self.reconcile(&mut made);
        made.pieces.label();
        for (cell, disagreement) in self.blamed(&made) {
            made.pieces.raise(cell, disagreement.off);
            let excess = &mut made.wants[cell].excess;
            *excess = excess.max(disagreement.off / self.region.error);
        }
        made
    }

    /// Fits the pieces of cells that disagree with their neighbours again, to the points of these
    /// too: where all points of a cell lie in a corner, its polynomial is anything in the others.
    fn reconcile(&self, made: &mut Built) {
        let mut beside: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for (cell, disagreement) in self.blamed(made) {
            let other = disagreement.cells.into_iter().find(|other| *other != cell);
            beside.entry(cell).or_default().extend(other);
        }
        let both = &*made;
        let refitted: Vec<(usize, Piece)> = (beside.par_iter())
            .filter_map(|(cell, beside)| Some((*cell, self.reconciled(both, *cell, beside)?)))
            .collect();
        for (cell, piece) in refitted {
            let first = made.pieces.cells[cell].pieces.start;
            made.pieces.pieces[first] = piece;
        }
    }

    /// A cell's piece, fitted to points of some of its neighbours too; if it errs no more for that.
    fn reconciled(&self, made: &Built, cell: usize, beside: &[usize]) -> Option<Piece> {
        let want = &made.wants[cell];
        let near = |k: &u32| {
            let z = self.cloud.z(*k as usize);
            (z.iter().zip(want.lo.iter().zip(&want.hi))).all(|(z, (lo, hi))| {
                let margin = 0.5 * ANCHORED * (hi - lo);
                (lo - margin..=hi + margin).contains(z)
            })
        };
        let mut theirs: Vec<u32> = (beside.iter())
            .flat_map(|other| made.wants[*other].points.iter().copied().filter(near))
            .collect();
        theirs.sort_unstable();
        theirs.dedup();
        let own = &want.points;
        let mut points = thinned(&theirs, own.len());
        points.extend(own);
        points.sort_unstable();
        points.dedup();
        let block = Block {
            lo: want.lo.clone(),
            hi: want.hi.clone(),
            points: Vec::new(),
            near: want.near,
            unanswered: Vec::new(),
        };
        let (piece, _) = self.of_group(&block, &points, false)?;
        let (mut piece, _) = self.finished(piece, own, &block, self.region.beyond);
        let by = self.bounds_by_equation(std::slice::from_ref(&piece))[0];
        self.judge(&mut piece, by, &[], (own, self.region.beyond));
        let before = made.pieces.pieces[made.pieces.cells[cell].pieces.start].bound;
        (piece.bound <= before.max(self.region.error)).then_some(piece)
    }

    fn nothing(&self) -> Built {
        Built {
            pieces: Pieces {
                region: self.region.clone(),
                frame: self.frame.clone(),
                terms: self.terms.clone(),
                directions: self.directions.clone(),
                nodes: Vec::new(),
                cells: Vec::new(),
                pieces: Vec::new(),
            },
            wants: Vec::new(),
        }
    }

    /// Pieces with some of their cells halved; whether any could be.
    fn halved(&self, mut made: Built, cells: &[usize]) -> (Built, bool) {
        let mut regrown: Vec<Option<Grown>> = Vec::new();
        regrown.resize_with(made.pieces.cells.len(), || None);
        let grown: Vec<(usize, Grown)> = (cells.par_iter())
            .filter_map(|cell| Some((*cell, self.halves(&made, *cell)?)))
            .collect();
        if grown.is_empty() {
            return (made, false);
        }
        for (cell, halves) in grown {
            regrown[cell] = Some(halves);
        }
        let mut all = self.nothing();
        all.replant(&mut made, 0, &mut regrown);
        all.pieces.finish();
        (all, true)
    }

    /// What grows in the halves of a cell, if they have points enough.
    fn halves(&self, made: &Built, cell: usize) -> Option<Grown> {
        let want = &made.wants[cell];
        if !self.is_dense(want.near) {
            return None;
        }
        let block = Block {
            lo: want.lo.clone(),
            hi: want.hi.clone(),
            points: want.points.clone(),
            near: want.near,
            unanswered: self.unanswered_in(&want.lo, &want.hi),
        };
        let own = made.pieces.pieces[made.pieces.cells[cell].pieces.clone()].iter();
        let own: Vec<_> = own
            .map(|piece| (piece.clone(), block.points.clone()))
            .collect();
        let axis = self.axis(&block, &own);
        (!self.is_finest(&block, axis)).then(|| self.split(block, axis, [None; 2]))
    }

    /// `old` is the node of the pieces made before that is this block's.
    fn grow(&self, block: Block, old: Option<usize>) -> Grown {
        let unwanted = |inner: &Region| self.frame.lies_in(inner, &block.lo, &block.hi);
        if !self.frame.may_meet(self.region, &block.lo, &block.hi)
            || self.without.is_some_and(unwanted)
        {
            let nothing = Want {
                lo: block.lo,
                hi: block.hi,
                ..Want::default()
            };
            return Grown::Cell(Vec::new(), nothing);
        }
        if let (Some(before), Some(old)) = (&self.before, old) {
            match before.pieces.nodes[old] {
                Node::Split {
                    axis, below, above, ..
                } => return self.split(block, axis, [Some(below), Some(above)]),
                Node::Cell(cell) => {
                    if let Some((own, excess, edges)) = self.kept(&block, before, cell) {
                        return self.cell(block, own, excess, &edges);
                    }
                }
            }
        }
        let dense = self.is_dense(block.near);
        let (own, excess) = self.fitted(&block, dense);
        if dense && excess > self.habits.enough {
            let axis = self.axis(&block, &own);
            if !self.is_finest(&block, axis) {
                return self.split(block, axis, [None; 2]);
            }
        }
        let made = self.made(&block, &own);
        if dense && self.without.is_none() && self.is_wrong(&block, &made) {
            let by_edges = || self.axis_by_edges(&block, &own);
            let axis = (made.of_edges > 1.0).then(by_edges).flatten();
            let axis = axis.unwrap_or_else(|| self.axis(&block, &own));
            if !self.is_finest(&block, axis) {
                return self.split(block, axis, [None; 2]);
            }
        }
        let of_edges = made.of_edges;
        let (pieces, edges) = self.judged(&block, &own, made);
        let of_bounds = pieces
            .iter()
            .map(|p| p.bound / self.region.error)
            .fold(excess.max(of_edges), f64::max);
        self.cell(block, pieces, of_bounds, &edges)
    }

    fn is_finest(&self, block: &Block, axis: usize) -> bool {
        block.hi[axis] - block.lo[axis] <= 0.5f64.powi(self.habits.most_halvings)
    }

    /// The two halves of a block.
    fn split(&self, block: Block, axis: usize, old: [Option<usize>; 2]) -> Grown {
        let n = self.cloud.variables;
        let at = 0.5 * (block.lo[axis] + block.hi[axis]);
        let half = |upper: bool| {
            let (mut lo, mut hi) = (block.lo.clone(), block.hi.clone());
            if upper {
                lo[axis] = at;
            } else {
                hi[axis] = at;
            }
            // Along the other axes the parent's points are as near as they can be; where they are
            // few, from further away.
            let within = |reach: f64| -> Vec<u32> {
                let margin = 0.5 * reach * (hi[axis] - lo[axis]);
                let (from, to) = (lo[axis] - margin, hi[axis] + margin);
                let near = |k: &&u32| {
                    let z = self.cloud.z[**k as usize * n + axis];
                    (from..=to).contains(&z)
                };
                block.points.iter().filter(near).copied().collect()
            };
            let mut points = within(FIT);
            let usual = |k: &&u32| {
                let z = self.cloud.z(**k as usize);
                (0..n).all(|i| {
                    let margin = 0.5 * FIT * (hi[i] - lo[i]);
                    (lo[i] - margin..=hi[i] + margin).contains(&z[i])
                })
            };
            let near = points.iter().filter(usual).count();
            // The parent's points may be from further away, too.
            if near as f64 >= self.least() {
                points.retain(|k| usual(&k));
            }
            for reach in WIDER {
                if self.leaves_quarters() || points.len() as f64 >= self.least() {
                    break;
                }
                points = within(reach);
            }
            let unanswered = (block.unanswered.iter().copied())
                .filter(|k| self.cloud.unanswered.lies_in(*k, &lo, &hi))
                .collect();
            Block {
                points,
                lo,
                hi,
                near,
                unanswered,
            }
        };
        let (below, above) = (half(false), half(true));
        drop(block.points);
        let both = if below.points.len() + above.points.len() > 500 {
            join(|| self.grow(below, old[0]), || self.grow(above, old[1]))
        } else {
            (self.grow(below, old[0]), self.grow(above, old[1]))
        };
        Grown::Split(axis, at, Box::new(both))
    }

    /// Pieces of a cell made before, if they were good enough and new points do not say otherwise;
    /// with their error over the one asked for, and the edge of shadows in one that is alone.
    fn kept(
        &self,
        block: &Block,
        before: &Before<'_>,
        cell: usize,
    ) -> Option<(Vec<Piece>, f64, Vec<Edge>)> {
        let mut own = before.pieces.pieces[before.pieces.cells[cell].pieces.clone()].to_vec();
        // A few points more make no better polynomial of one that is not good enough.
        let more = block
            .points
            .iter()
            .filter(|k| **k as usize >= before.points)
            .count();
        let dark = block
            .unanswered
            .iter()
            .filter(|k| **k as usize >= before.unanswered)
            .count();
        let dense = self.is_dense(block.near);
        let untouched = more == 0
            || (!self.leaves_quarters()
                && !dense
                && (more as f64) < WORTH_WHILE * block.points.len() as f64);
        let good = |p: &Piece| p.bound <= self.habits.enough * self.region.error;
        let surface = self.excess_of_surface(block, &own);
        let edges = match own.as_mut_slice() {
            // Its edge is by all that is known by now.
            [piece] => {
                let mut edge = self.edge(piece, &block.points);
                piece.clearance = std::mem::take(&mut edge.clearance);
                if !piece.clearance.is_empty() && piece.support.is_empty() {
                    piece.support = self.enclosed(piece, &block.points, self.region.beyond);
                }
                vec![edge]
            }
            _ if dark > 0 => return None,
            _ => Vec::new(),
        };
        let excess_of_edge = edges.first().map_or(0.0, |edge| edge.excess);
        if more + dark > 0 && excess_of_edge > 1.0 && dense {
            return None;
        }
        if !untouched && (own.is_empty() || !own.iter().all(good) || surface > self.habits.enough) {
            return None;
        }
        let n = self.cloud.variables;
        let agrees = |k: usize| {
            let z = self.cloud.z(k);
            own.iter().any(|piece| {
                let y = piece.place(z);
                let (v, _) = piece.value(&self.terms, &y[..n]);
                let size = self.cloud.v[k].abs().max(self.region.floor);
                // Outside the cell it is blended with others.
                y.iter().any(|y| y.abs() > 1.0) || (v - self.cloud.v[k]).abs() <= piece.bound * size
            })
        };
        let fresh = block
            .points
            .iter()
            .map(|k| *k as usize)
            .filter(|k| *k >= before.points);
        if !{ fresh }.all(agrees) || self.is_unfounded(block, &own) {
            return None;
        }
        let excess = own
            .iter()
            .map(|p| p.bound / self.region.error)
            .fold(0.0, f64::max);
        let excess = if own.is_empty() {
            f64::INFINITY
        } else {
            excess
        };
        Some((own, excess.max(surface).max(excess_of_edge), edges))
    }

    /// A cell, with what may be missing in it. Where a sheet ends too early its pieces may err by
    /// as much as V would jump.
    fn cell(&self, block: Block, mut pieces: Vec<Piece>, excess: f64, edges: &[Edge]) -> Grown {
        let is_finest = self.is_dense(block.near)
            && (0..self.cloud.variables).any(|axis| self.is_finest(&block, axis));
        let (mut bare, jump) = self.ends(&block, &pieces);
        for piece in &mut pieces {
            piece.bound = piece.bound.max(jump);
        }
        bare.extend(self.bare_places(&block));
        let mut want = Want {
            excess: excess.max(jump / self.region.error),
            bare: Vec::new(),
            lo: block.lo,
            hi: block.hi,
            points: block.points,
            near: block.near,
            is_finest,
            shaded: self.shaded(&pieces, edges),
        };
        let n = self.cloud.variables;
        want.bare = bare
            .chunks(n)
            .filter(|z| !want.is_in_shadow(z))
            .flatten()
            .copied()
            .collect();
        Grown::Cell(pieces, want)
    }

    /// Points that determine a polynomial of the highest degree.
    fn least(&self) -> f64 {
        LEAST_EQUATIONS * self.terms.upto[self.highest] as f64
            / (self.cloud.variables + 1) as f64
            / self.habits.learned
    }

    /// Whether the halves of a block with so many points near have enough for polynomials of their
    /// own, of the highest degree.
    fn is_dense(&self, near: usize) -> bool {
        near as f64 > 2.0 * self.least()
    }

    fn leaves_quarters(&self) -> bool {
        self.cloud.leaves_quarters()
    }

    /// The best piece for some of a block's points, with its error over the one asked for.
    fn of_group(&self, block: &Block, points: &[u32], can_be_halved: bool) -> Option<(Piece, f64)> {
        if self.leaves_quarters() {
            self.by_quarters(block, points, can_be_halved)
        } else {
            self.by_tracks(block, points, can_be_halved)
        }
    }

    /// Center and half widths of a block's piece.
    fn extent(&self, block: &Block) -> (Vec<f64>, Vec<f64>) {
        let both = || block.lo.iter().zip(&block.hi);
        (
            both().map(|(lo, hi)| 0.5 * (lo + hi)).collect(),
            both()
                .map(|(lo, hi)| 0.5 * (hi - lo) * (1.0 + BLEND))
                .collect(),
        )
    }

    /// A piece with the error over the one asked for; without bounds where its points are too few
    /// to tell.
    fn piece(
        &self,
        (center, half): (Vec<f64>, Vec<f64>),
        (shape, coefficients): (Shape, Vec<f64>),
        bounds: Option<[f64; 2]>,
        points: &[u32],
    ) -> (Piece, f64) {
        let [bound, p_bound] = bounds.unwrap_or([f64::INFINITY; 2]);
        let piece = Piece {
            center,
            half,
            shape,
            coefficients,
            bound,
            p_bound,
            sheet: self.label(points),
            support: Vec::new(),
            clearance: Vec::new(),
        };
        (piece, bound / self.region.error)
    }

    fn degree_of(&self, coefficients: &[f64]) -> usize {
        (self.terms.upto.iter())
            .position(|c| *c == coefficients.len())
            .unwrap_or(0)
    }

    /// Points in the variables of a box.
    fn data(
        &self,
        (center, half): (&[f64], &[f64]),
        list: &[u32],
        degree: usize,
        scale: Scale,
    ) -> Data<'_> {
        let n = self.cloud.variables;
        Data::new(&self.terms, degree, scale, list.len(), |at, y, q| {
            let k = list[at] as usize;
            for i in 0..n {
                y[i] = (self.cloud.z(k)[i] - center[i]) / half[i];
                q[i] = self.cloud.q(k)[i] * half[i];
            }
            (self.cloud.v[k], self.cloud.track[k])
        })
    }

    /// What errors in a cell with some points are relative to.
    fn scale(&self, points: &[u32]) -> Scale {
        /// V may be as much nearer to 0 than at all points, of the range that it has at them.
        const NEARER: f64 = 0.25;
        /// Where |V| is nowhere less than this share of what it is elsewhere in the cell, its own
        /// size will do.
        const ALIKE: f64 = 0.5;
        let floor = self.region.floor;
        if !self.is_signed {
            return Scale::OfEach(floor);
        }
        let values = || points.iter().map(|k| self.cloud.v[*k as usize]);
        let (lowest, highest) = values().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| {
            (a.min(v), b.max(v))
        });
        let least = lowest.max(-highest) - NEARER * (highest - lowest);
        match least >= ALIKE * highest.max(-lowest) {
            true => Scale::OfEach(floor),
            false => Scale::OfAll(least.max(floor)),
        }
    }

    /// The label that most of some points have.
    fn label(&self, points: &[u32]) -> i32 {
        let mut counts: Vec<(i32, usize)> = Vec::new();
        for k in points {
            let label = self.cloud.sheet[*k as usize];
            match counts.iter_mut().find(|(l, _)| *l == label) {
                Some((_, count)) => *count += 1,
                None => counts.push((label, 1)),
            }
        }
        counts
            .iter()
            .max_by_key(|(l, c)| (*c, -*l))
            .map_or(-1, |(l, _)| *l)
    }
}

/// The functions of V worth fitting with a high degree, of those with their errors at a low one;
/// and the least of these errors.
fn shortlist(tried: impl Iterator<Item = (f64, Shape)>) -> Option<(f64, Vec<Shape>)> {
    let mut tried: Vec<(f64, Shape)> = tried.collect();
    tried.sort_by(|a, b| a.0.total_cmp(&b.0));
    let &(least, _) = tried.first()?;
    // V itself where nothing is better.
    let nearly = |shape: Shape| {
        if shape == Shape::Value {
            2.0 * NEARLY
        } else {
            NEARLY
        }
    };
    let good = tried
        .into_iter()
        .filter(|(e, shape)| *e <= nearly(*shape) * least);
    Some((least, good.map(|(_, shape)| shape).take(2).collect()))
}

/// Some of a list, drawn by a hash: in order, neighbours on a track would be left out and kept in
/// turn.
fn thinned(list: &[u32], most: usize) -> Vec<u32> {
    let mut drawn = list.to_vec();
    if drawn.len() > most {
        drawn.select_nth_unstable_by_key(most, |k| mix(*k));
        drawn.truncate(most);
    }
    drawn
}

fn largest(errors: &[[f64; 2]]) -> [f64; 2] {
    let max = |i: usize| errors.iter().map(|e| e[i]).fold(0.0, f64::max);
    [max(0), max(1)]
}

/// A hash, so that neighbouring numbers part.
fn mix(k: u32) -> u32 {
    let mut h = k.wrapping_mul(0x9e37_79b9);
    h ^= h >> 15;
    h = h.wrapping_mul(0x85eb_ca6b);
    h ^ h >> 13
}
