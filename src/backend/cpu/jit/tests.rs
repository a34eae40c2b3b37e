//! Compiled code against the same operations on single numbers, bit by bit.

use super::*;
use crate::backend::cpu::arithmetic::Arithmetic;
use crate::program::{Instr, Primitive, Program};
use proptest::prelude::*;

const W: usize = 16;

fn instruction(kind: u8, at: impl Fn(u32) -> u32, a: u32, b: u32, c: u32) -> Instr {
    use Primitive::{Abs, Atan, Cos, Exp, Expm1, Log, Log1p, Sign, Sin, Sqrt, Step};
    let (a, b, c) = (at(a), at(b), at(c));
    match kind {
        0..=2 => Instr::Add(a, b),
        3 | 4 => Instr::Sub(a, b),
        5..=7 => Instr::Mul(a, b),
        8 => Instr::Div(a, b),
        9 => Instr::Neg(a),
        10..=13 => Instr::MulAdd(a, b, c),
        14 | 15 => Instr::MulSub(a, b, c),
        16 | 17 => Instr::NegMulAdd(a, b, c),
        18 => Instr::Min(a, b),
        19 => Instr::Max(a, b),
        20 => Instr::Const(f64::from(a) * 0.37 - f64::from(b) * 0.11),
        k => {
            let functions = [
                Sin, Cos, Exp, Expm1, Log, Log1p, Atan, Sqrt, Abs, Sign, Step,
            ];
            Instr::Call(functions[usize::from(k - 21) % functions.len()], a)
        }
    }
}

/// Any straight-line program, long enough that values find no register.
fn program() -> impl Strategy<Value = Program> {
    let instr = (0u8..32, any::<u32>(), any::<u32>(), any::<u32>());
    (
        1usize..8,
        proptest::collection::vec(instr, 1..300),
        1usize..40,
    )
        .prop_map(|(inputs, list, outputs)| {
            let mut code: Vec<Instr> = (0..inputs as u32).map(Instr::Input).collect();
            for (kind, a, b, c) in list {
                let next = code.len() as u32;
                code.push(instruction(kind, |k| k % next, a, b, c));
            }
            let end = code.len();
            let outputs = (end.saturating_sub(outputs)..end)
                .map(|v| v as u32)
                .collect();
            Program {
                inputs,
                code,
                outputs,
            }
        })
}

fn agree<T: Real>(
    program: &Program,
    precision: Precision,
    points: &[f64],
) -> Result<(), TestCaseError> {
    for set in sets() {
        agree_of::<T>(set, program, precision, points)?;
    }
    Ok(())
}

fn agree_of<T: Real>(
    set: Set,
    program: &Program,
    precision: Precision,
    points: &[f64],
) -> Result<(), TestCaseError> {
    let (inputs, outputs) = (program.inputs, program.outputs.len());
    let mut recorder = Recorder::new(precision, true);
    let loaded = recorder.loads(0..inputs);
    let values = recorder.program(program, &loaded);
    for (k, v) in values.iter().enumerate() {
        recorder.store(*v, inputs + k);
    }
    let executable = Executable::new(recorder, set, precision, W);
    let executable = executable.ok_or_else(|| TestCaseError::fail("not compiled"))?;
    let mut frame = vec![Lanes::<T, W>::splat(T::of(0.0)); inputs + outputs];
    let at = |k: usize, i: usize| T::of(points[(k * W + i) % points.len()]);
    for (k, slot) in frame[..inputs].iter_mut().enumerate() {
        for i in 0..W {
            slot.0[i] = at(k, i);
        }
    }
    executable.machine::<T>(&[]).run(&mut frame);
    for i in 0..W {
        let point: Vec<T> = (0..inputs).map(|k| at(k, i)).collect();
        let want = T::With::<true>::default().program(program, &point);
        for (k, want) in want.iter().enumerate() {
            let got = frame[inputs + k].0[i];
            let same = got.f64().to_bits() == want.f64().to_bits()
                || (got.f64().is_nan() && want.f64().is_nan());
            prop_assert!(
                same,
                "{set:?}: output {k}, lane {i}: {} for {}",
                got.f64(),
                want.f64()
            );
        }
    }
    Ok(())
}

/// The sets that this machine has. Encoders are also tested against an assembler, on machines that
/// lack a set.
fn sets() -> impl Iterator<Item = Set> {
    #[cfg(target_arch = "x86_64")]
    const ALL: &[Set] = &[Set::Avx2, Set::Avx512];
    #[cfg(not(target_arch = "x86_64"))]
    const ALL: &[Set] = &[Set::Neon];
    ALL.iter().copied().filter(|set| set.is_here())
}

/// Whether code can be run that was compiled. Where it cannot the test fails, unless
/// `COSTATE_WITHOUT_AVX2` says that the machine is known to lack AVX2.
fn here() -> bool {
    let here = super::works() && sets().next().is_some();
    assert!(
        here || std::env::var_os("COSTATE_WITHOUT_AVX2").is_some(),
        "this test needs AVX2: set COSTATE_WITHOUT_AVX2=1 to leave it out on a machine without"
    );
    here
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn compiled_code_computes_the_same_bits(
        program in program(),
        points in proptest::collection::vec(-3.0f64..3.0, 24),
    ) {
        if here() {
            agree::<f64>(&program, Precision::F64, &points)?;
            agree::<f32>(&program, Precision::F32, &points)?;
        }
    }

    #[test]
    fn compiled_code_computes_the_same_bits_of_anything(
        program in program(),
        points in proptest::collection::vec(any::<f64>(), 24),
    ) {
        if here() {
            agree::<f64>(&program, Precision::F64, &points)?;
            agree::<f32>(&program, Precision::F32, &points)?;
        }
    }
}

#[test]
fn parameters_are_given_with_each_call() {
    if !here() {
        return;
    }
    for set in sets() {
        let mut recorder = Recorder::new(Precision::F64, true);
        let (x, p) = (recorder.load(0), recorder.parameter(1));
        let sum = recorder.mul_add(x, p, p);
        recorder.store(sum, 1);
        let executable = Executable::new(recorder, set, Precision::F64, W).expect("compiled");
        let mut frame = vec![Lanes::<f64, W>::splat(3.0), Lanes::splat(0.0)];
        for p in [2.0, -5.0] {
            executable.machine(&[0.0, p]).run(&mut frame);
            assert_eq!(frame[1].0, [4.0 * p; W]);
        }
    }
}
