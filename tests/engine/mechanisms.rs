//! Scenes of bodies and joints: against values by two independent programs
//! (`tests/data/multibody_checks.json`), and against the same scene written by hand.

use costate::Scene;
use costate::session::{MechanismAt, MechanismSummary};
use serde_json::Value;

/// What the issue of these values allows.
const AGREES: f64 = 1e-11;

fn checks() -> Value {
    serde_json::from_str(include_str!("../data/multibody_checks.json")).unwrap()
}

fn list(value: &Value) -> Vec<f64> {
    match value {
        Value::Array(all) => all.iter().flat_map(list).collect(),
        number => vec![number.as_f64().unwrap()],
    }
}

/// Numbers in brackets, the first `count` of a list.
fn written(value: &Value, count: usize) -> String {
    let all: Vec<String> = list(value)[..count]
        .iter()
        .map(|v| format!("{v:?}"))
        .collect();
    format!("[{}]", all.join(", "))
}

/// A model of the file as a scene, with a torque `tau_NAME` in each joint.
fn scene_text(system: &Value) -> String {
    let model = &system["model"];
    let bodies = model["bodies"].as_array().unwrap();
    let planar = model["name"] != "arm6";
    let d = if planar { 2 } else { 3 };
    let mut text = format!(
        "[mechanism]\ngravity = {}\n[mechanism.bodies]\n",
        written(&model["gravity"], d)
    );
    let name = |b: &Value| b["name"].as_str().unwrap().to_owned();
    for b in bodies {
        let joint = b["joint"].as_str().unwrap();
        let mut keys = vec![
            format!("joint = \"{joint}\""),
            format!("at = {}", written(&b["xyz"], d)),
            format!("mass = {}", b["mass"]),
            format!("com = {}", written(&b["com"], d)),
        ];
        let rows = |m: &Value| -> String {
            let rows = m.as_array().unwrap().iter();
            format!(
                "[{}]",
                rows.map(|r| written(r, 3)).collect::<Vec<_>>().join(", ")
            )
        };
        if planar {
            keys.push(format!("inertia = {}", b["inertia"][2][2]));
        } else {
            keys.push(format!("inertia = {}", rows(&b["inertia"])));
            keys.push(format!("rotation = {}", rows(&b["rotation"])));
        }
        if !planar || joint == "prismatic" {
            keys.push(format!("axis = {}", written(&b["axis"], d)));
        }
        if let Ok(parent) = usize::try_from(b["parent"].as_i64().unwrap()) {
            keys.push(format!("parent = \"{}\"", name(&bodies[parent])));
        }
        text += &format!("{} = {{ {} }}\n", name(b), keys.join(", "));
    }
    let each = |line: &dyn Fn(&str) -> String| -> String {
        bodies.iter().map(|b| line(&name(b))).collect()
    };
    let tip = &system["states"][0]["tip"];
    let on = name(&bodies[tip["body"].as_u64().unwrap() as usize]);
    text += &format!(
        "[mechanism.points]\ntip = {{ body = \"{on}\", at = {} }}\n",
        written(&tip["offset"], d)
    );
    text += &format!(
        "[mechanism.forces]\n{}",
        each(&|n| format!("{n} = \"tau_{n}\"\n"))
    );
    text += &format!("[controls]\n{}", each(&|n| format!("tau_{n} = {{}}\n")));
    text += &format!(
        "[region]\n{}",
        each(&|n| format!("{n} = [-4, 4]\n{n}_rate = [-8, 8]\n"))
    );
    let squares = each(&|n| format!(" + tau_{n}^2"));
    text + &format!("[cost]\nrunning = \"0{squares}\"\nterminal = \"0\"\nfinal_time = 1\n")
}

fn agrees(what: &str, found: &[f64], wanted: &[f64]) {
    assert_eq!(found.len(), wanted.len(), "{what}");
    // What should be 0 is judged by what else is of its kind; 1e-3 where all are.
    let size = wanted.iter().fold(1e-3f64, |a, v| a.max(v.abs()));
    for (f, w) in found.iter().zip(wanted) {
        assert!((f - w).abs() <= AGREES * size, "{what}: {f:?} for {w:?}");
    }
}

