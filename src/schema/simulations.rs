//! Simulations forward in time.

use super::{Along, CONTROLS, Group, STATES, Unit, When, along, code, integer, real};

/// A row for each flight.
pub static SIMULATION: Group = Group {
    name: "simulation",
    title: "flights forward in time, with the scene's events",
    dimensions: &[along("flight", Along::Index, "flight index"), STATES],
    variables: &[
        real(
            "x0",
            &["flight", "state"],
            Unit::State,
            "state at the beginning",
        ),
        real(
            "x_end",
            &["flight", "state"],
            Unit::State,
            "state at the end, after the last event",
        ),
        real("t_end", &["flight"], Unit::Time, "time at the end"),
        integer("events", &["flight"], "events at which the state jumped"),
        code("status", &["flight"], "how the flight ended"),
        real(
            "J",
            &["flight"],
            Unit::Cost,
            "cost until the end; that at the final time is in it where the flight gets there",
        )
        .when(When::With("a law of Python")),
    ],
    attributes: &[
        ("time", "how long a flight was to last"),
        ("law", "what controlled; empty: controls were held"),
        ("backend", "cpu or gpu, or python"),
        ("adapter", "the device"),
        ("precision", "f32 or f64"),
        ("method", "integration method"),
        ("rtol", "relative tolerance of a step"),
    ],
};

/// A row for each event as it happened.
pub static SIMULATION_EVENTS: Group = Group {
    name: "simulation_events",
    title: "events of the flights of /simulation at which the state jumped, by flight and time",
    dimensions: &[along("jump", Along::Rows, "row index"), STATES],
    variables: &[
        integer("flight", &["jump"], "index of the flight in /simulation"),
        code("event", &["jump"], "which event"),
        real("t", &["jump"], Unit::Time, "time"),
        real("before", &["jump", "state"], Unit::State, "state before it"),
        real("after", &["jump", "state"], Unit::State, "state after it"),
    ],
    attributes: &[],
};

/// A row for each stored point.
pub static SIMULATION_SAMPLES: Group = Group {
    name: "simulation_samples",
    title: "points of the flights of /simulation, by flight and time: evenly spaced in each phase, from its first to its last",
    dimensions: &[along("sample", Along::Rows, "row index"), STATES, CONTROLS],
    variables: &[
        integer("flight", &["sample"], "index of the flight in /simulation"),
        integer(
            "phase",
            &["sample"],
            "index of the phase within the flight: the way from event to event",
        ),
        real("t", &["sample"], Unit::Time, "time"),
        real("x", &["sample", "state"], Unit::State, "state"),
        real("u", &["sample", "control"], Unit::Control, "control").when(When::Controls),
    ],
    attributes: &[],
};

/// A row for each orbit that was looked for.
pub static CYCLES: Group = Group {
    name: "cycles",
    title: "orbits that come back to themselves after some events",
    dimensions: &[
        along(
            "cycle",
            Along::Index,
            "index of the state near which it was looked for",
        ),
        along("multiplier", Along::Index, "multiplier index, by size"),
        STATES,
    ],
    variables: &[
        real(
            "x",
            &["cycle", "state"],
            Unit::State,
            "state after the event that the orbit begins with",
        ),
        real("period", &["cycle"], Unit::Time, "time until it is back"),
        real(
            "multiplier_re",
            &["cycle", "multiplier"],
            Unit::One,
            "eigenvalue of the return map, real part",
        ),
        real(
            "multiplier_im",
            &["cycle", "multiplier"],
            Unit::One,
            "eigenvalue of the return map, imaginary part",
        ),
        real(
            "residual",
            &["cycle"],
            Unit::One,
            "|return map - x|, in widths of the region",
        ),
        integer("iterations", &["cycle"], "steps of Newton's method"),
        code("status", &["cycle"], "whether there is one"),
    ],
    attributes: &[("events", "events after which an orbit is back")],
};
