//! A robot in URDF (Unified Robot Description Format) as a scene: `[mechanism]` with its joints and
//! bodies, a control a joint, limits as guards and bounds, and a first cost and region to begin with.
//!
//! A body has the name of the joint that moves it; its frame is the joint's. What a scene has no use
//! for is left out and said.

mod names;
mod text;

use costate::Scene;
use costate::low_level::diagnostics::ScenarioErrors;
use costate::low_level::mechanism::Impossible;
use costate::session::MechanismAt;
use names::Names;
use std::collections::BTreeMap;
use urdf_rs::{Joint, JointType, Link, Robot};

/// A scene that was made of a robot.
#[derive(Clone, Debug)]
pub struct Imported {
    /// The scene's text.
    pub text: String,
    pub joints: usize,
    /// Of all that moves.
    pub mass: f64,
    /// What was left out or changed.
    pub notes: Vec<String>,
}

/// Why there is no scene.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    #[error("it is no URDF: {0}")]
    Urdf(String),
    #[error("it is a xacro file: expand it first (xacro FILE > robot.urdf)")]
    Xacro,
    #[error("the robot has no joint that moves")]
    Rigid,
    #[error("{0}")]
    Tree(String),
    #[error("joint `{joint}` is {kind}, which a mechanism in space does not have")]
    Joint { joint: String, kind: &'static str },
    #[error("joint `{joint}`: {what}")]
    Number { joint: String, what: String },
    #[error("what the robot says makes no mechanism: {}", said(.0))]
    Scene(ScenarioErrors),
    #[error("{count} joints that move; a mechanism may have {MOST_JOINTS}")]
    TooMany { count: usize },
}

/// Joints that move, and depth of elements in the file, at most.
const MOST_JOINTS: usize = 200;
const DEEPEST: usize = 64;

/// The problems of a scene that nobody has seen, without their places.
fn said(errors: &ScenarioErrors) -> String {
    let all = errors.problems.iter().map(|p| match &p.help {
        Some(help) => format!("{} ({help})", p.message),
        None => p.message.clone(),
    });
    all.collect::<Vec<_>>().join("; ")
}

/// Whether elements are nested deeper than any robot's: parsers descend into them.
fn is_too_deep(text: &str) -> bool {
    let (mut depth, mut deepest) = (0usize, 0usize);
    for part in text.split('<').skip(1) {
        let closes = part.starts_with('/');
        let alone = part.split('>').next().is_some_and(|tag| tag.ends_with('/'));
        if closes {
            depth = depth.saturating_sub(1);
        } else if !alone && !part.starts_with(['?', '!']) {
            depth += 1;
            deepest = deepest.max(depth);
        }
    }
    deepest > DEEPEST
}

/// The text with 0 for what limits leave out: parsers ask for it.
fn with_limits(text: &str) -> String {
    let mut parts = text.split("<limit");
    let mut all = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        all += "<limit";
        let (tag, rest) = part.split_at(part.find('>').unwrap_or(part.len()));
        let (tag, end) = match tag.strip_suffix('/') {
            Some(tag) => (tag, "/"),
            None => (tag, ""),
        };
        all += tag;
        if part.starts_with([' ', '\n', '\t', '\r', '/', '>']) {
            for name in ["effort", "velocity"]
                .into_iter()
                .filter(|n| !tag.contains(*n))
            {
                all += &format!(" {name}=\"0\"");
            }
        }
        all += end;
        all += rest;
    }
    all
}

/// Which link's `<inertial>` lacks what it must have: parsers do not say.
fn unfinished(text: &str) -> Option<String> {
    (text.split("<link").skip(1)).find_map(|link| {
        let link = link.split("</link>").next()?;
        let inertial = link
            .split("<inertial")
            .nth(1)?
            .split("</inertial>")
            .next()?;
        let missing = ["<mass", "<inertia"].iter().find(|tag| {
            let mut found = inertial.match_indices(*tag);
            !found
                .any(|(at, _)| inertial[at + tag.len()..].starts_with([' ', '\n', '\t', '\r', '/']))
        })?;
        let name = link
            .split("name=")
            .nth(1)?
            .get(1..)?
            .split(['"', '\''])
            .next()?;
        Some(format!("; the inertial of link `{name}` has no {missing}>"))
    })
}

