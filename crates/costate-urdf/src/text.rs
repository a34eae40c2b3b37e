//! The scene's text.

use super::Part;
use costate::low_level::mechanism::Inertia;
use glam::{DMat3, DQuat, DVec3, EulerRot};
use std::fmt::Write as _;
use urdf_rs::{Joint, JointType, Robot};

/// Rates where a joint has no limit of velocity; way of a slide without limits, m.
const RATE: f64 = 10.0;
const WAY: f64 = 1.0;

/// What the text is made of.
pub struct Scene<'r> {
    robot: &'r Robot,
    parts: &'r [Part<'r>],
    file: &'r str,
}

/// A coordinate: its name, its limits and that of its rate, and what may push it.
struct Coordinate {
    name: String,
    range: [f64; 2],
    limited: bool,
    rate: Option<f64>,
    /// Largest force or torque; `None` where the joint has no motor.
    effort: Option<f64>,
    unit: &'static str,
    force_unit: &'static str,
    /// Whether it comes back after a turn.
    repeats: bool,
}

impl Coordinate {
    /// Where the scene begins: at 0, or in the middle of the limits.
    fn place(&self) -> f64 {
        begin_in(self.range)
    }
}

/// 0, or the middle of limits that leave it out.
fn begin_in([lower, upper]: [f64; 2]) -> f64 {
    match lower < 0.0 && upper > 0.0 {
        true => 0.0,
        false => 0.5 * (lower + upper),
    }
}

/// A joint's limits, where it has some.
fn range(joint: &Joint) -> Option<[f64; 2]> {
    let [lower, upper] = [joint.limit.lower, joint.limit.upper];
    (lower < upper && lower.is_finite() && upper.is_finite()).then_some([lower, upper])
}

impl<'r> Scene<'r> {
    pub fn new(robot: &'r Robot, parts: &'r [Part<'r>], file: &'r str) -> Self {
        Self { robot, parts, file }
    }

    fn coordinates(&self) -> Vec<Coordinate> {
        let moving = self.parts.iter().filter(|p| !p.fixed);
        moving.flat_map(coordinates).collect()
    }

    /// Whether each coordinate has a motor, so that postures can be held.
    pub fn is_actuated(&self) -> bool {
        self.coordinates().iter().all(|c| c.effort.is_some())
    }

    /// Whether forces that hold the coordinates are within what the motors can do.
    pub fn can_hold(&self, hold: &[f64]) -> bool {
        let all = self.coordinates();
        all.iter().zip(hold).all(|(c, force)| match c.effort {
            Some(effort) if effort > 0.0 => force.abs() < 0.999 * effort,
            _ => true,
        })
    }

    /// Coordinates with where the scene begins.
    pub fn places(&self) -> Vec<(String, f64)> {
        let all = self.coordinates();
        all.iter().map(|c| (c.name.clone(), c.place())).collect()
    }

    /// With the forces that hold each coordinate where the scene begins, an equilibrium; without
    /// them a finite horizon.
    pub fn text(&self, hold: Option<&[f64]>) -> String {
        let all = self.coordinates();
        let mut out = String::new();
        let name = (self.robot.name.chars())
            .filter(|c| !c.is_control() && *c != '"' && *c != '\\')
            .collect::<String>();
        let file = self.file.replace(['\n', '\r'], " ");
        let _ = writeln!(
            out,
            "# Made of {file} by `costate import`: bodies, joints and limits are the robot's; cost and region are to begin with.\ntitle = \"{}\"\n",
            if name.is_empty() { "Robot" } else { &name }
        );
        self.mechanism(&mut out);
        let motors: Vec<&Coordinate> = all.iter().filter(|c| c.effort.is_some()).collect();
        let _ = writeln!(out, "\n[mechanism.forces]");
        for c in &motors {
            let _ = writeln!(out, "{0} = \"{0}_force\"", c.name);
        }
        let _ = writeln!(out, "\n[controls]");
        for c in &motors {
            let bounds = match c.effort.filter(|e| *e > 0.0 && e.is_finite()) {
                Some(effort) => format!(", min = {:?}, max = {effort:?}", -effort),
                None => String::new(),
            };
            let _ = writeln!(
                out,
                "{}_force = {{ unit = \"{}\"{bounds} }}",
                c.name, c.force_unit
            );
        }
        if motors.is_empty() {
            // A scene has controls.
            let _ = writeln!(out, "nothing = {{}}");
        }
        let _ = writeln!(out, "\n[states]");
        for c in &all {
            let period = if c.repeats { ", period = \"2*pi\"" } else { "" };
            let _ = writeln!(out, "{} = {{ unit = \"{}\"{period} }}", c.name, c.unit);
        }
        guards(&all, &mut out);
        self.cost(&all, &motors, hold, &mut out);
        let _ = writeln!(out, "\n[region]");
        for c in &all {
            let [lower, upper] = c.range;
            let _ = writeln!(out, "{} = [{lower:?}, {upper:?}]", c.name);
            let rate = c.rate.unwrap_or(RATE);
            let _ = writeln!(out, "{}_rate = [{:?}, {rate:?}]", c.name, -rate);
        }
        let _ = writeln!(out, "\n[time]\nunit = \"s\"");
        out
    }

    fn mechanism(&self, out: &mut String) {
        let _ = writeln!(
            out,
            "[mechanism]\ngravity = [0, 0, -9.81]\n\n[mechanism.bodies]"
        );
        for part in self.parts {
            let _ = writeln!(out, "{}", body(part));
        }
        // The origins of links on which nothing hangs: tools, feet.
        let hangs = |part: &&Part<'_>| {
            let mut others = self.parts.iter();
            !others.any(|p| p.parent.as_ref() == Some(&part.name))
        };
        let _ = writeln!(out, "\n[mechanism.points]");
        for part in self.parts.iter().filter(hangs) {
            let _ = writeln!(out, "{0}_tip = {{ body = \"{0}\" }}", part.name);
        }
    }

