//! Lanes, and the interpreter of vector code on blocks of them.
//!
//! A register holds one value for each of `W` trajectories; an operation is a loop over the lanes
//! which the compiler turns into SIMD. `W` is several SIMD vectors, so decoding an operation is
//! paid for by many.

use super::arithmetic::Arithmetic;
use super::code::{Binary, Fused, Op, Recorder};
use super::real::Real;
use crate::program::Primitive;

/// A value for each lane.
#[repr(align(64))]
#[derive(Clone, Copy, Debug)]
pub struct Lanes<T, const W: usize>(pub [T; W]);

impl<T: Real, const W: usize> Lanes<T, W> {
    pub fn splat(x: T) -> Self {
        Self([x; W])
    }
}

/// Marks a place in the frame; else it is a register.
const FRAME: u32 = 1 << 31;

#[derive(Clone, Copy, Debug)]
enum Kind {
    Binary(Binary),
    Fused(Fused),
    Sqrt,
    ShiftLeft(u32),
    ShiftRight(u32),
    Blend,
    Call(Primitive),
    /// Sine into `to`, cosine into `c`.
    SinCos,
    Store,
}

#[derive(Clone, Copy, Debug)]
struct Step {
    kind: Kind,
    to: u32,
    a: u32,
    b: u32,
    c: u32,
}

/// Vector code with its registers assigned: parameters first, then constants, then what is reused.
#[derive(Clone, Debug)]
pub struct Interpreted {
    steps: Vec<Step>,
    parameters: usize,
    constants: Vec<u64>,
    registers: usize,
    slots: usize,
}

impl Interpreted {
    pub fn new(recorder: Recorder) -> Self {
        let (slots, parameters) = (recorder.slots(), recorder.parameters());
        let ops = recorder.finish(1);
        let mut last = vec![0; ops.len()];
        for (i, op) in ops.iter().enumerate() {
            op.reads().for_each(|v| last[v as usize] = i);
        }
        let constant = |op: &Op| match op {
            Op::Pattern(bits) => Some(*bits),
            _ => None,
        };
        let constants: Vec<u64> = ops.iter().filter_map(constant).collect();
        let fixed = parameters + constants.len();
        let mut registers = fixed;
        let mut free: Vec<u32> = Vec::new();
        let mut place = vec![0u32; ops.len()];
        let mut steps: Vec<Step> = Vec::new();
        let mut next_constant = parameters as u32;
        for (i, op) in ops.iter().enumerate() {
            let mut fresh = || {
                free.pop().unwrap_or_else(|| {
                    registers += 1;
                    registers as u32 - 1
                })
            };
            let at = |v: u32| place[v as usize];
            let step = |kind, to, a: u32, b: u32, c: u32| Step {
                kind,
                to,
                a: at(a),
                b: at(b),
                c: at(c),
            };
            let next = match *op {
                Op::Load(slot) => {
                    place[i] = FRAME | slot;
                    continue;
                }
                Op::Parameter(p) => {
                    place[i] = p;
                    continue;
                }
                Op::Pattern(_) => {
                    place[i] = next_constant;
                    next_constant += 1;
                    continue;
                }
                Op::Store(v, slot) => step(Kind::Store, FRAME | slot, v, v, v),
                Op::Binary(k, a, b) => step(Kind::Binary(k), fresh(), a, b, a),
                Op::Fused(k, a, b, c) => step(Kind::Fused(k), fresh(), a, b, c),
                Op::Blend(a, b, c) => step(Kind::Blend, fresh(), a, b, c),
                Op::Sqrt(a) => step(Kind::Sqrt, fresh(), a, a, a),
                Op::ShiftLeft(a, n) => step(Kind::ShiftLeft(n), fresh(), a, a, a),
                Op::ShiftRight(a, n) => step(Kind::ShiftRight(n), fresh(), a, a, a),
                Op::Call(f, a) => step(Kind::Call(f), fresh(), a, a, a),
            };
            place[i] = next.to;
            let pair = matches!(op, Op::Call(Primitive::Cos, a) if i > 0 && ops[i - 1] == Op::Call(Primitive::Sin, *a));
            match steps.last_mut() {
                Some(sine) if pair => {
                    sine.kind = Kind::SinCos;
                    sine.c = next.to;
                }
                _ => steps.push(next),
            }
            // The argument of a sine must outlive a cosine that joins it.
            if !matches!(op, Op::Call(Primitive::Sin, _)) {
                let ended = op.reads().filter(|v| last[*v as usize] == i);
                let mut dead: Vec<u32> = ended
                    .map(|v| place[v as usize])
                    .filter(|at| at & FRAME == 0 && *at >= fixed as u32)
                    .collect();
                dead.sort_unstable();
                dead.dedup();
                free.extend(dead);
            }
        }
        Self {
            steps,
            parameters,
            constants,
            registers,
            slots,
        }
    }

    /// Registers with the parameters and constants in place.
    ///
    /// # Panics
    /// When parameters are missing.
    pub fn registers<T: Real, const W: usize>(&self, parameters: &[T]) -> Vec<Lanes<T, W>> {
        assert!(
            parameters.len() >= self.parameters,
            "parameters are missing"
        );
        let mut arithmetic = T::With::<false>::default();
        let mut file = vec![Lanes::splat(T::of(0.0)); self.registers];
        let constants = self.constants.iter().map(|bits| arithmetic.pattern(*bits));
        for (r, c) in file.iter_mut().zip(
            parameters[..self.parameters]
                .iter()
                .copied()
                .chain(constants),
        ) {
            *r = Lanes::splat(c);
        }
        file
    }

