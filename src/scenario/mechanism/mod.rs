//! `[mechanism]`: bodies and joints, from which dynamics follow.
//!
//! Reading order: the coordinates (which are states), then what follows from parameters alone (the
//! tree, its motion, points and energies), whose names definitions may use, and at last the forces,
//! which may use definitions.

mod assemble;
mod bodies;
mod collisions;
mod contacts;
mod forces;
mod names;

pub(super) use names::{Generated, RATE};

use super::reader::{Reader, Section};
use super::scope::{Entry, Kinds, Meaning, Role};
use crate::diagnostics::{Problem, shorten};
use crate::expr::{Id, Kind};
use crate::mechanism::{Articulated, Constraint, Energy, Link, Load, Mechanism, Named, Posed};
use crate::model::{Located, Span};
use bodies::Spec;
use contacts::ContactName;
use forces::Acted;
use glam::DVec3;
use rustc_hash::FxHashMap;
use std::sync::Arc;

/// A joint must move this share of what the others move.
const LEAST_INERTIA: f64 = 1e-12;
/// Positions at which that is looked at.
const POSITIONS: usize = 5;

/// A mechanism without its forces.
pub(super) struct Structure {
    specs: Vec<Spec>,
    owners: Vec<usize>,
    links: Vec<Link>,
    points: Vec<Named>,
    posed: Posed,
    planar: bool,
    energy: Energy,
    /// Of the key of the link that makes each body's coordinate.
    spans: Vec<Span>,
    constraints: Vec<Constraint>,
    contacts: Vec<ContactName>,
}

impl<'a> Reader<'a> {
    /// What follows from the parameters; `state` gives the symbol of a state. `None` where something
    /// is wrong, which is reported.
    pub(super) fn structure(
        &mut self,
        section: &Section<'a>,
        state: &FxHashMap<&str, Id>,
    ) -> Option<Structure> {
        self.check_keys(section, "mechanism");
        let (gravity, planar) = self.gravity(section)?;
        let Some(bodies) = section.get("bodies") else {
            let problem = Problem::at(
                section.span.clone(),
                "[mechanism] has no bodies",
                "nothing that moves",
            );
            self.report(problem.with_help("[mechanism.bodies] with one table a body, such as arm = { joint = \"revolute\", mass = 1, shape = { rod = 0.5 } }"));
            return None;
        };
        let bodies = self.table(bodies, section.key_span("bodies"), "[mechanism.bodies]")?;
        let specs: Vec<Option<Spec>> = self.links(&bodies, planar);
        let specs: Option<Vec<Spec>> = specs.into_iter().collect();
        let specs = specs?;
        let Some(assembled) = self.assemble(&specs, gravity) else {
            if specs.iter().all(|s| s.kind == names::Kind::Fixed) {
                let message = "[mechanism] has no joint that moves";
                self.refuse::<()>(bodies.span.clone(), message, "all are fixed");
            }
            return None;
        };
        let tree = Arc::new(assembled.tree);
        let dependent = match section.get("dependent") {
            Some(value) => {
                let span = section.key_span("dependent");
                Some(self.table(value, span, "[mechanism.dependent]")?)
            }
            None => None,
        };
        let dependents = self.dependents(dependent.as_ref(), &tree, state)?;
        let (mut q, mut rates) = (Vec::new(), Vec::new());
        for body in &tree.bodies {
            let name = body.name.as_str();
            let (coordinate, rate) = match dependents.get(name) {
                Some(pair) => *pair,
                None => (
                    *state.get(name)?,
                    *state.get(format!("{name}{RATE}").as_str())?,
                ),
            };
            q.push(coordinate);
            rates.push(rate);
        }
        let posed = Posed::new(&mut self.graph, &tree, &q, &rates);
        let spans = assembled
            .owners
            .iter()
            .map(|o| specs[*o].span.clone())
            .collect();
        let mut structure = Structure {
            energy: self.energy(&posed, &specs, &assembled.owners),
            specs,
            owners: assembled.owners,
            links: assembled.links,
            points: Vec::new(),
            posed,
            planar,
            spans,
            constraints: Vec::new(),
            contacts: Vec::new(),
        };
        self.check_inertias(&structure)?;
        let points = section.get("points").map(|value| {
            let table = self.table(value, section.key_span("points"), "[mechanism.points]")?;
            self.points(&table, &structure)
        });
        structure.points = match points {
            Some(points) => points?,
            None => Vec::new(),
        };
        if let Some(value) = section.get("contacts") {
            let span = section.key_span("contacts");
            let table = self.table(value, span.clone(), "[mechanism.contacts]")?;
            let (constraints, names) = self.contacts(&table, &structure.points, planar)?;
            self.check_contacts(&structure, (&constraints, &span), dependents.len())?;
            (structure.constraints, structure.contacts) = (constraints, names);
        } else if let (Some(dependent), false) = (&dependent, dependents.is_empty()) {
            let message =
                "coordinates are dependent where points are held: there is no [mechanism.contacts]";
            return self.refuse(dependent.span.clone(), message, "held by what?");
        }
        let span = section.span.clone();
        let Energy { kinetic, potential } = structure.energy;
        let energy = self.graph.add(kinetic, potential);
        for (name, expr) in [
            ("kinetic", kinetic),
            ("potential", potential),
            ("energy", energy),
        ] {
            self.quantity(name, &span, expr, Kinds::STATE);
        }
        Some(structure)
    }

