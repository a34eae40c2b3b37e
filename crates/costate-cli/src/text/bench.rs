//! What `costate bench` prints: the table, what to take, what was not measured.

use costate::backend::Status;
use costate_bench::errors::{Errors, Quantiles};
use costate_bench::host_share::HostShare;
use costate_bench::measure::{Device, setting};
use costate_bench::{Bench, Row, Steps, Work, devices};
use serde_json::{Value, json};
use std::path::Path;

/// What a bench has done.
pub struct Done<'a> {
    pub title: &'a str,
    pub bench: &'a Bench,
    pub work: &'a Work,
    pub shares: &'a [HostShare],
    /// Errors to recommend settings for.
    pub wanted: &'a [f64],
    pub path: &'a Path,
    /// `None` where nothing could be drawn.
    pub picture: Option<&'a Path>,
    pub seconds: f64,
}

pub fn as_text(done: &Done<'_>) -> String {
    let bench = done.bench;
    let mut lines = vec![
        done.title.to_owned(),
        devices::machine(),
        format!(
            "{} trajectories, {}, median of {} passes in turn; errors of {}, of p of {}",
            bench.trajectories,
            if done.work.store {
                format!("{} points each", done.work.plan.run.levels.len())
            } else {
                "ends only".to_owned()
            },
            bench.rounds,
            bench.checked,
            bench.with_slopes,
        ),
        floor(bench),
    ];
    for (k, device) in bench.devices.iter().enumerate() {
        lines.push(String::new());
        lines.push(headed(device));
        lines.push(HEAD.to_owned());
        let mut rows: Vec<&Row> = bench.rows.iter().filter(|r| r.series.device == k).collect();
        // Series together, each from rough to fine.
        let series: Vec<_> = rows.iter().map(|r| r.series).collect();
        rows.sort_by_key(|r| series.iter().position(|s| *s == r.series));
        lines.extend(rows.into_iter().map(|r| line(bench, r)));
    }
    lines.push(String::new());
    lines.push("* no variant is faster with a smaller worst e_V. ! lost trajectories that the reference has (failed/compared).".into());
    lines.push("e_V, e_p: off the manifold, relative to max(1, V), max(1, |p|); e_H: change of H relative to the running cost.".into());
    if !bench.missing.is_empty() {
        lines.push("not measured:".into());
        lines.extend(
            bench
                .missing
                .iter()
                .map(|m| format!("  {}: {}", m.what, m.why)),
        );
    }
    lines.push(String::new());
    lines.extend(done.wanted.iter().flat_map(|e| recommended(done, *e)));
    lines.extend(done.shares.iter().map(|s| shared(bench, s)));
    let picture = (done.picture).map_or_else(String::new, |p| format!(" and {}", p.display()));
    lines.push(format!(
        "{:.1} s, written to {}{picture}",
        done.seconds,
        done.path.display()
    ));
    lines.join("\n")
}

fn headed(device: &Device) -> String {
    let rate = |k: usize, name: &str| {
        let peak = device.peak[k];
        (peak.is_finite()).then(|| format!("{:.0} Gflop/s {name}", peak * 1e-9))
    };
    let rates: Vec<String> = [rate(0, "f32"), rate(1, "f64")]
        .into_iter()
        .flatten()
        .collect();
    format!(
        "{}: {}; multiply-adds measured: {}",
        device.backend,
        device.adapter,
        rates.join(", ")
    )
}

/// The references' distance.
fn floor(bench: &Bench) -> String {
    let [a, b] = bench.floor.methods.map(|m| m.name());
    let e = &bench.floor.errors;
    format!(
        "references {a} and {b} at rtol 1e-14 differ by {:.1e} (e_V), {:.1e} (e_p), {:.1e} (e_H) at worst over {} trajectories: smaller errors cannot be told",
        e.value.worst, e.costate.worst, e.hamiltonian.worst, bench.floor.trajectories
    )
}

const HEAD: &str = "             setting      |  e_V worst    99 %  median |  e_p worst  e_H worst | trajectories/s    spread   kernel/s |  steps  of peak";

