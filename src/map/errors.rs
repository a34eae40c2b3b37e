//! What leaving out data shows of a value's error.

use super::{OF_CHANGE, OF_SIZE, SAME, SHEETS, Value, ValueMap, blend, distance_between};
use crate::sweep::accuracy::SMALL;

/// Sites by leaving out which the error at a state is told.
const LEFT_OUT: usize = 4;

impl ValueMap {
    /// Errors of a value: the largest shown by leaving out one of the sites around that are on its
    /// sheet.
    ///
    /// Where a state was solved, its own error counts: that of the solutions which the run solved
    /// again.
    pub(super) fn estimate(&self, x: &[f64], value: &mut Value) {
        if value.nearest < SAME && value.solved == value.sites && self.estimate_solved(x, value) {
            return;
        }
        let n = self.sites.n;
        let place: Vec<f64> = (0..n)
            .map(|i| {
                let s = x[i] - self.plan.system.reference[i];
                s / self.plan.widths[i] + self.turn(&value.winding, i)
            })
            .collect();
        let q: Vec<f64> = value
            .p
            .iter()
            .zip(&self.plan.widths)
            .map(|(p, w)| p * w)
            .collect();
        let size = q.iter().fold(0.0f64, |a, q| a.max(q.abs()));
        let near = self.around(&place, SHEETS * (2 * n + 4), &[]);
        if value.nearest < SAME && self.estimate_told(x, value, near.first().map(|(site, _)| *site))
        {
            return;
        }
        let alike = near.iter().filter(|(site, distance)| {
            (self.local_model(&place, 0, *site, *distance, None)).is_some_and(|o| {
                let far = distance_between(&o.prediction.q, &q);
                far <= OF_CHANGE * distance_between(&o.prediction.q, self.sites.q(*site))
                    + OF_SIZE * size
            })
        });
        let mut worst = [f64::NAN; 3];
        for (site, _) in alike.take(LEFT_OUT) {
            let errors = self.left_out[*site].get_or_init(|| self.leave_out(*site));
            for (worst, error) in worst.iter_mut().zip(errors) {
                *worst = worst.max(*error);
            }
        }
        // A single prediction, with nothing near it to leave out, has no error estimate.
        value.v_error = match value.sites {
            1 if worst[0].is_nan() => f64::NAN,
            _ => value.v_error.max(worst[0]),
        };
        value.p_error = worst[1] / size.max(f64::MIN_POSITIVE);
        value.u_error = worst[2];
    }

    /// The errors of a value that was interpolated in its turn, as they were told with it; whether
    /// it is one.
    fn estimate_told(&self, x: &[f64], value: &mut Value, site: Option<usize>) -> bool {
        let Some(own) = site.and_then(|site| self.sites.errors.get(&site)) else {
            return false;
        };
        (value.v_error, value.p_error, value.u_error) =
            (own.v, own.p, self.moved_control(x, value, own.p));
        true
    }

    /// The errors of a solved state from the run's estimate; whether there is one.
    fn estimate_solved(&self, x: &[f64], value: &mut Value) -> bool {
        let Some([own_v, own_p]) = self.own_errors else {
            return false;
        };
        let (w, scale) = (&self.plan.widths, SMALL * self.plan.value_scale);
        let size = (value.p.iter().zip(w)).fold(0.0f64, |a, (p, w)| a.max((p * w).abs()));
        value.v_error = own_v * (value.v.abs() + scale);
        let of_p = own_p * (size + scale);
        value.p_error = of_p / size.max(f64::MIN_POSITIVE);
        value.u_error = self.moved_control(x, value, value.p_error);
        true
    }

    /// What an error of p, relative to its largest component times the region's width, makes of u:
    /// no more than an error in each component does, one after the other.
    fn moved_control(&self, x: &[f64], value: &Value, relative: f64) -> f64 {
        let w = &self.plan.widths;
        let size = (value.p.iter().zip(w)).fold(0.0f64, |a, (p, w)| a.max((p * w).abs()));
        let of_p = relative * size.max(f64::MIN_POSITIVE);
        if of_p.is_nan() {
            return f64::NAN;
        }
        let s: Vec<f64> = (0..w.len())
            .map(|i| x[i] - self.plan.system.reference[i] + self.turn(&value.winding, i) * w[i])
            .collect();
        let mut moved = vec![0.0; value.u.len()];
        for i in 0..w.len() {
            let mut p = value.p.clone();
            p[i] += of_p / w[i];
            for ((moved, there), here) in moved.iter_mut().zip(self.control(&s, &p)).zip(&value.u) {
                *moved += (there - here).abs();
            }
        }
        moved.into_iter().fold(0.0, f64::max)
    }

    /// Errors of V, q (largest component) and u at a site where it is not used; NaN where the
    /// others do not reach it.
    fn leave_out(&self, site: usize) -> [f64; 3] {
        let (z, v, q) = (self.sites.z(site), self.sites.v[site], self.sites.q(site));
        let local_models = self.local_models(z, Some(site));
        // The site's own sheet is the one whose p is nearest.
        let sheets = self.sheets(&local_models);
        let blends = sheets
            .iter()
            .map(|members| blend(self.sites.n, &local_models, members).0);
        let nearest =
            blends.min_by(|a, b| distance_between(&a.q, q).total_cmp(&distance_between(&b.q, q)));
        let Some(prediction) = nearest else {
            return [f64::NAN; 3];
        };
        let w = &self.plan.widths;
        let s: Vec<f64> = z.iter().zip(w).map(|(z, w)| z * w).collect();
        let unscaled = |q: &[f64]| q.iter().zip(w).map(|(q, w)| q / w).collect::<Vec<f64>>();
        let (u, other) = (
            self.control(&s, &unscaled(q)),
            self.control(&s, &unscaled(&prediction.q)),
        );
        let largest = |a: &[f64], b: &[f64]| {
            a.iter()
                .zip(b)
                .fold(0.0f64, |m, (a, b)| m.max((a - b).abs()))
        };
        [
            (prediction.v - v).abs(),
            largest(&prediction.q, q),
            largest(&u, &other),
        ]
    }
}
