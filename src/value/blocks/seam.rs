//! What a block tells the others: its sheets, and the solutions at states whose neighbours may be of
//! other blocks.

use super::Block;
use crate::shooting::{Path, Solved};
use crate::sweep::Plan;
use crate::value::fold::Fold;
use crate::value::nearest;
use crate::value::solve::{Answers, Entry, EqualCost, Request};
use crate::value::targets::{Grid, Whole, neighbours_at_once};
use std::collections::{BTreeMap, BTreeSet};

/// Where the states of a block lie: least and largest along each axis.
pub type Bounds = Vec<[f64; 2]>;

/// States of each sheet by which a block is compared with another one that is some periods away, and
/// most periods.
const OF_COPIES: usize = 16;
const MOST_PERIODS: f64 = 16.0;

/// A sheet of a block.
#[derive(Clone, Debug, PartialEq)]
pub struct SheetOf {
    /// Its least V, and the state there.
    pub value: f64,
    pub x: Vec<f64>,
    /// Its number where copies by whole periods count as one.
    pub lifted: i32,
}

/// A solution at a state next to other blocks.
#[derive(Clone, Debug)]
pub struct BorderEntry {
    /// Within the block.
    pub sheet: i32,
    pub winding: Vec<i32>,
    /// Only its first node where no way begins with it.
    pub path: Path,
    pub solved: Solved,
}

/// A state next to other blocks.
#[derive(Clone, Debug)]
pub struct BorderState {
    pub x: Vec<f64>,
    /// Its numbers among the states given.
    pub rows: Vec<u32>,
    /// V above which it is of no interest.
    pub limit: f64,
    /// How far its neighbours are at most, in widths of the region.
    pub reach: f64,
    /// By rising V.
    pub entries: Vec<BorderEntry>,
}

/// What a block tells the others.
#[derive(Clone, Debug)]
pub struct Seam {
    pub block: usize,
    /// Whether nothing is to be joined to it: its sheets are too many, or the search was cut short.
    pub is_closed: bool,
    pub sheets: Vec<SheetOf>,
    /// Pairs of sheets over one state, the lower one first: they are never one.
    pub apart: Vec<[i32; 2]>,
    pub border: Vec<BorderState>,
    /// Points within the block where two sheets cost the same: `between` the lowest numbers of the
    /// states given there.
    pub crossings: Vec<EqualCost>,
    /// Folds within the block.
    pub folds: Vec<Fold>,
    /// How many solutions it has.
    pub solutions: usize,
    /// Integrations of the search, and how long it took (s).
    pub evaluations: u64,
    pub seconds: f64,
}

