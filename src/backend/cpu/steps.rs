//! Recording of a scene's integration steps as vector code.

use super::arithmetic::Arithmetic;
use super::code::{Recorder, Value};
use super::taylor;
use crate::backend::Spec;
use crate::integrator::{Scheme, Tableau, control};

/// Where the quantities of a block's trajectories lie in its frame of lanes.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    pub dim: usize,
    /// Leading components that derivatives depend on.
    pub inputs: usize,
    /// The vector where the step begins.
    pub y: usize,
    pub h: usize,
    /// Stage derivatives `[stage][component]`, or Taylor coefficients `[order - 1][component]`.
    pub k: usize,
    /// Coefficients of the dense output `[power - 1][component]`.
    pub dense: usize,
    pub y_new: usize,
    /// Squared error of a step in units of the tolerance; for a Taylor step 0, or not a number.
    pub error: usize,
    /// Largest Taylor coefficients of the last two orders in units of the tolerance.
    pub top: usize,
    /// Values of the kinks and of the guards where the step ends.
    pub kinks: usize,
    pub guards: usize,
    pub slots: usize,
}

impl Layout {
    pub fn new(spec: &Spec, scheme: Scheme) -> Self {
        let dim = spec.dim();
        let (y, h, k) = (0, dim, dim + 1);
        let (dense, y_new) = match scheme {
            Scheme::RungeKutta(tableau) => {
                let dense = k + tableau.stages() * dim;
                (dense, dense + tableau.degree() * dim)
            }
            // The coefficients are the dense output.
            Scheme::Taylor(order) => (k, k + order * dim),
        };
        let error = y_new + dim;
        let top = error + 1;
        let kinks = top + 2;
        let guards = kinks + spec.kinks.as_ref().map_or(0, |p| p.outputs.len());
        Self {
            dim,
            inputs: spec.rate.inputs,
            y,
            h,
            k,
            dense,
            y_new,
            error,
            top,
            kinks,
            guards,
            slots: guards + spec.guards.as_ref().map_or(0, |g| g.program.outputs.len()),
        }
    }

    pub fn stage(&self, s: usize) -> std::ops::Range<usize> {
        self.k + s * self.dim..self.k + (s + 1) * self.dim
    }
}

/// Parameters of all codes: rtol, then the absolute tolerances.
fn tolerances(r: &mut Recorder, layout: &Layout) -> (Value, Vec<Value>) {
    (r.parameter(0), (1..=layout.dim).map(|c| r.parameter(c)).collect())
}

/// The derivative at `y`, the kinks there, and the sums of squares of both in units of the tolerance (into `top`).
pub fn start(r: &mut Recorder, spec: &Spec, layout: &Layout) {
    let y = r.loads(layout.y..layout.y + layout.dim);
    let rate = r.program(&spec.rate, &y[..layout.inputs]);
    let (rtol, atol) = tolerances(r, layout);
    let mut sums = [r.constant(0.0); 2];
    for c in 0..layout.dim {
        let size = r.abs(y[c]);
        let scale = r.mul_add(rtol, size, atol[c]);
        for (sum, v) in sums.iter_mut().zip([y[c], rate[c]]) {
            let ratio = r.div(v, scale);
            *sum = r.mul_add(ratio, ratio, *sum);
        }
        r.store(rate[c], layout.k + c);
    }
    r.store(sums[0], layout.top);
    r.store(sums[1], layout.top + 1);
    ends(r, spec, layout, &y, false);
}

/// Kinks and guards at a point.
fn ends(r: &mut Recorder, spec: &Spec, layout: &Layout, y: &[Value], guarded: bool) {
    if let Some(program) = &spec.kinks {
        for (k, v) in r.program(program, &y[..program.inputs]).into_iter().enumerate() {
            r.store(v, layout.kinks + k);
        }
    }
    if let (Some(guards), true) = (&spec.guards, guarded) {
        for (g, v) in r.program(&guards.program, &y[..guards.program.inputs]).into_iter().enumerate() {
            r.store(v, layout.guards + g);
        }
    }
}

