//! `[mechanism.forces]`: what drives the joints, and acts on bodies.

use crate::diagnostics::shorten;
use crate::expr::Id;
use crate::mechanism::algebra::{V3, add, cross, zero};
use crate::mechanism::{Link, Load, Named, Posed};
use crate::model::Span;
use crate::scenario::build::Use;
use crate::scenario::mechanism::bodies::Spec;
use crate::scenario::reader::{Reader, Section, Value};
use crate::scenario::scope::Kinds;
use toml::de::DeValue;

const RULE: &str = "parameters, states, controls, disturbances and definitions";

/// What forces act on.
pub(super) struct Acted<'m> {
    pub posed: &'m Posed,
    pub links: &'m [Link],
    pub points: &'m [Named],
    pub planar: bool,
}

impl<'a> Reader<'a> {
    /// Springs and dampers of the joints, and all forces of the section.
    pub(super) fn load(
        &mut self,
        section: Option<&Section<'a>>,
        specs: &[Spec],
        owners: &[usize],
        acted: &Acted<'_>,
    ) -> Option<Load> {
        let motion = &acted.posed.motion;
        let mut load = Load::none(&mut self.graph, motion.frames.len());
        for (i, owner) in owners.iter().enumerate() {
            let spec = &specs[*owner];
            let g = &mut self.graph;
            let (damping, spring) = (g.constant(-spec.damping), g.constant(-spec.spring));
            let rest = g.constant(spec.rest);
            let damped = g.mul(damping, motion.rates[i]);
            let way = g.sub(motion.q[i], rest);
            let sprung = g.mul(spring, way);
            load.joints[i] = g.add(damped, sprung);
        }
        let mut all_good = true;
        for (name, span, value) in section.into_iter().flat_map(|s| s.entries()) {
            // One, or a list of several.
            let all = match value.get_ref() {
                DeValue::Array(all) => all.iter().collect(),
                _ => vec![value],
            };
            for one in all {
                let done = self.one_force((name, &span), one, acted, &mut load);
                all_good &= done.is_some();
            }
        }
        all_good.then_some(load)
    }

    /// A force at a joint (an expression), or on a body (a table).
    fn one_force(
        &mut self,
        (name, span): (&str, &Span),
        value: &'a Value<'a>,
        acted: &Acted<'_>,
        load: &mut Load,
    ) -> Option<()> {
        let bodies = &acted.posed.motion.tree.bodies;
        let joint = bodies.iter().position(|b| b.name == name);
        let link = acted.links.iter().position(|l| l.name == name);
        let is_table = matches!(value.get_ref(), DeValue::Table(_));
        match (joint, link) {
            (Some(i), _) if !is_table => self.joint_force(i, name, value, load),
            (_, Some(link)) if is_table => self.body_forces(link, name, value, acted, load),
            (None, Some(_)) => {
                let message = format!(
                    "`{}` has not one coordinate that a force could act along",
                    shorten(name)
                );
                let label = "write { moment = ... } or { point = ..., force = [...] }";
                self.refuse(span.clone(), message, label)
            }
            (Some(_), _) => {
                let message = format!(
                    "`{}` is a coordinate, which a force acts along: an expression",
                    shorten(name)
                );
                self.refuse(value.span(), message, "tables are for bodies")
            }
            (None, None) => {
                let names = bodies.iter().map(|b| b.name.as_str());
                let names = names.chain(acted.links.iter().map(|l| l.name.as_str()));
                let message = format!(
                    "unknown joint or body `{}` in [mechanism.forces]",
                    shorten(name)
                );
                self.unknown((name, span.clone()), message, "no such joint", names)
            }
        }
    }

    fn joint_force(
        &mut self,
        i: usize,
        name: &str,
        value: &'a Value<'a>,
        load: &mut Load,
    ) -> Option<()> {
        let what = format!("the force at joint `{}`", shorten(name));
        let force = self.force_expression(value, &what)?;
        load.joints[i] = self.graph.add(load.joints[i], force);
        Some(())
    }

    fn force_expression(&mut self, value: &'a Value<'a>, what: &str) -> Option<Id> {
        let purpose = Use {
            what,
            allowed: Kinds::ALL,
            rule: RULE,
        };
        self.expression(value, &purpose).map(|b| b.expr)
    }

