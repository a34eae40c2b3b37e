//! V over a plane of two states, made from what is known at the points of a grid.

use costate::low_level::map::{Value, ValueMap};
use costate::low_level::trajectories::{SolvedGrid, SolvedStates};
use rayon::prelude::*;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// What is known of the value function at a state.
#[derive(Clone, Debug, PartialEq)]
pub struct Local {
    pub v: f64,
    pub u: Vec<f64>,
    pub sheet: i32,
}

/// The value function at any state that the data reach.
pub trait Field: Sync {
    fn at(&self, x: &[f64]) -> Option<Local>;
}

/// Nothing is told in a cell whose corners contradict each other by more than this share of their
/// mean V. (Of the compressor V is then wrong by 6 % of it at most; where corners contradict each
/// other less, by as much less.)
const CONTRADICTION: f64 = 1.0;

/// A regular grid of solutions, one axis a state; an axis of one value holds only there.
///
/// Between points, V is the polynomial of the cell's corners with their V and p that is exact for a
/// cubic V (of two axes Adini's element). In a cell whose corners are on several sheets each sheet
/// continues by its own corners' `V_i + p_i . (x - x_i)`, and the cheapest counts: nothing is mixed
/// across sheets. Where V and p of corners contradict each other, nothing is known: V is too steep
/// there for the grid.
#[derive(Clone, Debug)]
pub struct GridField {
    pub axes: Vec<Vec<f64>>,
    v: Vec<f64>,
    p: Vec<f64>,
    u: Vec<f64>,
    sheet: Vec<i32>,
    controls: usize,
}

impl GridField {
    /// From `/map`. Points that are in `above` (or nothing is) have no value because V is above
    /// `limit`: next to known ones they are given one, at least the limit, so that regions up to
    /// the limit end where V passes it.
    pub fn of_map(map: &SolvedGrid, controls: usize, above: &[bool], limit: f64) -> Self {
        let mut field = Self {
            axes: map.axes.clone(),
            v: map.v.clone(),
            p: map.p.clone(),
            u: map.u.clone(),
            sheet: map.sheet.clone(),
            controls,
        };
        // Twice: corners of the grid's cells are reached by way of their neighbours.
        for _ in 0..2 {
            field.extend(above, limit);
        }
        field
    }

    /// From what a value map says at `count` x `count` states of a plane of the region; V above
    /// `limit` is left out, as what it foretells beyond its data. None of the states known: no
    /// field.
    pub fn of_value_map(
        map: &ValueMap,
        axes: [usize; 2],
        base: &[f64],
        region: &[[f64; 2]],
        count: usize,
        limit: f64,
    ) -> Option<Self> {
        let n = base.len();
        let along = |k: usize| {
            if axes.contains(&k) {
                even(region[k], count)
            } else {
                vec![base[k]]
            }
        };
        let mut field = Self {
            axes: (0..n).map(along).collect(),
            v: Vec::new(),
            p: Vec::new(),
            u: Vec::new(),
            sheet: Vec::new(),
            controls: 0,
        };
        let total: usize = field.axes.iter().map(Vec::len).product();
        let states: Vec<f64> = (0..total).flat_map(|k| field.state(k)).collect();
        let all = map.at_many(&states, false);
        let found: Vec<Option<Value>> = all.into_iter().map(|at| at.lowest.ok()).collect();
        field.controls = found.iter().flatten().next()?.u.len();
        let mut above = Vec::with_capacity(total);
        for value in found {
            let over = value.as_ref().is_some_and(|v| v.v > limit);
            above.push(over);
            match value.filter(|_| !over) {
                Some(value) => {
                    field.v.push(value.v);
                    field.p.extend(value.p);
                    field.u.extend(value.u);
                    field.sheet.push(value.sheet);
                }
                None => {
                    field.v.push(f64::NAN);
                    field.p.extend(vec![f64::NAN; n]);
                    field.u.extend(vec![f64::NAN; field.controls]);
                    field.sheet.push(-1);
                }
            }
        }
        field.label();
        field.extend(&above, limit);
        field.extend(&above, limit);
        field.close();
        Some(field)
    }

