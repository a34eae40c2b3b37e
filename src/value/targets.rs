//! Chosen states, and who is whose neighbour among them.

use super::nearest;

/// States to be solved for. Duplicates are solved once, and everything is done in an order that
/// depends on the states alone, so that results do not depend on the order in which they are given.
#[derive(Clone, Debug, Default)]
pub struct Targets {
    pub states: usize,
    /// Distinct states `[target][n]`, absolute, in lexicographic order.
    pub x: Vec<f64>,
    /// Target of each state as given.
    pub of_given: Vec<usize>,
    /// Pairs of neighbours, lower target first, sorted.
    pub edges: Vec<(usize, usize)>,
    /// V above which a target is of no interest, each.
    pub limits: Vec<f64>,
    /// Which of the targets belong to a grid.
    pub gridded: Vec<bool>,
    /// Rectangles of four neighbours `[corner; 4]`, counterclockwise, where the states form a grid
    /// in two of them.
    pub cells: Vec<[usize; 4]>,
}

/// A regular grid: the values along each state's axis, at least one each.
#[derive(Clone, Debug, PartialEq)]
pub struct Grid {
    pub axes: Vec<Vec<f64>>,
}

impl Grid {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.axes.iter().map(Vec::len).product()
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The points, the last state fastest.
    pub fn points(&self) -> Vec<f64> {
        let n = self.axes.len();
        let mut points = Vec::with_capacity(self.len() * n);
        let mut at = vec![0; n];
        for _ in 0..self.len() {
            points.extend(at.iter().zip(&self.axes).map(|(k, axis)| axis[*k]));
            for i in (0..n).rev() {
                at[i] += 1;
                if at[i] < self.axes[i].len() {
                    break;
                }
                at[i] = 0;
            }
        }
        points
    }

    /// Distance in the numbering between neighbours along each axis.
    fn strides(&self) -> Vec<usize> {
        let mut strides = vec![1; self.axes.len()];
        for i in (0..self.axes.len() - 1).rev() {
            strides[i] = strides[i + 1] * self.axes[i + 1].len();
        }
        strides
    }

    /// Neighbours along the axes, as pairs of the grid's numbering.
    fn edges(&self) -> Vec<(usize, usize)> {
        let strides = self.strides();
        let mut edges = Vec::new();
        for k in 0..self.len() {
            for (axis, stride) in self.axes.iter().zip(&strides) {
                if (k / stride) % axis.len() + 1 < axis.len() {
                    edges.push((k, k + stride));
                }
            }
        }
        edges
    }

    /// Rectangles of a grid with exactly two axes of more than one value.
    fn cells(&self) -> Vec<[usize; 4]> {
        let strides = self.strides();
        let long: Vec<usize> = (0..self.axes.len())
            .filter(|i| self.axes[*i].len() > 1)
            .collect();
        let [a, b] = long[..] else {
            return Vec::new();
        };
        let (sa, sb) = (strides[a], strides[b]);
        let mut cells = Vec::new();
        for i in 0..self.axes[a].len() - 1 {
            for j in 0..self.axes[b].len() - 1 {
                let k = i * sa + j * sb;
                cells.push([k, k + sa, k + sa + sb, k + sb]);
            }
        }
        cells
    }
}

