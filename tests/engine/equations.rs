//! Equations as text: parts that are used more than once have names where the text would be long.

use costate::Scene;
use costate::low_level::expr::Values;
use costate::session::Equations;

/// Definitions of the two before each: written out, the text doubles with every one.
fn nested(count: usize, first: &str) -> String {
    let later = (2..count).map(|i| {
        let (a, b) = (i - 1, i - 2);
        format!("{first}{i} = \"({first}{a} + {first}{b})*0.5*cos({first}{a})\"\n")
    });
    let definitions = format!("{first}0 = \"x/2\"\n{first}1 = \"v/2\"\n");
    definitions + &later.collect::<String>()
}

fn scene(definitions: &str, rate: &str) -> Scene {
    let text = format!(
        "[states]\nx = {{}}\nv = {{}}\n[controls]\nu = {{}}\n[definitions]\n{definitions}\n\
         [dynamics]\nx = \"v\"\nv = \"{rate}\"\n[cost]\nrunning = \"0.5*(x^2 + v^2 + u^2)\"\n\
         [equilibrium]\nx = 0\nv = 0\nu = 0\n[region]\nx = [-1, 1]\nv = [-1, 1]\n"
    );
    Scene::parse(&text, "nested.toml").unwrap()
}

fn bytes(count: usize) -> usize {
    let scene = scene(&nested(count, "a"), &format!("-x + u + a{}", count - 1));
    let equations = Equations::new(&scene);
    assert!(!equations.shared.is_empty());
    let parts = equations
        .shared
        .iter()
        .map(|(name, text)| name.len() + text.len());
    let rates = equations
        .state_equations
        .iter()
        .chain(&equations.adjoint_equations);
    parts.chain(rates.map(String::len)).sum()
}

#[test]
fn the_text_grows_with_the_definitions_and_not_with_their_products() {
    let (some, twice) = (bytes(40), bytes(80));
    assert!(some < 20_000, "{some}");
    assert!(twice < 3 * some, "{some}, {twice}");
}

/// dv/dt of a scene at a state.
fn rate(scene: &Scene, [x, v, u]: [f64; 3]) -> f64 {
    let model = &scene.model;
    let symbols = model.states.iter().map(|s| s.variable.symbol);
    let symbols = symbols.chain(model.controls.iter().map(|c| c.variable.symbol));
    let values: Values = symbols.zip([x, v, u]).collect();
    model.graph.eval(&[model.dynamics[1].expr], &values)[0]
}

#[test]
fn the_text_with_names_means_the_same() {
    let whole = scene(&nested(30, "a"), "-x + u + a29");
    let model = &whole.model;
    let together = model.graph.show_all(&[model.dynamics[1].expr], &model.text);
    assert!(together.shared.len() > 10, "{:?}", together.shared);
    let definitions = together.shared.iter();
    let definitions: String = definitions
        .map(|(n, t)| format!("{n} = \"{t}\"\n"))
        .collect();
    let again = scene(&definitions, &together.shown[0]);
    for k in 0..20 {
        let at = [0.7, 1.3, 2.1].map(|f| (f * f64::from(k)).sin());
        let (a, b) = (rate(&whole, at), rate(&again, at));
        assert!(
            (a - b).abs() <= 1e-12 * a.abs().max(1.0),
            "{at:?}: {a}, {b}"
        );
    }
}

#[test]
fn names_are_none_of_the_scene_s() {
    let scene = scene(&nested(30, "c"), "-x + u + c29");
    let equations = Equations::new(&scene);
    let own: Vec<String> = (0..30).map(|i| format!("c{i}")).collect();
    assert!(equations.shared.iter().all(|(name, _)| !own.contains(name)));
}
