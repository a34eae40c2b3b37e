//! Batches of flights with events, on any backend.
//!
//! A flight is integrated over a share of the time left to it, `dx/dq = T f(x)`, so that flights
//! with different times to go are one batch. Where an event's condition comes true, the duration of
//! its phase (the way from event to event) is found by Newton's method, `T <- T - g/g'`, each time
//! flying from the beginning of the phase: the state at an event is the end of a step, not of an
//! interpolation.

use super::between::{Point, crossing, points, suspect};
use super::watch::{Grain, Here, Side, Watch};
use crate::backend::{
    Backend, BackendError, By, Deadline, Guards, Kernel, Run, Spec, Status, Trajectories,
    batch_limit,
};
use crate::expr::{Graph, Id, Kind};
use crate::model::{Event, Method, Precision};
use crate::program::Program;
use rustc_hash::FxHashMap;
use std::collections::BTreeMap;

/// Newton's corrections of an event's time; it is located when one is this small, relative to the
/// phase.
const CORRECTIONS: usize = 20;
const LOCATED: f64 = 1e-13;
/// Where rounding, or the tolerance of a step, keeps corrections from falling that far, the last must
/// be below so many of these.
const ROUNDINGS: f64 = 64.0;
const TOLERANCES: f64 = 10.0;
/// Phases shorter than this share of the time so far are counted; so many in a row are an
/// accumulation of events (Zeno). Likewise of legs within a phase.
const SHORT: f64 = 1e-9;
const MOST_SHORT: usize = 20;
/// A phase shorter than this share of the time so far before one that is next to nothing shows an
/// accumulation.
const FADING: f64 = 1e-4;
/// Times that a suspected event between steps is looked for, and how many in a leg.
const LOOKS: usize = 4;
const SUSPECTS: usize = 16;
/// Absolute tolerance of what the step control is to leave alone.
const UNCONTROLLED: f64 = 1e30;

/// How a flight ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// The time is over.
    Time,
    /// As many events as were asked for.
    Events,
    /// At an event that ends it: its number.
    At(usize),
    /// Events came faster and faster.
    Zeno,
    /// An event's time could not be found: the flight touches the condition without crossing it.
    NotLocated,
    /// An event led to a state that is not finite.
    NoState,
    /// A condition has no value where the flight has come to.
    NoCondition,
    /// The integration could not go on.
    Failed(Status),
}

impl End {
    /// In a word.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            End::Time => "time",
            End::Events => "events",
            End::At(_) => "event",
            End::Zeno => "zeno",
            End::NotLocated => "not_located",
            End::NoState => "no_state",
            End::NoCondition => "no_condition",
            End::Failed(status) => status.name(),
        }
    }

    /// Its number in result files.
    #[must_use]
    pub fn code(self) -> i32 {
        match self {
            End::Time => 0,
            End::Events => 1,
            End::Zeno => 2,
            End::NotLocated => 3,
            End::NoState => 4,
            End::NoCondition => 5,
            End::Failed(status) => 6 + status as i32,
            End::At(event) => Self::FIRST_EVENT + i32::try_from(event).unwrap_or(i32::MAX >> 1),
        }
    }

    /// The code of the first event at which a flight may end; the others follow.
    pub const FIRST_EVENT: i32 = 16;

    /// All but those at an event.
    pub const OTHERS: [End; 9] = [
        End::Time,
        End::Events,
        End::Zeno,
        End::NotLocated,
        End::NoState,
        End::NoCondition,
        End::Failed(Status::StepFloor),
        End::Failed(Status::StepLimit),
        End::Failed(Status::NotFinite),
    ];
}

/// An event as it happened.
#[derive(Clone, Debug, PartialEq)]
pub struct Jump {
    pub flight: usize,
    pub event: usize,
    pub t: f64,
    pub before: Vec<f64>,
    pub after: Vec<f64>,
}

/// A stored point of a flight.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample {
    pub flight: usize,
    /// Number of the phase, from 0.
    pub phase: usize,
    pub t: f64,
    pub x: Vec<f64>,
}

