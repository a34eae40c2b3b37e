//! Just-in-time compilation of straight-line vector code for AVX2 and FMA: a whole step of a
//! scene's equations becomes machine code that keeps its values in registers, where an interpreter
//! would move each of them through memory.

mod allocate;
mod assembler;

use super::code::Recorder;
use super::lanes::Lanes;
use super::real::Real;
use crate::model::Precision;
use allocate::Layout;
use assembler::VECTOR;
use memmap2::{Mmap, MmapMut};

/// Operations above which code is not compiled: it would no longer fit the caches that instructions
/// come from.
pub const MOST_OPERATIONS: usize = 200_000;

/// A vector's bytes.
#[repr(align(32))]
#[derive(Clone, Copy)]
struct Vector(#[allow(dead_code, reason = "machine code reads it")] [u64; VECTOR / 8]);

/// Compiled code for frames of `W` lanes.
pub struct Executable {
    code: Mmap,
    /// Parameters, then constants.
    pool: Vec<Vector>,
    parameters: usize,
    spills: usize,
    /// Slots that a frame must have.
    slots: usize,
    /// Lanes of a frame, and groups of vectors they make.
    width: usize,
    groups: usize,
    precision: Precision,
}

/// An executable with its parameters, and room for what finds no register; one a thread.
pub struct Machine<'a> {
    executable: &'a Executable,
    pool: Vec<Vector>,
    spills: Vec<Vector>,
}

/// Whether the machine has the instructions, and lets a process make code that it runs.
pub fn works() -> bool {
    let has = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
    has && MmapMut::map_anon(1).is_ok_and(|memory| memory.make_exec().is_ok())
}

impl Executable {
    /// Compiles what was recorded for frames of `width` lanes; `None` where the machine lacks AVX2
    /// or FMA or forbids executable memory, or where the code would be too long.
    pub fn new(recorder: Recorder, precision: Precision, width: usize) -> Option<Self> {
        if !is_x86_feature_detected!("avx2") || !is_x86_feature_detected!("fma") {
            return None;
        }
        if recorder.ops.len() > MOST_OPERATIONS {
            return None;
        }
        let lanes = VECTOR / precision.bytes();
        let vectors = width / lanes;
        let copies = if vectors.is_multiple_of(2) { 2 } else { 1 };
        let (slots, parameters) = (recorder.slots(), recorder.parameters());
        let ops = recorder.finish(copies);
        let layout = Layout {
            stride: width * precision.bytes(),
            copies,
            parameters,
        };
        let assembled = allocate::assemble(&ops, layout, precision);
        let mut memory = MmapMut::map_anon(assembled.bytes.len()).ok()?;
        memory.copy_from_slice(&assembled.bytes);
        let splat = |bits: u64| {
            let bits = match precision {
                Precision::F32 => bits << 32 | bits,
                Precision::F64 => bits,
            };
            Vector([bits; VECTOR / 8])
        };
        Some(Self {
            code: memory.make_exec().ok()?,
            pool: (0..parameters)
                .map(|_| splat(0))
                .chain(assembled.pool.iter().map(|b| splat(*b)))
                .collect(),
            parameters,
            spills: assembled.spills,
            slots,
            width,
            groups: vectors / copies as usize,
            precision,
        })
    }

    /// The executable with values for its parameters.
    ///
    /// # Panics
    /// When there are not as many as were recorded.
    pub fn machine<T: Real>(&self, parameters: &[T]) -> Machine<'_> {
        assert!(
            parameters.len() >= self.parameters,
            "parameters are missing"
        );
        let mut pool = self.pool.clone();
        for (to, p) in pool.iter_mut().zip(&parameters[..self.parameters]) {
            let bits = match self.precision {
                Precision::F32 => {
                    let bits = u64::from(p.f32().to_bits());
                    bits << 32 | bits
                }
                Precision::F64 => p.f64().to_bits(),
            };
            *to = Vector([bits; VECTOR / 8]);
        }
        Machine {
            executable: self,
            pool,
            spills: vec![Vector([0; VECTOR / 8]); self.spills],
        }
    }
}

impl Machine<'_> {
    /// Runs the code on a frame.
    ///
    /// # Panics
    /// When the frame is not of the kind that the code was compiled for.
    pub fn run<T: Real, const W: usize>(&mut self, frame: &mut [Lanes<T, W>]) {
        let e = self.executable;
        assert!(frame.len() >= e.slots, "the frame is too short");
        assert!(
            W == e.width
                && size_of::<T>() == e.precision.bytes()
                && size_of::<Lanes<T, W>>() == W * size_of::<T>(),
            "a frame of another kind"
        );
        // SAFETY: the code is ours (its address is that of a live executable mapping), it reads and
        // writes the frame's slots below `slots` (asserted), the pool and the spills, each as long
        // as it was compiled for; the processor has the instructions (checked when it was
        // compiled).
        unsafe {
            let code: extern "sysv64" fn(*mut Lanes<T, W>, *const Vector, usize, *mut Vector) =
                std::mem::transmute(e.code.as_ptr());
            code(
                frame.as_mut_ptr(),
                self.pool.as_ptr(),
                e.groups,
                self.spills.as_mut_ptr(),
            );
        }
    }
}

#[cfg(test)]
mod tests;
