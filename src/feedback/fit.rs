//! The fit of a law: data, training in normalized variables, weights in the scene's own, and what
//! it is worth.

use super::law::{ClosedForm, Law, LawError, Meaning, Polynomial};
use super::network::{Layer, Network};
use super::quality::Quality;
use super::regression::{Pinned, Regression};
use super::samples::{Optimality, Samples, Selection};
use super::shape::Shape;
use super::training::{Rules, Step, Trained, train};
use super::units;
use crate::backend::Deadline;
use crate::backend::flops;
use crate::hamiltonian::Hamiltonian;
use crate::local::{LocalError, Riccati, linear_law};
use crate::model::{Base, Feedback, LawOutput, Model, Precision, Target};
use crate::program::Program;
use nalgebra::{DMatrix, DVector};
use std::time::Instant;

/// Trajectories without which there is nothing to divide.
const LEAST_TRAJECTORIES: usize = 3;
/// What is to be fitted must vary by this much of its size: less is rounding.
const LEAST_SPREAD: f64 = 1e-9;

/// Why a law was not fitted.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FitError {
    #[error(
        "law `{law}`: of {offered} samples {selected} lie in its box and under its conditions, of {trajectories} trajectories; \
         a fit needs at least {LEAST_TRAJECTORIES} of them (a wider box, fewer conditions, a larger value_max of the sweep?)"
    )]
    TooFew {
        law: String,
        offered: usize,
        selected: usize,
        trajectories: usize,
    },
    #[error(
        "law `{law}` has {parameters} weights, and only {residuals} data to train them: fewer units, or more samples"
    )]
    TooManyWeights {
        law: String,
        parameters: usize,
        residuals: usize,
    },
    #[error("law `{law}`: {source}")]
    Local { law: String, source: LocalError },
    #[error("law `{law}`: {source}")]
    Law { law: String, source: LawError },
    /// The training was given up.
    #[error("law `{law}`: the time given is over")]
    OutOfTime { law: String },
}

/// A fitted law and what is known of it.
#[derive(Clone, Debug)]
pub struct FittedLaw {
    pub name: String,
    pub law: Law,
    pub form: ClosedForm,
    pub selection: Selection,
    /// Samples of the training, validation and test sets.
    pub sets: [usize; 3],
    /// Trajectories of these sets.
    pub trajectories: [usize; 3],
    /// On the test set.
    pub quality: Quality,
    pub parameters: usize,
    /// Steps of the best start.
    pub iterations: usize,
    /// Root mean squares of normalized residuals, training and validation.
    pub residuals: [f64; 2],
    /// Hidden units whose transition is narrower than the spacing of the samples.
    pub narrow_units: usize,
    /// Floating-point operations of a call.
    pub flops: f64,
    pub seconds: f64,
    pub seed: u64,
    pub starts: usize,
}

/// What a fit reads: the scene and the points of its optimal trajectories.
#[derive(Clone, Copy)]
pub struct Data<'d> {
    pub model: &'d Model,
    pub hamiltonian: &'d Hamiltonian,
    pub samples: &'d Samples,
    /// See [`Samples::select`].
    pub known: &'d Optimality<'d>,
    /// When the fit is given up.
    pub deadline: Deadline,
}

/// Means and spreads by which variables are normalized.
struct Scales {
    center: Vec<f64>,
    width: Vec<f64>,
    mean: Vec<f64>,
    spread: Vec<f64>,
}

