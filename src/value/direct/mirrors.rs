//! Mirror images: changes of sign of states and controls that leave the problem as it is.

use super::descent::{Descent, Found, Transcription};
use super::stage::Rates;
use crate::numeric::random::uniform;
use crate::value::targets::Groups;

/// Points at which it is checked, and by what share of their size rates may differ there.
const POINTS: u64 = 8;
const ALIKE: f64 = 1e-9;
/// Share by which an image's cost may be off.
const SAME_COST: f64 = 1e-6;
/// Groups of states and controls that change their signs together, at most.
const MOST_GROUPS: usize = 6;

/// Signs of states and controls, deviations from the equilibrium, under which f changes its sign as
/// the states do, and L does not.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Mirror {
    pub states: Vec<f64>,
    pub controls: Vec<f64>,
}

impl Mirror {
    /// A state's image.
    pub fn of(&self, s: &[f64]) -> Vec<f64> {
        s.iter()
            .zip(&self.states)
            .map(|(s, sign)| sign * s)
            .collect()
    }

    /// An image of controls, those of any number of steps.
    fn controls_of(&self, u: &[f64], middle: &[f64]) -> Vec<f64> {
        let about = middle.iter().zip(&self.controls).cycle();
        (u.iter().zip(about))
            .map(|(u, (middle, sign))| middle + sign * (u - middle))
            .collect()
    }

    /// A trajectory's image, if it is one that costs the same: what is narrow, a bump of the cost on
    /// one side, lies between the points at which the mirror was checked.
    pub fn trajectory(
        &self,
        rates: &Rates,
        problem: &Transcription,
        found: &Found,
    ) -> Option<Found> {
        let all = |rows: &[Vec<f64>]| rows.iter().map(|row| self.of(row)).collect();
        let (n, m) = (self.states.len(), self.controls.len());
        let gain = |(k, gain): (usize, &f64)| self.controls[k / n % m] * self.states[k % n] * gain;
        let image = Found {
            cost: found.cost,
            states: all(&found.states),
            adjoints: all(&found.adjoints),
            controls: self.controls_of(&found.controls, &problem.middle),
            gains: found.gains.iter().enumerate().map(gain).collect(),
            steps: found.steps.clone(),
        };
        let (x, u) = (image.states.concat(), image.controls.clone());
        let there = Descent::from(rates, problem, x, u)?;
        let costs_the_same = (there.cost() - found.cost).abs() <= SAME_COST * found.cost.abs();
        (costs_the_same && there.is_closed()).then_some(image)
    }
}

/// All of them: what is coupled about the equilibrium changes its sign together, and whether that
/// holds is checked at points of the region.
pub(super) fn mirrors(rates: &Rates, problem: &Transcription) -> Vec<Mirror> {
    let (n, m) = (rates.states, rates.controls);
    let mut groups = Groups::new(n + m);
    for (a, b) in rates.couplings(&problem.middle) {
        groups.join(a, b);
    }
    let roots: Vec<usize> = (0..n + m).map(|i| groups.root(i)).collect();
    let mut distinct = roots.clone();
    distinct.sort_unstable();
    distinct.dedup();
    if distinct.len() > MOST_GROUPS {
        return Vec::new();
    }
    let of = |choice: usize| {
        let sign = |root: &usize| {
            let group = distinct.iter().position(|d| d == root).unwrap_or(0);
            if choice >> group & 1 == 1 { -1.0 } else { 1.0 }
        };
        let signs: Vec<f64> = roots.iter().map(sign).collect();
        let (states, controls) = signs.split_at(n);
        Mirror {
            states: states.to_vec(),
            controls: controls.to_vec(),
        }
    };
    (1..1 << distinct.len())
        .map(of)
        .filter(|mirror| mirror.states.contains(&-1.0) && holds(rates, problem, mirror))
        .collect()
}

