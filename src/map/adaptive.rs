//! A map to the error asked for: states are chosen, solved, and their extremals cut into points, until pieces fitted to these
//! say what points that were left out say, and what fresh states say that were never used.

mod beyond;
mod first;
mod horizon;

use super::pieces::{Before, Cloud, Frame, MOST_VARIABLES, Pieces, Region, Said, Steep, Want, build};
use crate::backend::BackendError;
use crate::model::{MapAim, Model};
use crate::shooting::{Path, Solver};
use crate::sweep::{Plan, spread_over};
use crate::value::{
    self, Answers, Archive, PointStatus, Progress, Request, Track, TrackPoints, Wish, path_from, solve_near,
    track_points,
};
pub use beyond::Beyond;
use first::{FACES, WITHIN};
use horizon::{CHECKED, FIRST_TIMES, TimeAxis};
use std::collections::{BTreeMap, HashMap};
use std::time::Instant;

/// Points of extremals are wanted this far outside the region, in its widths.
const AROUND: f64 = 0.05;
/// Largest distance between points of an extremal, in widths of the region, and change of log V.
const SPACING: f64 = 0.025;
const CHANGE: f64 = 0.15;
/// States of the first round that are searched for all sheets, by number of states.
const FIRST: [usize; 7] = [0, 64, 256, 256, 256, 384, 512];
/// States asked for in a cell at once: this many times a power of its error over the one asked for, and the most.
const A_CELL: f64 = 3.0;
const MORE: f64 = 0.4;
const MOST_A_CELL: f64 = 48.0;
/// A round solves for at most this many times the states solved before.
const GROWTH: f64 = 3.0;
const GROWTH_BY_QUARTERS: f64 = 2.0;
/// Share of the budget before the last rounds, and that is worth no further round.
const BEFORE_CLOSING: f64 = 0.88;
const ALL_BUT: f64 = 0.97;
/// Shortest step of the way from a point of an extremal to a state near it.
const LEAST_STEP: f64 = 1.0 / 8.0;
/// The same where there are few points yet.
const PATIENT_STEP: f64 = 1.0 / 64.0;
/// A change of V by itself counts as so many widths of a cell.
const STEEP: f64 = 2.0;
/// Failures in a cell after which no more states are tried there.
const MOST_FAILURES: u32 = 6;
/// Rounds of fresh states.
const CHECKS: usize = 4;
/// Share of fresh states whose error may be above the bound.
const ABOVE_BOUND: f64 = 0.01;
/// Slopes across that are this much less make another frame worth while.
const BETTER: f64 = 0.7;
/// States solved after which the frame stays.
const SETTLED: usize = 3000;
/// How far beyond their outermost points pieces say something, in half widths: behind a fold of a game there is nothing.
const BEYOND: f64 = 0.6;
const BEYOND_OF_GAME: f64 = 0.02;
/// Draws of a state in the part of a cell that lies in the region.
const DRAWS: usize = 20;
/// Other sheets than the lowest are kept at a state if they may be the lowest within this share of the region.
const NEAR: f64 = 0.05;
/// States in a cell that a fresh state has shown to be wrong, which are searched for all sheets.
const SEARCHED: usize = 4;
/// States that tell where the error is met.
const LOOKED_AT: usize = 4096;
/// Floor of V for relative errors unless the scene says, relative to the median over the region.
const FLOOR: f64 = 1e-3;

/// A fresh state and what the map says of it.
#[derive(Clone, Debug)]
pub struct Checked {
    /// Of a map with a time axis the time is the last component.
    pub x: Vec<f64>,
    pub status: PointStatus,
    /// V solved for, and said with its bound; NaN where there is none.
    pub solved: f64,
    pub said: f64,
    pub bound: f64,
}

impl Checked {
    fn of(x: &[f64], (status, solved): (PointStatus, f64), said: Option<&Said>) -> Self {
        Self {
            x: x.to_vec(),
            status,
            solved,
            said: said.map_or(f64::NAN, |s| s.v),
            bound: said.map_or(f64::NAN, |s| s.v_bound),
        }
    }
}

/// What came of it.
pub struct Adaptive {
    pub pieces: Pieces,
    /// Of an infinite horizon and of V(x, t): where solutions from the region lead.
    pub beyond: Option<Beyond>,
    pub check: Vec<Checked>,
    /// States solved for, and tried without an answer.
    pub states: usize,
    pub failed: usize,
    pub points: usize,
    pub rounds: usize,
    /// States of the first search: those that the budget had room for, and all.
    pub first: [usize; 2],
    /// Share of the region in cells where the error is above the one asked for, or nothing is known.
    pub unmet: f64,
    /// Share of the region where pieces are left out because their bounds are above `error_max`.
    pub uncertain: f64,
    pub error_max: f64,
    pub seconds: f64,
}

/// A state to be solved for, from which point of the cloud, for which cell.
struct Errand {
    /// With its time where the map has that axis.
    x: Vec<f64>,
    from: u32,
    cell: Vec<u64>,
    /// Half widths of the cell.
    half: Vec<f64>,
    /// The cell itself is good enough.
    only_bare: bool,
}

/// A point that a solution meets, with V.
type Met = (Vec<f64>, f64);

