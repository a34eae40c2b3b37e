//! `[mechanism.bodies]`: bodies with their joints, as they are written.

use super::names::{Kind, MOST_LINKS, links};
use crate::diagnostics::{Problem, shorten};
use crate::mechanism::Inertia;
use crate::mechanism::algebra::clean;
use crate::model::Span;
use crate::numeric::digits::plain;
use crate::scenario::reader::{Reader, Section, Value};
use glam::{DMat3, DQuat, DVec3, EulerRot};
use toml::de::DeValue;

/// How far a matrix may be from a rotation.
const ROUNDING: f64 = 1e-9;

/// A link as it is written.
#[derive(Clone, Debug)]
pub(super) struct Spec {
    pub name: String,
    /// Of the key.
    pub span: Span,
    /// Name and place; `None` is the world.
    pub parent: Option<(String, Span)>,
    pub kind: Kind,
    pub axis: DVec3,
    pub place: DVec3,
    pub rotation: DMat3,
    pub inertia: Inertia,
    /// Force by rate; force by way from `rest`.
    pub damping: f64,
    pub spring: f64,
    pub rest: f64,
    pub rotor: f64,
}

/// What a body is read for: which link of a chain it is.
#[derive(Clone, Copy)]
struct Which<'w> {
    what: &'w str,
    planar: bool,
    link: usize,
    links: usize,
    is_chain: bool,
}

/// Whether a value is three rows of three numbers.
fn is_square(value: &Value<'_>) -> bool {
    let length = |value: &Value<'_>| match value.get_ref() {
        DeValue::Array(all) => all.len(),
        _ => 0,
    };
    let rows = match value.get_ref() {
        DeValue::Array(rows) => rows,
        _ => return false,
    };
    depth(value) == 2 && rows.len() == 3 && rows.iter().all(|row| length(row) == 3)
}

/// Number of levels of arrays that a value has.
fn depth(value: &Value<'_>) -> usize {
    match value.get_ref() {
        DeValue::Array(all) => 1 + all.first().map_or(0, depth),
        _ => 0,
    }
}

impl<'a> Reader<'a> {
    /// All links, in the order in which they are written; `None` for those that are wrong.
    pub(super) fn links(&mut self, section: &Section<'a>, planar: bool) -> Vec<Option<Spec>> {
        let mut all = Vec::new();
        for (name, span, value) in section.entries() {
            let what = format!("body `{}`", shorten(name));
            let Some(body) = self.table(value, span.clone(), &what) else {
                all.push(None);
                continue;
            };
            self.check_keys(&body, "mechanism.bodies");
            let chain = match body.get("chain") {
                None => None,
                Some(value) => {
                    let count = self.count_to(value, "the number of links", 1, MOST_LINKS);
                    let Some(count) = count else {
                        all.push(None);
                        continue;
                    };
                    Some(count as u32)
                }
            };
            let names = links(name, chain);
            for (k, link) in names.iter().enumerate() {
                let which = Which {
                    what: &what,
                    planar,
                    link: k,
                    links: names.len(),
                    is_chain: chain.is_some(),
                };
                let before = k.checked_sub(1).map(|k| names[k].clone());
                let spec = self.link(link, &span, &body, &which, before);
                let wrong = spec.is_none();
                all.push(spec);
                if wrong {
                    break; // The links after it would be wrong in the same way.
                }
            }
        }
        all
    }

