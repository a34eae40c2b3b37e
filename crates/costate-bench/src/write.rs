//! The groups `/speed_error` and `/host_share`: what `costate bench` has measured.

use crate::errors::Quantiles;
use crate::host_share::HostShare;
use crate::{Bench, Row};
use costate::backend::Status;
use costate::low_level::hdf5::{
    AttributeValue, Dimension, Group, OutputError, ResultFile, Variable,
};

/// A numeric column: name, unit, meaning, value.
type Column = (
    &'static str,
    &'static str,
    &'static str,
    fn(&Bench, &Row) -> f64,
);
type Counted = (&'static str, &'static str, fn(&Row) -> usize);

const COLUMNS: [Column; 29] = [
    (
        "rtol",
        "1",
        "relative tolerance of a step; NaN for a fixed step",
        |_, r| r.steps.rtol().unwrap_or(f64::NAN),
    ),
    (
        "atol",
        "1",
        "absolute tolerance in units of each component's scale; NaN for a fixed step",
        |_, r| r.steps.rtol().map_or(f64::NAN, |_| r.atol),
    ),
    (
        "step",
        "s",
        "fixed step; NaN for an adaptive method",
        |_, r| r.steps.step().unwrap_or(f64::NAN),
    ),
    (
        "seconds_median",
        "s",
        "all trajectories, seeds on the host to results on the host: median pass",
        |_, r| r.median(),
    ),
    ("seconds_min", "s", "shortest pass", |_, r| r.spread()[0]),
    ("seconds_max", "s", "longest pass", |_, r| r.spread()[1]),
    (
        "trajectories_per_second",
        "1/s",
        "end to end, median pass",
        |b, r| b.trajectories_per_second(r),
    ),
    (
        "kernel_seconds_median",
        "s",
        "the same in kernels alone; NaN where not known",
        |_, r| r.kernel_median(),
    ),
    (
        "kernel_seconds_min",
        "s",
        "shortest pass in kernels",
        |_, r| r.kernel_spread()[0],
    ),
    (
        "kernel_seconds_max",
        "s",
        "longest pass in kernels",
        |_, r| r.kernel_spread()[1],
    ),
    (
        "kernel_trajectories_per_second",
        "1/s",
        "in kernels alone, median pass",
        |b, r| b.kernel_trajectories_per_second(r),
    ),
    (
        "compile_seconds",
        "s",
        "compiling the kernel of this backend, precision and method",
        |_, r| r.compile_seconds,
    ),
    (
        "first_seconds",
        "s",
        "first pass, not among those timed: it may compile more",
        |_, r| r.first_seconds,
    ),
    ("steps_mean", "1", "accepted steps a trajectory", |_, r| {
        r.steps_taken
    }),
    (
        "rejected_mean",
        "1",
        "rejected steps a trajectory",
        |_, r| r.steps_rejected,
    ),
    ("e_V_median", "1", VALUE, |_, r| r.errors.value.median),
    ("e_V_p99", "1", VALUE, |_, r| r.errors.value.p99),
    ("e_V_worst", "1", VALUE, |_, r| r.errors.value.worst),
    ("e_p_median", "1", COSTATE, |_, r| r.errors.costate.median),
    ("e_p_p99", "1", COSTATE, |_, r| r.errors.costate.p99),
    ("e_p_worst", "1", COSTATE, |_, r| r.errors.costate.worst),
    ("e_H_median", "1", HAMILTONIAN, |_, r| {
        r.errors.hamiltonian.median
    }),
    ("e_H_p99", "1", HAMILTONIAN, |_, r| r.errors.hamiltonian.p99),
    ("e_H_worst", "1", HAMILTONIAN, |_, r| {
        r.errors.hamiltonian.worst
    }),
    (
        "compared",
        "1",
        "share of the reference's samples that were compared",
        |_, r| r.errors.compared,
    ),
    (
        "flops",
        "1/s",
        "floating-point operations of the equations and the method a second in kernels",
        |_, r| r.flops,
    ),
    (
        "peak",
        "1/s",
        "what the device was measured to do in this precision",
        |b, r| b.devices[r.series.device].peak[r.series.precision as usize],
    ),
    ("peak_share", "1", "flops as a share of peak", |_, r| {
        r.peak_share
    }),
    (
        "lane_occupancy",
        "1",
        "share of the lanes' steps that were steps of a trajectory",
        |_, r| r.occupancy,
    ),
];
const VALUE: &str = "error of V off the manifold, |V - V_ref - p_ref.(x - x_ref)|/max(1, V_ref), largest of a trajectory";
const COSTATE: &str = "error of p off the manifold, |p - p_ref - dp/dx (x - x_ref)|/max(1, |p_ref|), p times the region's widths, largest of a trajectory";
const HAMILTONIAN: &str = "change of H against the reference relative to the largest running cost, largest of a trajectory";

