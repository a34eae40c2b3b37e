//! Recording of a scene's integration steps as vector code.

use super::arithmetic::{Arithmetic, Comparison};
use super::code::{Recorder, Value};
use super::real::Real;
use super::taylor::Series;
use super::{decide, taylor};
use crate::backend::{Run, Spec, Variant};
use crate::integrator::{Scheme, Tableau, control};
use crate::program::Program;

/// What a trajectory is between steps, as places in a frame. One such region is read by a step and
/// another one written.
#[derive(Clone, Copy, Debug)]
pub struct State {
    pub y: usize,
    /// Derivative at y; kept for Runge-Kutta steps.
    pub k: usize,
    pub t: usize,
    /// The step to attempt; for a Taylor step the longest one allowed.
    pub wanted: usize,
    /// Base-2 logarithm of the squared error of the step before; of Taylor steps the size of that
    /// step.
    pub before: usize,
    /// Step size to go on with behind a kink; 0 where none is ahead.
    pub resume: usize,
    /// Accepted and refused steps so far.
    pub steps: usize,
    pub rejected: usize,
    /// Values of the kinks at y.
    pub kinks: usize,
    pub end: usize,
}

impl State {
    fn new(first: usize, spec: &Spec, scheme: Scheme) -> Self {
        let dim = spec.dim();
        let y = first;
        let k = y + dim;
        let t = match scheme {
            Scheme::RungeKutta(_) => k + dim,
            Scheme::Taylor(_) => k,
        };
        let kinks = t + 6;
        // A Taylor step looks for kinks in its own polynomials.
        let kept = match scheme {
            Scheme::RungeKutta(_) => spec.kinks.as_ref().map_or(0, |p| p.outputs.len()),
            Scheme::Taylor(_) => 0,
        };
        Self {
            y,
            k,
            t,
            wanted: t + 1,
            before: t + 2,
            resume: t + 3,
            steps: t + 4,
            rejected: t + 5,
            kinks,
            end: kinks + kept,
        }
    }
}

/// Where the quantities of a block's trajectories lie in its frame of lanes.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    pub dim: usize,
    /// Leading components that derivatives depend on.
    pub inputs: usize,
    /// Where the step begins, and what follows: the new point where the step is accepted, else the
    /// same again.
    pub now: State,
    pub next: State,
    /// The level a trajectory comes to next; infinite for an idle lane.
    pub next_at: usize,
    pub first_step: usize,
    /// The step attempted.
    pub h: usize,
    /// Derivatives at the inner stages `[stage - 1][component]`.
    inner: usize,
    stages: usize,
    /// Coefficients of the dense output `[power - 1][component]`.
    pub dense: usize,
    /// Squared error of a step in units of the tolerance; for a Taylor step 0, or not a number.
    pub error: usize,
    /// Values of the guards at the new point.
    pub guards: usize,
    /// Masks: steps accepted; lanes that must be looked at singly.
    pub accepted: usize,
    pub special: usize,
    /// Squares of size and speed of a seed in units of the tolerance.
    pub seed: usize,
    pub slots: usize,
}

impl Layout {
    pub fn new(spec: &Spec, scheme: Scheme) -> Self {
        let dim = spec.dim();
        let now = State::new(0, spec, scheme);
        let next = State::new(now.end, spec, scheme);
        let next_at = next.end;
        let (first_step, inner) = (next_at + 1, next_at + 3);
        let (stages, h) = match scheme {
            Scheme::RungeKutta(tableau) => (tableau.stages(), now.wanted),
            Scheme::Taylor(_) => (2, next_at + 2),
        };
        let dense = inner + (stages - 2) * dim;
        let error = dense + scheme.degree() * dim;
        let guards = error + 1;
        let accepted = guards + spec.guards.as_ref().map_or(0, |g| g.program.outputs.len());
        Self {
            dim,
            inputs: spec.rate.inputs,
            now,
            next,
            next_at,
            first_step,
            h,
            inner,
            stages,
            dense,
            error,
            guards,
            accepted,
            special: accepted + 1,
            seed: accepted + 2,
            slots: accepted + 4,
        }
    }

