//! What is to be measured: backend x precision x method x tolerance (or step).

use costate::backend::Backend;
use costate::low_level::model::{Method, Precision};
use costate::low_level::sweep::Plan;

/// How long steps are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Steps {
    /// Relative tolerance of a step.
    Tolerance(f64),
    /// Length of all steps, in the scene's unit of time.
    Fixed(f64),
}

impl Steps {
    pub fn rtol(self) -> Option<f64> {
        match self {
            Steps::Tolerance(rtol) => Some(rtol),
            Steps::Fixed(_) => None,
        }
    }

    pub fn step(self) -> Option<f64> {
        match self {
            Steps::Tolerance(_) => None,
            Steps::Fixed(step) => Some(step),
        }
    }
}

/// What a kernel is compiled for once.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Series {
    /// Index into the list of backends.
    pub device: usize,
    pub precision: Precision,
    pub method: Method,
}

/// A series with its steps, from rough to fine.
#[derive(Clone, Debug, PartialEq)]
pub struct Ladder {
    pub series: Series,
    pub steps: Vec<Steps>,
}

/// Something that is not measured, and the reason.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Missing {
    pub what: String,
    pub why: String,
}

/// What the user wants measured.
#[derive(Clone, Debug)]
pub struct Wanted {
    pub precisions: Vec<Precision>,
    pub methods: Vec<Method>,
    /// Relative tolerances of a step.
    pub tolerances: Vec<f64>,
}

impl Default for Wanted {
    /// Everything that a scenario may ask for.
    fn default() -> Self {
        Self {
            precisions: vec![Precision::F32, Precision::F64],
            methods: Method::ALL.iter().map(|(_, m)| *m).collect(),
            tolerances: (3..=12).map(|k| 10f64.powi(-k)).collect(),
        }
    }
}

/// Steps of a fixed-step method along a trajectory of median duration: from about as few as an
/// adaptive method takes at a loose tolerance to as many as one of low order takes at a tight one.
const FIXED_STEPS: [f64; 8] = [16.0, 32.0, 64.0, 128.0, 256.0, 512.0, 1024.0, 2048.0];

/// All ladders on some backends, and what they cannot do. `duration` is that of the median
/// trajectory.
pub fn ladders(
    backends: &[Box<dyn Backend>],
    wanted: &Wanted,
    duration: f64,
) -> (Vec<Ladder>, Vec<Missing>) {
    let (mut ladders, mut missing) = (Vec::new(), Vec::new());
    for (device, backend) in backends.iter().enumerate() {
        for &precision in &wanted.precisions {
            if !backend.supports(precision) {
                missing.push(Missing {
                    what: format!("{} {}", backend.adapter(), precision.name()),
                    why: format!("the device has no {} arithmetic", precision.name()),
                });
                continue;
            }
            for &method in &wanted.methods {
                if !backend.offers(method) {
                    missing.push(Missing {
                        what: format!(
                            "{} {} {}",
                            backend.adapter(),
                            precision.name(),
                            method.name()
                        ),
                        why: "the backend has no such method".into(),
                    });
                    continue;
                }
                let series = Series {
                    device,
                    precision,
                    method,
                };
                let steps = if !method.adaptive() {
                    FIXED_STEPS
                        .iter()
                        .map(|n| Steps::Fixed(two_digits(duration / n)))
                        .collect()
                } else {
                    (wanted.tolerances.iter())
                        .filter(|rtol| **rtol >= Plan::least_rtol(precision))
                        .map(|rtol| Steps::Tolerance(*rtol))
                        .collect::<Vec<_>>()
                };
                if !steps.is_empty() {
                    ladders.push(Ladder { series, steps });
                }
            }
        }
    }
    (ladders, missing)
}

/// A number that can be written into a scenario.
fn two_digits(x: f64) -> f64 {
    format!("{x:.1e}").parse().unwrap_or(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use costate::backend::cpu::Cpu;

    #[test]
    fn every_method_has_a_ladder_within_what_its_precision_resolves() {
        let backends: Vec<Box<dyn Backend>> = vec![Box::new(Cpu::new())];
        let (ladders, missing) = ladders(&backends, &Wanted::default(), 1.7);
        assert!(missing.is_empty());
        assert_eq!(ladders.len(), 2 * Method::ALL.len());
        for ladder in &ladders {
            let finest = ladder.steps.last().unwrap();
            match (!ladder.series.method.adaptive(), ladder.series.precision) {
                (true, _) => assert!(finest.step().unwrap() < 1e-3),
                (false, Precision::F32) => assert_eq!(finest.rtol(), Some(1e-6)),
                (false, Precision::F64) => assert_eq!(finest.rtol(), Some(1e-12)),
            }
        }
        assert_eq!(two_digits(0.012_345), 0.012);
    }
}
