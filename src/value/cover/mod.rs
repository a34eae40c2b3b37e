//! Which parts of the swept manifold lie over a state: a search that depends on the state alone.
//!
//! The manifold of optimal trajectories is parametrized by seed and level. It is divided into
//! cells: a simplex of seeds between two levels. The extremals from a state x are the places of the
//! manifold whose state is x, so every cell whose image may hold x is divided further, until it is
//! small; what is left gives the first guesses for x. Cells over which no state asked for lies are
//! never divided, so the cost follows the states, not the region. Which cells there are, and how
//! they are divided, depends on the manifold alone: other states asked for at the same time change
//! nothing.

mod aim;
mod cell;
mod close;
mod copies;
mod fan;
mod first;
mod fold;
mod guess;
mod near;

use crate::backend::{Backend, BackendError, Deadline};
use crate::model::Model;
use crate::shooting::{End, Path};
use crate::sweep::Plan;
pub use aim::Aimed;
use cell::{Cell, Corners, KEPT, OfSeeds, Place};
use fan::Fan;
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use smallvec::SmallVec;
use std::collections::BTreeMap;

/// States up to which the manifold is divided into cells, and up to which points of trajectories
/// are looked up.
const MOST_IN_CELLS: usize = 3;
const MOST_STATES: usize = 6;
/// First seeds by the number of states.
const FIRST_SEEDS: [usize; MOST_STATES + 1] = [1, 64, 256, 300, 400, 400, 400];
/// Longest edge, in widths of the region, of a cell that gives a guess, by the number of states.
const LEAF: [f64; MOST_IN_CELLS + 1] = [0.04, 0.04, 0.04, 0.06];
/// Bend of such a cell at most.
const STRAIGHT: f64 = 0.1;
/// Bend that is assumed of the edges of first cells.
const FIRST_BEND: f64 = 0.5;
/// Shortest edge that is divided because of its bend.
const LEAST: f64 = 0.005;
/// Divisions of a cell whose trajectories end within it.
const DEEPEST: u32 = 40;
/// Trajectories go on to this many times the cost searched, so that cells on its level have their
/// corners.
const BEYOND: f64 = 2.0;
/// Cells that are divided for one state at a time, at most.
const MOST_CELLS: usize = 2048;
/// Rounds of dividing: seeds as near as rounding allows are met before.
const MOST_ROUNDS: usize = 160;
/// Trajectories of one search.
const MOST_TRAJECTORIES: usize = 400_000;

/// Whether trajectories go on behind guards, and it is told of each solution whether it leaves one.
/// Cells with corners behind a guard, of which nothing is known, are divided along all of it: a
/// line in a plane, but too much in space. In more states, where points near a state are looked up,
/// those behind guards would crowd out others.
pub(in crate::low_level::value) fn goes_behind_guards(states: usize) -> bool {
    states == MOST_IN_CELLS
}

/// A state looked for: a target's, as a deviation.
#[derive(Clone, Debug)]
pub struct Sought {
    pub target: usize,
    pub s: Vec<f64>,
    /// Whether it belongs to a grid.
    pub gridded: bool,
    /// Cost up to which everything was found before.
    pub above: f64,
}

/// A place of the manifold near a target: it gives first guesses.
#[derive(Clone, Debug)]
pub struct Candidate {
    pub target: usize,
    /// Periods by which the trajectory's start is away from the target as given.
    pub turns: Vec<i32>,
    pub goal: Vec<f64>,
    /// State (a deviation) and adjoint that the manifold has at the place.
    pub node: Vec<f64>,
    pub value: f64,
    /// The least V that its corners promise, each as its adjoint has it there: lower than `value`
    /// where the manifold bends within the cell.
    pub lowest: f64,
    /// V expected at the target, as curved on the way to it as at the equilibrium.
    pub expected: f64,
    /// How much the adjoint (unscaled) differs within the cell, a component.
    pub spread: Vec<f64>,
    /// Backward time at the place.
    time: f64,
    cell: Cell,
    place: Place,
    /// Of the part of the cell that the place is in, where that was looked at closely.
    part: Option<Box<Corners>>,
}

