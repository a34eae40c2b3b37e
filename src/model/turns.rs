//! Angles so many periods away that too little is left of them.

use super::{Model, State};
use crate::numeric::digits::plain;

/// Periods from 0 that an angle may be away. Subtracting them costs as many of the sixteen digits
/// that f64 has as this number has: eleven are left, about what states are solved to. Far beyond it
/// copies of a state cannot even be counted.
pub const MOST_TURNS: f64 = 1e5;

/// An angle that is further away.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{}: {}", self.what(), self.help())]
#[allow(missing_docs, reason = "fields whose name says what they are")]
pub struct TooManyTurns {
    pub name: String,
    pub value: f64,
    pub turns: f64,
    pub period: f64,
}

impl TooManyTurns {
    /// What is wrong.
    #[must_use]
    pub fn what(&self) -> String {
        let (name, value, turns) = (&self.name, plain(self.value), self.turns);
        format!("`{name}` = {value} is {turns:.1e} periods away from 0; at most {MOST_TURNS:e}")
    }

    /// The way out.
    #[must_use]
    pub fn help(&self) -> String {
        let period = plain(self.period);
        format!("subtract whole periods (of {period}), while the number has the angle's digits")
    }
}

impl State {
    /// Whether a value of the state can be counted in its periods, if it has one.
    ///
    /// # Errors
    /// [`TooManyTurns`].
    pub fn check_turns(&self, value: f64) -> Result<(), TooManyTurns> {
        let Some(period) = self.period else {
            return Ok(());
        };
        let turns = (value / period).abs();
        if turns <= MOST_TURNS {
            return Ok(());
        }
        Err(TooManyTurns {
            name: self.variable.name.clone(),
            value,
            turns,
            period,
        })
    }
}

impl Model {
    /// The same of a value of a state by number, or of what follows the states: the time.
    ///
    /// # Errors
    /// [`TooManyTurns`].
    pub fn check_turns_of(&self, component: usize, value: f64) -> Result<(), TooManyTurns> {
        let state = self.states.get(component);
        state.map_or(Ok(()), |state| state.check_turns(value))
    }

    /// The same of states `[state][component]`.
    ///
    /// # Errors
    /// The number of the first state that cannot, and [`TooManyTurns`].
    pub fn check_turns(&self, x: &[f64]) -> Result<(), (usize, TooManyTurns)> {
        let n = self.states.len();
        x.iter().enumerate().try_for_each(|(k, value)| {
            (self.states[k % n].check_turns(*value)).map_err(|error| (k / n, error))
        })
    }
}
