//! A polynomial about each site that interpolates its V and p, with curvature from the sites around
//! it.

use nalgebra::{DMatrix, DVector};

/// `V(z) = v + q.d + d'Hd/2 + cubic(d)`, `d = z - site`, of which H and the cubic part are here.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Nodal {
    /// Upper triangle row by row: the coefficient of `d_i d_j`, i <= j.
    second: Vec<f64>,
    /// Coefficients of `d_i d_j d_k`, i <= j <= k; empty for a quadratic.
    third: Vec<f64>,
    /// How far the sites used are away.
    pub reach: f64,
}

/// What a nodal polynomial says at a place.
#[derive(Clone, Debug)]
pub(super) struct Prediction {
    pub v: f64,
    pub q: Vec<f64>,
    /// Row-major.
    pub hessian: Vec<f64>,
}

/// A neighbour's data relative to the site's: its deviation, V less the tangent plane, and the
/// change of q.
pub(super) struct Neighbour {
    pub d: Vec<f64>,
    pub distance: f64,
    pub beyond_tangent: f64,
    pub dq: Vec<f64>,
}

/// Least share of the mean square direction to the neighbours that any direction has: less, and
/// they lie on a line or a plane, off which nothing is known.
const FLAT: f64 = 0.01;
/// A neighbour whose data are off the polynomial by more than this many times the median is of
/// another sheet.
const OUTLIER: f64 = 5.0;
/// Largest part of what q changes by that a polynomial may leave unexplained.
const UNEXPLAINED: f64 = 0.2;
/// Ridge of the normal equations, relative to their trace: what the neighbours say nothing about
/// stays 0.
const RIDGE: f64 = 1e-12;

fn quadratic_terms(n: usize) -> usize {
    n * (n + 1) / 2
}

fn cubic_terms(n: usize) -> usize {
    n * (n + 1) * (n + 2) / 6
}

/// Neighbours with which the cubic polynomial is well determined.
pub(super) fn wanted(n: usize) -> usize {
    (8 * (quadratic_terms(n) + cubic_terms(n))).div_ceil(5 * (n + 1)) + 2 * n
}

/// Fits curvature to neighbours by least squares; weights fall off with the distance (Franke &
/// Nielson 1980), rows of V are divided by the distance so that they weigh like those of q. `None`
/// with too few neighbours.
///
/// Neighbours that turn out not to belong are left out, and a polynomial that explains the rest
/// badly is none.
pub(super) fn fit(n: usize, mut neighbours: Vec<Neighbour>) -> Option<Nodal> {
    const ROUNDS: usize = 3;
    for _ in 0..ROUNDS {
        let nodal = least_squares(n, &neighbours)?;
        // What q changes by at the neighbours, by the data: a wild polynomial is no measure of
        // itself.
        let mut changes: Vec<f64> = neighbours.iter().map(|b| norm(&b.dq)).collect();
        changes.sort_by(f64::total_cmp);
        let usual = changes[changes.len() / 2].max(f64::MIN_POSITIVE);
        let misfits: Vec<f64> = neighbours.iter().map(|b| nodal.misfit(b, usual)).collect();
        let mut sorted = misfits.clone();
        sorted.sort_by(f64::total_cmp);
        let bound = OUTLIER * sorted[sorted.len() / 2].max(f64::EPSILON);
        // A good fit needs none of this: neighbours further away are naturally further off.
        let explained = misfits.iter().all(|m| *m <= UNEXPLAINED);
        if explained {
            return Some(nodal);
        }
        let before = neighbours.len();
        let mut keep = misfits.iter().map(|m| *m <= bound);
        neighbours.retain(|_| keep.next().unwrap_or(false));
        if neighbours.len() == before {
            return None;
        }
    }
    None
}

fn norm(v: &[f64]) -> f64 {
    v.iter().map(|v| v * v).sum::<f64>().sqrt()
}

/// Whether neighbours lie in all directions, or rather on a line, a plane.
fn flat(n: usize, neighbours: &[Neighbour]) -> bool {
    let mut spread = DMatrix::<f64>::zeros(n, n);
    for near in neighbours {
        let d = DVector::from_iterator(n, near.d.iter().map(|d| d / near.distance));
        spread += &d * d.transpose();
    }
    let least = spread.symmetric_eigenvalues().min();
    least < FLAT * neighbours.len() as f64 / n as f64
}

