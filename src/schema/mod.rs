//! The schema of the result file: each group with its dimensions, variables, units and meanings.
//!
//! This is data alone. Writers declare their groups from it (`result::table`), the reader checks
//! shapes against it, scenes may not use names that it reserves, and the reference of the file in
//! the guide is printed from it.

mod bench;
mod laws;
mod loops;
mod maps;
mod page;
mod shards;
mod simulations;
mod studies;
mod values;

pub use bench::{HOST_SHARE, SPEED_ERROR};
pub use laws::FEEDBACK;
pub use loops::{
    CLOSED_LOOP, CLOSED_LOOP_LAWS, CLOSED_LOOP_TRAJECTORIES, DISSIPATION, DISSIPATION_KINDS,
    DISSIPATION_TRAJECTORIES, OPERATING_CONTOURS, OPERATING_SETS,
};
pub use maps::{MAP_BEYOND, MAP_CHECK, MAP_PIECES};
pub use page::markdown;
pub use shards::{SHARD, SHARD_FILES, SHARD_POINTS, SHARD_SEAMS, SHARD_SHEETS};
pub use simulations::{CYCLES, SIMULATION, SIMULATION_EVENTS, SIMULATION_SAMPLES};
pub use studies::{
    ATTENUATION, ATTENUATION_CAUSTIC, ATTENUATION_REGIONS, STUDY, STUDY_TRAJECTORIES,
};
pub use values::{CAUSTIC, EQUAL_COST, FOLDS, MAP, POINTS, POINTS_SHEETS, TRAJECTORIES};

/// Every group, in the order in which the reference shows them.
pub static GROUPS: [&Group; 35] = [
    &TRAJECTORIES,
    &CAUSTIC,
    &POINTS,
    &POINTS_SHEETS,
    &MAP,
    &EQUAL_COST,
    &FOLDS,
    &MAP_PIECES,
    &MAP_BEYOND,
    &MAP_CHECK,
    &STUDY,
    &STUDY_TRAJECTORIES,
    &SIMULATION,
    &SIMULATION_EVENTS,
    &SIMULATION_SAMPLES,
    &CYCLES,
    &FEEDBACK,
    &CLOSED_LOOP,
    &CLOSED_LOOP_LAWS,
    &CLOSED_LOOP_TRAJECTORIES,
    &OPERATING_SETS,
    &OPERATING_CONTOURS,
    &DISSIPATION,
    &DISSIPATION_KINDS,
    &DISSIPATION_TRAJECTORIES,
    &ATTENUATION,
    &ATTENUATION_REGIONS,
    &ATTENUATION_CAUSTIC,
    &SPEED_ERROR,
    &HOST_SHARE,
    &SHARD,
    &SHARD_POINTS,
    &SHARD_SHEETS,
    &SHARD_SEAMS,
    &SHARD_FILES,
];

/// A group of the file.
#[derive(Debug)]
pub struct Group {
    /// Without the leading `/`.
    pub name: &'static str,
    /// What it holds.
    pub title: &'static str,
    pub dimensions: &'static [Dimension],
    pub variables: &'static [Variable],
    /// Names and meanings, besides `title`.
    pub attributes: &'static [(&'static str, &'static str)],
}

/// A dimension, with the coordinate variable of the same name.
#[derive(Clone, Copy, Debug)]
pub struct Dimension {
    /// In the file; a name in angle brackets stands for one that the scene gives.
    pub name: &'static str,
    pub along: Along,
    pub meaning: &'static str,
}

/// The values along a dimension.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Along {
    /// Counted from 0, of a length that is known when the group is made.
    Index,
    /// Counted from 0; rows are appended.
    Rows,
    /// A name for each index.
    Names,
    /// A number for each index.
    Values(Unit),
    /// The states, by name.
    States,
    /// The controls, by name; absent without any.
    Controls,
    /// The disturbances, by name; absent without any.
    Disturbances,
    /// One axis for each state, named like it, and one of the time where V depends on it.
    StateAxes,
}

/// A variable over some of a group's dimensions.
#[derive(Clone, Copy, Debug)]
pub struct Variable {
    /// In the file; a part in angle brackets stands for names that the scene gives.
    pub name: &'static str,
    pub kind: Kind,
    /// Names of dimensions, the slowest first.
    pub dimensions: &'static [&'static str],
    pub unit: Unit,
    pub meaning: &'static str,
    pub when: When,
}

/// What a variable stores.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// f64; NaN is 'no value'.
    Real,
    /// i32.
    Integer,
    /// i32 with `flag_values` and `flag_meanings`.
    Code,
    /// UTF-8 strings.
    Text,
}

/// The unit of a variable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    One,
    /// `[cost] unit`.
    Cost,
    /// `[time] unit`.
    Time,
    /// Cost by time.
    CostRate,
    /// Each state's own.
    State,
    /// Cost by each state's own.
    Costate,
    /// Each control's own.
    Control,
    /// Each disturbance's own.
    Disturbance,
    /// The same in every file.
    Fixed(&'static str),
}

/// Where a group has a variable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum When {
    Always,
    /// Where the scene has controls.
    Controls,
    /// Where the scene has disturbances.
    Disturbances,
    /// In words, to follow 'with'.
    With(&'static str),
}

/// The group of this name.
#[must_use]
pub fn group(name: &str) -> Option<&'static Group> {
    GROUPS.iter().find(|g| g.name == name).copied()
}

