//! Which events a flight looks out for.
//!
//! An event is met where its condition comes true, so what is looked out for depends on the side that
//! a flight is on: an *armed* event waits for its condition, another one for its end. Right after an
//! event the state lies on its surface, where rounding decides the side: there the surface is moved
//! by a little, away from the flight.

/// Grain of time, relative to that of the whole simulation: within it of an event's surface a state
/// lies on it.
pub(super) const GRAIN: f64 = 1e-10;
pub(super) const GRAIN_SINGLE: f64 = 1e-4;

/// A flight's view of an event.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Watch {
    pub armed: bool,
    /// By how much the surface is moved, in units of the condition.
    pub offset: f64,
}

/// What a state is to an event.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Side {
    /// The condition is true and comes true no more than it is.
    Watched(Watch),
    /// It comes true here.
    Met,
}

impl Watch {
    /// A flight that is to go on with an event armed or not; `ahead` and its rate are those of the
    /// state, `grain` is of time.
    pub fn on(armed: bool, (ahead, slope): (f64, f64), grain: f64) -> Self {
        let sign = if armed { 1.0 } else { -1.0 };
        let near = slope.abs() * grain;
        let offset = match sign * ahead > near {
            true => 0.0,
            false => (-sign * ahead).max(0.0) + 2.0 * near,
        };
        Self { armed, offset }
    }

    /// A phase that begins at a state; `just`: with this event.
    pub fn at((ahead, slope): (f64, f64), just: bool, grain: f64) -> Side {
        let near = slope.abs() * grain;
        // It has come true, and goes on being so.
        if just && slope < 0.0 && ahead <= near {
            return Side::Watched(Self::on(false, (ahead, slope), grain));
        }
        if ahead > 0.0 {
            return Side::Watched(Self {
                armed: true,
                offset: 0.0,
            });
        }
        if -ahead > near {
            return Side::Watched(Self::on(false, (ahead, slope), grain));
        }
        match slope > 0.0 {
            true => Side::Watched(Self::on(true, (ahead, slope), grain)),
            false => Side::Met,
        }
    }

    /// The sign of what a guard watches.
    pub fn sign(self) -> f64 {
        if self.armed { 1.0 } else { -1.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_on_the_surface_looks_ahead() {
        let grain = 1e-10;
        // Going away, whatever rounding says.
        for (ahead, just) in [(0.0, false), (-1e-17, true)] {
            let Side::Watched(watch) = Watch::at((ahead, 2.0), just, grain) else {
                panic!("met while leaving");
            };
            assert!(watch.armed && watch.offset + ahead > 0.0 && watch.offset < 1e-9);
        }
        assert_eq!(Watch::at((-1e-17, -2.0), false, grain), Side::Met);
        // Once is enough, but for what rests there.
        for ahead in [1e-17, -1e-17] {
            let Side::Watched(watch) = Watch::at((ahead, -2.0), true, grain) else {
                panic!("met twice");
            };
            assert!(!watch.armed && watch.offset - ahead > 0.0);
        }
        assert_eq!(Watch::at((0.0, 0.0), true, grain), Side::Met);
        // Well inside the condition: that it ends is waited for.
        let Side::Watched(watch) = Watch::at((-0.3, -2.0), false, grain) else {
            panic!("met inside");
        };
        assert!(!watch.armed && watch.offset == 0.0);
        let Side::Watched(watch) = Watch::at((0.3, -2.0), false, grain) else {
            panic!("met outside");
        };
        assert!(watch.armed && watch.offset == 0.0);
    }
}
