//! A seam as a list of numbers, in which it is stored, and back.

use super::{BorderEntry, BorderState, Seam, SheetOf};
use crate::shooting::{Path, Solved};
use crate::value::equal_cost::BoundaryPoint;
use crate::value::fold::Fold;
use crate::value::solve::EqualCost;

/// Numbers one after the other; lists begin with their length.
#[derive(Default)]
struct Writer(Vec<f64>);

impl Writer {
    fn whole(&mut self, number: impl Into<i64>) {
        self.0.push(number.into() as f64);
    }

    fn count(&mut self, count: usize) {
        self.0.push(count as f64);
    }

    fn list(&mut self, numbers: &[f64]) {
        self.count(numbers.len());
        self.0.extend_from_slice(numbers);
    }

    fn wholes(&mut self, numbers: &[i32]) {
        self.count(numbers.len());
        self.0.extend(numbers.iter().map(|k| f64::from(*k)));
    }
}

/// The same read; `None` where there are no such numbers.
struct Reader<'n>(&'n [f64]);

impl Reader<'_> {
    fn real(&mut self) -> Option<f64> {
        let (first, rest) = self.0.split_first()?;
        self.0 = rest;
        Some(*first)
    }

    fn whole(&mut self) -> Option<i32> {
        let number = self.real()?;
        (number.fract() == 0.0 && number.abs() <= f64::from(i32::MAX)).then_some(number as i32)
    }

    fn count(&mut self) -> Option<usize> {
        const MOST: f64 = 9e15;
        let number = self.real()?;
        (number.fract() == 0.0 && (0.0..MOST).contains(&number)).then_some(number as usize)
    }

    /// How many things follow, each of at least one number.
    fn length(&mut self) -> Option<usize> {
        self.count().filter(|count| *count <= self.0.len())
    }

    fn list(&mut self) -> Option<Vec<f64>> {
        let count = self.length()?;
        let (these, rest) = self.0.split_at(count);
        self.0 = rest;
        Some(these.to_vec())
    }

    fn wholes(&mut self) -> Option<Vec<i32>> {
        let count = self.length()?;
        (0..count).map(|_| self.whole()).collect()
    }

    fn all<T>(&mut self, one: impl Fn(&mut Self) -> Option<T>) -> Option<Vec<T>> {
        let count = self.length()?;
        (0..count).map(|_| one(self)).collect()
    }
}

impl Seam {
    /// All of it as numbers.
    #[must_use]
    pub fn to_numbers(&self) -> Vec<f64> {
        let mut out = Writer::default();
        out.count(self.block);
        out.whole(i32::from(self.is_closed));
        out.count(self.solutions);
        out.0.extend([self.evaluations as f64, self.seconds]);
        out.count(self.sheets.len());
        for sheet in &self.sheets {
            out.0.push(sheet.value);
            out.list(&sheet.x);
            out.whole(sheet.lifted);
        }
        out.count(self.apart.len());
        for pair in &self.apart {
            pair.iter().for_each(|sheet| out.whole(*sheet));
        }
        out.count(self.border.len());
        for state in &self.border {
            out.list(&state.x);
            out.count(state.rows.len());
            state.rows.iter().for_each(|row| out.whole(*row));
            out.0.extend([state.limit, state.reach]);
            out.count(state.entries.len());
            for entry in &state.entries {
                out.whole(entry.sheet);
                out.wholes(&entry.winding);
                out.count(entry.path.width);
                out.list(&entry.path.nodes);
                out.list(&entry.path.durations);
                let Solved {
                    value,
                    slope,
                    fold,
                    residual,
                    t,
                } = &entry.solved;
                out.0.extend([*value, *fold, *residual, *t]);
                out.list(slope.as_deref().unwrap_or(&[]));
            }
        }
        out.count(self.crossings.len());
        for EqualCost { point, u } in &self.crossings {
            out.count(point.between.0);
            out.count(point.between.1);
            out.list(&point.x);
            out.0.extend([point.value, point.difference]);
            out.wholes(&point.sheets);
            for list in point.p.iter().chain(&point.s).chain(u) {
                out.list(list);
            }
        }
        out.count(self.folds.len());
        for fold in &self.folds {
            out.list(&fold.s);
            out.list(&fold.p);
            out.0.push(fold.value);
        }
        out.0
    }

    /// The seams in a list of numbers; `None` where these are something else.
    #[must_use]
    pub fn all_from(numbers: &[f64]) -> Option<Vec<Self>> {
        let mut from = Reader(numbers);
        let mut all = Vec::new();
        while !from.0.is_empty() {
            all.push(Self::read(&mut from)?);
        }
        Some(all)
    }

