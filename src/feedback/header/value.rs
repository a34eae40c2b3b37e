//! V in pieces, or as a series about the equilibrium, as a C header: tables of numbers, and the
//! same steps as [`Pieces::sheets`] and [`LocalPolynomial::at`] in C (`pieces.c`, `local.c`,
//! `sum.c` beside this file).

use super::syntax::{self, Syntax, comment, fingerprint, real_text};
use crate::expr::Id;
use crate::hamiltonian::System;
use crate::local::LocalPolynomial;
use crate::map::pieces::{BLEND, Node, Pieces, SAME, Terms};
use crate::map::{GUARD_ROUNDING, ISAACS_RESIDUAL};
use crate::model::Model;

const SUM: &str = include_str!("sum.c");
const LOCAL: &str = include_str!("local.c");
const PIECES: &str = include_str!("pieces.c");

/// What is known of V.
#[derive(Clone, Copy, Debug)]
pub enum Known<'k> {
    /// Pieces, and the series near the equilibrium where there is one.
    Map(&'k Pieces, Option<&'k LocalPolynomial>),
    /// The series alone.
    Local(&'k LocalPolynomial),
}

/// The header's text. It defines `NAME_value(x, V, p)` and `NAME_control(x, u)`, which return 1
/// where V is known and else 0. u is the minimiser of the Hamiltonian at p, within its bounds.
/// Where the pieces have time as an axis it follows x, and p has dV/dt as its last component. The
/// type of numbers is as in [`super::header`].
pub fn value_header(name: &str, known: Known<'_>, system: &System, model: &Model) -> String {
    let text = |guard: &str| {
        let writer = Writer {
            c: Syntax {
                name,
                real: &format!("{name}_real"),
                function: &format!("{guard}_FN"),
            },
            known,
            system,
            model,
        };
        writer.title()
            + &syntax::begin(name, guard)
            + &writer.tables()
            + &writer.functions()
            + &syntax::end(guard)
    };
    // Another V of the same name is an error of the compiler, not left out.
    text(&format!("COSTATE_{name}_{:016x}", fingerprint(&text(""))))
}

impl<'k> Known<'k> {
    fn pieces(self) -> Option<&'k Pieces> {
        match self {
            Known::Map(pieces, _) => Some(pieces),
            Known::Local(_) => None,
        }
    }

    fn local(self) -> Option<&'k LocalPolynomial> {
        match self {
            Known::Map(_, local) => local,
            Known::Local(local) => Some(local),
        }
    }

    /// Most coefficients of a polynomial.
    fn terms(self) -> usize {
        let pieces = self.pieces().into_iter().flat_map(|p| &p.pieces);
        let local = self.local().map_or(1, |l| l.coefficients.len());
        let shear = self.pieces().map(|p| {
            p.frame
                .bend
                .as_ref()
                .map_or(1, |bend| bend.whole(&p.terms).len())
        });
        pieces
            .map(|p| p.coefficients.len())
            .fold(local.max(shear.unwrap_or(1)), usize::max)
    }
}

struct Writer<'a> {
    c: Syntax<'a>,
    known: Known<'a>,
    system: &'a System,
    model: &'a Model,
}

