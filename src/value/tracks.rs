//! Points along extremals: everywhere on one V and p are as exactly known as where it begins.

use super::Entry;
use super::clearance::{self, Clearance, Guards};
use super::survey::{Miss, Survey};
use super::targets::Targets;
use crate::backend::BackendError;
use crate::backend::cpu::Evaluator;
use crate::program::Program;
use crate::shooting::{Path, Solver};
use crate::sweep::Plan;

/// Points of an extremal beyond the state it was solved for.
const MOST_BEYOND: usize = 400;
/// How many times further apart points are where they are not wanted for themselves.
const SPARSER: f64 = 2.0;
/// An extremal is followed backward while H stays below this share of the terms that it is the sum
/// of.
const MOST_DRIFT: f64 = 1e-7;
/// Shortest segment of a guess, as a share of the longest of the extremal it comes from.
const SHORT: f64 = 0.3;

/// An extremal, from a state that was solved for to the end.
#[derive(Clone, Debug)]
pub struct Track {
    pub path: Path,
    pub value: f64,
    pub sheet: i32,
    /// Whether it is of use as a whole, or only the state it was solved for: of one that is not the
    /// least only that is.
    pub whole: bool,
}

impl Track {
    pub fn of(entry: &Entry, whole: bool) -> Self {
        Self {
            path: entry.path.clone(),
            value: entry.value,
            sheet: entry.sheet,
            whole,
        }
    }
}

/// Points on tracks. States are deviations, as in paths.
#[derive(Clone, Debug, Default)]
pub struct TrackPoints {
    pub states: usize,
    /// `(s, p)`, `[point][2n]`.
    pub nodes: Vec<f64>,
    pub v: Vec<f64>,
    pub track: Vec<u32>,
    /// Time after the track's beginning; negative before it.
    pub t: Vec<f64>,
    /// From there to the track's end.
    pub clearance: Vec<Clearance>,
}

impl TrackPoints {
    pub fn len(&self) -> usize {
        self.v.len()
    }

    pub fn is_empty(&self) -> bool {
        self.v.is_empty()
    }

    pub fn node(&self, k: usize) -> &[f64] {
        &self.nodes[k * 2 * self.states..][..2 * self.states]
    }

    pub fn push(&mut self, node: &[f64], v: f64, track: u32, t: f64) {
        self.nodes.extend_from_slice(node);
        self.v.push(v);
        self.track.push(track);
        self.t.push(t);
        self.clearance.push(Clearance::default());
    }

    pub fn extend(&mut self, other: Self) {
        self.nodes.extend(other.nodes);
        self.v.extend(other.v);
        self.track.extend(other.track);
        self.t.extend(other.t);
        self.clearance.extend(other.clearance);
    }

    /// Leaves out points by their numbers.
    pub fn retain(&mut self, keep: impl Fn(usize) -> bool) {
        if (0..self.len()).all(&keep) {
            return;
        }
        let all = std::mem::take(self);
        self.states = all.states;
        for k in (0..all.len()).filter(|k| keep(*k)) {
            self.push(all.node(k), all.v[k], all.track[k], all.t[k]);
            self.clearance[self.v.len() - 1] = all.clearance[k];
        }
    }
}

/// Where points are wanted, and how dense.
#[derive(Clone, Debug)]
pub struct Wish {
    /// Bounds of the states, as deviations; points outside are left out.
    pub bounds: Vec<[f64; 2]>,
    /// The part of these where points are as dense as is said here; elsewhere they are half as
    /// dense. Tracks are followed backward in this part only.
    pub around: Vec<[f64; 2]>,
    /// What distances are measured in, one a state.
    pub widths: Vec<f64>,
    /// Largest distance between neighbouring points of a track, in widths, and largest change of
    /// log V.
    pub spacing: f64,
    pub change: f64,
    /// V below which changes are not looked at.
    pub floor: f64,
    /// Points of larger V are left out.
    pub value_max: f64,
    /// Whether V does not depend on time: then all points of a track are of use, else its beginning
    /// alone.
    pub onward: bool,
    /// Of a finite horizon whose time is an axis its length, which distances in time are measured
    /// in.
    pub horizon: Option<f64>,
    /// Whether tracks are followed backward beyond where they begin.
    pub beyond: bool,
    /// Guards that cast shadows.
    pub shadows: Vec<bool>,
}

