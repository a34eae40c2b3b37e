//! V and the controls along a line of states, every solution found.

use super::Made;
use super::panels::{Curve, Panel, Panels};
use crate::canvas::{Ink, Stroke};
use crate::frame::Mark;
use crate::ticks::significant;
use crate::{Picture, Source, colours, names};
use costate::low_level::model::Model;
use costate::low_level::numeric::hermite::hermite;
use costate::low_level::schema;
use costate::low_level::trajectories::SolvedStates;
use std::collections::BTreeMap;

/// Fewer states make no line.
const LEAST: usize = 4;

/// States along one axis.
struct Slice {
    axis: usize,
    /// The fixed values; that of `axis` has no meaning.
    at: Vec<f64>,
}

impl Slice {
    /// The axis with the most values; the others where they are nearest to what is asked for.
    fn find(points: &SolvedStates, base: &[f64]) -> Option<Self> {
        let n = base.len();
        let values: Vec<Vec<f64>> = (0..n)
            .map(|k| {
                let mut all: Vec<f64> = points.x.iter().skip(k).step_by(n).copied().collect();
                all.sort_by(f64::total_cmp);
                all.dedup();
                all
            })
            .collect();
        let axis = (0..n).rev().max_by_key(|k| values[*k].len())?;
        let nearest = |k: usize| {
            values[k]
                .iter()
                .copied()
                .min_by(|a, b| (a - base[k]).abs().total_cmp(&(b - base[k]).abs()))
        };
        let at: Vec<f64> = (0..n).map(nearest).collect::<Option<_>>()?;
        let slice = Self { axis, at };
        let count = points.x.chunks(n).filter(|x| slice.has(x, 1e-9)).count();
        (count >= LEAST).then_some(slice)
    }

    /// The solutions on it, ascending along the line, then in V.
    fn entries(&self, all: &SolvedStates, model: &Model) -> Vec<Entry> {
        let (n, m) = (model.states.len(), model.controls.len());
        let mut entries: Vec<Entry> = (0..all.count)
            .filter(|k| self.has(&all.x[k * n..(k + 1) * n], 1e-9) && all.v[*k].is_finite())
            .map(|k| Entry {
                x: all.x[k * n + self.axis],
                v: all.v[k],
                slope: all.p[k * n + self.axis],
                u: all.u[k * m..(k + 1) * m].to_vec(),
                sheet: all.sheet[k],
            })
            .collect();
        entries.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.v.total_cmp(&b.v)));
        entries
    }

    /// The places along the line that were solved for.
    fn steps(&self, points: &SolvedStates, n: usize) -> Vec<f64> {
        let on = points.x.chunks(n).filter(|x| self.has(x, 1e-9));
        let mut steps: Vec<f64> = on.map(|x| x[self.axis]).collect();
        steps.sort_by(f64::total_cmp);
        steps.dedup();
        steps
    }

    /// The states that it holds fixed, in words.
    fn fixed(&self, model: &Model) -> String {
        let fixed = names::held(&model.states, &[self.axis], |k| self.at[k]);
        names::at(&fixed)
    }

    fn has(&self, x: &[f64], slack: f64) -> bool {
        (0..x.len()).all(|k| {
            k == self.axis || (x[k] - self.at[k]).abs() <= slack * self.at[k].abs().max(1.0)
        })
    }
}

/// A solution of the slice.
struct Entry {
    x: f64,
    v: f64,
    /// dV/dx along the line.
    slope: f64,
    u: Vec<f64>,
    sheet: i32,
}

pub fn picture(source: &Source<'_>) -> Made {
    let Some(found) = Found::read(source)? else {
        return Ok(None);
    };
    let model = source.model;
    let axis = &model.states[found.slice.axis].variable;
    let at = found.slice.fixed(model);
    Ok(Some(Picture {
        name: "slice".to_owned(),
        title: format!("All sheets along {}{at}", names::symbol(&axis.name)),
        caption: found.caption(&axis.name, &at),
        drawing: Box::new(Panels {
            x_label: names::label(axis),
            panels: found.panels(model),
            legend: found.legend(),
            marks: found.crossings.iter().map(|c| c[0]).collect(),
            columns: 1,
            tall: 1.5,
            log: false,
        }),
    }))
}

/// All solutions of the slice.
struct Found {
    slice: Slice,
    /// Ascending along the line, then in V.
    entries: Vec<Entry>,
    sheets: Vec<i32>,
    /// Entries by sheet, and those of the cheapest, in parts that belong together.
    branches: Vec<Vec<usize>>,
    cheapest: Vec<Vec<usize>>,
    /// Where two sheets cost the same: place and V.
    crossings: Vec<[f64; 2]>,
}

