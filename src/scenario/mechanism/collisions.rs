//! `collision` of an event: points that come to rest, and what of the contacts holds afterwards.

use super::names::RATE;
use crate::diagnostics::Problem;
use crate::expr::Id;
use crate::mechanism::{Articulated, Constraint, Mechanism, Posed};
use crate::model::Kept;
use crate::scenario::reader::{Reader, Section, Value};
use rustc_hash::FxHashMap;
use toml::de::DeValue;

impl<'a> Reader<'a> {
    /// q' after the plastic collision of an event, one a body of the tree: points come to rest, closed
    /// chains stay closed, and points that were held otherwise and are not named let go.
    pub(in crate::low_level::scenario) fn collision(
        &mut self,
        what: &str,
        value: &'a Value<'a>,
        mechanism: Option<&Mechanism>,
    ) -> Option<Vec<Id>> {
        let Some(mechanism) = mechanism else {
            if self.no_mechanism {
                return None;
            }
            let message = format!("{what}: only points of a [mechanism] collide");
            return self.refuse(value.span(), message, "no mechanism");
        };
        let DeValue::Array(entries) = value.get_ref() else {
            let message = format!("the collision of {what} must be a list of points");
            return self.refuse(value.span(), message, "such as [\"foot\"]");
        };
        let g = &mut self.graph;
        let posed = Posed::new(g, &mechanism.tree, &mechanism.q, &mechanism.rates);
        let mut constraints: Vec<Constraint> = Vec::new();
        for entry in entries {
            constraints.extend(self.stopped(what, entry, (mechanism, &posed))?);
        }
        if constraints.is_empty() {
            let message = format!("the collision of {what} names no point");
            return self.refuse(value.span(), message, "empty");
        }
        let joints = mechanism.constraints.iter();
        constraints.extend(joints.filter(|c| c.against.is_some()).cloned());

        if !self.are_independent(&posed, &constraints) {
            let message = format!(
                "the collision of {what} stops the same twice, or what cannot move: its impulses are not determined"
            );
            let problem = Problem::at(value.span(), message, "remove a point, or a direction");
            let help = "{ point = \"foot\", along = \"y\" } stops a point in one direction";
            self.report(problem.with_help(help));
            return None;
        }
        let g = &mut self.graph;
        let articulated = Articulated::new(g, &posed.motion);
        let held = posed.held(g, &articulated, &constraints);
        let (rates, _) = held.collision(g, &mechanism.rates);
        Some(rates)
    }

    /// What an entry of a collision brings to rest: a point by name, in all directions in which it
    /// moves, or along one.
    fn stopped(
        &mut self,
        what: &str,
        entry: &'a Value<'a>,
        (mechanism, posed): (&Mechanism, &Posed),
    ) -> Option<Vec<Constraint>> {
        let of = format!("a point of {what}");
        let (name, along) = match entry.get_ref() {
            DeValue::Table(_) => {
                let table: Section<'a> = self.table(entry, entry.span(), &of)?;
                self.check_keys(&table, "events.collision");
                let Some(point) = table.get("point") else {
                    let message = format!("a collision of {what} has no point");
                    let help = "{ point = \"foot\", along = \"y\" }";
                    let problem = Problem::at(entry.span(), message, "`point` is missing");
                    self.report(problem.with_help(help));
                    return None;
                };
                (point, table.get("along"))
            }
            _ => (entry, None),
        };
        let known = self.string(name, &of)?;
        let point = self.known_point(known, name.span(), &mechanism.points)?;
        let all = mechanism.axes(point);
        if let Some(along) = along {
            let direction = self.direction(along, &of, mechanism.planar)?;
            return Some(vec![Constraint {
                direction,
                ..all[0].clone()
            }]);
        }
        // Where joints let a point move in one direction alone, it is stopped in that one.
        let moving: Vec<Constraint> = (all.iter())
            .filter(|c| self.are_independent(posed, std::slice::from_ref(*c)))
            .cloned()
            .collect();
        // None is refused with the others.
        Some(if moving.is_empty() { all } else { moving })
    }

    /// What contacts keep as it is, after an event and before it; `collided` are q' after its collision,
    /// `after` the states after all of it, and `sets` whether coordinates or rates among them are set.
    pub(in crate::low_level::scenario) fn kept(
        &mut self,
        mechanism: &Mechanism,
        (collided, after): (Option<&[Id]>, &FxHashMap<&str, Id>),
        sets: bool,
    ) -> Vec<Kept> {
        let depends = mechanism.free(&self.graph).len() < mechanism.q.len();
        // Dependent coordinates follow whatever is set; what a collision makes of them, or leaves as it
        // is, must agree.
        if mechanism.constraints.is_empty() || depends && sets {
            return Vec::new();
        }
        let names = mechanism.tree.bodies.iter().map(|b| b.name.as_str());
        let mut becomes: FxHashMap<Id, Id> = FxHashMap::default();
        for (i, name) in names.clone().enumerate() {
            let rate = format!("{name}{RATE}");
            becomes.extend(after.get(name).map(|q| (mechanism.q[i], *q)));
            becomes.extend(after.get(rate.as_str()).map(|v| (mechanism.rates[i], *v)));
        }
        let q = self.graph.substitute(&mechanism.q, &becomes);
        let rates: Vec<Id> = (names.enumerate())
            .map(
                |(i, name)| match after.get(format!("{name}{RATE}").as_str()) {
                    Some(rate) => *rate,
                    None => collided.unwrap_or(&mechanism.rates)[i],
                },
            )
            .collect();
        let g = &mut self.graph;
        let then = Posed::new(g, &mechanism.tree, &q, &rates);
        let before = Posed::new(g, &mechanism.tree, &mechanism.q, &mechanism.rates);
        let mut all = Vec::new();
        for held in &mechanism.constraints {
            let ((speed, gap), (speed_before, gap_before)) =
                (then.kept(g, held), before.kept(g, held));
            let mut keep = |after: Id, before: Id| {
                all.push(Kept {
                    contact: held.name.clone(),
                    after,
                    before,
                });
            };
            keep(speed, speed_before);
            if let (Some(gap), Some(gap_before)) = (gap, gap_before) {
                keep(gap, gap_before);
            }
        }
        all
    }
}