impl Wish {
    fn has(&self, s: &[f64]) -> bool {
        within(s, &self.bounds)
    }

    fn is_around(&self, s: &[f64]) -> bool {
        within(s, &self.around)
    }

    fn width(&self, i: usize) -> f64 {
        self.widths[i]
    }
}

fn within(s: &[f64], bounds: &[[f64; 2]]) -> bool {
    s.iter().zip(bounds).all(|(s, [lo, hi])| s >= lo && s <= hi)
}

/// Points of tracks, those numbered from `first` on.
///
/// # Errors
/// Device failures only.
pub fn track_points(
    plan: &Plan,
    solver: &mut Solver,
    tracks: &[Track],
    first: u32,
    wish: &Wish,
) -> Result<TrackPoints, BackendError> {
    let mut points = TrackPoints {
        states: plan.system.states,
        ..TrackPoints::default()
    };
    if wish.onward {
        onward(solver, tracks, first, wish, &mut points)?;
    } else {
        for (k, track) in tracks.iter().enumerate() {
            points.push(track.path.node(0), track.value, first + k as u32, 0.0);
        }
    }
    if wish.beyond {
        backward(plan, solver, tracks, first, wish, &mut points)?;
    }
    let outside = clearance::tell(plan, solver, (tracks, first), &wish.shadows, &mut points)?;
    points.retain(|k| !outside[k]);
    Ok(points)
}

/// From where tracks begin to their ends.
fn onward(
    solver: &mut Solver,
    tracks: &[Track],
    first: u32,
    wish: &Wish,
    points: &mut TrackPoints,
) -> Result<(), BackendError> {
    let n = points.states;
    let paths: Vec<&Path> = tracks.iter().map(|t| &t.path).collect();
    let whole = solver.ends_of(&paths, true)?;
    let mut parts = Vec::new();
    let mut places = Vec::new();
    for (k, (track, done)) in tracks.iter().zip(&whole).enumerate() {
        let Some((_, costs)) = done else { continue };
        let number = first + k as u32;
        if !track.whole {
            points.push(track.path.node(0), track.value, number, 0.0);
            continue;
        }
        // Summed from the end: what is taken from a large V leaves its rounding to a small one.
        let mut left = vec![solver.scheme.end.at(&track.path.last()[..n]).value; costs.len() + 1];
        for q in (0..costs.len()).rev() {
            left[q] = left[q + 1] + costs[q];
        }
        left[0] = track.value;
        if let Some((part, at)) = divided((track, number), &left, wish, points) {
            parts.push(part);
            places.push((number, at));
        }
    }
    let ends = solver.ends_of(&parts.iter().collect::<Vec<_>>(), true)?;
    for ((number, at), done) in places.into_iter().zip(ends) {
        let Some((nodes, costs)) = done else { continue };
        for (k, (v, t)) in at.into_iter().enumerate() {
            let (node, v) = (&nodes[k * 2 * n..][..2 * n], v - costs[k]);
            if wish.has(&node[..n]) && v <= wish.value_max {
                points.push(node, v, number, t);
            }
        }
    }
    Ok(())
}

