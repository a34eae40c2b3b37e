//! The extremal controls and disturbances: `dH/d(u, w) = 0`, solved symbolically.

use super::implied_guard;
use crate::diagnostics::Problem;
use crate::expr::{Graph, Id, NotPolynomial, Polynomial};
use crate::model::{Guard, Located, Model, Span, Variable};
use std::collections::HashMap;

/// Highest power of the inputs looked at: enough to name the offending term.
const MAX_DEGREE: u8 = 6;

pub(super) struct Optimum {
    pub control: Vec<Id>,
    pub unclamped: Vec<Id>,
    pub disturbance: Vec<Id>,
    pub guards: Vec<Guard>,
}

impl Optimum {
    /// Input symbol -> extremal expression.
    pub fn replacements(&self, model: &Model) -> HashMap<Id, Id> {
        let controls = model
            .controls
            .iter()
            .map(|c| c.variable.symbol)
            .zip(self.control.iter().copied());
        let disturbances = model
            .disturbances
            .iter()
            .map(|w| w.symbol)
            .zip(self.disturbance.iter().copied());
        controls.chain(disturbances).collect()
    }
}

/// Solves for `u*`, `w*` as functions of (x, p).
pub(super) fn extremal_inputs(
    model: &Model,
    graph: &mut Graph,
    p: &[Id],
) -> Result<Optimum, Vec<Problem>> {
    let inputs: Vec<&Variable> = model
        .controls
        .iter()
        .map(|c| &c.variable)
        .chain(&model.disturbances)
        .collect();
    let symbols: Vec<Id> = inputs.iter().map(|v| v.symbol).collect();
    let mut problems = Vec::new();

    let mut rates = Vec::new();
    for (state, rate) in model.states.iter().zip(&model.dynamics) {
        let what = format!("the dynamics of `{}`", state.variable.name);
        match read(graph, rate, &symbols, &inputs, 1, &what, "affine") {
            Ok(poly) => rates.push(poly),
            Err(problem) => problems.push(problem),
        }
    }
    let cost = match read(
        graph,
        &model.running,
        &symbols,
        &inputs,
        2,
        "the running cost",
        "quadratic",
    ) {
        Ok(poly) => poly,
        Err(problem) => {
            problems.push(problem);
            Polynomial::new()
        }
    };
    if !problems.is_empty() {
        return Err(problems);
    }

    let m = inputs.len();
    let zero = graph.constant(0.0);
    let coefficient = |poly: &Polynomial, hits: &[usize]| {
        let mut e = vec![0u8; m];
        hits.iter().for_each(|&k| e[k] += 1);
        poly.get(&e).copied().unwrap_or(zero)
    };
    // dH/dz = hessian z + gradient, z = (u, w).
    let mut gradient = Vec::with_capacity(m);
    let mut hessian = vec![vec![zero; m]; m];
    for i in 0..m {
        let mut terms = vec![coefficient(&cost, &[i])];
        for (rate, &adjoint) in rates.iter().zip(p) {
            let c = coefficient(rate, &[i]);
            terms.push(graph.mul(c, adjoint));
        }
        gradient.push(graph.sum(&terms));
        for j in 0..m {
            let c = coefficient(&cost, &[i, j]);
            hessian[i][j] = if i == j {
                let two = graph.constant(2.0);
                graph.mul(two, c)
            } else {
                c
            };
        }
    }
    check_hessian(model, graph, &inputs, &hessian, &mut problems);
    if !problems.is_empty() {
        return Err(problems);
    }
    let guards = definiteness_guards(model, graph, &inputs, &hessian);
    let solution = solve(graph, hessian, gradient);

    let mut control = Vec::new();
    for (c, &u) in model.controls.iter().zip(&solution) {
        let mut v = u;
        if let Some(lo) = c.min {
            let lo = graph.constant(lo);
            v = graph.max(v, lo);
        }
        if let Some(hi) = c.max {
            let hi = graph.constant(hi);
            v = graph.min(v, hi);
        }
        control.push(v);
    }
    let k = model.controls.len();
    Ok(Optimum {
        control,
        unclamped: solution[..k].to_vec(),
        disturbance: solution[k..].to_vec(),
        guards,
    })
}

