//! The dissipation inequality of `[dissipation]`, checked and told.

use super::CliError;
use super::columns::columns;
use super::evaluate::{Sources, Wanted, same_problem};
use super::report::Terminal;
use costate::backend::Backend;
use costate::closed_loop::dissipation::{
    Certificate, Dissipation, Origin, TOLERANCE, check, flight, ratio_text,
};
use costate::closed_loop::{Laws, solved_values};
use costate::hdf5::ResultFile;
use costate::scene::Scene;
use costate::sweep::Choices;

/// V at initial states is solved for with this tolerance unless the scene's is tighter.
const SOLVED_RTOL: f64 = 1e-8;

/// Checks the laws of a scene's `[dissipation]` and writes what came of it.
pub(super) fn perform(
    from: &Sources<'_>,
    scene: &Scene,
    wanted: &Wanted,
    backend: &dyn Backend,
    terminal: &Terminal,
    file: &mut ResultFile,
) -> Result<Dissipation, CliError> {
    let Scene {
        model, hamiltonian, ..
    } = scene;
    let asked = model.dissipation.as_ref().ok_or(CliError::NoClosedLoop)?;
    let track = model.closed_loop.as_ref().and_then(|s| s.track);
    let laws = Laws::new(model, hamiltonian, track);
    let same = from
        .stored
        .is_some_and(|s| same_problem(&s.scene.model, model));
    let bar = terminal.progress();
    let solve = |states: &[f64]| {
        // More exact than what is interpolated, of which the ratio should say nothing.
        let choices = Choices {
            rtol: Some(
                wanted
                    .choices
                    .rtol
                    .unwrap_or(model.integrator.rtol.min(SOLVED_RTOL)),
            ),
            ..wanted.choices
        };
        solved_values(
            model,
            hamiltonian,
            backend,
            choices,
            states,
            &mut |_, _, _| {},
        )
    };
    let certificate = Certificate::of(&laws, from.chart(), same.then_some(&solve))?;
    if let (Certificate::Chart(..), false) = (&certificate, same) {
        terminal.note(
            "V in the file is of another problem (other parameters, equations or cost): whether it certifies a gain of this one is what the simulation says",
        );
    }
    let flight = flight(model, asked, laws.riccati())?;
    let chosen = from.choose(&laws, &flight, (wanted, true), terminal)?;
    bar.say("dissipation inequality: V at the initial states");
    let checked = check(
        &laws,
        (asked, &flight),
        &chosen,
        &certificate,
        backend,
        wanted.choices,
        &mut |law| bar.say(&format!("dissipation inequality of {law}")),
    )?;
    bar.clear();
    checked.write(model, file)?;
    terminal.say(&as_text(&checked))?;
    Ok(checked)
}

fn as_text(d: &Dissipation) -> String {
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

pub(super) fn as_json(d: &Dissipation) -> serde_json::Value {
    let laws: Vec<_> = (d.laws.iter())
        .map(|law| {
            let kinds: serde_json::Map<_, _> = (law.summaries(&d.cases).iter())
                .map(|s| {
                    let row = serde_json::json!({
                        "count": s.count, "judged": s.judged, "left": s.left, "median_ratio": s.median_ratio,
                        "worst_ratio": s.worst_ratio, "worst_violation": s.worst_violation, "exceeded": s.exceeded, "violated": s.violated,
                        "unexplained": s.unexplained,
                    });
                    (s.kind.name().to_owned(), row)
                })
                .collect();
            let (held, verdict) = law.verdict(&d.cases);
            serde_json::json!({
                "name": law.name, "source": law.source, "held": held, "verdict": verdict, "kinds": kinds,
                "statuses": d.statuses(law), "seconds": law.seconds,
            })
        })
        .collect();
    serde_json::json!({
        "disturbances": d.cases.count(), "final_time": d.final_time, "value_function": d.value, "frequencies": d.frequencies,
        "backend": d.backend, "adapter": d.adapter, "precision": d.numerics.precision.name(), "rtol": d.numerics.rtol,
        "laws": laws,
    })
}
