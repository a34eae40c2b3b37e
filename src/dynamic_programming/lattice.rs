//! A regular lattice of states and interpolation on it.

/// States of a grid at most.
pub const MOST_STATES: usize = 4;
/// Vertices of a cell at most.
const VERTICES: usize = 1 << MOST_STATES;
/// A neighbour that a lattice does not have.
const ABSENT: usize = usize::MAX;
/// Steps by which a point may lie outside by rounding.
const SLACK: f64 = 1e-9;
/// Intervals of an axis at least.
const LEAST_INTERVALS: f64 = 4.0;

/// One axis, as deviations from the reference. The reference itself is a node wherever the axis
/// holds it.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    pub first: f64,
    pub step: f64,
    pub count: usize,
    /// `count * step` is the period then, and the last node is followed by the first.
    pub period: Option<f64>,
}

impl Axis {
    /// An axis over `[lo, hi]` with about `count` nodes, or over a whole period.
    pub fn new([lo, hi]: [f64; 2], count: usize, period: Option<f64>) -> Self {
        if let Some(period) = period {
            let count = count.max(LEAST_INTERVALS as usize);
            let step = period / count as f64;
            return Self {
                first: -step * (count / 2) as f64,
                step,
                count,
                period: Some(period),
            };
        }
        let intervals = (count.max(2) as f64 - 1.0).max(LEAST_INTERVALS);
        let step = (hi - lo) / intervals;
        // Rounding must not add a node.
        let whole = |x: f64| (x / step - 1e-6).ceil();
        let (below, above) = if lo <= 0.0 && hi >= 0.0 {
            (whole(-lo), whole(hi))
        } else {
            (-lo / step, hi / step)
        };
        Self {
            first: -below * step,
            step,
            count: (below + above).round() as usize + 1,
            period: None,
        }
    }

    pub fn at(&self, node: usize) -> f64 {
        self.first + self.step * node as f64
    }

    /// The nearest copy of a deviation to the reference.
    pub fn wrapped(&self, s: f64) -> f64 {
        self.period
            .map_or(s, |period| s - period * (s / period).round())
    }
}

/// Axes and the order of the nodes: the last axis runs fastest.
#[derive(Clone, Debug, PartialEq)]
pub struct Lattice {
    pub axes: Vec<Axis>,
    strides: Vec<usize>,
}

/// Where a point lies: offsets of the nodes about it along each axis, and how far it is between the
/// two nearest (0 to 1).
#[derive(Clone, Copy, Debug)]
pub struct Cell<const N: usize> {
    lower: [usize; N],
    upper: [usize; N],
    before: [usize; N],
    after: [usize; N],
    fraction: [f64; N],
}

impl Lattice {
    pub fn new(axes: Vec<Axis>) -> Self {
        let mut strides = vec![1; axes.len()];
        for i in (1..axes.len()).rev() {
            strides[i - 1] = strides[i] * axes[i].count;
        }
        Self { axes, strides }
    }

    /// How far apart in the order of the nodes the neighbours along each axis are.
    pub fn strides(&self) -> &[usize] {
        &self.strides
    }

    /// Number of axes n.
    pub fn states(&self) -> usize {
        self.axes.len()
    }

