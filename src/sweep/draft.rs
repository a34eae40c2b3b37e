//! The parts of a plan: the manifold that a sweep begins on, its course along the trajectories, and
//! the programs that are integrated.

use super::plan::{BEYOND_VALUE, Numerics, PlanError, SEED_SHARE, Sampling, largest_quadratic};
use super::surface::Surface;
use crate::backend::{By, Guards, Run, Spec};
use crate::expr::Kind;
use crate::hamiltonian::{Hamiltonian, Slope, System, infinite};
use crate::local::{LocalSolution, Riccati, SeedChoice};
use crate::model::{Model, ShootOut};
use crate::program::Program;

/// Where trajectories begin.
pub(super) struct Manifold {
    pub surface: Surface,
    /// The local solution, for an infinite horizon.
    pub local: Option<LocalSolution>,
    /// Scale of V: value_max, or the largest terminal cost.
    pub value_scale: f64,
}

/// What a plan is made from.
pub(super) struct Draft<'a> {
    pub model: &'a Model,
    pub system: &'a System,
    pub shoot_out: &'a ShootOut,
    pub numerics: &'a Numerics,
    pub sampling: Sampling,
    /// Region as deviations.
    pub region: &'a [[f64; 2]],
    pub widths: &'a [f64],
}

/// The coordinate along trajectories, and where on it they are sampled and end.
pub(super) struct Course {
    pub by: By,
    /// The stored ones after the inner ones.
    pub levels: Vec<f64>,
    /// Leading levels that are not part of the result.
    pub inner: usize,
    /// A component, and the value at which a trajectory also ends.
    pub ceiling: Option<(usize, f64)>,
}

/// What is integrated, as programs.
pub(super) struct Integrand {
    pub rate: Program,
    pub guards: Option<Guards>,
    pub kinks: Option<Program>,
    /// Scale of each component.
    pub scales: Vec<f64>,
    /// Where the slope's upper triangle begins, if it is integrated.
    pub slope: Option<usize>,
}

