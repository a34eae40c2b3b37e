//! Evaluating a program at many points in f64, for what is reported beside the integrated vector.

use super::Simd;
use super::lanes::LaneProgram;
use crate::program::Program;
use rayon::prelude::*;

const LANES: usize = 16;
/// Points a task.
const CHUNK: usize = 4096;

/// A program for pointwise evaluation.
pub struct Evaluator {
    program: LaneProgram,
    inputs: usize,
    simd: Simd,
}

impl Evaluator {
    pub fn new(program: &Program) -> Self {
        Self {
            program: LaneProgram::new(program),
            inputs: program.inputs,
            simd: Simd::detect(),
        }
    }

    /// Values `[point][output]` at points which begin `stride` apart in `points`; of each the leading `inputs` entries
    /// are read, and of the last one no more need be there.
    ///
    /// # Panics
    /// When `stride` is below the program's number of inputs.
    pub fn eval(&self, points: &[f64], stride: usize) -> Vec<f64> {
        assert!(stride >= self.inputs, "points are narrower than the program's inputs");
        let outputs = self.program.outputs();
        let count = self.count(points, stride);
        let mut values = vec![0.0; count * outputs];
        if outputs == 0 {
            return values;
        }
        points
            .par_chunks(CHUNK * stride)
            .zip(values.par_chunks_mut(CHUNK * outputs))
            .for_each(|(points, values)| {
                match self.simd {
                    Simd::Baseline => self.chunk::<false>(points, stride, values),
                    // SAFETY: the features were detected.
                    #[cfg(target_arch = "x86_64")]
                    Simd::Avx2 => unsafe { avx2(self, points, stride, values) },
                    // SAFETY: as above.
                    #[cfg(target_arch = "x86_64")]
                    Simd::Avx512 => unsafe { avx512(self, points, stride, values) },
                }
            });
        values
    }

    fn count(&self, points: &[f64], stride: usize) -> usize {
        if points.len() < self.inputs {
            0
        } else {
            (points.len() - self.inputs) / stride + 1
        }
    }

    #[inline(always)]
    fn chunk<const FMA: bool>(&self, points: &[f64], stride: usize, values: &mut [f64]) {
        let outputs = self.program.outputs();
        let mut file = self.program.registers::<f64, LANES>();
        let count = self.count(points, stride);
        for first in (0..count).step_by(LANES) {
            let here = LANES.min(count - first);
            for (k, input) in self.program.inputs(&mut file, self.inputs).iter_mut().enumerate() {
                for i in 0..here {
                    input.0[i] = points[(first + i) * stride + k];
                }
            }
            self.program.run::<f64, LANES, FMA>(&mut file);
            for k in 0..outputs {
                let lane = self.program.output(&file, k);
                for i in 0..here {
                    values[(first + i) * outputs + k] = lane.0[i];
                }
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2(this: &Evaluator, points: &[f64], stride: usize, values: &mut [f64]) {
    this.chunk::<true>(points, stride, values);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
fn avx512(this: &Evaluator, points: &[f64], stride: usize, values: &mut [f64]) {
    this.chunk::<true>(points, stride, values);
}
