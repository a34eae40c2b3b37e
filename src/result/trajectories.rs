//! The group `/trajectories`.

use crate::hdf5::{Compression, GroupWriter, OutputError, ResultFile};
use crate::hdf5::{Dimension, Group, Variable};
use crate::trajectories::TrajectoryBlock;

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

/// What all trajectories of a file have in common.
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
}

/// Writes the group `/trajectories`.
#[derive(Debug)]
pub struct TrajectoryWriter {
    writer: GroupWriter,
    has_controls: bool,
    has_disturbances: bool,
}

impl ResultFile {
    /// Makes the group `/trajectories`.
    ///
    /// # Errors
    /// [`OutputError::EmptyDimension`] without a state or a sample, [`OutputError::Duplicate`] the
    /// second time, [`OutputError::File`] and [`OutputError::Hdf5`].
    pub fn trajectories(
        &mut self,
        schema: &TrajectorySchema,
    ) -> Result<TrajectoryWriter, OutputError> {
        Ok(TrajectoryWriter {
            writer: self.group(&schema.group())?,
            has_controls: !schema.controls.is_empty(),
            has_disturbances: !schema.disturbances.is_empty(),
        })
    }
}

impl TrajectoryWriter {
    /// How many trajectories have been appended.
    #[must_use]
    pub fn count(&self) -> usize {
        self.writer.rows()
    }

    /// Appends a block, of any size. Large blocks are faster than many of one trajectory.
    ///
    /// # Errors
    /// [`OutputError::Length`] for a list that does not fit the block's `count`,
    /// [`OutputError::UnknownVariable`] for controls or disturbances that the schema does not have;
    /// nothing is written then. [`OutputError::File`] and [`OutputError::Hdf5`].
    pub fn append(&mut self, block: &TrajectoryBlock) -> Result<(), OutputError> {
        let mut values = vec![
            ("t", (&block.t).into()),
            ("x", (&block.x).into()),
            ("p", (&block.p).into()),
            ("V", (&block.v).into()),
            ("H", (&block.h).into()),
            ("status", (&block.status).into()),
            ("sheet", (&block.sheet).into()),
            ("steps", (&block.steps).into()),
            ("rejected", (&block.rejected).into()),
            ("hamiltonian_drift", (&block.hamiltonian_drift).into()),
        ];
        if self.has_controls || !block.u.is_empty() {
            values.push(("u", (&block.u).into()));
        }
        if self.has_disturbances || !block.w.is_empty() {
            values.push(("w", (&block.w).into()));
        }
        self.writer.append(block.count, &values)
    }
}

impl TrajectorySchema {
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