impl Found {
    fn read(source: &Source<'_>) -> Result<Option<Self>, String> {
        let (Some(points), Some(all)) = (source.points()?, source.sheets()?) else {
            return Ok(None);
        };
        let model = source.model;
        let Some(slice) = Slice::find(points, &source.base) else {
            return Ok(None);
        };
        let entries = slice.entries(all, model);
        if entries.is_empty() {
            return Ok(None);
        }
        let steps = slice.steps(points, model.states.len());
        let branches = branches(&entries, &steps);
        let mut sheets: Vec<i32> = entries.iter().map(|e| e.sheet).collect();
        sheets.sort_unstable();
        sheets.dedup();
        // Of a single sheet all is the cheapest.
        let cheapest = if sheets.len() > 1 {
            cheapest(&entries, &steps)
        } else {
            Vec::new()
        };
        Ok(Some(Self {
            crossings: crossings(source, &slice)?,
            slice,
            entries,
            sheets,
            branches,
            cheapest,
        }))
    }

    /// V, and each control beneath.
    fn panels(&self, model: &Model) -> Vec<Panel> {
        let along = |k: &[usize]| curve(k.iter().map(|k| &self.entries[*k]).collect());
        let mut panels = vec![self.panel("V".to_owned(), &along)];
        panels[0].dots = self.crossings.clone();
        for (c, control) in model.controls.iter().enumerate() {
            let line = |k: &[usize]| {
                let entries = k.iter().map(|k| &self.entries[*k]);
                entries.map(|e| [e.x, e.u[c]]).collect()
            };
            let mut one = self.panel(names::label(&control.variable), &line);
            one.bounds = [control.min, control.max].into_iter().flatten().collect();
            panels.push(one);
        }
        panels
    }

    /// All branches over the band of the cheapest; `line` gives the points of some entries.
    fn panel(&self, label: String, line: &dyn Fn(&[usize]) -> Vec<[f64; 2]>) -> Panel {
        let mut curves: Vec<Curve> = (self.cheapest.iter())
            .map(|k| Curve {
                points: line(k),
                stroke: band(),
            })
            .collect();
        curves.extend(self.branches.iter().map(|k| Curve {
            points: line(k),
            stroke: Stroke::new(ink(self.entries[k[0]].sheet), 1.8),
        }));
        Panel {
            label,
            curves,
            ..Panel::default()
        }
    }

    fn legend(&self) -> Vec<(Mark, String)> {
        let mut legend: Vec<_> = (self.sheets.iter())
            .map(|s| (Mark::Line(Stroke::new(ink(*s), 2.5)), format!("sheet {s}")))
            .collect();
        if self.sheets.len() > 1 {
            legend.push((Mark::Line(band()), "cheapest".to_owned()));
        }
        if !self.crossings.is_empty() {
            legend.push((Mark::Dot(Ink::Text), "equal cost".to_owned()));
        }
        legend
    }

    /// `axis`: the state along the line; `at`: the others.
    fn caption(&self, axis: &str, at: &str) -> String {
        let mut caption = format!(
            "Every solution of the necessary conditions found{at}, one colour a sheet{}. Beneath, the control that each of them asks for.",
            if self.sheets.len() > 1 {
                ". The optimal one is the lowest, with the grey band"
            } else {
                ""
            }
        );
        let crossed: Vec<String> = (self.crossings.iter())
            .map(|c| significant(c[0], 5))
            .collect();
        if !crossed.is_empty() {
            caption += &format!(
                " At {} = {} two sheets cost the same: V has a kink and the optimal control jumps.",
                names::symbol(axis),
                crossed.join(", ")
            );
        }
        caption
    }
}

/// Colour of a sheet.
fn ink(sheet: i32) -> Ink {
    Ink::Colour(colours::class(sheet.max(0) as usize))
}

/// The band beneath the cheapest.
fn band() -> Stroke {
    Stroke::new(Ink::Text, 7.0).opacity(0.18)
}

/// V along a branch: between two states the cubic with their V and slopes. Where both slopes have
/// the sign of V's change, it stays between the two V: slopes that are too steep for that are less
/// steep in the picture (Fritsch and Carlson 1980).
fn curve(entries: Vec<&Entry>) -> Vec<[f64; 2]> {
    const BETWEEN: usize = 8;
    /// In units of the mean slope: a cubic with less is monotone.
    const STEEPEST: f64 = 3.0;
    let mut points: Vec<[f64; 2]> = Vec::new();
    for pair in entries.windows(2) {
        let (a, b) = (pair[0], pair[1]);
        let h = b.x - a.x;
        let mean = (b.v - a.v) / h;
        let is_monotone = a.slope * mean > 0.0 && b.slope * mean > 0.0;
        let most = if is_monotone {
            STEEPEST * mean.abs()
        } else {
            f64::INFINITY
        };
        let slopes = [a.slope, b.slope].map(|s| s.clamp(-most, most));
        points.extend((0..BETWEEN).map(|k| {
            let q = k as f64 / BETWEEN as f64;
            [
                a.x + q * h,
                hermite(q, h, [a.v, slopes[0]], [b.v, slopes[1]]),
            ]
        }));
    }
    points.extend(entries.last().map(|e| [e.x, e.v]));
    points
}

