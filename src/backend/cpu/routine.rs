//! Vector code ready to run: compiled where the machine allows it, else interpreted.

use super::Simd;
use super::code::Recorder;
use super::jit::{Executable, Machine, Set};
use super::lanes::{Interpreted, Lanes};
use super::real::Real;
use crate::model::Precision;

/// Code for frames of a certain number of lanes.
pub enum Routine {
    Compiled(Executable),
    Interpreted(Interpreted),
}

impl Routine {
    /// Bytes of machine code.
    pub fn bytes(&self) -> usize {
        match self {
            Routine::Compiled(executable) => executable.bytes(),
            Routine::Interpreted(_) => 0,
        }
    }

    /// `compile`: for which instructions, if at all. `record` may be called twice: once for the
    /// compiler, once for the interpreter.
    pub fn new(
        compile: Option<Simd>,
        precision: Precision,
        width: usize,
        record: impl Fn(&mut Recorder),
    ) -> Self {
        if let Some(set) = compile.and_then(set) {
            let mut recorder = Recorder::new(precision, true);
            record(&mut recorder);
            if let Some(executable) = Executable::new(recorder, set, precision, width) {
                return Routine::Compiled(executable);
            }
        }
        let mut recorder = Recorder::new(precision, false);
        record(&mut recorder);
        Routine::Interpreted(Interpreted::new(recorder))
    }

    /// Whether it is machine code.
    pub fn is_compiled(&self) -> bool {
        match self {
            Routine::Compiled(_) => true,
            Routine::Interpreted(_) => false,
        }
    }

    /// The code with values for its parameters and room to work; one a thread.
    pub fn session<T: Real, const W: usize>(&self, parameters: &[T]) -> Session<'_, T, W> {
        match self {
            Routine::Compiled(executable) => Session::Compiled(executable.machine(parameters)),
            Routine::Interpreted(code) => Session::Interpreted(code, code.registers(parameters)),
        }
    }
}

fn set(simd: Simd) -> Option<Set> {
    match simd {
        Simd::Baseline => None,
        #[cfg(target_arch = "x86_64")]
        Simd::Avx2 => Some(Set::Avx2),
        #[cfg(target_arch = "x86_64")]
        Simd::Avx512 => Some(Set::Avx512),
        #[cfg(not(target_arch = "x86_64"))]
        Simd::Neon => Some(Set::Neon),
    }
}

/// A [`Routine`] at work.
pub enum Session<'a, T, const W: usize> {
    Compiled(Machine<'a>),
    Interpreted(&'a Interpreted, Vec<Lanes<T, W>>),
}

impl<T: Real, const W: usize> Session<'_, T, W> {
    #[inline(always)]
    pub fn run<const FMA: bool>(&mut self, frame: &mut [Lanes<T, W>]) {
        match self {
            Session::Compiled(machine) => machine.run(frame),
            Session::Interpreted(code, file) => code.run::<T, W, FMA>(file, frame),
        }
    }
}
