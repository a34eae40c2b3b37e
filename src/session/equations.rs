//! The equations that follow from a scene, as text.

use crate::expr::ShownTogether;
use crate::model::Horizon;
use crate::scene::Scene;
use serde::Serialize;

/// The equations that follow from a scene, as text in the scene's own language.
///
/// ```
/// # use costate::{Scene, session::Equations};
/// # let scene = Scene::parse(r#"
/// #     states = { x = {} }
/// #     controls = { u = {} }
/// #     dynamics = { x = "u" }
/// #     cost = { running = "0.5*(x^2 + u^2)" }
/// #     equilibrium = { x = 0, u = 0 }
/// #     region = { x = [-1, 1] }
/// # "#, "scene.toml")?;
/// let equations = Equations::new(&scene);
/// assert_eq!(equations.optimal_control, ["-p_x"]);
/// assert_eq!(equations.adjoint_equations, ["-x"]);
/// # Ok::<(), costate::ScenarioErrors>(())
/// ```
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Equations {
    /// Parts that the texts below share, by name, where these would be long without: a text may
    /// have names of earlier ones.
    pub shared: Vec<(String, String)>,
    /// H(x, p, u, w), before the controls are inserted.
    pub hamiltonian: String,
    /// u*(x, p), one a control.
    pub optimal_control: Vec<String>,
    /// w*(x, p), one a disturbance.
    pub worst_disturbance: Vec<String>,
    /// dx/dt, one a state.
    pub state_equations: Vec<String>,
    /// dp/dt, one a state.
    pub adjoint_equations: Vec<String>,
    /// The terminal cost phi(x), on a finite horizon.
    pub terminal_cost: Option<String>,
    /// dphi/dx, one a state.
    pub terminal_costate: Vec<String>,
    /// The left sides of the guards, the program's own included: positive inside.
    pub guards: Vec<String>,
}

impl Equations {
    /// Of a scene.
    #[must_use]
    pub fn new(scene: &Scene) -> Self {
        let Scene {
            model, hamiltonian, ..
        } = scene;
        let h = hamiltonian;
        let mut graph = h.graph.clone();
        let (mut terminal, mut slopes) = (None, Vec::new());
        if let Horizon::Finite { terminal: phi, .. } = &model.horizon {
            terminal = Some(phi.expr);
            slopes.extend(h.x.iter().map(|x| graph.diff(phi.expr, *x)));
        }

        let guards: Vec<_> = h.guards.iter().map(|g| g.condition.expr).collect();
        let parts = [
            &[h.open][..],
            &h.control,
            &h.disturbance,
            &h.state_rate,
            &h.adjoint_rate,
            terminal.as_slice(),
            &slopes,
            &guards,
        ];
        let ShownTogether { shared, shown } = graph.show_all(&parts.concat(), &model.text);
        let mut rest = shown.into_iter();
        let [
            open,
            control,
            disturbance,
            state,
            adjoint,
            phi,
            slope,
            guards,
        ] = parts.map(|part| rest.by_ref().take(part.len()).collect::<Vec<String>>());
        Self {
            shared,
            hamiltonian: open.concat(),
            optimal_control: control,
            worst_disturbance: disturbance,
            state_equations: state,
            adjoint_equations: adjoint,
            terminal_cost: phi.into_iter().next(),
            terminal_costate: slope,
            guards,
        }
    }
}
