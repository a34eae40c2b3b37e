//! Pieces from scattered points: cells are halved until a polynomial says in each what points that it was not fitted to say.

use super::fit::{Data, Shape};
use super::terms::Terms;
use super::{BLEND, Cell, Frame, Node, Piece, Pieces, Region, directions, highest_degree};
use rayon::join;

/// Points as far outside a cell as this share of its half width are fitted too.
const FIT: f64 = 0.3;
/// Share of the error asked for at which a cell is not halved any more.
const ENOUGH: f64 = 0.6;
/// Equations a coefficient: fewer determine no polynomial.
const LEAST_EQUATIONS: f64 = 2.0;

/// The most equations a coefficient, by number of variables: where they cost little more of them leave fewer holes.
fn most_equations(variables: usize) -> f64 {
    match variables {
        1 | 2 => 12.0,
        3 => 8.0,
        _ => 4.0,
    }
}

/// One of this many tracks is left out of a first fit, to measure its error.
const LEFT_OUT: u32 = 4;
/// Share of the points that are fitted to.
const LEARNED: f64 = 1.0 - 1.0 / LEFT_OUT as f64;
/// Points that are left out at most; below how many all are left out in turn; points in a piece that tell its error.
const MOST_TESTS: usize = 300;
const MANY_TESTS: usize = 24;
const LEAST_TESTS: usize = 10;
/// Where a low degree errs by so many times what is asked, no high degree is tried before the block is halved.
const HOPELESS: f64 = 1000.0;
/// Of several functions of V those are tried whose errors at a low degree are within this factor of the least.
const NEARLY: f64 = 1.5;
/// Halvings of the region along one axis.
const MOST_HALVINGS: i32 = 14;
/// A corner of a cell is supported where a point lies within this many half widths.
const REACH: f64 = 1.25;
/// The same for a piece whose points lie all around.
const BESIDE: f64 = 0.8;
/// What points left out show is the largest of a sample; the bound allows for it.
const ALLOWANCE: f64 = 1.5;
/// Longest cells, in their own widths.
const SLIVER: f64 = 32.0;
/// Points a group of a sheet needs.
const LEAST_GROUP: usize = 6;
/// How far beyond their points pieces of several sheets in one cell say something, in half widths.
const BEYOND_OF_SEVERAL: f64 = 0.05;
/// Points of two sheets that are nearer to each other than this, in widths of the cell, show whether gradients jump; how many
/// pairs are looked at.
const NEAR_PAIR: f64 = 0.3;
const PAIRS: usize = 9;
/// Sheets in a cell.
const MOST_GROUPS: usize = 4;
/// Where a cell cannot be halved several sheets are taken for one whose error is this much larger.
const SEPARATE: f64 = 0.1;

/// What is known: V and its gradient at scattered points, in coordinates of a frame (0 to 1 over the region).
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
}

impl Cloud {
    pub fn len(&self) -> usize {
        self.v.len()
    }

    pub fn is_empty(&self) -> bool {
        self.v.is_empty()
    }

    pub fn z(&self, k: usize) -> &[f64] {
        &self.z[k * self.variables..][..self.variables]
    }

    pub fn q(&self, k: usize) -> &[f64] {
        &self.q[k * self.variables..][..self.variables]
    }
}

/// A cell in which more must be known.
#[derive(Clone, Debug)]
pub struct Want {
    pub lo: Vec<f64>,
    pub hi: Vec<f64>,
    /// Error over the one asked for.
    pub excess: f64,
    /// Places that no point is near to, `[place][variable]`.
    pub bare: Vec<f64>,
    /// Points in the cell and around it.
    pub points: Vec<u32>,
}

/// A box while it is looked at.
struct Block {
    lo: Vec<f64>,
    hi: Vec<f64>,
    /// Points in it and around it.
    points: Vec<u32>,
}

/// A fit with its errors, relative to V's size.
struct Fit {
    shape: Shape,
    coefficients: Vec<f64>,
    errors: [f64; 2],
}

struct Builder<'c> {
    cloud: &'c Cloud,
    terms: Terms,
    region: &'c Region,
    frame: &'c Frame,
    directions: Vec<Vec<f64>>,
    highest: usize,
    most_equations: f64,
    before: Option<Before<'c>>,
}