    fn link(
        &mut self,
        name: &str,
        span: &Span,
        body: &Section<'a>,
        which: &Which<'_>,
        before: Option<String>,
    ) -> Option<Spec> {
        let what = which.what;
        let Some(joint) = body.get("joint") else {
            let problem = Problem::at(
                span.clone(),
                format!("{what} has no joint"),
                "`joint` is missing",
            );
            let names: Vec<&str> = Kind::NAMES.iter().map(|(n, _)| *n).collect();
            self.report(problem.with_help(format!("joint = one of {}", names.join(", "))));
            return None;
        };
        let kind = self.choice(joint, "joint", &Kind::NAMES)?;
        if which.planar && matches!(kind, Kind::Spherical | Kind::Floating) {
            let message = format!("{what}: a mechanism in two dimensions has no such joint");
            return self.refuse(joint.span(), message, "needs gravity = [x, y, z]");
        }
        if which.is_chain && kind.coordinates().len() != 1 {
            let message = format!("{what}: the joints of a chain are revolute or prismatic");
            return self.refuse(joint.span(), message, "not in a chain");
        }
        let parent = match (before, body.get("parent")) {
            (Some(before), _) => Some((before, span.clone())),
            (None, Some(value)) => {
                let parent = self.string(value, &format!("the parent of {what}"))?;
                (parent != "world").then(|| (parent.to_owned(), value.span()))
            }
            (None, None) => None,
        };
        let place = self.place(body, which);
        let rotation = self.rotation(body, which);
        let axis = self.axis_of_joint(body, which, (kind, span));
        let inertia = self.inertia(body, which);
        let own = |key| (key, format!("the {key} of {what}"));
        let [damping, spring, rest, rotor] =
            ["damping", "spring", "rest", "rotor"]
                .map(own)
                .map(|(key, what)| {
                    let value = body
                        .get(key)
                        .and_then(|v| Some((v, self.one_of(v, which, 0)?)));
                    let Some((_, value)) = value else {
                        return Some(0.0);
                    };
                    if kind.coordinates().len() != 1 {
                        let message = format!("{what}: the joint has not one coordinate");
                        let label = match key {
                            "rotor" => {
                                "make it of joints of one coordinate, on bodies without mass"
                            }
                            _ => "write it in [mechanism.forces]",
                        };
                        return self.refuse(value.span(), message, label);
                    }
                    match key {
                        "damping" | "rotor" => {
                            self.number_that(value, &what, "at least 0", |v| v >= 0.0)
                        }
                        _ => self.number(value, &what),
                    }
                });
        if let (Some(_), None) = (body.get("rest"), body.get("spring")) {
            let message = format!("{what} has `rest`, but no spring");
            self.refuse::<()>(body.key_span("rest"), message, "of no use")?;
        }
        Some(Spec {
            name: name.to_owned(),
            span: span.clone(),
            parent,
            kind,
            axis: axis?,
            place: place?,
            rotation: rotation?,
            inertia: inertia?,
            damping: damping?,
            spring: spring?,
            rest: rest?,
            rotor: rotor?,
        })
    }

    /// The value of one link: of a chain's list of values, which are `levels` deep, or what is the
    /// same for all.
    fn one_of(
        &mut self,
        value: &'a Value<'a>,
        which: &Which<'_>,
        levels: usize,
    ) -> Option<&'a Value<'a>> {
        let DeValue::Array(all) = value.get_ref() else {
            return Some(value);
        };
        if !which.is_chain || depth(value) <= levels {
            return Some(value);
        }
        if all.len() != which.links {
            let message = format!(
                "{} has {} links, but a list of {}",
                which.what,
                which.links,
                all.len()
            );
            return self.refuse(value.span(), message, "one value for all, or one a link");
        }
        Some(&all[which.link])
    }

    /// Numbers of an array, as many as one of `counts`; `names` is for messages.
    pub(super) fn numbers(
        &mut self,
        value: &'a Value<'a>,
        what: &str,
        (names, counts): (&str, &[usize]),
    ) -> Option<Vec<f64>> {
        let length = match value.get_ref() {
            DeValue::Array(all) if counts.contains(&all.len()) => all.len(),
            _ => counts[0],
        };
        let all = self.array(value, what, names, length)?;
        let all: Vec<Option<f64>> = all.iter().map(|v| self.number(v, what)).collect();
        all.into_iter().collect()
    }