impl Writer<'_> {
    fn title(&self) -> String {
        let names =
            |all: &mut dyn Iterator<Item = &String>| all.cloned().collect::<Vec<_>>().join(", ");
        let what = match self.known {
            Known::Map(pieces, _) => {
                let named = self.model.states.iter().map(|s| s.variable.name.as_str());
                let region = (named
                    .chain([self.model.time_name()])
                    .zip(&pieces.region.lo)
                    .zip(&pieces.region.hi))
                .map(|((name, lo), hi)| format!("{name} in [{lo}, {hi}]"));
                format!(
                    "Value function `{}` in pieces, to an error of {:e} of V as asked, over\n   {}",
                    self.c.name,
                    pieces.region.error,
                    region.collect::<Vec<_>>().join(", ")
                )
            }
            Known::Local(local) => format!(
                "Value function `{}` about the equilibrium as its Taylor series of degree {}",
                self.c.name, local.degree
            ),
        };
        let returned = match self.known {
            Known::Map(..) => {
                "Both functions return 1 where V is known. Where they return 0 nothing is known, and V, p and u mean nothing."
            }
            Known::Local(_) => {
                "Both functions return 1 where what the series leaves out is small by its own measure, and 0 beyond."
            }
        };
        format!(
            "/* {what},\n   of the scene: {}\n   written by costate {}.\n   x: {}\n   u: {}\n   V: the value function, p: its gradient by x{}\n   \
             {returned}\n   Define COSTATE_FLOAT for single precision. About {} numbers lie on the stack. */\n",
            comment(&self.model.title),
            env!("CARGO_PKG_VERSION"),
            names(&mut self.model.states.iter().map(|s| &s.variable.name)),
            names(&mut self.model.controls.iter().map(|c| &c.variable.name)),
            match (self.is_timed(), self.model.final_time()) {
                (true, _) => " and, last, by the time t",
                (false, Some(_)) => "; both at t = 0 alone",
                (false, None) => "",
            },
            2 * self.known.terms() + 16 * self.model.states.len(),
        )
    }

    /// Variables of V: the states, and the time where it is an axis.
    fn variables(&self) -> usize {
        self.known
            .pieces()
            .map_or(self.model.states.len(), Pieces::states)
    }

    fn is_timed(&self) -> bool {
        self.variables() > self.model.states.len()
    }

    fn tables(&self) -> String {
        let n = self.variables();
        let name = self.c.name;
        let count = self.known.terms();
        let terms = Terms::through(n, count);
        let mut text = format!("enum {{ {name}_states = {n}, {name}_terms = {count} }};\n");
        text += "/* Monomials after the first: which earlier one times which variable. */\n";
        let factors = &terms.factors[..count];
        text += &self
            .c
            .integers("parent", factors.iter().map(|f| f.0.into()));
        text += &self.c.integers("times", factors.iter().map(|f| f.1.into()));
        let time = self.is_timed().then_some(0.0);
        text += &self.c.list(
            "reference",
            &self
                .system
                .reference
                .iter()
                .copied()
                .chain(time)
                .collect::<Vec<f64>>(),
        );
        let periods = self
            .model
            .states
            .iter()
            .map(|s| s.period.unwrap_or(0.0))
            .chain(time);
        text += "/* Of angles; of other states 0. */\n";
        text += &self.c.list("period", &periods.collect::<Vec<f64>>());
        if let Some(local) = self.known.local() {
            text += &format!(
                "\n/* Series about the equilibrium. */\nenum {{ {name}_local_terms = {} }};\n",
                local.coefficients.len()
            );
            text += &self.c.number("local_reach", local.reach);
            text += &self.c.table("local_matrix", &local.matrix, n);
            text += &self.c.list("local", &local.coefficients);
        }
        match self.known.pieces() {
            Some(pieces) => text + &self.piece_tables(pieces),
            None => text,
        }
    }

    fn piece_tables(&self, pieces: &Pieces) -> String {
        let (c, n, name) = (&self.c, self.variables(), self.c.name);
        let region = &pieces.region;
        let sheets = pieces
            .cells
            .iter()
            .map(|cell| cell.pieces.len())
            .max()
            .unwrap_or(1);
        let mut text = format!(
            "\n/* Region; limits of V; the share of a cell's half width by which it reaches over its faces. */\n\
             enum {{ {name}_sheets = {}, {name}_depth = {} }};\n",
            sheets.max(1),
            depth(&pieces.nodes, 0) + 1
        );
        text += &c.list("lower", &region.lo);
        text += &c.list("upper", &region.hi);
        for (of, value) in [
            ("value_max", region.value_max),
            ("floor", region.floor),
            ("overlap", BLEND),
            ("same", SAME),
        ] {
            text += &c.number(of, value);
        }
        text += "/* Coordinates t = frame (x - origin). */\n";
        text += &c.list("origin", &pieces.frame.origin);
        text += &c.table("frame", &pieces.frame.matrix, n);
        text + &self.shear(pieces)
            + &self.tree(pieces)
            + &self.cells(pieces)
            + &self.polynomials(pieces)
    }

    /// The tree of cells.
    fn tree(&self, pieces: &Pieces) -> String {
        let (c, n) = (&self.c, self.variables());
        let mut text = format!(
            "/* Tree: axis along which a node is split ({n}: it is a cell, whose number is in `below`), and where; how far the\n   \
             cells above and below reach. */\n"
        );
        let node = |of: &dyn Fn(&Node) -> usize| {
            pieces
                .nodes
                .iter()
                .map(of)
                .collect::<Vec<usize>>()
                .into_iter()
        };
        text += &c.integers(
            "axis",
            node(&|node| match node {
                Node::Cell(_) => n,
                Node::Split { axis, .. } => *axis,
            }),
        );
        text += &c.integers(
            "below",
            node(&|node| match node {
                Node::Cell(cell) => *cell,
                Node::Split { below, .. } => *below,
            }),
        );
        text += &c.integers(
            "above",
            node(&|node| match node {
                Node::Cell(_) => 0,
                Node::Split { above, .. } => *above,
            }),
        );
        let split = |node: &Node| match node {
            Node::Cell(_) => [0.0; 3],
            Node::Split { at, reach, .. } => [*at, reach[0], reach[1]],
        };
        let split: Vec<[f64; 3]> = pieces.nodes.iter().map(split).collect();
        text += &c.list("split", &split.iter().map(|s| s[0]).collect::<Vec<f64>>());
        let reach: Vec<f64> = split.iter().flat_map(|s| [s[1], s[2]]).collect();
        text + &c.table("reach", &reach, 2)
    }

    /// The corners of cells, and which pieces are theirs.
    fn cells(&self, pieces: &Pieces) -> String {
        let (c, n) = (&self.c, self.variables());
        let mut text = "/* Cells, and the first piece of each. */\n".to_owned();
        let cells = |side: &dyn Fn(usize) -> Vec<f64>| {
            (0..pieces.cells.len()).flat_map(side).collect::<Vec<f64>>()
        };
        text += &c.table("cell_lower", &cells(&|k| pieces.cells[k].lo.clone()), n);
        text += &c.table("cell_upper", &cells(&|k| pieces.cells[k].hi.clone()), n);
        let ends = pieces.cells.iter().map(|cell| cell.pieces.end);
        text + &c.integers(
            "pieces",
            [0].into_iter().chain(ends).collect::<Vec<_>>().into_iter(),
        )
    }

    /// The shear of the coordinates, and derivatives through it.
    fn shear(&self, pieces: &Pieces) -> String {
        let (c, Syntax { name, real, .. }) = (&self.c, &self.c);
        let Some(bend) = &pieces.frame.bend else {
            return format!(
                "static inline void {name}_shear({real} *t, {real} *slope) {{ (void)t; (void)slope; }}\n\
                 static inline void {name}_straighten(const {real} *slope, {real} *q) {{ (void)slope; (void)q; }}\n"
            );
        };
        let (axis, whole) = (bend.axis, bend.whole(&pieces.terms));
        let mut text = format!(
            "/* But t[{axis}] plus this polynomial of the others, from `lowest` on, in `width`s. */\n"
        );
        text += &c.number("lowest", bend.lowest);
        text += &c.number("width", bend.width);
        text += &c.list("phi", &whole);
        text + &format!(
            "static inline {real} {name}_sum(const {real} *c, int count, const {real} *y, {real} *slope);\n\
             static inline void {name}_shear({real} *t, {real} *slope)\n{{\n    \
             t[{axis}] = (t[{axis}] + {name}_sum({name}_phi, {count}, t, slope) - {name}_lowest) / {name}_width;\n}}\n\
             static inline void {name}_straighten(const {real} *slope, {real} *q)\n{{\n    int i;\n    \
             q[{axis}] /= {name}_width;\n    \
             for (i = 0; i < {name}_states; i++)\n        if (i != {axis}) q[i] += q[{axis}] * slope[i];\n}}\n",
            count = whole.len()
        )
    }

    fn polynomials(&self, pieces: &Pieces) -> String {
        let (c, n) = (&self.c, self.variables());
        let all = |of: &dyn Fn(usize) -> Vec<f64>| {
            (0..pieces.pieces.len()).flat_map(of).collect::<Vec<f64>>()
        };
        let mut text =
            "/* Pieces: polynomials of (t - center) / half; what of V they are of; bounds of their errors. */\n"
                .to_owned();
        text += &c.table("center", &all(&|k| pieces.pieces[k].center.clone()), n);
        text += &c.table("half", &all(&|k| pieces.pieces[k].half.clone()), n);
        text += &c.integers("shape", pieces.pieces.iter().map(|p| p.shape as usize));
        text += &c.list("bound", &all(&|k| vec![pieces.pieces[k].bound]));
        let first = pieces.pieces.iter().scan(0, |next, p| {
            *next += p.coefficients.len();
            Some(*next)
        });
        text += &c.integers(
            "first",
            [0].into_iter().chain(first).collect::<Vec<_>>().into_iter(),
        );
        text += &c.list(
            "coefficients",
            &all(&|k| pieces.pieces[k].coefficients.clone()),
        );
        text + &self.supports(pieces)
    }

    /// Where points of a piece are missing on one side.
    fn supports(&self, pieces: &Pieces) -> String {
        let Syntax { name, real, .. } = self.c;
        let c = &self.c;
        let ways = pieces.directions.len();
        let mut rows: Vec<f64> = Vec::new();
        let (terms, mut margins) = (pieces.margin_terms(), Vec::new());
        let mut place = Vec::new();
        for piece in &pieces.pieces {
            place.push(if piece.support.is_empty() {
                0
            } else {
                1 + rows.len() / (2 * ways)
            });
            rows.extend(piece.support.iter().flatten());
            if !piece.support.is_empty() {
                margins.extend(piece.margins(terms));
            }
        }
        let mut text = String::new();
        let mut inside = String::new();
        if !rows.is_empty() {
            text += "/* Extents of the points fitted to, where there are none on one side of the cell: the row of a piece (0: none),\n   \
                     and lowest and highest along each direction. */\n";
            text += &c.integers("support_of", place.into_iter());
            text += &c.table("direction", &pieces.directions.concat(), self.variables());
            text += &c.table("support", &rows, 2 * ways);
            inside = format!(
                "    int i, j;\n    if ({name}_support_of[k] == 0) return 1;\n    for (j = 0; j < {ways}; j++) {{\n        \
                 const {real} *extent = {name}_support[{name}_support_of[k] - 1] + 2 * j;\n        {real} along = 0;\n        \
                 for (i = 0; i < {name}_states; i++) along += {name}_direction[j][i] * y[i];\n        \
                 if (!(along >= extent[0] && along <= extent[1])) return 0;\n    }}\n"
            );
        }
        if terms > 0 {
            text += "/* Polynomials of the least margin of the guards along trajectories: nothing is said where they are negative. */\n";
            text += &c.table("margin", &margins, terms);
            inside += &format!(
                "    {{\n        const {real} *c = {name}_margin[{name}_support_of[k] - 1];\n        \
                 {real} margin = c[0];\n        int square = {name}_states;\n        \
                 for (i = 0; i < {name}_states; i++) {{\n            {real} slope = c[1 + i];\n            \
                 for (j = i; j < {name}_states; j++) slope += c[++square] * y[j];\n            \
                 margin += y[i] * slope;\n        }}\n        if (!(margin >= 0)) return 0;\n    }}\n"
            );
        }
        let unused = if inside.is_empty() {
            "    (void)k;\n    (void)y;\n"
        } else {
            ""
        };
        text + &format!(
            "\n/* Whether y lies among the points of a piece. */\nstatic inline int {name}_supported(int k, const {real} *y)\n{{\n\
             {inside}{unused}    return 1;\n}}\n"
        )
    }

    fn functions(&self) -> String {
        let Syntax {
            name,
            real,
            function,
        } = self.c;
        let filled = |template: &str| -> String {
            let parts = template.split("NAME").map(|part| {
                let part = part.replace("REAL", real);
                part.replace("FUN(", &format!("{function}("))
            });
            parts.collect::<Vec<String>>().join(name)
        };
        let mut text = filled(SUM);
        if self.known.local().is_some() {
            text += &filled(LOCAL);
        }
        let guards = match self.known {
            Known::Map(..) => self.system.guards_of_state(),
            Known::Local(_) => Vec::new(),
        };
        if self.known.pieces().is_some() {
            if !guards.is_empty() {
                text += &self.allowed(&guards);
            }
            text += &self.solves();
            text += &format!(
                "\n/* State i moved into the region by whole periods, where it has one. */\n\
                 static inline {real} {name}_turned(int i, {real} x)\n{{\n    \
                 if ({name}_period[i] > 0 && (x < {name}_lower[i] || x > {name}_upper[i]))\n        \
                 x += {name}_period[i] * {function}(ceil)(({name}_lower[i] - x) / {name}_period[i]);\n    return x;\n}}\n"
            );
            text += &filled(PIECES);
        }
        text += &format!(
            "\n/* V, p and the deviation s from the reference that they are of. */\n\
             static inline int {name}_at(const {real} *x, {real} *V, {real} *p, {real} *s)\n{{\n"
        );
        if !guards.is_empty() {
            text += &format!("    if (!{name}_allowed(x)) return 0;\n");
        }
        if self.known.local().is_some() {
            let near = format!("{name}_near(s, V, p)");
            text += &format!(
                "    int i;\n    for (i = 0; i < {name}_states; i++) {{\n        s[i] = x[i] - {name}_reference[i];\n        \
                 if ({name}_period[i] > 0) s[i] -= {name}_period[i] * {function}(round)(s[i] / {name}_period[i]);\n    }}\n"
            );
            text += &match self.known {
                Known::Map(..) => format!("    if ({near}) return 1;\n"),
                Known::Local(_) => format!("    return {near};\n"),
            };
        }
        if self.known.pieces().is_some() {
            text += &format!("    return {name}_chart(x, V, p, s);\n");
        }
        text + "}\n\n" + &self.entries()
    }

    /// What a controller calls: V with p, and u.
    fn entries(&self) -> String {
        let (n, m) = (self.model.states.len(), self.model.controls.len());
        let Syntax { name, real, .. } = self.c;
        let v = self.variables();
        // Time, where it is an axis, follows the states.
        let (time, place, at) = match self.is_timed() {
            true => {
                let all = (0..n).map(|i| format!("x[{i}]")).chain(["t".to_owned()]);
                let place = format!(
                    "    const {real} xt[{v}] = {{ {} }};\n",
                    all.collect::<Vec<_>>().join(", ")
                );
                (format!(", {real} t"), place, "xt")
            }
            false => (String::new(), String::new(), "x"),
        };
        let mut text = format!(
            "static inline int {name}_value(const {real} x[{n}]{time}, {real} *V, {real} p[{v}])\n{{\n    {real} s[{v}];\n{place}    \
             return {name}_at({at}, V, p, s);\n}}\n\n\
             static inline int {name}_control(const {real} x[{n}]{time}, {real} u[{m}])\n{{\n    {real} V, p[{v}], s[{v}];\n{place}    \
             const int known = {name}_at({at}, &V, p, s);\n"
        );
        if self.known.pieces().is_some() {
            text += "    if (!known) return 0;\n";
        }
        text += &self.straight(&self.system.observer.control, "u");
        text + "    return known;\n}\n"
    }

    fn straight(&self, roots: &[crate::expr::Id], target: &str) -> String {
        let (s, p) = self.system.inputs.split_at(self.system.states);
        self.c
            .straight(&self.system.graph, &[(s, "s"), (p, "p")], roots, target)
    }

    /// Whether no guard excludes a state by more than rounding.
    fn allowed(&self, guards: &[Id]) -> String {
        let Syntax { name, real, .. } = self.c;
        let (n, count) = (self.system.states, guards.len());
        let region: Vec<[f64; 2]> = (self.model.region.iter().zip(&self.system.reference))
            .map(|([lo, hi], r)| [lo - r, hi - r])
            .collect();
        let sizes = self.system.guard_sizes(&region);
        format!(
            "\n{}/* Whether no guard excludes x by more than rounding. */\n\
             static inline int {name}_allowed(const {real} *x)\n{{\n    {real} s[{n}], g[{count}];\n    int i;\n    \
             for (i = 0; i < {n}; i++) s[i] = x[i] - {name}_reference[i];\n\
             {}    for (i = 0; i < {count}; i++)\n        \
             if (!(g[i] >= -{name}_guard_size[i] * ({real})(sizeof({real}) < sizeof(double) ? 1e-6 : {GUARD_ROUNDING:e}))) return 0;\n    \
             return 1;\n}}\n",
            self.c.list("guard_size", &sizes),
            self.straight(guards, "g")
        )
    }

    /// Of a game whether p solves H = 0, as the value map asks; else always.
    fn solves(&self) -> String {
        let Syntax {
            name,
            real,
            function,
        } = self.c;
        let mut text = format!(
            "\nstatic inline int {name}_solves(const {real} *s, const {real} *p)\n{{\n    (void)s;\n    (void)p;\n"
        );
        if self.model.is_game() {
            let n = self.system.states;
            let rate = &self.system.rate;
            let roots = [&[self.system.observer.hamiltonian, rate[2 * n]], &rate[..n]].concat();
            text += &format!("    {real} h[{}], size;\n    int i;\n", n + 2);
            text += &self.straight(&roots, "h");
            text += &format!(
                "    size = {function}(fabs)(h[1]);\n    for (i = 0; i < {n}; i++) size += {function}(fabs)(h[2 + i] * p[i]);\n    \
                 if (!({function}(fabs)(h[0]) <= ({real}){} * size)) return 0;\n",
                real_text(ISAACS_RESIDUAL)
            );
        }
        text + "    return 1;\n}\n"
    }
}

/// Most nodes from one down to a cell, without itself.
fn depth(nodes: &[Node], node: usize) -> usize {
    match &nodes[node] {
        Node::Cell(_) => 0,
        Node::Split { below, above, .. } => 1 + depth(nodes, *below).max(depth(nodes, *above)),
    }
}
