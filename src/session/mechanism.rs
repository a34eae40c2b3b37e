//! The mechanism of a scene at chosen states: what the recursions give there, and whether they agree
//! with each other.

use crate::expr::{Graph, Id, Kind};
use crate::mechanism::{Articulated, Mechanism, Posed};
use crate::model::Model;
use crate::numeric::random::uniform;
use crate::program::Program;
use crate::scene::Scene;
use rustc_hash::FxHashMap;
use serde::Serialize;

/// The numbers of a mechanism at a state.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct MechanismState {
    /// Coordinates, one a body of the tree; dependent ones included.
    pub q: Vec<f64>,
    /// Their rates.
    pub q_rate: Vec<f64>,
    /// M(q), row by row.
    pub mass_matrix: Vec<Vec<f64>>,
    /// `C(q, q') q' + G(q)`, what the joints need without accelerations.
    pub bias: Vec<f64>,
    /// G(q).
    pub gravity: Vec<f64>,
    /// Generalized forces of springs, dampers and all that `[mechanism.forces]` has.
    pub forces: Vec<f64>,
    /// q''.
    pub accelerations: Vec<f64>,
    /// dq''/dq at fixed controls, row by row; columns: coordinates that are states.
    pub by_q: Vec<Vec<f64>>,
    /// dq''/dq', likewise.
    pub by_q_rate: Vec<Vec<f64>>,
    /// dq''/du.
    pub by_control: Vec<Vec<f64>>,
    /// dq''/dw.
    pub by_disturbance: Vec<Vec<f64>>,
    /// Kinetic energy.
    pub kinetic: f64,
    /// Potential energy, of gravity and springs.
    pub potential: f64,
    /// The points that the scene names.
    pub points: Vec<PointState>,
    /// Directions in which points are held.
    pub contacts: Vec<ContactState>,
    /// q' after a plastic collision in which all contacts come to rest.
    pub after_collision: Vec<f64>,
    /// J M^-1 J' of the contacts' directions, row by row.
    pub mobility: Vec<Vec<f64>>,
}

/// A point of a mechanism, in world axes.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PointState {
    /// The point.
    pub name: String,
    /// Its place.
    pub position: Vec<f64>,
    /// Its velocity.
    pub velocity: Vec<f64>,
    /// Acceleration where all q'' are 0.
    pub bias_acceleration: Vec<f64>,
    /// J M^-1 J', row by row: the inverse of the operational inertia that the point has.
    pub mobility: Vec<Vec<f64>>,
}

/// A direction in which a point is held.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ContactState {
    /// The point.
    pub name: String,
    /// The direction, in world axes.
    pub direction: Vec<f64>,
    /// The force that holds the point, as it acts on its body.
    pub force: f64,
    /// What a plastic collision gives it.
    pub impulse: f64,
    /// Velocity along the direction, 0 where it is held.
    pub velocity: f64,
}

/// An identity that a mechanism's equations must meet, at random states.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Identity {
    /// In words.
    pub name: String,
    /// Largest residual, relative to the size of its terms.
    pub residual: f64,
}

/// What a mechanism's equations are made of.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct MechanismSummary {
    /// Names of the coordinates, one a body of the tree.
    pub coordinates: Vec<String>,
    /// Operations of q''.
    pub forward_operations: usize,
    /// Operations of x' and p' together.
    pub characteristic_operations: usize,
    /// What its equations must meet.
    pub identities: Vec<Identity>,
}

/// A mechanism as a program of states, controls and disturbances.
pub struct MechanismAt<'s> {
    model: &'s Model,
    mechanism: &'s Mechanism,
    program: Program,
    /// Lengths of the parts of the program's outputs.
    parts: Vec<usize>,
}

/// Programs' inputs: states, controls, disturbances.
fn inputs(model: &Model) -> Vec<Id> {
    let states = model.states.iter().map(|s| s.variable.symbol);
    let controls = model.controls.iter().map(|c| c.variable.symbol);
    let disturbances = model.disturbances.iter().map(|w| w.symbol);
    states.chain(controls).chain(disturbances).collect()
}

