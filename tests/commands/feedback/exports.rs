//! Closed forms, C headers and ONNX models against the laws themselves.

use super::support::{output, scratch};
use super::{DOUBLE_INTEGRATOR, fitted, linear_quadratic, scene};
use costate::low_level::closed_loop::Laws;
use costate::low_level::feedback::{FittedLaw, Law, Meaning, header, onnx};
use costate::low_level::hamiltonian::Hamiltonian;
use costate::low_level::model::Model;
use costate::low_level::numeric::random::random;
use std::path::Path;
use std::process::Command;

/// Laws of all kinds, with states at which to compare them.
fn laws() -> Vec<(FittedLaw, Model)> {
    let quick = "starts = 1, iterations = 15, hidden = [5, 3]";
    let cases = [
        format!("feedback = {{ fit = \"u\", {quick} }}"),
        format!(
            "feedback = {{ fit = \"u\", inputs = [\"v\", \"x\"], base = \"local\", activation = \"tanh\", {quick} }}"
        ),
        format!("feedback = {{ fit = \"V\", inputs = [\"v\", \"x\"], {quick} }}"),
        format!("feedback = {{ fit = \"V\", base = \"none\", activation = \"tanh\", {quick} }}"),
        "feedback = { fit = \"V\", hidden = [] }".to_owned(),
    ];
    let of = |text: &String| {
        let (model, hamiltonian) = scene(text, DOUBLE_INTEGRATOR);
        let law = fitted(
            &model,
            &hamiltonian,
            &linear_quadratic(300),
            &model.feedback[0],
        );
        (law, model)
    };
    cases.iter().map(of).collect()
}

/// u, then V and p where there are, at a state.
fn expected(law: &FittedLaw, x: &[f64]) -> Vec<f64> {
    let form = &law.form;
    let mut roots = form.commands.clone();
    if let Some((value, slopes)) = &form.value {
        roots.push(*value);
        roots.extend(slopes);
    }
    form.graph.eval(
        &roots,
        &form.x.iter().copied().zip(x.iter().copied()).collect(),
    )
}

/// Far outside the data too, where units saturate and the bound acts.
fn places() -> Vec<[f64; 2]> {
    let mut places: Vec<[f64; 2]> = (0..20)
        .map(|k| [random(3, k), random(4, k)].map(|r| r as f64 / 2f64.powi(63) - 1.0))
        .collect();
    places.extend([[0.0, 0.0], [40.0, -30.0], [1.0, 1.0]]);
    places
}

/// The law itself, matrix by matrix, against its closed form.
#[test]
fn closed_forms_are_the_laws() {
    for (law, model) in laws() {
        let hamiltonian = Hamiltonian::derive(&model).unwrap();
        for x in places() {
            let names = law.law.network.inputs.iter();
            let inputs: Vec<f64> = names
                .map(|n| {
                    x[model
                        .states
                        .iter()
                        .position(|s| s.variable.name == *n)
                        .unwrap()]
                })
                .collect();
            let value = law.law.eval(&inputs)[0];
            let expected = expected(&law, &x);
            let got = match law.law.meaning {
                Meaning::Law => value.max(-1.5),
                Meaning::Value => value,
            };
            let expected = if law.law.meaning == Meaning::Law {
                expected[0]
            } else {
                expected[1]
            };
            // Sums of a few terms, some of about 1e3 at the far state.
            assert!(
                (got - expected).abs() <= 1e-12 * (1.0 + expected.abs()),
                "{got} {expected}"
            );
        }
        // As the closed loop reads the file.
        let toml = law.law.to_toml();
        let read = Laws::new(&model, &hamiltonian, None)
            .weights("law", &toml, "law.toml")
            .unwrap();
        for x in places() {
            let mut at = model.parameter_values();
            at.extend(hamiltonian.x.iter().copied().zip(x));
            let (u, wanted) = (
                read.graph.eval(&read.control, &at)[0],
                expected(&law, &x)[0],
            );
            assert!(
                (u - wanted).abs() <= 1e-12 * (1.0 + wanted.abs()),
                "{u} {wanted}"
            );
        }
        let again = Law::from_toml(&law.law.to_toml(), "law.toml").unwrap();
        assert_eq!(again, law.law);
    }
}

/// The exports' values at the places, `[place][value]`, against the closed form's.
fn compare(law: &FittedLaw, rows: &str, what: &str) {
    let places = places();
    let rows: Vec<Vec<f64>> = (rows.lines())
        .map(|line| {
            line.split_whitespace()
                .map(|v| v.parse().unwrap())
                .collect()
        })
        .collect();
    assert_eq!(rows.len(), places.len(), "{what}");
    for (x, row) in places.iter().zip(&rows) {
        let expected = expected(law, x);
        assert_eq!(row.len(), expected.len(), "{what}");
        for (got, wanted) in row.iter().zip(&expected) {
            // Another libm, and sums in another order.
            assert!(
                (got - wanted).abs() <= 1e-12 * (1.0 + wanted.abs()),
                "{what} at {x:?}: {got} {wanted}"
            );
        }
    }
}

/// A strict compiler of C99 in a directory.
fn compiler(directory: &Path) -> Command {
    let mut compiler = Command::new(std::env::var_os("CC").unwrap_or_else(|| "cc".into()));
    let strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"];
    compiler.args(strict).current_dir(directory);
    compiler
}