#[test]
fn scenes_of_bodies_agree_with_two_other_programs() {
    let mut compared = 0;
    for (name, system) in checks()["systems"].as_object().unwrap() {
        let text = scene_text(system);
        let scene = Scene::parse(&text, &format!("{name}.toml")).unwrap();
        let mechanism = MechanismAt::new(&scene).unwrap();
        for state in system["states"].as_array().unwrap() {
            let numbers = |key: &str| list(&state[key]);
            let x = [numbers("q"), numbers("qd")].concat();
            let found = mechanism.at(&x, &numbers("tau"), &[]);
            let d = found.points[0].position.len();
            let tip = |key: &str| list(&state["tip"][key])[..d].to_vec();
            let point = &found.points[0];
            for (key, found, wanted) in [
                (
                    "mass_matrix",
                    found.mass_matrix.concat(),
                    numbers("mass_matrix"),
                ),
                ("bias", found.bias, numbers("bias")),
                ("gravity_force", found.gravity, numbers("gravity_force")),
                ("qdd", found.accelerations, numbers("qdd")),
                ("dqdd_dq", found.by_q.concat(), numbers("dqdd_dq")),
                ("dqdd_dqd", found.by_q_rate.concat(), numbers("dqdd_dqd")),
                ("dqdd_dtau", found.by_control.concat(), numbers("dqdd_dtau")),
                ("kinetic", vec![found.kinetic], numbers("kinetic")),
                ("potential", vec![found.potential], numbers("potential")),
                ("position", point.position.clone(), tip("position")),
                ("velocity", point.velocity.clone(), tip("velocity")),
                (
                    "bias of the tip",
                    point.bias_acceleration.clone(),
                    tip("bias_acceleration"),
                ),
            ] {
                agrees(&format!("{name}: {key}"), &found, &wanted);
                compared += 1;
            }
        }
        for identity in MechanismSummary::new(&scene).unwrap().identities {
            assert!(identity.residual < AGREES, "{name}: {identity:?}");
        }
    }
    assert!(compared >= 12 * 8, "{compared}");
}

/// p' of the characteristics: the adjoint products of the file.
#[test]
fn adjoint_equations_agree_with_two_other_programs() {
    for (name, system) in checks()["systems"].as_object().unwrap() {
        let scene = Scene::parse(&scene_text(system), &format!("{name}.toml")).unwrap();
        let h = &scene.hamiltonian;
        let n = h.x.len() / 2;
        for state in system["states"].as_array().unwrap() {
            let numbers = |key: &str| list(&state[key]);
            let mut values = scene.model.parameter_values();
            values.extend(
                h.x.iter()
                    .copied()
                    .zip([numbers("q"), numbers("qd")].concat()),
            );
            values.extend(
                h.p.iter()
                    .copied()
                    .zip([vec![0.0; n], numbers("p2")].concat()),
            );
            let controls = scene.model.controls.iter().map(|c| c.variable.symbol);
            values.extend(controls.zip(numbers("tau")));
            // The rates with the controls as they are, not the optimal ones.
            let mut graph = h.graph.clone();
            let found = graph.gradient(h.open, &h.x);
            let found = graph.eval(&found, &values);
            agrees(&format!("{name}: by q"), &found[..n], &numbers("adjoint_q"));
            agrees(
                &format!("{name}: by q'"),
                &found[n..],
                &numbers("adjoint_qd"),
            );
        }
    }
}