    /// Derivatives at a stage of an accepted step; the last one is taken at the new point.
    pub fn stage(&self, s: usize) -> std::ops::Range<usize> {
        let first = match s {
            0 => self.now.k,
            s if s + 1 == self.stages => self.next.k,
            s => self.inner + (s - 1) * self.dim,
        };
        first..first + self.dim
    }
}

/// Parameters of all codes.
pub struct Parameters {
    pub rtol: Value,
    pub atol: Vec<Value>,
    /// Attempted steps with which a trajectory is looked at.
    pub step_limit: Value,
    /// The last level where it is a time.
    pub end: Value,
    pub ceiling: Option<(usize, Value)>,
    pub bounds: Vec<[Value; 2]>,
}

impl Parameters {
    fn new(r: &mut Recorder, dim: usize, variant: Variant) -> Self {
        let at = dim + 4;
        Self {
            rtol: r.parameter(0),
            step_limit: r.parameter(1),
            end: r.parameter(2),
            ceiling: variant.ceiling.map(|c| (c, r.parameter(3))),
            atol: (4..at).map(|c| r.parameter(c)).collect(),
            bounds: (0..variant.bounds)
                .map(|c| [r.parameter(at + 2 * c), r.parameter(at + 2 * c + 1)])
                .collect(),
        }
    }

    /// Their values in a run.
    pub fn values<T: Real>(run: &Run) -> Vec<T> {
        // Counts of steps are kept as numbers of the lanes' own kind.
        let counts = 0.5 / T::EPSILON;
        let mut list = vec![
            run.rtol,
            f64::from(run.max_steps.saturating_sub(1)).min(counts),
            run.levels.last().copied().unwrap_or(f64::INFINITY),
            run.ceiling.map_or(f64::INFINITY, |(_, v)| v),
        ];
        list.extend(&run.atol);
        list.extend(run.bounds.iter().flatten());
        list.into_iter().map(T::of).collect()
    }
}

/// The derivative at a seed, the kinks there, and the sums of squares of size and speed.
pub fn start(r: &mut Recorder, spec: &Spec, layout: &Layout, variant: Variant) {
    let given = Parameters::new(r, layout.dim, variant);
    let y = r.loads(layout.now.y..layout.now.y + layout.dim);
    let rate = r.program(&spec.rate, &y[..layout.inputs]);
    let mut sums = [r.constant(0.0); 2];
    for c in 0..layout.dim {
        let size = r.abs(y[c]);
        let scale = r.mul_add(given.rtol, size, given.atol[c]);
        for (sum, v) in sums.iter_mut().zip([y[c], rate[c]]) {
            let ratio = r.div(v, scale);
            *sum = r.mul_add(ratio, ratio, *sum);
        }
        r.store(rate[c], layout.dense + c);
    }
    r.store(sums[0], layout.seed);
    r.store(sums[1], layout.seed + 1);
    if let Some(program) = &spec.kinks
        && layout.next.kinks < layout.next.end
    {
        for (k, v) in r
            .program(program, &y[..program.inputs])
            .into_iter()
            .enumerate()
        {
            r.store(v, layout.next.kinks + k);
        }
    }
}

/// A step of a scheme, with the decisions about it.
pub fn step(r: &mut Recorder, spec: &Spec, layout: &Layout, scheme: Scheme, variant: Variant) {
    let given = Parameters::new(r, layout.dim, variant);
    let y = r.loads(layout.now.y..layout.now.y + layout.dim);
    let taken = match scheme {
        Scheme::RungeKutta(tableau) => runge_kutta(r, spec, layout, tableau, &given, &y),
        Scheme::Taylor(order) => taylor_step(r, spec, layout, order, &given, &y),
    };
    let decided = decide::Decision::new(r, spec, layout, scheme, &given, &taken);
    decided.store(r, layout, &taken);
}

