// Temporary: methods against each other on a scene's own sweep seeds.
use costate::backend::{Backend, cpu::Cpu};
use costate::hamiltonian::Hamiltonian;
use costate::model::{Method, Precision};
use costate::sweep::{Choices, Plan, sweep_keeping};
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let path = format!("{}/scenarios/{}.toml", env!("CARGO_MANIFEST_DIR"), args[1]);
    let rtol: f64 = args[2].parse().unwrap();
    let precision = if args.get(3).is_some_and(|a| a == "f32") {
        Precision::F32
    } else {
        Precision::F64
    };
    let model = costate::scenario::load(path.as_ref(), &[]).unwrap();
    let hamiltonian = Hamiltonian::derive(&model).unwrap();
    let cpu = Cpu::new();
    let plan = |method, rtol, precision| {
        Plan::new(
            &model,
            &hamiltonian,
            &cpu,
            Choices {
                method: Some(method),
                rtol: Some(rtol),
                precision: Some(precision),
                max_seeds: Some(1000),
                ..Choices::default()
            },
        )
        .unwrap()
    };
    let base = plan(Method::Dop853, 1e-13, Precision::F64);
    let mut seeds = Vec::new();
    sweep_keeping::<costate::backend::BackendError>(
        &base,
        &cpu,
        &mut |_, _| {},
        &mut |s, _| seeds.extend_from_slice(s),
        &mut |_| Ok(()),
    )
    .unwrap();
    let dim = base.spec.dim();
    let reference = cpu.compile(&base.spec).unwrap().integrate(&base.run, &seeds).unwrap();
    for method in [Method::Tsit5, Method::Dop853, Method::Taylor] {
        let p = plan(method, rtol, precision);
        let mut k = cpu.compile(&p.spec).unwrap();
        let mut run = p.run.clone();
        run.levels = base.run.levels.clone();
        let mut best = f64::INFINITY;
        let mut r = k.integrate(&run, &seeds).unwrap();
        for _ in 0..5 {
            let t = std::time::Instant::now();
            r = k.integrate(&run, &seeds).unwrap();
            best = best.min(t.elapsed().as_secs_f64());
        }
        let n = r.count();
        let mut worst: Vec<(f64, usize, usize)> = Vec::new();
        for i in 0..n {
            let mut w = (0.0, i, 0);
            for l in 0..r.levels {
                let (a, b) = (r.sample(i, l), reference.sample(i, l));
                for c in 1..=dim {
                    let e = (a[c] - b[c]).abs() / b[c].abs().max(1.0);
                    if e > w.0 {
                        w = (e, i, l);
                    }
                }
            }
            worst.push(w);
        }
        worst.sort_by(|a, b| a.0.total_cmp(&b.0));
        let differ = (0..n).filter(|i| r.status[*i] != reference.status[*i]).count();
        let (s, rej): (u32, u32) = (r.steps.iter().sum(), r.rejected.iter().sum());
        let mut counts = std::collections::BTreeMap::new();
        for s in &r.status {
            *counts.entry(s.name()).or_insert(0) += 1;
        }
        if method == Method::Taylor && args.len() > 4 {
            dump(&p, &r, &reference, args[4].parse().unwrap());
        }
        println!(
            "{}: {n} trajectories, {:.0}/s, {:.1} steps + {:.1}; error median {:.1e} p99 {:.1e} worst {:.1e} (trajectory {} level {}), statuses differ {differ} {counts:?}",
            method.name(),
            n as f64 / best,
            s as f64 / n as f64,
            rej as f64 / n as f64,
            worst[n / 2].0,
            worst[n * 99 / 100].0,
            worst[n - 1].0,
            worst[n - 1].1,
            worst[n - 1].2
        );
    }
}
#[allow(dead_code)]
pub fn dump(p: &Plan, r: &costate::backend::Trajectories, reference: &costate::backend::Trajectories, i: usize) {
    let kinks = p.spec.kinks.as_ref().unwrap();
    for l in 0..r.levels {
        let (a, b) = (r.sample(i, l), reference.sample(i, l));
        let e = (1..=p.spec.dim())
            .map(|c| (a[c] - b[c]).abs() / b[c].abs().max(1.0))
            .fold(0.0, f64::max);
        println!(
            "level {l} t {:.6} err {e:.1e} kinks {:?} p4 {:.6}",
            b[0],
            kinks.eval(&b[1..=kinks.inputs]),
            b[8]
        );
    }
    println!("steps {}", r.steps[i]);
}
