//! First guesses from the local solution about the equilibrium.

use super::{SHORT, Survey, Task};
use crate::shooting::{End, Path, Solved, Solver};
use crate::value::approach::Approach;
use crate::value::extremal::Extremal;

impl Survey<'_> {
    /// Targets so near the equilibrium that the local solution answers.
    pub(super) fn near_end(&mut self, solver: &Solver) {
        for target in 0..self.targets.len() {
            for winding in 0..self.windings.len() {
                let s = self.state(target, winding);
                if self.is_refused(target) || !solver.scheme.end.covers(&s) {
                    continue;
                }
                let at = solver.scheme.end.at(&s);
                let slope = solver.scheme.equations.scaled_slope(&at.hessian);
                let solved = Solved {
                    value: at.value,
                    slope: Some(slope),
                    fold: 1.0,
                    residual: 0.0,
                    t: 0.0,
                };
                let path = Path::new(&[s.as_slice(), &at.gradient].concat());
                self.add(Extremal {
                    target,
                    winding,
                    path,
                    solved,
                    iterations: 0,
                });
            }
        }
    }

    /// Guesses that follow the linear closed loop, from a state on the way to the target near which
    /// it holds.
    pub(super) fn linear_guesses(&self, end: &End, targets: &[usize], least: f64) -> Vec<Task> {
        let open = targets
            .iter()
            .filter(|t| self.is_open(**t) && self.targets.limits[**t] == f64::INFINITY);
        open.filter_map(|&target| {
            let (path, goal) = self.linear_path(end, target)?;
            Some(Task {
                from: None,
                target,
                winding: 0,
                way: Approach::new(path, goal, least),
            })
        })
        .collect()
    }

    /// Straight ways from the local solution to targets.
    pub(super) fn rays(&self, end: &End, targets: &[usize], longest: f64) -> Vec<Task> {
        // Of the distance from the equilibrium where the way begins.
        const SHORTEST: f64 = 1.0 / 64.0;
        let near = self.plan.local.as_ref().map_or(0.0, |l| l.seed_value);
        let ray = |&target: &usize| {
            let goal = self.state(target, 0);
            let share = self
                .plan
                .local
                .as_ref()
                .map(|l| (near / l.quadratic(&goal)).sqrt().min(1.0))?;
            let s: Vec<f64> = goal.iter().map(|g| share * g).collect();
            let at = end.at(&s);
            let mut path = Path::new(&[s.as_slice(), &at.gradient].concat());
            let (nodes, durations) = end.tail(&s, at.value, self.duration);
            path.append(&nodes, &durations);
            Some(Task {
                from: None,
                target,
                winding: 0,
                way: Approach::along(path, goal, SHORT.min(SHORTEST * share), longest),
            })
        };
        targets.iter().filter_map(ray).collect()
    }

    /// A path of the linear closed loop from a state on the way to a target near which it holds;
    /// with the target's state.
    pub(super) fn linear_path(&self, end: &End, target: usize) -> Option<(Path, Vec<f64>)> {
        let goal = self.state(target, 0);
        let (value, _) = end.linear(&goal)?;
        let near = self.plan.local.as_ref().map_or(0.0, |l| l.seed_value);
        let share = (near / value).sqrt().min(1.0);
        let s: Vec<f64> = goal.iter().map(|g| share * g).collect();
        let (value, p) = end.linear(&s)?;
        let mut path = Path::new(&[s.as_slice(), &p].concat());
        let (nodes, durations) = end.tail(&s, value, self.duration);
        path.append(&nodes, &durations);
        Some((path, goal))
    }
}
