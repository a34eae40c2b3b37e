//! The equations of the segments, with their variations, as programs.

use crate::backend::{By, Run, Spec};
use crate::expr::{Graph, Id, Kind};
use crate::hamiltonian::System;
use crate::model::{Method, Precision};
use crate::program::Program;
use rustc_hash::FxHashMap;

/// Absolute tolerance of what the step control is to leave alone.
const UNCONTROLLED: f64 = 1e30;

/// Segments `(s, p)` integrated forward over a duration of their own, in units of their own size.
///
/// With `z = (s, p)`, `z = r y`, r the size of z where the segment begins, and q the fraction of
/// its duration D: `dy/dq = D (dH/dp, -dH/dx) / r`, `dV/dq = D L / r^2`, and for a column v of the
/// variations `dv/dq = D J v`, J the Jacobian of the right-hand side (clamps included, almost
/// everywhere). Errors are thus controlled relative to the segment's size: what is small near the
/// equilibrium is still resolved, and a component that passes through 0 is not followed to nothing.
#[derive(Clone, Debug)]
pub struct Equations {
    /// Number of states n.
    pub states: usize,
    /// Variation columns that one integrated vector carries; a segment takes `2n / columns` of
    /// them.
    pub columns: usize,
    /// Of `(y, D, r)`: rates of `(y, D, r, V)`.
    plain: Program,
    /// Of `(y, D, r, columns)`: their rates.
    varied: Program,
    /// Of `(y, D, r)`: zero where the clamps of the controls, or what else has a kink, switch.
    kinks: Option<Program>,
    /// Scale of each component of z.
    pub scales: Vec<f64>,
    value_scale: f64,
}

impl Equations {
    /// `most` variation components are carried at once by an integrated vector; where equations are
    /// long, as many columns as keep the program below `longest` operations, or one.
    pub fn new(
        system: &System,
        widths: &[f64],
        value_scale: f64,
        (most, longest): (usize, usize),
    ) -> Self {
        let n = system.states;
        let mut graph = system.graph.clone();
        let duration = graph.symbol("segment duration", Kind::Parameter);
        let size = graph.symbol("segment size", Kind::Parameter);
        let units: Vec<Id> = (0..2 * n)
            .map(|i| graph.symbol(&format!("segment component {i}"), Kind::State))
            .collect();
        let replaced: FxHashMap<Id, Id> = (system.inputs.iter().zip(&units))
            .map(|(z, y)| (*z, graph.mul(size, *y)))
            .collect();
        let system_rates = graph.substitute(&system.rate, &replaced);
        let switches = graph.kinks(&system_rates);

        // The system's rates are those of backward time.
        let backward = graph.neg(duration);
        let per_size = graph.div(backward, size);
        let mut rates: Vec<Id> = system_rates[..2 * n]
            .iter()
            .map(|r| graph.mul(per_size, *r))
            .collect();
        let zero = graph.constant(0.0);
        rates.extend([zero, zero]);
        let cost = graph.mul(duration, system_rates[2 * n]);
        let square = graph.powi(size, 2);
        let cost = graph.div(cost, square);
        let mut inputs = units;
        inputs.extend([duration, size]);
        let plain_rates = [rates.as_slice(), &[cost]].concat();
        let plain = Program::lower(&graph, &inputs, &plain_rates);
        let kinks = (!switches.is_empty()).then(|| Program::lower(&graph, &inputs, &switches));

        let varied = Varied {
            graph,
            inputs,
            rates,
            replaced,
            backward,
        };
        let fitting = (1..=2 * n)
            .rev()
            .find(|c| (2 * n).is_multiple_of(*c) && 2 * n * c <= most)
            .unwrap_or(1);
        let (columns, varied) = varied.program(system, fitting, (plain.operations(), longest));
        let scales = (widths.iter().copied())
            .chain(widths.iter().map(|w| value_scale / w))
            .collect();
        Self {
            states: n,
            columns,
            plain,
            varied,
            kinks,
            scales,
            value_scale,
        }
    }

    /// Components of a plain segment: `(y, D, r, V)`.
    pub fn plain_width(&self) -> usize {
        2 * self.states + 3
    }

    /// Components of a segment with a group of variation columns: `(y, D, r, columns)`.
    pub fn varied_width(&self) -> usize {
        2 * self.states * (1 + self.columns) + 2
    }

    /// Size of a node: its largest scaled component, or 1 where it is 0.
    pub fn size(&self, node: &[f64]) -> f64 {
        let size = (node.iter().zip(&self.scales)).fold(0.0f64, |a, (z, s)| a.max((z / s).abs()));
        if size > 0.0 { size } else { 1.0 }
    }

    /// A slope `dp/ds` (row-major) in scaled units.
    pub fn scaled_slope(&self, slope: &[f64]) -> Vec<f64> {
        let n = self.states;
        (0..n * n)
            .map(|q| slope[q] * self.scales[q % n] / self.scales[n + q / n])
            .collect()
    }

    /// Groups of columns a segment.
    pub fn groups(&self) -> usize {
        2 * self.states / self.columns
    }

    fn spec(&self, rate: &Program, method: Method, precision: Precision) -> Spec {
        Spec {
            rate: rate.clone(),
            guards: None,
            kinks: self.kinks.clone(),
            method,
            precision,
            by: By::Time,
            store: false,
        }
    }

