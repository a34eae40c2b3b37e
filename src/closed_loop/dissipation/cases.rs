//! Which disturbances, from where.

use super::{Certificate, Laws, LoopError};
use crate::closed_loop::Initial;
use crate::closed_loop::forcing::{WAVES, Wave, components};
use crate::model::{self, Model};
use rustc_hash::FxHashMap;
use std::f64::consts::TAU;

/// Band of the sinusoids in units of the closed loop's slowest and fastest eigenvalue.
const BAND: [f64; 2] = [0.1, 5.0];
/// At most this share of the disturbances is the worst case.
const WORST_SHARE: usize = 3;
/// States at which w* is looked at, at most.
const LOOKED_AT: usize = 2000;
/// Random states tried for each one wanted.
const TRIES: usize = 50;
/// A state is the equilibrium if it is this near to it, in widths of the region.
const SAME: f64 = 1e-12;
/// Keeps the random numbers apart from those drawn elsewhere of the same seed.
const OWN: u64 = 0x6469_7373_6970_6174;
/// Random numbers set aside for each case.
const STRIDE: u64 = 1 << 20;

/// What moves the disturbance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DisturbanceKind {
    /// Band-limited noise: eight sinusoids of equal size, one in each part of the band (even on a
    /// logarithmic scale), with random frequencies and phases.
    Random,
    /// One sinusoid, its frequency anywhere in the band.
    Sinusoidal,
    /// w*(x, p), p being dV/dx.
    Worst,
}

impl DisturbanceKind {
    pub const ALL: [(&'static str, Self); 3] = [
        ("random", Self::Random),
        ("sinusoidal", Self::Sinusoidal),
        ("worst_case", Self::Worst),
    ];

    pub fn name(self) -> &'static str {
        Self::ALL
            .iter()
            .find(|(_, k)| *k == self)
            .map_or("?", |(n, _)| n)
    }
}

/// Disturbances and initial states, the same for all laws.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cases {
    pub kind: Vec<DisturbanceKind>,
    /// `[case][state]`.
    pub x0: Vec<f64>,
    pub states: usize,
    /// `[case][disturbance]`: that of the sinusoid, or sqrt(2) times the root mean square of the
    /// noise; NaN for the worst case.
    pub amplitude: Vec<f64>,
    /// `[case][disturbance]`: none for the worst case.
    pub waves: Vec<Vec<Wave>>,
    /// `[case][component]`: what the kernels are given.
    pub(super) forcing: Vec<f64>,
}

/// In [0, 1): a function of seed, case and place alone.
fn uniform(seed: u64, case: usize, place: usize) -> f64 {
    crate::numeric::random::uniform(seed ^ OWN, case as u64 * STRIDE + place as u64)
}

impl Cases {
    pub fn count(&self) -> usize {
        self.kind.len()
    }

    pub fn state(&self, case: usize) -> &[f64] {
        &self.x0[case * self.states..][..self.states]
    }

    /// The disturbances that a scene asks for, and the band of their frequencies.
    ///
    /// The worst case once from each initial state but the equilibrium (where w* = 0), for at most
    /// a third of all; the rest are random and sinusoidal by turns, every other one of both from
    /// the equilibrium, where the inequality is the L2 gain itself.
    ///
    /// # Errors
    /// [`LoopError::NoRates`], [`LoopError::NoAmplitude`], [`LoopError::NoStates`],
    /// [`LoopError::NoCount`].
    pub(super) fn draw(
        laws: &Laws<'_>,
        asked: &model::Dissipation,
        certificate: &Certificate<'_>,
        seed: u64,
    ) -> Result<(Self, [f64; 2]), LoopError> {
        let model = laws.model;
        let n = model.states.len();
        let sizes = || {
            laws.riccati()
                .into_iter()
                .flat_map(|r| r.eigenvalues.iter().map(|e| e.norm()))
        };
        let [slow, fast] = [
            sizes().fold(f64::INFINITY, f64::min),
            sizes().fold(0.0, f64::max),
        ];
        let auto = (slow > 0.0 && fast > 0.0 && slow.is_finite())
            .then(|| [BAND[0] * slow, BAND[1] * fast]);
        let band = (asked.frequencies.or(auto)).ok_or(LoopError::NoRates { key: "frequencies" })?;
        // As many states as disturbances from each.
        let spread = || spread(model, certificate, asked.disturbances.isqrt().max(2), seed);
        let states = match &asked.initial {
            Some(axes) => Initial::of_axes(model, axes)?.x,
            None => spread(),
        };
        let amplitude = match &asked.amplitude {
            Some(given) => given.clone(),
            None => {
                let largest = largest(laws, certificate, &states);
                let some = largest.iter().all(|a| *a > 0.0);
                let found = if some {
                    largest
                } else {
                    self::largest(laws, certificate, &spread())
                };
                if found.contains(&0.0) {
                    return Err(LoopError::NoAmplitude);
                }
                found
            }
        };
        let at_rest = |x: &&[f64]| {
            (x.iter().zip(model.reference()).zip(&model.region))
                .all(|((x, r), [lo, hi])| (x - r).abs() <= SAME * (hi - lo))
        };
        let rest = states.chunks_exact(n).find(at_rest);
        let others: Vec<&[f64]> = states.chunks_exact(n).filter(|x| !at_rest(x)).collect();
        let worst = others.len().min(asked.disturbances.div_ceil(WORST_SHARE));
        let mut this = Self {
            states: n,
            ..Self::default()
        };
        for case in 0..asked.disturbances {
            let number = case.saturating_sub(worst);
            let turn = number / 2;
            let (kind, from) = match (rest, others.is_empty()) {
                _ if case < worst => (DisturbanceKind::Worst, others[case * others.len() / worst]),
                (Some(rest), empty) if empty || turn % 2 == 0 => (by_turns(number), rest),
                (Some(_), _) => (by_turns(number), others[(turn / 2) % others.len()]),
                (None, false) => (by_turns(number), others[turn % others.len()]),
                (None, true) => return Err(LoopError::NoStates),
            };
            this.push(kind, from, &amplitude, band, seed);
        }
        Ok((this, band))
    }