struct Work<'a, 'p> {
    plan: &'a Plan,
    model: &'a Model,
    solver: &'a mut Solver,
    archive: &'a Archive,
    aim: &'a MapAim,
    progress: Progress<'p>,
    tracks: Vec<Track>,
    points: TrackPoints,
    /// Points of each track.
    of_track: Vec<Vec<u32>>,
    cloud: Cloud,
    frame: Frame,
    /// Track point and turns by periods that each point of the cloud comes from.
    origins: Vec<(u32, Vec<f64>)>,
    failures: HashMap<Vec<u64>, u32>,
    random: u64,
    states: usize,
    failed: usize,
    rounds: usize,
    /// States of the first search that were taken up, and all of it.
    first: [usize; 2],
    clock: Instant,
    /// Seconds a state of the last round, its pieces included.
    pace: f64,
    /// Of the states, and of the time where that is an axis.
    bounds: Vec<[f64; 2]>,
    axis: Option<TimeAxis>,
    /// dV/dt at the points, where time is an axis.
    rates: Vec<f64>,
}

/// Makes a map. `archive` gives the first guesses.
///
/// # Errors
/// Device failures only.
pub fn adaptive(
    plan: &Plan,
    model: &Model,
    solver: &mut Solver,
    archive: &Archive,
    aim: &MapAim,
    progress: Progress<'_>,
) -> Result<Adaptive, BackendError> {
    let axis = TimeAxis::of(plan, model, aim)?;
    let bounds: Vec<[f64; 2]> = (aim.bounds.iter().copied())
        .chain(axis.as_ref().map(|axis| [0.0, axis.last]))
        .collect();
    assert!(bounds.len() <= MOST_VARIABLES);
    let region = Region {
        lo: bounds.iter().map(|b| b[0]).collect(),
        hi: bounds.iter().map(|b| b[1]).collect(),
        error: aim.error,
        equal_cost: aim.equal_cost.unwrap_or(f64::INFINITY),
        floor: 0.0,
        value_max: aim.value_max.unwrap_or(f64::INFINITY),
        beyond: if plan.game { BEYOND_OF_GAME } else { BEYOND },
        game: plan.game,
    };
    let mut work = Work {
        plan,
        model,
        solver,
        archive,
        aim,
        progress,
        tracks: Vec::new(),
        points: TrackPoints {
            states: plan.system.states,
            ..TrackPoints::default()
        },
        of_track: Vec::new(),
        cloud: Cloud {
            variables: bounds.len(),
            ..Cloud::default()
        },
        frame: Frame::along(&region),
        origins: Vec::new(),
        failures: HashMap::new(),
        random: 0x5eed,
        states: 0,
        failed: 0,
        rounds: 0,
        first: [0; 2],
        pace: 0.0,
        clock: Instant::now(),
        bounds,
        axis,
        rates: Vec::new(),
    };
    work.run(region)
}

const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

/// A number from 0 to 1 of which close arguments tell nothing.
fn mixed(mut z: u64) -> f64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

impl Work<'_, '_> {
    fn run(&mut self, mut region: Region) -> Result<Adaptive, BackendError> {
        region.floor = self.first()?;
        let (mut check, mut met) = (Vec::new(), Vec::new());
        let mut pieces = self.refined(&region, Vec::new())?;
        let mut known = pieces.within(self.aim.error_max);
        for attempt in 0..CHECKS {
            (check, met) = self.checked(&known)?;
            let wrong: Vec<&Checked> = (check.iter())
                .filter(|c| c.status != PointStatus::AboveMax && (c.said - c.solved).abs() > c.bound)
                .collect();
            let enough = wrong.len() as f64 <= ABOVE_BOUND * check.len() as f64;
            if enough || attempt + 1 == CHECKS || self.is_spent(1.0) {
                break;
            }
            // More states in the cells that said too little of their errors, some of them searched for all sheets.
            let more: Vec<Want> = wrong.iter().map(|c| self.want_around(&pieces, c)).collect();
            let mut states = Vec::new();
            for (want, c) in more.iter().zip(&wrong) {
                for _ in 0..SEARCHED {
                    let mut x = (self.inside(want, &region))
                        .map(|z| self.frame.state(&z))
                        .unwrap_or_default();
                    if let (Some(t), Some(_)) = (x.last_mut(), &self.axis) {
                        // Of as many times as there are already.
                        *t = c.x[c.x.len() - 1];
                    }
                    states.extend(x);
                }
            }
            if !states.is_empty() {
                let (tracks, _) = self.searched(states, NEAR)?;
                self.add(tracks, region.floor)?;
            }
            pieces = self.refined(&region, more)?;
            known = pieces.within(self.aim.error_max);
        }
        // By many states: cells reach over the region's faces.
        let looked_at = spread_over(&self.bounds, LOOKED_AT);
        let unmet = |x: &&Vec<f64>| match pieces.at(x) {
            Some(said) => said.v_bound > region.error * said.v.abs().max(region.floor),
            // Nothing is said above the largest V of interest; of a map without pieces nothing is.
            None => region.value_max == f64::INFINITY || pieces.pieces.is_empty(),
        };
        let share =
            |of: &dyn Fn(&&Vec<f64>) -> bool| looked_at.iter().filter(of).count() as f64 / looked_at.len() as f64;
        Ok(Adaptive {
            unmet: share(&unmet),
            uncertain: share(&|x| pieces.at(x).is_some() && known.at(x).is_none()),
            error_max: self.aim.error_max,
            beyond: self.beyond(&region, &met),
            pieces: known,
            check,
            states: self.states,
            failed: self.failed,
            points: self.cloud.len(),
            rounds: self.rounds,
            first: self.first,
            seconds: self.clock.elapsed().as_secs_f64(),
        })
    }

