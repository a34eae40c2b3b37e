//! Where trajectories start, backward in time: the seed ellipsoid, or the terminal cost over the
//! region.

use super::complex::Complex;
use super::neighbours::{Edge, Vertex};
use crate::hamiltonian::{System, Terminal};
use crate::local::{LocalSolution, SeedScratch};
use crate::numeric::random::random;
use crate::program::Program;

/// Initial seeds for each dimension of the surface; fronts that need more get more.
const INITIAL: usize = 64;
/// States up to which the initial surface is refined before the sweep.
const FEW_STATES: usize = 6;
/// Dimensions up to which all corners of a box are looked at.
const ALL_CORNERS: usize = 10;
/// Guard values within this, relative to the seed's size, are zero but for rounding.
const ROUNDING: f64 = 1e-10;

/// A surface of seeds with coordinates ("parameters") in which points between seeds are found.
pub struct Surface {
    kind: Kind,
    states: usize,
    guards: Program,
    strict: Vec<bool>,
}

/// What guards say of a seed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Guarded {
    pub inside: bool,
    /// Inside, and on the boundary of a guard to rounding.
    pub on_boundary: bool,
}

enum Kind {
    /// Parameters are unit vectors.
    Sphere(Box<LocalSolution>),
    /// Parameters are fractions of the box of deviations.
    Box {
        terminal: Program,
        region: Vec<[f64; 2]>,
    },
}

impl Surface {
    pub fn sphere(system: &System, local: LocalSolution) -> Self {
        Self::new(system, Kind::Sphere(Box::new(local)))
    }

    pub fn terminal(system: &System, terminal: &Terminal, region: Vec<[f64; 2]>) -> Self {
        let roots: Vec<_> = terminal
            .gradient
            .iter()
            .copied()
            .chain([terminal.value])
            .collect();
        let program = Program::lower(&system.graph, &system.inputs, &roots);
        Self::new(
            system,
            Kind::Box {
                terminal: program,
                region,
            },
        )
    }

    fn new(system: &System, kind: Kind) -> Self {
        let guards: Vec<_> = system.guards.iter().map(|g| g.expr).collect();
        Self {
            kind,
            states: system.states,
            guards: Program::lower(&system.graph, &system.inputs, &guards),
            strict: system.guards.iter().map(|g| g.strict).collect(),
        }
    }

    /// A first triangulation, with the parameters of its vertices. With more than a few states
    /// every split multiplies simplices: there the corners alone are the start.
    pub fn triangulation(&self, most: usize) -> (Vec<Vec<Vertex>>, Vec<Vec<f64>>) {
        let n = self.states;
        let dimension = match self.kind {
            Kind::Sphere(_) => n - 1,
            Kind::Box { .. } => n,
        };
        let wanted = if n > FEW_STATES {
            0
        } else {
            most.min(INITIAL * dimension)
        };
        self.simplices(wanted)
    }

    /// The simplices of a triangulation with about so many vertices, and their parameters.
    pub fn simplices(&self, wanted: usize) -> (Vec<Vec<Vertex>>, Vec<Vec<f64>>) {
        let (mut complex, mut parameters) = match self.kind {
            Kind::Sphere(_) => Complex::sphere(self.states),
            Kind::Box { .. } => Complex::unit_box(self.states),
        };
        let mut open = complex.take_fresh();
        while parameters.len() < wanted && !open.is_empty() {
            // The longest first; ties in order of creation.
            let length = |e: &Edge| distance(&parameters[e.0 as usize], &parameters[e.1 as usize]);
            let longest = open.iter().map(length).fold(0.0, f64::max);
            let (split, keep): (Vec<Edge>, Vec<Edge>) = open
                .iter()
                .copied()
                .partition(|e| length(e) > 0.999 * longest);
            for edge in split {
                if parameters.len() >= wanted {
                    break;
                }
                complex.split(edge);
                let (a, b) = (edge.0 as usize, edge.1 as usize);
                parameters.push(self.between(&parameters[a], &parameters[b]));
            }
            open = keep;
            open.extend(complex.take_fresh());
        }
        (complex.simplices(), parameters)
    }

    /// The parameter half-way between two.
    pub fn between(&self, a: &[f64], b: &[f64]) -> Vec<f64> {
        self.toward(a, b, 0.5)
    }

    /// The parameter a fraction of the way from `a` to `b`.
    pub fn toward(&self, a: &[f64], b: &[f64], fraction: f64) -> Vec<f64> {
        let mut between = vec![0.0; a.len()];
        self.toward_into(a, b, fraction, &mut between);
        between
    }

    /// [`Surface::toward`], into memory that is there.
    pub fn toward_into(&self, a: &[f64], b: &[f64], fraction: f64, to: &mut [f64]) {
        for (to, (x, y)) in to.iter_mut().zip(a.iter().zip(b)) {
            *to = x + fraction * (y - x);
        }
        self.normalize(to);
    }

