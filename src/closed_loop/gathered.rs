//! Closed loops from some of the initial states at a time, put together.

use super::{Initial, LawResult, Path};

/// Status of an initial state that no part has simulated.
pub const NOT_MERGED: i32 = 9;

/// Closed loops from those initial states that are done. Each is a trajectory of its own: in whose
/// company it flies changes no bit of it.
#[derive(Clone, Debug, Default)]
pub struct Gathered {
    /// All that were asked for.
    initial: Initial,
    /// `[initial]`, of all.
    is_done: Vec<bool>,
    values: Vec<f64>,
    laws: Vec<LawResult>,
}

impl Gathered {
    pub fn new(initial: Initial) -> Self {
        let count = initial.count();
        Self {
            is_done: vec![false; count],
            values: vec![f64::NAN; count],
            laws: Vec::new(),
            initial,
        }
    }

    /// The initial states that were asked for.
    pub fn initial(&self) -> &Initial {
        &self.initial
    }

    /// Takes what was simulated from some of them, by their numbers.
    pub fn take(&mut self, numbers: &[usize], values: &[f64], laws: Vec<LawResult>) {
        let count = self.initial.count();
        if self.laws.is_empty() {
            self.laws = laws.iter().map(|law| law.of_none(count)).collect();
        }
        for (&number, value) in numbers.iter().zip(values) {
            self.is_done[number] = true;
            self.values[number] = *value;
        }
        for (to, from) in self.laws.iter_mut().zip(laws) {
            let records = from.records.len() / numbers.len().max(1);
            to.records.resize(count * records, f64::NAN);
            for (k, &number) in numbers.iter().enumerate() {
                to.cost[number] = from.cost[k];
                to.converged[number] = from.converged[k];
                to.status[number] = from.status[k];
                to.t_end[number] = from.t_end[k];
                to.fallback[number] = from.fallback.get(k).copied().unwrap_or(0);
                to.records[number * records..][..records]
                    .copy_from_slice(&from.records[k * records..][..records]);
            }
            to.updates += from.updates;
            to.round_trips += from.round_trips;
            to.seconds += from.seconds;
            to.paths.extend(from.paths.into_iter().map(|path| Path {
                initial: numbers[path.initial],
                ..path
            }));
            to.paths.sort_by_key(|path| path.initial);
        }
    }

    /// Whether all are there.
    pub fn is_whole(&self) -> bool {
        self.is_done.iter().all(|done| *done)
    }

    /// The numbers of those that are there.
    pub fn numbers(&self) -> Vec<usize> {
        let done = self.is_done.iter().enumerate();
        done.filter(|(_, done)| **done).map(|(k, _)| k).collect()
    }

    /// Those that are there: the initial states, V, and what came of each law.
    pub fn part(&self) -> (Initial, Vec<f64>, Vec<LawResult>) {
        let numbers = self.numbers();
        let laws = self.laws.iter().map(|law| {
            let count = law.status.len();
            let records = law.records.len() / count.max(1);
            let place = |number: usize| numbers.binary_search(&number).unwrap_or(0);
            LawResult {
                cost: some(&law.cost, &numbers),
                converged: some(&law.converged, &numbers),
                status: some(&law.status, &numbers),
                t_end: some(&law.t_end, &numbers),
                fallback: some(&law.fallback, &numbers),
                records: (numbers.iter())
                    .flat_map(|k| &law.records[k * records..][..records])
                    .copied()
                    .collect(),
                paths: (law.paths.iter().cloned())
                    .map(|path| Path {
                        initial: place(path.initial),
                        ..path
                    })
                    .collect(),
                ..law.counted()
            }
        });
        let laws = laws.collect();
        (
            self.initial.some(&numbers),
            some(&self.values, &numbers),
            laws,
        )
    }

    /// All, those too that are not there; trajectories of `samples` steps.
    pub fn all(mut self, samples: usize, controls: usize) -> (Initial, Vec<f64>, Vec<LawResult>) {
        let points = samples + 1;
        let kept = self.initial.kept();
        for law in &mut self.laws {
            let mut there = std::mem::take(&mut law.paths).into_iter().peekable();
            law.paths = (kept.iter())
                .map(
                    |&initial| match there.next_if(|path| path.initial == initial) {
                        Some(path) => path,
                        None => Path {
                            initial,
                            t: vec![f64::NAN; points],
                            x: vec![f64::NAN; points * self.initial.states],
                            u: vec![f64::NAN; points * controls],
                            ..Path::default()
                        },
                    },
                )
                .collect();
        }
        let laws = self.laws.iter().map(|law| LawResult {
            paths: law.paths.clone(),
            ..law.counted()
        });
        let laws = laws.collect();
        (self.initial, self.values, laws)
    }
}

