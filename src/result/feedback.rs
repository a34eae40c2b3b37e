//! Fitted laws in the result file: `/feedback`.

use crate::feedback::{Fitted, FittedLaw};
use crate::hdf5::{Dimension, Group, OutputError, ResultFile, Variable};

/// The group that fitted laws are written to.
pub const FEEDBACK_GROUP: &str = "feedback";

type Number = (&'static str, &'static str, fn(&FittedLaw) -> f64);

/// Floating-point variables: name, meaning, value.
const NUMBERS: [Number; 22] = [
    (
        "u_mean_relative_error",
        "mean |u - u_fit| over mean |u|, held-out trajectories",
        |l| l.quality.u.mean,
    ),
    (
        "u_max_relative_error",
        "largest |u - u_fit| over mean |u|, held-out trajectories",
        |l| l.quality.u.max,
    ),
    (
        "u_mean_error_of_range",
        "mean |u - u_fit| over the range of u, held-out trajectories",
        |l| l.quality.u.mean_of_range,
    ),
    (
        "V_mean_relative_error",
        "mean |V - V_fit| over mean V, held-out trajectories",
        |l| or_nan(l.quality.v, |e| e.mean),
    ),
    (
        "V_max_relative_error",
        "largest |V - V_fit| over mean V, held-out trajectories",
        |l| or_nan(l.quality.v, |e| e.max),
    ),
    (
        "p_mean_relative_error",
        "mean |p - p_fit| over mean |p|, in widths of the region, held-out trajectories",
        |l| or_nan(l.quality.p, |e| e.mean),
    ),
    (
        "p_max_relative_error",
        "largest |p - p_fit| over mean |p|, in widths of the region, held-out trajectories",
        |l| or_nan(l.quality.p, |e| e.max),
    ),
    (
        "hjb_residual_median",
        "|H(x, dV/dx)| over the running cost's mean, median over held-out trajectories",
        |l| or_nan(l.quality.hjb, |h| h.median),
    ),
    ("hjb_residual_90", "the same, 90 % quantile", |l| {
        or_nan(l.quality.hjb, |h| h.q90)
    }),
    ("hjb_residual_99", "the same, 99 % quantile", |l| {
        or_nan(l.quality.hjb, |h| h.q99)
    }),
    ("hjb_residual_max", "the same, largest", |l| {
        or_nan(l.quality.hjb, |h| h.max)
    }),
    (
        "running_cost_scale",
        "mean running cost over held-out trajectories",
        |l| or_nan(l.quality.hjb, |h| h.scale),
    ),
    (
        "loss_mean",
        "H(x, p, u_fit) - H(x, p, u*) over the running cost's mean, mean over held-out trajectories",
        |l| or_nan(l.quality.loss.as_ref(), |e| e.mean),
    ),
    ("loss_99", "the same, 99 % quantile", |l| {
        or_nan(l.quality.loss.as_ref(), |e| e.q99)
    }),
    ("loss_max", "the same, largest", |l| {
        or_nan(l.quality.loss.as_ref(), |e| e.max)
    }),
    (
        "training_residual",
        "root mean square of normalized residuals, training set",
        |l| l.residuals[0],
    ),
    (
        "validation_residual",
        "root mean square of normalized residuals, validation set",
        |l| l.residuals[1],
    ),
    ("flops", "floating-point operations of a call", |l| l.flops),
    ("fit_seconds", "time of the fit", |l| l.seconds),
    ("parameters", "weights and biases", |l| l.parameters as f64),
    (
        "iterations",
        "steps of Levenberg-Marquardt up to these weights",
        |l| l.iterations as f64,
    ),
    ("seed", "seed of the sets and the first weights", |l| {
        l.seed as f64
    }),
];

type Count = (&'static str, &'static str, fn(&FittedLaw) -> usize);

/// Integer variables.
const COUNTS: [Count; 8] = [
    ("training_samples", "samples of the training set", |l| {
        l.sets[0]
    }),
    ("validation_samples", "samples of the validation set", |l| {
        l.sets[1]
    }),
    ("test_samples", "samples of the test set", |l| l.sets[2]),
    (
        "training_trajectories",
        "trajectories of the training set",
        |l| l.trajectories[0],
    ),
    (
        "validation_trajectories",
        "trajectories of the validation set",
        |l| l.trajectories[1],
    ),
    ("test_trajectories", "trajectories of the test set", |l| {
        l.trajectories[2]
    }),
    (
        "narrow_units",
        "hidden units whose transition is narrower than the spacing of the samples",
        |l| l.narrow_units,
    ),
    ("starts", "trainings from different first weights", |l| {
        l.starts
    }),
];

fn or_nan<T>(of: Option<T>, number: fn(T) -> f64) -> f64 {
    of.map_or(f64::NAN, number)
}

impl Fitted {
    /// Writes the group `/feedback`.
    ///
    /// # Errors
    /// Those of the file.
    pub fn write(&self, file: &mut ResultFile) -> Result<(), OutputError> {
        let names = || self.laws.iter().map(|l| l.name.clone());
        let text = |name: &str, what: &str, of: &dyn Fn(&FittedLaw) -> String| {
            Variable::text(name, "law", self.laws.iter().map(of)).long_name(what)
        };
        let mut group = Group::new(FEEDBACK_GROUP)
            .dimension(Dimension::names("law", names()).long_name("fitted law"))
            .variable(text("name", "name of the law", &|l| l.name.clone()))
            .variable(text("kind", "what was fitted: u or V", &|l| {
                l.law.meaning.name().to_owned()
            }))
            .variable(text("outputs", "what the law commands", &|l| {
                l.form.outputs.join(" ")
            }))
            .variable(text("toml", "the weights file", &|l| l.law.to_toml()));
        for (name, what, _) in NUMBERS {
            group = group.variable(Variable::f64(name, ["law"]).long_name(what));
        }
        for (name, what, _) in COUNTS {
            group = group.variable(Variable::i32(name, ["law"]).long_name(what));
        }
        let mut writer = file.group(&group)?;
        for (name, _, of) in NUMBERS {
            writer.write(name, &self.laws.iter().map(of).collect::<Vec<f64>>())?;
        }
        for (name, _, of) in COUNTS {
            writer.write(
                name,
                &self.laws.iter().map(|l| of(l) as i32).collect::<Vec<i32>>(),
            )?;
        }
        Ok(())
    }
}
