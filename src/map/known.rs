//! What a value map is made of: plain data, from a file or from a run in memory.

use super::Coverage;
use super::pieces::Pieces;
use crate::sweep::Far;
use crate::trajectories::{SolvedGrid, SolvedStates, SweptTrajectories};

/// What is known of the value function of a scene.
#[derive(Debug, Default)]
pub struct Known {
    pub swept: Option<SweptTrajectories>,
    /// Solutions at scattered states: every one found, or the cheapest of each.
    pub solved: Option<SolvedStates>,
    pub grid: Option<SolvedGrid>,
    /// A map that was made to an error.
    pub pieces: Option<Pieces>,
    /// The same round the region of `pieces`; of use with them only.
    pub beyond: Option<Pieces>,
    pub sweep: SweepRecord,
    /// How well the states of the pieces were searched for cheaper sheets.
    pub coverage: Option<Coverage>,
    /// Whether states were solved by a search, not interpolated.
    pub searched: bool,
    /// Worst relative errors of V and p that the run itself found at its solved states.
    pub errors: Option<[f64; 2]>,
}

/// How a sweep ended.
#[derive(Clone, Copy, Debug)]
pub struct SweepRecord {
    /// Gaps wider than the spacing that remained; `None` where that is not known.
    pub gaps: Option<u64>,
    /// The widest, in widths of the region.
    pub widest: f64,
    /// Whether fronts lie too far apart to tell of what is between them.
    pub far: Option<Far>,
    /// Whether parts of the sweep are not in the file.
    pub lacks: bool,
    /// Trajectories whose integration failed.
    pub failed: u64,
}

impl Default for SweepRecord {
    fn default() -> Self {
        Self {
            gaps: None,
            widest: f64::NAN,
            far: None,
            lacks: false,
            failed: 0,
        }
    }
}
