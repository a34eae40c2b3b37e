//! Trajectories under the law of a chart that a device asks itself: those it has no answer for are
//! set here, while the others have gone on, and join a later flight at the beginning of that leg.

use super::charted::{Clock, Pilots, When, Wings};
use super::fallback::{Rest, hold_here};
use super::flights::Watch;
use super::simulate::{Batch, Ground};
use crate::backend::{BackendError, Course, Flown, Halt, Relay, Run, Status, Trajectories};
use crate::model::Outside;
use rustc_hash::FxHashMap;
use std::collections::BTreeMap;

/// A trajectory at the beginning of a leg.
#[derive(Clone, Copy)]
struct Waiting {
    of: usize,
    leg: usize,
    /// Whether its law is set.
    given: bool,
}

/// A trajectory that met the step limit in a leg.
struct Stiff {
    of: usize,
    leg: usize,
    /// Its place in the flight.
    lane: usize,
}

/// A batch between flights.
struct Relayed<'b> {
    ground: &'b Ground<'b>,
    pilots: Pilots<'b>,
    batch: &'b mut Batch,
    clock: Clock,
    /// For the next flight.
    waiting: Vec<Waiting>,
    /// By the leg that each is without an answer for.
    lost: BTreeMap<usize, Vec<usize>>,
}

impl Relayed<'_> {
    /// Whether trajectories end where the chart has no answer.
    fn stopped(&self) -> bool {
        self.pilots.outside == Outside::Stop
    }

    /// A trajectory goes on with a leg whose law is not set.
    fn go_on(&mut self, of: usize, leg: usize) {
        self.waiting.push(Waiting {
            of,
            leg,
            given: false,
        });
    }

    fn end(&mut self, of: usize, status: Status, t: f64) {
        self.ground.end(self.batch, of, status, t);
    }

    /// The flight of all that wait, which are put in its order. `watched`: all are looked at.
    fn course(&mut self, watched: bool) -> Course {
        // Those that are looked at come first.
        let all = watched || !self.ground.setting.closed_loop.records.is_empty();
        let kept: Vec<usize> = self.batch.kept.iter().map(|(i, _)| *i).collect();
        let traced = |w: &Waiting| all || kept.contains(&w.of);
        self.waiting.sort_by_key(|w| !traced(w));
        let (waiting, dim) = (&self.waiting, self.batch.dim);
        Course {
            legs: self.clock.all,
            vectors: (waiting.iter())
                .flat_map(|w| &self.batch.end[w.of * dim..][..dim])
                .copied()
                .collect(),
            first: waiting.iter().map(|w| w.leg as u32).collect(),
            given: waiting.iter().map(|w| w.given).collect(),
            traced: waiting.iter().filter(|w| traced(w)).count(),
        }
    }

    /// Notes how the flight of those in this order went; those that met the step limit are
    /// returned.
    fn land(&mut self, order: &[Waiting], flown: &Flown) -> Vec<Stiff> {
        let dim = self.batch.dim;
        let mut stiff = Vec::new();
        for (lane, from) in order.iter().enumerate() {
            let (of, leg) = (from.of, flown.leg[lane] as usize);
            let asked = flown.begun[lane] as usize - usize::from(from.given);
            self.batch.updates += asked;
            if asked > 0 {
                self.pilots.found(of);
            }
            self.batch.end[of * dim..][..dim].copy_from_slice(&flown.end[lane * dim..][..dim]);
            match flown.halt[lane] {
                Halt::Lost => self.lost.entry(leg).or_default().push(of),
                Halt::Paused => self.go_on(of, leg),
                Halt::Ended(Status::StepLimit) if !self.stopped() => {
                    stiff.push(Stiff { of, leg, lane });
                }
                Halt::Ended(status) => {
                    let t = self.clock.step * leg as f64 + flown.time[lane];
                    self.end(of, status, t);
                }
            }
        }
        stiff
    }

    /// Flies with p held what the model of V, next to where V is too steep for it, makes too stiff
    /// to follow.
    fn hold(
        &mut self,
        stiff: &[Stiff],
        flown: &Flown,
        wings: &mut Wings<'_>,
    ) -> Result<(), BackendError> {
        if stiff.is_empty() {
            return Ok(());
        }
        let (dim, clock) = (self.batch.dim, self.clock);
        let mut seeds: Vec<f64> = (stiff.iter())
            .flat_map(|s| &flown.begin[s.lane * dim..][..dim])
            .copied()
            .collect();
        seeds
            .chunks_exact_mut(dim)
            .for_each(|seed| hold_here(seed, self.ground.equations.states));
        let mut again = Trajectories::default();
        wings.fly((&seeds, dim), |_| clock.step, &mut again)?;
        self.ground.see_again(self.batch, stiff, &seeds, &again);
        for (j, Stiff { of, leg, .. }) in stiff.iter().enumerate() {
            self.batch.fallback[*of] += 1;
            self.batch.end[of * dim..][..dim].copy_from_slice(&again.end[j * dim..][..dim]);
            if again.status[j] == Status::Reached && leg + 1 < clock.all {
                self.go_on(*of, leg + 1);
            } else {
                let t = clock.step * *leg as f64 + again.end_time[j];
                self.end(*of, again.status[j], t);
            }
        }
        Ok(())
    }

    /// Sets the laws of those without an answer, so far as it is their turn.
    fn help(
        &mut self,
        wings: &mut Wings<'_>,
        watch: &mut Option<Watch<'_>>,
    ) -> Result<(), BackendError> {
        // A search takes many flights, as many for one as for all that are lost at a leg: so the
        // legs come one after the other, each once, when all others have come there.
        let helped = match self.pilots.outside {
            Outside::Search if !self.waiting.is_empty() => BTreeMap::new(),
            Outside::Search => self.lost.pop_first().into_iter().collect(),
            _ => std::mem::take(&mut self.lost),
        };
        let clock = self.clock;
        for (leg, mut lanes) in helped {
            lanes.sort_unstable();
            let when = When {
                t: &|_| clock.step * leg as f64,
                rest: Rest {
                    legs: clock.all - leg,
                    length: clock.step,
                },
                first: &|_| clock.step,
            };
            let (pilots, batch) = (&mut self.pilots, &mut *self.batch);
            self.ground
                .update(wings, pilots, batch, watch, (&when, &lanes))?;
            let goes_on = lanes
                .into_iter()
                .filter(|i| batch.status[*i] == Status::Reached as i32);
            self.waiting.extend(goes_on.map(|of| Waiting {
                of,
                leg,
                given: true,
            }));
        }
        Ok(())
    }
}