/// Riccati solutions at equilibria.
#[test]
fn linearizations_agree_with_two_other_programs() {
    let checks = checks();
    for (key, file) in [
        ("double_pendulum_upright_two_torques", "double_pendulum"),
        ("cart_pole_upright", "cart_pole_mechanism"),
    ] {
        let path = format!("{}/scenarios/{file}.toml", env!("CARGO_MANIFEST_DIR"));
        let scene = Scene::load(&path).unwrap();
        let riccati =
            costate::low_level::local::Riccati::solve(&scene.hamiltonian, &scene.model).unwrap();
        let wanted = &checks["linear_quadratic"][key];
        let found: Vec<f64> = riccati.p.transpose().iter().copied().collect();
        agrees(key, &found, &list(&wanted["P"]));
    }
}

const BY_HAND: &str = r#"
[states]
a = {}
b = {}
a_rate = {}
b_rate = {}
[definitions]
# Two bars: M = [A + C + 2 B cos b, C + B cos b; ., C], moments about the joints.
A = "0.05 + 1.2*0.3^2 + 0.7*0.9^2"
B = "0.7*0.9*0.35"
C = "0.02 + 0.7*0.35^2"
m11 = "A + C + 2*B*cos(b)"
m12 = "C + B*cos(b)"
h = "B*sin(b)"
t1 = "u + h*(2*a_rate*b_rate + b_rate^2) - 9.81*((1.2*0.3 + 0.7*0.9)*cos(a) + 0.7*0.35*cos(a + b)) - 0.1*a_rate"
t2 = "v - h*a_rate^2 - 9.81*0.7*0.35*cos(a + b) - 0.2*b_rate - 3*(b - 0.1)"
det = "m11*C - m12^2"
[dynamics]
a = "a_rate"
b = "b_rate"
a_rate = "(C*t1 - m12*t2)/det"
b_rate = "(m11*t2 - m12*t1)/det"
"#;

const BY_BODIES: &str = r#"
[mechanism]
gravity = [0, -9.81]
[mechanism.bodies]
a = { joint = "revolute", mass = 1.2, com = [0.3, 0], inertia = 0.05, damping = 0.1 }
b = { joint = "revolute", parent = "a", at = [0.9, 0], mass = 0.7, com = [0.35, 0], inertia = 0.02, damping = 0.2, spring = 3, rest = 0.1 }
[mechanism.forces]
a = "u"
b = "v"
"#;

const REST: &str = r#"
[controls]
u = { min = -40, max = 40 }
v = {}
[parameters]
u_e = "9.81*((1.2*0.3 + 0.7*0.9)*cos(0.4) + 0.7*0.35*cos(0.2))"
v_e = "9.81*0.7*0.35*cos(0.2) + 3*(-0.2 - 0.1)"
[cost]
running = "0.5*((a - 0.4)^2 + (b + 0.2)^2 + a_rate^2 + b_rate^2 + (u - u_e)^2 + (v - v_e)^2)"
[equilibrium]
a = 0.4
b = -0.2
a_rate = 0
b_rate = 0
u = "u_e"
v = "v_e"
[region]
a = [-2, 2]
b = [-2, 2]
a_rate = [-4, 4]
b_rate = [-4, 4]
"#;

#[test]
fn a_mechanism_is_the_scene_written_by_hand() {
    let [hand, bodies] = [BY_HAND, BY_BODIES].map(|part| {
        let scene = Scene::parse(&format!("{part}{REST}"), "two_bars.toml").unwrap();
        let session = costate::Session::new(&scene);
        let solved = session
            .solve(&[0.9, -0.5, 0.4, -1.0, -0.3, 0.6, 0.0, 0.0])
            .unwrap();
        [0, 1].map(|i| {
            let answer = solved.answer(i).expect("solved");
            let mut all = vec![answer.value];
            all.extend(answer.p.iter().chain(&answer.u));
            all
        })
    });
    for (hand, bodies) in hand.iter().zip(&bodies) {
        agrees("V, p, u", bodies, hand);
    }
}