/// `located` as a polynomial in the inputs of at most `degree`, or the reason why it is not.
fn read(
    graph: &mut Graph,
    located: &Located,
    symbols: &[Id],
    inputs: &[&Variable],
    degree: u8,
    what: &str,
    class: &str,
) -> Result<Polynomial, Problem> {
    let names = inputs
        .iter()
        .map(|v| format!("`{}`", v.name))
        .collect::<Vec<_>>()
        .join(", ");
    let refuse = |reason: String| {
        Problem::at(located.span.clone(), format!("{what} must be {class} in {names}: {reason}"), "not handled")
            .with_help("the optimal control is derived in closed form, which needs dynamics affine and a running cost quadratic in the controls (and disturbances)")
    };
    let poly = graph
        .polynomial(located.expr, symbols, MAX_DEGREE)
        .map_err(|e| match e {
            NotPolynomial::Inside(text) => refuse(format!("it contains `{text}`")),
            NotPolynomial::Degree => refuse(format!("its degree is above {MAX_DEGREE}")),
        })?;
    let total = |e: &[u8]| e.iter().map(|n| u32::from(*n)).sum::<u32>();
    if let Some((e, _)) = poly.iter().find(|(e, _)| total(e) > u32::from(degree)) {
        let factors: Vec<String> = e
            .iter()
            .zip(inputs)
            .filter(|(n, _)| **n > 0)
            .map(|(n, v)| {
                if *n == 1 {
                    v.name.clone()
                } else {
                    format!("{}^{n}", v.name)
                }
            })
            .collect();
        return Err(refuse(format!("it has a term in {}", factors.join("*"))));
    }
    Ok(poly)
}

/// Value of `expr` at the reference point (parameters and states only), where it is finite.
fn at_reference(model: &Model, graph: &Graph, expr: Id) -> f64 {
    let mut values = model.parameter_values();
    values.extend(
        model
            .states
            .iter()
            .map(|s| s.variable.symbol)
            .zip(model.reference().iter().copied()),
    );
    graph.eval(&[expr], &values)[0]
}

fn check_hessian(
    model: &Model,
    graph: &Graph,
    inputs: &[&Variable],
    hessian: &[Vec<Id>],
    problems: &mut Vec<Problem>,
) {
    let k = model.controls.len();
    let span = |_: usize| -> Span { model.running.span.clone() };
    for (i, input) in inputs.iter().enumerate() {
        let (role, sign, shape) = if i < k {
            ("control", 1.0, "convex")
        } else {
            ("disturbance", -1.0, "concave")
        };
        let curvature = at_reference(model, graph, hessian[i][i]);
        if graph.is_zero(hessian[i][i]) {
            problems.push(
                Problem::at(
                    span(i),
                    format!(
                        "the running cost has no quadratic term in {role} `{}`",
                        input.name
                    ),
                    "no such term",
                )
                .with_help(format!(
                    "add a term {}*{}^2",
                    if i < k { "r" } else { "-gamma^2" },
                    input.name
                )),
            );
        } else if sign * curvature <= 0.0 || curvature.is_nan() {
            problems.push(Problem::at(
                span(i),
                format!("the running cost must be {shape} in {role} `{}`: its second derivative there is {curvature} at the reference point", input.name),
                format!("not {shape}"),
            ));
        }
    }
    for (i, control) in model.controls.iter().enumerate() {
        let Some(bounds) = control
            .bounds_span
            .clone()
            .filter(|_| control.min.is_some() || control.max.is_some())
        else {
            continue;
        };
        for (j, other) in inputs.iter().enumerate() {
            if j != i && !graph.is_zero(hessian[i][j]) {
                problems.push(
                    Problem::at(
                        bounds.clone(),
                        format!(
                            "bounds on `{}` cannot be handled: the cost couples it to `{}` (a term {}*{}), and a clamp is exact only for a diagonal control Hessian",
                            control.variable.name, other.name, control.variable.name, other.name
                        ),
                        "bounded, but coupled",
                    )
                    .with_help("remove the bounds, or the cross term from the running cost"),
                );
            }
        }
    }
    // A dense block must be definite as a whole, not only on its diagonal.
    for (range, sign) in [(0..k, 1.0), (k..inputs.len(), -1.0)] {
        let size = range.len();
        if size < 2 || !problems.is_empty() {
            continue;
        }
        let entries = range
            .clone()
            .flat_map(|i| range.clone().map(move |j| (i, j)));
        let numbers: Vec<f64> = entries
            .map(|(i, j)| sign * at_reference(model, graph, hessian[i][j]))
            .collect();
        let smallest = nalgebra::DMatrix::from_row_slice(size, size, &numbers)
            .symmetric_eigenvalues()
            .min();
        if smallest.is_nan() || smallest <= 0.0 {
            problems.push(Problem::at(
                span(0),
                format!("the Hessian of the running cost in the inputs is not definite: smallest eigenvalue {smallest:.6e} at the reference point"),
                "not definite",
            ));
        }
    }
}