    fn cost(
        &self,
        all: &[Coordinate],
        motors: &[&Coordinate],
        hold: Option<&[f64]>,
        out: &mut String,
    ) {
        let away = |name: &str, from: f64| match from == 0.0 {
            true => format!("{name}^2"),
            false => format!("({name} - ({from:?}))^2"),
        };
        let mut terms = Vec::new();
        for c in all {
            terms.push(away(&c.name, c.place()));
            terms.push(format!("0.1*{}_rate^2", c.name));
        }
        for c in motors {
            let held = all.iter().position(|other| other.name == c.name);
            let force = hold.zip(held).map_or(0.0, |(hold, k)| hold[k]);
            terms.push(format!(
                "1e-3*{}",
                away(&format!("{}_force", c.name), force)
            ));
        }
        if motors.is_empty() {
            terms.push("nothing^2".to_owned());
        }
        let _ = writeln!(
            out,
            "\n[cost]\nrunning = \"\"\"\n0.5*({})\"\"\"",
            terms.join("\n   + ")
        );
        let Some(hold) = hold else {
            let _ = writeln!(out, "terminal = \"0\"\nfinal_time = 1");
            return;
        };
        let _ = writeln!(out, "\n[equilibrium]");
        for c in all {
            let _ = writeln!(out, "{} = {:?}", c.name, c.place());
        }
        for (c, force) in all.iter().zip(hold) {
            let _ = writeln!(out, "{}_force = {force:?}", c.name);
        }
    }
}

fn coordinates(part: &Part<'_>) -> Vec<Coordinate> {
    let (joint, name) = (part.joint, &part.name);
    let limit = &joint.limit;
    let rate = Some(limit.velocity).filter(|v| *v > 0.0 && v.is_finite());
    let angle = |name: String, range: [f64; 2], limited: bool| Coordinate {
        name,
        range,
        limited,
        rate,
        effort: Some(limit.effort),
        unit: "rad",
        force_unit: "N m",
        repeats: false,
    };
    let pi = std::f64::consts::PI;
    let way = |range: [f64; 2], limited: bool, name: String| Coordinate {
        unit: "m",
        force_unit: "N",
        ..angle(name, range, limited)
    };
    let limits = range(joint);
    // Of bodies that float nothing is driven.
    let free = |c: Coordinate| Coordinate { effort: None, ..c };
    match joint.joint_type {
        JointType::Continuous => vec![Coordinate {
            repeats: true,
            ..angle(name.clone(), [-pi, pi], false)
        }],
        JointType::Revolute => {
            vec![angle(
                name.clone(),
                limits.unwrap_or([-pi, pi]),
                limits.is_some(),
            )]
        }
        JointType::Prismatic => {
            vec![way(
                limits.unwrap_or([-WAY, WAY]),
                limits.is_some(),
                name.clone(),
            )]
        }
        JointType::Spherical => ["yaw", "pitch", "roll"]
            .map(|tail| free(angle(format!("{name}_{tail}"), [-1.5, 1.5], false)))
            .into(),
        JointType::Floating => {
            let places =
                ["x", "y", "z"].map(|tail| free(way([-WAY, WAY], false, format!("{name}_{tail}"))));
            let turns = ["yaw", "pitch", "roll"]
                .map(|tail| free(angle(format!("{name}_{tail}"), [-1.5, 1.5], false)));
            places.into_iter().chain(turns).collect()
        }
        JointType::Fixed | JointType::Planar => Vec::new(),
    }
}

/// Limits of the joints.
fn guards(all: &[Coordinate], out: &mut String) {
    let mut lines = String::new();
    for c in all {
        if c.limited {
            let [lower, upper] = c.range;
            let _ = writeln!(lines, "{0}_above = \"{0} > {lower:?}\"", c.name);
            let _ = writeln!(lines, "{0}_below = \"{0} < {upper:?}\"", c.name);
        }
        if let Some(rate) = c.rate {
            let _ = writeln!(
                lines,
                "{0}_rate_above = \"{0}_rate > {1:?}\"\n{0}_rate_below = \"{0}_rate < {rate:?}\"",
                c.name, -rate
            );
        }
    }
    if !lines.is_empty() {
        let _ = write!(out, "\n[guards]\n{lines}");
    }
}

