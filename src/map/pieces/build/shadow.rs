//! Where trajectories would leave a guard: the edge of its shadow.
//!
//! The least margin of the guards from a point to the end of its trajectory is a function of the
//! point with continuous slopes, but where two places of a trajectory are as near to the guards.
//! Beyond the points, where it comes to 0, the shadow begins.

use super::super::least_squares::{Equations, width};
use super::super::{BLEND, MOST_VARIABLES, Terms, margin_terms, quadratic};
use super::{Block, Builder, Piece, mix, thinned};
use crate::value::Clearance;

/// Points as far outside a piece as this many half widths tell its margins.
const AROUND: f64 = 1.5;
/// Share of the points whose margins are small ones: larger ones count as if they were little more.
const SMALL: f64 = 0.3;
/// Places in a shadow tell of its edge where their margins are above so many small ones below 0.
const DEEP: f64 = 0.3;
/// Points with margins below this share of a small one weigh as much as those with none.
const NEAR: f64 = 0.05;
/// Fits again, to places in a shadow that a fit takes for places outside.
const REFITS: usize = 2;
/// Equations a coefficient.
const EQUATIONS: usize = 3;
/// Longest cells that are halved for edges, in their own widths.
const SLIVER: f64 = 8.0;
/// Points that choose an axis, at most.
const MOST_POINTS: usize = 2000;
/// Places a side at which a margin is looked at.
const SIDE: usize = 5;
/// Parts of the margins that are left out in turn, to tell how far an edge is off.
const PARTS: u32 = 5;
/// How far an edge is off, at least, over what is good enough, where a few points tell of it.
const FEW_POINTS: f64 = 2.0;
/// Distance in widths of the region that an edge may be off, in relative errors asked for.
const EDGE: f64 = 2.0;

/// The edge of guards' shadows in a piece.
#[derive(Clone, Debug, Default)]
pub(super) struct Edge {
    /// As in [`Piece`], to be moved there.
    pub clearance: Vec<f64>,
    /// Where nothing can be told of it yet: about where it is, for the states that are to tell.
    pub about: Option<Vec<f64>>,
    /// How far points say that it is off, over what is good enough.
    pub excess: f64,
}

/// A place near a piece, in its variables, with the margin there.
#[derive(Clone, Copy)]
struct Margin {
    y: [f64; MOST_VARIABLES],
    margin: f64,
    /// Whether it is told by a trajectory that comes nearer to a guard later, or leaves it.
    ahead: bool,
    /// Part of the margins that it is left out with.
    part: u32,
}

/// Points near a piece with the margins that are fitted.
struct Near<'t> {
    terms: &'t Terms,
    all: Vec<Margin>,
    /// Those so deep in a shadow that they tell nothing of where its edge is, with margins that are
    /// not above theirs.
    deep: Vec<Margin>,
    /// What is a small margin.
    small: f64,
}

/// How far a polynomial of margins is off.
#[derive(Default)]
struct Off {
    /// Whether a margin tells of an edge.
    is_there: bool,
    /// Its largest overestimate.
    above: f64,
    /// The largest distance between edges, in widths of the region.
    by: f64,
}