    /// Number of nodes.
    pub fn len(&self) -> usize {
        self.axes.iter().map(|a| a.count).product()
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The state at a node.
    pub fn node(&self, index: usize) -> Vec<f64> {
        let along = |(axis, stride): (&Axis, &usize)| axis.at(index / stride % axis.count);
        self.axes.iter().zip(&self.strides).map(along).collect()
    }

    /// The node one step along an axis; the node itself at the lattice's border.
    pub fn neighbour(&self, index: usize, axis: usize, forward: bool) -> usize {
        let (a, stride) = (&self.axes[axis], self.strides[axis]);
        let k = index / stride % a.count;
        let next = match (forward, a.period.is_some()) {
            (true, _) if k + 1 < a.count => k + 1,
            (true, true) => 0,
            (false, _) if k > 0 => k - 1,
            (false, true) => a.count - 1,
            _ => k,
        };
        index - k * stride + next * stride
    }

    /// The node nearest to a state inside.
    pub fn nearest(&self, s: &[f64]) -> Option<usize> {
        let mut node = 0;
        for ((axis, stride), s) in self.axes.iter().zip(&self.strides).zip(s) {
            let k = ((s - axis.first) / axis.step).round();
            let k = match axis.period {
                Some(_) => k.rem_euclid(axis.count as f64),
                None => k,
            };
            if !(k >= 0.0 && k < axis.count as f64) {
                return None;
            }
            node += k as usize * stride;
        }
        Some(node)
    }

    /// The nearest copy of a state to the reference.
    pub fn wrapped(&self, s: &[f64]) -> Vec<f64> {
        self.axes
            .iter()
            .zip(s)
            .map(|(a, s)| a.wrapped(*s))
            .collect()
    }

    /// The cell that holds a point; `None` outside and for what is not a number.
    #[inline(always)]
    pub fn locate<const N: usize>(&self, s: &[f64]) -> Option<Cell<N>> {
        let mut cell = Cell {
            lower: [0; N],
            upper: [0; N],
            before: [ABSENT; N],
            after: [ABSENT; N],
            fraction: [0.0; N],
        };
        for i in 0..N {
            let (axis, stride) = (&self.axes[i], self.strides[i]);
            let count = axis.count;
            let mut x = (s[i] - axis.first) / axis.step;
            if axis.period.is_some() {
                let turns = (x / count as f64) as i64;
                x -= count as f64 * turns as f64;
                x += if x < 0.0 { count as f64 } else { 0.0 };
            }
            let last = if axis.period.is_some() {
                count
            } else {
                count - 1
            };
            if !(x >= -SLACK && x <= last as f64 + SLACK) {
                return None;
            }
            let k = (x as usize).min(last - 1);
            cell.fraction[i] = (x - k as f64).clamp(0.0, 1.0);
            cell.lower[i] = k * stride;
            if axis.period.is_some() {
                // One turn at most, without a division.
                let wrapped = |k: usize| if k >= count { k - count } else { k };
                cell.upper[i] = wrapped(k + 1) * stride;
                cell.before[i] = wrapped(k + count - 1) * stride;
                cell.after[i] = wrapped(k + 2) * stride;
            } else {
                cell.upper[i] = (k + 1) * stride;
                if k > 0 {
                    cell.before[i] = (k - 1) * stride;
                }
                if k + 2 < count {
                    cell.after[i] = (k + 2) * stride;
                }
            }
        }
        Some(cell)
    }
}

/// Values at the vertices of a cell: bit i of a vertex's number says whether it is the upper one
/// along axis i.
struct Vertices<const N: usize> {
    index: [usize; VERTICES],
    value: [f64; VERTICES],
}

impl<const N: usize> Vertices<N> {
    #[inline(always)]
    fn new<T: Copy + Into<f64>>(cell: &Cell<N>, values: &[T]) -> Self {
        let mut index = [0; VERTICES];
        for i in 0..N {
            index[0] += cell.lower[i];
        }
        for i in 0..N {
            for j in 0..1 << i {
                index[j | 1 << i] = index[j] + cell.upper[i] - cell.lower[i];
            }
        }
        let mut value = [0.0; VERTICES];
        for j in 0..1 << N {
            value[j] = values[index[j]].into();
        }
        Self { index, value }
    }

    #[inline(always)]
    fn multilinear(&self, cell: &Cell<N>) -> f64 {
        let mut v = self.value;
        for i in (0..N).rev() {
            for j in 0..1 << i {
                v[j] += cell.fraction[i] * (v[j | 1 << i] - v[j]);
            }
        }
        v[0]
    }

