//! Feedback laws as expressions: the controls of a scene as functions of its states, saturated as
//! in the scene.

use crate::diagnostics::{Problem, ScenarioErrors};
use crate::expr::{Graph, Id};
use crate::feedback::{self, NetworkError};
use crate::hamiltonian::{Hamiltonian, clamped};
use crate::local::{LocalError, Riccati, linear_law};
use crate::model::{Formula, GivenLaw, Horizon, Model, Span};
use rustc_hash::FxHashMap;
use std::path::{Path, PathBuf};

/// A commanded state is followed at this many times the fastest rate of the linear closed loop
/// unless told otherwise.
const TRACK: f64 = 5.0;

/// Why a law could not be made of what was given.
#[derive(Debug, thiserror::Error)]
pub enum LawError {
    /// It stands in the scene, with its place.
    #[error(transparent)]
    Scenario(#[from] ScenarioErrors),
    #[error(transparent)]
    Network(#[from] NetworkError),
    #[error("cannot read {path}: {source}", path = path.display())]
    Read {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("law `{law}`: {reason}")]
    Unfit { law: String, reason: String },
    #[error("there is no law `{name}` ({help})")]
    Unknown { name: String, help: String },
    #[error("law `lqr`: {0}")]
    Local(#[from] LocalError),
    #[error(
        "law `lqr` is that of an infinite horizon, and the horizon is finite: leave it out, or give a law of your own in [closed_loop.law]"
    )]
    NoEquilibrium,
}

/// A law of a scene.
#[derive(Clone, Debug)]
pub struct Law {
    pub name: String,
    /// The Hamiltonian's graph with the law's expressions.
    pub graph: Graph,
    /// One a control, within its bounds; functions of states and parameters, and of the
    /// Hamiltonian's p where the law is that of a [`Chart`](super::Chart).
    pub control: Vec<Id>,
    /// Whether p is to be had from a chart.
    pub charted: bool,
    /// Where the law comes from, in words.
    pub source: String,
}

/// What laws are made of.
pub struct Laws<'s> {
    pub model: &'s Model,
    pub hamiltonian: &'s Hamiltonian,
    /// The rate at which commanded states are followed, where the scene says.
    pub track: Option<f64>,
    riccati: Option<Riccati>,
    /// Why there is none, on an infinite horizon.
    unsolved: Option<LocalError>,
}

impl<'s> Laws<'s> {
    /// For a scene; the local solution is looked for where its horizon is infinite, and need not
    /// exist.
    pub fn new(model: &'s Model, hamiltonian: &'s Hamiltonian, track: Option<f64>) -> Self {
        let (riccati, unsolved) = match model.horizon {
            Horizon::Infinite { .. } => match Riccati::solve(hamiltonian, model) {
                Ok(riccati) => (Some(riccati), None),
                Err(error) => (None, Some(error)),
            },
            Horizon::Finite { .. } => (None, None),
        };
        Self {
            model,
            hamiltonian,
            track,
            riccati,
            unsolved,
        }
    }

    /// The linear-quadratic solution at the equilibrium, where there is one.
    pub fn riccati(&self) -> Option<&Riccati> {
        self.riccati.as_ref()
    }

    /// Why there is no linear-quadratic solution, on an infinite horizon.
    pub fn unsolved(&self) -> Option<&LocalError> {
        self.unsolved.as_ref()
    }

    /// `u = u_e + (du*/dx + du*/dp P)(x - x_e)`, saturated.
    ///
    /// # Errors
    /// Where the scene has no equilibrium or no stabilizing solution.
    pub fn lqr(&self) -> Result<Law, LawError> {
        let Horizon::Infinite { x, u, .. } = &self.model.horizon else {
            return Err(LawError::NoEquilibrium);
        };
        let gain = self.gain()?;
        let mut graph = self.hamiltonian.graph.clone();
        let controls = (u.iter().enumerate())
            .map(|(j, u)| {
                let mut terms = vec![graph.constant(*u)];
                for (i, &symbol) in self.hamiltonian.x.iter().enumerate() {
                    let (at, slope) = (graph.constant(x[i]), graph.constant(gain[j][i]));
                    let deviation = graph.sub(symbol, at);
                    terms.push(graph.mul(slope, deviation));
                }
                graph.sum(&terms)
            })
            .collect();
        Ok(self.law("lqr", graph, controls, "the Riccati solution"))
    }

