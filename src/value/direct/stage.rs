//! A step of the transcribed problem: state and cost after it, with derivatives by state and
//! control.

use crate::backend::cpu::{Evaluator, Simd};
use crate::expr::Kind;
use crate::model::Model;
use crate::numeric::dense::cholesky;
use crate::program::Program;
use nalgebra::DMatrix;
use rustc_hash::FxHashMap;

/// Stages of the classical fourth-order method.
const NODES: [f64; 4] = [0.0, 0.5, 0.5, 1.0];
const WEIGHTS: [f64; 4] = [1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0];

/// f and L with their derivatives, of a deviation and the controls.
pub(super) struct Rates {
    rates: Evaluator,
    derivatives: Evaluator,
    /// Second derivatives of a weighted sum of f, of `(x, u, weights)`: the upper triangle.
    /// None where all are 0.
    curvatures: Option<Evaluator>,
    /// Which of the derivatives, and of a full matrix of the second ones, are 0 whatever the point.
    zeros: Zeros,
    pub states: usize,
    pub controls: usize,
    pub simd: Simd,
}

/// Entries that are 0 whatever the point: half of a mechanism's, say, and most of a quadratic cost's.
struct Zeros {
    /// df/d(x, u), `[n][n + m]`.
    first: Vec<bool>,
    /// Second derivatives of L, `[n + m][n + m]`.
    second: Vec<bool>,
    /// Of the weighted sum of f, likewise.
    square: Vec<bool>,
}

/// Steps from states under constant controls, all at once: of each the state and the cost after it.
pub(super) struct Steps {
    /// `[step][n]`.
    pub next: Vec<f64>,
    pub cost: Vec<f64>,
    /// `(x, u)` at the stages, `[stage][step][n + m]`.
    stages: Vec<Vec<f64>>,
}

/// Derivatives of steps by `(x, u)`, `[step]`, row by row.
pub(super) struct Slopes {
    states: usize,
    width: usize,
    /// `[n][n + m]`.
    jacobian: Vec<f64>,
    gradient: Vec<f64>,
    /// Of Gauss-Newton: without the dynamics' curvature, and not negative. `[n + m][n + m]`.
    hessian: Vec<f64>,
    /// What the dynamics' curvature adds to that; empty where it is 0 and where no adjoints were
    /// given.
    curvature: Vec<f64>,
}

impl Slopes {
    pub fn jacobian(&self, step: usize) -> &[f64] {
        part(&self.jacobian, step, self.states * self.width)
    }

    pub fn gradient(&self, step: usize) -> &[f64] {
        part(&self.gradient, step, self.width)
    }

    pub fn hessian(&self, step: usize) -> &[f64] {
        part(&self.hessian, step, self.width * self.width)
    }

    /// Empty where it is 0.
    pub fn curvature(&self, step: usize) -> &[f64] {
        if self.curvature.is_empty() {
            return &[];
        }
        part(&self.curvature, step, self.width * self.width)
    }
}

fn part(all: &[f64], step: usize, size: usize) -> &[f64] {
    &all[step * size..][..size]
}

/// Steps whose derivatives are computed side by side.
const LANES: usize = 8;
type Lane = [f64; LANES];

/// What is computed of steps side by side.
struct Block {
    /// Durations of the steps.
    steps: Lane,
    by_stage: Vec<Lane>,
    slope: Vec<Lane>,
    product: Vec<Lane>,
    square: Vec<Lane>,
    jacobian: Vec<Lane>,
    gradient: Vec<Lane>,
    hessian: Vec<Lane>,
    curvature: Vec<Lane>,
    /// The derivatives of one stage, and its weighted second ones.
    here: Vec<Lane>,
    curved: Vec<Lane>,
}