/// Built pieces of a block.
enum Grown {
    Cell(Vec<Piece>, Vec<f64>, Vec<f64>),
    Split(usize, f64, Box<(Grown, Grown)>),
}

/// Pieces made before, of the cloud's first points.
pub struct Before<'b> {
    pub pieces: &'b Pieces,
    pub points: usize,
}

/// Makes pieces of points; and cells where more points are needed for the error asked for. Cells made before whose pieces
/// are good enough stay, if they say what the new points say.
pub fn build(cloud: &Cloud, region: &Region, frame: &Frame, before: Option<Before<'_>>) -> (Pieces, Vec<Want>) {
    let n = cloud.variables;
    let highest = highest_degree(n);
    let builder = Builder {
        cloud,
        terms: Terms::new(n, highest),
        region,
        frame,
        directions: directions(n),
        highest,
        most_equations: most_equations(n),
        before,
    };
    let root = builder.before.as_ref().map(|_| 0);
    let whole = Block {
        lo: vec![0.0; n],
        hi: vec![1.0; n],
        points: (0..cloud.len() as u32).collect(),
    };
    let (grown, wants) = builder.grow(whole, root);
    let mut pieces = Pieces {
        region: region.clone(),
        frame: frame.clone(),
        terms: builder.terms,
        directions: builder.directions,
        nodes: Vec::new(),
        cells: Vec::new(),
        pieces: Vec::new(),
    };
    plant(&mut pieces, grown);
    pieces.finish();
    pieces.label();
    (pieces, wants)
}

/// Adds a block's cells and nodes; the number of its node.
fn plant(pieces: &mut Pieces, grown: Grown) -> usize {
    let here = pieces.nodes.len();
    match grown {
        Grown::Cell(own, lo, hi) => {
            let first = pieces.pieces.len();
            pieces.pieces.extend(own);
            pieces.nodes.push(Node::Cell(pieces.cells.len()));
            pieces.cells.push(Cell {
                lo,
                hi,
                pieces: first..pieces.pieces.len(),
            });
        }
        Grown::Split(axis, at, both) => {
            pieces.nodes.push(Node::Cell(0));
            let (below, above) = *both;
            let below = plant(pieces, below);
            let above = plant(pieces, above);
            pieces.nodes[here] = Node::Split {
                axis,
                at,
                below,
                above,
                reach: [at, at],
            };
        }
    }
    here
}

