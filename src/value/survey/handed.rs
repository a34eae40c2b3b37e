//! Trajectories that are optimized directly, handed on from states to their neighbours and mirror
//! images: what one state's guesses lead to all others learn of. Where there are very many extremals
//! guesses seldom lead to a cheap one.

use super::optimized::OFF;
use super::{Survey, times};
use crate::backend::BackendError;
use crate::shooting::Solver;
use crate::value::direct::{Direct, Optimized};
use crate::value::extremal::alike;
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Trajectories that are kept of a state, those that cost least, and how much dearer than the
/// cheapest they may be: what is dearer here may be the cheaper one elsewhere.
const KEPT: usize = 3;
const DEARER: f64 = 1.3;
/// Costs of trajectories that are solved from, in those of the cheapest.
const ABOVE: f64 = 1.01;
/// Share of the largest component by which costates differ where trajectories of a state are two.
const ALIKE: f64 = 0.05;
/// Share of a width within which two places are one.
const SAME_PLACE: f64 = 1e-7;

/// An image's V is less than what is known, by this share; shortest step from it, as a share of the
/// way.
const LESS: f64 = 1e-9;
const FROM_IMAGE: f64 = 1.0 / 16.0;

/// Of states their images in mirrors of the problem: state and number of the mirror.
type Images = BTreeMap<usize, Vec<(usize, usize)>>;

/// Where a trajectory comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Origin {
    /// A guess.
    Search,
    /// The trajectory of another state.
    State(usize),
    /// A mirror with this number.
    Mirror(usize),
}

/// A trajectory that was not handed on yet.
struct News {
    at: usize,
    origin: Origin,
    one: Arc<Optimized>,
}

/// What is known of states by direct optimization.
#[derive(Default)]
pub(super) struct Known {
    /// Trajectories from each state, by rising cost.
    of: BTreeMap<usize, Vec<Arc<Optimized>>>,
    news: Vec<News>,
    neighbours: Vec<Vec<usize>>,
    images: Images,
}

impl Known {
    pub fn is_empty_at(&self, target: usize) -> bool {
        self.of.get(&target).is_none_or(Vec::is_empty)
    }

    fn holds(&self, news: &News) -> bool {
        let list = self.of.get(&news.at);
        list.is_some_and(|list| list.iter().any(|one| Arc::ptr_eq(one, &news.one)))
    }
}

