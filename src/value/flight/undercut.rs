//! Whether claimed values of V are undercut by flights.

use super::{
    AlongState, AlongTime, Expansion, Flight, Flown, Guide, Law, Linear, PIECES, Pilot, Terminal,
    guides,
};
use crate::backend::BackendError;
use crate::shooting::{Path, Solver};
use crate::sweep::Plan;

/// A flight undercuts a claim by more than this share of V, and this share of the scale of V.
const RELATIVE: f64 = 1e-6;
const ABSOLUTE: f64 = 1e-9;
/// Claims that are flown together.
const COHORT: usize = 4096;

/// A claimed V at a state, with the extremal that it is the cost of.
#[derive(Clone, Debug)]
pub struct Claim<'a> {
    pub value: f64,
    /// Its first node is the state.
    pub path: &'a Path,
    /// Other claims, the likeliest to undercut this one first.
    pub neighbours: Vec<usize>,
}

/// The law of a flight.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Flew {
    Linear,
    Expansion,
    Terminal,
    /// Along a claim's path, by time or by state.
    AlongTime(usize),
    AlongState(usize),
}

/// What flights say of a claim.
#[derive(Clone, Debug)]
pub struct Undercut {
    /// The least cost of a flight that came home before it had cost as much as is claimed; infinite
    /// if none did.
    pub cost: f64,
    /// The law of that flight.
    pub law: Option<Flew>,
    /// Number of flights.
    pub flown: usize,
    /// The path of that flight where it costs less than the claim, beyond the tolerance.
    pub path: Option<Path>,
}

/// Flies from each claim's state under the laws of the scene and along up to `most` of its
/// neighbours. Of a game nothing is flown.
///
/// # Errors
/// Device failures only.
pub fn undercut(
    plan: &Plan,
    pilot: &mut Pilot,
    solver: &mut Solver,
    claims: &[Claim<'_>],
    most: usize,
) -> Result<Vec<Undercut>, BackendError> {
    let mut results = vec![
        Undercut {
            cost: f64::INFINITY,
            law: None,
            flown: 0,
            path: None,
        };
        claims.len()
    ];
    if plan.game {
        return Ok(results);
    }
    let guides = followed(plan, solver, claims, most)?;
    for first in (0..claims.len()).step_by(COHORT) {
        let part = first..claims.len().min(first + COHORT);
        let laws: Vec<Vec<(Flew, Box<dyn Law + '_>)>> = (part.clone())
            .map(|k| laws_for(plan, &claims[k], &guides, most))
            .collect();
        let mut flights = Vec::new();
        let mut of = Vec::new();
        for (k, laws) in part.zip(&laws) {
            for (flew, law) in laws {
                flights.push(Flight {
                    start: claims[k].path.start().to_vec(),
                    law: law.as_ref(),
                    ceiling: claims[k].value + tolerance(plan, claims[k].value),
                });
                of.push((k, *flew));
            }
        }
        for ((k, flew), flown) in of.into_iter().zip(pilot.fly(&flights)?) {
            results[k].learn(plan, claims[k].value, flew, flown);
        }
    }
    Ok(results)
}

/// How far below a claimed V a flight must cost to undercut it.
pub fn tolerance(plan: &Plan, value: f64) -> f64 {
    RELATIVE * value.abs() + ABSOLUTE * plan.value_scale
}

/// Guides of the claims that are some other's neighbour.
fn followed(
    plan: &Plan,
    solver: &mut Solver,
    claims: &[Claim<'_>],
    most: usize,
) -> Result<Vec<Option<Guide>>, BackendError> {
    let mut wanted = vec![false; claims.len()];
    for k in claims
        .iter()
        .flat_map(|claim| claim.neighbours.iter().take(most))
    {
        wanted[*k] = true;
    }
    let paths: Vec<&Path> = (claims.iter().zip(&wanted))
        .filter(|(_, wanted)| **wanted)
        .map(|(claim, _)| claim.path)
        .collect();
    let mut made = guides(plan, solver, &paths, PIECES)?.into_iter();
    Ok(wanted
        .iter()
        .map(|wanted| wanted.then(|| made.next()).flatten())
        .collect())
}

fn laws_for<'a>(
    plan: &'a Plan,
    claim: &Claim<'_>,
    guides: &'a [Option<Guide>],
    most: usize,
) -> Vec<(Flew, Box<dyn Law + 'a>)> {
    let mut laws: Vec<(Flew, Box<dyn Law + 'a>)> = Vec::new();
    if let Some(law) = Linear::new(plan) {
        laws.push((Flew::Linear, Box::new(law)));
    }
    if let Some(law) = Expansion::new(plan) {
        laws.push((Flew::Expansion, Box::new(law)));
    }
    if let Some(law) = Terminal::new(plan) {
        laws.push((Flew::Terminal, Box::new(law)));
    }
    let start = claim.path.start();
    for &k in claim.neighbours.iter().take(most) {
        let Some(guide) = &guides[k] else { continue };
        if plan.local.is_some() {
            laws.push((
                Flew::AlongState(k),
                Box::new(AlongState::new(plan, guide, start)),
            ));
        } else {
            laws.push((
                Flew::AlongTime(k),
                Box::new(AlongTime::new(plan, guide, start)),
            ));
        }
    }
    laws
}

impl Undercut {
    fn learn(&mut self, plan: &Plan, claimed: f64, flew: Flew, flown: Flown) {
        self.flown += 1;
        if flown.cost < self.cost {
            self.cost = flown.cost;
            self.law = Some(flew);
            let undercuts = flown.cost < claimed - tolerance(plan, claimed);
            self.path = flown.path.filter(|_| undercuts);
        }
    }
}
