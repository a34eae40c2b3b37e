//! A map in pieces as flat arrays, for many states: what [`Pieces::at`] says, in f64 or f32,
//! without allocation.
//!
//! A batch of states is looked up first, which gives a list of pieces with a place in each; their
//! polynomials are summed in lanes, several pieces at once; then what they say is blended. What is
//! said of a state does not depend on the others.

mod bend;
mod blend;
#[cfg(feature = "gpu")]
mod packed;

use super::jets::{Jet, MOST_SECOND, Sum, Tables};
use super::{Cell, MOST_VARIABLES, Node, Piece, Pieces, Shape};
use crate::backend::cpu::lanes::Lanes;
use crate::backend::cpu::real::Real;
use bend::{Place, Shear};
use blend::{PieceValue, Share};

/// Polynomials summed at once: two vectors of f64 on AVX2.
pub const LANES: usize = 8;
/// States looked up before their polynomials are summed.
const BATCH: usize = 64;
/// Marks a piece that is said something of everywhere.
const EVERYWHERE: u32 = u32::MAX;

#[derive(Clone, Copy, Debug)]
struct Branch<T> {
    at: T,
    reach: [T; 2],
    /// Node numbers; a cell's number twice where it is no split.
    below: u32,
    above: u32,
    /// The number of states marks a cell.
    axis: u32,
}

#[derive(Clone, Copy, Debug)]
struct Head<T> {
    bound: T,
    p_bound: T,
    coefficients: u32,
    terms: u16,
    degree: u8,
    shape: Shape,
    sheet: i32,
    /// Where its supports begin.
    support: u32,
}

/// The map; see the module's text.
#[derive(Clone, Debug)]
pub struct Flat<T> {
    states: usize,
    tables: Tables,
    lo: Vec<T>,
    hi: Vec<T>,
    floor: T,
    value_max: T,
    origin: Vec<T>,
    /// `[coordinate][state]`.
    matrix: Vec<T>,
    shear: Option<Shear<T>>,
    directions: Vec<T>,
    nodes: Vec<Branch<T>>,
    /// `[cell][center, half][coordinate]`.
    cells: Vec<T>,
    /// First piece of each cell, and the end.
    owned: Vec<u32>,
    heads: Vec<Head<T>>,
    /// `[piece][center, half][coordinate]`.
    places: Vec<T>,
    /// Of divided powers, one piece after the other.
    coefficients: Vec<T>,
    /// Of a piece lowest and highest extent along each direction, and the polynomial of the guards'
    /// margins if any has one.
    supports: Vec<T>,
    /// Coefficients of these polynomials.
    margins: usize,
}

/// What is said of a state.
#[derive(Clone, Copy, Debug)]
pub struct Here<T> {
    pub v: T,
    pub p: [T; MOST_VARIABLES],
    /// `[state][state]` with the number of states as the stride; only where asked for.
    pub hessian: [T; MOST_VARIABLES * MOST_VARIABLES],
    pub v_bound: T,
    pub p_bound: [T; MOST_VARIABLES],
    pub sheet: i32,
    /// Pieces that were blended; 0 of the local solution.
    pub pieces: u32,
    /// Sheets over the state.
    pub sheets: u32,
}

impl<T: Real> Here<T> {
    pub fn blank() -> Self {
        let zero = T::of(0.0);
        Self {
            v: zero,
            p: [zero; MOST_VARIABLES],
            hessian: [zero; MOST_VARIABLES * MOST_VARIABLES],
            v_bound: zero,
            p_bound: [zero; MOST_VARIABLES],
            sheet: -1,
            pieces: 0,
            sheets: 0,
        }
    }

    /// Sets both halves of the second derivatives by a triangle `i <= j`, row by row.
    #[inline(always)]
    pub(crate) fn bent(&mut self, n: usize, triangle: impl Fn(usize) -> T) {
        let mut pair = 0;
        for i in 0..n {
            for j in i..n {
                self.hessian[i * n + j] = triangle(pair);
                self.hessian[j * n + i] = triangle(pair);
                pair += 1;
            }
        }
    }
}

/// A piece to be summed at a place in its own variables.
#[derive(Clone, Copy)]
struct Task<T> {
    piece: u32,
    y: [T; MOST_VARIABLES],
}

/// Room to work in; it does not grow any more after the first batches.
pub struct Desk<T> {
    tasks: Vec<Task<T>>,
    told: Vec<PieceValue<T>>,
    shares: Vec<Share<T>>,
    /// Of each state of a batch its first share, and its coordinates.
    first: Vec<u32>,
    places: Vec<Place<T>>,
    stack: Vec<(u32, bool)>,
    coefficients: Vec<Lanes<T, LANES>>,
    monomials: Vec<Lanes<T, LANES>>,
}