    /// The parameter that a mean of parameters stands for.
    pub fn normalized(&self, mut mean: Vec<f64>) -> Vec<f64> {
        self.normalize(&mut mean);
        mean
    }

    fn normalize(&self, mean: &mut [f64]) {
        if let Kind::Sphere(_) = self.kind {
            let norm = mean.iter().map(|x| x * x).sum::<f64>().sqrt();
            mean.iter_mut().for_each(|x| *x /= norm);
        }
    }

    /// The seed `(s, p, V)` at a parameter, into memory that is there.
    fn seed_into(&self, parameter: &[f64], seed: &mut [f64], scratch: &mut SeedScratch) {
        match &self.kind {
            Kind::Sphere(local) => local.seed_into(parameter, seed, scratch),
            Kind::Box { .. } => seed.copy_from_slice(&self.seed(parameter)),
        }
    }

    /// [`Surface::place`], with memory of its own: the parameter, and the seed.
    pub fn placed(&self, mut parameter: Vec<f64>) -> (Vec<f64>, Vec<f64>, Guarded) {
        let mut seed = vec![0.0; 2 * self.states + 1];
        let guarded = self.place(&mut parameter, &mut seed, &mut SeedScratch::default());
        (parameter, seed, guarded)
    }

    /// Computes the seed `(s, p, V)` at a parameter, which is moved back inside a guard where it is
    /// outside by rounding alone; and what the guards say of it.
    pub fn place(
        &self,
        parameter: &mut [f64],
        seed: &mut [f64],
        scratch: &mut SeedScratch,
    ) -> Guarded {
        self.seed_into(parameter, seed, scratch);
        if self.strict.is_empty() {
            return Guarded {
                inside: true,
                on_boundary: false,
            };
        }
        let values = self.guard_values(seed);
        let guarded = self.guarded(seed, &values);
        if guarded.inside {
            return guarded;
        }
        let Some(moved) = self.nudge(parameter, seed, &values) else {
            return guarded;
        };
        parameter.copy_from_slice(&moved);
        self.seed_into(parameter, seed, scratch);
        self.guarded(seed, &self.guard_values(seed))
    }

    /// What guards of such values say of a seed.
    fn guarded(&self, seed: &[f64], values: &[f64]) -> Guarded {
        let inside = self.all_hold(values);
        Guarded {
            inside,
            on_boundary: inside && self.is_at_one(seed, values),
        }
    }

    /// Whether a guard of such values is zero at a seed, to rounding.
    fn is_at_one(&self, seed: &[f64], values: &[f64]) -> bool {
        let size = self.size(seed);
        values.iter().any(|v| v.abs() <= ROUNDING * size)
    }

    /// The largest component of a seed's state.
    fn size(&self, seed: &[f64]) -> f64 {
        let states = seed[..self.states].iter();
        states.fold(0.0f64, |a, s| a.max(s.abs()))
    }

    fn all_hold(&self, values: &[f64]) -> bool {
        (values.iter().zip(&self.strict)).all(|(v, strict)| holds(*v, *strict))
    }

    /// The seed `(s, p, V)` at a parameter.
    pub fn seed(&self, parameter: &[f64]) -> Vec<f64> {
        match &self.kind {
            Kind::Sphere(local) => local.seed(parameter),
            Kind::Box { terminal, region } => {
                let s: Vec<f64> = parameter
                    .iter()
                    .zip(region)
                    .map(|(q, [lo, hi])| lo + q * (hi - lo))
                    .collect();
                // No adjoint enters the terminal cost.
                let inputs = [s.as_slice(), &vec![0.0; s.len()]].concat();
                s.into_iter().chain(terminal.eval(&inputs)).collect()
            }
        }
    }

    /// Seeds a small distance away, relative to the surface, in every direction of the manifold:
    /// along the surface, and where it surrounds an equilibrium also outward.
    pub fn near(&self, parameter: &[f64], distance: f64) -> Vec<Vec<f64>> {
        // On a sphere a step along its largest coordinate leads nowhere; the others span the
        // tangent plane.
        let largest =
            (0..parameter.len()).max_by(|i, j| parameter[*i].abs().total_cmp(&parameter[*j].abs()));
        (0..parameter.len())
            .map(|i| {
                if let (Kind::Sphere(local), true) = (&self.kind, Some(i) == largest) {
                    let s = &self.seed(parameter)[..self.states];
                    return local
                        .at_state(&s.iter().map(|x| x * (1.0 + distance)).collect::<Vec<_>>());
                }
                // Toward the middle: a box has nothing beyond its faces, nor has what a guard
                // limits.
                let mut q = parameter.to_vec();
                let inward = match self.kind {
                    Kind::Sphere(_) => q[i] > 0.0,
                    Kind::Box { .. } => q[i] > 0.5,
                };
                q[i] += if inward { -distance } else { distance };
                self.seed(&self.toward(&q, &q, 0.0))
            })
            .collect()
    }

