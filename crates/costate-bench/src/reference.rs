//! What results are compared with: the same seeds in f64 at 1e-14, by another method than the one
//! measured.

use super::errors::Meter;
use super::variants::Steps;
use super::work::Work;
use costate::backend::cpu::Cpu;
use costate::backend::{Backend, BackendError, Status, Trajectories};
use costate::low_level::model::{Method, Precision};
use costate::low_level::program::Program;
use nalgebra::{DMatrix, DVector};

/// Tolerance of references: close to what f64 can meet.
pub const REFERENCE_RTOL: f64 = 1e-14;
/// Tolerance of the neighbours that the slope of p is taken from: it is multiplied with the small
/// distance that an error moves a point along the manifold.
const NEIGHBOUR_RTOL: f64 = 1e-12;
/// Distance of neighbours on the seed surface. Their differences keep about six digits against
/// rounding, and are that much smaller than what bends the manifold.
const NEIGHBOUR: f64 = 1e-6;
/// Below this share of the tangent plane in x (the sine of its angle to p, both scaled) the sheet
/// turns back: p is no function of x there.
const FOLD: f64 = 1e-3;
/// Step limit: references take as many as they need.
const MOST_STEPS: u32 = 10_000_000;
/// Numbers kept of the slopes.
const MOST_SLOPES: usize = 8 << 20;

/// Methods that serve as references, the first for all others, the second for the first.
pub const METHODS: [Method; 2] = [Method::Taylor, Method::Dop853];

/// Reference trajectories, the leading ones of the work.
pub struct Reference {
    pub method: Method,
    pub result: Trajectories,
    /// `[trajectory][level]`.
    pub hamiltonian: Vec<f64>,
    /// Largest running cost of each trajectory at the levels.
    pub running: Vec<f64>,
}

impl Reference {
    /// Integrates the first `count` seeds.
    ///
    /// # Errors
    /// When the kernel cannot be compiled.
    pub fn new(
        work: &Work,
        meter: &Meter,
        method: Method,
        count: usize,
    ) -> Result<Self, BackendError> {
        let count = count.min(work.count());
        let seeds = &work.seeds[..count * work.plan.spec.dim()];
        let result = points(integrate(work, method, REFERENCE_RTOL, seeds)?);
        let (hamiltonian, running) = meter.values(&result);
        Ok(Self {
            method,
            hamiltonian,
            running: largest(&running, result.levels),
            result,
        })
    }

    /// Samples that exist.
    pub fn samples(&self) -> usize {
        let r = &self.result;
        (0..r.count() * r.levels)
            .filter(|k| !r.samples[k * (1 + r.dim)].is_nan())
            .count()
    }

    /// Duration of the median trajectory, in the scene's unit of time.
    pub fn median_duration(&self) -> f64 {
        let mut times: Vec<f64> = (self.result.end_time.iter().copied())
            .filter(|t| t.is_finite())
            .collect();
        times.sort_by(f64::total_cmp);
        times.get(times.len() / 2).copied().unwrap_or(1.0)
    }
}

fn integrate(
    work: &Work,
    method: Method,
    rtol: f64,
    seeds: &[f64],
) -> Result<Trajectories, BackendError> {
    let mut kernel = Cpu::new().compile(&work.spec(method, Precision::F64))?;
    let mut run = work.run(Steps::Tolerance(rtol));
    run.max_steps = MOST_STEPS;
    Ok(work
        .integrate(kernel.as_mut(), &run, seeds, usize::MAX)?
        .kept)
}

/// Where only ends were kept, the ends that were reached as samples at one level.
pub fn points(mut result: Trajectories) -> Trajectories {
    if result.levels == 0 {
        result.levels = 1;
        result.samples = (result
            .end
            .chunks(result.dim)
            .zip(&result.end_time)
            .zip(&result.status))
        .flat_map(|((end, time), status)| {
            let reached = *status == Status::Reached;
            let keep = move |x: f64| if reached { x } else { f64::NAN };
            std::iter::once(*time)
                .chain(end.iter().copied())
                .map(keep)
                .collect::<Vec<_>>()
        })
        .collect();
    }
    result
}

fn largest(values: &[f64], levels: usize) -> Vec<f64> {
    (values.chunks(levels))
        .map(|row| {
            row.iter()
                .filter(|x| !x.is_nan())
                .fold(0.0f64, |a, x| a.max(x.abs()))
        })
        .collect()
}

/// The slope of p along the manifold, at the samples of some reference trajectories: an error that
/// moves a point along the manifold changes p by it, and is no error of p.
///
/// The tangent plane of the manifold is spanned by the differences of neighbouring trajectories and
/// by the flow (on a finite horizon, where samples are at equal times, by the neighbours alone).
pub struct Slopes {
    /// Trajectories that have slopes: the leading ones.
    pub count: usize,
    /// `[trajectory][level][n x n]`, row-major, of p in units of cost a width by x in widths of the
    /// region; NaN where there is none.
    values: Vec<f64>,
    square: usize,
    levels: usize,
}

