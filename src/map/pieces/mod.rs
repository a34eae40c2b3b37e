//! A value function in pieces: cells of a region with a polynomial of V each, blended where they
//! overlap.
//!
//! The region is halved, along one axis at a time, into cells. Each cell has one polynomial a
//! sheet, fitted to V and p at scattered points in it and a little around it, of V or of a function
//! of V ([`Shape`]). Around the faces of cells their polynomials are blended by weights that sum to
//! one and have continuous derivatives (a partition of unity: Melenk & Babuska 1996), and p is the
//! gradient of the blend.

mod build;
mod fit;
mod flat;
#[cfg(test)]
mod flat_tests;
mod frame;
mod jets;
mod least_squares;
mod rounding;
mod terms;

pub use build::{Before, Cloud, Flow, Unanswered, Want, build, build_around};
pub use fit::Shape;
pub use flat::{Desk, Flat, Here, LANES};
pub use frame::{Bend, Frame, Steep};
pub(crate) use jets::{Jet, Sum, Tables, by_states};
pub use terms::{MOST_DEGREE, MOST_VARIABLES, Terms};

use crate::value::Groups;
use std::collections::BTreeMap;

/// Cells reach this share of their half width over their faces.
pub const BLEND: f64 = 0.1;
/// Where polynomials of several sheets lie over a state, they are blended with those that say the
/// same but for this many times their bounds.
pub const SAME: f64 = 3.0;
/// Across a face p of one sheet differs by less than this share.
const SHEET_MISFIT: f64 = 0.05;

/// Highest degree of the polynomials of so many variables.
pub fn highest_degree(variables: usize) -> usize {
    match variables {
        0..=2 => terms::MOST_DEGREE,
        3 => 6,
        _ => 4,
    }
}

/// What pieces are made for.
#[derive(Clone, Debug, PartialEq)]
pub struct Region {
    /// Absolute, one a state.
    pub lo: Vec<f64>,
    pub hi: Vec<f64>,
    /// Largest error wanted, relative to the larger one of V and the floor.
    pub error: f64,
    /// Largest distance wanted of the surface where two sheets cost the same from where it is said
    /// to be, in widths of the region; infinite: any.
    pub equal_cost: f64,
    pub floor: f64,
    /// Nothing is said of larger V.
    pub value_max: f64,
    /// How far beyond their outermost points pieces may say something, in half widths of theirs.
    pub beyond: f64,
    /// Whether V is that of a game, where behind a fold there is nothing.
    pub game: bool,
}

impl Region {
    pub fn width(&self, i: usize) -> f64 {
        self.hi[i] - self.lo[i]
    }

    /// Whether a state (absolute) lies in it.
    pub fn covers(&self, x: &[f64]) -> bool {
        (x.iter().zip(self.lo.iter().zip(&self.hi))).all(|(x, (lo, hi))| x >= lo && x <= hi)
    }
}

/// A polynomial over a cell and a little around it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Piece {
    /// In coordinates of the frame, 0 to 1; monomials are of `(z - center) / half`.
    pub center: Vec<f64>,
    pub half: Vec<f64>,
    pub shape: Shape,
    pub coefficients: Vec<f64>,
    /// Bounds of the errors of V and of its derivatives by the monomials' variables, relative to
    /// the larger one of V and the floor.
    pub bound: f64,
    pub p_bound: f64,
    pub sheet: i32,
    /// Extents of the points that it was fitted to along [`directions`], in its own variables,
    /// where points are missing on one side of the cell; else empty.
    pub support: Vec<[f64; 2]>,
    /// Coefficients of the least margin of the guards along trajectories, a polynomial of up to the
    /// second degree in its own variables (in the order of [`Terms`]): nothing is said where it is
    /// negative. Empty where all of them stay inside.
    pub clearance: Vec<f64>,
}

impl Piece {
    /// A place in the piece's own variables.
    fn place(&self, z: &[f64]) -> [f64; MOST_VARIABLES] {
        let mut y = [0.0; MOST_VARIABLES];
        for i in 0..z.len() {
            y[i] = (z[i] - self.center[i]) / self.half[i];
        }
        y
    }

