//! `[equilibrium]`: read, and checked against the equations.

use super::declare::Declared;
use super::mechanism::Generated;
use super::reader::{Reader, Section};
use crate::diagnostics::Problem;
use crate::diagnostics::shorten;
use crate::expr::{Fun, Graph, Id, Op};
use crate::mechanism::Mechanism;
use crate::model::{Control, Guard, Located, Span, Variable};
use crate::numeric::digits::plain;
use nalgebra::{DMatrix, DVector};
use rustc_hash::FxHashMap;

/// What may remain of f and L at the equilibrium, relative to the size of the terms they are made
/// of, there and over the region: so states of any size are checked alike. Parameters are typed
/// with some ten digits at best; rounding is far below.
const TOLERANCE: f64 = 1e-9;
/// What may remain in any case: sin(pi) is 1.2e-16, not 0.
const ROUNDING: f64 = 1e-14;
/// Further away than this share of the region's width it is another equilibrium.
const NEAR: f64 = 0.05;
/// Points of the region at which terms are looked at.
pub(super) const POINTS: usize = 16;

/// A value and the place it is given at.
#[derive(Clone, Debug)]
pub(super) struct Placed {
    pub value: f64,
    pub span: Span,
}

/// Values of all states and controls.
#[derive(Clone, Debug)]
pub(super) struct Equilibrium {
    pub x: Vec<Placed>,
    pub u: Vec<Placed>,
    pub span: Span,
}

/// What has been read of a scene, for the checks at the equilibrium.
pub(super) struct Scene<'s> {
    pub states: &'s [&'s Variable],
    pub controls: &'s [Control],
    pub disturbances: &'s [Variable],
    pub dynamics: &'s [Located],
    pub running: &'s Located,
    pub guards: &'s [Guard],
    pub region: Option<&'s [[f64; 2]]>,
    pub finite: bool,
    /// Its coordinates and rates may be held by other states, as by controls.
    pub mechanism: Option<&'s Mechanism>,
}