impl Draft<'_> {
    /// The ellipsoid of the local solution, or the terminal states of a finite horizon.
    ///
    /// # Errors
    /// [`PlanError::Local`].
    pub fn manifold(&self, hamiltonian: &Hamiltonian) -> Result<Manifold, PlanError> {
        let system = self.system;
        if let Some(terminal) = &system.terminal {
            let surface = Surface::terminal(system, terminal, self.region.to_vec());
            let scale = surface.largest_value();
            return Ok(Manifold {
                surface,
                local: None,
                value_scale: if scale > 0.0 { scale } else { 1.0 },
            });
        }
        let riccati = Riccati::solve(hamiltonian, self.model)?;
        let value_max = value_max(self.shoot_out);
        let first_front = value_max / self.shoot_out.samples as f64;
        let choice = SeedChoice {
            asked: self.shoot_out.seed_value,
            tolerance: SEED_SHARE * self.numerics.rtol * first_front,
            ceiling: 0.5 * first_front,
            outer: value_max,
        };
        let local = LocalSolution::new(system, self.model, riccati, choice)?;
        Ok(Manifold {
            surface: Surface::sphere(system, local.clone()),
            local: Some(local),
            value_scale: value_max,
        })
    }

    /// The levels of the sampling coordinate; with `inner`, also levels of V between the seeds and
    /// the first stored one.
    pub fn course(&self, manifold: &Manifold, inner: bool) -> Course {
        let local = manifold.local.as_ref();
        let samples = self.shoot_out.samples;
        let steps = |end: f64| {
            (1..=samples)
                .map(|k| end * k as f64 / samples as f64)
                .collect::<Vec<f64>>()
        };
        let (value, value_max) = (self.value(), value_max(self.shoot_out));
        let ceiling = (value, self.value_ceiling(local));
        let (by, levels, ceiling) = match self.sampling {
            Sampling::Value => (By::Component(value), steps(value_max), None),
            Sampling::Time => {
                let time = self.system.terminal.as_ref().map_or(0.0, |t| t.time);
                let mut levels = steps(time);
                // To the last bit.
                levels[samples - 1] = time;
                (By::Time, levels, value_max.is_finite().then_some(ceiling))
            }
            Sampling::ArcLength => (
                By::Component(value + 1),
                steps(self.shoot_out.arc_length),
                Some(ceiling),
            ),
        };
        let seed_value = local.map_or(0.0, |l| l.seed_value);
        let inner = if inner && self.sampling == Sampling::Value {
            inner_levels(seed_value, levels[0])
        } else {
            Vec::new()
        };
        Course {
            by,
            levels: [inner.as_slice(), &levels].concat(),
            inner: inner.len(),
            ceiling,
        }
    }

    /// Component of V in the integrated vector.
    fn value(&self) -> usize {
        2 * self.model.states.len()
    }

    /// V at which a trajectory is given up: in a game V may fall again along it.
    fn value_ceiling(&self, local: Option<&LocalSolution>) -> f64 {
        let value_max = value_max(self.shoot_out);
        if !self.model.is_game() {
            return value_max;
        }
        let corners = local.map_or(0.0, |l| largest_quadratic(self.model, &l.riccati));
        BEYOND_VALUE * value_max.max(corners)
    }

    /// Programs of `(s, p, V)`, of arc length where it is sampled by, and of the slope where folds
    /// are looked for. `value_scale` is a scale of V, `slope_units` are scales of the slope's
    /// entries (row-major).
    pub fn integrand(&self, value_scale: f64, slope_units: &[f64]) -> Integrand {
        let (system, n) = (self.system, self.model.states.len());
        let mut graph = system.graph.clone();
        let folds = (self.model.is_game() || self.shoot_out.folds).then(|| {
            let limit = infinite(self.numerics.precision);
            Slope::new(&mut graph, system, slope_units, limit)
        });
        // What is integrated beside (s, p) depends on them alone, but for the slope.
        let mut inputs = system.inputs.clone();
        let mut rate = system.rate.clone();
        let mut scales = self.scales(value_scale);
        if self.sampling == Sampling::ArcLength {
            rate.push(system.arc_rate);
            scales.push(1.0);
        }
        let switches = graph.kinks(&rate);
        let mut conditions: Vec<_> = system.guards.iter().map(|g| g.expr).collect();
        let mut strict: Vec<bool> = system.guards.iter().map(|g| g.strict).collect();
        let slope = folds.map(|slope| {
            let first = rate.len();
            inputs.extend(
                (2 * n..first).map(|k| graph.symbol(&format!("component {k}"), Kind::State)),
            );
            inputs.extend(&slope.symbols);
            rate.extend(&slope.rate);
            scales.extend(Slope::packed(slope_units, n));
            conditions.push(slope.guard);
            strict.push(true);
            first
        });
        let program = |roots: &[_]| Program::lower(&graph, &inputs, roots);
        Integrand {
            rate: program(&rate),
            guards: (!conditions.is_empty()).then(|| Guards {
                program: program(&conditions),
                strict,
            }),
            kinks: (!switches.is_empty()).then(|| program(&switches)),
            scales,
            slope,
        }
    }

    /// Scales of `(s, p, V)`.
    fn scales(&self, value_scale: f64) -> Vec<f64> {
        let mut scales = self.widths.to_vec();
        scales.extend(self.widths.iter().map(|w| value_scale / w));
        scales.push(value_scale);
        scales
    }

    /// Settings of the run, for components of these scales.
    pub fn run(&self, course: &Course, scales: &[f64]) -> Run {
        let integrator = &self.model.integrator;
        let periodic = self.model.states.iter().map(|s| s.period.is_some());
        Run {
            rtol: self.numerics.rtol,
            atol: scales.iter().map(|s| self.numerics.atol * s).collect(),
            step: integrator.step.unwrap_or(0.0),
            first: None,
            max_steps: u32::try_from(integrator.max_steps).unwrap_or(u32::MAX),
            levels: course.levels.clone(),
            ceiling: course.ceiling,
            bounds: with_margin(self.region, self.widths, periodic, self.shoot_out.margin),
        }
    }
}

impl Integrand {
    /// Of a kernel that samples by a coordinate, and stores the samples.
    pub fn spec(self, numerics: &Numerics, by: By) -> Spec {
        Spec {
            rate: self.rate,
            guards: self.guards,
            kinks: self.kinks,
            method: numerics.method,
            precision: numerics.precision,
            by,
            store: true,
        }
    }
}

/// A region of these widths with so many of them more on each side; a periodic state has no bounds.
pub fn with_margin(
    region: &[[f64; 2]],
    widths: &[f64],
    periodic: impl Iterator<Item = bool>,
    margin: f64,
) -> Vec<[f64; 2]> {
    (region.iter().zip(widths).zip(periodic))
        .map(|(([lo, hi], width), periodic)| {
            let margin = match periodic {
                true => f64::INFINITY,
                false => margin * width,
            };
            [lo - margin, hi + margin]
        })
        .collect()
}

/// V up to which is swept; infinite where the scene sets no limit.
fn value_max(shoot_out: &ShootOut) -> f64 {
    shoot_out.value_max.unwrap_or(f64::INFINITY)
}

/// Levels between the seeds' V and the first one asked for, each a few times the one before.
fn inner_levels(seed_value: f64, first: f64) -> Vec<f64> {
    const RATIO: f64 = 3.0;
    let mut levels = Vec::new();
    let mut level = RATIO * seed_value;
    while level < first / RATIO.sqrt() && levels.len() < 64 {
        levels.push(level);
        level *= RATIO;
    }
    levels
}
