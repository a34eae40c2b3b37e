//! How far neighbouring trajectories are apart: on the fronts both pass, and where they end in
//! folds.

use crate::backend::cpu::Simd;

/// Levels looked at together.
pub(super) const BLOCK: usize = 8;

/// What a trajectory has passed, in widths of the region.
#[derive(Clone, Copy)]
pub(super) struct Passed<'p> {
    /// `[state][level]`, each state's levels a multiple of [`BLOCK`] apart.
    pub path: &'p [f32],
    /// Levels passed.
    pub levels: usize,
    /// Whether it has ended at a guard.
    pub at_guard: bool,
    /// Where it has ended in a fold.
    pub fold: Option<&'p [f32]>,
}

/// What gaps are measured by.
pub(super) struct Gaps {
    /// The region in its own widths; endless along periodic states, whose every period meets it
    /// somewhere.
    pub bounds: Vec<[f32; 2]>,
    /// Gap that neighbours may leave.
    pub spacing: f64,
    /// Whether trajectories end in folds.
    pub folds: bool,
    pub simd: Simd,
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn widest_avx2(gaps: &Gaps, a: &[f32], b: &[f32], common: usize) -> f32 {
    gaps.widest_of(a, b, common)
}

impl Gaps {
    /// The widest gap between two trajectories.
    pub fn between(&self, a: Passed<'_>, b: Passed<'_>) -> f32 {
        let common = a.levels.min(b.levels);
        let front = self.widest(a.path, b.path, common);
        if self.folds {
            front.max(self.on_caustic(a, b, common))
        } else {
            front
        }
    }

    /// Widest gap over the fronts that both trajectories reach, where the piece of front between
    /// them may meet the region.
    fn widest(&self, a: &[f32], b: &[f32], common: usize) -> f32 {
        match self.simd {
            // SAFETY: both sets have AVX2, and were detected.
            #[cfg(target_arch = "x86_64")]
            Simd::Avx2 | Simd::Avx512 => unsafe { widest_avx2(self, a, b, common) },
            _ => self.widest_of(a, b, common),
        }
    }

    #[inline(always)]
    fn widest_of(&self, a: &[f32], b: &[f32], common: usize) -> f32 {
        let stride = a.len() / self.bounds.len();
        let mut widest = [0.0f32; BLOCK];
        for from in (0..common).step_by(BLOCK) {
            let mut gap = [0.0f32; BLOCK];
            let mut outside = [0u32; BLOCK];
            for (k, [lo, hi]) in self.bounds.iter().enumerate() {
                let x = &a[k * stride + from..][..BLOCK];
                let y = &b[k * stride + from..][..BLOCK];
                for l in 0..BLOCK {
                    let distance = (x[l] - y[l]).abs();
                    gap[l] = if distance > gap[l] { distance } else { gap[l] };
                    let (low, high) = if x[l] < y[l] {
                        (x[l], y[l])
                    } else {
                        (y[l], x[l])
                    };
                    outside[l] |= u32::from(high < *lo) | u32::from(low > *hi);
                }
            }
            for l in 0..BLOCK {
                let counts = outside[l] == 0 && from + l < common;
                let gap = if counts { gap[l] } else { 0.0 };
                widest[l] = if gap > widest[l] { gap } else { widest[l] };
            }
        }
        widest.into_iter().fold(0.0, f32::max)
    }

    /// Whether a piece of front between two states may lie in the region.
    fn may_meet(&self, x: &[f32], y: &[f32]) -> bool {
        (x.iter().zip(y).zip(&self.bounds))
            .all(|((x, y), [lo, hi])| x.max(*y) >= *lo && x.min(*y) <= *hi)
    }

    /// Gap between the folds that neighbours end in. Where one of them goes on, or its fold is
    /// elsewhere although they have come close together, the caustic has an end between them, and
    /// the gap is closed when they are `CLOSE`.
    fn on_caustic(&self, a: Passed<'_>, b: Passed<'_>, common: usize) -> f32 {
        const CLOSE: f64 = 1.0 / 32.0;
        let distance = |x: &[f32], y: &[f32]| {
            (x.iter().zip(y)).fold(0.0, |widest: f32, (x, y)| widest.max((x - y).abs()))
        };
        let apart = match common.checked_sub(1) {
            None => f32::INFINITY,
            Some(last) => distance(&self.at(a.path, last), &self.at(b.path, last)),
        };
        if f64::from(apart) <= CLOSE * self.spacing {
            return 0.0;
        }
        // What the longer one passes alone may lie in the region although the shorter one ends
        // outside.
        let (longer, shorter) = if a.levels > b.levels { (a, b) } else { (b, a) };
        let alone = || {
            (common..longer.levels).any(|level| {
                let x = self.at(longer.path, level);
                self.may_meet(&x, &x)
            })
        };
        match (a.fold, b.fold) {
            (Some(x), Some(y)) if self.may_meet(x, y) || alone() => distance(x, y),
            // Any gap above the spacing will do.
            (Some(x), None) | (None, Some(x)) if self.may_meet(x, x) || alone() => 1.0,
            // One has left for good, the other comes back. (A guard is no caustic.)
            (None, None) if !shorter.at_guard && alone() => 1.0,
            _ => 0.0,
        }
    }

    /// The state at a level of a path.
    fn at(&self, path: &[f32], level: usize) -> Vec<f32> {
        let stride = path.len() / self.bounds.len();
        path.iter().skip(level).step_by(stride).copied().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of two that part where one ends at a guard there is no caustic between; where it has left
    /// the region, there may be.
    #[test]
    fn a_guard_is_no_caustic() {
        let gaps = Gaps {
            bounds: vec![[-1.0, 1.0]],
            spacing: 0.1,
            folds: true,
            simd: Simd::Baseline,
        };
        let paths = [[0.0; BLOCK], [0.05; BLOCK]];
        for (at_guard, expected) in [(true, 0.05), (false, 1.0)] {
            let [short, long] = [(3, at_guard), (4, false)].map(|(levels, at_guard)| Passed {
                path: &paths[levels - 3],
                levels,
                at_guard,
                fold: None,
            });
            assert_eq!(gaps.between(short, long), expected, "guard: {at_guard}");
        }
    }
}