    /// The inverse: coordinates of a place in its own variables.
    fn coordinates(&self, y: &[f64]) -> Vec<f64> {
        (self.center.iter().zip(&self.half).zip(y))
            .map(|((center, half), y)| center + half * y)
            .collect()
    }

    /// Whether a place in its own variables lies within the extent of its points, and outside the
    /// shadow of a guard.
    fn supports(&self, directions: &[Vec<f64>], y: &[f64]) -> bool {
        (self.clearance.is_empty() || quadratic(&self.clearance, y) >= 0.0)
            && self.encloses(directions, y)
    }

    /// All coefficients of the polynomial of the guards' margins: 1 where it has none.
    pub fn margins(&self, count: usize) -> Vec<f64> {
        let mut all = self.clearance.clone();
        if all.is_empty() && count > 0 {
            all.push(1.0);
        }
        all.resize(count, 0.0);
        all
    }

    fn encloses(&self, directions: &[Vec<f64>], y: &[f64]) -> bool {
        (self.support.iter().zip(directions)).all(|([lo, hi], d)| {
            let at: f64 = d.iter().zip(y).map(|(d, y)| d * y).sum();
            at >= *lo && at <= *hi
        })
    }

    /// V and its gradient (in coordinates of the region) at a place in its own variables.
    fn value(&self, terms: &Terms, y: &[f64]) -> (f64, [f64; MOST_VARIABLES]) {
        let mut q = [0.0; MOST_VARIABLES];
        let (v, slope) = self.shape.back(terms.sum(&self.coefficients, y, &mut q));
        for i in 0..y.len() {
            q[i] *= slope / self.half[i];
        }
        (v, q)
    }
}

/// Coefficients of a polynomial of the second degree in so many variables, that of the guards'
/// margins.
pub fn margin_terms(variables: usize) -> usize {
    (variables + 1) * (variables + 2) / 2
}

/// A polynomial of up to the second degree, of whose coefficients those of no higher degree may be
/// left out.
fn quadratic(c: &[f64], y: &[f64]) -> f64 {
    let n = y.len();
    let (linear, mut squares) = (&c[1..=n], c[n + 1..].iter());
    let mut sum = c[0];
    for i in 0..n {
        let bent: f64 = y[i..]
            .iter()
            .zip(squares.by_ref())
            .map(|(y, c)| c * y)
            .sum();
        sum += y[i] * (linear[i] + bent);
    }
    sum
}

/// Directions along which points are enclosed: the axes and those between two of them; of two
/// variables more.
pub fn directions(n: usize) -> Vec<Vec<f64>> {
    if n == 2 {
        return (0..8)
            .map(|k| {
                let angle = std::f64::consts::PI * f64::from(k) / 8.0;
                vec![angle.cos(), angle.sin()]
            })
            .collect();
    }
    let mut all = Vec::new();
    for i in 0..n {
        for (j, sign) in (i..n).flat_map(|j| [(j, 1.0), (j, -1.0)]) {
            let mut d = vec![0.0; n];
            d[i] = 1.0;
            if i != j {
                d[j] = sign;
            } else if sign < 0.0 {
                continue;
            }
            all.push(d);
        }
    }
    all
}

/// A cell, in coordinates of the frame; several pieces are several sheets.
#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    pub lo: Vec<f64>,
    pub hi: Vec<f64>,
    pub pieces: std::ops::Range<usize>,
}

#[derive(Clone, Debug, PartialEq)]
pub enum Node {
    Cell(usize),
    Split {
        axis: usize,
        at: f64,
        below: usize,
        above: usize,
        /// Lowest coordinate to which cells above reach, and highest to which cells below do.
        reach: [f64; 2],
    },
}

