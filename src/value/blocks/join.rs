//! Sheets of blocks that are one, and where two sheets cost the same between blocks.

use super::{Seam, SheetOf};
use crate::backend::BackendError;
use crate::model::Model;
use crate::shooting::Solver;
use crate::sweep::Plan;
use crate::value::approach::{Approach, follow};
use crate::value::equal_cost::{BoundaryPoint, along_lines};
use crate::value::extremal::{Extremal, misfit, same};
use crate::value::fold::Fold;
use crate::value::nearest;
use crate::value::solve::{EqualCost, Request, value_max, with_controls};
use crate::value::survey::{Sheets, Survey, Wanted};
use crate::value::targets::{Grid, Targets, compare, neighbours_at_once};
use rustc_hash::{FxHashMap, FxHashSet};
use std::collections::BTreeMap;

/// Ways that are followed between two parts of sheets, one after the other.
const WAYS: usize = 3;
/// Shortest steps of a way, as a share of it.
const LEAST: f64 = 1.0 / 32.0;

/// What is asked for beyond the states.
#[derive(Clone, Copy, Debug)]
pub struct Wanting {
    wanted: Wanted,
    /// Whether it is looked for where two sheets cost the same.
    equal_cost: bool,
}

impl Wanting {
    pub fn of(plan: &Plan, model: &Model, request: &Request) -> Self {
        Self {
            wanted: Wanted {
                value_max: value_max(plan, model, request),
                sheets: !request.one_sheet,
            },
            equal_cost: !request.one_sheet && !plan.game,
        }
    }

    /// The same without what takes time.
    pub fn in_no_time(self) -> Self {
        Self {
            wanted: Wanted {
                sheets: false,
                ..self.wanted
            },
            equal_cost: false,
        }
    }
}

/// Numbers of sheets over all blocks, and what lies between these.
#[derive(Clone, Debug, Default)]
pub struct Joined {
    /// Of each sheet of each block (in the order of the seams) its number over all; and where
    /// copies by whole periods count as one.
    pub sheet: Vec<Vec<i32>>,
    pub lifted: Vec<Vec<i32>>,
    /// How many there are.
    pub sheets: usize,
    pub lifted_sheets: usize,
    /// Points between blocks where two sheets cost the same; `between` are the lowest numbers of
    /// the states given there.
    pub crossings: Vec<EqualCost>,
}

/// Gives the sheets of blocks one number over all: by rising least V.
///
/// # Errors
/// Device failures only.
pub fn join(
    plan: &Plan,
    solver: &mut Solver,
    seams: &[Seam],
    grids: &[Grid],
    wanting: Wanting,
) -> Result<Joined, BackendError> {
    let border = Border::new(plan, seams, grids);
    let mut survey = Survey::new(plan, &border.targets, solver)?;
    let parts = Parts::new(seams, &mut survey, &border);
    join_what_fits(&mut survey);
    if wanting.wanted.sheets && !plan.game {
        follow_ways(&mut survey, solver, wanting.wanted)?;
    }
    let mut joined = parts.number(seams, &mut survey, &border.reach);
    if wanting.equal_cost {
        let (mut points, more) = survey.crossings(solver, wanting.wanted)?;
        if more {
            joined = parts.number(seams, &mut survey, &border.reach);
            points = survey.crossings(solver, wanting.wanted)?.0;
        }
        for point in &mut points {
            let (a, b) = point.between;
            let (a, b) = (border.row[a], border.row[b]);
            point.between = (a.min(b), a.max(b));
        }
        joined.crossings = with_controls(plan, points);
    }
    Ok(joined)
}

/// The states next to other blocks, by rising state.
struct Border {
    targets: Targets,
    /// Seam and place in it of each.
    of: Vec<(usize, usize)>,
    /// Its lowest number among the states given.
    row: Vec<usize>,
    /// How far its neighbours are at most.
    reach: Vec<f64>,
}

