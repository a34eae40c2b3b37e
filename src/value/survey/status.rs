//! Why a target has no solution.

use crate::shooting::Path;

/// Why a target has no solution, as a status; 0 is solved.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(i32)]
pub enum PointStatus {
    Converged = 0,
    /// The target is outside a guard.
    OutsideGuard = 1,
    /// The solution found leaves a guard on its way.
    LeavesGuard = 2,
    /// Newton's method did not converge on the way to the target.
    NotReached = 3,
    /// The sheet ends in a fold on the way to the target. Of a game: no solution without a fold
    /// along it was found.
    Fold = 4,
    /// The equations are not defined on the way to the target.
    NotFinite = 5,
    /// The trajectory does not come near the equilibrium.
    Horizon = 6,
    /// No trajectory of the sweep, nor a solved target, to start from.
    NoGuess = 7,
    /// Its V, as far as its neighbours tell, is above what is of interest: it was not tried.
    AboveMax = 8,
    /// Of a game: several sheets without a fold lie over it, none of which is the value.
    SeveralSheets = 9,
    /// Of a game: the cost is negative there, which certifies nothing.
    NegativeValue = 10,
    /// A control that was flown costs less than the least V found, and nothing that costs as little
    /// was found from it.
    Undercut = 11,
    /// The run was ended before it was solved.
    OutOfTime = 12,
    /// The shard that it belongs to is not among those that were put together.
    NotMerged = 13,
}

impl PointStatus {
    pub const ALL: [(PointStatus, &'static str); 14] = [
        (PointStatus::Converged, "converged"),
        (PointStatus::OutsideGuard, "outside_guard"),
        (PointStatus::LeavesGuard, "leaves_guard"),
        (PointStatus::NotReached, "not_reached"),
        (PointStatus::Fold, "fold"),
        (PointStatus::NotFinite, "not_finite"),
        (PointStatus::Horizon, "horizon"),
        (PointStatus::NoGuess, "no_guess"),
        (PointStatus::AboveMax, "above_value_max"),
        (PointStatus::SeveralSheets, "several_sheets"),
        (PointStatus::NegativeValue, "negative_value"),
        (PointStatus::Undercut, "undercut"),
        (PointStatus::OutOfTime, "out_of_time"),
        (PointStatus::NotMerged, "not_merged"),
    ];

    pub fn name(self) -> &'static str {
        PointStatus::ALL
            .iter()
            .find(|(s, _)| *s == self)
            .map_or("?", |(_, n)| n)
    }
}

/// What is known of a target without a solution.
#[derive(Clone, Debug)]
pub struct Miss {
    pub status: PointStatus,
    /// Furthest state reached toward it (absolute), and the distance left in widths of the region.
    pub furthest: Option<Vec<f64>>,
    pub left: f64,
    /// The solution there, if it was found but leaves a guard on its way.
    pub cut: Option<Path>,
}