    /// Gives solutions without a label, as those next to the equilibrium, that of a neighbour,
    /// first those whose V and p agree best with its; or that of all others, where these have but
    /// one.
    fn label(&mut self) {
        let mut offers = BinaryHeap::new();
        // Contradictions are not negative: their bits are in their order.
        let offer = |field: &Self, offers: &mut BinaryHeap<_>, from: usize| {
            let open = field.beside(from).into_iter();
            for k in open.filter(|k| field.sheet[*k] < 0 && field.v[*k].is_finite()) {
                let off = field.contradiction(&[(k, 0.0), (from, 0.0)]);
                offers.push(Reverse((off.to_bits(), k, field.sheet[from])));
            }
        };
        for k in (0..self.v.len()).filter(|k| self.sheet[*k] >= 0 && self.v[*k].is_finite()) {
            offer(self, &mut offers, k);
        }
        while let Some(Reverse((_, k, sheet))) = offers.pop() {
            if self.sheet[k] < 0 {
                self.sheet[k] = sheet;
                offer(self, &mut offers, k);
            }
        }
        let mut labels: Vec<i32> = self.sheet.iter().copied().filter(|s| *s >= 0).collect();
        labels.sort_unstable();
        labels.dedup();
        if let [one] = labels.as_slice() {
            self.sheet.fill(*one);
        }
    }

    /// The points next to one along the axes.
    fn beside(&self, k: usize) -> Vec<usize> {
        let (mut stride, mut all) = (1, Vec::new());
        for axis in self.axes.iter().rev() {
            let place = k / stride % axis.len();
            all.extend((place > 0).then(|| k - stride));
            all.extend((place + 1 < axis.len()).then(|| k + stride));
            stride *= axis.len();
        }
        all
    }

    /// Gives single unknown points amid known ones the values that their neighbours foretell.
    fn close(&mut self) {
        let known = |k: usize| self.v[k].is_finite();
        let mut new = Vec::new();
        for k in (0..self.v.len()).filter(|k| !known(*k)) {
            let beside = self.beside(k);
            let around = beside.iter().filter(|j| known(**j)).count();
            let unknown = beside.len() - around;
            if around >= 2
                && unknown <= 1
                && let Some(value) = self.extrapolated(k)
            {
                new.push((k, value));
            }
        }
        for (k, (v, p, from)) in new {
            self.set(k, v, &p, from);
        }
    }

    /// Gives points that are known to be, or extrapolated to be, above the limit and are next to
    /// known ones the values that their nearest neighbours' p and its change foretell.
    fn extend(&mut self, above: &[bool], limit: f64) {
        let mut new = Vec::new();
        for k in (0..self.v.len()).filter(|k| self.v[*k].is_nan()) {
            let known_above = above.get(k).copied().unwrap_or(false);
            match self.extrapolated(k) {
                Some((v, p, from)) if known_above => {
                    new.push((k, v.max(limit * (1.0 + 1e-9)), p, from))
                }
                Some((v, p, from)) if v >= limit => new.push((k, v, p, from)),
                _ => {}
            }
        }
        for (k, v, p, from) in new {
            self.set(k, v, &p, from);
        }
    }

    /// Sets a point's V and p, the rest as at another one.
    fn set(&mut self, k: usize, v: f64, p: &[f64], from: usize) {
        let (n, m) = (self.axes.len(), self.controls);
        self.v[k] = v;
        self.p[k * n..(k + 1) * n].copy_from_slice(p);
        self.u.copy_within(from * m..(from + 1) * m, k * m);
        self.sheet[k] = self.sheet[from];
    }