    /// The declaration of the group `/trajectories`.
    #[must_use]
    pub fn group(&self) -> Group {
        let (cost, time) = (self.cost(), self.time());
        let rate = quotient(cost, time);
        let costates: Vec<String> = self
            .states
            .iter()
            .map(|state| quotient(cost, state.unit()))
            .collect();

        let mut group = Group::new("trajectories")
            .compression(self.compression)
            .expected_rows(self.expected_trajectories)
            .attribute("title", "characteristics of the value function")
            .dimension(Dimension::unlimited("trajectory"))
            .dimension(Dimension::index("sample", self.samples));
        group = with_axes(group, "state", &self.states);
        group = with_axes(group, "control", &self.controls);
        group = with_axes(group, "disturbance", &self.disturbances);
        group = group
            .variable(
                Variable::text(
                    "costate_units",
                    "state",
                    costates.iter().map(String::as_str),
                )
                .long_name("unit of the costate of each state"),
            )
            .variable(over_samples(
                "t",
                None,
                time,
                "time, 0 at the end at the equilibrium",
            ))
            .variable(over_samples(
                "x",
                Some("state"),
                &common(self.states.iter().map(Axis::unit), "state_units"),
                "state",
            ))
            .variable(over_samples(
                "p",
                Some("state"),
                &common(costates.iter().map(String::as_str), "costate_units"),
                "costate, the gradient of the value function",
            ));
        if !self.controls.is_empty() {
            let unit = common(self.controls.iter().map(Axis::unit), "control_units");
            group = group.variable(over_samples("u", Some("control"), &unit, "control"));
        }
        if !self.disturbances.is_empty() {
            let unit = common(
                self.disturbances.iter().map(Axis::unit),
                "disturbance_units",
            );
            group = group.variable(over_samples("w", Some("disturbance"), &unit, "disturbance"));
        }
        group
            .variable(over_samples("V", None, cost, "value function"))
            .variable(over_samples("H", None, &rate, "Hamiltonian"))
            .variable(
                Variable::i32("status", ["trajectory"])
                    .long_name("how the trajectory ended")
                    .flags(
                        self.status_flags
                            .iter()
                            .map(|(code, meaning)| (*code, meaning.as_str())),
                    ),
            )
            .variable(count("sheet", "sheet of the value function"))
            .variable(count("steps", "accepted integration steps"))
            .variable(count("rejected", "rejected integration steps"))
            .variable(
                Variable::f64("hamiltonian_drift", ["trajectory"])
                    .unit(&rate)
                    .long_name("largest deviation of the Hamiltonian from its invariant value"),
            )
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

fn over_samples(name: &str, component: Option<&str>, unit: &str, long_name: &str) -> Variable {
    let dims = ["trajectory", "sample"].into_iter().chain(component);
    Variable::f64(name, dims).unit(unit).long_name(long_name)
}

fn count(name: &str, long_name: &str) -> Variable {
    Variable::i32(name, ["trajectory"]).long_name(long_name)
}

/// The unit that all components share, or where to look for each.
pub(super) fn common<'u>(mut units: impl Iterator<Item = &'u str>, variable: &str) -> String {
    match units.next() {
        Some(first) if units.all(|unit| unit == first) => first.to_owned(),
        _ => format!("see {variable}"),
    }
}

/// The unit of a quotient, as UDUNITS reads it.
pub(super) fn quotient(numerator: &str, denominator: &str) -> String {
    if denominator == DIMENSIONLESS {
        numerator.to_owned()
    } else if denominator.chars().all(char::is_alphabetic) {
        format!("{numerator}/{denominator}")
    } else {
        format!("{numerator}/({denominator})")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::testing::TemporaryDirectory;
    use rust_hdf5::H5File;

    fn axis(name: &str, unit: Option<&str>) -> Axis {
        Axis {
            name: name.to_owned(),
            unit: unit.map(str::to_owned),
            long_name: None,
        }
    }

    fn schema() -> TrajectorySchema {
        TrajectorySchema {
            states: vec![axis("phi", Some("rad")), axis("omega", Some("rad/s"))],
            controls: vec![axis("torque", Some("N m"))],
            samples: 2,
            status_flags: vec![(0, "reached level".into()), (1, "left region".into())],
            ..TrajectorySchema::default()
        }
    }

    fn block() -> TrajectoryBlock {
        TrajectoryBlock {
            count: 1,
            t: vec![-1.0, 0.0],
            x: vec![0.1, 0.2, 0.3, 0.4],
            p: vec![1.0, 2.0, 3.0, 4.0],
            u: vec![5.0, 6.0],
            w: vec![],
            v: vec![7.0, f64::NAN],
            h: vec![0.0, 1e-9],
            status: vec![1],
            sheet: vec![0],
            steps: vec![12],
            rejected: vec![3],
            hamiltonian_drift: vec![1e-9],
        }
    }

    #[test]
    fn a_block_comes_back() {
        let directory = TemporaryDirectory::new("block");
        let mut file = ResultFile::create(directory.path().join("result.h5")).unwrap();
        let mut writer = file.trajectories(&schema()).unwrap();
        writer.append(&TrajectoryBlock::default()).unwrap();
        writer.append(&block()).unwrap();
        assert_eq!(writer.count(), 1);
        let back = H5File::open(file.finish().unwrap()).unwrap();
        let x = back.dataset("trajectories/x").unwrap();
        assert_eq!(x.shape(), [1, 2, 2]);
        assert_eq!(x.read_raw::<f64>().unwrap(), block().x);
        let unit = |name: &str| {
            let dataset = back.dataset(&format!("trajectories/{name}")).unwrap();
            dataset.attr("units").unwrap().read_string().unwrap()
        };
        assert_eq!(unit("t"), "1");
        assert_eq!(unit("x"), "see state_units");
        assert_eq!(unit("u"), "N m");
        assert_eq!(unit("H"), "1");
        let units = back.dataset("trajectories/costate_units").unwrap();
        assert_eq!(units.read_vlen_strings().unwrap(), ["1/rad", "1/(rad/s)"]);
        for absent in ["w", "disturbance", "disturbance_units"] {
            assert!(back.dataset(&format!("trajectories/{absent}")).is_err());
        }
    }

    #[test]
    fn blocks_that_do_not_fit_the_schema() {
        let directory = TemporaryDirectory::new("misfit");
        let mut file = ResultFile::create(directory.path().join("result.h5")).unwrap();
        let mut writer = file.trajectories(&schema()).unwrap();
        let mut short = block();
        short.p.pop();
        assert!(matches!(
            writer.append(&short),
            Err(OutputError::Length { .. })
        ));
        let mut disturbed = block();
        disturbed.w = vec![0.0; 2];
        assert!(matches!(
            writer.append(&disturbed),
            Err(OutputError::UnknownVariable { .. })
        ));
        let mut undriven = block();
        undriven.u.clear();
        assert!(matches!(
            writer.append(&undriven),
            Err(OutputError::Length { .. })
        ));
        assert_eq!(writer.count(), 0);
    }

    #[test]
    fn a_system_has_states_and_samples() {
        let directory = TemporaryDirectory::new("nothing");
        let mut file = ResultFile::create(directory.path().join("result.h5")).unwrap();
        let stateless = TrajectorySchema {
            states: vec![],
            ..schema()
        };
        let unsampled = TrajectorySchema {
            samples: 0,
            ..schema()
        };
        for schema in [stateless, unsampled] {
            assert!(matches!(
                file.trajectories(&schema),
                Err(OutputError::EmptyDimension { .. })
            ));
        }
    }
}
