//! What is asked of a scene.

use super::{SessionError, Shard};
use crate::model::Model;
use crate::trajectories::SweptTrajectories;
use crate::value::{Grid, Request};
use std::sync::Arc;

/// What is asked of a scene.
///
/// ```
/// use costate::session::Wanted;
/// let solve = Wanted::states(vec![0.5, 0.2]);
/// assert!(!solve.sweep);
/// ```
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Wanted {
    /// The sweep is a result, where the scene has `[shoot_out]`. Else it gives first guesses only.
    pub sweep: bool,
    /// What is kept of the sweep's trajectories in a result file.
    pub kept: Kept,
    /// States that are solved for.
    pub states: States,
    /// The map to an error, where the scene has `[map] error`.
    pub map: bool,
    /// The scene's `[study]`, where it has one.
    pub study: bool,
    /// The scene's laws, closed loops, dissipation inequality and levels of attenuation. A pass
    /// ([`Session::prepare`](super::Session::prepare)) leaves them out, as they need its result
    /// file.
    pub laws: bool,
    /// First guesses also come from V on a grid (slower; up to 4 states, no games).
    pub grid_guesses: bool,
    /// First guesses come from these trajectories, where states need a sweep for them; without any it
    /// is made.
    pub archive: Option<Arc<GivenSweep>>,
    /// Only this part of it. What is not divided, every shard does (the sweep for first guesses).
    pub shard: Option<Shard>,
    /// Whether what is done is kept for a later run, and what an earlier one has kept is used.
    pub resume: Resume,
}

/// Trajectories that were swept before.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GivenSweep {
    /// They, with their costates and times.
    pub swept: SweptTrajectories,
    /// What tells them from others, in a word.
    pub of: String,
}

/// Whether work that is ended can be gone on with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Resume {
    /// No.
    #[default]
    Never,
    /// What is done is kept for a later run as the work goes on, after so many seconds each time (60
    /// is usual). An earlier run counts for nothing.
    Later(u32),
    /// The same; what an earlier run has kept is not done again.
    Now(u32),
}

/// What is kept of swept trajectories.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kept {
    /// Everything.
    #[default]
    All,
    /// x, V, status and sheet, x and V in f32 where that resolves them.
    Values,
    /// Nothing: the sweep is told of.
    Nothing,
}

/// Which states are solved for.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum States {
    /// None.
    #[default]
    None,
    /// Those of the scene's `[homotopy]` and `[map]`.
    OfScene {
        /// Whether a scene without any, and without a map to an error, is refused.
        needed: bool,
    },
    /// Those of the scene's `[map]` alone; a scene without any, and without a map to an error, is
    /// refused.
    OfMap,
    /// A list of your own.
    Listed(Listed),
}

/// States in a list of one's own.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Listed {
    /// `[state][component]`, absolute, in the scene's units.
    pub x: Vec<f64>,
    /// One solution a state is enough. Faster, but where sheets overlap it may not be the least.
    pub one_sheet: bool,
    /// Stored points of the trajectory from each state; `None`: no trajectories.
    pub samples: Option<usize>,
}

impl Wanted {
    /// All that the scene asks for, as `costate run` does it.
    #[must_use]
    pub fn all() -> Self {
        Self {
            sweep: true,
            kept: Kept::All,
            states: States::OfScene { needed: false },
            map: true,
            study: true,
            laws: true,
            grid_guesses: false,
            archive: None,
            shard: None,
            resume: Resume::Never,
        }
    }

    /// The sweep alone, as `costate shoot-out` does it.
    #[must_use]
    pub fn sweep() -> Self {
        Self {
            sweep: true,
            ..Self::default()
        }
    }

    /// The states and the map that the scene asks for, as `costate homotopy` does it.
    #[must_use]
    pub fn homotopy() -> Self {
        Self {
            states: States::OfScene { needed: true },
            map: true,
            ..Self::default()
        }
    }

    /// The map that the scene asks for, as `costate map` does it.
    #[must_use]
    pub fn map() -> Self {
        Self {
            states: States::OfMap,
            map: true,
            ..Self::default()
        }
    }

    /// States of one's own (`[state][component]`), as `costate solve` does it.
    #[must_use]
    pub fn states(x: Vec<f64>) -> Self {
        Self {
            states: States::Listed(Listed {
                x,
                ..Listed::default()
            }),
            ..Self::default()
        }
    }
}

/// The states that are solved for, as a request, and where their answers belong.
#[derive(Clone, Debug)]
pub(crate) struct Targets {
    states: usize,
    pub request: Request,
    /// The last grid is that of `/map`.
    pub map: bool,
    /// The states are a list of the user's own.
    pub listed: bool,
    /// Stored points of the trajectory from each.
    pub samples: Option<usize>,
}

impl Targets {
    /// `None` where no states are solved for.
    pub fn new(model: &Model, wanted: &Wanted) -> Result<Option<Self>, SessionError> {
        let none = Self {
            states: model.states.len(),
            request: Request::default(),
            map: false,
            listed: false,
            samples: None,
        };
        match &wanted.states {
            States::None => Ok(None),
            States::Listed(listed) => {
                let (given, states) = (listed.x.len(), model.states.len());
                if !given.is_multiple_of(states) {
                    return Err(SessionError::Components { given, states });
                }
                model.check_turns(&listed.x)?;
                Ok(Some(Self {
                    request: Request {
                        points: listed.x.clone(),
                        one_sheet: listed.one_sheet,
                        ..Request::default()
                    },
                    listed: true,
                    samples: listed.samples,
                    ..none
                }))
            }
            States::OfScene { .. } | States::OfMap => {
                let of_map = wanted.states == States::OfMap;
                let homotopy = model.homotopy.as_ref().filter(|_| !of_map);
                let homotopy = homotopy.map(Grid::homotopy);
                let map = model.map.as_ref().map(|m| Grid::map(m, model));
                if homotopy.is_none() && map.is_none() {
                    let is_mapped = model.map_aim.is_some();
                    return match &wanted.states {
                        States::OfMap if !is_mapped => Err(SessionError::NoMap),
                        States::OfScene { needed: true } if !is_mapped => {
                            Err(SessionError::NoTargets)
                        }
                        _ => Ok(None),
                    };
                }
                let limits = (homotopy.iter().map(|_| f64::INFINITY))
                    .chain((model.map.iter()).map(|m| m.value_max.unwrap_or(f64::INFINITY)))
                    .collect();
                Ok(Some(Self {
                    map: map.is_some(),
                    request: Request {
                        limits,
                        grids: homotopy.into_iter().chain(map).collect(),
                        ..Request::default()
                    },
                    ..none
                }))
            }
        }
    }

    /// How many states.
    pub fn count(&self) -> usize {
        let grids = self.request.grids.iter().map(Grid::len).sum::<usize>();
        grids + self.request.points.len() / self.states
    }

    /// How many of the states, from the first on, belong to `/points`. A list and a map never come
    /// together.
    pub fn points(&self) -> usize {
        self.count() - self.map_grid().map_or(0, Grid::len)
    }

    /// The grid of `/map`.
    pub fn map_grid(&self) -> Option<&Grid> {
        self.request.grids.last().filter(|_| self.map)
    }

    /// All states, `[state][component]`.
    pub fn all(&self) -> Vec<f64> {
        let grids = self.request.grids.iter().flat_map(Grid::points);
        grids.chain(self.request.points.iter().copied()).collect()
    }
}