/// A step as attempted.
pub struct Taken {
    pub h: Value,
    pub y: Vec<Value>,
    pub y_new: Vec<Value>,
    /// Derivatives at both ends, where they are kept.
    pub k: Option<(Vec<Value>, Vec<Value>)>,
    pub error: Value,
    pub kinks: Vec<Value>,
    pub guards: Vec<Value>,
    /// The step that a Taylor expansion allows, whatever else has shortened it.
    pub reach: Value,
}

impl Taken {
    fn new(
        r: &mut Recorder,
        spec: &Spec,
        h: Value,
        y: &[Value],
        y_new: Vec<Value>,
        k: Option<(Vec<Value>, Vec<Value>)>,
        error: Value,
    ) -> Self {
        let mut at_end = |program: &Program| r.program(program, &y_new[..program.inputs]);
        Self {
            kinks: (spec.kinks.as_ref().filter(|_| k.is_some())).map_or_else(Vec::new, &mut at_end),
            guards: spec
                .guards
                .as_ref()
                .map_or_else(Vec::new, |g| at_end(&g.program)),
            h,
            y: y.to_vec(),
            y_new,
            k,
            error,
            reach: h,
        }
    }
}

/// A Runge-Kutta step from `y` and the derivative there to the new point, with its error.
fn runge_kutta(
    r: &mut Recorder,
    spec: &Spec,
    layout: &Layout,
    tableau: &Tableau,
    given: &Parameters,
    y: &[Value],
) -> Taken {
    let (dim, inputs, stages) = (layout.dim, layout.inputs, tableau.stages());
    let h = r.load(layout.now.wanted);
    let mut k = vec![r.loads(layout.stage(0))];
    let mut y_new = Vec::new();
    for s in 1..stages {
        // Components that no derivative depends on are needed only at the end of the step.
        let components = if s + 1 == stages { dim } else { inputs };
        let point: Vec<Value> = (0..components)
            .map(|c| {
                if spec.is_constant(c) {
                    return y[c];
                }
                let sum = r.weighted(tableau.a[s - 1].iter().zip(&k).map(|(a, k)| (*a, k[c])));
                r.mul_add(sum, h, y[c])
            })
            .collect();
        let rate = r.program(&spec.rate, &point[..inputs]);
        if s + 1 < stages {
            // Slots of components that never change stay 0.
            for (c, (v, slot)) in rate.iter().zip(layout.stage(s)).enumerate() {
                if !spec.is_constant(c) {
                    r.store(*v, slot);
                }
            }
        }
        k.push(rate);
        y_new = point;
    }
    let error = if tableau.adaptive() {
        estimate(r, (spec, given), tableau, h, y, &y_new, &k)
    } else {
        // Zero times a finite number is zero; anything else is not a number.
        let zero = r.constant(0.0);
        let mut sum = zero;
        for (y, k) in y_new.iter().zip(&k[stages - 1]) {
            let both = r.add(*y, *k);
            sum = r.mul_add(zero, both, sum);
        }
        sum
    };
    let last = k.pop().unwrap_or_default();
    Taken::new(r, spec, h, y, y_new, Some((k.swap_remove(0), last)), error)
}