/// A program of expressions with the parameters' values in them.
pub(super) fn lower(graph: &mut Graph, model: &Model, inputs: &[Id], exprs: &[Id]) -> Program {
    let values: FxHashMap<Id, Id> = (model.parameter_values().into_iter())
        .map(|(symbol, value)| (symbol, graph.constant(value)))
        .collect();
    let exprs = graph.substitute(exprs, &values);
    Program::lower(graph, inputs, &exprs)
}

impl<'s> MechanismAt<'s> {
    /// Of a scene; `None` where it has no mechanism.
    #[must_use]
    pub fn new(scene: &'s Scene) -> Option<Self> {
        let model = &scene.model;
        let mechanism = model.mechanism.as_ref()?;
        let mut graph = model.graph.clone();
        let g = &mut graph;
        let count = mechanism.tree.bodies.len();
        let posed = Posed::new(g, &mechanism.tree, &mechanism.q, &mechanism.rates);
        let motion = &posed.motion;
        let articulated = Articulated::new(g, motion);
        let none = g.constant(0.0);
        let still = Posed::new(g, &mechanism.tree, &mechanism.q, &vec![none; count]);
        let free: Vec<Id> = mechanism.free(g);
        let rates: Vec<Id> = (mechanism.rates.iter().copied())
            .filter(|v| g.as_symbol(*v).is_some())
            .collect();
        let controls: Vec<Id> = model.controls.iter().map(|c| c.variable.symbol).collect();
        let disturbances: Vec<Id> = model.disturbances.iter().map(|w| w.symbol).collect();
        let by = |g: &mut Graph, symbols: &[Id]| -> Vec<Id> {
            let columns: Vec<Vec<Id>> = (symbols.iter())
                .map(|s| g.diff_all(&mechanism.second, *s))
                .collect();
            (0..count)
                .flat_map(|i| columns.iter().map(move |c| c[i]))
                .collect()
        };

        let held = posed.held(g, &articulated, &mechanism.constraints);
        let (after, impulses) = held.collision(g, &mechanism.rates);
        let mut points = Vec::new();
        for named in &mechanism.points {
            let point = posed.point(g, &named.mount, named.at);
            let bias = motion.point_bias(g, &point, &posed.orientations);
            points.extend(point.position.into_iter().chain(point.velocity).chain(bias));
            let all = mechanism.axes(named);
            let mobility = posed.held(g, &articulated, &all).mobility().concat();
            points.extend(mobility);
        }
        let outputs: Vec<Vec<Id>> = vec![
            mechanism.q.clone(),
            mechanism.rates.clone(),
            motion.mass_matrix(g).concat(),
            motion.joint_forces(g, None, true, None),
            still.motion.joint_forces(g, None, true, None),
            motion.generalized(g, &mechanism.load),
            mechanism.second.clone(),
            by(g, &free),
            by(g, &rates),
            by(g, &controls),
            by(g, &disturbances),
            vec![mechanism.energy.kinetic, mechanism.energy.potential],
            points,
            mechanism.forces.clone(),
            impulses,
            held.velocities(g),
            after,
            held.mobility().concat(),
        ];
        let program = lower(&mut graph, model, &inputs(model), &outputs.concat());
        Some(Self {
            model,
            mechanism,
            program,
            parts: outputs.iter().map(Vec::len).collect(),
        })
    }

