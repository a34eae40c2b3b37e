//! The recursions against values by two independent programs (`tests/data/multibody_checks.json`).

use super::{Articulated, Body, Constraint, Inertia, Joint, Load, Motion, Mount, Posed, Tree};
use crate::expr::{Graph, Id, Kind};
use crate::program::Program;
use glam::{DMat3, DVec3};
use serde_json::Value;
use std::sync::Arc;

/// Relative to the largest of the values compared: sums of some hundred terms in other order.
const AGREES: f64 = 1e-12;

fn checks() -> Value {
    serde_json::from_str(include_str!("../../tests/data/multibody_checks.json")).unwrap()
}

fn list(value: &Value) -> Vec<f64> {
    match value {
        Value::Array(all) => all.iter().flat_map(list).collect(),
        number => vec![number.as_f64().unwrap()],
    }
}

fn vector(value: &Value) -> DVec3 {
    DVec3::from_slice(&list(value))
}

/// Written row by row.
fn matrix(value: &Value) -> DMat3 {
    DMat3::from_cols_slice(&list(value)).transpose()
}

fn tree(model: &Value) -> Tree {
    let bodies = model["bodies"].as_array().unwrap().iter();
    let bodies = bodies.map(|b| Body {
        name: b["name"].as_str().unwrap().to_owned(),
        parent: usize::try_from(b["parent"].as_i64().unwrap()).ok(),
        joint: match b["joint"].as_str().unwrap() {
            "revolute" => Joint::Revolute,
            _ => Joint::Prismatic,
        },
        axis: vector(&b["axis"]),
        place: vector(&b["xyz"]),
        rotation: matrix(&b["rotation"]),
        inertia: Inertia {
            mass: b["mass"].as_f64().unwrap(),
            com: vector(&b["com"]),
            about_com: matrix(&b["inertia"]),
        },
        rotor: 0.0,
    });
    Tree {
        gravity: vector(&model["gravity"]),
        bodies: bodies.collect(),
    }
}

struct Checked {
    graph: Graph,
    q: Vec<Id>,
    rates: Vec<Id>,
    tau: Vec<Id>,
    p: Vec<Id>,
}

impl Checked {
    fn new(count: usize) -> Self {
        let mut graph = Graph::new();
        let mut some = |name: &str| -> Vec<Id> {
            (0..count)
                .map(|i| graph.symbol(&format!("{name}{i}"), Kind::State))
                .collect()
        };
        let (q, rates, tau, p) = (some("q"), some("v"), some("tau"), some("p"));
        Self {
            graph,
            q,
            rates,
            tau,
            p,
        }
    }

    fn program(&self, outputs: &[Id]) -> Program {
        let inputs = [&self.q[..], &self.rates, &self.tau, &self.p].concat();
        Program::lower(&self.graph, &inputs, outputs)
    }
}

fn agrees(what: &str, found: &[f64], wanted: &[f64]) {
    assert_eq!(found.len(), wanted.len(), "{what}");
    let size = wanted.iter().fold(1e-3f64, |a, v| a.max(v.abs()));
    for (f, w) in found.iter().zip(wanted) {
        assert!(
            (f - w).abs() <= AGREES * size,
            "{what}: {f:?} for {w:?}, of {size:e}"
        );
    }
}

