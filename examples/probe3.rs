use costate::backend::{Backend, By, Run, Spec, cpu::Cpu};
use costate::expr::{Graph, Kind};
use costate::model::{Method, Precision};
use costate::program::Program;
fn main() {
    let mut g = Graph::new();
    let inputs = [g.symbol("c", Kind::State), g.symbol("s", Kind::State)];
    let [c, s] = inputs;
    let (low, high, two) = (g.constant(-1.0), g.constant(1.0), g.constant(2.0));
    let dc = g.neg(s);
    let push = g.mul(two, c);
    let above = g.max(push, low);
    let limited = g.min(above, high);
    let roots = [dc, c, limited];
    let switches = g.kinks(&roots);
    let spec = Spec {
        rate: Program::lower(&g, &inputs, &roots),
        guards: None,
        kinks: Some(Program::lower(&g, &inputs, &switches)),
        method: Method::Taylor,
        precision: Precision::F64,
        by: By::Time,
        store: true,
    };
    println!("{:?}\n{:?}", spec.rate, spec.kinks);
    let count = 345;
    let seeds: Vec<f64> = (0..count)
        .flat_map(|i| {
            let a = std::f64::consts::TAU * i as f64 / count as f64;
            [a.cos(), a.sin(), 0.0]
        })
        .collect();
    let levels: Vec<f64> = (1..=120).map(|k| k as f64 * 0.05).collect();
    let run = Run {
        rtol: 1e-10,
        atol: vec![1e-10; 3],
        step: 0.0,
        max_steps: 2000,
        levels: levels.clone(),
        ceiling: None,
        bounds: vec![],
    };
    let r = Cpu::new().compile(&spec).unwrap().integrate(&run, &seeds).unwrap();
    let clamp = |a: f64| (2.0 * a.cos()).clamp(-1.0, 1.0);
    let mut shown = 0;
    for i in 0..count {
        let a0 = std::f64::consts::TAU * i as f64 / count as f64;
        let mut exact = 0.0;
        let mut t = 0.0;
        for (l, level) in levels.iter().enumerate() {
            while t < level - 1e-9 {
                exact += 1e-5 * clamp(a0 + t + 0.5e-5);
                t += 1e-5;
            }
            let e = r.sample(i, l)[3] - exact;
            if e.abs() > 1e-7 {
                println!(
                    "{i}: level {level} push {:.6} err {e:.2e} steps {}",
                    2.0 * (a0 + level).cos(),
                    r.steps[i]
                );
                shown += 1;
                break;
            }
        }
        if shown > 8 {
            break;
        }
    }
}