impl Targets {
    /// Targets at the points of grids and at single states `[point][n]`, given in this order.
    /// `widths` measure distances.
    ///
    /// A target's limit is the highest of the states that it stands for: `limits` has one a grid;
    /// single states have none.
    pub fn new(
        states: usize,
        grids: &[Grid],
        limits: &[f64],
        singles: &[f64],
        widths: &[f64],
    ) -> Self {
        let mut given: Vec<f64> = grids.iter().flat_map(Grid::points).collect();
        let gridded = given.len() / states;
        given.extend_from_slice(singles);
        let count = given.len() / states;
        let row = |k: usize| &given[k * states..][..states];
        let compare = |a: &usize, b: &usize| {
            let (a, b) = (row(*a), row(*b));
            a.iter()
                .zip(b)
                .map(|(x, y)| x.total_cmp(y))
                .find(|o| o.is_ne())
                .unwrap_or(std::cmp::Ordering::Equal)
        };
        let mut order: Vec<usize> = (0..count).collect();
        order.sort_by(compare);
        let mut this = Self {
            states,
            of_given: vec![0; count],
            ..Self::default()
        };
        for (k, &g) in order.iter().enumerate() {
            if k == 0 || compare(&order[k - 1], &g).is_ne() {
                this.x.extend_from_slice(row(g));
            }
            this.of_given[g] = this.len() - 1;
        }
        this.limits = vec![f64::NEG_INFINITY; this.len()];
        let of_grids =
            (grids.iter().zip(limits)).flat_map(|(g, limit)| std::iter::repeat_n(*limit, g.len()));
        for (k, limit) in of_grids
            .chain(std::iter::repeat(f64::INFINITY))
            .take(count)
            .enumerate()
        {
            let target = this.of_given[k];
            this.limits[target] = this.limits[target].max(limit);
        }
        this.gridded = vec![false; this.len()];
        for k in 0..gridded {
            this.gridded[this.of_given[k]] = true;
        }
        let mut first = 0;
        let mut before: Vec<usize> = Vec::new();
        for grid in grids {
            let at = |k: usize| this.of_given[first + k];
            let edges: Vec<_> = grid
                .edges()
                .into_iter()
                .map(|(a, b)| (at(a), at(b)))
                .collect();
            let cells: Vec<_> = grid.cells().into_iter().map(|c| c.map(at)).collect();
            let own: Vec<usize> = (0..grid.len()).map(at).collect();
            this.edges.extend(edges);
            this.cells.extend(cells);
            this.join_sets(&before, &own, widths);
            before.extend(own);
            first += grid.len();
        }
        let singles: Vec<usize> = (gridded..count).map(|k| this.of_given[k]).collect();
        this.join_nearest(&singles, widths);
        this.edges = (this.edges.iter())
            .filter(|(a, b)| a != b)
            .map(|(a, b)| (*a.min(b), *a.max(b)))
            .collect();
        this.edges.sort_unstable();
        this.edges.dedup();
        this.join_parts(widths);
        this
    }

    pub fn len(&self) -> usize {
        self.x.len() / self.states.max(1)
    }

    pub fn is_empty(&self) -> bool {
        self.x.is_empty()
    }

    pub fn state(&self, target: usize) -> &[f64] {
        &self.x[target * self.states..][..self.states]
    }

    fn scaled(&self, widths: &[f64]) -> Vec<f64> {
        self.x
            .chunks(self.states)
            .flat_map(|x| x.iter().zip(widths).map(|(x, w)| x / w))
            .collect()
    }

    /// Joins two sets: each target of the smaller one with the nearest of the larger one.
    fn join_sets(&mut self, a: &[usize], b: &[usize], widths: &[f64]) {
        let (few, many) = if a.len() < b.len() { (a, b) } else { (b, a) };
        if few.is_empty() {
            return;
        }
        let scaled = |t: usize| -> Vec<f64> {
            self.state(t)
                .iter()
                .zip(widths)
                .map(|(x, w)| x / w)
                .collect()
        };
        let places: Vec<f64> = many.iter().flat_map(|t| scaled(*t)).collect();
        let tree = nearest::index(&places, self.states);
        let edges: Vec<(usize, usize)> = (few.iter())
            .flat_map(|t| {
                tree.near(&scaled(*t), 0.0, 1)
                    .into_iter()
                    .map(|(k, _)| (*t, many[k]))
            })
            .collect();
        self.edges.extend(edges);
    }

    /// Joins each of some targets with those nearest to it.
    fn join_nearest(&mut self, loose: &[usize], widths: &[f64]) {
        if loose.is_empty() || self.len() < 2 {
            return;
        }
        let scaled = self.scaled(widths);
        let tree = nearest::index(&scaled, self.states);
        for &a in loose {
            let place = &scaled[a * self.states..][..self.states];
            let near = tree.near(place, f64::INFINITY, self.states + 2);
            self.edges
                .extend(near.iter().map(|(b, _)| (a, *b)).filter(|(a, b)| a != b));
        }
    }

