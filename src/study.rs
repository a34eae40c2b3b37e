//! A study: the optimal trajectory from one state for several values of a scene's parameters.

use crate::backend::{Backend, BackendError};
use crate::diagnostics::ScenarioErrors;
use crate::expr::Id;
use crate::local::closed_loop_margin;
use crate::model::{Extremum, Model, Record, Study};
use crate::program::Program;
use crate::scene::Scene;
use crate::sweep::{Choices, Plan, PlanError};
use crate::trajectories::TrajectoryBlock;
use crate::value::{self, Grid, PointStatus, StatesError};
use rustc_hash::FxHashMap;

/// Points of a trajectory that recorded quantities are taken from: what an extremum may be missed
/// by is of the second order in their distance.
const LOOKED_AT: usize = 4001;
/// Share of its size to which the slowest mode of the closed loop falls until nothing more is
/// looked at.
const SETTLED: f64 = 1e-6;
/// Largest step about the equilibrium, over the time constant of the fastest mode: of a method of
/// order four, errors of 1e-7.
const RESOLVED: f64 = 0.1;
const MOST_STEPS: usize = 1_000_000;

/// Why a study could not be made. A variant that has no solution is a row with its status, no
/// error.
#[derive(Debug, thiserror::Error)]
pub enum StudyError {
    #[error("variant {variant}: {errors}")]
    Scene {
        variant: String,
        errors: Box<ScenarioErrors>,
    },
    #[error("variant {variant}: {source}")]
    Plan { variant: String, source: PlanError },
    #[error(transparent)]
    Backend(#[from] BackendError),
}

/// One variant's optimal trajectory.
#[derive(Clone, Debug)]
pub struct Variant {
    /// Values of the varied parameters, in the scene's order.
    pub parameters: Vec<f64>,
    pub x0: Vec<f64>,
    pub status: PointStatus,
    /// NaN without a solution, like all that follows.
    pub value: f64,
    pub u: Vec<f64>,
    /// Solutions found.
    pub sheets: usize,
    /// Time from `x0` to where the local solution takes over.
    pub duration: f64,
    /// The recorded quantities.
    pub records: Vec<f64>,
    /// The trajectory, where there is one.
    pub trajectory: Option<TrajectoryBlock>,
}

/// The values of the varied parameters of each variant: every combination, the last parameter's
/// fastest.
pub fn combinations(asked: &Study) -> Vec<Vec<f64>> {
    let axes = asked.vary.iter().map(|(_, values)| values.clone());
    let grid = Grid {
        axes: axes.collect(),
    };
    (0..grid.len()).map(|k| grid.point(k)).collect()
}

/// Some variants of the scene's `[study]`, by their numbers (see [`combinations`]). After each one
/// `told` has those that are done.
///
/// # Errors
/// [`StudyError`].
///
/// # Panics
/// Without a `[study]`, and where there is no variant of a number.
pub fn study(
    scene: &Scene,
    backend: &dyn Backend,
    choices: Choices,
    own: &[usize],
    told: &mut dyn FnMut(&[Variant]),
) -> Result<Vec<Variant>, StudyError> {
    let asked = scene.model.study.as_ref().expect("the scene has a [study]");
    let combinations = combinations(asked);
    let mut all = Vec::with_capacity(own.len());
    told(&all);
    for &k in own {
        let parameters = combinations[k].clone();
        let set: Vec<(&str, f64)> = (asked.vary.iter().zip(&parameters))
            .map(|((name, _), value)| (name.as_str(), *value))
            .collect();
        let name = set
            .iter()
            .map(|(n, v)| format!("{n} = {v:?}"))
            .collect::<Vec<_>>()
            .join(", ");
        let made = match choices.deadline.has_passed() {
            true => Err(StudyError::Backend(BackendError::OutOfTime)),
            false => variant(scene, &set, &name, parameters.clone(), backend, choices),
        };
        all.push(match made {
            Err(StudyError::Backend(BackendError::OutOfTime)) => {
                Variant::without(&scene.model, asked, parameters, PointStatus::OutOfTime)
            }
            made => made?,
        });
        told(&all);
    }
    Ok(all)
}

impl Variant {
    /// One without an answer.
    pub fn without(
        model: &Model,
        asked: &Study,
        parameters: Vec<f64>,
        status: PointStatus,
    ) -> Self {
        Self {
            parameters,
            x0: asked.from.clone(),
            status,
            value: f64::NAN,
            u: vec![f64::NAN; model.controls.len()],
            sheets: 0,
            duration: f64::NAN,
            records: vec![f64::NAN; asked.records.len()],
            trajectory: None,
        }
    }
}

fn variant(
    scene: &Scene,
    set: &[(&str, f64)],
    name: &str,
    parameters: Vec<f64>,
    backend: &dyn Backend,
    choices: Choices,
) -> Result<Variant, StudyError> {
    let wrong = |errors| StudyError::Scene {
        variant: name.to_owned(),
        errors: Box::new(errors),
    };
    let Scene {
        model, hamiltonian, ..
    } = &scene.with(set).map_err(wrong)?;
    let asked = model
        .study
        .as_ref()
        .expect("the scene has a [study] whatever the parameters");
    let solving = value::solve_states(
        model,
        hamiltonian,
        backend,
        choices,
        &asked.from,
        &mut |_, _, _| {},
    );
    let (plan, mut solver, found) = solving.map_err(|e| match e {
        StatesError::Plan(source) => StudyError::Plan {
            variant: name.to_owned(),
            source,
        },
        StatesError::Backend(e) => e.into(),
    })?;
    let target = found.targets.of_given[0];
    let mut row = Variant {
        parameters,
        x0: asked.from.clone(),
        status: found.status(target),
        value: f64::NAN,
        u: vec![f64::NAN; model.controls.len()],
        sheets: found.of(target).len(),
        duration: f64::NAN,
        records: vec![f64::NAN; asked.records.len()],
        trajectory: None,
    };
    let Some(entry) = found.answer(target) else {
        return Ok(row);
    };
    row.value = entry.value;
    row.u = entry.u.clone();
    row.duration = entry.path.horizon();
    let fine = value::sampled(&plan, &mut solver, &[entry], LOOKED_AT)?;
    let rest = settling(&plan, &entry.path.last()[..model.states.len()]);
    let x = [fine.x, rest.x].concat();
    let u = [fine.u, rest.u].concat();
    row.records = recorded(model, &asked.records, (&x, &u));
    row.trajectory = Some(value::sampled(&plan, &mut solver, &[entry], asked.samples)?);
    Ok(row)
}

/// States (absolute) and controls at some times, row by row.
#[derive(Default)]
struct Settling {
    x: Vec<f64>,
    u: Vec<f64>,
}

/// The rest of a trajectory from where the local solution takes over, at `s` from the equilibrium:
/// until the slowest mode has fallen to [`SETTLED`]. A stiff one that would need more than
/// [`MOST_STEPS`] steps is followed for these. Empty on a finite horizon.
fn settling(plan: &Plan, s: &[f64]) -> Settling {
    let mut settling = Settling::default();
    let Some(local) = &plan.local else {
        return settling;
    };
    let (system, n) = (&plan.system, s.len());
    let inputs = |s: &[f64]| local.at_state(s)[..2 * n].to_vec();
    let backward = Program::lower(&system.graph, &system.inputs, &system.rate[..n]);
    let control = Program::lower(&system.graph, &system.inputs, &system.observer.control);

    let modes = &local.riccati.eigenvalues;
    let fastest = modes.iter().map(|e| e.norm()).fold(0.0, f64::max);
    let time = -SETTLED.ln() / closed_loop_margin(&local.riccati);
    let step = (time / LOOKED_AT as f64).min(RESOLVED / fastest);
    let steps = ((time / step).ceil() as usize).min(MOST_STEPS);

    let ahead = |s: &[f64], by: f64, slope: &[f64]| -> Vec<f64> {
        s.iter().zip(slope).map(|(s, k)| s - by * k).collect()
    };
    let mut s = s.to_vec();
    for _ in 0..steps {
        // The classical Runge-Kutta method.
        let k1 = backward.eval(&inputs(&s));
        let k2 = backward.eval(&inputs(&ahead(&s, 0.5 * step, &k1)));
        let k3 = backward.eval(&inputs(&ahead(&s, 0.5 * step, &k2)));
        let k4 = backward.eval(&inputs(&ahead(&s, step, &k3)));
        let mean: Vec<f64> = (0..n)
            .map(|i| (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]) / 6.0)
            .collect();
        s = ahead(&s, step, &mean);
        let absolute = s.iter().zip(&system.reference).map(|(s, x)| s + x);
        settling.x.extend(absolute);
        settling.u.extend(control.eval(&inputs(&s)));
    }
    settling
}