impl Border {
    fn new(plan: &Plan, seams: &[Seam], grids: &[Grid]) -> Self {
        let n = plan.system.states;
        let mut of: Vec<(usize, usize)> = (seams.iter().enumerate())
            .filter(|(_, seam)| !seam.is_closed)
            .flat_map(|(k, seam)| (0..seam.border.len()).map(move |place| (k, place)))
            .collect();
        let state = |(k, place): (usize, usize)| &seams[k].border[place];
        of.sort_by(|a, b| compare(&state(*a).x, &state(*b).x));
        let gridded: usize = grids.iter().map(Grid::len).sum();
        let all = || of.iter().map(|one| state(*one));
        let mut targets = Targets {
            states: n,
            x: all().flat_map(|s| s.x.iter().copied()).collect(),
            limits: all().map(|s| s.limit).collect(),
            gridded: all()
                .map(|s| s.rows.iter().any(|row| (*row as usize) < gridded))
                .collect(),
            ..Targets::default()
        };
        let at: FxHashMap<usize, usize> = (all().enumerate())
            .flat_map(|(t, s)| s.rows.iter().map(move |row| (*row as usize, t)))
            .collect();
        let mut first = 0;
        let mut edges: Vec<(usize, usize)> = Vec::new();
        for grid in grids {
            for (&row, &a) in &at {
                if (first..first + grid.len()).contains(&row) {
                    let others = grid.edges_from(row - first);
                    edges.extend(others.filter_map(|(_, k)| Some((a, *at.get(&(first + k))?))));
                }
            }
            first += grid.len();
        }
        let single: Vec<usize> = (0..of.len()).filter(|t| !targets.gridded[*t]).collect();
        if !single.is_empty() {
            let scaled = targets.scaled(&plan.widths);
            let tree = nearest::index(&scaled, n);
            for &a in &single {
                let place = &scaled[a * n..][..n];
                let near = tree.near(place, f64::INFINITY, neighbours_at_once(n));
                edges.extend(near.iter().map(|(b, _)| (a, *b)));
            }
        }
        targets.edges = (edges.into_iter())
            .map(|(a, b)| (a.min(b), a.max(b)))
            .filter(|(a, b)| of[*a].0 != of[*b].0)
            .collect();
        targets.edges.sort_unstable();
        targets.edges.dedup();
        let row = all().map(|s| s.rows[0] as usize).collect();
        let reach = all().map(|s| s.reach).collect();
        Self {
            targets,
            of,
            row,
            reach,
        }
    }
}

/// The sheets of all blocks, of which some are one.
struct Parts {
    /// An extremal of each sheet of each seam, if it is next to others.
    member: Vec<Vec<Option<usize>>>,
}

impl Parts {
    /// Puts the border's solutions into a survey.
    fn new(seams: &[Seam], survey: &mut Survey<'_>, border: &Border) -> Self {
        let mut member: Vec<Vec<Option<usize>>> =
            seams.iter().map(|s| vec![None; s.sheets.len()]).collect();
        survey.windings = vec![vec![0; survey.targets.states]];
        for (target, &(k, place)) in border.of.iter().enumerate() {
            for entry in &seams[k].border[place].entries {
                let turns: Vec<i32> = (entry.winding.iter().enumerate())
                    .map(|(i, w)| w - survey.base(target, i))
                    .collect();
                let winding = survey.winding(&turns);
                let index = survey.extremals.len();
                let extremal = Extremal {
                    target,
                    winding,
                    path: entry.path.clone(),
                    solved: entry.solved.clone(),
                    iterations: 0,
                };
                survey.joined.push(index, &extremal);
                survey.at[target].push(index);
                survey.extremals.push(extremal);
                match &mut member[k][entry.sheet as usize] {
                    Some(first) => survey.joined.unite(*first, index),
                    none => *none = Some(index),
                }
            }
        }
        // Sheets over one state of a block are two, wherever that is.
        let mut place = usize::MAX;
        for (seam, member) in seams.iter().zip(&member) {
            for [a, b] in &seam.apart {
                if let (Some(a), Some(b)) = (member[*a as usize], member[*b as usize]) {
                    survey.joined.part(a, b, place);
                    place -= 1;
                }
            }
        }
        Self { member }
    }

