//! Lowering of expressions to instructions.

use super::{Instr, Primitive, Program, Value};
use crate::expr::{Fun, Graph, Id, Node, Op};
use rustc_hash::FxHashMap;

#[derive(PartialEq, Eq, Hash)]
struct Key(u8, u64, Value, Value);

/// Emits instructions, each distinct one once.
struct Builder {
    code: Vec<Instr>,
    known: FxHashMap<Key, Value>,
}

impl Builder {
    fn emit(&mut self, instr: Instr) -> Value {
        let key = match instr {
            Instr::Input(i) => Key(0, u64::from(i), 0, 0),
            Instr::Const(c) => Key(1, c.to_bits(), 0, 0),
            Instr::Add(a, b) => Key(2, 0, a.min(b), a.max(b)),
            Instr::Sub(a, b) => Key(3, 0, a, b),
            Instr::Mul(a, b) => Key(4, 0, a.min(b), a.max(b)),
            Instr::Div(a, b) => Key(5, 0, a, b),
            Instr::Neg(a) => Key(6, 0, a, 0),
            Instr::Min(a, b) => Key(7, 0, a, b),
            Instr::Max(a, b) => Key(8, 0, a, b),
            Instr::Call(f, a) => Key(9, f as u64, a, 0),
            // Fused forms come from a later pass and are never looked up.
            Instr::MulAdd(..) | Instr::MulSub(..) | Instr::NegMulAdd(..) => {
                Key(10, self.code.len() as u64, 0, 0)
            }
        };
        let next = self.code.len() as Value;
        let value = *self.known.entry(key).or_insert(next);
        if value == next {
            self.code.push(instr);
        }
        value
    }

    fn constant(&mut self, c: f64) -> Value {
        self.emit(Instr::Const(c))
    }

    fn call(&mut self, f: Primitive, a: Value) -> Value {
        if matches!(f, Primitive::Sin | Primitive::Cos) {
            // The pair side by side; the unneeded one is removed later.
            let s = self.emit(Instr::Call(Primitive::Sin, a));
            let c = self.emit(Instr::Call(Primitive::Cos, a));
            return if f == Primitive::Sin { s } else { c };
        }
        self.emit(Instr::Call(f, a))
    }

    fn unary(&mut self, f: Fun, a: Value) -> Value {
        match f {
            Fun::Sin => self.call(Primitive::Sin, a),
            Fun::Cos => self.call(Primitive::Cos, a),
            Fun::Exp => self.call(Primitive::Exp, a),
            Fun::Expm1 => self.call(Primitive::Expm1, a),
            Fun::Log => self.call(Primitive::Log, a),
            Fun::Log1p => self.call(Primitive::Log1p, a),
            Fun::Atan => self.call(Primitive::Atan, a),
            Fun::Sqrt => self.call(Primitive::Sqrt, a),
            Fun::Abs => self.call(Primitive::Abs, a),
            Fun::Sign => self.call(Primitive::Sign, a),
            Fun::Step => self.call(Primitive::Step, a),
            Fun::Tan => {
                let (s, c) = (self.call(Primitive::Sin, a), self.call(Primitive::Cos, a));
                self.emit(Instr::Div(s, c))
            }
            Fun::Asin => self.arcsine(a),
            Fun::Acos => {
                // 2 atan(sqrt((1 - a) / (1 + a))): no cancellation near a = 1.
                let one = self.constant(1.0);
                let (n, d) = (self.emit(Instr::Sub(one, a)), self.emit(Instr::Add(one, a)));
                let q = self.emit(Instr::Div(n, d));
                let root = self.call(Primitive::Sqrt, q);
                let angle = self.call(Primitive::Atan, root);
                self.emit(Instr::Add(angle, angle))
            }
            Fun::Sinh => {
                // With e = expm1(|a|): (e + e/(e + 1)) / 2, given the sign of a.
                let size = self.call(Primitive::Abs, a);
                let e = self.call(Primitive::Expm1, size);
                let one = self.constant(1.0);
                let e1 = self.emit(Instr::Add(e, one));
                let q = self.emit(Instr::Div(e, e1));
                let sum = self.emit(Instr::Add(e, q));
                let half = self.constant(0.5);
                let value = self.emit(Instr::Mul(half, sum));
                let sign = self.call(Primitive::Sign, a);
                self.emit(Instr::Mul(sign, value))
            }
            Fun::Cosh => {
                let e = self.call(Primitive::Exp, a);
                let one = self.constant(1.0);
                let q = self.emit(Instr::Div(one, e));
                let sum = self.emit(Instr::Add(e, q));
                let half = self.constant(0.5);
                self.emit(Instr::Mul(half, sum))
            }
            Fun::Tanh => {
                // 1 - 2/(exp(2|a|) + 1) in expm1 form, given the sign: e/(e + 2) saturates without
                // overflow to NaN because the argument is capped.
                let size = self.call(Primitive::Abs, a);
                let two_a = self.emit(Instr::Add(size, size));
                let cap = self.constant(80.0);
                let capped = self.emit(Instr::Min(two_a, cap));
                let e = self.call(Primitive::Expm1, capped);
                let two = self.constant(2.0);
                let e2 = self.emit(Instr::Add(e, two));
                let q = self.emit(Instr::Div(e, e2));
                let sign = self.call(Primitive::Sign, a);
                self.emit(Instr::Mul(sign, q))
            }
        }
    }

