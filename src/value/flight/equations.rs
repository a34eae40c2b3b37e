//! What a period of a flight integrates.

use crate::backend::cpu::Cpu;
use crate::backend::{Backend, BackendError, By, Guards, Kernel, Run, Spec};
use crate::expr::{Graph, Id, Kind};
use crate::hamiltonian::Slope;
use crate::model::{Method, Precision};
use crate::program::Program;
use crate::sweep::Plan;
use rustc_hash::FxHashMap;

/// Tolerance of a step, so that a flight's cost is good to about ten times it.
const RTOL: f64 = 1e-9;
/// Absolute tolerance of what the step control is to leave alone.
const UNCONTROLLED: f64 = 1e30;
/// Attempted steps a period: what needs more is running away.
const MOST_STEPS: u32 = 2000;

/// A period of a flight as a trajectory of a kernel, in units of the flight's size r where the
/// period begins: `(y, J, q, H, T, r, c)` with `s = r y`, the cost `c J`, the costate `r (q + H y)`
/// (H as its upper triangle) and the duration T, over which time runs from 0 to 1. Only y and J
/// change. So tolerances mean the same far out and near the equilibrium, and c, about the cost of
/// the whole flight, makes errors of the cost relative to that.
pub(super) struct Equations {
    pub states: usize,
    pub widths: Vec<f64>,
    pub spec: Spec,
    pub run: Run,
}

impl Equations {
    pub fn new(plan: &Plan) -> Self {
        let system = &plan.system;
        let n = system.states;
        let mut graph = system.graph.clone();
        let symbols = |graph: &mut Graph, name: &str, count: usize| -> Vec<Id> {
            (0..count)
                .map(|i| graph.symbol(&format!("flight {name} {i}"), Kind::State))
                .collect()
        };
        let y = symbols(&mut graph, "state", n);
        let cost = symbols(&mut graph, "cost", 1);
        let q = symbols(&mut graph, "costate", n);
        let h = symbols(&mut graph, "slope", Slope::len(n));
        let [duration, size, unit] =
            ["duration", "size", "cost unit"].map(|name| symbols(&mut graph, name, 1)[0]);
        let replaced = law(&mut graph, &system.inputs, &y, &q, &h, size);
        let guards: Vec<Id> = system.guards.iter().map(|g| g.expr).collect();
        let rates = [&system.rate[..n], &system.rate[2 * n..=2 * n], &guards].concat();
        let all = graph.substitute(&rates, &replaced);
        let (rates, guards) = all.split_at(n + 1);
        let switches = graph.kinks(rates);
        // The system's rates are those of backward time.
        let backward = graph.neg(duration);
        let per_size = graph.div(backward, size);
        let mut rate: Vec<Id> = rates[..n].iter().map(|f| graph.mul(per_size, *f)).collect();
        let spent = graph.mul(duration, rates[n]);
        rate.push(graph.div(spent, unit));
        let inputs = [y, cost, q, h, vec![duration, size, unit]].concat();
        let zero = graph.constant(0.0);
        rate.resize(inputs.len(), zero);
        let spec = Spec {
            rate: Program::lower(&graph, &inputs, &rate),
            guards: (!guards.is_empty()).then(|| Guards {
                program: Program::lower(&graph, &inputs, guards),
                strict: system.guards.iter().map(|g| g.strict).collect(),
            }),
            kinks: (!switches.is_empty()).then(|| Program::lower(&graph, &inputs, &switches)),
            method: Method::Dop853,
            precision: Precision::F64,
            by: By::Time,
            store: false,
        };
        // The step control's norm is a mean over all components, of which only these have an error.
        let rtol = RTOL * ((n + 1) as f64 / inputs.len() as f64).sqrt();
        let mut atol: Vec<f64> = plan.widths.iter().map(|w| rtol * w).collect();
        atol.push(rtol);
        atol.resize(inputs.len(), UNCONTROLLED);
        Self {
            states: n,
            widths: plan.widths.clone(),
            spec,
            run: Run {
                rtol,
                atol,
                step: 0.0,
                first: None,
                max_steps: MOST_STEPS,
                levels: vec![1.0],
                ceiling: None,
                bounds: Vec::new(),
            },
        }
    }

    pub fn compile(&self) -> Result<Box<dyn Kernel>, BackendError> {
        Cpu::new().compile(&self.spec)
    }

    /// Size of a state: its largest deviation in widths, or 1 where it is 0.
    fn size(&self, s: &[f64]) -> f64 {
        let size = (s.iter().zip(&self.widths)).fold(0.0f64, |a, (s, w)| a.max((s / w).abs()));
        if size > 0.0 { size } else { 1.0 }
    }

    /// Adds the vector at the beginning of a period under a law `(q, H)` to `seeds`; `unit` is the
    /// cost's.
    pub fn seed(
        &self,
        s: &[f64],
        (q, h): (&[f64], &[f64]),
        (duration, unit): (f64, f64),
        seeds: &mut Vec<f64>,
    ) {
        let size = self.size(s);
        seeds.extend(s.iter().map(|s| s / size));
        seeds.push(0.0);
        seeds.extend(q.iter().map(|q| q / size));
        seeds.extend(Slope::packed(h, self.states));
        seeds.extend([duration, size, unit]);
    }

    /// State and cost of a period from the vector at its end.
    pub fn read(&self, end: &[f64]) -> (Vec<f64>, f64) {
        let n = self.states;
        let [size, unit] = [end[end.len() - 2], end[end.len() - 1]];
        (end[..n].iter().map(|y| y * size).collect(), end[n] * unit)
    }
}

/// What takes the place of `(s, p)`: `r y` and `r (q + H y)`.
fn law(
    graph: &mut Graph,
    inputs: &[Id],
    y: &[Id],
    q: &[Id],
    h: &[Id],
    size: Id,
) -> FxHashMap<Id, Id> {
    let n = y.len();
    // The upper triangle, row by row.
    let entry = |i: usize, j: usize| {
        let (i, j) = (i.min(j), i.max(j));
        h[i * n - i * (i + 1) / 2 + j]
    };
    let mut replaced = FxHashMap::default();
    for i in 0..n {
        replaced.insert(inputs[i], graph.mul(size, y[i]));
        let mut terms: Vec<Id> = (0..n).map(|j| graph.mul(entry(i, j), y[j])).collect();
        terms.push(q[i]);
        let sum = graph.sum(&terms);
        replaced.insert(inputs[n + i], graph.mul(size, sum));
    }
    replaced
}
