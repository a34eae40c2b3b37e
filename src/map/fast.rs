//! Values as fast as can be, for controllers.

use super::nodal::Prediction;
use super::{BEYOND, INSIDE, LOOK, LocalModel, Value, ValueMap};
use crate::sweep::Sampling;

/// Nearest sites among which one of the lowest sheet is looked for first, and the distance (in
/// widths) at which none is.
const NEAREST: usize = 12;
const FAR: f64 = 0.5;

impl ValueMap {
    /// V, p, Hessian and u on the lowest sheet without errors, as fast as can be: what a controller
    /// asks for. Where only one sheet is near, the local model of the nearest site is the answer;
    /// else as [`ValueMap::without_errors`].
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
        match self.uncontested(&z) {
            Some(local_model) => {
                let prediction = local_model.prediction.clone();
                Some(self.value(&s, &local_model, prediction))
                    .filter(|value| self.solves_isaacs(&s, &value.p))
            }
            None => self.without_errors(x).lowest.ok(),
        }
    }

    /// The local model of the nearest site on the lowest sheet, where no other sheet is as low
    /// around it.
    fn uncontested(&self, z: &[f64]) -> Option<LocalModel> {
        let mut best: Option<LocalModel> = None;
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
            if distance > INSIDE * reach || self.is_contested(site) {
                return None;
            }
            let local_model = self.local_model(&place, w, site, distance, None)?;
            if self.is_implausible(&local_model.prediction) {
                return None;
            }
            if best
                .as_ref()
                .is_none_or(|b| local_model.prediction.v < b.prediction.v)
            {
                best = Some(local_model);
            }
        }
        best
    }

    /// Where the running cost is nowhere negative nor is V.
    pub(super) fn is_implausible(&self, prediction: &Prediction) -> bool {
        self.plan.sampling == Sampling::Value && prediction.v < 0.0
    }

    /// Whether another sheet is cheaper where a site is, by more than interpolation errs.
    fn is_dominated(&self, site: usize) -> bool {
        const MARGIN: f64 = 0.02;
        *self.dominated[site].get_or_init(|| {
            let w = &self.plan.widths;
            let x: Vec<f64> = (self
                .sites
                .z(site)
                .iter()
                .zip(w)
                .zip(&self.plan.system.reference))
            .map(|((z, w), r)| z * w + r)
            .collect();
            let v = self.sites.v[site];
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
