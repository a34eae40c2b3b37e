//! Legs of flights: to the next thing that is watched for, between steps too, and to where an event
//! is.

use super::{End, Flight, Flights, MOST_SHORT, Options, SHORT, Simulator};
use crate::backend::{BackendError, Run, Status, Trajectories, batch_limit};
use crate::hybrid::between::{Point, crossing, points, suspect};
use crate::hybrid::watch::{Grain, Here, LOCATED, Watch};
use std::collections::BTreeMap;

/// Newton's corrections of an event's time; it is located when one is this small, relative to the
/// phase.
const CORRECTIONS: usize = 20;
/// Where the tolerance of a step keeps corrections from falling that far, the last must be below so many
/// of these.
const TOLERANCES: f64 = 10.0;
/// Share of a condition's size from which short flights lead to its surface.
const NEAR: f64 = 1e-3;
/// So many corrections in a row that come no nearer show rounding.
const STALE: usize = 3;
/// Short flights from the nearest state to the surface, at most.
const POLISHING: usize = 6;
/// Times that a suspected event between steps is looked for, and how many in a leg.
const LOOKS: usize = 4;
const SUSPECTS: usize = 16;

/// What a leg came to.
pub(super) enum Met {
    /// A surface that was passed.
    Nothing,
    Event(usize),
    End,
}

/// An event that may be met between two points of a leg.
struct Suspect {
    leg: usize,
    event: usize,
    between: (Point, Point),
    /// When.
    at: f64,
    /// The stored point before it, and when: flights begin there.
    from: (Vec<f64>, f64),
}

/// Something that happened between the ends of steps.
struct Early {
    event: usize,
    /// Since the beginning of the leg, about; and the state there.
    t: f64,
    x: Vec<f64>,
    /// The stored point before it.
    from: (Vec<f64>, f64),
    /// Times before and after it.
    between: [f64; 2],
}

/// An event whose time is looked for.
struct Sought<'f> {
    flight: &'f mut Flight,
    event: usize,
    /// It is no earlier than the first; the condition is true at the second, where one is known.
    after: f64,
    until: Option<f64>,
    /// The nearest so far, and for how many corrections it has been that.
    best: Option<Near>,
    stale: usize,
    /// Where the leg has ended, and when: it is near.
    end: (Vec<f64>, f64),
}

/// A state near an event.
struct Near {
    flown: f64,
    x: Vec<f64>,
    here: Here,
}

impl<'f> Sought<'f> {
    fn new(flight: &'f mut Flight, event: usize, between: Option<[f64; 2]>, grain: Grain) -> Self {
        let watch = flight.watched[event];
        let since = (watch.since - grain.time).max(flight.passed.1);
        // Before a surface that is moved the condition may be true already.
        let unmoved = between.filter(|_| watch.offset == 0.0);
        Self {
            after: unmoved.map_or(since, |[after, _]| after.max(since)),
            until: between.map(|[_, until]| until),
            end: (flight.x.clone(), flight.flown),
            flight,
            event,
            best: None,
            stale: 0,
        }
    }
}

