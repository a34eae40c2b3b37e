//! What is decided between the periods of a flight: whether it is home, how long the next period
//! is, its guess.

use super::{Flight, FlightEnd, Flown, costate, homeward};
use crate::local::{LocalSolution, closed_loop_margin};
use crate::program::Program;
use crate::shooting::{End, Path};
use crate::sweep::{Plan, guard_holds};

/// Periods of a first guess' segment: the first, the shortest and the longest one of a flight.
const FIRST: f64 = 1.0 / 6.0;
const SHORTEST: f64 = 1.0 / 24.0;
const LONGEST: f64 = 1.0;
/// The longest one where the local expansion holds, in times of the slowest mode.
const SETTLED_PERIOD: f64 = 0.5;
/// Periods of a finite horizon at least.
const FINITE_PERIODS: f64 = 32.0;
/// Relative difference of the law's new answer from the old one above which a period is flown again
/// in shorter ones.
const TOO_DIFFERENT: f64 = 0.03;
/// Relative change of the costate at which a law's new answer is to differ from the old one:
/// periods are made as long as that. What a flight costs too much is of second order in it.
const ANSWERS_DIFFER: f64 = 0.01;
/// A flight is home where the estimated error of the local V, which is added to the cost, is this
/// share of the cost.
const HOME_SHARE: f64 = 1e-9;
/// The local V at home is below this times the quadratic one.
const MOST_VALUE: f64 = 4.0;
/// A guess follows the flight until the expansion's error is this share of V; from there on the
/// local solution.
const SETTLED: f64 = 1e-2;
/// Times of the slowest mode after which a flight is given up.
const LONGEST_FLIGHT: f64 = 100.0;
/// Periods after which it is: where rates are far apart, or a law's answers jump all the time.
const MOST_PERIODS: f64 = 20_000.0;

/// A flight in the air.
pub(super) struct Air {
    /// Which of the flights.
    pub flight: usize,
    pub t: f64,
    pub s: Vec<f64>,
    pub cost: f64,
    period: f64,
    /// Time, state and cost where the last period began.
    before: (f64, Vec<f64>, f64),
    /// Periods flown so far.
    pub periods: u32,
    /// The law's last answer `(q, H)`.
    pub law: Option<(Vec<f64>, Vec<f64>)>,
    /// Whether the state is where the local expansion holds.
    settled: bool,
    /// Points of the guess: times and nodes `(s, p)`.
    times: Vec<f64>,
    nodes: Vec<f64>,
}

impl Air {
    pub fn new(flight: usize, start: &[f64], period: f64) -> Self {
        Self {
            flight,
            t: 0.0,
            s: start.to_vec(),
            cost: 0.0,
            period,
            before: (0.0, start.to_vec(), 0.0),
            periods: 0,
            law: None,
            settled: false,
            times: Vec::new(),
            nodes: Vec::new(),
        }
    }

    fn record(&mut self, p: &[f64]) {
        self.times.push(self.t);
        self.nodes.extend_from_slice(&self.s);
        self.nodes.extend_from_slice(p);
    }
}

/// What a scene's flights have in common.
pub(super) struct Course {
    end: End,
    local: Option<LocalSolution>,
    periods: Vec<Option<f64>>,
    widths: Vec<f64>,
    value_scale: f64,
    guards: Option<(Program, Vec<bool>)>,
    /// Duration of a first guess' segments.
    segment: f64,
    /// Final time of a finite horizon.
    time: Option<f64>,
    /// The first period, and the longest ones.
    pub first: f64,
    longest: f64,
    settled_longest: f64,
    given_up: f64,
    /// Whether the cost of a flight only rises, so that one above the ceiling is not worth flying
    /// on.
    rises: bool,
    /// Share of the usual periods.
    fine: f64,
}

