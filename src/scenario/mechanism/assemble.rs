//! Links -> a tree of bodies with one coordinate each.

use super::bodies::Spec;
use super::names::Kind;
use crate::diagnostics::{Problem, shorten};
use crate::mechanism::{Body, Inertia, Joint, Link, Mount, Tree};
use crate::scenario::reader::Reader;
use glam::{DMat3, DVec3};

/// A tree, and what a scene's names are in it.
pub(super) struct Assembled {
    pub tree: Tree,
    /// In the order of the scene.
    pub links: Vec<Link>,
    /// Of each body of the tree, the link whose coordinate it has.
    pub owners: Vec<usize>,
}

impl Reader<'_> {
    /// Hangs all links on each other; `None` where a parent is unknown or links hang on themselves,
    /// which is reported.
    pub(super) fn assemble(&mut self, specs: &[Spec], gravity: DVec3) -> Option<Assembled> {
        let parents = self.parents(specs)?;
        let order = self.order(specs, &parents)?;
        let mut tree = Tree {
            gravity,
            bodies: Vec::new(),
        };
        let mut mounts = vec![Mount::WORLD; specs.len()];
        let mut owners = Vec::new();
        for link in order {
            let spec = &specs[link];
            let on = parents[link].map_or(Mount::WORLD, |p| mounts[p]);
            let placed = Mount {
                body: on.body,
                place: on.point(spec.place),
                rotation: on.rotation * spec.rotation,
            };
            if spec.kind == Kind::Fixed {
                if let Some(body) = on.body {
                    let own = spec.inertia.placed(placed.place, placed.rotation);
                    let whole = &mut tree.bodies[body].inertia;
                    *whole = whole.joined(&own);
                }
                mounts[link] = placed;
                continue;
            }
            let mut parent = placed.body;
            let (mut place, mut rotation) = (placed.place, placed.rotation);
            let joints = joints(spec);
            let last = joints.len() - 1;
            for (k, (joint, axis, tail)) in joints.into_iter().enumerate() {
                tree.bodies.push(Body {
                    name: format!("{}{tail}", spec.name),
                    parent,
                    joint,
                    axis,
                    place,
                    rotation,
                    inertia: if k == last {
                        spec.inertia
                    } else {
                        Inertia::NONE
                    },
                    rotor: spec.rotor,
                });
                owners.push(link);
                parent = Some(tree.bodies.len() - 1);
                (place, rotation) = (DVec3::ZERO, DMat3::IDENTITY);
            }
            mounts[link] = Mount {
                body: parent,
                ..Mount::WORLD
            };
        }
        if tree.bodies.is_empty() {
            return None;
        }
        let links = (specs.iter().zip(mounts).zip(&parents))
            .map(|((spec, mount), parent)| Link {
                name: spec.name.clone(),
                mount,
                parent: *parent,
                mass: spec.inertia.mass,
                com: spec.inertia.com,
                slides: matches!(spec.kind, Kind::Prismatic | Kind::Planar | Kind::Floating),
            })
            .collect();
        Some(Assembled {
            tree,
            links,
            owners,
        })
    }

    fn parents(&mut self, specs: &[Spec]) -> Option<Vec<Option<usize>>> {
        let names = || specs.iter().map(|s| s.name.as_str());
        let mut parents = Vec::with_capacity(specs.len());
        let mut all_known = true;
        for spec in specs {
            let Some((name, span)) = &spec.parent else {
                parents.push(None);
                continue;
            };
            let parent = names().position(|n| n == name);
            if parent.is_none() {
                let message = format!(
                    "unknown body `{}`, the parent of `{}`",
                    shorten(name),
                    spec.name
                );
                let known = names().chain(["world"]);
                self.unknown::<()>((name, span.clone()), message, "no such body", known);
                all_known = false;
            }
            parents.push(parent);
        }
        all_known.then_some(parents)
    }

    /// Parents before their children, else as they are written.
    fn order(&mut self, specs: &[Spec], parents: &[Option<usize>]) -> Option<Vec<usize>> {
        let mut order: Vec<usize> = Vec::with_capacity(specs.len());
        let mut placed = vec![false; specs.len()];
        while order.len() < specs.len() {
            let next =
                (0..specs.len()).find(|i| !placed[*i] && parents[*i].is_none_or(|p| placed[p]));
            let Some(next) = next else { break };
            placed[next] = true;
            order.push(next);
        }
        if order.len() == specs.len() {
            return Some(order);
        }
        // From a link that is left, upward until one comes again.
        let mut way = vec![placed.iter().position(|p| !p)?];
        while let Some(up) = parents[*way.last()?] {
            if let Some(at) = way.iter().position(|w| *w == up) {
                way.drain(..at);
                break;
            }
            way.push(up);
        }
        let names: Vec<&str> = way
            .iter()
            .chain(&way[..1])
            .map(|w| specs[*w].name.as_str())
            .collect();
        let message = format!(
            "bodies hang on each other in a circle: {}",
            names.join(" on ")
        );
        let span =
            (specs[way[0]].parent.as_ref()).map_or(specs[way[0]].span.clone(), |(_, s)| s.clone());
        let problem = Problem::at(span, message, "a tree has no circle");
        self.report(problem.with_help("the first body has no parent, or parent = \"world\"; a closed chain is cut at one joint, where two points are held together ([mechanism.contacts])"));
        None
    }
}

/// The joints of one coordinate that a joint is made of, with their axes in its frame and what
/// follows the body's name in the coordinate's.
fn joints(spec: &Spec) -> Vec<(Joint, DVec3, &'static str)> {
    use Joint::{Prismatic, Revolute};
    let of = |list: &[(Joint, DVec3)]| -> Vec<(Joint, DVec3, &'static str)> {
        let tails = spec.kind.coordinates();
        (list.iter().zip(tails))
            .map(|((j, a), t)| (*j, *a, *t))
            .collect()
    };
    let slides = [
        (Prismatic, DVec3::X),
        (Prismatic, DVec3::Y),
        (Prismatic, DVec3::Z),
    ];
    let turns = [
        (Revolute, DVec3::Z),
        (Revolute, DVec3::Y),
        (Revolute, DVec3::X),
    ];
    match spec.kind {
        Kind::Revolute => of(&[(Revolute, spec.axis)]),
        Kind::Prismatic => of(&[(Prismatic, spec.axis)]),
        Kind::Planar => of(&[slides[0], slides[1], turns[0]]),
        Kind::Spherical => of(&turns),
        Kind::Floating => of(&[slides, turns].concat()),
        Kind::Fixed => Vec::new(),
    }
}