#[test]
fn recursions_agree_with_two_other_programs() {
    let checks = checks();
    for (name, system) in checks["systems"].as_object().unwrap() {
        let tree = Arc::new(tree(&system["model"]));
        let count = tree.bodies.len();
        let mut c = Checked::new(count);
        let g = &mut c.graph;
        let motion = Motion::new(g, &tree, &c.q, &c.rates);
        let articulated = Articulated::new(g, &motion);
        let load = Load {
            joints: c.tau.clone(),
            ..Load::none(g, count)
        };
        let second = articulated.accelerations(g, &load).joints;
        let needed = motion.joint_forces(g, Some(&second), true, None);
        let bias = motion.joint_forces(g, None, true, None);
        let mass = motion.mass_matrix(g).concat();
        let orientations = motion.orientations(g);
        let origins = motion.origins(g, &orientations);
        let velocities = motion.velocities(g);
        let kinetic = motion.kinetic(g, &velocities);
        let potential = motion.potential(g, &orientations, &origins);
        let terms: Vec<Id> = (c.p.iter().zip(&second))
            .map(|(p, a)| g.mul(*p, *a))
            .collect();
        let power = g.sum(&terms);
        let adjoint_q = g.gradient(power, &c.q);
        let adjoint_v = g.gradient(power, &c.rates);
        let by_q: Vec<Id> = c.q.iter().flat_map(|q| g.diff_all(&second, *q)).collect();
        let by_v: Vec<Id> = c
            .rates
            .iter()
            .flat_map(|v| g.diff_all(&second, *v))
            .collect();
        let by_tau: Vec<Id> = c.tau.iter().flat_map(|t| g.diff_all(&second, *t)).collect();
        let tip = &system["states"][0]["tip"];
        let body = tip["body"].as_u64().unwrap() as usize;
        let mount = Mount {
            body: Some(body),
            ..Mount::WORLD
        };
        let point = motion.point(
            g,
            &mount,
            vector(&tip["offset"]),
            (&orientations, &origins, &velocities),
        );
        let tip_bias = motion.point_bias(g, &point, &orientations);

        let named = [
            ("mass_matrix", mass),
            ("bias", bias),
            ("qdd", second.clone()),
            ("inverse_of_qdd", needed),
            ("kinetic", vec![kinetic]),
            ("potential", vec![potential]),
            ("adjoint_q", adjoint_q),
            ("adjoint_qd", adjoint_v),
            ("dqdd_dtau", by_tau),
            ("tip.position", point.position.to_vec()),
            ("tip.velocity", point.velocity.to_vec()),
            ("tip.bias_acceleration", tip_bias.to_vec()),
        ];
        let columns = [("dqdd_dq", by_q), ("dqdd_dqd", by_v)];
        let forward = c.program(&second).operations();
        let mut roots = second.clone();
        roots.extend(
            named
                .iter()
                .filter(|(n, _)| n.starts_with("adjoint"))
                .flat_map(|(_, v)| v.clone()),
        );
        println!(
            "{name}: q'' {forward} operations, with its adjoint product {}",
            c.program(&roots).operations()
        );
        for state in system["states"].as_array().unwrap() {
            let at: Vec<f64> = ["q", "qd", "tau", "p2"]
                .iter()
                .flat_map(|k| list(&state[k]))
                .collect();
            for (key, exprs) in &named {
                let wanted = match key.strip_prefix("tip.") {
                    Some(of_tip) => &state["tip"][of_tip],
                    None => &state[*key],
                };
                agrees(
                    &format!("{name} {key}"),
                    &c.program(exprs).eval(&at),
                    &list(wanted),
                );
            }
            for (key, exprs) in &columns {
                let found = c.program(exprs).eval(&at);
                let rows: Vec<f64> = (0..count * count)
                    .map(|k| found[k % count * count + k / count])
                    .collect();
                agrees(&format!("{name} {key}"), &rows, &list(&state[*key]));
            }
        }
    }
}

