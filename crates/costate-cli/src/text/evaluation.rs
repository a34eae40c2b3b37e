//! Closed loops as text.

use crate::common::columns::columns;
use costate::low_level::closed_loop::{Evaluation, MAP};

/// Laws side by side.
pub fn text(e: &Evaluation) -> String {
    let numerics = &e.numerics;
    let known = e.values.iter().filter(|v| !v.is_nan()).count();
    let mapped = e.laws.iter().any(|law| law.name == MAP) && e.leg_method != numerics.method;
    let legs = if mapped {
        format!(" (law `map`: {})", e.leg_method.name())
    } else {
        String::new()
    };
    let t = format!(
        "closed loop from {} initial states to t = {}: {} on {}, {} {}{legs}, rtol {:e}; V known at {known}\n",
        e.initial.count(),
        e.closed_loop.final_time,
        e.backend,
        e.adapter,
        numerics.precision.name(),
        numerics.method.name(),
        numerics.rtol
    );
    let mut rows: Vec<Vec<String>> = vec![
        ["law", "converged", "J/V - 1 median", "99 %"]
            .into_iter()
            .map(str::to_owned)
            .chain(e.closed_loop.records.iter().map(|r| r.name.clone()))
            .chain(e.closed_loop.sets.iter().map(|s| s.name.clone()))
            .chain(["states/s", "ended"].map(str::to_owned))
            .collect(),
    ];
    for (law, sets) in e.laws.iter().zip(&e.sets) {
        let spread = e.spread(law);
        let number = |v: Option<f64>| v.map_or_else(|| "-".to_owned(), |v| format!("{v:.2e}"));
        let mut row = vec![
            law.name.clone(),
            format!("{:.2} %", 100.0 * law.share_converged()),
            number(spread.map(|s| s.median)),
            number(spread.map(|s| s.p99)),
        ];
        row.extend((0..e.closed_loop.records.len()).map(|k| format!("{:.5}", e.worst(law, k))));
        row.extend(sets.iter().map(|s| format!("{:.2} %", 100.0 * s.share)));
        row.push(format!("{:.0}", law.rate()));
        row.push(e.status_text(law));
        rows.push(row);
    }
    t + &columns(&rows, &[0, rows[0].len() - 1])
}