    fn is_spent(&self, share: f64) -> bool {
        self.states_left(share) == 0 || self.seconds_left(share) <= 0.0
    }

    /// What is left of a share of the budget.
    fn states_left(&self, share: f64) -> usize {
        ((share * self.aim.states as f64) as usize).saturating_sub(self.states + self.failed)
    }

    fn seconds_left(&self, share: f64) -> f64 {
        (self.aim.seconds).map_or(f64::INFINITY, |s| share * s - self.clock.elapsed().as_secs_f64())
    }

    /// V up to which points are kept: a little beyond what is asked for, for the pieces at its edge.
    fn most_value(&self) -> f64 {
        self.aim.value_max.map_or(f64::INFINITY, |v| v + 0.1 * v.abs())
    }

    /// Fresh states of the region (absolute), in an order without end. The seed asked for turns them, and nothing else of a map.
    fn fresh(&mut self, count: usize) -> Vec<f64> {
        let bounds = self.bounds.clone();
        let turn = |i: usize| match self.plan.seed {
            0 => 0.0,
            seed => mixed(seed.wrapping_add((i as u64 + 1).wrapping_mul(GOLDEN))),
        };
        let turns: Vec<f64> = (0..bounds.len()).map(turn).collect();
        (0..count)
            .flat_map(|_| {
                (bounds.iter().zip(&turns))
                    .map(|([lo, hi], turn)| lo + (hi - lo) * (self.uniform() + turn).fract())
                    .collect::<Vec<_>>()
            })
            .collect()
    }

    /// A number from 0 to 1 (splitmix64).
    fn uniform(&mut self) -> f64 {
        self.random = self.random.wrapping_add(GOLDEN);
        mixed(self.random)
    }

    /// Solves for states; where time is an axis, those of one time after the other. Of each answers the numbers of its states.
    fn solve(&mut self, states: Vec<f64>, in_company: bool) -> Result<Vec<(Vec<usize>, Answers)>, BackendError> {
        let v = self.cloud.variables;
        if self.axis.is_none() {
            let numbers = (0..states.len() / v).collect();
            return Ok(vec![(numbers, self.solve_from(0.0, states, in_company)?)]);
        }
        // Times are not negative: their bits are in their order.
        let mut by_time: BTreeMap<u64, (Vec<usize>, Vec<f64>)> = BTreeMap::new();
        for (k, x) in states.chunks(v).enumerate() {
            let (numbers, points) = by_time.entry(x[v - 1].to_bits()).or_default();
            numbers.push(k);
            points.extend_from_slice(&x[..v - 1]);
        }
        (by_time.into_iter())
            .map(|(t, (numbers, points))| Ok((numbers, self.solve_from(f64::from_bits(t), points, in_company)?)))
            .collect()
    }

    fn solve_from(&mut self, t: f64, points: Vec<f64>, in_company: bool) -> Result<Answers, BackendError> {
        let request = Request {
            points,
            in_company,
            value_max: self.aim.value_max,
            ..Request::default()
        };
        if let Some(axis) = self.axis.as_mut().filter(|_| t > 0.0) {
            let from = axis.from(t, self.plan, self.model)?;
            let (plan, model, archive) = (&from.plan, &from.model, &from.archive);
            return value::solve(plan, model, &mut from.solver, archive, &request, &mut *self.progress);
        }
        value::solve(
            self.plan,
            self.model,
            self.solver,
            self.archive,
            &request,
            &mut *self.progress,
        )
    }

    /// Solves for the first states, searched for all sheets; the floor of V.
    fn first(&mut self) -> Result<f64, BackendError> {
        let n = self.cloud.variables;
        let mut wide: Vec<[f64; 2]> = (self.aim.bounds.iter())
            .map(|[lo, hi]| [lo - 0.5 * AROUND * (hi - lo), hi + 0.5 * AROUND * (hi - lo)])
            .collect();
        wide.extend(self.axis.as_ref().map(|axis| [0.0, axis.last]));
        let states = self.of_levels(spread_over(&wide, FIRST[n]));
        let (mut tracks, mut values) = self.searched_in_budget(states, WITHIN)?;
        // Where trajectories are not followed backward only states on the region's faces tell of these.
        if !self.goes_beyond() {
            let mut states = Vec::new();
            // The end of the horizon needs no search.
            let faces = 2 * n - usize::from(self.axis.is_some());
            for face in 0..faces {
                let mut side = wide.clone();
                side[face / 2] = [wide[face / 2][face % 2]; 2];
                states.extend(spread_over(&side, FIRST[n] / (2 * n)));
            }
            let states = self.of_levels(states);
            let (more, others) = self.searched_in_budget(states, FACES)?;
            tracks.extend(more);
            values.extend(others);
        }
        values.retain(|v| v.is_finite());
        values.iter_mut().for_each(|v| *v = v.abs());
        values.sort_by(f64::total_cmp);
        let median = values.get(values.len() / 2).copied().unwrap_or(1.0);
        let floor = self.aim.floor.unwrap_or(FLOOR * median);
        self.add(tracks, floor)?;
        if self.goes_beyond() {
            self.edges(floor)?;
        }
        if self.axis.is_some() {
            let mut states = spread_over(&wide, FIRST[n]);
            let corners = (0..1usize << (n - 1)).map(|corner| (0..n - 1).map(|i| wide[i][corner >> i & 1]).collect());
            states.extend(corners);
            self.add_ends(&states);
        }
        Ok(floor)
    }

