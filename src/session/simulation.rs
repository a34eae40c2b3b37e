//! Simulation forward in time, with the events of a scene.

use super::mechanism::lower;
use super::{Session, SessionError};
use crate::backend::cpu::in_pool;
use crate::closed_loop::{Initial, LQR, Law, LawError, Laws, MAP, Weights};
use crate::expr::{Graph, Id};
use crate::hamiltonian::clamped;
use crate::hybrid::{Cycle, CycleError, End, Flights, OFF, Options, Orbits, Simulator};
use crate::mechanism::Posed;
use crate::model::{
    DEFAULT_EVENTS, DEFAULT_PHASE_SAMPLES, Event, Horizon, Kept, Method, Model, Precision,
};
use crate::numeric::random::uniform;
use crate::program::Program;
use crate::scene::Scene;
use crate::sweep::{Choices, Numerics};
use rustc_hash::FxHashMap;

/// Nearer to a surface than this, relative to the condition, a flight begins on it: rounding.
const BEGINS: f64 = 1e-15;
/// Tolerance of flights that an orbit is looked for with, at most.
const ORBIT_RTOL: f64 = 1e-11;

/// What is asked of a simulation in place of what the scene's `[simulation]` says.
#[derive(Clone, Debug, Default)]
pub struct SimulationOptions {
    /// How long a flight lasts.
    pub time: Option<f64>,
    /// Events after which it ends.
    pub events: Option<usize>,
    /// Stored points of a phase after its first; 0: none at all.
    pub samples: Option<usize>,
    /// What controls.
    pub law: Option<ControlledBy>,
    /// Looks for an orbit that comes back to itself after so many events near each state, and begins
    /// there where one is found; 0: looks for none.
    pub cycle: Option<usize>,
}

impl SimulationOptions {
    /// With what the scene says, or the default, where nothing is asked.
    #[must_use]
    pub fn or_of(self, model: &Model) -> Self {
        let given = model.simulation.as_ref();
        let law = given.and_then(|s| s.law.clone());
        Self {
            time: (self.time)
                .or(given.and_then(|s| s.time))
                .or(model.final_time()),
            events: self
                .events
                .or(Some(given.map_or(DEFAULT_EVENTS, |s| s.events))),
            samples: self
                .samples
                .or(Some(given.map_or(DEFAULT_PHASE_SAMPLES, |s| s.samples))),
            law: self.law.or(law.map(ControlledBy::Law)),
            cycle: self.cycle.or(given.and_then(|s| s.cycle)),
        }
    }
}

/// What controls a simulated system.
#[derive(Clone, Debug)]
pub enum ControlledBy {
    /// `lqr`, or a law of the scene's `[closed_loop.law]`.
    Law(String),
    /// The law of a weights file.
    Weights(Weights),
    /// Controls stay as they are at the equilibrium, or 0.
    Nothing,
}

/// A simulation as it went.
#[derive(Clone, Debug)]
pub struct Simulated {
    /// `[flight][n]`: where flights began.
    pub initial: Vec<f64>,
    /// How they went.
    pub flights: Flights,
    /// `[sample][control]`.
    pub u: Vec<f64>,
    /// Names of events, then of guards at which a flight may end: `event_NAME`, `guard_NAME`.
    pub names: Vec<String>,
    /// How many of these are events.
    pub events: usize,
    /// The law's name; none where controls are held.
    pub law: Option<String>,
    /// Integration method.
    pub method: &'static str,
    /// Arithmetic of the integration.
    pub precision: Precision,
    /// Relative tolerance of a step.
    pub rtol: f64,
    /// How long a flight was to last.
    pub time: f64,
    /// Orbits near the states, if any were looked for.
    pub cycles: Option<Cycles>,
    /// `[flight]`: what each cost, where that was integrated too.
    pub cost: Option<Vec<f64>>,
}

