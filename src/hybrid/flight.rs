//! Batches of flights with events, on any backend.
//!
//! A flight is integrated over a share of the time left to it, `dx/dq = T f(x)`, so that flights
//! with different times to go are one batch. Where an event's condition comes true, the duration of
//! its phase (the way from event to event) is found by Newton's method, `T <- T - g/g'`, each time
//! flying from the beginning of the phase: the state at an event is the end of a step, not of an
//! interpolation.

mod legs;

use legs::Met;

use super::watch::{Grain, Here, Side, Watch};
use crate::backend::{
    Backend, BackendError, By, Deadline, Guards, Kernel, Run, Spec, Status, Trajectories,
    batch_limit,
};
use crate::expr::{Graph, Id, Kind};
use crate::model::{Event, Method, Precision};
use crate::program::Program;
use rustc_hash::FxHashMap;

/// Phases shorter than this share of the time so far are counted; so many in a row are an
/// accumulation of events (Zeno). Likewise of legs within a phase.
const SHORT: f64 = 1e-9;
const MOST_SHORT: usize = 20;
/// An event that turns the motion leaves more than this share of its speed; less is rounding, of a
/// motion that was brought to rest.
const TURNED: f64 = 1e-9;
/// Gaps and velocities of contacts that are more than rounding, in the scene's units.
pub const OFF: f64 = 1e-6;
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
    /// An event led to a state in which a contact of the mechanism does not hold.
    ContactLost,
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
            End::ContactLost => "contact_lost",
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
            End::ContactLost => 12,
            End::At(event) => Self::FIRST_EVENT + i32::try_from(event).unwrap_or(i32::MAX >> 1),
        }
    }

    /// The end of a number; `None` where there is none such.
    #[must_use]
    pub fn of_code(code: i32) -> Option<Self> {
        let event = usize::try_from(code - Self::FIRST_EVENT);
        let at_event = event.ok().map(End::At);
        at_event.or(Self::OTHERS.into_iter().find(|end| end.code() == code))
    }

    /// The code of the first event at which a flight may end; the others follow.
    pub const FIRST_EVENT: i32 = 16;

    /// All but those at an event.
    pub const OTHERS: [End; 10] = [
        End::Time,
        End::Events,
        End::Zeno,
        End::NotLocated,
        End::NoState,
        End::NoCondition,
        End::ContactLost,
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

/// A contact that does not hold after an event.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lost {
    pub flight: usize,
    pub event: usize,
    /// Number among what the event keeps, and its value.
    pub kept: usize,
    pub by: f64,
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
    /// Of the region.
    pub widths: Vec<f64>,
    /// What a flight begins nearer to than this share of a condition's size is true there.
    pub begins: f64,
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
    /// The first flight that a contact was lost in.
    pub lost: Option<Lost>,
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
    plain: Box<dyn Kernel>,
    /// The same with stored points.
    stored: Box<dyn Kernel>,
    /// Of a state: `ahead` of each event, the first and second rates of these, and where events
    /// count.
    conditions: Program,
    /// Of a state: the state after each event, then what contacts keep, after it and before it.
    maps: Vec<Option<Program>>,
}

crate::opaque!(Simulator);