impl Candidate {
    /// Whether the target lies in the cell itself, not only near it.
    pub fn is_inside(&self) -> bool {
        self.outside() == 0.0
    }

    /// A seed of the cell; of a point of a trajectory that of the trajectory.
    pub fn seed(&self) -> u32 {
        self.cell.seeds[0]
    }

    /// How far the target is from the place: relative to the cell, or in widths of the region from
    /// a trajectory's point.
    fn outside(&self) -> f64 {
        self.place.outside.max(0.0)
    }

    pub fn adjoint(&self) -> &[f64] {
        &self.node[self.node.len() / 2..]
    }

    /// Whether two guesses come from one cell, for one copy of a target.
    pub fn is_same(&self, other: &Self) -> bool {
        let key = |c: &Self| (c.target, c.cell.level);
        key(self) == key(other) && self.turns == other.turns && self.cell.seeds == other.cell.seeds
    }
}

/// What a search found.
#[derive(Default)]
pub struct Cells {
    /// Ordered by target; of each the best placed first.
    pub candidates: Vec<Candidate>,
    /// Targets for which cells were left undivided, with the least V there.
    pub uncovered: BTreeMap<usize, f64>,
}

/// A copy of a target.
struct Copy {
    sought: usize,
    turns: Vec<i32>,
    /// State in widths of the region.
    x: Vec<f64>,
}

/// A cell with the copies that may lie in it.
struct Open {
    cell: Cell,
    corners: Corners,
    copies: SmallVec<[u32; 4]>,
}

/// A cell to be divided between two of its seeds (positions), at a third.
struct Division {
    open: Open,
    a: usize,
    b: usize,
    middle: u32,
}

/// The manifold of a plan, searched for the cells over states.
pub struct Cover<'a> {
    fan: Fan<'a>,
    /// Simplices of the first seeds.
    base: Vec<Vec<u32>>,
    /// The same, divided where trajectories part, up to a cost.
    roots: Vec<Vec<u32>>,
    divided_to: f64,
    /// Infinite horizon: cells lie between levels.
    stationary: bool,
    duration: f64,
    /// Cost that the levels of the search are powers of: what the linearization gives at the
    /// region's corners.
    pub unit: f64,
}

impl<'a> Cover<'a> {
    /// Whether a plan's manifold can be searched.
    pub fn serves(plan: &Plan) -> bool {
        let most = if plan.system.terminal.is_some() {
            MOST_IN_CELLS
        } else {
            MOST_STATES
        };
        !plan.game && plan.system.states <= most
    }

    /// Whether it can be divided into cells, so that nothing is left out that is larger than the
    /// cells looked at.
    pub fn has_cells(&self) -> bool {
        self.fan.plan.system.states <= MOST_IN_CELLS
    }

    /// Whether a state lies within the seeds, and the path of the local solution from there.
    pub fn within_seeds(&self, s: &[f64], end: &End) -> Option<Path> {
        /// Between the seeds the first cells begin a little outside.
        const MARGIN: f64 = 2.0;
        let (value, node) = self.fan.local(s, MARGIN)?;
        let mut path = Path::new(&node);
        let (nodes, durations) = end.tail(s, value, self.duration);
        path.append(&nodes, &durations);
        Some(path)
    }

    /// # Errors
    /// When the kernel cannot be compiled.
    pub fn new(
        plan: &'a Plan,
        model: &Model,
        duration: f64,
        backend: &dyn Backend,
    ) -> Result<Self, BackendError> {
        let unit = plan.corner_value();
        let mut fan = Fan::new(plan, model, unit, backend)?;
        let most = FIRST_SEEDS[plan.system.states];
        let (complex, parameters) = fan.surface.simplices(most);
        for parameter in parameters {
            fan.seed(parameter);
        }
        Ok(Self {
            fan,
            base: complex,
            roots: Vec::new(),
            divided_to: f64::NAN,
            stationary: plan.system.terminal.is_none(),
            duration,
            unit,
        })
    }

