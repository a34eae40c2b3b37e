//! The Hamilton-Jacobi-Bellman equation inside cells: along the flow V falls by the running cost,
//! at any place, whether a trajectory is known there or not.
//!
//! Where `p` is nearly `dV/dx`, `f(x, u*(x, p))' dV/dx = -L(x, u*(x, p))` holds to the square of
//! what `p` is off by, because `dH/dp = f` at the minimizing control (the step of policy
//! iteration). Places without points take part in a fit by this equation, and every piece is judged
//! by its residual at places spread over it.

use super::super::fit::Along;
use super::super::{MOST_VARIABLES, Piece};
use super::{BEYOND_OF_SEVERAL, Block, Builder};
use crate::backend::cpu::Evaluator;
use crate::program::Program;
use crate::sweep::Plan;

/// Places at which the residual is looked at.
const PLACES: usize = 32;
/// So many times as many are drawn at most: a piece may say something in a small part of its cell.
const MOST_DRAWN: usize = 64;
/// Share of the largest residual that a bound is at least. A polynomial of degree k has slopes up
/// to k^2 times its size (Markov): in a plane, where degrees are high, less of a residual is an
/// error of V.
const SHARE: f64 = 1.0;
const SHARE_IN_PLANE: f64 = 0.25;
/// Errors so many times larger than asked for are those of a polynomial that goes on without
/// points.
const FAR_OFF: f64 = 30.0;
/// Whole periods looked at where the cost tells them apart.
const PERIODS: i32 = 2;
/// States with a period that are moved by several.
const MOST_MOVED: usize = 2;

/// f and L of a problem whose V solves the equation, as functions of state and p.
pub struct Flow {
    /// Rates of the states backward in time, and L.
    rates: Evaluator,
    reference: Vec<f64>,
    /// Whether the last variable is time.
    timed: bool,
    /// By what a state may be moved: V at it is that of a copy, whole periods away, whose cost is
    /// another. The first is nothing.
    moves: Vec<Vec<f64>>,
}

impl Flow {
    /// That of a plan; `timed`: the last variable is time. `None` where V does not solve the
    /// equation: behind a fold of a game nothing does, and V(x, 0) alone does not tell dV/dt.
    pub fn of(plan: &Plan, timed: bool) -> Option<Self> {
        if plan.game || (plan.local.is_none() && !timed) {
            return None;
        }
        let system = &plan.system;
        let n = system.states;
        let mut moves = vec![vec![0.0; n]];
        let told_apart = (0..n).filter_map(|i| {
            let period = plan.periods[i].filter(|_| plan.recurrent[i].is_none())?;
            Some((i, period))
        });
        let told_apart: Vec<(usize, f64)> = told_apart.collect();
        if told_apart.len() > MOST_MOVED {
            return None;
        }
        for (i, period) in told_apart {
            let moved = |turns: i32| {
                moves.iter().cloned().map(move |mut x: Vec<f64>| {
                    x[i] += f64::from(turns) * period;
                    x
                })
            };
            let order = (0..=PERIODS).flat_map(|k| [k, -k]).skip(1);
            moves = order.flat_map(moved).collect();
        }
        let outputs = [&system.rate[..n], &system.rate[2 * n..=2 * n]].concat();
        Some(Self {
            rates: Evaluator::new(&Program::lower(&system.graph, &system.inputs, &outputs)),
            reference: system.reference.clone(),
            timed,
            moves,
        })
    }

    /// Whether the problem is the same at all copies of a state.
    pub(super) fn repeats(&self) -> bool {
        self.moves.len() == 1
    }

    /// Rates of the variables and L at states with slopes of V, `[state][variable]`.
    fn at(&self, x: &[f64], p: &[f64], moved: &[f64]) -> Vec<(Vec<f64>, f64)> {
        let n = self.reference.len();
        let variables = n + usize::from(self.timed);
        let mut inputs = Vec::with_capacity(x.len() / variables * 2 * n);
        for (x, p) in x.chunks(variables).zip(p.chunks(variables)) {
            inputs.extend(x.iter().zip(&self.reference).map(|(x, r)| x - r));
            let s = inputs.len() - n;
            inputs[s..]
                .iter_mut()
                .zip(moved)
                .for_each(|(s, moved)| *s += moved);
            inputs.extend(&p[..n]);
        }
        (self.rates.eval(&inputs, 2 * n).chunks(n + 1))
            .map(|values| {
                let mut f: Vec<f64> = values[..n].iter().map(|g| -g).collect();
                if self.timed {
                    f.push(1.0);
                }
                (f, values[n])
            })
            .collect()
    }
}

