//! The arithmetic rate of the processor: multiply-adds on as many independent SIMD registers as
//! hide their latency.

use super::Simd;
use super::real::Real;
use crate::model::Precision;
use rayon::prelude::*;
use std::hint::black_box;
use std::time::Instant;

/// Chains of multiply-adds (a processor of today has about 8 on the way), and the length of each.
const CHAINS: usize = 10;
const LINKS: usize = 1 << 21;
/// Tries; the fastest counts, for others may share the machine.
const REPEATS: usize = 5;
/// A factor that keeps the chains finite, and what is added. Unknown to the compiler.
const FACTOR: f64 = 0.999;
const SUMMAND: f64 = 1e-3;

/// Floating-point operations a second of all threads (a multiply-add is two).
pub(super) fn peak(simd: Simd, precision: Precision) -> f64 {
    let threads = rayon::current_num_threads();
    (0..REPEATS)
        .map(|_| {
            let begin = Instant::now();
            let operations: f64 = (0..threads)
                .into_par_iter()
                .with_max_len(1)
                .map(|_| run(simd, precision))
                .sum();
            operations / begin.elapsed().as_secs_f64()
        })
        .fold(0.0, f64::max)
}

/// Operations done.
fn run(simd: Simd, precision: Precision) -> f64 {
    match (simd, precision) {
        (Simd::Baseline, Precision::F64) => plain::<f64, 64>(),
        (Simd::Baseline, Precision::F32) => plain::<f32, 64>(),
        // SAFETY: the features were detected when the backend was made; so below.
        #[cfg(target_arch = "x86_64")]
        (Simd::Avx2, Precision::F64) => unsafe { x86::avx2_f64() },
        #[cfg(target_arch = "x86_64")]
        (Simd::Avx2, Precision::F32) => unsafe { x86::avx2_f32() },
        #[cfg(target_arch = "x86_64")]
        (Simd::Avx512, Precision::F64) => unsafe { x86::avx512_f64() },
        #[cfg(target_arch = "x86_64")]
        (Simd::Avx512, Precision::F32) => unsafe { x86::avx512_f32() },
        #[cfg(target_arch = "aarch64")]
        (Simd::Neon, Precision::F64) => unsafe { arm::neon_f64() },
        #[cfg(target_arch = "aarch64")]
        (Simd::Neon, Precision::F32) => unsafe { arm::neon_f32() },
        #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
        (Simd::Neon, _) => unreachable!("no machine of this kind has it"),
    }
}

/// For instruction sets of which nothing more is known: a lower bound. More lanes than registers
/// hold, or the compiler would unroll the loop instead of vectorizing it.
fn plain<T: Real, const W: usize>() -> f64 {
    let (a, b) = (T::of(black_box(FACTOR)), T::of(black_box(SUMMAND)));
    let mut x = [b; W];
    for _ in 0..LINKS {
        for x in &mut x {
            *x = x.mul_add::<false>(a, b);
        }
    }
    black_box(x.iter().map(|x| x.f64()).sum::<f64>());
    (2 * LINKS * W) as f64
}

/// Written with intrinsics: what the compiler makes of loops differs from one length to another.
macro_rules! chains {
    (#[$features:meta] $name:ident, $real:ty, $lanes:expr, $splat:ident, $multiply_add:expr) => {
        #[$features]
        pub fn $name() -> f64 {
            let (a, b) = (
                $splat(black_box(FACTOR as $real)),
                $splat(black_box(SUMMAND as $real)),
            );
            let mut x = [b; CHAINS];
            for _ in 0..LINKS {
                for x in &mut x {
                    *x = $multiply_add(*x, a, b);
                }
            }
            black_box(x);
            (2 * LINKS * CHAINS * $lanes) as f64
        }
    };
}

#[cfg(target_arch = "aarch64")]
mod arm {
    use super::{CHAINS, FACTOR, LINKS, SUMMAND};
    use std::arch::aarch64::*;
    use std::hint::black_box;

    chains!(
        #[target_feature(enable = "neon")]
        neon_f64,
        f64,
        2,
        vdupq_n_f64,
        |x, a, b| vfmaq_f64(b, x, a)
    );
    chains!(
        #[target_feature(enable = "neon")]
        neon_f32,
        f32,
        4,
        vdupq_n_f32,
        |x, a, b| vfmaq_f32(b, x, a)
    );
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{CHAINS, FACTOR, LINKS, SUMMAND};
    use std::arch::x86_64::*;
    use std::hint::black_box;

    chains!(
        #[target_feature(enable = "avx2,fma")]
        avx2_f64,
        f64,
        4,
        _mm256_set1_pd,
        _mm256_fmadd_pd
    );
    chains!(
        #[target_feature(enable = "avx2,fma")]
        avx2_f32,
        f32,
        8,
        _mm256_set1_ps,
        _mm256_fmadd_ps
    );
    chains!(
        #[target_feature(enable = "avx512f")]
        avx512_f64,
        f64,
        8,
        _mm512_set1_pd,
        _mm512_fmadd_pd
    );
    chains!(
        #[target_feature(enable = "avx512f")]
        avx512_f32,
        f32,
        16,
        _mm512_set1_ps,
        _mm512_fmadd_ps
    );
}