    /// Searches that take longer fail with [`BackendError::OutOfTime`].
    pub fn until(mut self, deadline: Deadline) -> Self {
        self.fan.deadline = deadline;
        self
    }

    /// Trajectories integrated so far.
    pub fn trajectories(&self) -> usize {
        self.fan.integrated
    }

    /// Finds the cells over states in which V may be at most `ceiling`.
    ///
    /// # Errors
    /// Device failures only.
    pub fn search(&mut self, sought: &[Sought], ceiling: f64) -> Result<Cells, BackendError> {
        if self.divided_to != ceiling {
            self.divide_first(ceiling)?;
        }
        let all = self.first_cells(ceiling);
        let copies = self.copies(sought, &all);
        let mut cells = Cells::default();
        if let Some(value) = self.out_of_turns(&all) {
            for one in sought {
                lower(&mut cells.uncovered, one.target, value);
            }
        }
        let mut open = assign(all, &copies, sought, self.fan.plan.system.states);
        let mut leaves: Vec<Open> = Vec::new();
        for round in 0.. {
            self.drop_excess(&mut open, &copies, sought, &mut cells.uncovered);
            if open.is_empty() {
                break;
            }
            if round == MOST_ROUNDS || self.fan.integrated > MOST_TRAJECTORIES {
                for cell in &open {
                    for c in &cell.copies {
                        lower(
                            &mut cells.uncovered,
                            sought[copies[*c as usize].sought].target,
                            cell.corners.value,
                        );
                    }
                }
                break;
            }
            let left = (&mut leaves, &mut cells.uncovered);
            open = self.divide(open, left, (&copies, sought), ceiling)?;
        }
        let closely = self.look_closely(&leaves)?;
        let (this, all) = (&*self, copies.as_slice());
        cells.candidates = (leaves.par_iter().enumerate())
            .flat_map_iter(|(k, leaf)| {
                let close = this.close(&closely, k, &leaf.cell);
                let copies = leaf.copies.iter().map(move |c| &all[*c as usize]);
                copies.filter_map(move |copy| this.candidate(leaf, close.as_ref(), copy, sought))
            })
            .collect();
        cells.candidates.par_sort_by(|a, b| {
            (a.target, &a.turns)
                .cmp(&(b.target, &b.turns))
                .then(a.outside().total_cmp(&b.outside()))
                .then(a.value.total_cmp(&b.value))
        });
        Ok(cells)
    }

    /// Where too many cells are open over a state the costliest are left out, and the state is not
    /// covered from there on.
    fn drop_excess(
        &self,
        open: &mut Vec<Open>,
        copies: &[Copy],
        sought: &[Sought],
        uncovered: &mut BTreeMap<usize, f64>,
    ) {
        let mut count = vec![0usize; sought.len()];
        for cell in open.iter() {
            for c in &cell.copies {
                count[copies[*c as usize].sought] += 1;
            }
        }
        if count.iter().all(|c| *c <= MOST_CELLS) {
            return;
        }
        let mut values: FxHashMap<usize, Vec<f64>> = FxHashMap::default();
        for cell in open.iter() {
            for c in &cell.copies {
                let of = copies[*c as usize].sought;
                if count[of] > MOST_CELLS {
                    values.entry(of).or_default().push(cell.corners.value);
                }
            }
        }
        let limits: FxHashMap<usize, f64> = (values.into_iter())
            .map(|(of, mut v)| (of, *v.select_nth_unstable_by(MOST_CELLS, f64::total_cmp).1))
            .collect();
        for cell in open.iter_mut() {
            let value = cell.corners.value;
            cell.copies.retain(|c| {
                let of = copies[*c as usize].sought;
                let kept = limits.get(&of).is_none_or(|limit| value < *limit);
                if !kept {
                    lower(uncovered, sought[of].target, value);
                }
                kept
            });
        }
        open.retain(|cell| !cell.copies.is_empty());
    }

