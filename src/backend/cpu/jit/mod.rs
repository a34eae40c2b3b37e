//! Just-in-time compilation of straight-line vector code for AVX2 and FMA, AVX-512, or NEON: a whole
//! step of a scene's equations becomes machine code that keeps its values in registers, where an
//! interpreter would move each of them through memory.

mod allocate;
mod encoder;
#[cfg(test)]
mod listing;
// Encodings are tested on every machine, and run where the processor is of their kind.
#[cfg(any(not(target_arch = "x86_64"), test))]
mod neon;
#[cfg(any(target_arch = "x86_64", test))]
mod x86;

use super::code::Recorder;
use super::lanes::Lanes;
use super::real::Real;
use crate::model::Precision;
use allocate::Layout;
use memmap2::{Mmap, MmapMut};

/// Operations above which code is not compiled: it would no longer fit the caches that instructions
/// come from.
pub const MOST_OPERATIONS: usize = 200_000;

#[cfg(not(target_arch = "x86_64"))]
pub use neon::Set;
#[cfg(target_arch = "x86_64")]
pub use x86::Set;

/// Bytes that no vector is larger than, aligned as any is.
#[repr(align(64))]
#[derive(Clone, Copy)]
struct Line([u64; LINE]);

const LINE: usize = 8;

/// Vectors of a set's size, one behind the other.
#[derive(Clone)]
struct Vectors {
    lines: Vec<Line>,
    /// Words of a vector.
    words: usize,
}

impl Vectors {
    fn new(count: usize, set: Set) -> Self {
        let words = set.vector() / 8;
        Self {
            lines: vec![Line([0; LINE]); (count * words).div_ceil(LINE)],
            words,
        }
    }

    /// Puts the same number into all lanes of a vector.
    fn splat(&mut self, vector: usize, bits: u64, precision: Precision) {
        let bits = match precision {
            Precision::F32 => bits << 32 | bits,
            Precision::F64 => bits,
        };
        for word in vector * self.words..(vector + 1) * self.words {
            self.lines[word / LINE].0[word % LINE] = bits;
        }
    }
}

/// Compiled code for frames of `W` lanes.
pub struct Executable {
    code: Mmap,
    /// Parameters, then constants.
    pool: Vectors,
    parameters: usize,
    spills: usize,
    /// Slots that a frame must have.
    slots: usize,
    /// Lanes of a frame, and groups of vectors they make.
    width: usize,
    groups: usize,
    set: Set,
    precision: Precision,
}

/// An executable with its parameters, and room for what finds no register; one a thread.
pub struct Machine<'a> {
    executable: &'a Executable,
    pool: Vectors,
    spills: Vectors,
}

/// Whether the machine lets a process make code that it runs.
pub fn works() -> bool {
    MmapMut::map_anon(1).is_ok_and(|memory| memory.make_exec().is_ok())
}

impl Set {
    /// Whether the machine has it.
    pub fn is_here(self) -> bool {
        match self {
            #[cfg(not(target_arch = "x86_64"))]
            Self::Neon => cfg!(target_arch = "aarch64"),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => {
                is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512vl")
            }
        }
    }
}

impl Executable {
    /// Bytes of the machine code.
    pub fn bytes(&self) -> usize {
        self.code.len()
    }

    /// Compiles what was recorded for frames of `width` lanes; `None` where the machine lacks the
    /// instructions or forbids executable memory, or where the code would be too long.
    pub fn new(recorder: Recorder, set: Set, precision: Precision, width: usize) -> Option<Self> {
        if !set.is_here() {
            return None;
        }
        if recorder.ops.len() > MOST_OPERATIONS {
            return None;
        }
        let lanes = set.vector() / precision.bytes();
        let vectors = width / lanes;
        let copies = if vectors.is_multiple_of(2) { 2 } else { 1 };
        let (slots, parameters) = (recorder.slots(), recorder.parameters());
        let ops = recorder.finish(copies);
        let layout = Layout {
            stride: width * precision.bytes(),
            copies,
            parameters,
        };
        let assembled = allocate::assemble(&ops, layout, set.encoder(precision));
        let mut memory = MmapMut::map_anon(assembled.bytes.len()).ok()?;
        memory.copy_from_slice(&assembled.bytes);
        let mut pool = Vectors::new(parameters + assembled.pool.len(), set);
        for (k, bits) in assembled.pool.iter().enumerate() {
            pool.splat(parameters + k, *bits, precision);
        }
        #[cfg(target_arch = "aarch64")]
        synchronize(&memory);
        Some(Self {
            code: memory.make_exec().ok()?,
            pool,
            parameters,
            spills: assembled.spills,
            slots,
            width,
            groups: vectors / copies as usize,
            set,
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
        for (k, p) in parameters[..self.parameters].iter().enumerate() {
            let bits = match self.precision {
                Precision::F32 => u64::from(p.f32().to_bits()),
                Precision::F64 => p.f64().to_bits(),
            };
            pool.splat(k, bits, self.precision);
        }
        Machine {
            executable: self,
            pool,
            spills: Vectors::new(self.spills, self.set),
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
            let code: Code<T, W> = std::mem::transmute(e.code.as_ptr());
            code(
                frame.as_mut_ptr(),
                self.pool.lines.as_ptr(),
                e.groups,
                self.spills.lines.as_mut_ptr(),
            );
        }
    }
}

/// The frame, the pool, how many groups of vectors, and the spills.
#[cfg(target_arch = "x86_64")]
type Code<T, const W: usize> = extern "sysv64" fn(*mut Lanes<T, W>, *const Line, usize, *mut Line);
#[cfg(not(target_arch = "x86_64"))]
type Code<T, const W: usize> = extern "C" fn(*mut Lanes<T, W>, *const Line, usize, *mut Line);

/// Lets instructions be fetched as they were written: the caches of aarch64 do not see to it
/// (DDI 0487, B2.7.4.2).
#[cfg(target_arch = "aarch64")]
fn synchronize(code: &[u8]) {
    const LEAST_LINE: usize = 16;
    let lines =
        || (code.as_ptr() as usize..code.as_ptr() as usize + code.len()).step_by(LEAST_LINE);
    // SAFETY: caches of memory that is ours are cleaned; no memory changes.
    unsafe {
        for at in lines() {
            core::arch::asm!("dc cvau, {}", in(reg) at, options(nostack, preserves_flags));
        }
        core::arch::asm!("dsb ish", options(nostack, preserves_flags));
        for at in lines() {
            core::arch::asm!("ic ivau, {}", in(reg) at, options(nostack, preserves_flags));
        }
        core::arch::asm!("dsb ish", "isb", options(nostack, preserves_flags));
    }
}

#[cfg(test)]
mod tests;
