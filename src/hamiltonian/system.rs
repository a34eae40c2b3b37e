//! The equations in the form that is integrated: numbers for parameters, deviations from the
//! reference point for states, backward time.

use super::Hamiltonian;
use crate::expr::{Deviation, Graph, Id, Kind};
use crate::model::{Guard, Horizon, Model};
use crate::program::Program;
use rustc_hash::FxHashMap;

/// The backward bicharacteristics of a scene.
///
/// The integrated vector is `(s, p, V)` with `s = x - reference`, of dimension `2n + 1`, as
/// functions of `tau = -t`: `ds/dtau = -f`, `dp/dtau = dH/dx`, `dV/dtau = L`.
#[derive(Clone, Debug)]
pub struct System {
    pub graph: Graph,
    /// Number of states n.
    pub states: usize,
    /// Input symbols: deviations `s`, then adjoints `p`.
    pub inputs: Vec<Id>,
    /// Derivatives of `(s, p, V)` by backward time.
    pub rate: Vec<Id>,
    /// Arc length per backward time in coordinates scaled by the region's widths.
    pub arc_rate: Id,
    /// What is reported at a point.
    pub observer: Observer,
    pub guards: Vec<GuardExpr>,
    /// x at s = 0.
    pub reference: Vec<f64>,
    /// L at the point of least cost in u for the given s (p = 0): where it is nowhere negative V is
    /// monotone.
    pub least_running: Id,
    /// Terminal cost and its gradient, where the horizon is finite.
    pub terminal: Option<Terminal>,
}

/// `phi(x(T))` and `dphi/dx` as functions of `s`.
#[derive(Clone, Debug)]
pub struct Terminal {
    pub value: Id,
    pub gradient: Vec<Id>,
    pub time: f64,
}

/// Expressions of `(s, p)` reported with each stored point.
#[derive(Clone, Debug)]
pub struct Observer {
    pub control: Vec<Id>,
    pub disturbance: Vec<Id>,
    pub hamiltonian: Id,
    /// Controls without their bounds, for the range in which the local solution holds.
    pub unclamped: Vec<Id>,
}

/// A guard as an expression of `s` and `p`: inside where `expr > 0` (strict) or `expr >= 0`.
#[derive(Clone, Debug)]
pub struct GuardExpr {
    pub name: String,
    pub expr: Id,
    pub strict: bool,
}

impl GuardExpr {
    /// Guards, one an expression.
    pub(crate) fn all(guards: &[Guard], exprs: Vec<Id>) -> Vec<Self> {
        (guards.iter().zip(exprs))
            .map(|(g, expr)| Self {
                name: g.name.clone(),
                expr,
                strict: g.strict,
            })
            .collect()
    }
}

impl Terminal {
    /// That of a finite horizon; `symbols` are what stands for the scene's symbols.
    fn of(
        graph: &mut Graph,
        hamiltonian: &Hamiltonian,
        model: &Model,
        symbols: &FxHashMap<Id, Deviation>,
    ) -> Option<Self> {
        let Horizon::Finite {
            terminal,
            final_time,
            ..
        } = &model.horizon
        else {
            return None;
        };
        let mut roots = vec![terminal.expr];
        roots.extend(hamiltonian.x.iter().map(|x| graph.diff(terminal.expr, *x)));
        let forms = graph.deviations(&roots, symbols);
        let mut all = forms.into_iter().map(|f| graph.whole(f));
        all.next().map(|value| Self {
            value,
            gradient: all.collect(),
            time: *final_time,
        })
    }
}

/// The input symbols (deviations, then adjoints), and what stands for the scene's symbols.
fn inputs(
    graph: &mut Graph,
    hamiltonian: &Hamiltonian,
    model: &Model,
) -> (Vec<Id>, FxHashMap<Id, Deviation>) {
    let (mut inputs, mut symbols) = deviations(graph, model);
    for &p in &hamiltonian.p {
        symbols.insert(p, Deviation::new(0.0, p));
        inputs.push(p);
    }
    (inputs, symbols)
}

/// Symbols of the deviations of the states, and what stands for the scene's states and parameters.
pub fn deviations(graph: &mut Graph, model: &Model) -> (Vec<Id>, FxHashMap<Id, Deviation>) {
    let mut symbols: FxHashMap<Id, Deviation> = FxHashMap::default();
    let zero = graph.constant(0.0);
    for (symbol, value) in model.parameter_values() {
        symbols.insert(symbol, Deviation::new(value, zero));
    }
    let mut inputs = Vec::new();
    for (state, &at) in model.states.iter().zip(model.reference()) {
        let s = graph.symbol(&format!("d_{}", state.variable.name), Kind::State);
        symbols.insert(state.variable.symbol, Deviation::new(at, s));
        inputs.push(s);
    }
    (inputs, symbols)
}