impl Rates {
    /// Time of the fastest mode of the open loop about the equilibrium; infinite where none moves.
    pub fn fastest(&self, controls: &[f64]) -> f64 {
        let (n, width) = (self.states, self.states + self.controls);
        let at = [&vec![0.0; n], controls].concat();
        let slopes = self.derivatives.eval(&at, width);
        let open = DMatrix::from_fn(n, n, |i, j| slopes[i * width + j]);
        let rates = open.complex_eigenvalues();
        rates.iter().map(|e| e.norm()).fold(0.0, f64::max).recip()
    }

    pub fn new(model: &Model) -> Self {
        let mut graph = model.graph.clone();
        let n = model.states.len();
        let mut values: FxHashMap<_, _> = FxHashMap::default();
        for (symbol, value) in model.parameter_values() {
            values.insert(symbol, graph.constant(value));
        }
        let mut inputs = Vec::new();
        for (state, &at) in model.states.iter().zip(model.reference()) {
            let name = format!("direct {}", state.variable.name);
            let deviation = graph.symbol(&name, Kind::State);
            let at = graph.constant(at);
            values.insert(state.variable.symbol, graph.add(deviation, at));
            inputs.push(deviation);
        }
        inputs.extend(model.controls.iter().map(|c| c.variable.symbol));
        let open: Vec<_> = (model.dynamics.iter())
            .map(|d| d.expr)
            .chain([model.running.expr])
            .collect();
        let rates = graph.substitute(&open, &values);
        let mut derivatives = Vec::new();
        for rate in &rates {
            derivatives.extend(inputs.iter().map(|z| graph.diff(*rate, *z)));
        }
        for k in n * inputs.len()..(n + 1) * inputs.len() {
            let slope = derivatives[k];
            derivatives.extend(inputs.iter().map(|z| graph.diff(slope, *z)));
        }
        let mut weights = Vec::new();
        let mut weighted = graph.constant(0.0);
        for (i, rate) in rates[..n].iter().enumerate() {
            weights.push(graph.symbol(&format!("direct weight {i}"), Kind::State));
            let share = graph.mul(weights[i], *rate);
            weighted = graph.add(weighted, share);
        }
        let mut curvatures = Vec::new();
        for (i, a) in inputs.iter().enumerate() {
            let slope = graph.diff(weighted, *a);
            curvatures.extend(inputs[i..].iter().map(|b| graph.diff(slope, *b)));
        }
        let width = inputs.len();
        let is_zero: Vec<bool> = derivatives.iter().map(|d| graph.is_zero(*d)).collect();
        let mut square = vec![true; width * width];
        let places = (0..width).flat_map(|a| (a..width).map(move |b| (a, b)));
        for ((a, b), c) in places.zip(&curvatures) {
            square[a * width + b] = graph.is_zero(*c);
            square[b * width + a] = square[a * width + b];
        }
        let zeros = Zeros {
            first: is_zero[..n * width].to_vec(),
            second: is_zero[(n + 1) * width..].to_vec(),
            square,
        };
        let lower =
            |inputs: &[_], roots: &[_]| Evaluator::new(&Program::lower(&graph, inputs, roots));
        Self {
            rates: lower(&inputs, &rates),
            derivatives: lower(&inputs, &derivatives),
            curvatures: (curvatures.iter().any(|c| !graph.is_zero(*c)))
                .then(|| lower(&[inputs.as_slice(), &weights].concat(), &curvatures)),
            zeros,
            states: n,
            controls: model.controls.len(),
            simd: Simd::detect(),
        }
    }

    /// f and L at a point `(s, u)`.
    pub fn at(&self, point: &[f64]) -> Vec<f64> {
        self.rates.eval(point, point.len())
    }

