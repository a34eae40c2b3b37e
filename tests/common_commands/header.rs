//! What a header of V says of states, compiled and asked.

use super::done;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

/// What a header says of a state.
#[derive(Debug)]
pub struct Said {
    pub known: bool,
    pub v: f64,
    pub p: Vec<f64>,
    pub u: Vec<f64>,
}

/// Compiles `NAME.h` of a directory and asks it about states; n states, m controls.
pub fn ask(
    directory: &Path,
    name: &str,
    [n, m]: [usize; 2],
    flags: &[&str],
    states: &[Vec<f64>],
) -> Vec<Said> {
    let program = format!(
        "#include \"{name}.h\"\n#include <stdio.h>\n\
         int main(void) {{\n  double in; int i, k;\n  for (;;) {{\n    {name}_real x[{n}], V = 0, p[{n}] = {{0}}, u[{m}] = {{0}};\n    \
         for (i = 0; i < {n}; i++) {{ if (scanf(\"%lf\", &in) != 1) return 0; x[i] = ({name}_real)in; }}\n    \
         k = {name}_value(x, &V, p);\n    if (k != {name}_control(x, u)) return 1;\n    printf(\"%d %.17g\", k, (double)V);\n    \
         for (i = 0; i < {n}; i++) printf(\" %.17g\", (double)p[i]);\n    \
         for (i = 0; i < {m}; i++) printf(\" %.17g\", (double)u[i]);\n    printf(\"\\n\");\n  }}\n}}\n"
    );
    std::fs::write(directory.join("main.c"), program).unwrap();
    let compiled = Command::new(std::env::var_os("CC").unwrap_or_else(|| "cc".into()))
        .args(["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"])
        .args(flags)
        .args(["-o", "main", "main.c", "-lm"])
        .current_dir(directory)
        .output()
        .unwrap();
    done(compiled);
    let mut running = Command::new(directory.join("main"))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let text: String = (states.iter())
        .map(|x| x.iter().map(|x| format!("{x:?} ")).collect::<String>() + "\n")
        .collect();
    let mut input = running.stdin.take().unwrap();
    let writer = std::thread::spawn(move || input.write_all(text.as_bytes()).unwrap());
    let rows = done(running.wait_with_output().unwrap());
    writer.join().unwrap();
    let rows = rows.lines().map(|line| {
        let numbers: Vec<f64> = line
            .split_whitespace()
            .map(|v| v.parse().unwrap())
            .collect();
        assert_eq!(numbers.len(), 2 + n + m);
        Said {
            known: numbers[0] == 1.0,
            v: numbers[1],
            p: numbers[2..2 + n].to_vec(),
            u: numbers[2 + n..].to_vec(),
        }
    });
    let rows: Vec<Said> = rows.collect();
    assert_eq!(rows.len(), states.len());
    rows
}