impl<'a> Reader<'a> {
    /// `[equilibrium]`; `None` where a value is missing or wrong.
    pub fn equilibrium(
        &mut self,
        section: &Section<'a>,
        states: &[Declared<'a>],
        controls: &[Declared<'a>],
        disturbances: &[Declared<'a>],
        generated: &Generated,
    ) -> Option<Equilibrium> {
        for d in disturbances
            .iter()
            .filter(|d| section.get(d.name).is_some())
        {
            let message = format!(
                "`{}` is a disturbance, which is 0 at the equilibrium",
                shorten(d.name)
            );
            self.report(Problem::at(
                section.key_span(d.name),
                message,
                "remove this",
            ));
        }
        let known: Vec<Declared<'a>> = states
            .iter()
            .chain(controls)
            .chain(disturbances)
            .cloned()
            .collect();
        self.entries_of(section, &known, "states and controls");
        let (x, u) = (
            self.values_of(section, states, ("state", generated)),
            self.values_of(section, controls, ("control", generated)),
        );
        Some(Equilibrium {
            x: x?,
            u: u?,
            span: section.span.clone(),
        })
    }

    fn values_of(
        &mut self,
        section: &Section<'a>,
        names: &[Declared<'a>],
        (noun, generated): (&str, &Generated),
    ) -> Option<Vec<Placed>> {
        let mut all = Vec::with_capacity(names.len());
        let mut missing = Vec::new();
        for declared in names {
            let name = shorten(declared.name);
            all.push(match section.get(declared.name) {
                Some(v) => self.number(v, &format!("the equilibrium of `{name}`")),
                // A mechanism is at rest.
                None if generated.is_rate(declared.name) => Some(0.0),
                None => {
                    missing.push(name);
                    None
                }
            });
        }
        self.report_missing(section, noun, &missing);
        let place = |d: &Declared<'a>| {
            section
                .get(d.name)
                .map_or_else(|| section.span.clone(), |v| v.span())
        };
        all.into_iter()
            .zip(names)
            .map(|(v, d)| {
                v.map(|value| Placed {
                    value,
                    span: place(d),
                })
            })
            .collect()
    }

    /// One problem for all that have no value.
    fn report_missing(&mut self, section: &Section<'a>, noun: &str, missing: &[String]) {
        /// Names that a message lists.
        const LISTED: usize = 12;
        let quoted = missing.iter().take(LISTED).map(|name| format!("`{name}`"));
        let quoted: Vec<String> = quoted.collect();
        let message = match missing.len() {
            0 => return,
            1 => format!("{noun} {} has no value in [equilibrium]", quoted[0]),
            _ => {
                let more = match missing.len().saturating_sub(LISTED) {
                    0 => String::new(),
                    more => format!(" and {more} more"),
                };
                let names = quoted.join(", ");
                format!("{noun}s {names}{more} have no value in [equilibrium]")
            }
        };
        let zeros = missing
            .iter()
            .take(LISTED)
            .map(|name| format!("{name} = 0"));
        let zeros: Vec<String> = zeros.collect();
        let help = format!("where it is 0, write {}", zeros.join(", "));
        let problem = Problem::at(section.span.clone(), message, "missing here");
        self.report(problem.with_help(help));
    }

    /// Checks the equilibrium against bounds and region.
    pub fn check_equilibrium_range(
        &mut self,
        at: &Equilibrium,
        states: &[&Variable],
        controls: &[Control],
        region: Option<&[[f64; 2]]>,
        finite: bool,
    ) {
        for ((placed, state), [lower, upper]) in
            at.x.iter().zip(states).zip(region.unwrap_or_default())
        {
            let value = placed.value;
            if value < *lower || value > *upper {
                let message = format!(
                    "the equilibrium is outside the region: `{}` is {}",
                    state.name,
                    plain(value)
                );
                self.report(Problem::at(
                    placed.span.clone(),
                    message,
                    format!("not in [{}, {}]", plain(*lower), plain(*upper)),
                ));
            }
        }
        for (placed, control) in at.u.iter().zip(controls).filter(|_| !finite) {
            let value = placed.value;
            let (min, max) = (
                control.min.unwrap_or(f64::NEG_INFINITY),
                control.max.unwrap_or(f64::INFINITY),
            );
            if min < max && !(value > min && value < max) {
                let name = &control.variable.name;
                let message = format!(
                    "the equilibrium of `{name}` is {}, not strictly between its bounds",
                    plain(value)
                );
                let help = "the local solution at the equilibrium needs the control strictly inside its bounds";
                let label = format!("not inside ({}, {})", plain(min), plain(max));
                self.report(Problem::at(placed.span.clone(), message, label).with_help(help));
            }
        }
    }

    /// Largest size of an expression's terms at some points of the region, the other values as
    /// given; 1 where the region is not known.
    fn size_over(&self, expr: Id, values: &FxHashMap<Id, f64>, scene: &Scene<'_>) -> f64 {
        let Some(region) = scene.region else {
            return 1.0;
        };
        let mut values = values.clone();
        (0..POINTS)
            .map(|k| {
                values.extend(point_of(k, scene.states, region));
                sized(&self.graph, expr, &values).1
            })
            .filter(|size| size.is_finite())
            .fold(0.0, f64::max)
    }

    /// The equilibrium next to the values given, in words, where there is one near by: with the
    /// controls as they are, or else of states and controls together the nearest in widths of the
    /// region.
    fn nearest_equilibrium(
        &self,
        at: &Equilibrium,
        scene: &Scene<'_>,
        values: &FxHashMap<Id, f64>,
    ) -> Option<String> {
        let states = scene.states.iter().map(|s| (s.symbol, s.name.as_str()));
        let controls = scene.controls.iter();
        let unknowns: Vec<(Id, &str)> = states
            .chain(controls.map(|c| (c.variable.symbol, c.variable.name.as_str())))
            .collect();
        let given: Vec<f64> = at.x.iter().chain(&at.u).map(|p| p.value).collect();
        let widths: Vec<f64> = (scene.region?.iter().map(|[lo, hi]| hi - lo))
            .chain(at.u.iter().map(|p| p.value.abs().max(1.0)))
            .collect();
        let rates: Vec<Id> = scene.dynamics.iter().map(|f| f.expr).collect();
        let moved = [rates.len(), unknowns.len()].into_iter().find_map(|free| {
            let symbols: Vec<Id> = unknowns[..free].iter().map(|(id, _)| *id).collect();
            let at: Vec<f64> = given[..free].to_vec();
            self.root(&rates, &symbols, &at, (&widths, NEAR), values)
        });
        let Some(moved) = moved else {
            return self.holding(at, scene, &rates, values);
        };
        let moved: Vec<f64> = (moved.iter().chain(&given[moved.len()..]))
            .copied()
            .collect();
        // One at a bound would be refused.
        let states = moved.len() - scene.controls.len();
        if !scene.controls.iter().zip(&moved[states..]).all(is_inside) {
            return None;
        }
        let written = unknowns.iter().zip(moved);
        let written: Vec<String> = written
            .map(|((_, name), moved)| format!("{name}={moved:?}"))
            .collect();
        Some(format!(
            "the nearest equilibrium has {}; write that, or what it is as an expression (in the cost too, where it stands there)",
            written.join(", ")
        ))
    }

    /// The controls, wherever they are, that keep the states where they are, in words; of a
    /// mechanism with its motors' states.
    fn holding(
        &self,
        at: &Equilibrium,
        scene: &Scene<'_>,
        rates: &[Id],
        values: &FxHashMap<Id, f64>,
    ) -> Option<String> {
        let motors = (scene.states.iter().zip(&at.x))
            .filter(|(s, _)| scene.mechanism.is_some_and(|m| !m.moves(s.symbol)));
        let controls = (scene.controls.iter().zip(&at.u)).map(|(c, u)| (&c.variable, u.value));
        let unknowns: Vec<(&Variable, f64)> =
            motors.map(|(s, x)| (*s, x.value)).chain(controls).collect();
        let symbols: Vec<Id> = unknowns.iter().map(|(v, _)| v.symbol).collect();
        let given: Vec<f64> = unknowns.iter().map(|(_, value)| *value).collect();
        let held = self.root(
            rates,
            &symbols,
            &given,
            (&vec![1.0; given.len()], f64::INFINITY),
            values,
        )?;
        let (motors, controls) = held.split_at(held.len() - scene.controls.len());
        if !scene.controls.iter().zip(controls).all(is_inside) {
            return None;
        }
        let written = unknowns.iter().zip(motors.iter().chain(controls));
        let written: Vec<String> = written
            .map(|((variable, _), value)| format!("{} = {value:?}", variable.name))
            .collect();
        let states = match motors.is_empty() {
            true => "these states are",
            false => "this posture is",
        };
        Some(format!(
            "{states} held by {}; write that, or what it is as an expression (in the cost too, where it stands there)",
            written.join(", ")
        ))
    }

    /// Values of `unknowns`, no further from those given than a share of `widths`, where all of `rates` are 0: Newton's method, with
    /// the shortest step in `widths` where there are more unknowns than equations.
    fn root(
        &self,
        rates: &[Id],
        unknowns: &[Id],
        given: &[f64],
        (widths, nearest): (&[f64], f64),
        values: &FxHashMap<Id, f64>,
    ) -> Option<Vec<f64>> {
        /// What is left of a value next to 0 is rounding.
        const ZERO: f64 = 1e-13;
        const STEPS: usize = 30;
        let mut graph = self.graph.clone();
        let (n, m) = (rates.len(), unknowns.len());
        let slopes: Vec<Id> = (0..n * m)
            .map(|k| graph.diff(rates[k / m], unknowns[k % m]))
            .collect();
        let at = |point: &[f64]| {
            let mut here = values.clone();
            here.extend(unknowns.iter().copied().zip(point.iter().copied()));
            here
        };

        let mut point = given.to_vec();
        for _ in 0..STEPS {
            let here = at(&point);
            let rate = DVector::from_vec(graph.eval(rates, &here));
            let slope = graph.eval(&slopes, &here);
            let jacobian = DMatrix::from_fn(n, m, |i, j| slope[i * m + j] * widths[j]);
            if jacobian.iter().chain(rate.iter()).any(|v| !v.is_finite()) {
                return None;
            }
            let step = jacobian.svd(true, true).solve(&rate, 1e-9).ok()?;
            for j in 0..m {
                point[j] -= step[j] * widths[j];
            }
            if step.norm() < 1e-15 {
                break;
            }
        }
        for ((value, given), width) in point.iter_mut().zip(given).zip(widths) {
            if (*value - given).abs() < ZERO * width {
                *value = *given;
            } else if value.abs() < ZERO * width {
                *value = 0.0;
            }
        }
        let near = (0..m).all(|j| (point[j] - given[j]).abs() <= nearest * widths[j]);
        let here = at(&point);
        let solved = rates.iter().all(|f| {
            let (value, size) = sized(&graph, *f, &here);
            is_zero(value, size.max(1.0))
        });
        (near && solved).then_some(point)
    }

    /// Checks f = 0, L = 0, dL/dx = 0 and smoothness (not with a final time) and the guards at the
    /// equilibrium.
    pub fn check_equilibrium(&mut self, at: &Equilibrium, scene: &Scene<'_>) {
        let before = self.problems.len();
        let mut values = self.values.clone();
        values.extend(
            scene
                .states
                .iter()
                .zip(&at.x)
                .map(|(s, p)| (s.symbol, p.value)),
        );
        values.extend(
            scene
                .controls
                .iter()
                .zip(&at.u)
                .map(|(c, p)| (c.variable.symbol, p.value)),
        );
        values.extend(scene.disturbances.iter().map(|w| (w.symbol, 0.0)));
        let mut nearest = None;
        for (i, f) in scene.dynamics.iter().enumerate() {
            let (value, size) = sized(&self.graph, f.expr, &values);
            if !is_zero(value, size.max(self.size_over(f.expr, &values, scene))) {
                let name = &scene.states[i].name;
                let message =
                    format!("this is no equilibrium: d{name}/dt is {value:.6e} there, not 0");
                let label = format!("d{name}/dt = {value:.6e} here");
                let mut problem = Problem::at(at.x[i].span.clone(), message, label);
                // The first problem alone tells where one is.
                if nearest.is_none() {
                    nearest = Some(self.nearest_equilibrium(at, scene, &values));
                    problem.help = nearest.clone().flatten();
                }
                self.report(problem);
            }
        }
        let (value, size) = sized(&self.graph, scene.running.expr, &values);
        let size = size.max(self.size_over(scene.running.expr, &values, scene));
        if !scene.finite && !is_zero(value, size) {
            let message = format!("the running cost is {value:.6e} at the equilibrium, not 0");
            let problem = Problem::at(at.span.clone(), message, format!("L = {value:.6e} here"));
            self.report(problem.with_help(
                "V over an infinite horizon is finite only if L = 0 at the equilibrium (minimal time: the guide's chapter Tasks)",
            ));
        }
        // Where it is no equilibrium, derivatives there say nothing.
        if !scene.finite && self.problems.len() == before {
            self.check_smooth_rest(&values, scene);
        }
        for guard in scene.guards {
            let (value, size) = sized(&self.graph, guard.condition.expr, &values);
            // On the border of `>=` rounding must not decide.
            let holds = if guard.strict {
                value > 0.0
            } else {
                value >= -remainder(size.max(self.size_over(guard.condition.expr, &values, scene)))
            };
            if !holds {
                let message = format!("guard `{}` does not hold at the equilibrium", guard.name);
                let label = format!("the difference of its sides is {value:.6e}");
                self.report(Problem::at(guard.condition.span.clone(), message, label));
            }
        }
    }
}

/// The `k`-th point of the region at which terms are looked at: corners first, then points between
/// (a Kronecker sequence).
pub(super) fn point_of<'s>(
    k: usize,
    states: &'s [&'s Variable],
    region: &'s [[f64; 2]],
) -> impl Iterator<Item = (Id, f64)> + 's {
    states
        .iter()
        .zip(region)
        .enumerate()
        .map(move |(i, (state, [lo, hi]))| {
            let fraction = match k {
                0 => 0.0,
                1 => 1.0,
                2 => (i % 2) as f64,
                _ => (k as f64 * (i as f64 + 2.0).sqrt()).fract(),
            };
            (state.symbol, lo + (hi - lo) * fraction)
        })
}