    /// V and p at a point from two known ones of one sheet in a row next to it, where V is least;
    /// and the nearer of these.
    fn extrapolated(&self, k: usize) -> Option<(f64, Vec<f64>, usize)> {
        let n = self.axes.len();
        let mut stride = 1;
        let mut best: Option<(f64, Vec<f64>, usize)> = None;
        for d in (0..n).rev() {
            let count = self.axes[d].len();
            let place = k / stride % count;
            for up in [false, true] {
                let inside = if up { place + 2 < count } else { place >= 2 };
                if !inside {
                    continue;
                }
                let step = |by: usize| if up { k + by * stride } else { k - by * stride };
                let at = |by: usize| self.axes[d][if up { place + by } else { place - by }];
                let (near, far) = (step(1), step(2));
                if !self.v[near].is_finite()
                    || !self.v[far].is_finite()
                    || self.sheet[near] != self.sheet[far]
                {
                    continue;
                }
                let (h, before) = (at(0) - at(1), at(1) - at(2));
                let p: Vec<f64> = (0..n)
                    .map(|i| {
                        let (a, b) = (self.p[near * n + i], self.p[far * n + i]);
                        a + (a - b) * h / before
                    })
                    .collect();
                let v = self.v[near] + 0.5 * h * (self.p[near * n + d] + p[d]);
                if best.as_ref().is_none_or(|(least, ..)| v < *least) {
                    best = Some((v, p, near));
                }
            }
            stride *= count;
        }
        best
    }

    /// From `/points`, where these are all points of a grid, each once.
    pub fn of_points(points: &SolvedStates, states: usize, controls: usize) -> Option<Self> {
        let mut axes: Vec<Vec<f64>> = (0..states)
            .map(|k| points.x.iter().skip(k).step_by(states).copied().collect())
            .collect();
        for axis in &mut axes {
            axis.sort_by(f64::total_cmp);
            axis.dedup();
        }
        let count: usize = axes.iter().map(Vec::len).product();
        if count != points.count || count < 2 {
            return None;
        }
        let mut order = vec![usize::MAX; count];
        for (k, x) in points.x.chunks(states).enumerate() {
            let mut place = 0;
            for (axis, x) in axes.iter().zip(x) {
                place = place * axis.len() + axis.binary_search_by(|a| a.total_cmp(x)).ok()?;
            }
            order[place] = k;
        }
        if order.contains(&usize::MAX) {
            return None;
        }
        let rows = |values: &[f64], width: usize| -> Vec<f64> {
            order
                .iter()
                .flat_map(|k| values[k * width..(k + 1) * width].to_vec())
                .collect()
        };
        Some(Self {
            v: rows(&points.v, 1),
            p: rows(&points.p, states),
            u: rows(&points.u, controls),
            sheet: order.iter().map(|k| points.sheet[*k]).collect(),
            axes,
            controls,
        })
    }

    /// The largest size of V at its points.
    pub fn largest(&self) -> f64 {
        self.v
            .iter()
            .filter(|v| v.is_finite())
            .fold(0.0, |a, v| a.max(v.abs()))
    }

    /// The value of an axis that has but one.
    pub fn fixed(&self, k: usize) -> Option<f64> {
        match self.axes[k].as_slice() {
            [one] => Some(*one),
            _ => None,
        }
    }

    /// States along which it extends.
    pub fn extent(&self) -> Vec<usize> {
        (0..self.axes.len())
            .filter(|k| self.axes[*k].len() > 1)
            .collect()
    }

    /// The corners of the cell around `x` and their weights.
    fn corners(&self, x: &[f64]) -> Option<Vec<(usize, f64)>> {
        let mut corners = vec![(0usize, 1.0f64)];
        for (axis, &x) in self.axes.iter().zip(x) {
            let (first, last) = (*axis.first()?, *axis.last()?);
            let slack = 1e-9 * (last - first).abs().max(first.abs()).max(1e-9);
            if x < first - slack || x > last + slack {
                return None;
            }
            let above = axis
                .partition_point(|a| *a <= x)
                .clamp(1, axis.len().max(2) - 1);
            let ends: Vec<(usize, f64)> = match axis.get(above) {
                Some(next) => {
                    let s = ((x - axis[above - 1]) / (next - axis[above - 1])).clamp(0.0, 1.0);
                    vec![(above - 1, 1.0 - s), (above, s)]
                }
                None => vec![(0, 1.0)],
            };
            corners = (corners.iter())
                .flat_map(|(place, w)| {
                    ends.iter()
                        .map(move |(k, s)| (place * axis.len() + k, w * s))
                })
                .filter(|(_, w)| *w > 0.0)
                .collect();
        }
        Some(corners)
    }

