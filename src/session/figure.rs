//! A mechanism as lines between joints and points, to be drawn.

use super::mechanism::lower;
use crate::mechanism::Posed;
use crate::program::Program;
use crate::scene::Scene;
use glam::{DMat3, DVec3};

/// Where a mechanism in space is looked at from: so much to the side, and from above.
const AZIMUTH: f64 = -0.9;
const ELEVATION: f64 = 0.35;

/// The lines of a scene's mechanism at any state.
///
/// A body is drawn from its joint to the joints of the bodies that hang on it and to its points; one
/// without either to twice the way to its centre of mass, which is the end of a uniform rod. Slides of
/// bodies without mass are not drawn.
#[derive(Debug)]
pub struct StickFigure {
    /// Of the state, the places of all vertices.
    places: Program,
    vertices: usize,
    /// Pairs of vertices with a line between them.
    pub lines: Vec<[usize; 2]>,
    /// Vertices on which no other body hangs: their paths are worth drawing.
    pub ends: Vec<usize>,
    /// Vertices that are joints.
    pub joints: Vec<usize>,
    /// Rows: what points right, up and towards the eye in pictures.
    view: DMat3,
    /// Whether the mechanism is planar: pictures have its coordinates.
    pub planar: bool,
}

impl StickFigure {
    /// Of a scene; `None` where it has no mechanism.
    #[must_use]
    pub fn new(scene: &Scene) -> Option<Self> {
        let model = &scene.model;
        let mechanism = model.mechanism.as_ref()?;
        let mut graph = model.graph.clone();
        let posed = Posed::new(&mut graph, &mechanism.tree, &mechanism.q, &mechanism.rates);
        let mut outputs = Vec::new();
        let mut vertex = |graph: &mut _, mount: &_, at: DVec3| {
            outputs.extend(posed.point(graph, mount, at).position);
            outputs.len() / 3 - 1
        };
        let links = &mechanism.links;
        let joints: Vec<usize> = (links.iter())
            .map(|link| vertex(&mut graph, &link.mount, DVec3::ZERO))
            .collect();
        let (mut lines, mut ends) = (Vec::new(), Vec::new());
        for (k, link) in links.iter().enumerate() {
            // A slide of a body without mass is no part of the mechanism to be seen.
            let seen = |parent: &usize| !link.slides || links[*parent].mass > 0.0;
            if let Some(parent) = link.parent.filter(seen) {
                lines.push([joints[parent], joints[k]]);
            }
            let hang = links.iter().any(|l| l.parent == Some(k));
            let points = mechanism.points.iter().filter(|p| p.link == Some(k));
            let mut has_points = false;
            for point in points {
                has_points = true;
                let at = vertex(&mut graph, &point.mount, point.at);
                lines.push([joints[k], at]);
                ends.push(at);
            }
            if !hang && !has_points {
                let end = match link.com == DVec3::ZERO {
                    true => joints[k],
                    false => vertex(&mut graph, &link.mount, 2.0 * link.com),
                };
                lines.push([joints[k], end]);
                ends.push(end);
            }
        }
        lines.retain(|[a, b]| a != b);
        let x: Vec<_> = model.states.iter().map(|s| s.variable.symbol).collect();
        Some(Self {
            vertices: outputs.len() / 3,
            places: lower(&mut graph, model, &x, &outputs),
            lines,
            ends,
            joints,
            view: view(mechanism.planar, mechanism.tree.gravity),
            planar: mechanism.planar,
        })
    }

    /// Vertices.
    #[must_use]
    pub fn vertices(&self) -> usize {
        self.vertices
    }

    /// Where the vertices are at a state, in the world's axes.
    #[must_use]
    pub fn at(&self, x: &[f64]) -> Vec<[f64; 3]> {
        let all = self.places.eval(x);
        all.chunks(3).map(|p| [p[0], p[1], p[2]]).collect()
    }

    /// A place as it is seen: right, and up. Of a planar mechanism its x and y.
    #[must_use]
    pub fn seen(&self, place: [f64; 3]) -> [f64; 2] {
        let seen = self.view * DVec3::from_array(place);
        [seen.x, seen.y]
    }
}

/// From world axes to those of a picture.
fn view(planar: bool, gravity: DVec3) -> DMat3 {
    if planar {
        return DMat3::IDENTITY;
    }
    // Up is against gravity, or z.
    let up = (-gravity).try_normalize().unwrap_or(DVec3::Z);
    let side = up.any_orthonormal_vector();
    let ahead = up.cross(side);
    let away = AZIMUTH.cos() * side + AZIMUTH.sin() * ahead;
    let eye = ELEVATION.cos() * away + ELEVATION.sin() * up;
    let right = up.cross(eye).normalize();
    DMat3::from_cols(right, eye.cross(right), eye).transpose()
}