/// What the header of a law says at the places, compiled with some flags.
fn by_header(directory: &Path, law: &FittedLaw, model: &Model, flags: &[&str]) -> String {
    std::fs::write(
        directory.join("law.h"),
        header("law", &law.law, &law.form, model),
    )
    .unwrap();
    let mut program =
        String::from("#include \"law.h\"\n#include <stdio.h>\nint main(void) {\nlaw_real u[1];\n");
    let value = law.form.value.is_some();
    if value {
        program += "law_real V, p[2];\n";
    }
    for [x, v] in places() {
        program += &format!(
            "{{ const law_real x[2] = {{ {x:?}, {v:?} }}; law_u(x, u); printf(\"%.17g\", u[0]);\n"
        );
        if value {
            program += "law_V(x, &V, p); printf(\" %.17g %.17g %.17g\", V, p[0], p[1]);\n";
        }
        program += "printf(\"\\n\"); }\n";
    }
    program += "return 0;\n}\n";
    std::fs::write(directory.join("main.c"), program).unwrap();
    let files = ["-o", "main", "main.c", "-lm"];
    output(compiler(directory).args(flags).args(files));
    output(&mut Command::new(directory.join("main")))
}

#[test]
fn the_c_header_is_the_law() {
    for (k, (law, model)) in laws().into_iter().enumerate() {
        let directory = scratch(&format!("header{k}"));
        compare(
            &law,
            &by_header(&directory, &law, &model, &[]),
            &format!("header {k}"),
        );
        // In single precision: nothing is computed in double on the way, so rounding adds up.
        let single = by_header(&directory, &law, &model, &["-DCOSTATE_FLOAT"]);
        for (x, row) in places().iter().zip(single.lines()) {
            let got: Vec<f64> = row.split_whitespace().map(|v| v.parse().unwrap()).collect();
            for (got, wanted) in got.iter().zip(expected(&law, x)) {
                assert!(
                    (got - wanted).abs() <= 2e-5 * (1.0 + wanted.abs()),
                    "header {k} at {x:?}: {got} {wanted}"
                );
            }
        }
        std::fs::remove_dir_all(directory).unwrap();
    }
}

/// Two laws of one name do not hide each other, and a title may hold anything.
#[test]
fn headers_do_not_hide_each_other() {
    let (laws, directory) = (laws(), scratch("headers"));
    let compiles = |second: usize| {
        for (file, (law, model)) in [("a.h", &laws[0]), ("b.h", &laws[second])] {
            let model = Model {
                title: "a /* b */ c ???/ \\".to_owned(),
                ..model.clone()
            };
            std::fs::write(
                directory.join(file),
                header("law", &law.law, &law.form, &model),
            )
            .unwrap();
        }
        let text = "#include \"a.h\"\n#include \"b.h\"\nvoid f(const double *x, double *u);\nvoid f(const double *x, double *u) { law_u(x, u); }\n";
        std::fs::write(directory.join("both.c"), text).unwrap();
        let done = compiler(&directory)
            .args(["-c", "both.c"])
            .output()
            .unwrap();
        (
            done.status.success(),
            String::from_utf8_lossy(&done.stderr).into_owned(),
        )
    };
    let (same, text) = compiles(0);
    assert!(same, "{text}");
    let (other, text) = compiles(1);
    assert!(!other && text.contains("redefinition"), "{text}");
    std::fs::remove_dir_all(directory).unwrap();
}

/// What the file costs in flash: hardly more than its numbers.
#[test]
fn a_header_is_hardly_longer_than_its_numbers() {
    let text = "feedback = { fit = \"V\", base = \"none\", hidden = [20, 12], starts = 1, iterations = 2 }";
    let (model, hamiltonian) = scene(text, DOUBLE_INTEGRATOR);
    let law = fitted(
        &model,
        &hamiltonian,
        &linear_quadratic(300),
        &model.feedback[0],
    );
    let weights = law.law.network.parameters();
    assert_eq!(weights, 3 * 20 + 21 * 12 + 13);
    let length = header("law", &law.law, &law.form, &model).len();
    assert!(length < 10_000, "{length} characters for {weights} weights");
}

/// onnxruntime's answer to a batch of states; see `tests/check_onnx.py`.
#[test]
fn the_onnx_model_is_the_law() {
    let python = std::env::var_os("COSTATE_TEST_PYTHON").unwrap_or_else(|| "python3".into());
    let script = Path::new(crate::ROOT).join("tests/check_onnx.py");
    for (k, (law, model)) in laws().into_iter().enumerate() {
        let directory = scratch(&format!("onnx{k}"));
        let file = directory.join("law.onnx");
        std::fs::write(&file, onnx("law", &law.law, &law.form, &model).unwrap()).unwrap();
        let states: Vec<String> = places()
            .iter()
            .flatten()
            .map(|x| format!("{x:?}"))
            .collect();
        let rows = output(
            Command::new(&python)
                .arg(&script)
                .arg(&file)
                .arg("2")
                .args(states),
        );
        compare(&law, &rows, &format!("onnx {k}"));
        std::fs::remove_dir_all(directory).unwrap();
    }
}
