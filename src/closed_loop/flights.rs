//! What is asked of a batch of trajectories, and how they went.

/// A trajectory kept whole, `samples + 1` points; NaN after its end.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Path {
    /// Index of its initial state.
    pub initial: usize,
    pub t: Vec<f64>,
    /// `[point][state]`.
    pub x: Vec<f64>,
    /// `[point][control]`.
    pub u: Vec<f64>,
    /// `[point][disturbance]`; empty where there is no forcing, and so are the others.
    pub w: Vec<f64>,
    /// Integrals of L(x, u, 0), and of what L(x, u, w) is less.
    pub cost: Vec<f64>,
    pub supplied: Vec<f64>,
}

/// From where a batch flies.
#[derive(Clone, Copy, Default)]
pub(super) struct Starts<'a> {
    /// `[trajectory][state]`.
    pub x: &'a [f64],
    /// `[trajectory][component of the forcing]`; empty without one.
    pub forcing: &'a [f64],
    /// Indices of those that are kept whole.
    pub kept: &'a [usize],
}

/// A trajectory at a time at which it is looked at.
pub(super) struct Seen<'a> {
    pub trajectory: usize,
    pub t: f64,
    /// Deviation from the reference.
    pub s: &'a [f64],
    pub cost: f64,
    pub supplied: f64,
    /// V of the chart here, where there is one.
    pub v: Option<f64>,
}

/// Is shown every trajectory at its stored times, in order; under a chart's law also at its
/// updates.
pub(super) type Watch<'a> = &'a mut dyn FnMut(Seen<'_>);

/// How closed-loop trajectories went, in the order of their initial states.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Flights {
    /// `[trajectory][state]`: deviation from the reference at the end.
    pub end: Vec<f64>,
    pub t_end: Vec<f64>,
    /// [`Status`](crate::backend::Status) codes, [`OUTSIDE_MAP`](super::OUTSIDE_MAP), and from
    /// [`GUARD_STATUS`](crate::sweep::GUARD_STATUS) on the guards.
    pub status: Vec<i32>,
    /// Integral of the running cost up to the end.
    pub cost: Vec<f64>,
    /// Terminal cost at the end, where the horizon is finite.
    pub terminal: Vec<f64>,
    /// Updates of a chart's law, and of each trajectory those at which the chart had no answer.
    pub updates: usize,
    pub fallback: Vec<u32>,
    /// Of a chart's law: how often states went between the host and a device, or the host waited
    /// for one.
    pub round_trips: usize,
    /// `[trajectory][record]`.
    pub records: Vec<f64>,
    pub paths: Vec<Path>,
}