/// The whole.
#[derive(Clone, Debug)]
pub struct Pieces {
    pub region: Region,
    pub frame: Frame,
    pub terms: Terms,
    /// Along which supports are given.
    pub directions: Vec<Vec<f64>>,
    /// The first is the root.
    pub nodes: Vec<Node>,
    pub cells: Vec<Cell>,
    pub pieces: Vec<Piece>,
}

/// What pieces say of a state.
#[derive(Clone, Debug, PartialEq)]
pub struct Said {
    pub v: f64,
    pub p: Vec<f64>,
    /// Bound of V's error, and of each component of p.
    pub v_bound: f64,
    pub p_bound: Vec<f64>,
    pub sheet: i32,
    /// Pieces that were blended.
    pub pieces: usize,
}

/// V, its gradient (in coordinates of the region) and their bounds at a place.
pub(super) struct PieceValue {
    v: f64,
    q: [f64; MOST_VARIABLES],
    v_bound: f64,
    p_bound: [f64; MOST_VARIABLES],
    sheet: i32,
}

impl Pieces {
    /// From their parts; `None` where a piece's number of coefficients is that of no degree.
    pub fn new(
        region: Region,
        frame: Frame,
        nodes: Vec<Node>,
        cells: Vec<Cell>,
        pieces: Vec<Piece>,
    ) -> Option<Self> {
        let n = region.lo.len();
        if n == 0 || n > MOST_VARIABLES {
            return None;
        }
        let all = Terms::new(n, highest_degree(n));
        if !pieces
            .iter()
            .all(|p| all.upto.contains(&p.coefficients.len()))
        {
            return None;
        }
        let mut this = Self {
            region,
            frame,
            terms: all,
            directions: directions(n),
            nodes,
            cells,
            pieces,
        };
        this.finish();
        Some(this)
    }

    /// Fills in how far cells reach, and raises bounds that are below the rounding of the sums.
    fn finish(&mut self) {
        if !self.nodes.is_empty() {
            self.extent(0);
        }
        self.raise_to_rounding();
    }

    /// Lowest and highest coordinates to which the cells below a node reach.
    fn extent(&mut self, node: usize) -> Vec<[f64; 2]> {
        match self.nodes[node] {
            Node::Cell(cell) => {
                let Cell { lo, hi, .. } = &self.cells[cell];
                (lo.iter().zip(hi))
                    .map(|(lo, hi)| {
                        let more = 0.5 * BLEND * (hi - lo);
                        [lo - more, hi + more]
                    })
                    .collect()
            }
            Node::Split {
                axis,
                at,
                below,
                above,
                ..
            } => {
                let (a, b) = (self.extent(below), self.extent(above));
                self.nodes[node] = Node::Split {
                    axis,
                    at,
                    below,
                    above,
                    reach: [b[axis][0], a[axis][1]],
                };
                (a.iter().zip(&b))
                    .map(|(a, b)| [a[0].min(b[0]), a[1].max(b[1])])
                    .collect()
            }
        }
    }