/// What is asked of a simulation.
#[derive(Clone, Debug)]
pub struct Options {
    pub time: f64,
    /// Events after which a flight ends.
    pub events: usize,
    /// Stored points of a phase after its first; 0: none at all.
    pub samples: usize,
    pub rtol: f64,
    /// One a state.
    pub atol: Vec<f64>,
    /// Of a fixed-step method.
    pub step: f64,
    pub max_steps: u32,
    pub deadline: Deadline,
}

/// How flights went.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Flights {
    /// `[flight][n]`: the last state, after the last event.
    pub last: Vec<f64>,
    pub t: Vec<f64>,
    pub end: Vec<End>,
    /// Events of each.
    pub events: Vec<usize>,
    /// By time within a flight.
    pub jumps: Vec<Jump>,
    pub samples: Vec<Sample>,
    pub steps: u64,
    pub rejected: u64,
}

/// Kernels and maps of a system with events.
pub struct Simulator {
    states: usize,
    precision: Precision,
    adaptive: bool,
    /// Of events: whether one that is true at the beginning is met there.
    at_once: Vec<bool>,
    /// Of events: their conditions' sizes over the region.
    sizes: Vec<f64>,
    /// Until something comes true that is watched for: `(x, T, sign and offset an event, conditions)`.
    /// The conditions are there for the step control.
    guarded: Box<dyn Kernel>,
    /// Over a given time: `(x, T)`.
    pub(super) plain: Box<dyn Kernel>,
    /// The same with stored points.
    stored: Box<dyn Kernel>,
    /// Of a state: `ahead` of each event, the first and second rates of these, and where events
    /// count.
    conditions: Program,
    /// For what a neighbour of a flight does.
    pub(super) linear: Linear,
    /// Of a state: the state after each event.
    maps: Vec<Option<Program>>,
}

crate::opaque!(Simulator);

/// Linearizations: the variation of a flight, and derivatives of conditions and maps.
pub(super) struct Linear {
    /// `(x, T, v)`: v is a variation of x, at a given time.
    pub varied: Box<dyn Kernel>,
    pub rates: Program,
    /// Of a state: the gradient of each event's `ahead`.
    pub gradients: Program,
    /// Of a state: the Jacobian of each event's map, row by row.
    pub jacobians: Vec<Option<Program>>,
}

/// A flight under way.
struct Flight {
    /// Number in the list.
    number: usize,
    phase: usize,
    /// Where the phase began, and when.
    begin: Vec<f64>,
    t: f64,
    /// Where the flight is, and for how long the phase has lasted.
    x: Vec<f64>,
    flown: f64,
    watched: Vec<Watch>,
    /// The event that the phase began with, and how long the one before lasted.
    after: Option<usize>,
    before: f64,
    /// Of events that have happened at this instant: whether they were armed since.
    known: Vec<Option<bool>>,
    /// Phases, or legs of this phase, that were short, in a row.
    short: usize,
    short_legs: usize,
    end: Option<End>,
}

