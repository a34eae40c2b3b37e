//! A mechanism with its symbols and what acts on it: what a scene's `[mechanism]` comes to.

use super::algebra::V3;
use super::{Constraint, Load, Motion, Mount, Point, Tree};
use crate::expr::{Graph, Id};
use glam::DVec3;
use rustc_hash::FxHashMap;
use std::sync::Arc;

/// A body as it was named; it may be part of another one (a fixed joint) or have coordinates of
/// massless bodies before it.
#[derive(Clone, Debug, PartialEq)]
pub struct Link {
    pub name: String,
    pub mount: Mount,
    /// The link that it hangs on.
    pub parent: Option<usize>,
    pub mass: f64,
    /// Centre of mass, in the frame of the mount.
    pub com: DVec3,
    /// Whether its origin moves against its parent.
    pub slides: bool,
}

/// A point that was named.
#[derive(Clone, Debug, PartialEq)]
pub struct Named {
    pub name: String,
    pub link: Option<usize>,
    pub mount: Mount,
    /// In the frame of the mount.
    pub at: DVec3,
}

/// A mechanism: bodies, symbols and forces.
#[derive(Clone, Debug)]
pub struct Mechanism {
    pub tree: Arc<Tree>,
    /// Whether it was described in two dimensions.
    pub planar: bool,
    /// The coordinates and their rates, one a body of the tree: symbols, or expressions of those of
    /// others.
    pub q: Vec<Id>,
    pub rates: Vec<Id>,
    pub links: Vec<Link>,
    pub points: Vec<Named>,
    /// Of the joints, springs and dampers included, and of forces at points.
    pub load: Load,
    /// Directions in which points are held.
    pub constraints: Vec<Constraint>,
    /// q'', one a body.
    pub second: Vec<Id>,
    /// Of the constraints.
    pub forces: Vec<Id>,
    pub energy: Energy,
}

impl Mechanism {
    /// The coordinates that are states: those that do not follow from others.
    pub fn free(&self, g: &Graph) -> Vec<Id> {
        let all = self.q.iter().copied();
        all.filter(|q| g.as_symbol(*q).is_some()).collect()
    }

    /// Whether a symbol is a coordinate or a rate.
    pub fn moves(&self, symbol: Id) -> bool {
        self.q.contains(&symbol) || self.rates.contains(&symbol)
    }

    /// How the symbols of `free` coordinates and of their rates move.
    pub fn motion_of(&self, g: &Graph, free: &[Id]) -> FxHashMap<Id, Id> {
        let mut moving = FxHashMap::default();
        for (i, q) in self.q.iter().enumerate().filter(|(_, q)| free.contains(q)) {
            moving.insert(*q, self.rates[i]);
            if g.as_symbol(self.rates[i]).is_some() {
                moving.insert(self.rates[i], self.second[i]);
            }
        }
        moving
    }

    /// A point as if it were held in all directions.
    pub fn axes(&self, point: &Named) -> Vec<Constraint> {
        let count = if self.planar { 2 } else { 3 };
        (DVec3::AXES[..count].iter())
            .map(|direction| Constraint {
                name: point.name.clone(),
                at: (point.mount, point.at),
                against: None,
                direction: *direction,
            })
            .collect()
    }
}

/// Energies.
#[derive(Clone, Copy, Debug)]
pub struct Energy {
    pub kinetic: Id,
    /// Of gravity and springs.
    pub potential: Id,
}

/// A tree in motion, with where its bodies are in the world.
#[derive(Clone, Debug)]
pub struct Posed {
    pub motion: Motion,
    /// From each body's working axes to the world's.
    pub orientations: Vec<super::algebra::M3>,
    /// Of each body, in world axes.
    pub origins: Vec<V3>,
    /// Of the origins, in working axes.
    pub velocities: Vec<V3>,
}

impl Posed {
    /// Of a tree at given coordinates and rates.
    pub fn new(g: &mut Graph, tree: &Arc<Tree>, q: &[Id], rates: &[Id]) -> Self {
        let motion = Motion::new(g, tree, q, rates);
        let orientations = motion.orientations(g);
        let origins = motion.origins(g, &orientations);
        let velocities = motion.velocities(g);
        Self {
            motion,
            orientations,
            origins,
            velocities,
        }
    }

    pub fn point(&self, g: &mut Graph, mount: &Mount, at: DVec3) -> Point {
        let all = (
            &self.orientations[..],
            &self.origins[..],
            &self.velocities[..],
        );
        self.motion.point(g, mount, at, all)
    }

    pub fn kinetic(&self, g: &mut Graph) -> Id {
        self.motion.kinetic(g, &self.velocities)
    }

    /// Of gravity.
    pub fn potential(&self, g: &mut Graph) -> Id {
        (self.motion).potential(g, &self.orientations, &self.origins)
    }

    /// A vector of world axes in a body's working axes.
    pub fn into_working(&self, g: &mut Graph, body: usize, v: V3) -> V3 {
        super::algebra::transposed_times(g, &self.orientations[body], v)
    }
}
