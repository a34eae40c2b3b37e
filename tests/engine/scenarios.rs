//! The scenes that come with the program: they are read, and those with a known answer satisfy its
//! equation.

use costate::Scene;
use costate::low_level::expr::Id;
use costate::low_level::model::{Horizon, Model};
use costate::low_level::scenario::load;
use std::path::Path;

fn scene(name: &str, set: &[(&str, &str)]) -> Model {
    let path = Path::new(crate::ROOT).join("scenarios").join(name);
    let set: Vec<_> = set
        .iter()
        .map(|(n, v)| ((*n).to_owned(), (*v).to_owned()))
        .collect();
    load(&path, &set).unwrap_or_else(|e| panic!("{e}"))
}

/// (f, L) at a state and control.
fn equations(model: &Model, x: &[f64], u: &[f64]) -> (Vec<f64>, f64) {
    let mut values = model.parameter_values();
    values.extend(
        model
            .states
            .iter()
            .map(|s| s.variable.symbol)
            .zip(x.iter().copied()),
    );
    values.extend(
        model
            .controls
            .iter()
            .map(|c| c.variable.symbol)
            .zip(u.iter().copied()),
    );
    let f: Vec<Id> = model.dynamics.iter().map(|d| d.expr).collect();
    (
        model.graph.eval(&f, &values),
        model.graph.eval(&[model.running.expr], &values)[0],
    )
}

fn parameter(model: &Model, name: &str) -> f64 {
    model
        .parameters
        .iter()
        .find(|p| p.name == name)
        .unwrap_or_else(|| panic!("no parameter {name}"))
        .value
}

/// A few points spread over the region.
fn points(model: &Model) -> Vec<Vec<f64>> {
    let fraction =
        |i: usize, k: usize| (0.37 * (i + 1) as f64 * (k + 1) as f64 + 0.11 * k as f64).fract();
    let at = |i| {
        model
            .region
            .iter()
            .enumerate()
            .map(|(k, [a, b])| a + (b - a) * fraction(i, k))
            .collect()
    };
    (0..40).map(at).collect()
}

/// Terms of order 1 to 100 cancel to some hundred epsilons.
const ROUNDING: f64 = 1e-11;

#[test]
fn all_scenes_are_read() {
    for (name, states, controls) in [
        ("pendulum.toml", 2, 1),
        ("moore_greitzer.toml", 4, 1),
        ("moore_greitzer_unconstrained.toml", 3, 1),
        ("linear_quadratic.toml", 4, 2),
        ("manufactured.toml", 2, 1),
        ("finite_horizon.toml", 2, 1),
        ("linear_game.toml", 2, 1),
        ("manufactured_game.toml", 2, 1),
    ] {
        let model = scene(name, &[]);
        assert_eq!(
            (model.states.len(), model.controls.len()),
            (states, controls),
            "{name}"
        );
        assert!(model.shoot_out.is_some(), "{name}");
    }
}

#[test]
fn the_compressor_is_the_thesis_one() {
    let model = scene("moore_greitzer.toml", &[]);
    let Horizon::Infinite { x, u, .. } = &model.horizon else {
        panic!("the horizon is infinite")
    };
    assert_eq!(u, &[0.0]);
    assert!((x[1] - 2.0829).abs() < 1e-12, "Psi_c(1.2) = {}", x[1]);
    assert!(
        (x[3] - 1.5244).abs() < 5e-5,
        "gamma0 = {}, 1.5244 in the thesis",
        x[3]
    );
    assert_eq!(
        (model.controls[0].min, model.controls[0].max),
        (Some(-0.1), Some(0.1))
    );
    for set in [
        ("Phi0", "1.4"),
        ("Phi0", "1.1"),
        ("v_max", "0.2"),
        ("c", "5"),
    ] {
        scene("moore_greitzer.toml", &[set]);
        assert_eq!(
            parameter(&scene("moore_greitzer.toml", &[set]), set.0),
            set.1.parse().unwrap_or(f64::NAN)
        );
    }
}

