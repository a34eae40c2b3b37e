//! States searched for all sheets.

use super::Work;
use crate::backend::BackendError;
use crate::map::pieces::MOST_VARIABLES;
use crate::shooting::Path;
use crate::value::{self, Answers, Request, Track};
use std::collections::BTreeMap;

impl Work<'_, '_> {
    /// Solves for states (absolute) with a search for all sheets; the tracks of the answers, and V.
    /// Of other sheets that may be the lowest within `half` of a state (in the frame's coordinates)
    /// the state itself. V is NaN where there is none.
    pub(super) fn searched(
        &mut self,
        states: Vec<f64>,
        half: f64,
    ) -> Result<(Vec<Track>, Vec<f64>), BackendError> {
        let half = vec![half; self.cloud.variables];
        let mut given = vec![f64::NAN; states.len() / self.cloud.variables];
        let mut tracks = Vec::new();
        let v = self.cloud.variables;
        for (numbers, answers) in self.solve(states.clone(), self.axis.is_some())? {
            let (values, mut found, others) = self.taken(&answers, &half);
            if let Some(axis) = &mut self.axis {
                found = axis.unfolded(found, &others)?;
            }
            tracks.extend(found);
            for (number, target) in numbers.into_iter().zip(&answers.targets.of_given) {
                given[number] = values[*target];
                // Of V(x, 0) only states that are solved tell; where V depends on no time their
                // trajectories do, too.
                if self.tells_of_beginnings() && values[*target].is_finite() {
                    let x = states[number * v..][..v].to_vec();
                    self.asked.push((x, values[*target]));
                }
                if values[*target].is_nan() {
                    let cut = answers.misses[*target].as_ref().and_then(|m| m.cut.clone());
                    self.note(&states[number * v..][..v], (answers.status(*target), cut));
                }
            }
        }
        Ok((tracks, given))
    }

    /// Solves for states; where time is an axis, those of one time after the other. Of each answers
    /// the numbers of its states.
    pub(super) fn solve(
        &mut self,
        states: Vec<f64>,
        in_company: bool,
    ) -> Result<Vec<(Vec<usize>, Answers)>, BackendError> {
        let v = self.cloud.variables;
        if self.axis.is_none() {
            let numbers = (0..states.len() / v).collect();
            return Ok(vec![(numbers, self.solve_from(0.0, states, in_company)?)]);
        }
        // Times are not negative: their bits are in their order.
        let mut by_time: BTreeMap<u64, (Vec<usize>, Vec<f64>)> = BTreeMap::new();
        for (k, x) in states.chunks(v).enumerate() {
            let (numbers, points) = by_time.entry(x[v - 1].to_bits()).or_default();
            numbers.push(k);
            points.extend_from_slice(&x[..v - 1]);
        }
        (by_time.into_iter())
            .map(|(t, (numbers, points))| {
                Ok((
                    numbers,
                    self.solve_from(f64::from_bits(t), points, in_company)?,
                ))
            })
            .collect()
    }

    fn solve_from(
        &mut self,
        t: f64,
        points: Vec<f64>,
        in_company: bool,
    ) -> Result<Answers, BackendError> {
        let request = Request {
            points,
            in_company,
            value_max: self.aim.value_max,
            ..Request::default()
        };
        if let Some(axis) = self.axis.as_mut().filter(|_| t > 0.0) {
            let from = axis.from(t, self.plan, self.model)?;
            let (plan, model, archive) = (&from.plan, &from.model, &from.archive);
            from.solver.deadline = self.solver.deadline;
            return value::solve(
                plan,
                model,
                &mut from.solver,
                archive,
                &request,
                &mut *self.progress,
            );
        }
        value::solve(
            self.plan,
            self.model,
            self.solver,
            self.archive,
            &request,
            &mut *self.progress,
        )
    }

    /// V at each target, and tracks, with whether each is of another sheet than the lowest.
    fn taken(&mut self, answers: &Answers, half: &[f64]) -> (Vec<f64>, Vec<Track>, Vec<bool>) {
        let mut values = vec![f64::NAN; answers.targets.len()];
        let (mut tracks, mut dearer) = (Vec::new(), Vec::new());
        for target in 0..answers.targets.len() {
            self.cloud.several |= answers.of(target).len() > 1;
            let found = answers.answer(target);
            let Some(answer) = found.filter(|a| a.value <= self.most_value()) else {
                self.failed += 1;
                self.above_max += usize::from(found.is_some());
                continue;
            };
            self.states += 1;
            values[target] = answer.value;
            let others = answers
                .of(target)
                .iter()
                .filter(|e| !self.plan.game && e.value > answer.value);
            let near = others
                .filter(|e| self.may_cross((&answer.path, answer.value), (&e.path, e.value), half));
            let near: Vec<Track> = near.map(|e| Track::of(e, false)).collect();
            tracks.push(Track::of(answer, true));
            tracks.extend(near);
            dearer.push(false);
            dearer.resize(tracks.len(), true);
        }
        (values, tracks, dearer)
    }

    /// Whether a solution may cost as little as the lowest one within a cell around their state.
    fn may_cross(&self, lowest: (&Path, f64), other: (&Path, f64), half: &[f64]) -> bool {
        let n = half.len();
        let mut q = [[0.0; MOST_VARIABLES]; 2];
        let reference = &self.plan.system.reference;
        let mut x: Vec<f64> = lowest
            .0
            .start()
            .iter()
            .zip(reference)
            .map(|(s, r)| s + r)
            .collect();
        x.extend(self.axis.as_ref().map(|axis| axis.begins(lowest.0)));
        let mut z = [0.0; MOST_VARIABLES];
        self.frame.of(&x, &mut z[..n]);
        for (q, path) in q.iter_mut().zip([lowest.0, other.0]) {
            let mut p = path.adjoint().to_vec();
            p.extend(
                self.axis
                    .iter()
                    .flat_map(|axis| axis.rates(path.node(0), path.width)),
            );
            self.frame.gradient_of(&z[..n], &p, &mut q[..n]);
        }
        let change: f64 = (0..n).map(|i| (q[1][i] - q[0][i]).abs() * half[i]).sum();
        other.1 - lowest.1 <= change
    }
}
