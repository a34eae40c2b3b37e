//! Laws that a scene has of itself: of its linearization, of the local expansion, of the terminal
//! cost.

use super::{Law, homeward, tangent};
use crate::local::LocalSolution;
use crate::shooting::End;
use crate::sweep::Plan;

/// The expansion is used where its error is at most this share of V: further out the linear law
/// does better.
const RANGE: f64 = 0.05;

/// `p = P (s - s*)` about the nearest winding of the equilibrium (the Riccati solution).
pub struct Linear<'a> {
    local: &'a LocalSolution,
    periods: &'a [Option<f64>],
}

impl<'a> Linear<'a> {
    /// `None` on a finite horizon.
    pub fn new(plan: &'a Plan) -> Option<Self> {
        Some(Self {
            local: plan.local.as_ref()?,
            periods: &plan.recurrent,
        })
    }

    fn about(&self, s: &[f64], home: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let equilibrium: Vec<f64> = s.iter().zip(home).map(|(s, home)| s - home).collect();
        // Symmetric: by columns is by rows.
        let p = self.local.riccati.p.as_slice().to_vec();
        tangent(&vec![0.0; s.len()], p, &equilibrium)
    }
}

impl Law for Linear<'_> {
    fn costate(&self, _: f64, s: &[f64]) -> Option<(Vec<f64>, Vec<f64>)> {
        Some(self.about(s, &homeward(s, self.periods)))
    }
}

/// Gradient and Hessian of the local expansion of V about the nearest winding of the equilibrium;
/// [`Linear`] outside its range.
pub struct Expansion<'a> {
    linear: Linear<'a>,
}

impl<'a> Expansion<'a> {
    /// `None` on a finite horizon.
    pub fn new(plan: &'a Plan) -> Option<Self> {
        Linear::new(plan).map(|linear| Self { linear })
    }

    /// The expansion's costate where its estimated error is at most a `share` of V.
    pub(super) fn within(&self, s: &[f64], share: f64) -> Option<(Vec<f64>, Vec<f64>)> {
        self.within_about(s, homeward(s, self.linear.periods), share)
    }

    /// The same about the winding of the equilibrium from which the state is `home` away.
    pub(super) fn within_about(
        &self,
        s: &[f64],
        home: Vec<f64>,
        share: f64,
    ) -> Option<(Vec<f64>, Vec<f64>)> {
        let local = self.linear.local;
        let quadratic = local.quadratic(&home);
        if local.error_where(quadratic) > share * quadratic {
            return None;
        }
        let (_, p, hessian) = local.expansion(&home);
        let finite = p.iter().chain(&hessian).all(|x| x.is_finite());
        finite.then(|| tangent(&p, hessian, s))
    }
}

impl Law for Expansion<'_> {
    fn costate(&self, t: f64, s: &[f64]) -> Option<(Vec<f64>, Vec<f64>)> {
        self.within(s, RANGE).or_else(|| self.linear.costate(t, s))
    }
}

/// A costate that goes evenly from one to another in a time, whatever the state: a control that
/// changes sign at most once, or about a constant one.
pub struct Drifting {
    pub from: Vec<f64>,
    pub to: Vec<f64>,
    pub time: f64,
}

impl Law for Drifting {
    fn costate(&self, t: f64, s: &[f64]) -> Option<(Vec<f64>, Vec<f64>)> {
        let share = (t / self.time).clamp(0.0, 1.0);
        let p = (self.from.iter().zip(&self.to)).map(|(from, to)| from + share * (to - from));
        Some((p.collect(), vec![0.0; s.len() * s.len()]))
    }
}

/// The gradient of the terminal cost, as if the final time were now.
pub struct Terminal {
    end: End,
}

impl Terminal {
    /// `None` on an infinite horizon.
    pub fn new(plan: &Plan) -> Option<Self> {
        plan.system.terminal.as_ref()?;
        Some(Self {
            end: End::new(&plan.system, None),
        })
    }
}

impl Law for Terminal {
    fn costate(&self, _: f64, s: &[f64]) -> Option<(Vec<f64>, Vec<f64>)> {
        let at = self.end.at(s);
        let finite = at.gradient.iter().chain(&at.hessian).all(|x| x.is_finite());
        finite.then(|| tangent(&at.gradient, at.hessian, s))
    }
}