impl Seam {
    /// Of the numbered block.
    pub(super) fn of(
        plan: &Plan,
        (number, block): (usize, &Block),
        (whole, boxes): (&Whole<'_>, &[Bounds]),
        answers: &Answers,
        request: &Request,
    ) -> Self {
        let targets = &answers.targets;
        let mut sheets: Vec<Option<SheetOf>> = vec![None; answers.sheets];
        let mut apart: BTreeSet<[i32; 2]> = BTreeSet::new();
        for target in 0..targets.len() {
            let here = answers.of(target);
            for (k, entry) in here.iter().enumerate() {
                let known = &mut sheets[entry.sheet as usize];
                // Targets come by rising state.
                if known.as_ref().is_none_or(|known| entry.value < known.value) {
                    *known = Some(SheetOf {
                        value: entry.value,
                        x: targets.state(target).to_vec(),
                        lifted: entry.lifted,
                    });
                }
                for other in &here[k + 1..] {
                    if other.winding == entry.winding && other.sheet != entry.sheet {
                        let mut pair = [entry.sheet, other.sheet];
                        pair.sort_unstable();
                        apart.insert(pair);
                    }
                }
            }
        }

        let reach = reach(plan, block, whole);
        let mut is_border = border(plan, block, (whole, &request.grids), &reach);
        for local in beside_copies(plan, (number, block), (whole, boxes), answers) {
            is_border[local] = true;
        }
        // Ways between single states are followed from the cheapest alone, where two cost the same.
        let follows = !request.one_sheet && !plan.game;
        let state = |local: usize| BorderState {
            x: targets.state(local).to_vec(),
            rows: whole.rows(block.members[local]).to_vec(),
            limit: targets.limits[local],
            reach: reach[local],
            entries: (answers.of(local).iter().enumerate())
                .map(|(k, entry)| {
                    BorderEntry::of(entry, follows && (k == 0 || targets.gridded[local]))
                })
                .collect(),
        };
        Self {
            block: number,
            is_closed: answers.is_crowded || answers.stopped,
            sheets: sheets.into_iter().flatten().collect(),
            apart: apart.into_iter().collect(),
            border: (0..targets.len())
                .filter(|local| is_border[*local] && !answers.of(*local).is_empty())
                .map(state)
                .collect(),
            crossings: (answers.equal_cost.iter())
                .map(|one| {
                    let row = |t: usize| whole.rows(block.members[t])[0] as usize;
                    let (a, b) = one.point.between;
                    let mut one = one.clone();
                    one.point.between = (row(a).min(row(b)), row(a).max(row(b)));
                    (one.point.line, one.point.place) = (-1, -1);
                    one
                })
                .collect(),
            folds: answers.folds.clone(),
            solutions: answers.entries.len(),
            evaluations: answers.evaluations,
            seconds: answers.seconds,
        }
    }
}

impl BorderEntry {
    fn of(entry: &Entry, whole: bool) -> Self {
        Self {
            sheet: entry.sheet,
            winding: entry.winding.clone(),
            path: match whole {
                true => entry.path.clone(),
                false => Path::new(entry.path.node(0)),
            },
            solved: Solved {
                value: entry.value,
                slope: entry.slope.clone(),
                fold: entry.fold,
                residual: entry.residual,
                t: 0.0,
            },
        }
    }
}

/// Whether each state of a block may have neighbours in others: of a grid it has, along an axis; of
/// single ones those nearest to it within the block are further than another block.
fn border(
    plan: &Plan,
    block: &Block,
    (whole, grids): (&Whole<'_>, &[Grid]),
    reach: &[f64],
) -> Vec<bool> {
    let (n, count) = (plan.system.states, block.members.len());
    let mut is_border = vec![false; count];
    let is_here = |row: usize| block.members.binary_search(&whole.target(row)).is_ok();
    let mut first = 0;
    for grid in grids {
        for (local, &target) in block.members.iter().enumerate() {
            let rows = whole.rows(target).iter().map(|row| *row as usize);
            let mut nodes = rows.filter(|row| (first..first + grid.len()).contains(row));
            is_border[local] |=
                nodes.any(|row| (grid.beside(row - first)).any(|other| !is_here(first + other)));
        }
        first += grid.len();
    }
    if whole.rows_on_grids() == whole.rows_in_all() {
        return is_border;
    }
    for (local, &target) in block.members.iter().enumerate() {
        let x = &whole.x()[target * n..][..n];
        is_border[local] |= (0..n).any(|i| {
            let to = |plane: f64| (x[i] - plane).abs() / plan.widths[i];
            let mut planes = block.within[i].iter().filter(|plane| plane.is_finite());
            planes.any(|plane| to(*plane) <= reach[local])
        });
    }
    is_border
}

/// How far the neighbours of each state of a block are at most, in widths of the region; infinite
/// where it has too few.
fn reach(plan: &Plan, block: &Block, whole: &Whole<'_>) -> Vec<f64> {
    let n = plan.system.states;
    let scaled: Vec<f64> = (block.members.iter())
        .flat_map(|t| {
            let x = &whole.x()[t * n..][..n];
            x.iter().zip(&plan.widths).map(|(x, w)| x / w)
        })
        .collect();
    let tree = nearest::index(&scaled, n);
    (scaled.chunks(n))
        .map(|place| {
            let near = tree.near(place, f64::INFINITY, neighbours_at_once(n));
            match near.len() < neighbours_at_once(n) {
                true => f64::INFINITY,
                false => near.last().map_or(f64::INFINITY, |(_, d)| *d),
            }
        })
        .collect()
}

/// Some states of a block that lie, some periods away, where states of another block do, or of its
/// own: by them sheets are told from their copies.
fn beside_copies(
    plan: &Plan,
    (number, block): (usize, &Block),
    (whole, boxes): (&Whole<'_>, &[Bounds]),
    answers: &Answers,
) -> BTreeSet<usize> {
    let n = plan.system.states;
    let mut found = BTreeSet::new();
    if plan.periods.iter().all(Option::is_none) {
        return found;
    }
    let own = &boxes[number];
    for other in boxes {
        for shift in shifts(plan, own, other) {
            // The middle of what both have, where this block is.
            let middle: Vec<f64> = (0..n)
                .map(|i| {
                    let [lo, hi] = [
                        own[i][0].max(other[i][0] + shift[i]),
                        own[i][1].min(other[i][1] + shift[i]),
                    ];
                    0.5 * (lo + hi)
                })
                .collect();
            let far = |local: usize| -> f64 {
                let x = &whole.x()[block.members[local] * n..][..n];
                (0..n)
                    .map(|i| ((x[i] - middle[i]) / plan.widths[i]).powi(2))
                    .sum()
            };
            let mut near: Vec<(f64, usize)> = (0..block.members.len())
                .map(|local| (far(local), local))
                .collect();
            near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            // Of each sheet, one way round, some: what lies over the middle need not be all there is.
            let mut taken: BTreeMap<(i32, &[i32]), usize> = BTreeMap::new();
            for (_, local) in near {
                for entry in answers.of(local) {
                    let count = taken.entry((entry.sheet, &entry.winding)).or_insert(0);
                    if *count < OF_COPIES {
                        *count += 1;
                        found.insert(local);
                    }
                }
            }
        }
    }
    found
}

/// Whole periods by which one box overlaps another, none left out.
fn shifts(plan: &Plan, own: &Bounds, other: &Bounds) -> Vec<Vec<f64>> {
    let mut all: Vec<Vec<f64>> = vec![Vec::new()];
    for (i, (own, other)) in own.iter().zip(other).enumerate() {
        let along: Vec<f64> = match plan.periods[i] {
            None => vec![0.0],
            Some(period) => {
                let first = ((own[0] - other[1]) / period).ceil().max(-MOST_PERIODS);
                let last = ((own[1] - other[0]) / period).floor().min(MOST_PERIODS);
                (first as i64..=last as i64)
                    .map(|k| k as f64 * period)
                    .collect()
            }
        };
        let overlaps = |shift: &f64| own[0] <= other[1] + shift && other[0] + shift <= own[1];
        let along: Vec<f64> = along.into_iter().filter(overlaps).collect();
        all = (all.iter())
            .flat_map(|begun| {
                along
                    .iter()
                    .map(|shift| [begun.as_slice(), &[*shift]].concat())
            })
            .collect();
    }
    all.retain(|shift| shift.iter().any(|s| *s != 0.0));
    all
}
