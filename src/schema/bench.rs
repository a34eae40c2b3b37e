//! Speed against error, as `costate bench` measures it.

use super::{Along, Group, Unit, along, integer, real, text};

const VALUE: &str = "error of V off the manifold, |V - V_ref - p_ref.(x - x_ref)|/max(1, V_ref), largest of a trajectory";
const COSTATE: &str = "error of p off the manifold, |p - p_ref - dp/dx (x - x_ref)|/max(1, |p_ref|), p times the region's widths, largest of a trajectory";
const HAMILTONIAN: &str = "change of H against the reference relative to the largest running cost, largest of a trajectory";

/// A row for each variant that was measured.
pub static SPEED_ERROR: Group = Group {
    name: "speed_error",
    title: "speed against error",
    dimensions: &[along("row", Along::Index, "row index")],
    variables: &[
        text("backend", &["row"], "what integrated"),
        text("adapter", &["row"], "device"),
        text("precision", &["row"], "arithmetic"),
        text("method", &["row"], "integration method"),
        real(
            "rtol",
            &["row"],
            Unit::One,
            "relative tolerance of a step; NaN for a fixed step",
        ),
        real(
            "atol",
            &["row"],
            Unit::One,
            "absolute tolerance in units of each component's scale; NaN for a fixed step",
        ),
        real(
            "step",
            &["row"],
            Unit::Time,
            "fixed step; NaN for an adaptive method",
        ),
        real(
            "seconds_median",
            &["row"],
            Unit::Fixed("s"),
            "all trajectories, seeds on the host to results on the host: median pass",
        ),
        real("seconds_min", &["row"], Unit::Fixed("s"), "shortest pass"),
        real("seconds_max", &["row"], Unit::Fixed("s"), "longest pass"),
        real(
            "trajectories_per_second",
            &["row"],
            Unit::Fixed("1/s"),
            "end to end, median pass",
        ),
        real(
            "kernel_seconds_median",
            &["row"],
            Unit::Fixed("s"),
            "the same in kernels alone; NaN where not known",
        ),
        real(
            "kernel_seconds_min",
            &["row"],
            Unit::Fixed("s"),
            "shortest pass in kernels",
        ),
        real(
            "kernel_seconds_max",
            &["row"],
            Unit::Fixed("s"),
            "longest pass in kernels",
        ),
        real(
            "kernel_trajectories_per_second",
            &["row"],
            Unit::Fixed("1/s"),
            "in kernels alone, median pass",
        ),
        real(
            "compile_seconds",
            &["row"],
            Unit::Fixed("s"),
            "compiling the kernel of this backend, precision and method",
        ),
        real(
            "first_seconds",
            &["row"],
            Unit::Fixed("s"),
            "first pass, not among those timed: it may compile more",
        ),
        real(
            "steps_mean",
            &["row"],
            Unit::One,
            "accepted steps a trajectory",
        ),
        real(
            "rejected_mean",
            &["row"],
            Unit::One,
            "rejected steps a trajectory",
        ),
        real("e_V_median", &["row"], Unit::One, VALUE),
        real("e_V_p99", &["row"], Unit::One, VALUE),
        real("e_V_worst", &["row"], Unit::One, VALUE),
        real("e_p_median", &["row"], Unit::One, COSTATE),
        real("e_p_p99", &["row"], Unit::One, COSTATE),
        real("e_p_worst", &["row"], Unit::One, COSTATE),
        real("e_H_median", &["row"], Unit::One, HAMILTONIAN),
        real("e_H_p99", &["row"], Unit::One, HAMILTONIAN),
        real("e_H_worst", &["row"], Unit::One, HAMILTONIAN),
        real(
            "compared",
            &["row"],
            Unit::One,
            "share of the reference's samples that were compared",
        ),
        real(
            "flops",
            &["row"],
            Unit::Fixed("1/s"),
            "floating-point operations of the equations and the method a second in kernels",
        ),
        real(
            "peak",
            &["row"],
            Unit::Fixed("1/s"),
            "what the device was measured to do in this precision",
        ),
        real(
            "peak_share",
            &["row"],
            Unit::One,
            "flops as a share of peak",
        ),
        real(
            "lane_occupancy",
            &["row"],
            Unit::One,
            "share of the lanes' steps that were steps of a trajectory",
        ),
        integer("passes", &["row"], "timed passes"),
        integer(
            "failed",
            &["row"],
            "trajectories compared that failed while the reference did not",
        ),
        integer(
            "reference_failed",
            &["row"],
            "trajectories whose reference failed, not compared",
        ),
        integer(
            "pareto",
            &["row"],
            "1 where no variant is faster with a smaller worst e_V",
        ),
        integer("status_<status>", &["row"], "trajectories that ended so"),
    ],
    attributes: &[
        ("machine", "processor and cores"),
        ("trajectories", "trajectories of a pass"),
        (
            "trajectories_compared",
            "of these, compared with a reference",
        ),
        ("trajectories_with_e_p", "of these, with an error of p"),
        ("reference_rtol", "tolerance of the references"),
        ("reference_methods", "their methods"),
        ("floor_e_V", "by how much the references differ in V"),
        ("floor_e_p", "in p"),
        ("floor_e_H", "in H"),
        ("not_measured", "variants left out, and why"),
    ],
};

/// A row for each whole sweep that was timed.
pub static HOST_SHARE: Group = Group {
    name: "host_share",
    title: "time of whole sweeps that is not the kernel's",
    dimensions: &[along("row", Along::Index, "row index")],
    variables: &[
        text("adapter", &["row"], "device"),
        text("precision", &["row"], "arithmetic"),
        integer("trajectories", &["row"], "trajectories swept"),
        real("bytes", &["row"], Unit::Fixed("B"), "size of the file"),
        real(
            "wall_seconds",
            &["row"],
            Unit::Fixed("s"),
            "the whole sweep, from its plan to the finished file",
        ),
        real(
            "kernel_seconds",
            &["row"],
            Unit::Fixed("s"),
            "in kernels alone",
        ),
        real(
            "call_seconds",
            &["row"],
            Unit::Fixed("s"),
            "in the backend's calls, transfers included",
        ),
        real(
            "compile_seconds",
            &["row"],
            Unit::Fixed("s"),
            "compiling the kernel",
        ),
        real(
            "sweep_seconds",
            &["row"],
            Unit::Fixed("s"),
            "the same sweep with nothing written",
        ),
        real(
            "writing_seconds",
            &["row"],
            Unit::Fixed("s"),
            "in calls that write, beside the sweep",
        ),
        real(
            "finishing_seconds",
            &["row"],
            Unit::Fixed("s"),
            "flushing the finished file to the disk",
        ),
        real(
            "host_share",
            &["row"],
            Unit::One,
            "share of the whole that is not a kernel's",
        ),
    ],
    attributes: &[],
};