fn estimate(
    r: &mut Recorder,
    (spec, given): (&Spec, &Parameters),
    tableau: &Tableau,
    h: Value,
    y: &[Value],
    y_new: &[Value],
    k: &[Vec<Value>],
) -> Value {
    let share = r.constant(1.0 / y.len() as f64);
    let zero = r.constant(0.0);
    let (mut total, mut other) = (zero, zero);
    for c in (0..y.len()).filter(|c| !spec.is_constant(*c)) {
        let (p, q) = (r.abs(y[c]), r.abs(y_new[c]));
        let size = r.larger(p, q);
        let scale = r.mul_add(given.rtol, size, given.atol[c]);
        let unit = r.div(h, scale);
        let mut square = |weights: &[f64], sum: Value| {
            let e = r.weighted(weights.iter().zip(k).map(|(w, k)| (*w, k[c])));
            let e = r.mul(e, unit);
            r.mul_add(e, e, sum)
        };
        total = square(tableau.error, total);
        if !tableau.companion.is_empty() {
            other = square(tableau.companion, other);
        }
    }
    total = r.mul(total, share);
    if tableau.companion.is_empty() {
        return total;
    }
    let weight = r.constant(control::COMPANION);
    let other = r.mul(other, share);
    let sum = r.mul_add(weight, other, total);
    let ratio = r.div(total, sum);
    let error = r.mul(total, ratio);
    let some = r.compare(Comparison::Less, zero, sum);
    r.select(some, error, total)
}

/// The dense output of a Runge-Kutta step: its further stages, and the polynomials' coefficients
/// `[power - 1][component]` in the fraction of the step, per unit of h.
pub fn dense(r: &mut Recorder, spec: &Spec, layout: &Layout, tableau: &Tableau) {
    let h = r.load(layout.h);
    let y = r.loads(layout.now.y..layout.now.y + layout.inputs);
    let mut k: Vec<Vec<Value>> = (0..tableau.stages())
        .map(|s| r.loads(layout.stage(s)))
        .collect();
    for a in tableau.extra {
        let point: Vec<Value> = (0..layout.inputs)
            .map(|c| {
                let sum = r.weighted(a.iter().zip(&k).map(|(a, k)| (*a, k[c])));
                r.mul_add(sum, h, y[c])
            })
            .collect();
        k.push(r.program(&spec.rate, &point));
    }
    for c in (0..layout.dim).filter(|c| !spec.is_constant(*c)) {
        let parts: Vec<Value> = (0..tableau.degree())
            .map(|i| r.weighted(tableau.dense.iter().zip(&k).map(|(d, k)| (d[i], k[c]))))
            .collect();
        for m in 0..tableau.degree() {
            let sum = r.weighted((0..tableau.degree()).map(|i| (tableau.power(i, m), parts[i])));
            r.store(sum, layout.dense + m * layout.dim + c);
        }
    }
}

/// A solution as a Taylor polynomial about the beginning of a step.
pub struct Expansion {
    /// Coefficients by component.
    series: Vec<Series>,
    order: usize,
    /// The largest one of the last order but one, and of the last, in units of the tolerance.
    pub last: [Value; 2],
}

impl Expansion {
    pub fn new(
        r: &mut Recorder,
        spec: &Spec,
        order: usize,
        (rtol, atol): (Value, &[Value]),
        y: &[Value],
    ) -> Self {
        let series = taylor::solution(r, &spec.rate, y, order);
        let zero = r.constant(0.0);
        let mut last = [zero; 2];
        for c in 0..y.len() {
            let size = r.abs(y[c]);
            let scale = r.mul_add(rtol, size, atol[c]);
            for (most, j) in last.iter_mut().zip([order - 1, order]) {
                let size = r.abs(series[c][j].unwrap_or(zero));
                let ratio = r.div(size, scale);
                *most = r.greatest(ratio, *most);
            }
        }
        Self {
            series,
            order,
            last,
        }
    }

    /// The step at which the last coefficients are as large as the tolerance.
    fn reach(&self, r: &mut Recorder) -> Value {
        let zero = r.constant(0.0);
        let mut reach = None;
        for (most, j) in self.last.into_iter().zip([self.order - 1, self.order]) {
            let log = decide::log2(r, most);
            let share = r.constant(-1.0 / j as f64);
            let log = r.mul(log, share);
            reach = Some(reach.map_or(log, |other| r.smaller(log, other)));
        }
        let power = decide::exp2(r, reach.unwrap_or(zero));
        let safety = r.constant(control::taylor_safety(self.order));
        let reach = r.mul(power, safety);
        // What is not finite takes no step, and is refused for it.
        let [below, top] = self.last.map(|most| r.sub(most, most));
        let nothing = r.add(below, top);
        let finite = r.compare(Comparison::Equal, nothing, zero);
        r.select(finite, reach, zero)
    }

