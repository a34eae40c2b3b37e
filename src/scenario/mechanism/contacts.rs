//! `[mechanism.contacts]` and `[mechanism.dependent]`: points that are held, and coordinates that
//! follow from others because of that.

use super::Structure;
use super::names::RATE;
use crate::diagnostics::{Problem, shorten};
use crate::expr::Id;
use crate::mechanism::{Articulated, Constraint, Named, Posed, Tree};
use crate::model::Span;
use crate::scenario::build::Use;
use crate::scenario::reader::{Reader, Section, Value};
use crate::scenario::scope::{Entry, Kinds, Meaning, Role};
use glam::DVec3;
use rustc_hash::FxHashMap;
use toml::de::DeValue;

/// What is left of velocities, and of the mobility of what is held, relative to their size.
const ROUNDING: f64 = 1e-8;
/// States at which that is looked at.
const STATES: usize = 5;
/// Directions by name.
const AXES: [(&str, DVec3); 3] = [("x", DVec3::X), ("y", DVec3::Y), ("z", DVec3::Z)];

/// Names of a contact's forces, with the constraints that they are of.
pub(super) struct ContactName {
    pub name: String,
    pub constraint: usize,
    pub span: Span,
}

impl<'a> Reader<'a> {
    /// Expressions of the coordinates that follow from others, by name, and of their rates.
    pub(super) fn dependents(
        &mut self,
        section: Option<&Section<'a>>,
        tree: &Tree,
        symbols: &FxHashMap<&str, Id>,
    ) -> Option<FxHashMap<String, (Id, Id)>> {
        let mut found = FxHashMap::default();
        let mut all_good = true;
        let names: Vec<&str> = tree.bodies.iter().map(|b| b.name.as_str()).collect();
        let moving: FxHashMap<Id, Id> = (names.iter())
            .filter_map(|n| {
                Some((
                    *symbols.get(n)?,
                    *symbols.get(format!("{n}{RATE}").as_str())?,
                ))
            })
            .collect();
        for (name, span, value) in section.into_iter().flat_map(|s| s.entries()) {
            if !names.contains(&name) {
                let message = format!("unknown coordinate `{}`", shorten(name));
                let known = names.iter().copied();
                self.unknown::<()>((name, span), message, "no such coordinate", known);
                all_good = false;
                continue;
            }
            let what = format!("coordinate `{}`", shorten(name));
            let purpose = Use {
                what: &what,
                allowed: Kinds::PARAMETER.and(Kinds::STATE),
                rule: "parameters, coordinates that are states, and dependent ones above it",
            };
            let Some(built) = self.expression(value, &purpose) else {
                all_good = false;
                continue;
            };
            let rate = self.graph.tangents(&[built.expr], &moving)[0];
            self.quantity(name, &span, built.expr, Kinds::STATE);
            self.quantity(&format!("{name}{RATE}"), &span, rate, Kinds::STATE);
            found.insert(name.to_owned(), (built.expr, rate));
        }
        all_good.then_some(found)
    }

    /// The constraints of all contacts, and the names of their forces, which are entered as not
    /// known yet.
    pub(super) fn contacts(
        &mut self,
        section: &Section<'a>,
        points: &[Named],
        planar: bool,
    ) -> Option<(Vec<Constraint>, Vec<ContactName>)> {
        let (mut constraints, mut names) = (Vec::new(), Vec::new());
        let mut all_good = true;
        if section.entries().next().is_none() {
            let message = "[mechanism.contacts] names no point";
            return self.refuse(section.span.clone(), message, "foot = {} holds a point");
        }
        for (name, span, value) in section.entries() {
            match self.contact(name, &span, value, points, planar) {
                Some(of_contact) => {
                    for (tail, constraint) in of_contact {
                        names.push(ContactName {
                            name: format!("{name}.{tail}"),
                            constraint: constraints.len(),
                            span: span.clone(),
                        });
                        constraints.push(constraint);
                    }
                }
                None => all_good = false,
            }
        }
        for contact in &names {
            if self.scope.get(&contact.name).is_none() {
                self.scope.declare(
                    &contact.name,
                    Entry {
                        role: Role::Quantity,
                        span: contact.span.clone(),
                        meaning: Meaning::Later,
                    },
                );
            }
        }
        all_good.then_some((constraints, names))
    }

