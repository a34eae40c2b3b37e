//! Trajectories and solved states as plain lists, which rooms hand each other.

/// Trajectories, every list row-major as in the result file: the trajectory slowest, then the
/// sample, then the component. NaN is 'no value'.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrajectoryBlock {
    /// How many trajectories.
    pub count: usize,
    /// Times, `count x samples`, ascending along a trajectory.
    pub t: Vec<f64>,
    /// States, `count x samples x states`.
    pub x: Vec<f64>,
    /// Costates dV/dx, `count x samples x states`.
    pub p: Vec<f64>,
    /// Controls, `count x samples x controls`.
    pub u: Vec<f64>,
    /// Disturbances, `count x samples x disturbances`.
    pub w: Vec<f64>,
    /// Values, `count x samples`.
    pub v: Vec<f64>,
    /// Hamiltonians, `count x samples`.
    pub h: Vec<f64>,
    /// How each ended, `count`.
    pub status: Vec<i32>,
    /// The sheet of the value function each belongs to, `count`.
    pub sheet: Vec<i32>,
    /// Accepted steps, `count`.
    pub steps: Vec<i32>,
    /// Rejected steps, `count`.
    pub rejected: Vec<i32>,
    /// Largest deviation of the Hamiltonian from its invariant value, `count`.
    pub hamiltonian_drift: Vec<f64>,
}

/// Swept trajectories, each with as many samples; arrays row-major, NaN where a trajectory has no
/// value.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SweptTrajectories {
    pub count: usize,
    pub samples: usize,
    /// `[trajectory][sample]`: time, 0 at the end at the equilibrium.
    pub t: Vec<f64>,
    /// `[trajectory][sample][state]`.
    pub x: Vec<f64>,
    /// `[trajectory][sample][state]`.
    pub p: Vec<f64>,
    /// `[trajectory][sample][control]`.
    pub u: Vec<f64>,
    /// `[trajectory][sample]`: V.
    pub v: Vec<f64>,
    /// `[trajectory][sample]`: H.
    pub h: Vec<f64>,
    pub status: Vec<i32>,
    pub sheet: Vec<i32>,
}

impl SweptTrajectories {
    /// Whether costates, controls and times are known, and not values alone.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.p.len() == self.x.len()
    }
}

/// Solutions at states: the cheapest each, or all of them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SolvedStates {
    pub count: usize,
    /// `[point][state]`.
    pub x: Vec<f64>,
    pub v: Vec<f64>,
    pub p: Vec<f64>,
    pub u: Vec<f64>,
    pub sheet: Vec<i32>,
    /// Index of the state; of several solutions of a state the same.
    pub point: Vec<i32>,
    /// Codes of [`PointStatus`](crate::value::PointStatus); empty where there are none.
    pub status: Vec<i32>,
    /// What is known of their errors if they were interpolated; empty where all of them were solved
    /// for.
    pub errors: Vec<StatedErrors>,
}

/// Errors of an interpolated value: of V, and of p relative to its largest component, each times
/// the region's width. NaN where they are not known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StatedErrors {
    pub v: f64,
    pub p: f64,
}

/// Solutions on a regular grid.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SolvedGrid {
    /// Values along the axis of each state.
    pub axes: Vec<Vec<f64>>,
    /// `[axis 0]..[axis n-1]`, last fastest; likewise the others.
    pub v: Vec<f64>,
    pub p: Vec<f64>,
    pub u: Vec<f64>,
    pub sheet: Vec<i32>,
    /// Codes of [`PointStatus`](crate::value::PointStatus); empty where there are none.
    pub status: Vec<i32>,
    /// As in [`SolvedStates`].
    pub errors: Vec<StatedErrors>,
}