    /// Numbers all sheets, by rising least V.
    fn number(&self, seams: &[Seam], survey: &mut Survey<'_>, reach: &[f64]) -> Joined {
        let mut groups = survey.joined.clone();
        let key_of = |groups: &mut Sheets, k: usize, s: usize| match self.member[k][s] {
            Some(e) => Part::Joined(groups.root(e)),
            None => Part::Alone(seams[k].block, s as i32),
        };
        let keys: Vec<Vec<Part>> = (seams.iter().enumerate())
            .map(|(k, seam)| {
                (0..seam.sheets.len())
                    .map(|s| key_of(&mut groups, k, s))
                    .collect()
            })
            .collect();
        let (sheet, sheets, number) = numbers(seams, &keys);
        survey.sheet = (0..survey.extremals.len())
            .map(|e| number[&Part::Joined(groups.root(e))])
            .collect();

        // The same with the copies that each block knows of.
        let mut groups = survey.joined.clone();
        let mut of_copies: BTreeMap<(usize, i32), usize> = BTreeMap::new();
        for (k, seam) in seams.iter().enumerate() {
            for (s, sheet) in seam.sheets.iter().enumerate() {
                if let Some(e) = self.member[k][s] {
                    let first = *of_copies.entry((k, sheet.lifted)).or_insert(e);
                    groups.unite(first, e);
                }
            }
        }
        let mut groups = match survey.plan.periods.iter().any(Option::is_some) {
            true => survey.with_copies(groups, reach),
            false => groups,
        };
        let mut key_of = |k: usize, lifted: i32| match of_copies.get(&(k, lifted)) {
            Some(e) => Part::Joined(groups.root(*e)),
            None => Part::Alone(seams[k].block, lifted),
        };
        let keys: Vec<Vec<Part>> = (seams.iter().enumerate())
            .map(|(k, seam)| seam.sheets.iter().map(|s| key_of(k, s.lifted)).collect())
            .collect();
        let (lifted, lifted_sheets, _) = numbers(seams, &keys);
        Joined {
            sheet,
            lifted,
            sheets,
            lifted_sheets,
            crossings: Vec::new(),
        }
    }
}

/// What is numbered: sheets of blocks that are one, or a sheet of one block (its number and the
/// sheet's) that nothing is joined to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
enum Part {
    Joined(usize),
    Alone(usize, i32),
}

/// The number of each part, by rising least V (of equal ones by the state there).
type Numbers = FxHashMap<Part, i32>;

/// Numbers of all sheets, and how many there are.
fn numbers(seams: &[Seam], keys: &[Vec<Part>]) -> (Vec<Vec<i32>>, usize, Numbers) {
    let mut least: BTreeMap<Part, &SheetOf> = BTreeMap::new();
    let compared =
        |a: &SheetOf, b: &SheetOf| (a.value.total_cmp(&b.value)).then_with(|| compare(&a.x, &b.x));
    for (seam, keys) in seams.iter().zip(keys) {
        for (sheet, key) in seam.sheets.iter().zip(keys) {
            let known = least.entry(*key).or_insert(sheet);
            if compared(sheet, known).is_lt() {
                *known = sheet;
            }
        }
    }
    let mut order: Vec<(Part, &SheetOf)> = least.into_iter().collect();
    order.sort_by(|a, b| compared(a.1, b.1));
    let number: Numbers = (order.iter().enumerate())
        .map(|(k, (part, _))| (*part, k as i32))
        .collect();
    let of = |keys: &Vec<Part>| keys.iter().map(|key| number[key]).collect();
    (keys.iter().map(of).collect(), number.len(), number)
}