    /// Pairs among `(s, u)` that are coupled about the equilibrium: one in the rate of the other, or
    /// both in a product in the running cost.
    pub fn couplings(&self, controls: &[f64]) -> Vec<(usize, usize)> {
        let (n, width) = (self.states, self.states + self.controls);
        let slopes = (self.derivatives).eval(&[&vec![0.0; n], controls].concat(), width);
        let of = |row: usize, to: usize| {
            let row = &slopes[row * width..][..width];
            let coupled = (row.iter().enumerate()).filter(|(_, slope)| **slope != 0.0);
            coupled.map(move |(by, _)| (to, by))
        };
        let rates = (0..n).flat_map(|i| of(i, i));
        let costs = (0..width).flat_map(|i| of(n + 1 + i, i));
        rates.chain(costs).collect()
    }

    /// Steps of the classical fourth-order method from `x`, `[step][n]`, under `u`, `[step][m]`;
    /// `None` where one is not finite.
    pub fn steps(&self, x: &[f64], u: &[f64], h: &[f64]) -> Option<Steps> {
        let (n, m) = (self.states, self.controls);
        let (width, count) = (n + m, u.len() / m);
        let mut steps = Steps {
            next: x[..count * n].to_vec(),
            cost: vec![0.0; count],
            stages: Vec::with_capacity(NODES.len()),
        };
        let mut rates = vec![0.0; count * (n + 1)];
        for (node, weight) in NODES.into_iter().zip(WEIGHTS) {
            let mut at = Vec::with_capacity(count * width);
            for k in 0..count {
                at.extend((0..n).map(|i| x[k * n + i] + node * h[k] * rates[k * (n + 1) + i]));
                at.extend_from_slice(&u[k * m..][..m]);
            }
            rates = self.rates.eval(&at, width);
            for k in 0..count {
                let rate = &rates[k * (n + 1)..][..=n];
                (0..n).for_each(|i| steps.next[k * n + i] += weight * h[k] * rate[i]);
                steps.cost[k] += weight * h[k] * rate[n];
            }
            steps.stages.push(at);
        }
        let finite = steps.next.iter().chain(&steps.cost).all(|v| v.is_finite());
        finite.then_some(steps)
    }

    /// The state after a single step, into `next`; `room` is memory.
    pub fn step(&self, x: &[f64], u: &[f64], h: f64, next: &mut [f64], room: &mut Vec<f64>) {
        let (n, width) = (self.states, self.states + self.controls);
        room.clear();
        room.resize(width + n + 1, 0.0);
        let (at, rate) = room.split_at_mut(width);
        at[n..].copy_from_slice(u);
        next.copy_from_slice(x);
        for (node, weight) in NODES.into_iter().zip(WEIGHTS) {
            (0..n).for_each(|i| at[i] = x[i] + node * h * rate[i]);
            self.rates.fill(at, width, rate);
            (0..n).for_each(|i| next[i] += weight * h * rate[i]);
        }
    }

    /// Derivatives of steps, through all stages; with the dynamics' curvature for adjoints after
    /// the steps, `[step][n]`.
    pub fn slopes(&self, steps: &Steps, h: &[f64], adjoints: Option<&[f64]>) -> Slopes {
        let (n, width) = (self.states, self.states + self.controls);
        let outputs = (n + 1) * width + width * width;
        let all: Vec<Vec<f64>> = steps
            .stages
            .iter()
            .map(|at| self.derivatives.eval(at, width))
            .collect();
        let curvatures = (self.curvatures.as_ref().zip(adjoints))
            .map_or_else(Vec::new, |(second, p)| {
                self.curvatures(second, steps, h, p, &all)
            });
        let (count, square) = (steps.cost.len(), width * width);
        let is_curved = !curvatures.is_empty();
        let mut slopes = Slopes {
            states: n,
            width,
            jacobian: vec![0.0; count * n * width],
            gradient: vec![0.0; count * width],
            hessian: vec![0.0; count * square],
            curvature: vec![0.0; if is_curved { count * square } else { 0 }],
        };
        let lanes = |size: usize| vec![[0.0; LANES]; size];
        let mut block = Block {
            steps: [0.0; LANES],
            by_stage: lanes(n * width),
            slope: lanes(n * width),
            product: lanes(square),
            square: lanes(square),
            jacobian: lanes(n * width),
            gradient: lanes(width),
            hessian: lanes(square),
            curvature: lanes(square),
            here: lanes(outputs),
            curved: lanes(width * (width + 1) / 2),
        };
        for first in (0..count).step_by(LANES) {
            let here = LANES.min(count - first);
            block.clear();
            block.steps[..here].copy_from_slice(&h[first..][..here]);
            for (stage, all) in all.iter().enumerate() {
                gather(all, first, here, &mut block.here);
                if is_curved {
                    gather(&curvatures[stage], first, here, &mut block.curved);
                }
                block.add_by(self.simd, &self.zeros, stage, n, is_curved);
            }
            block.mirror();
            scatter(&block.jacobian, first, here, &mut slopes.jacobian);
            scatter(&block.gradient, first, here, &mut slopes.gradient);
            scatter(&block.hessian, first, here, &mut slopes.hessian);
            if is_curved {
                scatter(&block.curvature, first, here, &mut slopes.curvature);
            }
        }
        let mut room = Vec::with_capacity(square);
        for hessian in slopes.hessian.chunks_mut(square) {
            not_negative(hessian, width, &mut room);
        }
        slopes
    }