    /// Numbers the sheets. Pieces belong to one where they agree across the face between their
    /// cells, the best agreement first, unless the sheet would then lie over a cell twice. The one
    /// with the least V is 0.
    fn label(&mut self) {
        /// Off a face, in widths of the cell.
        const OFF: f64 = 1e-9;
        let n = self.states();
        let mut contacts: Vec<(f64, usize, usize)> = Vec::new();
        for (own, cell) in self.cells.iter().enumerate() {
            for axis in 0..n {
                let mut z: Vec<f64> = cell
                    .lo
                    .iter()
                    .zip(&cell.hi)
                    .map(|(lo, hi)| 0.5 * (lo + hi))
                    .collect();
                z[axis] = cell.hi[axis] + OFF * (cell.hi[axis] - cell.lo[axis]);
                if z[axis] >= 1.0 {
                    continue;
                }
                let beside = self.cells[self.cell(&z)].pieces.clone();
                for a in self.cells[own].pieces.clone() {
                    for b in beside.clone() {
                        let misfit = self
                            .misfit(a, b, &z)
                            .filter(|misfit| *misfit <= SHEET_MISFIT);
                        contacts.extend(misfit.map(|misfit| (misfit, a, b)));
                    }
                }
            }
        }
        contacts.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        let mut sheets = Groups::new(self.pieces.len());
        // Cells with several pieces, of each sheet.
        let mut shared: Vec<Vec<usize>> = vec![Vec::new(); self.pieces.len()];
        for (k, cell) in self
            .cells
            .iter()
            .enumerate()
            .filter(|(_, c)| c.pieces.len() > 1)
        {
            for piece in cell.pieces.clone() {
                shared[piece].push(k);
            }
        }
        for (_, a, b) in contacts {
            let (a, b) = (sheets.root(a), sheets.root(b));
            if a == b || shared[a].iter().any(|cell| shared[b].contains(cell)) {
                continue;
            }
            sheets.join(a, b);
            let joined = [
                std::mem::take(&mut shared[a]),
                std::mem::take(&mut shared[b]),
            ]
            .concat();
            shared[sheets.root(a)] = joined;
        }
        let mut least: BTreeMap<usize, f64> = BTreeMap::new();
        for k in 0..self.pieces.len() {
            let v = self
                .told(k, &self.pieces[k].center)
                .map_or(f64::INFINITY, |told| told.v);
            let sheet = least.entry(sheets.root(k)).or_insert(f64::INFINITY);
            *sheet = v.min(*sheet);
        }
        let mut order: Vec<(f64, usize)> = least.into_iter().map(|(root, v)| (v, root)).collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let numbers: BTreeMap<usize, i32> = (order.into_iter().zip(0..))
            .map(|((_, root), k)| (root, k))
            .collect();
        for k in 0..self.pieces.len() {
            self.pieces[k].sheet = numbers[&sheets.root(k)];
        }
    }

    /// How far two pieces are from saying the same of p at a place, relative to p, beyond their
    /// bounds.
    fn misfit(&self, a: usize, b: usize, z: &[f64]) -> Option<f64> {
        let n = z.len();
        let (a, b) = (self.told(a, z)?, self.told(b, z)?);
        let size = |q: &[f64]| q.iter().fold(0.0f64, |m, x| m.max(x.abs()));
        let off: Vec<f64> = (0..n).map(|i| a.q[i] - b.q[i]).collect();
        let bounds = size(&a.p_bound[..n]) + size(&b.p_bound[..n]);
        let largest = size(&a.q[..n]).max(size(&b.q[..n]));
        let misfit = (size(&off) - bounds).max(0.0) / largest.max(f64::MIN_POSITIVE);
        misfit.is_finite().then_some(misfit)
    }

    /// Without the pieces whose bounds are above `most`, relative to the larger one of V and the
    /// floor. A cell of several sheets says nothing if one of them is: it might be the lowest.
    pub fn within(mut self, most: f64) -> Self {
        let mut all: Vec<Option<Piece>> = self.pieces.drain(..).map(Some).collect();
        for cell in &mut self.cells {
            let own = &mut all[cell.pieces.clone()];
            let first = self.pieces.len();
            if own.iter().flatten().all(|piece| piece.bound <= most) {
                self.pieces.extend(own.iter_mut().filter_map(Option::take));
            }
            cell.pieces = first..self.pieces.len();
        }
        self
    }

    /// Raises the bounds of the pieces at a state to the error that V shows of them there.
    pub fn admit(&mut self, x: &[f64], v: f64) {
        let off = self.at(x).filter(|said| (said.v - v).abs() > said.v_bound);
        if let Some(said) = off {
            let mut z = vec![0.0; x.len()];
            self.frame.of(x, &mut z);
            self.raise(
                self.cell(&z),
                (said.v - v).abs() / said.v.abs().max(self.region.floor),
            );
        }
    }

    pub fn states(&self) -> usize {
        self.region.lo.len()
    }

    /// Coefficients of the guards' margins in a piece; none where no piece has any.
    pub fn margin_terms(&self) -> usize {
        match self.pieces.iter().any(|p| !p.clearance.is_empty()) {
            true => margin_terms(self.states()),
            false => 0,
        }
    }