    /// A vector of the mechanism's dimensions.
    pub(super) fn vector(
        &mut self,
        value: &'a Value<'a>,
        what: &str,
        planar: bool,
    ) -> Option<DVec3> {
        let shape: (&str, &[usize]) = match planar {
            true => ("[x, y]", &[2]),
            false => ("[x, y, z]", &[3]),
        };
        let all = self.numbers(value, what, shape)?;
        Some(DVec3::new(
            all[0],
            all[1],
            all.get(2).copied().unwrap_or(0.0),
        ))
    }

    /// Where the joint is in the parent's frame. Of a chain one place is that of all links after the
    /// first.
    fn place(&mut self, body: &Section<'a>, which: &Which<'_>) -> Option<DVec3> {
        let what = format!("the place of {}", which.what);
        let first = which.is_chain && which.link == 0;
        let value = match body.get("start").filter(|_| first) {
            Some(start) => Some(start),
            None => match body.get("at") {
                Some(at) if first && depth(at) < 2 => None,
                Some(at) => Some(self.one_of(at, which, 1)?),
                None => None,
            },
        };
        if let (Some(_), false) = (body.get("start"), which.is_chain) {
            let message = format!("{what}: `start` is of chains");
            return self.refuse(body.key_span("start"), message, "write `at`");
        }
        match value {
            Some(value) => self.vector(value, &what, which.planar),
            None => Some(DVec3::ZERO),
        }
    }

    /// The joint's axes in the parent's frame.
    fn rotation(&mut self, body: &Section<'a>, which: &Which<'_>) -> Option<DMat3> {
        let what = format!("the rotation of {}", which.what);
        if let (Some(_), Some(rpy)) = (body.get("rotation"), body.get("rpy")) {
            let message = format!("{} has both rotation and rpy", which.what);
            return self.refuse(rpy.span(), message, "one of them");
        }
        if let Some(value) = body.get("rpy") {
            let value = self.one_of(value, which, 1)?;
            if which.planar {
                let message = format!("{what}: in two dimensions it is one angle");
                return self.refuse(value.span(), message, "write rotation = angle");
            }
            let angles = self.numbers(value, &what, ("[roll, pitch, yaw]", &[3]))?;
            let turn = DQuat::from_euler(EulerRot::ZYX, angles[2], angles[1], angles[0]);
            return Some(clean(DMat3::from_quat(turn)));
        }
        let Some(value) = body.get("rotation") else {
            return Some(DMat3::IDENTITY);
        };
        let value = self.one_of(value, which, if which.planar { 0 } else { 2 })?;
        if which.planar {
            let angle = self.number(value, &what)?;
            return Some(clean(DMat3::from_rotation_z(angle)));
        }
        let matrix = self.matrix(value, &what)?;
        let off = (matrix * matrix.transpose() - DMat3::IDENTITY).to_cols_array();
        let is_rotation = off.iter().all(|v| v.abs() < ROUNDING) && matrix.determinant() > 0.0;
        match is_rotation {
            true => Some(clean(matrix)),
            false => {
                let problem = Problem::at(
                    value.span(),
                    format!("{what} is no rotation"),
                    "columns: the joint's axes",
                );
                self.report(
                    problem
                        .with_help("all digits are needed; rpy = [roll, pitch, yaw] takes angles"),
                );
                None
            }
        }
    }

    /// Three rows of three.
    fn matrix(&mut self, value: &'a Value<'a>, what: &str) -> Option<DMat3> {
        let rows = self.array(value, what, "three rows", 3)?;
        let rows: Vec<Option<DVec3>> = (rows.iter())
            .map(|row| self.vector(row, &format!("a row of {what}"), false))
            .collect();
        let rows: Option<Vec<DVec3>> = rows.into_iter().collect();
        let rows = rows?;
        Some(DMat3::from_cols(rows[0], rows[1], rows[2]).transpose())
    }

