//! Many states in blocks: each is solved as if there were no others, so that what is found at a
//! state depends on its block alone, and blocks can be solved anywhere, in any order.
//!
//! [`cut`] makes them of states that lie next to each other, as what is searched for one serves the
//! next; which ones depends on all the states asked for, and on nothing else. [`Seam`] is what a
//! block tells the others, [`join`] gives sheets one number over all of them, and finds where two
//! cost the same between blocks.

mod join;
mod numbers;
mod seam;
mod solve;

pub use join::{Joined, Wanting, edges, join};
pub use seam::{BorderEntry, BorderState, Bounds, Seam, SheetOf};
pub use solve::{Blocks, Found, Keeper, NoKeeper, Sweep};

use super::PointStatus;
use super::solve::{Answers, Request};
use super::targets::{Grid, Targets, Whole};
use crate::sweep::Plan;
use std::cmp::Ordering;

/// States of a block at most. In few dimensions the search for one state serves those beside it, and
/// blocks of so many take no longer in all than one of all states; in more, states take longer, and
/// work is to be divided all the same.
const MOST: [usize; 3] = [1024, 512, 256];
/// The same of a finite horizon, whose states take ten times as long or more: what is done is kept
/// block by block.
const MOST_OF_HORIZON: [usize; 3] = [256, 128, 128];
/// The same where a device solves many at once.
const ON_DEVICE: usize = 4096;

/// Some of the targets of a request.
#[derive(Clone, Debug, PartialEq)]
pub struct Block {
    /// By rising number.
    pub members: Vec<usize>,
    /// Where it was cut off from others, in the units of the states: `[least, largest]` of each,
    /// without bounds where there are no others.
    pub within: Vec<[f64; 2]>,
}

impl Block {
    /// Where its states lie.
    fn bounds(&self, x: &[f64], states: usize) -> Bounds {
        let mut bounds = vec![[f64::INFINITY, f64::NEG_INFINITY]; states];
        for member in &self.members {
            for (bound, x) in bounds.iter_mut().zip(&x[member * states..][..states]) {
                *bound = [bound[0].min(*x), bound[1].max(*x)];
            }
        }
        bounds
    }
}

/// States of a block at most.
pub fn size(plan: &Plan, on_device: bool) -> usize {
    if on_device {
        return ON_DEVICE;
    }
    let most = match plan.system.terminal {
        Some(_) => MOST_OF_HORIZON,
        None => MOST,
    };
    most[plan.system.states.clamp(2, 4) - 2]
}

/// Cuts states into blocks of at most so many: again and again across the axis along which they lie
/// furthest apart, in widths of the region.
pub fn cut(x: &[f64], states: usize, widths: &[f64], most: usize) -> Vec<Block> {
    let all = Block {
        members: (0..x.len() / states).collect(),
        within: vec![[f64::NEG_INFINITY, f64::INFINITY]; states],
    };
    let mut done = Vec::new();
    let mut open = vec![all];
    while let Some(block) = open.pop() {
        let count = block.members.len();
        if count <= most {
            done.push(block);
            continue;
        }
        let [lower, upper] = halves(block, x, widths, most);
        open.push(upper);
        open.push(lower);
    }
    for block in &mut done {
        block.members.sort_unstable();
    }
    done
}

/// The parts of a block that is too large, of so many states that blocks come out alike.
fn halves(block: Block, x: &[f64], widths: &[f64], most: usize) -> [Block; 2] {
    let states = widths.len();
    let Block {
        mut members,
        within,
    } = block;
    let along = |member: usize, axis: usize| x[member * states + axis];
    let extent = |axis: usize| {
        let [mut lo, mut hi] = [f64::INFINITY, f64::NEG_INFINITY];
        for &m in &members {
            (lo, hi) = (lo.min(along(m, axis)), hi.max(along(m, axis)));
        }
        (hi - lo) / widths[axis]
    };
    let mut axis = 0;
    let mut furthest = f64::NEG_INFINITY;
    for i in 0..states {
        let apart = extent(i);
        if apart > furthest {
            (axis, furthest) = (i, apart);
        }
    }
    let parts = members.len().div_ceil(most);
    let middle = members.len() * (parts / 2) / parts;
    // Members are numbered in the order of their states.
    let order = |a: &usize, b: &usize| -> Ordering {
        (along(*a, axis).total_cmp(&along(*b, axis))).then(a.cmp(b))
    };
    let (_, &mut first, _) = members.select_nth_unstable_by(middle, order);
    let upper = members.split_off(middle);
    let plane = along(first, axis);
    let (mut below, mut above) = (within.clone(), within);
    below[axis][1] = plane;
    above[axis][0] = plane;
    [(members, below), (upper, above)].map(|(members, within)| Block { members, within })
}

