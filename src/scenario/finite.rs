//! Whether a scene's equations have values at all.

use super::equilibrium::{Scene, point_of};
use super::reader::Reader;
use crate::diagnostics::Problem;
use crate::model::Located;

/// States of the region at which values are looked for.
const STATES: usize = 1024;

impl Reader<'_> {
    /// Refuses rates, and a running cost, that have a finite value nowhere in the region; the
    /// controls are as near to 0 as their bounds let them be.
    pub fn check_finite(&mut self, scene: &Scene<'_>) {
        let Some(region) = scene.region else { return };
        let rates =
            (scene.dynamics.iter().zip(scene.states)).map(|(f, s)| (format!("d{}/dt", s.name), f));
        let mut without: Vec<(String, &Located)> = rates
            .chain([("the running cost".to_owned(), scene.running)])
            .collect();
        for k in 0..STATES {
            if without.is_empty() {
                return;
            }
            let mut values = self.values.clone();
            values.extend(point_of(k, scene.states, region));
            values.extend(scene.controls.iter().map(|c| {
                let [least, most] = [
                    c.min.unwrap_or(f64::NEG_INFINITY),
                    c.max.unwrap_or(f64::INFINITY),
                ];
                (c.variable.symbol, 0f64.max(least).min(most))
            }));
            values.extend(scene.disturbances.iter().map(|w| (w.symbol, 0.0)));
            without.retain(|(_, f)| !self.graph.eval(&[f.expr], &values)[0].is_finite());
        }
        if let Some((what, f)) = without.first() {
            let message = format!("{what} is a finite number nowhere in the region");
            let label = format!("looked for at {STATES} states");
            let help = "numbers far out of proportion, or a function outside its domain, such as sqrt or asin";
            self.report(Problem::at(f.span.clone(), message, label).with_help(help));
        }
    }
}
