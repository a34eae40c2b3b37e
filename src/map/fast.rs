//! Values as fast as can be, for controllers.

use super::nodal::Prediction;
use super::{BEYOND, INSIDE, LOOK, LocalModel, SAME, Source, Value, ValueMap};
use crate::sweep::Sampling;

/// Nearest sites among which one of the lowest sheet is looked for first, and the distance (in
/// widths) at which none is.
const NEAREST: usize = 12;
const FAR: f64 = 0.5;
/// Sites at one place that are looked at, more than sheets are kept.
const TOGETHER: usize = 32;
/// Nearest sites among which others of its sheet are looked for, and how many are blended.
const AROUND: usize = 48;
const BLENDED: usize = 8;

impl ValueMap {
    /// V, p, Hessian and u on the lowest sheet without errors, as fast as can be: what a controller
    /// asks for. Where only one sheet is near, the local model of the nearest site is the answer, or
    /// that of a few; else as [`ValueMap::without_errors`].
    pub fn local(&self, x: &[f64]) -> Option<Value> {
        self.local_at(x, 0.0)
    }

    /// The same at a time of a finite horizon; of a map of V(x, 0) that at all times.
    pub fn local_at(&self, x: &[f64], t: f64) -> Option<Value> {
        let t = self.time.map_or(0.0, |last| t.clamp(0.0, last));
        let s: Vec<f64> = x
            .iter()
            .zip(&self.plan.system.reference)
            .map(|(x, r)| x - r)
            .collect();
        if let Some(value) = self.near_equilibrium(&s) {
            return Some(value);
        }
        if let Some(at) = self.in_pieces(x, t) {
            return at.lowest.ok();
        }
        if t > 0.0 {
            return None;
        }
        let z: Vec<f64> = s
            .iter()
            .zip(&self.plan.widths)
            .map(|(s, w)| s / w)
            .collect();
        match self.uncontested(&s, &z) {
            Some(value) => Some(value).filter(|value| self.solves_isaacs(&s, &value.p)),
            None => self.without_errors(x).lowest.ok(),
        }
    }

    /// What the nearest sites of the lowest sheet say, where no other sheet is as low around them.
    fn uncontested(&self, s: &[f64], z: &[f64]) -> Option<Value> {
        let mut best: Option<Value> = None;
        for (w, winding) in self.windings.iter().enumerate() {
            let place: Vec<f64> = (0..z.len()).map(|i| z[i] + self.turn(winding, i)).collect();
            let near = self.tree.near(&place, f64::INFINITY, NEAREST);
            if near.first().is_none_or(|(_, distance)| *distance > FAR) {
                continue;
            }
            let Some(&(site, distance)) = near.iter().find(|(site, _)| !self.is_dominated(*site))
            else {
                // All of another sheet, or none is left to ask.
                continue;
            };
            let reach = self.nodal(site, None)?.reach;
            if distance > BEYOND * reach {
                continue;
            }
            if self.is_contested(site) {
                return None;
            }
            let local_model = self.local_model(&place, w, site, distance, None)?;
            let value = if distance > INSIDE * reach {
                let local_models = self.of_its_sheet(&place, local_model);
                if local_models.len() == 1 {
                    // A single site, so far away, says nothing: see `blended`.
                    continue;
                }
                let members: Vec<usize> = (0..local_models.len()).collect();
                self.blended(s, &local_models, &members)?
            } else if self.is_implausible(&local_model.prediction) {
                return None;
            } else {
                let prediction = local_model.prediction.clone();
                self.value(s, &local_model, prediction)
            };
            if best.as_ref().is_none_or(|b| value.v < b.v) {
                best = Some(value);
            }
        }
        best
    }

    /// The local model of the site nearest to a place, with those of sites about it that agree.
    fn of_its_sheet(&self, place: &[f64], nearest: LocalModel) -> Vec<LocalModel> {
        let (first, winding) = (nearest.site, nearest.winding);
        let near = self.tree.near(place, f64::INFINITY, AROUND);
        let mut local_models = vec![nearest];
        for (site, distance) in near {
            if site == first || !self.sites.consistent(first, site) {
                continue;
            }
            let one = self.local_model(place, winding, site, distance, None);
            local_models.extend(one.filter(|one| self.agree(&local_models[0], one)));
            if local_models.len() == BLENDED {
                break;
            }
        }
        local_models
    }

    /// Where the running cost is nowhere negative nor is V.
    pub(super) fn is_implausible(&self, prediction: &Prediction) -> bool {
        self.plan.sampling == Sampling::Value && prediction.v < 0.0
    }

    /// Whether another sheet is cheaper where a site is, by more than interpolation errs.
    fn is_dominated(&self, site: usize) -> bool {
        const MARGIN: f64 = 0.02;
        *self.dominated[site].get_or_init(|| {
            let v = self.sites.v[site];
            // A solved state's solutions are all known.
            if self.sites.source[site] == Source::Solved {
                let here = self.tree.near(self.sites.z(site), SAME, TOGETHER);
                let mut values = (here.iter())
                    .filter(|(k, _)| self.sites.source[*k] == Source::Solved)
                    .map(|(k, _)| self.sites.v[*k]);
                return values.any(|here| here < v - MARGIN * v.abs());
            }
            let w = &self.plan.widths;
            let x: Vec<f64> = (self
                .sites
                .z(site)
                .iter()
                .zip(w)
                .zip(&self.plan.system.reference))
            .map(|((z, w), r)| z * w + r)
            .collect();
            (self.ranked(&x, 0.0).lowest).is_ok_and(|here| here.v < v - MARGIN * v.abs())
        })
    }

    /// Whether sites of another sheet that may be the lowest lie around one.
    fn is_contested(&self, site: usize) -> bool {
        *self.contested[site].get_or_init(|| {
            let near = self
                .tree
                .near(self.sites.z(site), f64::INFINITY, LOOK * (self.sites.n + 1));
            near.iter()
                .any(|(k, _)| !self.sites.consistent(site, *k) && !self.is_dominated(*k))
        })
    }
}
