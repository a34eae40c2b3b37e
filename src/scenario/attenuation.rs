//! `[attenuation]`: the parameter that is the level of attenuation, and where its smallest value is
//! asked for.

use super::declare::{Declarations, Declared};
use super::reader::{Reader, Section, Value};
use super::settings::grid_points;
use crate::diagnostics::Problem;
use crate::diagnostics::did_you_mean;
use crate::diagnostics::shorten;
use crate::model::{Attenuation, GridAxis};
use crate::schema;
use toml::de::DeValue;

/// Relative tolerance of the smallest value that covers the states, unless given.
const DEFAULT_TOLERANCE: f64 = 1e-3;
/// Values whose regions are stored.
const MOST_LEVELS: usize = 12;

impl<'a> Reader<'a> {
    /// `[attenuation]`; `None` where something in it is wrong.
    pub fn attenuation(
        &mut self,
        section: &Section<'a>,
        declared: &Declarations<'a>,
        region: Option<&[[f64; 2]]>,
        finite: bool,
    ) -> Option<Attenuation> {
        self.check_keys(section, "attenuation");
        let before = self.problems.len();
        if declared.disturbances.is_empty() {
            let problem = Problem::at(
                section.span.clone(),
                "[attenuation] is for scenes with [disturbances], of which this one has none",
                "nothing to attenuate",
            );
            self.report(problem.with_help(
                "declare the disturbances in [disturbances], and weigh them in the cost: - 0.5*gamma^2*w^2",
            ));
        } else if finite {
            let message = "[attenuation] is of the infinite horizon; this scene has a final time";
            self.report(Problem::at(section.span.clone(), message, "remove this"));
        }
        if let Some(state) = declared
            .states
            .iter()
            .find(|s| schema::ATTENUATION_REGIONS.reserves(s.name))
        {
            let message = format!(
                "a state named `{}` cannot be an axis of the regions of [attenuation], which have a variable of that name",
                state.name
            );
            self.report(Problem::at(state.span.clone(), message, "rename the state"));
        }
        let parameter = self.level_parameter(section, &declared.parameters);
        let range = section.get("range").and_then(|v| self.level_range(v));
        let tolerance = (section.get("tolerance")).and_then(|v| {
            self.number_that(v, "tolerance", "from 1e-6 to 0.5", |t| {
                (1e-6..=0.5).contains(&t)
            })
        });
        let axes = self.covered_states(section, &declared.states, region);
        let levels = section
            .get("levels")
            .map(|v| self.level_values(v))
            .unwrap_or_default();
        (self.problems.len() == before).then_some(())?;
        let parameter = parameter?;
        Some(Attenuation {
            parameter: parameter.name.to_owned(),
            parameter_span: parameter.value.span(),
            range,
            tolerance: tolerance.unwrap_or(DEFAULT_TOLERANCE),
            axes: axes?,
            levels,
            span: section.span.clone(),
        })
    }

    /// The parameter named, which must be a number in the file: it is replaced by others.
    fn level_parameter<'d>(
        &mut self,
        section: &Section<'a>,
        parameters: &'d [Declared<'a>],
    ) -> Option<&'d Declared<'a>> {
        let Some(value) = section.get("parameter") else {
            let problem = Problem::at(
                section.span.clone(),
                "[attenuation] does not name the parameter that is the level of attenuation",
                "`parameter` is missing",
            );
            self.report(problem.with_help("add parameter = \"gamma\", a name of [parameters]"));
            return None;
        };
        let name = self.string(value, "parameter")?;
        let Some(found) = parameters.iter().find(|p| p.name == name) else {
            let names = || parameters.iter().map(|p| p.name);
            let help = did_you_mean(name, names()).unwrap_or_else(|| {
                format!("parameters: {}", names().collect::<Vec<_>>().join(", "))
            });
            let message = format!("`{}` is not a parameter", shorten(name));
            self.report(Problem::at(value.span(), message, "not in [parameters]").with_help(help));
            return None;
        };
        if matches!(found.value.get_ref(), DeValue::String(_)) {
            let message = format!(
                "parameter `{}` is an expression; the level of attenuation must be a number",
                shorten(name)
            );
            let problem = Problem::at(value.span(), message, "other values are put in its place");
            self.report(problem.with_help(
                "name the parameter that it follows from, or write its value as a number",
            ));
            return None;
        }
        Some(found)
    }

    fn level_range(&mut self, value: &'a Value<'a>) -> Option<[f64; 2]> {
        let range = self.interval(value, "range")?;
        if range[0] > 0.0 {
            return Some(range);
        }
        let message = format!("range must be above 0, but begins at {}", range[0]);
        self.refuse(value.span(), message, "a level of attenuation is positive")
    }

    fn level_values(&mut self, value: &'a Value<'a>) -> Vec<f64> {
        let DeValue::Array(array) = value.get_ref() else {
            self.report(Problem::at(
                value.span(),
                "levels must be a list",
                "expected [..., ...]",
            ));
            return Vec::new();
        };
        if array.is_empty() || array.len() > MOST_LEVELS {
            let message = format!(
                "levels must be 1 to {MOST_LEVELS} values, not {}",
                array.len()
            );
            self.report(Problem::at(
                value.span(),
                message,
                "each is solved for, and drawn",
            ));
        }
        let mut levels: Vec<f64> = (array.iter())
            .filter_map(|v| self.number_that(v, "a level", "greater than 0", |v| v > 0.0))
            .collect();
        levels.sort_by(f64::total_cmp);
        levels.dedup();
        levels
    }

    /// The grid at which coverage is judged: the whole region unless `states` says otherwise.
    fn covered_states(
        &mut self,
        section: &Section<'a>,
        states: &[Declared<'a>],
        region: Option<&[[f64; 2]]>,
    ) -> Option<Vec<GridAxis>> {
        let count = default_count(states.len());
        let whole = |i: usize| {
            let [first, last] = *region?.get(i)?;
            Some(GridAxis::Range { first, last, count })
        };
        let Some(value) = section.get("states") else {
            return (0..states.len()).map(whole).collect();
        };
        let table = self.table(
            value,
            section.key_span("states"),
            "the states of [attenuation]",
        )?;
        let axes = self.grid_axes(&table, states, &whole)?;
        self.grid_size(&table, grid_points(&axes))?;
        Some(axes)
    }
}

/// Points along each axis of a grid that is not given: about 1000 in all, and odd, so that the
/// middle is among them.
fn default_count(states: usize) -> usize {
    let most = 1000f64.powf(1.0 / states.max(1) as f64).floor() as usize;
    (most - (most + 1) % 2).clamp(3, 401)
}

#[cfg(test)]
mod tests {
    #[test]
    fn about_a_thousand_states() {
        let counts = [1, 2, 3, 4, 5].map(super::default_count);
        assert_eq!(counts, [401, 31, 9, 5, 3]);
    }
}