impl LawResult {
    /// Of none of so many initial states.
    fn of_none(&self, count: usize) -> Self {
        Self {
            name: self.name.clone(),
            source: self.source.clone(),
            cost: vec![f64::NAN; count],
            converged: vec![false; count],
            status: vec![NOT_MERGED; count],
            t_end: vec![f64::NAN; count],
            fallback: vec![0; count],
            ..Self::default()
        }
    }

    /// With the share of its updates that the chart had no answer at.
    fn counted(&self) -> Self {
        let fallback: f64 = self.fallback.iter().map(|k| f64::from(*k)).sum();
        Self {
            held: fallback / self.updates.max(1) as f64,
            ..self.clone()
        }
    }
}

/// Some of the elements of a list.
fn some<T: Copy>(all: &[T], numbers: &[usize]) -> Vec<T> {
    numbers.iter().map(|k| all[*k]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn initial() -> Initial {
        Initial {
            x: (0..12).map(f64::from).collect(),
            states: 2,
            axes: vec![(0, vec![0.0, 1.0, 2.0]), (1, vec![0.0, 1.0])],
            ..Initial::default()
        }
    }

    fn law(numbers: &[usize]) -> Vec<LawResult> {
        let of = |scale: f64| -> Vec<f64> { numbers.iter().map(|k| scale * *k as f64).collect() };
        vec![LawResult {
            name: "a".to_owned(),
            cost: of(1.0),
            records: numbers
                .iter()
                .flat_map(|k| [*k as f64, -(*k as f64)])
                .collect(),
            converged: numbers.iter().map(|k| k % 2 == 0).collect(),
            status: numbers.iter().map(|k| *k as i32 % 2).collect(),
            t_end: of(10.0),
            fallback: numbers.iter().map(|k| *k as u32).collect(),
            updates: 10 * numbers.len(),
            seconds: 1.0,
            paths: (0..numbers.len())
                .map(|place| Path {
                    initial: place,
                    t: vec![numbers[place] as f64; 2],
                    ..Path::default()
                })
                .collect(),
            ..LawResult::default()
        }]
    }

    /// Whatever the pieces, and their order, all of them are what one of all would be.
    #[test]
    fn pieces_are_put_where_they_belong() {
        let mut one = Gathered::new(initial());
        one.take(
            &[0, 1, 2, 3, 4, 5],
            &[0.0, 1.0, 2.0, 3.0, 4.0, 5.0],
            law(&[0, 1, 2, 3, 4, 5]),
        );
        let mut pieces = Gathered::new(initial());
        pieces.take(&[1, 4], &[1.0, 4.0], law(&[1, 4]));
        assert_eq!(pieces.numbers(), [1, 4]);
        assert!(!pieces.is_whole());
        pieces.take(&[0, 2, 3, 5], &[0.0, 2.0, 3.0, 5.0], law(&[0, 2, 3, 5]));
        assert!(pieces.is_whole());
        let (a, b) = (one.all(1, 0), pieces.all(1, 0));
        assert_eq!((&a.0, &a.1), (&b.0, &b.1));
        let [a, b] = [&a.2[0], &b.2[0]];
        assert_eq!((&a.cost, &a.records), (&b.cost, &b.records));
        assert_eq!((&a.status, &a.fallback), (&b.status, &b.fallback));
        assert_eq!((a.held, a.updates), (15.0 / 60.0, 60));
        assert_eq!((b.held, b.updates), (a.held, a.updates));
        assert_eq!(a.paths, b.paths);
    }

    /// What is not there is said to be so.
    #[test]
    fn gaps_have_a_status() {
        let mut some = Gathered::new(initial());
        some.take(&[1, 4], &[1.0, 4.0], law(&[1, 4]));
        let (initial, values, laws) = some.part();
        assert_eq!(initial.x, [2.0, 3.0, 8.0, 9.0]);
        assert_eq!(
            (values, laws[0].cost.clone()),
            (vec![1.0, 4.0], vec![1.0, 4.0])
        );
        assert_eq!(laws[0].paths[1].initial, 1);
        let (_, values, laws) = some.all(1, 0);
        assert_eq!(laws[0].status, [9, 1, 9, 9, 0, 9]);
        assert!(values[0].is_nan() && laws[0].records[0].is_nan());
        assert_eq!(laws[0].paths.len(), 6);
        assert!(laws[0].paths[0].t[0].is_nan() && laws[0].paths[1].t[0] == 1.0);
    }
}
