//! Trajectories of a batch under the law of a chart, each leg by leg from its start to its end.

use super::charted::{Pilots, When, Wings};
use super::equations::{chart_of, set_chart};
use super::fallback::{Rest, hold_here};
use super::flights::Watch;
use super::pace::{Course, End, Pace};
use super::simulate::{Batch, Ground};
use crate::backend::{BackendError, Status, Trajectories};
use crate::model::Outside;

/// Times are met to this share of a sample's interval.
const INSTANT: f64 = 1e-9;

/// A batch on its way.
pub(super) struct Journey<'j, 'g> {
    ground: &'j Ground<'g>,
    pilots: Pilots<'j>,
    batch: &'j mut Batch,
    courses: Vec<Course>,
    /// Vectors where the legs in hand begin, with their laws.
    begin: Vec<f64>,
    /// Trajectories of which legs end where samples are taken.
    sampled: Vec<bool>,
    flown: Trajectories,
}

impl<'j, 'g> Journey<'j, 'g> {
    pub fn new(
        ground: &'j Ground<'g>,
        pilots: Pilots<'j>,
        batch: &'j mut Batch,
        watched: bool,
    ) -> Self {
        let count = batch.status.len();
        let all = watched
            || !ground.setting.closed_loop.records.is_empty()
            || matches!(ground.pace, Pace::Period(_));
        let mut sampled = vec![all; count];
        batch.kept.iter().for_each(|(i, _)| sampled[*i] = true);
        Self {
            ground,
            pilots,
            courses: vec![Course::new(&ground.pace); count],
            begin: batch.end.clone(),
            sampled,
            batch,
            flown: Trajectories::default(),
        }
    }

    /// From the start to the end of all.
    pub fn fly(
        mut self,
        wings: &mut Wings<'_>,
        watch: &mut Option<Watch<'_>>,
    ) -> Result<(), BackendError> {
        let last = self.ground.setting.closed_loop.final_time;
        let mut alive: Vec<usize> = (0..self.batch.status.len()).collect();
        let mut arrived = alive.clone();
        loop {
            self.ground.setting.numerics.deadline.check()?;
            let accepted = self.judged(&arrived);
            self.record(&accepted.iter().map(|(_, i)| *i).collect::<Vec<_>>());
            let going = self.onward(&accepted);
            self.give_laws(wings, watch, &going)?;
            alive.retain(|i| {
                self.batch.status[*i] == Status::Reached as i32 && self.courses[*i].t < last
            });
            if alive.is_empty() {
                break;
            }
            self.legs(wings, &alive, &mut arrived)?;
        }
        let ended: Vec<usize> = (0..self.batch.status.len())
            .filter(|i| self.batch.status[*i] == Status::Reached as i32)
            .collect();
        self.ground.conclude(self.pilots, self.batch, &ended, watch);
        Ok(())
    }

    fn interval(&self) -> f64 {
        self.ground.setting.closed_loop.interval()
    }

    /// The time at which a leg has to end at the latest.
    fn stop(&self, i: usize) -> f64 {
        self.courses[i].stop(self.ground.setting.closed_loop, self.sampled[i])
    }

    /// Asks the chart where legs have ended; the trajectories whose legs were good enough, each
    /// with the place of the answer. The others are where their legs began again.
    fn judged(&mut self, arrived: &[usize]) -> Vec<(usize, usize)> {
        let last = self.ground.setting.closed_loop.final_time - INSTANT * self.interval();
        let ends = |i: usize| self.courses[i].t + self.courses[i].length;
        let (lanes, done): (Vec<usize>, Vec<usize>) = (arrived.iter())
            .partition(|i| ends(**i) < last || self.ground.pace.judges(&self.courses[**i]));
        let middle = lanes.first().map_or(0.0, |i| ends(*i)) + 0.5 * self.ground.pace.leg_of_lost();
        (self.pilots.asked).ask(self.ground, self.pilots.chart, self.batch, &lanes, middle);
        let bad = self.undone(&lanes);
        let good = lanes
            .into_iter()
            .enumerate()
            .filter(|(_, i)| bad.binary_search(i).is_err());
        // Of those at the end nothing is asked any more.
        let mut accepted: Vec<(usize, usize)> = good
            .chain(done.into_iter().map(|i| (usize::MAX, i)))
            .collect();
        accepted.sort_unstable_by_key(|(_, i)| *i);
        accepted
    }

