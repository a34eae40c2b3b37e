//! What the tests of values at chosen states share: a scene solved at grids and points.
#![allow(dead_code, reason = "each test file uses its part")]

use costate::backend::{Backend, BackendError, cpu::Cpu};
use costate::low_level::model::Model;
use costate::low_level::shooting::Solver;
use costate::low_level::sweep::{Choices, Plan, sweep_keeping};
use costate::low_level::value::{self, Answers, Archive, Entry, Grid, Request};

#[allow(unused_imports, reason = "each test file uses its part")]
pub use crate::common_oracles::{parse, scene};

/// A scene swept, ready to be solved at states.
pub struct Swept {
    pub model: Model,
    pub plan: Plan,
    pub archive: Archive,
}

impl Swept {
    pub fn on(model: Model, backend: &dyn Backend, most: usize) -> Self {
        let hamiltonian = crate::common_oracles::derive(&model);
        let choices = Choices {
            inner_levels: true,
            max_seeds: Some(most),
            unasked: true,
            ..Choices::default()
        };
        let plan =
            Plan::new(&model, &hamiltonian, backend, choices).expect("the scene can be swept");
        let mut archive = Archive::new(&plan);
        sweep_keeping::<BackendError>(
            &plan,
            backend,
            &mut |_, _| {},
            &mut |seeds, batch| archive.keep(seeds, batch),
            None,
        )
        .expect("the backend works");
        Self {
            model,
            plan,
            archive,
        }
    }

    pub fn new(model: Model, most: usize) -> Self {
        Self::on(model, &Cpu::new(), most)
    }

    pub fn solver(&self) -> Solver {
        value::solver(&self.plan, &Cpu::new()).expect("the CPU compiles everything")
    }

    pub fn solve(&self, request: &Request) -> Answers {
        self.solve_with(&mut self.solver(), request)
    }

    pub fn solve_with(&self, solver: &mut Solver, request: &Request) -> Answers {
        value::solve(
            &self.plan,
            &self.model,
            solver,
            &self.archive,
            request,
            &mut |_, _, _| {},
        )
        .expect("the backend works")
    }

    pub fn points(&self, points: &[f64]) -> Answers {
        self.solve(&Request {
            points: points.to_vec(),
            ..Request::default()
        })
    }

    pub fn grid(&self, axes: Vec<Vec<f64>>) -> Answers {
        self.solve(&Request {
            grids: vec![Grid { axes }],
            limits: vec![f64::INFINITY],
            ..Request::default()
        })
    }
}

/// The lowest solution of the k-th state given.
pub fn given(answers: &Answers, k: usize) -> Option<&Entry> {
    answers.answer(answers.targets.of_given[k])
}

pub fn spaced(first: f64, last: f64, count: usize) -> Vec<f64> {
    (0..count)
        .map(|k| first + (last - first) * k as f64 / (count - 1) as f64)
        .collect()
}

pub fn largest(v: impl IntoIterator<Item = f64>) -> f64 {
    v.into_iter().fold(0.0, |a: f64, x| a.max(x.abs()))
}
