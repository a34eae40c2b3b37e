//! What the sites around a place say there, and which of them speak of one sheet.

use super::nodal::{self, Neighbour, Nodal, Prediction};
use super::{
    AGREED, BEYOND, FEW, LOOK, OF_CHANGE, OF_SIZE, ONE_SIDED, SAME, SHEETS, SPREAD, ValueMap,
};
use std::borrow::Cow;

/// A site's polynomial, if there is one, and the sites around that were asked for it.
pub(super) type Fitted = (Option<Nodal>, Box<[u32]>);

/// What one site says at a place.
pub(super) struct LocalModel {
    pub site: usize,
    pub winding: usize,
    pub distance: f64,
    /// From the place to the site, scaled.
    pub to: Vec<f64>,
    pub prediction: Prediction,
}

impl ValueMap {
    /// Sites near a place that lie on different sides of it, by distance; `without` is passed over.
    pub(super) fn around(
        &self,
        place: &[f64],
        most: usize,
        without: &[usize],
    ) -> Vec<(usize, f64)> {
        let near = |look: usize| self.tree.near(place, f64::INFINITY, look * most);
        // Mostly the nearest few lie on enough sides.
        let few = near(FEW);
        let chosen = self.spread(&few, most, without);
        if chosen.len() == most || few.len() < FEW * most {
            return chosen;
        }
        self.spread(&near(LOOK), most, without)
    }

    /// Of sites by distance those that lie on different sides.
    fn spread(&self, near: &[(usize, f64)], most: usize, without: &[usize]) -> Vec<(usize, f64)> {
        let mut chosen: Vec<(usize, f64)> = Vec::with_capacity(most);
        for &(site, distance) in near {
            if without.contains(&site) {
                continue;
            }
            let z = self.sites.z(site);
            let beside = (SPREAD * distance).powi(2);
            let crowded = chosen.iter().any(|(other, _)| {
                square_between(z, self.sites.z(*other)) < beside
                    && self.sites.consistent(site, *other)
            });
            if !crowded {
                chosen.push((site, distance));
                if chosen.len() == most {
                    break;
                }
            }
        }
        chosen
    }

    /// A site's polynomial; `without` one of the others.
    pub(super) fn nodal(&self, site: usize, without: Option<usize>) -> Option<Cow<'_, Nodal>> {
        let (of_all, asked) = self.nodal[site].get_or_init(|| self.fit(site, None));
        // What was not asked has no part in it.
        match without.filter(|without| asked.contains(&(*without as u32))) {
            Some(without) => self.fit(site, Some(without)).0.map(Cow::Owned),
            None => of_all.as_ref().map(Cow::Borrowed),
        }
    }

    /// The polynomial, and the sites around that were asked for it.
    fn fit(&self, site: usize, without: Option<usize>) -> Fitted {
        let n = self.sites.n;
        let (z, v, q) = (self.sites.z(site), self.sites.v[site], self.sites.q(site));
        let most = nodal::wanted(n);
        let excluded: Vec<usize> = without.into_iter().chain([site]).collect();
        // Twice as many: some will belong to other sheets.
        let mut near = self.around(z, 2 * most, &excluded);
        let asked = near.iter().map(|(k, _)| *k as u32).collect();
        near.retain(|(k, d)| *d > SAME && self.sites.consistent(site, *k));
        let agreed: Vec<bool> = (near.iter())
            .map(|(k, _)| {
                let with = near
                    .iter()
                    .filter(|(j, _)| self.sites.consistent(*k, *j))
                    .count();
                with as f64 >= AGREED * near.len() as f64
            })
            .collect();
        let neighbours: Vec<Neighbour> = (near.iter().zip(agreed))
            .filter(|(_, agreed)| *agreed)
            .take(most)
            .map(|(&(k, distance), _)| {
                let d: Vec<f64> = self.sites.z(k).iter().zip(z).map(|(a, b)| a - b).collect();
                Neighbour {
                    distance,
                    beyond_tangent: self.sites.v[k]
                        - v
                        - q.iter().zip(&d).map(|(q, d)| q * d).sum::<f64>(),
                    dq: self.sites.q(k).iter().zip(q).map(|(a, b)| a - b).collect(),
                    d,
                }
            })
            .collect();
        let fitted = nodal::fit(n, neighbours);
        let nodal = match self.sites.hessian.get(&site) {
            Some(hessian) => {
                let reach = fitted.map_or(0.0, |f| f.reach);
                Some(Nodal::of_hessian(n, hessian, reach))
            }
            None => fitted,
        };
        (nodal, asked)
    }

    pub(super) fn local_model(
        &self,
        place: &[f64],
        winding: usize,
        site: usize,
        distance: f64,
        without: Option<usize>,
    ) -> Option<LocalModel> {
        let to: Vec<f64> = self
            .sites
            .z(site)
            .iter()
            .zip(place)
            .map(|(z, p)| z - p)
            .collect();
        let nodal = match self.nodal(site, without) {
            Some(nodal) if distance < SAME || distance <= BEYOND * nodal.reach => nodal,
            // Where a site is, its own V and p are known whatever its neighbours say.
            None if distance < SAME => {
                let n = self.sites.n;
                Cow::Owned(Nodal::of_hessian(n, &vec![0.0; n * n], 0.0))
            }
            _ => return None,
        };
        let d: Vec<f64> = to.iter().map(|t| -t).collect();
        Some(LocalModel {
            site,
            winding,
            distance,
            prediction: nodal.at(self.sites.v[site], self.sites.q(site), &d),
            to,
        })
    }

    /// What the sites around a place say there, by distance.
    pub(super) fn local_models(&self, z: &[f64], without: Option<usize>) -> Vec<LocalModel> {
        let n = self.sites.n;
        let most = SHEETS * (2 * n + 4);
        let excluded: Vec<usize> = without.into_iter().collect();
        let mut local_models = Vec::new();
        for (w, winding) in self.windings.iter().enumerate() {
            let place: Vec<f64> = (0..n).map(|i| z[i] + self.turn(winding, i)).collect();
            let near = self.around(&place, most, &excluded);
            local_models.extend(
                near.into_iter()
                    .filter_map(|(site, d)| self.local_model(&place, w, site, d, without)),
            );
        }
        local_models.sort_by(|a, b| a.distance.total_cmp(&b.distance).then(a.site.cmp(&b.site)));
        local_models
    }

    /// LocalModels that agree, sheet by sheet; of each the nearest comes first.
    pub(super) fn sheets(&self, local_models: &[LocalModel]) -> Vec<Vec<usize>> {
        let mut sheets: Vec<Vec<usize>> = Vec::new();
        for k in 0..local_models.len() {
            match (sheets.iter_mut())
                .find(|members| self.agree(&local_models[members[0]], &local_models[k]))
            {
                Some(members) => members.push(k),
                None => sheets.push(vec![k]),
            }
        }
        sheets
    }

    /// Whether two sites mean the same sheet: they differ by less than a part of what their
    /// polynomials change by from site to place.
    pub(super) fn agree(&self, a: &LocalModel, b: &LocalModel) -> bool {
        let norm = |v: &[f64]| v.iter().map(|v| v * v).sum::<f64>().sqrt();
        let change = |o: &LocalModel| distance_between(&o.prediction.q, self.sites.q(o.site));
        let changed = change(a).max(change(b));
        let size = norm(&a.prediction.q).max(norm(&b.prediction.q));
        let q = OF_CHANGE * changed + OF_SIZE * size;
        let distance = a.distance.max(b.distance).max(SAME);
        distance_between(&a.prediction.q, &b.prediction.q) <= q
            && (a.prediction.v - b.prediction.v).abs() <= q * distance
    }
}