/// A joint with the link that it moves.
pub(crate) struct Part<'r> {
    pub joint: &'r Joint,
    pub link: &'r Link,
    /// The body's name, and that of the body before it.
    pub name: String,
    pub parent: Option<String>,
    pub fixed: bool,
    /// Where a joint that mimics another is fixed.
    pub at: f64,
}

/// Reads a robot. `file` is for the scene's first line.
///
/// # Errors
/// [`ImportError`].
pub fn import(urdf: &str, file: &str) -> Result<Imported, ImportError> {
    if urdf.contains("xmlns:xacro") || urdf.contains("<xacro:") {
        return Err(ImportError::Xacro);
    }
    if is_too_deep(urdf) {
        let what = format!("its elements are nested more than {DEEPEST} deep");
        return Err(ImportError::Urdf(what));
    }
    let robot = urdf_rs::read_from_string(&with_limits(urdf)).map_err(|e| {
        let place = unfinished(urdf).unwrap_or_default();
        let text = e.to_string();
        let text = text.strip_prefix("custom: ").unwrap_or(&text);
        ImportError::Urdf(format!("{text}{place}"))
    })?;
    let mut notes = Vec::new();
    let parts = parts(&robot, &mut notes)?;
    let joints = parts.iter().filter(|p| !p.fixed).count();
    if joints == 0 {
        return Err(ImportError::Rigid);
    }
    if joints > MOST_JOINTS {
        return Err(ImportError::TooMany { count: joints });
    }
    for part in &parts {
        check(part)?;
    }
    remarks(&robot, &parts, &mut notes);
    for (tag, what) in [
        ("<transmission", "transmissions"),
        ("<gazebo", "what is for Gazebo"),
    ] {
        if urdf.contains(tag) {
            notes.push(format!("left out: {what}"));
        }
    }

    let scene = text::Scene::new(&robot, &parts, file);
    // Torques that hold the robot where it is to stand are asked of the mechanism itself.
    let first = scene.text(None);
    let read = Scene::parse(&first, file).map_err(ImportError::Scene)?;
    let actuated = scene.is_actuated();
    let hold = actuated.then(|| holding(&read, &scene)).flatten();
    let held = hold.filter(|hold| scene.can_hold(hold));
    let text = scene.text(held.as_deref());
    Scene::parse(&text, file).map_err(ImportError::Scene)?;
    if held.is_none() {
        let why = match actuated {
            true => "the motors cannot hold the robot where the scene begins",
            false => "not every coordinate has a motor",
        };
        notes.push(format!(
            "no equilibrium: {why}, so the cost is that of a finite horizon"
        ));
    }
    let mass = parts.iter().map(|p| p.link.inertial.mass.value).sum();
    Ok(Imported {
        text,
        joints,
        mass,
        notes,
    })
}

/// What holds each coordinate at the place where the scene begins.
fn holding(read: &Scene, scene: &text::Scene<'_>) -> Option<Vec<f64>> {
    let at = MechanismAt::new(read)?;
    let names = at.coordinates();
    let places = scene.places();
    let states = read.model.states.iter().map(|s| {
        let name = &s.variable.name;
        places
            .iter()
            .find(|(own, _)| own == name)
            .map_or(0.0, |(_, x)| *x)
    });
    let x: Vec<f64> = states.collect();
    let u = vec![0.0; read.model.controls.len()];
    let found = at.at(&x, &u, &[]);
    let by_name: BTreeMap<&String, f64> = names.iter().zip(found.gravity).collect();
    places
        .iter()
        .map(|(name, _)| by_name.get(name).copied())
        .collect()
}

