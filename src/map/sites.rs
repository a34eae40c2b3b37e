//! Where V and p are known: swept samples, solved states, map nodes, and the local solution near
//! the equilibrium.

use super::{Known, MapError, SHEETS};
use crate::backend::{BackendError, cpu::Cpu};
use crate::hamiltonian::Hamiltonian;
use crate::model::{Horizon, Model, SeedValue};
use crate::sweep::{Choices, Plan, Sampling, sweep};
use crate::trajectories::StatedErrors;
use crate::value::Grid;
use rustc_hash::FxHashMap;

/// No sheet number is known.
pub(super) const UNLABELLED: i32 = -1;
/// Finest and coarsest distance between sites that is wanted, in widths of the region: of the
/// scene's `spacing`.
const COARSEST: f64 = 0.05;
/// Distance from the equilibrium within which sites may lie closer, in proportion.
const NEAR: f64 = 0.3;
const FINEST: f64 = 1e-3;
/// Largest error of the local solution at a site of it, relative to V there.
const LOCAL_ERROR: f64 = 1e-5;

/// Where a site's numbers come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Source {
    /// A sample of a swept trajectory.
    Sample,
    /// A state solved for (`/points_sheets` or `/map`).
    Solved,
    /// A value that was interpolated in its turn, with an error of its own.
    Interpolated,
    /// The local solution about the equilibrium.
    Local,
}

/// Scattered data in scaled coordinates: `z = (x - reference) / width`, `q = p * width`.
#[derive(Clone, Debug, Default)]
pub(super) struct Sites {
    pub n: usize,
    pub z: Vec<f64>,
    pub v: Vec<f64>,
    pub q: Vec<f64>,
    pub sheet: Vec<i32>,
    pub source: Vec<Source>,
    /// Row-major Hessian where it is known, of local sites.
    pub hessian: FxHashMap<usize, Vec<f64>>,
    /// Of those that were interpolated.
    pub errors: FxHashMap<usize, StatedErrors>,
}

impl Sites {
    /// All sites, thinned to about half the distance between neighbouring trajectories.
    ///
    /// # Errors
    /// [`MapError`] where the sweep next to the equilibrium fails.
    pub fn collect(
        model: &Model,
        hamiltonian: &Hamiltonian,
        plan: &Plan,
        known: &Known,
    ) -> Result<Self, MapError> {
        let mut all = Gathering::new(plan);
        if let Some(entries) = &known.solved {
            for k in 0..entries.count {
                let row = (
                    entries.x.as_slice(),
                    entries.v.as_slice(),
                    entries.p.as_slice(),
                );
                all.add_answer(row, k, entries.sheet[k], entries.errors.get(k));
            }
        }
        if let Some(map) = &known.grid {
            let axes = map.axes.clone();
            let x = Grid { axes }.points();
            for k in 0..map.v.len() {
                let row = (x.as_slice(), map.v.as_slice(), map.p.as_slice());
                all.add_answer(row, k, map.sheet[k], map.errors.get(k));
            }
        }
        // V of a finite horizon depends on time: only at its beginning is it the value function
        // asked for.
        let begins = match model.horizon {
            Horizon::Finite { final_time, .. } => -final_time * (1.0 - 1e-9),
            Horizon::Infinite { .. } => f64::INFINITY,
        };
        if let Some(swept) = &known.swept {
            for k in (0..swept.count * swept.samples).filter(|k| swept.t[*k] <= begins) {
                let sheet = swept.sheet[k / swept.samples];
                all.add(&swept.x, &swept.v, &swept.p, k, sheet, Source::Sample);
            }
            let least = swept
                .v
                .iter()
                .copied()
                .filter(|v| *v > 0.0)
                .fold(f64::INFINITY, f64::min);
            all.add_inner((model, hamiltonian), plan, least)?;
        }
        all.add_local(plan);
        Ok(all.finished())
    }

    pub fn len(&self) -> usize {
        self.v.len()
    }

    /// The sites that are not dropped, in their order.
    fn without(self, dropped: &[bool]) -> Self {
        if !dropped.contains(&true) {
            return self;
        }
        let kept: Vec<usize> = (0..self.len()).filter(|k| !dropped[*k]).collect();
        fn moved<T: Clone>(all: &FxHashMap<usize, T>, kept: &[usize]) -> FxHashMap<usize, T> {
            let each = kept.iter().enumerate();
            each.filter_map(|(new, old)| Some((new, all.get(old)?.clone())))
                .collect()
        }
        let rows = |all: fn(&Self, usize) -> &[f64]| {
            kept.iter().flat_map(|k| all(&self, *k)).copied().collect()
        };
        Self {
            n: self.n,
            z: rows(Self::z),
            q: rows(Self::q),
            v: kept.iter().map(|k| self.v[*k]).collect(),
            sheet: kept.iter().map(|k| self.sheet[*k]).collect(),
            source: kept.iter().map(|k| self.source[*k]).collect(),
            hessian: moved(&self.hessian, &kept),
            errors: moved(&self.errors, &kept),
        }
    }

