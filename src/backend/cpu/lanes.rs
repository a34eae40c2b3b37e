//! Running a register program on a block of lanes.
//!
//! A register holds one value for each of `W` trajectories; an instruction is a loop over the lanes which the compiler
//! turns into SIMD. `W` is several SIMD vectors, so decoding an instruction is paid for by many operations.

use super::arithmetic::Arithmetic;
use super::real::Real;
use crate::program::{Allocation, Instr, Primitive, Program};

/// One register: a value for each lane.
#[repr(align(64))]
#[derive(Clone, Copy, Debug)]
pub struct Lanes<T, const W: usize>(pub [T; W]);

impl<T: Real, const W: usize> Lanes<T, W> {
    pub fn splat(x: T) -> Self {
        Self([x; W])
    }
}

#[derive(Clone, Copy, Debug)]
enum Code {
    Add,
    Sub,
    Mul,
    Div,
    Neg,
    MulAdd,
    MulSub,
    NegMulAdd,
    Min,
    Max,
    Sin,
    Cos,
    /// Sine into `to`, cosine into `c`.
    SinCos,
    Exp,
    Expm1,
    Log,
    Log1p,
    Atan,
    Sqrt,
    Abs,
    Sign,
    Step,
}

#[derive(Clone, Copy, Debug)]
struct Op {
    code: Code,
    to: u16,
    a: u16,
    b: u16,
    c: u16,
}

/// A program with its registers assigned.
#[derive(Clone, Debug)]
pub struct LaneProgram {
    ops: Vec<Op>,
    constants: Vec<f64>,
    first_input: usize,
    outputs: Vec<u16>,
    registers: usize,
}

impl LaneProgram {
    pub fn new(program: &Program) -> Self {
        let allocation = Allocation::new(program);
        let slot = |v: u32| allocation.slot[v as usize];
        let mut ops: Vec<Op> = Vec::new();
        for (i, instr) in program.code.iter().enumerate() {
            let to = allocation.slot[i];
            let op = |code, a, b, c| Op {
                code,
                to,
                a: slot(a),
                b: slot(b),
                c: slot(c),
            };
            let next = match *instr {
                Instr::Input(_) | Instr::Const(_) => continue,
                Instr::Add(a, b) => op(Code::Add, a, b, a),
                Instr::Sub(a, b) => op(Code::Sub, a, b, a),
                Instr::Mul(a, b) => op(Code::Mul, a, b, a),
                Instr::Div(a, b) => op(Code::Div, a, b, a),
                Instr::Min(a, b) => op(Code::Min, a, b, a),
                Instr::Max(a, b) => op(Code::Max, a, b, a),
                Instr::Neg(a) => op(Code::Neg, a, a, a),
                Instr::MulAdd(a, b, c) => op(Code::MulAdd, a, b, c),
                Instr::MulSub(a, b, c) => op(Code::MulSub, a, b, c),
                Instr::NegMulAdd(a, b, c) => op(Code::NegMulAdd, a, b, c),
                Instr::Call(Primitive::Cos, a) => match ops.last_mut() {
                    Some(last) if matches!(last.code, Code::Sin) && last.a == slot(a) => {
                        last.code = Code::SinCos;
                        last.c = to;
                        continue;
                    }
                    _ => op(Code::Cos, a, a, a),
                },
                Instr::Call(f, a) => op(primitive(f), a, a, a),
            };
            ops.push(next);
        }
        let outputs: Vec<u16> = program.outputs.iter().map(|o| slot(*o)).collect();
        let this = Self {
            ops,
            constants: allocation.constants,
            first_input: usize::from(allocation.first_input),
            outputs,
            registers: allocation.registers,
        };
        this.check();
        this
    }

    /// What [`LaneProgram::run`] relies on: indices in range, no instruction writing a register that it reads.
    fn check(&self) {
        for op in &self.ops {
            for r in [op.to, op.a, op.b, op.c] {
                assert!(usize::from(r) < self.registers, "register out of range");
            }
            let pair = matches!(op.code, Code::SinCos);
            assert!(
                op.to != op.a && op.to != op.b && op.to != op.c,
                "an instruction overwrites its operand"
            );
            assert!(!pair || op.c != op.a, "an instruction overwrites its operand");
        }
        assert!(
            self.outputs.iter().all(|o| usize::from(*o) < self.registers),
            "output register out of range"
        );
    }

    /// A register file with the constants in place.
    pub fn registers<T: Real, const W: usize>(&self) -> Vec<Lanes<T, W>> {
        let mut file = vec![Lanes::splat(T::of(0.0)); self.registers];
        for (r, c) in file.iter_mut().zip(&self.constants) {
            *r = Lanes::splat(T::of(*c));
        }
        file
    }