/// Where a scene with this joint begins.
pub fn begin(joint: &Joint) -> f64 {
    match joint.joint_type {
        JointType::Revolute | JointType::Prismatic => range(joint).map_or(0.0, begin_in),
        _ => 0.0,
    }
}

/// A number as it is written; -0 is 0.
pub fn number(v: f64) -> String {
    format!("{:?}", v + 0.0)
}

fn vector(v: &[f64]) -> String {
    let all: Vec<String> = v.iter().map(|v| number(*v)).collect();
    format!("[{}]", all.join(", "))
}

/// Turned by roll, pitch and yaw about fixed axes.
fn turned([roll, pitch, yaw]: [f64; 3]) -> DQuat {
    DQuat::from_euler(EulerRot::ZYX, yaw, pitch, roll)
}

/// A body's line.
fn body(part: &Part<'_>) -> String {
    let joint = part.joint;
    let kind = match joint.joint_type {
        _ if part.fixed => "fixed",
        JointType::Revolute | JointType::Continuous => "revolute",
        JointType::Prismatic => "prismatic",
        JointType::Spherical => "spherical",
        JointType::Floating => "floating",
        JointType::Fixed | JointType::Planar => "fixed",
    };
    let mut keys = vec![format!("joint = \"{kind}\"")];
    if let Some(parent) = &part.parent {
        keys.push(format!("parent = \"{parent}\""));
    }
    let zero = |v: &[f64]| v.iter().all(|v| *v == 0.0);
    let (place, rpy) = frame(part);
    if !zero(&place) {
        keys.push(format!("at = {}", vector(&place)));
    }
    if !zero(&rpy) {
        keys.push(format!("rpy = {}", vector(&rpy)));
    }
    if matches!(kind, "revolute" | "prismatic") {
        keys.push(format!("axis = {}", vector(&joint.axis.xyz[..])));
    }
    let inertial = &part.link.inertial;
    if inertial.mass.value != 0.0 {
        keys.push(format!("mass = {}", number(inertial.mass.value)));
        if !zero(&inertial.origin.xyz[..]) {
            keys.push(format!("com = {}", vector(&inertial.origin.xyz[..])));
        }
    }
    let inertia = inertia(part);
    if inertia.about_com != DMat3::ZERO {
        let [x, y, z] = [
            inertia.about_com.x_axis,
            inertia.about_com.y_axis,
            inertia.about_com.z_axis,
        ];
        keys.push(format!(
            "inertia = {}",
            vector(&[x.x, x.y, x.z, y.y, y.z, z.z])
        ));
    }
    let damping = joint.dynamics.as_ref().map_or(0.0, |d| d.damping);
    if damping > 0.0 && !part.fixed && matches!(kind, "revolute" | "prismatic") {
        keys.push(format!("damping = {}", number(damping)));
    }
    format!("{} = {{ {} }}", part.name, keys.join(", "))
}

/// Place and angles of the joint's frame in its parent's; that of a joint that mimics another is
/// moved by where it is.
fn frame(part: &Part<'_>) -> ([f64; 3], [f64; 3]) {
    let joint = part.joint;
    let (place, rpy) = (*joint.origin.xyz, *joint.origin.rpy);
    let axis = DVec3::from(*joint.axis.xyz).try_normalize();
    let (Some(axis), true) = (axis, part.at != 0.0) else {
        return (place, rpy);
    };
    let turn = turned(rpy);
    if joint.joint_type == JointType::Prismatic {
        return ((DVec3::from(place) + turn * (part.at * axis)).into(), rpy);
    }
    let (yaw, pitch, roll) = (turn * DQuat::from_axis_angle(axis, part.at)).to_euler(EulerRot::ZYX);
    (place, [roll, pitch, yaw])
}

/// Of a link, its tensor along the axes of the joint's frame: URDF gives it along those of the
/// inertial frame.
pub fn inertia(part: &Part<'_>) -> Inertia {
    let inertial = &part.link.inertial;
    let i = &inertial.inertia;
    let own = DMat3::from_cols_array(&[
        i.ixx, i.ixy, i.ixz, i.ixy, i.iyy, i.iyz, i.ixz, i.iyz, i.izz,
    ]);
    let rpy = *inertial.origin.rpy;
    let about_com = match rpy == [0.0; 3] {
        true => own,
        false => {
            let turn = DMat3::from_quat(turned(rpy));
            turn * own * turn.transpose()
        }
    };
    Inertia {
        mass: inertial.mass.value,
        com: DVec3::from(*inertial.origin.xyz),
        about_com,
    }
}