impl Simulator {
    /// Of rates and events as functions of `x` alone, on a backend. `guards` are events at which a
    /// flight ends, also where it begins; `states` are some of the region, `[state][n]`.
    ///
    /// # Errors
    /// What the backend refuses to compile.
    pub fn new(
        graph: &mut Graph,
        (x, rates): (&[Id], &[Id]),
        (events, guards): (&[Event], &[Event]),
        (backend, method, precision): (&dyn Backend, Method, Precision),
        states: &[f64],
    ) -> Result<Self, BackendError> {
        let n = x.len();
        let all: Vec<&Event> = events.iter().chain(guards).collect();
        let ahead: Vec<Id> = all.iter().map(|e| e.ahead).collect();
        let moving: FxHashMap<Id, Id> = x.iter().copied().zip(rates.iter().copied()).collect();
        let slopes = graph.tangents(&ahead, &moving);
        let curves = graph.tangents(&slopes, &moving);
        let duration = graph.symbol("phase duration", Kind::Parameter);
        let mut scaled =
            |of: &[Id]| -> Vec<Id> { of.iter().map(|f| graph.mul(duration, *f)).collect() };
        let (rate, slope) = (scaled(rates), scaled(&slopes));
        let zero = graph.constant(0.0);
        let mut inputs = [x, &[duration]].concat();
        let plain_inputs = inputs.clone();
        let mut watched = Vec::new();
        for (k, ahead) in ahead.iter().enumerate() {
            let sign = graph.symbol(&format!("side of event {k}"), Kind::Parameter);
            let offset = graph.symbol(&format!("offset of event {k}"), Kind::Parameter);
            inputs.extend([sign, offset]);
            let signed = graph.mul(sign, *ahead);
            watched.push(graph.add(signed, offset));
        }
        // A step ends where a condition has a kink, too.
        let switches = graph.kinks(&[rates, &ahead].concat());
        let everywhere = graph.constant(1.0);
        let only = all.iter().map(|e| e.only.unwrap_or(everywhere));
        let conditions: Vec<Id> = [&ahead[..], &slopes, &curves]
            .concat()
            .into_iter()
            .chain(only)
            .collect();
        let linear = Linearized::new(graph, x, rates, &all, duration);

        let spec = |inputs: &[Id], more: &[Id], guarded: bool, store: bool| Spec {
            rate: {
                let constants = std::iter::repeat_n(zero, inputs.len() - n);
                let rate: Vec<Id> = (rate.iter().copied())
                    .chain(constants)
                    .chain(more.iter().copied())
                    .collect();
                Program::lower(graph, inputs, &rate)
            },
            guards: (guarded && !watched.is_empty()).then(|| Guards {
                program: Program::lower(graph, inputs, &watched),
                strict: vec![true; watched.len()],
            }),
            kinks: (!switches.is_empty()).then(|| Program::lower(graph, inputs, &switches)),
            method,
            precision,
            by: By::Time,
            store,
        };
        let varied = Spec {
            rate: Program::lower(graph, &linear.inputs, &linear.varied),
            ..spec(&plain_inputs, &[], false, false)
        };
        let of_state = |roots: &[Id]| Program::lower(graph, x, roots);
        let conditions = of_state(&conditions);
        Ok(Self {
            states: n,
            precision,
            adaptive: method.adaptive(),
            at_once: (0..all.len()).map(|k| k >= events.len()).collect(),
            sizes: sizes(&conditions, states, n, all.len()),
            guarded: backend.compile(&spec(&inputs, &slope, true, false))?,
            plain: backend.compile(&spec(&plain_inputs, &[], false, false))?,
            stored: backend.compile(&spec(&plain_inputs, &[], false, true))?,
            conditions,
            linear: Linear {
                varied: backend.compile(&varied)?,
                rates: of_state(rates),
                gradients: of_state(&linear.gradients),
                jacobians: (linear.jacobians.iter())
                    .map(|all| all.as_ref().map(|all| of_state(all)))
                    .collect(),
            },
            maps: (all.iter())
                .map(|e| e.map.as_ref().map(|map| of_state(map)))
                .collect(),
        })
    }

    /// Simulates from states `[flight][n]`.
    ///
    /// # Errors
    /// Device failures, and a deadline that has passed.
    pub fn fly(&mut self, from: &[f64], options: &Options) -> Result<Flights, BackendError> {
        let n = self.states;
        let mut flights = Flights::default();
        let width = n + 1 + 3 * self.at_once.len();
        for (k, chunk) in from
            .chunks(batch_limit(width, options.samples) * n)
            .enumerate()
        {
            let first = k * batch_limit(width, options.samples);
            self.fly_batch(chunk, first, options, &mut flights)?;
        }
        // Batches go phase by phase.
        flights.jumps.sort_by_key(|jump| jump.flight);
        flights.samples.sort_by_key(|sample| sample.flight);
        Ok(flights)
    }