    /// A named point; one that is not known is reported.
    pub(in crate::low_level::scenario) fn known_point<'p>(
        &mut self,
        name: &str,
        span: Span,
        points: &'p [Named],
    ) -> Option<&'p Named> {
        if let Some(point) = points.iter().find(|p| p.name == name) {
            return Some(point);
        }
        let message = format!("unknown point `{}`", shorten(name));
        let known = points.iter().map(|p| p.name.as_str());
        self.unknown((name, span), message, "not in [mechanism.points]", known)
    }

    fn contact(
        &mut self,
        name: &'a str,
        span: &Span,
        value: &'a Value<'a>,
        points: &[Named],
        planar: bool,
    ) -> Option<Vec<(String, Constraint)>> {
        let what = format!("contact `{}`", shorten(name));
        let table = self.table(value, value.span(), &what)?;
        self.check_keys(&table, "mechanism.contacts");
        let at = self.known_point(name, span.clone(), points)?;
        let at = (at.mount, at.at);
        let against = match table.get("with") {
            Some(other) => {
                let known = self.string(other, &format!("the point that {what} is held to"))?;
                let other = self.known_point(known, other.span(), points)?;
                Some((other.mount, other.at))
            }
            None => None,
        };
        if at.0.body == against.and_then(|(mount, _)| mount.body) {
            let message = match (at.0.body, &against) {
                (None, None) => format!("{what}: the point is on what is fixed to the world"),
                _ => format!("{what}: both points are on one body"),
            };
            return self.refuse(span.clone(), message, "nothing is held by it");
        }
        let axes = &AXES[..if planar { 2 } else { 3 }];
        let directions: Vec<(String, DVec3)> = match table.get("along") {
            None => axes.iter().map(|(n, d)| (format!("f{n}"), *d)).collect(),
            Some(along) => vec![("f".to_owned(), self.direction(along, &what, planar)?)],
        };
        let constraint = |(tail, direction): (String, DVec3)| {
            let constraint = Constraint {
                name: name.to_owned(),
                at,
                against,
                direction,
            };
            (tail, constraint)
        };
        Some(directions.into_iter().map(constraint).collect())
    }

    /// A direction in world axes: the name of one, or its components.
    pub(super) fn direction(
        &mut self,
        along: &'a Value<'a>,
        what: &str,
        planar: bool,
    ) -> Option<DVec3> {
        let axes = &AXES[..if planar { 2 } else { 3 }];
        let direction = match along.get_ref() {
            DeValue::String(_) => self.choice(along, "direction", axes)?,
            _ => self.vector(along, &format!("the direction of {what}"), planar)?,
        };
        let unit = direction.try_normalize();
        if unit.is_none() {
            let message = format!("the direction of {what} is 0");
            return self.refuse(along.span(), message, "no direction");
        }
        unit
    }

    /// Refuses contacts that are not independent of each other, and dependent coordinates that do
    /// not keep what is held where it is.
    pub(super) fn check_contacts(
        &mut self,
        structure: &Structure,
        (constraints, span): (&[Constraint], &Span),
        dependent: usize,
    ) -> Option<()> {
        let tree = &structure.posed.motion.tree;
        if constraints.len() >= tree.bodies.len() {
            let message = format!(
                "the contacts hold {} directions of a mechanism with {} coordinates: it is locked",
                constraints.len(),
                tree.bodies.len()
            );
            return self.refuse(span.clone(), message, "nothing can move");
        }
        if dependent > 0 && dependent != constraints.len() {
            let message = format!(
                "{dependent} coordinates are dependent, but the contacts hold {} directions",
                constraints.len()
            );
            return self.refuse(span.clone(), message, "as many as are held, or none");
        }
        let (least, fastest) = self.freedom(&structure.posed, constraints);
        if least < ROUNDING {
            let message = "the contacts hold the same twice, or what cannot move: their forces are not determined";
            return self.refuse(
                span.clone(),
                message,
                "remove one, or a direction of it (`along`)",
            );
        }
        if dependent > 0 && fastest > ROUNDING {
            let message = "the dependent coordinates do not hold the contacts: a held point moves";
            let problem = Problem::at(
                span.clone(),
                message,
                format!("up to {fastest:.3e} at rates of about 1"),
            );
            self.report(problem.with_help("each dependent coordinate is what the others make it while the points stay where they are"));
            return None;
        }
        Some(())
    }

    /// Whether constraints determine their forces.
    pub(in crate::low_level::scenario) fn are_independent(
        &self,
        posed: &Posed,
        constraints: &[Constraint],
    ) -> bool {
        self.freedom(posed, constraints).0 >= ROUNDING
    }

    /// Of constraints, at states of about 1: the least mobility along any combination of them, of
    /// the largest that the points have when they are free; and the fastest velocity along one.
    fn freedom(&self, posed: &Posed, constraints: &[Constraint]) -> (f64, f64) {
        let mut graph = self.graph.clone();
        let articulated = Articulated::new(&mut graph, &posed.motion);
        let held = posed.held(&mut graph, &articulated, constraints);
        let mobility = held.mobility().concat();
        let velocities = held.velocities(&mut graph);
        // What the points could move by if they were free, in any direction.
        let anyway: Vec<Constraint> = (constraints.iter())
            .flat_map(|c| {
                DVec3::AXES.map(|direction| Constraint {
                    direction,
                    ..c.clone()
                })
            })
            .collect();
        let free = posed.held(&mut graph, &articulated, &anyway);
        let free: Vec<Id> = (0..anyway.len()).map(|k| free.mobility()[k][k]).collect();
        let symbols: Vec<Id> = (graph.reachable(&[&mobility[..], &velocities, &free].concat()))
            .into_iter()
            .filter(|id| graph.as_symbol(*id).is_some())
            .collect();
        let n = constraints.len();
        let (mut least, mut fastest) = (f64::INFINITY, 0.0f64);
        for k in 0..STATES {
            let mut values = self.values.clone();
            for (i, symbol) in symbols.iter().enumerate() {
                let value = (1.0 + (i * STATES + k) as f64 * 0.7548776662).sin();
                values.entry(*symbol).or_insert(value);
            }
            let all = graph.eval(&mobility, &values);
            let speeds = graph.eval(&velocities, &values);
            if all.iter().chain(&speeds).any(|v| !v.is_finite()) {
                continue; // Out of reach of the dependent coordinates.
            }
            let matrix = nalgebra::DMatrix::from_row_slice(n, n, &all);
            let moments = matrix.symmetric_eigenvalues();
            let most = graph.eval(&free, &values).into_iter().fold(0.0, f64::max);
            let share = if most > 0.0 {
                moments.min() / most
            } else {
                0.0
            };
            least = least.min(share);
            fastest = speeds.iter().fold(fastest, |a, v| a.max(v.abs()));
        }
        (least, fastest)
    }
}