    pub fn plain_spec(&self, method: Method, precision: Precision) -> Spec {
        self.spec(&self.plain, method, precision)
    }

    pub fn varied_spec(&self, method: Method, precision: Precision) -> Spec {
        self.spec(&self.varied, method, precision)
    }

    /// Settings of the plain segments' integration.
    pub fn plain_run(&self, rtol: f64, max_steps: u32) -> Run {
        let mut atol: Vec<f64> = self.scales.iter().map(|s| rtol * s).collect();
        atol.extend([UNCONTROLLED, UNCONTROLLED, rtol * self.value_scale]);
        Self::run(rtol, atol, max_steps)
    }

    /// Settings of the integration with variations: steps are controlled by z alone, so that all
    /// groups of columns of a segment take the same ones.
    pub fn varied_run(&self, rtol: f64, max_steps: u32) -> Run {
        let width = self.varied_width();
        // The norm is a mean over all components, which are 0 but for those of z.
        let rtol = rtol * (2.0 * self.states as f64 / width as f64).sqrt();
        let mut atol: Vec<f64> = self.scales.iter().map(|s| rtol * s).collect();
        atol.resize(width, UNCONTROLLED);
        Self::run(rtol, atol, max_steps)
    }

    fn run(rtol: f64, atol: Vec<f64>, max_steps: u32) -> Run {
        Run {
            rtol,
            atol,
            step: 0.0,
            first: None,
            max_steps,
            levels: vec![1.0],
            ceiling: None,
            bounds: Vec::new(),
        }
    }
}

/// What variation columns are added to.
struct Varied {
    graph: Graph,
    /// `(y, D, r)`, and their rates.
    inputs: Vec<Id>,
    rates: Vec<Id>,
    /// What stands for the system's inputs.
    replaced: FxHashMap<Id, Id>,
    /// -D.
    backward: Id,
}

/// Operations of a plain segment up to which the Jacobian is written out.
const SHORT: usize = 400;

impl Varied {
    /// The program with variation columns, and how many: of short equations the Jacobian times
    /// columns, which fit into an integrated vector; of long ones the rates' derivatives along each
    /// column, a few of which are as long as the equations themselves.
    fn program(
        self,
        system: &System,
        fitting: usize,
        (plain, longest): (usize, usize),
    ) -> (usize, Program) {
        let n = system.states;
        if plain <= SHORT {
            return (fitting, self.by_jacobian(system, fitting));
        }
        let one = self.along(system, 1);
        let each = one.operations().saturating_sub(plain).max(1);
        let most = longest.saturating_sub(plain) / each;
        let columns = (1..=2 * n)
            .rev()
            .find(|c| (2 * n).is_multiple_of(*c) && *c <= most);
        match columns {
            Some(columns) if columns > 1 => (columns, self.along(system, columns)),
            _ => (1, one),
        }
    }

    fn column(graph: &mut Graph, c: usize, count: usize) -> Vec<Id> {
        (0..count)
            .map(|i| graph.symbol(&format!("variation {c} {i}"), Kind::State))
            .collect()
    }

    fn by_jacobian(&self, system: &System, columns: usize) -> Program {
        let n = system.states;
        let (mut graph, mut inputs, mut rates) =
            (self.graph.clone(), self.inputs.clone(), self.rates.clone());
        // By column, then transposed.
        let by_input: Vec<Vec<Id>> = (system.inputs.iter())
            .map(|x| graph.diff_all(&system.rate[..2 * n], *x))
            .collect();
        let entries: Vec<Id> = (0..2 * n)
            .flat_map(|i| by_input.iter().map(move |c| c[i]))
            .collect();
        let jacobian = graph.substitute(&entries, &self.replaced);
        for c in 0..columns {
            let column = Self::column(&mut graph, c, 2 * n);
            for row in jacobian.chunks(2 * n) {
                let rate = product(&mut graph, row, &column);
                rates.push(graph.mul(self.backward, rate));
            }
            inputs.extend(column);
        }
        Program::lower(&graph, &inputs, &rates)
    }

    fn along(&self, system: &System, columns: usize) -> Program {
        let n = system.states;
        let (mut graph, mut inputs, mut rates) =
            (self.graph.clone(), self.inputs.clone(), self.rates.clone());
        for c in 0..columns {
            let column = Self::column(&mut graph, c, 2 * n);
            let directions = system.inputs.iter().copied().zip(column.iter().copied());
            let tangents = graph.tangents(&system.rate[..2 * n], &directions.collect());
            let tangents = graph.substitute(&tangents, &self.replaced);
            rates.extend(tangents.iter().map(|t| graph.mul(self.backward, *t)));
            inputs.extend(column);
        }
        Program::lower(&graph, &inputs, &rates)
    }
}

fn product(graph: &mut Graph, row: &[Id], column: &[Id]) -> Id {
    let terms = (row.iter().zip(column))
        .filter(|(a, _)| !graph.is_zero(**a))
        .map(|(a, v)| (*a, *v))
        .collect::<Vec<_>>();
    let terms: Vec<Id> = terms.into_iter().map(|(a, v)| graph.mul(a, v)).collect();
    graph.sum(&terms)
}
