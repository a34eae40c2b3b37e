//! States that are reached from points near them.

use super::{A_WORKER, Way, Worker, Workers, done_by, foreign_answer};
use crate::backend::BackendError;
use crate::shooting::Path;
use crate::value::{FoundNear, Miss, PointStatus, solve_near};
use prost::Message;

/// States that are worth sending away, and of a task at least.
const LEAST: usize = 32;
const LEAST_OF_TASK: usize = 8;

/// States, each with a guess near it.
#[derive(Clone, PartialEq, Message)]
pub(super) struct Task {
    /// Shortest step on the way from a guess to its state, as a share of the way.
    #[prost(double, tag = "1")]
    least: f64,
    #[prost(message, repeated, tag = "2")]
    guesses: Vec<Guess>,
}

#[derive(Clone, PartialEq, Message)]
struct Guess {
    #[prost(double, repeated, tag = "1")]
    x: Vec<f64>,
    #[prost(message, required, tag = "2")]
    path: Way,
}

/// What was found, in the order of the guesses.
#[derive(Clone, PartialEq, Message)]
struct Done {
    #[prost(message, repeated, tag = "1")]
    found: Vec<Found>,
}

#[derive(Clone, PartialEq, Message)]
struct Found {
    /// A solution and V; or what is known where there is none.
    #[prost(message, optional, tag = "1")]
    path: Option<Way>,
    #[prost(double, tag = "2")]
    value: f64,
    #[prost(message, optional, tag = "3")]
    miss: Option<Missed>,
}

/// What is known of a state without a solution.
#[derive(Clone, PartialEq, Message)]
pub(super) struct Missed {
    #[prost(int32, tag = "1")]
    status: i32,
    #[prost(double, repeated, tag = "2")]
    furthest: Vec<f64>,
    #[prost(double, tag = "3")]
    left: f64,
    #[prost(message, optional, tag = "4")]
    cut: Option<Way>,
}

impl Task {
    /// Does it; `None` where it is none.
    pub fn work(self, worker: &mut Worker) -> Result<Option<Vec<u8>>, BackendError> {
        let n = worker.plan.system.states;
        let guess = |guess: Guess| {
            let path = guess.path.into_path(2 * n)?;
            (guess.x.len() == n).then_some((guess.x, path))
        };
        let Some(guesses) = self.guesses.into_iter().map(guess).collect() else {
            return Ok(None);
        };
        let found = solve_near(&worker.plan, &mut worker.solver, guesses, self.least)?;
        let found = found.into_iter().map(Found::of).collect();
        Ok(Some(Done { found }.encode_to_vec()))
    }
}

/// Has states solved for by workers, as [`solve_near`] does it here; `None` where that is not worth
/// while.
///
/// # Errors
/// [`BackendError::Workers`], [`BackendError::Foreign`].
pub fn solved_by(
    workers: &dyn Workers,
    width: usize,
    guesses: &[(Vec<f64>, Path)],
    least: f64,
) -> Result<Option<Vec<FoundNear>>, BackendError> {
    let count = workers.count();
    if guesses.len() < LEAST || count == 0 {
        return Ok(None);
    }
    let of_task = (guesses.len().div_ceil(A_WORKER * count)).max(LEAST_OF_TASK);
    let task = |guesses: &[(Vec<f64>, Path)]| {
        let guess = |(x, path): &(Vec<f64>, Path)| Guess {
            x: x.clone(),
            path: Way::of(path),
        };
        super::Task {
            width: width as u32,
            ways: Task {
                least,
                guesses: guesses.iter().map(guess).collect(),
            },
        }
    };
    let mut found = Vec::with_capacity(guesses.len());
    for answer in done_by(workers, guesses.chunks(of_task).map(task))? {
        let done = Done::decode(answer.as_slice()).map_err(|_| foreign_answer())?;
        for one in done.found {
            found.push(one.into_found(width).ok_or_else(foreign_answer)?);
        }
    }
    match found.len() == guesses.len() {
        true => Ok(Some(found)),
        false => Err(foreign_answer()),
    }
}

impl Found {
    fn of(found: FoundNear) -> Self {
        match found {
            Ok((path, value)) => Self {
                path: Some(Way::of(&path)),
                value,
                miss: None,
            },
            Err(miss) => Self {
                path: None,
                value: f64::NAN,
                miss: miss.as_ref().map(Missed::of),
            },
        }
    }