/// A flight under way.
struct Flight {
    /// Number in the list.
    number: usize,
    phase: usize,
    /// Where the phase began, and when.
    begin: Vec<f64>,
    t: f64,
    /// Where, and after how long, an event was passed by in this phase: times are located from there.
    passed: (Vec<f64>, f64),
    /// Where the flight is, and for how long the phase has lasted.
    x: Vec<f64>,
    flown: f64,
    /// How long when its latest leg began.
    leg: f64,
    watched: Vec<Watch>,
    /// The event that the phase began with, and the rate at which its condition came true.
    after: Option<usize>,
    came: f64,
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
        let sizes = sizes(graph, &ahead, x, states);
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
        let of_state = |roots: &[Id]| Program::lower(graph, x, roots);
        let conditions = of_state(&conditions);
        Ok(Self {
            states: n,
            precision,
            adaptive: method.adaptive(),
            at_once: (0..all.len()).map(|k| k >= events.len()).collect(),
            sizes,
            guarded: backend.compile(&spec(&inputs, &slope, true, false))?,
            plain: backend.compile(&spec(&plain_inputs, &[], false, false))?,
            stored: backend.compile(&spec(&plain_inputs, &[], false, true))?,
            conditions,
            maps: (all.iter())
                .map(|e| {
                    let kept =
                        (e.kept.iter().map(|k| k.after)).chain(e.kept.iter().map(|k| k.before));
                    let map = e.map.as_ref()?.iter().copied();
                    Some(of_state(&map.chain(kept).collect::<Vec<Id>>()))
                })
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
                passed: (x.to_vec(), 0.0),
                t: 0.0,
                x: x.to_vec(),
                flown: 0.0,
                leg: 0.0,
                watched: Vec::new(),
                after: None,
                came: 0.0,
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
        let grain = self.grain(options).after(flight.t);
        let all = self.conditions.eval(&flight.x);
        if self.is_unknown(&all) {
            flight.end = Some(End::NoCondition);
            return None;
        }
        let mut met = None;
        for (event, at_once) in self.at_once.iter().enumerate() {
            let here = self.condition(&all, event);
            // What has just happened is true, and what a flight begins with has not come true.
            let just = flight.after == Some(event);
            let begins = flight.phase == 0;
            let is_true = !at_once && here.ahead <= options.begins * here.size;
            let known = match just || begins && is_true {
                true => Some(false),
                false => flight.known[event],
            };
            // A guard holds on its surface, and goes on holding where the state leads back from there.
            let on_it = here.ahead.abs() <= here.rounding(self.precision, 0.0);
            let turns_back = on_it && here.leaves(grain);
            let side = match *at_once && here.ahead <= 0.0 && !turns_back {
                true => Side::Met,
                false => Watch::at(here, known, grain),
            };
            // It was turned, and would leave for less than a moment.
            let turned = just && here.slope > TURNED * flight.came.abs();
            if turned && here.is_on_surface(grain) && !here.leaves(grain) {
                flight.end = Some(End::Zeno);
                return None;
            }
            let watch = match side {
                Side::Met if self.counts(&all, event) => {
                    met = met.or(Some(event));
                    continue;
                }
                Side::Met if self.is_unasked(&all, event) => {
                    flight.end = Some(End::NoCondition);
                    return None;
                }
                Side::Met => Watch::on(false, here, grain),
                Side::Watched(watch) => watch,
            };
            if known.is_some() && here.is_on_surface(grain) {
                flight.known[event] = Some(watch.armed);
            }
            flight.watched.push(watch);
        }
        if met.is_some() {
            flight.watched.clear();
        }
        met
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

    /// Whether nobody can say if an event counts.
    fn is_unasked(&self, all: &[f64], event: usize) -> bool {
        all[3 * self.at_once.len() + event].is_nan()
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
        let mut after = map.eval(&before);
        let kept = after.split_off(self.states);
        let (kept, kept_before) = kept.split_at(kept.len() / 2);
        let lost = lost_contact(kept, kept_before);
        if let Some(kept_number) = lost {
            flights.lost.get_or_insert(Lost {
                flight: flight.number,
                event,
                kept: kept_number,
                by: kept[kept_number],
            });
        }
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
        flight.came = self.condition(&all, event).slope;
        if flight.flown > self.grain(options).time {
            flight.known.fill(None);
        }
        flight.known[event] = Some(false);
        // What is on its surface at the same moment: what is armed comes true, too, if the state goes
        // into it after the jump; what was true stays so.
        let grain = self.grain(options).after(flight.t);
        let (mut ends, mut due) = (None, false);
        let there = self.conditions.eval(&after);
        for other in (0..self.at_once.len()).filter(|o| *o != event) {
            let here = self.condition(&all, other);
            if !here.is_on_surface(grain) {
                continue;
            }
            // Its side tells more than its watch, but for rounding; that may have been turned past this
            // moment.
            let rounding = here.rounding(self.precision, flight.flown);
            let watch = flight.watched.get(other);
            let armed = flight.known[other].unwrap_or_else(|| match here.ahead.abs() > rounding {
                true => here.ahead > 0.0,
                false => watch.is_none_or(|w| {
                    w.armed != (w.since > flight.flown - grain.time && w.since > 0.0)
                }),
            });
            flight.known[other] = Some(armed);
            let now = here.ahead.abs() <= rounding && here.slope < 0.0;
            if !(armed && now) || self.at_once[other] {
                continue;
            }
            // One that ends the flight does so when those before it in the scene have happened, unless
            // the state has left its surface by then.
            let then = self.condition(&there, other);
            let waits = due && then.is_on_surface(grain) && !then.leaves(grain);
            match self.maps[other].is_none() {
                true if !waits && self.counts(&all, other) => {
                    ends = ends.or(Some(End::At(other)));
                }
                true => {}
                // What has happened by then decides.
                false => due |= self.counts(&there, other),
            }
        }
        flight.begin.clone_from(&after);
        flight.passed = (after.clone(), 0.0);
        flight.x = after;
        flight.flown = 0.0;
        flight.short_legs = 0;
        flight.watched.clear();
        flight.end = if !finite {
            Some(End::NoState)
        } else if ends.is_some() {
            ends
        } else if flight.short >= MOST_SHORT {
            Some(End::Zeno)
        } else if flight.phase >= options.events {
            Some(End::Events)
        } else if lost.is_some() {
            Some(End::ContactLost)
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

/// The first of what contacts keep that is off after an event, and more so than before it.
pub fn lost_contact(after: &[f64], before: &[f64]) -> Option<usize> {
    (after.iter().zip(before))
        .position(|(after, before)| after.abs() > OFF && after.abs() > 2.0 * before.abs())
}

/// The largest value of each condition at some states (`[state][n]`), or of what its rounding is a
/// share of: of x times its derivative by that; 1 where there is none.
pub fn sizes(graph: &mut Graph, ahead: &[Id], x: &[Id], states: &[f64]) -> Vec<f64> {
    let gradients: Vec<Id> = (ahead.iter())
        .flat_map(|ahead| graph.gradient(*ahead, x))
        .collect();
    let [conditions, gradients] = [ahead, &gradients].map(|all| Program::lower(graph, x, all));
    let n = x.len();
    let mut sizes = vec![0.0f64; ahead.len()];
    for x in states.chunks(n) {
        let (all, slopes) = (conditions.eval(x), gradients.eval(x));
        for (k, size) in sizes.iter_mut().enumerate() {
            let slopes = slopes[k * n..][..n].iter().zip(x);
            let terms: f64 = slopes.map(|(slope, x)| (slope * x).abs()).sum();
            for value in [all[k].abs(), terms] {
                if value.is_finite() {
                    *size = size.max(value);
                }
            }
        }
    }
    sizes
        .iter_mut()
        .filter(|s| **s == 0.0)
        .for_each(|s| *s = 1.0);
    sizes
}

impl Flights {
    fn count(&mut self, flown: &Trajectories) {
        self.steps += flown.steps.iter().map(|s| u64::from(*s)).sum::<u64>();
        self.rejected += flown.rejected.iter().map(|s| u64::from(*s)).sum::<u64>();
    }
}