/// All expressions of a Hamiltonian, in the order in which [`System::new`] takes them apart again.
fn roots(hamiltonian: &Hamiltonian) -> Vec<Id> {
    (hamiltonian.state_rate.iter())
        .chain(&hamiltonian.adjoint_rate)
        .chain([&hamiltonian.running, &hamiltonian.value])
        .chain(&hamiltonian.control)
        .chain(&hamiltonian.unclamped)
        .chain(&hamiltonian.disturbance)
        .copied()
        .chain(hamiltonian.guards.iter().map(|g| g.condition.expr))
        .collect()
}

/// Speed of the states in units of a region's widths.
fn arc_rate(graph: &mut Graph, rates: &[Id], region: &[[f64; 2]]) -> Id {
    let squares: Vec<Id> = (rates.iter().zip(region))
        .map(|(f, [lo, hi])| {
            let width = graph.constant(1.0 / (hi - lo));
            let scaled = graph.mul(*f, width);
            graph.powi(scaled, 2)
        })
        .collect();
    let square = graph.sum(&squares);
    graph.unary(crate::expr::Fun::Sqrt, square)
}

impl System {
    /// The guards that depend on the state alone.
    pub fn guards_of_state(&self) -> Vec<Id> {
        let adjoints = &self.inputs[self.states..];
        (self.guards.iter().map(|g| g.expr))
            .filter(|expr| !adjoints.iter().any(|p| self.graph.depends_on(&[*expr], *p)))
            .collect()
    }

    /// Sizes of the margins of these guards, by which it is told what is rounding: the median of
    /// those that are not 0 at the reference and the middles of a region's faces (as deviations),
    /// next to one of which a guard may have a pole.
    pub fn guard_sizes(&self, region: &[[f64; 2]]) -> Vec<f64> {
        let guards = self.guards_of_state();
        let program = Program::lower(&self.graph, &self.inputs[..self.states], &guards);
        let faces = region
            .iter()
            .enumerate()
            .flat_map(|(i, bounds)| bounds.map(|s| (i, s)));
        let mut sizes = vec![Vec::new(); guards.len()];
        for (i, s) in faces.chain([(0, 0.0)]) {
            let mut state = vec![0.0; self.states];
            state[i] = s;
            let margins = program.eval(&state);
            for (sizes, margin) in sizes
                .iter_mut()
                .zip(margins)
                .filter(|(_, m)| m.is_finite() && *m != 0.0)
            {
                sizes.push(margin.abs());
            }
        }
        let median = |mut sizes: Vec<f64>| {
            sizes.sort_by(f64::total_cmp);
            sizes
                .get(sizes.len().saturating_sub(1) / 2)
                .copied()
                .unwrap_or(0.0)
        };
        sizes.into_iter().map(median).collect()
    }

    /// The bicharacteristics of a scene about its reference point.
    pub fn new(hamiltonian: &Hamiltonian, model: &Model) -> Self {
        let mut graph = hamiltonian.graph.clone();
        let n = hamiltonian.states();
        let (inputs, symbols) = inputs(&mut graph, hamiltonian, model);
        let forms = graph.deviations(&roots(hamiltonian), &symbols);
        let terminal = Terminal::of(&mut graph, hamiltonian, model, &symbols);
        // An equilibrium makes every rate, L and H vanish at s = 0, p = 0; what is left of their
        // values there is rounding and is dropped. The scene's check has bounded it.
        let at_rest = matches!(model.horizon, Horizon::Infinite { .. });
        let mut forms = forms.into_iter();
        let mut take = |count: usize, drop_value: bool| -> Vec<Id> {
            (forms.by_ref().take(count))
                .map(|f| if drop_value { f.change } else { graph.whole(f) })
                .collect()
        };
        let (forward, costs) = (take(2 * n, at_rest), take(2, at_rest));
        let (m, k) = (hamiltonian.control.len(), hamiltonian.disturbance.len());
        let (control, unclamped, disturbance) = (take(m, false), take(m, false), take(k, false));
        let guards = take(hamiltonian.guards.len(), false);

        let mut rate: Vec<Id> = forward.iter().map(|f| graph.neg(*f)).collect();
        rate.push(costs[0]);
        let arc_rate = arc_rate(&mut graph, &rate[..n], &model.region);
        let zero = graph.constant(0.0);
        let at_zero_adjoint = hamiltonian.p.iter().map(|p| (*p, zero)).collect();
        let least_running = graph.substitute(&[costs[0]], &at_zero_adjoint)[0];
        Self {
            states: n,
            inputs,
            rate,
            arc_rate,
            observer: Observer {
                control,
                disturbance,
                hamiltonian: costs[1],
                unclamped,
            },
            guards: GuardExpr::all(&hamiltonian.guards, guards),
            reference: model.reference().to_vec(),
            least_running,
            terminal,
            graph,
        }
    }

    /// Values of expressions at `(s, p)` in f64; for a few points, not for sweeps.
    pub fn eval(&self, exprs: &[Id], s: &[f64], p: &[f64]) -> Vec<f64> {
        let values = self
            .inputs
            .iter()
            .copied()
            .zip(s.iter().chain(p).copied())
            .collect();
        self.graph.eval(exprs, &values)
    }
}