    /// States one after the other, their times of few.
    fn of_levels(&self, mut states: Vec<Vec<f64>>) -> Vec<f64> {
        if let Some(axis) = &self.axis {
            for x in &mut states {
                let t = x.last_mut().expect("time is the last");
                let times = FIRST_TIMES as f64;
                *t = (*t / axis.last * times).floor().min(times - 1.0) * axis.last / times;
            }
        }
        states.into_iter().flatten().collect()
    }

    /// States on the region's faces and in its corners: what lies there no other states surround.
    fn edges(&mut self, floor: f64) -> Result<(), BackendError> {
        let n = self.plan.system.states;
        let bounds = self.aim.bounds.clone();
        let mut states: Vec<Vec<f64>> = (0..1usize << n)
            .map(|corner| (0..n).map(|i| bounds[i][corner >> i & 1]).collect())
            .collect();
        for face in 0..2 * n {
            let mut side = bounds.clone();
            side[face / 2] = [bounds[face / 2][face % 2]; 2];
            states.extend(spread_over(&side, FIRST[n] / (2 * n)));
        }
        self.first[1] += states.len();
        if self.seconds_left(1.0) > 0.0 {
            states.truncate(self.states_left(1.0));
        } else {
            states.clear();
        }
        self.first[0] += states.len();
        let mut z = vec![0.0; n];
        let mut guesses = Vec::new();
        for x in states {
            self.frame.of(&x, &mut z);
            let Some(from) = self.nearest(&z) else { return Ok(()) };
            let shift = &self.origins[from as usize].1;
            let x = x.iter().zip(shift).map(|(x, s)| x - s).collect();
            guesses.push((x, self.guess(from), self.cloud.sheet[from as usize]));
        }
        let sheets: Vec<i32> = guesses.iter().map(|(.., sheet)| *sheet).collect();
        let guesses = guesses.into_iter().map(|(x, path, _)| (x, path)).collect();
        let found = solve_near(self.plan, self.solver, guesses, PATIENT_STEP)?;
        let most = self.most_value();
        let tracks: Vec<Track> = (found.into_iter().zip(sheets))
            .filter_map(|(found, sheet)| {
                let (path, value) = found.filter(|(_, value)| *value <= most)?;
                Some(Track {
                    path,
                    value,
                    sheet,
                    whole: true,
                })
            })
            .collect();
        self.states += tracks.len();
        self.add(tracks, floor)
    }

    /// Solves for states (absolute) with a search for all sheets; the tracks of the answers, and V. Of other sheets that may
    /// be the lowest within `half` of a state (in the frame's coordinates) the state itself. V is NaN where there is none.
    fn searched(&mut self, states: Vec<f64>, half: f64) -> Result<(Vec<Track>, Vec<f64>), BackendError> {
        let half = vec![half; self.cloud.variables];
        let mut given = vec![f64::NAN; states.len() / self.cloud.variables];
        let mut tracks = Vec::new();
        for (numbers, answers) in self.solve(states, self.axis.is_some())? {
            let (values, mut found, others) = self.taken(&answers, &half);
            if let Some(axis) = &mut self.axis {
                found = axis.unfolded(found, &others)?;
            }
            tracks.extend(found);
            for (number, target) in numbers.into_iter().zip(&answers.targets.of_given) {
                given[number] = values[*target];
            }
        }
        Ok((tracks, given))
    }

    /// V at each target, and tracks, with whether each is of another sheet than the lowest.
    fn taken(&mut self, answers: &Answers, half: &[f64]) -> (Vec<f64>, Vec<Track>, Vec<bool>) {
        let mut values = vec![f64::NAN; answers.targets.len()];
        let (mut tracks, mut dearer) = (Vec::new(), Vec::new());
        for target in 0..answers.targets.len() {
            self.cloud.several |= answers.of(target).len() > 1;
            let answer = answers.answer(target).filter(|a| a.value <= self.most_value());
            let Some(answer) = answer else {
                self.failed += 1;
                continue;
            };
            self.states += 1;
            values[target] = answer.value;
            let others = answers
                .of(target)
                .iter()
                .filter(|e| !self.plan.game && e.value > answer.value);
            let near = others.filter(|e| self.may_cross((&answer.path, answer.value), (&e.path, e.value), half));
            let near: Vec<Track> = near.map(|e| Track::of(e, false)).collect();
            tracks.push(Track::of(answer, true));
            tracks.extend(near);
            dearer.push(false);
            dearer.resize(tracks.len(), true);
        }
        (values, tracks, dearer)
    }

    /// Whether extremals are followed backward beyond the states they were solved for: where sheets lie over each other what
    /// comes before an answer need not be one.
    fn goes_beyond(&self) -> bool {
        !self.plan.game && self.plan.local.is_some() && !self.cloud.several
    }

    /// Adds tracks and their points.
    fn add(&mut self, tracks: Vec<Track>, floor: f64) -> Result<(), BackendError> {
        let wish = self.wish(floor);
        let first = self.tracks.len() as u32;
        let found = track_points(self.plan, self.solver, &tracks, first, &self.in_any_period(&wish))?;
        self.keep(tracks, found, (&wish.bounds, &wish.around));
        Ok(())
    }

