//! Whether V is the least: a second answer from V on a grid, which knows nothing of sheets.

use super::{Session, SessionError};
use crate::dynamic_programming::{self, Device, GridValue, Options, extent};
use crate::scene::Scene;
use crate::value::{self, Claims, Comparison, referee};

/// How V is compared with V on a grid.
#[derive(Clone, Debug, PartialEq)]
pub struct LeastOptions {
    /// Nodes of the grid along each axis; empty: by the number of states.
    pub nodes: Vec<usize>,
    /// Widths of the region by which the grid goes beyond the region and the states.
    pub margin: f64,
    /// Seconds for the grid; on an infinite horizon its values are taken as they are then.
    pub seconds: Option<f64>,
    /// The grid and V are apart where they differ by more than this share of V.
    pub apart: f64,
}

impl Default for LeastOptions {
    fn default() -> Self {
        Self {
            nodes: Vec::new(),
            margin: 0.3,
            seconds: None,
            apart: 0.1,
        }
    }
}

impl Session<'_> {
    /// Compares claimed values with V on a grid, and solves from the grid's greedy paths.
    ///
    /// # Errors
    /// Scenes that have no V on a grid (games, more than 4 states); device failures.
    pub fn check_least(
        &self,
        claims: &Claims,
        options: &LeastOptions,
    ) -> Result<(GridValue, Comparison), SessionError> {
        let Scene {
            model, hamiltonian, ..
        } = self.scene;
        dynamic_programming::refuse(model, &model.file_name)?;
        let backend = self.backend.as_ref();
        let choices = value::for_guesses(self.choices, model.states.len(), claims.v.len());
        let plan = self.plan(choices)?;

        let step = self.step();
        step.say("V on a grid");
        let options_of_grid = Options {
            nodes: options.nodes.clone(),
            share: 1.0,
            margin: options.margin,
            holds: extent(&plan, &claims.x),
            budget_seconds: options.seconds,
        };
        let device = Device::of(backend);
        let grid = dynamic_programming::solve(model, hamiltonian, &plan, &options_of_grid, device)?;

        step.say("greedy paths");
        let mut solver = value::solver(&plan, backend)?;
        let compared = referee(&plan, &mut solver, &grid, claims, options.apart)?;
        Ok((grid, compared))
    }
}
