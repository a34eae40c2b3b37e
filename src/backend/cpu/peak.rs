//! The arithmetic rate of the processor: multiply-adds on as many independent SIMD registers as hide their latency.

use super::Simd;
use super::real::Real;
use crate::model::Precision;
use rayon::prelude::*;
use std::time::Instant;

/// Multiply-adds of a chain.
const LINKS: usize = 1 << 20;
/// Tries; the fastest counts, for others may share the machine.
const REPEATS: usize = 5;

/// Floating-point operations a second of all threads (a multiply-add is two).
pub(super) fn peak(simd: Simd, precision: Precision) -> f64 {
    let threads = rayon::current_num_threads();
    (0..REPEATS)
        .map(|_| {
            let begin = Instant::now();
            let operations: f64 = (0..threads)
                .into_par_iter()
                .with_max_len(1)
                .map(|_| match precision {
                    Precision::F64 => run::<f64, 16, 32, 64>(simd),
                    Precision::F32 => run::<f32, 32, 64, 128>(simd),
                })
                .sum();
            operations / begin.elapsed().as_secs_f64()
        })
        .fold(0.0, f64::max)
}

/// Eight registers of each instruction set: `A`, `B` and `C` lanes with 128, 256 and 512 bits.
fn run<T: Real, const A: usize, const B: usize, const C: usize>(simd: Simd) -> f64 {
    match simd {
        Simd::Baseline => chains::<T, A, false>(),
        // SAFETY: the features were detected when the backend was made.
        #[cfg(target_arch = "x86_64")]
        Simd::Avx2 => unsafe { avx2::<T, B>() },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Simd::Avx512 => unsafe { avx512::<T, C>() },
    }
}

/// Operations done.
#[inline(always)]
fn chains<T: Real, const W: usize, const FMA: bool>() -> f64 {
    // Unknown to the compiler, like the sum.
    let a = T::of(std::hint::black_box(0.999));
    let b = T::of(std::hint::black_box(1e-3));
    let mut x = [b; W];
    for _ in 0..LINKS {
        for i in 0..W {
            x[i] = x[i].mul_add::<FMA>(a, b);
        }
    }
    std::hint::black_box(x.iter().map(|x| x.f64()).sum::<f64>());
    2.0 * LINKS as f64 * W as f64
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2<T: Real, const W: usize>() -> f64 {
    chains::<T, W, true>()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
fn avx512<T: Real, const W: usize>() -> f64 {
    chains::<T, W, true>()
}
