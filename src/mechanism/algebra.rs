//! Vectors and matrices of expressions, and rotations that act on them.
//!
//! Entries that are the number 0 or 1 are folded by the graph, so planar mechanisms pay nothing for
//! the third dimension.

use crate::expr::{Fun, Graph, Id};
use glam::{DMat3, DVec3};

/// A vector.
pub type V3 = [Id; 3];
/// A matrix, row by row.
pub type M3 = [[Id; 3]; 3];

/// Entries of rotations closer than this to 0 or 1 are rounding of what is exactly that.
const ROUNDING: f64 = 1e-15;

/// A rotation with its rounding taken off: 0 and 1 where they are meant.
#[must_use]
pub fn clean(rotation: DMat3) -> DMat3 {
    let entry = |v: f64| {
        let whole = v.round();
        if (v - whole).abs() < ROUNDING {
            whole
        } else {
            v
        }
    };
    DMat3::from_cols_array(&rotation.to_cols_array().map(entry))
}

/// A factor of a rotation.
#[derive(Clone, Copy, Debug)]
pub enum Turn {
    Constant(DMat3),
    /// About a coordinate axis, by an angle of this sine and cosine.
    About {
        axis: usize,
        sin: Id,
        cos: Id,
    },
}

impl Turn {
    /// About a coordinate axis.
    pub fn about(g: &mut Graph, axis: usize, angle: Id) -> Self {
        Self::About {
            axis,
            sin: g.unary(Fun::Sin, angle),
            cos: g.unary(Fun::Cos, angle),
        }
    }
}

/// A rotation as a product of turns: the last acts first.
pub type Rotation = Vec<Turn>;

pub fn zero(g: &mut Graph) -> V3 {
    [g.constant(0.0); 3]
}

pub fn constant(g: &mut Graph, v: DVec3) -> V3 {
    v.to_array().map(|c| g.constant(c))
}

/// A matrix of numbers.
pub fn constants(g: &mut Graph, m: DMat3) -> M3 {
    [0, 1, 2].map(|i| m.row(i).to_array().map(|c| g.constant(c)))
}

pub fn add(g: &mut Graph, a: V3, b: V3) -> V3 {
    [0, 1, 2].map(|i| g.add(a[i], b[i]))
}

pub fn sub(g: &mut Graph, a: V3, b: V3) -> V3 {
    [0, 1, 2].map(|i| g.sub(a[i], b[i]))
}

pub fn scale(g: &mut Graph, factor: Id, a: V3) -> V3 {
    a.map(|c| g.mul(factor, c))
}

pub fn neg(g: &mut Graph, a: V3) -> V3 {
    a.map(|c| g.neg(c))
}

pub fn dot(g: &mut Graph, a: V3, b: V3) -> Id {
    let terms = [0, 1, 2].map(|i| g.mul(a[i], b[i]));
    g.sum(&terms)
}

pub fn cross(g: &mut Graph, a: V3, b: V3) -> V3 {
    [0, 1, 2].map(|i| {
        let (j, k) = ((i + 1) % 3, (i + 2) % 3);
        let (x, y) = (g.mul(a[j], b[k]), g.mul(a[k], b[j]));
        g.sub(x, y)
    })
}

/// `m v`.
pub fn times(g: &mut Graph, m: &M3, v: V3) -> V3 {
    m.map(|row| dot(g, row, v))
}

/// `m' v`.
pub fn transposed_times(g: &mut Graph, m: &M3, v: V3) -> V3 {
    times(g, &transposed(m), v)
}

pub fn transposed(m: &M3) -> M3 {
    [0, 1, 2].map(|i| [0, 1, 2].map(|j| m[j][i]))
}

pub fn add_matrices(g: &mut Graph, a: &M3, b: &M3) -> M3 {
    [0, 1, 2].map(|i| add(g, a[i], b[i]))
}

/// The sum of symmetric matrices.
pub fn add_symmetric(g: &mut Graph, a: &M3, b: &M3) -> M3 {
    symmetric(|i, j| g.add(a[i][j], b[i][j]))
}

