//! The smallest level whose region of validity covers given states.

use crate::value::PointStatus;
use std::collections::BTreeMap;

/// Values between the ends at which coverage is looked at before the answer is narrowed.
const COARSE: usize = 5;
/// Points of the curve, at least.
const LEAST_ROWS: usize = 14;
/// Evaluations, at most.
const MOST_ROWS: usize = 60;
/// Without a range, the value is doubled so often until the states are covered.
const DOUBLINGS: usize = 6;
/// The curve goes on to so many times the answer.
const BEYOND: f64 = 1.5;
/// Default levels between gamma* (0) and the smallest covering value (1), by the logarithm.
const SHARES: [f64; 2] = [0.12, 0.5];

/// What is known of the states at one level.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// One a state.
    pub status: Vec<PointStatus>,
    /// NaN where not valid.
    pub v: Vec<f64>,
    /// States where trajectories met folds.
    pub folds: Vec<Vec<f64>>,
    /// Why the scene could not be swept at this level.
    pub failure: Option<String>,
}

/// One level of the curve.
#[derive(Clone, Debug)]
pub struct Row {
    pub value: f64,
    pub outcome: Outcome,
}

impl Row {
    /// States that are asked for: those inside the guards.
    pub fn wanted(&self) -> usize {
        (self.outcome.status.iter())
            .filter(|s| **s != PointStatus::OutsideGuard)
            .count()
    }

    /// States at which V is valid.
    pub fn valid(&self) -> usize {
        (self.outcome.status.iter())
            .filter(|s| **s == PointStatus::Converged)
            .count()
    }

    /// Share of the wanted states that are valid; NaN if none is wanted.
    pub fn coverage(&self) -> f64 {
        self.valid() as f64 / self.wanted() as f64
    }

    pub fn covers(&self) -> bool {
        self.wanted() > 0 && self.valid() == self.wanted()
    }

    /// Numbers of states by status, those that are valid or outside a guard left out; the most
    /// frequent first.
    pub fn failing(&self) -> Vec<(PointStatus, usize)> {
        let mut counts: BTreeMap<i32, (PointStatus, usize)> = BTreeMap::new();
        let failing =
            |s: &&PointStatus| !matches!(s, PointStatus::Converged | PointStatus::OutsideGuard);
        for status in self.outcome.status.iter().filter(failing) {
            counts.entry(*status as i32).or_insert((*status, 0)).1 += 1;
        }
        let mut counts: Vec<_> = counts.into_values().collect();
        counts.sort_by_key(|(_, n)| std::cmp::Reverse(*n));
        counts
    }
}

/// Between which values is searched, and how exactly.
#[derive(Clone, Copy, Debug)]
pub struct Sought {
    /// gamma* of the linearization, below which nothing is asked.
    pub star: f64,
    /// Whether `star` itself may be asked: it is the lower end of a range, not the end of what is
    /// possible.
    pub allowed: bool,
    /// The scene's own value.
    pub own: f64,
    /// Upper end; `None`: from `own` on by factors of two.
    pub top: Option<f64>,
    /// Relative width of the answer's bracket.
    pub tolerance: f64,
}

/// The answer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Covering {
    /// All values looked at from `upper` on cover; `lower`, the next one below it, does not.
    Smallest { lower: f64, upper: f64 },
    /// All values looked at cover, down to this one: gamma* itself to the tolerance, or the lower
    /// end of the range.
    All { upper: f64 },
    /// The largest value looked at does not cover.
    Never { top: f64, coverage: f64 },
}

/// What was seen.
#[derive(Clone, Debug)]
pub struct Search {
    /// By rising value.
    pub rows: Vec<Row>,
    pub covering: Covering,
    /// Whether coverage never falls with a rising value.
    pub monotone: bool,
}

impl Search {
    /// The smallest value from which on all that were looked at cover.
    pub fn smallest(&self) -> Option<f64> {
        match self.covering {
            Covering::Smallest { upper, .. } | Covering::All { upper } => Some(upper),
            Covering::Never { .. } => None,
        }
    }

    /// Values below the answer that cover nevertheless.
    pub fn covering_below(&self) -> Vec<f64> {
        let smallest = self.smallest().unwrap_or(f64::INFINITY);
        let below = self
            .rows
            .iter()
            .filter(|r| r.covers() && r.value < smallest);
        below.map(|r| r.value).collect()
    }

    /// The row next below the answer, whose states fail first; the last one where nothing covers.
    pub fn first_failing(&self) -> Option<&Row> {
        let at = match self.covering {
            Covering::Smallest { lower, .. } => lower,
            Covering::Never { top, .. } => top,
            Covering::All { .. } => return None,
        };
        self.rows.iter().find(|r| r.value == at)
    }
}

