//! `/simulation` and what belongs to it.

use super::TrajectorySchema;
use super::table::Table;
use crate::hdf5::{OutputError, ResultFile};
use crate::hybrid::{Cycle, CycleError, End};
use crate::schema;
use crate::session::{Cycles, Simulated};

/// Codes of orbits that were looked for, with their meanings.
const CYCLE_STATUSES: [(i32, &str); 4] = [
    (0, "found"),
    (1, "no_return"),
    (2, "not_converged"),
    (3, "at_rest"),
];

/// The code of such an orbit.
fn code(found: &Result<Cycle, CycleError>) -> i32 {
    match found {
        Ok(_) => 0,
        Err(CycleError::NoReturn { .. }) => 1,
        Err(CycleError::Diverged { .. }) => 2,
        Err(CycleError::AtRest { .. }) => 3,
    }
}

impl ResultFile {
    /// Writes flights, and the orbits that they begin on; `device` is the backend's name and its adapter.
    ///
    /// # Errors
    /// [`OutputError`] on writing.
    pub fn simulation(
        &mut self,
        axes: &TrajectorySchema,
        simulated: &Simulated,
        device: (&str, &str),
    ) -> Result<(), OutputError> {
        let flights = &simulated.flights;
        let count = flights.t.len();
        let at_events =
            (simulated.names.iter().enumerate()).map(|(k, name)| (End::At(k).code(), name.clone()));
        let others = End::OTHERS.map(|end| (end.code(), end.name().to_owned()));
        let integers = |all: &mut dyn Iterator<Item = usize>| -> Vec<i32> {
            all.map(|n| i32::try_from(n).unwrap_or(i32::MAX)).collect()
        };
        let mut table = Table::new(&schema::SIMULATION, axes).length("flight", count);
        table
            .put("x0", &simulated.initial)
            .put("x_end", &flights.last)
            .put("t_end", &flights.t)
            .put("events", integers(&mut flights.events.iter().copied()))
            .put_codes(
                "status",
                others.into_iter().chain(at_events),
                flights.end.iter().map(|e| e.code()).collect::<Vec<i32>>(),
            )
            .attribute("time", simulated.time)
            .attribute("law", simulated.law.clone().unwrap_or_default())
            .attribute("backend", device.0)
            .attribute("adapter", device.1)
            .attribute("precision", simulated.precision.name())
            .attribute("method", simulated.method)
            .attribute("rtol", simulated.rtol);
        if let Some(cost) = &simulated.cost {
            table.put("J", cost);
        }
        table.write(self)?;

        let jumps = &flights.jumps;
        let names = simulated.names.iter().take(simulated.events);
        let mut table = Table::new(&schema::SIMULATION_EVENTS, axes).length("jump", jumps.len());
        table
            .put("flight", integers(&mut jumps.iter().map(|j| j.flight)))
            .put_codes(
                "event",
                (0i32..).zip(names.cloned()),
                integers(&mut jumps.iter().map(|j| j.event)),
            )
            .put("t", jumps.iter().map(|j| j.t).collect::<Vec<f64>>())
            .put("before", flat(jumps.iter().map(|j| &j.before)))
            .put("after", flat(jumps.iter().map(|j| &j.after)));
        table.write(self)?;

        let samples = &flights.samples;
        let mut table =
            Table::new(&schema::SIMULATION_SAMPLES, axes).length("sample", samples.len());
        table
            .put("flight", integers(&mut samples.iter().map(|s| s.flight)))
            .put("phase", integers(&mut samples.iter().map(|s| s.phase)))
            .put("t", samples.iter().map(|s| s.t).collect::<Vec<f64>>())
            .put("x", flat(samples.iter().map(|s| &s.x)));
        if !axes.controls.is_empty() {
            table.put("u", &simulated.u);
        }
        table.write(self)?;
        match &simulated.cycles {
            Some(found) => self.cycles(axes, found),
            None => Ok(()),
        }
    }

    fn cycles(&mut self, axes: &TrajectorySchema, found: &Cycles) -> Result<(), OutputError> {
        let (events, cycles) = (found.events, &found.found);
        let n = axes.states.len();
        let unknown = vec![f64::NAN; n];
        let numbers = |of: &dyn Fn(&Cycle) -> f64| -> Vec<f64> {
            (cycles.iter())
                .map(|c| c.as_ref().map_or(f64::NAN, of))
                .collect()
        };
        let multipliers = |part: usize| -> Vec<f64> {
            (cycles.iter())
                .flat_map(|c| match c {
                    Ok(cycle) => cycle.multipliers.iter().map(|m| m[part]).collect(),
                    Err(_) => unknown.clone(),
                })
                .collect()
        };
        let mut table = Table::new(&schema::CYCLES, axes)
            .length("cycle", cycles.len())
            .length("multiplier", n);
        table
            .attribute("events", i64::try_from(events).unwrap_or(i64::MAX))
            .put(
                "x",
                flat(
                    cycles
                        .iter()
                        .map(|c| c.as_ref().map_or(&unknown, |c| &c.start)),
                ),
            )
            .put("period", numbers(&|c| c.period))
            .put("multiplier_re", multipliers(0))
            .put("multiplier_im", multipliers(1))
            .put("residual", numbers(&|c| c.residual))
            .put(
                "iterations",
                (cycles.iter())
                    .map(|c| c.as_ref().map_or(0, |c| c.iterations as i32))
                    .collect::<Vec<i32>>(),
            )
            .put_codes(
                "status",
                CYCLE_STATUSES,
                cycles.iter().map(code).collect::<Vec<i32>>(),
            );
        table.write(self)
    }
}

fn flat<'v>(rows: impl Iterator<Item = &'v Vec<f64>>) -> Vec<f64> {
    rows.flatten().copied().collect()
}
