//! Whether a scene repeats itself after the periods that it names.

use super::equilibrium::{POINTS, Scene, point_of, sized};
use super::reader::Reader;
use crate::diagnostics::Problem;
use crate::expr::Id;
use crate::model::State;
use crate::numeric::digits::plain;
use rustc_hash::FxHashMap;

/// Periods in the region's width, at most: a state is looked for a few periods away, never a
/// thousand.
pub(super) const MOST_PERIODS: f64 = 1000.0;
/// Relative difference that rounding leaves. A period, or a factor of the equations, with few
/// digits leaves more: V would be that much wrong at states a few periods away, and nothing would
/// show it.
const ROUNDING: f64 = 1e-8;

/// With six decimals, or as many digits where that would be hundreds.
fn placed(at: f64) -> String {
    match at.abs() < 1e15 {
        true => format!("{at:.6}"),
        false => format!("{at:.6e}"),
    }
}

impl Reader<'_> {
    /// Checks each period against the region, and the equations one period later at some points of
    /// the region. The cost and guards need not repeat: then the copies of a state by whole periods
    /// are told apart, and the cheapest counts.
    pub fn check_periods(&mut self, states: &[State], scene: &Scene<'_>) {
        let Some(region) = scene.region else { return };
        let rates = scene.dynamics.iter().zip(states);
        let rates = rates.map(|(f, s)| (format!("d{}/dt", s.variable.name), f.expr));
        let all: Vec<(String, Id)> = rates.collect();

        for (i, state) in states.iter().enumerate() {
            let Some(period) = state.period else { continue };
            let [lower, upper] = region[i];
            let count = (upper - lower) / period;
            if count > MOST_PERIODS {
                let message = format!(
                    "the region is {count:.1e} periods of `{}` wide; at most {MOST_PERIODS}",
                    state.variable.name
                );
                let label = format!("its period is {period:e}");
                self.report(Problem::at(state.variable.span.clone(), message, label));
                continue;
            }
            if let Some(message) = self.differs(period, state, &all, scene, region) {
                let problem = Problem::at(
                    state.variable.span.clone(),
                    message,
                    "not the same one period later",
                );
                self.report(problem.with_help(
                    "give the period, and factors such as pi/180 in the equations, as expressions (period = \"2*pi\": digits cut short are not enough), or leave it out if the state is no angle",
                ));
            }
        }
    }

    /// What is not the same one period later, in words.
    fn differs(
        &self,
        period: f64,
        state: &State,
        all: &[(String, Id)],
        scene: &Scene<'_>,
        region: &[[f64; 2]],
    ) -> Option<String> {
        let name = &state.variable.name;
        for k in 0..POINTS {
            let mut here = self.values.clone();
            here.extend(point_of(k, scene.states, region));
            // Any values within the bounds will do.
            let inputs = scene.controls.iter().enumerate().map(|(j, c)| {
                let value = ((k + 1) as f64 * (j as f64 + 3.0).sqrt()).sin();
                let bounds = (
                    c.min.unwrap_or(f64::NEG_INFINITY),
                    c.max.unwrap_or(f64::INFINITY),
                );
                (c.variable.symbol, value.max(bounds.0).min(bounds.1))
            });
            here.extend(inputs);
            here.extend(scene.disturbances.iter().map(|w| (w.symbol, 0.1)));
            let at = here.get(&state.variable.symbol).copied()?;
            let mut later: FxHashMap<Id, f64> = here.clone();
            later.insert(state.variable.symbol, at + period);
            for (what, expr) in all {
                let (a, size) = sized(&self.graph, *expr, &here);
                let (b, later_size) = sized(&self.graph, *expr, &later);
                let bound = ROUNDING * size.max(later_size).max(f64::MIN_POSITIVE);
                if a.is_finite() && b.is_finite() && (a - b).abs() > bound {
                    return Some(format!(
                        "`{name}` is said to repeat after {}, but {what} does not: it is {a:.6e} at {name} = {}, and {b:.6e} \
                         one period later",
                        plain(period),
                        placed(at)
                    ));
                }
            }
        }
        None
    }
}
