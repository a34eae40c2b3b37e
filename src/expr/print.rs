//! Printing expressions as a person would write them, in the scenario file's own syntax.

use super::{Graph, Id, Node, Op};

// Binding strengths: sum < product < unary minus < power < atom.
const SUM: u8 = 1;
const PRODUCT: u8 = 2;
const UNARY: u8 = 3;
const POWER: u8 = 4;
const ATOM: u8 = 5;

/// Text and binding strength of a printed expression.
type Shown = (String, u8);

/// Expressions as texts, with names for the parts that they share: see [`Graph::show_all`].
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ShownTogether {
    /// Name and text; a text has names of earlier ones.
    pub shared: Vec<(String, String)>,
    /// One for each expression.
    pub shown: Vec<String>,
}

/// Texts that are longer in all than this (about so many characters) name what they share.
const LONG: usize = 20_000;
/// What is no longer than this needs no name.
const SHORT: usize = 12;

fn wrapped((text, strength): Shown, least: u8) -> String {
    if strength < least {
        format!("({text})")
    } else {
        text
    }
}

/// `left` continued, in place: sums of many thousand terms are printed in linear time.
fn joined(mut left: String, sign: &str, right: &str) -> String {
    left.push_str(sign);
    left.push_str(right);
    left
}

impl Graph {
    /// The expression as text that parses back to an equal value.
    pub fn show(&self, id: Id) -> String {
        // A stack of its own: sums may be deeper than the thread's stack allows.
        let mut pending = vec![(id, false)];
        let mut done: Vec<Shown> = Vec::new();
        while let Some((id, arguments_done)) = pending.pop() {
            let arguments: Vec<Id> = self.arguments(id).collect();
            if arguments_done {
                let shown = done.split_off(done.len() - arguments.len());
                done.push(self.show_node(id, shown));
            } else {
                pending.push((id, true));
                pending.extend(arguments.iter().rev().map(|a| (*a, false)));
            }
        }
        done.pop().unwrap_or_default().0
    }

    /// Expressions as texts together. Where these would be long, parts that are used more than once
    /// have a name and stand only once: the texts grow with the graph, not with the number of ways
    /// through it.
    ///
    /// `taken`: a text whose words are no such names.
    pub fn show_all(&self, roots: &[Id], taken: &str) -> ShownTogether {
        let reachable = self.reachable(roots);
        let mut users = vec![0u32; self.len()];
        let mut length = vec![0usize; self.len()];
        for &id in &reachable {
            let mut all = 12usize;
            for a in self.arguments(id) {
                users[a.0 as usize] += 1;
                all = all.saturating_add(length[a.0 as usize]);
            }
            length[id.0 as usize] = all;
        }
        let whole = (roots.iter()).fold(0usize, |n, r| n.saturating_add(length[r.0 as usize]));
        if whole <= LONG {
            return ShownTogether {
                shared: Vec::new(),
                shown: roots.iter().map(|r| self.show(*r)).collect(),
            };
        }

        for root in roots {
            users[root.0 as usize] += 1;
        }
        let prefix = self.free_prefix(taken);
        let mut shared: Vec<(String, String)> = Vec::new();
        let mut texts: Vec<Shown> = vec![Shown::default(); self.len()];
        for &id in &reachable {
            let several = |a: Id| users[a.0 as usize] > 1;
            let arguments: Vec<Shown> = (self.arguments(id))
                .map(|a| match several(a) {
                    true => texts[a.0 as usize].clone(),
                    // Its only user: a chain of many thousand terms is not copied at each link.
                    false => std::mem::take(&mut texts[a.0 as usize]),
                })
                .collect();
            let mut shown = self.show_node(id, arguments);
            if several(id) && shown.0.len() > SHORT {
                let name = format!("{prefix}{}", shared.len() + 1);
                shared.push((name.clone(), shown.0));
                shown = (name, ATOM);
            }
            texts[id.0 as usize] = shown;
        }
        let shown = roots.iter().map(|r| texts[r.0 as usize].0.clone());
        ShownTogether {
            shown: shown.collect(),
            shared,
        }
    }

