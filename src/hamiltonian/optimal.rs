//! The extremal controls and disturbances: `dH/d(u, w) = 0`, solved symbolically.

use super::implied_guard;
use crate::diagnostics::Problem;
use crate::expr::{Graph, Id, NotPolynomial, Polynomial};
use crate::model::{Control, Guard, Located, Model, Variable};
use rustc_hash::FxHashMap;
use std::ops::Range;

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
    pub fn replacements(&self, model: &Model) -> FxHashMap<Id, Id> {
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
///
/// # Errors
/// All reasons why there is no closed form.
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
    let (driven, cost) = input_terms(model, graph, &inputs, p)?;
    let (hessian, gradient) = derivatives(graph, &driven, &cost);
    check_hessian(model, graph, &inputs, &hessian)?;
    let guards = definiteness_guards(model, graph, &inputs, &hessian);
    let solution = solve(graph, hessian, gradient);

    let control = (model.controls.iter().zip(&solution))
        .map(|(control, u)| clamped(graph, control, *u))
        .collect();
    let k = model.controls.len();
    Ok(Optimum {
        control,
        unclamped: solution[..k].to_vec(),
        disturbance: solution[k..].to_vec(),
        guards,
    })
}

/// `d(p'f)/dz`, z = (u, w), free of z, and the running cost as a polynomial in z.
///
/// # Errors
/// All reasons why the dynamics are not affine and the cost is not quadratic in the inputs.
fn input_terms(
    model: &Model,
    graph: &mut Graph,
    inputs: &[&Variable],
    p: &[Id],
) -> Result<(Vec<Id>, Polynomial), Vec<Problem>> {
    let symbols: Vec<Id> = inputs.iter().map(|v| v.symbol).collect();
    let rates: Vec<Id> = model.dynamics.iter().map(|d| d.expr).collect();
    let mut problems = Vec::new();
    let seen_affine = graph.degrees(&rates, &symbols);
    let driven = if seen_affine.iter().all(|d| d.is_some_and(|d| d <= 1)) {
        let terms: Vec<Id> = p
            .iter()
            .zip(&rates)
            .map(|(p, f)| graph.mul(*p, *f))
            .collect();
        let power = graph.sum(&terms);
        graph.gradient(power, &symbols)
    } else {
        // What is not seen to be affine may be so once it is taken apart.
        affine_terms(model, graph, inputs, p).unwrap_or_else(|found| {
            problems.extend(found);
            Vec::new()
        })
    };
    let running = &model.running;
    let what = "the running cost";
    match read(graph, running, &symbols, inputs, 2, what, "quadratic") {
        Ok(cost) if problems.is_empty() => return Ok((driven, cost)),
        Ok(_) => {}
        Err(problem) => problems.push(problem),
    }
    Err(problems)
}

/// `d(p'f)/dz` by f as polynomials in z.
///
/// # Errors
/// All reasons why these are not affine.
fn affine_terms(
    model: &Model,
    graph: &mut Graph,
    inputs: &[&Variable],
    p: &[Id],
) -> Result<Vec<Id>, Vec<Problem>> {
    let symbols: Vec<Id> = inputs.iter().map(|v| v.symbol).collect();
    let mut problems = Vec::new();
    let mut terms = vec![Vec::new(); inputs.len()];
    for ((state, rate), &adjoint) in model.states.iter().zip(&model.dynamics).zip(p) {
        let what = format!("the dynamics of `{}`", state.variable.name);
        match read(graph, rate, &symbols, inputs, 1, &what, "affine") {
            Ok(poly) => {
                for (i, terms) in terms.iter_mut().enumerate() {
                    if let Some(&c) = poly.get(&unit(inputs.len(), &[i])) {
                        terms.push(graph.mul(c, adjoint));
                    }
                }
            }
            Err(problem) => problems.push(problem),
        }
    }
    match problems.is_empty() {
        true => Ok(terms.iter().map(|terms| graph.sum(terms)).collect()),
        false => Err(problems),
    }
}

/// Exponents of a product of inputs.
fn unit(inputs: usize, hits: &[usize]) -> Vec<u8> {
    let mut exponents = vec![0u8; inputs];
    hits.iter().for_each(|&k| exponents[k] += 1);
    exponents
}

/// `dH/dz = hessian z + gradient`, z = (u, w), of `d(p'f)/dz` and the cost as a polynomial in z.
fn derivatives(graph: &mut Graph, driven: &[Id], cost: &Polynomial) -> (Vec<Vec<Id>>, Vec<Id>) {
    let m = driven.len();
    let zero = graph.constant(0.0);
    let coefficient = |hits: &[usize]| cost.get(&unit(m, hits)).copied().unwrap_or(zero);
    let mut gradient = Vec::with_capacity(m);
    let mut hessian = vec![vec![zero; m]; m];
    for i in 0..m {
        gradient.push(graph.add(coefficient(&[i]), driven[i]));
        for j in 0..m {
            let c = coefficient(&[i, j]);
            hessian[i][j] = if i == j {
                let two = graph.constant(2.0);
                graph.mul(two, c)
            } else {
                c
            };
        }
    }
    (hessian, gradient)
}

