//! Mistakes in weights files and in `[feedback]`, told with their places.

use super::DOUBLE_INTEGRATOR;
use costate::low_level::feedback::{Law, Network};

fn printed() -> Network {
    Network::from_toml(
        include_str!("../../../scenarios/hardt_network.toml"),
        "hardt_network.toml",
    )
    .unwrap()
}

/// Every mistake in a weights file is told with its place.
#[test]
fn wrong_weights_files_are_refused_with_places() {
    let text = printed().to_toml();
    let cases: [(&str, &str, &str); 12] = [
        (
            "activation = \"logistic\"",
            "activation = \"relu\"",
            "w.toml:1:14: the activation must be",
        ),
        (
            "activation = \"logistic\"",
            "",
            "w.toml: `activation` is missing",
        ),
        (
            "inputs = [\"Phi\", \"Psi\", \"R\"]",
            "inputs = [\"Phi\", \"Psi\"]",
            "W1 has 3 columns, but there are 2 inputs",
        ),
        (
            "inputs = [\"Phi\", \"Psi\", \"R\"]",
            "inputs = [\"Phi\", \"Phi\", \"R\"]",
            "w.toml:2:18: `Phi` a second time",
        ),
        (
            "output = \"gamma\"",
            "outputs = [\"gamma\", \"g\"]",
            "1 rows of w2, but 2 outputs",
        ),
        ("b2 = -1.1896", "", "`b2` is missing"),
        (
            "b2 = -1.1896",
            "b2 = nan",
            "w.toml:18:6: b2 must hold finite numbers",
        ),
        ("b2 = -1.1896", "b2 = [1, 2]", "w2 has 1 rows, b2 2 values"),
        (
            "b2 = -1.1896",
            "b2 = -1.1896\nw4 = [1]",
            "w.toml:19:1: unknown key `w4`",
        ),
        (
            "[-10.2954, 6.2032, 9.8482]",
            "[-10.2954, 6.2032]",
            "W1 has rows of 2 and of 3 numbers",
        ),
        (
            "[-10.2954, 6.2032, 9.8482]",
            "[-10.2954, 6.2032, \"a\"]",
            "w.toml:5:22: W1 must hold finite numbers",
        ),
        (
            "b2 = -1.1896",
            "b2 = -1.1896\n[base]\ncenter = [1]",
            "`base` makes this more than a network",
        ),
    ];
    for (old, new, expected) in cases {
        assert!(text.contains(old), "{old} is not in\n{text}");
        let wrong = text.replace(old, new);
        let message = Network::from_toml(&wrong, "w.toml")
            .unwrap_err()
            .to_string();
        assert!(message.contains(expected), "{new}: {message}");
    }
    let base = text + "[base]\ncenter = [1, 2, 3]\nconstant = [0]\nlinear = [[1, 2]]\n";
    let message = Law::from_toml(&base, "w.toml").unwrap_err().to_string();
    assert!(
        message.contains("linear must be 1 x 3, not 1 x 2"),
        "{message}"
    );
}

/// Every mistake in `[feedback]` is told with its place.
#[test]
fn wrong_sections_are_refused_with_places() {
    let lines = DOUBLE_INTEGRATOR.lines().count();
    let cases: [(&str, usize, &str); 19] = [
        ("[feedback]", 1, "[feedback] has no fit"),
        ("[feedback]\nfit = \"x\"", 2, "unknown fit `x`"),
        (
            "[feedback]\nfit = \"u\"\nhiden = [3]",
            3,
            "unknown key `hiden`",
        ),
        (
            "[feedback]\nfit = \"u\"\nhidden = 3",
            3,
            "hidden must be a list",
        ),
        (
            "[feedback]\nfit = \"u\"\nhidden = [3, 0]",
            3,
            "units must be a whole number from 1 to 1000, not 0",
        ),
        (
            "[feedback]\nfit = \"u\"\noutput = \"w\"",
            3,
            "`w` is neither a control nor a state",
        ),
        (
            "[feedback]\nfit = \"u\"\noutput = [\"u\", \"u\"]",
            3,
            "output `u` a second time",
        ),
        (
            "[feedback]\nfit = \"V\"\noutput = \"u\"",
            3,
            "output has no meaning",
        ),
        (
            "[feedback]\nfit = \"V\"\ninputs = \"x\"",
            3,
            "V is a function of all states",
        ),
        (
            "[feedback]\nfit = \"u\"\ninputs = [\"x\", \"u\"]",
            3,
            "`u` is not a state",
        ),
        (
            "[feedback]\nfit = \"u\"\noutput = \"v\"\ninputs = [\"x\", \"v\"]",
            4,
            "input `v` is the output",
        ),
        (
            "[feedback]\nfit = \"u\"\noutput = \"v\"\nbase = \"local\"",
            4,
            "the local solution commands no states",
        ),
        (
            "[feedback]\nfit = \"u\"\nbox = { x = [1, 0] }",
            3,
            "the box of `x` is empty",
        ),
        (
            "[feedback]\nfit = \"u\"\nbox = { u = [0, 1] }",
            3,
            "`u` is a control",
        ),
        ("[feedback]\nfit = \"u\"\nwhere = [\"x >\"]", 3, ""),
        (
            "[feedback]\nfit = \"u\"\nwhere = [\"u > 1\"]",
            3,
            "a condition of `where` may not use `u`",
        ),
        (
            "[feedback]\nfit = \"u\"\ngradient = true",
            3,
            "gradient has no meaning",
        ),
        (
            "[feedback]\nfit = \"u\"\ntest = 0.5\nvalidation = 0.5",
            3,
            "leave less than a tenth",
        ),
        (
            "[feedback.lqr]\nfit = \"u\"",
            1,
            "a law cannot be called `lqr`",
        ),
    ];
    for (section, line, expected) in cases {
        let text = format!("{DOUBLE_INTEGRATOR}{section}\n");
        let error = costate::low_level::scenario::parse(&text, "scene.toml", &[]).unwrap_err();
        assert_eq!(error.problems.len(), 1, "{section}: {error}");
        assert!(
            error.problems[0].message.contains(expected),
            "{section}: {error}"
        );
        assert_eq!(
            error.place(&error.problems[0]).unwrap().0,
            lines + line,
            "{section}: {error}"
        );
    }
}