/// Adds the nodes of a track to its points, with the V `left` at each; and gives unconnected
/// segments to the points between them, if there are any, each with V at its begin and the time of
/// its end.
fn divided(
    (track, number): (&Track, u32),
    left: &[f64],
    wish: &Wish,
    points: &mut TrackPoints,
) -> Option<(Path, Vec<(f64, f64)>)> {
    let n = points.states;
    let mut t = 0.0;
    let mut part = Path {
        width: 2 * n,
        ..Path::default()
    };
    let mut at = Vec::new();
    for (q, duration) in track.path.durations.iter().enumerate() {
        let (here, next) = (track.path.node(q), track.path.node(q + 1));
        let (v, after) = (left[q], left[q + 1]);
        if wish.has(&here[..n]) && v <= wish.value_max {
            points.push(here, v, number, t);
        }
        let time = wish.horizon.map_or(0.0, |horizon| duration / horizon);
        let way = (0..n)
            .map(|i| ((next[i] - here[i]) / wish.width(i)).powi(2))
            .chain([time * time])
            .sum::<f64>()
            .sqrt();
        let fall = (v.abs().max(wish.floor) / after.abs().max(wish.floor))
            .ln()
            .abs();
        let far = !wish.is_around(&here[..n]) && !wish.is_around(&next[..n]);
        let sparser = if far { SPARSER } else { 1.0 };
        let pieces = (way / wish.spacing).max(fall / wish.change) / sparser;
        let pieces = pieces.ceil().clamp(1.0, 64.0) as usize;
        let outside = !wish.has(&here[..n]) && !wish.has(&next[..n]);
        for r in (1..pieces).filter(|_| !outside) {
            let way = duration * r as f64 / pieces as f64;
            part.push(way, here);
            at.push((v, t + way));
        }
        t += duration;
        // What follows is the local solution's.
        if wish.horizon.is_none() && after.abs() < 1e-3 * wish.floor {
            break;
        }
    }
    if part.durations.is_empty() {
        return None;
    }
    part.nodes.extend_from_slice(track.path.last());
    Some((part, at))
}

/// A track on its way backward from its beginning.
struct Going {
    track: u32,
    node: Vec<f64>,
    v: f64,
    t: f64,
}

/// Adds points of tracks before the states that these were solved for, as long as they are exact
/// and wanted. Track k has the number `first + k`.
///
/// # Errors
/// Device failures only.
fn backward(
    plan: &Plan,
    solver: &mut Solver,
    tracks: &[Track],
    first: u32,
    wish: &Wish,
    points: &mut TrackPoints,
) -> Result<(), BackendError> {
    let backward = Backward::new(plan, wish);
    let mut going: Vec<Going> = (tracks.iter().enumerate())
        .filter(|(_, track)| track.whole)
        .map(|(k, track)| Going {
            track: first + k as u32,
            node: track.path.node(0).to_vec(),
            v: track.value,
            t: 0.0,
        })
        .collect();
    for _ in 0..MOST_BEYOND {
        going = backward.step(solver, going)?;
        backward.keep_exact(&mut going);
        if going.is_empty() {
            break;
        }
        for g in &going {
            points.push(&g.node, g.v, g.track, g.t);
        }
    }
    Ok(())
}

/// With what tracks are followed backward.
struct Backward<'b> {
    plan: &'b Plan,
    wish: &'b Wish,
    n: usize,
    /// Rates of `(s, p, V)`, and H.
    rates: Evaluator,
    guards: Option<Guards>,
}

impl<'b> Backward<'b> {
    fn new(plan: &'b Plan, wish: &'b Wish) -> Self {
        let (system, n) = (&plan.system, plan.system.states);
        let roots = [&system.rate[..=2 * n], &[system.observer.hamiltonian]].concat();
        Self {
            plan,
            wish,
            n,
            rates: Evaluator::new(&Program::lower(&system.graph, &system.inputs, &roots)),
            guards: Guards::of(plan),
        }
    }

    /// Rates and H of each, `[track][2n + 2]`.
    fn rates(&self, going: &[Going]) -> Vec<f64> {
        let nodes: Vec<f64> = going.iter().flat_map(|g| g.node.iter().copied()).collect();
        self.rates.eval(&nodes, 2 * self.n)
    }

    /// Times to the next points that are wanted.
    fn steps(&self, going: &[Going]) -> Vec<f64> {
        let (n, wish) = (self.n, self.wish);
        (going.iter().zip(self.rates(going).chunks(2 * n + 2)))
            .map(|(g, rate)| {
                let speed = (0..n)
                    .map(|i| (rate[i] / wish.width(i)).powi(2))
                    .sum::<f64>()
                    .sqrt();
                let growth = (rate[2 * n] / g.v.abs().max(wish.floor)).abs();
                (wish.spacing / speed).min(wish.change / growth)
            })
            .collect()
    }