fn least_squares(n: usize, neighbours: &[Neighbour]) -> Option<Nodal> {
    let (squares, cubes) = (quadratic_terms(n), cubic_terms(n));
    let cubic = neighbours.len() * (n + 1) >= squares + cubes + 2 * n && neighbours.len() > n + 1;
    if neighbours.len() < n.max(2) || flat(n, neighbours) {
        return None;
    }
    let columns = if cubic { squares + cubes } else { squares };
    let reach = 1.1 * neighbours.iter().map(|b| b.distance).fold(0.0, f64::max);
    let rows = neighbours.len() * (n + 1);
    let mut a = DMatrix::zeros(rows, columns);
    let mut b = DVector::zeros(rows);
    for (k, near) in neighbours.iter().enumerate() {
        let weight = (reach - near.distance) / (reach * near.distance) * reach;
        // Lengths in units of the reach: columns of like size.
        let d: Vec<f64> = near.d.iter().map(|d| d / reach).collect();
        let (row, over) = (k * (n + 1), reach * weight / near.distance);
        monomials(&d, cubic, |column, value, slopes| {
            a[(row, column)] = over * value;
            for (i, slope) in slopes.iter().enumerate() {
                a[(row + 1 + i, column)] = weight * slope;
            }
        });
        b[row] = over * near.beyond_tangent;
        for i in 0..n {
            b[row + 1 + i] = weight * near.dq[i] * reach;
        }
    }
    let mut normal = a.tr_mul(&a);
    let ridge = RIDGE * normal.trace().max(f64::MIN_POSITIVE);
    for k in 0..columns {
        normal[(k, k)] += ridge;
    }
    let found = normal.cholesky()?.solve(&a.tr_mul(&b));
    if found.iter().any(|c| !c.is_finite()) {
        return None;
    }
    let scaled = |k: usize, power: i32| found[k] / reach.powi(power);
    Some(Nodal {
        second: (0..squares).map(|k| scaled(k, 2)).collect(),
        third: (squares..columns).map(|k| scaled(k, 3)).collect(),
        reach,
    })
}

/// Calls `each(column, value, slopes)` for every quadratic and, where asked, cubic monomial of d.
fn monomials(d: &[f64], cubic: bool, mut each: impl FnMut(usize, f64, &[f64])) {
    let n = d.len();
    let mut column = 0;
    let mut slopes = vec![0.0; n];
    for i in 0..n {
        for j in i..n {
            slopes.fill(0.0);
            slopes[i] += d[j];
            slopes[j] += d[i];
            each(column, d[i] * d[j], &slopes);
            column += 1;
        }
    }
    if !cubic {
        return;
    }
    for i in 0..n {
        for j in i..n {
            for k in j..n {
                slopes.fill(0.0);
                slopes[i] += d[j] * d[k];
                slopes[j] += d[i] * d[k];
                slopes[k] += d[i] * d[j];
                each(column, d[i] * d[j] * d[k], &slopes);
                column += 1;
            }
        }
    }
}

impl Nodal {
    /// The polynomial whose second derivatives at the site are given (row-major).
    pub fn of_hessian(n: usize, hessian: &[f64], reach: f64) -> Self {
        let mut second = Vec::with_capacity(quadratic_terms(n));
        for i in 0..n {
            for j in i..n {
                let h = hessian[i * n + j];
                second.push(if i == j { 0.5 * h } else { h });
            }
        }
        Self {
            second,
            third: Vec::new(),
            reach,
        }
    }

    /// How far a neighbour's q is off, of what q changes by there and usually.
    fn misfit(&self, near: &Neighbour, usual: f64) -> f64 {
        let zero = vec![0.0; near.d.len()];
        let prediction = self.at(0.0, &zero, &near.d);
        let off: Vec<f64> = prediction
            .q
            .iter()
            .zip(&near.dq)
            .map(|(a, b)| a - b)
            .collect();
        norm(&off) / norm(&near.dq).max(usual)
    }

