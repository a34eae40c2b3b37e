//! What a run prints of its own error, and of rates too far apart for its methods.

use costate::low_level::local::show_eigenvalue;
use costate::low_level::model::Precision;
use costate::low_level::sweep::Plan;
use costate::low_level::sweep::accuracy::{Accuracy, PROMISE, Spread};
use costate::low_level::sweep::stiffness::Separation;
use costate::session::Estimates;

/// The errors of the sweep in a line.
pub fn swept_text(estimates: &Estimates) -> Option<String> {
    let a = estimates.swept.as_ref()?;
    let Some(value) = a.value else {
        return Some(format!(
            "error estimate: none, no point of the {} sampled trajectories could be compared",
            a.sampled
        ));
    };
    Some(format!(
        "error estimate ({} trajectories again, f64 {} rtol {:.0e}): V {}{}{}",
        a.sampled,
        a.method.name(),
        a.rtol,
        quantiles(value),
        worst("p", a.costate),
        worst("u", a.control)
    ))
}

/// The errors of the solved states in a line.
pub fn solved_text(estimates: &Estimates) -> Option<String> {
    let a = estimates.solved.as_ref()?;
    let value = a.value?;
    Some(format!(
        "error estimate ({} states again, tolerance {:.0e}): V {}{}{}",
        a.sampled - a.failed,
        a.tolerance,
        quantiles(value),
        worst("p", a.costate),
        worst("u", a.control)
    ))
}

/// Warnings: the error asked for was not met, and why a run is slow or incomplete.
pub fn notes(estimates: &Estimates, plan: &Plan) -> Vec<String> {
    let mut notes = Vec::new();
    if let Some(a) = &estimates.swept {
        notes.extend(swept_notes(plan, a));
    }
    if let Some(a) = estimates.solved.as_ref().filter(|a| a.met() == Some(false)) {
        notes.push(format!(
            "the error asked for was not met at the solved states: V is wrong by up to {:.1e}, asked {:.0e}",
            a.value.map_or(f64::NAN, |v| v.worst),
            a.bound
        ));
    }
    if let Some(s) = estimates.separation.filter(Separation::hides_fronts) {
        notes.push(separation_note(plan, &s));
    }
    if let Some(h) = &estimates.held {
        notes.push(format!(
            "stiff: {:.0} % of the steps are held by stability, not accuracy (mean h |lambda| = {:.1}; {} is stable to {:.1}); \
             trajectories last {:.0} time constants of the fastest rate, |lambda| = {:.3e}. The result is right, but an \
             explicit method is slow here and a larger tolerance does not help: replace the fast state by its quasi-steady value",
            100.0 * h.share,
            h.product,
            plan.method().name(),
            h.boundary,
            h.time_constants,
            h.rate
        ));
    }
    if let Some(s) = &estimates.segments {
        let beyond = match s.beyond {
            0 => String::new(),
            n => format!("; {n} states (status horizon) would take more than are tried"),
        };
        notes.push(format!(
            "stiff: the fastest rate, {}, is {:.0} times the slowest, {}: a solution takes {:.0} segments{beyond}. What is solved \
             is right, but the time grows with that ratio: replace the fast states by their quasi-steady values where it matters",
            show_eigenvalue(s.separation.fastest),
            s.separation.ratio,
            show_eigenvalue(s.separation.slowest),
            s.mean
        ));
    }
    notes
}

fn separation_note(plan: &Plan, s: &Separation) -> String {
    // Boundary value problems take some multiple of the ratio in segments, which has its limit.
    const SOLVABLE: f64 = 1000.5;
    let solve = if s.ratio <= SOLVABLE {
        "ask for states there ([homotopy], [map], costate solve), or "
    } else {
        ""
    };
    let enough =
        plan.spec.precision == Precision::F32 && s.digits < -Precision::F64.epsilon().log10();
    let finer = if enough {
        ", or use --precision f64"
    } else {
        ""
    };
    format!(
        "the closed loop's rates are far apart, {} and {} (ratio {:.0}): fronts along the slow modes come from seeds that differ in \
         digit {:.0} at the earliest, and {} has {:.0}. What is swept is right, but those parts are not covered: {solve}replace the \
         fast states by their quasi-steady values{finer}",
        show_eigenvalue(s.fastest),
        show_eigenvalue(s.slowest),
        s.ratio,
        s.digits,
        plan.spec.precision.name(),
        s.resolved,
    )
}

fn swept_notes(plan: &Plan, a: &Accuracy) -> Vec<String> {
    let mut notes = Vec::new();
    let Some(value) = a.value else {
        notes.push("the error could not be estimated: no sampled trajectory has a point that its reference reaches too".to_owned());
        return notes;
    };
    if value.worst > a.bound {
        let remedy = if !plan.method().adaptive() {
            "a fixed step controls no error: use a smaller one, or a method that chooses its steps"
        } else if plan.spec.precision == Precision::F32 {
            "f32's rounding is the floor of what it reaches: use --precision f64, or ask for less"
        } else if plan.run.rtol > plan.rtol_asked {
            "f64's rounding is the floor of what it reaches: ask for less"
        } else if plan
            .local
            .as_ref()
            .is_some_and(|l| l.error > 0.1 * a.bound * plan.value_scale)
        {
            "the seeds are off by that much already: use a smaller seed_value"
        } else if a.parts_fast() && !plan.shoot_out.folds {
            "trajectories part so fast there that a smaller rtol may not help: extremals that have met a fold are not optimal, and [shoot_out] folds = true ends them there"
        } else {
            "use a smaller rtol"
        };
        notes.push(format!(
            "the error asked for was NOT met: V is wrong by up to {:.1e} of it, {:.0e} ({PROMISE} rtol) was asked; {remedy}",
            value.worst, a.bound
        ));
    }
    if a.met() == Some(false) && value.worst <= a.bound {
        notes.push(format!(
            "{} of {} sampled trajectories end otherwise than in a finer integration: do not trust where trajectories end",
            a.differ, a.sampled
        ));
    }
    if a.met().is_none() {
        notes.push(format!(
            "the error of {} of {} sampled points could not be told: trajectories part so fast there that the same seed leads \
             elsewhere in a finer integration; what remains is |H|",
            a.parted,
            a.parted + a.compared
        ));
    }
    notes
}

fn quantiles(s: Spread) -> String {
    format!(
        "median {:.1e}, 99 % {:.1e}, worst {:.1e}",
        s.median, s.p99, s.worst
    )
}

fn worst(name: &str, spread: Option<Spread>) -> String {
    spread.map_or_else(String::new, |s| format!("; {name} worst {:.1e}", s.worst))
}