    fn arcsine(&mut self, a: Value) -> Value {
        // atan(a / sqrt((1 - a)(1 + a))); at |a| = 1 the quotient is infinite and atan gives pi/2.
        let one = self.constant(1.0);
        let (lo, hi) = (self.emit(Instr::Sub(one, a)), self.emit(Instr::Add(one, a)));
        let square = self.emit(Instr::Mul(lo, hi));
        let root = self.call(Primitive::Sqrt, square);
        let q = self.emit(Instr::Div(a, root));
        self.call(Primitive::Atan, q)
    }

    fn power(&mut self, a: Value, n: u32) -> Value {
        match n {
            0 => self.constant(1.0),
            1 => a,
            _ => {
                let half = self.power(a, n / 2);
                let square = self.emit(Instr::Mul(half, half));
                if n % 2 == 1 {
                    self.emit(Instr::Mul(square, a))
                } else {
                    square
                }
            }
        }
    }
}

pub(super) fn lower(graph: &Graph, inputs: &[Id], outputs: &[Id]) -> Program {
    let mut b = Builder {
        code: Vec::new(),
        known: FxHashMap::default(),
    };
    let mut value: FxHashMap<Id, Value> = FxHashMap::default();
    for (i, symbol) in inputs.iter().enumerate() {
        value.insert(*symbol, b.emit(Instr::Input(i as u32)));
    }
    for id in graph.reachable(outputs) {
        if value.contains_key(&id) {
            continue;
        }
        let v = match graph.node(id) {
            Node::Const(bits) => b.constant(f64::from_bits(bits)),
            Node::Symbol(_) => panic!("`{}` is not an input of the program", graph.show(id)),
            Node::Neg(a) => b.emit(Instr::Neg(value[&a])),
            Node::Unary(f, a) => b.unary(f, value[&a]),
            Node::Powi(a, n) => {
                let p = b.power(value[&a], n.unsigned_abs());
                if n < 0 {
                    let one = b.constant(1.0);
                    b.emit(Instr::Div(one, p))
                } else {
                    p
                }
            }
            Node::Binary(op, x, y) => {
                let (x, y) = (value[&x], value[&y]);
                match op {
                    Op::Add => b.emit(Instr::Add(x, y)),
                    Op::Sub => b.emit(Instr::Sub(x, y)),
                    Op::Mul => b.emit(Instr::Mul(x, y)),
                    Op::Div => b.emit(Instr::Div(x, y)),
                    Op::Min => b.emit(Instr::Min(x, y)),
                    Op::Max => b.emit(Instr::Max(x, y)),
                    Op::Pow => {
                        let log = b.call(Primitive::Log, x);
                        let scaled = b.emit(Instr::Mul(y, log));
                        b.call(Primitive::Exp, scaled)
                    }
                }
            }
        };
        value.insert(id, v);
    }
    let outputs = outputs.iter().map(|o| value[o]).collect();
    let fused = fuse(Program {
        inputs: inputs.len(),
        code: b.code,
        outputs,
    });
    compact(fused)
}

/// Joins a product that is used once with the sum it goes into.
fn fuse(mut program: Program) -> Program {
    let mut uses = vec![0u32; program.code.len()];
    let reads = program
        .code
        .iter()
        .flat_map(Instr::reads)
        .chain(program.outputs.iter().copied());
    reads.for_each(|v| uses[v as usize] += 1);
    let product = |code: &[Instr], v: Value| match code[v as usize] {
        Instr::Mul(a, b) if uses[v as usize] == 1 => Some((a, b)),
        _ => None,
    };
    for i in 0..program.code.len() {
        let fused = match program.code[i] {
            Instr::Add(x, y) => product(&program.code, y)
                .map(|(a, b)| Instr::MulAdd(a, b, x))
                .or_else(|| product(&program.code, x).map(|(a, b)| Instr::MulAdd(a, b, y))),
            Instr::Sub(x, y) => product(&program.code, y)
                .map(|(a, b)| Instr::NegMulAdd(a, b, x))
                .or_else(|| product(&program.code, x).map(|(a, b)| Instr::MulSub(a, b, y))),
            _ => None,
        };
        if let Some(instr) = fused {
            program.code[i] = instr;
        }
    }
    program
}

/// Removes what no output needs; inputs stay in front so that their values are their indices.
fn compact(program: Program) -> Program {
    let mut needed = vec![false; program.code.len()];
    program
        .outputs
        .iter()
        .for_each(|o| needed[*o as usize] = true);
    needed[..program.inputs].fill(true);
    for i in (0..program.code.len()).rev() {
        if needed[i] {
            program.code[i]
                .reads()
                .for_each(|v| needed[v as usize] = true);
        }
    }
    let mut new = vec![0; program.code.len()];
    let mut code = Vec::new();
    for (i, instr) in program.code.iter().enumerate().filter(|(i, _)| needed[*i]) {
        new[i] = code.len() as Value;
        code.push(instr.renumbered(|v| new[v as usize]));
    }
    Program {
        inputs: program.inputs,
        code,
        outputs: program.outputs.iter().map(|o| new[*o as usize]).collect(),
    }
}
