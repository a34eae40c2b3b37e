//! For how long the law of a chart is kept before the chart is asked again.
//!
//! A period, where one is asked for. Else as long as the law in use costs next to nothing more than
//! the chart's. Where p is the chart's at the end of a leg and `u` the control of the law in use,
//! that is
//!
//! ```text
//! L(x, u) + p'f(x, u) - min over v of (L(x, v) + p'f(x, v)) >= 0,
//! ```
//!
//! by which J grows faster than V falls. It is compared with the running cost, whose integral is V.
//!
//! Of controls at their bounds this says nothing: they may be the same at the end of a leg, and
//! should have been others on the way. There p of the law in use, q, must be near the chart's: over
//! the range of f under all controls, of which f under the controls of p and of -p is taken, the
//! Hamiltonian must not differ by much,
//!
//! ```text
//! sum over i of |q_i - p_i| |f_i(x, u(p)) - f_i(x, u(-p))|.
//! ```

use super::Setting;
use super::charted::Clock;
use super::equations::Equations;
use crate::backend::cpu::Evaluator;
use crate::model::{ClosedLoop, Horizon};

/// What is lost may be so many times `rtol` of the running cost: what is promised for V.
const LOSS: f64 = 30.0;
/// What p is off by may change the Hamiltonian, over the range of f, by so many times the root of
/// `rtol` of the running cost: what is lost goes with the square of it.
const MISS: f64 = 100.0;
/// p errs with the square of the leg's length, and what is lost goes with the square of that.
const ORDER: f64 = 4.0;
const ORDER_OF_P: f64 = 2.0;
/// A leg is so much shorter than would be just good enough.
const SAFETY: f64 = 0.9;
/// Changes of length from leg to leg.
const SHRINK: f64 = 0.1;
const GROW: f64 = 3.0;
/// Shortest, first and longest legs, of the final time.
const SHORTEST: f64 = 1.0 / 65536.0;
const FIRST: f64 = 1.0 / 4096.0;
const LONGEST: f64 = 1.0 / 8.0;
/// Legs without the chart's law are a sample's interval long, and at most this share of the final
/// time.
const LOST: f64 = 1.0 / 400.0;
/// Legs after which a trajectory's are no longer made shorter than a sample's interval: it slides
/// where V has a kink.
const PATIENCE: u32 = 4096;

/// How long legs are.
pub(super) enum Pace {
    /// All the same.
    Period(f64),
    AsNeeded(Judge),
}

/// Judges legs at their ends.
pub(super) struct Judge {
    /// f and L.
    rates: Evaluator,
    tolerance: f64,
    tolerance_of_p: f64,
    /// Running cost that counts as none.
    floor: f64,
    final_time: f64,
    interval: f64,
}

/// What is thought of a leg: whether it will do, and how long it had better been.
pub(super) struct Verdict {
    pub good: bool,
    pub length: f64,
}

/// What is known at the end of a leg.
pub(super) struct End<'e> {
    /// f and L under the law in use, under the chart's, and under the chart's with -p.
    pub in_use: &'e [f64],
    pub charted: &'e [f64],
    pub opposed: &'e [f64],
    /// The chart's p, and that of the law in use.
    pub p: &'e [f64],
    pub p_in_use: &'e [f64],
}

/// How a trajectory comes along.
#[derive(Clone, Copy)]
pub(super) struct Course {
    /// Where the leg in hand begins.
    pub t: f64,
    /// The next sample's number.
    pub sample: usize,
    /// Length of the leg in hand, 0 before the first; and what the next one should have.
    pub length: f64,
    pub wanted: f64,
    /// Whether the leg in hand is flown under the chart's own law.
    pub charted: bool,
    pub legs: u32,
}

impl Pace {
    /// At times of a horizon, and under disturbances, which say when they change, legs are all the
    /// same; so are those of a method that takes steps of one length.
    pub fn new(setting: &Setting<'_>, equations: &Equations) -> Self {
        let same = setting.closed_loop.period.is_some()
            || matches!(setting.model.horizon, Horizon::Finite { .. })
            || equations.supplied().is_some()
            || !setting.leg_method.adaptive();
        if same {
            Pace::Period(Clock::of(setting.closed_loop).step)
        } else {
            Pace::AsNeeded(Judge::new(setting, equations))
        }
    }

    pub fn first(&self) -> f64 {
        match self {
            Pace::Period(period) => *period,
            Pace::AsNeeded(judge) => FIRST * judge.final_time,
        }
    }

    /// Whether a leg that went wrong is flown again.
    pub fn may_shorten(&self, course: &Course) -> bool {
        matches!(self, Pace::AsNeeded(judge) if course.charted && course.length > judge.shortest(course))
    }

    /// Whether the leg in hand may turn out not to be good enough.
    pub fn judges(&self, course: &Course) -> bool {
        matches!(self, Pace::AsNeeded(_)) && course.charted && course.length > 0.0
    }

    /// Length of legs without the chart's law.
    pub fn leg_of_lost(&self) -> f64 {
        match self {
            Pace::Period(period) => *period,
            Pace::AsNeeded(judge) => judge.interval.min(LOST * judge.final_time),
        }
    }
}

impl Judge {
    fn new(setting: &Setting<'_>, equations: &Equations) -> Self {
        let scene = setting.closed_loop;
        let rtol = setting.numerics.rtol;
        Self {
            rates: Evaluator::new(&equations.rates()),
            tolerance: LOSS * rtol,
            tolerance_of_p: MISS * rtol.sqrt(),
            floor: rtol * setting.value_scale / scene.final_time,
            final_time: scene.final_time,
            interval: scene.interval(),
        }
    }

