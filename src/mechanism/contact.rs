//! Held points: contact forces, and what a plastic collision does, in O(N) operations a constraint
//! (Hardt 1999, III.B to III.D).
//!
//! A constraint holds a point of a body, against the world or a point of another body, along a
//! direction. With J the Jacobian of all constraints and `L = J M^-1 J'`: contact forces are `-L^-1 (J
//! q''_free + J' q')`, impulses `-L^-1 J q'`. J has full rank where the constraints are independent.

use super::algebra::{V3, add, constant, cross, dot, neg, scale, sub, transposed_times};
use super::forward::{Accelerations, Articulated, Load};
use super::system::Posed;
use super::{Mount, Point};
use crate::expr::{Graph, Id};
use glam::DVec3;

/// A point that is held along a direction of world axes.
#[derive(Clone, Debug, PartialEq)]
pub struct Constraint {
    /// Of the contact that it is part of.
    pub name: String,
    pub at: (Mount, DVec3),
    /// The point of another body that it is held to; `None` is the world.
    pub against: Option<(Mount, DVec3)>,
    pub direction: DVec3,
}

/// Constraints at one position of a mechanism.
#[derive(Clone, Debug)]
pub struct Held<'p> {
    posed: &'p Posed,
    rows: Vec<Row>,
    /// M^-1 J', a column a constraint.
    responses: Vec<Accelerations>,
    /// J M^-1 J'.
    mobility: Vec<Vec<Id>>,
}

/// A constraint in motion.
#[derive(Clone, Debug)]
struct Row {
    at: Point,
    against: Option<Point>,
    direction: V3,
}

impl Row {
    /// The part along the direction of what `at` is at each point.
    fn along(&self, g: &mut Graph, mut at: impl FnMut(&mut Graph, &Point) -> V3) -> Id {
        let here = at(g, &self.at);
        let all = match &self.against {
            Some(other) => {
                let there = at(g, other);
                sub(g, here, there)
            }
            None => here,
        };
        dot(g, self.direction, all)
    }

    /// A force on the point, and its reaction on the one that it is held to.
    fn push(&self, g: &mut Graph, posed: &Posed, load: &mut Load, force: V3) {
        posed.push(g, load, &self.at, force);
        if let Some(other) = &self.against {
            let back = neg(g, force);
            posed.push(g, load, other, back);
        }
    }
}

impl Posed {
    /// Forces along world axes at points, as wrenches on their bodies.
    fn push(&self, g: &mut Graph, load: &mut Load, point: &Point, force: V3) {
        let Some(i) = point.body else { return };
        let force = transposed_times(g, &self.orientations[i], force);
        let moment = cross(g, point.arm, force);
        let (t, f) = load.bodies[i];
        load.bodies[i] = (add(g, t, moment), add(g, f, force));
    }

    fn row(&self, g: &mut Graph, c: &Constraint) -> Row {
        Row {
            at: self.point(g, &c.at.0, c.at.1),
            against: c.against.map(|(mount, at)| self.point(g, &mount, at)),
            direction: constant(g, c.direction),
        }
    }

    /// What a constraint keeps as it is, along its direction: velocity, and the way from the point
    /// of another body that it holds to.
    pub fn kept(&self, g: &mut Graph, constraint: &Constraint) -> (Id, Option<Id>) {
        let row = self.row(g, constraint);
        let velocity = row.along(g, |_, point| point.velocity);
        let against = row.against.is_some();
        let gap = against.then(|| row.along(g, |_, point| point.position));
        (velocity, gap)
    }

    /// Eliminates constraints; `articulated` is of this position.
    pub fn held(
        &self,
        g: &mut Graph,
        articulated: &Articulated<'_>,
        constraints: &[Constraint],
    ) -> Held<'_> {
        let rows: Vec<Row> = constraints.iter().map(|c| self.row(g, c)).collect();
        let count = self.motion.frames.len();
        let responses: Vec<Accelerations> = (rows.iter())
            .map(|row| {
                let mut load = Load::none(g, count);
                row.push(g, self, &mut load, row.direction);
                articulated.response(g, &load)
            })
            .collect();
        let mut mobility = vec![Vec::new(); rows.len()];
        for (i, row) in rows.iter().enumerate() {
            for response in &responses[..=i] {
                mobility[i].push(row.along(g, |g, point| self.carried(g, point, response)));
            }
        }
        for i in 0..rows.len() {
            for j in i + 1..rows.len() {
                let entry = mobility[j][i];
                mobility[i].push(entry);
            }
        }
        Held {
            posed: self,
            rows,
            responses,
            mobility,
        }
    }

    /// Acceleration of a point in world axes, without what velocities add.
    fn carried(&self, g: &mut Graph, point: &Point, accelerations: &Accelerations) -> V3 {
        let Some(i) = point.body else {
            return super::algebra::zero(g);
        };
        let (alpha, a) = accelerations.bodies[i];
        let around = cross(g, alpha, point.arm);
        let sum = add(g, a, around);
        super::algebra::times(g, &self.orientations[i], sum)
    }
}

