//! Values at many states at once.

use super::pieces::{Here, Said};
use super::swift::{Answer, Room, turns_into};
use super::{At, Value, ValueMap, of_states};
use rayon::prelude::*;
use std::borrow::Cow;

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
    /// V, p and u at states (absolute) `[state][component]`, on a finite horizon at t = 0: as
    /// [`ValueMap::without_errors`], many at once and fast where a map in pieces or the local
    /// solution answers.
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
            self.each(x, 0.0, (false, false), room, |k, here| {
                let Some(here) = here else { return };
                v[k] = here.v;
                v_error[k] = here.v_bound;
                p[k * n..][..n].copy_from_slice(&here.p[..n]);
            });
        });
        all.u = self.controls(x, &all.p);
        all
    }

    /// [`ValueMap::at`] (or, without `errors`, [`ValueMap::without_errors`]) at states
    /// `[state][component]`: many at once where a map in pieces has one sheet, or the local
    /// solution holds.
    pub fn at_many(&self, x: &[f64], errors: bool) -> Vec<At> {
        self.at_times(x, &vec![0.0; x.len() / self.states()], errors)
    }

    /// The same at times of a finite horizon, one a state.
    pub fn at_times(&self, x: &[f64], t: &[f64], errors: bool) -> Vec<At> {
        let n = self.states();
        let mut found: Vec<Option<(Value, Vec<f64>)>> = vec![None; x.len() / n];
        // Of a map of V(x, 0) what is said elsewhere is not known.
        let swift = self.swift.as_ref();
        if let Some(swift) = swift.filter(|_| self.time.is_some() || t.iter().all(|t| *t == 0.0)) {
            let tasks =
                (x.par_chunks(CHUNK * n)).zip(t.par_chunks(CHUNK).zip(found.par_chunks_mut(CHUNK)));
            tasks.for_each_init(Room::new, |room, (x, (t, found))| {
                swift.each(&self.places(x, |k| t[k]), true, room, |k, answer| {
                    if let Answer::Known(here) = answer
                        && here.sheets == 1
                    {
                        found[k] = self.as_value(&x[k * n..][..n], here);
                    }
                });
            });
        }
        if let Some(excluded) = self.excluded(x) {
            (found.iter_mut().zip(excluded))
                .for_each(|(found, excluded)| drop(found.take_if(|_| excluded)));
        }
        self.add_controls(x, &mut found);
        (found.into_par_iter().zip(x.par_chunks(n)).zip(t))
            .map(|((value, x), t)| match value {
                Some(value) => At {
                    lowest: Ok(value.0),
                    others: Vec::new(),
                },
                None if errors => self.at_time(x, *t),
                None => self.without_errors_at(x, *t),
            })
            .collect()
    }

    /// Whether a guard excludes each of some states (absolute), by more than rounding: pieces are
    /// smooth and say something there too. `None` where the scene has no guard of the state alone.
    pub(super) fn excluded(&self, x: &[f64]) -> Option<Vec<bool>> {
        Some(self.guarded.as_ref()?.excluded(x))
    }

    /// States as the pieces want them: with their times where time is an axis.
    pub(super) fn places<'x>(&self, x: &'x [f64], t: impl Fn(usize) -> f64) -> Cow<'x, [f64]> {
        if self.time.is_none() {
            return Cow::Borrowed(x);
        }
        let states = x.chunks_exact(self.states()).enumerate();
        Cow::Owned(
            states
                .flat_map(|(k, x)| x.iter().copied().chain([t(k)]))
                .collect(),
        )
    }

    /// What is said of a state, still without u; with the bounds of p.
    pub(super) fn as_value(&self, x: &[f64], here: &Here<f64>) -> Option<(Value, Vec<f64>)> {
        let all = x.len() + usize::from(self.time.is_some());
        let (moved, mut winding) = self.wound(self.pieces.as_ref()?, x);
        if here.pieces == 0 {
            let s: Vec<f64> = x
                .iter()
                .zip(&self.plan.system.reference)
                .map(|(x, r)| x - r)
                .collect();
            winding = self.unwound(&s).2;
        }
        let said = Said {
            v: here.v,
            p: here.p[..all].to_vec(),
            v_bound: here.v_bound,
            p_bound: here.p_bound[..all].to_vec(),
            sheet: here.sheet,
            pieces: here.pieces as usize,
        };
        Some(self.told(&moved, winding, said, &here.hessian))
    }

    /// u of values, and what the bound of p, one component after the other, makes of it.
    pub(super) fn add_controls(&self, x: &[f64], found: &mut [Option<(Value, Vec<f64>)>]) {
        let n = self.states();
        // Rows of one state: p, then p with each component lower and higher.
        let rows = 1 + 2 * n;
        let states = (ROWS / rows).max(1);
        for (x, found) in x.chunks(states * n).zip(found.chunks_mut(states)) {
            let mut places = Vec::with_capacity(found.len() * rows * n);
            let mut costates = Vec::with_capacity(found.len() * rows * n);
            for (x, (value, bound)) in
                (x.chunks_exact(n).zip(found.iter())).filter_map(|(x, f)| Some((x, f.as_ref()?)))
            {
                for row in 0..rows {
                    places.extend_from_slice(x);
                    let at = costates.len();
                    costates.extend_from_slice(&value.p);
                    if let (1.., Some(bound)) = (row, bound.get(row.wrapping_sub(1) / 2)) {
                        costates[at + (row - 1) / 2] += if row % 2 == 1 { -bound } else { *bound };
                    }
                }
            }
            let u = self.controls(&places, &costates);
            let width = u.len() / (places.len() / n).max(1);
            for ((value, _), own) in (found.iter_mut().flatten()).zip(u.chunks(width.max(1) * rows))
            {
                value.u = own[..width].to_vec();
                let off = own.chunks(width.max(1)).skip(1);
                let off = off.flat_map(|row| row.iter().zip(&value.u).map(|(a, b)| (a - b).abs()));
                value.u_error = off.fold(0.0, f64::max);
            }
        }
    }

    /// The bound of V's error at states, in units of the error that a map in pieces was asked for
    /// (NaN where there is none), and whether V is known. `None` where no error was asked for.
    pub fn excess(&self, x: &[f64]) -> Option<Vec<(f64, bool)>> {
        let region = &self.pieces.as_ref()?.region;
        let many = self.many(x);
        let of = |(v, bound): (&f64, &f64)| {
            (
                bound / (region.error * v.abs().max(region.floor)),
                v.is_finite(),
            )
        };
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

    /// The first component of a state that lies outside the region of the map in pieces, or else of
    /// the scene, with its bounds there; periods do not count.
    pub fn outside(&self, x: &[f64]) -> Option<(usize, [f64; 2])> {
        let bounds = |i: usize| match &self.pieces {
            Some(pieces) => [pieces.region.lo[i], pieces.region.hi[i]],
            None => self.plan.region[i].map(|s| s + self.plan.system.reference[i]),
        };
        (0..x.len()).map(|i| (i, bounds(i))).find(|(i, [lo, hi])| {
            let turns = self.plan.periods[*i]
                .map_or(0.0, |period| period * turns_into(x[*i], [*lo, *hi], period));
            !(*lo..=*hi).contains(&(x[*i] + turns))
        })
    }

    /// Moves a state into the region of the map in pieces, a little within its faces; false where
    /// there is none.
    pub(crate) fn clamp_to_pieces(&self, x: &mut [f64]) -> bool {
        /// Of the region's width.
        const WITHIN: f64 = 1e-6;
        let Some(pieces) = &self.pieces else {
            return false;
        };
        for i in 0..x.len() {
            let (lo, hi) = (pieces.region.lo[i], pieces.region.hi[i]);
            if let Some(period) = self.plan.periods[i] {
                x[i] += turns_into(x[i], [lo, hi], period) * period;
            }
            let margin = WITHIN * (hi - lo);
            x[i] = x[i].clamp(lo + margin, hi - margin);
        }
        true
    }

    /// What is known of V at some states, at a time where that is an axis, on the lowest sheet,
    /// told with their numbers in some order; with second derivatives, and what is too uncertain to
    /// be told as V, where asked for.
    pub(crate) fn each(
        &self,
        x: &[f64],
        t: f64,
        (second, rough): (bool, bool),
        room: &mut Room<f64>,
        mut tell: impl FnMut(usize, Option<&Here<f64>>),
    ) {
        let n = self.states();
        let mut slow = Here::blank();
        let mut ask = |k: usize, tell: &mut dyn FnMut(usize, Option<&Here<f64>>)| {
            let found = self.local_at(&x[k * n..][..n], t);
            if let Some(value) = &found {
                slow.v = value.v;
                slow.v_bound = if value.in_pieces {
                    value.v_error
                } else {
                    f64::NAN
                };
                slow.p[..n].copy_from_slice(&value.p);
                slow.hessian[..n * n].copy_from_slice(&value.hessian);
                slow.sheet = value.sheet;
            }
            tell(k, found.as_ref().map(|_| &slow));
        };
        let t = self.time.map_or(0.0, |last| t.clamp(0.0, last));
        match &self.swift {
            Some(swift) => {
                let excluded = self.excluded(x);
                let is_excluded = |k: usize| excluded.as_ref().is_some_and(|excluded| excluded[k]);
                swift.each(
                    &self.places(x, |_| t),
                    second,
                    room,
                    |k, answer| match answer {
                        _ if is_excluded(k) => tell(k, None),
                        Answer::Rough(_) if !rough => tell(k, None),
                        Answer::Known(here) | Answer::Rough(here) if self.time.is_some() => {
                            let mut here = *here;
                            if second {
                                let hessian = of_states(&here.hessian, n + 1, n);
                                here.hessian[..n * n].copy_from_slice(&hessian);
                            }
                            tell(k, Some(&here));
                        }
                        Answer::Known(here) | Answer::Rough(here) => tell(k, Some(here)),
                        Answer::Unknown => tell(k, None),
                        // What is interpolated between solutions far apart is no law.
                        Answer::Elsewhere if self.pieces_alone || self.beyond.is_some() => {
                            tell(k, None)
                        }
                        Answer::Elsewhere => ask(k, &mut tell),
                    },
                )
            }
            None => (0..x.len() / n).for_each(|k| ask(k, &mut tell)),
        }
    }
}