/// What was found for each block, as one.
#[derive(Clone)]
pub struct Gathering<'g> {
    whole: &'g Whole<'g>,
    plan: &'g Plan,
    grids: &'g [Grid],
    boxes: &'g [Bounds],
    blocks: Vec<(usize, Answers)>,
    members: Vec<&'g Block>,
    seams: Vec<Seam>,
}

impl<'g> Gathering<'g> {
    pub fn new(
        whole: &'g Whole<'g>,
        plan: &'g Plan,
        (grids, boxes): (&'g [Grid], &'g [Bounds]),
    ) -> Self {
        Self {
            whole,
            plan,
            grids,
            boxes,
            blocks: Vec::new(),
            members: Vec::new(),
            seams: Vec::new(),
        }
    }

    /// Adds what was found for a block.
    pub fn add(&mut self, number: usize, block: &'g Block, answers: Answers, request: &Request) {
        let of = (self.whole, self.boxes);
        let seam = Seam::of(self.plan, (number, block), of, &answers, request);
        self.seams.push(seam);
        self.blocks.push((number, answers));
        self.members.push(block);
    }

    pub fn seams(&self) -> &[Seam] {
        &self.seams
    }

    /// The only block there is, as it was found.
    pub fn alone(mut self) -> Found {
        let (_, answers) = self.blocks.remove(0);
        Found {
            block_of: vec![0; answers.targets.of_given.len()],
            sheet_within: answers.entries.iter().map(|e| e.sheet).collect(),
            is_done: vec![!answers.stopped],
            states: vec![answers.targets.len()],
            seams: self.seams,
            answers,
        }
    }