    /// Second derivatives of f at the stages, weighted by the stages' adjoints.
    fn curvatures(
        &self,
        second: &Evaluator,
        steps: &Steps,
        h: &[f64],
        adjoints: &[f64],
        derivatives: &[Vec<f64>],
    ) -> Vec<Vec<f64>> {
        let (n, width) = (self.states, self.states + self.controls);
        let count = steps.cost.len();
        let outputs = (n + 1) * width + width * width;
        let mut curvatures = vec![Vec::new(); NODES.len()];
        // Adjoints of the stages' rates, `[step][n]`, from the last stage to the first.
        let mut weights: Vec<f64> = Vec::new();
        for stage in (0..NODES.len()).rev() {
            let mut here: Vec<f64> = (adjoints.iter().enumerate())
                .map(|(k, p)| h[k / n] * WEIGHTS[stage] * p)
                .collect();
            if let (Some(node), Some(of_next)) = (NODES.get(stage + 1), derivatives.get(stage + 1))
            {
                for k in 0..count {
                    let next = &of_next[k * outputs..][..outputs];
                    for i in 0..n {
                        let dynamics: f64 = (0..n)
                            .map(|j| next[j * width + i] * weights[k * n + j])
                            .sum();
                        let cost = h[k] * WEIGHTS[stage + 1] * next[n * width + i];
                        here[k * n + i] += node * h[k] * (dynamics + cost);
                    }
                }
            }
            weights = here;
            let points = steps.stages[stage].chunks(width).zip(weights.chunks(n));
            let at: Vec<f64> = points
                .flat_map(|(z, weights)| [z, weights].concat())
                .collect();
            curvatures[stage] = second.eval(&at, width + n);
        }
        curvatures
    }
}

impl Block {
    fn clear(&mut self) {
        let Self {
            slope,
            jacobian,
            gradient,
            hessian,
            curvature,
            ..
        } = self;
        let states = jacobian.len() / gradient.len();
        let width = gradient.len();
        for lanes in [slope, &mut *jacobian, gradient, hessian, curvature] {
            lanes.fill([0.0; LANES]);
        }
        for i in 0..states {
            jacobian[i * width + i] = [1.0; LANES];
        }
    }