#[test]
fn overrides_reach_what_is_computed_from_them() {
    let model = scene(
        "moore_greitzer.toml",
        &[("Phi0", "1 + beta/4"), ("v_max", "1/10"), ("v_max", "1/5")],
    );
    assert_eq!(model.reference()[0], 1.25);
    assert_eq!(model.controls[0].max, Some(0.2));
    assert!((parameter(&model, "gamma0") - 2.25 / parameter(&model, "Psi0").sqrt()).abs() < 1e-15);
}

/// A number given as a number, negative ones too, makes the same scene as one typed, down to the
/// order of its graph.
#[test]
fn a_scene_at_other_values_is_that_of_typed_ones() {
    let path = format!("{}/scenarios/moore_greitzer.toml", crate::ROOT);
    let scene = Scene::load(&path).unwrap();
    for (name, value) in [
        ("Phi0", 1.25),
        ("c", -0.3),
        ("v_max", 0.2),
        ("beta", 1.0 / 3.0),
    ] {
        let typed = [(name.to_owned(), format!("{value:?}"))];
        let (with, typed) = (
            scene.with(&[(name, value)]),
            Scene::load_with(&path, &typed),
        );
        let (with, typed) = match (with, typed) {
            (Ok(with), Ok(typed)) => (with, typed),
            // What is wrong with the scene then is the same too.
            (with, typed) => {
                assert_eq!(
                    with.unwrap_err().to_string(),
                    typed.unwrap_err().to_string()
                );
                continue;
            }
        };
        assert_eq!(parameter(&with.model, name), value);
        assert_eq!(with.model.overrides, typed.model.overrides);
        assert_eq!(with.model.reference(), typed.model.reference());
        assert_eq!(
            format!("{:?}", with.model.parameters),
            format!("{:?}", typed.model.parameters)
        );
        assert_eq!(
            with.hamiltonian.adjoint_rate,
            typed.hamiltonian.adjoint_rate
        );
        let shown = |s: &Scene| s.hamiltonian.graph.show(s.hamiltonian.open);
        assert_eq!(shown(&with), shown(&typed));
    }
    // The last value counts, and an unknown name is refused as on the command line.
    let twice = scene
        .with(&[("Phi0", 1.2)])
        .unwrap()
        .with(&[("Phi0", 1.3)])
        .unwrap();
    assert_eq!(parameter(&twice.model, "Phi0"), 1.3);
    let refused = scene.with(&[("Phi1", 1.0)]).unwrap_err().to_string();
    assert!(
        refused.contains("there is no parameter `Phi1`"),
        "{refused}"
    );
}

#[test]
fn the_manufactured_value_function_satisfies_its_equation() {
    let model = scene("manufactured.toml", &[]);
    let r = parameter(&model, "r");
    for point in points(&model) {
        let (x, y) = (point[0], point[1]);
        let v = [
            x + 0.5 * x.sin() + 0.5 * y + 0.5 * x * y * y,
            2.0 * y + 0.5 * x + 0.5 * x * x * y,
        ];
        let best = -v[1] / r;
        let hamiltonian = |u: f64| {
            let (f, cost) = equations(&model, &point, &[u]);
            v[0] * f[0] + v[1] * f[1] + cost
        };
        assert!(
            hamiltonian(best).abs() < ROUNDING,
            "H = {} at {point:?}",
            hamiltonian(best)
        );
        assert!(hamiltonian(best + 0.1) > 0.0 && hamiltonian(best - 0.1) > 0.0);
        let (_, cost) = equations(&model, &point, &[0.0]);
        assert!(cost > 1.29 * (x * x + y * y), "q = {cost} at {point:?}");
    }
}