    /// The input registers.
    #[inline(always)]
    pub fn inputs<'a, T: Real, const W: usize>(
        &self,
        file: &'a mut [Lanes<T, W>],
        count: usize,
    ) -> &'a mut [Lanes<T, W>] {
        &mut file[self.first_input..self.first_input + count]
    }

    /// Register of an output.
    #[inline(always)]
    pub fn output<'a, T, const W: usize>(&self, file: &'a [Lanes<T, W>], k: usize) -> &'a Lanes<T, W> {
        &file[usize::from(self.outputs[k])]
    }

    pub fn outputs(&self) -> usize {
        self.outputs.len()
    }

    /// Executes the program on the register file made by [`LaneProgram::registers`].
    #[inline(always)]
    pub fn run<T: Real, const W: usize, const FMA: bool>(&self, file: &mut [Lanes<T, W>]) {
        assert!(file.len() >= self.registers, "register file of another program");
        let base = file.as_mut_ptr();
        for op in &self.ops {
            // SAFETY: `check` has made sure that all indices are below `registers` (asserted to be within `file`) and
            // that the written registers are none of those read, so the references do not alias.
            let (to, a, b, c) = unsafe {
                (
                    &mut (*base.add(usize::from(op.to))).0,
                    &(*base.add(usize::from(op.a))).0,
                    &(*base.add(usize::from(op.b))).0,
                    base.add(usize::from(op.c)),
                )
            };
            match op.code {
                Code::Add => map2(to, a, b, |x, y| x + y),
                Code::Sub => map2(to, a, b, |x, y| x - y),
                Code::Mul => map2(to, a, b, |x, y| x * y),
                Code::Div => map2(to, a, b, |x, y| x / y),
                Code::Min => map2(to, a, b, |x, y| T::With::<FMA>::default().least(x, y)),
                Code::Max => map2(to, a, b, |x, y| T::With::<FMA>::default().greatest(x, y)),
                Code::Neg => map1(to, a, |x| -x),
                // SAFETY: as above; `c` is only read.
                Code::MulAdd => map3(to, a, b, unsafe { &(*c).0 }, |x, y, z| x.mul_add::<FMA>(y, z)),
                Code::MulSub => map3(to, a, b, unsafe { &(*c).0 }, |x, y, z| x.mul_add::<FMA>(y, -z)),
                Code::NegMulAdd => map3(to, a, b, unsafe { &(*c).0 }, |x, y, z| (-x).mul_add::<FMA>(y, z)),
                Code::SinCos => {
                    // SAFETY: as above; `c` is neither `to` nor `a` here.
                    let cosine = unsafe { &mut (*c).0 };
                    for i in 0..W {
                        (to[i], cosine[i]) = T::With::<FMA>::default().sin_cos(a[i]);
                    }
                }
                Code::Sin => map1(to, a, |x| T::With::<FMA>::default().sin_cos(x).0),
                Code::Cos => map1(to, a, |x| T::With::<FMA>::default().sin_cos(x).1),
                Code::Exp => map1(to, a, |x| T::With::<FMA>::default().exp(x)),
                Code::Expm1 => map1(to, a, |x| T::With::<FMA>::default().expm1(x)),
                Code::Log => map1(to, a, |x| T::With::<FMA>::default().log(x)),
                Code::Log1p => map1(to, a, |x| T::With::<FMA>::default().log1p(x)),
                Code::Atan => map1(to, a, |x| T::With::<FMA>::default().atan(x)),
                Code::Sqrt => map1(to, a, T::root),
                Code::Abs => map1(to, a, T::absolute),
                Code::Sign => map1(to, a, |x| T::With::<FMA>::default().sign(x)),
                Code::Step => map1(to, a, |x| T::With::<FMA>::default().step(x)),
            }
        }
    }
}

fn primitive(f: Primitive) -> Code {
    match f {
        Primitive::Sin => Code::Sin,
        Primitive::Cos => Code::Cos,
        Primitive::Exp => Code::Exp,
        Primitive::Expm1 => Code::Expm1,
        Primitive::Log => Code::Log,
        Primitive::Log1p => Code::Log1p,
        Primitive::Atan => Code::Atan,
        Primitive::Sqrt => Code::Sqrt,
        Primitive::Abs => Code::Abs,
        Primitive::Sign => Code::Sign,
        Primitive::Step => Code::Step,
    }
}

#[inline(always)]
fn map1<T: Copy, const W: usize>(to: &mut [T; W], a: &[T; W], f: impl Fn(T) -> T) {
    for i in 0..W {
        to[i] = f(a[i]);
    }
}

#[inline(always)]
fn map2<T: Copy, const W: usize>(to: &mut [T; W], a: &[T; W], b: &[T; W], f: impl Fn(T, T) -> T) {
    for i in 0..W {
        to[i] = f(a[i], b[i]);
    }
}

#[inline(always)]
fn map3<T: Copy, const W: usize>(to: &mut [T; W], a: &[T; W], b: &[T; W], c: &[T; W], f: impl Fn(T, T, T) -> T) {
    for i in 0..W {
        to[i] = f(a[i], b[i], c[i]);
    }
}