    pub fn z(&self, i: usize) -> &[f64] {
        &self.z[i * self.n..(i + 1) * self.n]
    }

    pub fn q(&self, i: usize) -> &[f64] {
        &self.q[i * self.n..(i + 1) * self.n]
    }

    /// Whether two sites can lie on one smooth sheet: the trapezoidal rule over p gives the
    /// difference of V to within a part of what p changes by.
    pub fn consistent(&self, i: usize, j: usize) -> bool {
        let labels = [self.sheet[i], self.sheet[j]];
        if !labels.contains(&UNLABELLED) && labels[0] != labels[1] {
            return false;
        }
        consistent(
            (self.z(i), self.v[i], self.q(i)),
            (self.z(j), self.v[j], self.q(j)),
        )
    }
}

/// x, V and p.
type Datum<'d, V = f64> = (&'d [f64], V, &'d [f64]);

fn consistent((za, va, qa): Datum<'_>, (zb, vb, qb): Datum<'_>) -> bool {
    // Third derivatives of V bend p over the distance by at most this share of its change.
    const BEND: f64 = 0.2;
    const FLOOR: f64 = 0.01;
    let (mut mean, mut change, mut size, mut distance) = (0.0, 0.0, 0.0, 0.0);
    for i in 0..za.len() {
        let d = zb[i] - za[i];
        mean += 0.5 * (qa[i] + qb[i]) * d;
        change += (qb[i] - qa[i]).powi(2);
        size += (0.5 * (qa[i].abs() + qb[i].abs())).powi(2);
        distance += d * d;
    }
    let distance = distance.sqrt();
    (vb - va - mean).abs() <= (BEND * change.sqrt() + FLOOR * size.sqrt()) * distance
}

/// Sites as they are added; near ones of the same sheet are dropped.
struct Gathering<'p> {
    plan: &'p Plan,
    sites: Sites,
    spacing: f64,
    cells: FxHashMap<(i32, Vec<i64>), Vec<usize>>,
}

impl<'p> Gathering<'p> {
    fn new(plan: &'p Plan) -> Self {
        Self {
            plan,
            sites: Sites {
                n: plan.system.states,
                ..Sites::default()
            },
            spacing: 0.5 * plan.shoot_out.spacing.min(COARSEST),
            cells: FxHashMap::default(),
        }
    }

    /// A state's answer: solved for, unless it has errors of an interpolation.
    fn add_answer(
        &mut self,
        (x, v, p): Datum<'_, &[f64]>,
        k: usize,
        sheet: i32,
        errors: Option<&StatedErrors>,
    ) {
        let Some(errors) = errors else {
            self.add(x, v, p, k, sheet, Source::Solved);
            return;
        };
        if let Some(site) = self.add(x, v, p, k, sheet, Source::Interpolated) {
            self.sites.errors.insert(site, *errors);
        }
    }

    /// Row `k` of arrays `[row][state]`; what is not finite is left out.
    fn add(
        &mut self,
        x: &[f64],
        v: &[f64],
        p: &[f64],
        k: usize,
        sheet: i32,
        source: Source,
    ) -> Option<usize> {
        let n = self.sites.n;
        let row = k * n..(k + 1) * n;
        let reference = &self.plan.system.reference;
        let s: Vec<f64> = x[row.clone()]
            .iter()
            .zip(reference)
            .map(|(x, r)| x - r)
            .collect();
        self.add_deviation(&s, v[k], &p[row], sheet, source)
    }

    fn add_deviation(
        &mut self,
        s: &[f64],
        v: f64,
        p: &[f64],
        sheet: i32,
        source: Source,
    ) -> Option<usize> {
        let n = self.sites.n;
        let widths = &self.plan.widths;
        let z: Vec<f64> = s.iter().zip(widths).map(|(s, w)| s / w).collect();
        let q: Vec<f64> = p.iter().zip(widths).map(|(p, w)| p * w).collect();
        if !v.is_finite() || z.iter().chain(&q).any(|c| !c.is_finite()) {
            return None;
        }
        let radius = z.iter().map(|z| z * z).sum::<f64>().sqrt();
        // Cells of about the wanted distance, in powers of two of it.
        let level = (radius / NEAR).clamp(FINEST, 1.0).log2().floor();
        let size = self.spacing * level.exp2() / (n as f64).sqrt();
        let cell = z.iter().map(|z| (z / size).floor() as i64).collect();
        let here = self.cells.entry((level as i32, cell)).or_default();
        let sites = &mut self.sites;
        // Answers that were asked for are all kept.
        let taken = |&k: &usize| consistent((sites.z(k), sites.v[k], sites.q(k)), (&z, v, &q));
        if source == Source::Sample && here.iter().any(taken) {
            return None;
        }
        here.push(sites.v.len());
        sites.z.extend_from_slice(&z);
        sites.q.extend_from_slice(&q);
        sites.v.push(v);
        sites.sheet.push(sheet);
        sites.source.push(source);
        Some(sites.v.len() - 1)
    }