    /// The step `h`, or a shorter one that ends just behind the first kink in it.
    pub fn up_to_kinks(
        &self,
        r: &mut Recorder,
        spec: &Spec,
        mut h: Value,
        (t, first_step): (Value, Value),
    ) -> Value {
        let Some(program) = &spec.kinks else { return h };
        // No step to a kink is below what counts as stuck.
        let reached = r.larger(t, first_step);
        let unit = r.constant(2.0 * control::FLOOR_ULPS * r.epsilon());
        let floor = r.mul(unit, reached);
        for kink in taylor::along(r, program, &self.series, self.order) {
            let to = up_to_kink(r, &kink, h);
            let to = r.larger(to, floor);
            h = r.smaller(to, h);
        }
        h
    }

    /// Coefficient `j` of a component.
    pub fn coefficient(&self, r: &mut Recorder, component: usize, j: usize) -> Value {
        let zero = r.constant(0.0);
        self.series[component][j].unwrap_or(zero)
    }

    /// The solution after a step.
    pub fn at(&self, r: &mut Recorder, h: Value) -> Vec<Value> {
        let zero = r.constant(0.0);
        let polynomial = |series: &Series| {
            let highest = series[self.order].unwrap_or(zero);
            (0..self.order).rev().fold(highest, |sum, j| {
                r.mul_add(sum, h, series[j].unwrap_or(zero))
            })
        };
        self.series.iter().map(polynomial).collect()
    }
}

/// A Taylor step: the solution's coefficients, the step at which the last ones are as large as the
/// tolerance, and the polynomials' values there.
fn taylor_step(
    r: &mut Recorder,
    spec: &Spec,
    layout: &Layout,
    order: usize,
    given: &Parameters,
    y: &[Value],
) -> Taken {
    let expansion = Expansion::new(r, spec, order, (given.rtol, &given.atol), y);
    for c in 0..layout.dim {
        for j in 1..=order {
            let coefficient = expansion.coefficient(r, c, j);
            r.store(coefficient, layout.dense + (j - 1) * layout.dim + c);
        }
    }
    let reach = expansion.reach(r);
    // Where a solution is a polynomial its last terms say nothing about how far it is followed at
    // once: steps grow by a bounded factor. The first one is of the size |y|/|y'|.
    let (before, first_step) = (r.load(layout.now.before), r.load(layout.first_step));
    let (grow, begin) = (r.constant(control::GROW), r.constant(1.0 / control::SHARE));
    let (most, first) = (r.mul(before, grow), r.mul(first_step, begin));
    let zero = r.constant(0.0);
    let begun = r.compare(Comparison::Less, zero, before);
    let most = r.select(begun, most, first);
    let reach = r.smaller(reach, most);
    let wanted = r.load(layout.now.wanted);
    let h = decide::stretched(r, reach, wanted);
    let t = r.load(layout.now.t);
    let h = expansion.up_to_kinks(r, spec, h, (t, first_step));
    r.store(h, layout.h);
    let y_new = expansion.at(r, h);
    let error = (y_new.iter()).fold(zero, |error, y| r.mul_add(zero, *y, error));
    Taken {
        reach,
        ..Taken::new(r, spec, h, y, y_new, None, error)
    }
}