fn line(bench: &Bench, row: &Row) -> String {
    let e = &row.errors;
    let rate = bench.trajectories_per_second(row);
    let [least, most] = row.spread();
    let spread = format!(
        "{:+.0}/{:+.0} %",
        100.0 * (least / row.median() - 1.0),
        100.0 * (most / row.median() - 1.0)
    );
    let kernel = bench.kernel_trajectories_per_second(row);
    let share = |x: f64, text: String| if x.is_finite() { text } else { "-".to_owned() };
    format!(
        "{}{} {} {:<6} {:<11} |  {:>9} {:>7} {:>7} |  {:>9}  {:>9} | {:>14} {:>9} {:>10} | {:>6.1} {:>8}{}",
        if row.pareto { '*' } else { ' ' },
        if e.complete() { ' ' } else { '!' },
        row.series.precision.name(),
        row.series.method.name(),
        setting(row.steps),
        brief(e.value.worst),
        brief(e.value.p99),
        brief(e.value.median),
        brief(e.costate.worst),
        brief(e.hamiltonian.worst),
        grouped(rate),
        spread,
        share(kernel, grouped(kernel)),
        row.steps_taken + row.steps_rejected,
        share(row.peak_share, format!("{:.1} %", 100.0 * row.peak_share)),
        if e.complete() {
            String::new()
        } else {
            format!("  {}/{:.0} %", e.failed, 100.0 * e.compared)
        }
    )
}

fn brief(x: f64) -> String {
    if x.is_nan() {
        "-".to_owned()
    } else {
        format!("{x:.1e}")
    }
}

/// Three significant digits, thousands apart.
fn grouped(x: f64) -> String {
    if !x.is_finite() {
        return "-".to_owned();
    }
    let unit = 10f64.powi((x.max(1.0).log10().floor() as i32 - 2).max(0));
    let digits = format!("{:.0}", (x / unit).round() * unit);
    let mut text = String::new();
    for (k, d) in digits.chars().enumerate() {
        if k > 0 && (digits.len() - k) % 3 == 0 {
            text.push(',');
        }
        text.push(d);
    }
    text
}

/// The lines of `[integrator]`.
fn section(row: &Row) -> Vec<String> {
    let mut lines = vec![
        "[integrator]".to_owned(),
        format!("method = \"{}\"", row.series.method.name()),
    ];
    match row.steps {
        Steps::Tolerance(rtol) => {
            lines.push(format!("rtol = {rtol:e}"));
            lines.push(format!("atol = {:e}", row.atol));
        }
        Steps::Fixed(step) => lines.push(format!("step = {step}")),
    }
    lines.push(format!("precision = \"{}\"", row.series.precision.name()));
    lines
}

fn recommended(done: &Done<'_>, wanted: f64) -> Vec<String> {
    let bench = done.bench;
    let Some(row) = bench.fastest(wanted) else {
        return vec![format!(
            "for V to {wanted:.0e}: no variant measured is that good"
        )];
    };
    let head = format!(
        "for V to {wanted:.0e}, {}: {} trajectories/s, worst e_V {:.1e}, 99 % {:.1e}, e_p {:.1e}",
        bench.devices[row.series.device].adapter,
        grouped(bench.trajectories_per_second(row)),
        row.errors.value.worst,
        row.errors.value.p99,
        row.errors.costate.worst
    );
    std::iter::once(head)
        .chain(section(row).into_iter().map(|l| format!("    {l}")))
        .collect()
}

fn shared(bench: &Bench, s: &HostShare) -> String {
    format!(
        "a whole sweep of {} trajectories ({}, {}): {:.2} s, {:.0} % of it not in the kernel (kernel {:.2} s, its calls with transfers {:.2} s, writing beside the sweep {:.2} s, flushing {} MiB to the disk {:.2} s; with nothing written the sweep takes {:.2} s)",
        s.trajectories,
        bench.devices[s.device].adapter,
        s.precision.name(),
        s.wall_seconds,
        100.0 * s.share(),
        s.times.kernels,
        s.times.calls,
        s.writing_seconds,
        s.bytes >> 20,
        s.finishing_seconds,
        s.sweep_seconds,
    )
}