/// A symmetric matrix of its upper triangle.
pub fn symmetric(mut entry: impl FnMut(usize, usize) -> Id) -> M3 {
    let (xx, xy, xz) = (entry(0, 0), entry(0, 1), entry(0, 2));
    let (yy, yz, zz) = (entry(1, 1), entry(1, 2), entry(2, 2));
    [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
}

/// The matrix `[a]x` of the cross product, `[a]x b = a x b`.
pub fn skew(g: &mut Graph, a: V3) -> M3 {
    let zero = g.constant(0.0);
    let minus = neg(g, a);
    [
        [zero, minus[2], a[1]],
        [a[2], zero, minus[0]],
        [minus[1], a[0], zero],
    ]
}

/// `a b`.
pub fn product(g: &mut Graph, a: &M3, b: &M3) -> M3 {
    let columns = transposed(b);
    a.map(|row| columns.map(|column| dot(g, row, column)))
}

/// `R v`.
pub fn rotate(g: &mut Graph, rotation: &[Turn], v: V3) -> V3 {
    (rotation.iter().rev()).fold(v, |v, turn| turn_by(g, turn, v, false))
}

/// `R' v`.
pub fn rotate_back(g: &mut Graph, rotation: &[Turn], v: V3) -> V3 {
    (rotation.iter()).fold(v, |v, turn| turn_by(g, turn, v, true))
}

fn turn_by(g: &mut Graph, turn: &Turn, v: V3, back: bool) -> V3 {
    match *turn {
        Turn::Constant(m) => {
            let m = constants(g, if back { m.transpose() } else { m });
            times(g, &m, v)
        }
        Turn::About { axis, sin, cos } => {
            let sin = if back { g.neg(sin) } else { sin };
            let (i, j) = ((axis + 1) % 3, (axis + 2) % 3);
            let mut turned = v;
            (turned[i], turned[j]) = turn_pair(g, (sin, cos), v[i], v[j]);
            turned
        }
    }
}

fn turn_pair(g: &mut Graph, (sin, cos): (Id, Id), x: Id, y: Id) -> (Id, Id) {
    let (a, b) = (g.mul(cos, x), g.mul(sin, y));
    let (c, d) = (g.mul(sin, x), g.mul(cos, y));
    (g.sub(a, b), g.add(c, d))
}

/// `R m`.
pub fn rotate_columns(g: &mut Graph, rotation: &[Turn], m: &M3) -> M3 {
    let columns = transposed(m).map(|column| rotate(g, rotation, column));
    transposed(&columns)
}

/// `R m R'`; m and the result are symmetric where `symmetric`.
pub fn conjugate(g: &mut Graph, rotation: &[Turn], m: &M3, is_symmetric: bool) -> M3 {
    (rotation.iter().rev()).fold(*m, |m, turn| match *turn {
        Turn::Constant(r) => {
            let rows = constants(g, r);
            let left = product(g, &rows, &m);
            if is_symmetric {
                symmetric(|i, j| dot(g, left[i], rows[j]))
            } else {
                product(g, &left, &transposed(&rows))
            }
        }
        Turn::About { axis, sin, cos } => conjugate_about(g, axis, (sin, cos), &m, is_symmetric),
    })
}

/// A turn about a coordinate axis: in the plane of the turn `[a b; c d]` becomes `[d + cos e, b +
/// sin e; c + sin e, a + d - (d + cos e)]` with `e = cos (a - d) - sin (b + c)`.
fn conjugate_about(
    g: &mut Graph,
    axis: usize,
    (sin, cos): (Id, Id),
    m: &M3,
    is_symmetric: bool,
) -> M3 {
    let (i, j, k) = ((axis + 1) % 3, (axis + 2) % 3, axis);
    let (a, b, c, d) = (m[i][i], m[i][j], m[j][i], m[j][j]);
    let (difference, sum) = (g.sub(a, d), g.add(b, c));
    let (x, y) = (g.mul(cos, difference), g.mul(sin, sum));
    let e = g.sub(x, y);
    let (along, across) = (g.mul(cos, e), g.mul(sin, e));

    let mut turned = *m;
    turned[i][i] = g.add(d, along);
    let trace = g.add(a, d);
    turned[j][j] = g.sub(trace, turned[i][i]);
    turned[i][j] = g.add(b, across);
    turned[j][i] = if is_symmetric {
        turned[i][j]
    } else {
        g.add(c, across)
    };
    (turned[i][k], turned[j][k]) = turn_pair(g, (sin, cos), m[i][k], m[j][k]);
    (turned[k][i], turned[k][j]) = if is_symmetric {
        (turned[i][k], turned[j][k])
    } else {
        turn_pair(g, (sin, cos), m[k][i], m[k][j])
    };
    turned
}