/// A Runge-Kutta step from `y` and the derivative there to the new point, the derivatives on the way, and the error.
pub fn runge_kutta(r: &mut Recorder, spec: &Spec, layout: &Layout, tableau: &Tableau) {
    let (dim, inputs, stages) = (layout.dim, layout.inputs, tableau.stages());
    let y = r.loads(layout.y..layout.y + dim);
    let h = r.load(layout.h);
    let mut k = vec![r.loads(layout.stage(0))];
    let mut y_new = Vec::new();
    for s in 1..stages {
        // Components that no derivative depends on are needed only at the end of the step.
        let components = if s + 1 == stages { dim } else { inputs };
        let point: Vec<Value> = (0..components)
            .map(|c| {
                let sum = r.weighted(tableau.a[s - 1].iter().zip(&k).map(|(a, k)| (*a, k[c])));
                r.mul_add(sum, h, y[c])
            })
            .collect();
        let rate = r.program(&spec.rate, &point[..inputs]);
        for (v, slot) in rate.iter().zip(layout.stage(s)) {
            r.store(*v, slot);
        }
        k.push(rate);
        y_new = point;
    }
    for (c, v) in y_new.iter().enumerate() {
        r.store(*v, layout.y_new + c);
    }
    let error = if tableau.adaptive() {
        estimate(r, layout, tableau, h, &y, &y_new, &k)
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
    r.store(error, layout.error);
    ends(r, spec, layout, &y_new, true);
}

fn estimate(
    r: &mut Recorder,
    layout: &Layout,
    tableau: &Tableau,
    h: Value,
    y: &[Value],
    y_new: &[Value],
    k: &[Vec<Value>],
) -> Value {
    let (rtol, atol) = tolerances(r, layout);
    let share = r.constant(1.0 / layout.dim as f64);
    let zero = r.constant(0.0);
    let (mut total, mut other) = (zero, zero);
    for c in 0..layout.dim {
        let (p, q) = (r.abs(y[c]), r.abs(y_new[c]));
        let less = r.compare(super::arithmetic::Comparison::Less, q, p);
        let size = r.select(less, p, q);
        let scale = r.mul_add(rtol, size, atol[c]);
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
    let some = r.compare(super::arithmetic::Comparison::Less, zero, sum);
    r.select(some, error, total)
}

/// The dense output of a Runge-Kutta step: its further stages, and the polynomials' coefficients
/// `[power - 1][component]` in the fraction of the step, per unit of h.
pub fn dense(r: &mut Recorder, spec: &Spec, layout: &Layout, tableau: &Tableau) {
    let h = r.load(layout.h);
    let y = r.loads(layout.y..layout.y + layout.inputs);
    let mut k: Vec<Vec<Value>> = (0..tableau.stages()).map(|s| r.loads(layout.stage(s))).collect();
    for a in tableau.extra {
        let point: Vec<Value> = (0..layout.inputs)
            .map(|c| {
                let sum = r.weighted(a.iter().zip(&k).map(|(a, k)| (*a, k[c])));
                r.mul_add(sum, h, y[c])
            })
            .collect();
        k.push(r.program(&spec.rate, &point));
    }
    for m in 0..tableau.degree() {
        for c in 0..layout.dim {
            let sum = r.weighted(tableau.dense.iter().zip(&k).map(|(d, k)| (d[m], k[c])));
            r.store(sum, layout.dense + m * layout.dim + c);
        }
    }
}

/// Taylor coefficients of the solution at `y`, and the largest ones of the last two orders.
pub fn expansion(r: &mut Recorder, spec: &Spec, layout: &Layout, order: usize) {
    let y = r.loads(layout.y..layout.y + layout.dim);
    let series = taylor::solution(r, &spec.rate, &y, order);
    let zero = r.constant(0.0);
    for (c, series) in series.iter().enumerate() {
        for (j, v) in series.iter().enumerate().skip(1) {
            r.store(v.unwrap_or(zero), layout.stage(j - 1).start + c);
        }
    }
    let (rtol, atol) = tolerances(r, layout);
    let mut most = [zero; 2];
    for c in 0..layout.dim {
        let size = r.abs(y[c]);
        let scale = r.mul_add(rtol, size, atol[c]);
        for (most, j) in most.iter_mut().zip([order - 1, order]) {
            let size = r.abs(series[c][j].unwrap_or(zero));
            let ratio = r.div(size, scale);
            *most = r.greatest(ratio, *most);
        }
    }
    r.store(most[0], layout.top);
    r.store(most[1], layout.top + 1);
}

/// The Taylor polynomial's value after a step of `h`.
pub fn evaluation(r: &mut Recorder, spec: &Spec, layout: &Layout, order: usize) {
    let h = r.load(layout.h);
    let mut y_new = Vec::new();
    let zero = r.constant(0.0);
    let mut error = zero;
    for c in 0..layout.dim {
        let mut sum = r.load(layout.stage(order - 1).start + c);
        for j in (0..order - 1).rev() {
            let k = r.load(layout.stage(j).start + c);
            sum = r.mul_add(sum, h, k);
        }
        let y = r.load(layout.y + c);
        let v = r.mul_add(sum, h, y);
        r.store(v, layout.y_new + c);
        error = r.mul_add(zero, v, error);
        y_new.push(v);
    }
    r.store(error, layout.error);
    ends(r, spec, layout, &y_new, true);
}
