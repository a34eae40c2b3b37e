//! V, p and u at chosen states: every sheet, the lowest one, and where two cost the same.

mod accuracy;
mod approach;
mod archive;
pub mod blocks;
mod clearance;
mod conjugate;
mod cover;
mod direct;
mod equal_cost;
mod extremal;
pub mod flight;
mod fold;
mod grow;
mod march;
pub(crate) mod nearest;
mod referee;
mod sampled;
mod solve;
mod states;
mod survey;
mod targets;
mod tracks;

pub use accuracy::{SolvedAccuracy, accuracy};
pub use approach::{Approach, Unreached, follow};
pub use archive::{Archive, Index, Place};
pub use clearance::{Clearance, clearances, tell as tell_clearances};
pub use conjugate::ConjugatePoints;
pub use cover::Cover;
pub use equal_cost::BoundaryPoint;
pub use extremal::Extremal;
pub use fold::Fold;
pub use march::{Marched, march};
pub use referee::{Claims, Comparison, Flown, Led, referee};
pub use sampled::sampled;
pub use solve::{
    Answers, Common, Entry, EqualCost, Evidence, Request, for_guesses, goes_without_sweep,
    guess_seeds, may_need_sweep, may_use_sweep, solve, solve_targets, solver, spaced,
};
pub use states::{StatesError, count_blocks, solve_blocks, solve_states, solve_states_folding};
pub use survey::{Miss, PointStatus, Progress, Support, Survey, Wanted};
pub use targets::{Grid, Groups, Targets, Whole};
pub use tracks::{FoundNear, Track, TrackPoints, Wish, path_from, solve_near, track_points};