impl<T: Real> Desk<T> {
    pub fn new() -> Self {
        Self {
            tasks: Vec::new(),
            told: Vec::new(),
            shares: Vec::new(),
            first: Vec::new(),
            places: Vec::new(),
            stack: Vec::new(),
            coefficients: Vec::new(),
            monomials: Vec::new(),
        }
    }
}

impl<T: Real> Default for Desk<T> {
    fn default() -> Self {
        Self::new()
    }
}

impl<T: Real> Branch<T> {
    /// A node of a tree over n coordinates.
    fn of(node: &Node, n: usize) -> Self {
        match *node {
            Node::Cell(cell) => Self {
                at: T::of(0.0),
                reach: [T::of(0.0); 2],
                below: cell as u32,
                above: cell as u32,
                axis: n as u32,
            },
            Node::Split {
                axis,
                at,
                below,
                above,
                reach,
            } => Self {
                at: T::of(at),
                reach: reach.map(T::of),
                below: below as u32,
                above: above as u32,
                axis: axis as u32,
            },
        }
    }
}

impl<T: Real> Flat<T> {
    /// The arrays of a map.
    pub fn new(pieces: &Pieces) -> Self {
        let n = pieces.states();
        let tables = Tables::new(&pieces.terms);
        let all = |values: &[f64]| -> Vec<T> { values.iter().map(|v| T::of(*v)).collect() };
        let mut this = Self {
            states: n,
            lo: all(&pieces.region.lo),
            hi: all(&pieces.region.hi),
            floor: T::of(pieces.region.floor),
            value_max: T::of(pieces.region.value_max),
            origin: all(&pieces.frame.origin),
            matrix: all(&pieces.frame.matrix),
            shear: pieces.frame.bend.as_ref().map(Shear::new),
            directions: all(&pieces.directions.concat()),
            nodes: Vec::with_capacity(pieces.nodes.len()),
            cells: Vec::with_capacity(pieces.cells.len() * 2 * n),
            owned: Vec::with_capacity(pieces.cells.len() + 1),
            heads: Vec::with_capacity(pieces.pieces.len()),
            places: Vec::with_capacity(pieces.pieces.len() * 2 * n),
            coefficients: Vec::new(),
            supports: Vec::new(),
            margins: pieces.margin_terms(),
            tables,
        };
        let nodes = pieces.nodes.iter().map(|node| Branch::of(node, n));
        this.nodes.extend(nodes);
        for cell in &pieces.cells {
            this.put_cell(cell);
            for piece in &pieces.pieces[cell.pieces.clone()] {
                this.put_piece(piece);
            }
        }
        this.owned.push(this.heads.len() as u32);
        this
    }

    /// Adds a cell, whose pieces are to follow.
    fn put_cell(&mut self, Cell { lo, hi, .. }: &Cell) {
        let both = || lo.iter().zip(hi);
        self.cells
            .extend(both().map(|(lo, hi)| T::of(0.5 * (lo + hi))));
        self.cells
            .extend(both().map(|(lo, hi)| T::of(0.5 * (hi - lo))));
        self.owned.push(self.heads.len() as u32);
    }

    /// Adds a piece to the last cell.
    fn put_piece(&mut self, piece: &Piece) {
        let terms = piece.coefficients.len();
        let degree = self.tables.upto.iter().position(|k| *k == terms);
        self.heads.push(Head {
            bound: T::of(piece.bound),
            p_bound: T::of(piece.p_bound),
            coefficients: self.coefficients.len() as u32,
            terms: terms as u16,
            degree: degree.unwrap_or(0) as u8,
            shape: piece.shape,
            sheet: piece.sheet,
            support: match piece.support.is_empty() {
                true => EVERYWHERE,
                false => self.supports.len() as u32,
            },
        });
        let place = piece.center.iter().chain(&piece.half);
        self.places.extend(place.map(|v| T::of(*v)));
        let scaled = piece.coefficients.iter().zip(&self.tables.scale);
        self.coefficients.extend(scaled.map(|(c, s)| T::of(c * s)));
        self.supports
            .extend(piece.support.iter().flatten().map(|s| T::of(*s)));
        if !piece.support.is_empty() {
            self.supports
                .extend(piece.margins(self.margins).into_iter().map(T::of));
        }
    }

    pub fn states(&self) -> usize {
        self.states
    }

    /// Whether a state lies in the region.
    pub fn covers(&self, x: &[T]) -> bool {
        x.iter()
            .zip(self.lo.iter().zip(&self.hi))
            .all(|(x, (lo, hi))| x >= lo && x <= hi)
    }