    /// The state of a point.
    fn state(&self, mut place: usize) -> Vec<f64> {
        let mut x = vec![0.0; self.axes.len()];
        for (k, axis) in self.axes.iter().enumerate().rev() {
            x[k] = axis[place % axis.len()];
            place /= axis.len();
        }
        x
    }

    /// By how much V and p of a sheet's corners contradict each other: not at all for a quadratic
    /// V.
    fn contradiction(&self, corners: &[(usize, f64)]) -> f64 {
        let n = self.axes.len();
        let pairs = (corners.iter().enumerate())
            .flat_map(|(k, (a, _))| corners[..k].iter().map(move |(b, _)| (*a, *b)));
        let by = |(a, b): (usize, usize)| {
            let (from, to) = (self.state(a), self.state(b));
            let extrapolated: f64 = (0..n)
                .map(|i| 0.5 * (self.p[a * n + i] + self.p[b * n + i]) * (to[i] - from[i]))
                .sum();
            (self.v[b] - self.v[a] - extrapolated).abs()
        };
        pairs.map(by).fold(0.0, f64::max)
    }

    /// V of one sheet where it is not all of a cell's corners': the mean of what they say, each by
    /// its own p.
    fn tangents(&self, x: &[f64], corners: &[(usize, f64)]) -> f64 {
        let n = self.axes.len();
        let (mut total, mut weight) = (0.0, 0.0);
        for (k, w) in corners {
            let from = self.state(*k);
            let along: f64 = (0..n).map(|i| self.p[k * n + i] * (x[i] - from[i])).sum();
            total += w * (self.v[*k] + along);
            weight += w;
        }
        total / weight
    }

    /// V from the corners around a place and their shares `w`, the products of `1 - s_i` with the
    /// distance `s_i` from the corner in units of the cell: `sum w (V (1 + sum s_i (1 - 2 s_i)) +
    /// sum p_i h_i s_i (1 - s_i))`.
    fn cubic(&self, x: &[f64], corners: &[(usize, f64)]) -> f64 {
        let n = self.axes.len();
        let states: Vec<Vec<f64>> = corners.iter().map(|(k, _)| self.state(*k)).collect();
        let size = |i: usize| {
            let ends = states.iter().map(|s| s[i]);
            let (least, most) = ends.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), x| {
                (a.min(x), b.max(x))
            });
            most - least
        };
        let sizes: Vec<f64> = (0..n).map(size).collect();
        let of_corner = |((k, w), from): (&(usize, f64), &Vec<f64>)| {
            let (mut share, mut slopes) = (1.0, 0.0);
            for i in (0..n).filter(|i| sizes[*i] > 0.0) {
                let s = ((x[i] - from[i]) / sizes[i]).abs();
                share += s * (1.0 - 2.0 * s);
                slopes += self.p[k * n + i] * (x[i] - from[i]) * (1.0 - s);
            }
            w * (self.v[*k] * share + slopes)
        };
        corners.iter().zip(&states).map(of_corner).sum()
    }
}

impl Field for GridField {
    fn at(&self, x: &[f64]) -> Option<Local> {
        let corners = self.corners(x)?;
        if corners.iter().any(|(k, _)| !self.v[*k].is_finite()) {
            return None;
        }
        let mut sheets: Vec<i32> = corners.iter().map(|(k, _)| self.sheet[*k]).collect();
        sheets.sort_unstable();
        sheets.dedup();
        let best = (sheets.iter())
            .map(|sheet| {
                let own: Vec<_> = (corners.iter())
                    .filter(|(k, _)| self.sheet[*k] == *sheet)
                    .copied()
                    .collect();
                let v = if sheets.len() == 1 {
                    self.cubic(x, &own)
                } else {
                    self.tangents(x, &own)
                };
                (v, *sheet, own)
            })
            .min_by(|a, b| a.0.total_cmp(&b.0))?;
        let (v, sheet, own) = best;
        let mean = own.iter().map(|(k, _)| self.v[*k].abs()).sum::<f64>() / own.len() as f64;
        if self.contradiction(&own) > CONTRADICTION * mean {
            return None;
        }
        let weight: f64 = own.iter().map(|(_, w)| w).sum();
        let m = self.controls;
        let u = (0..m)
            .map(|c| own.iter().map(|(k, w)| w * self.u[k * m + c]).sum::<f64>() / weight)
            .collect();
        Some(Local { v, u, sheet })
    }
}

