//! Names and units that the groups of a scene share.

use crate::hdf5::{Compression, Dimension, Group, Variable};
use crate::model::Model;
use crate::schema::Unit;

/// A state, control or disturbance as the file names it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Axis {
    /// Its name, the coordinate value along its dimension.
    pub name: String,
    /// Its unit; `"1"` when `None`.
    pub unit: Option<String>,
    /// What it is, in words; its name when `None`.
    pub long_name: Option<String>,
}

impl Axis {
    pub(super) fn unit(&self) -> &str {
        self.unit.as_deref().unwrap_or(DIMENSIONLESS)
    }

    pub(super) fn description(&self) -> &str {
        self.long_name.as_deref().unwrap_or(&self.name)
    }
}

const DIMENSIONLESS: &str = "1";

/// The axes of a scene, and what all swept trajectories of a file have in common.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrajectorySchema {
    /// The states, at least one.
    pub states: Vec<Axis>,
    /// The controls; without any, the file has no `control` and no `u`.
    pub controls: Vec<Axis>,
    /// The disturbances; without any, the file has no `disturbance` and no `w`.
    pub disturbances: Vec<Axis>,
    /// Samples of a trajectory, at least one.
    pub samples: usize,
    /// The statuses' codes and meanings.
    pub status_flags: Vec<(i32, String)>,
    /// The unit of cost, hence of V; `"1"` when `None`.
    pub cost_unit: Option<String>,
    /// The unit of time; `"1"` when `None`.
    pub time_unit: Option<String>,
    /// About how many trajectories will come, if known: see [`Group::expected_rows`].
    pub expected_trajectories: Option<usize>,
    /// How the values are stored.
    pub compression: Compression,
    /// Of trajectories x, V, status and sheet alone; then whether x and V are stored in f32.
    pub values_only: Option<[bool; 2]>,
}

impl TrajectorySchema {
    /// The axes of a scene alone.
    #[must_use]
    pub fn axes(model: &Model) -> Self {
        let axis = |v: &crate::model::Variable| Axis {
            name: v.name.clone(),
            unit: v.unit.clone(),
            long_name: v.long_name.clone(),
        };
        Self {
            states: model.states.iter().map(|s| axis(&s.variable)).collect(),
            controls: model.controls.iter().map(|c| axis(&c.variable)).collect(),
            disturbances: model.disturbances.iter().map(axis).collect(),
            cost_unit: model.cost_unit.clone(),
            time_unit: model.time_unit.clone(),
            // Of a sweep writing takes most of the time.
            compression: Compression::None,
            ..Self::default()
        }
    }

    /// The unit of cost.
    #[must_use]
    pub fn cost(&self) -> &str {
        self.cost_unit.as_deref().unwrap_or(DIMENSIONLESS)
    }

    /// The unit of time.
    #[must_use]
    pub fn time(&self) -> &str {
        self.time_unit.as_deref().unwrap_or(DIMENSIONLESS)
    }
}

/// Units of a scene.
pub(super) struct Names<'a> {
    axes: &'a TrajectorySchema,
    costates: Vec<String>,
}

impl<'a> Names<'a> {
    pub fn new(axes: &'a TrajectorySchema) -> Self {
        let costate = |state: &Axis| quotient(axes.cost(), state.unit());
        Self {
            costates: axes.states.iter().map(costate).collect(),
            axes,
        }
    }

    pub fn axes(&self) -> &'a TrajectorySchema {
        self.axes
    }

    /// Whether there are controls, and disturbances.
    pub fn has(&self) -> (bool, bool) {
        (
            !self.axes.controls.is_empty(),
            !self.axes.disturbances.is_empty(),
        )
    }

    /// The variable with the unit of each costate.
    pub fn costate_units(&self) -> Variable {
        Variable::text("costate_units", "state", self.costates.clone())
            .long_name("unit of the costate of each state")
    }

    /// A unit in this file.
    pub fn unit(&self, unit: Unit) -> String {
        let of = |axes: &[Axis], variable: &str| common(axes.iter().map(Axis::unit), variable);
        match unit {
            Unit::One => DIMENSIONLESS.to_owned(),
            Unit::Cost => self.axes.cost().to_owned(),
            Unit::Time => self.axes.time().to_owned(),
            Unit::CostRate => quotient(self.axes.cost(), self.axes.time()),
            Unit::State => of(&self.axes.states, "state_units"),
            Unit::Costate => common(self.costates.iter().map(String::as_str), "costate_units"),
            Unit::Control => of(&self.axes.controls, "control_units"),
            Unit::Disturbance => of(&self.axes.disturbances, "disturbance_units"),
            Unit::Fixed(unit) => unit.to_owned(),
        }
    }
}

/// Adds the dimension `name` with the names, units and descriptions of its components; nothing
/// without any, except that a system has states.
pub(super) fn with_axes(group: Group, name: &str, axes: &[Axis]) -> Group {
    if axes.is_empty() && name != "state" {
        return group;
    }
    let names = axes.iter().map(|axis| axis.name.as_str());
    let units = axes.iter().map(Axis::unit);
    let descriptions = axes.iter().map(Axis::description);
    group
        .dimension(Dimension::names(name, names))
        .variable(
            Variable::text(&format!("{name}_units"), name, units)
                .long_name(&format!("unit of each {name}")),
        )
        .variable(
            Variable::text(&format!("{name}_long_name"), name, descriptions)
                .long_name(&format!("description of each {name}")),
        )
}

/// The unit that all components share, or where to look for each.
pub(super) fn common<'u>(mut units: impl Iterator<Item = &'u str>, variable: &str) -> String {
    match units.next() {
        Some(first) if units.all(|unit| unit == first) => first.to_owned(),
        _ => format!("see {variable}"),
    }
}

/// The unit of a product, as UDUNITS reads it.
pub(super) fn product(units: &[String]) -> String {
    let factors = units.iter().filter(|unit| *unit != DIMENSIONLESS);
    let factors: Vec<String> = factors
        .map(|unit| match unit.chars().all(char::is_alphabetic) {
            true => unit.clone(),
            false => format!("({unit})"),
        })
        .collect();
    match factors.is_empty() {
        true => DIMENSIONLESS.to_owned(),
        false => factors.join(" "),
    }
}

/// The unit of a quotient, as UDUNITS reads it.
fn quotient(numerator: &str, denominator: &str) -> String {
    if denominator == DIMENSIONLESS {
        numerator.to_owned()
    } else if denominator.chars().all(char::is_alphabetic) {
        format!("{numerator}/{denominator}")
    } else {
        format!("{numerator}/({denominator})")
    }
}
