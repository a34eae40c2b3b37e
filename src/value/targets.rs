//! Chosen states, and who is whose neighbour among them.

use super::nearest;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

/// States to be solved for. Duplicates are solved once, and everything is done in an order that
/// depends on the states alone, so that results do not depend on the order in which they are given.
#[derive(Clone, Debug, Default)]
pub struct Targets {
    pub states: usize,
    /// Distinct states `[target][n]`, absolute, in lexicographic order.
    pub x: Vec<f64>,
    /// Target of each state as given.
    pub of_given: Vec<usize>,
    /// The number of each of these states among all that were given: of a part not all are here.
    pub rows: Vec<usize>,
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

    /// The neighbours after a point along the axes, as pairs of the grid's numbering.
    pub fn edges_from(&self, k: usize) -> impl Iterator<Item = (usize, usize)> {
        (self.axes.iter().zip(self.strides()))
            .filter(move |(axis, stride)| (k / stride) % axis.len() + 1 < axis.len())
            .map(move |(_, stride)| (k, k + stride))
    }

    /// The neighbours of a point along the axes.
    pub fn beside(&self, k: usize) -> impl Iterator<Item = usize> {
        (self.axes.iter().zip(self.strides())).flat_map(move |(axis, stride)| {
            let place = (k / stride) % axis.len();
            let before = (place > 0).then(|| k - stride);
            before
                .into_iter()
                .chain((place + 1 < axis.len()).then(|| k + stride))
        })
    }

    /// A point by its number.
    pub fn point(&self, k: usize) -> Vec<f64> {
        (self.axes.iter().zip(self.strides()))
            .map(|(axis, stride)| axis[(k / stride) % axis.len()])
            .collect()
    }

    /// The number of a point, if it is one of the grid's.
    pub fn find(&self, x: &[f64]) -> Option<usize> {
        let mut k = 0;
        for ((axis, stride), x) in self.axes.iter().zip(self.strides()).zip(x) {
            k += stride * axis.iter().position(|value| value.total_cmp(x).is_eq())?;
        }
        Some(k)
    }

    /// The rectangle that begins at a point of a grid with exactly two axes of more than one value.
    pub fn cell_from(&self, k: usize) -> Option<[usize; 4]> {
        let strides = self.strides();
        let long: Vec<usize> = (0..self.axes.len())
            .filter(|i| self.axes[*i].len() > 1)
            .collect();
        let [a, b] = long[..] else {
            return None;
        };
        let (sa, sb) = (strides[a], strides[b]);
        let inside = |i: usize| (k / strides[i]) % self.axes[i].len() + 1 < self.axes[i].len();
        (inside(a) && inside(b)).then(|| [k, k + sa, k + sa + sb, k + sb])
    }
}

/// All states of a request, each once, before it is known who is whose neighbour.
pub struct Whole<'g> {
    grids: &'g [Grid],
    targets: Targets,
    /// The states given of each target: those of a target, and where the next one's begin.
    given: Vec<u32>,
    first: Vec<u32>,
    /// States given that belong to grids: the first ones.
    gridded: usize,
}

impl<'g> Whole<'g> {
    /// As [`Targets::new`] takes them.
    pub fn new(states: usize, grids: &'g [Grid], limits: &[f64], singles: &[f64]) -> Self {
        let mut given: Vec<f64> = grids.iter().flat_map(Grid::points).collect();
        let gridded = given.len() / states;
        given.extend_from_slice(singles);
        let count = given.len() / states;
        let row = |k: usize| &given[k * states..][..states];
        let mut order: Vec<u32> = (0..count as u32).collect();
        order.par_sort_by(|a, b| compare(row(*a as usize), row(*b as usize)));
        let mut targets = Targets {
            states,
            of_given: vec![0; count],
            rows: (0..count).collect(),
            ..Targets::default()
        };
        let mut first = Vec::new();
        for (k, &g) in order.iter().enumerate() {
            let here = row(g as usize);
            if k == 0 || compare(row(order[k - 1] as usize), here).is_ne() {
                targets.x.extend_from_slice(here);
                first.push(k as u32);
            }
            targets.of_given[g as usize] = targets.len() - 1;
        }
        first.push(count as u32);
        targets.limits = vec![f64::NEG_INFINITY; targets.len()];
        let of_grids =
            (grids.iter().zip(limits)).flat_map(|(g, limit)| std::iter::repeat_n(*limit, g.len()));
        for (k, limit) in of_grids
            .chain(std::iter::repeat(f64::INFINITY))
            .take(count)
            .enumerate()
        {
            let target = targets.of_given[k];
            targets.limits[target] = targets.limits[target].max(limit);
        }
        targets.gridded = vec![false; targets.len()];
        for k in 0..gridded {
            targets.gridded[targets.of_given[k]] = true;
        }
        Self {
            grids,
            targets,
            given: order,
            first,
            gridded,
        }
    }