    /// V and the rest on the lowest sheet at states `[state][component]`, told one after the other
    /// with their numbers; `None` outside the region and where nothing is known. Second derivatives
    /// only where asked for.
    #[inline(always)]
    pub fn each<const FMA: bool>(
        &self,
        x: &[T],
        second: bool,
        desk: &mut Desk<T>,
        mut tell: impl FnMut(usize, Option<&Here<T>>),
    ) {
        let n = self.states;
        let mut here = Here::blank();
        let most = *self.tables.upto.last().unwrap_or(&1);
        let of_shear = self.shear.as_ref().map_or(0, Shear::terms);
        desk.coefficients.resize(most, Lanes::splat(T::of(0.0)));
        desk.monomials
            .resize(most.max(of_shear), Lanes::splat(T::of(0.0)));
        for (batch, x) in x.chunks(BATCH * n).enumerate() {
            desk.tasks.clear();
            desk.shares.clear();
            desk.first.clear();
            desk.places.clear();
            self.place::<FMA>(x, second, desk);
            for (k, x) in x.chunks_exact(n).enumerate() {
                desk.first.push(desk.shares.len() as u32);
                if self.covers(x) {
                    let z = desk.places[k].z;
                    self.look_up(&z, desk);
                }
            }
            desk.first.push(desk.shares.len() as u32);
            self.sum::<FMA>(second, desk);
            for k in 0..x.len() / n {
                let shares = &desk.shares[desk.first[k] as usize..desk.first[k + 1] as usize];
                let known = self.blend(&desk.places[k], shares, &desk.told, second, &mut here);
                tell(batch * BATCH + k, known.then_some(&here));
            }
        }
    }

    /// Coordinates of states in the frame.
    #[inline(always)]
    fn place<const FMA: bool>(&self, x: &[T], second: bool, desk: &mut Desk<T>) {
        let n = self.states;
        for x in x.chunks_exact(n) {
            let mut place = Place::zero();
            for (z, row) in place.z.iter_mut().zip(self.matrix.chunks_exact(n)) {
                for j in 0..n {
                    *z = *z + row[j] * (x[j] - self.origin[j]);
                }
            }
            desk.places.push(place);
        }
        if let Some(shear) = &self.shear {
            shear.bend::<FMA>(n, second, &mut desk.monomials, &mut desk.places);
        }
    }

    /// Lists the cells that reach over a place, and their pieces.
    #[inline(always)]
    fn look_up(&self, z: &[T; MOST_VARIABLES], desk: &mut Desk<T>) {
        let n = self.states;
        desk.stack.clear();
        desk.stack.push((0, true));
        while let Some((at, own)) = desk.stack.pop() {
            let node = &self.nodes[at as usize];
            if node.axis as usize == n {
                self.share(node.below as usize, own, &z[..n], desk);
                continue;
            }
            let z = z[node.axis as usize];
            let is_below = z < node.at;
            // The one below is looked at first.
            if z > node.reach[0] {
                desk.stack.push((node.above, own && !is_below));
            }
            if z < node.reach[1] {
                desk.stack.push((node.below, own && is_below));
            }
        }
    }

    #[inline(always)]
    fn share(&self, cell: usize, own: bool, z: &[T], desk: &mut Desk<T>) {
        let n = z.len();
        let Some(weight) = self.weight(cell, z) else {
            return;
        };
        let (first, end) = (self.owned[cell], self.owned[cell + 1]);
        let from = desk.tasks.len() as u32;
        for piece in first..end {
            let place = &self.places[piece as usize * 2 * n..][..2 * n];
            let mut y = [T::of(0.0); MOST_VARIABLES];
            for i in 0..n {
                y[i] = (z[i] - place[i]) / place[n + i];
            }
            let support = self.heads[piece as usize].support;
            if support == EVERYWHERE || self.encloses(support as usize, &y[..n]) {
                desk.tasks.push(Task { piece, y });
            }
        }
        desk.shares.push(Share {
            own,
            sole: end - first == 1,
            from,
            to: desk.tasks.len() as u32,
            weight,
        });
    }