/// Energy of free motion, flown by the program's own integrator.
#[test]
fn energy_of_free_motion_stays() {
    for (name, system) in checks()["systems"].as_object().unwrap() {
        // Without torques: in reverse time from a state at p = 0, u* = 0.
        let scene = Scene::parse(&scene_text(system), &format!("{name}.toml")).unwrap();
        let mechanism = MechanismAt::new(&scene).unwrap();
        let free = &system["free_motion"];
        let start = [list(&free["q0"]), list(&free["qd0"])].concat();
        let end = flown(&scene, &start, free["time"].as_f64().unwrap());
        agrees(
            &format!("{name}: free motion"),
            &end,
            &list(&free["state_at_time"]),
        );
        let energy = |x: &[f64]| {
            let here = mechanism.at(x, &vec![0.0; x.len() / 2], &[]);
            here.kinetic + here.potential
        };
        let long = flown(&scene, &start, 10.0);
        let (before, after) = (energy(&start), energy(&long));
        let size = mechanism
            .at(&start, &vec![0.0; start.len() / 2], &[])
            .kinetic
            .max(before.abs());
        assert!(
            (after - before).abs() <= AGREES * size,
            "{name}: {before:?}, then {after:?}"
        );
    }
}

/// The state after a time without controls, by a kernel of the CPU.
fn flown(scene: &Scene, start: &[f64], time: f64) -> Vec<f64> {
    use costate::backend::cpu::Cpu;
    use costate::backend::{Backend, By, Run, Spec};
    use costate::low_level::program::Program;
    use costate::{Method, Precision};
    let model = &scene.model;
    let mut graph = model.graph.clone();
    let zero = graph.constant(0.0);
    let symbols: Vec<_> = model.states.iter().map(|s| s.variable.symbol).collect();
    let none = model
        .controls
        .iter()
        .map(|c| (c.variable.symbol, zero))
        .collect();
    let rates: Vec<_> = model.dynamics.iter().map(|d| d.expr).collect();
    let rates = graph.substitute(&rates, &none);
    let width = symbols.len();
    let spec = Spec {
        rate: Program::lower(&graph, &symbols, &rates),
        guards: None,
        kinks: None,
        method: Method::Dop853,
        precision: Precision::F64,
        by: By::Time,
        store: true,
    };
    let mut kernel = Cpu::new().compile(&spec).unwrap();
    let run = Run {
        rtol: 1e-13,
        atol: vec![1e-13; width],
        step: 0.0,
        first: None,
        max_steps: 1_000_000,
        levels: vec![time],
        ceiling: None,
        bounds: Vec::new(),
    };
    kernel.integrate(&run, start).unwrap().end
}

/// What identities are met to on random trees: accelerations of light tips of long chains are found
/// from sums of terms some hundred times as large, and residuals are relative to forces.
const OF_A_TREE: f64 = 1e-9;