/// V over two states, the others fixed.
#[derive(Clone, Debug)]
pub struct Plane {
    /// The two states.
    pub axes: [usize; 2],
    pub x: Vec<f64>,
    pub y: Vec<f64>,
    /// `[i * y.len() + j]`; NaN where unknown. Likewise the others.
    pub v: Vec<f64>,
    pub u: Vec<Vec<f64>>,
    pub sheet: Vec<i32>,
    /// Cells whose corners are on different sheets.
    pub cut: Vec<bool>,
    /// The whole state, of which the two are replaced.
    pub base: Vec<f64>,
    /// V above this is not known.
    pub limit: f64,
    /// The map's bound of V's error at each point, in units of the error that it was asked for; NaN
    /// where that is not known. Empty where no error was asked for.
    pub excess: Vec<f64>,
}

impl Plane {
    /// A field over `x` x `y`; `None` where it has no value at all.
    pub fn new(
        field: &dyn Field,
        axes: [usize; 2],
        base: &[f64],
        x: Vec<f64>,
        y: Vec<f64>,
    ) -> Option<Self> {
        let row = |a: &f64| -> Vec<Option<Local>> {
            let mut state = base.to_vec();
            state[axes[0]] = *a;
            let at = |b: &f64| {
                state[axes[1]] = *b;
                field.at(&state)
            };
            y.iter().map(at).collect()
        };
        let found: Vec<Option<Local>> = x.par_iter().map(row).collect::<Vec<_>>().concat();
        let v = found
            .iter()
            .map(|l| l.as_ref().map_or(f64::NAN, |l| l.v))
            .collect();
        let sheet = found
            .iter()
            .map(|l| l.as_ref().map_or(-1, |l| l.sheet))
            .collect();
        let u = found
            .into_iter()
            .map(|l| l.map(|l| l.u).unwrap_or_default())
            .collect();
        let mut plane = Self {
            axes,
            x,
            y,
            v,
            u,
            sheet,
            cut: Vec::new(),
            base: base.to_vec(),
            limit: f64::INFINITY,
            excess: Vec::new(),
        };
        plane.cut = plane.cuts();
        plane.v.iter().any(|v| v.is_finite()).then_some(plane)
    }

    fn cuts(&self) -> Vec<bool> {
        let (nx, ny) = (self.x.len(), self.y.len());
        let mut cut = Vec::with_capacity(nx.saturating_sub(1) * ny.saturating_sub(1));
        for i in 0..nx.saturating_sub(1) {
            for j in 0..ny.saturating_sub(1) {
                let corners = [
                    i * ny + j,
                    (i + 1) * ny + j,
                    (i + 1) * ny + j + 1,
                    i * ny + j + 1,
                ];
                // What has no label goes with any.
                let mut labels = corners.iter().map(|k| self.sheet[*k]).filter(|s| *s >= 0);
                let first = labels.next();
                cut.push(labels.any(|s| Some(s) != first));
            }
        }
        cut
    }

    /// Control `k` at all points.
    pub fn control(&self, k: usize) -> Vec<f64> {
        self.u
            .iter()
            .map(|u| u.get(k).copied().unwrap_or(f64::NAN))
            .collect()
    }

    /// Sheets that are on it, ascending.
    pub fn sheets(&self) -> Vec<i32> {
        let mut all: Vec<i32> = (self.sheet.iter().zip(&self.v))
            .filter(|(s, v)| v.is_finite() && **s >= 0)
            .map(|(s, _)| *s)
            .collect();
        all.sort_unstable();
        all.dedup();
        all
    }
}

/// The points of an axis and as many between each two that there are about `wanted` in all.
pub fn refined(axis: &[f64], wanted: usize) -> Vec<f64> {
    let parts = (wanted / axis.len().max(1)).clamp(1, 16);
    let mut fine: Vec<f64> = axis
        .windows(2)
        .flat_map(|w| (0..parts).map(move |k| w[0] + (w[1] - w[0]) * k as f64 / parts as f64))
        .collect();
    fine.extend(axis.last());
    fine
}