    /// Whether a place lies within a piece's points, and outside the shadow of a guard.
    fn encloses(&self, support: usize, y: &[T]) -> bool {
        let n = y.len();
        let zero = T::of(0.0);
        let ways = self.directions.chunks_exact(n);
        let (extents, rest) = self.supports[support..].split_at(2 * ways.len());
        let enclosed = extents.chunks_exact(2).zip(ways).all(|(extent, d)| {
            let mut at = zero;
            for i in 0..n {
                at = at + d[i] * y[i];
            }
            at >= extent[0] && at <= extent[1]
        });
        if !enclosed || self.margins == 0 {
            return enclosed;
        }
        let (mut margin, mut square) = (rest[0], n);
        for i in 0..n {
            let mut slope = rest[1 + i];
            for y in &y[i..] {
                square += 1;
                slope = slope + rest[square] * *y;
            }
            margin = margin + y[i] * slope;
        }
        margin >= zero
    }

    /// Sums the polynomials of all tasks.
    #[inline(always)]
    fn sum<const FMA: bool>(&self, second: bool, desk: &mut Desk<T>) {
        let n = self.states;
        let zero = Lanes::splat(T::of(0.0));
        desk.told.clear();
        let mut jet = Jet::zero();
        for tasks in desk.tasks.chunks(LANES) {
            let mut y = [zero; MOST_VARIABLES];
            let heads: [&Head<T>; LANES] =
                std::array::from_fn(|l| &self.heads[tasks[l.min(tasks.len() - 1)].piece as usize]);
            let degree = heads.iter().map(|h| h.degree).max().map_or(0, usize::from);
            for (l, task) in tasks.iter().enumerate() {
                for i in 0..n {
                    y[i].0[l] = task.y[i];
                }
            }
            let count = self.tables.upto[degree];
            if heads.iter().all(|h| usize::from(h.terms) == count) {
                let own: [&[T]; LANES] =
                    heads.map(|h| &self.coefficients[h.coefficients as usize..][..count]);
                for t in 0..count {
                    for l in 0..LANES {
                        desk.coefficients[t].0[l] = own[l][t];
                    }
                }
            } else {
                // A polynomial of lower degree has zeros for the rest.
                desk.coefficients[..count].fill(zero);
                for (l, head) in heads.iter().enumerate() {
                    let own =
                        &self.coefficients[head.coefficients as usize..][..usize::from(head.terms)];
                    for (to, c) in desk.coefficients.iter_mut().zip(own) {
                        to.0[l] = *c;
                    }
                }
            }
            Sum {
                tables: &self.tables,
                degree,
                coefficients: &desk.coefficients,
                monomials: &mut desk.monomials,
            }
            .at::<FMA>(n, &y, second, &mut jet);
            for (l, task) in tasks.iter().enumerate() {
                desk.told.push(self.told(task, heads[l], &jet, l, second));
            }
        }
    }

    /// What a piece says of V, from its polynomial.
    #[inline(always)]
    fn told(
        &self,
        task: &Task<T>,
        head: &Head<T>,
        jet: &Jet<T, LANES>,
        l: usize,
        second: bool,
    ) -> PieceValue<T> {
        let n = self.states;
        let half = &self.places[task.piece as usize * 2 * n + n..][..n];
        let (v, slope, bend) = back(head.shape, jet.v.0[l]);
        let size = v.absolute();
        let size = if size > self.floor { size } else { self.floor };
        let mut told = PieceValue {
            v,
            q: [T::of(0.0); MOST_VARIABLES],
            h: [T::of(0.0); MOST_SECOND],
            v_bound: head.bound * size,
            p_bound: [T::of(0.0); MOST_VARIABLES],
            sheet: head.sheet,
        };
        for i in 0..n {
            told.q[i] = jet.q[i].0[l] * (slope / half[i]);
            told.p_bound[i] = head.p_bound * size / half[i];
        }
        if second {
            let mut pair = 0;
            for i in 0..n {
                for j in i..n {
                    let bent = bend * jet.q[i].0[l] * jet.q[j].0[l];
                    told.h[pair] = (slope * jet.h[pair].0[l] + bent) / (half[i] * half[j]);
                    pair += 1;
                }
            }
        }
        told
    }
}

/// V and its first and second derivative by the function of it that is a polynomial; V is not a
/// number where no V has this value of the function.
#[inline(always)]
fn back<T: Real>(shape: Shape, w: T) -> (T, T, T) {
    let (zero, one, two) = (T::of(0.0), T::of(1.0), T::of(2.0));
    match shape {
        Shape::Value => (w, one, zero),
        Shape::Root if w < zero => (T::of(f64::NAN), zero, zero),
        Shape::Root => (w * w, two * w, two),
        Shape::Logarithm => {
            let v = T::of(w.f64().exp());
            (v, v, v)
        }
        Shape::Reciprocal if w <= zero => (T::of(f64::NAN), zero, zero),
        Shape::Reciprocal => {
            let v = one / w;
            (v, -(v * v), two * v * v * v)
        }
    }
}
