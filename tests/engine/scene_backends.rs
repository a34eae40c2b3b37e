//! Every shipped scene on both backends: precision x method x scene, all trajectories compared, odd
//! batch sizes.

use crate::common;

use common::{Mismatch, Side, Tolerance, any_gpu, compare};
use costate::backend::{Backend, Status, Trajectories, cpu::Cpu};
use costate::low_level::hamiltonian::Hamiltonian;
use costate::low_level::model::{Method, Model, Precision};
use costate::low_level::sweep::{Choices, Plan};

const SCENES: [&str; 6] = [
    "pendulum",
    "moore_greitzer",
    "moore_greitzer_unconstrained",
    "linear_quadratic",
    "manufactured",
    "finite_horizon",
];
/// Around the sizes of lanes, workgroups and blocks.
const SIZES: [usize; 4] = [1, 63, 65, 345];
/// Levels stored a trajectory: enough to see every part of it.
const SAMPLES: usize = 12;

fn scene(name: &str, method: Method) -> (Model, Hamiltonian) {
    let path = format!("{}/scenarios/{name}.toml", crate::ROOT);
    let mut model =
        costate::low_level::scenario::load(path.as_ref(), &[]).expect("a shipped scene is valid");
    model.integrator.method = Some(method);
    model.integrator.step = (method == Method::Rk4).then_some(0.02);
    let shoot_out = model.shoot_out.as_mut().expect("shipped scenes are swept");
    shoot_out.samples = SAMPLES;
    // The far fronts of sensitive scenes amplify rounding a thousandfold and more: two backends are
    // compared where a wrong instruction shows and rounding does not.
    shoot_out.value_max = shoot_out.value_max.map(|v| 0.3 * v);
    let hamiltonian = Hamiltonian::derive(&model).expect("a shipped scene is in the class");
    (model, hamiltonian)
}

/// `count` seeds of the scene, spread over its surface, none outside the guards.
fn seeds(plan: &Plan, count: usize) -> Vec<f64> {
    let (_, mut parameters) = plan.surface.triangulation(usize::MAX);
    let mut k = 0;
    while parameters.len() < 3 * count {
        let other = (7 * k + 3) % parameters.len();
        let fraction = 0.1 + 0.8 * ((k as f64 * 0.618_034).fract());
        let next = plan
            .surface
            .toward(&parameters[k], &parameters[other], fraction);
        if next.iter().all(|x| x.is_finite()) {
            parameters.push(next);
        }
        k += 1;
    }
    let inside = parameters
        .into_iter()
        .rev()
        .map(|q| plan.surface.seed(&q))
        .filter(|s| plan.surface.inside(s));
    let list: Vec<Vec<f64>> = inside.take(count).collect();
    assert_eq!(
        list.len(),
        count,
        "the surface has too few seeds inside the guards"
    );
    list.concat()
}

/// What rounding may do. Both sides run the same program with the same step control, so that they
/// differ by rounding (a few units a step, of random sign). Rounding is relative to the state,
/// which grows as well, so that it is amplified by the ratio of the modes' growth, for which the
/// root of the largest growth is taken. With adaptive steps a step may be accepted on one side
/// only: each side is then within the sum of its steps' tolerances.
fn tolerance(plan: &Plan, seeds: &[f64], result: &Trajectories) -> Tolerance {
    const UNITS_A_STEP: f64 = 4.0;
    let n = plan.system.states;
    let size = |v: &[f64]| {
        v[..n]
            .iter()
            .zip(&plan.widths)
            .map(|(s, w)| (s / w).abs())
            .fold(0.0, f64::max)
    };
    let growth = (result.end.chunks(result.dim).zip(seeds.chunks(result.dim)))
        .map(|(end, seed)| size(end) / size(seed))
        .filter(|g| g.is_finite())
        .fold(1.0, f64::max);
    let steps = result.steps.iter().copied().max().map_or(1.0, f64::from);
    let rounding = UNITS_A_STEP * plan.spec.precision.epsilon() * (steps * growth).sqrt();
    let relative = match plan.spec.method {
        Method::Rk4 => rounding,
        Method::Tsit5 | Method::Dop853 | Method::Taylor => rounding + plan.run.rtol * steps,
    };
    // Components that pass through zero are measured against the scene's own sizes: those of V, the
    // largest.
    let scale = result
        .end
        .iter()
        .map(|v| v.abs())
        .filter(|v| v.is_finite())
        .fold(0.0, f64::max);
    Tolerance {
        relative,
        absolute: relative * scale.min(10.0),
        // Where a control meets its bound, rounding decides how many steps are rejected on the way
        // in.
        steps: match plan.spec.method {
            // As in tests/backends.rs: kinks met after some three refused steps, an estimate known
            // to a factor of two.
            Method::Dop853 => |steps| 2 + 6 * 3 + steps / 4,
            _ => |steps| 2 + steps / 4,
        },
        loose: &[Status::LeftRegion],
    }
}

#[test]
fn scenes_agree_on_both_backends() {
    let (cpu, gpu) = (Cpu::new(), any_gpu());
    for name in SCENES {
        for method in [Method::Rk4, Method::Tsit5, Method::Dop853] {
            let (model, hamiltonian) = scene(name, method);
            for precision in [Precision::F32, Precision::F64] {
                // At the scenes' own rtol, f32's error estimates are partly rounding noise, and so
                // would be its steps.
                let rtol = (precision == Precision::F32).then_some(1e-4);
                let choices = Choices {
                    precision: Some(precision),
                    rtol,
                    ..Choices::default()
                };
                let plan =
                    Plan::new(&model, &hamiltonian, &cpu, choices).expect("the scene can be swept");
                let dim = plan.spec.dim();
                let all = seeds(&plan, SIZES[3]);
                let mut on_cpu = cpu.compile(&plan.spec).expect("the CPU kernel compiles");
                let mut on_gpu = gpu.compile(&plan.spec).expect("the GPU kernel compiles");
                for size in SIZES {
                    let seeds = &all[..size * dim];
                    let a = on_cpu.integrate(&plan.run, seeds).expect("the CPU works");
                    let b = on_gpu.integrate(&plan.run, seeds).expect("the GPU works");
                    let sides = (
                        Side {
                            backend: cpu.name(),
                            result: &a,
                        },
                        Side {
                            backend: gpu.name(),
                            result: &b,
                        },
                    );
                    let tolerance = tolerance(&plan, seeds, &a);
                    let what = format!("{name} {} {} x {size}", precision.name(), method.name());
                    let agreement = compare(sides.0, sides.1, tolerance).unwrap_or_else(|e| {
                        panic!("{what}: {e}, relative tolerance {:.1e}", tolerance.relative)
                    });
                    println!(
                        "{what}: worst {:.2e} of tolerance {:.1e}",
                        agreement.worst, tolerance.relative
                    );
                    assert!(
                        agreement.samples >= size,
                        "{what}: only {} samples were compared",
                        agreement.samples
                    );

                    let mut spoiled = b.clone();
                    let sign = if b.end[0] < 0.0 { -1.0 } else { 1.0 };
                    spoiled.end[0] +=
                        sign * 3.0 * (tolerance.absolute + tolerance.relative * b.end[0].abs());
                    let spoiled = Side {
                        backend: gpu.name(),
                        result: &spoiled,
                    };
                    if b.status[0] != Status::LeftRegion {
                        assert!(
                            matches!(
                                compare(sides.0, spoiled, tolerance),
                                Err(Mismatch::Value { trajectory: 0, .. })
                            ),
                            "{what}: a perturbed result passes"
                        );
                    }
                }
            }
        }
    }
}