/// `count` even places.
pub fn even([from, to]: [f64; 2], count: usize) -> Vec<f64> {
    costate::low_level::value::spaced(from, to, count.max(2))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The cheaper of (x - 1)^2 + x y and (x + 1)^2 + x y + y^2 / 2, on sheets 0 and 1.
    fn two_wells(x: f64, y: f64) -> (f64, [f64; 2], i32) {
        let a = (x - 1.0) * (x - 1.0) + x * y;
        let b = (x + 1.0) * (x + 1.0) + x * y + 0.5 * y * y;
        if a <= b {
            (a, [2.0 * (x - 1.0) + y, x], 0)
        } else {
            (b, [2.0 * (x + 1.0) + y, x + y], 1)
        }
    }

    fn map(count: usize) -> SolvedGrid {
        let axis = even([-2.0, 2.0], count);
        let mut map = SolvedGrid {
            axes: vec![axis.clone(), axis.clone()],
            ..SolvedGrid::default()
        };
        for x in &axis {
            for y in &axis {
                let (v, p, sheet) = two_wells(*x, *y);
                map.v.push(v);
                map.p.extend(p);
                map.u.push(*x);
                map.sheet.push(sheet);
            }
        }
        map
    }

    #[test]
    fn quadratic_pieces_are_exact_and_not_mixed() {
        let field = GridField::of_map(&map(9), 1, &[], f64::INFINITY);
        let mut seen = [0, 0];
        for x in even([-1.97, 1.93], 37) {
            for y in even([-1.9, 1.99], 41) {
                let local = field.at(&[x, y]).unwrap();
                let (v, _, sheet) = two_wells(x, y);
                let mixed = {
                    let corners = field.corners(&[x, y]).unwrap();
                    corners
                        .iter()
                        .any(|(k, _)| field.sheet[*k] != field.sheet[corners[0].0])
                };
                // In a cell with both sheets each continues from its own corners: second order,
                // curvature 2, cells of 0.5.
                let tolerance = if mixed {
                    0.5 * 2.0 * 2.0 * 0.5f64.powi(2)
                } else {
                    1e-12
                };
                assert!((local.v - v).abs() <= tolerance, "{x} {y}");
                if !mixed {
                    assert_eq!(local.sheet, sheet);
                    assert!((local.u[0] - x).abs() < 1e-12);
                    seen[sheet as usize] += 1;
                }
            }
        }
        assert!(seen.iter().all(|s| *s > 200), "{seen:?}");
        assert!(field.at(&[2.1, 0.0]).is_none());
    }

    #[test]
    fn what_has_no_label_is_of_the_sheet_it_agrees_with() {
        let labelled = map(41);
        let mut map = labelled.clone();
        // Round the bottom of a well, and over to where the other is the cheaper one.
        let mut open = 0;
        for (k, x) in (0..map.v.len()).map(|k| (k, [k / 41, k % 41].map(|i| map.axes[0][i]))) {
            if (x[0] - 0.6).hypot(x[1]) < 0.8 {
                map.sheet[k] = -1;
                open += 1;
            }
        }
        let mut field = GridField::of_map(&map, 1, &[], f64::INFINITY);
        field.label();
        let wrong = (field.sheet.iter().zip(&labelled.sheet))
            .filter(|(a, b)| a != b)
            .count();
        assert!(open > 150 && wrong == 0, "{wrong} of {open}");
    }

    #[test]
    fn holes_stay_holes_but_what_is_above_a_limit() {
        let mut map = map(9);
        map.v[4 * 9 + 4] = f64::NAN;
        let x = [map.axes[0][4] + 0.1, map.axes[1][4] - 0.1];
        assert!(
            GridField::of_map(&map, 1, &[], f64::INFINITY)
                .at(&x)
                .is_none()
        );
        // One well, known up to a limit: it is continued by its own quadratic, on the grid's side
        // of the limit.
        let limit = 6.0;
        let axis = even([-3.0, 3.0], 13);
        let mut well = SolvedGrid {
            axes: vec![axis.clone(), axis.clone()],
            ..SolvedGrid::default()
        };
        let mut above = Vec::new();
        for x in &axis {
            for y in &axis {
                let v = x * x + y * y;
                above.push(v > limit);
                let known = |w: f64| if v > limit { f64::NAN } else { w };
                well.v.push(known(v));
                well.p.extend([known(2.0 * x), known(2.0 * y)]);
                well.u.push(known(*x));
                well.sheet.push(if v > limit { -1 } else { 0 });
            }
        }
        let field = GridField::of_map(&well, 1, &above, limit);
        for x in even([-2.4, 2.4], 33) {
            for y in even([-2.4, 2.4], 33) {
                let v = x * x + y * y;
                if v < limit + 1.0 {
                    let found = field.at(&[x, y]).unwrap();
                    assert!((found.v - v).abs() < 1e-9, "{x} {y}: {} {v}", found.v);
                    assert_eq!(found.sheet, 0);
                }
            }
        }
    }

    /// The compressor near deep stall, where V rises a hundredfold within a cell: blank there, and
    /// right where it is not.
    #[test]
    fn what_is_too_steep_for_the_grid_is_blank() {
        let text = include_str!("../../../tests/data/picture/compressor_plane.csv");
        let rows: Vec<Vec<f64>> = (text.lines().filter(|l| !l.starts_with(['#', 'P'])))
            .map(|l| l.split(',').map(|v| v.parse().unwrap()).collect())
            .collect();
        let (grid, others) = rows.split_at(63);
        let mut points = SolvedStates {
            count: grid.len(),
            ..SolvedStates::default()
        };
        for row in grid {
            points.x.extend(&row[..2]);
            points.v.push(row[2]);
            points.p.extend(&row[3..5]);
            points.u.push(row[5]);
            points.sheet.push(0);
        }
        let field = GridField::of_points(&points, 2, 1).unwrap();
        let mut known = 0;
        for row in others {
            let (x, v) = (&row[..2], row[2]);
            if let Some(local) = field.at(x) {
                known += 1;
                assert!((local.v - v).abs() < 0.1 * v, "{x:?}: {} {v}", local.v);
            }
        }
        // Next to the corner the grid says nothing.
        assert!(field.at(&[1.02, 2.05]).is_none() && field.at(&[1.02, 2.1]).is_none());
        assert!(known > 3 * others.len() / 4, "{known} of {}", others.len());
    }

    #[test]
    fn points_of_a_grid_in_any_order() {
        let whole = map(5);
        let field = GridField::of_map(&whole, 1, &[], f64::INFINITY);
        let order: Vec<usize> = (0..25).map(|k| k * 7 % 25).collect();
        let mut points = SolvedStates {
            count: 25,
            ..SolvedStates::default()
        };
        for k in order {
            points.x.extend(field.state(k));
            points.v.push(whole.v[k]);
            points.p.extend(&whole.p[2 * k..2 * k + 2]);
            points.u.push(whole.u[k]);
            points.sheet.push(whole.sheet[k]);
        }
        let same = GridField::of_points(&points, 2, 1).unwrap();
        assert_eq!(
            (same.v, same.p, same.sheet),
            (field.v, field.p, field.sheet)
        );
        points.x[0] += 0.1;
        assert!(GridField::of_points(&points, 2, 1).is_none());
    }

    #[test]
    fn cells_between_sheets_are_cut() {
        let field = GridField::of_map(&map(17), 1, &[], f64::INFINITY);
        let axis = even([-2.0, 2.0], 33);
        let plane = Plane::new(&field, [0, 1], &[0.0, 0.0], axis.clone(), axis).unwrap();
        assert_eq!(plane.sheets(), [0, 1]);
        for i in 0..32 {
            for j in 0..32 {
                let at = |di: usize, dj: usize| plane.sheet[(i + di) * 33 + j + dj];
                let same = at(0, 0) == at(1, 0) && at(0, 0) == at(0, 1) && at(0, 0) == at(1, 1);
                assert_eq!(plane.cut[i * 32 + j], !same);
            }
        }
        assert_eq!(refined(&[0.0, 1.0, 3.0], 6), [0.0, 0.5, 1.0, 2.0, 3.0]);
    }
}