    fn read(from: &mut Reader<'_>) -> Option<Self> {
        let block = from.count()?;
        let is_closed = from.whole()? != 0;
        let solutions = from.count()?;
        let (evaluations, seconds) = (from.real()? as u64, from.real()?);
        let sheets = from.all(|from| {
            Some(SheetOf {
                value: from.real()?,
                x: from.list()?,
                lifted: from.whole()?,
            })
        })?;
        let apart = from.all(|from| Some([from.whole()?, from.whole()?]))?;
        let border = from.all(|from| {
            Some(BorderState {
                x: from.list()?,
                rows: from.all(|from| u32::try_from(from.count()?).ok())?,
                limit: from.real()?,
                reach: from.real()?,
                entries: from.all(entry)?,
            })
        })?;
        let crossings = from.all(crossing)?;
        let folds = from.all(|from| {
            Some(Fold {
                s: from.list()?,
                p: from.list()?,
                value: from.real()?,
            })
        })?;
        let seam = Self {
            block,
            is_closed,
            sheets,
            apart,
            border,
            crossings,
            folds,
            solutions,
            evaluations,
            seconds,
        };
        seam.names_its_sheets().then_some(seam)
    }

    /// Whether all sheets that it speaks of are among its own.
    fn names_its_sheets(&self) -> bool {
        let has = |sheet: &i32| usize::try_from(*sheet).is_ok_and(|s| s < self.sheets.len());
        let of_border = self.border.iter().flat_map(|state| &state.entries);
        let of_points = self.crossings.iter().flat_map(|one| &one.point.sheets);
        self.apart.iter().flatten().all(has)
            && of_border.map(|entry| &entry.sheet).all(has)
            && of_points.into_iter().all(has)
    }
}

fn entry(from: &mut Reader<'_>) -> Option<BorderEntry> {
    let sheet = from.whole()?;
    let winding = from.wholes()?;
    let path = Path {
        width: from.count()?,
        nodes: from.list()?,
        durations: from.list()?,
    };
    let segments = path.durations.len();
    let fits = path.width > 0 && path.nodes.len() == (segments + 1) * path.width;
    let [value, fold, residual, t] = [from.real()?, from.real()?, from.real()?, from.real()?];
    let slope = Some(from.list()?).filter(|slope| !slope.is_empty());
    fits.then_some(BorderEntry {
        sheet,
        winding,
        path,
        solved: Solved {
            value,
            slope,
            fold,
            residual,
            t,
        },
    })
}

fn crossing(from: &mut Reader<'_>) -> Option<EqualCost> {
    let between = (from.count()?, from.count()?);
    let x = from.list()?;
    let (value, difference) = (from.real()?, from.real()?);
    let sheets = from.wholes()?.try_into().ok()?;
    let mut lists = || -> Option<[Vec<f64>; 2]> { Some([from.list()?, from.list()?]) };
    let (p, s, u) = (lists()?, lists()?, lists()?);
    Some(EqualCost {
        point: BoundaryPoint {
            between,
            x,
            value,
            difference,
            sheets,
            p,
            s,
            line: -1,
            place: -1,
        },
        u,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seam() -> Seam {
        let path = Path {
            width: 2,
            nodes: vec![0.1, f64::NAN, 0.3, -0.4],
            durations: vec![1.5],
        };
        let solved = |slope| Solved {
            value: 1.0 / 3.0,
            slope,
            fold: 0.5,
            residual: 1e-11,
            t: 0.0,
        };
        let entry = |sheet, slope| BorderEntry {
            sheet,
            winding: vec![-2],
            path: path.clone(),
            solved: solved(slope),
        };
        let state = |rows: Vec<u32>, entries| BorderState {
            x: vec![-0.0],
            rows,
            limit: f64::INFINITY,
            reach: 0.1,
            entries,
        };
        let sheet = |lifted| SheetOf {
            value: 0.25,
            x: vec![1e-300],
            lifted,
        };
        Seam {
            block: 7,
            is_closed: false,
            sheets: vec![sheet(0), sheet(0)],
            apart: vec![[0, 1]],
            border: vec![
                state(
                    vec![3, 4_000_000_000],
                    vec![entry(0, None), entry(1, Some(vec![2.0]))],
                ),
                state(vec![5], Vec::new()),
            ],
            crossings: vec![EqualCost {
                point: BoundaryPoint {
                    between: (3, 5),
                    x: vec![0.5],
                    value: 2.0,
                    difference: 1e-12,
                    sheets: [0, 1],
                    p: [vec![1.0], vec![-1.0]],
                    s: [vec![0.5], vec![0.5]],
                    line: -1,
                    place: -1,
                },
                u: [Vec::new(), Vec::new()],
            }],
            folds: vec![Fold {
                s: vec![0.1],
                p: vec![0.2],
                value: 0.3,
            }],
            solutions: 3,
            evaluations: 12,
            seconds: 0.5,
        }
    }

    #[test]
    fn seams_come_back_from_their_numbers() {
        let numbers = [seam().to_numbers(), seam().to_numbers()].concat();
        let back = Seam::all_from(&numbers).expect("they are seams");
        assert_eq!(back.len(), 2);
        // NaN is not equal to itself: the texts are.
        assert_eq!(format!("{:?}", back[1]), format!("{:?}", seam()));
    }

    #[test]
    fn other_numbers_are_no_seams() {
        let numbers = seam().to_numbers();
        for end in 1..numbers.len() {
            assert!(Seam::all_from(&numbers[..end]).is_none(), "{end}");
        }
        // A sheet that there is not.
        let wrong = Seam {
            apart: vec![[0, 2]],
            ..seam()
        };
        assert!(Seam::all_from(&wrong.to_numbers()).is_none());
    }
}