/// Orbits that were looked for, one near each state.
#[derive(Clone, Debug)]
pub struct Cycles {
    /// After so many events they come back.
    pub events: usize,
    /// `[flight]`.
    pub found: Vec<Result<Cycle, CycleError>>,
}

impl Cycles {
    /// Where flights begin: at the orbit, or in the state near which none was found.
    fn begins(&self, near: &[f64]) -> Vec<f64> {
        let near = near.chunks(near.len() / self.found.len().max(1));
        let begins = near
            .zip(&self.found)
            .flat_map(|(near, found)| found.as_ref().map_or(near, |cycle| &cycle.start));
        begins.copied().collect()
    }
}

impl Simulated {
    /// How a flight ended, in a word: `time`, `events`, `event_NAME`, `guard_NAME`, `zeno`,
    /// `not_located`, `no_state`, `no_condition`, `contact_lost`, or that of a failed integration.
    #[must_use]
    pub fn status(&self, flight: usize) -> &str {
        end_name(&self.names, self.flights.end[flight])
    }

    /// How many flights ended in each way.
    #[must_use]
    pub fn by_status(&self) -> std::collections::BTreeMap<&str, usize> {
        let mut counts = std::collections::BTreeMap::new();
        for flight in 0..self.flights.end.len() {
            *counts.entry(self.status(flight)).or_insert(0) += 1;
        }
        counts
    }
}

/// An end in a word; `names` are those of the events and guards at which flights end.
#[must_use]
pub fn end_name(names: &[String], end: End) -> &str {
    match end {
        End::At(event) => names.get(event).map_or("?", String::as_str),
        other => other.name(),
    }
}

/// What a simulator is made of.
struct Parts {
    x: Vec<Id>,
    rates: Vec<Id>,
    events: Vec<Event>,
    guards: Vec<Event>,
}

/// A scene under a law, ready to be simulated.
struct Prepared {
    graph: Graph,
    parts: Parts,
    simulator: Simulator,
    options: Options,
    /// Controls as functions of the state.
    control: Program,
    method: Method,
    simulated: Simulated,
}

