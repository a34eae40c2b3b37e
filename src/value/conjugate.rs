//! Whether an extremal has a conjugate point: whether the manifold folds along it before its state
//! is reached.

use crate::backend::cpu::Cpu;
use crate::backend::{Backend, BackendError, By, Guards, Kernel, Run, Spec, Status};
use crate::expr::Kind;
use crate::hamiltonian::{Slope, infinite};
use crate::model::{Method, Precision};
use crate::program::Program;
use crate::shooting::{End, Path};
use crate::sweep::Plan;

/// Tolerance of the slopes: they only have to tell finite from infinite.
const RTOL: f64 = 1e-8;
/// Of a step, by which the size of what is integrated is bounded.
const MOST_STEPS: u32 = 100_000;

/// Integrates the slope `X = dp/dx` along paths, from their end backward in time, one segment after
/// the other from its stored node: errors along the manifold do not add up. `(s, p, X, D)`, D the
/// segment's duration; time runs from 0 to 1.
pub struct ConjugatePoints {
    kernel: Box<dyn Kernel>,
    run: Run,
    end: End,
    states: usize,
}

impl ConjugatePoints {
    /// # Errors
    /// When the kernel cannot be compiled.
    pub fn new(plan: &Plan) -> Result<Self, BackendError> {
        let n = plan.system.states;
        let mut graph = plan.system.graph.clone();
        let slope = Slope::new(
            &mut graph,
            &plan.system,
            &plan.slope_units,
            infinite(Precision::F64),
        );
        let duration = graph.symbol("segment duration", Kind::Parameter);
        let inputs = [plan.system.inputs.as_slice(), &slope.symbols, &[duration]].concat();
        let mut rate: Vec<_> = (plan.system.rate[..2 * n].iter().chain(&slope.rate))
            .map(|r| graph.mul(duration, *r))
            .collect();
        rate.push(graph.constant(0.0));
        let switches = graph.kinks(&plan.system.rate[..2 * n]);
        let spec = Spec {
            rate: Program::lower(&graph, &inputs, &rate),
            guards: Some(Guards {
                program: Program::lower(&graph, &inputs, &[slope.guard]),
                strict: vec![true],
            }),
            kinks: (!switches.is_empty()).then(|| Program::lower(&graph, &inputs, &switches)),
            method: Method::Dop853,
            precision: Precision::F64,
            by: By::Time,
            store: false,
        };
        let scales = (plan.widths.iter().copied())
            .chain(plan.widths.iter().map(|w| plan.value_scale / w))
            .chain(Slope::packed(&plan.slope_units, n))
            .chain([1.0]);
        Ok(Self {
            kernel: Cpu::new().compile(&spec)?,
            run: Run {
                rtol: RTOL,
                atol: scales.map(|s| RTOL * s).collect(),
                step: 0.0,
                first: None,
                max_steps: MOST_STEPS,
                levels: vec![1.0],
                ceiling: None,
                bounds: Vec::new(),
            },
            end: End::new(&plan.system, plan.local.as_ref()),
            states: n,
        })
    }

    /// Of each path whether it has none. A path along which the slope cannot be followed counts as
    /// one that has.
    ///
    /// # Errors
    /// Device failures only.
    pub fn absent(&mut self, paths: &[&Path]) -> Result<Vec<bool>, BackendError> {
        let n = self.states;
        let dim = 2 * n + Slope::len(n) + 1;
        let mut slopes: Vec<Option<Vec<f64>>> = (paths.iter())
            .map(|path| Some(Slope::packed(&self.end.at(&path.last()[..n]).hessian, n)))
            .collect();
        let longest = paths.iter().map(|p| p.segments()).max().unwrap_or(0);
        for behind in 0..longest {
            let mut seeds = Vec::new();
            let mut under_way = Vec::new();
            for (k, (path, slope)) in paths.iter().zip(&slopes).enumerate() {
                let (Some(slope), true) = (slope, behind < path.segments()) else {
                    continue;
                };
                let segment = path.segments() - 1 - behind;
                seeds.extend_from_slice(path.node(segment + 1));
                seeds.extend_from_slice(slope);
                seeds.push(path.durations[segment]);
                under_way.push(k);
            }
            if under_way.is_empty() {
                break;
            }
            let batch = self.kernel.integrate(&self.run, &seeds)?;
            for (i, k) in under_way.into_iter().enumerate() {
                let slope = &batch.end[i * dim + 2 * n..][..Slope::len(n)];
                slopes[k] = (batch.status[i] == Status::Reached).then(|| slope.to_vec());
            }
        }
        Ok(slopes.into_iter().map(|s| s.is_some()).collect())
    }
}