    /// Of unit length.
    fn axis_of_joint(
        &mut self,
        body: &Section<'a>,
        which: &Which<'_>,
        (kind, span): (Kind, &Span),
    ) -> Option<DVec3> {
        let what = format!("the axis of {}", which.what);
        let Some(value) = body.get("axis") else {
            if kind == Kind::Prismatic {
                let problem = Problem::at(
                    span.clone(),
                    format!("{what} is missing"),
                    "slides, but where to?",
                );
                self.report(problem.with_help("axis = \"x\", or a vector in the joint's frame"));
                return None;
            }
            return Some(DVec3::Z);
        };
        if !matches!(kind, Kind::Revolute | Kind::Prismatic) {
            let message = format!("{what}: only revolute and prismatic joints have one");
            return self.refuse(value.span(), message, "remove this");
        }
        // Names of axes, one a link, are no vector.
        let is_name = |v: &Value<'_>| matches!(v.get_ref().as_str(), Some("x" | "y" | "z"));
        let names = value
            .get_ref()
            .as_array()
            .is_some_and(|all| all.iter().all(is_name));
        let levels = usize::from(!(which.is_chain && names));
        let value = self.one_of(value, which, levels)?;
        if which.planar && kind == Kind::Revolute {
            let message = format!("{what}: in two dimensions joints turn about z");
            return self.refuse(value.span(), message, "remove this");
        }
        let axis = match value.get_ref() {
            DeValue::String(_) => {
                let all = [("x", DVec3::X), ("y", DVec3::Y), ("z", DVec3::Z)];
                let known = &all[..if which.planar { 2 } else { 3 }];
                self.choice(value, "axis", known)?
            }
            _ => self.vector(value, &what, which.planar)?,
        };
        match axis.try_normalize() {
            Some(unit) => Some(unit),
            None => self.refuse(
                value.span(),
                format!("{what} is 0: the joint is locked"),
                "no direction; joint = \"fixed\" locks it",
            ),
        }
    }

    fn inertia(&mut self, body: &Section<'a>, which: &Which<'_>) -> Option<Inertia> {
        let what = which.what;
        let mass = match body.get("mass") {
            Some(value) => {
                let value = self.one_of(value, which, 0)?;
                self.number_that(value, &format!("the mass of {what}"), "at least 0", |m| {
                    m >= 0.0
                })?
            }
            None => 0.0,
        };
        let shape = match body.get("shape") {
            Some(value) => {
                let value = self.one_of(value, which, 0)?;
                if mass == 0.0 {
                    let message = format!("{what} has a shape, but no mass");
                    return self.refuse(value.span(), message, "add mass = ...");
                }
                Some(self.shape(value, which)?)
            }
            None => None,
        };
        let (mut com, mut about_com) = match shape {
            Some((com, per_mass)) => (com, mass * per_mass),
            None => (DVec3::ZERO, DMat3::ZERO),
        };
        if let Some(value) = body.get("com") {
            let value = self.one_of(value, which, 1)?;
            com = self.vector(
                value,
                &format!("the centre of mass of {what}"),
                which.planar,
            )?;
        }
        if let Some(value) = body.get("inertia") {
            if shape.is_some() {
                let message = format!("{what} has both shape and inertia");
                return self.refuse(value.span(), message, "one of them");
            }
            if which.is_chain && which.links == 3 && !which.planar && is_square(value) {
                let message =
                    format!("the inertia of {what} may be one tensor, or three of diagonals");
                let problem = Problem::at(value.span(), message, "three rows of three");
                self.report(problem.with_help(
                    "one for all: [xx, xy, xz, yy, yz, zz]; one a link: a list of three such",
                ));
                return None;
            }
            let value = self.one_of(value, which, if which.planar { 0 } else { 1 })?;
            about_com = self.tensor(value, which)?;
        }
        let all = Inertia {
            mass,
            com,
            about_com,
        };
        if let Some(why) = all.impossible(which.planar) {
            let message = format!("no body has the inertia of {what}: {why}");
            // Models in use have such; their equations are good nevertheless.
            if why.is_usable() {
                self.notes.push(message);
                return Some(all);
            }
            let span = body.get("inertia").map_or(body.span.clone(), |v| v.span());
            return self.refuse(span, message, "about the centre of mass");
        }
        Some(all)
    }