    fn fly_batch(
        &mut self,
        from: &[f64],
        first: usize,
        options: &Options,
        flights: &mut Flights,
    ) -> Result<(), BackendError> {
        let mut all: Vec<Flight> = (from.chunks(self.states).enumerate())
            .map(|(i, x)| Flight {
                number: first + i,
                phase: 0,
                begin: x.to_vec(),
                t: 0.0,
                x: x.to_vec(),
                flown: 0.0,
                watched: Vec::new(),
                after: None,
                before: f64::INFINITY,
                known: vec![None; self.at_once.len()],
                short: 0,
                short_legs: 0,
                end: None,
            })
            .collect();
        loop {
            options.deadline.check()?;
            let mut active: Vec<&mut Flight> = all.iter_mut().filter(|f| f.end.is_none()).collect();
            if active.is_empty() {
                break;
            }
            // Each flight goes one leg, to the next thing it watches for; some are at an event then,
            // others at their end.
            let mut due: Vec<(&mut Flight, Option<usize>)> = Vec::new();
            let mut flying = Vec::new();
            for flight in active.drain(..) {
                match self.look_out(flight, options) {
                    Some(event) => due.push((flight, Some(event))),
                    None if flight.end.is_some() => {}
                    None => flying.push(flight),
                }
            }
            for (flight, met) in self.leg(flying, options, flights)? {
                match met {
                    Met::Nothing => {}
                    Met::Event(event) => due.push((flight, Some(event))),
                    Met::End => due.push((flight, None)),
                }
            }
            if options.samples > 0 {
                self.keep(&due, options, flights)?;
            }
            for (flight, event) in due {
                if let Some(event) = event {
                    self.jump(flight, event, options, flights);
                } else {
                    flight.t += flight.flown;
                }
            }
        }
        for flight in all {
            flights.last.extend(flight.x);
            flights.t.push(flight.t);
            flights.end.extend(flight.end);
            flights.events.push(flight.phase);
        }
        Ok(())
    }

    /// Sets what a phase that begins looks out for; an event that is met right there. A flight may
    /// end there, too.
    fn look_out(&self, flight: &mut Flight, options: &Options) -> Option<usize> {
        if !flight.watched.is_empty() || self.at_once.is_empty() {
            return None;
        }
        let grain = self.grain(options);
        let all = self.conditions.eval(&flight.x);
        if self.is_unknown(&all) {
            flight.end = Some(End::NoCondition);
            return None;
        }
        for (event, at_once) in self.at_once.iter().enumerate() {
            let here = self.condition(&all, event);
            // What has just happened is true, and what a flight begins with has not come true.
            let just = flight.after == Some(event);
            let begins = flight.phase == 0;
            let known = match just || begins {
                true => Some(false),
                false => flight.known[event],
            };
            let side = match *at_once && here.ahead <= 0.0 {
                true => Side::Met,
                false => Watch::at(here, known, grain),
            };
            // It would leave, for less than a moment, after a phase that was hardly longer.
            let fades = flight.before < FADING * flight.t;
            let touches = here.is_on_surface(grain) && here.is_flat(grain);
            if just && touches && here.slope > 0.0 && fades {
                flight.end = Some(End::Zeno);
                return None;
            }
            let watch = match side {
                Side::Met if self.counts(&all, event) => {
                    flight.watched.clear();
                    return Some(event);
                }
                Side::Met => Watch::on(false, here, grain),
                Side::Watched(watch) => watch,
            };
            if known.is_some() && here.is_on_surface(grain) {
                flight.known[event] = Some(watch.armed);
            }
            flight.watched.push(watch);
        }
        None
    }

    /// Whether a condition is not a number.
    fn is_unknown(&self, all: &[f64]) -> bool {
        all[..self.at_once.len()].iter().any(|ahead| ahead.is_nan())
    }

    fn grain(&self, options: &Options) -> Grain {
        Grain::new(options.time, self.precision)
    }

    /// An event's condition at a state.
    fn condition(&self, all: &[f64], event: usize) -> Here {
        let count = self.at_once.len();
        Here {
            ahead: all[event],
            slope: all[count + event],
            curve: all[2 * count + event],
            size: self.sizes[event],
        }
    }

