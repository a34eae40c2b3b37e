//! Values at many states at once.

use super::ValueMap;
use super::swift::{Answer, Room};
use crate::map::pieces::Here;
use rayon::prelude::*;

/// States of a task.
const CHUNK: usize = 512;
/// States whose controls are computed at once.
const ROWS: usize = 1 << 16;

/// V, p and u on the lowest sheet at some states; NaN where they are not known.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Many {
    /// `[state]`.
    pub v: Vec<f64>,
    /// Estimated error of V, where it is that of a map in pieces or the local solution; else NaN.
    pub v_error: Vec<f64>,
    /// `[state][component]`.
    pub p: Vec<f64>,
    /// `[state][control]`.
    pub u: Vec<f64>,
}

impl ValueMap {
    /// V, p and u at states (absolute) `[state][component]`: as [`ValueMap::without_errors`], many at once and fast where a map
    /// in pieces or the local solution answers.
    pub fn many(&self, x: &[f64]) -> Many {
        let n = self.states();
        let count = x.len() / n;
        let mut all = Many {
            v: vec![f64::NAN; count],
            v_error: vec![f64::NAN; count],
            p: vec![f64::NAN; count * n],
            u: Vec::new(),
        };
        let tasks = (x.par_chunks(CHUNK * n))
            .zip(all.v.par_chunks_mut(CHUNK))
            .zip(all.v_error.par_chunks_mut(CHUNK))
            .zip(all.p.par_chunks_mut(CHUNK * n));
        tasks.for_each_init(Room::new, |room, (((x, v), v_error), p)| {
            self.each(x, false, room, |k, here| {
                let Some(here) = here else { return };
                v[k] = here.v;
                v_error[k] = here.v_bound;
                p[k * n..][..n].copy_from_slice(&here.p[..n]);
            });
        });
        all.u = self.controls(x, &all.p);
        all
    }

    /// The bound of V's error at states, in units of the error that a map in pieces was asked for (NaN where there is none), and
    /// whether V is known. `None` where no error was asked for.
    pub fn excess(&self, x: &[f64]) -> Option<Vec<(f64, bool)>> {
        let region = &self.pieces.as_ref()?.region;
        let many = self.many(x);
        let of = |(v, bound): (&f64, &f64)| (bound / (region.error * v.abs().max(region.floor)), v.is_finite());
        Some(many.v.iter().zip(&many.v_error).map(of).collect())
    }

    /// u at states with their p.
    fn controls(&self, x: &[f64], p: &[f64]) -> Vec<f64> {
        let n = self.states();
        let reference = &self.plan.system.reference;
        let mut u = Vec::new();
        for (x, p) in x.chunks(ROWS * n).zip(p.chunks(ROWS * n)) {
            let mut rows = vec![0.0; 2 * x.len()];
            for (row, (x, p)) in rows
                .chunks_exact_mut(2 * n)
                .zip(x.chunks_exact(n).zip(p.chunks_exact(n)))
            {
                for i in 0..n {
                    row[i] = x[i] - reference[i];
                }
                row[n..].copy_from_slice(p);
            }
            u.extend(self.controls.eval(&rows, 2 * n));
        }
        u
    }

    /// Moves a state into the region of the map in pieces, a little within its faces; false where there is none.
    pub(crate) fn clamp_to_pieces(&self, x: &mut [f64]) -> bool {
        /// Of the region's width.
        const WITHIN: f64 = 1e-6;
        let Some(pieces) = &self.pieces else { return false };
        for i in 0..x.len() {
            let (lo, hi) = (pieces.region.lo[i], pieces.region.hi[i]);
            if let Some(period) = self.plan.periods[i]
                && (x[i] < lo || x[i] > hi)
            {
                x[i] += ((lo - x[i]) / period).ceil() * period;
            }
            let margin = WITHIN * (hi - lo);
            x[i] = x[i].clamp(lo + margin, hi - margin);
        }
        true
    }

    /// What is known of V at some states on the lowest sheet, told with their numbers in some order.
    pub(crate) fn each(
        &self,
        x: &[f64],
        second: bool,
        room: &mut Room<f64>,
        mut tell: impl FnMut(usize, Option<&Here<f64>>),
    ) {
        let n = self.states();
        let mut slow = Here::blank();
        let mut ask = |k: usize, tell: &mut dyn FnMut(usize, Option<&Here<f64>>)| {
            let found = self.local(&x[k * n..][..n]);
            if let Some(value) = &found {
                slow.v = value.v;
                slow.v_bound = if value.in_pieces { value.v_error } else { f64::NAN };
                slow.p[..n].copy_from_slice(&value.p);
                slow.hessian[..n * n].copy_from_slice(&value.hessian);
                slow.sheet = value.sheet;
            }
            tell(k, found.as_ref().map(|_| &slow));
        };
        match &self.swift {
            Some(swift) => swift.each(x, second, room, |k, answer| match answer {
                Answer::Known(here) => tell(k, Some(here)),
                Answer::Unknown => tell(k, None),
                Answer::Elsewhere if self.pieces_alone => tell(k, None),
                Answer::Elsewhere => ask(k, &mut tell),
            }),
            None => (0..x.len() / n).for_each(|k| ask(k, &mut tell)),
        }
    }
}