    /// Of a state with a period any number of periods away will do.
    fn in_any_period(&self, wish: &Wish) -> Wish {
        let wide = |bounds: &[[f64; 2]]| -> Vec<[f64; 2]> {
            let each = bounds.iter().zip(&self.plan.periods);
            each.map(|(b, period)| period.map_or(*b, |_| [f64::NEG_INFINITY, f64::INFINITY]))
                .collect()
        };
        Wish {
            bounds: wide(&wish.bounds),
            around: wide(&wish.around),
            ..wish.clone()
        }
    }

    /// Points at the end of the horizon, where V is the terminal cost, at states (with a time or without).
    fn add_ends(&mut self, states: &[Vec<f64>]) {
        let Some(axis) = &self.axis else { return };
        let n = self.plan.system.states;
        let reference = &self.plan.system.reference;
        let mut found = TrackPoints {
            states: n,
            ..TrackPoints::default()
        };
        let mut tracks = Vec::new();
        let bounds = vec![[f64::NEG_INFINITY, f64::INFINITY]; n];
        for x in states {
            let s: Vec<f64> = x.iter().zip(reference).map(|(x, r)| x - r).collect();
            let (node, value) = axis.at_end(&s);
            if value > self.most_value() || !value.is_finite() {
                continue;
            }
            found.push(&node, value, (self.tracks.len() + tracks.len()) as u32, 0.0);
            tracks.push(Track {
                path: Path::new(&node),
                value,
                sheet: 0,
                whole: false,
            });
        }
        self.keep(tracks, found, (&bounds, &bounds));
    }

    /// Keeps tracks with their points: within bounds, and of those around the region as points of the cloud.
    fn keep(&mut self, tracks: Vec<Track>, found: TrackPoints, (bounds, around): (&[[f64; 2]], &[[f64; 2]])) {
        let n = self.plan.system.states;
        if let Some(axis) = &self.axis {
            self.rates.extend(axis.rates(&found.nodes, 2 * n));
        }
        self.of_track.resize(self.tracks.len() + tracks.len(), Vec::new());
        self.tracks.extend(tracks);
        for k in 0..found.len() {
            let track = found.track[k];
            let number = self.points.len() as u32 + k as u32;
            self.of_track[track as usize].push(number);
            let node = found.node(k);
            for mut shift in self.shifts(&node[..n], bounds) {
                let near = |i: usize| (around[i][0]..=around[i][1]).contains(&(node[i] + shift[i]));
                if !(0..n).all(near) {
                    continue;
                }
                let Track { path, sheet, .. } = &self.tracks[track as usize];
                let x = self.state_of(&found, k, path, &shift);
                let mut p = node[n..].to_vec();
                if self.axis.is_some() {
                    p.push(self.rates[number as usize]);
                    shift.push(0.0);
                }
                self.cloud.add(&self.frame, (&x, &p), found.v[k], (track, *sheet));
                self.origins.push((number, shift));
            }
        }
        self.points.nodes.extend(found.nodes);
        self.points.v.extend(found.v);
        self.points.track.extend(found.track);
        self.points.t.extend(found.t);
    }

    /// State (absolute, moved by whole periods) of a point on a path, with its time where that is an axis.
    fn state_of(&self, points: &TrackPoints, k: usize, path: &Path, shift: &[f64]) -> Vec<f64> {
        let node = points.node(k).iter().zip(shift).zip(&self.plan.system.reference);
        node.map(|((s, shift), r)| s + shift + r)
            .chain(self.axis.as_ref().map(|axis| axis.begins(path) + points.t[k]))
            .collect()
    }

    /// State (as solved, absolute) and gradient of a point, with its time and dV/dt where time is an axis.
    fn coordinates(&self, point: usize) -> (Vec<f64>, Vec<f64>) {
        let path = &self.tracks[self.points.track[point] as usize].path;
        let x = self.state_of(&self.points, point, path, &[0.0; MOST_VARIABLES]);
        let mut p = self.points.node(point)[self.plan.system.states..].to_vec();
        p.extend(self.axis.as_ref().map(|_| self.rates[point]));
        (x, p)
    }

    /// All whole periods by which a state (deviation) comes into bounds.
    fn shifts(&self, s: &[f64], bounds: &[[f64; 2]]) -> Vec<Vec<f64>> {
        let mut all = vec![vec![0.0; s.len()]];
        for (i, period) in self.plan.periods.iter().enumerate() {
            let Some(period) = period else { continue };
            let [lo, hi] = bounds[i];
            let (first, last) = (
                ((lo - s[i]) / period).ceil() as i32,
                ((hi - s[i]) / period).floor() as i32,
            );
            all = (all.iter())
                .flat_map(|base| {
                    (first..=last).map(|k| {
                        let mut shift = base.clone();
                        shift[i] = f64::from(k) * period;
                        shift
                    })
                })
                .collect();
        }
        all
    }