    /// Adds what a stage contributes.
    #[inline(always)]
    fn add<const FUSED: bool>(&mut self, zeros: &Zeros, stage: usize, n: usize, is_curved: bool) {
        let one = [1.0; LANES];
        let (to_stage, share) = (
            self.steps.map(|h| NODES[stage] * h),
            self.steps.map(|h| WEIGHTS[stage] * h),
        );
        let width = self.gradient.len();
        let (first, rest) = self.here.split_at(n * width);
        let (gradient, second) = rest.split_at(width);
        if is_curved {
            symmetric(&self.curved, width, &mut self.square);
        }
        if NODES[stage] == 0.0 {
            // The stage's state is that of the step.
            self.slope.copy_from_slice(first);
            add_all(&mut self.gradient, &share, gradient);
            add_all(&mut self.hessian, &share, second);
            if is_curved {
                add_all(&mut self.curvature, &one, &self.square);
            }
        } else {
            // d(stage)/d(x, u), of the states; the controls are those of the step.
            for (k, (b, s)) in self.by_stage.iter_mut().zip(&self.slope).enumerate() {
                let unit = f64::from(u8::from(k % width == k / width));
                for l in 0..LANES {
                    b[l] = unit + to_stage[l] * s[l];
                }
            }
            let by_stage = &self.by_stage;
            chained::<FUSED>(first, &zeros.first, by_stage, n, &mut self.slope);
            chained::<FUSED>(second, &zeros.second, by_stage, n, &mut self.product);
            for (row, of_state) in by_stage.chunks(width).zip(gradient) {
                add_lanes(&mut self.gradient, &share, of_state, row);
            }
            add_all(&mut self.gradient[n..], &share, &gradient[n..]);
            add_product::<FUSED>(by_stage, &self.product, n, &share, &mut self.hessian);
            if is_curved {
                chained::<FUSED>(&self.square, &zeros.square, by_stage, n, &mut self.product);
                add_product::<FUSED>(by_stage, &self.product, n, &one, &mut self.curvature);
            }
        }
        add_all(&mut self.jacobian, &share, &self.slope);
    }

    /// The same with the widest vectors there are.
    fn add_by(&mut self, simd: Simd, zeros: &Zeros, stage: usize, n: usize, is_curved: bool) {
        match simd {
            // SAFETY: the set was detected.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => unsafe { add_avx512(self, zeros, stage, n, is_curved) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => unsafe { add_avx2(self, zeros, stage, n, is_curved) },
            _ => self.add::<false>(zeros, stage, n, is_curved),
        }
    }