    fn push(
        &mut self,
        kind: DisturbanceKind,
        x0: &[f64],
        largest: &[f64],
        [low, high]: [f64; 2],
        seed: u64,
    ) {
        let case = self.count();
        let frequency = |share: f64| low * (high / low).powf(share);
        let waves: Vec<Vec<Wave>> = (largest.iter().enumerate())
            .map(|(j, largest)| {
                let draw = |k: usize| uniform(seed, case, (2 * WAVES + 1) * j + k + 1);
                // In (0, 1]: some are small, some as large as may be.
                let amplitude = largest * (1.0 - draw(0));
                let (count, own) = match kind {
                    DisturbanceKind::Worst => (0, f64::NAN),
                    DisturbanceKind::Sinusoidal => (1, amplitude),
                    DisturbanceKind::Random => (WAVES, amplitude),
                };
                self.amplitude.push(own);
                (0..count)
                    .map(|k| Wave {
                        amplitude: amplitude / (count as f64).sqrt(),
                        frequency: frequency((k as f64 + draw(2 * k + 1)) / count as f64),
                        phase: TAU * draw(2 * k + 2),
                    })
                    .collect()
            })
            .collect();
        let worst = f64::from(u8::from(kind == DisturbanceKind::Worst));
        self.forcing.extend(components(worst, &waves));
        self.waves.extend(waves);
        self.kind.push(kind);
        self.x0.extend_from_slice(x0);
    }
}

fn by_turns(number: usize) -> DisturbanceKind {
    [DisturbanceKind::Random, DisturbanceKind::Sinusoidal][number % 2]
}

/// The equilibrium and random states of the region at which V is known and not negative.
fn spread(model: &Model, certificate: &Certificate<'_>, count: usize, seed: u64) -> Vec<f64> {
    let n = model.states.len();
    let mut all = model.reference().to_vec();
    for k in 0..TRIES * count {
        let draw = |i: usize| uniform(!seed, k, i);
        let x: Vec<f64> = (model.region.iter().enumerate())
            .map(|(i, [lo, hi])| lo + (hi - lo) * draw(i))
            .collect();
        if certificate.local(&x).is_some_and(|(v, _)| v >= 0.0) {
            all.extend(x);
        }
        if all.len() == count * n {
            break;
        }
    }
    all
}

/// Largest |w*| of each disturbance over some states.
fn largest(laws: &Laws<'_>, certificate: &Certificate<'_>, states: &[f64]) -> Vec<f64> {
    let h = laws.hamiltonian;
    let mut values: FxHashMap<_, _> = h.point(laws.model);
    let mut most = vec![0.0; h.disturbance.len()];
    let n = h.states();
    let stride = (states.len() / n).div_ceil(LOOKED_AT).max(1);
    for x in states.chunks_exact(n).step_by(stride) {
        let Some((_, p)) = certificate.local(x) else {
            continue;
        };
        values.extend(h.x.iter().copied().zip(x.iter().copied()));
        values.extend(h.p.iter().copied().zip(p));
        for (most, w) in most.iter_mut().zip(h.graph.eval(&h.disturbance, &values)) {
            *most = f64::max(*most, w.abs());
        }
    }
    most
}