    /// The least and the largest value.
    #[inline(always)]
    fn range(&self) -> (f64, f64) {
        let (mut lo, mut hi) = (self.value[0], self.value[0]);
        for j in 1..1 << N {
            let v = self.value[j];
            lo = if v < lo { v } else { lo };
            hi = if v > hi { v } else { hi };
        }
        (lo, hi)
    }

    /// Second differences along each axis on the line of vertices nearest to the point: the one of
    /// least size of the two about the cell, 0 where their signs differ (at a kink, which no
    /// parabola should follow).
    #[inline(always)]
    fn curvature<T: Copy + Into<f64>>(&self, cell: &Cell<N>, values: &[T]) -> [f64; N] {
        let mut near = 0;
        for i in 0..N {
            near |= usize::from(cell.fraction[i] >= 0.5) << i;
        }
        let mut curvature = [0.0; N];
        for i in 0..N {
            let (low, high) = (near & !(1 << i), near | 1 << i);
            let (v0, v1) = (self.value[low], self.value[high]);
            let base = self.index[low] - cell.lower[i];
            let left = || v1 - 2.0 * v0 + values[base + cell.before[i]].into();
            let right = || values[base + cell.after[i]].into() - 2.0 * v1 + v0;
            curvature[i] = match (cell.before[i] != ABSENT, cell.after[i] != ABSENT) {
                (true, true) => lesser(left(), right()),
                (true, false) => left(),
                (false, true) => right(),
                (false, false) => 0.0,
            };
        }
        curvature
    }

    /// The multilinear interpolant's slopes by the fractions.
    #[inline(always)]
    fn slopes(&self, cell: &Cell<N>) -> [f64; N] {
        let mut slopes = [0.0; N];
        for i in 0..N {
            let mut v = self.value;
            for k in (0..N).rev() {
                let t = if k == i { 1.0 } else { cell.fraction[k] };
                for j in 0..1 << k {
                    let step = v[j | 1 << k] - v[j];
                    v[j] = if k == i { step } else { v[j] + t * step };
                }
            }
            slopes[i] = v[0];
        }
        slopes
    }
}

/// The one of least size; 0 where the signs differ.
#[inline(always)]
fn lesser(a: f64, b: f64) -> f64 {
    if a * b <= 0.0 {
        0.0
    } else if a.abs() < b.abs() {
        a
    } else {
        b
    }
}

/// The value at a point of a cell: multilinear, and where all vertices are below `bent_below` bent
/// by second differences along the axes, which makes it exact for quadratics. It never leaves the
/// range of the vertices, without which an iteration with it need not converge.
#[inline(always)]
pub fn interpolate<const N: usize, T: Copy + Into<f64>>(
    values: &[T],
    cell: &Cell<N>,
    bent_below: f64,
) -> f64 {
    let vertices = Vertices::new(cell, values);
    let linear = vertices.multilinear(cell);
    let (lo, hi) = vertices.range();
    if hi >= bent_below {
        return linear;
    }
    let curvature = vertices.curvature(cell, values);
    let mut value = linear;
    for i in 0..N {
        value -= 0.5 * cell.fraction[i] * (1.0 - cell.fraction[i]) * curvature[i];
    }
    value.clamp(lo, hi)
}

/// The gradient of the same.
pub fn slope<const N: usize, T: Copy + Into<f64>>(
    lattice: &Lattice,
    values: &[T],
    cell: &Cell<N>,
    bent_below: f64,
) -> [f64; N] {
    let vertices = Vertices::new(cell, values);
    let mut slopes = vertices.slopes(cell);
    let (lo, hi) = vertices.range();
    let curvature = if hi < bent_below {
        vertices.curvature(cell, values)
    } else {
        [0.0; N]
    };
    for i in 0..N {
        let bend = (0.5 * curvature[i]).clamp(lo - hi, hi - lo);
        slopes[i] = (slopes[i] - bend * (1.0 - 2.0 * cell.fraction[i])) / lattice.axes[i].step;
    }
    slopes
}

/// The largest value at a cell's vertices.
pub fn largest<const N: usize, T: Copy + Into<f64>>(values: &[T], cell: &Cell<N>) -> f64 {
    Vertices::new(cell, values).range().1
}

/// Calls a function generic over the number of states with the number in hand.
macro_rules! by_states {
    ($n:expr, $function:ident ( $($argument:expr),* $(,)? )) => {
        match $n {
            1 => $function::<1>($($argument),*),
            2 => $function::<2>($($argument),*),
            3 => $function::<3>($($argument),*),
            _ => $function::<4>($($argument),*),
        }
    };
}
pub(crate) use by_states;

#[cfg(test)]
mod tests {
    use super::*;

