//! Forward dynamics by articulated bodies, in O(N) operations (Featherstone 1983; Hardt 1999, II.F),
//! on expressions.
//!
//! With classical accelerations of the bodies' origins: the force and moment that a body needs from
//! its joint are `[t; f] = [A B; B' C] [alpha; a] + bias`. Eliminating the joint's own coordinate
//! gives what the parent has to carry.

use super::algebra::{
    M3, V3, add, add_matrices, add_symmetric, conjugate, constant, cross, dot, product, rotate,
    rotate_back, scale, skew, sub, symmetric, times, transposed, transposed_times, zero,
};
use super::motion::Motion;
use super::tree::Joint;
use crate::expr::{Graph, Id};

/// `[A B; B' C]`.
#[derive(Clone, Copy, Debug)]
pub struct Blocks {
    a: M3,
    b: M3,
    c: M3,
}

/// A moment about a body's origin, and a force.
pub type Wrench = (V3, V3);

/// A joint after elimination.
#[derive(Clone, Copy, Debug)]
struct Eliminated {
    /// What the joint's axis is to its body: `[A B; B' C] S`.
    carried: Wrench,
    /// S' [A B; B' C] S + rotor, what moves with the joint.
    inertia: Id,
    inverse: Id,
    /// Where the joint carries nothing of itself: which entry of the wrench is its own force.
    own: Option<(usize, f64)>,
    /// What is left for the parent, in the working axes.
    left: Blocks,
    /// The same in the parent's.
    turned: Blocks,
}

/// Articulated bodies: what all accelerations of one position share.
#[derive(Clone, Debug)]
pub struct Articulated<'m> {
    motion: &'m Motion,
    joints: Vec<Eliminated>,
}

/// What acts on a mechanism, by body.
#[derive(Clone, Debug)]
pub struct Load {
    /// Force or moment at each joint, along its axis.
    pub joints: Vec<Id>,
    /// Moment about each body's origin and force, in working axes.
    pub bodies: Vec<Wrench>,
}

impl Load {
    /// Nothing.
    pub fn none(g: &mut Graph, count: usize) -> Self {
        let none = zero(g);
        Self {
            joints: vec![none[0]; count],
            bodies: vec![(none, none); count],
        }
    }
}

/// Accelerations.
#[derive(Clone, Debug)]
pub struct Accelerations {
    /// q''.
    pub joints: Vec<Id>,
    /// Angular, and of the origin, in working axes; less gravity where that acts.
    pub bodies: Vec<(V3, V3)>,
}

impl Blocks {
    /// Of a rigid body.
    fn rigid(g: &mut Graph, motion: &Motion, i: usize) -> Self {
        let frame = &motion.frames[i];
        let mass = g.constant(motion.tree.bodies[i].inertia.mass);
        let none = g.constant(0.0);
        Self {
            a: frame.tensor,
            b: skew(g, frame.moment),
            c: [0, 1, 2].map(|i| [0, 1, 2].map(|j| if i == j { mass } else { none })),
        }
    }

    fn plus(&self, g: &mut Graph, other: &Self) -> Self {
        Self {
            a: add_symmetric(g, &self.a, &other.a),
            b: add_matrices(g, &self.b, &other.b),
            c: add_symmetric(g, &self.c, &other.c),
        }
    }

    /// From the axes of `rotation`'s beginning to those of its end.
    fn turned(&self, g: &mut Graph, rotation: &[super::algebra::Turn]) -> Self {
        Self {
            a: conjugate(g, rotation, &self.a, true),
            b: conjugate(g, rotation, &self.b, false),
            c: conjugate(g, rotation, &self.c, true),
        }
    }

    /// About a point from which the present one is at `arm`.
    fn moved(&self, g: &mut Graph, arm: V3) -> Self {
        let arm = skew(g, arm);
        let across = product(g, &arm, &self.c);
        let b = add_matrices(g, &self.b, &across);
        let (x, y) = (product(g, &self.b, &arm), product(g, &arm, &transposed(&b)));
        Self {
            a: symmetric(|i, j| {
                let change = g.sub(y[i][j], x[i][j]);
                g.add(self.a[i][j], change)
            }),
            b,
            c: self.c,
        }
    }

    /// What turning about, or sliding along, an axis takes.
    fn along(&self, g: &mut Graph, joint: Joint, axis: V3) -> Wrench {
        match joint {
            Joint::Revolute => (times(g, &self.a, axis), transposed_times(g, &self.b, axis)),
            Joint::Prismatic => (times(g, &self.b, axis), times(g, &self.c, axis)),
        }
    }

