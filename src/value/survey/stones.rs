//! Stepping stones: states over the whole region, the same ones for every request, from whose
//! solutions single states are solved for too. What is found at a single state so does not hang on
//! which others were asked for with it.

use super::spread::Effort;
use super::{Progress, SHORT, Survey, Task, Wanted};
use crate::backend::BackendError;
use crate::numeric::random::uniform;
use crate::shooting::Solver;
use crate::value::approach::Approach;
use crate::value::archive::Archive;
use crate::value::cover::Cover;
use crate::value::flight::homeward;
use crate::value::targets::Targets;

/// Stepping stones, and the shares of the region in which they lie, by turns.
const STONES: u64 = 64;
const SHARES: [f64; 2] = [1.0, 0.5];
/// Of the stones' extremals those nearest to a state that are tried; and on how many further sheets
/// the nearest one.
const NEAREST: usize = 6;
const SHEETS: usize = 6;

impl Survey<'_> {
    /// Solves for single states where nothing shows which extremals there are: from trajectories
    /// that are optimized directly, and where that leaves a doubt from stepping stones.
    pub(super) fn search_singly(
        &mut self,
        solver: &mut Solver,
        archive: &Archive,
        cover: Option<&mut Cover<'_>>,
        wanted: Wanted,
        progress: Progress<'_>,
    ) -> Result<(), BackendError> {
        let is_shown = cover.as_ref().is_some_and(|c| c.has_cells());
        if is_shown || self.plan.game || self.plan.system.terminal.is_some() {
            return Ok(());
        }
        let mut doubtful: Vec<usize> = (0..self.targets.len())
            .filter(|t| !self.targets.gridded[*t] && !self.is_refused(*t))
            .filter(|t| !solver.scheme.end.covers(&self.state(*t, 0)))
            .collect();
        if doubtful.is_empty() {
            return Ok(());
        }
        let left = self.with_direct(|survey, direct| {
            survey.try_optimized(solver, direct, &doubtful, progress)
        })?;
        doubtful = left.unwrap_or(doubtful);
        if !doubtful.is_empty() {
            self.over_stones(solver, archive, cover, wanted, &doubtful)?;
            progress("from stepping stones", self.solved(), self.targets.len());
        }
        Ok(())
    }

    fn over_stones(
        &mut self,
        solver: &mut Solver,
        archive: &Archive,
        cover: Option<&mut Cover<'_>>,
        wanted: Wanted,
        doubtful: &[usize],
    ) -> Result<(), BackendError> {
        let mut targets = Targets::new(
            self.targets.states,
            &[],
            &[],
            &self.stones(),
            &self.plan.widths,
        );
        // They stand side by side, as the points of a grid do.
        targets.gridded.fill(true);
        let mut stones = Survey::new(self.plan, &targets, solver)?;
        let mut quiet = |_: &str, _: usize, _: usize| ();
        let index = stones.begin(solver, archive, cover.as_deref())?;
        stones.first_search(solver, archive, &index, cover, wanted, &mut quiet)?;
        stones.spread(solver, wanted, Effort::Neighbours, &mut quiet)?;
        stones.check_by_flights(solver, &mut quiet)?;
        stones.label();
        self.evaluations += stones.evaluations;
        let mut tasks = Vec::new();
        for &target in doubtful {
            for e in stones.nearest_to(&self.state(target, 0)) {
                let path = stones.extremals[e].path.clone();
                let winding = self.winding_near(target, path.start());
                tasks.push(Task {
                    from: None,
                    target,
                    winding,
                    way: Approach::from_solution(path, self.state(target, winding), SHORT),
                });
            }
        }
        self.send(solver, tasks)?;
        Ok(())
    }

    /// The stepping stones, absolute.
    pub(super) fn stones(&self) -> Vec<f64> {
        let (plan, n) = (self.plan, self.targets.states);
        let number = |k: u64, i: usize| {
            let [lo, hi] = plan.region[i];
            SHARES[k as usize % SHARES.len()]
                * (lo + uniform(0, k * n as u64 + i as u64) * (hi - lo))
        };
        (0..STONES)
            .flat_map(|k| (0..n).map(move |i| plan.system.reference[i] + number(k, i)))
            .collect()
    }

    /// The extremals nearest to a state, a deviation, and the nearest ones on further sheets.
    fn nearest_to(&self, s: &[f64]) -> Vec<usize> {
        let far = |e: usize| -> f64 {
            let start = self.extremals[e].path.start();
            let apart: Vec<f64> = s.iter().zip(start).map(|(a, b)| a - b).collect();
            (homeward(&apart, &self.plan.periods)
                .iter()
                .zip(&self.plan.widths))
            .map(|(apart, width)| (apart / width).powi(2))
            .sum()
        };
        let mut order: Vec<(f64, usize)> = (0..self.extremals.len()).map(|e| (far(e), e)).collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut chosen: Vec<usize> = order.iter().take(NEAREST).map(|(_, e)| *e).collect();
        for (_, e) in order.into_iter().skip(NEAREST) {
            let is_new = chosen.iter().all(|c| self.lifted[*c] != self.lifted[e]);
            if is_new && chosen.len() < NEAREST + SHEETS {
                chosen.push(e);
            }
        }
        chosen
    }
}