    /// Joins parts that no edge connects, each with the one before it, by a short edge.
    fn join_parts(&mut self, widths: &[f64]) {
        let mut parts = Groups::new(self.len());
        for &(a, b) in &self.edges {
            parts.join(a, b);
        }
        let mut seen: Vec<usize> = Vec::new();
        let mut extra = Vec::new();
        let distance = |a: usize, b: usize| -> f64 {
            let (a, b) = (self.state(a), self.state(b));
            (0..self.states)
                .map(|i| ((a[i] - b[i]) / widths[i]).powi(2))
                .sum()
        };
        for t in 0..self.len() {
            let root = parts.root(t);
            if !seen.contains(&root) {
                // The nearest of the targets shortly before it in order.
                let from = t.saturating_sub(64);
                if let Some(b) =
                    (from..t).min_by(|a, b| distance(*a, t).total_cmp(&distance(*b, t)))
                {
                    extra.push((b, t));
                }
                seen.push(root);
            }
        }
        self.edges.extend(extra);
        self.edges.sort_unstable();
    }

    /// Neighbours of each target, in order.
    pub fn neighbours(&self) -> Vec<Vec<usize>> {
        let mut list = vec![Vec::new(); self.len()];
        for &(a, b) in &self.edges {
            list[a].push(b);
            list[b].push(a);
        }
        list
    }
}

/// Disjoint groups that can be joined; a group's root is its lowest member.
#[derive(Clone, Debug, Default)]
pub struct Groups {
    parent: Vec<usize>,
}

impl Groups {
    pub fn new(count: usize) -> Self {
        Self {
            parent: (0..count).collect(),
        }
    }

    /// A further member in a group of its own.
    pub fn push(&mut self) {
        self.parent.push(self.parent.len());
    }

    pub fn root(&mut self, mut a: usize) -> usize {
        while self.parent[a] != a {
            self.parent[a] = self.parent[self.parent[a]];
            a = self.parent[a];
        }
        a
    }

    /// True when they were apart.
    pub fn join(&mut self, a: usize, b: usize) -> bool {
        let (a, b) = (self.root(a), self.root(b));
        self.parent[a.max(b)] = a.min(b);
        a != b
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grid_has_its_points_edges_and_cells() {
        let grid = Grid {
            axes: vec![vec![0.0, 1.0, 2.0], vec![5.0], vec![0.0, 1.0]],
        };
        assert_eq!(grid.points()[..6], [0.0, 5.0, 0.0, 0.0, 5.0, 1.0]);
        let targets = Targets::new(3, &[grid], &[f64::INFINITY], &[], &[1.0; 3]);
        assert_eq!(
            (targets.len(), targets.edges.len(), targets.cells.len()),
            (6, 7, 2)
        );
    }

    #[test]
    fn order_and_duplicates_do_not_matter() {
        let a = Targets::new(
            2,
            &[],
            &[],
            &[0.0, 1.0, 2.0, 3.0, 0.5, 0.5, 2.0, 3.0],
            &[1.0, 1.0],
        );
        let b = Targets::new(2, &[], &[], &[2.0, 3.0, 0.5, 0.5, 0.0, 1.0], &[1.0, 1.0]);
        assert_eq!(a.x, b.x);
        assert_eq!(a.edges, b.edges);
        assert_eq!(a.len(), 3);
        assert_eq!(a.of_given[1], a.of_given[3]);
        assert_eq!(a.state(a.of_given[2]), [0.5, 0.5]);
    }

    #[test]
    fn all_parts_are_joined() {
        let mut points = Vec::new();
        for k in 0..10 {
            points.extend([f64::from(k) * 0.01, 0.0, 100.0 + f64::from(k) * 0.01, 0.0]);
        }
        let targets = Targets::new(2, &[], &[], &points, &[1.0, 1.0]);
        let mut groups = Groups::new(targets.len());
        let joins = targets
            .edges
            .iter()
            .filter(|(a, b)| groups.join(*a, *b))
            .count();
        assert_eq!(joins, targets.len() - 1);
    }
}