pub fn as_json(done: &Done<'_>) -> Value {
    let bench = done.bench;
    let recommendation = |wanted: &f64| {
        let best = bench.fastest(*wanted);
        json!({
            "error": wanted,
            "variant": best.map(|row| row_json(bench, row)),
            "integrator": best.map(section),
        })
    };
    json!({
        "title": done.title,
        "file": done.path.display().to_string(),
        "picture": done.picture.map(|p| p.display().to_string()),
        "machine": devices::machine(),
        "devices": bench.devices.iter().map(|d| json!({
            "backend": d.backend, "adapter": d.adapter, "peak_f32": d.peak[0], "peak_f64": d.peak[1],
        })).collect::<Vec<_>>(),
        "trajectories": bench.trajectories,
        "trajectories_compared": bench.checked,
        "trajectories_with_e_p": bench.with_slopes,
        "passes": bench.rounds,
        "reference_seconds": bench.reference_seconds,
        "reference_floor": {
            "methods": bench.floor.methods.map(|m| m.name()),
            "trajectories": bench.floor.trajectories,
            "errors": errors_json(&bench.floor.errors),
        },
        "rows": bench.rows.iter().map(|row| row_json(bench, row)).collect::<Vec<_>>(),
        "not_measured": bench.missing.iter().map(|m| json!({ "what": m.what, "why": m.why })).collect::<Vec<_>>(),
        "recommended": done.wanted.iter().map(recommendation).collect::<Vec<_>>(),
        "host_share": done.shares.iter().map(|s| share_json(bench, s)).collect::<Vec<_>>(),
        "wall_seconds": done.seconds,
    })
}

fn row_json(bench: &Bench, r: &Row) -> Value {
    let device = &bench.devices[r.series.device];
    let statuses: serde_json::Map<String, Value> = (Status::ALL.iter().zip(r.statuses))
        .map(|((_, name), n)| ((*name).to_owned(), n.into()))
        .collect();
    json!({
        "backend": device.backend, "adapter": device.adapter,
        "precision": r.series.precision.name(), "method": r.series.method.name(),
        "rtol": r.steps.rtol(), "atol": r.steps.rtol().map(|_| r.atol), "step": r.steps.step(),
        "seconds": { "median": r.median(), "min": r.spread()[0], "max": r.spread()[1], "all": r.seconds },
        "trajectories_per_second": bench.trajectories_per_second(r),
        "kernel_seconds": { "median": r.kernel_median(), "min": r.kernel_spread()[0], "max": r.kernel_spread()[1] },
        "kernel_trajectories_per_second": bench.kernel_trajectories_per_second(r),
        "compile_seconds": r.compile_seconds, "first_seconds": r.first_seconds,
        "steps_mean": r.steps_taken, "rejected_mean": r.steps_rejected,
        "errors": errors_json(&r.errors), "status": statuses,
        "flops": r.flops, "peak_share": r.peak_share, "lane_occupancy": r.occupancy, "pareto": r.pareto,
    })
}

fn errors_json(e: &Errors) -> Value {
    let quantiles = |q: &Quantiles| json!({ "median": q.median, "p99": q.p99, "worst": q.worst });
    json!({
        "e_V": quantiles(&e.value), "e_p": quantiles(&e.costate), "e_H": quantiles(&e.hamiltonian),
        "compared": e.compared, "failed": e.failed, "reference_failed": e.reference_failed,
    })
}

fn share_json(bench: &Bench, s: &HostShare) -> Value {
    json!({
        "adapter": bench.devices[s.device].adapter, "precision": s.precision.name(),
        "trajectories": s.trajectories, "wall_seconds": s.wall_seconds,
        "kernel_seconds": s.times.kernels, "call_seconds": s.times.calls, "compile_seconds": s.times.compiling,
        "sweep_seconds": s.sweep_seconds, "writing_seconds": s.writing_seconds,
        "finishing_seconds": s.finishing_seconds,
        "host_share": s.share(), "bytes": s.bytes,
    })
}

#[cfg(test)]
mod tests {
    #[test]
    fn numbers_in_groups() {
        assert_eq!(super::grouped(1_234_567.0), "1,230,000");
        assert_eq!(super::grouped(999.6), "1,000");
        assert_eq!(super::grouped(12.3), "12");
        assert_eq!(super::grouped(f64::NAN), "-");
    }
}
