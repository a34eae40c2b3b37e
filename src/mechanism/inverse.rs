//! Inverse dynamics by the recursive Newton-Euler method, in O(N) operations, and the mass matrix
//! by composite bodies.

use super::algebra::{V3, add, constant, cross, dot, rotate, rotate_back, scale, sub, times, zero};
use super::forward::{Load, Wrench, velocity_wrench};
use super::motion::Motion;
use super::tree::Joint;
use crate::expr::{Graph, Id};

impl Motion {
    /// Forces at the joints under which the coordinates have accelerations `second`: `M q'' + C q' +
    /// G`, less what the load's wrenches give. `second`: `None` is 0 everywhere.
    pub fn joint_forces(
        &self,
        g: &mut Graph,
        second: Option<&[Id]>,
        gravity: bool,
        bodies: Option<&[Wrench]>,
    ) -> Vec<Id> {
        let count = self.frames.len();
        let none = zero(g);
        let base = match gravity {
            true => constant(g, -self.tree.gravity),
            false => none,
        };
        let accelerations = self.bias_accelerations(g, second, base);
        let mut wrenches: Vec<Wrench> = Vec::with_capacity(count);
        for i in 0..count {
            let (body, frame) = (&self.tree.bodies[i], &self.frames[i]);
            let (alpha, a) = accelerations[i];
            let needed = velocity_wrench(g, self, i);
            let mass = g.constant(body.inertia.mass);
            let carried = scale(g, mass, a);
            let around = cross(g, alpha, frame.moment);
            let force = add(g, carried, around);
            let force = add(g, force, needed.1);
            let spun = times(g, &frame.tensor, alpha);
            let leant = cross(g, frame.moment, a);
            let moment = add(g, spun, leant);
            let mut wrench = (add(g, moment, needed.0), force);
            if let Some(given) = bodies {
                wrench = (sub(g, wrench.0, given[i].0), sub(g, wrench.1, given[i].1));
            }
            wrenches.push(wrench);
        }
        let mut forces = self.gathered(g, wrenches);
        if let Some(second) = second {
            for i in 0..count {
                let rotor = g.constant(self.tree.bodies[i].rotor);
                let own = g.mul(rotor, second[i]);
                forces[i] = g.add(forces[i], own);
            }
        }
        forces
    }

    /// Angular accelerations and those of the origins, in working axes, at given q'' (`None`: 0).
    pub fn bias_accelerations(
        &self,
        g: &mut Graph,
        second: Option<&[Id]>,
        base: V3,
    ) -> Vec<(V3, V3)> {
        let none = zero(g);
        let mut all: Vec<(V3, V3)> = Vec::with_capacity(self.frames.len());
        for (i, body) in self.tree.bodies.iter().enumerate() {
            let frame = &self.frames[i];
            let (alpha, a) = body.parent.map_or((none, base), |p| all[p]);
            let bias = self.joint_bias(g, i);
            let around = cross(g, alpha, frame.arm);
            let linear = add(g, a, around);
            let linear = add(g, linear, bias.1);
            let mut linear = rotate_back(g, &frame.turn, linear);
            let angular = rotate_back(g, &frame.turn, alpha);
            let mut angular = add(g, angular, bias.0);
            if let Some(second) = second {
                let own = scale(g, second[i], frame.axis);
                match body.joint {
                    Joint::Revolute => angular = add(g, angular, own),
                    Joint::Prismatic => linear = add(g, linear, own),
                }
            }
            all.push((angular, linear));
        }
        all
    }

    /// Forces at the joints that wrenches on the bodies come to: the sum over all bodies of
    /// J'(wrench).
    pub fn gathered(&self, g: &mut Graph, mut wrenches: Vec<Wrench>) -> Vec<Id> {
        let mut forces = Vec::with_capacity(wrenches.len());
        for i in (0..wrenches.len()).rev() {
            let (body, frame) = (&self.tree.bodies[i], &self.frames[i]);
            let (moment, force) = wrenches[i];
            forces.push(match body.joint {
                Joint::Revolute => dot(g, frame.axis, moment),
                Joint::Prismatic => dot(g, frame.axis, force),
            });
            let Some(p) = body.parent else { continue };
            let force = rotate(g, &frame.turn, force);
            let moment = rotate(g, &frame.turn, moment);
            let about = cross(g, frame.arm, force);
            let moment = add(g, moment, about);
            wrenches[p] = (add(g, wrenches[p].0, moment), add(g, wrenches[p].1, force));
        }
        forces.reverse();
        forces
    }

    /// Generalized forces of a load.
    pub fn generalized(&self, g: &mut Graph, load: &Load) -> Vec<Id> {
        let gathered = self.gathered(g, load.bodies.clone());
        (gathered.iter().zip(&load.joints))
            .map(|(a, b)| g.add(*a, *b))
            .collect()
    }

    /// The mass matrix, row by row: its columns are the forces that unit accelerations take.
    pub fn mass_matrix(&self, g: &mut Graph) -> Vec<Vec<Id>> {
        let count = self.frames.len();
        let (one, none) = (g.constant(1.0), g.constant(0.0));
        let still = Motion {
            rates: vec![none; count],
            ..self.clone()
        }
        .at_rest(g);
        (0..count)
            .map(|j| {
                let unit: Vec<Id> = (0..count)
                    .map(|i| if i == j { one } else { none })
                    .collect();
                still.joint_forces(g, Some(&unit), false, None)
            })
            .collect()
    }

    /// The same position without velocities.
    fn at_rest(mut self, g: &mut Graph) -> Self {
        let none = zero(g);
        for frame in &mut self.frames {
            frame.omega = none;
            frame.centripetal = [none; 3];
        }
        self
    }
}
