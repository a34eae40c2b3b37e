//! An independent check of V at solved states: V on a grid, which knows nothing of extremals, and
//! what its greedy paths lead to.

use super::flight::tolerance;
use super::survey::Survey;
use super::targets::Targets;
use crate::backend::BackendError;
use crate::dynamic_programming::GridValue;
use crate::numeric::quantile::nearest_rank;
use crate::shooting::Solver;
use crate::sweep::Plan;

/// States of which all greedy paths are flown; of more only those where the grid is lower, and some
/// spread evenly.
const ALL: usize = 600;
const LOWER: usize = 400;
const SPREAD: usize = 300;
/// Differences of V below this share of the median V are relative to that share: next to the
/// equilibrium the grid says nothing.
const SMALL: f64 = 0.01;
/// The grid's error is not above what this share of the states' differences stay below.
const USUAL: f64 = 0.9;
/// Share of V to which the cost of a greedy flight is good, the local solution at its end included.
const FLIGHT: f64 = 0.01;

/// V as claimed at some states.
#[derive(Clone, Debug, Default)]
pub struct Claims {
    /// `[state][n]`, absolute.
    pub x: Vec<f64>,
    pub v: Vec<f64>,
    /// What V may be off by, where it was interpolated; 0 where it was solved for.
    pub error: Vec<f64>,
}

/// Where the greedy path from a state led.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Led {
    /// To an extremal that costs what is claimed.
    Same,
    /// To a cheaper extremal.
    Lower,
    /// To a dearer extremal.
    Dearer,
    /// To no extremal.
    Nowhere,
}

/// What came of the greedy path from a state.
#[derive(Clone, Debug)]
pub struct Flown {
    /// Index of the claim.
    pub claim: usize,
    /// Cost of the flight, good to about a hundredth; `None` where it led nowhere.
    pub cost: Option<f64>,
    pub led: Led,
    /// V and dV/dx of the extremal that was found.
    pub found: Option<(f64, Vec<f64>)>,
    /// Whether something cheaper than the claim is known: the extremal, or the flight alone.
    pub undercut: bool,
}

/// What V on a grid says of claims.
#[derive(Clone, Debug, Default)]
pub struct Comparison {
    /// V of the grid at each claim; `None` where it does not know the state.
    pub grid: Vec<Option<f64>>,
    /// `(grid - V) / V` of those.
    pub differences: Vec<Option<f64>>,
    /// The greedy paths that were flown.
    pub flown: Vec<Flown>,
}

/// Compares claims with V on a grid, and solves from the grid's greedy paths: of all claims, or of
/// many of those where the grid is lower than its error (at most `apart`, a share of V) explains,
/// and of some spread evenly.
///
/// # Errors
/// Device failures only.
pub fn referee(
    plan: &Plan,
    solver: &mut Solver,
    grid: &GridValue,
    claims: &Claims,
    apart: f64,
) -> Result<Comparison, BackendError> {
    let n = plan.system.states;
    let targets = Targets::new(n, &[], &[], &claims.x, &plan.widths);
    let mut survey = Survey::new(plan, &targets, solver)?;
    survey.windings = vec![vec![0; n]];
    let said: Vec<Option<f64>> = (0..claims.v.len())
        .map(|k| grid.value(&survey.state(targets.of_given[k], 0)))
        .collect();
    let differences = differences(&said, &claims.v);
    let chosen = chosen(&differences, apart);
    let mut wanted: Vec<usize> = chosen.iter().map(|k| targets.of_given[*k]).collect();
    wanted.sort_unstable();
    wanted.dedup();
    let greedy = survey.try_greedy(solver, grid, &wanted)?;
    let flown = (chosen.into_iter())
        .filter_map(|claim| {
            let place = wanted.binary_search(&targets.of_given[claim]).ok()?;
            let found = greedy[place].extremal.map(|e| &survey.extremals[e]);
            let found = found.map(|e| (e.value(), e.adjoint().to_vec()));
            Some(judged(plan, (claim, claims), greedy[place].cost, found))
        })
        .collect();
    Ok(Comparison {
        grid: said,
        differences,
        flown,
    })
}