    /// Trajectories whose legs cost too much by the chart's answers, taken back to where these
    /// began.
    fn undone(&mut self, lanes: &[usize]) -> Vec<usize> {
        let Pace::AsNeeded(judge) = &self.ground.pace else {
            return Vec::new();
        };
        let dim = self.batch.dim;
        let judged: Vec<(usize, usize)> = (lanes.iter().copied().enumerate())
            .filter(|(_, i)| self.ground.pace.judges(&self.courses[*i]))
            .collect();
        // Under the law in use, under the chart's, and under that of the opposite p.
        let n = self.ground.equations.states;
        let mut laws = Vec::with_capacity(3 * judged.len() * dim);
        let mut p_in_use = Vec::with_capacity(judged.len() * n);
        let mut opposite = vec![0.0; n];
        for &(j, i) in &judged {
            if let Some(answer) = self.pilots.asked.answer(j) {
                let end = &self.batch.end[i * dim..][..dim];
                p_in_use.extend(chart_of(end, n));
                let at = laws.len();
                (0..3).for_each(|_| laws.extend_from_slice(end));
                set_chart(&mut laws[at + dim..][..dim], answer.p, answer.hessian);
                opposite.iter_mut().zip(answer.p).for_each(|(o, p)| *o = -p);
                set_chart(&mut laws[at + 2 * dim..], &opposite, answer.hessian);
            }
        }
        let rates = judge.rates(&laws, dim);
        let mut ends = rates
            .chunks_exact(3 * (n + 1))
            .zip(p_in_use.chunks_exact(n));
        let mut bad = Vec::new();
        for (j, i) in judged {
            let course = &mut self.courses[i];
            let verdict = match self.pilots.asked.answer(j) {
                Some(answer) => {
                    let (rates, p_in_use) = ends.next().expect("one for each answer");
                    let end = End {
                        in_use: &rates[..=n],
                        charted: &rates[n + 1..][..=n],
                        opposed: &rates[2 * (n + 1)..],
                        p: answer.p,
                        p_in_use,
                    };
                    judge.verdict(course, &end)
                }
                None => judge.failed(course),
            };
            course.wanted = verdict.length;
            if !verdict.good {
                self.batch.end[i * dim..][..dim].copy_from_slice(&self.begin[i * dim..][..dim]);
                bad.push(i);
            }
        }
        bad
    }

    /// Shows the legs of some trajectories to their records.
    fn record(&mut self, lanes: &[usize]) {
        if self.ground.setting.closed_loop.records.is_empty() {
            return;
        }
        let (dim, width) = (self.batch.dim, self.ground.observer_width());
        let flown: Vec<usize> = lanes
            .iter()
            .copied()
            .filter(|i| self.courses[*i].length > 0.0)
            .collect();
        let rows = |of: &[f64]| -> Vec<f64> {
            flown
                .iter()
                .flat_map(|i| &of[i * dim..][..dim])
                .copied()
                .collect()
        };
        let (from, to) = (rows(&self.begin), rows(&self.batch.end));
        let observer = &self.ground.observer;
        let (before, after) = (observer.eval(&from, dim), observer.eval(&to, dim));
        let courses = &self.courses;
        self.batch.records.each(|i, view| {
            if let Ok(j) = flown.binary_search(&i) {
                let ends = [&before[j * width..][..width], &after[j * width..][..width]];
                view.see(courses[i].length, &from[j * dim..][..dim], ends);
            }
        });
    }

    /// Adds good legs to the ways; those that go on.
    fn onward(&mut self, accepted: &[(usize, usize)]) -> Vec<(usize, usize)> {
        let scene = self.ground.setting.closed_loop;
        let instant = INSTANT * self.interval();
        let mut going = Vec::with_capacity(accepted.len());
        for &(j, i) in accepted {
            let stop = self.stop(i);
            let course = &mut self.courses[i];
            course.t += course.length;
            course.length = 0.0;
            if stop - course.t <= instant {
                course.t = stop;
                course.sample += 1;
            }
            self.batch.t_end[i] = course.t;
            if course.t < scene.final_time {
                going.push((j, i));
            }
        }
        going
    }