    /// Whether an event counts at the state of these conditions.
    fn counts(&self, all: &[f64], event: usize) -> bool {
        all[3 * self.at_once.len() + event] >= 0.0
    }

    /// One leg of each flight.
    fn leg<'f>(
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
            flight.flown += duration;
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
                    let armed = flight.watched[event].armed;
                    let lost = self.is_unknown(&all);
                    if lost || flight.short_legs > MOST_SHORT {
                        flight.end = Some(match lost {
                            true => End::NoCondition,
                            false => End::NotLocated,
                        });
                        Met::End
                    } else if armed && self.counts(&all, event) {
                        Met::Event(event)
                    } else {
                        let here = self.condition(&all, event);
                        flight.watched[event] = Watch::on(!armed, here, grain);
                        Met::Nothing
                    }
                }
                other => {
                    flight.end = Some(End::Failed(other));
                    Met::End
                }
            };
            match met {
                Met::Event(event) => at_events.push((flight, event)),
                met => legs.push((flight, met)),
            }
        }
        self.locate(&mut at_events, options, flights)?;
        legs.extend(at_events.into_iter().map(|(flight, event)| {
            let met = match flight.end {
                Some(_) => Met::End,
                None => Met::Event(event),
            };
            (flight, met)
        }));
        Ok(legs)
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
                .flat_map(|(k, _, _, _, at)| flying[*k].x.iter().copied().chain([*at]))
                .collect();
            let flown = self.plain.integrate(&run, &seeds)?;
            flights.count(&flown);
            let mut still = Vec::new();
            for (j, (k, event, a, b, at)) in suspects.into_iter().enumerate() {
                if flown.status[j] != Status::Reached {
                    continue;
                }
                let all = self.conditions.eval(&flown.end[j * (n + 1)..][..n]);
                let watch = flying[k].watched[event];
                let here = self.left(&all, event, watch, at);
                if here.left <= 0.0 {
                    let t = crossing(a, here);
                    if early[k].as_ref().is_none_or(|known| t < known.t) {
                        let x = Vec::new();
                        early[k] = Some(Early { event, t, x });
                    }
                    continue;
                }
                let halves = [(a, here), (here, b)];
                let next = halves.into_iter().filter(|(a, b)| a.t < b.t);
                still.extend(next.filter_map(|(a, b)| {
                    let at = suspect(a, b).filter(|at| *at > a.t && *at < b.t)?;
                    Some((k, event, a, b, at))
                }));
            }
            suspects = still;
        }
        self.states_there(flying, durations, &mut early, &run)?;
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
                    found.push((k, event, a, b, at));
                    own += 1;
                }
            }
            (before, t) = (here, now);
        }
    }

    /// States where something happened early; what a guard has seen before is not early.
    fn states_there(
        &mut self,
        flying: &[&mut Flight],
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
            .filter_map(|k| Some((k, early[*k].as_ref()?)))
            .flat_map(|(k, e)| flying[*k].x.iter().copied().chain([e.t]))
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

    /// The event whose surface, as it is watched, is the nearest in time.
    fn nearest(&self, all: &[f64], watched: &[Watch]) -> usize {
        let time = |e: usize| {
            let here = self.condition(all, e);
            (watched[e].left(here.ahead) / here.slope).abs()
        };
        (0..watched.len())
            .min_by(|a, b| time(*a).total_cmp(&time(*b)))
            .unwrap_or(0)
    }

    /// Newton's method for the duration of phases that end at events.
    fn locate(
        &mut self,
        at: &mut [(&mut Flight, usize)],
        options: &Options,
        flights: &mut Flights,
    ) -> Result<(), BackendError> {
        let n = self.states;
        let run = self.run(options, vec![1.0], n + 1);
        let enough = (ROUNDINGS * self.precision.epsilon()).max(TOLERANCES * options.rtol);
        let mut open: Vec<usize> = (0..at.len()).collect();
        for correction in 1..=CORRECTIONS {
            if open.is_empty() {
                break;
            }
            let seeds: Vec<f64> = (open.iter())
                .flat_map(|k| {
                    let flight = &at[*k].0;
                    flight.begin.iter().copied().chain([flight.flown])
                })
                .collect();
            let flown = self.plain.integrate(&run, &seeds)?;
            flights.count(&flown);
            let mut still = Vec::new();
            for (j, k) in open.into_iter().enumerate() {
                let (flight, event) = &mut at[k];
                if flown.status[j] != Status::Reached {
                    flight.end = Some(End::Failed(flown.status[j]));
                    continue;
                }
                flight.x = flown.end[j * (n + 1)..][..n].to_vec();
                let all = self.conditions.eval(&flight.x);
                let here = self.condition(&all, *event);
                let by = -here.ahead / here.slope;
                let limit = options.time - flight.t;
                if by.abs() <= LOCATED * flight.flown || flight.flown == 0.0 {
                    continue;
                }
                let last = correction == CORRECTIONS;
                if last && by.abs() <= enough * flight.flown {
                    continue;
                }
                let moved = flight.flown + by;
                if last || !by.is_finite() || moved < 0.0 || moved > 1.5 * limit {
                    // What rounding makes of an event right after another one.
                    flight.end = Some(match flight.flown <= SHORT * flight.t {
                        true => End::Zeno,
                        false => End::NotLocated,
                    });
                    continue;
                }
                flight.flown = moved;
                still.push(k);
            }
            open = still;
        }
        Ok(())
    }

    /// An event at the end of a phase.
    fn jump(&self, flight: &mut Flight, event: usize, options: &Options, flights: &mut Flights) {
        flight.t += flight.flown;
        let Some(map) = &self.maps[event] else {
            flight.end = Some(End::At(event));
            return;
        };
        let before = std::mem::take(&mut flight.x);
        let all = self.conditions.eval(&before);
        let after = map.eval(&before);
        flights.jumps.push(Jump {
            flight: flight.number,
            event,
            t: flight.t,
            before,
            after: after.clone(),
        });
        let finite = after.iter().all(|v| v.is_finite());
        flight.short = match flight.flown <= SHORT * flight.t {
            true => flight.short + 1,
            false => 0,
        };
        flight.phase += 1;
        flight.after = Some(event);
        flight.before = flight.flown;
        if flight.flown > self.grain(options).time {
            flight.known.fill(None);
        }
        flight.known[event] = Some(false);
        // What is on its surface at the same moment comes true, too.
        let grain = self.grain(options);
        for other in (0..self.at_once.len()).filter(|o| *o != event) {
            let here = self.condition(&all, other);
            if flight.known[other].is_none() && here.is_on_surface(grain) && here.slope < 0.0 {
                flight.known[other] = Some(true);
            }
        }
        flight.begin.clone_from(&after);
        flight.x = after;
        flight.flown = 0.0;
        flight.short_legs = 0;
        flight.watched.clear();
        flight.end = if !finite {
            Some(End::NoState)
        } else if flight.short >= MOST_SHORT {
            Some(End::Zeno)
        } else if flight.phase >= options.events {
            Some(End::Events)
        } else {
            None
        };
    }

    pub(super) fn run(&self, options: &Options, levels: Vec<f64>, dim: usize) -> Run {
        // The norm is a mean over all components, of which some never change.
        let share = (self.states as f64 / dim as f64).sqrt();
        let mut atol: Vec<f64> = options.atol.iter().map(|a| a * share).collect();
        atol.resize(dim, UNCONTROLLED);
        Run {
            rtol: options.rtol * share,
            atol,
            step: match self.adaptive {
                true => 0.0,
                // Time runs from 0 to 1.
                false => options.step / options.time,
            },
            first: None,
            max_steps: options.max_steps,
            levels,
            ceiling: None,
            bounds: Vec::new(),
        }
    }

    /// Stores points of phases that have come to their end.
    fn keep(
        &mut self,
        due: &[(&mut Flight, Option<usize>)],
        options: &Options,
        flights: &mut Flights,
    ) -> Result<(), BackendError> {
        let n = self.states;
        let levels: Vec<f64> = (1..=options.samples)
            .map(|k| k as f64 / options.samples as f64)
            .collect();
        let run = self.run(options, levels.clone(), n + 1);
        let lasting: Vec<&Flight> = due.iter().map(|(f, _)| &**f).collect();
        let seeds: Vec<f64> = (lasting.iter())
            .flat_map(|f| f.begin.iter().copied().chain([f.flown]))
            .collect();
        if seeds.is_empty() {
            return Ok(());
        }
        let flown = self.stored.integrate(&run, &seeds)?;
        for (k, flight) in lasting.iter().enumerate() {
            let mut push = |t: f64, x: &[f64]| {
                flights.samples.push(Sample {
                    flight: flight.number,
                    phase: flight.phase,
                    t,
                    x: x.to_vec(),
                });
            };
            push(flight.t, &flight.begin);
            for (level, share) in levels.iter().enumerate() {
                let row = flown.sample(k, level);
                if flight.flown > 0.0 && row[0].is_finite() {
                    push(flight.t + share * flight.flown, &row[1..=n]);
                }
            }
        }
        Ok(())
    }
}