/// The biped of the thesis on one foot, on both, at their impact, and pushed off.
#[test]
fn contacts_and_collisions_agree() {
    let checks = checks();
    let tree = Arc::new(tree(&checks["systems"]["biped"]["model"]));
    let biped = &checks["biped"];
    let count = tree.bodies.len();
    let mut c = Checked::new(count);
    let g = &mut c.graph;
    let posed = Posed::new(g, &tree, &c.q, &c.rates);
    let articulated = Articulated::new(g, &posed.motion);
    // The shanks are the bodies 4 and 6.
    let foot = |shank: usize| {
        let mount = Mount {
            body: Some(shank),
            ..Mount::WORLD
        };
        (mount, DVec3::new(0.5, 0.0, 0.0))
    };
    let feet = |shanks: &[usize]| -> Vec<Constraint> {
        let axes = |shank: usize| {
            [DVec3::X, DVec3::Y].map(|direction| Constraint {
                name: format!("foot of {shank}"),
                at: foot(shank),
                against: None,
                direction,
            })
        };
        shanks.iter().flat_map(|s| axes(*s)).collect()
    };
    let load = Load {
        joints: c.tau.clone(),
        ..Load::none(g, count)
    };
    let free = articulated.accelerations(g, &load);
    let [one, both, front] =
        [&[4][..], &[4, 6], &[6]].map(|shanks| posed.held(g, &articulated, &feet(shanks)));
    let (standing, pressed) = one.contact(g, &free);
    let (double, pressed_both) = both.contact(g, &free);
    let (after, impulses) = both.collision(g, &c.rates);
    let (after_front, impulse_front) = front.collision(g, &c.rates);
    let kinetic = posed.kinetic(g);
    let lambda: Vec<Id> = both.mobility().concat();
    let swung = posed.point(g, &foot(6).0, foot(6).1).velocity;
    let stood = posed.point(g, &foot(4).0, foot(4).1).velocity;
    // Along the lower leg from foot 2 to knee 2, while foot 1 is held.
    let axis = posed.motion.axes_of(g, &foot(6).0);
    let up = axis.map(|row| g.neg(row[0]));
    let pushed = {
        let size = g.constant(3.0);
        let force = super::algebra::scale(g, size, up);
        let arm = posed.point(g, &foot(6).0, foot(6).1).arm;
        let moment = super::algebra::cross(g, arm, force);
        let mut load = Load::none(g, count);
        load.bodies[6] = (moment, force);
        one.impulse(g, &articulated, &load, &c.rates).0
    };

    let at = |state: &Value, rates: &str, tau: &str| -> Vec<f64> {
        let base = &biped["single_support"];
        let q = if state["q"].is_array() {
            &state["q"]
        } else {
            &base["q"]
        };
        let tau = match tau {
            "" => vec![0.0; count],
            key => list(&state[key]),
        };
        [list(q), list(&state[rates]), tau, vec![0.0; count]].concat()
    };
    let state = &biped["single_support"];
    let here = at(state, "qd", "generalized_force");
    let check = |what: &str, exprs: &[Id], here: &[f64], wanted: &[f64]| {
        agrees(what, &c.program(exprs).eval(here), wanted);
    };
    check(
        "free",
        &free.joints,
        &here,
        &list(&state["free_acceleration"]),
    );
    check("standing", &standing, &here, &list(&state["qdd"]));
    check("force", &pressed, &here, &list(&state["force_on_foot_1"]));
    check(
        "swung",
        &swung[..2],
        &here,
        &list(&state["foot_2_velocity"]),
    );
    // The reduced dynamics: hip, torso, hip 2, knee 2.
    let independent = [0, 1, 2, 5, 6].map(|i| standing[i]);
    check(
        "reduced",
        &independent,
        &here,
        &list(&state["reduced_acceleration"]),
    );

    let state = &biped["impact_two_feet"];
    let here = at(state, "qd_before", "");
    check("after", &after, &here, &list(&state["qd_after"]));
    check(
        "impulse 1",
        &impulses[..2],
        &here,
        &list(&state["impulse_foot_1"]),
    );
    check(
        "impulse 2",
        &impulses[2..],
        &here,
        &list(&state["impulse_foot_2"]),
    );
    check("lambda", &lambda, &here, &list(&state["lambda_inverse"]));
    check("before", &[kinetic], &here, &list(&state["kinetic_before"]));
    let settled = c.program(&after).eval(&here);
    let mut there = here.clone();
    there[count..2 * count].copy_from_slice(&settled);
    check(
        "kinetic after",
        &[kinetic],
        &there,
        &list(&state["kinetic_after"]),
    );
    // Once more it changes nothing.
    agrees("idempotent", &c.program(&after).eval(&there), &settled);

    let state = &biped["impact_front_foot_only"];
    check("front", &after_front, &here, &list(&state["qd_after"]));
    check(
        "front impulse",
        &impulse_front,
        &here,
        &list(&state["impulse_foot_2"]),
    );
    there[count..2 * count].copy_from_slice(&c.program(&after_front).eval(&here));
    check(
        "stood",
        &stood[..2],
        &there,
        &list(&state["foot_1_velocity_after"]),
    );

    let state = &biped["double_support"];
    let tau = by_inputs(&biped["single_support"], &list(&state["u"]));
    let mut here = at(state, "qd", "");
    here[2 * count..3 * count].copy_from_slice(&tau);
    check("double", &double, &here, &list(&state["qdd"]));
    check(
        "double 1",
        &pressed_both[..2],
        &here,
        &list(&state["force_on_foot_1"]),
    );
    check(
        "double 2",
        &pressed_both[2..],
        &here,
        &list(&state["force_on_foot_2"]),
    );

    let state = &biped["liftoff_impulse"];
    let here = at(state, "qd_before", "");
    check("pushed", &pushed, &here, &list(&state["qd_after"]));
}

/// Generalized forces of the six torques.
fn by_inputs(state: &Value, u: &[f64]) -> Vec<f64> {
    let rows = state["input_matrix"].as_array().unwrap().iter();
    rows.map(|row| list(row).iter().zip(u).map(|(a, b)| a * b).sum())
        .collect()
}