/// Joints with their links, parents first, named as a scene wants it.
fn parts<'r>(robot: &'r Robot, notes: &mut Vec<String>) -> Result<Vec<Part<'r>>, ImportError> {
    let tree = |what: String| Err(ImportError::Tree(what));
    let links: BTreeMap<&str, &Link> = robot.links.iter().map(|l| (l.name.as_str(), l)).collect();
    if links.len() < robot.links.len() {
        let twice = robot.links.iter().find(|l| {
            let same = robot.links.iter().filter(|other| other.name == l.name);
            same.count() > 1
        });
        let name = twice.map_or("", |l| l.name.as_str());
        return tree(format!("two links are called `{name}`"));
    }
    for joint in &robot.joints {
        for link in [&joint.parent.link, &joint.child.link] {
            if !links.contains_key(link.as_str()) {
                return tree(format!("joint `{}`: there is no link `{link}`", joint.name));
            }
        }
    }
    let moves = |link: &Link| {
        (robot.joints.iter())
            .filter(|j| j.child.link == link.name)
            .count()
    };
    if let Some(link) = robot.links.iter().find(|l| moves(l) > 1) {
        return tree(format!("link `{}` is the child of two joints", link.name));
    }
    let roots: Vec<&Link> = robot.links.iter().filter(|l| moves(l) == 0).collect();
    let [root] = roots.as_slice() else {
        let names: Vec<&str> = roots.iter().map(|l| l.name.as_str()).collect();
        if robot.links.is_empty() {
            return tree("there is no link in it".to_owned());
        }
        return tree(match names.is_empty() {
            true => "links hang on each other in a circle".to_owned(),
            false => format!("more than one link hangs on nothing: {}", names.join(", ")),
        });
    };
    if root.inertial.mass.value > 0.0 {
        notes.push(format!(
            "link `{}` is fixed to the world: its mass plays no part",
            root.name
        ));
    }
    let mut names = Names::new();
    let mut parts: Vec<Part<'r>> = Vec::new();
    let mut open: Vec<(&str, Option<String>)> = vec![(root.name.as_str(), None)];
    // In the order of the file among the joints of a link.
    while let Some((link, body)) = open.pop() {
        let here = robot.joints.iter().filter(|j| j.parent.link == link);
        let mut next = Vec::new();
        for joint in here {
            let name = names.of(&joint.name, notes);
            let mimics = joint.mimic.is_some();
            let at = if mimics { mimicked(robot, joint)? } else { 0.0 };
            if mimics {
                notes.push(format!(
                    "joint `{}` mimics another one: it is fixed at {}, where it is as the scene begins",
                    joint.name,
                    text::number(at)
                ));
            }
            next.push((joint.child.link.as_str(), Some(name.clone())));
            parts.push(Part {
                joint,
                link: links[joint.child.link.as_str()],
                name,
                parent: body.clone(),
                fixed: joint.joint_type == JointType::Fixed || mimics,
                at,
            });
        }
        open.extend(next.into_iter().rev());
    }
    if parts.len() < robot.joints.len() {
        return tree("links hang on each other in a circle".to_owned());
    }
    Ok(parts)
}

/// Where a joint that mimics another (which may do so itself) is where the scene begins.
fn mimicked(robot: &Robot, joint: &Joint) -> Result<f64, ImportError> {
    // place = factor * (that of the joint) + shift
    let (mut joint, mut factor, mut shift) = (joint, 1.0, 0.0);
    for _ in 0..=robot.joints.len() {
        let Some(mimic) = &joint.mimic else {
            return Ok(factor * text::begin(joint) + shift);
        };
        shift += factor * mimic.offset.unwrap_or(0.0);
        factor *= mimic.multiplier.unwrap_or(1.0);
        let Some(other) = robot.joints.iter().find(|j| j.name == mimic.joint) else {
            let (name, other) = (&joint.name, &mimic.joint);
            let what = format!("joint `{name}` mimics `{other}`, and there is no such joint");
            return Err(ImportError::Tree(what));
        };
        joint = other;
    }
    let what = format!("joints mimic each other in a circle: `{}`", joint.name);
    Err(ImportError::Tree(what))
}

/// Refuses joints and numbers that no mechanism has.
fn check(part: &Part<'_>) -> Result<(), ImportError> {
    let joint = part.joint;
    if joint.joint_type == JointType::Planar && !part.fixed {
        return Err(ImportError::Joint {
            joint: joint.name.clone(),
            kind: "planar",
        });
    }
    let wrong = |what: &str| ImportError::Number {
        joint: joint.name.clone(),
        what: what.to_owned(),
    };
    let inertia = &part.link.inertial.inertia;
    let numbers = [
        &joint.origin.xyz[..],
        &joint.origin.rpy[..],
        &joint.axis.xyz[..],
        &part.link.inertial.origin.xyz[..],
        &part.link.inertial.origin.rpy[..],
        &[part.link.inertial.mass.value, part.at][..],
        &[inertia.ixx, inertia.ixy, inertia.ixz][..],
        &[inertia.iyy, inertia.iyz, inertia.izz][..],
    ];
    if numbers.concat().iter().any(|v| !v.is_finite()) {
        return Err(wrong("a number is not finite"));
    }
    let turns = matches!(
        joint.joint_type,
        JointType::Revolute | JointType::Continuous | JointType::Prismatic
    );
    if turns && !part.fixed && joint.axis.xyz.iter().all(|v| *v == 0.0) {
        return Err(wrong("its axis is 0"));
    }
    Ok(())
}