/// Searches for the smallest value that covers: the upper end first, a coarse curve, bisection of
/// the logarithm, then `levels` (chosen where there are none) and what the curve still lacks.
/// Returned with the levels.
///
/// # Errors
/// Those of `evaluate`.
pub fn search<E>(
    sought: &Sought,
    levels: &[f64],
    evaluate: &mut dyn FnMut(f64) -> Result<Outcome, E>,
) -> Result<(Search, Vec<f64>), E> {
    let mut curve = Curve {
        rows: Vec::new(),
        evaluate,
    };
    let Sought {
        star, tolerance, ..
    } = *sought;
    let near = if sought.allowed {
        star
    } else {
        star * (1.0 + tolerance)
    };
    let mut top = sought
        .top
        .unwrap_or(sought.own)
        .max(near * (1.0 + tolerance));
    let mut covered = curve.at(top)?;
    for _ in 0..DOUBLINGS {
        if covered || sought.top.is_some() {
            break;
        }
        top *= 2.0;
        covered = curve.at(top)?;
    }
    for k in 0..COARSE {
        curve.at(between(near, top, k as f64 / COARSE as f64))?;
    }
    curve.narrow(tolerance)?;
    let own = sought.own.max(near);
    let levels = if levels.is_empty() {
        let end = curve
            .covering()
            .value()
            .map_or(own, |c| c.min(own))
            .max(near);
        let mut chosen = SHARES.map(|s| between(star, end, s).max(near)).to_vec();
        chosen.push(own);
        chosen.dedup_by(|a, b| *a / *b < 1.0 + tolerance);
        chosen
    } else {
        levels.to_vec()
    };
    for level in &levels {
        curve.at(*level)?;
    }
    let beyond = curve.covering().value().map_or(top, |c| BEYOND * c);
    if beyond > top {
        top = sought.top.map_or(beyond, |most| beyond.min(most));
        curve.at(top)?;
    }
    // What is looked at for the curve may move the answer.
    loop {
        curve.narrow(tolerance)?;
        if curve.rows.len() >= LEAST_ROWS || !curve.fill()? {
            break;
        }
    }
    let covering = curve.covering();
    let coverage: Vec<f64> = curve.rows.iter().map(Row::coverage).collect();
    let search = Search {
        covering: covering.known(&curve.rows, sought),
        monotone: coverage.windows(2).all(|w| w[1] >= w[0]),
        rows: curve.rows,
    };
    Ok((search, levels))
}

/// The value at a share of the way, by the logarithm.
fn between(from: f64, to: f64, share: f64) -> f64 {
    if share == 0.0 {
        from
    } else {
        from * (to / from).powf(share)
    }
}

/// Neighbouring values between which coverage becomes complete for good.
enum Edge {
    Between(f64, f64),
    /// Everything covers; with the smallest value looked at.
    All(f64),
    Never,
}

impl Edge {
    fn value(&self) -> Option<f64> {
        match self {
            Edge::Between(_, upper) | Edge::All(upper) => Some(*upper),
            Edge::Never => None,
        }
    }

    fn known(&self, rows: &[Row], sought: &Sought) -> Covering {
        match *self {
            Edge::Between(lower, upper) => Covering::Smallest { lower, upper },
            Edge::All(upper) => Covering::All { upper },
            Edge::Never => Covering::Never {
                top: rows.last().map_or(sought.star, |r| r.value),
                coverage: rows.last().map_or(0.0, Row::coverage),
            },
        }
    }
}

/// Rows by rising value, and what makes them.
struct Curve<'e, E> {
    rows: Vec<Row>,
    evaluate: &'e mut dyn FnMut(f64) -> Result<Outcome, E>,
}

impl<E> Curve<'_, E> {
    /// Looks at a value, unless that has been done; whether it covers.
    fn at(&mut self, value: f64) -> Result<bool, E> {
        let k = self.rows.partition_point(|r| r.value < value);
        if self.rows.get(k).is_none_or(|r| r.value != value) {
            let outcome = (self.evaluate)(value)?;
            self.rows.insert(k, Row { value, outcome });
        }
        Ok(self.rows[k].covers())
    }

    fn covering(&self) -> Edge {
        match (
            self.rows.iter().rposition(|r| !r.covers()),
            self.rows.first(),
        ) {
            (Some(k), _) if k + 1 == self.rows.len() => Edge::Never,
            (Some(k), _) => Edge::Between(self.rows[k].value, self.rows[k + 1].value),
            (None, Some(first)) => Edge::All(first.value),
            (None, None) => Edge::Never,
        }
    }

    /// Bisects until the answer's bracket is narrow enough.
    fn narrow(&mut self, tolerance: f64) -> Result<(), E> {
        while let Edge::Between(lower, upper) = self.covering() {
            if upper / lower - 1.0 <= tolerance || self.rows.len() >= MOST_ROWS {
                break;
            }
            self.at(between(lower, upper, 0.5))?;
        }
        Ok(())
    }

    /// Looks at the middle of the widest gap; `false` where there is none.
    fn fill(&mut self) -> Result<bool, E> {
        let gaps = self.rows.windows(2).map(|w| (w[0].value, w[1].value));
        let Some((a, b)) = gaps.max_by(|x, y| (x.1 / x.0).total_cmp(&(y.1 / y.0))) else {
            return Ok(false);
        };
        if b / a < 1.0 + 1e-6 {
            return Ok(false);
        }
        self.at(between(a, b, 0.5))?;
        Ok(true)
    }
}