    /// Builds pieces, and solves for states where they are not good enough, until they are.
    fn refined(&mut self, region: &Region, more: Vec<Want>) -> Result<Pieces, BackendError> {
        let mut more = Some(more).filter(|m| !m.is_empty());
        let mut before: Option<(Pieces, usize)> = None;
        let mut last: Option<(Instant, usize)> = None;
        let mut closing = false;
        loop {
            if self.states < SETTLED && self.turn(region) {
                before = None;
            }
            let old = before.as_ref().map(|(pieces, points)| Before {
                pieces,
                points: *points,
                apart: Vec::new(),
            });
            let (pieces, wants) = build(&self.cloud, region, &self.frame, old);
            let asked: Vec<Want> = (more.take().into_iter().flatten().chain(wants.iter().cloned()))
                .filter(|w| self.failures.get(&key(w)).is_none_or(|f| *f < MOST_FAILURES))
                .collect();
            if asked.is_empty() || self.is_spent(1.0) || (closing && self.is_spent(ALL_BUT)) {
                return Ok(pieces);
            }
            // The last states are first for the holes that the rounds before have left between their new cells, and for cells
            // of which nothing would be said.
            closing = self.is_spent(BEFORE_CLOSING);
            let asked = match closing.then(|| holes(&asked, self.aim.error_max / self.aim.error)) {
                Some(holes) if !holes.is_empty() => holes,
                _ => asked,
            };
            let (solved, clock) = (self.states + self.failed, Instant::now());
            if let Some((began, first)) = last {
                self.pace = (clock - began).as_secs_f64() / (solved - first).max(1) as f64;
            }
            last = Some((clock, solved));
            self.rounds += 1;
            let known = self.cloud.len();
            let share = if closing { 1.0 } else { BEFORE_CLOSING };
            if !self.answer(asked, region, share)? {
                return Ok(pieces);
            }
            let said = format!("in {} cells", pieces.cells.len());
            (self.progress)(&said, self.states, self.states + wants.len());
            before = Some((pieces, known));
        }
    }

    /// Turns the frame to where V is steep, relative to itself, if that is in one direction; whether it was turned.
    fn turn(&mut self, region: &Region) -> bool {
        let places = self.steep_places(region, None);
        let Some(frame) = Frame::fitted(region, &places) else {
            return false;
        };
        if frame.across(region, &places) > BETTER * self.frame.across(region, &places) {
            return false;
        }
        self.frame = frame;
        let n = self.cloud.variables;
        for k in 0..self.origins.len() {
            let (point, shift) = &self.origins[k];
            let (mut x, p) = self.coordinates(*point as usize);
            x.iter_mut().zip(shift).for_each(|(x, s)| *x += s);
            let z = &mut self.cloud.z[k * n..][..n];
            self.frame.of(&x, z);
            self.frame.gradient_of(z, &p, &mut self.cloud.q[k * n..][..n]);
        }
        true
    }

    /// Points in the region, but not in a part of it, with V's slopes relative to itself; all parts weigh the same.
    fn steep_places(&self, region: &Region, without: Option<&Region>) -> Vec<Steep> {
        let n = self.cloud.variables;
        let a_side = if n <= 4 { 8.0 } else { 4.0 };
        let mut counts: HashMap<Vec<u8>, f64> = HashMap::new();
        let mut places = Vec::new();
        let mut boxes = Vec::new();
        for k in 0..self.points.len() {
            let (x, p) = self.coordinates(k);
            let t: Vec<f64> = (0..n).map(|i| (x[i] - region.lo[i]) / region.width(i)).collect();
            if !t.iter().all(|t| (0.0..=1.0).contains(t)) || without.is_some_and(|part| part.covers(&x)) {
                continue;
            }
            let part: Vec<u8> = t.iter().map(|t| (t * a_side) as u8).collect();
            *counts.entry(part.clone()).or_default() += 1.0;
            boxes.push(part);
            let size = self.points.v[k].abs().max(region.floor);
            places.push(Steep {
                slope: (0..n).map(|i| p[i] * region.width(i) / size).collect(),
                t,
                weight: 0.0,
            });
        }
        for (place, part) in places.iter_mut().zip(&boxes) {
            place.weight = 1.0 / (counts[part] * counts.len() as f64);
        }
        places
    }