impl Simulator {
    /// One leg of each flight.
    pub(super) fn leg<'f>(
        &mut self,
        flying: Vec<&'f mut Flight>,
        options: &Options,
        flights: &mut Flights,
    ) -> Result<Vec<(&'f mut Flight, Met)>, BackendError> {
        let n = self.states;
        let left: Vec<f64> = (flying.iter())
            .map(|f| options.time - f.t - f.flown)
            .collect();
        let (mut seeds, mut full) = (Vec::new(), Vec::new());
        for (flight, left) in flying.iter().zip(&left) {
            seeds.extend_from_slice(&flight.x);
            seeds.push(*left);
            seeds.extend(flight.watched.iter().flat_map(|w| [w.sign(), w.offset]));
        }
        if flying.is_empty() {
            return Ok(Vec::new());
        }
        let dim = n + 1 + 3 * self.at_once.len();
        for row in seeds.chunks(n + 1 + 2 * self.at_once.len()) {
            let conditions = std::iter::repeat_n(0.0, self.at_once.len());
            full.extend(row.iter().copied().chain(conditions));
        }
        let mut run = self.run(options, vec![1.0], dim);
        let share = run.rtol;
        for (atol, size) in run.atol[n + 1 + 2 * self.at_once.len()..]
            .iter_mut()
            .zip(&self.sizes)
        {
            *atol = share * size;
        }
        let flown = self.guarded.integrate(&run, &full)?;
        flights.count(&flown);
        let grain = self.grain(options);
        let durations: Vec<f64> = (flown.status.iter().zip(&flown.end_time).zip(&left))
            .map(|((status, t), left)| match status {
                Status::Reached => *left,
                _ => left * t,
            })
            .collect();
        let early = self.between(&flying, (&durations, &flown.steps), options, flights)?;
        let mut legs = Vec::new();
        let mut at_events = Vec::new();
        for (k, (flight, early)) in flying.into_iter().zip(early).enumerate() {
            let (duration, status) = match &early {
                Some(early) => (early.t, Status::Guard),
                None => (durations[k], flown.status[k]),
            };
            flight.leg = flight.flown;
            flight.flown += duration;
            let grain = grain.after(flight.t + flight.flown);
            flight.x = match &early {
                Some(early) => early.x.clone(),
                None => flown.end[k * dim..][..n].to_vec(),
            };
            let met = match status {
                Status::Reached => match self.passed(flight, duration, grain) {
                    Some(event) => Met::Event(event),
                    None => {
                        flight.end = Some(End::Time);
                        Met::End
                    }
                },
                Status::Guard => {
                    flight.short_legs = match duration <= SHORT * (flight.t + flight.flown) {
                        true => flight.short_legs + 1,
                        false => 0,
                    };
                    let all = self.conditions.eval(&flight.x);
                    let event = match &early {
                        Some(early) => early.event,
                        None => self.nearest(&all, &flight.watched),
                    };
                    let lost = self.is_unknown(&all);
                    if lost || flight.short_legs > MOST_SHORT {
                        flight.end = Some(match lost {
                            true => End::NoCondition,
                            false => End::NotLocated,
                        });
                        Met::End
                    } else if flight.watched[event].armed {
                        Met::Event(event)
                    } else {
                        let here = self.condition(&all, event);
                        flight.watched[event] = Watch::on(true, here, grain).from(flight.flown);
                        Met::Nothing
                    }
                }
                other => {
                    flight.end = Some(End::Failed(other));
                    Met::End
                }
            };
            match met {
                Met::Event(event) => {
                    let ends = early.map(|early| early.between.map(|t| flight.leg + t));
                    at_events.push(Sought::new(flight, event, ends, grain));
                }
                met => legs.push((flight, met)),
            }
        }
        self.locate(&mut at_events, options, flights)?;
        // Another surface, which is watched beyond itself, may have been crossed before.
        for _ in 1..self.at_once.len() {
            let mut before: Vec<Sought> = Vec::new();
            at_events = (at_events.into_iter())
                .filter_map(|sought| match self.crossed_before(&sought) {
                    Some((event, flown)) => {
                        sought.flight.flown = flown;
                        before.push(Sought::new(sought.flight, event, None, grain));
                        None
                    }
                    None => Some(sought),
                })
                .collect();
            if before.is_empty() {
                break;
            }
            self.locate(&mut before, options, flights)?;
            at_events.append(&mut before);
        }
        legs.extend(at_events.into_iter().map(|sought| {
            let Sought { flight, event, .. } = sought;
            let grain = grain.after(flight.t + flight.flown);
            let all = self.conditions.eval(&flight.x);
            let met = match flight.end {
                Some(End::Failed(_)) => Met::End,
                _ if self.is_unasked(&all, event) => {
                    flight.end = Some(End::NoCondition);
                    Met::End
                }
                None if self.counts(&all, event) => Met::Event(event),
                Some(_) if self.counts(&all, event) => Met::End,
                // It is passed by.
                _ => {
                    let here = self.condition(&all, event);
                    flight.end = None;
                    flight.watched[event] = Watch::on(false, here, grain).from(flight.flown);
                    flight.passed = (flight.x.clone(), flight.flown);
                    Met::Nothing
                }
            };
            (flight, met)
        }));
        Ok(legs)
    }

    /// An event that was met before the one which was located, and when, about.
    fn crossed_before(&self, located: &Sought<'_>) -> Option<(usize, f64)> {
        let flight = &located.flight;
        if flight.end.is_some() {
            return None;
        }
        let all = self.conditions.eval(&flight.x);
        let crossed = (flight.watched.iter().enumerate()).filter_map(|(event, watch)| {
            let here = self.condition(&all, event);
            let is_moved = event != located.event && watch.armed && watch.offset > 0.0;
            let rounding = here.rounding(self.precision, flight.flown);
            let at = flight.flown - here.ahead / here.slope;
            let since = watch.since.max(flight.passed.1);
            let is_before = here.ahead < -rounding && here.slope < 0.0 && at > since;
            (is_moved && is_before && self.counts(&all, event)).then_some((event, at))
        });
        crossed.min_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// An event that has come true by the end, within what its surface was moved by.
    fn passed(&self, flight: &Flight, duration: f64, grain: Grain) -> Option<usize> {
        let all = self.conditions.eval(&flight.x);
        let met = |event: &usize| {
            let (watch, here) = (flight.watched[*event], self.condition(&all, *event));
            let moved = watch.armed && watch.offset > 0.0;
            moved && here.ahead < 0.0 && here.slope < 0.0 && self.counts(&all, *event)
        };
        (0..flight.watched.len())
            .find(met)
            .filter(|_| duration > grain.time)
    }

    /// What happened between the ends of the steps of legs of these durations, if anything.
    fn between(
        &mut self,
        flying: &[&mut Flight],
        (durations, steps): (&[f64], &[u32]),
        options: &Options,
        flights: &mut Flights,
    ) -> Result<Vec<Option<Early>>, BackendError> {
        let n = self.states;
        let mut early: Vec<Option<Early>> = flying.iter().map(|_| None).collect();
        if self.at_once.is_empty() {
            return Ok(early);
        }
        // How closely one is looked at does not depend on the others.
        let mut groups: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for (k, steps) in steps.iter().enumerate() {
            groups.entry(points(*steps)).or_default().push(k);
        }
        let mut suspects = Vec::new();
        for (count, members) in groups {
            let levels: Vec<f64> = (1..=count).map(|k| k as f64 / count as f64).collect();
            let run = self.run(options, levels, n + 1);
            for part in members.chunks(batch_limit(n + 1, count)) {
                let seeds: Vec<f64> = (part.iter())
                    .flat_map(|k| flying[*k].x.iter().copied().chain([durations[*k]]))
                    .collect();
                let flown = self.stored.integrate(&run, &seeds)?;
                for (row, &k) in part.iter().enumerate() {
                    let leg = (flying[k].x.as_slice(), durations[k]);
                    self.suspects(&flown, (row, k), leg, &flying[k].watched, &mut suspects);
                }
            }
        }

        // What is suspected is flown to, until it is sure.
        let run = self.run(options, vec![1.0], n + 1);
        for _ in 0..LOOKS {
            if suspects.is_empty() {
                break;
            }
            let seeds: Vec<f64> = (suspects.iter())
                .flat_map(|s| s.from.0.iter().copied().chain([s.at - s.from.1]))
                .collect();
            let flown = self.plain.integrate(&run, &seeds)?;
            flights.count(&flown);
            let mut still = Vec::new();
            for (j, suspected) in suspects.into_iter().enumerate() {
                let (k, event, at) = (suspected.leg, suspected.event, suspected.at);
                let (a, b) = suspected.between;
                if flown.status[j] != Status::Reached {
                    continue;
                }
                let all = self.conditions.eval(&flown.end[j * (n + 1)..][..n]);
                let watch = flying[k].watched[event];
                let here = self.left(&all, event, watch, at);
                if here.left <= 0.0 {
                    let t = crossing(a, here);
                    if early[k].as_ref().is_none_or(|known| t < known.t) {
                        let (between, x) = ([a.t, here.t], Vec::new());
                        early[k] = Some(Early {
                            event,
                            t,
                            between,
                            x,
                            from: suspected.from,
                        });
                    }
                    continue;
                }
                let halves = [(a, here), (here, b)];
                let next = halves.into_iter().filter(|(a, b)| a.t < b.t);
                still.extend(next.filter_map(|(a, b)| {
                    let at = suspect(a, b).filter(|at| *at > a.t && *at < b.t)?;
                    Some(Suspect {
                        between: (a, b),
                        at,
                        from: suspected.from.clone(),
                        ..suspected
                    })
                }));
            }
            suspects = still;
        }
        self.states_there(durations, &mut early, &run)?;
        Ok(early)
    }

    /// What may have happened between the stored points of a leg.
    fn suspects(
        &self,
        flown: &Trajectories,
        (row, k): (usize, usize),
        (begin, duration): (&[f64], f64),
        watched: &[Watch],
        found: &mut Vec<Suspect>,
    ) {
        let n = self.states;
        let (mut before, mut t, mut own) = (self.conditions.eval(begin), 0.0, 0);
        let mut last = begin.to_vec();
        for level in 0..flown.levels {
            let sample = flown.sample(row, level);
            if !sample[0].is_finite() || own >= SUSPECTS {
                return;
            }
            let here = self.conditions.eval(&sample[1..=n]);
            let now = sample[0] * duration;
            for (event, watch) in watched.iter().enumerate() {
                let a = self.left(&before, event, *watch, t);
                let b = self.left(&here, event, *watch, now);
                if let Some(at) = suspect(a, b).filter(|_| a.left > 0.0) {
                    found.push(Suspect {
                        leg: k,
                        event,
                        between: (a, b),
                        at,
                        from: (last.clone(), t),
                    });
                    own += 1;
                }
            }
            (before, t) = (here, now);
            last.clear();
            last.extend_from_slice(&sample[1..=n]);
        }
    }

    /// States where something happened early; what a guard has seen before is not early.
    fn states_there(
        &mut self,
        durations: &[f64],
        early: &mut [Option<Early>],
        run: &Run,
    ) -> Result<(), BackendError> {
        let n = self.states;
        for (early, duration) in early.iter_mut().zip(durations) {
            if early.as_ref().is_some_and(|e| e.t >= *duration) {
                *early = None;
            }
        }
        let found: Vec<usize> = (0..early.len()).filter(|k| early[*k].is_some()).collect();
        let seeds: Vec<f64> = (found.iter())
            .filter_map(|k| early[*k].as_ref())
            .flat_map(|e| e.from.0.iter().copied().chain([e.t - e.from.1]))
            .collect();
        if found.is_empty() {
            return Ok(());
        }
        let flown = self.plain.integrate(run, &seeds)?;
        for (j, k) in found.into_iter().enumerate() {
            match (&mut early[k], flown.status[j]) {
                (Some(early), Status::Reached) => {
                    early.x = flown.end[j * (n + 1)..][..n].to_vec();
                }
                (early, _) => *early = None,
            }
        }
        Ok(())
    }

    /// What is left of an event at a time, as it is watched.
    fn left(&self, all: &[f64], event: usize, watch: Watch, t: f64) -> Point {
        let here = self.condition(all, event);
        Point {
            t,
            left: watch.left(here.ahead),
            rate: watch.sign() * here.slope,
        }
    }

    /// The event whose surface was crossed first: some surfaces are watched beyond themselves. Where
    /// none was, the one whose watch is the nearest in time.
    fn nearest(&self, all: &[f64], watched: &[Watch]) -> usize {
        let time = |e: usize| {
            let (here, watch) = (self.condition(all, e), watched[e]);
            let crossed = watch.sign() * here.ahead <= 0.0 && watch.sign() * here.slope < 0.0;
            match crossed {
                true => -(here.ahead / here.slope).abs(),
                false => (watch.left(here.ahead) / here.slope).abs(),
            }
        };
        (0..watched.len())
            .min_by(|a, b| time(*a).total_cmp(&time(*b)))
            .unwrap_or(0)
    }

    /// Newton's method for the duration of phases that end at events, kept between a time at which
    /// the condition is not true yet and one at which it is.
    fn locate(
        &mut self,
        at: &mut [Sought<'_>],
        options: &Options,
        flights: &mut Flights,
    ) -> Result<(), BackendError> {
        let n = self.states;
        let run = self.run(options, vec![1.0], n + 1);
        let mut open: Vec<usize> = (0..at.len()).collect();
        for correction in 1..=CORRECTIONS {
            if open.is_empty() {
                break;
            }
            let seeds: Vec<f64> = (open.iter())
                .flat_map(|k| {
                    let flight = &at[*k].flight;
                    let (from, since) = &flight.passed;
                    from.iter().copied().chain([flight.flown - since])
                })
                .collect();
            let flown = self.plain.integrate(&run, &seeds)?;
            flights.count(&flown);
            let mut still = Vec::new();
            for (j, k) in open.into_iter().enumerate() {
                let sought = &mut at[k];
                if flown.status[j] != Status::Reached {
                    sought.flight.end = Some(End::Failed(flown.status[j]));
                    continue;
                }
                let x = flown.end[j * (n + 1)..][..n].to_vec();
                let here = self.condition(&self.conditions.eval(&x), sought.event);
                let there = sought.is_there(x, here);
                if there || correction == CORRECTIONS || sought.stale >= STALE {
                    continue;
                }
                if sought.correct(here, options.time) {
                    still.push(k);
                }
            }
            open = still;
        }
        self.polish(at, &run, options, flights)?;
        let grain = self.grain(options);
        for sought in at {
            self.settle(sought, grain);
        }
        Ok(())
    }

    /// Flies from the nearest states onto the surface. Flights from the beginning of a phase that
    /// differ a little in their time differ by their tolerance in their end, which is further from the
    /// surface than rounding; where motion is sensitive by more than that, and the nearest is where
    /// the leg has ended.
    fn polish(
        &mut self,
        at: &mut [Sought<'_>],
        run: &Run,
        options: &Options,
        flights: &mut Flights,
    ) -> Result<(), BackendError> {
        let n = self.states;
        for sought in at.iter_mut() {
            let left = options.time - sought.flight.t;
            let is_near = |best: &Near| {
                let by = best.here.ahead / best.here.slope;
                let share = LOCATED.max(TOLERANCES * options.rtol);
                by.abs() <= share * best.flown
                    && best.here.ahead.abs() <= NEAR * best.here.size
                    && best.flown - by <= left
            };
            if sought.best.as_ref().is_some_and(is_near) {
                continue;
            }
            let (x, flown) = sought.end.clone();
            let here = self.condition(&self.conditions.eval(&x), sought.event);
            sought.best = Some(Near { flown, x, here });
        }
        let mut open: Vec<usize> = (0..at.len()).collect();
        for _ in 0..POLISHING {
            let to_go = |k: &usize| -> Option<(usize, f64)> {
                let best = at[*k].best.as_ref()?;
                let by = -best.here.ahead / best.here.slope;
                let rounding = self.precision.epsilon() * best.here.size;
                let is_far = best.here.ahead.abs() > rounding && by.is_finite();
                (is_far && by.abs() <= best.flown).then_some((*k, by))
            };
            let going: Vec<(usize, f64)> = open.iter().filter_map(to_go).collect();
            if going.is_empty() {
                break;
            }
            let seeds: Vec<f64> = (going.iter())
                .filter_map(|(k, by)| Some((at[*k].best.as_ref()?, by)))
                .flat_map(|(best, by)| best.x.iter().copied().chain([*by]))
                .collect();
            let flown = self.plain.integrate(run, &seeds)?;
            flights.count(&flown);
            open.clear();
            for (j, (k, by)) in going.into_iter().enumerate() {
                let sought = &mut at[k];
                let x = flown.end[j * (n + 1)..][..n].to_vec();
                let here = self.condition(&self.conditions.eval(&x), sought.event);
                let nearer =
                    (sought.best.as_ref()).filter(|best| here.ahead.abs() < best.here.ahead.abs());
                if let (Some(best), Status::Reached) = (nearer, flown.status[j]) {
                    let flown = best.flown + by;
                    sought.best = Some(Near { flown, x, here });
                    open.push(k);
                }
            }
        }
        Ok(())
    }

    /// The nearest state that was found is the event's, if it is one.
    fn settle(&self, sought: &mut Sought<'_>, grain: Grain) {
        let Some(best) = sought.best.take() else {
            return;
        };
        let flight = &mut *sought.flight;
        if matches!(flight.end, Some(End::Failed(_))) {
            return;
        }
        let Near { flown, x, here } = best;
        let near = here.ahead.abs() <= here.rounding(self.precision, flown);
        let comes = here.slope <= 0.0;
        // What rounding makes of an event right after another one, or of bounces lower than that.
        let again = flight.after == Some(sought.event) && here.is_flat(grain);
        flight.end = match flown <= SHORT * flight.t || again {
            _ if near && comes => None,
            true => Some(End::Zeno),
            false => Some(End::NotLocated),
        };
        (flight.flown, flight.x) = (flown, x);
    }
}

impl Sought<'_> {
    /// Keeps a state if it is the nearest so far; whether there is nothing nearer.
    fn is_there(&mut self, x: Vec<f64>, here: Here) -> bool {
        let flown = self.flight.flown;
        let nearer = |best: &Near| here.ahead.abs() < best.here.ahead.abs();
        match self.best.as_ref().is_none_or(nearer) {
            true => {
                self.best = Some(Near { flown, x, here });
                self.stale = 0;
            }
            false => self.stale += 1,
        }
        let by = -here.ahead / here.slope;
        by.abs() <= LOCATED * flown || flown == 0.0
    }

    /// The next time to look at; whether there is one.
    fn correct(&mut self, here: Here, longest: f64) -> bool {
        let flight = &mut *self.flight;
        match here.ahead > 0.0 {
            true => self.after = self.after.max(flight.flown),
            false => self.until = Some(self.until.unwrap_or(f64::INFINITY).min(flight.flown)),
        }
        let moved = flight.flown - here.ahead / here.slope;
        let last = self.until.unwrap_or(1.5 * (longest - flight.t));
        let inside = moved > self.after && moved < last;
        flight.flown = match (inside, self.until) {
            (true, _) => moved,
            (false, Some(until)) => {
                self.stale = 0;
                0.5 * (self.after + until)
            }
            (false, None) => return false,
        };
        true
    }
}