#[test]
fn the_finite_horizon_value_function_satisfies_its_equation() {
    let model = scene("finite_horizon.toml", &[]);
    let Horizon::Finite {
        terminal,
        final_time,
        reference,
    } = &model.horizon
    else {
        panic!("the horizon is finite")
    };
    assert_eq!(
        (*final_time, reference.as_slice()),
        (2.0, [0.0, 0.0].as_slice())
    );
    let s = parameter(&model, "s");
    let value = |x: f64, v: f64, tau: f64| {
        let y = x + v * tau;
        let d = (tau.powi(3) / 3.0 + 1.0 / s) * (tau + 1.0 / s) - tau.powi(4) / 4.0;
        ((tau + 1.0 / s) * y * y - tau * tau * y * v + (tau.powi(3) / 3.0 + 1.0 / s) * v * v)
            / (2.0 * d)
    };
    // Central differences of a smooth function: error h^2 times third derivatives, below 1e4 here.
    let h = 1e-5;
    for (i, point) in points(&model).into_iter().enumerate() {
        let (x, v, tau) = (point[0], point[1], 0.2 + 0.04 * i as f64);
        let v_x = (value(x + h, v, tau) - value(x - h, v, tau)) / (2.0 * h);
        let v_v = (value(x, v + h, tau) - value(x, v - h, tau)) / (2.0 * h);
        let v_tau = (value(x, v, tau + h) - value(x, v, tau - h)) / (2.0 * h);
        let (f, cost) = equations(&model, &point, &[-v_v]);
        let residual = -v_tau + v_x * f[0] + v_v * f[1] + cost;
        assert!(
            residual.abs() < 1e-5,
            "{residual} at {point:?}, tau = {tau}"
        );
        let mut at = model.parameter_values();
        at.extend(
            model
                .states
                .iter()
                .map(|s| s.variable.symbol)
                .zip(point.iter().copied()),
        );
        let phi = model.graph.eval(&[terminal.expr], &at)[0];
        assert!(
            (phi - value(x, v, 0.0)).abs() < ROUNDING * (1.0 + phi),
            "{phi} at {point:?}"
        );
    }
}

/// `atol` follows `rtol` where the file gives that alone.
#[test]
fn atol_follows_rtol() {
    let scene = |integrator: &str| {
        let text = format!(
            "states = {{ x = {{}} }}\ncontrols = {{ u = {{}} }}\ndynamics = {{ x = \"u\" }}\n\
             cost = {{ running = \"x^2 + u^2\" }}\nequilibrium = {{ x = 0, u = 0 }}\nregion = {{ x = [-1, 1] }}\n{integrator}"
        );
        let model = costate::low_level::scenario::parse(&text, "test.toml", &[])
            .unwrap_or_else(|e| panic!("{}", e.render(false)));
        (model.integrator.rtol, model.integrator.atol)
    };
    assert_eq!(scene(""), (1e-6, 1e-9));
    assert_eq!(scene("integrator = { rtol = 1e-3 }"), (1e-3, 1e-6));
    assert_eq!(scene("integrator = { atol = 1e-7 }"), (1e-6, 1e-7));
    assert_eq!(
        scene("integrator = { rtol = 1e-8, atol = 1e-7 }"),
        (1e-8, 1e-7)
    );
}

/// An equilibrium is checked relative to the sizes of its states, and rounding is no fault.
#[test]
fn equilibria_of_small_and_large_states() {
    let problems = |x: f64, at: &str, size: f64| {
        let text = format!(
            "parameters = {{ x0 = {x:e} }}\nstates = {{ x = {{}} }}\ncontrols = {{ u = {{}} }}\n\
             dynamics = {{ x = \"x0 - x + u\" }}\ncost = {{ running = \"((x - x0)/{size:e})^2 + u^2\" }}\n\
             equilibrium = {{ x = {at}, u = 0 }}\nregion = {{ x = [{:e}, {:e}] }}\n",
            x - size,
            x + size
        );
        match costate::low_level::scenario::parse(&text, "test.toml", &[]) {
            Ok(_) => String::new(),
            Err(e) => e.render(false),
        }
    };
    for size in [1e-6, 1.0, 1e6] {
        assert_eq!(problems(2.0 * size, "\"x0\"", size), "", "{size}");
        // Ten digits, as one types a number.
        assert_eq!(
            problems(
                2.0 * size / 3.0,
                &format!("{:.10e}", 2.0 * size / 3.0),
                size
            ),
            "",
            "{size}"
        );
        let off = problems(2.0 * size, &format!("{:e}", 2.0001 * size), size);
        assert!(off.contains("this is no equilibrium"), "{size}: {off}");
    }
    // sin(pi) is not 0 in any arithmetic.
    assert_eq!(problems(0.0, "\"sin(pi)\"", 1.0), "");
}
