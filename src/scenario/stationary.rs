//! What the local solution at an equilibrium needs of the equations: a running cost that is
//! stationary there, and neither cost nor dynamics with a kink there.

use super::equilibrium::{POINTS, Scene, is_zero, sized};
use super::reader::Reader;
use crate::diagnostics::Problem;
use crate::expr::{Fun, Graph, Id, Kind, Node};
use crate::model::Located;
use rustc_hash::FxHashMap;

/// Longest text of an expression that is shown, in leaves of its tree.
const SHOWN: f64 = 40.0;

impl Reader<'_> {
    /// Checks dL/dx = 0 at the equilibrium (the characteristics rest at (x*, 0) only there; dL/du =
    /// 0 is checked with the extremal controls) and that nothing the linearization is made of jumps
    /// there. `values` are those of all symbols at the equilibrium.
    pub fn check_smooth_rest(&mut self, values: &FxHashMap<Id, f64>, scene: &Scene<'_>) {
        // Derivatives are looked at in a graph of their own: that of the model stays as it is.
        let mut graph = self.graph.clone();
        let before = self.problems.len();
        let places = places(values, scene);
        self.check_kinks(&mut graph, &places, scene);
        if self.problems.len() > before {
            return;
        }
        for state in scene.states {
            let slope = graph.diff(scene.running.expr, state.symbol);
            let (value, size) = at_all(&graph, slope, &places);
            // What is not finite has no second derivatives either, which the linearization says.
            if value.is_finite() && !is_zero(value, size) {
                let name = &state.name;
                let message = format!(
                    "the running cost is not stationary at the equilibrium: dL/d{name} is {value:.6e} there, not 0"
                );
                let label = format!("dL/d{name} = {value:.6e} at the equilibrium");
                let help = format!(
                    "with such a term rest is not optimal (on one side of it L is negative) or dV/dx is not 0 there, from \
                     which the local solution starts; write the cost in terms of the deviation from the equilibrium, such \
                     as ({name} - {at})^2, move [equilibrium] to where L is least, or give [cost] a final_time",
                    at = places[0][&state.symbol]
                );
                self.report(
                    Problem::at(scene.running.span.clone(), message, label).with_help(help),
                );
            }
        }
    }

    fn check_kinks(&mut self, graph: &mut Graph, places: &[FxHashMap<Id, f64>], scene: &Scene<'_>) {
        let inputs: Vec<Id> = (scene.states.iter().map(|s| s.symbol))
            .chain(scene.controls.iter().map(|c| c.variable.symbol))
            .chain(scene.disturbances.iter().map(|w| w.symbol))
            .collect();
        let rates = (scene.dynamics.iter().zip(scene.states))
            .map(|(f, state)| (format!("the dynamics of `{}` have", state.name), f, 1));
        let cost = ("the running cost has".to_owned(), scene.running, 2);
        for (what, located, order) in rates.chain([cost]) {
            if let Some(kink) = kink(graph, located, order, &inputs, places) {
                let message = format!("{what} a kink at the equilibrium: {kink}");
                let help = "the local solution needs the dynamics once and the cost twice differentiable at the equilibrium: \
                            round the kink, such as sqrt(a^2 + e^2) - e for abs(a) with a small e, or move [equilibrium] off it \
                            (in the controls the cost has to be quadratic)";
                let problem = Problem::at(
                    located.span.clone(),
                    message,
                    "not smooth at the equilibrium",
                );
                self.report(problem.with_help(help));
            }
        }
    }
}

/// The equilibrium, and points of the region with everything else as there.
fn places(values: &FxHashMap<Id, f64>, scene: &Scene<'_>) -> Vec<FxHashMap<Id, f64>> {
    let over = (0..POINTS)
        .filter_map(|k| Some((k, scene.region?)))
        .map(|(k, region)| {
            let mut values = values.clone();
            values.extend(super::equilibrium::point_of(k, scene.states, region));
            values
        });
    [values.clone()].into_iter().chain(over).collect()
}

/// Value at the first place, and the largest size of its terms at any.
fn at_all(graph: &Graph, expr: Id, places: &[FxHashMap<Id, f64>]) -> (f64, f64) {
    let (value, size) = sized(graph, expr, &places[0]);
    let sizes = places[1..]
        .iter()
        .map(|values| sized(graph, expr, values).1);
    (value, sizes.filter(|s| s.is_finite()).fold(size, f64::max))
}

/// The first kink through the equilibrium across which a derivative up to `order` jumps, in words.
///
/// Each abs(a) with a = 0 there becomes sign * a. A derivative that differs between sign = 1 and -1
/// jumps: that of abs(x) does, that of the drag v*abs(v) does not.
fn kink(
    graph: &mut Graph,
    located: &Located,
    order: usize,
    inputs: &[Id],
    places: &[FxHashMap<Id, f64>],
) -> Option<String> {
    let mut places = places.to_vec();
    let (expr, kinks) = with_signs(graph, located.expr, &mut places);
    if kinks.is_empty() {
        return None;
    }
    let mut derivatives: Vec<Id> = inputs.iter().map(|i| graph.diff(expr, *i)).collect();
    if order == 2 {
        let first = derivatives.clone();
        for slope in first {
            derivatives.extend(inputs.iter().map(|i| graph.diff(slope, *i)));
        }
    }
    for (sign, text) in &kinks {
        for others in [1.0, -1.0] {
            let mut side = |value: f64, derivative: Id| {
                for at in &mut places {
                    at.extend(kinks.iter().map(|(s, _)| (*s, others)));
                    at.insert(*sign, value);
                }
                at_all(graph, derivative, &places)
            };
            for &derivative in &derivatives {
                let ((above, size), (below, other)) =
                    (side(1.0, derivative), side(-1.0, derivative));
                let jump = above - below;
                if jump.is_finite() && !is_zero(jump, size.max(other)) {
                    return Some(format!("`{text}`, whose argument is 0 there"));
                }
            }
        }
    }
    None
}

/// An expression with each abs(a), a = 0 at the first place, as sign * a; the new symbols, which
/// are given the value 1 at all places, with the text of what they stand in for.
fn with_signs(
    graph: &mut Graph,
    expr: Id,
    places: &mut [FxHashMap<Id, f64>],
) -> (Id, Vec<(Id, String)>) {
    let (mut expr, mut kinks) = (expr, Vec::new());
    loop {
        let found = graph
            .reachable(&[expr])
            .into_iter()
            .find_map(|id| match graph.node(id) {
                Node::Unary(Fun::Abs, a) => {
                    let (value, size) = at_all(graph, a, places);
                    is_zero(value, size).then_some((id, a))
                }
                _ => None,
            });
        let Some((id, argument)) = found else {
            return (expr, kinks);
        };
        let text = shown(graph, id);
        // A name that no scene can give.
        let sign = graph.symbol(&format!("sign of kink {}", kinks.len()), Kind::Parameter);
        for at in places.iter_mut() {
            at.insert(sign, 1.0);
        }
        let side = graph.mul(sign, argument);
        expr = graph.substitute(&[expr], &FxHashMap::from_iter([(id, side)]))[0];
        kinks.push((sign, text));
    }
}

/// The text of an expression, if it is short: shared parts are written out each time.
fn shown(graph: &Graph, id: Id) -> String {
    let leaves = graph.fold(
        &[id],
        &mut |_| 1.0,
        &mut |_| 1.0,
        &mut |_, a| *a,
        &mut |_, a, b| a + b,
    )[0];
    if leaves <= SHOWN {
        graph.show(id)
    } else {
        "abs(...)".to_owned()
    }
}
