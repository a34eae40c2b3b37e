//! Fitted laws in the result file: `/feedback`.

use super::table::{NO_AXES, Table};
use crate::feedback::{Fitted, FittedLaw};
use crate::hdf5::{OutputError, ResultFile};
use crate::schema;

/// The group that fitted laws are written to.
pub const FEEDBACK_GROUP: &str = schema::FEEDBACK.name;

type Number = (&'static str, fn(&FittedLaw) -> f64);

/// Floating-point variables: name, value.
const NUMBERS: [Number; 22] = [
    ("u_mean_relative_error", |l| l.quality.u.mean),
    ("u_max_relative_error", |l| l.quality.u.max),
    ("u_mean_error_of_range", |l| l.quality.u.mean_of_range),
    ("V_mean_relative_error", |l| or_nan(l.quality.v, |e| e.mean)),
    ("V_max_relative_error", |l| or_nan(l.quality.v, |e| e.max)),
    ("p_mean_relative_error", |l| or_nan(l.quality.p, |e| e.mean)),
    ("p_max_relative_error", |l| or_nan(l.quality.p, |e| e.max)),
    ("hjb_residual_median", |l| {
        or_nan(l.quality.hjb, |h| h.median)
    }),
    ("hjb_residual_90", |l| or_nan(l.quality.hjb, |h| h.q90)),
    ("hjb_residual_99", |l| or_nan(l.quality.hjb, |h| h.q99)),
    ("hjb_residual_max", |l| or_nan(l.quality.hjb, |h| h.max)),
    ("running_cost_scale", |l| or_nan(l.quality.hjb, |h| h.scale)),
    ("loss_mean", |l| or_nan(l.quality.loss.as_ref(), |e| e.mean)),
    ("loss_99", |l| or_nan(l.quality.loss.as_ref(), |e| e.q99)),
    ("loss_max", |l| or_nan(l.quality.loss.as_ref(), |e| e.max)),
    ("training_residual", |l| l.residuals[0]),
    ("validation_residual", |l| l.residuals[1]),
    ("flops", |l| l.flops),
    ("fit_seconds", |l| l.seconds),
    ("parameters", |l| l.parameters as f64),
    ("iterations", |l| l.iterations as f64),
    ("seed", |l| l.seed as f64),
];

type Count = (&'static str, fn(&FittedLaw) -> usize);

/// Integer variables.
const COUNTS: [Count; 8] = [
    ("training_samples", |l| l.sets[0]),
    ("validation_samples", |l| l.sets[1]),
    ("test_samples", |l| l.sets[2]),
    ("training_trajectories", |l| l.trajectories[0]),
    ("validation_trajectories", |l| l.trajectories[1]),
    ("test_trajectories", |l| l.trajectories[2]),
    ("narrow_units", |l| l.narrow_units),
    ("starts", |l| l.starts),
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
        let laws = &self.laws;
        let text = |of: fn(&FittedLaw) -> String| laws.iter().map(of).collect::<Vec<String>>();
        let mut table = Table::new(&schema::FEEDBACK, &NO_AXES)
            .labels("law", laws.iter().map(|l| l.name.as_str()));
        table
            .put("name", text(|l| l.name.clone()))
            .put("kind", text(|l| l.law.meaning.name().to_owned()))
            .put("outputs", text(|l| l.form.outputs.join(" ")))
            .put("toml", text(|l| l.law.to_toml()));
        for (name, of) in NUMBERS {
            table.put(name, laws.iter().map(of).collect::<Vec<f64>>());
        }
        for (name, of) in COUNTS {
            let counts = laws.iter().map(|l| of(l) as i32);
            table.put(name, counts.collect::<Vec<i32>>());
        }
        table.write(file)
    }
}