    /// Whether a seed is inside all guards.
    pub fn inside(&self, seed: &[f64]) -> bool {
        self.all_hold(&self.guard_values(seed))
    }

    /// Whether a seed lies on the boundary of a guard, to rounding.
    pub fn on_boundary(&self, seed: &[f64]) -> bool {
        self.is_at_one(seed, &self.guard_values(seed))
    }

    fn guard_values(&self, seed: &[f64]) -> Vec<f64> {
        self.guards.eval(&seed[..2 * self.states])
    }

    /// Where a parameter with this seed and these values of its guards is back inside, if it is
    /// outside by rounding alone: points between two on a guard's boundary lie on it, but for
    /// rounding.
    fn nudge(&self, parameter: &[f64], seed: &[f64], values: &[f64]) -> Option<Vec<f64>> {
        let size = self.size(seed);
        let worst = (values.iter().copied().enumerate()).min_by(|a, b| a.1.total_cmp(&b.1));
        let (k, value) =
            worst.filter(|(k, v)| !holds(*v, self.strict[*k]) && *v >= -ROUNDING * size)?;
        let slopes = self.guard_slopes(parameter, k);
        let square: f64 = slopes.iter().map(|x| x * x).sum();
        // Twice the way, so that rounding does not leave it outside again.
        let factor = (-2.0 * value + f64::EPSILON * size) / square;
        let moved: Vec<f64> = (parameter.iter().zip(&slopes))
            .map(|(q, d)| q + factor * d)
            .collect();
        moved.iter().all(|x| x.is_finite()).then_some(moved)
    }

    /// Derivatives of a guard's value by the parameter, by central differences.
    fn guard_slopes(&self, parameter: &[f64], guard: usize) -> Vec<f64> {
        const STEP: f64 = 1e-6;
        let at = |i: usize, by: f64| {
            let mut q = parameter.to_vec();
            q[i] += by;
            self.guard_values(&self.seed(&q))[guard]
        };
        let slope = |i: usize| (at(i, STEP) - at(i, -STEP)) / (2.0 * STEP);
        (0..parameter.len()).map(slope).collect()
    }

    /// The parameter on a guard's boundary straight in front of one that it excludes, if that is
    /// no further than `reach`. What is on the surface's rim stays there.
    pub fn onto_guard(&self, outside: &[f64], reach: f64) -> Option<Vec<f64>> {
        let values = self.guard_values(&self.seed(outside));
        let worst = (values.iter().enumerate()).min_by(|a, b| a.1.total_cmp(b.1));
        let mut slopes = self.guard_slopes(outside, worst?.0);
        let is_box = matches!(self.kind, Kind::Box { .. });
        for (slope, q) in slopes.iter_mut().zip(outside) {
            if is_box && (*q <= 0.0 || *q >= 1.0) {
                *slope = 0.0;
            }
        }
        let norm = slopes.iter().map(|x| x * x).sum::<f64>().sqrt();
        let mut inside: Vec<f64> = (outside.iter().zip(&slopes))
            .map(|(q, slope)| q + reach * slope / norm)
            .collect();
        if is_box {
            inside.iter_mut().for_each(|q| *q = q.clamp(0.0, 1.0));
        }
        let inside = self.normalized(inside);
        let is_inside = inside.iter().all(|q| q.is_finite()) && self.inside(&self.seed(&inside));
        is_inside.then(|| self.boundary(&inside, outside))
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
        let Kind::Box { region, .. } = &self.kind else {
            return 0.0;
        };
        let n = region.len();
        corners(n)
            .map(|c| {
                c.into_iter()
                    .map(|upper| f64::from(u8::from(upper)))
                    .collect::<Vec<_>>()
            })
            .chain([vec![0.5; n]])
            .map(|q| self.seed(&q)[2 * n].abs())
            .filter(|v| v.is_finite())
            .fold(0.0, f64::max)
    }
}

/// Corners of a box in n dimensions, as lower (`false`) or upper along each: all of them up to
/// [`ALL_CORNERS`], above it as many, drawn the same in every run.
pub(super) fn corners(n: usize) -> impl Iterator<Item = Vec<bool>> {
    let all = n <= ALL_CORNERS;
    (0..1usize << n.min(ALL_CORNERS)).map(move |c| {
        let drawn = |i: usize| random(c as u64, i as u64) & 1 == 1;
        (0..n)
            .map(|i| if all { c >> i & 1 == 1 } else { drawn(i) })
            .collect()
    })
}

/// Whether a guard with this value is kept.
pub fn holds(value: f64, strict: bool) -> bool {
    if strict { value > 0.0 } else { value >= 0.0 }
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter()
        .zip(b)
        .map(|(x, y)| (x - y).powi(2))
        .sum::<f64>()
        .sqrt()
}