const COUNTS: [Counted; 4] = [
    ("passes", "timed passes", |r| r.seconds.len()),
    (
        "failed",
        "trajectories compared that failed while the reference did not",
        |r| r.errors.failed,
    ),
    (
        "reference_failed",
        "trajectories whose reference failed, not compared",
        |r| r.errors.reference_failed,
    ),
    (
        "pareto",
        "1 where no variant is faster with a smaller worst e_V",
        |r| usize::from(r.pareto),
    ),
];

/// Writes `/speed_error`, one row a variant.
///
/// # Errors
/// [`OutputError`] on writing, and where there is no row.
pub fn speed_error(file: &mut ResultFile, bench: &Bench) -> Result<(), OutputError> {
    let rows = &bench.rows;
    let device = |r: &Row| &bench.devices[r.series.device];
    let text = |name: &str, what: &str, value: &dyn Fn(&Row) -> String| {
        Variable::text(name, "row", rows.iter().map(value)).long_name(what)
    };
    let mut group = Group::new("speed_error")
        .dimension(Dimension::index("row", rows.len()))
        .variable(text("backend", "what integrated", &|r| {
            device(r).backend.to_owned()
        }))
        .variable(text("adapter", "device", &|r| device(r).adapter.clone()))
        .variable(text("precision", "arithmetic", &|r| {
            r.series.precision.name().to_owned()
        }))
        .variable(text("method", "integration method", &|r| {
            r.series.method.name().to_owned()
        }));
    for (name, value) in attributes(bench) {
        group = group.attribute(name, value);
    }
    for (name, unit, what, _) in COLUMNS {
        group = group.variable(Variable::f64(name, ["row"]).unit(unit).long_name(what));
    }
    for (name, what, _) in COUNTS {
        group = group.variable(Variable::i32(name, ["row"]).long_name(what));
    }
    for (_, status) in Status::ALL {
        let what = format!("trajectories that ended so: {}", status.replace('_', " "));
        group =
            group.variable(Variable::i32(&format!("status_{status}"), ["row"]).long_name(&what));
    }
    let mut writer = file.group(&group)?;
    for (name, _, _, value) in COLUMNS {
        let values: Vec<f64> = rows.iter().map(|r| value(bench, r)).collect();
        writer.write(name, &values)?;
    }
    let count = |n: usize| i32::try_from(n).unwrap_or(i32::MAX);
    for (name, _, value) in COUNTS {
        let values: Vec<i32> = rows.iter().map(|r| count(value(r))).collect();
        writer.write(name, &values)?;
    }
    for (k, (_, status)) in Status::ALL.iter().enumerate() {
        let values: Vec<i32> = rows.iter().map(|r| count(r.statuses[k])).collect();
        writer.write(&format!("status_{status}"), &values)?;
    }
    Ok(())
}

