//! The check of the dissipation inequality as text.

use crate::common::columns::columns;
use costate::low_level::closed_loop::dissipation::{Dissipation, Origin, TOLERANCE, ratio_text};

/// A row for each law and kind of disturbance, and a verdict for each law.
pub fn text(d: &Dissipation) -> String {
    let numerics = &d.numerics;
    let mut text = format!(
        "dissipation inequality under {} disturbances to t = {:.4}: {} on {}, {} {}, rtol {:e}; V {}\n",
        d.cases.count(),
        d.final_time,
        d.backend,
        d.adapter,
        numerics.precision.name(),
        numerics.method.name(),
        numerics.rtol,
        d.value,
    );
    let solved = d.origin.iter().filter(|o| **o == Origin::Solved).count();
    if solved > 0 {
        text.truncate(text.len() - 1);
        text += &format!(
            ", at {:.1} % of the initial states solved for\n",
            100.0 * solved as f64 / d.origin.len() as f64
        );
    }
    let beyond = format!("beyond {TOLERANCE:e}");
    let heading = [
        "law",
        "disturbance",
        "judged",
        "ended early",
        "E/(W + V0) median",
        "largest",
        "above 1",
        "violation",
        &beyond,
        "unexplained",
    ];
    let mut rows = vec![heading.map(str::to_owned).to_vec()];
    for law in &d.laws {
        for s in law.summaries(&d.cases) {
            rows.push(vec![
                law.name.clone(),
                s.kind.name().to_owned(),
                s.judged.to_string(),
                s.left.to_string(),
                ratio_text(s.median_ratio),
                ratio_text(s.worst_ratio),
                s.exceeded.to_string(),
                format!("{:.1e}", s.worst_violation),
                s.violated.to_string(),
                s.unexplained.to_string(),
            ]);
        }
    }
    text += &columns(&rows, &[0, 1]);
    for law in &d.laws {
        let rate = law.status.len() as f64 / law.seconds;
        let (_, verdict) = law.verdict(&d.cases);
        text += &format!("\nlaw `{}`: {verdict}; {rate:.0} disturbances/s", law.name);
    }
    text
}