    /// Of the symmetric matrices only the upper triangles are added to.
    fn mirror(&mut self) {
        let width = self.gradient.len();
        for matrix in [&mut self.hessian, &mut self.curvature] {
            for a in 0..width {
                for b in 0..a {
                    matrix[a * width + b] = matrix[b * width + a];
                }
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,fma")]
fn add_avx512(block: &mut Block, zeros: &Zeros, stage: usize, n: usize, is_curved: bool) {
    block.add::<true>(zeros, stage, n, is_curved);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn add_avx2(block: &mut Block, zeros: &Zeros, stage: usize, n: usize, is_curved: bool) {
    block.add::<true>(zeros, stage, n, is_curved);
}

/// Numbers of steps, `[step][size]`, side by side, and back.
fn gather(all: &[f64], first: usize, count: usize, lanes: &mut [Lane]) {
    let size = lanes.len();
    for l in 0..count {
        let one = part(all, first + l, size);
        lanes.iter_mut().zip(one).for_each(|(lane, v)| lane[l] = *v);
    }
}

fn scatter(lanes: &[Lane], first: usize, count: usize, all: &mut [f64]) {
    let size = lanes.len();
    for l in 0..count {
        let one = &mut all[(first + l) * size..][..size];
        one.iter_mut().zip(lanes).for_each(|(v, lane)| *v = lane[l]);
    }
}

/// `sum += factor by`.
#[inline(always)]
fn add_all(sum: &mut [Lane], factor: &Lane, by: &[Lane]) {
    for (sum, by) in sum.iter_mut().zip(by) {
        for l in 0..LANES {
            sum[l] += factor[l] * by[l];
        }
    }
}

/// `sum += factor a row`, each lane with its own `a`.
#[inline(always)]
fn add_lanes(sum: &mut [Lane], factor: &Lane, a: &Lane, row: &[Lane]) {
    let mut scaled = [0.0; LANES];
    for l in 0..LANES {
        scaled[l] = factor[l] * a[l];
    }
    for (sum, b) in sum.iter_mut().zip(row) {
        for l in 0..LANES {
            sum[l] += scaled[l] * b[l];
        }
    }
}

/// A symmetric matrix from its upper triangle.
#[inline(always)]
fn symmetric(upper: &[Lane], width: usize, square: &mut [Lane]) {
    let places = (0..width).flat_map(|a| (a..width).map(move |b| (a, b)));
    for ((a, b), v) in places.zip(upper) {
        square[a * width + b] = *v;
        square[b * width + a] = *v;
    }
}

/// `c = a [b; 0 1]`: derivatives by state and control become those by the step's; `b` is of the
/// states, `[n][width]`. `zeros`: entries of a that are 0 whatever the point.
#[inline(always)]
fn chained<const FUSED: bool>(a: &[Lane], zeros: &[bool], b: &[Lane], n: usize, c: &mut [Lane]) {
    let width = b.len() / n;
    let rows = a.chunks(width).zip(zeros.chunks(width));
    for ((a, zeros), c) in rows.zip(c.chunks_mut(width)) {
        c[..n].fill([0.0; LANES]);
        c[n..].copy_from_slice(&a[n..]);
        let rows = (a[..n].iter().zip(zeros).zip(b.chunks(width)))
            .filter(|((_, zero), _)| !**zero)
            .map(|((a, _), b)| (*a, b));
        add_rows::<FUSED>(rows, c);
    }
}

/// Adds `factor [b; 0 1]' a` to the upper triangle of `c`.
#[inline(always)]
fn add_product<const FUSED: bool>(b: &[Lane], a: &[Lane], n: usize, factor: &Lane, c: &mut [Lane]) {
    let width = b.len() / n;
    for (i, c) in c.chunks_mut(width).enumerate() {
        let rows =
            (b.chunks(width).zip(a.chunks(width))).map(|(b, a)| (product(factor, &b[i]), &a[i..]));
        add_rows::<FUSED>(rows, &mut c[i..]);
        if i >= n {
            add_all(c, factor, &a[i * width..][..width]);
        }
    }
}

#[inline(always)]
fn product(a: &Lane, b: &Lane) -> Lane {
    let mut product = *a;
    for l in 0..LANES {
        product[l] *= b[l];
    }
    product
}

/// Adds rows, each times its number: several at once, so that sums are read and written less often.
#[inline(always)]
fn add_rows<'a, const FUSED: bool>(
    mut rows: impl Iterator<Item = (Lane, &'a [Lane])>,
    sum: &mut [Lane],
) {
    while let Some((a, row)) = rows.next() {
        let Some((b, second)) = rows.next() else {
            for (sum, x) in sum.iter_mut().zip(row) {
                for l in 0..LANES {
                    sum[l] = plus::<FUSED>(sum[l], a[l], x[l]);
                }
            }
            return;
        };
        let Some((c, third)) = rows.next() else {
            for ((sum, x), y) in sum.iter_mut().zip(row).zip(second) {
                for l in 0..LANES {
                    let one = plus::<FUSED>(sum[l], a[l], x[l]);
                    sum[l] = plus::<FUSED>(one, b[l], y[l]);
                }
            }
            return;
        };
        for (((sum, x), y), z) in sum.iter_mut().zip(row).zip(second).zip(third) {
            for l in 0..LANES {
                let one = plus::<FUSED>(sum[l], a[l], x[l]);
                let two = plus::<FUSED>(one, b[l], y[l]);
                sum[l] = plus::<FUSED>(two, c[l], z[l]);
            }
        }
    }
}

/// `sum + a b`, where the machine has it in one instruction.
#[inline(always)]
fn plus<const FUSED: bool>(sum: f64, a: f64, b: f64) -> f64 {
    if FUSED {
        a.mul_add(b, sum)
    } else {
        sum + a * b
    }
}

/// `c = a b` for matrices of `rows x inner` and `inner x columns`, row by row.
#[inline(always)]
pub(super) fn times(
    a: &[f64],
    b: &[f64],
    rows: usize,
    inner: usize,
    columns: usize,
    c: &mut [f64],
) {
    for i in 0..rows {
        let row = &mut c[i * columns..(i + 1) * columns];
        row.fill(0.0);
        for k in 0..inner {
            let factor = a[i * inner + k];
            for (c, b) in row.iter_mut().zip(&b[k * columns..(k + 1) * columns]) {
                *c += factor * b;
            }
        }
    }
}

/// Replaces negative eigenvalues of a symmetric matrix by 0; `room` is memory.
fn not_negative(matrix: &mut [f64], width: usize, room: &mut Vec<f64>) {
    room.clear();
    room.extend_from_slice(matrix);
    if cholesky(width, room).is_some() {
        return;
    }
    let mut eigen = DMatrix::from_row_slice(width, width, matrix).symmetric_eigen();
    eigen.eigenvalues.iter_mut().for_each(|v| *v = v.max(0.0));
    matrix.copy_from_slice(eigen.recompose().as_slice());
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario;

    #[test]
    fn derivatives_are_those_of_the_step() {
        let text = r#"
            states = { a = {}, b = {} }
            controls = { u = {} }
            dynamics = { a = "b", b = "sin(a) - 0.3*b^2 + u*cos(a)" }
            cost = { running = "2*a^2 + 0.5*b^2 + 0.3*cosh(u)*u^2 + 0.1*a*b" }
            equilibrium = { a = 0, b = 0, u = 0 }
            region = { a = [-1, 1], b = [-1, 1] }
            shoot_out = { value_max = 1 }
            "#;
        let model = scenario::parse(text, "test", &[]).expect("a scene");
        let rates = Rates::new(&model);
        let (z, h, p) = ([0.7, -0.4, 0.3], [0.2], [1.3, -0.8]);
        // Cost of a step and p times the state after it.
        let lagrangian = |z: &[f64]| {
            let steps = rates.steps(&z[..2], &z[2..], &h).expect("finite");
            steps.cost[0] + p.iter().zip(&steps.next).map(|(p, x)| p * x).sum::<f64>()
        };
        let steps = rates.steps(&z[..2], &z[2..], &h).expect("finite");
        let mut next = [0.0; 2];
        rates.step(&z[..2], &z[2..], h[0], &mut next, &mut Vec::new());
        assert_eq!(steps.next, next, "a single step");
        let slopes = rates.slopes(&steps, &h, Some(&p));
        let (jacobian, gradient) = (slopes.jacobian(0), slopes.gradient(0));
        let eps = 1e-4;
        let moved = |by: &[(usize, f64)]| {
            let mut z = z;
            by.iter().for_each(|(i, d)| z[*i] += d);
            lagrangian(&z)
        };
        for i in 0..3 {
            let slope = gradient[i] + p[0] * jacobian[i] + p[1] * jacobian[3 + i];
            let difference = (moved(&[(i, eps)]) - moved(&[(i, -eps)])) / (2.0 * eps);
            assert!(
                (slope - difference).abs() < 1e-7,
                "slope {i}: {slope} and {difference}"
            );
            for j in 0..3 {
                let second = slopes.hessian(0)[i * 3 + j] + slopes.curvature(0)[i * 3 + j];
                let corner = |a: f64, b: f64| moved(&[(i, a * eps), (j, b * eps)]);
                let difference = (corner(1.0, 1.0) - corner(1.0, -1.0) - corner(-1.0, 1.0)
                    + corner(-1.0, -1.0))
                    / (4.0 * eps * eps);
                assert!(
                    (second - difference).abs() < 1e-6,
                    "{i}, {j}: {second} and {difference}"
                );
            }
        }
    }
}