impl Course {
    /// Periods are `fine` times as long as usual: what a flight costs too much goes with the fourth
    /// power.
    pub fn new(plan: &Plan, fine: f64) -> Self {
        let system = &plan.system;
        let guards = (!system.guards.is_empty()).then(|| {
            let exprs: Vec<_> = system.guards.iter().map(|g| g.expr).collect();
            let strict = system.guards.iter().map(|g| g.strict).collect();
            (
                Program::lower(&system.graph, &system.inputs, &exprs),
                strict,
            )
        });
        let segment = plan.segment_duration();
        let slowest = plan
            .local
            .as_ref()
            .map(|l| closed_loop_margin(&l.riccati).recip());
        let time = system.terminal.as_ref().map(|t| t.time);
        let longest =
            fine * (LONGEST * segment).min(time.map_or(f64::INFINITY, |t| t / FINITE_PERIODS));
        Self {
            end: End::new(system, plan.local.as_ref()),
            local: plan.local.clone(),
            periods: plan.recurrent.clone(),
            widths: plan.widths.clone(),
            value_scale: plan.value_scale,
            guards,
            segment,
            time,
            first: (fine * FIRST * segment).min(longest),
            longest,
            settled_longest: slowest.map_or(longest, |slowest| {
                longest.max(fine * SETTLED_PERIOD * slowest)
            }),
            rises: plan.costs_are_positive(),
            fine,
            given_up: slowest.map_or(f64::INFINITY, |slowest| LONGEST_FLIGHT * slowest),
        }
    }

    /// Asks the law for the next period; the result of a flight that has come to its end.
    pub fn steer(&self, air: &mut Air, flight: &Flight<'_>) -> Option<Flown> {
        if air.s.iter().any(|s| !s.is_finite()) || !air.cost.is_finite() {
            return Some(Flown::failed(FlightEnd::Failed));
        }
        if let Some(home) = self.home(air) {
            return Some(home);
        }
        let Some((q, h)) = flight.law.costate(air.t, &air.s) else {
            return Some(Flown::failed(FlightEnd::NoAnswer));
        };
        let p = costate(&q, &h, &air.s);
        if air.t == 0.0 && !self.is_inside(&air.s, &p) {
            return Some(Flown::failed(FlightEnd::LeftGuard));
        }
        if let Some((q, h)) = &air.law {
            let difference = self.difference(&costate(q, h, &air.s), &p);
            let longest = if air.settled {
                self.settled_longest
            } else {
                self.longest
            };
            let shortest = (self.fine * SHORTEST * self.segment).min(longest);
            let flown = air.t - air.before.0;
            // It goes with the square of the period.
            let share = self.fine.powi(2);
            let factor = (share * ANSWERS_DIFFER / difference).sqrt().clamp(0.5, 2.0);
            air.period = (flown * factor).clamp(shortest, longest);
            // Only a period that was much longer than the next one is worth doing again.
            if difference > share * TOO_DIFFERENT && flown > 1.5 * air.period {
                (air.t, air.cost) = (air.before.0, air.before.2);
                air.s.clone_from(&air.before.1);
                return None;
            }
        }
        if self.rises && air.cost >= flight.ceiling {
            return Some(Flown::failed(FlightEnd::AboveCeiling));
        }
        if air.t > self.given_up || f64::from(air.periods) > MOST_PERIODS / self.fine {
            return Some(Flown::failed(FlightEnd::TimeUp));
        }
        if !air.settled {
            air.record(&p);
        }
        air.settled = self.is_settled(&air.s);
        (air.before.0, air.before.2) = (air.t, air.cost);
        air.before.1.clone_from(&air.s);
        // What is kept stays where it is: threads that take memory at every period wait for each other.
        match &mut air.law {
            Some((old_q, old_h)) => {
                old_q.clone_from(&q);
                old_h.clone_from(&h);
            }
            none => *none = Some((q, h)),
        }
        None
    }

    /// Relative difference of two costates, in widths.
    fn difference(&self, old: &[f64], new: &[f64]) -> f64 {
        let pairs = || old.iter().zip(new).zip(&self.widths);
        let size = pairs().fold(0.0f64, |most, ((_, new), w)| most.max((new * w).abs()));
        let change = pairs().fold(0.0f64, |most, ((old, new), w)| {
            most.max(((new - old) * w).abs())
        });
        if change > 0.0 { change / size } else { 0.0 }
    }

    /// The periods that are left out of a state while it is integrated: near another winding of the
    /// equilibrium it is as accurate as near the one at 0. Guards are not asked to be periodic;
    /// with them nothing is left out.
    pub fn turns(&self, s: &[f64]) -> Vec<f64> {
        if self.time.is_some() || self.guards.is_some() {
            return vec![0.0; s.len()];
        }
        let home = homeward(s, &self.periods);
        s.iter().zip(home).map(|(s, home)| s - home).collect()
    }

