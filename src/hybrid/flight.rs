//! Batches of flights with events, on any backend.
//!
//! A flight is integrated over a share of the time left to it, `dx/dq = T f(x)`, so that flights
//! with different times to go are one batch. Where an event's condition comes true, the duration of
//! its phase (the way from event to event) is found by Newton's method, `T <- T - g/g'`, each time
//! flying from the beginning of the phase: the state at an event is the end of a step, not of an
//! interpolation.

use super::watch::{GRAIN, GRAIN_SINGLE, Side, Watch};
use crate::backend::{
    Backend, BackendError, By, Deadline, Guards, Kernel, Run, Spec, Status, batch_limit,
};
use crate::expr::{Graph, Id, Kind};
use crate::model::{Event, Method, Precision};
use crate::program::Program;
use rustc_hash::FxHashMap;

/// Newton's corrections of an event's time; it is located when one is this small, relative to the
/// phase.
const CORRECTIONS: usize = 6;
const LOCATED: f64 = 1e-13;
/// Where rounding, or the tolerance of a step, keeps corrections from falling that far, the last must
/// be below so many of these.
const ROUNDINGS: f64 = 64.0;
const TOLERANCES: f64 = 10.0;
/// Phases shorter than this share of the whole time are counted; so many in a row are an
/// accumulation of events (Zeno). Likewise of legs within a phase.
const SHORT: f64 = 1e-9;
const MOST_SHORT: usize = 20;
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
            End::Failed(status) => 5 + status as i32,
            End::At(event) => Self::FIRST_EVENT + i32::try_from(event).unwrap_or(i32::MAX >> 1),
        }
    }

    /// The code of the first event at which a flight may end; the others follow.
    pub const FIRST_EVENT: i32 = 16;

    /// All but those at an event.
    pub const OTHERS: [End; 8] = [
        End::Time,
        End::Events,
        End::Zeno,
        End::NotLocated,
        End::NoState,
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
    /// Until something comes true that is watched for: `(x, T, sign and offset an event)`.
    guarded: Box<dyn Kernel>,
    /// Over a given time: `(x, T)`.
    plain: Box<dyn Kernel>,
    /// The same with stored points.
    stored: Option<Box<dyn Kernel>>,
    /// Of a state: `ahead` of each event, the rates of these, and where events count.
    conditions: Program,
    /// Of a state: the state after each event.
    maps: Vec<Option<Program>>,
}

crate::opaque!(Simulator);

/// A flight under way.
struct Flight {
    /// Number in the list.
    number: usize,
    phase: usize,
    /// The event that the phase began with.
    after: Option<usize>,
    /// Where the phase began, and when.
    begin: Vec<f64>,
    t: f64,
    /// Where the flight is, and for how long the phase has lasted.
    x: Vec<f64>,
    flown: f64,
    watched: Vec<Watch>,
    /// Phases, or legs of this phase, that were short, in a row.
    short: usize,
    short_legs: usize,
    end: Option<End>,
}