    /// Sets the laws of trajectories at the beginnings of their legs, and keeps samples.
    fn give_laws(
        &mut self,
        wings: &mut Wings<'_>,
        watch: &mut Option<Watch<'_>>,
        going: &[(usize, usize)],
    ) -> Result<(), BackendError> {
        let scene = self.ground.setting.closed_loop;
        let lost = self.ground.pace.leg_of_lost();
        let (courses, sampled) = (&self.courses, &self.sampled);
        let t = |i: usize| courses[i].t;
        let longest = going
            .iter()
            .map(|(_, i)| scene.final_time - t(*i))
            .fold(0.0, f64::max);
        let when = When {
            t: &t,
            rest: Rest {
                legs: (longest / lost - INSTANT).ceil() as usize,
                length: lost,
            },
            first: &|i| (courses[i].stop(scene, sampled[i]) - courses[i].t).min(lost),
        };
        (self.ground).set(wings, &mut self.pilots, self.batch, watch, (&when, going))?;
        for &(j, i) in going {
            self.courses[i].charted = self.pilots.asked.answer(j).is_some();
        }
        let (dim, interval) = (self.batch.dim, self.interval());
        for (i, path) in &mut self.batch.kept {
            let course = &self.courses[*i];
            let at_sample =
                (course.t - interval * (course.sample - 1) as f64).abs() <= INSTANT * interval;
            let here = going.binary_search_by_key(i, |(_, i)| *i).is_ok();
            if here && at_sample && self.batch.status[*i] == Status::Reached as i32 {
                self.ground
                    .keep(path, course.t, &self.batch.end[*i * dim..][..dim]);
            }
        }
        Ok(())
    }

    /// Flies a leg of each; `arrived` are then those that have come to its end.
    fn legs(
        &mut self,
        wings: &mut Wings<'_>,
        alive: &[usize],
        arrived: &mut Vec<usize>,
    ) -> Result<(), BackendError> {
        let dim = self.batch.dim;
        let mut vectors = Vec::with_capacity(alive.len() * dim);
        for &i in alive {
            let left = self.stop(i) - self.courses[i].t;
            let course = &mut self.courses[i];
            let lost = !course.charted && matches!(self.ground.pace, Pace::AsNeeded(_));
            course.length = match lost {
                true => left.min(self.ground.pace.leg_of_lost()),
                false => left / (left / course.wanted * (1.0 - INSTANT)).ceil().max(1.0),
            };
            course.legs += 1;
            vectors.extend_from_slice(&self.batch.end[i * dim..][..dim]);
        }
        let mut flown = std::mem::take(&mut self.flown);
        let length = |j: usize| self.courses[alive[j]].length;
        wings.fly((&vectors, dim), length, &mut flown)?;
        if self.pilots.outside != Outside::Stop {
            self.fly_stiff(wings, (alive, &mut vectors), &mut flown)?;
        }
        arrived.clear();
        let mut ended = Vec::new();
        for (j, &i) in alive.iter().enumerate() {
            let reached = flown.status[j] == Status::Reached;
            if !reached && self.ground.pace.may_shorten(&self.courses[i]) {
                // It stays where the leg began.
                self.courses[i].wanted = 0.5 * self.courses[i].length;
                self.courses[i].length = 0.0;
                continue;
            }
            self.begin[i * dim..][..dim].copy_from_slice(&vectors[j * dim..][..dim]);
            self.batch.end[i * dim..][..dim].copy_from_slice(&flown.end[j * dim..][..dim]);
            if reached {
                arrived.push(i);
                continue;
            }
            let (start, end) = (
                &self.batch.start[i * dim..][..dim],
                &flown.end[j * dim..][..dim],
            );
            self.batch.status[i] = self.ground.code(flown.status[j], start, end);
            self.batch.t_end[i] = self.courses[i].t + flown.end_time[j];
            self.courses[i].length = flown.end_time[j];
            ended.push(i);
        }
        self.record(&ended);
        self.flown = flown;
        Ok(())
    }

    /// Flies again, with p held, the legs that the model of V, next to where V is too steep for it,
    /// makes too stiff to follow.
    fn fly_stiff(
        &mut self,
        wings: &mut Wings<'_>,
        (alive, vectors): (&[usize], &mut [f64]),
        flown: &mut Trajectories,
    ) -> Result<(), BackendError> {
        let dim = self.batch.dim;
        for (j, &i) in alive.iter().enumerate() {
            if flown.status[j] != Status::StepLimit
                || self.ground.pace.may_shorten(&self.courses[i])
            {
                continue;
            }
            let vector = &mut vectors[j * dim..][..dim];
            hold_here(vector, self.ground.equations.states);
            self.batch.fallback[i] += 1;
            let mut again = Trajectories::default();
            wings.fly((vector, dim), |_| self.courses[i].length, &mut again)?;
            flown.status[j] = again.status[0];
            flown.end_time[j] = again.end_time[0];
            flown.end[j * dim..][..dim].copy_from_slice(&again.end);
        }
        Ok(())
    }
}