    /// Whether a state (absolute) lies in the region.
    pub fn covers(&self, x: &[f64]) -> bool {
        self.region.covers(x)
    }

    /// V on the lowest sheet at a state (absolute); `None` outside the region and where nothing is
    /// known.
    pub fn at(&self, x: &[f64]) -> Option<Said> {
        self.sheets(x).into_iter().next()
    }

    /// All sheets at a state, by rising V.
    pub fn sheets(&self, x: &[f64]) -> Vec<Said> {
        if !self.covers(x) {
            return Vec::new();
        }
        let n = self.states();
        let mut z = [0.0; MOST_VARIABLES];
        self.frame.of(x, &mut z[..n]);
        let z = &z[..n];
        let mut own: Vec<PieceValue> = (self.cells[self.cell(z)].pieces.clone())
            .filter_map(|k| self.told(k, z))
            .collect();
        own.sort_by(|a, b| a.v.total_cmp(&b.v));
        own.retain(|told| told.v <= self.region.value_max);
        let sole = self.cells[self.cell(z)].pieces.len() == 1;
        (0..own.len())
            .map(|k| self.blended(z, &own[k], sole))
            .collect()
    }

    /// The cell in which a place lies.
    pub(super) fn cell(&self, z: &[f64]) -> usize {
        let mut node = 0;
        loop {
            match self.nodes[node] {
                Node::Cell(cell) => return cell,
                Node::Split {
                    axis,
                    at,
                    below,
                    above,
                    ..
                } => node = if z[axis] < at { below } else { above },
            }
        }
    }

    /// What a piece says; `None` outside its points.
    fn told(&self, piece: usize, z: &[f64]) -> Option<PieceValue> {
        let n = z.len();
        let piece = &self.pieces[piece];
        let y = piece.place(z);
        if !piece.supports(&self.directions, &y[..n]) {
            return None;
        }
        let (v, q) = piece.value(&self.terms, &y[..n]);
        let size = v.abs().max(self.region.floor);
        let mut p_bound = [0.0; MOST_VARIABLES];
        for i in 0..n {
            p_bound[i] = piece.p_bound * size / piece.half[i];
        }
        v.is_finite().then_some(PieceValue {
            v,
            q,
            v_bound: piece.bound * size,
            p_bound,
            sheet: piece.sheet,
        })
    }

    /// One sheet's blend at a place; `sole`: its cell has no other piece.
    fn blended(&self, z: &[f64], first: &PieceValue, sole: bool) -> Said {
        let n = z.len();
        let (mut total, mut slope) = (0.0, [0.0; MOST_VARIABLES]);
        let (mut v, mut q) = (0.0, [0.0; MOST_VARIABLES]);
        let (mut v_bound, mut p_bound) = (first.v_bound, first.p_bound);
        let mut pieces = 0;
        let mut add = |told: &PieceValue, w: f64, dw: &[f64; MOST_VARIABLES]| {
            total += w;
            // Around the first: the differences are small.
            v += w * (told.v - first.v);
            for i in 0..n {
                slope[i] += dw[i];
                q[i] += w * (told.q[i] - first.q[i]) + dw[i] * (told.v - first.v);
            }
            v_bound = v_bound.max(told.v_bound);
            for i in 0..n {
                p_bound[i] = told.p_bound[i].max(p_bound[i]);
            }
            pieces += 1;
        };
        self.around(0, z, &mut |cell| {
            let Some((w, dw)) = weight(&self.cells[cell], z) else {
                return;
            };
            let here = self.cells[cell].lo.iter().zip(&self.cells[cell].hi).zip(z);
            if here.into_iter().all(|((lo, hi), z)| z >= lo && z < hi) {
                add(first, w, &dw);
                return;
            }
            // The piece of the same sheet, if the neighbour has one.
            let mut best: Option<PieceValue> = None;
            for k in self.cells[cell].pieces.clone() {
                let Some(told) = self.told(k, z) else {
                    continue;
                };
                if best
                    .as_ref()
                    .is_none_or(|b| (told.v - first.v).abs() < (b.v - first.v).abs())
                {
                    best = Some(told);
                }
            }
            let Some(told) = best else { return };
            let alone = sole && self.cells[cell].pieces.len() == 1;
            if alone || (told.v - first.v).abs() <= SAME * (told.v_bound + first.v_bound) {
                add(&told, w, &dw);
            }
        });
        if total <= 0.0 {
            (total, v) = (1.0, 0.0);
        }
        let blend = v / total;
        for i in 0..n {
            q[i] = first.q[i] + (q[i] - blend * slope[i]) / total;
        }
        let (mut p, mut bound) = (vec![0.0; n], vec![0.0; n]);
        self.frame.gradient(z, &q[..n], &mut p);
        self.frame.gradient_bound(z, &p_bound[..n], &mut bound);
        Said {
            v: first.v + blend,
            p,
            v_bound,
            p_bound: bound,
            sheet: first.sheet,
            pieces: pieces.max(1),
        }
    }

