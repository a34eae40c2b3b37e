//! Angles of a scene that are too many periods away.

use super::periods::MOST_PERIODS;
use super::reader::{Reader, Section};
use super::scene::{Loops, Posed, Sections, Settings};
use crate::diagnostics::{Problem, Span};
use crate::model::{GridAxis, Start, State};
use toml::de::DeValue;

/// Where a section has an entry a state, and the values of a state's entry.
struct Place<'v> {
    section: &'static str,
    /// The key of a table within the section that has the entries.
    key: Option<&'static str>,
    values: &'v dyn Fn(usize) -> Vec<f64>,
}

impl Reader<'_> {
    /// Reports states that are given too many periods away, wherever the scene gives some.
    pub(super) fn check_turns(
        &mut self,
        sections: &Sections<'_>,
        posed: &Posed,
        (settings, loops): (&Settings, &Loops),
    ) {
        let Some(states) = &posed.states else { return };
        let equilibrium = |i: usize| (posed.equilibrium.iter().map(|e| e.x[i].value)).collect();
        let region = |i: usize| posed.region.iter().flat_map(|r| r[i]).collect();
        let homotopy = |i: usize| {
            let axes = settings.homotopy.iter();
            axes.flat_map(|h| ends_of_axis(h.axes[i])).collect()
        };
        let study = |i: usize| loops.study.iter().map(|s| s.from[i]).collect();
        let flown = |i: usize| {
            let initial = loops.closed_loop.iter();
            initial.flat_map(|c| ends_of_start(c.initial[i])).collect()
        };
        let disturbed = |i: usize| {
            let initial = loops.dissipation.iter().filter_map(|d| d.initial.as_ref());
            initial
                .flat_map(|starts| ends_of_start(starts[i]))
                .collect()
        };
        let place = |section, key, values| Place {
            section,
            key,
            values,
        };
        for place in [
            place("equilibrium", None, &equilibrium as &dyn Fn(usize) -> _),
            place("region", None, &region),
            place("homotopy", None, &homotopy),
            place("study", Some("from"), &study),
            place("closed_loop", Some("initial"), &flown),
            place("dissipation", Some("initial"), &disturbed),
        ] {
            if let Some(section) = sections.get(place.section) {
                self.check_turns_of(section, &place, (states, posed.region.as_deref()));
            }
        }
    }

    fn check_turns_of(
        &mut self,
        section: &Section<'_>,
        place: &Place<'_>,
        (states, region): (&[State], Option<&[[f64; 2]]>),
    ) {
        // A period that is refused itself makes everything far away.
        let width = |i: usize| region.map_or(0.0, |r| r[i][1] - r[i][0]);
        let counted = |i: usize, state: &State| {
            (state.period).is_some_and(|period| width(i) / period <= MOST_PERIODS)
        };
        let states = states.iter().enumerate();
        for (i, state) in states.filter(|(i, state)| counted(*i, state)) {
            // A state that is not named stays at the equilibrium, which is looked at itself.
            let Some(span) = span_of(section, place.key, &state.variable.name) else {
                continue;
            };
            let wrong = (place.values)(i).into_iter();
            if let Some(error) = wrong.filter_map(|x| state.check_turns(x).err()).next() {
                let problem = Problem::at(span, error.what(), "too far away");
                self.report(problem.with_help(error.help()));
            }
        }
    }
}

/// Where a section, or the table under a key of it, names a state.
fn span_of(section: &Section<'_>, key: Option<&str>, state: &str) -> Option<Span> {
    let Some(key) = key else {
        return Some(section.get(state)?.span());
    };
    match section.get(key)?.get_ref() {
        DeValue::Table(table) => Some(table.get(state)?.span()),
        _ => None,
    }
}

fn ends_of_axis(axis: GridAxis) -> [f64; 2] {
    match axis {
        GridAxis::Fixed(x) => [x, x],
        GridAxis::Range { first, last, .. } => [first, last],
    }
}

fn ends_of_start(start: Start) -> [f64; 2] {
    match start {
        Start::Fixed(x) => [x, x],
        Start::Range { first, last, .. } => [first, last],
    }
}