    fn lattice() -> Lattice {
        Lattice::new(vec![
            Axis::new([-1.0, 1.0], 9, None),
            Axis::new([-2.0, 1.0], 8, None),
            Axis::new([0.0, 0.0], 12, Some(3.0)),
        ])
    }

    #[test]
    fn the_reference_is_a_node_of_every_axis() {
        for axis in [
            Axis::new([-1.0, 2.3], 10, None),
            Axis::new([-1.0, 1.0], 10, None),
            Axis::new([0.0, 0.0], 10, Some(2.0)),
        ] {
            let nearest = (0..axis.count)
                .map(|k| axis.at(k).abs())
                .fold(1.0, f64::min);
            assert!(nearest < 1e-12 * axis.step.max(1.0), "{axis:?}");
        }
        assert_eq!(Axis::new([-1.0, 1.0], 11, None).count, 11);
    }

    /// Quadratic in the plain axes with a mixed term; the periodic axis is left out of it.
    #[test]
    fn quadratics_and_their_gradients_are_exact() {
        let lattice = lattice();
        let f = |s: &[f64]| 1.0 + 2.0 * s[0] * s[0] - 0.5 * s[0] * s[1] + s[1] * s[1] + 0.3 * s[1];
        let values: Vec<f64> = (0..lattice.len()).map(|k| f(&lattice.node(k))).collect();
        // Rounding of terms of size 10, divided by a step of 0.25.
        const ROUNDING: f64 = 1e-12;
        for s in [[0.61, -1.3, 0.4], [-0.93, 0.77, 1.49], [0.2, 0.9, -7.3]] {
            let cell = lattice.locate::<3>(&s).expect("inside");
            assert!((interpolate(&values, &cell, f64::INFINITY) - f(&s)).abs() < ROUNDING);
            assert!((interpolate(&values, &cell, f64::NEG_INFINITY) - f(&s)).abs() > 1e-4);
            let p = slope(&lattice, &values, &cell, f64::INFINITY);
            assert!((p[0] - (4.0 * s[0] - 0.5 * s[1])).abs() < ROUNDING);
            assert!((p[1] - (2.0 * s[1] - 0.5 * s[0] + 0.3)).abs() < ROUNDING);
            assert_eq!(p[2], 0.0);
        }
    }

    #[test]
    fn periodic_axes_wrap_and_others_end() {
        let lattice = lattice();
        let values: Vec<f64> = (0..lattice.len())
            .map(|k| (lattice.node(k)[2] * std::f64::consts::TAU / 3.0).cos())
            .collect();
        let at = |z: f64| {
            let cell = lattice.locate::<3>(&[0.0, 0.0, z]).expect("inside");
            interpolate(&values, &cell, f64::INFINITY)
        };
        assert!((at(0.31) - at(0.31 + 3.0)).abs() < 1e-12);
        assert!((at(1.49) - at(1.49 - 9.0)).abs() < 1e-12);
        assert!(lattice.locate::<3>(&[1.1, 0.0, 0.0]).is_none());
        assert!(lattice.locate::<3>(&[f64::NAN, 0.0, 0.0]).is_none());
        let last = lattice.len() - 1;
        assert_eq!(lattice.neighbour(last, 2, true), last - 11);
        assert_eq!(lattice.neighbour(last, 0, true), last);
    }
}