/// What all rows have in common.
fn attributes(bench: &Bench) -> Vec<(&'static str, AttributeValue)> {
    let [a, b] = bench.floor.methods.map(|m| m.name());
    let worst = |q: &Quantiles| q.worst;
    let missing: Vec<String> = bench
        .missing
        .iter()
        .map(|m| format!("{}: {}", m.what, m.why))
        .collect();
    let integer = |n: usize| AttributeValue::from(i64::try_from(n).unwrap_or(i64::MAX));
    let floor = &bench.floor.errors;
    vec![
        ("title", "speed against error".into()),
        ("machine", crate::devices::machine().into()),
        ("trajectories", integer(bench.trajectories)),
        ("trajectories_compared", integer(bench.checked)),
        ("trajectories_with_e_p", integer(bench.with_slopes)),
        ("reference_rtol", crate::reference::REFERENCE_RTOL.into()),
        (
            "reference_methods",
            format!("{a}, {b}: for each method the first that it is not").into(),
        ),
        ("floor_e_V", worst(&floor.value).into()),
        ("floor_e_p", worst(&floor.costate).into()),
        ("floor_e_H", worst(&floor.hamiltonian).into()),
        ("not_measured", missing.join("; ").into()),
    ]
}

/// Writes `/host_share`, one row a sweep that was timed; nothing where none was.
///
/// # Errors
/// [`OutputError`] on writing.
pub fn host_shares(
    file: &mut ResultFile,
    bench: &Bench,
    shares: &[HostShare],
) -> Result<(), OutputError> {
    type Seconds = (
        &'static str,
        &'static str,
        &'static str,
        fn(&HostShare) -> f64,
    );
    const TIMES: [Seconds; 8] = [
        (
            "wall_seconds",
            "s",
            "the whole sweep, from its plan to the finished file",
            |s| s.wall_seconds,
        ),
        ("kernel_seconds", "s", "in kernels alone", |s| {
            s.times.kernels
        }),
        (
            "call_seconds",
            "s",
            "in the backend's calls, transfers included",
            |s| s.times.calls,
        ),
        ("compile_seconds", "s", "compiling the kernel", |s| {
            s.times.compiling
        }),
        (
            "sweep_seconds",
            "s",
            "the same sweep with nothing written",
            |s| s.sweep_seconds,
        ),
        (
            "writing_seconds",
            "s",
            "in calls that write, beside the sweep",
            |s| s.writing_seconds,
        ),
        (
            "finishing_seconds",
            "s",
            "flushing the finished file to the disk",
            |s| s.finishing_seconds,
        ),
        (
            "host_share",
            "1",
            "share of the whole that is not a kernel's",
            HostShare::share,
        ),
    ];
    if shares.is_empty() {
        return Ok(());
    }
    let mut group = Group::new("host_share")
        .attribute("title", "time of whole sweeps that is not the kernel's")
        .dimension(Dimension::index("row", shares.len()))
        .variable(
            Variable::text(
                "adapter",
                "row",
                shares
                    .iter()
                    .map(|s| bench.devices[s.device].adapter.clone()),
            )
            .long_name("device"),
        )
        .variable(
            Variable::text(
                "precision",
                "row",
                shares.iter().map(|s| s.precision.name()),
            )
            .long_name("arithmetic"),
        )
        .variable(Variable::i32("trajectories", ["row"]).long_name("trajectories swept"))
        .variable(
            Variable::f64("bytes", ["row"])
                .unit("B")
                .long_name("size of the file"),
        );
    for (name, unit, what, _) in TIMES {
        group = group.variable(Variable::f64(name, ["row"]).unit(unit).long_name(what));
    }
    let mut writer = file.group(&group)?;
    let counts: Vec<i32> = shares
        .iter()
        .map(|s| i32::try_from(s.trajectories).unwrap_or(i32::MAX))
        .collect();
    writer.write("trajectories", &counts)?;
    writer.write(
        "bytes",
        &shares.iter().map(|s| s.bytes as f64).collect::<Vec<f64>>(),
    )?;
    for (name, _, _, value) in TIMES {
        writer.write(name, &shares.iter().map(value).collect::<Vec<f64>>())?;
    }
    Ok(())
}
