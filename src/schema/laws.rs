//! Fitted laws.

use super::{Along, Group, Unit, along, integer, real, text};

/// A row for each fitted law.
pub static FEEDBACK: Group = Group {
    name: "feedback",
    title: "feedback laws fitted to the trajectories of this file",
    dimensions: &[along("law", Along::Names, "fitted law")],
    variables: &[
        text("name", &["law"], "name of the law"),
        text("kind", &["law"], "what was fitted: u or V"),
        text("outputs", &["law"], "what the law commands"),
        text("toml", &["law"], "the weights file"),
        real(
            "u_mean_relative_error",
            &["law"],
            Unit::One,
            "mean |u - u_fit| over mean |u|, held-out trajectories",
        ),
        real(
            "u_max_relative_error",
            &["law"],
            Unit::One,
            "largest |u - u_fit| over mean |u|, held-out trajectories",
        ),
        real(
            "u_mean_error_of_range",
            &["law"],
            Unit::One,
            "mean |u - u_fit| over the range of u, held-out trajectories",
        ),
        real(
            "V_mean_relative_error",
            &["law"],
            Unit::One,
            "mean |V - V_fit| over mean V, held-out trajectories",
        ),
        real(
            "V_max_relative_error",
            &["law"],
            Unit::One,
            "largest |V - V_fit| over mean V, held-out trajectories",
        ),
        real(
            "p_mean_relative_error",
            &["law"],
            Unit::One,
            "mean |p - p_fit| over mean |p|, in widths of the region, held-out trajectories",
        ),
        real(
            "p_max_relative_error",
            &["law"],
            Unit::One,
            "largest |p - p_fit| over mean |p|, in widths of the region, held-out trajectories",
        ),
        real(
            "hjb_residual_median",
            &["law"],
            Unit::One,
            "|H(x, dV/dx)| over the running cost's mean, median over held-out trajectories",
        ),
        real(
            "hjb_residual_90",
            &["law"],
            Unit::One,
            "the same, 90 % quantile",
        ),
        real(
            "hjb_residual_99",
            &["law"],
            Unit::One,
            "the same, 99 % quantile",
        ),
        real("hjb_residual_max", &["law"], Unit::One, "the same, largest"),
        real(
            "running_cost_scale",
            &["law"],
            Unit::One,
            "mean running cost over held-out trajectories",
        ),
        real(
            "loss_mean",
            &["law"],
            Unit::One,
            "H(x, p, u_fit) - H(x, p, u*) over the running cost's mean, mean over held-out trajectories",
        ),
        real("loss_99", &["law"], Unit::One, "the same, 99 % quantile"),
        real("loss_max", &["law"], Unit::One, "the same, largest"),
        real(
            "training_residual",
            &["law"],
            Unit::One,
            "root mean square of normalized residuals, training set",
        ),
        real(
            "validation_residual",
            &["law"],
            Unit::One,
            "root mean square of normalized residuals, validation set",
        ),
        real(
            "flops",
            &["law"],
            Unit::One,
            "floating-point operations of a call",
        ),
        real("fit_seconds", &["law"], Unit::Fixed("s"), "time of the fit"),
        real("parameters", &["law"], Unit::One, "weights and biases"),
        real(
            "iterations",
            &["law"],
            Unit::One,
            "steps of Levenberg-Marquardt up to these weights",
        ),
        real(
            "seed",
            &["law"],
            Unit::One,
            "seed of the sets and the first weights",
        ),
        integer("training_samples", &["law"], "samples of the training set"),
        integer(
            "validation_samples",
            &["law"],
            "samples of the validation set",
        ),
        integer("test_samples", &["law"], "samples of the test set"),
        integer(
            "training_trajectories",
            &["law"],
            "trajectories of the training set",
        ),
        integer(
            "validation_trajectories",
            &["law"],
            "trajectories of the validation set",
        ),
        integer(
            "test_trajectories",
            &["law"],
            "trajectories of the test set",
        ),
        integer(
            "narrow_units",
            &["law"],
            "hidden units whose transition is narrower than the spacing of the samples",
        ),
        integer("starts", &["law"], "trainings from different first weights"),
    ],
    attributes: &[],
};
