//! Turning what the device wrote into [`Trajectories`].

use super::emit::stored;
use super::memory::Shape;
use super::{EVENT, RUNNING, UNWRITTEN};
use crate::backend::{BackendError, By, Run, Spec, Status, Trajectories};
use crate::model::Precision;
use rayon::prelude::*;

/// Bytes of a part's buffers.
pub struct Written<'a> {
    /// `[field][trajectory]`
    pub counters: &'a [u8],
    /// `[component, then time][trajectory]`
    pub ends: &'a [u8],
    /// `[trajectory][level][time, then components but the coordinate]`
    pub samples: &'a [u8],
}

/// Fills the results of the trajectories from `first` on.
pub fn fill(
    result: &mut Trajectories,
    first: usize,
    spec: &Spec,
    run: &Run,
    shape: Shape,
    written: &Written<'_>,
) -> Result<(), BackendError> {
    let count = shape.trajectories;
    let counters: &[u32] = bytemuck::cast_slice(written.counters);
    let field = |k: usize| &counters[k * count..(k + 1) * count];
    let unwritten = |index: usize| BackendError::Unwritten {
        index: first + index,
    };
    let those = first..first + count;
    let wrong = (result.status[those.clone()].par_iter_mut())
        .zip(field(0))
        .with_min_len(4096)
        .enumerate()
        .filter_map(|(index, (to, code))| {
            let status = match *code {
                RUNNING | UNWRITTEN | EVENT => None,
                code => Status::from_code(code as i32),
            };
            status.map(|status| *to = status).is_none().then_some(index)
        })
        .min();
    if let Some(index) = wrong {
        return Err(unwritten(index));
    }
    for (to, from) in [(&mut result.steps, 2), (&mut result.rejected, 3)] {
        (to[those.clone()].par_iter_mut())
            .zip(field(from))
            .with_min_len(4096)
            .for_each(|(to, from)| *to = *from);
    }
    let sentinel = (written.ends.par_chunks_exact(shape.real))
        .with_min_len(4096)
        .position_first(|slot| slot.iter().all(|byte| *byte == 0xff));
    if let Some(slot) = sentinel {
        return Err(unwritten(slot % count));
    }
    let passed = Passed {
        first: field(4),
        end: field(1),
    };
    match spec.precision {
        Precision::F32 => numbers::<f32>(result, first, spec, run, shape, written, &passed),
        Precision::F64 => numbers::<f64>(result, first, spec, run, shape, written, &passed),
    }
    Ok(())
}

/// Levels that were stored: from the first after those that the seed had passed.
struct Passed<'a> {
    first: &'a [u32],
    end: &'a [u32],
}

fn numbers<T: bytemuck::Pod + Into<f64> + Send + Sync>(
    result: &mut Trajectories,
    first: usize,
    spec: &Spec,
    run: &Run,
    shape: Shape,
    written: &Written<'_>,
    passed: &Passed<'_>,
) {
    let (dim, count, levels) = (shape.dim, shape.trajectories, shape.levels);
    let ends: &[T] = bytemuck::cast_slice(written.ends);
    result.end[first * dim..(first + count) * dim]
        .par_chunks_exact_mut(dim)
        .zip(&mut result.end_time[first..first + count])
        .enumerate()
        .with_min_len(1024)
        .for_each(|(i, (end, time))| {
            for (c, to) in end.iter_mut().enumerate() {
                *to = ends[c * count + i].into();
            }
            *time = ends[dim * count + i].into();
        });
    if levels == 0 {
        return;
    }
    let samples: &[T] = bytemuck::cast_slice(written.samples);
    let components: Vec<usize> = stored(spec).collect();
    let width = 1 + dim;
    let to = &mut result.samples[first * levels * width..(first + count) * levels * width];
    to.par_chunks_mut(levels * width)
        .zip(samples.par_chunks(levels * shape.sample))
        .enumerate()
        .with_min_len(64)
        .for_each(|(i, (to, from))| {
            let kept = passed.first[i] as usize..passed.end[i] as usize;
            for (k, to) in to.chunks_exact_mut(width).enumerate() {
                if !kept.contains(&k) {
                    to.fill(f64::NAN);
                    continue;
                }
                let from = &from[k * shape.sample..(k + 1) * shape.sample];
                to[0] = from[0].into();
                for (c, x) in components.iter().zip(&from[1..]) {
                    to[1 + c] = (*x).into();
                }
                if let By::Component(c) = spec.by {
                    to[1 + c] = run.levels[k];
                }
            }
        });
}