impl Held<'_> {
    /// `J M^-1 J'`, row by row: the inverse of the operational inertia of what is held.
    pub fn mobility(&self) -> &[Vec<Id>] {
        &self.mobility
    }

    /// Velocities along the constraints: 0 where they are held.
    pub fn velocities(&self, g: &mut Graph) -> Vec<Id> {
        (self.rows.iter())
            .map(|row| row.along(g, |_, point| point.velocity))
            .collect()
    }

    /// Generalized forces that forces along the constraints come to: `J' f`.
    pub fn generalized(&self, g: &mut Graph, forces: &[Id]) -> Vec<Id> {
        let mut load = Load::none(g, self.posed.motion.frames.len());
        for (row, force) in self.rows.iter().zip(forces) {
            let along = scale(g, *force, row.direction);
            row.push(g, self.posed, &mut load, along);
        }
        self.posed.motion.generalized(g, &load)
    }

    /// Accelerations along the constraints: what q'' gives, and what velocities add.
    pub fn accelerations(&self, g: &mut Graph, second: &[Id]) -> Vec<Vec<Id>> {
        let posed = self.posed;
        let still = super::algebra::zero(g);
        let whole = posed.motion.bias_accelerations(g, Some(second), still);
        let bias = posed.motion.bias_accelerations(g, None, still);
        (self.rows.iter())
            .map(|row| {
                let [whole, bias] = [&whole, &bias].map(|all| {
                    row.along(g, |g, point| {
                        (posed.motion).point_acceleration(g, point, all, &posed.orientations)
                    })
                });
                vec![g.sub(whole, bias), bias]
            })
            .collect()
    }

    /// q'' and the forces of the constraints, of the accelerations without them.
    pub fn contact(&self, g: &mut Graph, free: &Accelerations) -> (Vec<Id>, Vec<Id>) {
        let posed = self.posed;
        let gravity = constant(g, posed.motion.tree.gravity);
        let unmet: Vec<Id> = (self.rows.iter())
            .map(|row| {
                row.along(g, |g, point| {
                    if point.body.is_none() {
                        return super::algebra::zero(g);
                    }
                    let all = posed.motion.point_acceleration(
                        g,
                        point,
                        &free.bodies,
                        &posed.orientations,
                    );
                    add(g, all, gravity)
                })
            })
            .collect();
        let forces = self.forces(g, &unmet);
        (self.changed(g, &free.joints, &forces), forces)
    }

    /// Rates after a plastic collision, and its impulses: all velocities along the constraints are 0
    /// then.
    pub fn collision(&self, g: &mut Graph, rates: &[Id]) -> (Vec<Id>, Vec<Id>) {
        let unmet = self.velocities(g);
        let impulses = self.forces(g, &unmet);
        (self.changed(g, rates, &impulses), impulses)
    }

    /// Rates after an impulse (a load of impulses) while the constraints hold, which react.
    pub fn impulse(
        &self,
        g: &mut Graph,
        articulated: &Articulated<'_>,
        load: &Load,
        rates: &[Id],
    ) -> (Vec<Id>, Vec<Id>) {
        let pushed = articulated.response(g, load);
        let unmet: Vec<Id> = (self.rows.iter())
            .map(|row| row.along(g, |g, point| self.posed.carried(g, point, &pushed)))
            .collect();
        let reactions = self.forces(g, &unmet);
        let moved: Vec<Id> = (rates.iter().zip(&pushed.joints))
            .map(|(v, dv)| g.add(*v, *dv))
            .collect();
        (self.changed(g, &moved, &reactions), reactions)
    }

    /// `-L^-1 unmet` by `L = U' D U` without pivots: L is positive definite.
    fn forces(&self, g: &mut Graph, unmet: &[Id]) -> Vec<Id> {
        let n = unmet.len();
        let mut matrix = self.mobility.clone();
        let mut right: Vec<Id> = unmet.iter().map(|v| g.neg(*v)).collect();
        let one = g.constant(1.0);
        let mut inverses = Vec::with_capacity(n);
        for k in 0..n {
            let inverse = g.div(one, matrix[k][k]);
            inverses.push(inverse);
            for i in k + 1..n {
                let factor = g.mul(matrix[i][k], inverse);
                for j in k + 1..=i {
                    let taken = g.mul(factor, matrix[j][k]);
                    matrix[i][j] = g.sub(matrix[i][j], taken);
                }
                let taken = g.mul(factor, right[k]);
                right[i] = g.sub(right[i], taken);
            }
        }
        for k in (0..n).rev() {
            for i in k + 1..n {
                let taken = g.mul(matrix[i][k], right[i]);
                right[k] = g.sub(right[k], taken);
            }
            right[k] = g.mul(right[k], inverses[k]);
        }
        right
    }

    /// With what forces of the constraints add.
    fn changed(&self, g: &mut Graph, from: &[Id], forces: &[Id]) -> Vec<Id> {
        let mut changed = from.to_vec();
        for (response, force) in self.responses.iter().zip(forces) {
            for (value, by) in changed.iter_mut().zip(&response.joints) {
                let part = g.mul(*force, *by);
                *value = g.add(*value, part);
            }
        }
        changed
    }
}