/// The recorded quantities at the states and controls of a trajectory.
fn recorded(model: &Model, records: &[Record], (x, u): (&[f64], &[f64])) -> Vec<f64> {
    let mut graph = model.graph.clone();
    let numbers: FxHashMap<Id, Id> = (model.parameter_values().into_iter())
        .map(|(symbol, value)| (symbol, graph.constant(value)))
        .collect();
    let of: Vec<Id> = records.iter().map(|r| r.of.expr).collect();
    let of = graph.substitute(&of, &numbers);
    let inputs: Vec<Id> = (model.states.iter().map(|s| s.variable.symbol))
        .chain(model.controls.iter().map(|c| c.variable.symbol))
        .collect();
    let program = Program::lower(&graph, &inputs, &of);
    let (n, m) = (model.states.len(), model.controls.len());
    let mut values = records.iter().map(|_| f64::NAN).collect::<Vec<_>>();
    for q in 0..x.len() / n {
        let at = [&x[q * n..(q + 1) * n], &u[q * m..(q + 1) * m]].concat();
        for ((value, here), record) in values.iter_mut().zip(program.eval(&at)).zip(records) {
            *value = match record.extremum {
                Extremum::Min => value.min(here),
                Extremum::Max => value.max(here),
                Extremum::Final => here,
            };
        }
    }
    values
}