    /// What names may begin with that are followed by a number and are no symbol's, and no word of
    /// a text.
    fn free_prefix(&self, text: &str) -> String {
        let numbered = |word: &str, prefix: &str| {
            let rest = word.strip_prefix(prefix);
            rest.is_some_and(|rest| rest.chars().all(|c| c.is_ascii_digit()))
        };
        let taken = |prefix: &str| {
            let words = text.split(|c: char| !c.is_alphanumeric() && c != '_');
            let symbols = self.symbols().iter().map(|symbol| symbol.name.as_str());
            words.chain(symbols).any(|word| numbered(word, prefix))
        };
        let mut prefix = "c".to_owned();
        while taken(&prefix) {
            prefix.push('_');
        }
        prefix
    }

    /// One node, given its printed arguments.
    fn show_node(&self, id: Id, arguments: Vec<Shown>) -> Shown {
        let mut arguments = arguments.into_iter();
        let mut next = || arguments.next().unwrap_or_default();
        match self.node(id) {
            Node::Const(bits) => {
                let v = f64::from_bits(bits);
                let text = if v != 0.0 && (v.abs() < 1e-4 || v.abs() >= 1e16) {
                    format!("{v:e}")
                } else {
                    format!("{v}")
                };
                (text, if v < 0.0 { UNARY } else { ATOM })
            }
            Node::Symbol(i) => (self.symbols()[i as usize].name.clone(), ATOM),
            Node::Neg(_) => (format!("-{}", wrapped(next(), PRODUCT)), UNARY),
            Node::Unary(f, _) => (format!("{}({})", f.name(), next().0), ATOM),
            Node::Powi(_, n) => (format!("{}^{n}", wrapped(next(), ATOM)), POWER),
            Node::Binary(op, a, b) => self.show_binary(op, (a, next()), (b, next())),
        }
    }

    fn show_binary(&self, op: Op, (a, left): (Id, Shown), (b, right): (Id, Shown)) -> Shown {
        match op {
            Op::Add => {
                // A leading minus reads better in second place.
                let (first, second) = match self.as_constant(a) {
                    Some(_) => (right, left),
                    None => (left, right),
                };
                let ((left, strength), right) = (first, wrapped(second, SUM));
                if let Some(rest) = right.strip_prefix('-') {
                    (joined(left, " - ", rest), SUM)
                } else if let Some(rest) = left.strip_prefix('-').filter(|_| strength > SUM) {
                    (joined(right, " - ", rest), SUM)
                } else {
                    (joined(left, " + ", &right), SUM)
                }
            }
            Op::Sub => {
                let (left, right) = (wrapped(left, SUM), wrapped(right, PRODUCT));
                match right.strip_prefix('-') {
                    Some(rest) => (joined(left, " + ", rest), SUM),
                    None => (joined(left, " - ", &right), SUM),
                }
            }
            Op::Mul => {
                let left = match self.as_constant(a) {
                    Some(_) => left.0,
                    None => wrapped(left, PRODUCT),
                };
                let right = match self.node(b) {
                    Node::Binary(Op::Div, ..) => wrapped(right, UNARY),
                    _ => wrapped(right, PRODUCT),
                };
                (joined(left, "*", &right), PRODUCT)
            }
            Op::Div => (
                format!("{}/{}", wrapped(left, PRODUCT), wrapped(right, UNARY)),
                PRODUCT,
            ),
            Op::Pow => (
                format!("{}^{}", wrapped(left, ATOM), wrapped(right, ATOM)),
                POWER,
            ),
            Op::Min => (format!("min({}, {})", left.0, right.0), ATOM),
            Op::Max => (format!("max({}, {})", left.0, right.0), ATOM),
        }
    }
}