/// What the equation says of a piece.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Residual {
    /// Relative to V.
    pub largest: f64,
    /// Whether it comes to another branch of its function of V, where it says nothing.
    pub off_branch: bool,
}

impl Builder<'_> {
    /// Places spread over a piece, in its variables, where it says the least of the cell's pieces,
    /// or comes to another branch of its function of V; `turn` makes others.
    pub(super) fn places(
        &self,
        piece: &Piece,
        others: &[Piece],
        (count, turn): (usize, f64),
    ) -> Vec<[f64; MOST_VARIABLES]> {
        let n = self.cloud.variables;
        // The root of x^(n+1) = x + 1: its powers spread points evenly (Roberts 2018).
        let root = (0..32).fold(2.0f64, |x, _| (1.0 + x).powf(1.0 / (n as f64 + 1.0)));
        (0..MOST_DRAWN * count)
            .map(|k| {
                std::array::from_fn(|i| {
                    let step = root.powi(-(i as i32 + 1));
                    if i < n {
                        2.0 * (turn + (k as f64 + 0.5) * step).fract() - 1.0
                    } else {
                        0.0
                    }
                })
            })
            .filter(|y: &[f64; MOST_VARIABLES]| {
                let z = piece.coordinates(&y[..n]);
                let above = || {
                    let said = piece.value(&self.terms, &y[..n]).0;
                    said > self.region.value_max || said > self.least_of(others, &z)
                };
                piece.supports(&self.directions, &y[..n])
                    && self.region.covers(&self.frame.state(&z))
                    && !above()
            })
            .take(count)
            .collect()
    }

    /// The least V that some pieces say at a place.
    fn least_of(&self, pieces: &[Piece], z: &[f64]) -> f64 {
        let n = z.len();
        (pieces.iter())
            .filter_map(|piece| {
                let y = piece.place(z);
                let said = piece.value(&self.terms, &y[..n]).0;
                (said.is_finite() && piece.supports(&self.directions, &y[..n])).then_some(said)
            })
            .fold(f64::INFINITY, f64::min)
    }

    /// The equation along the flow at places of a piece, by the control that its slopes ask for;
    /// `None` where it says nothing.
    pub(super) fn along(
        &self,
        piece: &Piece,
        places: &[[f64; MOST_VARIABLES]],
        flow: &Flow,
        moved: &[f64],
    ) -> Vec<Option<Along>> {
        let n = self.cloud.variables;
        let (mut x, mut p) = (Vec::new(), Vec::new());
        let mut said = Vec::new();
        for y in places {
            let z = piece.coordinates(&y[..n]);
            let (value, q) = piece.value(&self.terms, &y[..n]);
            let mut own = vec![0.0; n];
            self.frame.gradient(&z, &q[..n], &mut own);
            x.extend(self.frame.state(&z));
            p.extend(own);
            said.push((z, value, q));
        }
        (flow.at(&x, &p, moved).into_iter().zip(said).zip(places))
            .map(|(((f, running), (z, value, q)), place)| {
                let mut direction = [0.0; MOST_VARIABLES];
                self.frame.rates(&z, &f, &mut direction[..n]);
                (0..n).for_each(|i| direction[i] /= piece.half[i]);
                let speed = direction.iter().fold(0.0f64, |a, d| a.max(d.abs()));
                direction.iter_mut().for_each(|d| *d /= speed);
                let along: f64 = (0..n).map(|i| direction[i] * q[i] * piece.half[i]).sum();
                let one = Along {
                    y: *place,
                    direction,
                    slope: -running / speed,
                    said: along,
                    v: value,
                };
                (speed > 0.0 && one.slope.is_finite() && along.is_finite()).then_some(one)
            })
            .collect()
    }

    /// The largest residual of the equation at places of a piece: by how much V errs, relative to
    /// itself, on the way of one half width along the flow. 0 where nothing is known of it.
    pub(super) fn residual(&self, piece: &Piece, others: &[Piece], turn: f64) -> Residual {
        let Some(flow) = self.flow else {
            return Residual::default();
        };
        let n = self.cloud.variables;
        let places = self.places(piece, others, (PLACES, turn));
        let mut least = vec![f64::INFINITY; places.len()];
        for moved in &flow.moves {
            for (least, along) in least
                .iter_mut()
                .zip(self.along(piece, &places, flow, moved))
            {
                let Some(along) = along else { continue };
                let off = (along.said - along.slope).abs() / along.v.abs().max(self.region.floor);
                *least = off.min(*least);
            }
        }
        Residual {
            largest: least
                .into_iter()
                .filter(|r| r.is_finite())
                .fold(0.0, f64::max),
            off_branch: (places.iter()).any(|y| piece.value(&self.terms, &y[..n]).0.is_nan()),
        }
    }

    /// What the bounds of a cell's pieces are at least, by the equation where each says the least
    /// of them.
    pub(super) fn bounds_by_equation(&self, pieces: &[Piece]) -> Vec<Residual> {
        (0..pieces.len())
            .map(|k| self.bound_by_equation(&pieces[k], &[&pieces[..k], &pieces[k + 1..]].concat()))
            .collect()
    }

    fn bound_by_equation(&self, piece: &Piece, others: &[Piece]) -> Residual {
        let share = if self.cloud.variables <= 2 {
            SHARE_IN_PLANE
        } else {
            SHARE
        };
        let residual = self.residual(piece, others, 0.0);
        Residual {
            largest: share * residual.largest,
            ..residual
        }
    }

    /// Whether the equation says that a cell's pieces err by more than is good enough, and than
    /// their bounds.
    pub(super) fn is_contradicted(&self, pieces: &[Piece], bounds: &[Residual]) -> bool {
        let enough = self.habits.enough * self.region.error;
        (pieces.iter().zip(bounds))
            .any(|(piece, by)| by.off_branch || by.largest > piece.bound.max(enough))
    }

    /// Lets a good piece that keeps to its points say what V is all over its cell, if the equation
    /// holds all over it: where it is alone, no sheets lie over each other, no place is known to
    /// have no solution, and no guard casts a shadow.
    pub(super) fn extend(&self, piece: &mut Piece, block: &Block) {
        let is_good =
            piece.bound <= self.region.error && self.flow.is_some() && self.without.is_none();
        let is_sole = !self.cloud.several && !self.is_shaded && block.unanswered.is_empty();
        if piece.support.is_empty() || !is_good || !is_sole {
            return;
        }
        let support = std::mem::take(&mut piece.support);
        let all = [0.0, 0.25, 0.5, 0.75].map(|turn| self.residual(piece, &[], turn));
        let largest = all.iter().map(|r| r.largest).fold(0.0, f64::max);
        if all.iter().any(|r| r.off_branch) || largest > self.region.error {
            piece.support = support;
        } else {
            piece.bound = piece.bound.max(largest);
        }
    }

    /// Raises the bound of a piece to what the equation shows. One that goes on without points may
    /// say too much there: it first keeps closer to them.
    pub(super) fn judge(
        &self,
        piece: &mut Piece,
        mut by: Residual,
        others: &[Piece],
        (points, beyond): (&[u32], f64),
    ) {
        if by.off_branch || by.largest > piece.bound.max(FAR_OFF * self.region.error) {
            piece.support = self.enclosed(piece, points, beyond.min(BEYOND_OF_SEVERAL));
            by = self.bound_by_equation(piece, others);
        }
        let bound = by.largest;
        if bound > piece.bound {
            // Of a polynomial that meets its points exactly nothing is known of p's errors.
            piece.p_bound = piece.p_bound.max(bound) * (bound / piece.bound.max(0.01 * bound));
            piece.bound = bound;
        }
    }
}