/// What counts as zero among terms of this size.
fn remainder(size: f64) -> f64 {
    TOLERANCE * size + ROUNDING
}

pub(super) fn is_zero(value: f64, size: f64) -> bool {
    value.is_finite() && value.abs() <= remainder(size)
}

/// Whether a control lies strictly between its bounds.
fn is_inside((control, u): (&Control, &f64)) -> bool {
    control.min.is_none_or(|min| *u > min) && control.max.is_none_or(|max| *u < max)
}

/// Nodes above which sizes of terms say nothing: they multiply from node to node.
const LONG: usize = 300;

/// Value of an expression and the size of the terms that may have cancelled in it: node by node, and
/// of long expressions, such as a mechanism's, by what its numbers and symbols contribute.
pub(super) fn sized(graph: &Graph, expr: Id, values: &FxHashMap<Id, f64>) -> (f64, f64) {
    if graph.reachable(&[expr]).len() > LONG {
        return graph.sensitivity(expr, values);
    }
    // A step small enough for the slope, large enough against rounding: near the square root of
    // f64's epsilon.
    const STEP: f64 = 1e-8;
    let pair = |v: f64| (v, v.abs());
    graph.fold(
        &[expr],
        &mut |id| pair(values.get(&id).copied().unwrap_or(f64::NAN)),
        &mut |c| pair(c),
        &mut |f: Fun, (v, size)| {
            let y = f.apply(*v);
            let spread = (f.apply(v + STEP * size) - y).abs() / STEP;
            (y, y.abs() + if spread.is_finite() { spread } else { 0.0 })
        },
        &mut |op, (a, sa), (b, sb)| match op {
            Op::Add => (a + b, sa + sb),
            Op::Sub => (a - b, sa + sb),
            Op::Mul => (a * b, sa * sb),
            Op::Div => (a / b, sa / b.abs()),
            Op::Pow => pair(a.powf(*b)),
            Op::Min => (a.min(*b), sa.max(*sb)),
            Op::Max => (a.max(*b), sa.max(*sb)),
        },
    )[0]
}
