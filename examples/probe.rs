use costate::backend::{BackendError, cpu::Cpu};
use costate::hamiltonian::Hamiltonian;
use costate::shooting::*;
use costate::sweep::*;
use costate::value::*;
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let model = costate::scenario::load(std::path::Path::new(&args[1]), &[]).unwrap();
    let h = Hamiltonian::derive(&model).unwrap();
    let cpu = Cpu::new();
    let most: usize = args[2].parse().unwrap();
    let counts: Vec<usize> = args[3].split(',').map(|x| x.parse().unwrap()).collect();
    let columns: usize = args[4].parse().unwrap();
    let t0 = std::time::Instant::now();
    let plan = Plan::new(
        &model,
        &h,
        &cpu,
        Choices {
            inner_levels: true,
            max_seeds: Some(most),
            ..Choices::default()
        },
    )
    .unwrap();
    let mut archive = Archive::new(&plan);
    let rep = sweep_keeping::<BackendError>(&plan, &cpu, &mut |_, _| {}, &mut |s, b| archive.keep(s, b), &mut |_| {
        Ok(())
    })
    .unwrap();
    println!(
        "sweep {} traj {:.3}s, {} MB",
        rep.trajectories,
        t0.elapsed().as_secs_f64(),
        archive.bytes() >> 20
    );
    let n = plan.widths.len();
    let end = End::new(&plan.system, plan.local.as_ref());
    let vs = plan.shoot_out.value_max.unwrap_or(1.0);
    let eq = Equations::new(&plan.system, &plan.widths, vs, columns);
    println!("columns {} groups {} ops {}", eq.columns, eq.groups(), eq.operations());
    let duration = segment_duration(&plan);
    let index = Index::new(&archive, &plan.widths, &plan.region, plan.shoot_out.spacing);
    println!(
        "index {} {:.3}s duration {duration}",
        index.len(),
        t0.elapsed().as_secs_f64()
    );
    let scheme = Scheme {
        equations: eq,
        end,
        tolerance: 1e-9,
        duration,
    };
    let mut solver = Solver::new(&cpu, costate::model::Precision::F64, scheme, 1e-10).unwrap();
    // targets
    let mut targets: Vec<Vec<f64>> = vec![vec![]];
    for i in 0..n {
        let [lo, hi] = if let Ok(b) = std::env::var("BOX") {
            let v: Vec<f64> = b.split(',').map(|x| x.parse().unwrap()).collect();
            [
                v[2 * i] - plan.system.reference[i],
                v[2 * i + 1] - plan.system.reference[i],
            ]
        } else {
            plan.region[i]
        };
        let c = counts[i];
        targets = targets
            .into_iter()
            .flat_map(|t| {
                (0..c).map(move |k| {
                    let mut t = t.clone();
                    t.push(if c == 1 && std::env::var("BOX").is_ok() {
                        lo
                    } else if c == 1 {
                        0.0
                    } else {
                        lo + (hi - lo) * (k as f64) / (c as f64 - 1.0)
                    });
                    t
                })
            })
            .collect();
    }
    let t1 = std::time::Instant::now();
    let mut ways: Vec<Approach> = targets
        .iter()
        .map(|t| {
            let q: Vec<f64> = t.iter().zip(&plan.widths).map(|(s, w)| s / w).collect();
            let near = index.near(&q, 0.0, 1)[0];
            Approach::new(archive.path(near.0, &solver.scheme.end, vs * 0.01, duration), t.clone())
        })
        .collect();
    println!("guesses {:.3}s", t1.elapsed().as_secs_f64());
    follow(&mut solver, &mut ways).unwrap();
    let dt = t1.elapsed().as_secs_f64();
    println!(
        "{} targets {:.3} s: {:.0}/s  {:?}",
        targets.len(),
        dt,
        targets.len() as f64 / dt,
        solver.work
    );
    let mut fails = std::collections::BTreeMap::new();
    let mut worst_h = 0.0f64;
    let mut evals = 0;
    let mut segs = 0;
    for (t, w) in targets.iter().zip(ways) {
        let (e, r) = w.finish();
        evals += e;
        match r {
            Ok((job, s)) => {
                segs += job.path.segments();
                let h = plan.system.eval(
                    &[plan.system.observer.hamiltonian],
                    job.path.start(),
                    job.path.adjoint(),
                )[0];
                let l = plan
                    .system
                    .eval(&[plan.system.rate[2 * n]], job.path.start(), job.path.adjoint())[0];
                worst_h = worst_h.max(h.abs() / l.abs());
                if args.len() > 5 {
                    println!(
                        "{:?} V {:.9} p {:?} fold {:.2e} res {:.1e}",
                        t,
                        s.value,
                        job.path.adjoint(),
                        s.fold,
                        s.residual
                    );
                }
            }
            Err(u) => {
                *fails.entry(format!("{:?}", u.failure)).or_insert(0) += 1;
                if args.len() > 5 {
                    println!("{:?} FAIL {:?} at {}", t, u.failure, u.share);
                }
            }
        }
    }
    println!(
        "fails {fails:?} worst |H|/L {worst_h:.1e} evals {:.1} segs {:.1}",
        evals as f64 / targets.len() as f64,
        segs as f64 / targets.len() as f64
    );
}