    /// Less what a joint that is free takes upon itself: `I - U U' / D`. The entries of `own` are 0
    /// then.
    fn without(&self, g: &mut Graph, carried: Wrench, inverse: Id, own: Option<usize>) -> Self {
        let all: Vec<Id> = carried.0.iter().chain(&carried.1).copied().collect();
        let shares: Vec<Id> = all.iter().map(|u| g.mul(*u, inverse)).collect();
        let mut less = |value: Id, i: usize, j: usize| {
            if own == Some(i) || own == Some(j) {
                return g.constant(0.0);
            }
            let taken = g.mul(all[i], shares[j]);
            g.sub(value, taken)
        };
        Self {
            a: symmetric(|i, j| less(self.a[i][j], i, j)),
            b: [0, 1, 2].map(|i| [0, 1, 2].map(|j| less(self.b[i][j], i, 3 + j))),
            c: symmetric(|i, j| less(self.c[i][j], 3 + i, 3 + j)),
        }
    }

    fn of_angular(&self, g: &mut Graph, alpha: V3) -> Wrench {
        (
            times(g, &self.a, alpha),
            transposed_times(g, &self.b, alpha),
        )
    }

    fn of_linear(&self, g: &mut Graph, acceleration: V3) -> Wrench {
        (
            times(g, &self.b, acceleration),
            times(g, &self.c, acceleration),
        )
    }
}

fn add_wrench(g: &mut Graph, x: Wrench, y: Wrench) -> Wrench {
    (add(g, x.0, y.0), add(g, x.1, y.1))
}

/// The part of a wrench, or of accelerations, along a joint's axis.
fn along(g: &mut Graph, joint: Joint, axis: V3, of: Wrench) -> Id {
    match joint {
        Joint::Revolute => dot(g, axis, of.0),
        Joint::Prismatic => dot(g, axis, of.1),
    }
}

impl<'m> Articulated<'m> {
    /// Eliminates all joints, from the last body to the first.
    pub fn new(g: &mut Graph, motion: &'m Motion) -> Self {
        let count = motion.frames.len();
        let mut bodies: Vec<Blocks> = (0..count).map(|i| Blocks::rigid(g, motion, i)).collect();
        let mut joints = Vec::with_capacity(count);
        for i in (0..count).rev() {
            let (body, frame) = (&motion.tree.bodies[i], &motion.frames[i]);
            let whole = bodies[i];
            let carried = whole.along(g, body.joint, frame.axis);
            let own_inertia = along(g, body.joint, frame.axis, carried);
            let rotor = g.constant(body.rotor);
            let inertia = g.add(own_inertia, rotor);
            let one = g.constant(1.0);
            let inverse = g.div(one, inertia);
            let own = frame
                .aligned
                .filter(|_| body.rotor == 0.0)
                .map(|(k, sign)| {
                    let first = if body.joint == Joint::Prismatic { 3 } else { 0 };
                    (first + k, sign)
                });
            let left = whole.without(g, carried, inverse, own.map(|(k, _)| k));
            let turned = left.turned(g, &frame.turn);
            if let Some(p) = body.parent {
                let moved = turned.moved(g, frame.arm);
                bodies[p] = bodies[p].plus(g, &moved);
            }
            joints.push(Eliminated {
                carried,
                inertia,
                inverse,
                own,
                left,
                turned,
            });
        }
        joints.reverse();
        Self { motion, joints }
    }

    /// What moves with each joint where all after it are free: positive in a mechanism that can be
    /// driven.
    pub fn inertias(&self) -> Vec<Id> {
        self.joints.iter().map(|j| j.inertia).collect()
    }

    /// The accelerations under a load, with gravity and the forces of velocity.
    pub fn accelerations(&self, g: &mut Graph, load: &Load) -> Accelerations {
        let motion = self.motion;
        let count = motion.frames.len();
        let biases: Vec<(V3, V3)> = (0..count).map(|i| motion.joint_bias(g, i)).collect();
        let wrenches = (0..count)
            .map(|i| {
                let needed = velocity_wrench(g, motion, i);
                (
                    sub(g, needed.0, load.bodies[i].0),
                    sub(g, needed.1, load.bodies[i].1),
                )
            })
            .collect();
        let up = constant(g, -motion.tree.gravity);
        self.sweep(g, &load.joints, wrenches, Some(&biases), up)
    }