impl Ground<'_> {
    /// Flies a batch with as few round trips as there are legs without an answer one after the
    /// other, and as there is room to tell of legs that are looked at.
    ///
    /// # Errors
    /// Device failures, and a deadline that has passed.
    pub fn by_relay(
        &self,
        (relay, run): (&mut (dyn Relay + '_), &Run),
        mut wings: Wings<'_>,
        pilots: Pilots<'_>,
        batch: &mut Batch,
        watch: &mut Option<Watch<'_>>,
    ) -> Result<(), BackendError> {
        let clock = Clock::of(self.setting.closed_loop);
        let mut flights = Relayed {
            ground: self,
            pilots,
            clock,
            waiting: Vec::new(),
            lost: BTreeMap::new(),
            batch,
        };
        (0..flights.batch.status.len()).for_each(|of| flights.go_on(of, 0));
        while !(flights.waiting.is_empty() && flights.lost.is_empty()) {
            let course = flights.course(watch.is_some());
            self.setting.numerics.deadline.check()?;
            let flown = relay.fly(run, &course)?;
            flights.batch.round_trips += flown.waits;
            let (order, stopped) = (std::mem::take(&mut flights.waiting), flights.stopped());
            let seen = &order[..course.traced];
            self.see(flights.batch, seen, &flown, clock, stopped, watch);
            let stiff = flights.land(&order, &flown);
            flights.hold(&stiff, &flown, &mut wings)?;
            flights.help(&mut wings, watch)?;
            flights.waiting.sort_by_key(|w| w.of);
        }
        let Relayed { pilots, batch, .. } = flights;
        batch.round_trips += wings.trips;
        let alive: Vec<usize> = (0..batch.status.len())
            .filter(|i| batch.status[*i] == Status::Reached as i32)
            .collect();
        self.conclude(pilots, batch, &alive, watch);
        Ok(())
    }

    fn end(&self, batch: &mut Batch, i: usize, status: Status, t: f64) {
        let own = i * batch.dim..(i + 1) * batch.dim;
        batch.status[i] = self.code(status, &batch.start[own.clone()], &batch.end[own]);
        batch.t_end[i] = t;
    }

    /// Shows what is told of the beginnings of legs to whoever looks at it.
    fn see(
        &self,
        batch: &mut Batch,
        seen: &[Waiting],
        flown: &Flown,
        clock: Clock,
        stopped: bool,
        watch: &mut Option<Watch<'_>>,
    ) {
        let (dim, room) = (batch.dim, flown.room);
        let row = |j: usize, r: usize| &flown.rows[(j * room + r) * (dim + 1)..][..dim + 1];
        if let Some(watch) = watch {
            for (j, from) in seen.iter().enumerate() {
                for r in 0..flown.begun[j] as usize {
                    // Of a law that was given what was known is shown already.
                    let (vector, v) = row(j, r).split_at(dim);
                    if !v[0].is_nan() {
                        let t = clock.step * (from.leg + r) as f64;
                        self.show(watch, batch.first + from.of, t, vector, Some(v[0]));
                    }
                }
            }
        }
        let place: FxHashMap<usize, usize> =
            seen.iter().enumerate().map(|(j, w)| (w.of, j)).collect();
        for (i, path) in &mut batch.kept {
            let Some(&j) = place.get(i) else { continue };
            let legs = (0..flown.begun[j] as usize).map(|r| (r, seen[j].leg + r));
            for (r, leg) in legs.filter(|(_, leg)| leg % clock.updates == 0) {
                self.keep(path, clock.step * leg as f64, &row(j, r)[..dim]);
            }
        }
        if self.setting.closed_loop.records.is_empty() {
            return;
        }
        // A leg ends where the next one begins, still with its own law.
        let (n, width) = (self.equations.states, self.observer_width());
        let law = n..2 * n + n * (n + 1) / 2;
        let mut ends = vec![0.0; seen.len() * room * dim];
        for j in 0..seen.len() {
            let begun = flown.begun[j] as usize;
            for r in 0..begun {
                let end = &mut ends[(j * room + r) * dim..][..dim];
                if r + 1 < begun {
                    end.copy_from_slice(&row(j, r + 1)[..dim]);
                    end[law.clone()].copy_from_slice(&row(j, r)[law.clone()]);
                } else {
                    end.copy_from_slice(&flown.end[j * dim..][..dim]);
                }
            }
        }
        let (before, after) = (
            self.observer.eval(&flown.rows, dim + 1),
            self.observer.eval(&ends, dim),
        );
        batch.records.each(|i, view| {
            let Some(&j) = place.get(&i) else { return };
            let begun = flown.begun[j] as usize;
            for r in 0..begun {
                let at = j * room + r;
                let length = match flown.halt[j] {
                    // It is flown again.
                    Halt::Ended(Status::StepLimit) if r + 1 == begun && !stopped => break,
                    Halt::Ended(_) if r + 1 == begun => flown.time[j],
                    _ => clock.step,
                };
                let both = [
                    &before[at * width..][..width],
                    &after[at * width..][..width],
                ];
                view.see(length, &row(j, r)[..dim], both);
            }
        });
    }

    /// Shows legs that were flown with p held to the records of their trajectories.
    fn see_again(&self, batch: &mut Batch, stiff: &[Stiff], seeds: &[f64], again: &Trajectories) {
        if self.setting.closed_loop.records.is_empty() {
            return;
        }
        let (dim, width) = (batch.dim, self.observer_width());
        let (before, after) = (
            self.observer.eval(seeds, dim),
            self.observer.eval(&again.end, dim),
        );
        batch.records.each(|i, view| {
            if let Some(j) = stiff.iter().position(|s| s.of == i) {
                let both = [&before[j * width..][..width], &after[j * width..][..width]];
                view.see(again.end_time[j], &seeds[j * dim..][..dim], both);
            }
        });
    }
}
