//! A law as a C header that needs nothing but `math.h`: weights in arrays, loops over them, and
//! straight-line code of `u*(x, p)` where the law is a value function. In double precision, or in
//! single.

mod syntax;
mod value;

pub use value::{Known, value_header};

use super::law::{ClosedForm, Law, Meaning, Polynomial};
use super::network::{Activation, Layer};
use crate::model::Model;
use syntax::{Syntax, comment, fingerprint, number};

/// The header's text. It defines `NAME_u(x, u)`, and of a value function also `NAME_V(x, V, p)`;
/// bounds on controls are applied. Numbers are of the type `NAME_real`: `double`, or `float` where
/// `COSTATE_FLOAT` is defined. `name` is an identifier.
pub fn header(name: &str, law: &Law, form: &ClosedForm, model: &Model) -> String {
    // Another law of the same name is an error of the compiler, not left out.
    let guard = format!("COSTATE_{name}_{:016x}", fingerprint(&law.to_toml()));
    let states: Vec<&str> = model
        .states
        .iter()
        .map(|s| s.variable.name.as_str())
        .collect();
    let (n, m) = (states.len(), form.outputs.len());
    let value = law.meaning == Meaning::Value;
    let mut text = format!(
        "/* Feedback law `{name}` of the scene: {}\n   written by costate {}.\n   x: {}\n   u: {}{}\n   \
         Define COSTATE_FLOAT for single precision. */\n",
        comment(&model.title),
        env!("CARGO_PKG_VERSION"),
        states.join(", "),
        form.outputs.join(", "),
        if value {
            "\n   V: the value function, p: its gradient by x"
        } else {
            ""
        },
    );
    text += &syntax::begin(name, &guard);
    let c = Syntax {
        real: &format!("{name}_real"),
        function: &format!("{guard}_FN"),
        name,
    };
    text += &c.data(law, &states);
    text += &c.network(law);
    let Syntax { real, .. } = c;
    if value {
        text += &format!(
            "\nstatic inline void {name}_V(const {real} x[{n}], {real} *V, {real} p[{n}])\n{{\n"
        );
        text += &format!("    {name}_outputs(x, V, p);\n}}\n");
    }
    text += &format!("\nstatic inline void {name}_u(const {real} x[{n}], {real} u[{m}])\n{{\n");
    match &form.optimal {
        Some(optimal) => {
            text += &format!("    {real} V, p[{n}];\n    {name}_V(x, &V, p);\n");
            let symbols = [(form.x.as_slice(), "x"), (&optimal.p, "p")];
            text += &c.straight(&form.graph, &symbols, &optimal.commands, "u");
        }
        None => {
            text += &format!("    {name}_outputs(x, u);\n");
            for (i, output) in form.outputs.iter().enumerate() {
                let control = model.controls.iter().find(|c| c.variable.name == *output);
                let bounds = control.map_or([None; 2], |c| [c.min, c.max]);
                for (bound, sign) in bounds.into_iter().zip(["<", ">"]) {
                    let Some(bound) = bound else { continue };
                    let bound = number(bound);
                    text += &format!(
                        "    if (u[{i}] {sign} ({real}){bound}) u[{i}] = ({real}){bound};\n"
                    );
                }
            }
        }
    }
    text + "}\n" + &syntax::end(&guard)
}

