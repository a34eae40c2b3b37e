//! Greedy paths: from a state step by step under the control whose step and value at its end cost
//! least.

use super::equations::Equations;
use super::level::{last, middle, whole};
use super::{GridValue, Stride};
use crate::local::LocalSolution;
use crate::shooting::{End, Path};

/// Cells that the step crosses by which a control is judged: short ones are the better controls,
/// longer ones cannot profit from what interpolation leaves out at a kink. Each is tried until a
/// flight costs little more than the value says.
const CELLS: [f64; 3] = [0.75, 3.0, 6.0];
/// Cells that are flown before the next choice.
const FLOWN: f64 = 0.75;
const ENOUGH: f64 = 1.02;
/// Parts in which a step is integrated.
const PARTS: usize = 4;
/// Share of the fastest mode's time constant that a step lasts at most, and one near the
/// equilibrium.
const LONGEST: f64 = 0.25;
const LONGEST_LOCAL: f64 = 0.1;
/// Steps at most.
const STEPS: usize = 20_000;
/// A path that has cost this many times the value at its beginning goes nowhere.
const DEAREST: f64 = 4.0;
/// Cells from the equilibrium within which the local law is flown.
const NEAR: f64 = 1.5;
/// Segments of a path at most.
const SEGMENTS: f64 = 400.0;
/// Improvements of a step's control by the costate at its end.
const COSTATES: usize = 2;

/// A flown path: states and costates, times and the cost so far.
struct Flight {
    s: Vec<f64>,
    time: f64,
    cost: f64,
    cells: f64,
    control: Vec<f64>,
    /// `(time, s, p)`.
    nodes: Vec<(f64, Vec<f64>, Vec<f64>)>,
}

impl GridValue {
    /// The greedy path from a deviation: what its flight costs, the cost from its end on included,
    /// which V is at most; and its nodes `(s, p)` in forward time with p the grid's gradient. On an
    /// infinite horizon it ends in the local solution's range with that solution's tail, and where
    /// the flight went round a periodic axis the whole path is moved by periods so that it ends at
    /// the reference: its first state may be a copy of `s`. `None` where s is not reached, or the
    /// flight leads nowhere.
    pub fn greedy(&self, s: &[f64]) -> Option<(f64, Path)> {
        self.greedy_in_parts(s, 1)
    }

    /// The same with nodes so many times closer together.
    pub fn greedy_in_parts(&self, s: &[f64], parts: usize) -> Option<(f64, Path)> {
        let (s, value, _) = self.best_copy(s)?;
        let mut best: Option<Flight> = None;
        for cells in CELLS {
            let Some(flight) = self.flight(&s, value, cells) else {
                continue;
            };
            let enough = flight.cost <= value + (ENOUGH - 1.0) * value.abs();
            if best.as_ref().is_none_or(|b| flight.cost < b.cost) {
                best = Some(flight);
            }
            if enough {
                break;
            }
        }
        best.map(|flight| self.path_of(flight, self.segment / parts as f64))
    }

    /// A flight whose controls are judged by steps of so many cells.
    fn flight(&self, s: &[f64], value: f64, cells: f64) -> Option<Flight> {
        let mut flight = Flight {
            s: s.to_vec(),
            time: 0.0,
            cost: 0.0,
            cells,
            control: self.node_control(s)?,
            nodes: Vec::new(),
        };
        match &self.end {
            End::Manifold(local) => self.fly_to_rest(&mut flight, local, DEAREST * value.abs())?,
            End::Terminal { time, .. } => self.fly_until(&mut flight, *time)?,
        }
        Some(flight)
    }

    /// Value and gradient at a time.
    fn value_at(&self, time: f64, s: &[f64]) -> Option<(f64, Vec<f64>)> {
        if self.slices.is_empty() {
            return self.at(&self.grid.values, s);
        }
        let place = (time / self.slice_step).clamp(0.0, (self.slices.len() - 1) as f64);
        let k = (place as usize).min(self.slices.len() - 2);
        let fraction = place - k as f64;
        let (before, after) = (
            self.at(&self.slices[k], s)?,
            self.at(&self.slices[k + 1], s)?,
        );
        let between = |a: f64, b: f64| a + fraction * (b - a);
        let p = before
            .1
            .iter()
            .zip(&after.1)
            .map(|(a, b)| between(*a, *b))
            .collect();
        Some((between(before.0, after.0), p))
    }

    /// The control of the nearest node.
    fn node_control(&self, s: &[f64]) -> Option<Vec<f64>> {
        let m = self.equations.controls;
        let node = self.grid.lattice.nearest(s)?;
        Some(self.controls[node * m..][..m].to_vec())
    }

    fn fly_to_rest(&self, flight: &mut Flight, local: &LocalSolution, dearest: f64) -> Option<()> {
        let level = super::stationary::local_level(local);
        let fastest = local
            .riccati
            .eigenvalues
            .iter()
            .map(|e| e.norm())
            .fold(0.0, f64::max);
        let lattice = &self.grid.lattice;
        for _ in 0..STEPS {
            let near = lattice.wrapped(&flight.s);
            if local.quadratic(&near) <= level {
                let at = local.expansion(&near);
                flight.nodes.push((flight.time, flight.s.clone(), at.1));
                flight.cost += at.0;
                return Some(());
            }
            if near
                .iter()
                .zip(&lattice.axes)
                .all(|(s, a)| s.abs() <= NEAR * a.step)
            {
                self.local_step(flight, local, &near, LONGEST_LOCAL / fastest)?;
            } else {
                self.greedy_step(flight, LONGEST / fastest)?;
            }
            if flight.cost > dearest {
                return None;
            }
        }
        None
    }