/// Entries by sheet in the line's order, parted where a state has none. Where a sheet has several
/// solutions at a state they are told apart by rank.
fn branches(entries: &[Entry], steps: &[f64]) -> Vec<Vec<usize>> {
    let mut by: BTreeMap<(i32, usize), Vec<(usize, usize)>> = BTreeMap::new();
    let mut rank: BTreeMap<(usize, i32), usize> = BTreeMap::new();
    for (k, e) in entries.iter().enumerate() {
        let step = steps.partition_point(|s| *s < e.x);
        let r = rank.entry((step, e.sheet)).or_default();
        by.entry((e.sheet, *r)).or_default().push((step, k));
        *r += 1;
    }
    by.into_values().flat_map(|line| parted(&line)).collect()
}

/// Parts of consecutive steps.
fn parted(line: &[(usize, usize)]) -> Vec<Vec<usize>> {
    let mut parts: Vec<Vec<usize>> = Vec::new();
    let mut last = None;
    for (step, k) in line {
        match parts
            .last_mut()
            .filter(|_| last.is_some_and(|l| l + 1 == *step))
        {
            Some(part) => part.push(*k),
            None => parts.push(vec![*k]),
        }
        last = Some(*step);
    }
    parts
}

/// The cheapest entries, parted where the sheet changes.
fn cheapest(entries: &[Entry], steps: &[f64]) -> Vec<Vec<usize>> {
    let mut lowest: Vec<(usize, usize)> = Vec::new();
    for (k, e) in entries.iter().enumerate() {
        let step = steps.partition_point(|s| *s < e.x);
        // Entries of a state ascend in V.
        if lowest.last().is_none_or(|(s, _)| *s != step) {
            lowest.push((step, k));
        }
    }
    let mut parts = Vec::new();
    for part in parted(&lowest) {
        for same in part.chunk_by(|a, b| entries[*a].sheet == entries[*b].sheet) {
            parts.push(same.to_vec());
        }
    }
    parts
}

/// Points of `/equal_cost` on the line: place and V.
fn crossings(source: &Source<'_>, slice: &Slice) -> Result<Vec<[f64; 2]>, String> {
    let Some(group) = source.stored.group(&schema::EQUAL_COST) else {
        return Ok(Vec::new());
    };
    let text = |e: costate::low_level::result::StoredError| e.to_string();
    let (x, v) = (
        group.f64("x").map_err(text)?.values,
        group.f64("V").map_err(text)?.values,
    );
    let n = source.base.len();
    let on = x.chunks(n).zip(v).filter(|(x, _)| slice.has(x, 1e-7));
    let mut found: Vec<[f64; 2]> = on.map(|(x, v)| [x[slice.axis], v]).collect();
    found.sort_by(|a, b| a[0].total_cmp(&b[0]));
    // A map's edge and the line's own may both have found it.
    found.dedup_by(|a, b| {
        (a[0] - b[0]).abs() <= 1e-6 * a[0].abs().max(1.0)
            && (a[1] - b[1]).abs() <= 1e-6 * a[1].abs().max(1.0)
    });
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_do_not_leave_what_was_solved() {
        let entry = |x: f64, v: f64, slope: f64| Entry {
            x,
            v,
            slope,
            u: Vec::new(),
            sheet: 0,
        };
        // The compressor near deep stall: a cubic with these slopes falls to -1 between V = 4.68
        // and 0.58.
        let steep = [
            entry(1.0, 4.681, -604.07),
            entry(1.05, 0.5785, -22.716),
            entry(1.1, 0.2439, -6.45),
        ];
        let line = curve(steep.iter().collect());
        assert_eq!(line.len(), 17);
        assert!(line.windows(2).all(|w| w[1][1] <= w[0][1]), "{line:?}");
        // A well between two states is kept: V = x^2.
        let well = [entry(-1.0, 1.0, -2.0), entry(1.2, 1.44, 2.4)];
        for [x, v] in curve(well.iter().collect()) {
            assert!((v - x * x).abs() < 1e-12, "{x} {v}");
        }
    }
}
