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
    let scheme = Scheme {
        equations: eq,
        end,
        tolerance: 1e-9,
        duration,
    };
    let mut solver = Solver::new(&cpu, costate::model::Precision::F64, scheme, 1e-10).unwrap();
    let b: Vec<f64> = std::env::var("BOX")
        .map(|b| b.split(',').map(|x| x.parse().unwrap()).collect())
        .unwrap_or_else(|_| model.region.iter().flatten().copied().collect());
    let axes = (0..n)
        .map(|i| {
            let c = counts[i];
            (0..c)
                .map(|k| {
                    if c == 1 {
                        b[2 * i]
                    } else {
                        b[2 * i] + (b[2 * i + 1] - b[2 * i]) * k as f64 / (c as f64 - 1.0)
                    }
                })
                .collect()
        })
        .collect();
    let t1 = std::time::Instant::now();
    let targets = Targets::new(n, &[Grid { axes }], &[f64::INFINITY], &[], &plan.widths);
    let mut survey = Survey::new(&plan, &targets, &solver);
    let limit: f64 = args[5].parse().unwrap();
    let verbose = args.len() > 6;
    survey
        .run(
            &mut solver,
            &archive,
            Wanted {
                value_max: limit,
                sheets: limit > 0.0,
            },
            &mut |s, a, b| println!("  {s} {a}/{b} {:.3}", t1.elapsed().as_secs_f64()),
        )
        .unwrap();
    let dt = t1.elapsed().as_secs_f64();
    println!(
        "{} targets {:.3} s: {:.0}/s  {:?}",
        targets.len(),
        dt,
        targets.len() as f64 / dt,
        solver.work
    );
    println!(
        "windings {:?} extremals {} folds {} evals {:.1}",
        survey.windings,
        survey.extremals.len(),
        survey.folds.len(),
        survey.evaluations as f64 / targets.len() as f64
    );
    let mut by = std::collections::BTreeMap::new();
    for (e, s) in survey.extremals.iter().zip(&survey.sheet) {
        let w: &mut (usize, f64, f64, Vec<i32>) =
            by.entry(*s)
                .or_insert((0, f64::INFINITY, 0.0, survey.windings[e.winding].clone()));
        w.0 += 1;
        w.1 = w.1.min(e.value());
        w.2 = w.2.max(e.value());
    }
    for (s, w) in by.iter().take(30) {
        println!("sheet {s}: {w:?}");
    }
    let mut misses = std::collections::BTreeMap::new();
    for (t, m) in survey.misses.iter().enumerate() {
        if let Some(m) = m {
            *misses.entry(m.status.name()).or_insert(0) += 1;
            if verbose {
                println!("{:?} {m:?}", targets.state(t));
            }
        }
    }
    println!("misses {misses:?}");
    if verbose {
        for t in 0..targets.len() {
            println!(
                "{:?}: {:?}",
                targets.state(t),
                survey.at[t]
                    .iter()
                    .map(|e| format!(
                        "s{} V {:.8} fold {:.1e}",
                        survey.sheet[*e],
                        survey.extremals[*e].value(),
                        survey.extremals[*e].solved.fold
                    ))
                    .collect::<Vec<_>>()
            );
        }
    }
}