impl Session<'_> {
    /// Simulates forward in time from states (`[flight][component]`; `None`: those of the scene's
    /// `[simulation]`), with the scene's events; from orbits near them, if orbits are asked for.
    ///
    /// ```
    /// # use costate::{Scene, Session};
    /// use costate::session::SimulationOptions;
    /// let scene = Scene::parse(r#"
    ///     states = { h = {}, v = {} }
    ///     controls = { u = {} }
    ///     dynamics = { h = "v", v = "-9.81 + u" }
    ///     cost = { running = "u^2", terminal = "0", final_time = 1 }
    ///     region = { h = [0, 2], v = [-5, 5] }
    ///     events.floor = { when = "h <= 0", set = { v = "-0.8*v" } }
    /// "#, "scene.toml")?;
    /// let options = SimulationOptions { events: Some(1), ..SimulationOptions::default() };
    /// let done = Session::new(&scene).simulate(Some(&[1.0, 0.0]), &options)?;
    /// let fall = (2.0f64 / 9.81).sqrt();
    /// assert!((done.flights.t[0] - fall).abs() < 1e-9);
    /// assert!((done.flights.last[1] - 0.8 * 9.81 * fall).abs() < 1e-8);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`SessionError::Components`], [`SessionError::NotFinite`], [`SessionError::NoTime`]; what is
    /// wrong with a law; device failures. How a flight ends is no error.
    pub fn simulate(
        &self,
        from: Option<&[f64]>,
        options: &SimulationOptions,
    ) -> Result<Simulated, SessionError> {
        let near = self.starts(from)?;
        let options = &options.clone().or_of(&self.scene.model);
        let cycles = (options.cycle.filter(|events| *events > 0))
            .map(|events| {
                let found = self.cycles(Some(&near), events, options)?;
                Ok::<_, SessionError>(Cycles { events, found })
            })
            .transpose()?;
        let initial = match &cycles {
            Some(cycles) => cycles.begins(&near),
            None => near,
        };
        let Prepared {
            mut simulator,
            options,
            control,
            simulated,
            ..
        } = self.prepare_simulation(options, self.choices)?;
        self.note_contacts(&initial);
        let flights = in_pool(|| simulator.fly(&initial, &options))?;
        if let Some(lost) = flights.lost {
            let event = &self.scene.model.events[lost.event];
            self.progress.note(&format!(
                "flight {}: contact `{}` does not hold after event `{}` (off by {:.3e}), and its forces would keep that as it is",
                lost.flight + 1,
                event.kept[lost.kept].contact,
                event.name,
                lost.by
            ));
        }
        let u = (flights.samples.iter())
            .flat_map(|s| control.eval(&s.x))
            .collect();
        Ok(Simulated {
            initial,
            flights,
            u,
            cycles,
            ..simulated
        })
    }

    /// Orbits near states (as for [`Session::simulate`]) that come back to themselves after so many
    /// events.
    ///
    /// # Errors
    /// As [`Session::simulate`]. That no orbit is found is no error of the session.
    pub fn cycles(
        &self,
        near: Option<&[f64]>,
        events: usize,
        options: &SimulationOptions,
    ) -> Result<Vec<Result<Cycle, CycleError>>, SessionError> {
        let near = self.starts(near)?;
        // What comes back to within the tolerance of a plain flight need not be an orbit.
        let numerics = Numerics::choose(&self.scene.model, self.backend.as_ref(), self.choices)?;
        let exact = self.backend.supports(Precision::F64);
        let choices = Choices {
            precision: exact.then_some(Precision::F64).or(self.choices.precision),
            rtol: exact
                .then_some(numerics.rtol.min(ORBIT_RTOL))
                .or(self.choices.rtol),
            ..self.choices
        };
        let asked = SimulationOptions {
            samples: Some(0),
            ..options.clone()
        };
        let mut prepared = self.prepare_simulation(&asked, choices)?;
        let n = self.scene.model.states.len();
        let parts = &prepared.parts;
        let mut orbits = Orbits::new(
            &mut prepared.graph,
            prepared.simulator,
            (&parts.x, &parts.rates),
            (&parts.events, &parts.guards),
            (
                self.backend.as_ref(),
                prepared.method,
                prepared.simulated.precision,
            ),
        )?;
        (near.chunks(n))
            .map(|guess| Ok(orbits.cycle(guess, events, &prepared.options)?))
            .collect()
    }

    /// Says so where flights begin in states that the mechanism's contacts do not allow: forces keep
    /// only what is met at the beginning.
    fn note_contacts(&self, initial: &[f64]) {
        let model = &self.scene.model;
        let Some(mechanism) = &model.mechanism else {
            return;
        };
        let mut graph = model.graph.clone();
        let posed = Posed::new(&mut graph, &mechanism.tree, &mechanism.q, &mechanism.rates);
        let mut outputs = Vec::new();
        for constraint in &mechanism.constraints {
            let (speed, gap) = posed.kept(&mut graph, constraint);
            // Where a point is held by the world is nobody's choice.
            outputs.extend([gap.unwrap_or(speed), speed]);
        }
        if outputs.is_empty() {
            return;
        }
        let x: Vec<Id> = model.states.iter().map(|s| s.variable.symbol).collect();
        let program = lower(&mut graph, model, &x, &outputs);
        let off = (initial.chunks(x.len()).enumerate()).find_map(|(k, x)| {
            let all = program.eval(x);
            let worst = all.iter().position(|v| v.abs() > OFF)?;
            Some((k, worst, all[worst]))
        });
        if let Some((flight, worst, by)) = off {
            let name = &mechanism.constraints[worst / 2].name;
            let what = match worst % 2 == 0 && mechanism.constraints[worst / 2].against.is_some() {
                true => "its points are apart by",
                false => "its point moves at",
            };
            self.progress.note(&format!(
                "flight {} begins where contact `{name}` does not hold: {what} {by:.3e}; contact forces keep that as it is",
                flight + 1
            ));
        }
    }

    /// States from which flights begin: those given, or else the scene's, or the reference.
    ///
    /// # Errors
    /// States that do not fit the scene.
    pub fn starts(&self, from: Option<&[f64]>) -> Result<Vec<f64>, SessionError> {
        let model = &self.scene.model;
        let n = model.states.len();
        match (from, &model.simulation) {
            (Some(given), _) => {
                self.check_states(given)?;
                Ok(given.to_vec())
            }
            (None, Some(asked)) => Ok(Initial::of_axes(model, &asked.initial)
                .map_err(SessionError::Loop)?
                .x),
            (None, None) => Ok(model.reference()[..n].to_vec()),
        }
    }

    fn prepare_simulation(
        &self,
        asked: &SimulationOptions,
        choices: Choices,
    ) -> Result<Prepared, SessionError> {
        let model = &self.scene.model;
        let asked = asked.clone().or_of(model);
        let time = asked.time.ok_or(SessionError::NoTime)?;
        let numerics = Numerics::choose(model, self.backend.as_ref(), choices)?;
        let law = self.law_of(asked.law.as_ref())?;
        let mut system = Closed::new(model, law.as_ref());
        let guards: Vec<Event> = (model.guards.iter())
            .map(|guard| Event {
                name: guard.name.clone(),
                ahead: guard.condition.expr,
                only: None,
                map: None,
                kept: Vec::new(),
            })
            .collect();
        let [events, guards] = [&model.events, &guards].map(|all| system.events(all));
        let rates: Vec<Id> = model.dynamics.iter().map(|f| f.expr).collect();
        let rates = system.closed(&rates);
        let controls: Vec<Id> = model.controls.iter().map(|c| c.variable.symbol).collect();
        let controls = system.closed(&controls);
        let x: Vec<Id> = model.states.iter().map(|s| s.variable.symbol).collect();
        let operations = system.graph.reachable(&rates).len();
        if operations > crate::sweep::MOST_OPERATIONS {
            return Err(crate::sweep::PlanError::TooLong { operations }.into());
        }
        let simulator = Simulator::new(
            &mut system.graph,
            (&x, &rates),
            (&events, &guards),
            (self.backend.as_ref(), numerics.method, numerics.precision),
            &some_states(model),
        )?;
        let widths = model.region.iter().map(|[lo, hi]| hi - lo);
        let options = Options {
            time,
            events: asked.events.unwrap_or(DEFAULT_EVENTS),
            samples: asked.samples.unwrap_or(DEFAULT_PHASE_SAMPLES),
            rtol: numerics.rtol,
            atol: widths.clone().map(|width| numerics.atol * width).collect(),
            widths: widths.collect(),
            begins: BEGINS,
            step: model.integrator.step.unwrap_or(0.0),
            max_steps: u32::try_from(model.integrator.max_steps).unwrap_or(u32::MAX),
            deadline: self.choices.deadline,
        };
        let named = |kind: &str, all: &[Event]| -> Vec<String> {
            all.iter().map(|e| format!("{kind}_{}", e.name)).collect()
        };
        let control = Program::lower(&system.graph, &x, &controls);
        Ok(Prepared {
            graph: system.graph,
            simulator,
            options,
            control,
            method: numerics.method,
            simulated: Simulated {
                initial: Vec::new(),
                flights: Flights::default(),
                u: Vec::new(),
                names: [named("event", &events), named("guard", &guards)].concat(),
                events: events.len(),
                law: law.map(|l| l.name),
                method: numerics.method.name(),
                precision: numerics.precision,
                rtol: numerics.rtol,
                time,
                cycles: None,
                cost: None,
            },
            parts: Parts {
                x,
                rates,
                events,
                guards,
            },
        })
    }

    /// The law that is asked for; `None` where controls are held.
    fn law_of(&self, asked: Option<&ControlledBy>) -> Result<Option<Law>, SessionError> {
        let Scene {
            model, hamiltonian, ..
        } = self.scene;
        let closed_loop = model.closed_loop.as_ref();
        let laws = || Laws::new(model, hamiltonian, closed_loop.and_then(|c| c.track));
        Ok(match asked {
            None | Some(ControlledBy::Nothing) => None,
            Some(ControlledBy::Weights(w)) => Some(laws().weights(&w.name, &w.text, &w.file)?),
            Some(ControlledBy::Law(name)) if name == LQR => Some(laws().lqr()?),
            Some(ControlledBy::Law(name)) => {
                let given = closed_loop.map_or(&[][..], |c| &c.given);
                let Some(found) = given.iter().find(|g| g.name == *name) else {
                    let known = given.iter().map(|g| g.name.as_str()).chain([LQR]);
                    let help = match name == MAP {
                        true => "the law of a map is simulated by `costate evaluate`, which knows no events".to_owned(),
                        false => format!("known: {}", known.collect::<Vec<_>>().join(", ")),
                    };
                    let name = crate::diagnostics::shorten(name);
                    return Err(LawError::Unknown { name, help }.into());
                };
                Some(laws().given(found)?)
            }
        })
    }
}

