//! Trajectories under the law of a chart that a device asks itself: those it has no answer for are
//! set here, while the others have gone on, and join a later flight at the beginning of that leg.

use super::charted::{Clock, Pilots, When, Wings};
use super::fallback::{Rest, hold_here};
use super::flights::Watch;
use super::simulate::{Batch, Ground};
use crate::backend::{BackendError, Course, Flown, Halt, Relay, Run, Status, Trajectories};
use crate::model::Outside;
use std::collections::{BTreeMap, HashMap};

/// A trajectory at the beginning of a leg.
#[derive(Clone, Copy)]
struct Waiting {
    of: usize,
    leg: usize,
    /// Whether its law is set.
    given: bool,
}

impl Ground<'_> {
    /// Flies a batch with as few round trips as there are legs without an answer one after the
    /// other, and as there is room to tell of legs that are looked at.
    pub fn by_relay(
        &self,
        (relay, run): (&mut (dyn Relay + '_), &Run),
        mut wings: Wings<'_>,
        mut pilots: Pilots<'_>,
        batch: &mut Batch,
        watch: &mut Option<Watch<'_>>,
    ) -> Result<(), BackendError> {
        let (dim, clock) = (batch.dim, Clock::of(self.setting.closed_loop));
        let at_start = |of| Waiting {
            of,
            leg: 0,
            given: false,
        };
        let mut waiting: Vec<Waiting> = (0..batch.status.len()).map(at_start).collect();
        // By the leg that each is without an answer for.
        let mut lost: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        while !(waiting.is_empty() && lost.is_empty()) {
            // Those that are looked at come first.
            let all = watch.is_some() || !self.setting.closed_loop.records.is_empty();
            let kept: Vec<usize> = batch.kept.iter().map(|(i, _)| *i).collect();
            let traced = |w: &Waiting| all || kept.contains(&w.of);
            waiting.sort_by_key(|w| !traced(w));
            let course = Course {
                legs: clock.all,
                vectors: (waiting.iter())
                    .flat_map(|w| &batch.end[w.of * dim..][..dim])
                    .copied()
                    .collect(),
                first: waiting.iter().map(|w| w.leg as u32).collect(),
                given: waiting.iter().map(|w| w.given).collect(),
                traced: waiting.iter().filter(|w| traced(w)).count(),
            };
            self.setting.numerics.deadline.check()?;
            let flown = relay.fly(run, &course)?;
            batch.round_trips += flown.waits;
            let stopped = pilots.outside == Outside::Stop;
            self.see(
                batch,
                &waiting[..course.traced],
                &flown,
                clock,
                stopped,
                watch,
            );
            let (mut next, mut stiff) = (Vec::new(), Vec::new());
            for (j, from) in waiting.iter().enumerate() {
                let (i, leg) = (from.of, flown.leg[j] as usize);
                let asked = flown.begun[j] as usize - usize::from(from.given);
                batch.updates += asked;
                if asked > 0 {
                    pilots.found(i);
                }
                batch.end[i * dim..][..dim].copy_from_slice(&flown.end[j * dim..][..dim]);
                match flown.halt[j] {
                    Halt::Lost => lost.entry(leg).or_default().push(i),
                    Halt::Paused => next.push(Waiting { leg, ..at_start(i) }),
                    Halt::Ended(Status::StepLimit) if !stopped => stiff.push((i, leg, j)),
                    Halt::Ended(status) => {
                        self.end(batch, i, status, clock.step * leg as f64 + flown.time[j])
                    }
                }
            }
            // With p held, what the model of V, next to where V is too steep for it, makes too
            // stiff to follow.
            if !stiff.is_empty() {
                let mut seeds: Vec<f64> = (stiff.iter())
                    .flat_map(|(_, _, j)| &flown.begin[j * dim..][..dim])
                    .copied()
                    .collect();
                seeds
                    .chunks_exact_mut(dim)
                    .for_each(|seed| hold_here(seed, self.equations.states));
                let mut again = Trajectories::default();
                wings.fly((&seeds, dim), |_| clock.step, &mut again)?;
                self.see_again(batch, &stiff, &seeds, &again);
                for (j, (i, leg, _)) in stiff.into_iter().enumerate() {
                    batch.fallback[i] += 1;
                    batch.end[i * dim..][..dim].copy_from_slice(&again.end[j * dim..][..dim]);
                    let goes_on = again.status[j] == Status::Reached && leg + 1 < clock.all;
                    if goes_on {
                        next.push(Waiting {
                            leg: leg + 1,
                            ..at_start(i)
                        });
                    } else {
                        self.end(
                            batch,
                            i,
                            again.status[j],
                            clock.step * leg as f64 + again.end_time[j],
                        );
                    }
                }
            }
            // A search takes many flights, as many for one as for all that are lost at a leg: so
            // the legs come one after the other, each once, when all others have come there.
            let helped = match pilots.outside {
                Outside::Search if !next.is_empty() => BTreeMap::new(),
                Outside::Search => lost.pop_first().into_iter().collect(),
                _ => std::mem::take(&mut lost),
            };
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
                self.update(&mut wings, &mut pilots, batch, watch, (&when, &lanes))?;
                let goes_on = lanes
                    .into_iter()
                    .filter(|i| batch.status[*i] == Status::Reached as i32);
                next.extend(goes_on.map(|of| Waiting {
                    of,
                    leg,
                    given: true,
                }));
            }
            next.sort_by_key(|w| w.of);
            waiting = next;
        }
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
        let place: HashMap<usize, usize> =
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

    /// Shows legs that were flown with p held, of trajectories with the first of these numbers, to
    /// their records.
    fn see_again(
        &self,
        batch: &mut Batch,
        stiff: &[(usize, usize, usize)],
        seeds: &[f64],
        again: &Trajectories,
    ) {
        if self.setting.closed_loop.records.is_empty() {
            return;
        }
        let (dim, width) = (batch.dim, self.observer_width());
        let (before, after) = (
            self.observer.eval(seeds, dim),
            self.observer.eval(&again.end, dim),
        );
        batch.records.each(|i, view| {
            if let Some(j) = stiff.iter().position(|(of, ..)| *of == i) {
                let both = [&before[j * width..][..width], &after[j * width..][..width]];
                view.see(again.end_time[j], &seeds[j * dim..][..dim], both);
            }
        });
    }
}