    /// `[control][state]`: slopes of the optimal linear law.
    ///
    /// # Errors
    /// Where there is no stabilizing Riccati solution.
    pub fn gain(&self) -> Result<Vec<Vec<f64>>, LawError> {
        let riccati = match &self.riccati {
            Some(found) => found.clone(),
            None => Riccati::solve(self.hamiltonian, self.model)?,
        };
        Ok(linear_law(self.hamiltonian, self.model, &riccati))
    }

    /// The law of a value function of which p is known around each state.
    pub fn chart(&self, name: &str) -> Law {
        let graph = self.hamiltonian.graph.clone();
        Law {
            charted: true,
            ..self.law(
                name,
                graph,
                self.hamiltonian.unclamped.clone(),
                "the value map",
            )
        }
    }

    /// A law of `[closed_loop.law]`; weights files are looked for beside the scene.
    ///
    /// # Errors
    /// What is wrong with it, with its place in the scene; what is wrong with a weights file.
    pub fn given(&self, given: &GivenLaw) -> Result<Law, LawError> {
        match &given.formula {
            Formula::Expressions(outputs) => {
                let outputs: Vec<(String, Id)> =
                    outputs.iter().map(|(n, l)| (n.clone(), l.expr)).collect();
                let graph = self.hamiltonian.graph.clone();
                self.of_outputs(&given.name, graph, &outputs, "the scene")
                    .map_err(|e| self.placed(e, &given.span))
            }
            Formula::Weights { file, span } => {
                let path = self.beside(file);
                let text = crate::files::read_text(&path).map_err(|source| {
                    self.placed(
                        LawError::Unfit {
                            law: given.name.clone(),
                            reason: format!("cannot read {}: {source}", path.display()),
                        },
                        span,
                    )
                })?;
                self.weights(&given.name, &text, &path.display().to_string())
                    .map_err(|e| self.placed(e, span))
            }
        }
    }