impl Near<'_> {
    /// Weight of the equation of a margin.
    fn weight(&self, margin: f64) -> f64 {
        1.0 / (margin.abs() + NEAR * self.small)
    }

    /// A polynomial of the margins, of the second degree or the first; `None` where there are too
    /// few points.
    fn fitted(&self) -> Option<Vec<f64>> {
        let mut margins = self.fitted_to(&[])?;
        for _ in 0..REFITS {
            let above = |m: &&Margin| self.at(&margins, m) > m.margin;
            let above: Vec<_> = self.deep.iter().filter(above).copied().collect();
            if above.is_empty() {
                break;
            }
            margins = self.fitted_to(&above)?;
        }
        Some(margins)
    }

    fn fitted_to(&self, more: &[Margin]) -> Option<Vec<f64>> {
        let n = self.terms.variables;
        let sizes = [margin_terms(n), n + 1];
        let points = self.all.len() + more.len();
        let count = sizes.into_iter().find(|some| points >= EQUATIONS * some)?;
        let mut equations = Equations {
            rows: vec![0.0; points * width(count)],
            right: Vec::with_capacity(points),
            coefficients: count,
        };
        let (mut values, mut slopes) = (vec![0.0; count], vec![0.0; n * count]);
        let rows = equations.rows.chunks_exact_mut(width(count));
        for (Margin { y, margin, .. }, row) in self.all.iter().chain(more).zip(rows) {
            let weight = self.weight(*margin);
            self.terms.at(&y[..n], &mut values, &mut slopes);
            row.iter_mut()
                .zip(&values)
                .for_each(|(to, value)| *to = weight * value);
            equations.right.push(weight * margin);
        }
        let factors = equations.factors();
        let determined =
            (sizes.into_iter()).find(|some| *some <= count && *some <= factors.determined)?;
        let mut margins = factors.solution(determined);
        margins.resize(margin_terms(n), 0.0);
        margins.iter().all(|c| c.is_finite()).then_some(margins)
    }

    /// How far a polynomial of the margins is off inside a piece, of all or of a part of them.
    fn off(&self, (polynomial, piece): (&[f64], &Piece), part: Option<u32>) -> Off {
        let n = self.terms.variables;
        let mut off = Off::default();
        let asked = |m: &Margin| is_inside(m, n) && part.is_none_or(|part| m.part == part);
        let deep = self.deep.iter().map(|m| (m, false));
        let all = (self.all.iter().map(|m| (m, m.ahead)).chain(deep)).filter(|(m, _)| asked(m));
        for (m, may_tell) in all {
            let mut slope = [0.0; MOST_VARIABLES];
            let margin = self.terms.sum(polynomial, &m.y[..n], &mut slope);
            // In half widths of the piece; where a point is further away from the edge, it tells
            // nothing of where that is.
            let size = slope[..n].iter().map(|s| s * s).sum::<f64>().sqrt();
            let tells = may_tell && m.margin.min(margin) <= size;
            let above = match tells {
                true => margin - m.margin,
                // Places known to lie in a shadow are not told, whatever the fit says.
                false if m.margin < 0.0 => margin,
                false => continue,
            };
            off.above = off.above.max(above);
            off.is_there |= tells;
            if tells || above > 0.0 {
                let by_widths = (0..n)
                    .map(|i| (slope[i] / piece.half[i]).powi(2))
                    .sum::<f64>()
                    .sqrt();
                off.by = off.by.max(above.abs() / by_widths.max(f64::MIN_POSITIVE));
            }
        }
        off
    }

    /// Some of them.
    fn only(&self, keep: impl Fn(&Margin) -> bool) -> Self {
        let some = |all: &[Margin]| all.iter().copied().filter(|m| keep(m)).collect();
        Self {
            terms: self.terms,
            small: self.small,
            all: some(&self.all),
            deep: some(&self.deep),
        }
    }

    fn at(&self, polynomial: &[f64], m: &Margin) -> f64 {
        quadratic(polynomial, &m.y[..self.terms.variables])
    }

    /// Sum of the squares by which a polynomial of its own is off; 0 where there are too few points
    /// for one.
    fn misfit(&self) -> f64 {
        let Some(fitted) = self.fitted() else {
            return 0.0;
        };
        (self.all.iter())
            .map(|m| (self.weight(m.margin) * (self.at(&fitted, m) - m.margin)).powi(2))
            .sum()
    }
}