/// What is left out of the scene.
fn remarks(robot: &Robot, parts: &[Part<'_>], notes: &mut Vec<String>) {
    let looks = robot.links.iter().any(|l| !l.visual.is_empty());
    let shapes = robot.links.iter().any(|l| !l.collision.is_empty());
    if looks || shapes {
        notes.push("left out: how links look, and their shapes for collisions".to_owned());
    }
    let some = |of: &dyn Fn(&Joint) -> bool| -> Vec<&str> {
        (parts.iter().filter(|p| of(p.joint)))
            .map(|p| p.joint.name.as_str())
            .collect()
    };
    let rubs = some(&|j| j.dynamics.as_ref().is_some_and(|d| d.friction != 0.0));
    if !rubs.is_empty() {
        notes.push(format!(
            "left out: Coulomb friction of {} (damping is kept)",
            rubs.join(", ")
        ));
    }
    let safe = some(&|j| j.safety_controller.is_some() || j.calibration.is_some());
    if !safe.is_empty() {
        notes.push(format!(
            "left out: safety controllers and calibration of {}",
            safe.join(", ")
        ));
    }
    let odd = some(&|j| {
        let limit = &j.limit;
        let bounded = limit.lower != 0.0 || limit.upper != 0.0;
        let slides = matches!(j.joint_type, JointType::Revolute | JointType::Prismatic);
        let is_range = limit.lower < limit.upper;
        (slides && bounded && !is_range) || limit.effort < 0.0 || limit.velocity < 0.0
    });
    if !odd.is_empty() {
        notes.push(format!(
            "left out: limits that are no limits (lower not below upper, or negative) of {}",
            odd.join(", ")
        ));
    }
    let moves = |j: &Joint| {
        let part = parts.iter().find(|p| p.joint.name == j.name);
        part.is_some_and(|p| !p.fixed)
    };
    let driven = |j: &Joint| {
        use JointType::{Continuous, Prismatic, Revolute};
        moves(j) && matches!(j.joint_type, Revolute | Continuous | Prismatic)
    };
    let unlimited = [
        (
            "position",
            some(&|j| {
                let [lower, upper] = [j.limit.lower, j.limit.upper];
                let limited = j.joint_type != JointType::Continuous;
                driven(j)
                    && limited
                    && (lower == 0.0 && upper == 0.0 || !(upper - lower).is_finite())
            }),
        ),
        (
            "velocity",
            some(&|j| driven(j) && (j.limit.velocity == 0.0 || !j.limit.velocity.is_finite())),
        ),
        (
            "effort",
            some(&|j| driven(j) && (j.limit.effort == 0.0 || !j.limit.effort.is_finite())),
        ),
    ];
    for (what, joints) in unlimited.iter().filter(|(_, joints)| !joints.is_empty()) {
        notes.push(format!(
            "no limit of {what} (missing, 0 or infinite, which is taken for none): {}",
            joints.join(", ")
        ));
    }
    let unlike: Vec<&str> = (parts.iter())
        .filter(|p| {
            text::inertia(p)
                .impossible(false)
                .is_some_and(Impossible::is_usable)
        })
        .map(|p| p.link.name.as_str())
        .collect();
    if !unlike.is_empty() {
        notes.push(format!(
            "no body has the inertia of {}: it is taken as it is",
            unlike.join(", ")
        ));
    }
    let pushes = some(&|j| {
        let damping = j.dynamics.as_ref().map_or(0.0, |d| d.damping);
        damping < 0.0 || damping.is_nan()
    });
    if !pushes.is_empty() {
        notes.push(format!(
            "left out: damping that is negative or no number of {}",
            pushes.join(", ")
        ));
    }
    let jerks = some(&|j| j.limit.acceleration.is_finite() || j.limit.jerk.is_finite());
    if !jerks.is_empty() {
        notes.push(format!(
            "left out: limits of acceleration and jerk of {}",
            jerks.join(", ")
        ));
    }
}

#[cfg(test)]
mod tests;