    /// The law of a weights file's text, a network's or of a value function's; `file` is for
    /// messages.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn weights(&self, name: &str, text: &str, file: &str) -> Result<Law, LawError> {
        let form = feedback::Law::from_toml(text, file)?
            .closed_form(self.model, self.hamiltonian)
            .map_err(|e| LawError::Unfit {
                law: name.to_owned(),
                reason: e.to_string(),
            })?;
        let outputs: Vec<(String, Id)> = form.outputs.into_iter().zip(form.commands).collect();
        self.of_outputs(name, form.graph, &outputs, file)
    }

    /// A law that gives controls, or states to be commanded, by name.
    ///
    /// # Errors
    /// [`LawError::Unfit`] where a name is neither, a control is given twice or not at all, or a
    /// state cannot be commanded.
    pub fn of_outputs(
        &self,
        name: &str,
        mut graph: Graph,
        outputs: &[(String, Id)],
        source: &str,
    ) -> Result<Law, LawError> {
        let unfit = |reason: String| LawError::Unfit {
            law: name.to_owned(),
            reason,
        };
        let controls = &self.model.controls;
        let mut given: Vec<Option<Id>> = vec![None; controls.len()];
        let mut commanded = Vec::new();
        for (output, expr) in outputs {
            if let Some(j) = controls.iter().position(|c| c.variable.name == *output) {
                given[j] = Some(*expr);
            } else if let Some(i) = self
                .model
                .states
                .iter()
                .position(|s| s.variable.name == *output)
            {
                commanded.push((self.actuator(&mut graph, i).map_err(unfit)?, *expr));
            } else {
                return Err(unfit(format!(
                    "its output `{output}` is neither a control nor a state"
                )));
            }
        }
        for (actuator, _) in &commanded {
            let u = &controls[actuator.control].variable.name;
            let state = &self.model.states[actuator.state].variable.name;
            let twice = commanded
                .iter()
                .filter(|(a, _)| a.control == actuator.control)
                .count()
                > 1;
            if twice || given[actuator.control].is_some() {
                return Err(unfit(format!(
                    "control `{u}`, which moves `{state}`, is given twice"
                )));
            }
        }
        let moved: Vec<usize> = commanded.iter().map(|(a, _)| a.control).collect();
        if let Some(j) = (0..controls.len()).find(|j| given[*j].is_none() && !moved.contains(j)) {
            let u = &controls[j].variable.name;
            return Err(unfit(format!("it does not give control `{u}`")));
        }
        let mut all = given.clone();
        let within: Vec<Option<Id>> = (given.iter().enumerate())
            .map(|(j, u)| u.map(|u| clamped(&mut graph, &self.model.controls[j], u)))
            .collect();
        for (actuator, command) in &commanded {
            let rate = self.track_rate().ok_or_else(|| {
                unfit("the scene has no linear closed loop to tell how fast: give track = ... in [closed_loop]".into())
            })?;
            let u = self.follow(&mut graph, actuator, *command, &within, rate);
            all[actuator.control] = Some(u);
        }
        let control = all.into_iter().flatten().collect();
        Ok(self.law(name, graph, control, source))
    }

    /// The rate at which commanded states are followed.
    fn track_rate(&self) -> Option<f64> {
        let fastest = |r: &Riccati| r.eigenvalues.iter().map(|e| e.norm()).fold(0.0, f64::max);
        self.track
            .or_else(|| self.riccati.as_ref().map(|r| TRACK * fastest(r)))
    }

    /// How state `i` is moved: `x_i' = free + gain u_j`, with one control u_j.
    fn actuator(&self, graph: &mut Graph, i: usize) -> Result<Actuator, String> {
        let state = &self.model.states[i].variable.name;
        let rate = self.model.dynamics[i].expr;
        let symbols: Vec<Id> = self
            .model
            .controls
            .iter()
            .map(|c| c.variable.symbol)
            .collect();
        let within: Vec<usize> = (0..symbols.len())
            .filter(|j| graph.depends_on(&[rate], symbols[*j]))
            .collect();
        let &[control] = within.as_slice() else {
            return Err(format!(
                "state `{state}` cannot be commanded: its dynamics has {} controls in it, not one",
                within.len()
            ));
        };
        // The scene is affine in its controls: the slope has no control in it.
        let gain = graph.diff(rate, symbols[control]);
        let zero = graph.constant(0.0);
        let free = graph.substitute(&[rate], &FxHashMap::from_iter([(symbols[control], zero)]))[0];
        Ok(Actuator {
            state: i,
            control,
            gain,
            free,
        })
    }

    /// `u = (d/dt c + rate (c - x_i) - free)/gain`, so that `x_i - c` decays at `rate` as far as
    /// u's bounds allow; without `d/dt c` where that would depend on u itself.
    fn follow(
        &self,
        graph: &mut Graph,
        actuator: &Actuator,
        command: Id,
        given: &[Option<Id>],
        rate: f64,
    ) -> Id {
        let symbols: FxHashMap<Id, Id> = (self.model.controls.iter().zip(given))
            .filter_map(|(c, expr)| Some((c.variable.symbol, (*expr)?)))
            .collect();
        let unknown: Vec<Id> = (self.model.controls.iter().zip(given))
            .filter(|(_, expr)| expr.is_none())
            .map(|(c, _)| c.variable.symbol)
            .collect();
        let mut terms = Vec::new();
        let mut explicit = true;
        for (k, &x) in self.hamiltonian.x.iter().enumerate() {
            let slope = graph.diff(command, x);
            if graph.is_zero(slope) {
                continue;
            }
            let f = self.model.dynamics[k].expr;
            explicit &= k != actuator.state && !unknown.iter().any(|u| graph.depends_on(&[f], *u));
            let f = graph.substitute(&[f], &symbols)[0];
            terms.push(graph.mul(slope, f));
        }
        if !explicit {
            terms.clear();
        }
        let behind = graph.sub(command, self.hamiltonian.x[actuator.state]);
        let rate = graph.constant(rate);
        terms.push(graph.mul(rate, behind));
        let wanted = graph.sum(&terms);
        let rest = graph.sub(wanted, actuator.free);
        graph.div(rest, actuator.gain)
    }

    /// With the bounds of the controls.
    fn law(&self, name: &str, mut graph: Graph, control: Vec<Id>, source: &str) -> Law {
        let control = (control.into_iter().enumerate())
            .map(|(j, u)| clamped(&mut graph, &self.model.controls[j], u))
            .collect();
        Law {
            name: name.to_owned(),
            graph,
            control,
            charted: false,
            source: source.to_owned(),
        }
    }

    /// A file named in the scene: beside the scene, unless its name is absolute.
    fn beside(&self, file: &str) -> PathBuf {
        let folder = Path::new(&self.model.file_name).parent();
        folder.map_or_else(|| PathBuf::from(file), |folder| folder.join(file))
    }

    fn placed(&self, error: LawError, span: &Span) -> LawError {
        match error {
            LawError::Unfit { law, reason } => {
                let problem =
                    Problem::at(span.clone(), format!("law `{law}`: {reason}"), "this law");
                self.model.errors(vec![problem]).into()
            }
            other => other,
        }
    }
}

/// `x_state' = free + gain u_control`.
struct Actuator {
    state: usize,
    control: usize,
    gain: Id,
    free: Id,
}