/// Fits a law. `scene` is the one that the law is part of: that of the data, or another one of the
/// same states and controls. `progress` is called from all threads.
///
/// # Errors
/// [`FitError`] where there are too few data, or no local solution to build on.
pub fn fit(
    data: Data<'_>,
    scene: &Model,
    law: &Feedback,
    progress: &(dyn Fn(Step) + Sync),
) -> Result<FittedLaw, FitError> {
    let clock = Instant::now();
    let (samples, selection) = selected(data, scene, law)?;
    let sets = samples.split(law);
    let base = base(data, law)?;
    let fitted = [&sets.training, &sets.validation].map(|s| unscaled(law, base.as_ref(), s));
    let scales = Scales::of(law, base.is_some(), &fitted[0]);
    let [mut training, validation] = fitted.map(|r| scales.normalized(r, law, base.as_ref()));
    let shape = shape(law, &training)?;
    let spacing = units::spacing(&training, &sets.training.trajectory);
    training.steepest = units::steepest(&shape, spacing);
    let rules = Rules {
        starts: law.starts,
        seed: law.seed,
        iterations: law.iterations,
        patience: law.patience,
        deadline: data.deadline,
    };
    let trained = train(&shape, &training, &validation, rules, progress);
    let trained = trained.ok_or_else(|| FitError::OutOfTime {
        law: law.name.clone(),
    })?;
    let made = assemble(data.model, law, &shape, &trained, &scales, base);
    let form = made.closed_form(data.model, data.hamiltonian);
    let form = form.map_err(|source| FitError::Law {
        law: law.name.clone(),
        source,
    })?;
    let program = Program::lower(&form.graph, &form.x, &form.commands);
    let (test, wanted) = (&sets.test, commanded(law, &sets.test));
    let quality = Quality::of(&form, data.model, data.hamiltonian, test, &wanted);
    let all = [&sets.training, &sets.validation, &sets.test];
    Ok(FittedLaw {
        name: law.name.clone(),
        parameters: shape.parameters(),
        law: made,
        selection,
        sets: all.map(Samples::len),
        trajectories: all.map(count_trajectories),
        quality,
        iterations: trained.iterations,
        residuals: [trained.training, trained.validation],
        narrow_units: units::narrow(&shape, &trained.weights, &training, spacing),
        flops: flops::of_program(&program, Precision::F64),
        seconds: clock.elapsed().as_secs_f64(),
        seed: law.seed,
        starts: law.starts,
        form,
    })
}

/// The samples that a law is fitted to.
///
/// # Errors
/// [`FitError::TooFew`], [`FitError::OutOfTime`].
fn selected(
    data: Data<'_>,
    scene: &Model,
    law: &Feedback,
) -> Result<(Samples, Selection), FitError> {
    // A map takes its time to tell of all samples.
    let known = |x: &[f64], v: f64| match data.deadline.has_passed() {
        true => Some(false),
        false => (data.known)(x, v),
    };
    let (samples, selection) = data.samples.select(scene, law, &known);
    data.deadline.check().map_err(|_| FitError::OutOfTime {
        law: law.name.clone(),
    })?;
    let trajectories = count_trajectories(&samples);
    if trajectories < LEAST_TRAJECTORIES {
        return Err(FitError::TooFew {
            law: law.name.clone(),
            offered: selection.offered,
            selected: selection.selected,
            trajectories,
        });
    }
    Ok((samples, selection))
}

/// The shape of a law's network.
///
/// # Errors
/// [`FitError::TooManyWeights`].
fn shape(law: &Feedback, training: &Regression) -> Result<Shape, FitError> {
    let shape = Shape {
        sizes: [
            &[training.inputs],
            law.hidden.as_slice(),
            &[training.outputs],
        ]
        .concat(),
        activation: law.activation,
    };
    if shape.parameters() > training.residuals() {
        return Err(FitError::TooManyWeights {
            law: law.name.clone(),
            parameters: shape.parameters(),
            residuals: training.residuals(),
        });
    }
    Ok(shape)
}

fn count_trajectories(samples: &Samples) -> usize {
    let mut all = samples.trajectory.clone();
    all.sort_unstable();
    all.dedup();
    all.len()
}

/// What the law's outputs are at samples; all controls where V is fitted.
fn commanded(law: &Feedback, samples: &Samples) -> Vec<f64> {
    let of = |k: usize| -> Vec<f64> {
        match &law.target {
            Target::Value => samples.u_of(k).to_vec(),
            Target::Law(outputs) => (outputs.iter())
                .map(|output| match *output {
                    LawOutput::Control(i) => samples.u_of(k)[i],
                    LawOutput::State(i) => samples.x_of(k)[i],
                })
                .collect(),
        }
    };
    (0..samples.len()).flat_map(of).collect()
}

