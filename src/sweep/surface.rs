//! Where trajectories start, backward in time: the seed ellipsoid, or the terminal cost over the region.

use super::complex::{Complex, Edge};
use crate::hamiltonian::{GuardExpr, System, Terminal};
use crate::local::LocalSolution;

/// Initial seeds for each dimension of the surface; fronts that need more get more.
const INITIAL: usize = 64;

/// A surface of seeds with coordinates ("parameters") in which points between seeds are found.
pub struct Surface {
    kind: Kind,
    system: System,
}

enum Kind {
    /// Parameters are unit vectors.
    Sphere(Box<LocalSolution>),
    /// Parameters are fractions of the box of deviations.
    Box { terminal: Terminal, region: Vec<[f64; 2]> },
}

impl Surface {
    pub fn sphere(system: &System, local: LocalSolution) -> Self {
        Self { kind: Kind::Sphere(Box::new(local)), system: system.clone() }
    }

    pub fn terminal(system: &System, terminal: Terminal, region: Vec<[f64; 2]>) -> Self {
        Self { kind: Kind::Box { terminal, region }, system: system.clone() }
    }

    /// A first triangulation, with the parameters of its vertices.
    pub fn triangulation(&self) -> (Complex, Vec<Vec<f64>>) {
        let n = self.system.states;
        let (mut complex, mut parameters) = match self.kind {
            Kind::Sphere(_) => Complex::sphere(n),
            Kind::Box { .. } => Complex::unit_box(n),
        };
        let dimension = match self.kind {
            Kind::Sphere(_) => n - 1,
            Kind::Box { .. } => n,
        };
        let mut open = complex.take_fresh();
        while parameters.len() < INITIAL * dimension && !open.is_empty() {
            // The longest first; ties in order of creation.
            let length = |e: &Edge| distance(&parameters[e.0 as usize], &parameters[e.1 as usize]);
            let longest = open.iter().map(length).fold(0.0, f64::max);
            let (split, keep): (Vec<Edge>, Vec<Edge>) = open.iter().copied().partition(|e| length(e) > 0.999 * longest);
            for edge in split {
                let middle = self.between(&parameters[edge.0 as usize], &parameters[edge.1 as usize]);
                if complex.split(edge).is_some() {
                    parameters.push(middle);
                }
            }
            open = keep;
            open.extend(complex.take_fresh());
        }
        complex.renew();
        (complex, parameters)
    }

    /// The parameter half-way between two.
    pub fn between(&self, a: &[f64], b: &[f64]) -> Vec<f64> {
        self.toward(a, b, 0.5)
    }

    /// The parameter a fraction of the way from `a` to `b`.
    pub fn toward(&self, a: &[f64], b: &[f64], fraction: f64) -> Vec<f64> {
        let mut m: Vec<f64> = a.iter().zip(b).map(|(x, y)| x + fraction * (y - x)).collect();
        if let Kind::Sphere(_) = self.kind {
            let norm = m.iter().map(|x| x * x).sum::<f64>().sqrt();
            m.iter_mut().for_each(|x| *x /= norm);
        }
        m
    }

    /// The seed `(s, p, V)` at a parameter.
    pub fn seed(&self, parameter: &[f64]) -> Vec<f64> {
        match &self.kind {
            Kind::Sphere(local) => local.seed(parameter),
            Kind::Box { terminal, region } => {
                let s: Vec<f64> = parameter.iter().zip(region).map(|(q, [lo, hi])| lo + q * (hi - lo)).collect();
                let zero = vec![0.0; s.len()];
                let p = self.system.eval(&terminal.gradient, &s, &zero);
                let v = self.system.eval(&[terminal.value], &s, &zero);
                s.into_iter().chain(p).chain(v).collect()
            }
        }
    }

    /// Smallest guard value at a seed, and whether all guards hold there.
    pub fn inside(&self, seed: &[f64]) -> bool {
        self.guard_values(seed).iter().zip(&self.system.guards).all(|(v, g): (&f64, &GuardExpr)| g.holds(*v))
    }

    fn guard_values(&self, seed: &[f64]) -> Vec<f64> {
        let n = self.system.states;
        let exprs: Vec<_> = self.system.guards.iter().map(|g| g.expr).collect();
        self.system.eval(&exprs, &seed[..n], &seed[n..2 * n])
    }

    /// The parameter moved back inside where it is outside by rounding alone: points between two on a guard's boundary
    /// lie on it, but for rounding.
    pub fn nudged(&self, parameter: Vec<f64>) -> Vec<f64> {
        const ROUNDING: f64 = 1e-10;
        const STEP: f64 = 1e-6;
        let n = self.system.states;
        let seed = self.seed(&parameter);
        let size = seed[..n].iter().fold(0.0f64, |a, s| a.max(s.abs()));
        let values = self.guard_values(&seed);
        let worst = values.iter().copied().enumerate().min_by(|a, b| a.1.total_cmp(&b.1));
        let Some((k, value)) = worst.filter(|(k, v)| !self.system.guards[*k].holds(*v) && *v >= -ROUNDING * size) else {
            return parameter;
        };
        let slopes: Vec<f64> = (0..parameter.len())
            .map(|i| {
                let at = |sign: f64| {
                    let mut q = parameter.clone();
                    q[i] += sign * STEP;
                    self.guard_values(&self.seed(&q))[k]
                };
                (at(1.0) - at(-1.0)) / (2.0 * STEP)
            })
            .collect();
        let square: f64 = slopes.iter().map(|x| x * x).sum();
        // Twice the way, so that rounding does not leave it outside again.
        let factor = (-2.0 * value + f64::EPSILON * size) / square;
        let moved: Vec<f64> = parameter.iter().zip(&slopes).map(|(q, d)| q + factor * d).collect();
        if moved.iter().all(|x| x.is_finite()) { moved } else { parameter }
    }

    /// Last parameter inside the guards on the way from `inside` to `outside`.
    pub fn boundary(&self, inside: &[f64], outside: &[f64]) -> Vec<f64> {
        let (mut lo, mut hi) = (0.0, 1.0);
        while hi - lo > 2.0 * f64::EPSILON {
            let middle = 0.5 * (lo + hi);
            if self.inside(&self.seed(&self.toward(inside, outside, middle))) {
                lo = middle;
            } else {
                hi = middle;
            }
        }
        self.toward(inside, outside, lo)
    }

    /// Largest V over the corners and the middle of a terminal surface (0 for the seed ellipsoid).
    pub fn largest_value(&self) -> f64 {
        let Kind::Box { region, .. } = &self.kind else { return 0.0 };
        let n = region.len();
        (0..1u32 << n)
            .map(|c| (0..n).map(|i| f64::from(c >> i & 1)).collect::<Vec<_>>())
            .chain([vec![0.5; n]])
            .map(|q| self.seed(&q)[2 * n].abs())
            .filter(|v| v.is_finite())
            .fold(0.0, f64::max)
    }
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| (x - y).powi(2)).sum::<f64>().sqrt()
}