    /// Runs the code on a frame with the registers made by [`Interpreted::registers`].
    ///
    /// # Panics
    /// When the frame or the registers are too few.
    #[inline(always)]
    pub fn run<T: Real, const W: usize, const FMA: bool>(
        &self,
        file: &mut [Lanes<T, W>],
        frame: &mut [Lanes<T, W>],
    ) {
        assert!(file.len() >= self.registers, "registers of another code");
        assert!(frame.len() >= self.slots, "the frame is too short");
        let (file, frame) = (file.as_mut_ptr(), frame.as_mut_ptr());
        // SAFETY (of all places): registers are below `registers` and slots below `slots` by
        // construction, both asserted to be there.
        let place = |p: u32| unsafe {
            if p & FRAME == 0 {
                file.add(p as usize)
            } else {
                frame.add((p & !FRAME) as usize)
            }
        };
        for step in &self.steps {
            // SAFETY: as above; a result's register is none of the operands' (it is taken before
            // they are given up), and no slot is both loaded and stored, so the references do not
            // alias.
            let (to, a, b, c) = unsafe {
                (
                    &mut (*place(step.to)).0,
                    &(*place(step.a)).0,
                    &(*place(step.b)).0,
                    place(step.c),
                )
            };
            let mut m = T::With::<FMA>::default();
            match step.kind {
                Kind::Binary(Binary::Add) => map2(to, a, b, |x, y| x + y),
                Kind::Binary(Binary::Sub) => map2(to, a, b, |x, y| x - y),
                Kind::Binary(Binary::Mul) => map2(to, a, b, |x, y| x * y),
                Kind::Binary(Binary::Div) => map2(to, a, b, |x, y| x / y),
                Kind::Binary(Binary::And) => map2(to, a, b, |x, y| m.and(x, y)),
                Kind::Binary(Binary::Or) => map2(to, a, b, |x, y| m.or(x, y)),
                Kind::Binary(Binary::Xor) => map2(to, a, b, |x, y| m.xor(x, y)),
                Kind::Binary(Binary::AddBits) => map2(to, a, b, |x, y| m.add_bits(x, y)),
                Kind::Binary(Binary::Compare(how)) => map2(to, a, b, |x, y| {
                    let (holds, all, none) = (m.compare(how, x, y), m.pattern(!0), m.pattern(0));
                    m.select(holds, all, none)
                }),
                // SAFETY: as above; `c` is only read.
                Kind::Fused(Fused::MulAdd) => {
                    map3(to, a, b, unsafe { &(*c).0 }, |x, y, z| m.mul_add(x, y, z))
                }
                Kind::Fused(Fused::MulSub) => {
                    map3(to, a, b, unsafe { &(*c).0 }, |x, y, z| m.mul_sub(x, y, z))
                }
                Kind::Fused(Fused::NegMulAdd) => map3(to, a, b, unsafe { &(*c).0 }, |x, y, z| {
                    m.neg_mul_add(x, y, z)
                }),
                Kind::Blend => map3(to, a, b, unsafe { &(*c).0 }, |x, y, z| {
                    let mask = m.top_bit(x);
                    m.select(mask, y, z)
                }),
                Kind::SinCos => {
                    // SAFETY: as above; `c` is a result's register here, neither `to` nor `a`.
                    let cosine = unsafe { &mut (*c).0 };
                    for i in 0..W {
                        (to[i], cosine[i]) = m.sin_cos(a[i]);
                    }
                }
                Kind::Sqrt => map1(to, a, |x| x.root()),
                Kind::ShiftLeft(n) => map1(to, a, |x| m.shift_left(x, n)),
                Kind::ShiftRight(n) => map1(to, a, |x| m.shift_right(x, n)),
                Kind::Store => *to = *a,
                Kind::Call(Primitive::Sin) => map1(to, a, |x| m.sin_cos(x).0),
                Kind::Call(Primitive::Cos) => map1(to, a, |x| m.sin_cos(x).1),
                Kind::Call(Primitive::Exp) => map1(to, a, |x| m.exp(x)),
                Kind::Call(Primitive::Expm1) => map1(to, a, |x| m.expm1(x)),
                Kind::Call(Primitive::Log) => map1(to, a, |x| m.log(x)),
                Kind::Call(Primitive::Log1p) => map1(to, a, |x| m.log1p(x)),
                Kind::Call(Primitive::Atan) => map1(to, a, |x| m.atan(x)),
                Kind::Call(Primitive::Sqrt) => map1(to, a, |x| x.root()),
                Kind::Call(Primitive::Abs) => map1(to, a, T::absolute),
                Kind::Call(Primitive::Sign) => map1(to, a, |x| m.sign(x)),
                Kind::Call(Primitive::Step) => map1(to, a, |x| m.step(x)),
            }
        }
    }
}

#[inline(always)]
fn map1<T: Copy, const W: usize>(to: &mut [T; W], a: &[T; W], mut f: impl FnMut(T) -> T) {
    for i in 0..W {
        to[i] = f(a[i]);
    }
}

#[inline(always)]
fn map2<T: Copy, const W: usize>(
    to: &mut [T; W],
    a: &[T; W],
    b: &[T; W],
    mut f: impl FnMut(T, T) -> T,
) {
    for i in 0..W {
        to[i] = f(a[i], b[i]);
    }
}

#[inline(always)]
fn map3<T: Copy, const W: usize>(
    to: &mut [T; W],
    a: &[T; W],
    b: &[T; W],
    c: &[T; W],
    mut f: impl FnMut(T, T, T) -> T,
) {
    for i in 0..W {
        to[i] = f(a[i], b[i], c[i]);
    }
}