    /// About the cost of the whole flight.
    pub fn unit(&self, air: &Air) -> f64 {
        let left = match &self.local {
            Some(local) => local.quadratic(&homeward(&air.s, &self.periods)),
            None => self.end.at(&air.s).value.abs(),
        };
        let unit = air.cost.abs() + left;
        if unit > 0.0 && unit.is_finite() {
            unit
        } else {
            self.value_scale
        }
    }

    fn is_inside(&self, s: &[f64], p: &[f64]) -> bool {
        self.guards.as_ref().is_none_or(|(program, strict)| {
            let values = program.eval(&[s, p].concat());
            values
                .iter()
                .zip(strict)
                .all(|(v, strict)| guard_holds(*v, *strict))
        })
    }

    /// Whether a guess may go on with the local solution.
    fn is_settled(&self, s: &[f64]) -> bool {
        self.local.as_ref().is_some_and(|local| {
            let quadratic = local.quadratic(&homeward(s, &self.periods));
            quadratic <= local.value_within(SETTLED * quadratic, f64::INFINITY)
        })
    }

    /// The result of a flight that has come home.
    fn home(&self, air: &Air) -> Option<Flown> {
        let home = homeward(&air.s, &self.periods);
        let rest = match (&self.local, self.time) {
            (_, Some(time)) => (air.t >= time).then(|| self.end.at(&air.s).value)?,
            (Some(local), None) => {
                let quadratic = local.quadratic(&home);
                let within = |cost: f64| local.value_within(HOME_SHARE * cost, f64::INFINITY);
                // Most are far from home, and the expansion takes a while.
                if quadratic > within(air.cost.abs() + MOST_VALUE * quadratic) {
                    return None;
                }
                let value = local.expansion(&home).0;
                (quadratic <= within((air.cost + value).abs()))
                    .then(|| value + local.error_where(quadratic))?
            }
            (None, None) => return None,
        };
        let cost = air.cost + rest;
        Some(Flown {
            cost,
            path: Some(self.path(air, &home, cost)),
            end: FlightEnd::Home,
        })
    }

    /// The guess of a flight that is home: its points as far apart as a first guess' segments, with
    /// the local tail.
    fn path(&self, air: &Air, home: &[f64], cost: f64) -> Path {
        let n = home.len();
        let infinite = self.time.is_none();
        // Moved by the periods that separate the equilibrium it came to from the one at 0.
        let turns: Vec<f64> = (air.s.iter().zip(home))
            .map(|(s, home)| if infinite { s - home } else { 0.0 })
            .collect();
        let moved = |k: usize| -> Vec<f64> {
            let mut node = air.nodes[2 * n * k..2 * n * (k + 1)].to_vec();
            node.iter_mut().zip(&turns).for_each(|(s, turn)| *s -= turn);
            node
        };
        let end = if infinite { home } else { &air.s };
        let last = [end, &self.end.at(end).gradient].concat();
        let Some(&from) = air.times.first() else {
            // Home from the beginning.
            let mut path = Path::new(&last);
            let (nodes, durations) = self.end.tail(home, cost, self.segment);
            path.append(&nodes, &durations);
            return path;
        };
        let mut path = Path::new(&moved(0));
        let mut at = from;
        let points = air.times.len();
        for k in 1..points {
            // The last point that is not too far away, or the next one.
            let next = air.times.get(k + 1).copied().unwrap_or(f64::INFINITY);
            let is_last = k + 1 == points && infinite;
            if is_last || next - at > self.segment * (1.0 + 1e-9) {
                path.push(air.times[k] - at, &moved(k));
                at = air.times[k];
            }
        }
        if infinite {
            let s = path.last()[..n].to_vec();
            let (nodes, durations) = self.end.tail(&s, cost, self.segment);
            path.append(&nodes, &durations);
        } else {
            // By what is left, so that the durations add up to the horizon.
            path.push(air.t - path.horizon(), &last);
        }
        path
    }

    /// Duration of the next period, and the time at its end.
    pub fn next(&self, air: &Air) -> (f64, f64) {
        let Some(time) = self.time else {
            return (air.period, air.t + air.period);
        };
        let left = time - air.t;
        // Equal parts of what is left, none of them a scrap; the last one ends at the final time
        // itself.
        let parts = (left / air.period * (1.0 - 1e-9)).ceil();
        if parts <= 1.0 {
            (left, time)
        } else {
            (left / parts, air.t + left / parts)
        }
    }
}

impl Flown {
    pub(super) fn failed(end: FlightEnd) -> Self {
        Self {
            cost: f64::INFINITY,
            path: None,
            end,
        }
    }
}
