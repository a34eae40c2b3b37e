//! What is kept of a sweep's vertices while they have open edges, in rows of flat arrays.

use super::gaps::Passed;
use super::neighbours::Vertex;
use super::paths::{Paths, Row};

/// Without a row.
const NONE: u32 = u32::MAX;

/// What has become of a vertex.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum State {
    Pending,
    /// Outside a guard: not swept.
    Outside,
    Swept,
}

/// What is known of a new vertex.
pub(super) struct Place {
    pub state: State,
    /// Whether it is on the boundary of a guard.
    pub boundary: bool,
}

/// Rows of vertices.
pub(super) struct Nodes {
    /// By vertex.
    row: Vec<u32>,
    free: Vec<u32>,
    states: usize,
    /// Numbers of a parameter and of a seed, `(s, p, V)`.
    parameter: usize,
    seed: usize,
    /// By row, as everything below.
    parameters: Vec<f64>,
    seeds: Vec<f64>,
    state: Vec<State>,
    /// On the boundary of a guard: nothing is between it and an outside neighbour.
    boundary: Vec<bool>,
    passed: Vec<Extent>,
    /// Where trajectories have ended in folds, in widths of the region; NaN where they have not.
    folds: Vec<f32>,
    paths: Paths,
}

/// How far a trajectory came.
#[derive(Clone, Copy, Default)]
pub(super) struct Extent {
    /// Levels passed.
    pub levels: u32,
    /// Whether it has ended at a guard.
    pub at_guard: bool,
}

/// What a swept trajectory leaves with its vertex.
pub(super) struct Slot<'n> {
    row: Row<'n>,
    passed: &'n mut Extent,
    fold: &'n mut [f32],
}

impl Slot<'_> {
    /// `path`: as [`Passed::path`].
    pub fn fill(&mut self, path: &[f32], passed: Extent, fold: Option<impl Iterator<Item = f32>>) {
        self.row.write(path);
        *self.passed = passed;
        match fold {
            Some(fold) => self.fold.iter_mut().zip(fold).for_each(|(to, x)| *to = x),
            None => self.fold.fill(f32::NAN),
        }
    }
}

impl Nodes {
    /// For seeds of `states` states with so many parameters, and trajectories over `levels`.
    pub fn new(states: usize, parameter: usize, levels: usize) -> Self {
        Self {
            row: Vec::new(),
            free: Vec::new(),
            states,
            parameter,
            seed: 2 * states + 1,
            parameters: Vec::new(),
            seeds: Vec::new(),
            state: Vec::new(),
            boundary: Vec::new(),
            passed: Vec::new(),
            folds: Vec::new(),
            paths: Paths::new(states, levels),
        }
    }

    /// Numbers of a path (see [`Slot::fill`]).
    pub fn path_width(&self) -> usize {
        self.paths.width()
    }

    /// Numbers of a parameter.
    pub fn parameter_width(&self) -> usize {
        self.parameter
    }

    /// Why paths could not be read, if so.
    pub fn failure(&self) -> Option<std::io::Error> {
        self.paths.failure()
    }

    /// Enters a new vertex; they come in order.
    pub fn add(&mut self, parameter: &[f64], seed: &[f64], new: Place) -> Vertex {
        let Place { state, boundary } = new;
        let row = self.free.pop().unwrap_or_else(|| {
            let row = self.state.len();
            self.parameters.resize((row + 1) * self.parameter, 0.0);
            self.seeds.resize((row + 1) * self.seed, 0.0);
            self.folds.resize((row + 1) * self.states, f32::NAN);
            self.state.push(state);
            self.boundary.push(boundary);
            self.passed.push(Extent::default());
            row as u32
        });
        let at = row as usize;
        self.seeds[at * self.seed..][..self.seed].copy_from_slice(seed);
        self.state[at] = state;
        self.boundary[at] = boundary;
        self.parameters[at * self.parameter..][..self.parameter].copy_from_slice(parameter);
        self.row.push(row);
        self.row.len() as Vertex - 1
    }

    /// Drops a vertex.
    pub fn forget(&mut self, vertex: Vertex) {
        let row = std::mem::replace(&mut self.row[vertex as usize], NONE);
        if row != NONE {
            self.free.push(row);
        }
    }

    /// The row of a vertex that is not forgotten.
    fn row(&self, vertex: Vertex) -> Option<usize> {
        let row = self.row[vertex as usize];
        (row != NONE).then_some(row as usize)
    }

    pub fn state(&self, vertex: Vertex) -> Option<State> {
        self.row(vertex).map(|row| self.state[row])
    }

    pub fn is_on_boundary(&self, vertex: Vertex) -> bool {
        self.row(vertex).is_some_and(|row| self.boundary[row])
    }

    /// The parameter of a vertex; nothing of one forgotten.
    pub fn parameter(&self, vertex: Vertex) -> &[f64] {
        (self.row(vertex)).map_or(&[], |row| {
            &self.parameters[row * self.parameter..][..self.parameter]
        })
    }

    /// The seed of a vertex; nothing of one forgotten.
    pub fn seed(&self, vertex: Vertex) -> &[f64] {
        (self.row(vertex)).map_or(&[], |row| &self.seeds[row * self.seed..][..self.seed])
    }

    /// What a swept vertex has passed; `buffer` is memory for it.
    pub fn passed<'n>(&'n self, vertex: Vertex, buffer: &'n mut Vec<f32>) -> Option<Passed<'n>> {
        let row = self.row(vertex)?;
        let fold = &self.folds[row * self.states..][..self.states];
        Some(Passed {
            path: self.paths.read(row as u32, buffer),
            levels: self.passed[row].levels as usize,
            at_guard: self.passed[row].at_guard,
            fold: (!fold[0].is_nan()).then_some(fold),
        })
    }

    /// Marks vertices as swept, and gives where what they leave is to be written, in their order.
    pub fn sweep(&mut self, vertices: &[Vertex]) -> Vec<Slot<'_>> {
        let rows: Vec<u32> = vertices.iter().map(|v| self.row[*v as usize]).collect();
        for row in &rows {
            self.state[*row as usize] = State::Swept;
        }
        self.paths.reserve(self.state.len());
        let mut order: Vec<u32> = (0..rows.len() as u32).collect();
        order.sort_unstable_by_key(|i| rows[*i as usize]);
        let ascending: Vec<u32> = order.iter().map(|i| rows[*i as usize]).collect();

        let (mut passed, mut folds) = (&mut self.passed[..], &mut self.folds[..]);
        let mut first = 0;
        let mut slots: Vec<(u32, Slot<'_>)> = (self.paths.rows_mut(&ascending).into_iter())
            .zip(ascending.iter().zip(&order))
            .map(|(path, (row, i))| {
                let skipped = *row as usize - first;
                first = *row as usize + 1;
                let rest = &mut std::mem::take(&mut passed)[skipped..];
                let (here, after) = rest.split_at_mut(1);
                passed = after;
                let rest = &mut std::mem::take(&mut folds)[skipped * self.states..];
                let (fold, after) = rest.split_at_mut(self.states);
                folds = after;
                let slot = Slot {
                    row: path,
                    passed: &mut here[0],
                    fold,
                };
                (*i, slot)
            })
            .collect();
        slots.sort_unstable_by_key(|(i, _)| *i);
        slots.into_iter().map(|(_, slot)| slot).collect()
    }
}
