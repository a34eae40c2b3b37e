//! Which parts of the swept manifold lie over a state: a search that depends on the state alone.
//!
//! The manifold of optimal trajectories is parametrized by seed and level. It is divided into cells: a simplex of seeds
//! between two levels. The extremals from a state x are the places of the manifold whose state is x, so every cell whose
//! image may hold x is divided further, until it is small; what is left gives the first guesses for x. Cells over which no
//! state asked for lies are never divided, so the cost follows the states, not the region. Which cells there are, and
//! how they are divided, depends on the manifold alone: other states asked for at the same time change nothing.

mod cell;
mod fan;
mod near;

use crate::backend::{Backend, BackendError};
use crate::model::Model;
use crate::shooting::{End, Path};
use crate::sweep::Plan;
use cell::{Cell, Corners, KEPT, Place};
use fan::Fan;
use rayon::prelude::*;
use std::collections::{BTreeMap, HashMap};

/// States up to which the manifold is divided into cells, and up to which points of trajectories are looked up.
const MOST_IN_CELLS: usize = 3;
const MOST_STATES: usize = 6;
/// First seeds by the number of states.
const FIRST_SEEDS: [usize; MOST_STATES + 1] = [1, 2, 256, 300, 400, 400, 400];
/// Widest gap, in widths of the region, between neighbouring first trajectories; and how many there are at most.
const SPACING: [f64; MOST_STATES + 1] = [0.05, 0.05, 0.08, 0.15, 0.2, 0.3, 0.4];
const MOST_FIRST: [usize; MOST_STATES + 1] = [2, 2, 4000, 4000, 1200, 800, 400];
/// Widths beyond the region up to which gaps are looked at.
const AROUND: f64 = 0.25;
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
/// How far outside a cell, relative to it, a state may lie that is looked for in it.
const OUTSIDE: f64 = 0.35;
/// Trajectories go on to this many times the cost searched, so that cells on its level have their corners.
const BEYOND: f64 = 2.0;
/// Cells that are divided for one state at a time, at most.
const MOST_CELLS: usize = 2048;
/// Rounds of dividing: seeds as near as rounding allows are met before.
const MOST_ROUNDS: usize = 160;
/// Periods by which a state is shifted at most.
const MOST_TURNS: i32 = 16;
/// Most segments that a guess begins with.
const MOST_SEGMENTS: f64 = 400.0;
/// Trajectories of one search.
const MOST_TRAJECTORIES: usize = 400_000;

/// A state looked for: a target's, as a deviation.
#[derive(Clone, Debug)]
pub struct Sought {
    pub target: usize,
    pub s: Vec<f64>,
    /// Cost up to which everything was found before.
    pub above: f64,
}

/// A first guess from a cell over a target.
#[derive(Clone, Debug)]
pub struct Candidate {
    pub target: usize,
    /// The seed whose trajectory passes beside the target.
    pub seed: u32,
    /// Periods by which the trajectory's start is away from the target as given.
    pub turns: Vec<i32>,
    pub goal: Vec<f64>,
    /// The mean of the cell's trajectories.
    pub path: Path,
    /// The cell's trajectory that passes nearest: it is a solution from its own state.
    pub beside: Path,
    pub value: f64,
    /// How much the adjoint (unscaled) differs within the cell, a component.
    pub spread: Vec<f64>,
    outside: f64,
}