    fn body_forces(
        &mut self,
        link: usize,
        name: &str,
        value: &'a Value<'a>,
        acted: &Acted<'_>,
        load: &mut Load,
    ) -> Option<()> {
        let what = format!("the force on body `{}`", shorten(name));
        let table = self.table(value, value.span(), &what)?;
        self.check_keys(&table, "mechanism.forces.body");
        if table.get("moment").is_none() && table.get("force").is_none() {
            let message = format!("{what} has neither moment nor force");
            return self.refuse(value.span(), message, "moment = ... or force = [...]");
        }
        let own_axes = match table.get("axes") {
            Some(axes) => self.choice(axes, "axes", &[("world", false), ("body", true)])?,
            None => false,
        };
        let body = acted.links[link].mount.body;
        let mut wrench = (zero(&mut self.graph), zero(&mut self.graph));
        if let Some(moment) = table.get("moment") {
            let given = self.moment(moment, &what, acted.planar)?;
            wrench.0 = self.in_working_axes(given, link, own_axes, acted);
        }
        match table.get("force") {
            Some(force) => {
                let given = self.vector_expression(force, &what, acted.planar)?;
                wrench.1 = self.in_working_axes(given, link, own_axes, acted);
                let arm = self.point_of_force(&table, link, &what, acted)?;
                let about = cross(&mut self.graph, arm, wrench.1);
                wrench.0 = add(&mut self.graph, wrench.0, about);
            }
            None if table.get("point").is_some() || table.get("at").is_some() => {
                let message = format!("{what}: a moment acts at no point");
                return self.refuse(value.span(), message, "no force with it");
            }
            None => {}
        }
        // On the world it does nothing.
        if let Some(i) = body {
            let (t, f) = load.bodies[i];
            load.bodies[i] = (
                add(&mut self.graph, t, wrench.0),
                add(&mut self.graph, f, wrench.1),
            );
        }
        Some(())
    }

    fn moment(&mut self, value: &'a Value<'a>, what: &str, planar: bool) -> Option<V3> {
        if !planar {
            return self.vector_expression(value, what, false);
        }
        let about_z = self.force_expression(value, what)?;
        let none = self.graph.constant(0.0);
        Some([none, none, about_z])
    }

    fn vector_expression(&mut self, value: &'a Value<'a>, what: &str, planar: bool) -> Option<V3> {
        let (names, length) = if planar {
            ("[x, y]", 2)
        } else {
            ("[x, y, z]", 3)
        };
        let all = self.array(value, what, names, length)?;
        let all: Vec<Option<Id>> = all.iter().map(|v| self.force_expression(v, what)).collect();
        let all: Option<Vec<Id>> = all.into_iter().collect();
        let all = all?;
        let none = self.graph.constant(0.0);
        Some([all[0], all[1], all.get(2).copied().unwrap_or(none)])
    }

    /// A vector of world axes, or of the body's own, in the working axes of the body.
    fn in_working_axes(&mut self, v: V3, link: usize, own_axes: bool, acted: &Acted<'_>) -> V3 {
        let mount = acted.links[link].mount;
        let g = &mut self.graph;
        match mount.body {
            _ if own_axes => {
                let axes = acted.posed.motion.axes_of(g, &mount);
                crate::mechanism::algebra::times(g, &axes, v)
            }
            Some(body) => acted.posed.into_working(g, body, v),
            None => v,
        }
    }

    /// From the origin of the body in the tree to where a force acts, in working axes: a named point
    /// of this body, a place in its frame, or its origin.
    fn point_of_force(
        &mut self,
        table: &Section<'a>,
        link: usize,
        what: &str,
        acted: &Acted<'_>,
    ) -> Option<V3> {
        let motion = &acted.posed.motion;
        let mount = acted.links[link].mount;
        if let Some(value) = table.get("point") {
            let name = self.string(value, &format!("the point of {what}"))?;
            let point = self.known_point(name, value.span(), acted.points)?;
            let (on, at) = (point.mount, point.at);
            if on.body != mount.body {
                let message = format!("{what}: point `{name}` is not on this body");
                return self.refuse(value.span(), message, "a point of another body");
            }
            return Some(motion.arm_of(&mut self.graph, &on, at));
        }
        let at = match table.get("at") {
            Some(value) => self.vector(value, &format!("the place of {what}"), acted.planar)?,
            None => glam::DVec3::ZERO,
        };
        Some(motion.arm_of(&mut self.graph, &mount, at))
    }
}