impl Syntax<'_> {
    /// Weights, and what is added to the network, as arrays.
    fn data(&self, law: &Law, states: &[&str]) -> String {
        let mut text = String::new();
        let place = |input: &String| {
            states
                .iter()
                .position(|s| s == input)
                .expect("an input is a state")
        };
        let places: Vec<String> = law
            .network
            .inputs
            .iter()
            .map(|i| place(i).to_string())
            .collect();
        text += &format!(
            "/* Which states the inputs are. */\nstatic const int {}_inputs[{}] = {{{}}};\n",
            self.name,
            places.len(),
            places.join(",")
        );
        for (k, Layer { weights, bias }) in law.network.layers.iter().enumerate() {
            text += &self.matrix(&format!("W{}", k + 1), weights);
            text += &self.vector(&format!("b{}", k + 1), bias.iter().copied());
        }
        if let Some(base) = &law.base {
            text += "/* Added: constant + linear d + 1/2 d' quadratic d, d = inputs - center. */\n";
            text += &self.vector("center", base.center.iter().copied());
            text += &self.vector("constant", base.constant.iter().copied());
            text += &self.matrix("linear", &base.linear);
            if let Some(quadratic) = &base.quadratic {
                text += &self.matrix("quadratic", quadratic);
            }
        }
        text
    }

    /// `NAME_outputs(x, y)`: what the network and the polynomial give; of a value function with its
    /// gradient, backward through the layers.
    fn network(&self, law: &Law) -> String {
        let Self { name, real, .. } = self;
        let layers = &law.network.layers;
        let (inputs, last) = (law.network.inputs.len(), layers.len());
        let size = |k: usize| {
            if k == 0 {
                inputs
            } else {
                layers[k - 1].bias.len()
            }
        };
        let value = law.meaning == Meaning::Value;
        let slopes = if value {
            format!(", {real} *p")
        } else {
            String::new()
        };
        let mut text = format!(
            "\nstatic inline void {name}_outputs(const {real} *x, {real} *y{slopes})\n{{\n    int i, j;\n"
        );
        let hidden: Vec<String> = (0..last).map(|k| format!("h{k}[{}]", size(k))).collect();
        text += &format!("    {real} {};\n", hidden.join(", "));
        text += &format!("    for (i = 0; i < {inputs}; i++) h0[i] = x[{name}_inputs[i]];\n");
        for k in 1..=last {
            let target = if k == last {
                "y".to_owned()
            } else {
                format!("h{k}")
            };
            let (rows, columns) = (size(k), size(k - 1));
            let unit = if k == last {
                "z".to_owned()
            } else {
                self.unit(law.network.activation)
            };
            text += &format!(
                "    for (i = 0; i < {rows}; i++) {{\n        {real} z = {name}_b{k}[i];\n        \
                 for (j = 0; j < {columns}; j++) z += {name}_W{k}[i][j] * h{}[j];\n        {target}[i] = {unit};\n    }}\n",
                k - 1
            );
        }
        if value {
            text += &self.backward(law, &size);
        }
        if let Some(base) = &law.base {
            text += &self.polynomial(base, value);
        }
        text + "}\n"
    }

    fn unit(&self, activation: Activation) -> String {
        let Self { real, function, .. } = self;
        match activation {
            Activation::Tanh => format!("{function}(tanh)(z)"),
            Activation::Logistic => {
                format!("({real})0.5 + ({real})0.5 * {function}(tanh)(({real})0.5 * z)")
            }
        }
    }

    /// The only output's slopes by the states.
    fn backward(&self, law: &Law, size: &dyn Fn(usize) -> usize) -> String {
        let Self { name, real, .. } = self;
        let last = law.network.layers.len();
        let slopes: Vec<String> = (0..last).map(|k| format!("g{k}[{}]", size(k))).collect();
        let inputs = size(0);
        let mut text = format!(
            "    /* Slopes, from the output backward. */\n    {{\n    {real} {};\n",
            slopes.join(", ")
        );
        for k in (0..last).rev() {
            let columns = size(k);
            if k + 1 == last {
                text += &format!(
                    "    for (j = 0; j < {columns}; j++) g{k}[j] = {name}_W{last}[0][j];\n"
                );
            } else {
                let (above, rows) = (k + 1, size(k + 1));
                text += &format!(
                    "    for (j = 0; j < {columns}; j++) g{k}[j] = 0;\n    for (i = 0; i < {rows}; i++) {{\n        \
                     const {real} s = g{above}[i] * {};\n        \
                     for (j = 0; j < {columns}; j++) g{k}[j] += s * {name}_W{above}[i][j];\n    }}\n",
                    match law.network.activation {
                        Activation::Tanh => format!("(1 - h{above}[i] * h{above}[i])"),
                        Activation::Logistic => format!("h{above}[i] * (1 - h{above}[i])"),
                    }
                );
            }
        }
        text + &format!("    for (i = 0; i < {inputs}; i++) p[{name}_inputs[i]] = g0[i];\n    }}\n")
    }

    fn polynomial(&self, base: &Polynomial, value: bool) -> String {
        let Self { name, real, .. } = self;
        let (inputs, outputs) = (base.center.len(), base.constant.len());
        let mut text = format!("    for (j = 0; j < {inputs}; j++) h0[j] -= {name}_center[j];\n");
        text += &format!(
            "    for (i = 0; i < {outputs}; i++) {{\n        y[i] += {name}_constant[i];\n        \
             for (j = 0; j < {inputs}; j++) y[i] += {name}_linear[i][j] * h0[j];\n    }}\n"
        );
        if value {
            text += &format!(
                "    for (j = 0; j < {inputs}; j++) p[{name}_inputs[j]] += {name}_linear[0][j];\n"
            );
        }
        if base.quadratic.is_some() {
            text += &format!(
                "    for (i = 0; i < {inputs}; i++) {{\n        {real} q = 0;\n        \
                 for (j = 0; j < {inputs}; j++) q += {name}_quadratic[i][j] * h0[j];\n        \
                 *y += ({real})0.5 * h0[i] * q;\n"
            );
            if value {
                text += &format!("        p[{name}_inputs[i]] += q;\n");
            }
            text += "    }\n";
        }
        text
    }
}