impl Candidate {
    /// Whether the target lies in the cell itself, not only near it.
    pub fn is_inside(&self) -> bool {
        self.outside == 0.0
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
    copies: Vec<u32>,
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
    /// Cost that the levels of the search are powers of: what the linearization gives at the region's corners.
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

    /// Whether it can be divided into cells, so that nothing is left out that is larger than the cells looked at.
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
    pub fn new(plan: &'a Plan, model: &Model, duration: f64, backend: &dyn Backend) -> Result<Self, BackendError> {
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

    /// Trajectories integrated so far.
    pub fn trajectories(&self) -> usize {
        self.fan.integrated
    }

    /// Finds the cells over states in which V may be at most `ceiling`.
    ///
    /// # Errors
    /// Device failures only.
    pub fn search(&mut self, sought: &[Sought], ceiling: f64, end: &End) -> Result<Cells, BackendError> {
        if self.divided_to != ceiling {
            self.divide_first(ceiling)?;
        }
        let all = self.first_cells(ceiling);
        let copies = self.copies(sought, &all);
        let mut open = assign(all, &copies, sought, self.fan.plan.system.states);
        let mut cells = Cells::default();
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
            open = self.divide(open, &mut leaves, &copies, ceiling)?;
        }
        cells.candidates = leaves
            .par_iter()
            .flat_map_iter(|leaf| {
                leaf.copies
                    .iter()
                    .filter_map(|c| self.candidate(leaf, &copies[*c as usize], sought, end))
            })
            .collect();
        cells.candidates.sort_by(|a, b| {
            (a.target, &a.turns)
                .cmp(&(b.target, &b.turns))
                .then(a.outside.total_cmp(&b.outside))
                .then(a.value.total_cmp(&b.value))
        });
        Ok(cells)
    }

    /// Divides the first simplices, from the start, where neighbouring trajectories part before their cost is `ceiling`: the
    /// cells of a narrow bundle that goes elsewhere are not seen from outside it.
    fn divide_first(&mut self, ceiling: f64) -> Result<(), BackendError> {
        let n = self.fan.plan.system.states;
        let mut done: Vec<Vec<u32>> = Vec::new();
        let mut open = self.base.clone();
        let first: Vec<u32> = self.base.iter().flatten().copied().collect();
        self.fan.integrate(&first, BEYOND * ceiling)?;
        let mut made = 0;
        while !open.is_empty() {
            let gaps: Vec<(f64, u32, u32)> = open.par_iter().map(|s| self.widest(s, ceiling)).collect();
            let mut next = Vec::new();
            let mut middles = Vec::new();
            for (simplex, (gap, a, b)) in open.into_iter().zip(gaps) {
                let wide = gap > SPACING[n] && made < MOST_FIRST[n];
                let Some(middle) = wide.then(|| self.fan.middle(a, b)).flatten() else {
                    done.push(simplex);
                    continue;
                };
                middles.push(middle);
                for end in [a, b] {
                    next.push(simplex.iter().map(|v| if *v == end { middle } else { *v }).collect());
                }
            }
            self.fan.integrate(&middles, BEYOND * ceiling)?;
            middles.sort_unstable();
            middles.dedup();
            made += middles.len();
            open = next;
        }
        (self.roots, self.divided_to) = (done, ceiling);
        Ok(())
    }

    /// The widest gap between two trajectories of a simplex, and which. Endless, between the two furthest apart, where all of
    /// them cost too much but what lies between may not.
    fn widest(&self, simplex: &[u32], ceiling: f64) -> (f64, u32, u32) {
        if let Some((a, b)) = (!self.stationary).then(|| self.fan.hidden(simplex, ceiling)).flatten() {
            return (f64::INFINITY, a, b);
        }
        let mut widest = (0.0, 0, 0);
        for (k, a) in simplex.iter().enumerate() {
            for b in &simplex[k + 1..] {
                let gap = self.fan.gap(*a, *b, ceiling, AROUND);
                if gap > widest.0 {
                    widest = (gap, *a, *b);
                }
            }
        }
        widest
    }

    /// The cells of the first simplices.
    fn first_cells(&self, ceiling: f64) -> Vec<(Cell, Corners)> {
        let fan = &self.fan;
        self.roots
            .par_iter()
            .flat_map_iter(|seeds| {
                let last = seeds.iter().map(|v| fan.reached(*v)).max().unwrap_or(0);
                let levels = if self.stationary {
                    0..last
                } else {
                    fan.levels()..fan.levels() + 1
                };
                levels.filter_map(move |level| {
                    let cell = Cell {
                        seeds: seeds.clone(),
                        level,
                        bend: f64::INFINITY,
                        depth: 0,
                    };
                    let corners = cell.corners(fan, self.stationary);
                    let any = corners.known.iter().any(|k| *k);
                    (any && corners.value <= ceiling).then_some((cell, corners))
                })
            })
            .collect()
    }

    /// The states looked for with all windings that come near a cell.
    fn copies(&self, sought: &[Sought], cells: &[(Cell, Corners)]) -> Vec<Copy> {
        let n = self.fan.plan.system.states;
        let mut extent = vec![[f64::INFINITY, f64::NEG_INFINITY]; n];
        for (_, corners) in cells {
            for (extent, bound) in extent.iter_mut().zip(corners.bounds(n, f64::INFINITY)) {
                *extent = [extent[0].min(bound[0]), extent[1].max(bound[1])];
            }
        }
        self.copies_within(sought, &extent)
    }

    /// The states looked for with all windings within a range (in widths).
    fn copies_within(&self, sought: &[Sought], extent: &[[f64; 2]]) -> Vec<Copy> {
        let plan = self.fan.plan;
        let n = plan.system.states;
        let mut copies = Vec::new();
        for (k, one) in sought.iter().enumerate() {
            let mut turns: Vec<Vec<i32>> = vec![Vec::new()];
            for i in 0..n {
                let range = match plan.periods[i] {
                    Some(period) => {
                        let width = period / plan.widths[i];
                        let x = one.s[i] / plan.widths[i];
                        let lowest = ((extent[i][0] - x) / width).ceil().max(-1e6) as i32;
                        let highest = ((extent[i][1] - x) / width).floor().min(1e6) as i32;
                        let nearest = (-one.s[i] / period).round().clamp(-1e6, 1e6) as i32;
                        lowest.max(nearest - MOST_TURNS)..=highest.min(nearest + MOST_TURNS)
                    }
                    None => 0..=0,
                };
                turns = (turns.iter())
                    .flat_map(|t| range.clone().map(|k| [t.as_slice(), &[k]].concat()))
                    .collect();
            }
            for turns in turns {
                let x = (0..n)
                    .map(|i| (one.s[i] + f64::from(turns[i]) * plan.periods[i].unwrap_or(0.0)) / plan.widths[i])
                    .collect();
                copies.push(Copy { sought: k, turns, x });
            }
        }
        copies
    }

    /// Where too many cells are open over a state the costliest are left out, and the state is not covered from there on.
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
        let mut values: HashMap<usize, Vec<f64>> = HashMap::new();
        for cell in open.iter() {
            for c in &cell.copies {
                let of = copies[*c as usize].sought;
                if count[of] > MOST_CELLS {
                    values.entry(of).or_default().push(cell.corners.value);
                }
            }
        }
        let limits: HashMap<usize, f64> = (values.into_iter())
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
    fn divide(
        &mut self,
        open: Vec<Open>,
        leaves: &mut Vec<Open>,
        copies: &[Copy],
        ceiling: f64,
    ) -> Result<Vec<Open>, BackendError> {
        let n = self.fan.plan.system.states;
        let leaf = LEAF[n];
        let mut split: Vec<Division> = Vec::new();
        for open in open {
            let seeds = &open.cell.seeds;
            let (a, b, length) = open.corners.longest(seeds.len(), n);
            let complete = open.corners.complete();
            let straight = open.cell.bend <= STRAIGHT || length <= LEAST;
            if complete && length <= leaf && straight {
                leaves.push(open);
                continue;
            }
            if !complete && (length <= LEAST || open.cell.depth >= DEEPEST) {
                continue;
            }
            match self.fan.middle(seeds[a], seeds[b]) {
                Some(middle) => split.push(Division { open, a, b, middle }),
                None if complete => leaves.push(open),
                None => {}
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
        let there: Vec<Option<Vec<f64>>> = (0..layers)
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
                seeds: seeds.iter().map(|v| if *v == end { middle } else { *v }).collect(),
                level: *level,
                bend,
                depth: depth + 1,
            };
            let corners = cell.corners(fan, self.stationary);
            if !corners.known.iter().any(|k| *k) || corners.value > ceiling {
                return None;
            }
            let bounds = corners.bounds(n, bend);
            let longest = corners.longest(seeds.len(), n).2;
            let bend = bend.max(corners.skew(seeds.len(), n, longest));
            let copies: Vec<u32> = (open.copies.iter().copied())
                .filter(|c| {
                    let x = &copies[*c as usize].x;
                    holds(&bounds, x) && corners.may_hold(x, seeds.len(), longest, bend)
                })
                .collect();
            (!copies.is_empty()).then_some(Open { cell, corners, copies })
        };
        [seeds[a], seeds[b]].into_iter().filter_map(half).collect()
    }

    /// The guess that a leaf gives for a state, if the state lies in it.
    fn candidate(&self, leaf: &Open, copy: &Copy, sought: &[Sought], end: &End) -> Option<Candidate> {
        let plan = self.fan.plan;
        let n = plan.system.states;
        let seeds = &leaf.cell.seeds;
        let place = match leaf.corners.locate(&copy.x, seeds.len()) {
            Some(place) if place.outside > OUTSIDE => return None,
            Some(place) => place,
            // A flat cell: its middle, if the state is hardly outside its corners.
            None if !holds(&leaf.corners.bounds(n, 0.0), &copy.x) => return None,
            None => Place {
                weights: vec![1.0 / seeds.len() as f64; seeds.len()],
                share: 0.5,
                outside: OUTSIDE,
            },
        };
        let one = &sought[copy.sought];
        let first = self.at(&leaf.cell, &place);
        let spread = self.spread(&leaf.cell, &first);
        let path = self.path(&leaf.cell, &place, &first, end);
        let beside = self.beside(&leaf.cell, &place, end);
        Some(Candidate {
            target: one.target,
            seed: seeds[0],
            turns: copy.turns.clone(),
            goal: copy.x.iter().zip(&plan.widths).map(|(x, w)| x * w).collect(),
            path,
            beside,
            value: first[1 + 2 * n],
            spread,
            outside: place.outside.max(0.0),
        })
    }

    /// The guess that a point of a trajectory gives for a state near it.
    fn point_guess(
        &self,
        seed: u32,
        level: usize,
        copy: &Copy,
        sought: &[Sought],
        distance: f64,
        end: &End,
    ) -> Candidate {
        let widths = &self.fan.plan.widths;
        let n = widths.len();
        let cell = Cell {
            seeds: vec![seed],
            level,
            bend: 0.0,
            depth: 0,
        };
        let place = Place {
            weights: vec![1.0],
            share: 0.0,
            outside: distance,
        };
        let first = self.mixed(&cell, &place, level);
        let path = self.path(&cell, &place, &first, end);
        let goal: Vec<f64> = copy.x.iter().zip(widths).map(|(x, w)| x * w).collect();
        let change: f64 = (0..n).map(|i| first[1 + n + i] * (goal[i] - first[1 + i])).sum();
        Candidate {
            target: sought[copy.sought].target,
            seed,
            turns: copy.turns.clone(),
            goal,
            beside: path.clone(),
            path,
            value: first[1 + 2 * n] + change,
            spread: vec![0.0; n],
            outside: distance,
        }
    }

    /// `(t, s, p, V)` at a place of a cell.
    fn at(&self, cell: &Cell, place: &Place) -> Vec<f64> {
        let lower = self.mixed(cell, place, cell.level);
        if !self.stationary {
            return lower;
        }
        let upper = self.mixed(cell, place, cell.level + 1);
        // A cubic along the trajectory: it is known how fast all changes at both levels.
        let (q, step) = (place.share, self.fan.step(cell.level));
        let rates = self.fan.along(&[lower.as_slice(), &upper].concat());
        let (below, above) = rates.split_at(lower.len());
        let blend = [
            (1.0 + 2.0 * q) * (1.0 - q).powi(2),
            q * q * (3.0 - 2.0 * q),
            q * (1.0 - q).powi(2) * step,
            q * q * (q - 1.0) * step,
        ];
        (0..lower.len())
            .map(|i| {
                let straight = lower[i] + q * (upper[i] - lower[i]);
                let cubic = blend[0] * lower[i] + blend[1] * upper[i] + blend[2] * below[i] + blend[3] * above[i];
                // Where the trajectories of a cell differ too much their mean is none.
                let usual = (upper[i] - lower[i]).abs();
                if (cubic - straight).abs() <= usual {
                    cubic
                } else {
                    straight
                }
            })
            .collect()
    }

    /// The path of the corner with the largest weight, from the level nearer to a place.
    fn beside(&self, cell: &Cell, place: &Place, end: &End) -> Path {
        let most = (0..place.weights.len()).max_by(|a, b| place.weights[*a].total_cmp(&place.weights[*b]));
        let upper = self.stationary && place.share > 0.5;
        let corner = Place {
            weights: (0..place.weights.len())
                .map(|q| f64::from(u8::from(Some(q) == most)))
                .collect(),
            share: 0.0,
            outside: 0.0,
        };
        let cell = Cell {
            level: cell.level + usize::from(upper),
            ..cell.clone()
        };
        let first = self.mixed(&cell, &corner, cell.level);
        self.path(&cell, &corner, &first, end)
    }

    /// The mean of a cell's trajectories at a level, by a place's weights.
    fn mixed(&self, cell: &Cell, place: &Place, level: usize) -> Vec<f64> {
        let mut mean = vec![0.0; 2 + 2 * self.fan.plan.system.states];
        for (seed, weight) in cell.seeds.iter().zip(&place.weights) {
            if let Some((point, _)) = self.fan.point(*seed, level) {
                mean.iter_mut()
                    .zip(point)
                    .for_each(|(m, x)| *m += weight * f64::from(*x));
            }
        }
        if !self.stationary && level > 0 {
            // To the last bit.
            mean[0] = self.fan.time(level);
        }
        mean
    }

    /// How far the corners' adjoints are from the one at a place.
    fn spread(&self, cell: &Cell, at: &[f64]) -> Vec<f64> {
        let n = self.fan.plan.system.states;
        let mut spread = vec![0.0f64; n];
        for level in cell.level..=cell.level + usize::from(self.stationary) {
            for seed in &cell.seeds {
                let Some((point, _)) = self.fan.point(*seed, level) else {
                    continue;
                };
                for (i, spread) in spread.iter_mut().enumerate() {
                    *spread = spread.max((f64::from(point[1 + n + i]) - at[1 + n + i]).abs());
                }
            }
        }
        spread
    }

    /// The path from a place to the end: the mean of the cell's trajectories, and on into the range of the end's condition.
    fn path(&self, cell: &Cell, place: &Place, first: &[f64], end: &End) -> Path {
        let n = self.fan.plan.system.states;
        let mut path = Path::new(&first[1..=2 * n]);
        let shortest = (first[0] / MOST_SEGMENTS).max(self.duration);
        let points: Vec<Vec<f64>> = (0..=cell.level)
            .rev()
            .map(|level| self.mixed(cell, place, level))
            .collect();
        let mut at = first[0];
        for (k, point) in points.iter().enumerate() {
            let before = points.get(k + 1).map_or(f64::NEG_INFINITY, |next| next[0]);
            // The last point that is not too far away, or the next one.
            if at - before > shortest && at > point[0] {
                path.push(at - point[0], &point[1..=2 * n]);
                at = point[0];
            }
        }
        let s = path.last()[..n].to_vec();
        let (nodes, durations) = end.tail(&s, first[1 + 2 * n], self.duration);
        path.append(&nodes, &durations);
        path
    }
}

/// Lowers an entry.
fn lower(map: &mut BTreeMap<usize, f64>, key: usize, value: f64) {
    let entry = map.entry(key).or_insert(value);
    *entry = entry.min(value);
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
            let mut inside: Vec<u32> = (order[from..to.max(from)].iter().copied())
                .filter(|c| {
                    let copy = &copies[*c as usize];
                    corners.highest >= SEARCHED * sought[copy.sought].above && holds(&bounds, &copy.x)
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
