//! The groups `/speed_error` and `/host_share`: what `costate bench` has measured.

use crate::errors::Quantiles;
use crate::host_share::HostShare;
use crate::{Bench, Row};
use costate::backend::Status;
use costate::low_level::hdf5::{AttributeValue, OutputError, ResultFile};
use costate::low_level::model::Model;
use costate::low_level::result::{Table, TrajectorySchema};
use costate::low_level::schema;

/// A numeric column: name, value.
type Column = (&'static str, fn(&Bench, &Row) -> f64);
type Counted = (&'static str, fn(&Row) -> usize);

const COLUMNS: [Column; 29] = [
    ("rtol", |_, r| r.steps.rtol().unwrap_or(f64::NAN)),
    ("atol", |_, r| r.steps.rtol().map_or(f64::NAN, |_| r.atol)),
    ("step", |_, r| r.steps.step().unwrap_or(f64::NAN)),
    ("seconds_median", |_, r| r.median()),
    ("seconds_min", |_, r| r.spread()[0]),
    ("seconds_max", |_, r| r.spread()[1]),
    ("trajectories_per_second", |b, r| {
        b.trajectories_per_second(r)
    }),
    ("kernel_seconds_median", |_, r| r.kernel_median()),
    ("kernel_seconds_min", |_, r| r.kernel_spread()[0]),
    ("kernel_seconds_max", |_, r| r.kernel_spread()[1]),
    ("kernel_trajectories_per_second", |b, r| {
        b.kernel_trajectories_per_second(r)
    }),
    ("compile_seconds", |_, r| r.compile_seconds),
    ("first_seconds", |_, r| r.first_seconds),
    ("steps_mean", |_, r| r.steps_taken),
    ("rejected_mean", |_, r| r.steps_rejected),
    ("e_V_median", |_, r| r.errors.value.median),
    ("e_V_p99", |_, r| r.errors.value.p99),
    ("e_V_worst", |_, r| r.errors.value.worst),
    ("e_p_median", |_, r| r.errors.costate.median),
    ("e_p_p99", |_, r| r.errors.costate.p99),
    ("e_p_worst", |_, r| r.errors.costate.worst),
    ("e_H_median", |_, r| r.errors.hamiltonian.median),
    ("e_H_p99", |_, r| r.errors.hamiltonian.p99),
    ("e_H_worst", |_, r| r.errors.hamiltonian.worst),
    ("compared", |_, r| r.errors.compared),
    ("flops", |_, r| r.flops),
    ("peak", |b, r| {
        b.devices[r.series.device].peak[r.series.precision as usize]
    }),
    ("peak_share", |_, r| r.peak_share),
    ("lane_occupancy", |_, r| r.occupancy),
];

const COUNTS: [Counted; 4] = [
    ("passes", |r| r.seconds.len()),
    ("failed", |r| r.errors.failed),
    ("reference_failed", |r| r.errors.reference_failed),
    ("pareto", |r| usize::from(r.pareto)),
];

/// Writes `/speed_error`, one row a variant.
///
/// # Errors
/// [`OutputError`] on writing, and where there is no row.
pub fn speed_error(file: &mut ResultFile, bench: &Bench, model: &Model) -> Result<(), OutputError> {
    let rows = &bench.rows;
    let device = |r: &Row| &bench.devices[r.series.device];
    let text = |of: &dyn Fn(&Row) -> String| rows.iter().map(of).collect::<Vec<String>>();
    let axes = TrajectorySchema::axes(model);
    let mut table = Table::new(&schema::SPEED_ERROR, &axes).length("row", rows.len());
    for (name, value) in attributes(bench) {
        table.attribute(name, value);
    }
    table
        .put("backend", text(&|r| device(r).backend.to_owned()))
        .put("adapter", text(&|r| device(r).adapter.clone()))
        .put("precision", text(&|r| r.series.precision.name().to_owned()))
        .put("method", text(&|r| r.series.method.name().to_owned()));
    for (name, value) in COLUMNS {
        let values = rows.iter().map(|r| value(bench, r));
        table.put(name, values.collect::<Vec<f64>>());
    }
    let count = |n: usize| i32::try_from(n).unwrap_or(i32::MAX);
    for (name, value) in COUNTS {
        let values = rows.iter().map(|r| count(value(r)));
        table.put(name, values.collect::<Vec<i32>>());
    }
    for (k, (_, status)) in Status::ALL.iter().enumerate() {
        let what = format!("trajectories that ended so: {}", status.replace('_', " "));
        let values: Vec<i32> = rows.iter().map(|r| count(r.statuses[k])).collect();
        let name = format!("status_{status}");
        table.put_named("status_<status>", &name, Some(&what), values);
    }
    table.write(file)
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
    if shares.is_empty() {
        return Ok(());
    }
    let text = |of: &dyn Fn(&HostShare) -> String| shares.iter().map(of).collect::<Vec<String>>();
    let column = |of: fn(&HostShare) -> f64| shares.iter().map(of).collect::<Vec<f64>>();
    let counts = shares
        .iter()
        .map(|s| i32::try_from(s.trajectories).unwrap_or(i32::MAX));
    let axes = TrajectorySchema::default();
    let mut table = Table::new(&schema::HOST_SHARE, &axes).length("row", shares.len());
    table
        .put(
            "adapter",
            text(&|s| bench.devices[s.device].adapter.clone()),
        )
        .put("precision", text(&|s| s.precision.name().to_owned()))
        .put("trajectories", counts.collect::<Vec<i32>>())
        .put("bytes", column(|s| s.bytes as f64))
        .put("wall_seconds", column(|s| s.wall_seconds))
        .put("kernel_seconds", column(|s| s.times.kernels))
        .put("call_seconds", column(|s| s.times.calls))
        .put("compile_seconds", column(|s| s.times.compiling))
        .put("sweep_seconds", column(|s| s.sweep_seconds))
        .put("writing_seconds", column(|s| s.writing_seconds))
        .put("finishing_seconds", column(|s| s.finishing_seconds))
        .put("host_share", column(HostShare::share));
    table.write(file)
}
