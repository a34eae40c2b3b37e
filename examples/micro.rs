use costate::backend::{Backend, cpu::Cpu};
use costate::hamiltonian::Hamiltonian;
use costate::model::{Method, Precision};
use costate::shooting::*;
use costate::sweep::*;
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let model = costate::scenario::load(std::path::Path::new(&args[1]), &[]).unwrap();
    let h = Hamiltonian::derive(&model).unwrap();
    let cpu = Cpu::new();
    let plan = Plan::new(
        &model,
        &h,
        &cpu,
        Choices {
            inner_levels: true,
            max_seeds: Some(1000),
            ..Choices::default()
        },
    )
    .unwrap();
    let n = plan.widths.len();
    for columns in [1000, 32, 16, 8] {
        let eq = Equations::new(
            &plan.system,
            &plan.widths,
            plan.shoot_out.value_max.unwrap_or(1.0),
            columns,
        );
        for method in [Method::Tsit5, Method::Dop853] {
            for (name, spec, run, width, groups) in [
                (
                    "plain",
                    eq.plain_spec(method, Precision::F64, false),
                    eq.plain_run(1e-10, 10000, 1),
                    eq.plain_width(),
                    1,
                ),
                (
                    "varied",
                    eq.varied_spec(method, Precision::F64),
                    eq.varied_run(1e-10, 10000),
                    eq.varied_width(),
                    eq.groups(),
                ),
            ] {
                let mut k = cpu.compile(&spec).unwrap();
                for count in [64, 4096] {
                    let mut seeds = vec![0.0; count * width];
                    let local = plan.local.as_ref().unwrap();
                    for i in 0..count {
                        let a = i as f64 * 0.7;
                        let d: Vec<f64> = (0..n).map(|j| (a * (j + 1) as f64).sin()).collect();
                        let norm = d.iter().map(|x| x * x).sum::<f64>().sqrt();
                        let d: Vec<f64> = d.iter().map(|x| x / norm).collect();
                        let s = local.seed(&d);
                        for j in 0..2 * n {
                            seeds[i * width + j] = s[j] * 30.0;
                        }
                        seeds[i * width + 2 * n] = 1.0;
                        seeds[i * width + 2 * n + 1] = 1.0;
                    }
                    let t = std::time::Instant::now();
                    let r = k.integrate(&run, &seeds).unwrap();
                    let dt = t.elapsed().as_secs_f64();
                    let t = std::time::Instant::now();
                    let _ = k.integrate(&run, &seeds).unwrap();
                    let dt = dt.min(t.elapsed().as_secs_f64());
                    let steps: u32 = r.steps.iter().sum();
                    let rej: u32 = r.rejected.iter().sum();
                    println!(
                        "cols {columns} {method:?} {name} count {count}: {:.1} us/segment (x{groups} groups = {:.1}), {:.1} steps, {:.1} rejected; {:.0} ksteps/s",
                        dt / count as f64 * 1e6,
                        dt / count as f64 * 1e6 * groups as f64,
                        steps as f64 / count as f64,
                        rej as f64 / count as f64,
                        steps as f64 / dt / 1e3
                    );
                }
            }
        }
    }
}