    /// The tracks one step earlier, those that stay where points are wanted.
    fn step(&self, solver: &mut Solver, going: Vec<Going>) -> Result<Vec<Going>, BackendError> {
        let (n, wish) = (self.n, self.wish);
        let steps = self.steps(&going);
        let parts: Vec<Path> = (going.iter().zip(&steps))
            .map(|(g, step)| {
                let mut part = Path::new(&g.node);
                // The end is not known yet.
                part.push(-step, &g.node);
                part
            })
            .collect();
        let done = solver.ends_of(&parts.iter().collect::<Vec<_>>(), true)?;
        Ok((going.into_iter().zip(done).zip(&steps))
            .filter_map(|((g, done), step)| {
                let (node, costs) = done?;
                let v = g.v - costs[0];
                let inside = wish.is_around(&node[..n]) && v <= wish.value_max && step.is_finite();
                (inside && node.iter().all(|z| z.is_finite())).then_some(Going {
                    node,
                    v,
                    t: g.t - step,
                    ..g
                })
            })
            .collect())
    }

    /// Ends tracks by rounding, and where guards end what is allowed.
    fn keep_exact(&self, going: &mut Vec<Going>) {
        let n = self.n;
        let values = self.rates(going);
        let nodes: Vec<f64> = going.iter().flat_map(|g| g.node.iter().copied()).collect();
        let allowed = self.guards.as_ref().map(|g| g.margins(&nodes));
        let guards = self.plan.system.guards.len();
        let mut k = 0;
        going.retain(|g| {
            let rate = &values[k * (2 * n + 2)..][..2 * n + 2];
            let terms: f64 =
                (0..n).map(|i| (rate[i] * g.node[n + i]).abs()).sum::<f64>() + rate[2 * n].abs();
            let outside = (allowed.as_ref())
                .is_some_and(|a| a[k * guards..][..guards].iter().any(|g| *g < 0.0));
            k += 1;
            rate[2 * n + 1].abs() <= MOST_DRIFT * terms && !outside
        });
    }
}

/// The rest of a track from one of its points on, as a guess. `later` are points of the same track
/// that follow it before the track's own beginning, by time.
pub fn path_from(track: &Track, node: &[f64], t: f64, later: &[(f64, &[f64])]) -> Path {
    let mut path = Path::new(node);
    let usual = track.path.durations.iter().copied().fold(0.0, f64::max);
    let mut at = t;
    let mut push = |at: &mut f64, to: f64, node: &[f64], last: bool| {
        // What is left of a segment goes with the next if it is short.
        if to - *at > SHORT * usual || last {
            path.push(to - *at, node);
            *at = to;
        }
    };
    let own = later.iter().filter(|(t, _)| *t < 0.0);
    for (to, node) in own.filter(|(to, _)| *to > t) {
        push(&mut at, *to, node, false);
    }
    if t < 0.0 {
        push(&mut at, 0.0, track.path.node(0), false);
    }
    let mut ends = 0.0;
    for (k, duration) in track.path.durations.iter().enumerate() {
        ends += duration;
        if ends > t {
            push(
                &mut at,
                ends,
                track.path.node(k + 1),
                k + 1 == track.path.segments(),
            );
        }
    }
    path
}

/// A solution and V, or what is known where there is none.
pub type FoundNear = Result<(Path, f64), Option<Miss>>;

/// Solves for states from guesses near them; of each what was found, or why nothing was.
///
/// # Errors
/// Device failures only.
pub fn solve_near(
    plan: &Plan,
    solver: &mut Solver,
    guesses: Vec<(Vec<f64>, Path)>,
    least: f64,
) -> Result<Vec<FoundNear>, BackendError> {
    let n = plan.system.states;
    let count = guesses.len();
    // In the order given, without neighbours: each is a problem of its own.
    let targets = Targets {
        states: n,
        x: guesses
            .iter()
            .flat_map(|(x, _)| x.iter().copied())
            .collect(),
        of_given: (0..count).collect(),
        limits: vec![f64::INFINITY; count],
        gridded: vec![true; count],
        ..Targets::default()
    };
    let mut survey = Survey::new(plan, &targets, solver)?;
    let paths = guesses.into_iter().map(|(_, path)| path).collect();
    survey.solve_along(solver, paths, least)
}