impl Simulator {
    /// Of rates and events as functions of `x` alone, on a backend. `guards` are events at which a
    /// flight ends, also where it begins.
    ///
    /// # Errors
    /// What the backend refuses to compile.
    pub fn new(
        graph: &mut Graph,
        (x, rates): (&[Id], &[Id]),
        (events, guards): (&[Event], &[Event]),
        (backend, method, precision): (&dyn Backend, Method, Precision),
        store: bool,
    ) -> Result<Self, BackendError> {
        let n = x.len();
        let all: Vec<&Event> = events.iter().chain(guards).collect();
        let ahead: Vec<Id> = all.iter().map(|e| e.ahead).collect();
        let duration = graph.symbol("phase duration", Kind::Parameter);
        let scaled: Vec<Id> = rates.iter().map(|f| graph.mul(duration, *f)).collect();
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
        let switches = graph.kinks(rates);
        let moving: FxHashMap<Id, Id> = x.iter().copied().zip(rates.iter().copied()).collect();
        let slopes = graph.tangents(&ahead, &moving);
        let everywhere = graph.constant(1.0);
        let only = all.iter().map(|e| e.only.unwrap_or(everywhere));
        let conditions: Vec<Id> = ahead.iter().copied().chain(slopes).chain(only).collect();

        let spec = |inputs: &[Id], guarded: bool, store: bool| Spec {
            rate: {
                let constants = std::iter::repeat_n(zero, inputs.len() - n);
                let rate: Vec<Id> = scaled.iter().copied().chain(constants).collect();
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
        let guarded = backend.compile(&spec(&inputs, true, false))?;
        let plain = backend.compile(&spec(&plain_inputs, false, false))?;
        let stored = match store {
            true => Some(backend.compile(&spec(&plain_inputs, false, true))?),
            false => None,
        };
        Ok(Self {
            states: n,
            precision,
            adaptive: method.adaptive(),
            at_once: (0..all.len()).map(|k| k >= events.len()).collect(),
            guarded,
            plain,
            stored,
            conditions: Program::lower(graph, x, &conditions),
            maps: (all.iter())
                .map(|e| e.map.as_ref().map(|map| Program::lower(graph, x, map)))
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
        let width = n + 1 + 2 * self.at_once.len();
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
                after: None,
                begin: x.to_vec(),
                t: 0.0,
                x: x.to_vec(),
                flown: 0.0,
                watched: Vec::new(),
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

    /// Sets what a phase that begins looks out for; an event that is met right there.
    fn look_out(&self, flight: &mut Flight, options: &Options) -> Option<usize> {
        if !flight.watched.is_empty() || self.at_once.is_empty() {
            return None;
        }
        let grain = self.grain(options);
        let all = self.conditions.eval(&flight.x);
        for (event, at_once) in self.at_once.iter().enumerate() {
            let here = self.condition(&all, event);
            let side = match *at_once && here.0 <= 0.0 {
                true => Side::Met,
                false => Watch::at(here, flight.after == Some(event), grain),
            };
            match side {
                Side::Met if self.counts(&all, event) => {
                    flight.watched.clear();
                    return Some(event);
                }
                Side::Met => flight.watched.push(Watch::on(false, here, grain)),
                Side::Watched(watch) => flight.watched.push(watch),
            }
        }
        None
    }

    fn grain(&self, options: &Options) -> f64 {
        options.time
            * match self.precision {
                Precision::F64 => GRAIN,
                Precision::F32 => GRAIN_SINGLE,
            }
    }

    /// `ahead` of an event, and its rate.
    fn condition(&self, all: &[f64], event: usize) -> (f64, f64) {
        (all[event], all[self.at_once.len() + event])
    }

    /// Whether an event counts at the state of these conditions.
    fn counts(&self, all: &[f64], event: usize) -> bool {
        all[2 * self.at_once.len() + event] >= 0.0
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
        let mut seeds = Vec::new();
        for (flight, left) in flying.iter().zip(&left) {
            seeds.extend_from_slice(&flight.x);
            seeds.push(*left);
            seeds.extend(flight.watched.iter().flat_map(|w| [w.sign(), w.offset]));
        }
        let dim = n + 1 + 2 * self.at_once.len();
        let run = self.run(options, vec![1.0], dim);
        let flown = match flying.is_empty() {
            true => return Ok(Vec::new()),
            false => self.guarded.integrate(&run, &seeds)?,
        };
        flights.count(&flown);
        let grain = self.grain(options);
        let mut legs = Vec::new();
        let mut at_events = Vec::new();
        for (k, flight) in flying.into_iter().enumerate() {
            let status = flown.status[k];
            let duration = match status {
                Status::Reached => left[k],
                _ => left[k] * flown.end_time[k],
            };
            flight.flown += duration;
            flight.x = flown.end[k * dim..][..n].to_vec();
            let met = match status {
                Status::Reached => {
                    flight.end = Some(End::Time);
                    Met::End
                }
                Status::Guard => {
                    flight.short_legs = match duration < SHORT * options.time {
                        true => flight.short_legs + 1,
                        false => 0,
                    };
                    let all = self.conditions.eval(&flight.x);
                    let event = self.nearest(&all, &flight.watched);
                    let armed = flight.watched[event].armed;
                    if flight.short_legs > MOST_SHORT {
                        flight.end = Some(End::NotLocated);
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

    /// The event whose surface, as it is watched, is the nearest in time.
    fn nearest(&self, all: &[f64], watched: &[Watch]) -> usize {
        let time = |e: usize| {
            let (ahead, slope) = self.condition(all, e);
            let left = watched[e].sign() * ahead + watched[e].offset;
            (left / slope).abs()
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
                let (ahead, slope) = self.condition(&all, *event);
                let by = -ahead / slope;
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
                    flight.end = Some(match flight.flown < SHORT * options.time {
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
        let after = map.eval(&before);
        flights.jumps.push(Jump {
            flight: flight.number,
            event,
            t: flight.t,
            before,
            after: after.clone(),
        });
        let finite = after.iter().all(|v| v.is_finite());
        flight.short = match flight.flown < SHORT * options.time {
            true => flight.short + 1,
            false => 0,
        };
        flight.phase += 1;
        flight.after = Some(event);
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

    fn run(&self, options: &Options, levels: Vec<f64>, dim: usize) -> Run {
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
        let Some(stored) = &mut self.stored else {
            return Ok(());
        };
        let lasting: Vec<&Flight> = due.iter().map(|(f, _)| &**f).collect();
        let seeds: Vec<f64> = (lasting.iter())
            .flat_map(|f| f.begin.iter().copied().chain([f.flown]))
            .collect();
        if seeds.is_empty() {
            return Ok(());
        }
        let flown = stored.integrate(&run, &seeds)?;
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

/// What a leg came to.
enum Met {
    /// A surface that was passed.
    Nothing,
    Event(usize),
    End,
}

impl Flights {
    fn count(&mut self, flown: &crate::backend::Trajectories) {
        self.steps += flown.steps.iter().map(|s| u64::from(*s)).sum::<u64>();
        self.rejected += flown.rejected.iter().map(|s| u64::from(*s)).sum::<u64>();
    }
}