    /// Solves for states in cells that want some, with a share of the budget; false where there is nothing to start from.
    fn answer(&mut self, mut wants: Vec<Want>, region: &Region, share: f64) -> Result<bool, BackendError> {
        let in_time = (self.seconds_left(share) / self.pace).max(0.0);
        let in_time = if in_time.is_nan() { usize::MAX } else { in_time as usize };
        let growth = if self.cloud.leaves_quarters() {
            GROWTH_BY_QUARTERS
        } else {
            GROWTH
        };
        let budget = self
            .states_left(share)
            .min((growth * self.states as f64) as usize)
            .min(in_time)
            .max(1);
        wants.sort_by(|a, b| b.excess.total_cmp(&a.excess));
        let mut errands = Vec::new();
        // One for each in turn, the worst first: many in few cells at once would halve these where their points lie alone.
        let quota = |w: &Want| (A_CELL * w.excess.max(1.0).powf(MORE)).min(MOST_A_CELL) as usize;
        for turn in 0..MOST_A_CELL as usize {
            for want in wants.iter().filter(|w| turn < quota(w)) {
                if errands.len() >= budget {
                    break;
                }
                self.errand(want, turn, region, &mut errands);
            }
        }
        if errands.is_empty() {
            return Ok(false);
        }
        let ends: Vec<Vec<f64>> = (errands.iter().filter(|e| self.is_at_end(&e.x)))
            .map(|e| e.x.clone())
            .collect();
        errands.retain(|e| !self.is_at_end(&e.x));
        self.add_ends(&ends);
        // Where sheets lie over each other a way from a point near tells nothing of the others.
        if self.cloud.several {
            let mut states = Vec::new();
            let mut widest = 0.0f64;
            for errand in &errands {
                let shift = &self.origins[errand.from as usize].1;
                let at = states.len();
                states.extend(errand.x.iter().zip(shift).map(|(x, s)| x + s));
                if let Some(axis) = &self.axis {
                    let extent = self.extent_in_time(errand);
                    let t = states[at..].last_mut().expect("time is the last");
                    *t = axis.of_few(*t, extent);
                    if axis.is_at_end(*t) {
                        *t = errand.x[errand.x.len() - 1];
                    }
                }
                widest = errand.half.iter().fold(widest, |a, h| a.max(*h));
            }
            let (tracks, values) = self.searched(states, widest.min(NEAR))?;
            for (errand, _) in errands
                .into_iter()
                .zip(values)
                .filter(|(e, v)| e.only_bare || v.is_nan())
            {
                *self.failures.entry(errand.cell).or_default() += 1;
            }
            self.add(tracks, region.floor)?;
            return Ok(true);
        }
        let guesses: Vec<_> = errands.iter().map(|e| self.way(e)).collect();
        let found = solve_near(self.plan, self.solver, guesses, LEAST_STEP)?;
        let mut tracks = Vec::new();
        let most = self.most_value();
        for (errand, found) in errands.into_iter().zip(found) {
            let found = found.filter(|(_, value)| *value <= most);
            if errand.only_bare || found.is_none() {
                *self.failures.entry(errand.cell).or_default() += 1;
            }
            let Some((path, value)) = found else {
                self.failed += 1;
                continue;
            };
            self.states += 1;
            tracks.push(Track {
                path,
                value,
                sheet: self.cloud.sheet[errand.from as usize],
                whole: true,
            });
        }
        self.add(tracks, region.floor)?;
        Ok(true)
    }

    fn is_at_end(&self, x: &[f64]) -> bool {
        (self.axis.as_ref()).is_some_and(|axis| axis.is_at_end(x[x.len() - 1]))
    }

    /// How far an errand's cell reaches in time.
    fn extent_in_time(&self, errand: &Errand) -> f64 {
        let v = errand.half.len();
        let n = self.frame.inverse_row(v - 1);
        n.iter().zip(&errand.half).map(|(r, h)| (r * h).abs()).sum()
    }

    /// The state of an errand, and the path to begin with.
    fn way(&self, errand: &Errand) -> (Vec<f64>, Path) {
        let mut path = self.guess(errand.from);
        let Some(axis) = &self.axis else {
            return (errand.x.clone(), path);
        };
        let n = errand.x.len() - 1;
        path.set_horizon(axis.last - errand.x[n]);
        (errand.x[..n].to_vec(), path)
    }

    /// A place drawn from the part of a cell that lies in the region.
    fn inside(&mut self, want: &Want, region: &Region) -> Option<Vec<f64>> {
        let n = want.lo.len();
        (0..DRAWS).find_map(|_| {
            let z: Vec<f64> = (0..n)
                .map(|i| want.lo[i] + (want.hi[i] - want.lo[i]) * self.uniform())
                .collect();
            let x = self.frame.state(&z);
            region.covers(&x).then_some(z)
        })
    }

    /// Whether a solution may cost as little as the lowest one within a cell around their state.
    fn may_cross(&self, lowest: (&Path, f64), other: (&Path, f64), half: &[f64]) -> bool {
        let n = half.len();
        let mut q = [[0.0; MOST_VARIABLES]; 2];
        let reference = &self.plan.system.reference;
        let mut x: Vec<f64> = lowest.0.start().iter().zip(reference).map(|(s, r)| s + r).collect();
        x.extend(self.axis.as_ref().map(|axis| axis.begins(lowest.0)));
        let mut z = [0.0; MOST_VARIABLES];
        self.frame.of(&x, &mut z[..n]);
        for (q, path) in q.iter_mut().zip([lowest.0, other.0]) {
            let mut p = path.adjoint().to_vec();
            p.extend(self.axis.iter().flat_map(|axis| axis.rates(path.node(0), path.width)));
            self.frame.gradient_of(&z[..n], &p, &mut q[..n]);
        }
        let change: f64 = (0..n).map(|i| (q[1][i] - q[0][i]).abs() * half[i]).sum();
        other.1 - lowest.1 <= change
    }

    /// A way to a state of a cell, a bare corner or one that is drawn, from the nearest point.
    fn errand(&mut self, want: &Want, turn: usize, region: &Region, errands: &mut Vec<Errand>) {
        let n = self.cloud.variables;
        let places = want.bare.len() / n;
        let z: Vec<f64> = if turn < places {
            want.bare[((turn + self.rounds) % places) * n..][..n].to_vec()
        } else if want.excess > 1.0 {
            match self.inside(want, region) {
                Some(z) => z,
                None => {
                    *self.failures.entry(key(want)).or_default() += 1;
                    return;
                }
            }
        } else {
            return;
        };
        // In widths of the cell, and by how much V would change on the way.
        let distance = |k: u32| -> f64 {
            let (at, q) = (self.cloud.z(k as usize), self.cloud.q(k as usize));
            let (mut far, mut change) = (0.0, 0.0);
            for i in 0..n {
                far += ((z[i] - at[i]) / (want.hi[i] - want.lo[i])).powi(2);
                change += q[i] * (z[i] - at[i]);
            }
            far + (STEEP * change / self.cloud.v[k as usize].abs().max(region.floor)).powi(2)
        };
        let nearest = want
            .points
            .iter()
            .copied()
            .filter(|k| self.goes_on(*k))
            .min_by(|a, b| distance(*a).total_cmp(&distance(*b)));
        let Some(from) = nearest.or_else(|| self.nearest(&z)) else {
            return;
        };
        // As many periods away as the point that it is reached from.
        let shift = &self.origins[from as usize].1;
        errands.push(Errand {
            x: self.frame.state(&z).iter().zip(shift).map(|(x, s)| x - s).collect(),
            from,
            cell: key(want),
            half: want.lo.iter().zip(&want.hi).map(|(lo, hi)| 0.5 * (hi - lo)).collect(),
            only_bare: want.excess <= 1.0,
        });
    }

