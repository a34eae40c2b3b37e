//! What the tests of the closed loop share: scenes evaluated, and an integrator of their own.
#![allow(dead_code, reason = "every test crate uses a part")]

use costate::backend::Backend;
use costate::low_level::closed_loop::{Chart, Evaluation, Initial, Law, LawResult, Laws, Setting};
use costate::low_level::hamiltonian::Hamiltonian;
use costate::low_level::model::{Method, Model, Precision};
use costate::low_level::sweep::Choices;

use crate::common;
pub use common::any_gpu;

pub struct Scene {
    pub model: Model,
    pub hamiltonian: Hamiltonian,
}

/// How an evaluation is to be integrated.
#[derive(Clone, Copy, Debug)]
pub struct Asked {
    pub precision: Precision,
    pub rtol: f64,
    pub method: Option<Method>,
}

pub const TIGHT: Asked = Asked {
    precision: Precision::F64,
    rtol: 1e-10,
    method: None,
};

impl Scene {
    pub fn new(text: &str) -> Self {
        let model = costate::low_level::scenario::parse(text, "test.toml", &[])
            .unwrap_or_else(|e| panic!("{}", e.render(false)));
        Self::of(model)
    }

    pub fn of(model: Model) -> Self {
        let hamiltonian =
            Hamiltonian::derive(&model).unwrap_or_else(|problems| panic!("{problems:?}"));
        Self { model, hamiltonian }
    }

    pub fn initial(&self) -> Initial {
        Initial::new(
            &self.model,
            self.model.closed_loop.as_ref().unwrap(),
            None,
            0,
        )
        .unwrap()
    }

    /// The laws named, from the scene's initial states or those given.
    pub fn evaluate(
        &self,
        backend: &dyn Backend,
        asked: Asked,
        names: &[&str],
        initial: Initial,
        chart: Option<&dyn Chart>,
        values: Option<Vec<f64>>,
    ) -> Evaluation {
        let closed_loop = self
            .model
            .closed_loop
            .as_ref()
            .expect("the scene has a closed loop");
        let laws = Laws::new(&self.model, &self.hamiltonian, closed_loop.track);
        let choices = Choices {
            precision: Some(asked.precision),
            rtol: Some(asked.rtol),
            method: asked.method,
            ..Choices::default()
        };
        let setting = Setting::new(&laws, closed_loop, backend, choices).unwrap();
        let chosen: Vec<Law> = (names.iter())
            .map(|name| match *name {
                "lqr" => laws.lqr().unwrap(),
                "map" => laws.chart("map"),
                name => {
                    let given = closed_loop.given.iter().find(|g| g.name == name).unwrap();
                    laws.given(given).unwrap_or_else(|e| panic!("{e}"))
                }
            })
            .collect();
        setting
            .evaluate(&chosen, initial, chart, values, backend, &mut |_| {})
            .unwrap_or_else(|e| panic!("{}: {e}", backend.name()))
    }

    /// One law on the CPU, tightly.
    pub fn tightly(&self, name: &str) -> LawResult {
        let cpu = costate::backend::cpu::Cpu::new();
        self.evaluate(&cpu, TIGHT, &[name], self.initial(), None, None)
            .laws
            .remove(0)
    }
}

/// The classical Runge-Kutta method with small steps: a reference that shares nothing with the
/// program.
pub fn runge_kutta(
    f: &dyn Fn(&[f64]) -> Vec<f64>,
    start: &[f64],
    time: f64,
    steps: usize,
    see: &mut dyn FnMut(&[f64]),
) -> Vec<f64> {
    let h = time / steps as f64;
    let mut y = start.to_vec();
    let along = |y: &[f64], k: &[f64], h: f64| -> Vec<f64> {
        y.iter().zip(k).map(|(y, k)| y + h * k).collect()
    };
    see(&y);
    for _ in 0..steps {
        let k1 = f(&y);
        let k2 = f(&along(&y, &k1, 0.5 * h));
        let k3 = f(&along(&y, &k2, 0.5 * h));
        let k4 = f(&along(&y, &k3, h));
        for i in 0..y.len() {
            y[i] += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
        }
        see(&y);
    }
    y
}