    /// The states `[target][n]`, in lexicographic order.
    pub fn x(&self) -> &[f64] {
        &self.targets.x
    }

    /// The target of a state given.
    pub fn target(&self, row: usize) -> usize {
        self.targets.of_given[row]
    }

    /// How many states were given for grids, and in all.
    pub fn rows_on_grids(&self) -> usize {
        self.gridded
    }

    /// See [`rows_on_grids`](Self::rows_on_grids).
    pub fn rows_in_all(&self) -> usize {
        self.given.len()
    }

    /// The states given of a target, in rising order.
    pub fn rows(&self, target: usize) -> &[u32] {
        &self.given[self.first[target] as usize..self.first[target + 1] as usize]
    }

    /// Some of the targets, by rising number, without their neighbours.
    pub fn some(&self, members: &[usize]) -> Targets {
        let all = &self.targets;
        let mut rows: Vec<(usize, usize)> = (members.iter().enumerate())
            .flat_map(|(local, t)| self.rows(*t).iter().map(move |g| (*g as usize, local)))
            .collect();
        rows.sort_unstable();
        Targets {
            states: all.states,
            x: (members.iter())
                .flat_map(|t| all.state(*t).iter().copied())
                .collect(),
            of_given: rows.iter().map(|(_, local)| *local).collect(),
            rows: rows.iter().map(|(row, _)| *row).collect(),
            limits: members.iter().map(|t| all.limits[*t]).collect(),
            gridded: members.iter().map(|t| all.gridded[*t]).collect(),
            ..Targets::default()
        }
    }

    /// Some of the targets, by rising number, as if there were no others.
    pub fn part(&self, members: &[usize], widths: &[f64]) -> Targets {
        let mut this = self.some(members);
        let on_grids = this.rows.partition_point(|row| *row < self.gridded);
        let at: FxHashMap<usize, usize> = (this.rows.iter().copied())
            .zip(this.of_given.iter().copied())
            .take(on_grids)
            .collect();
        let (mut first, mut begin) = (0, 0);
        let mut before: Vec<usize> = Vec::new();
        for grid in self.grids {
            let end = first + grid.len();
            let count = this.rows[begin..on_grids].partition_point(|row| *row < end);
            let nodes: Vec<usize> = (this.rows[begin..begin + count].iter())
                .map(|row| row - first)
                .collect();
            let node = |k: usize| at.get(&(first + k)).copied();
            let edges = nodes.iter().flat_map(|k| grid.edges_from(*k));
            let edges: Vec<_> = edges.filter_map(|(a, b)| node(a).zip(node(b))).collect();
            let cells = nodes.iter().filter_map(|k| grid.cell_from(*k));
            let cells: Vec<_> = cells
                .filter_map(|cell| {
                    let [a, b, c, d] = cell.map(node);
                    Some([a?, b?, c?, d?])
                })
                .collect();
            let own = this.of_given[begin..begin + count].to_vec();
            this.edges.extend(edges);
            this.cells.extend(cells);
            this.join_sets(&before, &own, widths);
            before.extend(own);
            (first, begin) = (end, begin + count);
        }
        let singles = this.of_given[on_grids..].to_vec();
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
}

/// How many of the states nearest to a single one, itself included, are looked at as its
/// neighbours.
pub fn neighbours_at_once(states: usize) -> usize {
    states + 2
}

/// States in lexicographic order.
pub fn compare(a: &[f64], b: &[f64]) -> std::cmp::Ordering {
    (a.iter().zip(b))
        .map(|(x, y)| x.total_cmp(y))
        .find(|o| o.is_ne())
        .unwrap_or(std::cmp::Ordering::Equal)
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
        let whole = Whole::new(states, grids, limits, singles);
        let all: Vec<usize> = (0..whole.targets.len()).collect();
        whole.part(&all, widths)
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

    pub fn scaled(&self, widths: &[f64]) -> Vec<f64> {
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
            let near = tree.near(place, f64::INFINITY, neighbours_at_once(self.states));
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