    /// One step under the linearization's law.
    fn local_step(
        &self,
        flight: &mut Flight,
        local: &LocalSolution,
        near: &[f64],
        time: f64,
    ) -> Option<()> {
        let p = &local.riccati.p * nalgebra::DVector::from_column_slice(near);
        let u = self.equations.law.eval(&[&flight.s, p.as_slice()].concat());
        let (s, cost) = self.equations.flown(&flight.s, &u, time)?;
        flight.moved(p.as_slice().to_vec(), s, cost, time, u);
        Some(())
    }

    fn fly_until(&self, flight: &mut Flight, end: f64) -> Option<()> {
        // What is left after the last step is rounding.
        while end - flight.time > 1e-12 * end {
            let left = end - flight.time;
            self.greedy_step(flight, left.min(self.slice_step))?;
        }
        let at = self.end.at(&flight.s);
        flight.cost += at.value;
        flight
            .nodes
            .push((flight.time, flight.s.clone(), at.gradient));
        Some(())
    }

    /// The step from where a flight is that costs least with the value at its end.
    fn greedy_step(&self, flight: &mut Flight, longest: f64) -> Option<()> {
        let (n, s) = (self.equations.states, flight.s.clone());
        let (_, p) = self.value_at(flight.time, &s)?;
        let cells = flight.cells;
        let stride = Stride::Cells { cells, longest };
        let mut best: Option<(f64, Vec<f64>, f64)> = None;
        let mut attempt = |u: &[f64]| -> Option<Vec<f64>> {
            let mut u = u.to_vec();
            self.equations.bounded(&mut u);
            let first = self.equations.motion.eval(&[s.as_slice(), &u].concat());
            let time = stride.duration(&self.grid.lattice, &first[..n]);
            let (end, cost) = self.equations.step(&s, &u, time)?;
            let (value, p) = self.value_at(flight.time + time, &end)?;
            // Steps of different lengths: each is judged by the whole cost.
            if best.as_ref().is_none_or(|b| cost + value < b.0) {
                best = Some((cost + value, u, time));
            }
            Some(p)
        };
        let law = |p: &[f64]| self.equations.law.eval(&[s.as_slice(), p].concat());
        attempt(&flight.control);
        if let Some(u) = self.node_control(&s) {
            attempt(&u);
        }
        let mut costate = p.clone();
        for _ in 0..=COSTATES {
            match attempt(&law(&costate)) {
                Some(at_end) => costate = at_end,
                None => break,
            }
        }
        for u in &self.spread {
            attempt(u);
        }
        let (_, u, time) = best?;
        let time = time * (FLOWN / cells).min(1.0);
        let (end, cost) = self.equations.flown(&s, &u, time)?;
        flight.moved(p, end, cost, time, u);
        Some(())
    }

    /// Nodes at least a time `segment` apart, the tail behind them.
    fn path_of(&self, flight: Flight, segment: f64) -> (f64, Path) {
        let lattice = &self.grid.lattice;
        let (total, nodes) = (flight.time, flight.nodes);
        let end = nodes.last().map_or(Vec::new(), |n| n.1.clone());
        let copy: Vec<f64> = match &self.end {
            End::Manifold(_) => end
                .iter()
                .zip(lattice.wrapped(&end))
                .map(|(s, w)| w - s)
                .collect(),
            End::Terminal { .. } => vec![0.0; end.len()],
        };
        let joined = |(_, s, p): &(f64, Vec<f64>, Vec<f64>)| -> Vec<f64> {
            s.iter()
                .zip(&copy)
                .map(|(s, c)| s + c)
                .chain(p.iter().copied())
                .collect()
        };
        let shortest = segment.max(total / SEGMENTS);
        let mut path = Path::new(&joined(&nodes[0]));
        let mut at = nodes[0].0;
        for (k, node) in nodes.iter().enumerate().skip(1) {
            let next = nodes.get(k + 1).map_or(f64::INFINITY, |n| n.0);
            if next - at > shortest {
                path.push(node.0 - at, &joined(node));
                at = node.0;
            }
        }
        let s = path.last()[..end.len()].to_vec();
        let (tail, durations) = self.end.tail(&s, flight.cost, self.segment);
        path.append(&tail, &durations);
        (flight.cost, path)
    }
}

impl Flight {
    fn moved(&mut self, p: Vec<f64>, to: Vec<f64>, cost: f64, time: f64, control: Vec<f64>) {
        let from = std::mem::replace(&mut self.s, to);
        self.nodes.push((self.time, from, p));
        self.time += time;
        self.cost += cost;
        self.control = control;
    }
}

impl Equations {
    /// One step of Kutta's third-order method under a constant control: its end and its cost.
    fn step(&self, s: &[f64], u: &[f64], time: f64) -> Option<(Vec<f64>, f64)> {
        let n = self.states;
        let mut point = [s, u].concat();
        let k1 = self.motion.eval(&point);
        middle(s, &k1, time, &mut point[..n]);
        let k2 = self.motion.eval(&point);
        last(s, &k1, &k2, time, &mut point[..n]);
        let k3 = self.motion.eval(&point);
        let valid =
            self.is_valid(&k1) && self.is_valid(&k2) && k3[..=n].iter().all(|x| x.is_finite());
        let by = |c: usize| whole(k1[c], k2[c], k3[c], time);
        valid.then(|| ((0..n).map(|c| s[c] + by(c)).collect(), by(n)))
    }

    /// The same in several parts.
    fn flown(&self, s: &[f64], u: &[f64], time: f64) -> Option<(Vec<f64>, f64)> {
        let (mut s, mut cost) = (s.to_vec(), 0.0);
        for _ in 0..PARTS {
            let (end, part) = self.step(&s, u, time / PARTS as f64)?;
            (s, cost) = (end, cost + part);
        }
        Some((s, cost))
    }
}
