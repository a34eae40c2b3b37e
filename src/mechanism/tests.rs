//! The recursions against values by two independent programs (`tests/data/multibody_checks.json`).

use super::{Articulated, Body, Inertia, Joint, Load, Motion, Mount, Tree};
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
        let terms: Vec<Id> = (c.p.iter().zip(&second)).map(|(p, a)| g.mul(*p, *a)).collect();
        let power = g.sum(&terms);
        let adjoint_q = g.gradient(power, &c.q);
        let adjoint_v = g.gradient(power, &c.rates);
        let by_q: Vec<Id> = c.q.iter().flat_map(|q| g.diff_all(&second, *q)).collect();
        let by_v: Vec<Id> = c.rates.iter().flat_map(|v| g.diff_all(&second, *v)).collect();
        let by_tau: Vec<Id> = c.tau.iter().flat_map(|t| g.diff_all(&second, *t)).collect();
        let tip = &system["states"][0]["tip"];
        let body = tip["body"].as_u64().unwrap() as usize;
        let mount = Mount {
            body: Some(body),
            ..Mount::WORLD
        };
        let point = motion.point(g, &mount, vector(&tip["offset"]), (&orientations, &origins, &velocities));
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
        roots.extend(named.iter().filter(|(n, _)| n.starts_with("adjoint")).flat_map(|(_, v)| v.clone()));
        println!("{name}: q'' {forward} operations, with its adjoint product {}", c.program(&roots).operations());
        for state in system["states"].as_array().unwrap() {
            let at: Vec<f64> = ["q", "qd", "tau", "p2"].iter().flat_map(|k| list(&state[k])).collect();
            for (key, exprs) in &named {
                let wanted = match key.strip_prefix("tip.") {
                    Some(of_tip) => &state["tip"][of_tip],
                    None => &state[*key],
                };
                agrees(&format!("{name} {key}"), &c.program(exprs).eval(&at), &list(wanted));
            }
            for (key, exprs) in &columns {
                let found = c.program(exprs).eval(&at);
                let rows: Vec<f64> = (0..count * count).map(|k| found[k % count * count + k / count]).collect();
                agrees(&format!("{name} {key}"), &rows, &list(&state[*key]));
            }
        }
    }
}