/// States of the region, at random, and the reference: `[state][n]`.
#[must_use]
pub fn some_states(model: &Model) -> Vec<f64> {
    const STATES: u64 = 64;
    let n = model.states.len() as u64;
    let at = |k: u64, i: u64, [lower, upper]: [f64; 2]| lower + uniform(k, i) * (upper - lower);
    let random = (0..STATES).flat_map(|k| (0..n).map(move |i| at(k, i, model.region[i as usize])));
    random.chain(model.reference().iter().copied()).collect()
}

/// A scene's expressions as functions of its states: parameters are numbers, disturbances 0, and
/// controls those of a law.
struct Closed {
    graph: Graph,
    replaced: FxHashMap<Id, Id>,
}

impl Closed {
    fn new(model: &Model, law: Option<&Law>) -> Self {
        let mut graph = law.map_or_else(|| model.graph.clone(), |law| law.graph.clone());
        let mut replaced = FxHashMap::default();
        for parameter in &model.parameters {
            replaced.insert(parameter.symbol, graph.constant(parameter.value));
        }
        for disturbance in &model.disturbances {
            replaced.insert(disturbance.symbol, graph.constant(0.0));
        }
        let controls: Vec<Id> = match (law, &model.horizon) {
            (Some(law), _) => graph.substitute(&law.control, &replaced),
            (None, Horizon::Infinite { u, .. }) => u.iter().map(|u| graph.constant(*u)).collect(),
            (None, Horizon::Finite { .. }) => (model.controls.iter())
                .map(|control| {
                    let zero = graph.constant(0.0);
                    clamped(&mut graph, control, zero)
                })
                .collect(),
        };
        for (control, u) in model.controls.iter().zip(controls) {
            replaced.insert(control.variable.symbol, u);
        }
        Self { graph, replaced }
    }

    fn closed(&mut self, expressions: &[Id]) -> Vec<Id> {
        self.graph.substitute(expressions, &self.replaced)
    }

    fn events(&mut self, all: &[Event]) -> Vec<Event> {
        (all.iter())
            .map(|event| Event {
                name: event.name.clone(),
                ahead: self.closed(&[event.ahead])[0],
                only: event.only.map(|only| self.closed(&[only])[0]),
                map: event.map.as_ref().map(|map| self.closed(map)),
                kept: (event.kept.iter())
                    .map(|kept| {
                        let ends = self.closed(&[kept.after, kept.before]);
                        Kept {
                            contact: kept.contact.clone(),
                            after: ends[0],
                            before: ends[1],
                        }
                    })
                    .collect(),
            })
            .collect()
    }
}