/// The local solution in the law's inputs, where it is asked for.
fn base(data: Data<'_>, law: &Feedback) -> Result<Option<Polynomial>, FitError> {
    if law.base == Base::None {
        return Ok(None);
    }
    let riccati =
        Riccati::solve(data.hamiltonian, data.model).map_err(|source| FitError::Local {
            law: law.name.clone(),
            source,
        })?;
    let reference = data.model.reference();
    let center = law.inputs.iter().map(|i| reference[*i]).collect();
    let Target::Law(outputs) = &law.target else {
        let among = |i: usize, j: usize| riccati.p[(law.inputs[i], law.inputs[j])];
        let n = law.inputs.len();
        return Ok(Some(Polynomial {
            center,
            constant: vec![0.0],
            linear: DMatrix::zeros(1, n),
            quadratic: Some(DMatrix::from_fn(n, n, |i, j| {
                0.5 * (among(i, j) + among(j, i))
            })),
        }));
    };
    let h = data.hamiltonian;
    let at = h.graph.eval(&h.unclamped, &h.point(data.model));
    let gain = linear_law(h, data.model, &riccati);
    let controls = outputs.iter().filter_map(|o| match o {
        LawOutput::Control(i) => Some(*i),
        LawOutput::State(_) => None,
    });
    let controls: Vec<usize> = controls.collect();
    Ok(Some(Polynomial {
        center,
        constant: controls.iter().map(|i| at[*i]).collect(),
        linear: DMatrix::from_fn(controls.len(), law.inputs.len(), |o, i| {
            gain[controls[o]][law.inputs[i]]
        }),
        quadratic: None,
    }))
}

/// The regression in the scene's variables, what the base gives taken off.
fn unscaled(law: &Feedback, base: Option<&Polynomial>, samples: &Samples) -> Regression {
    let wanted = match law.target {
        Target::Value => samples.v.clone(),
        Target::Law(_) => commanded(law, samples),
    };
    let outputs = wanted.len() / samples.len().max(1);
    let n = law.inputs.len();
    let mut regression = Regression {
        inputs: n,
        outputs,
        y: wanted,
        ..Regression::default()
    };
    for k in 0..samples.len() {
        let x: Vec<f64> = law.inputs.iter().map(|i| samples.x_of(k)[*i]).collect();
        let mut slopes: Vec<f64> = Vec::new();
        if law.gradient {
            slopes.extend(law.inputs.iter().map(|i| samples.p_of(k)[*i]));
        }
        if let Some(base) = base {
            let y = &mut regression.y[k * outputs..][..outputs];
            y.iter_mut()
                .enumerate()
                .for_each(|(o, y)| *y -= base.eval(&x, o));
            slopes
                .iter_mut()
                .zip(base.slopes(&x))
                .for_each(|(s, b)| *s -= b);
        }
        regression.x.extend(x);
        regression.slopes.extend(slopes);
    }
    regression
}

impl Scales {
    fn of(law: &Feedback, pinned: bool, data: &Regression) -> Self {
        let column = |values: &[f64], width: usize, i: usize| -> (f64, f64) {
            let count = (values.len() / width).max(1) as f64;
            let all = || values.iter().skip(i).step_by(width);
            let mean = all().sum::<f64>() / count;
            let square = all().map(|v| (v - mean).powi(2)).sum::<f64>() / count;
            (mean, square.sqrt())
        };
        let (center, width): (Vec<f64>, Vec<f64>) = (0..data.inputs)
            .map(|i| {
                let (mean, spread) = column(&data.x, data.inputs, i);
                let [lower, upper] = law.bounds[law.inputs[i]];
                // An input that does not vary in the data is not to be blown up.
                (mean, spread.max(1e-6 * (upper - lower)))
            })
            .unzip();
        let (mean, spread): (Vec<f64>, Vec<f64>) = (0..data.outputs)
            .map(|o| {
                let (mean, spread) = column(&data.y, data.outputs, o);
                let mean = if pinned { 0.0 } else { mean };
                let size = (mean.abs() + spread).max(f64::MIN_POSITIVE);
                (
                    mean,
                    if spread > LEAST_SPREAD * size {
                        spread
                    } else {
                        size
                    },
                )
            })
            .unzip();
        Self {
            center,
            width,
            mean,
            spread,
        }
    }