    fn gravity(&mut self, section: &Section<'a>) -> Option<(DVec3, bool)> {
        let Some(value) = section.get("gravity") else {
            let problem = Problem::at(
                section.span.clone(),
                "[mechanism] has no gravity",
                "`gravity` is missing",
            );
            self.report(problem.with_help("gravity = [0, -9.81]: two numbers for a planar mechanism, three for one in space (zeros for none)"));
            return None;
        };
        let names = "[x, y] or [x, y, z]";
        let all = self.numbers(value, "gravity", (names, &[2, 3]))?;
        let planar = all.len() == 2;
        Some((
            DVec3::new(all[0], all[1], all.get(2).copied().unwrap_or(0.0)),
            planar,
        ))
    }

    fn energy(&mut self, posed: &Posed, specs: &[Spec], owners: &[usize]) -> Energy {
        let g = &mut self.graph;
        let mut terms = vec![posed.potential(g)];
        for (i, owner) in owners.iter().enumerate() {
            let spec = &specs[*owner];
            let rest = g.constant(spec.rest);
            let way = g.sub(posed.motion.q[i], rest);
            let square = g.powi(way, 2);
            let stiffness = g.constant(0.5 * spec.spring);
            terms.push(g.mul(stiffness, square));
        }
        Energy {
            kinetic: posed.kinetic(g),
            potential: g.sum(&terms),
        }
    }

    /// Refuses joints that move nothing: their accelerations would be infinite.
    fn check_inertias(&mut self, structure: &Structure) -> Option<()> {
        let motion = &structure.posed.motion;
        let mut graph = self.graph.clone();
        let inertias = Articulated::new(&mut graph, motion).inertias();
        let at: Vec<Vec<f64>> = (0..POSITIONS)
            .filter_map(|k| {
                let place =
                    |i: usize| 3.0 * (1.0 + (i * POSITIONS + k) as f64 * 0.7548776662).sin();
                // Parameters too: dependent coordinates are expressions of them.
                let mut values = self.values.clone();
                values.extend(motion.q.iter().enumerate().map(|(i, q)| (*q, place(i))));
                values.extend(motion.rates.iter().map(|v| (*v, 0.0)));
                // Where dependent coordinates are out of reach nothing is told.
                let reached = graph.eval(&motion.q, &values).iter().all(|q| q.is_finite());
                reached.then(|| graph.eval(&inertias, &values))
            })
            .collect();
        let size = at
            .iter()
            .flatten()
            .fold(0.0f64, |a, v| if v.is_finite() { a.max(*v) } else { a });
        let mut reported = Vec::new();
        for (i, body) in motion.tree.bodies.iter().enumerate().rev() {
            let moves = |v: &f64| v.is_finite() && *v > LEAST_INERTIA * size;
            let owner = structure.owners[i];
            if at.iter().all(|values| moves(&values[i])) || reported.contains(&owner) {
                continue;
            }
            // What is infinite further in comes of it.
            if !reported.is_empty() && at.iter().any(|values| !values[i].is_finite()) {
                continue;
            }
            reported.push(owner);
            let name = &body.name;
            let (message, label, help) =
                match reported.len() == 1 && at.iter().all(|v| !v[i].is_finite()) {
                    true => (
                        format!("the joint `{name}` moves more than numbers can say"),
                        "its inertia is infinite",
                        "masses and lengths are far out of proportion",
                    ),
                    false => (
                        format!("the joint `{name}` moves no mass"),
                        "its acceleration would be infinite",
                        "give the body a mass away from the axis, an inertia, or a rotor",
                    ),
                };
            let problem = Problem::at(structure.spans[i].clone(), message, label);
            self.report(problem.with_help(help));
        }
        reported.is_empty().then_some(())
    }

    fn points(&mut self, section: &Section<'a>, structure: &Structure) -> Option<Vec<Named>> {
        let mut all = Vec::new();
        for (name, span, value) in section.entries() {
            let what = format!("point `{}`", shorten(name));
            let point = self.point(name, &what, value, structure);
            if let Some(point) = &point {
                let found = structure
                    .posed
                    .point(&mut self.graph, &point.mount, point.at);
                let count = if structure.planar { 2 } else { 3 };
                for (k, axis) in ["x", "y", "z"].into_iter().enumerate().take(count) {
                    self.quantity(
                        &format!("{name}.{axis}"),
                        &span,
                        found.position[k],
                        Kinds::STATE,
                    );
                    self.quantity(
                        &format!("{name}.v{axis}"),
                        &span,
                        found.velocity[k],
                        Kinds::STATE,
                    );
                }
            }
            all.push(point);
        }
        all.into_iter().collect()
    }