/// Where the Hessian depends on the state it could lose its sign away from the reference point: a
/// guard each.
fn definiteness_guards(
    model: &Model,
    graph: &mut Graph,
    inputs: &[&Variable],
    hessian: &[Vec<Id>],
) -> Vec<Guard> {
    let states: Vec<Id> = model.states.iter().map(|s| s.variable.symbol).collect();
    let mut guards = Vec::new();
    let k = model.controls.len();
    for (i, input) in inputs.iter().enumerate() {
        let varies = states.iter().any(|s| graph.depends_on(&hessian[i], *s));
        if varies {
            let pivot = pivot(graph, hessian, i);
            let expr = if i < k { pivot } else { graph.neg(pivot) };
            guards.push(implied_guard(
                format!("definite_in_{}", input.name),
                expr,
                &model.running,
            ));
        }
    }
    guards
}

/// The `i`-th pivot of elimination without exchange: positive for all i exactly for a positive
/// definite matrix.
fn pivot(graph: &mut Graph, hessian: &[Vec<Id>], i: usize) -> Id {
    let mut a: Vec<Vec<Id>> = hessian[..=i].iter().map(|row| row[..=i].to_vec()).collect();
    for k in 0..i {
        eliminate(graph, &mut a, &mut [], k);
    }
    a[i][i]
}

fn eliminate(graph: &mut Graph, a: &mut [Vec<Id>], b: &mut [Id], k: usize) {
    for i in k + 1..a.len() {
        if graph.is_zero(a[i][k]) {
            continue;
        }
        let factor = graph.div(a[i][k], a[k][k]);
        for j in k..a.len() {
            let t = graph.mul(factor, a[k][j]);
            a[i][j] = graph.sub(a[i][j], t);
        }
        if !b.is_empty() {
            let t = graph.mul(factor, b[k]);
            b[i] = graph.sub(b[i], t);
        }
    }
}

/// Solves `a z = -b` by symbolic elimination (definite blocks need no pivoting).
fn solve(graph: &mut Graph, mut a: Vec<Vec<Id>>, b: Vec<Id>) -> Vec<Id> {
    let m = b.len();
    let mut rhs: Vec<Id> = b.into_iter().map(|v| graph.neg(v)).collect();
    for k in 0..m {
        eliminate(graph, &mut a, &mut rhs, k);
    }
    let mut z = rhs.clone();
    for i in (0..m).rev() {
        let mut v = rhs[i];
        for j in i + 1..m {
            let t = graph.mul(a[i][j], z[j]);
            v = graph.sub(v, t);
        }
        z[i] = graph.div(v, a[i][i]);
    }
    z
}
