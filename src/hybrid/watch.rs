//! Which events a flight looks out for.
//!
//! An event is met where its condition comes true, so what is looked out for depends on the side that
//! a flight is on: an *armed* event waits for its condition, another one for its end. Right after an
//! event the state lies on its surface, where rounding decides the side. So it is told by where the
//! state goes, and by what was so before, and the surface is moved by a little, away from the flight.

use crate::model::Precision;

/// Roundings of a time that an event may be off by.
const TICKS: f64 = 4.0;
/// What is this many roundings of a condition from its surface lies on it.
const ROUNDINGS: f64 = 64.0;
/// The time of an event is known to this, relative to the phase.
pub(super) const LOCATED: f64 = 1e-13;

/// Sizes that are next to nothing.
#[derive(Clone, Copy, Debug)]
pub(super) struct Grain {
    /// Of time: what is this near to a surface lies on it.
    pub time: f64,
    /// The same as a share of a condition's size over the region.
    near: f64,
    /// Share of that size that is rounding; and rounding of time.
    rounding: f64,
    tick: f64,
    epsilon: f64,
    /// A flight that leaves a surface by less than this share does not leave it.
    height: f64,
}

impl Grain {
    /// For flights so long.
    pub fn new(time: f64, precision: Precision) -> Self {
        let (near, rounding, height) = match precision {
            Precision::F64 => (1e-10, 1e-12, 1e-15),
            Precision::F32 => (1e-5, 1e-5, 5e-7),
        };
        Self {
            time: near * time,
            near,
            rounding,
            tick: 0.0,
            epsilon: precision.epsilon(),
            height,
        }
    }

    /// After a time, which is known to so many digits alone.
    pub fn after(self, t: f64) -> Self {
        Self {
            tick: TICKS * self.epsilon * t,
            ..self
        }
    }
}

/// A condition at a state: positive until it is true; its first and second derivative by time, and
/// its size over the region.
#[derive(Clone, Copy, Debug)]
pub(super) struct Here {
    pub ahead: f64,
    pub slope: f64,
    pub curve: f64,
    pub size: f64,
}

impl Here {
    /// What is on the surface is no further away than this.
    fn touch(&self, grain: Grain) -> f64 {
        let slope = self.slope.abs();
        (slope * grain.time).min(grain.near * self.size)
            + grain.rounding * self.size
            + slope * grain.tick
    }

    /// Whether a state on the surface goes to where the condition is not true.
    pub fn leaves(&self, grain: Grain) -> bool {
        match self.is_flat(grain) {
            true => self.curve > 0.0,
            false => self.slope > 0.0,
        }
    }

    /// Whether what the slope does is undone before long.
    pub fn is_flat(&self, grain: Grain) -> bool {
        // It gets as far as slope^2 / (2 |curve|).
        self.slope * self.slope <= 2.0 * self.curve.abs() * grain.height * self.size
    }

    /// What is no nearer to the surface of an event than this, after a phase so long, may be on it.
    pub fn rounding(&self, precision: Precision, flown: f64) -> f64 {
        ROUNDINGS * precision.epsilon() * self.size + self.slope.abs() * 2.0 * LOCATED * flown
    }

    pub fn is_on_surface(&self, grain: Grain) -> bool {
        self.ahead.abs() <= self.touch(grain)
    }
}

/// A flight's view of an event.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Watch {
    pub armed: bool,
    /// By how much the surface is moved, in units of the condition.
    pub offset: f64,
    /// Since when, in the time of the phase: what is met was met after that.
    pub since: f64,
}

/// What a state is to an event.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Side {
    /// The condition comes true no more than it is.
    Watched(Watch),
    /// It comes true here.
    Met,
}

impl Watch {
    /// A flight that is to go on with an event armed or not.
    pub fn on(armed: bool, here: Here, grain: Grain) -> Self {
        let sign = if armed { 1.0 } else { -1.0 };
        let touch = here.touch(grain);
        let offset = match sign * here.ahead > touch {
            true => 0.0,
            false => (-sign * here.ahead).max(0.0) + 2.0 * touch,
        };
        let since = 0.0;
        Self {
            armed,
            offset,
            since,
        }
    }

    /// The same from a time of the phase on.
    pub fn from(self, since: f64) -> Self {
        Self { since, ..self }
    }

    /// A phase that begins at a state. `known`: on the surface since this instant, and whether it
    /// was armed; where nothing is known, the condition was true before.
    pub fn at(here: Here, known: Option<bool>, grain: Grain) -> Side {
        if !here.is_on_surface(grain) {
            return Side::Watched(Self {
                armed: here.ahead > 0.0,
                offset: 0.0,
                since: 0.0,
            });
        }
        match (here.leaves(grain), known) {
            (true, _) => Side::Watched(Self::on(true, here, grain)),
            // It has come true, and goes on being so.
            (false, Some(false)) => Side::Watched(Self::on(false, here, grain)),
            (false, None) if here.ahead > 0.0 => Side::Watched(Self {
                armed: true,
                offset: 0.0,
                since: 0.0,
            }),
            (false, None) => Side::Watched(Self::on(false, here, grain)),
            (false, Some(true)) => Side::Met,
        }
    }

    /// The sign of what a guard watches.
    pub fn sign(self) -> f64 {
        if self.armed { 1.0 } else { -1.0 }
    }

    /// What is positive as long as nothing is met.
    pub fn left(self, ahead: f64) -> f64 {
        self.sign() * ahead + self.offset
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn here(ahead: f64, slope: f64, curve: f64) -> Here {
        Here {
            ahead,
            slope,
            curve,
            size: 1.0,
        }
    }

    fn armed(here: Here, known: Option<bool>) -> Option<bool> {
        match Watch::at(here, known, Grain::new(1.0, Precision::F64)) {
            Side::Met => None,
            Side::Watched(watch) => {
                assert!(watch.left(here.ahead) > 0.0);
                assert!(watch.offset < 1e-9);
                Some(watch.armed)
            }
        }
    }

    #[test]
    fn a_state_on_the_surface_looks_ahead() {
        for ahead in [1e-17, 0.0, -1e-17] {
            // Going away, whatever rounding says; coming, just met or met before it left.
            for known in [None, Some(false), Some(true)] {
                assert_eq!(armed(here(ahead, 2.0, -9.8), known), Some(true));
            }
            assert_eq!(armed(here(ahead, -2.0, 0.0), Some(false)), Some(false));
            assert_eq!(armed(here(ahead, -2.0, 0.0), Some(true)), None);
            // At rest there and pushed in, with a rate that is rounding.
            for slope in [0.0, 1e-17, -1e-17] {
                assert_eq!(armed(here(ahead, slope, -9.8), Some(false)), Some(false));
                assert_eq!(armed(here(ahead, slope, 9.8), Some(false)), Some(true));
            }
        }
        assert_eq!(armed(here(-1e-17, -2.0, 0.0), None), Some(false));
        assert_eq!(armed(here(1e-17, -2.0, 0.0), None), Some(true));
        // Well inside the condition: that it ends is waited for.
        assert_eq!(armed(here(-0.3, -2.0, 0.0), None), Some(false));
        assert_eq!(armed(here(0.3, -2.0, 0.0), Some(false)), Some(true));
    }
}
