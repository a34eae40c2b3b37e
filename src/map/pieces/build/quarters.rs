//! Fits in a plane, and of several sheets: a quarter of the tracks is left out. Of tracks that run
//! side by side one alone is not missed.

use super::super::fit::{Data, Shape};
use super::patch::Patch;
use super::{Block, Builder, HOPELESS, LEAST_TESTS, LOW, Piece, largest, mix, shortlist, thinned};

/// One of this many tracks is left out of a first fit, to measure its error.
const LEFT_OUT: u32 = 4;
/// Share of the points that are fitted to.
pub(super) const LEARNED: f64 = 1.0 - 1.0 / LEFT_OUT as f64;
/// Points that are left out at most; below how many all are left out in turn.
const MOST_TESTS: usize = 300;
const MANY_TESTS: usize = 24;

/// A fit with its errors, relative to V's size.
struct Fit {
    shape: Shape,
    coefficients: Vec<f64>,
    errors: [f64; 2],
}

impl Builder<'_> {
    /// The best piece for some of a block's points, with its error over the one asked for.
    pub(super) fn by_quarters(
        &self,
        block: &Block,
        points: &[u32],
        can_be_halved: bool,
    ) -> Option<(Piece, f64)> {
        let (tests, learned): (Vec<u32>, Vec<u32>) =
            (points.iter().copied()).partition(|k| self.quarter(*k) == 0);
        let highest = self.highest_of(learned.len())?;
        let patch = self.patch(block, points);
        let inside = |k: &u32| self.tells(&patch, *k);
        let tests: Vec<u32> = tests.into_iter().filter(inside).collect();
        let enough = points.iter().filter(|k| inside(k)).count() >= LEAST_TESTS;

        // Which function of V is smoothest here a low degree tells.
        let low = highest.min(LOW);
        let (first, shapes) = self.shapes_by_quarters(&patch, (&learned, &tests), low)?;
        let hopeless = can_be_halved && first > HOPELESS * self.region.error;
        let degree = if hopeless { low } else { highest };
        let most = self.most_points(degree);
        let learned = self.data_of(&patch, &thinned(&learned, most), degree);
        let tested = self.data_of(&patch, &thinned(&tests, MOST_TESTS), degree);
        let mut fit = self.best_by_quarters((&learned, &tested), shapes, degree, enough)?;
        // Few points: each is left out once.
        if tests.len() < MANY_TESTS && !hopeless {
            for turn in 1..LEFT_OUT {
                self.leave_out(&patch, turn, most, &mut fit);
            }
        }
        let bounds = fit.errors.map(|e| self.habits.allowance * e);
        let fitted = (fit.shape, fit.coefficients);
        Some(self.piece_of(patch, fitted, enough.then_some(bounds)))
    }

    /// Which quarter of the tracks a point is of.
    fn quarter(&self, k: u32) -> u32 {
        mix(self.cloud.track[k as usize]) % LEFT_OUT
    }

    /// The functions of V worth fitting, by the errors that a low degree fitted to some points has
    /// at others; and the least of these.
    fn shapes_by_quarters(
        &self,
        patch: &Patch<'_>,
        (learned, tests): (&[u32], &[u32]),
        low: usize,
    ) -> Option<(f64, Vec<Shape>)> {
        let few = |list: &[u32]| {
            thinned(
                list,
                (self.habits.most_equations * self.terms.upto[low] as f64) as usize,
            )
        };
        let rough = self.data_of(patch, &few(learned), low);
        let rough_tests = self.data_of(patch, &few(tests), low);
        let least = rough.least().min(rough_tests.least());
        let tried = (Shape::ALL.iter())
            .filter(|(shape, _)| shape.serves(least))
            .filter_map(|(shape, _)| {
                let fitted = rough.fits(*shape, low).pop()?;
                Some((largest(&rough_tests.errors(*shape, &fitted))[0], *shape))
            });
        shortlist(tried)
    }

    /// The fit that errs least at the tests, of some shapes and the highest degrees; where the
    /// points are enough to tell, no more are tried after one that is good enough.
    fn best_by_quarters(
        &self,
        (learned, tested): (&Data<'_>, &Data<'_>),
        shapes: Vec<Shape>,
        degree: usize,
        enough: bool,
    ) -> Option<Fit> {
        let met = |e: f64| e * self.habits.allowance <= self.habits.enough * self.region.error;
        let mut best: Option<Fit> = None;
        for shape in shapes {
            for coefficients in learned.fits(shape, degree).into_iter().rev().take(3) {
                let errors = largest(&tested.errors(shape, &coefficients));
                if best.as_ref().is_none_or(|b| errors[0] < b.errors[0]) {
                    best = Some(Fit {
                        shape,
                        coefficients,
                        errors,
                    });
                }
                if enough && best.as_ref().is_some_and(|b| met(b.errors[0])) {
                    return best;
                }
            }
        }
        best
    }

    /// Fits to at most so many points without one of the quarters, and raises a fit's errors to
    /// those that show there.
    fn leave_out(&self, patch: &Patch<'_>, quarter: u32, most: usize, fit: &mut Fit) {
        let (out, rest): (Vec<u32>, Vec<u32>) =
            (patch.points.iter().copied()).partition(|k| self.quarter(*k) == quarter);
        let out: Vec<u32> = (out.into_iter())
            .filter(|k| self.tells(patch, *k))
            .collect();
        if out.is_empty() {
            return;
        }
        let degree = self.degree_of(&fit.coefficients);
        let fitted = self
            .data_of(patch, &thinned(&rest, most), degree)
            .fits(fit.shape, degree)
            .pop();
        let errors = match fitted {
            Some(c) if c.len() == fit.coefficients.len() => {
                largest(&self.data_of(patch, &out, degree).errors(fit.shape, &c))
            }
            _ => [f64::INFINITY; 2],
        };
        fit.errors = [0, 1].map(|i| fit.errors[i].max(errors[i]));
    }

    /// The same polynomial with all of its points, now that its error is known.
    pub(super) fn with_all(&self, mut piece: Piece, points: &[u32]) -> Piece {
        let n = self.cloud.variables;
        let degree = self.degree_of(&piece.coefficients);
        let most = (1.5 * self.habits.most_equations * self.terms.upto[degree] as f64
            / (n + 1) as f64)
            .ceil() as usize;
        let scale = self.scale(points);
        let data = |list: &[u32]| self.data((&piece.center, &piece.half), list, degree, scale);
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

    /// The axis along which a block is halved: along which its polynomial of V changes most in its
    /// highest terms.
    pub(super) fn axis_by_terms(&self, block: &Block, pieces: &[(Piece, Vec<u32>)]) -> usize {
        let n = self.cloud.variables;
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
        (self.wide(block).into_iter())
            .max_by(|a, b| share[*a].total_cmp(&share[*b]))
            .unwrap_or(0)
    }
}