/// A random mechanism: bodies in space with joints of all kinds, springs, dampers, rotors, forces
/// and a held point.
fn random_scene(seed: u64, bodies: usize, planar: bool) -> String {
    let mut index = 0;
    let mut uniform = |from: f64, to: f64| {
        index += 1;
        from + (to - from) * costate::low_level::numeric::random::uniform(seed, index)
    };
    let d = if planar { 2 } else { 3 };
    let vector = |u: &mut dyn FnMut(f64, f64) -> f64, size: f64| -> String {
        let all: Vec<String> = (0..d).map(|_| format!("{:?}", u(-size, size))).collect();
        format!("[{}]", all.join(", "))
    };
    let kinds: &[(&str, &[&str])] = &[
        ("revolute", &[""]),
        ("prismatic", &[""]),
        ("revolute", &[""]),
        ("fixed", &[]),
        ("planar", &["_x", "_y", ""]),
        ("spherical", &["_yaw", "_pitch", "_roll"]),
        ("floating", &["_x", "_y", "_z", "_yaw", "_pitch", "_roll"]),
    ];
    let known = if planar { 5 } else { 7 };
    let mut text = format!("[mechanism]\ngravity = {}\n", vector(&mut uniform, 10.0));
    let mut coordinates: Vec<String> = Vec::new();
    for b in 0..bodies {
        // The first moves, and the last is light enough to be whipped.
        let kind = match b {
            0 => 0,
            _ => uniform(0.0, known as f64) as usize,
        };
        let (joint, tails) = kinds[kind];
        text += &format!("[mechanism.bodies.b{b}]\njoint = \"{joint}\"\n");
        if b > 0 {
            let parent = uniform(0.0, b as f64) as usize;
            text += &format!("parent = \"b{parent}\"\n");
        }
        text += &format!(
            "at = {}\nmass = {:?}\n",
            vector(&mut uniform, 1.0),
            uniform(0.3, 3.0)
        );
        text += &format!("com = {}\n", vector(&mut uniform, 0.3));
        if planar {
            text += &format!(
                "rotation = {:?}\ninertia = {:?}\n",
                uniform(-3.0, 3.0),
                uniform(0.01, 0.3)
            );
        } else {
            let [a, b, c] = [(); 3].map(|()| uniform(-3.0, 3.0));
            text += &format!("rpy = [{a:?}, {b:?}, {c:?}]\n");
            let [a, b, c] = [(); 3].map(|()| uniform(0.1, 0.2));
            text += &format!("inertia = [{a:?}, 0.01, -0.02, {b:?}, 0.03, {c:?}]\n");
        }
        if joint == "prismatic" || (joint == "revolute" && !planar && uniform(0.0, 1.0) < 0.6) {
            text += &format!("axis = {}\n", vector(&mut uniform, 1.0));
        }
        if tails.len() == 1 {
            text += &format!(
                "spring = {:?}\nrest = {:?}\ndamping = {:?}\nrotor = {:?}\n",
                uniform(0.0, 5.0),
                uniform(-1.0, 1.0),
                uniform(0.0, 1.0),
                if b % 2 == 0 { 0.0 } else { uniform(0.0, 0.2) }
            );
        }
        coordinates.extend(tails.iter().map(|tail| format!("b{b}{tail}")));
    }
    let last = format!("b{}", bodies - 1);
    text += &format!(
        "[mechanism.points]\ntip = {{ body = \"{last}\", at = {} }}\n",
        vector(&mut uniform, 0.5)
    );
    let zeros = ["0.3*u"; 3][..d].to_vec().join("\", \"");
    let pushed = format!("{{ point = \"tip\", force = [\"{zeros}\"], axes = \"body\" }}");
    let turned = "\"u + 0.1*b0_rate\"";
    text += &match bodies {
        1 => format!("[mechanism.forces]\nb0 = [{turned}, {pushed}]\n"),
        _ => format!("[mechanism.forces]\nb0 = {turned}\n{last} = {pushed}\n"),
    };
    if coordinates.len() > 5 {
        text += "[mechanism.contacts]\ntip = { along = \"y\" }\n";
    }
    let region: String = (coordinates.iter())
        .map(|c| format!("{c} = [-1, 1]\n{c}_rate = [-1, 1]\n"))
        .collect();
    text + &format!(
        "[controls]\nu = {{}}\n[region]\n{region}[cost]\nrunning = \"u^2\"\nterminal = \"energy\"\nfinal_time = 1\n"
    )
}

#[test]
fn identities_hold_on_random_trees() {
    let mut looked_at = 0;
    for seed in 0..60 {
        let bodies = 1 + seed as usize % 12;
        let planar = seed % 3 == 0;
        let text = random_scene(seed, bodies, planar);
        let scene = match Scene::parse(&text, "random.toml") {
            Ok(scene) => scene,
            // A point that nothing can move along y.
            Err(e) if e.to_string().contains("are not determined") => continue,
            Err(e) => panic!("{seed}: {e}\n{text}"),
        };
        let summary = MechanismSummary::new(&scene).unwrap();
        for identity in &summary.identities {
            assert!(
                identity.residual < OF_A_TREE,
                "{seed}: {identity:?}\n{text}"
            );
            looked_at += 1;
        }
    }
    assert!(looked_at > 200, "{looked_at}");
}