    /// Divides cells at the middle of their longest edges; those that are small become leaves.
    /// States over one that is not, and cannot be divided, are not covered from there on.
    fn divide(
        &mut self,
        open: Vec<Open>,
        (leaves, uncovered): (&mut Vec<Open>, &mut BTreeMap<usize, f64>),
        (copies, sought): (&[Copy], &[Sought]),
        ceiling: f64,
    ) -> Result<Vec<Open>, BackendError> {
        let n = self.fan.plan.system.states;
        let leaf = LEAF[n];
        let looked_at: Vec<_> = (open.par_iter())
            .map(|Open { cell, corners, .. }| {
                let longest = corners.longest(cell.seeds.len(), n);
                let turn = || self.turn(cell, corners, longest.2);
                let is_short = longest.2 <= LEAST;
                let straight = is_short || (cell.bend <= STRAIGHT && turn() <= STRAIGHT);
                (longest, corners.complete(), straight)
            })
            .collect();
        let mut split: Vec<Division> = Vec::new();
        for (open, ((a, b, length), complete, straight)) in open.into_iter().zip(looked_at) {
            let seeds = &open.cell.seeds;
            if complete && length <= leaf && straight {
                leaves.push(open);
                continue;
            }
            if !complete && (length <= LEAST || open.cell.depth >= DEEPEST) {
                continue;
            }
            if let Some(middle) = self.fan.middle(seeds[a], seeds[b]) {
                split.push(Division { open, a, b, middle });
                continue;
            }
            // No number lies between its seeds, and their trajectories part: what lies between these
            // is not known.
            if length > leaf {
                for c in &open.copies {
                    let target = sought[copies[*c as usize].sought].target;
                    lower(uncovered, target, open.corners.value);
                }
            }
            if complete {
                leaves.push(open);
            }
        }
        let middles: Vec<u32> = split.iter().map(|d| d.middle).collect();
        self.fan.integrate(&middles, BEYOND * ceiling)?;
        let this = &*self;
        Ok(split
            .into_par_iter()
            .flat_map_iter(|division| this.halves(division, copies, ceiling))
            .collect())
    }

    /// How far a cell may reach beyond its corners as its trajectories turn, relative to its longest
    /// edge.
    fn turn(&self, cell: &Cell, corners: &Corners, longest: f64) -> f64 {
        if !self.stationary {
            return 0.0;
        }
        let (seeds, n) = (cell.seeds.len(), self.fan.plan.system.states);
        corners.turn(seeds, n, self.fan.step(cell.level), longest)
    }

    /// How far a cell may reach beyond its corners as its trajectories turn or pass beside the straight
    /// lines between its levels, relative to its longest edge.
    fn stray(&self, cell: &Cell, corners: &Corners, longest: f64) -> f64 {
        if !self.stationary {
            return 0.0;
        }
        let is_whole = |q: &usize| !self.fan.is_cut(cell.seeds[*q], cell.level + 1);
        let whole: OfSeeds<usize> = (0..cell.seeds.len()).filter(is_whole).collect();
        let (n, step) = (self.fan.plan.system.states, self.fan.step(cell.level));
        let bow = corners.bow(&whole, n, step, longest);
        self.turn(cell, corners, longest).max(bow)
    }