/// Joins neighbours' solutions that are as a smooth sheet has them, those that fit best first.
fn join_what_fits(survey: &mut Survey<'_>) {
    let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
    for &(a, b) in &survey.targets.edges {
        for (from, to) in [(a, b), (b, a)] {
            for &e in &survey.at[from] {
                if let Some((misfit, other)) = best_fit(survey, e, to)
                    && misfit < 1.0
                {
                    pairs.push((misfit, e, other));
                }
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    for (_, e, other) in pairs {
        survey.join(e, other);
    }
}

/// The solution at a neighbour that fits best to one, and how far it is from fitting.
fn best_fit(survey: &Survey<'_>, e: usize, to: usize) -> Option<(f64, usize)> {
    let this = &survey.extremals[e];
    if !survey.same_base(this.target, to) {
        return None;
    }
    (survey.at[to].iter())
        .map(|other| (*other, &survey.extremals[*other]))
        .filter(|(_, other)| other.winding == this.winding)
        .map(|(k, other)| (misfit(this, other, &survey.scales), k))
        .min_by(|a, b| a.0.total_cmp(&b.0))
}

/// Follows solutions from states of grids to their neighbours, where none there is of their sheet:
/// what they lead to is, if it is known. A few ways between two parts, one after the other.
fn follow_ways(
    survey: &mut Survey<'_>,
    solver: &mut Solver,
    wanted: Wanted,
) -> Result<(), BackendError> {
    let mut followed: FxHashSet<(usize, usize)> = FxHashSet::default();
    for _ in 0..WAYS {
        // Of each part, to each sheet that may be its own, the way that fits best.
        let mut ways: BTreeMap<(usize, usize), (f64, usize, usize)> = BTreeMap::new();
        for &(a, b) in &survey.targets.edges {
            for (from, to) in [(a, b), (b, a)] {
                if !(survey.targets.gridded[from] && survey.targets.gridded[to]) {
                    continue;
                }
                for e in survey.at[from].clone() {
                    let root = survey.joined.root(e);
                    let has_it = |survey: &mut Survey<'_>| {
                        let there = survey.at[to].clone();
                        there.iter().any(|other| survey.joined.root(*other) == root)
                    };
                    let value = survey.extremals[e].value();
                    let is_wanted =
                        value <= survey.sheets_to(to, wanted) || survey.lowest(from) == Some(e);
                    if !is_wanted || followed.contains(&(e, to)) || has_it(survey) {
                        continue;
                    }
                    let Some((misfit, other)) = best_fit(survey, e, to) else {
                        continue;
                    };
                    let key = (root, survey.joined.root(other));
                    let way = (misfit, e, to);
                    let known = ways.entry(key).or_insert(way);
                    if misfit < known.0 {
                        *known = way;
                    }
                }
            }
        }
        if ways.is_empty() {
            return Ok(());
        }
        let ways: Vec<(usize, usize)> = ways.into_values().map(|(_, e, to)| (e, to)).collect();
        let mut approaches: Vec<Approach> = (ways.iter())
            .map(|&(e, to)| {
                let Extremal { winding, path, .. } = &survey.extremals[e];
                let goal = survey.state(to, *winding);
                Approach::from_solution(path.clone(), goal, LEAST)
            })
            .collect();
        follow(solver, &mut approaches)?;
        solver.deadline.check()?;
        for ((e, to), way) in ways.into_iter().zip(approaches) {
            followed.insert((e, to));
            let Ok((job, _)) = way.finish().1 else {
                continue;
            };
            let winding = survey.extremals[e].winding;
            let found = survey.at[to].iter().copied().find(|other| {
                let other = &survey.extremals[*other];
                other.winding == winding
                    && same(other.adjoint(), job.path.adjoint(), &survey.scales)
            });
            if let Some(other) = found {
                survey.join(e, other);
            }
        }
    }
    Ok(())
}

/// Where two sheets cost the same, within blocks and between them, with its lines over the cells of
/// grids; and the folds of all blocks.
pub fn edges(seams: &[Seam], joined: &Joined, grids: &[Grid]) -> (Vec<EqualCost>, Vec<Fold>) {
    let (mut points, mut folds) = (joined.crossings.clone(), Vec::new());
    for (seam, number) in seams.iter().zip(&joined.sheet) {
        points.extend(seam.crossings.iter().cloned().map(|mut one| {
            one.renumber(|sheet| number[sheet as usize]);
            one
        }));
        folds.extend(seam.folds.iter().cloned());
    }
    points.sort_by_key(|one| one.point.between);
    lines(&mut points, grids);
    (points, folds)
}

/// Joins points where two sheets cost the same to lines over the cells of grids. `between` of each
/// are the lowest numbers of the states given there.
fn lines(points: &mut [EqualCost], grids: &[Grid]) {
    for one in points.iter_mut() {
        (one.point.line, one.point.place) = (-1, -1);
    }
    let mut first = 0;
    let mut cells: Vec<[usize; 4]> = Vec::new();
    for (g, grid) in grids.iter().enumerate() {
        // A state of several grids has its number in the first of them.
        let lowest = |k: usize| {
            let x = grid.point(k);
            let mut before = 0;
            for other in &grids[..g] {
                if let Some(k) = other.find(&x) {
                    return before + k;
                }
                before += other.len();
            }
            first + k
        };
        let of_grid = (0..grid.len()).filter_map(|k| grid.cell_from(k));
        cells.extend(of_grid.map(|cell| cell.map(lowest)));
        first += grid.len();
    }
    let mut only: Vec<BoundaryPoint> = points.iter().map(|p| p.point.clone()).collect();
    along_lines(&mut only, &cells);
    for (point, numbered) in points.iter_mut().zip(only) {
        point.point = numbered;
    }
}
