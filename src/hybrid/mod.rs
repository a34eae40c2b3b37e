//! Simulation forward in time of systems whose states jump at events: flights between events, which
//! are located to rounding, and the maps that they bring. Orbits that come back to themselves, and
//! how their neighbours do.

mod between;
mod cycle;
mod flight;
mod watch;

pub use cycle::{Cycle, CycleError, Orbits};
pub use flight::{End, Flights, Jump, Lost, OFF, Options, Sample, Simulator, lost_contact, sizes};