    /// The point nearest to a place, of all.
    fn nearest(&self, z: &[f64]) -> Option<u32> {
        let distance = |k: usize| -> f64 { self.cloud.z(k).iter().zip(z).map(|(a, b)| (a - b).powi(2)).sum() };
        (0..self.cloud.len())
            .filter(|k| self.goes_on(*k as u32))
            .min_by(|a, b| distance(*a).total_cmp(&distance(*b)))
            .map(|k| k as u32)
    }

    /// Whether a point's track goes on from there: one at the end of a horizon is no guess of another.
    fn goes_on(&self, k: u32) -> bool {
        let track = self.points.track[self.origins[k as usize].0 as usize];
        self.tracks[track as usize].path.segments() > 0
    }

    /// The path from a point of the cloud on.
    fn guess(&self, k: u32) -> Path {
        let (point, _) = &self.origins[k as usize];
        let number = *point as usize;
        let track = self.points.track[number] as usize;
        let t = self.points.t[number];
        let mut later: Vec<(f64, &[f64])> = (self.of_track[track].iter())
            .map(|q| (self.points.t[*q as usize], self.points.node(*q as usize)))
            .filter(|(q, _)| t < 0.0 && *q > t && *q < 0.0)
            .collect();
        later.sort_by(|a, b| a.0.total_cmp(&b.0));
        path_from(&self.tracks[track], self.points.node(number), t, &later)
    }

    /// Fresh states, solved from scratch and looked up; and what their solutions meet outside the region, with V.
    fn checked(&mut self, pieces: &Pieces) -> Result<(Vec<Checked>, Vec<Met>), BackendError> {
        let n = self.cloud.variables;
        let mut states = self.fresh(self.aim.check);
        if self.axis.is_some() {
            // Of as many times as there are, the first ones'.
            for k in CHECKED..states.len() / n {
                states[k * n + n - 1] = states[(k % CHECKED) * n + n - 1];
            }
        }
        let all = self.solve(states.clone(), false)?;
        let mut of = vec![(0, 0); states.len() / n];
        for (group, (numbers, answers)) in all.iter().enumerate() {
            for (number, target) in numbers.iter().zip(&answers.targets.of_given) {
                of[*number] = (group, *target);
            }
        }
        let met = self.met_beyond(&all, &pieces.region)?;
        let check = (states.chunks(n).zip(of))
            .map(|(x, (group, target))| {
                let answers = &all[group].1;
                let above = answers
                    .answer(target)
                    .is_some_and(|a| a.value > pieces.region.value_max);
                let status = if above {
                    PointStatus::AboveMax
                } else {
                    answers.status(target)
                };
                let solved = answers.answer(target).map_or(f64::NAN, |e| e.value);
                Checked::of(x, (status, solved), pieces.at(x).as_ref())
            })
            .collect();
        Ok((check, met))
    }

    /// More states for the cell round a fresh state.
    fn want_around(&self, pieces: &Pieces, checked: &Checked) -> Want {
        let mut z = vec![0.0; checked.x.len()];
        self.frame.of(&checked.x, &mut z);
        let cell = (pieces.cells.iter())
            .find(|c| (0..z.len()).all(|i| z[i] >= c.lo[i] && z[i] <= c.hi[i]))
            .expect("the cells fill the region");
        let more = |i: usize| 0.3 * (cell.hi[i] - cell.lo[i]);
        let near = |k: &u32| {
            let at = self.cloud.z(*k as usize);
            (0..z.len()).all(|i| at[i] >= cell.lo[i] - more(i) && at[i] <= cell.hi[i] + more(i))
        };
        Want {
            lo: cell.lo.clone(),
            hi: cell.hi.clone(),
            excess: (checked.said - checked.solved).abs() / checked.bound * 2.0,
            bare: Vec::new(),
            points: (0..self.cloud.len() as u32).filter(near).collect(),
            dense: false,
        }
    }
}

/// Cells with bare places, and those in error by more than `most` times the one asked for.
fn holes(wants: &[Want], most: f64) -> Vec<Want> {
    let bad = |w: &Want| w.excess > most;
    let some = wants.iter().filter(|w| bad(w) || !w.bare.is_empty());
    some.map(|w| Want {
        excess: if bad(w) { w.excess } else { 1.0 },
        ..w.clone()
    })
    .collect()
}

/// A cell as a key.
fn key(want: &Want) -> Vec<u64> {
    want.lo.iter().chain(&want.hi).map(|x| x.to_bits()).collect()
}