    /// The sites, without swept samples of sheets far above: where more sheets lie over a cell than
    /// there is room for (see [`SHEETS`]), those of highest V are dropped, or they would crowd out
    /// the lowest among the sites that are looked at. Not of a game, where every sheet counts.
    fn finished(self) -> Sites {
        if self.plan.game {
            return self.sites;
        }
        let mut dropped = vec![false; self.sites.len()];
        for members in self.cells.values().filter(|m| m.len() > SHEETS) {
            let mut by_value = members.clone();
            by_value.sort_by(|a, b| self.sites.v[*a].total_cmp(&self.sites.v[*b]));
            for &k in &by_value[SHEETS..] {
                dropped[k] = self.sites.source[k] == Source::Sample;
            }
        }
        self.sites.without(&dropped)
    }

    /// Levels of V at equal distances leave gaps near the equilibrium: the first is far from the
    /// seeds, and between the first few the radius grows by half and more. A small sweep of its own
    /// fills them.
    fn add_inner(
        &mut self,
        (model, hamiltonian): (&Model, &Hamiltonian),
        plan: &Plan,
        least: f64,
    ) -> Result<(), MapError> {
        /// Distance between neighbours on the outermost front, of its largest radius.
        const SPACING: f64 = 0.15;
        const LEVELS: usize = 8;
        const SAMPLES: usize = 4 * LEVELS;
        const MOST_SEEDS: usize = 4000;
        let Some(local) = &plan.local else {
            return Ok(());
        };
        if !least.is_finite() || least <= 2.0 * local.seed_value {
            return Ok(());
        }
        let n = self.sites.n;
        let mut radius = (0..n)
            .map(|i| {
                let mut s = vec![0.0; n];
                s[i] = plan.widths[i];
                (LEVELS as f64 * least / local.quadratic(&s).max(f64::MIN_POSITIVE)).sqrt()
            })
            .fold(0.0, f64::max);
        let mut model = model.clone();
        let mut inner = plan.shoot_out.clone();
        if plan.sampling == Sampling::ArcLength {
            inner.arc_length *= LEVELS as f64 / inner.samples as f64;
            radius = inner.arc_length;
        } else {
            inner.value_max = Some(LEVELS as f64 * least);
        }
        inner.samples = SAMPLES;
        inner.spacing = SPACING * radius;
        inner.max_seeds = MOST_SEEDS;
        inner.seed_value = SeedValue::Auto;
        model.shoot_out = Some(inner);
        let backend = Cpu::new();
        let plan = Plan::new(&model, hamiltonian, &backend, Choices::default())?;
        sweep::<BackendError>(&plan, &backend, &mut |_, _| {}, &mut |block| {
            for k in 0..block.v.len() {
                self.add(&block.x, &block.v, &block.p, k, UNLABELLED, Source::Sample);
            }
            Ok(())
        })?;
        Ok(())
    }

    /// The equilibrium, and ellipsoids about it as far as the local solution is good.
    fn add_local(&mut self, plan: &Plan) {
        let Some(local) = &plan.local else { return };
        let n = self.sites.n;
        let mut directions: Vec<Vec<f64>> = Vec::new();
        for i in 0..n {
            for sign in [1.0, -1.0] {
                let mut d = vec![0.0; n];
                d[i] = sign;
                directions.push(d.clone());
                for j in 0..i {
                    for other in [1.0, -1.0] {
                        let mut d = d.clone();
                        d[j] = other;
                        directions.push(d);
                    }
                }
            }
        }
        let mut levels = vec![];
        let mut level = local.seed_value;
        // Outward to where the samples begin, each twice as far; the error of V is relative to V.
        // Beyond the reach controls meet their bounds.
        let reach = local.value_within(f64::INFINITY, plan.value_scale);
        while local.error_where(level) <= LOCAL_ERROR * level && level < reach && levels.len() < 8 {
            levels.push(level);
            level *= 4.0;
        }
        let zero = vec![0.0; n];
        self.add_with_hessian(&zero);
        for level in levels {
            for direction in &directions {
                let s: Vec<f64> = direction
                    .iter()
                    .zip(&plan.widths)
                    .map(|(d, w)| d * w)
                    .collect();
                let size = (level / local.quadratic(&s).max(f64::MIN_POSITIVE)).sqrt();
                let s: Vec<f64> = s.iter().map(|s| s * size).collect();
                self.add_with_hessian(&s);
            }
        }
    }

    fn add_with_hessian(&mut self, s: &[f64]) {
        let Some(local) = &self.plan.local else {
            return;
        };
        let (v, p, hessian) = local.expansion(s);
        let n = self.sites.n;
        if let Some(k) = self.add_deviation(s, v, &p, UNLABELLED, Source::Local) {
            let w = &self.plan.widths;
            let scaled = (0..n * n)
                .map(|k| hessian[k] * w[k / n] * w[k % n])
                .collect();
            self.sites.hessian.insert(k, scaled);
        }
    }
}