impl Survey<'_> {
    /// Nothing yet, of some targets.
    pub(super) fn known(&self, direct: &Direct<'_>, targets: &[usize]) -> Known {
        Known {
            neighbours: self.targets.neighbours(),
            images: self.images(direct, targets),
            ..Known::default()
        }
    }

    /// Of states their images in mirrors of the problem: state and number of the mirror.
    fn images(&self, direct: &Direct<'_>, targets: &[usize]) -> Images {
        if !direct.is_mirrored() {
            return Images::new();
        }
        let key = |s: &[f64]| -> Vec<i64> {
            (s.iter().zip(&self.plan.widths))
                .map(|(s, width)| (s / (SAME_PLACE * width)).round() as i64)
                .collect()
        };
        let at: FxHashMap<Vec<i64>, usize> = (targets.iter())
            .map(|t| (key(&self.state(*t, 0)), *t))
            .collect();
        let images = |t: &usize| {
            let images = direct.images(&self.state(*t, 0)).into_iter();
            let images = images.filter_map(|(mirror, s)| Some((*at.get(&key(&s))?, mirror)));
            (*t, images.filter(|(to, _)| to != t).collect())
        };
        targets.iter().map(images).collect()
    }

    /// Solves from the images of solutions of a grid, where those cost less than what was found
    /// (single states are told of nothing); states that have a lower V now.
    pub(super) fn solve_images(
        &mut self,
        solver: &mut Solver,
        direct: &Direct<'_>,
    ) -> Result<Vec<usize>, BackendError> {
        let solved: Vec<usize> = (0..self.targets.len())
            .filter(|t| self.targets.gridded[*t] && !self.at[*t].is_empty())
            .collect();
        let images = self.images(direct, &solved);
        let mut tasks = Vec::new();
        let mut before = Vec::new();
        for (from, images) in &images {
            for &(to, mirror) in images {
                let (Some(e), known) = (self.lowest(*from), self.least_value(to)) else {
                    continue;
                };
                if self.extremals[e].value() < times(1.0 - LESS, known) {
                    let path = direct.image(&self.extremals[e].path, mirror);
                    tasks.extend(self.task_along(to, path, FROM_IMAGE));
                    before.push((to, known));
                }
            }
        }
        self.send(solver, tasks)?;
        before.retain(|(t, known)| self.least_value(*t) < *known);
        Ok(before.into_iter().map(|(t, _)| t).collect())
    }

    /// Cost of the cheapest that is known from a state, solved for or optimized.
    pub(super) fn least_known(&self, known: &Known, target: usize) -> f64 {
        let cheapest = known.of.get(&target).and_then(|list| list.first());
        let optimized = cheapest.map_or(f64::INFINITY, |one| one.cost);
        optimized.min(self.least_value(target))
    }

    /// Takes up what was found from a state, if it is among the cheapest; whether it is cheaper than
    /// what was known, if anything was.
    pub(super) fn learn(
        &self,
        known: &mut Known,
        target: usize,
        found: Vec<Optimized>,
        origin: Origin,
    ) -> bool {
        let before = self.least_known(known, target);
        for one in found {
            let least = self.least_known(known, target);
            let list = known.of.entry(target).or_default();
            let is_like = |other: &Arc<Optimized>| {
                let (a, b) = (one.path.adjoint(), other.path.adjoint());
                (one.cost - other.cost).abs() <= OFF * other.cost.abs()
                    && alike(a, b, &self.scales, ALIKE)
            };
            let is_dear = one.cost > times(DEARER, least);
            if is_dear || self.is_solved(target, &one) || list.iter().any(is_like) {
                continue;
            }
            let place = list.partition_point(|other| other.cost <= one.cost);
            if place >= KEPT {
                continue;
            }
            let one = Arc::new(one);
            list.insert(place, one.clone());
            list.truncate(KEPT);
            let most = times(DEARER, list[0].cost);
            list.retain(|other| other.cost <= most);
            known.news.push(News {
                at: target,
                origin,
                one,
            });
        }
        before.is_finite() && self.least_known(known, target) < times(1.0 - OFF, before)
    }

    /// Hands trajectories on until none is among the cheapest anywhere.
    pub(super) fn hand_on(
        &mut self,
        solver: &Solver,
        direct: &Direct<'_>,
        known: &mut Known,
    ) -> Result<(), BackendError> {
        loop {
            let mut news = std::mem::take(&mut known.news);
            news.retain(|news| known.holds(news));
            if news.is_empty() {
                return Ok(());
            }
            self.mirror(direct, &news, known);
            let mut ways: Vec<(&News, usize, Vec<f64>, f64)> = Vec::new();
            for news in &news {
                for &to in &known.neighbours[news.at] {
                    // What is handed on from an image is the image of what the original leads to.
                    let is_done = match news.origin {
                        Origin::Search => false,
                        Origin::State(from) => from == to,
                        Origin::Mirror(mirror) => (known.images.get(&to))
                            .is_some_and(|images| images.iter().any(|(_, m)| *m == mirror)),
                    };
                    if is_done || !self.targets.gridded[to] || self.is_refused(to) {
                        continue;
                    }
                    let most = self.least_known(known, to).min(self.targets.limits[to]);
                    ways.push((news, to, self.state(to, 0), most));
                    self.starts[to] += 1;
                }
            }
            let end = &solver.scheme.end;
            let found: Vec<Option<Optimized>> = (ways.par_iter())
                .map(|(news, _, s, most)| direct.handed(&news.one, s, *most, end))
                .collect();
            solver.deadline.check()?;
            for ((news, to, ..), found) in ways.into_iter().zip(found) {
                let found = found.into_iter().collect();
                self.learn(known, to, found, Origin::State(news.at));
            }
        }
    }

    /// Takes what is new to its mirror images, where they are states that are asked for.
    fn mirror(&self, direct: &Direct<'_>, news: &[News], known: &mut Known) {
        for news in news {
            if matches!(news.origin, Origin::Mirror(_)) {
                continue;
            }
            for (to, mirror) in known.images.get(&news.at).cloned().unwrap_or_default() {
                let image = direct.mirrored(&news.one, mirror);
                let image = image.into_iter().collect();
                self.learn(known, to, image, Origin::Mirror(mirror));
            }
        }
    }

    /// Of what was found by direct optimization what no solution is as cheap as.
    pub(super) fn still_unknown(&self, known: Known) -> Vec<(usize, Optimized)> {
        let mut found = Vec::new();
        for (target, list) in known.of {
            let cheapest = list.first().map_or(f64::INFINITY, |one| one.cost);
            let most = times(ABOVE, cheapest.min(self.least_value(target)));
            let new =
                (list.into_iter()).filter(|one| one.cost <= most && !self.is_solved(target, one));
            found.extend(new.map(|one| (target, Arc::unwrap_or_clone(one))));
        }
        found
    }
}