fn judged(
    plan: &Plan,
    (claim, claims): (usize, &Claims),
    cost: Option<f64>,
    found: Option<(f64, Vec<f64>)>,
) -> Flown {
    let v = claims.v[claim];
    let enough = tolerance(plan, v) + claims.error[claim];
    let led = match &found {
        None => Led::Nowhere,
        Some((value, _)) if *value < v - enough => Led::Lower,
        Some((value, _)) if *value > v + enough => Led::Dearer,
        Some(_) => Led::Same,
    };
    let flight = cost.is_some_and(|cost| cost < v - FLIGHT * v.abs() - enough);
    Flown {
        claim,
        cost,
        undercut: led == Led::Lower || flight,
        led,
        found,
    }
}

fn differences(grid: &[Option<f64>], v: &[f64]) -> Vec<Option<f64>> {
    let mut sizes: Vec<f64> = v.iter().map(|v| v.abs()).collect();
    sizes.sort_by(f64::total_cmp);
    let least = (SMALL * nearest_rank(&sizes, 0.5)).max(f64::MIN_POSITIVE);
    (grid.iter().zip(v))
        .map(|(grid, v)| grid.map(|grid| (grid - v) / v.abs().max(least)))
        .collect()
}

/// The claims from whose states greedy paths are flown, in order.
fn chosen(differences: &[Option<f64>], apart: f64) -> Vec<usize> {
    let known: Vec<(usize, f64)> = (differences.iter().enumerate())
        .filter_map(|(k, d)| d.map(|d| (k, d)))
        .collect();
    if known.len() <= ALL {
        return known.into_iter().map(|(k, _)| k).collect();
    }
    let mut sizes: Vec<f64> = known.iter().map(|(_, d)| d.abs()).collect();
    sizes.sort_by(f64::total_cmp);
    let error = nearest_rank(&sizes, USUAL).min(apart);
    let mut lower: Vec<(usize, f64)> = known.iter().copied().filter(|(_, d)| *d < -error).collect();
    lower.sort_by(|a, b| a.1.total_cmp(&b.1));
    let spread = (0..SPREAD).map(|j| known[j * known.len() / SPREAD].0);
    let mut list: Vec<usize> = lower
        .into_iter()
        .take(LOWER)
        .map(|(k, _)| k)
        .chain(spread)
        .collect();
    list.sort_unstable();
    list.dedup();
    list
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_many_states_the_lower_ones_and_a_sample_are_flown() {
        let mut differences: Vec<Option<f64>> =
            (0..2000).map(|k| Some(1e-3 * f64::from(k % 10))).collect();
        for k in (0..2000).step_by(401) {
            differences[k] = Some(-0.2);
        }
        differences[7] = None;
        let list = chosen(&differences, 0.1);
        assert!(
            (0..2000).step_by(401).all(|k| list.contains(&k)),
            "every suspect"
        );
        assert!(!list.contains(&7) && list.len() <= SPREAD + 5);
        assert!(list.is_sorted() && list.windows(2).all(|w| w[0] < w[1]));
        // Few are all flown, but where the grid knows nothing.
        assert_eq!(chosen(&differences[..20], 0.1).len(), 19);
    }

    #[test]
    fn differences_next_to_the_equilibrium_are_of_the_usual_v() {
        let found = differences(&[Some(1.1), Some(1e-3), None], &[1.0, 0.0, 1.0]);
        assert!((found[0].unwrap_or(0.0) - 0.1).abs() < 1e-12);
        assert!((found[1].unwrap_or(0.0) - 0.1).abs() < 1e-12);
        assert_eq!(found[2], None);
    }
}