impl Builder<'_> {
    /// `old` is the node of the pieces made before that is this block's.
    fn grow(&self, block: Block, old: Option<usize>) -> (Grown, Vec<Want>) {
        if !self.frame.may_meet(self.region, &block.lo, &block.hi) {
            return (Grown::Cell(Vec::new(), block.lo, block.hi), Vec::new());
        }
        if let (Some(before), Some(old)) = (&self.before, old) {
            match before.pieces.nodes[old] {
                Node::Split {
                    axis, at, below, above, ..
                } => return self.split(block, axis, at, [Some(below), Some(above)]),
                Node::Cell(cell) => {
                    if let Some(kept) = self.kept(&block, before, cell) {
                        return kept;
                    }
                }
            }
        }
        let dense = self.is_dense(&block);
        let (own, excess) = self.fitted(&block, dense);
        let settled = excess <= ENOUGH;
        let axis = self.axis(&block, &own);
        let finest = block.hi[axis] - block.lo[axis] <= 0.5f64.powi(MOST_HALVINGS);
        if settled || !dense || finest {
            // Of several sheets none says anything much beyond its own points.
            let beyond = if own.len() > 1 {
                self.region.beyond.min(BEYOND_OF_SEVERAL)
            } else {
                self.region.beyond
            };
            let pieces = own
                .into_iter()
                .map(|(piece, points)| self.finished(piece, &points, &block, beyond))
                .collect();
            let wants = self.wants(&block, excess);
            return (Grown::Cell(pieces, block.lo, block.hi), wants);
        }
        let at = 0.5 * (block.lo[axis] + block.hi[axis]);
        self.split(block, axis, at, [None; 2])
    }

    /// The two halves of a block.
    fn split(&self, block: Block, axis: usize, at: f64, old: [Option<usize>; 2]) -> (Grown, Vec<Want>) {
        let n = self.cloud.variables;
        let half = |upper: bool| {
            let (mut lo, mut hi) = (block.lo.clone(), block.hi.clone());
            if upper {
                lo[axis] = at;
            } else {
                hi[axis] = at;
            }
            let margin = 0.5 * FIT * (hi[axis] - lo[axis]);
            let (from, to) = (lo[axis] - margin, hi[axis] + margin);
            // Along the other axes the parent's points are as near as they can be.
            let near = |k: &&u32| {
                let z = self.cloud.z[**k as usize * n + axis];
                (from..=to).contains(&z)
            };
            Block {
                points: block.points.iter().filter(near).copied().collect(),
                lo,
                hi,
            }
        };
        let (below, above) = (half(false), half(true));
        drop(block.points);
        let ((below, mut wants), (above, more)) = if below.points.len() + above.points.len() > 500 {
            join(|| self.grow(below, old[0]), || self.grow(above, old[1]))
        } else {
            (self.grow(below, old[0]), self.grow(above, old[1]))
        };
        wants.extend(more);
        (Grown::Split(axis, at, Box::new((below, above))), wants)
    }

    /// A cell made before, if it was good enough and new points do not say otherwise.
    fn kept(&self, block: &Block, before: &Before<'_>, cell: usize) -> Option<(Grown, Vec<Want>)> {
        let own = &before.pieces.pieces[before.pieces.cells[cell].pieces.clone()];
        let good = |p: &Piece| p.bound <= ENOUGH * self.region.error;
        if own.is_empty() || !own.iter().all(good) {
            return None;
        }
        let n = self.cloud.variables;
        let agrees = |k: usize| {
            let z = self.cloud.z(k);
            own.iter().any(|piece| {
                let y: Vec<f64> = (0..n).map(|i| (z[i] - piece.center[i]) / piece.half[i]).collect();
                let mut gradient = [0.0; super::MOST_VARIABLES];
                let (v, _) = piece.shape.back(self.terms.sum(&piece.coefficients, &y, &mut gradient));
                let size = self.cloud.v[k].abs().max(self.region.floor);
                // Outside the cell it is blended with others.
                y.iter().any(|y| y.abs() > 1.0) || (v - self.cloud.v[k]).abs() <= piece.bound * size
            })
        };
        let fresh = block.points.iter().map(|k| *k as usize).filter(|k| *k >= before.points);
        if !{ fresh }.all(agrees) {
            return None;
        }
        let excess = own.iter().map(|p| p.bound / self.region.error).fold(0.0, f64::max);
        let wants = self.wants(block, excess);
        let grown = Grown::Cell(own.to_vec(), block.lo.clone(), block.hi.clone());
        Some((grown, wants))
    }

    /// What is missing in a cell.
    fn wants(&self, block: &Block, excess: f64) -> Vec<Want> {
        let bare = self.bare_places(block);
        if excess <= 1.0 && bare.is_empty() {
            return Vec::new();
        }
        vec![Want {
            lo: block.lo.clone(),
            hi: block.hi.clone(),
            excess,
            bare,
            points: block.points.clone(),
        }]
    }

    /// Whether the halves of a block have points enough for polynomials of their own, of the highest degree.
    fn is_dense(&self, block: &Block) -> bool {
        let n = self.cloud.variables;
        let each = LEAST_EQUATIONS * self.terms.upto[self.highest] as f64 / (n + 1) as f64 / LEARNED;
        block.points.len() as f64 > 2.0 * each
    }

    /// The pieces of a block, one a sheet; with their largest error over the one asked for.
    fn fitted(&self, block: &Block, can_be_halved: bool) -> (Vec<(Piece, Vec<u32>)>, f64) {
        let all = self.of_group(block, &block.points, can_be_halved);
        if let Some((piece, excess)) = all {
            if excess <= ENOUGH {
                return (vec![(piece, block.points.clone())], excess);
            }
            for groups in self.groups(block) {
                let groups = self.sorted_out(block, groups);
                if groups.len() < 2 || !self.jumps(block, &groups) {
                    continue;
                }
                let each: Option<Vec<_>> = groups.iter().map(|g| self.of_group(block, g, can_be_halved)).collect();
                let Some(each) = each else { continue };
                let worst = each.iter().map(|(_, e)| *e).fold(0.0, f64::max);
                if !self.is_supported(block, &each, &groups) {
                    continue;
                }
                if worst <= ENOUGH || (worst < SEPARATE * excess && !can_be_halved) {
                    let pieces = each.into_iter().map(|(p, _)| p).zip(groups).collect();
                    return (pieces, worst);
                }
            }
            return (vec![(piece, block.points.clone())], excess);
        }
        (Vec::new(), f64::INFINITY)
    }

    /// Ways to part a block's points by sheets: by their labels, and by their gradients.
    fn groups(&self, block: &Block) -> Vec<Vec<Vec<u32>>> {
        let mut labels: Vec<i32> = block.points.iter().map(|k| self.cloud.sheet[*k as usize]).collect();
        labels.sort_unstable();
        labels.dedup();
        let labelled: Vec<Vec<u32>> = (labels.iter())
            .map(|l| {
                let of = |k: &&u32| self.cloud.sheet[**k as usize] == *l;
                block.points.iter().filter(of).copied().collect()
            })
            .filter(|g: &Vec<u32>| g.len() >= LEAST_GROUP)
            .collect();
        let mut ways = Vec::new();
        if (2..=MOST_GROUPS).contains(&labelled.len()) {
            ways.push(labelled);
        }
        ways.extend(self.parted(block));
        ways
    }

    /// Two groups of points by their gradients (two means).
    fn parted(&self, block: &Block) -> Option<Vec<Vec<u32>>> {
        let n = self.cloud.variables;
        let q = |k: u32| self.cloud.q(k as usize);
        let mean = |points: &[u32]| -> Vec<f64> {
            (0..n)
                .map(|i| points.iter().map(|k| q(*k)[i]).sum::<f64>() / points.len().max(1) as f64)
                .collect()
        };
        let far = |k: u32, from: &[f64]| -> f64 {
            (q(k).iter().zip(from).zip(block.hi.iter().zip(&block.lo)))
                .map(|((q, c), (hi, lo))| ((q - c) * (hi - lo)).powi(2))
                .sum()
        };
        // From the points furthest apart.
        let middle = mean(&block.points);
        let furthest = |from: &[f64]| {
            let all = block.points.iter().copied();
            all.max_by(|a, b| far(*a, from).total_cmp(&far(*b, from)))
        };
        let a = furthest(&middle)?;
        let b = furthest(q(a))?;
        let (mut one, mut other) = (q(a).to_vec(), q(b).to_vec());
        let mut groups = [Vec::new(), Vec::new()];
        for _ in 0..8 {
            let (first, second) = (block.points.iter().copied()).partition(|k| far(*k, &one) <= far(*k, &other));
            groups = [first, second];
            if groups.iter().any(|g: &Vec<u32>| g.len() < LEAST_GROUP) {
                return None;
            }
            one = mean(&groups[0]);
            other = mean(&groups[1]);
        }
        Some(groups.into())
    }

    /// Whether no sheet says that it is lower than another where it has no points of its own.
    fn is_supported(&self, block: &Block, each: &[(Piece, f64)], groups: &[Vec<u32>]) -> bool {
        let n = self.cloud.variables;
        let far = |k: u32, l: u32| -> f64 {
            let (a, b) = (self.cloud.z(k as usize), self.cloud.z(l as usize));
            (0..n)
                .map(|i| ((a[i] - b[i]) / (block.hi[i] - block.lo[i])).powi(2))
                .sum()
        };
        let inside = |k: &u32| {
            let z = self.cloud.z(*k as usize);
            (0..n).all(|i| z[i] >= block.lo[i] && z[i] <= block.hi[i])
        };
        for (own, group) in groups.iter().enumerate() {
            for k in group.iter().copied().filter(inside) {
                let (z, v) = (self.cloud.z(k as usize), self.cloud.v[k as usize]);
                for (other, (piece, _)) in each.iter().enumerate().filter(|(other, _)| *other != own) {
                    let y: Vec<f64> = (0..n).map(|i| (z[i] - piece.center[i]) / piece.half[i]).collect();
                    let mut gradient = [0.0; super::MOST_VARIABLES];
                    let (said, _) = piece.shape.back(self.terms.sum(&piece.coefficients, &y, &mut gradient));
                    let lower = said < v - self.region.error * v.abs().max(self.region.floor);
                    let near = |l: &u32| far(k, *l) < 0.25 * NEAR_PAIR * NEAR_PAIR;
                    if lower && !groups[other].iter().any(near) {
                        return false;
                    }
                }
            }
        }
        true
    }

    /// Whether gradients jump between groups where they are near each other: those of a smooth function that was cut in two
    /// do not.
    fn jumps(&self, block: &Block, groups: &[Vec<u32>]) -> bool {
        let n = self.cloud.variables;
        let width: Vec<f64> = (0..n).map(|i| block.hi[i] - block.lo[i]).collect();
        let mean = |points: &[u32], i: usize| {
            points.iter().map(|k| self.cloud.q(*k as usize)[i]).sum::<f64>() / points.len() as f64
        };
        let mut met = vec![false; groups.len()];
        for a in 0..groups.len() {
            for b in a + 1..groups.len() {
                let between: f64 = (0..n)
                    .map(|i| ((mean(&groups[a], i) - mean(&groups[b], i)) * width[i]).powi(2))
                    .sum::<f64>()
                    .sqrt();
                let mut pairs: Vec<(f64, f64)> = Vec::new();
                for k in thinned(&groups[a], MOST_TESTS) {
                    let (zk, qk) = (self.cloud.z(k as usize), self.cloud.q(k as usize));
                    for l in thinned(&groups[b], MOST_TESTS) {
                        let (zl, ql) = (self.cloud.z(l as usize), self.cloud.q(l as usize));
                        let far: f64 = (0..n).map(|i| ((zk[i] - zl[i]) / width[i]).powi(2)).sum();
                        if far < NEAR_PAIR * NEAR_PAIR {
                            let jump: f64 = (0..n).map(|i| ((qk[i] - ql[i]) * width[i]).powi(2)).sum();
                            pairs.push((far, jump.sqrt()));
                        }
                    }
                }
                if pairs.is_empty() {
                    continue;
                }
                pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
                pairs.truncate(PAIRS);
                pairs.sort_by(|a, b| a.1.total_cmp(&b.1));
                if pairs[pairs.len() / 2].1 < 0.5 * between {
                    return false;
                }
                (met[a], met[b]) = (true, true);
            }
        }
        met.into_iter().all(|m| m)
    }

    /// Groups after each point has gone to the one whose polynomial says what it says: labels are those of where a way began,
    /// which Newton's method may have left.
    fn sorted_out(&self, block: &Block, mut groups: Vec<Vec<u32>>) -> Vec<Vec<u32>> {
        const ROUNDS: usize = 8;
        let n = self.cloud.variables;
        let center: Vec<f64> = (0..n).map(|i| 0.5 * (block.lo[i] + block.hi[i])).collect();
        let half: Vec<f64> = (0..n)
            .map(|i| 0.5 * (block.hi[i] - block.lo[i]) * (1.0 + BLEND))
            .collect();
        let data = |list: &[u32], degree: usize| self.data(&center, &half, list, degree);
        let all: Vec<u32> = groups.concat();
        for round in 0..ROUNDS {
            let degree = if round < ROUNDS / 2 { 2 } else { self.highest.min(3) };
            let whole = data(&all, degree);
            let mut errors: Vec<Vec<f64>> = Vec::new();
            for group in &groups {
                let most = (2.0 * self.most_equations * self.terms.upto[degree] as f64) as usize;
                let Some(fitted) = data(&thinned(group, most), degree).fits(Shape::Value, degree).pop() else {
                    return Vec::new();
                };
                let each = whole.errors(Shape::Value, &fitted);
                errors.push(each.iter().map(|e| e[0] + e[1]).collect());
            }
            let mut next = vec![Vec::new(); groups.len()];
            for (k, point) in all.iter().enumerate() {
                let best = (0..groups.len()).min_by(|a, b| errors[*a][k].total_cmp(&errors[*b][k]));
                next[best.unwrap_or(0)].push(*point);
            }
            next.retain(|g| g.len() >= LEAST_GROUP);
            let same = next.iter().map(Vec::len).eq(groups.iter().map(Vec::len));
            groups = next;
            if groups.len() < 2 || (same && round >= ROUNDS / 2) {
                break;
            }
        }
        groups
    }

    /// The best piece for some of a block's points, with its error over the one asked for.
    fn of_group(&self, block: &Block, points: &[u32], can_be_halved: bool) -> Option<(Piece, f64)> {
        let n = self.cloud.variables;
        let center: Vec<f64> = (0..n).map(|i| 0.5 * (block.lo[i] + block.hi[i])).collect();
        let half: Vec<f64> = (0..n)
            .map(|i| 0.5 * (block.hi[i] - block.lo[i]) * (1.0 + BLEND))
            .collect();
        let fold = |k: u32| mix(self.cloud.track[k as usize]) % LEFT_OUT;
        let (tests, learned): (Vec<u32>, Vec<u32>) = (points.iter().copied()).partition(|k| fold(*k) == 0);
        let equations = |count: usize| ((n + 1) * count) as f64;
        let determined =
            |degree: usize, points: usize| equations(points) >= LEAST_EQUATIONS * self.terms.upto[degree] as f64;
        let highest = (1..=self.highest).rev().find(|d| determined(*d, learned.len()))?;
        let inside = |k: &u32| {
            let z = self.cloud.z(*k as usize);
            (0..n).all(|i| (z[i] - center[i]).abs() <= half[i])
        };
        let tests: Vec<u32> = tests.into_iter().filter(inside).collect();
        let data = |list: &[u32], degree: usize| self.data(&center, &half, list, degree);
        let enough = points.iter().filter(|k| inside(k)).count() >= LEAST_TESTS;
        // Which function of V is smoothest here a low degree tells.
        let low = highest.min(2);
        let few = |list: &[u32]| thinned(list, (self.most_equations * self.terms.upto[low] as f64) as usize);
        let (rough, rough_tests) = (data(&few(&learned), low), data(&few(&tests), low));
        let least = rough.least().min(rough_tests.least());
        let mut shapes: Vec<(f64, Shape)> = (Shape::ALL.iter())
            .filter(|(shape, _)| shape.serves(least))
            .filter_map(|(shape, _)| {
                let fitted = rough.fits(*shape, low).pop()?;
                Some((largest(&rough_tests.errors(*shape, &fitted))[0], *shape))
            })
            .collect();
        // V itself where nothing is better.
        shapes.sort_by(|a, b| a.0.total_cmp(&b.0));
        let &(first, _) = shapes.first()?;
        shapes.retain(|(e, shape)| *e <= NEARLY * first || (*shape == Shape::Value && *e <= 2.0 * NEARLY * first));
        shapes.truncate(2);
        let hopeless = can_be_halved && first > HOPELESS * self.region.error;
        let degree = if hopeless { low } else { highest };
        let most = (self.most_equations * self.terms.upto[degree] as f64 / (n + 1) as f64).ceil() as usize;
        let learned = data(&thinned(&learned, most), degree);
        let tested = data(&thinned(&tests, MOST_TESTS), degree);
        let mut best: Option<Fit> = None;
        'tried: for (_, shape) in shapes {
            for coefficients in learned.fits(shape, degree).into_iter().rev().take(3) {
                let errors = largest(&tested.errors(shape, &coefficients));
                if best.as_ref().is_none_or(|b| errors[0] < b.errors[0]) {
                    best = Some(Fit {
                        shape,
                        coefficients,
                        errors,
                    });
                }
                let met = |e: f64| e * ALLOWANCE <= ENOUGH * self.region.error;
                if enough && best.as_ref().is_some_and(|b| met(b.errors[0])) {
                    break 'tried;
                }
            }
        }
        let mut fit = best?;
        // Few points: each is left out once.
        if tests.len() < MANY_TESTS && !hopeless {
            let degree = self.degree_of(&fit.coefficients);
            for turn in 1..LEFT_OUT {
                let (out, rest): (Vec<u32>, Vec<u32>) = (points.iter().copied()).partition(|k| fold(*k) == turn);
                let out: Vec<u32> = out.into_iter().filter(inside).collect();
                if out.is_empty() {
                    continue;
                }
                let fitted = data(&thinned(&rest, most), degree).fits(fit.shape, degree).pop();
                let errors = match fitted {
                    Some(c) if c.len() == fit.coefficients.len() => largest(&data(&out, degree).errors(fit.shape, &c)),
                    _ => [f64::INFINITY; 2],
                };
                fit.errors = [0, 1].map(|i| fit.errors[i].max(errors[i]));
            }
        }
        let bound = if enough {
            ALLOWANCE * fit.errors[0]
        } else {
            f64::INFINITY
        };
        let piece = Piece {
            center,
            half,
            shape: fit.shape,
            coefficients: fit.coefficients,
            bound,
            p_bound: if enough {
                ALLOWANCE * fit.errors[1]
            } else {
                f64::INFINITY
            },
            sheet: self.label(points),
            support: Vec::new(),
        };
        Some((piece, bound / self.region.error))
    }

    /// The same polynomial with all of its points, now that its error is known.
    fn finished(&self, mut piece: Piece, points: &[u32], block: &Block, beyond: f64) -> Piece {
        let n = self.cloud.variables;
        // Alone in the region's inside, a sheet has points all around unless they are few.
        let reach = if beyond < self.region.beyond || self.region.game {
            BESIDE
        } else {
            REACH
        };
        if !self.places_without(block, points, 2, reach).is_empty() {
            piece.support = self.enclosed(&piece, points, beyond);
        }
        let degree = self.degree_of(&piece.coefficients);
        let most = (1.5 * self.most_equations * self.terms.upto[degree] as f64 / (n + 1) as f64).ceil() as usize;
        let data = |list: &[u32]| self.data(&piece.center, &piece.half, list, degree);
        // It must not be worse than the one that was tested.
        let inside = |k: &u32| {
            let z = self.cloud.z(*k as usize);
            (0..n).all(|i| (z[i] - piece.center[i]).abs() <= piece.half[i])
        };
        let within: Vec<u32> = points.iter().copied().filter(inside).collect();
        let seen = data(&thinned(&within, 2 * MOST_TESTS));
        let old = largest(&seen.errors(piece.shape, &piece.coefficients));
        let found = data(&thinned(points, most)).fits(piece.shape, degree).pop();
        let found = found.filter(|c| c.len() == piece.coefficients.len());
        let mut error = old;
        if let Some(found) = found {
            let new = largest(&seen.errors(piece.shape, &found));
            if new[0] <= old[0] {
                (error, piece.coefficients) = (new, found);
            }
        }
        piece.bound = piece.bound.max(error[0]);
        piece.p_bound = piece.p_bound.max(error[1]);
        piece
    }

    fn degree_of(&self, coefficients: &[f64]) -> usize {
        (self.terms.upto.iter())
            .position(|c| *c == coefficients.len())
            .unwrap_or(0)
    }

    /// Points in the variables of a box.
    fn data(&self, center: &[f64], half: &[f64], list: &[u32], degree: usize) -> Data<'_> {
        let n = self.cloud.variables;
        let points = list.iter().map(|k| {
            let k = *k as usize;
            let y = (0..n).map(|i| (self.cloud.z(k)[i] - center[i]) / half[i]).collect();
            let q = (0..n).map(|i| self.cloud.q(k)[i] * half[i]).collect();
            (y, self.cloud.v[k], q)
        });
        Data::new(&self.terms, degree, self.region.floor, points)
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
        counts.iter().max_by_key(|(l, c)| (*c, -*l)).map_or(-1, |(l, _)| *l)
    }

    /// The axis along which a block is halved: along which its polynomial of V changes most in its highest terms.
    fn axis(&self, block: &Block, pieces: &[(Piece, Vec<u32>)]) -> usize {
        let n = self.cloud.variables;
        let width = |i: usize| block.hi[i] - block.lo[i];
        let widest = (0..n).map(width).fold(0.0, f64::max);
        let mut share = vec![0.0f64; n];
        for (piece, _) in pieces {
            let highest = self.degree_of(&piece.coefficients);
            for (term, c) in piece.coefficients.iter().enumerate() {
                let degree = self.terms.degree_of(term);
                if degree + 1 < highest || degree < 2 {
                    continue;
                }
                for (i, power) in self.terms.powers_of(term).iter().enumerate() {
                    share[i] += c.abs() * f64::from(*power) / degree as f64;
                }
            }
        }
        if share.iter().all(|s| *s == 0.0) {
            share = (0..n).map(|i| self.change(block, i)).collect();
        }
        // No slivers.
        let wide = |i: &usize| width(*i) * SLIVER > widest;
        (0..n)
            .filter(wide)
            .max_by(|a, b| share[*a].total_cmp(&share[*b]))
            .unwrap_or(0)
    }

    /// How much V changes along an axis, relative to itself, differently at different points.
    fn change(&self, block: &Block, axis: usize) -> f64 {
        let width = block.hi[axis] - block.lo[axis];
        let stride = (block.points.len() / 1000).max(1);
        let relative = |k: &u32| {
            let k = *k as usize;
            self.cloud.q(k)[axis] * width / self.cloud.v[k].abs().max(self.region.floor)
        };
        let all: Vec<f64> = block.points.iter().step_by(stride).map(relative).collect();
        let mean = all.iter().sum::<f64>() / all.len().max(1) as f64;
        (all.iter().map(|c| (c - mean).powi(2)).sum::<f64>() / all.len().max(1) as f64).sqrt()
    }

    /// Extents of points along directions, in the piece's variables, and a little more: between tracks there may be others.
    fn enclosed(&self, piece: &Piece, points: &[u32], beyond: f64) -> Vec<[f64; 2]> {
        let n = self.cloud.variables;
        (self.directions.iter())
            .map(|d| {
                let along = points.iter().map(|k| {
                    let z = self.cloud.z(*k as usize);
                    (0..n)
                        .map(|i| d[i] * (z[i] - piece.center[i]) / piece.half[i])
                        .sum::<f64>()
                });
                let [lo, hi] = along.fold([f64::INFINITY, f64::NEG_INFINITY], |[lo, hi], t| [lo.min(t), hi.max(t)]);
                [lo - beyond, hi + beyond]
            })
            .collect()
    }

    /// Places of a block that no point is near to: where few variables allow high degrees, between its corners too.
    fn bare_places(&self, block: &Block) -> Vec<f64> {
        let (a_side, reach) = match self.cloud.variables {
            1 | 2 => (5, 0.35),
            3 => (4, 0.5),
            _ => (2, REACH),
        };
        self.places_without(block, &block.points, a_side, reach)
    }

    /// Places of a grid over a block, in the region, that none of some points is within so many half widths of.
    fn places_without(&self, block: &Block, points: &[u32], a_side: usize, reach: f64) -> Vec<f64> {
        let n = self.cloud.variables;
        let half = |i: usize| 0.5 * (block.hi[i] - block.lo[i]);
        let mut bare = Vec::new();
        for place in 0..a_side.pow(n as u32) {
            let mut left = place;
            let at: Vec<f64> = (0..n)
                .map(|i| {
                    let share = (left % a_side) as f64 / (a_side - 1) as f64;
                    left /= a_side;
                    block.lo[i] + share * (block.hi[i] - block.lo[i])
                })
                .collect();
            let near = |k: &u32| {
                let z = self.cloud.z(*k as usize);
                (0..n).all(|i| (z[i] - at[i]).abs() <= reach * half(i))
            };
            let x = self.frame.state(&at);
            let inside = (0..n).all(|i| x[i] >= self.region.lo[i] && x[i] <= self.region.hi[i]);
            if inside && !points.iter().any(near) {
                bare.extend(at);
            }
        }
        bare
    }
}

/// Some of a list, drawn by a hash: in order, neighbours on a track would be left out and kept in turn.
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