impl Builder<'_> {
    fn near(&self, piece: &Piece, points: &[u32]) -> Near<'_> {
        let n = self.cloud.variables;
        let holes = &self.cloud.unanswered;
        let hole = |k: &u32| {
            let at = *k as usize;
            (&holes.z[at * n..][..n], holes.clearance[at], true, *k)
        };
        let point = |k: &u32| {
            let at = *k as usize;
            let Clearance { margin, ahead } = self.cloud.clearance[at];
            (self.cloud.z(at), margin, ahead, self.cloud.track[at])
        };
        // Holes around the piece, too.
        let mut all: Vec<Margin> = (points.iter().map(point))
            .chain(self.cut.iter().map(hole))
            .filter(|(_, margin, ..)| margin.is_finite())
            .map(|(z, margin, ahead, part)| Margin {
                y: piece.place(z),
                margin,
                ahead,
                part: mix(part) % PARTS,
            })
            .filter(|m| m.y[..n].iter().all(|y| y.abs() <= AROUND))
            .collect();
        all.sort_by(|a, b| a.margin.total_cmp(&b.margin));
        let inside = all.partition_point(|m| m.margin < 0.0);
        let rank = inside + (SMALL * (all.len() - inside) as f64) as usize;
        let small = all
            .get(rank)
            .map_or(0.0, |m| m.margin)
            .max(f64::MIN_POSITIVE);
        let (mut deep, mut all): (Vec<_>, Vec<_>) =
            all.into_iter().partition(|m| m.margin <= -DEEP * small);
        deep.iter_mut().for_each(|m| m.margin = -DEEP * small);
        for m in all.iter_mut().chain(&mut deep) {
            m.margin /= 1.0 + m.margin / small;
        }
        Near {
            terms: &self.terms,
            all,
            deep,
            small,
        }
    }

    /// The axis along which a block is halved because the edge of shadows is off in it.
    pub(super) fn axis_by_edges(
        &self,
        block: &Block,
        pieces: &[(Piece, Vec<u32>)],
    ) -> Option<usize> {
        let n = self.cloud.variables;
        let near: Vec<Near> = (pieces.iter())
            .map(|(piece, points)| self.near(piece, &thinned(points, MOST_POINTS)))
            .collect();
        let misfit = |axis: usize| -> f64 {
            let halves = near.iter().flat_map(|near| {
                [false, true].map(|upper| near.only(|m| (m.y[axis] >= 0.0) == upper))
            });
            halves.map(|half| half.misfit()).sum()
        };
        let width = |i: usize| block.hi[i] - block.lo[i];
        let widest = (0..n).map(width).fold(0.0, f64::max);
        let wide = self
            .wide(block)
            .into_iter()
            .filter(|i| width(*i) * SLIVER > widest);
        let each = wide.map(|axis| (axis, misfit(axis)));
        each.min_by(|a, b| a.1.total_cmp(&b.1))
            .map(|(axis, _)| axis)
    }

    /// A piece with the edge by which states are asked for, if it is known.
    pub(super) fn shaded(&self, pieces: &[Piece], edges: &[Edge]) -> Option<Box<Piece>> {
        let ([piece], [edge]) = (pieces, edges) else {
            return None;
        };
        let clearance = edge.about.as_ref().unwrap_or(&piece.clearance);
        is_told(clearance).then(|| {
            let mut shaded = piece.clone();
            shaded.clearance.clone_from(clearance);
            Box::new(shaded)
        })
    }

    /// The edge of shadows by points of a piece; none where margins are positive all over it, or
    /// not known.
    pub(super) fn edge(&self, piece: &Piece, points: &[u32]) -> Edge {
        if !self.is_shaded {
            return Edge::default();
        }
        let n = self.cloud.variables;
        let good = EDGE * self.region.error * (1.0 + BLEND);
        let near = self.near(piece, points);
        let Some(mut clearance) = near.fitted() else {
            // Of a few points next to a shadow it is not known where that begins.
            let is_dark = near.all.iter().chain(&near.deep).any(|m| m.margin < 0.0);
            if !is_dark {
                return Edge::default();
            }
            return Edge {
                clearance: nowhere(n),
                about: None,
                excess: piece.half.iter().copied().fold(0.0, f64::max) / good,
            };
        };

        let mut off = near.off((&clearance, piece), None);
        // A guard that is nearest at the states themselves has no shadow: it is asked for each
        // state.
        let is_there = off.is_there || !near.deep.is_empty();
        if off.by > good {
            // Not resolved, it may be anywhere between its points.
            for part in 0..PARTS {
                let others = near.only(|m| m.part != part);
                let Some(fitted) = others.fitted() else {
                    continue;
                };
                off.above = off.above.max(near.off((&fitted, piece), Some(part)).above);
            }
        }
        // What is near the edge of a shadow is rather not told than told in it.
        clearance[0] -= off.above;
        let excess = off.by / good;
        // A plane through a few points tells of the edge next to them alone: more are asked for.
        if is_there && !is_curved(&clearance, n) {
            return Edge {
                clearance: nowhere(n),
                about: Some(clearance),
                excess: excess.max(FEW_POINTS),
            };
        }
        let mut places = 0..SIDE.pow(n as u32);
        let is_there = is_there
            && places.any(|place| {
                let mut rest = place;
                let y: [f64; MOST_VARIABLES] = std::array::from_fn(|_| {
                    let step = rest % SIDE;
                    rest /= SIDE;
                    2.0 * step as f64 / (SIDE - 1) as f64 - 1.0
                });
                quadratic(&clearance, &y[..n]) < 0.0
            });
        Edge {
            clearance: if is_there { clearance } else { Vec::new() },
            about: None,
            excess,
        }
    }
}

/// Whether a polynomial tells of an edge: neither there is none, nor is it unknown where.
fn is_told(clearance: &[f64]) -> bool {
    clearance.iter().skip(1).any(|c| *c != 0.0)
}

/// Whether a polynomial has terms of the second degree.
fn is_curved(clearance: &[f64], n: usize) -> bool {
    clearance[n + 1..].iter().any(|c| *c != 0.0)
}

fn is_inside(m: &Margin, n: usize) -> bool {
    m.y[..n].iter().all(|y| y.abs() <= 1.0)
}

/// A polynomial that is negative everywhere.
fn nowhere(n: usize) -> Vec<f64> {
    let mut margins = vec![0.0; margin_terms(n)];
    margins[0] = -1.0;
    margins
}