    fn shortest(&self, course: &Course) -> f64 {
        if course.legs > PATIENCE {
            self.interval
        } else {
            SHORTEST * self.final_time
        }
    }

    /// A leg of which nothing is known at its end.
    pub fn failed(&self, course: &Course) -> Verdict {
        Verdict {
            good: course.length <= self.shortest(course),
            length: (0.5 * course.length).max(self.shortest(course)),
        }
    }

    /// What f and L are under the laws of some vectors.
    pub fn rates(&self, vectors: &[f64], dim: usize) -> Vec<f64> {
        self.rates.eval(vectors, dim)
    }

    /// A leg at whose end these are the laws.
    pub fn verdict(&self, course: &Course, end: &End<'_>) -> Verdict {
        let n = end.p.len();
        let hamiltonian = |rates: &[f64]| -> f64 {
            rates[n] + end.p.iter().zip(rates).map(|(p, f)| p * f).sum::<f64>()
        };
        let cost = end.charted[n].abs() + self.floor;
        let lost = (hamiltonian(end.in_use) - hamiltonian(end.charted)) / (self.tolerance * cost);
        let missed: f64 = (0..n)
            .map(|i| (end.p_in_use[i] - end.p[i]).abs() * (end.charted[i] - end.opposed[i]).abs())
            .sum();
        let missed = missed / (self.tolerance_of_p * cost);
        let shortest = self.shortest(course);
        // What is not a number is not good.
        let good = lost <= 1.0 && missed <= 1.0;
        let fitting = |excess: f64, order: f64| match excess > 0.0 {
            true => SAFETY * excess.powf(-1.0 / order),
            false => GROW,
        };
        let change = match lost.is_nan() || missed.is_nan() {
            true => f64::NAN,
            false => fitting(lost, ORDER).min(fitting(missed, ORDER_OF_P)),
        };
        let change = if change.is_nan() {
            SHRINK
        } else {
            change.clamp(SHRINK, GROW)
        };
        Verdict {
            good: good || course.length <= shortest,
            // Of few samples the interval may be above the longest.
            length: (change * course.length)
                .min(LONGEST * self.final_time)
                .max(shortest),
        }
    }
}

impl Course {
    pub fn new(pace: &Pace) -> Self {
        Self {
            t: 0.0,
            sample: 1,
            length: 0.0,
            wanted: pace.first(),
            charted: false,
            legs: 0,
        }
    }

    /// The time at which the next leg has to end at the latest.
    pub fn stop(&self, scene: &ClosedLoop, sampled: bool) -> f64 {
        if sampled && self.sample < scene.samples {
            scene.interval() * self.sample as f64
        } else {
            scene.final_time
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::expr::{Graph, Kind};
    use crate::program::Program;

    /// A judge of a problem to t = 8 in samples of 4, and a leg of 0.5 from its start.
    fn setting() -> (Judge, Course) {
        let mut graph = Graph::default();
        let x = graph.symbol("x", Kind::State);
        let judge = Judge {
            rates: Evaluator::new(&Program::lower(&graph, &[x], &[x, x])),
            tolerance: 1e-5,
            tolerance_of_p: 0.1,
            floor: 1e-9,
            final_time: 8.0,
            interval: 4.0,
        };
        let course = Course {
            t: 0.0,
            sample: 1,
            length: 0.5,
            wanted: 0.5,
            charted: true,
            legs: 1,
        };
        (judge, course)
    }

    /// A trajectory that slides has legs of a sample's interval, also where that is longer than all
    /// others.
    #[test]
    fn few_samples_make_no_leg_impossible() {
        let (judge, course) = setting();
        // The law in use costs 1 more than the chart's: by far too much, but it is not flown again.
        let end = End {
            in_use: &[0.0, 2.0],
            charted: &[0.0, 1.0],
            opposed: &[0.0, 1.0],
            p: &[1.0],
            p_in_use: &[1.0],
        };
        let sliding = Course {
            legs: PATIENCE + 1,
            ..course
        };
        let verdict = judge.verdict(&sliding, &end);
        assert!(verdict.good);
        assert_eq!(verdict.length, 4.0);
        let verdict = judge.verdict(&course, &end);
        assert!(!verdict.good);
        assert_eq!(verdict.length, 0.05);
    }

    /// A control at its bound at the end may have been at another on the way, if p of the law in
    /// use is far from the chart's.
    #[test]
    fn p_is_judged_where_controls_are_at_their_bounds() {
        let (judge, course) = setting();
        // x' = u between -1 and 1, u = -1 under both laws, L = 2.
        let end = |p_in_use: f64| {
            let p_in_use = [p_in_use];
            let end = End {
                in_use: &[-1.0, 2.0],
                charted: &[-1.0, 2.0],
                opposed: &[1.0, 2.0],
                p: &[3.0],
                p_in_use: &p_in_use,
            };
            judge.verdict(&course, &end)
        };
        let near = end(3.025);
        assert!(near.good);
        assert!(
            (near.length / 0.5 - SAFETY * 2.0).abs() < 1e-9,
            "{}",
            near.length
        );
        let far = end(5.0);
        assert!(!far.good);
        assert!(far.length < 0.25 * 0.5);
    }
}
