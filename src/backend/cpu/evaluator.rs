//! Evaluating a program at many points in f64, for what is reported beside the integrated vector.

use super::Simd;
use super::arithmetic::Arithmetic;
use super::code::Recorder;
use super::lanes::Lanes;
use super::routine::Routine;
use crate::model::Precision;
use crate::program::Program;
use rayon::prelude::*;

const LANES: usize = 16;
/// Points a task.
const CHUNK: usize = 4096;

/// A program for pointwise evaluation.
pub struct Evaluator {
    routine: Routine,
    inputs: usize,
    outputs: usize,
    simd: Simd,
}

impl Evaluator {
    pub fn new(program: &Program) -> Self {
        let simd = Simd::detect();
        let record = |r: &mut Recorder| {
            let inputs = r.loads(0..program.inputs);
            for (k, v) in r.program(program, &inputs).into_iter().enumerate() {
                r.store(v, program.inputs + k);
            }
        };
        Self {
            routine: Routine::new(Some(simd), Precision::F64, LANES, record),
            inputs: program.inputs,
            outputs: program.outputs.len(),
            simd,
        }
    }

    /// Values `[point][output]` at points which begin `stride` apart in `points`; of each the
    /// leading `inputs` entries are read, and of the last one no more need be there.
    ///
    /// # Panics
    /// When `stride` is below the program's number of inputs.
    pub fn eval(&self, points: &[f64], stride: usize) -> Vec<f64> {
        assert!(
            stride >= self.inputs,
            "points are narrower than the program's inputs"
        );
        let outputs = self.outputs;
        let count = self.count(points, stride);
        let mut values = vec![0.0; count * outputs];
        if outputs == 0 {
            return values;
        }
        points
            .par_chunks(CHUNK * stride)
            .zip(values.par_chunks_mut(CHUNK * outputs))
            .for_each(|(points, values)| self.fill(points, stride, values));
        values
    }

    /// [`Evaluator::eval`] on the calling thread, into memory that is there.
    pub fn fill(&self, points: &[f64], stride: usize, values: &mut [f64]) {
        match self.simd {
            Simd::Baseline => self.chunk::<false>(points, stride, values),
            // SAFETY: the features were detected.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 => unsafe { avx2(self, points, stride, values) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx512 => unsafe { avx512(self, points, stride, values) },
            #[cfg(not(target_arch = "x86_64"))]
            Simd::Neon => self.chunk::<true>(points, stride, values),
        }
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
        let outputs = self.outputs;
        let mut session = self.routine.session::<f64, LANES>(&[]);
        let mut frame = vec![Lanes::<f64, LANES>::splat(0.0); self.inputs + outputs];
        let count = self.count(points, stride);
        for first in (0..count).step_by(LANES) {
            let here = LANES.min(count - first);
            for (k, input) in frame[..self.inputs].iter_mut().enumerate() {
                for i in 0..here {
                    input.0[i] = points[(first + i) * stride + k];
                }
            }
            session.run::<FMA>(&mut frame);
            for (k, lane) in frame[self.inputs..].iter().enumerate() {
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
