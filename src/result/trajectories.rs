//! The group `/trajectories`.

use super::TrajectorySchema;
use super::table::{Data, Table};
use crate::hdf5::{Group, GroupWriter, OutputError, ResultFile, Values};
use crate::schema;
use crate::trajectories::TrajectoryBlock;

/// Writes the group `/trajectories`.
#[derive(Debug)]
pub struct TrajectoryWriter {
    writer: GroupWriter,
    has_controls: bool,
    has_disturbances: bool,
    values_only: bool,
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
            writer: self.group(&schema.group()?)?,
            has_controls: !schema.controls.is_empty(),
            has_disturbances: !schema.disturbances.is_empty(),
            values_only: schema.values_only.is_some(),
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
            ("x", (&block.x).into()),
            ("V", (&block.v).into()),
            ("status", (&block.status).into()),
            ("sheet", (&block.sheet).into()),
        ];
        if self.values_only {
            return self.writer.append(block.count, &values);
        }
        values.extend::<[(&str, Values<'_>); 6]>([
            ("t", (&block.t).into()),
            ("p", (&block.p).into()),
            ("H", (&block.h).into()),
            ("steps", (&block.steps).into()),
            ("rejected", (&block.rejected).into()),
            ("hamiltonian_drift", (&block.hamiltonian_drift).into()),
        ]);
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
    /// The declaration of the group `/trajectories`.
    ///
    /// # Errors
    /// [`OutputError::MissingVariable`], a mistake of the program.
    pub fn group(&self) -> Result<Group, OutputError> {
        let mut table = Table::new(&schema::TRAJECTORIES, self)
            .compression(self.compression)
            .length("trajectory", self.expected_trajectories)
            .length("sample", self.samples);
        if let Some(in_single) = self.values_only {
            table = table.partial();
            table.attribute("stored", "values");
            for (name, in_single) in ["x", "V"].into_iter().zip(in_single) {
                table.put(
                    name,
                    match in_single {
                        true => Data::LaterInSingle,
                        false => Data::Later,
                    },
                );
            }
            table.put_codes("status", self.status_flags.iter().cloned(), Data::Later);
            table.put("sheet", Data::Later);
            return table.declare();
        }
        for name in ["t", "x", "p"] {
            table.put(name, Data::Later);
        }
        if !self.controls.is_empty() {
            table.put("u", Data::Later);
        }
        if !self.disturbances.is_empty() {
            table.put("w", Data::Later);
        }
        for name in ["V", "H"] {
            table.put(name, Data::Later);
        }
        table.put_codes("status", self.status_flags.iter().cloned(), Data::Later);
        for name in ["sheet", "steps", "rejected", "hamiltonian_drift"] {
            table.put(name, Data::Later);
        }
        table.declare()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::testing::TemporaryDirectory;
    use crate::result::Axis;
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