/// A leg, an event, the points between which it may be met, and when.
type Suspect = (usize, usize, Point, Point, f64);

/// Something that happened between the ends of steps.
struct Early {
    event: usize,
    /// Since the beginning of the leg, about; and the state there.
    t: f64,
    x: Vec<f64>,
}

/// Expressions of [`Linear`].
struct Linearized {
    /// `(x, T, v)`.
    inputs: Vec<Id>,
    varied: Vec<Id>,
    gradients: Vec<Id>,
    jacobians: Vec<Option<Vec<Id>>>,
}

impl Linearized {
    fn new(graph: &mut Graph, x: &[Id], rates: &[Id], all: &[&Event], duration: Id) -> Self {
        let column: Vec<Id> = (0..x.len())
            .map(|i| graph.symbol(&format!("variation {i}"), Kind::State))
            .collect();
        let along = x.iter().copied().zip(column.iter().copied()).collect();
        let tangents = graph.tangents(rates, &along);
        let zero = graph.constant(0.0);
        let mut varied: Vec<Id> = rates.iter().map(|f| graph.mul(duration, *f)).collect();
        varied.push(zero);
        varied.extend(
            tangents
                .iter()
                .map(|t| graph.mul(duration, *t))
                .collect::<Vec<_>>(),
        );
        let gradients = (all.iter())
            .flat_map(|e| graph.gradient(e.ahead, x))
            .collect();
        let jacobians = (all.iter())
            .map(|e| {
                let rows = e.map.as_ref()?.iter();
                Some(rows.flat_map(|row| graph.gradient(*row, x)).collect())
            })
            .collect();
        Self {
            inputs: [x, &[duration], &column].concat(),
            varied,
            gradients,
            jacobians,
        }
    }
}

/// The largest value of each condition at some states; 1 where there is none.
fn sizes(conditions: &Program, states: &[f64], n: usize, count: usize) -> Vec<f64> {
    let mut sizes = vec![0.0f64; count];
    for x in states.chunks(n) {
        let all = conditions.eval(x);
        for (size, value) in sizes.iter_mut().zip(&all) {
            if value.is_finite() {
                *size = size.max(value.abs());
            }
        }
    }
    sizes
        .iter_mut()
        .filter(|s| **s == 0.0)
        .for_each(|s| *s = 1.0);
    sizes
}

/// What a leg came to.
enum Met {
    /// A surface that was passed.
    Nothing,
    Event(usize),
    End,
}

impl Flights {
    fn count(&mut self, flown: &Trajectories) {
        self.steps += flown.steps.iter().map(|s| u64::from(*s)).sum::<u64>();
        self.rejected += flown.rejected.iter().map(|s| u64::from(*s)).sum::<u64>();
    }
}