/// A slide on a rail that holds the end of a rod: the rod's angle follows from the height, which must
/// not leave the rod's length. Where it would nothing is told, and nothing is refused.
#[test]
fn dependent_coordinates_may_have_a_domain() {
    let text = r#"
        [parameters]
        l = 1
        [mechanism]
        gravity = [0, -9.81]
        [mechanism.bodies]
        x = { joint = "prismatic", axis = "x", mass = 1 }
        y = { joint = "prismatic", axis = "y", parent = "x", mass = 1 }
        rod = { joint = "revolute", parent = "y", mass = 0.5, shape = { rod = 1 } }
        [mechanism.points]
        end = { body = "rod", at = [1, 0] }
        [mechanism.contacts]
        end = { along = "y" }
        [mechanism.dependent]
        rod = "asin(-y/l)"
        [mechanism.forces]
        x = "u"
        [controls]
        u = {}
        [region]
        x = [-1, 1]
        y = [-0.3, 0.3]
        x_rate = [-1, 1]
        y_rate = [-1, 1]
        [cost]
        running = "x^2 + y^2 + u^2"
        terminal = "0"
        final_time = 1
    "#;
    let scene = Scene::parse(text, "rod.toml").unwrap_or_else(|e| panic!("{e}"));
    let summary = MechanismSummary::new(&scene).unwrap();
    assert!(summary.identities.len() > 6);
    for identity in summary.identities {
        assert!(identity.residual < AGREES, "{identity:?}");
    }
}

#[test]
fn a_tensor_of_a_chain_of_three_is_not_guessed() {
    let text = r#"
        mechanism = { gravity = [0, 0, -9.81], bodies = { k = { chain = 3, joint = "revolute", axis = "x", mass = 1,
            at = [1, 0, 0], com = [0, 1, 0], inertia = [[0.1, 0.01, 0.02], [0.01, 0.2, 0.03], [0.02, 0.03, 0.15]] } } }
    "#;
    let refused = Scene::parse(text, "chain.toml")
        .expect_err("ambiguous")
        .to_string();
    assert!(
        refused.contains("may be one tensor, or three of diagonals"),
        "{refused}"
    );
}

/// Axes of a chain's links, by name: the same links one by one.
#[test]
fn axes_of_a_chain_by_name() {
    let rest = |names: [&str; 3]| {
        let each = |of: &dyn Fn(&str) -> String| names.map(of).concat();
        format!(
            "[mechanism.forces]\n{}[controls]\nu = {{}}\n[cost]\nrunning = \"u^2\"\nterminal = \"0\"\nfinal_time = 1\n[region]\n{}",
            each(&|n| format!("{n} = \"u\"\n")),
            each(&|n| format!("{n} = [-1, 1]\n{n}_rate = [-1, 1]\n")),
        )
    };
    let begin = "[mechanism]\ngravity = [0, 0, -9.81]\n[mechanism.bodies]\n";
    let body = "joint = \"revolute\", mass = 1, shape = { box = [0.4, 0.1, 0.2] }";
    let chain = format!(
        "{begin}a = {{ {body}, chain = 3, at = [0.4, 0, 0], axis = [\"z\", \"y\", \"x\"] }}\n{}",
        rest(["a1", "a2", "a3"])
    );
    let apart = format!(
        "{begin}a1 = {{ {body}, axis = \"z\" }}\na2 = {{ {body}, parent = \"a1\", at = [0.4, 0, 0], axis = \"y\" }}\n\
         a3 = {{ {body}, parent = \"a2\", at = [0.4, 0, 0], axis = \"x\" }}\n{}",
        rest(["a1", "a2", "a3"])
    );
    let [chain, apart] = [chain, apart].map(|text| {
        let scene = Scene::parse(&text, "scene.toml").unwrap_or_else(|e| panic!("{e}"));
        let at = MechanismAt::new(&scene).unwrap();
        at.at(&[0.3, -0.4, 0.5, 0.1, 0.2, -0.3], &[0.7], &[])
    });
    assert_eq!(chain, apart);
    assert!(chain.accelerations.iter().all(|a| a.abs() > 1e-3));
}