    fn point(
        &mut self,
        name: &'a str,
        what: &str,
        value: &'a super::reader::Value<'a>,
        structure: &Structure,
    ) -> Option<Named> {
        let table = self.table(value, value.span(), what)?;
        self.check_keys(&table, "mechanism.points");
        if !super::lexer::is_identifier(name) {
            let help = "letters, digits and _, not a digit first";
            self.report(
                Problem::at(value.span(), format!("{what}: not a name"), "not a name")
                    .with_help(help),
            );
            return None;
        }
        let link = match table.get("body") {
            None => None,
            Some(body) => {
                let known = self.string(body, &format!("the body of {what}"))?;
                let links = structure.links.iter();
                let found = links.clone().position(|l| l.name == known);
                if found.is_none() && known != "world" {
                    let message = format!("unknown body `{}`", shorten(known));
                    let names = links.map(|l| l.name.as_str()).chain(["world"]);
                    return self.unknown((known, body.span()), message, "no such body", names);
                }
                found
            }
        };
        let at = match table.get("at") {
            Some(at) => self.vector(at, &format!("the place of {what}"), structure.planar)?,
            None => DVec3::ZERO,
        };
        let mount = link.map_or(crate::mechanism::Mount::WORLD, |l| structure.links[l].mount);
        Some(Named {
            name: name.to_owned(),
            link,
            mount,
            at,
        })
    }

    /// Enters something that follows from the mechanism into the scope.
    fn quantity(&mut self, name: &str, span: &Span, expr: Id, kinds: Kinds) {
        if let Some(first) = self.scope.get(name) {
            let noun = first.role.noun();
            let message = format!("`{name}` is a quantity of the mechanism, and {noun}");
            let place = first.span.clone();
            self.report(Problem::at(place, message, "rename this"));
            return;
        }
        self.scope.declare(
            name,
            Entry {
                role: Role::Quantity,
                span: span.clone(),
                meaning: Meaning::Known { expr, kinds },
            },
        );
    }

    /// q'', and the forces of the constraints.
    fn second(&mut self, structure: &Structure, load: &Load) -> (Vec<Id>, Vec<Id>) {
        let g = &mut self.graph;
        let articulated = Articulated::new(g, &structure.posed.motion);
        let free = articulated.accelerations(g, load);
        if structure.constraints.is_empty() {
            return (free.joints, Vec::new());
        }
        let held = structure
            .posed
            .held(g, &articulated, &structure.constraints);
        held.contact(g, &free)
    }

    /// The kinds of symbols that an expression depends on.
    pub(super) fn kinds_of(&self, expr: Id) -> Kinds {
        let symbols = self.graph.reachable(&[expr]).into_iter();
        symbols
            .filter_map(|id| self.graph.as_symbol(id))
            .fold(Kinds::NONE, |kinds, symbol| {
                kinds.and(match symbol.kind {
                    Kind::Parameter => Kinds::PARAMETER,
                    Kind::Control => Kinds::CONTROL,
                    Kind::Disturbance => Kinds::DISTURBANCE,
                    Kind::State | Kind::Adjoint => Kinds::STATE,
                })
            })
    }

    /// The mechanism with its forces, and the rates of its states by name.
    pub(super) fn mechanism(
        &mut self,
        section: &Section<'a>,
        structure: Structure,
    ) -> Option<(Mechanism, FxHashMap<String, Located>)> {
        let given = match section.get("forces") {
            Some(value) => {
                Some(self.table(value, section.key_span("forces"), "[mechanism.forces]")?)
            }
            None => None,
        };
        let acted = Acted {
            posed: &structure.posed,
            links: &structure.links,
            points: &structure.points,
            planar: structure.planar,
        };
        let load: Load = self.load(given.as_ref(), &structure.specs, &structure.owners, &acted)?;
        let motion = &structure.posed.motion;
        let (second, forces) = self.second(&structure, &load);
        for contact in &structure.contacts {
            let expr = forces[contact.constraint];
            let kinds = self.kinds_of(expr);
            (self.scope).set(
                &contact.name,
                Role::Quantity,
                Meaning::Known { expr, kinds },
            );
        }
        let mut rates = FxHashMap::default();
        for (i, body) in motion.tree.bodies.iter().enumerate() {
            let located = |expr: Id| Located {
                expr,
                span: structure.spans[i].clone(),
            };
            rates.insert(body.name.clone(), located(motion.rates[i]));
            rates.insert(format!("{}{RATE}", body.name), located(second[i]));
        }
        let mechanism = Mechanism {
            tree: motion.tree.clone(),
            planar: structure.planar,
            q: motion.q.clone(),
            rates: motion.rates.clone(),
            links: structure.links,
            points: structure.points,
            constraints: structure.constraints,
            load,
            second,
            forces,
            energy: structure.energy,
        };
        Some((mechanism, rates))
    }
}