/// Blends what the members say, with weights that are infinite at a site and 0 at the furthest; and
/// how far they are apart in V (weighted root mean square).
pub(super) fn blend(n: usize, local_models: &[LocalModel], members: &[usize]) -> (Prediction, f64) {
    let first = &local_models[members[0]];
    if first.distance < SAME || members.len() == 1 {
        return (first.prediction.clone(), 0.0);
    }
    let reach = 1.1 * local_models[members[members.len() - 1]].distance;
    let mut sum = Prediction {
        v: 0.0,
        q: vec![0.0; n],
        hessian: vec![0.0; n * n],
    };
    let weights: Vec<f64> = (members.iter().map(|k| local_models[*k].distance))
        .map(|d| ((reach - d) / (reach * d)).powi(2))
        .collect();
    let total: f64 = weights.iter().sum();
    for (k, weight) in members.iter().zip(&weights) {
        let o = &local_models[*k];
        sum.v += weight * o.prediction.v;
        for (a, b) in sum.q.iter_mut().zip(&o.prediction.q) {
            *a += weight * b;
        }
        for (a, b) in sum.hessian.iter_mut().zip(&o.prediction.hessian) {
            *a += weight * b;
        }
    }
    sum.v /= total;
    sum.q
        .iter_mut()
        .chain(&mut sum.hessian)
        .for_each(|a| *a /= total);
    let squares = members
        .iter()
        .zip(&weights)
        .map(|(k, w)| w * (local_models[*k].prediction.v - sum.v).powi(2));
    let apart = (squares.sum::<f64>() / total).sqrt();
    (sum, apart)
}

/// Whether sites lie on all sides of a place.
pub(super) fn surrounded<'o>(n: usize, members: impl Iterator<Item = &'o LocalModel>) -> bool {
    let mut mean = vec![0.0; n];
    let mut count = 0.0;
    for o in members {
        count += 1.0;
        for (m, t) in mean.iter_mut().zip(&o.to) {
            *m += t / o.distance.max(SAME);
        }
    }
    count >= 2.0 && mean.iter().map(|m| m * m).sum::<f64>().sqrt() <= ONE_SIDED * count
}

pub(super) fn distance_between(a: &[f64], b: &[f64]) -> f64 {
    square_between(a, b).sqrt()
}

fn square_between(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum()
}