    /// At a state, under controls and disturbances.
    #[must_use]
    pub fn at(&self, x: &[f64], u: &[f64], w: &[f64]) -> MechanismState {
        let all = self.program.eval(&[x, u, w].concat());
        let mut rest = &all[..];
        let mut parts = self.parts.iter().map(|length| {
            let (part, left) = rest.split_at(*length);
            rest = left;
            part.to_vec()
        });
        let mut next = || parts.next().unwrap_or_default();
        let rows = |flat: Vec<f64>, columns: usize| -> Vec<Vec<f64>> {
            flat.chunks(columns.max(1)).map(<[f64]>::to_vec).collect()
        };
        let mechanism = self.mechanism;
        let count = mechanism.tree.bodies.len();
        let dimensions = if mechanism.planar { 2 } else { 3 };
        let (q, q_rate, mass) = (next(), next(), next());
        let (bias, gravity, forces, accelerations) = (next(), next(), next(), next());
        let [by_q, by_q_rate, by_control, by_disturbance] = [next(), next(), next(), next()];
        let (energies, points) = (next(), next());
        let (held, impulses, velocities, after, mobility) =
            (next(), next(), next(), next(), next());
        let columns = |flat: &[f64]| flat.len() / count;
        let of_point = 9 + dimensions * dimensions;
        MechanismState {
            q,
            q_rate,
            mass_matrix: rows(mass, count),
            bias,
            gravity,
            forces,
            accelerations,
            by_q: rows(by_q.clone(), columns(&by_q)),
            by_q_rate: rows(by_q_rate.clone(), columns(&by_q_rate)),
            by_control: rows(by_control.clone(), columns(&by_control)),
            by_disturbance: rows(by_disturbance.clone(), columns(&by_disturbance)),
            kinetic: energies[0],
            potential: energies[1],
            points: (mechanism.points.iter().zip(points.chunks(of_point)))
                .map(|(named, numbers)| PointState {
                    name: named.name.clone(),
                    position: numbers[..dimensions].to_vec(),
                    velocity: numbers[3..3 + dimensions].to_vec(),
                    bias_acceleration: numbers[6..6 + dimensions].to_vec(),
                    mobility: rows(numbers[9..].to_vec(), dimensions),
                })
                .collect(),
            contacts: (mechanism.constraints.iter().enumerate())
                .map(|(k, constraint)| ContactState {
                    name: constraint.name.clone(),
                    direction: constraint.direction.to_array()[..dimensions].to_vec(),
                    force: held[k],
                    impulse: impulses[k],
                    velocity: velocities[k],
                })
                .collect(),
            after_collision: after,
            mobility: rows(mobility, mechanism.constraints.len()),
        }
    }

    /// Names of the coordinates, one a body of the tree.
    #[must_use]
    pub fn coordinates(&self) -> Vec<String> {
        (self.mechanism.tree.bodies.iter())
            .map(|b| b.name.clone())
            .collect()
    }

    /// The scene's states, controls and disturbances, in the order of [`Self::at`].
    #[must_use]
    pub fn model(&self) -> &'s Model {
        self.model
    }
}

/// States at which identities are looked at.
const STATES: usize = 8;
const SEED: u64 = 0x6d65_6368;

impl MechanismSummary {
    /// Of a scene; `None` where it has no mechanism.
    #[must_use]
    pub fn new(scene: &Scene) -> Option<Self> {
        let model = &scene.model;
        let mechanism = model.mechanism.as_ref()?;
        let mut graph = scene.hamiltonian.graph.clone();
        let h = &scene.hamiltonian;
        let symbols: Vec<Id> = h.x.iter().chain(&h.p).copied().collect();
        let rates = [&h.state_rate[..], &h.adjoint_rate].concat();
        let characteristics = lower(&mut graph, model, &symbols, &rates);
        let forward = lower(&mut graph, model, &inputs(model), &mechanism.second);
        Some(Self {
            coordinates: mechanism
                .tree
                .bodies
                .iter()
                .map(|b| b.name.clone())
                .collect(),
            forward_operations: forward.operations(),
            characteristic_operations: characteristics.operations(),
            identities: identities(model, mechanism),
        })
    }
}

/// A sum that must be 0: its terms at each place, which tell its size.
struct Sum {
    name: &'static str,
    /// `[place][term]`.
    places: Vec<Vec<Id>>,
}

