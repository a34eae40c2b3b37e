//! The law of several known solutions.

use super::{Expansion, Law, tangent, times};
use crate::sweep::Plan;
use crate::value::nearest::{self, MOST_DIMENSIONS, Nearest};

/// Sites looked at: those not further than this many times the nearest one's distance, and how many
/// at most.
const REACH: f64 = 1.5;
const MOST_NEAR: usize = 6;
/// Near the equilibrium the local expansion is used where it is good to this share of V.
const ARRIVED: f64 = 1e-3;

/// What is known of V at a state.
#[derive(Clone, Debug)]
pub struct Site {
    /// Deviation.
    pub s: Vec<f64>,
    pub value: f64,
    pub p: Vec<f64>,
    /// `dp/ds`, row-major; without one p counts as constant.
    pub slope: Option<Vec<f64>>,
}

/// p of known solutions: that of the site nearby (in widths, windings not counted) whose
/// second-order V is least.
pub struct At<'a> {
    sites: &'a [Site],
    index: Box<dyn Nearest>,
    widths: &'a [f64],
    periods: &'a [Option<f64>],
    local: Option<Expansion<'a>>,
}

impl<'a> At<'a> {
    /// `None` without sites, or with more states than are searched.
    pub fn new(plan: &'a Plan, sites: &'a [Site]) -> Option<Self> {
        let n = plan.widths.len();
        if sites.is_empty() || n > MOST_DIMENSIONS {
            return None;
        }
        let places: Vec<f64> = (sites.iter())
            .flat_map(|site| scaled(&once(&site.s, &plan.recurrent), &plan.widths))
            .collect();
        Some(Self {
            sites,
            index: nearest::index(&places, n),
            widths: &plan.widths,
            periods: &plan.recurrent,
            local: Expansion::new(plan),
        })
    }

    /// Sites near a state with their distances; a state at the edge of a period is near to both
    /// ends of it.
    fn near(&self, s: &[f64]) -> Vec<(usize, f64)> {
        let here = once(s, self.periods);
        let mut found = self
            .index
            .near(&scaled(&here, self.widths), f64::INFINITY, MOST_NEAR);
        for (i, period) in self.periods.iter().enumerate() {
            for turn in period.iter().flat_map(|period| [-period, *period]) {
                let mut copy = here.clone();
                copy[i] += turn;
                found.extend(self.index.near(
                    &scaled(&copy, self.widths),
                    f64::INFINITY,
                    MOST_NEAR,
                ));
            }
        }
        let nearest = found.iter().map(|f| f.1).fold(f64::INFINITY, f64::min);
        found.retain(|(_, d)| *d <= REACH * nearest);
        found
    }

    /// The way from a site to the copy of a state nearest to it.
    fn way(&self, site: &Site, s: &[f64]) -> Vec<f64> {
        super::homeward(
            &s.iter()
                .zip(&site.s)
                .map(|(s, at)| s - at)
                .collect::<Vec<_>>(),
            self.periods,
        )
    }

    fn predicted(&self, site: &Site, s: &[f64]) -> f64 {
        let way = self.way(site, s);
        let turned = site
            .slope
            .as_ref()
            .map_or(vec![0.0; s.len()], |x| times(x, &way).collect());
        let second = way.iter().zip(&site.p).zip(&turned);
        site.value + second.map(|((d, p), x)| d * (p + 0.5 * x)).sum::<f64>()
    }
}

impl Law for At<'_> {
    fn costate(&self, _: f64, s: &[f64]) -> Option<(Vec<f64>, Vec<f64>)> {
        if let Some(near) = self
            .local
            .as_ref()
            .and_then(|local| local.within(s, ARRIVED))
        {
            return Some(near);
        }
        let near = self.near(s);
        let predicted = |k: &usize| self.predicted(&self.sites[*k], s);
        let best =
            (near.into_iter().map(|f| f.0)).min_by(|a, b| predicted(a).total_cmp(&predicted(b)))?;
        let site = &self.sites[best];
        let way = self.way(site, s);
        let there: Vec<f64> = s.iter().zip(&way).map(|(s, d)| s - d).collect();
        let slope = site
            .slope
            .clone()
            .unwrap_or_else(|| vec![0.0; s.len() * s.len()]);
        Some(tangent(&site.p, slope, &there))
    }
}

fn scaled(s: &[f64], widths: &[f64]) -> Vec<f64> {
    s.iter().zip(widths).map(|(s, w)| s / w).collect()
}

/// A state with its periodic components within half a period of 0.
fn once(s: &[f64], periods: &[Option<f64>]) -> Vec<f64> {
    super::homeward(s, periods)
}