    /// The halves of a cell with the states that may lie in each.
    fn halves(&self, division: Division, copies: &[Copy], ceiling: f64) -> Vec<Open> {
        let Division { open, a, b, middle } = division;
        let (fan, n) = (&self.fan, self.fan.plan.system.states);
        let Cell {
            seeds,
            level,
            bend,
            depth,
        } = &open.cell;
        let layers = 1 + usize::from(self.stationary);
        let there: SmallVec<[Option<SmallVec<[f64; 3]>>; 2]> = (0..layers)
            .map(|layer| {
                let (point, known) = fan.point(middle, level + layer)?;
                let x = point[1..=n]
                    .iter()
                    .zip(&fan.plan.widths)
                    .map(|(s, w)| f64::from(*s) / w);
                known.then(|| x.collect())
            })
            .collect();
        let here = open.corners.bend(a, b, &there, seeds.len(), n);
        // Half as long an edge is half as bent.
        let bend = (0.5 * here).max(KEPT * bend.min(FIRST_BEND));
        let half = |end: u32| {
            let cell = Cell {
                seeds: seeds
                    .iter()
                    .map(|v| if *v == end { middle } else { *v })
                    .collect(),
                level: *level,
                bend,
                depth: depth + 1,
            };
            let corners = cell.corners(fan, self.stationary);
            if !corners.known.iter().any(|k| *k) || corners.lowest > ceiling {
                return None;
            }
            let longest = corners.longest(seeds.len(), n).2;
            let stray = self.stray(&cell, &corners, longest);
            let bounds = corners.bounds(n, bend.max(stray));
            let bend = bend.max(stray).max(corners.skew(seeds.len(), n, longest));
            let copies: SmallVec<[u32; 4]> = (open.copies.iter().copied())
                .filter(|c| {
                    let x = &copies[*c as usize].x;
                    holds(&bounds, x) && corners.may_hold(x, seeds.len(), longest, bend)
                })
                .collect();
            (!copies.is_empty()).then_some(Open {
                cell,
                corners,
                copies,
            })
        };
        [seeds[a], seeds[b]].into_iter().filter_map(half).collect()
    }
}

/// Lowers an entry.
pub(in crate::low_level::value) fn lower(map: &mut BTreeMap<usize, f64>, key: usize, value: f64) {
    let entry = map.entry(key).or_insert(value);
    *entry = entry.min(value);
}

/// V at a state (a deviation) by V and the adjoint at a point `(t, s, p, V)`.
fn tangent<T: Into<f64> + std::marker::Copy>(
    point: &[T],
    n: usize,
    state: impl Fn(usize) -> f64,
) -> f64 {
    let at = |i: usize| -> f64 { point[1 + i].into() };
    at(2 * n) + (0..n).map(|i| at(n + i) * (state(i) - at(i))).sum::<f64>()
}

fn holds(bounds: &[[f64; 2]], x: &[f64]) -> bool {
    bounds.iter().zip(x).all(|([lo, hi], x)| x >= lo && x <= hi)
}

/// The cells with the copies that may lie in each; none without.
fn assign(cells: Vec<(Cell, Corners)>, copies: &[Copy], sought: &[Sought], n: usize) -> Vec<Open> {
    /// Cells that end below this share of what was searched before are left out.
    const SEARCHED: f64 = 0.7;
    // By the first coordinate, so that only those in a cell's range are looked at.
    let mut order: Vec<u32> = (0..copies.len() as u32).collect();
    let key = |c: u32| copies[c as usize].x[0];
    order.sort_by(|a, b| key(*a).total_cmp(&key(*b)));
    cells
        .into_par_iter()
        .filter_map(|(cell, corners)| {
            let bounds = corners.bounds(n, f64::INFINITY);
            let from = order.partition_point(|c| key(*c) < bounds[0][0]);
            let to = order.partition_point(|c| key(*c) <= bounds[0][1]);
            let mut inside: SmallVec<[u32; 4]> = (order[from..to.max(from)].iter().copied())
                .filter(|c| {
                    let copy = &copies[*c as usize];
                    let above = sought[copy.sought].above;
                    // Costs may be negative: what was not searched at all leaves nothing out.
                    (above <= 0.0 || corners.highest >= SEARCHED * above) && holds(&bounds, &copy.x)
                })
                .collect();
            inside.sort_unstable();
            (!inside.is_empty()).then_some(Open {
                cell,
                corners,
                copies: inside,
            })
        })
        .collect()
}