    fn normalized(
        &self,
        mut data: Regression,
        law: &Feedback,
        base: Option<&Polynomial>,
    ) -> Regression {
        let place = |x: f64, i: usize| (x - self.center[i]) / self.width[i];
        let (inputs, outputs) = (data.inputs, data.outputs);
        for (k, x) in data.x.iter_mut().enumerate() {
            *x = place(*x, k % inputs);
        }
        for (k, y) in data.y.iter_mut().enumerate() {
            *y = (*y - self.mean[k % outputs]) / self.spread[k % outputs];
        }
        for (k, slope) in data.slopes.iter_mut().enumerate() {
            *slope *= self.width[k % inputs] / self.spread[0];
        }
        data.pinned = base.map(|base| Pinned {
            at: base
                .center
                .iter()
                .enumerate()
                .map(|(i, x)| place(*x, i))
                .collect(),
            slopes: law.target == Target::Value,
        });
        data
    }

    /// The trained network as one of the scene's variables.
    fn layers(&self, shape: &Shape, weights: &[f64]) -> Vec<Layer> {
        let mut layers: Vec<Layer> = (shape.places().into_iter().zip(shape.sizes.windows(2)))
            .map(|([begin, biases, end], sizes)| Layer {
                weights: DMatrix::from_row_slice(sizes[1], sizes[0], &weights[begin..biases]),
                bias: DVector::from_column_slice(&weights[biases..end]),
            })
            .collect();
        let first = &mut layers[0];
        for (i, (center, width)) in self.center.iter().zip(&self.width).enumerate() {
            first.weights.column_mut(i).scale_mut(1.0 / width);
            let shift = first.weights.column(i) * *center;
            first.bias -= shift;
        }
        let last = layers.last_mut().expect("a network has a layer");
        for (o, (mean, spread)) in self.mean.iter().zip(&self.spread).enumerate() {
            last.weights.row_mut(o).scale_mut(*spread);
            last.bias[o] = last.bias[o] * spread + mean;
        }
        layers
    }
}

impl Polynomial {
    /// Derivatives of the only output.
    fn slopes(&self, x: &[f64]) -> Vec<f64> {
        let d = DVector::from_iterator(x.len(), x.iter().zip(&self.center).map(|(x, c)| x - c));
        let mut slopes = self.linear.row(0).transpose();
        if let Some(quadratic) = &self.quadratic {
            slopes += quadratic * d;
        }
        slopes.as_slice().to_vec()
    }
}

/// The law in the scene's variables; what pins the network at the equilibrium goes into the base.
fn assemble(
    model: &Model,
    law: &Feedback,
    shape: &Shape,
    trained: &Trained,
    scales: &Scales,
    mut base: Option<Polynomial>,
) -> Law {
    let name = |i: usize| model.states[i].variable.name.clone();
    let (meaning, outputs) = match &law.target {
        Target::Value => (Meaning::Value, vec!["V".to_owned()]),
        Target::Law(outputs) => {
            let names = outputs.iter().map(|output| match *output {
                LawOutput::Control(i) => model.controls[i].variable.name.clone(),
                LawOutput::State(i) => name(i),
            });
            (Meaning::Law, names.collect())
        }
    };
    let network = Network {
        activation: law.activation,
        inputs: law.inputs.iter().map(|i| name(*i)).collect(),
        outputs,
        layers: scales.layers(shape, &trained.weights),
    };
    if let Some(base) = &mut base {
        let at = network.eval(&base.center);
        base.constant.iter_mut().zip(at).for_each(|(c, n)| *c -= n);
        if meaning == Meaning::Value {
            let mut pass = shape.pass();
            let place = |(i, x): (usize, &f64)| (x - scales.center[i]) / scales.width[i];
            let place: Vec<f64> = base.center.iter().enumerate().map(place).collect();
            shape.forward(&trained.weights, &place, &mut pass);
            for i in 0..place.len() {
                let slope = shape.slope(&trained.weights, i, &mut pass)[0];
                base.linear[(0, i)] -= slope * scales.spread[0] / scales.width[i];
            }
        }
    }
    Law {
        meaning,
        network,
        base,
    }
}