impl AsRef<str> for Group {
    fn as_ref(&self) -> &str {
        self.name
    }
}

impl Group {
    /// The variable that a file's name belongs to: that of this name, or one whose name the scene
    /// gives.
    pub fn variable(&self, name: &str) -> Option<&'static Variable> {
        let exact = self.variables.iter().find(|v| v.name == name);
        exact.or_else(|| {
            let mut open = self.variables.iter().filter(|v| v.fits(name));
            open.find(|_| !self.reserves(name))
        })
    }

    /// Whether a name that a scene would give to something in this group is taken: by a variable, a
    /// dimension, or the units and descriptions that any dimension may have.
    #[must_use]
    pub fn reserves(&self, name: &str) -> bool {
        const ENDINGS: [&str; 2] = ["_units", "_long_name"];
        let variables = self.variables.iter().map(|v| v.name);
        let dimensions = self.dimensions.iter().map(|d| d.name);
        ENDINGS.iter().any(|end| name.ends_with(end))
            || LATER.contains(&name)
            || variables.chain(dimensions).any(|own| own == name)
    }
}

/// Names that a later version may write beside a scene's own.
const LATER: [&str; 4] = ["u", "control", "w", "disturbance"];

impl Variable {
    /// The variable, only where the group has it.
    #[must_use]
    pub(crate) const fn when(mut self, when: When) -> Self {
        self.when = when;
        self
    }

    /// Whether the scene gives the name, or a part of it.
    #[must_use]
    pub fn is_open(&self) -> bool {
        self.name.contains('<')
    }

    /// Whether an open name can be this one.
    fn fits(&self, name: &str) -> bool {
        let Some((before, rest)) = self.name.split_once('<') else {
            return false;
        };
        let after = rest.split_once('>').map_or("", |(_, after)| after);
        name.len() > before.len() + after.len() && name.starts_with(before) && name.ends_with(after)
    }
}

const fn variable(
    name: &'static str,
    kind: Kind,
    dimensions: &'static [&'static str],
    unit: Unit,
    meaning: &'static str,
) -> Variable {
    Variable {
        name,
        kind,
        dimensions,
        unit,
        meaning,
        when: When::Always,
    }
}

pub(crate) const fn real(
    name: &'static str,
    dimensions: &'static [&'static str],
    unit: Unit,
    meaning: &'static str,
) -> Variable {
    variable(name, Kind::Real, dimensions, unit, meaning)
}

pub(crate) const fn integer(
    name: &'static str,
    dimensions: &'static [&'static str],
    meaning: &'static str,
) -> Variable {
    variable(name, Kind::Integer, dimensions, Unit::One, meaning)
}

pub(crate) const fn code(
    name: &'static str,
    dimensions: &'static [&'static str],
    meaning: &'static str,
) -> Variable {
    variable(name, Kind::Code, dimensions, Unit::One, meaning)
}

pub(crate) const fn text(
    name: &'static str,
    dimensions: &'static [&'static str],
    meaning: &'static str,
) -> Variable {
    variable(name, Kind::Text, dimensions, Unit::One, meaning)
}

pub(crate) const fn along(name: &'static str, along: Along, meaning: &'static str) -> Dimension {
    Dimension {
        name,
        along,
        meaning,
    }
}

pub(crate) const STATES: Dimension = along("state", Along::States, "state");
pub(crate) const CONTROLS: Dimension = along("control", Along::Controls, "control");
pub(crate) const DISTURBANCES: Dimension = along("disturbance", Along::Disturbances, "disturbance");
pub(crate) const STATE_AXES: Dimension = along(
    "<state>",
    Along::StateAxes,
    "an axis for each state, named like it; of V(x, t) also one of the time",
);

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn groups_are_consistent() {
        let mut names = BTreeSet::new();
        for group in GROUPS {
            assert!(names.insert(group.name), "/{} twice", group.name);
            let mut own = BTreeSet::new();
            for dimension in group.dimensions {
                assert!(own.insert(dimension.name), "/{}", group.name);
            }
            for variable in group.variables {
                let place = format!("/{}/{}", group.name, variable.name);
                assert!(own.insert(variable.name), "{place} twice");
                assert!(!variable.meaning.is_empty(), "{place}");
                for dimension in variable.dimensions {
                    let known = group.dimensions.iter().any(|d| d.name == *dimension);
                    assert!(
                        known,
                        "{place} is over {dimension}, which the group has not"
                    );
                }
            }
        }
    }

    #[test]
    fn open_names_fit() {
        let group = &CLOSED_LOOP_LAWS;
        assert_eq!(group.variable("rate").unwrap().name, "rate");
        assert_eq!(group.variable("worst_R").unwrap().name, "worst_<quantity>");
        assert!(group.variable("worst_").is_none());
        assert!(group.variable("other").is_none());
        // A dimension is no quantity that a scene records.
        assert!(CLOSED_LOOP.variable("law").is_none());
        assert_eq!(CLOSED_LOOP.variable("R").unwrap().name, "<quantity>");
        assert!(CLOSED_LOOP.reserves("J"));
        assert!(CLOSED_LOOP.reserves("law"));
        assert!(CLOSED_LOOP.reserves("state_units"));
        assert!(!CLOSED_LOOP.reserves("largest"));
    }
}
