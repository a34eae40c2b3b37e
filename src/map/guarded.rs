//! States that guards exclude.

use crate::backend::cpu::Evaluator;
use crate::program::Program;
use crate::sweep::{Plan, spread_over};

/// A guard's margin below 0 by this share of its size is rounding.
pub(crate) const GUARD_ROUNDING: f64 = 1e-12;
/// Where guards exclude most of a region, so many times as many states are drawn at most.
const MOST_DRAWN: usize = 256;

/// A scene's guards that depend on the state alone.
pub(super) struct Guarded {
    margins: Evaluator,
    /// Sizes of their margins.
    sizes: Vec<f64>,
    reference: Vec<f64>,
}

impl Guarded {
    /// `None` where there are none.
    pub fn of(plan: &Plan) -> Option<Self> {
        let system = &plan.system;
        let guards = system.guards_of_state();
        (!guards.is_empty()).then(|| Self {
            margins: Evaluator::new(&Program::lower(
                &system.graph,
                &system.inputs[..system.states],
                &guards,
            )),
            sizes: system.guard_sizes(&plan.region),
            reference: system.reference.clone(),
        })
    }

    /// Whether a guard excludes each of some states (absolute), by more than rounding.
    pub fn excluded(&self, x: &[f64]) -> Vec<bool> {
        let s: Vec<f64> = (x.iter().zip(self.reference.iter().cycle()))
            .map(|(x, r)| x - r)
            .collect();
        let margins = self.margins.eval(&s, self.reference.len());
        let excluded = margins.chunks_exact(self.sizes.len()).map(|margins| {
            // Where a guard is not a number it does not hold.
            let holds = |(margin, size): (&f64, &f64)| *margin >= -GUARD_ROUNDING * size;
            !margins.iter().zip(&self.sizes).all(holds)
        });
        excluded.collect()
    }

    /// Those of some states (absolute, and with what else may follow) that no guard excludes.
    pub fn admitted(&self, mut states: Vec<Vec<f64>>) -> Vec<Vec<f64>> {
        let n = self.reference.len();
        let x: Vec<f64> = states.iter().flat_map(|x| x[..n].iter().copied()).collect();
        let mut excluded = self.excluded(&x).into_iter();
        states.retain(|_| excluded.next() == Some(false));
        states
    }

    /// So many states spread over bounds, among which guards exclude few: where they exclude most
    /// of them, others are drawn.
    pub fn spread(&self, bounds: &[[f64; 2]], count: usize) -> Vec<Vec<f64>> {
        let states = spread_over(bounds, count);
        let mut some = self.admitted(states.clone());
        if 2 * some.len() >= count {
            return states;
        }
        let mut drawn = 1;
        while some.len() < count && drawn < MOST_DRAWN {
            drawn *= 4;
            some = self.admitted(spread_over(bounds, drawn * count));
        }
        some.truncate(count);
        some
    }
}
