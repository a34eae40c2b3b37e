//! Comparing what two backends made of the same batch.
#![allow(dead_code, reason = "every test crate uses a part")]

use costate::backend::gpu::{Gpu, Selection};
use costate::backend::{Status, Trajectories};
use std::fmt;

/// One side of a comparison.
#[derive(Clone, Copy)]
pub struct Side<'a> {
    /// [`costate::backend::Backend::name`].
    pub backend: &'a str,
    pub result: &'a Trajectories,
}

/// Allowed difference of a value, `absolute + relative * |value|`; both must be reasoned where they
/// are chosen.
#[derive(Clone, Copy, Debug)]
pub struct Tolerance {
    pub relative: f64,
    pub absolute: f64,
    /// Allowed difference in attempted steps, given their number.
    pub steps: fn(u32) -> u32,
    /// Ways to end that are seen at the end of a step only (leaving the region, a ceiling). Where
    /// steps are chosen by rounding errors among others, the two sides may see them a step apart:
    /// of such trajectories the samples that both sides have are compared, but not the ends.
    pub loose: &'static [Status],
}

/// Why two sides do not agree.
#[derive(Debug, PartialEq)]
pub enum Mismatch {
    /// Both sides name this backend: nothing was compared.
    SameBackend(String),
    Shape,
    Status {
        trajectory: usize,
        a: Status,
        b: Status,
    },
    Steps {
        trajectory: usize,
        a: u32,
        b: u32,
    },
    /// A level was passed on one side only.
    Passed {
        trajectory: usize,
        level: usize,
    },
    /// A value differs; `units` times the tolerance.
    Value {
        trajectory: usize,
        what: String,
        a: f64,
        b: f64,
        units: f64,
    },
}

impl fmt::Display for Mismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self:?}")
    }
}

/// How close two sides that agree came.
#[derive(Clone, Copy, Debug, Default)]
pub struct Agreement {
    /// Largest difference in units of its tolerance.
    pub worst: f64,
    /// Values compared.
    pub values: usize,
    /// Samples that were passed.
    pub samples: usize,
    /// Trajectories that ended in different ways, one of them loose.
    pub split: usize,
}

/// Compares all trajectories: status, steps, end points, samples.
pub fn compare(a: Side<'_>, b: Side<'_>, tolerance: Tolerance) -> Result<Agreement, Mismatch> {
    if a.backend == b.backend {
        return Err(Mismatch::SameBackend(a.backend.to_owned()));
    }
    let (a, b) = (a.result, b.result);
    if (a.dim, a.levels, a.count(), a.end.len(), a.samples.len())
        != (b.dim, b.levels, b.count(), b.end.len(), b.samples.len())
    {
        return Err(Mismatch::Shape);
    }
    let mut agreement = Agreement::default();
    let mut value = |trajectory: usize, what: &dyn Fn() -> String, p: f64, q: f64| {
        let allowed = tolerance.absolute + tolerance.relative * p.abs().max(q.abs());
        let units = if p == q { 0.0 } else { (p - q).abs() / allowed };
        // A NaN on either side is a mismatch.
        if units.is_nan() || units > 1.0 {
            return Err(Mismatch::Value {
                trajectory,
                what: what(),
                a: p,
                b: q,
                units,
            });
        }
        agreement.worst = agreement.worst.max(units);
        agreement.values += 1;
        Ok(())
    };
    let (mut samples, mut split) = (0, 0);
    for i in 0..a.count() {
        let loose = [a.status[i], b.status[i]]
            .iter()
            .any(|s| tolerance.loose.contains(s));
        if a.status[i] != b.status[i] {
            if !loose {
                return Err(Mismatch::Status {
                    trajectory: i,
                    a: a.status[i],
                    b: b.status[i],
                });
            }
            split += 1;
        }
        let (p, q) = (a.steps[i] + a.rejected[i], b.steps[i] + b.rejected[i]);
        if p.abs_diff(q) > (tolerance.steps)(p) {
            return Err(Mismatch::Steps {
                trajectory: i,
                a: p,
                b: q,
            });
        }
        if a.status[i] == Status::NotFinite {
            continue;
        }
        if !loose {
            value(i, &|| "end time".to_owned(), a.end_time[i], b.end_time[i])?;
            for c in 0..a.dim {
                value(
                    i,
                    &|| format!("end component {c}"),
                    a.end[i * a.dim + c],
                    b.end[i * a.dim + c],
                )?;
            }
        }
        for k in 0..a.levels {
            let (p, q) = (a.sample(i, k), b.sample(i, k));
            if p[0].is_nan() || q[0].is_nan() {
                if !loose && p[0].is_nan() != q[0].is_nan() {
                    return Err(Mismatch::Passed {
                        trajectory: i,
                        level: k,
                    });
                }
                continue;
            }
            samples += 1;
            for c in 0..=a.dim {
                value(i, &|| format!("level {k} entry {c}"), p[c], q[c])?;
            }
        }
    }
    agreement.split = split;
    agreement.samples = samples;
    Ok(agreement)
}

/// Any adapter, a software one included. A machine without one fails the test: GPU code that
/// nothing runs is not tested.
pub fn any_gpu() -> Gpu {
    match Gpu::open(&Selection::Any) {
        Ok(Some(gpu)) => gpu,
        Ok(None) => {
            panic!("no adapter was found; install a software one (Debian: mesa-vulkan-drivers)")
        }
        Err(e) => panic!("{e}; install a software adapter (Debian: mesa-vulkan-drivers)"),
    }
}

/// Whether to leave out a test of compiled code. On a machine without AVX2 the test fails, unless
/// `COSTATE_WITHOUT_AVX2` says that this is known.
pub fn without_avx2(missing: bool) -> bool {
    assert!(
        !missing || std::env::var_os("COSTATE_WITHOUT_AVX2").is_some(),
        "this test needs AVX2: set COSTATE_WITHOUT_AVX2=1 to leave it out on a machine without"
    );
    missing
}