    /// V, its slope and curvature at `site + d`.
    pub fn at(&self, v: f64, q: &[f64], d: &[f64]) -> Prediction {
        let n = d.len();
        let mut here = Prediction {
            v: v + q.iter().zip(d).map(|(q, d)| q * d).sum::<f64>(),
            q: q.to_vec(),
            hessian: vec![0.0; n * n],
        };
        let mut coefficients = self.second.iter();
        for i in 0..n {
            for j in i..n {
                let c = coefficients.next().copied().unwrap_or(0.0);
                here.v += c * d[i] * d[j];
                here.q[i] += c * d[j];
                here.q[j] += c * d[i];
                here.hessian[i * n + j] += c;
                here.hessian[j * n + i] += c;
            }
        }
        let mut coefficients = self.third.iter();
        if self.third.is_empty() {
            return here;
        }
        for i in 0..n {
            for j in i..n {
                for k in j..n {
                    let c = coefficients.next().copied().unwrap_or(0.0);
                    here.v += c * d[i] * d[j] * d[k];
                    here.q[i] += c * d[j] * d[k];
                    here.q[j] += c * d[i] * d[k];
                    here.q[k] += c * d[i] * d[j];
                    for (a, b, rest) in [(i, j, d[k]), (i, k, d[j]), (j, k, d[i])] {
                        here.hessian[a * n + b] += c * rest;
                        here.hessian[b * n + a] += c * rest;
                    }
                }
            }
        }
        here
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A cubic in three variables: V, gradient, Hessian.
    fn cubic(x: &[f64]) -> (f64, Vec<f64>, Vec<f64>) {
        let [a, b, c] = [x[0], x[1], x[2]];
        (
            1.0 + a - 2.0 * b + a * a + 3.0 * a * c - b * b + a * b * c - 2.0 * c * c * c
                + a * a * b,
            vec![
                1.0 + 2.0 * a + 3.0 * c + b * c + 2.0 * a * b,
                -2.0 - 2.0 * b + a * c + a * a,
                3.0 * a + a * b - 6.0 * c * c,
            ],
            vec![
                2.0 + 2.0 * b,
                c + 2.0 * a,
                3.0 + b,
                c + 2.0 * a,
                -2.0,
                a,
                3.0 + b,
                a,
                -12.0 * c,
            ],
        )
    }

    #[test]
    fn a_cubic_is_reproduced() {
        let site = [0.3, -0.2, 0.5];
        let (v, q, _) = cubic(&site);
        let near = |k: usize| -> Vec<f64> {
            (0..3)
                .map(|i| (((k * 37 + i * 11) * 29) % 97) as f64 / 97.0 - 0.5)
                .collect()
        };
        let neighbours: Vec<Neighbour> = (1..=wanted(3))
            .map(|k| {
                let d: Vec<f64> = near(k).iter().map(|x| 0.1 * x).collect();
                let x: Vec<f64> = site.iter().zip(&d).map(|(s, d)| s + d).collect();
                let (there, slope, _) = cubic(&x);
                Neighbour {
                    distance: d.iter().map(|d| d * d).sum::<f64>().sqrt(),
                    beyond_tangent: there - v - q.iter().zip(&d).map(|(q, d)| q * d).sum::<f64>(),
                    dq: slope.iter().zip(&q).map(|(a, b)| a - b).collect(),
                    d,
                }
            })
            .collect();
        let nodal = fit(3, neighbours).unwrap();
        let d = [0.03, -0.02, 0.04];
        let x: Vec<f64> = site.iter().zip(&d).map(|(s, d)| s + d).collect();
        let (expected, found) = (cubic(&x), nodal.at(v, &q, &d));
        // The ridge is the only error: 1e-12 of coefficients of order one, magnified by the
        // conditioning.
        assert!(
            (found.v - expected.0).abs() < 1e-10,
            "{} {}",
            found.v,
            expected.0
        );
        for (a, b) in found.q.iter().zip(&expected.1) {
            assert!((a - b).abs() < 1e-8);
        }
        for (a, b) in found.hessian.iter().zip(&expected.2) {
            assert!((a - b).abs() < 1e-6);
        }
    }

    #[test]
    fn neighbours_on_a_line_say_nothing_off_it() {
        let line = |k: usize| {
            let d = vec![0.01 * (k + 1) as f64, 0.0];
            Neighbour {
                distance: d[0],
                beyond_tangent: d[0] * d[0],
                dq: vec![2.0 * d[0], 0.0],
                d,
            }
        };
        assert!(fit(2, (0..8).map(line).collect()).is_none());
        assert!(fit(2, (0..1).map(line).collect()).is_none());
    }

    #[test]
    fn a_neighbour_of_another_sheet_is_left_out() {
        let neighbour = |k: usize| {
            let (angle, distance) = (k as f64 * 0.9, 0.06 + 0.01 * (k % 5) as f64);
            let d = vec![distance * angle.cos(), distance * angle.sin()];
            let other = if k == 3 { 0.15 } else { 0.0 };
            Neighbour {
                distance,
                // V = a^2 + a b, and one that is not of it.
                beyond_tangent: d[0] * d[0] + d[0] * d[1] + 0.1 * other,
                dq: vec![2.0 * d[0] + d[1] + other, d[0] - other],
                d,
            }
        };
        let nodal = fit(2, (0..14).map(neighbour).collect()).unwrap();
        let there = nodal.at(0.0, &[0.0, 0.0], &[0.02, 0.03]);
        assert!((there.v - (4e-4 + 6e-4)).abs() < 1e-10, "{}", there.v);
    }
}
