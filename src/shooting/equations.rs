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
    /// `most` variation components are carried at once by an integrated vector.
    pub fn new(system: &System, widths: &[f64], value_scale: f64, most: usize) -> Self {
        let n = system.states;
        let columns = (1..=2 * n)
            .rev()
            .find(|c| (2 * n).is_multiple_of(*c) && 2 * n * c <= most)
            .unwrap_or(1);
        let mut graph = system.graph.clone();
        let duration = graph.symbol("segment duration", Kind::Parameter);
        let size = graph.symbol("segment size", Kind::Parameter);
        let units: Vec<Id> = (0..2 * n)
            .map(|i| graph.symbol(&format!("segment component {i}"), Kind::State))
            .collect();
        let replaced: FxHashMap<Id, Id> = (system.inputs.iter().zip(&units))
            .map(|(z, y)| (*z, graph.mul(size, *y)))
            .collect();
        // By column, then transposed.
        let by_input: Vec<Vec<Id>> = (system.inputs.iter())
            .map(|x| graph.diff_all(&system.rate[..2 * n], *x))
            .collect();
        let mut roots = system.rate.clone();
        roots.extend((0..2 * n).flat_map(|i| by_input.iter().map(move |c| c[i])));
        let roots = graph.substitute(&roots, &replaced);
        let (system_rates, jacobian) = roots.split_at(2 * n + 1);
        let switches = graph.kinks(system_rates);

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
        let kinks = (!switches.is_empty()).then_some((inputs.clone(), switches));
        for c in 0..columns {
            let column: Vec<Id> = (0..2 * n)
                .map(|i| graph.symbol(&format!("variation {c} {i}"), Kind::State))
                .collect();
            for row in jacobian.chunks(2 * n) {
                let rate = product(&mut graph, row, &column);
                rates.push(graph.mul(backward, rate));
            }
            inputs.extend(column);
        }
        let varied = Program::lower(&graph, &inputs, &rates);
        let scales = (widths.iter().copied())
            .chain(widths.iter().map(|w| value_scale / w))
            .collect();
        Self {
            states: n,
            columns,
            plain,
            varied,
            kinks: kinks.map(|(inputs, switches)| Program::lower(&graph, &inputs, &switches)),
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

fn product(graph: &mut Graph, row: &[Id], column: &[Id]) -> Id {
    let terms = (row.iter().zip(column))
        .filter(|(a, _)| !graph.is_zero(**a))
        .map(|(a, v)| (*a, *v))
        .collect::<Vec<_>>();
    let terms: Vec<Id> = terms.into_iter().map(|(a, v)| graph.mul(a, v)).collect();
    graph.sum(&terms)
}