    /// `d2V/dx2` of the lowest sheet (row-major), by differences of p; NaN where nothing is known.
    pub fn hessian(&self, x: &[f64]) -> Vec<f64> {
        /// Of the region's width: p is as smooth as its pieces.
        const STEP: f64 = 1e-5;
        let n = x.len();
        let mut hessian = vec![f64::NAN; n * n];
        for j in 0..n {
            let step = STEP * self.region.width(j);
            let at = |sign: f64| {
                let mut x = x.to_vec();
                x[j] = (x[j] + sign * step).clamp(self.region.lo[j], self.region.hi[j]);
                self.at(&x).map(|said| (x[j], said.p))
            };
            if let (Some((a, pa)), Some((b, pb))) = (at(-1.0), at(1.0)) {
                for i in 0..n {
                    hessian[i * n + j] = (pb[i] - pa[i]) / (b - a);
                }
            }
        }
        hessian
    }

    /// Cells that reach over a place.
    fn around(&self, node: usize, z: &[f64], found: &mut impl FnMut(usize)) {
        match &self.nodes[node] {
            Node::Cell(cell) => found(*cell),
            Node::Split {
                axis,
                below,
                above,
                reach,
                ..
            } => {
                if z[*axis] < reach[1] {
                    self.around(*below, z, found);
                }
                if z[*axis] > reach[0] {
                    self.around(*above, z, found);
                }
            }
        }
    }
}

/// Weight of a cell at a place, before they are made to sum to one, and its gradient; `None` where
/// it is 0.
fn weight(cell: &Cell, z: &[f64]) -> Option<(f64, [f64; MOST_VARIABLES])> {
    let n = z.len();
    let (mut factors, mut slopes) = ([1.0; MOST_VARIABLES], [0.0; MOST_VARIABLES]);
    for i in 0..n {
        let half = 0.5 * (cell.hi[i] - cell.lo[i]);
        let offset = (z[i] - 0.5 * (cell.lo[i] + cell.hi[i])) / half;
        // From 1 at the inner edge of the overlap to 0 at the outer one, with two continuous
        // derivatives.
        let t = (offset.abs() - (1.0 - BLEND)) / (2.0 * BLEND);
        if t >= 1.0 {
            return None;
        }
        if t > 0.0 {
            factors[i] = 1.0 - t * t * t * (10.0 - 15.0 * t + 6.0 * t * t);
            slopes[i] =
                -30.0 * t * t * (1.0 - t) * (1.0 - t) * offset.signum() / (2.0 * BLEND * half);
        }
    }
    let w: f64 = factors[..n].iter().product();
    let mut dw = [0.0; MOST_VARIABLES];
    for i in (0..n).filter(|i| slopes[*i] != 0.0) {
        dw[i] = slopes[i]
            * (0..n)
                .filter(|k| *k != i)
                .map(|k| factors[k])
                .product::<f64>();
    }
    Some((w, dw))
}