/// A step of `h`, or the way to just behind the first zero of a series in it: the branch taken
/// where the step begins is kept to its end. A quarter of the step is taken to have one extremum at
/// most, since steps stay well within the radius of convergence.
fn up_to_kink(r: &mut Recorder, series: &[Option<Value>], h: Value) -> Value {
    const POINTS: u32 = 4;
    const ITERATIONS: u32 = 6;
    let zero = r.constant(0.0);
    let coefficient = |r: &mut Recorder, n: usize| series[n].unwrap_or_else(|| r.constant(0.0));
    let top = series.len() - 1;
    // Value and slope after the fraction q of the step.
    let at = |r: &mut Recorder, q: Value| {
        let t = r.mul(q, h);
        let mut value = coefficient(r, top);
        let mut slope = zero;
        for n in (0..top).rev() {
            slope = r.mul_add(slope, t, value);
            let c = coefficient(r, n);
            value = r.mul_add(value, t, c);
        }
        (value, r.mul(slope, h))
    };
    // The side on which the step begins: of the first coefficient that is not zero.
    let mut side = zero;
    for n in (0..=top.min(2)).rev() {
        let c = coefficient(r, n);
        let tie = r.compare(Comparison::Equal, c, zero);
        side = r.select(tie, side, c);
    }
    let beyond = |r: &mut Recorder, value: Value| {
        let product = r.mul(side, value);
        r.compare(Comparison::Less, product, zero)
    };
    let one = r.constant(1.0);
    let (mut lo, mut hi) = (one, one);
    let mut met = zero;
    let part = 1.0 / f64::from(POINTS);
    let ends: Vec<(Value, Value)> = (0..=POINTS)
        .map(|k| {
            let q = r.constant(f64::from(k) * part);
            at(r, q)
        })
        .collect();
    for k in (0..POINTS as usize).rev() {
        let (q, length) = (r.constant(k as f64 * part), r.constant(part));
        let whole = r.add(q, length);
        // Where it turns back towards its side, the zeros lie to both sides of the extremum.
        let ((_, begin), (value, end)) = (ends[k], ends[k + 1]);
        let change = r.sub(begin, end);
        let share = r.div(begin, change);
        let turning = r.mul_add(share, length, q);
        let (a, b) = (r.mul(side, begin), r.mul(side, end));
        let (towards, back) = (
            r.compare(Comparison::Less, a, zero),
            r.compare(Comparison::Less, zero, b),
        );
        let turns = r.and(towards, back);
        let (extreme, _) = at(r, turning);
        let (at_end, at_turn) = (beyond(r, value), beyond(r, extreme));
        let at_turn = r.and(at_turn, turns);
        let behind = r.select(at_turn, turning, whole);
        let crossed = r.or(at_end, at_turn);
        lo = r.select(crossed, q, lo);
        hi = r.select(crossed, behind, hi);
        met = r.or(met, crossed);
    }
    // Newton's method within the bracket.
    let half = r.constant(0.5);
    let sum = r.add(lo, hi);
    let mut q = r.mul(half, sum);
    for _ in 0..ITERATIONS {
        let (value, slope) = at(r, q);
        let crossed = beyond(r, value);
        hi = r.select(crossed, q, hi);
        lo = r.select(crossed, lo, q);
        let change = r.div(value, slope);
        let next = r.sub(q, change);
        let outside = [
            r.compare(Comparison::Less, next, lo),
            r.compare(Comparison::Less, hi, next),
            r.compare(Comparison::Unordered, next, next),
        ];
        let outside = outside.into_iter().fold(zero, |all, mask| r.or(all, mask));
        let sum = r.add(lo, hi);
        let middle = r.mul(half, sum);
        q = r.select(outside, middle, next);
    }
    // The branch left behind is kept that little too long.
    let margin = r.constant(r.epsilon().powf(2.0 / 3.0));
    let behind = r.add(q, margin);
    let (value, _) = at(r, behind);
    let crossed = beyond(r, value);
    // Where the zero was not found so well, the step ends before it: the next one meets it again.
    let some = r.compare(Comparison::Less, zero, lo);
    let other = r.select(some, lo, hi);
    let q = r.select(crossed, behind, other);
    let q = r.select(met, q, one);
    r.mul(q, h)
}