impl Slopes {
    /// Integrates the neighbours of up to `count` of the reference's trajectories.
    ///
    /// # Errors
    /// When the kernel cannot be compiled.
    pub fn new(work: &Work, reference: &Reference, count: usize) -> Result<Self, BackendError> {
        let n = work.states();
        let levels = reference.result.levels;
        let count = count
            .min(reference.result.count())
            .min(MOST_SLOPES / (levels * n * n))
            .max(1);
        let mut sides = Vec::new();
        let directions = if work.plan.system.terminal.is_some() {
            n
        } else {
            n - 1
        };
        for k in 0..directions {
            sides.push([
                neighbours(work, reference, count, k, 1.0)?,
                neighbours(work, reference, count, k, -1.0)?,
            ]);
        }
        let flow = work.plan.system.terminal.is_none().then(|| {
            let rate = Program::lower(
                &work.plan.system.graph,
                &work.plan.system.inputs,
                &work.plan.system.rate[..2 * n],
            );
            let r = &reference.result;
            costate::backend::cpu::Evaluator::new(&rate).eval(&r.samples[1..], 1 + r.dim)
        });
        let mut values = vec![f64::NAN; count * levels * n * n];
        for (at, to) in values.chunks_mut(n * n).enumerate() {
            let (i, level) = (at / levels, at % levels);
            let mut columns: Vec<Vec<f64>> = (sides.iter())
                .map(|[a, b]| {
                    let (a, b) = (
                        &a.sample(i, level)[1..=2 * n],
                        &b.sample(i, level)[1..=2 * n],
                    );
                    a.iter().zip(b).map(|(a, b)| a - b).collect()
                })
                .collect();
            columns.extend(
                flow.iter()
                    .map(|f| f[at * 2 * n..(at + 1) * 2 * n].to_vec()),
            );
            let p = &reference.result.sample(i, level)[1 + n..=2 * n];
            if let Some(slope) = slope(&columns, p, &work.plan.widths) {
                to.copy_from_slice(&slope);
            }
        }
        Ok(Self {
            count,
            values,
            square: n * n,
            levels,
        })
    }

    /// The slope at a sample; `None` where it is not known.
    pub fn at(&self, i: usize, level: usize) -> Option<&[f64]> {
        let start = (i * self.levels + level) * self.square;
        let slope = (i < self.count).then(|| &self.values[start..start + self.square])?;
        slope.iter().all(|x| x.is_finite()).then_some(slope)
    }
}

/// Trajectories from seeds beside the reference's, in the `k`-th direction along the seed surface.
/// One outside a guard has no samples.
fn neighbours(
    work: &Work,
    reference: &Reference,
    count: usize,
    k: usize,
    side: f64,
) -> Result<Trajectories, BackendError> {
    let dim = work.plan.spec.dim();
    let mut inside = Vec::with_capacity(count);
    let mut seeds = Vec::with_capacity(count * dim);
    for (i, parameter) in work.parameters[..count].iter().enumerate() {
        let seed = work.seed(&beside(
            parameter,
            k,
            side * NEIGHBOUR,
            work.plan.system.terminal.is_some(),
        ));
        inside.push(seed.is_some());
        let own = || work.seeds[i * dim..(i + 1) * dim].to_vec();
        seeds.extend(seed.unwrap_or_else(own));
    }
    let mut result = points(integrate(work, reference.method, NEIGHBOUR_RTOL, &seeds)?);
    let width = result.levels * (1 + dim);
    for (samples, inside) in result.samples.chunks_mut(width).zip(inside) {
        if !inside {
            samples.fill(f64::NAN);
        }
    }
    Ok(result)
}

/// A parameter beside another: along an axis of the box, or on the sphere along the `k`-th axis
/// other than the one it points along most, less its part outward.
fn beside(parameter: &[f64], k: usize, by: f64, flat: bool) -> Vec<f64> {
    let mut moved = parameter.to_vec();
    if flat {
        moved[k] += by;
        return moved;
    }
    let along =
        (0..parameter.len()).max_by(|a, b| parameter[*a].abs().total_cmp(&parameter[*b].abs()));
    let axis = k + usize::from(along.is_some_and(|a| k >= a));
    for (i, x) in moved.iter_mut().enumerate() {
        let unit = if i == axis { 1.0 } else { 0.0 };
        *x += by * (unit - parameter[axis] * parameter[i]);
    }
    let norm = moved.iter().map(|x| x * x).sum::<f64>().sqrt();
    moved.iter_mut().for_each(|x| *x /= norm);
    moved
}

/// dp/dx of a plane spanned by columns `(dx, dp)`, p scaled to units of cost and x to widths;
/// `None` where the plane stands upright, or a column is not known.
fn slope(columns: &[Vec<f64>], p: &[f64], widths: &[f64]) -> Option<Vec<f64>> {
    let n = widths.len();
    let cost = p
        .iter()
        .zip(widths)
        .map(|(p, w)| (p * w).powi(2))
        .sum::<f64>()
        .sqrt();
    let mut plane = DMatrix::zeros(2 * n, n);
    for (mut to, column) in plane.column_iter_mut().zip(columns) {
        for i in 0..n {
            to[i] = column[i] / widths[i];
            to[n + i] = column[n + i] * widths[i] / cost;
        }
        let norm = to.norm();
        to /= norm;
    }
    if !plane.iter().all(|x| x.is_finite()) {
        return None;
    }
    let basis = plane.qr().q();
    let (x, p) = (basis.rows(0, n).into_owned(), basis.rows(n, n).into_owned());
    let least = x.clone().svd(false, false).singular_values.min();
    if least < FOLD {
        return None;
    }
    // S x = p, row by row.
    let inverse = x.try_inverse()?;
    Some((p * inverse).transpose().iter().map(|s| s * cost).collect())
}

/// What p is expected to change by, in units of cost, where x moved by `moved` (widths).
pub fn follow(slope: &[f64], moved: &[f64]) -> DVector<f64> {
    let n = moved.len();
    DMatrix::from_row_slice(n, n, slope) * DVector::from_column_slice(moved)
}