    /// A tensor of inertia about the centre of mass.
    fn tensor(&mut self, value: &'a Value<'a>, which: &Which<'_>) -> Option<DMat3> {
        let what = format!("the inertia of {}", which.what);
        if which.planar {
            let about_z = self.number_that(value, &what, "at least 0", |i| i >= 0.0)?;
            return Some(DMat3::from_diagonal(DVec3::new(0.0, 0.0, about_z)));
        }
        let tensor = if depth(value) == 2 {
            self.matrix(value, &what)?
        } else {
            let names = "[xx, yy, zz], [xx, xy, xz, yy, yz, zz] or three rows";
            let all = self.numbers(value, &what, (names, &[3, 6]))?;
            match all[..] {
                [xx, yy, zz] => DMat3::from_diagonal(DVec3::new(xx, yy, zz)),
                [xx, xy, xz, yy, yz, zz] => {
                    DMat3::from_cols_array(&[xx, xy, xz, xy, yy, yz, xz, yz, zz])
                }
                _ => return None,
            }
        };
        Some(tensor)
    }

    /// Centre of mass and tensor of a unit mass.
    fn shape(&mut self, value: &'a Value<'a>, which: &Which<'_>) -> Option<(DVec3, DMat3)> {
        let what = format!("the shape of {}", which.what);
        let table = self.table(value, value.span(), &what)?;
        self.check_keys(&table, "mechanism.bodies.shape");
        let mut entries = table.entries();
        let (Some((name, _, size)), None) = (entries.next(), entries.next()) else {
            let message = format!("{what} must be one of ellipsoid, cylinder, box, rod, sphere");
            return self.refuse(value.span(), message, "such as { rod = 0.5 }");
        };
        let what = format!("the {name} of {}", which.what);
        let sizes: Vec<f64> = match (name, size.get_ref()) {
            ("rod" | "sphere", _) => vec![self.number(size, &what)?],
            ("cylinder", _) => self.numbers(size, &what, ("[length, radius]", &[2]))?,
            ("box", _) => self.numbers(size, &what, ("[x, y, z], its edges", &[3]))?,
            _ => self.numbers(
                size,
                &what,
                (
                    "[length, radius], or [x, y, z], its axes from end to end",
                    &[2, 3],
                ),
            )?,
        };
        if sizes.iter().any(|s| *s <= 0.0) {
            let sizes: Vec<String> = sizes.iter().map(|s| plain(*s)).collect();
            let message = format!(
                "{what} must have sizes greater than 0, not {}",
                sizes.join(", ")
            );
            return self.refuse(size.span(), message, "a size");
        }
        Some(solid(name, &sizes))
    }
}

/// Centre of mass and tensor about it of a solid of unit mass that begins at the joint and lies
/// along x; a sphere is about the joint.
fn solid(name: &str, sizes: &[f64]) -> (DVec3, DMat3) {
    // By the mean squares of the distances from the planes through the centre.
    let squares = match (name, sizes) {
        ("rod", [l]) => DVec3::new(l * l / 12.0, 0.0, 0.0),
        ("sphere", [r]) => DVec3::splat(r * r / 5.0),
        ("cylinder", [l, r]) => DVec3::new(l * l / 12.0, r * r / 4.0, r * r / 4.0),
        ("box", [x, y, z]) => DVec3::new(x * x, y * y, z * z) / 12.0,
        (_, [l, r]) => DVec3::new(l * l / 4.0, r * r, r * r) / 5.0,
        (_, all) => DVec3::from_slice(all).powf(2.0) / 20.0,
    };
    let middle = match name {
        "sphere" => 0.0,
        _ => 0.5 * sizes[0],
    };
    let DVec3 { x, y, z } = squares;
    let tensor = DMat3::from_diagonal(DVec3::new(y + z, z + x, x + y));
    (DVec3::new(middle, 0.0, 0.0), tensor)
}
