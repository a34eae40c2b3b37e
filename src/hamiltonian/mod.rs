//! The Hamiltonian and its bicharacteristics, derived symbolically from the dynamics and the cost.
//!
//! `H(x, p) = min_u max_w [ p'f(x, u, w) + L(x, u, w) ]`. f is affine and L quadratic in (u, w), so
//! the extremal `u*`, `w*` are explicit; box bounds are a clamp, exact where the Hessian of H in
//! that control is diagonal. By the envelope theorem `dH/dx` is taken at fixed `u*`, `w*`, clamps
//! included (Hardt 1999, chapter V).

mod optimal;
mod slope;
mod system;

pub use optimal::clamped;
pub use slope::{Slope, infinite};
pub use system::{GuardExpr, Observer, System, Terminal, deviations};

use crate::diagnostics::Problem;
use crate::expr::{Graph, Id, Kind};
use crate::model::{Guard, Located, Model};
use rustc_hash::FxHashMap;

/// The derived equations, in the scene's own symbols (parameters not yet replaced by their values).
#[derive(Clone, Debug)]
pub struct Hamiltonian {
    pub graph: Graph,
    /// State symbols.
    pub x: Vec<Id>,
    /// Adjoint symbols, `p = dV/dx`.
    pub p: Vec<Id>,
    /// Optimal control of (x, p), clamped where bounded.
    pub control: Vec<Id>,
    /// The same without the bounds.
    pub unclamped: Vec<Id>,
    /// Worst-case disturbance of (x, p).
    pub disturbance: Vec<Id>,
    /// H(x, p) with `u*`, `w*` inserted.
    pub value: Id,
    /// H as a function of (x, p, u, w), for display.
    pub open: Id,
    /// `x' = dH/dp = f(x, u*, w*)`.
    pub state_rate: Vec<Id>,
    /// `p' = -dH/dx`.
    pub adjoint_rate: Vec<Id>,
    /// `L(x, u*, w*)`; `V' = -L`.
    pub running: Id,
    /// The scene's guards and those that keep the Hessian of H in u definite where it depends on x.
    pub guards: Vec<Guard>,
}

/// Operations, or states, up to which derivatives are also taken symbol by symbol.
const SHORT: usize = 200;
const FEW: usize = 4;

/// Whether derivatives of an expression may be written out symbol by symbol.
fn is_short(graph: &Graph, expr: Id, states: usize) -> bool {
    states <= FEW || graph.reachable(&[expr]).len() <= SHORT
}

/// dH/dx at fixed inputs: in reverse, for the price of a few H, or symbol by symbol where that is
/// less.
fn slopes(graph: &mut Graph, open: Id, x: &[Id]) -> Vec<Id> {
    let reverse = graph.gradient(open, x);
    if !is_short(graph, open, x.len()) {
        return reverse;
    }
    let forward: Vec<Id> = x.iter().map(|state| graph.diff(open, *state)).collect();
    let operations = |slopes: &[Id]| {
        let reached = graph.reachable(&[&[open], slopes].concat());
        reached
            .iter()
            .filter(|id| graph.arguments(**id).next().is_some())
            .count()
    };
    if operations(&reverse) < operations(&forward) {
        reverse
    } else {
        forward
    }
}

impl Hamiltonian {
    /// Derives all equations of a scene.
    ///
    /// # Errors
    /// Every reason why the scene is outside the class handled: dynamics not affine or cost not
    /// quadratic in the controls and disturbances, no (or an indefinite) quadratic term, bounds on
    /// a control coupled to another.
    pub fn derive(model: &Model) -> Result<Self, Vec<Problem>> {
        let mut graph = model.graph.clone();
        let x: Vec<Id> = model.states.iter().map(|s| s.variable.symbol).collect();
        let p: Vec<Id> = model
            .states
            .iter()
            .map(|s| graph.symbol(&format!("p_{}", s.variable.name), Kind::Adjoint))
            .collect();

        let optimum = optimal::extremal_inputs(model, &mut graph, &p)?;
        let f: Vec<Id> = model.dynamics.iter().map(|d| d.expr).collect();
        let terms: Vec<Id> = p.iter().zip(&f).map(|(p, f)| graph.mul(*p, *f)).collect();
        let power = graph.sum(&terms);
        let open = graph.add(power, model.running.expr);

        let mut roots = f.clone();
        roots.push(model.running.expr);
        roots.push(open);
        let slopes = slopes(&mut graph, open, &x);
        roots.extend(slopes.iter().map(|slope| graph.neg(*slope)));
        let inserted = graph.substitute(&roots, &optimum.replacements(model));
        let n = x.len();
        Ok(Self {
            state_rate: inserted[..n].to_vec(),
            running: inserted[n],
            value: inserted[n + 1],
            adjoint_rate: inserted[n + 2..].to_vec(),
            open,
            control: optimum.control,
            unclamped: optimum.unclamped,
            disturbance: optimum.disturbance,
            guards: model.guards.iter().cloned().chain(optimum.guards).collect(),
            graph,
            x,
            p,
        })
    }

    /// Number of states.
    pub fn states(&self) -> usize {
        self.x.len()
    }

    /// Hessian of H in (x, p) without the clamps, at the reference point and p = 0, row-major (2n x
    /// 2n).
    ///
    /// The clamps are left out because the equilibrium control lies strictly between its bounds.
    pub fn hessian_at(&self, model: &Model) -> Vec<f64> {
        let mut graph = self.graph.clone();
        let swap: FxHashMap<Id, Id> = model
            .controls
            .iter()
            .map(|c| c.variable.symbol)
            .zip(self.unclamped.clone())
            .collect();
        let worst = model
            .disturbances
            .iter()
            .map(|w| w.symbol)
            .zip(self.disturbance.clone());
        let map = swap.into_iter().chain(worst).collect();
        let smooth = graph.substitute(&[self.open], &map)[0];
        let variables: Vec<Id> = self.x.iter().chain(&self.p).copied().collect();
        let point = self.point(model);
        // Written out, what cancels does so exactly.
        if is_short(&graph, smooth, self.x.len()) {
            let mut second = Vec::new();
            for &a in &variables {
                let slope = graph.diff(smooth, a);
                for &b in &variables {
                    second.push(graph.diff(slope, b));
                }
            }
            return graph.eval(&second, &point);
        }
        graph.hessian(smooth, &variables, &point)
    }

    /// Values of parameters, states at the reference point and zero adjoints.
    pub fn point(&self, model: &Model) -> FxHashMap<Id, f64> {
        let mut values = model.parameter_values();
        values.extend(
            self.x
                .iter()
                .copied()
                .zip(model.reference().iter().copied()),
        );
        values.extend(self.p.iter().map(|p| (*p, 0.0)));
        values
    }
}

/// A guard that the program adds itself.
pub(crate) fn implied_guard(name: String, expr: Id, from: &Located) -> Guard {
    Guard {
        name,
        condition: Located {
            expr,
            span: from.span.clone(),
        },
        strict: true,
    }
}