    /// q'' of a load alone, at rest and without gravity: M^-1 times its generalized forces.
    pub fn response(&self, g: &mut Graph, load: &Load) -> Accelerations {
        let wrenches = (load.bodies.iter())
            .map(|(t, f)| (super::algebra::neg(g, *t), super::algebra::neg(g, *f)))
            .collect();
        let none = zero(g);
        self.sweep(g, &load.joints, wrenches, None, none)
    }

    /// The sweep inward that gathers what the parents have to carry, and the one outward that gives
    /// the accelerations. `base` is that of the world.
    fn sweep(
        &self,
        g: &mut Graph,
        forces: &[Id],
        mut wrenches: Vec<Wrench>,
        biases: Option<&[(V3, V3)]>,
        base: V3,
    ) -> Accelerations {
        let motion = self.motion;
        let count = motion.frames.len();
        // What is left of each joint's force for its own motion.
        let mut driving = vec![forces.first().copied(); count];
        for i in (0..count).rev() {
            let (body, frame, joint) = (&motion.tree.bodies[i], &motion.frames[i], &self.joints[i]);
            let taken = along(g, body.joint, frame.axis, wrenches[i]);
            let left = g.sub(forces[i], taken);
            driving[i] = Some(left);
            let Some(p) = body.parent else { continue };
            // On to the parent: bias + U (what is left) / D.
            let share = g.mul(joint.inverse, left);
            let (t, f) = joint.carried;
            let passed = (scale(g, share, t), scale(g, share, f));
            let mut wrench = add_wrench(g, wrenches[i], passed);
            if let Some((k, sign)) = joint.own {
                let own = if sign < 0.0 {
                    g.neg(forces[i])
                } else {
                    forces[i]
                };
                match k {
                    0..3 => wrench.0[k] = own,
                    _ => wrench.1[k - 3] = own,
                }
            }
            if let Some(biases) = biases {
                let needed = joint.left.of_angular(g, biases[i].0);
                wrench = add_wrench(g, wrench, needed);
            }
            let mut wrench = (
                rotate(g, &frame.turn, wrench.0),
                rotate(g, &frame.turn, wrench.1),
            );
            if let Some(biases) = biases {
                let needed = joint.turned.of_linear(g, biases[i].1);
                wrench = add_wrench(g, wrench, needed);
            }
            let about = cross(g, frame.arm, wrench.1);
            wrench.0 = add(g, wrench.0, about);
            wrenches[p] = add_wrench(g, wrenches[p], wrench);
        }

        let none = zero(g);
        let mut found = Accelerations {
            joints: Vec::with_capacity(count),
            bodies: Vec::with_capacity(count),
        };
        for i in 0..count {
            let (body, frame, joint) = (&motion.tree.bodies[i], &motion.frames[i], &self.joints[i]);
            let (alpha, a) = body.parent.map_or((none, base), |p| found.bodies[p]);
            let around = cross(g, alpha, frame.arm);
            let mut linear = add(g, a, around);
            if let Some(biases) = biases {
                linear = add(g, linear, biases[i].1);
            }
            let mut linear = rotate_back(g, &frame.turn, linear);
            let mut angular = rotate_back(g, &frame.turn, alpha);
            if let Some(biases) = biases {
                angular = add(g, angular, biases[i].0);
            }
            let (x, y) = (
                dot(g, joint.carried.0, angular),
                dot(g, joint.carried.1, linear),
            );
            let carried = g.add(x, y);
            let left = driving[i].map_or(carried, |left| g.sub(left, carried));
            let own = g.mul(joint.inverse, left);
            let moved = scale(g, own, frame.axis);
            match body.joint {
                Joint::Revolute => angular = add(g, angular, moved),
                Joint::Prismatic => linear = add(g, linear, moved),
            }
            found.joints.push(own);
            found.bodies.push((angular, linear));
        }
        found
    }
}

/// Moment about a body's origin and force that its velocities need: `w x J w`, `w x (w x m c)`.
pub(super) fn velocity_wrench(g: &mut Graph, motion: &Motion, i: usize) -> Wrench {
    let frame = &motion.frames[i];
    let spun = times(g, &frame.tensor, frame.omega);
    let moment = cross(g, frame.omega, spun);
    (moment, times(g, &frame.centripetal, frame.moment))
}