/// A control within its bounds.
pub fn clamped(graph: &mut Graph, control: &Control, u: Id) -> Id {
    let mut v = u;
    if let Some(lo) = control.min {
        let lo = graph.constant(lo);
        v = graph.max(v, lo);
    }
    if let Some(hi) = control.max {
        let hi = graph.constant(hi);
        v = graph.min(v, hi);
    }
    v
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

/// Whether the running cost is convex in the controls and concave in the disturbances, and the
/// bounds are on controls that the cost does not couple.
///
/// # Errors
/// All reasons why not.
fn check_hessian(
    model: &Model,
    graph: &Graph,
    inputs: &[&Variable],
    hessian: &[Vec<Id>],
) -> Result<(), Vec<Problem>> {
    let k = model.controls.len();
    let mut problems = Vec::new();
    for (i, input) in inputs.iter().enumerate() {
        let curvature = (hessian[i][i], at_reference(model, graph, hessian[i][i]));
        let is_control = i < k;
        problems.extend(curvature_problem(
            model, graph, input, is_control, curvature,
        ));
    }
    for (i, control) in model.controls.iter().enumerate() {
        let others = inputs.iter().enumerate();
        let coupled = others
            .filter(|(j, _)| *j != i && !graph.is_zero(hessian[i][*j]))
            .map(|(_, other)| *other);
        problems.extend(coupling_problems(control, coupled));
    }
    // A dense block must be definite as a whole, not only on its diagonal.
    for (range, sign) in [(0..k, 1.0), (k..inputs.len(), -1.0)] {
        if range.len() < 2 || !problems.is_empty() {
            continue;
        }
        let smallest = smallest_eigenvalue(model, graph, hessian, range, sign);
        if smallest.is_nan() || smallest <= 0.0 {
            problems.push(Problem::at(
                model.running.span.clone(),
                format!("the Hessian of the running cost in the inputs is not definite: smallest eigenvalue {smallest:.6e} at the reference point"),
                "not definite",
            ));
        }
    }
    if problems.is_empty() {
        Ok(())
    } else {
        Err(problems)
    }
}

/// What is wrong with the second derivative of the running cost by an input: an expression, and its
/// value at the reference point.
fn curvature_problem(
    model: &Model,
    graph: &Graph,
    input: &Variable,
    is_control: bool,
    (second, curvature): (Id, f64),
) -> Option<Problem> {
    let span = model.running.span.clone();
    let (role, sign, shape, weight) = if is_control {
        ("control", 1.0, "convex", "r")
    } else {
        ("disturbance", -1.0, "concave", "-gamma^2")
    };
    if graph.is_zero(second) {
        let message = format!(
            "the running cost has no quadratic term in {role} `{}`",
            input.name
        );
        let help = format!("add a term {weight}*{}^2", input.name);
        return Some(Problem::at(span, message, "no such term").with_help(help));
    }
    (sign * curvature <= 0.0 || curvature.is_nan()).then(|| {
        Problem::at(
            span,
            format!("the running cost must be {shape} in {role} `{}`: its second derivative there is {curvature} at the reference point", input.name),
            format!("not {shape}"),
        )
    })
}

/// The inputs that the cost couples to a control which has bounds.
fn coupling_problems<'m>(
    control: &'m Control,
    coupled: impl Iterator<Item = &'m Variable>,
) -> impl Iterator<Item = Problem> {
    let is_bounded = control.min.is_some() || control.max.is_some();
    let bounds = control.bounds_span.as_ref().filter(|_| is_bounded);
    coupled.filter_map(move |other| {
        let problem = Problem::at(
            bounds?.clone(),
            format!(
                "bounds on `{}` cannot be handled: the cost couples it to `{}` (a term {}*{}), and a clamp is exact only for a diagonal control Hessian",
                control.variable.name, other.name, control.variable.name, other.name
            ),
            "bounded, but coupled",
        );
        let help = "remove the bounds, or the cross term from the running cost";
        Some(problem.with_help(help))
    })
}

/// Of a diagonal block of the Hessian, times a sign, at the reference point.
fn smallest_eigenvalue(
    model: &Model,
    graph: &Graph,
    hessian: &[Vec<Id>],
    block: Range<usize>,
    sign: f64,
) -> f64 {
    let size = block.len();
    let entries = block
        .clone()
        .flat_map(|i| block.clone().map(move |j| (i, j)));
    let numbers: Vec<f64> = entries
        .map(|(i, j)| sign * at_reference(model, graph, hessian[i][j]))
        .collect();
    nalgebra::DMatrix::from_row_slice(size, size, &numbers)
        .symmetric_eigenvalues()
        .min()
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