/// Whether the problem is its own image, at points of the region and in its controls' bounds.
fn holds(rates: &Rates, problem: &Transcription, mirror: &Mirror) -> bool {
    let near = |a: f64, b: f64, size: f64| a == b || (a - b).abs() <= ALIKE * size;
    for ((sign, middle), [lo, hi]) in
        (mirror.controls.iter().zip(&problem.middle)).zip(&problem.bounds)
    {
        let image = 2.0 * middle - hi;
        if *sign < 0.0 && !near(*lo, image, lo.abs().max(1.0)) {
            return false;
        }
    }
    let n = rates.states;
    (0..POINTS).all(|k| {
        let number = |i: usize| 2.0 * uniform(k, i as u64) - 1.0;
        let s: Vec<f64> = (problem.widths.iter().enumerate())
            .map(|(i, width)| 0.5 * number(i) * width)
            .collect();
        let control = |(j, middle): (usize, &f64)| {
            let room = problem.bounds[j].map(|b| (b - middle).abs());
            let room = room[0].min(room[1]);
            middle + number(n + j) * if room.is_finite() { room } else { 1.0 }
        };
        let u: Vec<f64> = problem.middle.iter().enumerate().map(control).collect();
        let here = rates.at(&[s.as_slice(), &u].concat());
        let there = rates.at(&[mirror.of(&s), mirror.controls_of(&u, &problem.middle)].concat());
        let size = here.iter().fold(0.0_f64, |size, v| size.max(v.abs()));
        let signs = mirror.states.iter().chain(&[1.0]);
        (here.iter().zip(&there).zip(signs)).all(|((a, b), sign)| near(sign * a, *b, size))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::Deadline;
    use crate::scenario;

    fn problem(dynamics: &str, running: &str, bounds: [f64; 2]) -> (Rates, Transcription) {
        let text = format!(
            r#"
            states = {{ a = {{}}, b = {{}}, c = {{}} }}
            controls = {{ u = {{}} }}
            dynamics = {{ a = "b", {dynamics} }}
            cost = {{ running = "{running}" }}
            equilibrium = {{ a = 0, b = 0, c = 0, u = 0 }}
            region = {{ a = [-1, 1], b = [-1, 1], c = [-1, 1] }}
            shoot_out = {{ value_max = 1 }}
            "#
        );
        let model = scenario::parse(&text, "test", &[]).expect("a scene");
        let problem = Transcription {
            steps: vec![0.1; 60],
            widths: vec![2.0; 3],
            middle: vec![0.0],
            bounds: vec![bounds],
            end: vec![0.0; 9],
            deadline: Deadline::default(),
        };
        (Rates::new(&model), problem)
    }

    fn of(dynamics: &str, running: &str, bounds: [f64; 2]) -> Vec<Mirror> {
        let (rates, problem) = problem(dynamics, running, bounds);
        mirrors(&rates, &problem)
    }

    /// A bump that none of the points meets: images of what goes by it are none.
    #[test]
    fn images_beside_a_bump_on_one_side() {
        let free = [f64::NEG_INFINITY, f64::INFINITY];
        let dynamics = r#"b = "-a - 2*b + u", c = "-c""#;
        let cost = "a^2 + b^2 + c^2 + u^2 + 100*exp(-((a - 0.4)^2 + b^2 + (c - 0.4)^2)/2e-3)";
        let (rates, problem) = problem(dynamics, cost, free);
        let odd = mirrors(&rates, &problem)
            .into_iter()
            .find(|m| m.states == [-1.0; 3])
            .expect("no point meets the bump");
        let from = |s: [f64; 3]| {
            let way = |t: f64| s.iter().map(|s| s * (-t).exp()).collect();
            let guess: Vec<Vec<f64>> = problem.times().map(way).collect();
            let mut descent = Descent::new(&rates, &problem, &guess).expect("finite");
            descent.begin().expect("leads somewhere");
            descent.finish().expect("ends")
        };
        let image = |s: [f64; 3]| odd.trajectory(&rates, &problem, &from(s));
        let apart = image([0.5, 0.0, -0.5]).expect("nothing is in its way");
        let direct = from([-0.5, 0.0, 0.5]);
        assert!((apart.cost - direct.cost).abs() <= 1e-6 * direct.cost);
        assert_eq!(apart.states[0], direct.states[0]);
        // Its image begins on the bump.
        assert!(image([-0.4, 0.0, -0.4]).is_none());
    }

    #[test]
    fn signs_that_leave_the_problem_as_it_is() {
        let free = [f64::NEG_INFINITY, f64::INFINITY];
        let cost = "a^2 + b^2 + c^2 + u^2";
        let signs = |mirrors: Vec<Mirror>| -> Vec<Vec<f64>> {
            let all = |m: Mirror| [m.states, m.controls].concat();
            mirrors.into_iter().map(all).collect()
        };
        // c goes its own way.
        let apart = r#"b = "sin(a) + u", c = "-c^3 - c""#;
        let both = signs(of(apart, cost, free));
        assert_eq!(
            both,
            [[-1.0, -1.0, 1.0, -1.0], [1.0, 1.0, -1.0, 1.0], [-1.0; 4]]
        );
        // It is driven by the square of a: only a, b and u change their signs, and c does not.
        let driven = r#"b = "sin(a) + u", c = "a^2 - c""#;
        assert_eq!(signs(of(driven, cost, free)), [[-1.0, -1.0, 1.0, -1.0]]);
        // A bound on one side, a square in the dynamics, a cost that is not even.
        assert_eq!(signs(of(driven, cost, [-1.0, 2.0])), [[0.0; 4]; 0]);
        let odd = r#"b = "sin(a) + a^2 + u", c = "-c^3 - c^2 - c""#;
        assert_eq!(signs(of(odd, cost, free)), [[0.0; 4]; 0]);
        let uneven = "a^2 + b^2 + c^2 + u^2 + a^3*b^2 + c^3";
        assert_eq!(signs(of(apart, uneven, free)), [[0.0; 4]; 0]);
    }
}