fn identities(model: &Model, mechanism: &Mechanism) -> Vec<Identity> {
    let mut graph = model.graph.clone();
    let g = &mut graph;
    let posed = Posed::new(g, &mechanism.tree, &mechanism.q, &mechanism.rates);
    let motion = &posed.motion;
    let second = &mechanism.second;
    let articulated = Articulated::new(g, motion);
    let held = posed.held(g, &articulated, &mechanism.constraints);
    // What acts: given forces and those of contacts, as generalized forces.
    let acting = motion.generalized(g, &mechanism.load);
    let through = held.generalized(g, &mechanism.forces);
    let needed = motion.joint_forces(g, Some(second), true, None);
    let bias = motion.joint_forces(g, None, true, None);
    let mass = motion.mass_matrix(g);

    let two = g.constant(2.0);
    let loose: Vec<Id> = (0..second.len())
        .map(|i| g.symbol(&format!("rate {i} before a collision"), Kind::Parameter))
        .collect();
    let mut sums = Vec::new();
    let mut inverse = Vec::new();
    let mut composite = Vec::new();
    for i in 0..second.len() {
        let (given, of_contacts) = (g.neg(acting[i]), g.neg(through[i]));
        inverse.push(vec![needed[i], given, of_contacts]);
        let mut terms: Vec<Id> = (mass[i].iter().zip(second))
            .map(|(m, a)| g.mul(*m, *a))
            .collect();
        terms.extend([bias[i], given, of_contacts]);
        composite.push(terms);
    }
    sums.push(Sum {
        name: "inverse dynamics of q'' = forces",
        places: inverse,
    });
    sums.push(Sum {
        name: "M q'' + C q' + G = forces",
        places: composite,
    });
    sums.push(Sum {
        name: "M = M'",
        places: (0..second.len())
            .flat_map(|i| (0..i).map(move |j| (i, j)))
            .map(|(i, j)| vec![mass[i][j], g.neg(mass[j][i])])
            .collect(),
    });
    // Twice the kinetic energy, of the bodies' velocities, is q'.M q'.
    let twice = g.mul(two, mechanism.energy.kinetic);
    let mut terms = vec![g.neg(twice)];
    for (i, row) in mass.iter().enumerate() {
        for (j, m) in row.iter().enumerate() {
            let momentum = g.mul(*m, mechanism.rates[j]);
            terms.push(g.mul(mechanism.rates[i], momentum));
        }
    }
    sums.push(Sum {
        name: "kinetic energy = 1/2 q'.M q'",
        places: vec![terms],
    });
    // d(kinetic + potential of gravity)/dt = q' . forces
    let free: Vec<Id> = mechanism.free(g);
    let moving: FxHashMap<Id, Id> = mechanism.motion_of(g, &free);
    let gravity = posed.potential(g);
    let energy = g.add(mechanism.energy.kinetic, gravity);
    let rate = g.tangents(&[energy], &moving)[0];
    let mut terms = vec![rate];
    for (i, force) in acting.iter().enumerate() {
        let whole = g.add(*force, through[i]);
        let power = g.mul(mechanism.rates[i], whole);
        terms.push(g.neg(power));
    }
    sums.push(Sum {
        name: "d(energy)/dt = q'.forces",
        places: vec![terms],
    });
    if !mechanism.constraints.is_empty() {
        sums.push(Sum {
            name: "accelerations of held points are 0",
            places: (held.accelerations(g, second).into_iter())
                .map(|mut terms| {
                    // Of a size that accelerations have: along a rail they may be rounding alone.
                    terms.extend(second.iter().flat_map(|a| [*a, g.neg(*a)]));
                    terms
                })
                .collect(),
        });
        // A collision: M dq' = J' impulse, all held points at rest after it, and the energy that is
        // lost is that of dq'. Rates before it are any: what contacts hold has no impulse.
        let struck = Posed::new(g, &mechanism.tree, &mechanism.q, &loose);
        let its = Articulated::new(g, &struck.motion);
        let held = struck.held(g, &its, &mechanism.constraints);
        let (after, impulses) = held.collision(g, &loose);
        let change: Vec<Id> = (after.iter().zip(&loose))
            .map(|(after, before)| g.sub(*after, *before))
            .collect();
        let through = held.generalized(g, &impulses);
        let momentum: Vec<Vec<Id>> = (0..change.len())
            .map(|i| {
                let mut terms: Vec<Id> = (mass[i].iter().zip(&change))
                    .map(|(m, v)| g.mul(*m, *v))
                    .collect();
                terms.push(g.neg(through[i]));
                terms
            })
            .collect();
        sums.push(Sum {
            name: "M dq' = J' impulse at a collision",
            places: momentum,
        });
        let settled = Posed::new(g, &mechanism.tree, &mechanism.q, &after);
        let of_change = Posed::new(g, &mechanism.tree, &mechanism.q, &change);
        let still = Articulated::new(g, &settled.motion);
        let rest = settled
            .held(g, &still, &mechanism.constraints)
            .velocities(g);
        let before = held.velocities(g);
        sums.push(Sum {
            name: "held points are at rest after a collision",
            places: (rest.iter().zip(&before))
                .map(|(rest, before)| {
                    let mut terms = vec![g.sub(*rest, *before), *before];
                    let speeds = loose.iter();
                    terms.extend(speeds.flat_map(|v| [*v, g.neg(*v)]));
                    terms
                })
                .collect(),
        });
        let kinetic = struck.kinetic(g);
        let (left, lost) = (settled.kinetic(g), of_change.kinetic(g));
        sums.push(Sum {
            name: "kinetic energy lost = 1/2 dq'.M dq'",
            places: vec![vec![kinetic, g.neg(left), g.neg(lost)]],
        });
    }
    // The gradient in reverse against tangents forward.
    let weights: Vec<Id> = (0..second.len())
        .map(|i| g.constant(1.0 + i as f64 * 0.25))
        .collect();
    let products: Vec<Id> = (weights.iter().zip(second))
        .map(|(p, a)| g.mul(*p, *a))
        .collect();
    let product = g.sum(&products);
    let symbols: Vec<Id> = moving.keys().copied().collect();
    let gradient = g.gradient(product, &symbols);
    let mut terms: Vec<Id> = (symbols.iter().zip(&gradient))
        .map(|(s, slope)| g.mul(moving[s], *slope))
        .collect();
    let along = g.tangents(&[product], &moving)[0];
    terms.push(g.neg(along));
    sums.push(Sum {
        name: "gradient of p.q'' in reverse = forward",
        places: vec![terms],
    });

    let lengths: Vec<Vec<usize>> = sums
        .iter()
        .map(|s| s.places.iter().map(Vec::len).collect())
        .collect();
    let outputs: Vec<Id> = sums.iter().flat_map(|s| s.places.concat()).collect();
    let symbols = [inputs(model), loose].concat();
    let program = lower(g, model, &symbols, &outputs);
    let follows = free.len() < mechanism.q.len();
    let (mut worst, mut seen) = (vec![0.0f64; sums.len()], vec![false; sums.len()]);
    for k in 0..STATES {
        let at: Vec<f64> = (0..symbols.len())
            .map(|i| {
                let share = uniform(SEED, (k * symbols.len() + i) as u64);
                // Of controls and disturbances any values will do.
                let [lower, upper] = model.region.get(i).copied().unwrap_or([-1.5, 1.5]);
                lower + share * (upper - lower)
            })
            .collect();
        let all = program.eval(&at);
        let mut rest = &all[..];
        for ((worst, seen), places) in worst.iter_mut().zip(&mut seen).zip(&lengths) {
            let (mut size, mut off, mut finite) = (0.0f64, 0.0f64, true);
            for length in places {
                let (terms, left) = rest.split_at(*length);
                rest = left;
                finite &= terms.iter().all(|t| t.is_finite());
                size = terms.iter().fold(size, |a, t| a.max(t.abs()));
                off = off.max(terms.iter().sum::<f64>().abs());
            }
            *seen |= finite;
            if finite && size > 0.0 {
                *worst = worst.max(off / size);
            } else if !finite && !follows {
                // Out of reach of dependent coordinates nothing is said.
                *worst = f64::INFINITY;
            }
        }
    }
    (sums.iter().zip(worst).zip(seen))
        .map(|((sum, residual), seen)| Identity {
            name: sum.name.to_owned(),
            // Of numbers that are nowhere finite nothing is kept.
            residual: if seen { residual } else { f64::INFINITY },
        })
        .collect()
}
