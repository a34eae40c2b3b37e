//! What the tests of scenarios/hard share.
#![allow(dead_code, reason = "each test file uses its part")]

use crate::common::any_gpu;
use crate::common_oracles::{Asked, F32, F64, Sweep, scene};
use costate::backend::{Backend, cpu::Cpu};
use costate::low_level::model::Model;

/// A scene in scenarios/hard.
pub fn hard(name: &str) -> Model {
    scene(&format!("hard/{name}"), &[])
}

/// Both backends, each in both precisions.
pub fn everywhere(model: &Model, mut look: impl FnMut(&Sweep, Asked, &str)) {
    for asked in [F64, F32] {
        for backend in [
            Box::new(Cpu::new()) as Box<dyn Backend>,
            Box::new(any_gpu()),
        ] {
            let what = format!(
                "{} {} {}",
                model.title,
                backend.name(),
                asked.precision.name()
            );
            let sweep = Sweep::on(backend, model, asked);
            nothing_is_padded(&sweep, &what);
            look(&sweep, asked, &what);
        }
    }
}

/// What is stored is finite up to a trajectory's end and NaN after it, and every trajectory is
/// counted once.
pub fn nothing_is_padded(sweep: &Sweep, what: &str) {
    let levels = sweep.plan.samples();
    let mut points = 0;
    for i in 0..sweep.count() {
        // Rising t: what does not exist comes first.
        let t = &sweep.stored.t[i * levels..][..levels];
        let first = t.iter().take_while(|t| t.is_nan()).count();
        assert!(
            t[first..].iter().all(|t| t.is_finite()),
            "{what}: a hole in trajectory {i}"
        );
        points += levels - first;
    }
    for s in sweep.samples() {
        let all = s.x.iter().chain(s.p).chain(s.u).chain([&s.v, &s.h]);
        assert!(
            all.into_iter().all(|x| x.is_finite()),
            "{what}: not finite at t = {}",
            s.t
        );
    }
    assert!(points > 0, "{what}: nothing is stored");
    let counted: usize = sweep.report.by_status.values().sum();
    assert_eq!(counted, sweep.count(), "{what}: statuses");
}