    /// All as one.
    pub fn finish(self, joined: Joined) -> Found {
        let mut of: Vec<(usize, usize, usize)> = (self.members.iter().enumerate())
            .flat_map(|(k, block)| {
                (block.members.iter().enumerate()).map(move |(local, target)| (*target, k, local))
            })
            .collect();
        of.sort_unstable();
        let members: Vec<usize> = of.iter().map(|(target, ..)| *target).collect();
        let targets = self.whole.some(&members);
        let block_of: Vec<usize> = (targets.of_given.iter())
            .map(|t| self.blocks[of[*t].1].0)
            .collect();

        let game = self.plan.game;
        let mut all = Answers {
            game,
            targets,
            first: vec![0],
            stopped: self.blocks.iter().any(|(_, a)| a.stopped),
            searched: self.blocks.iter().map(|(_, a)| a.searched).sum(),
            evaluations: self.blocks.iter().map(|(_, a)| a.evaluations).sum(),
            work: self.blocks.last().map(|(_, a)| a.work).unwrap_or_default(),
            seconds: self.blocks.iter().map(|(_, a)| a.seconds).sum(),
            ..Answers::default()
        };
        all.cut = (of.iter())
            .map(|(_, k, _)| self.blocks[*k].1.stopped)
            .collect();
        let is_done: Vec<bool> = self.blocks.iter().map(|(_, a)| !a.stopped).collect();
        let states: Vec<usize> = self.members.iter().map(|b| b.members.len()).collect();
        let mut principal = Vec::new();
        let mut sheet_within = Vec::new();
        let mut blocks: Vec<Answers> = self.blocks.into_iter().map(|(_, a)| a).collect();
        let mut within: Vec<Vec<i32>> = Vec::new();
        for (k, answers) in blocks.iter_mut().enumerate() {
            within.push(answers.entries.iter().map(|e| e.sheet).collect());
            for entry in &mut answers.entries {
                let sheet = entry.sheet as usize;
                (entry.sheet, entry.lifted) = (joined.sheet[k][sheet], joined.lifted[k][sheet]);
            }
        }
        let mut entries: Vec<std::vec::IntoIter<super::Entry>> = (blocks.iter_mut())
            .map(|a| std::mem::take(&mut a.entries).into_iter())
            .collect();
        for (target, (_, k, local)) in of.iter().enumerate() {
            let (from, to) = (blocks[*k].first[*local], blocks[*k].first[*local + 1]);
            let answers = &mut blocks[*k];
            principal.push(
                (answers.principal.as_ref())
                    .and_then(|p| p[*local])
                    .map(|e| all.entries.len() + e - from),
            );
            // Each block's states come in their order.
            let here = entries[*k].by_ref().take(to - from);
            all.entries
                .extend(here.map(|entry| super::Entry { target, ..entry }));
            sheet_within.extend_from_slice(&within[*k][from..to]);
            all.first.push(all.entries.len());
            all.misses.push(answers.misses[*local].take());
            all.support.push(answers.support[*local]);
        }
        let has_principal = blocks.iter().any(|a| a.principal.is_some());
        all.principal = has_principal.then_some(principal);
        (all.equal_cost, all.folds) = edges(&self.seams, &joined, self.grids);
        (all.sheets, all.lifted) = (joined.sheets, joined.lifted_sheets);
        Found {
            answers: all,
            block_of,
            sheet_within,
            is_done,
            states,
            seams: self.seams,
        }
    }
}

impl Answers {
    /// Of states that were not come to in time: nothing.
    pub fn out_of_time(plan: &Plan, targets: Targets) -> Self {
        let count = targets.len();
        let miss = super::Miss {
            status: PointStatus::OutOfTime,
            furthest: None,
            left: f64::NAN,
            cut: None,
        };
        Self {
            game: plan.game,
            stopped: true,
            principal: (plan.game && plan.local.is_some()).then(|| vec![None; count]),
            first: vec![0; count + 1],
            misses: vec![Some(miss); count],
            support: vec![super::Support::default(); count],
            targets,
            ..Self::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::random::uniform;

    fn states(count: u64, n: u64) -> Vec<f64> {
        (0..count * n).map(|k| uniform(3, k)).collect()
    }

    /// Blocks have each state once, are about as large as each other, and keep to their bounds.
    #[test]
    fn blocks_part_all_states() {
        for (count, n) in [(1000u64, 2usize), (257, 3), (64, 1), (1, 2)] {
            let x = states(count, n as u64);
            let blocks = cut(&x, n, &vec![1.0; n], 64);
            assert_eq!(blocks.len(), (count as usize).div_ceil(64));
            let mut seen: Vec<usize> = blocks.iter().flat_map(|b| b.members.clone()).collect();
            seen.sort_unstable();
            assert_eq!(seen, (0..count as usize).collect::<Vec<_>>());
            for block in &blocks {
                assert!(block.members.len() <= 64 && block.members.is_sorted());
                assert!(2 * block.members.len() + 2 >= 64.min(count as usize));
                for m in &block.members {
                    for i in 0..n {
                        let [lo, hi] = block.within[i];
                        assert!((lo..=hi).contains(&x[m * n + i]));
                    }
                }
            }
        }
    }

    /// States that are alike along an axis are cut all the same.
    #[test]
    fn a_grid_is_cut_too() {
        let x: Vec<f64> = (0..40)
            .flat_map(|i| (0..30).flat_map(move |j| [f64::from(i), f64::from(j)]))
            .collect();
        let blocks = cut(&x, 2, &[1.0, 1.0], 100);
        assert_eq!(blocks.len(), 12);
        assert!(blocks.iter().all(|b| b.members.len() == 100));
    }
}