    /// `None` where it is not as this version writes it.
    fn into_found(self, width: usize) -> Option<FoundNear> {
        if let Some(way) = self.path {
            return Some(Ok((way.into_path(width)?, self.value)));
        }
        match self.miss {
            Some(miss) => Some(Err(Some(miss.into_miss(width)?))),
            None => Some(Err(None)),
        }
    }
}

impl Missed {
    pub fn of(miss: &Miss) -> Self {
        Self {
            status: miss.status as i32,
            furthest: miss.furthest.clone().unwrap_or_default(),
            left: miss.left,
            cut: miss.cut.as_ref().map(Way::of),
        }
    }

    /// `None` where it is not as this version writes it.
    pub fn into_miss(self, width: usize) -> Option<Miss> {
        let (status, _) = (PointStatus::ALL.iter()).find(|(s, _)| *s as i32 == self.status)?;
        let cut = match self.cut {
            Some(way) => Some(way.into_path(width)?),
            None => None,
        };
        Some(Miss {
            status: *status,
            furthest: Some(self.furthest).filter(|x| !x.is_empty()),
            left: self.left,
            cut,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn path(segments: usize) -> Path {
        Path {
            width: 4,
            nodes: (0..4 * (segments + 1)).map(|k| 0.1 * k as f64).collect(),
            durations: vec![f64::MIN_POSITIVE; segments],
        }
    }

    /// Does nothing with what it is sent but to answer it with misses of its own.
    struct Echo(usize);

    impl Workers for Echo {
        fn count(&self) -> usize {
            self.0
        }

        fn work(&self, tasks: Vec<Vec<u8>>) -> Result<Vec<Vec<u8>>, String> {
            let done = |task: Vec<u8>| {
                let task = super::super::Task::decode(task.as_slice()).expect("it is a task");
                let found = task.ways.guesses.iter().map(|guess| {
                    Found::of(Ok((guess.path.clone().into_path(4).unwrap(), guess.x[0])))
                });
                Done {
                    found: found.collect(),
                }
                .encode_to_vec()
            };
            Ok(tasks.into_iter().map(done).collect())
        }
    }

    /// What comes back is what was sent, in its order, whatever the number of workers.
    #[test]
    fn states_come_back_in_their_order() {
        let guesses: Vec<_> = (0..100)
            .map(|k| (vec![f64::from(k), -0.0], path(k as usize % 5)))
            .collect();
        for workers in [1, 3, 200] {
            let found = solved_by(&Echo(workers), 4, &guesses, 0.5)
                .unwrap()
                .unwrap();
            assert_eq!(found.len(), 100);
            for ((x, path), found) in guesses.iter().zip(found) {
                let (same, value) = found.expect("all were found");
                assert_eq!((&same, value), (path, x[0]));
            }
        }
        assert!(
            solved_by(&Echo(4), 4, &guesses[..3], 0.5)
                .unwrap()
                .is_none()
        );
        assert!(solved_by(&Echo(0), 4, &guesses, 0.5).unwrap().is_none());
    }

    #[test]
    fn misses_come_back_as_they_were() {
        let miss = Miss {
            status: PointStatus::LeavesGuard,
            furthest: Some(vec![1.0, 2.0]),
            left: f64::NAN,
            cut: Some(path(2)),
        };
        let back = Found::of(Err(Some(miss))).into_found(4).unwrap();
        let miss = back.unwrap_err().expect("something is known");
        assert_eq!(miss.status, PointStatus::LeavesGuard);
        assert_eq!(miss.furthest, Some(vec![1.0, 2.0]));
        assert!(miss.left.is_nan());
        assert_eq!(miss.cut, Some(path(2)));
        assert!(matches!(
            Found::of(Err(None)).into_found(4),
            Some(Err(None))
        ));
        // A solution whose nodes are not as many as its segments ask for is none.
        let cut_short = Found {
            path: Some(Way {
                nodes: vec![0.0; 7],
                durations: Vec::new(),
            }),
            ..Found::default()
        };
        assert!(cut_short.into_found(4).is_none());
    }
}
