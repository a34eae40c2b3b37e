//! Whether Taylor's method is worth a shader: whole steps as the CPU records them, Taylor's and
//! those of Runge-Kutta methods, written as WGSL with nothing around them, and timed.
//!
//! `cargo test --release --lib -p costate straight -- --ignored --nocapture` prints a line a
//! setting: trajectories a second of the shooting-out work of `benches/shoot_out.rs` (pendulum,
//! four time units), the device's time, and the largest relative error of the ends.

use super::adapter::Device;
use super::clock::Clock;
use super::emit::WORKGROUP;
use super::memory::{read_back, reals};
use super::shader::{Fragment, Source, conditional};
use super::text::{self, condition, literal, primitive};
use crate::backend::adapters::Selection;
use crate::backend::cpu::Cpu;
use crate::backend::cpu::arithmetic::Comparison;
use crate::backend::cpu::code::{Binary, Fused, Op, Recorder, Value};
use crate::backend::cpu::steps::{self, Layout, Parameters};
use crate::backend::{Backend, By, Run, Spec, Variant};
use crate::hamiltonian::{Hamiltonian, System};
use crate::integrator::{Scheme, control};
use crate::local::Riccati;
use crate::model::{Method, Precision};
use crate::program::{Primitive, Program};
use std::fmt::Write;
use std::time::Instant;
use wgpu::BufferUsages;

const TRAJECTORIES: usize = 8192;
const REPEATS: usize = 5;
/// Steps of a trajectory at most.
const STEPS: u32 = 3000;

/// Straight-line code on the variables `f0`, `f1`, ... of a function.
fn statements(recorder: Recorder, precision: Precision, parameters: &[f64]) -> String {
    let ops = recorder.finish(1);
    let bits = 8 * precision.bytes();
    let all = u64::MAX >> (64 - bits);
    let suffix = if bits == 64 { "lu" } else { "u" };
    let mut text = String::new();
    // What stands for each value, and whether it is a truth.
    let mut names: Vec<(String, bool)> = Vec::with_capacity(ops.len());
    for (i, op) in ops.iter().enumerate() {
        let name = |v: Value| names[v as usize].0.as_str();
        let pattern = |v: Value| match ops[v as usize] {
            Op::Pattern(bits) => Some(bits),
            _ => None,
        };
        let truth = |v: Value| -> Option<String> {
            match (names[v as usize].1, pattern(v)) {
                (true, _) => Some(name(v).to_owned()),
                (_, Some(0)) => Some("false".to_owned()),
                (_, Some(bits)) if bits == all => Some("true".to_owned()),
                _ => None,
            }
        };
        let known = |v: Value| names[v as usize].1;
        let of_bits = |a: Value, operator: &str, b: Value| {
            format!(
                "bitcast<real>(bitcast<bits>({}) {operator} bitcast<bits>({}))",
                name(a),
                name(b)
            )
        };
        let mut is_truth = false;
        let expression = match *op {
            Op::Load(slot) => {
                names.push((format!("f{slot}"), false));
                continue;
            }
            Op::Parameter(p) => {
                names.push((literal(parameters[p as usize], precision), false));
                continue;
            }
            Op::Pattern(pattern) => {
                let value = match precision {
                    Precision::F32 => f64::from(f32::from_bits(pattern as u32)),
                    Precision::F64 => f64::from_bits(pattern),
                };
                let normal = value == 0.0 || value.is_normal();
                let exact = if value == f64::INFINITY {
                    "LARGEST".to_owned()
                } else if normal && !(value == 0.0 && value.is_sign_negative()) {
                    format!("real({})", literal(value, precision))
                } else {
                    format!("bitcast<real>(bits({pattern}{suffix}))")
                };
                names.push((exact, false));
                continue;
            }
            Op::Store(v, slot) => {
                let value = match known(v) {
                    true => format!("select(real(0.0), real(1.0), {})", name(v)),
                    false => name(v).to_owned(),
                };
                let _ = writeln!(text, "f{slot} = {value};");
                names.push((String::new(), false));
                continue;
            }
            Op::Binary(kind @ (Binary::And | Binary::Or | Binary::Xor), a, b) => {
                let operator = match kind {
                    Binary::And => "&",
                    Binary::Or => "|",
                    _ => "^",
                };
                match (truth(a), truth(b)) {
                    (Some(x), Some(y)) if known(a) || known(b) => {
                        is_truth = true;
                        match kind {
                            Binary::Xor => format!("{x} != {y}"),
                            _ => format!("{x} {operator} {y}"),
                        }
                    }
                    _ => of_bits(a, operator, b),
                }
            }
            Op::Binary(Binary::AddBits, a, b) => of_bits(a, "+", b),
            Op::Binary(Binary::Compare(how), a, b) => {
                is_truth = true;
                match how {
                    Comparison::Less => format!("{} < {}", name(a), name(b)),
                    Comparison::Equal => format!("{} == {}", name(a), name(b)),
                    Comparison::Unordered => format!(
                        "!(({a} <= 0.0) | ({a} > 0.0)) | !(({b} <= 0.0) | ({b} > 0.0))",
                        a = name(a),
                        b = name(b)
                    ),
                }
            }
            // A compiler may make `x` of `(x + magic) - magic`.
            Op::Binary(Binary::Sub, a, m) if rounds(&ops, a, m) => match ops[a as usize] {
                Op::Binary(_, x, _) => format!("round({})", name(x)),
                _ => unreachable!("it is a sum"),
            },
            Op::Binary(kind, a, b) => {
                let operator = match kind {
                    Binary::Add => "+",
                    Binary::Sub => "-",
                    Binary::Mul => "*",
                    _ => "/",
                };
                format!("{} {operator} {}", name(a), name(b))
            }
            Op::Fused(kind, a, b, c) => match kind {
                Fused::MulAdd => format!("{} * {} + {}", name(a), name(b), name(c)),
                Fused::MulSub => format!("{} * {} - {}", name(a), name(b), name(c)),
                Fused::NegMulAdd => format!("{} - {} * {}", name(c), name(a), name(b)),
            },
            Op::Sqrt(a) => format!("sqrt({})", name(a)),
            Op::ShiftLeft(a, by) => {
                format!("bitcast<real>(bitcast<bits>({}) << {by}u)", name(a))
            }
            Op::ShiftRight(a, by) => {
                format!("bitcast<real>(bitcast<bits>({}) >> {by}u)", name(a))
            }
            Op::Blend(mask, yes, no) => {
                let mask = match known(mask) {
                    true => name(mask).to_owned(),
                    false => format!(
                        "((bitcast<bits>({}) >> {}u) != 0{suffix})",
                        name(mask),
                        bits - 1
                    ),
                };
                match (truth(yes), truth(no)) {
                    (Some(x), Some(y)) if known(yes) || known(no) => {
                        is_truth = true;
                        format!("select({y}, {x}, {mask})")
                    }
                    _ => format!("select({}, {}, {mask})", name(no), name(yes)),
                }
            }
            Op::Call(Primitive::Sin, a) => {
                let _ = writeln!(text, "let pair{i} = sin_cos({});", name(a));
                names.push((format!("pair{i}.sine"), false));
                continue;
            }
            Op::Call(Primitive::Cos, _) if matches!(ops[i - 1], Op::Call(Primitive::Sin, _)) => {
                names.push((format!("pair{}.cosine", i - 1), false));
                continue;
            }
            Op::Call(f, a) => format!("{}({})", primitive(f), name(a)),
        };
        let _ = writeln!(text, "let v{i} = {expression};");
        names.push((format!("v{i}"), is_truth));
    }
    text
}

/// Whether `a - m` rounds: `a` is a sum with the same constant.
fn rounds(ops: &[Op], a: Value, m: Value) -> bool {
    matches!(ops[m as usize], Op::Pattern(_))
        && matches!(ops[a as usize], Op::Binary(Binary::Add, _, b) if b == m)
}

/// A module that integrates one trajectory an invocation, up to a time; how many operations its
/// step has.
fn module(spec: &Spec, scheme: Scheme, run: &Run) -> (Source, usize) {
    let (precision, layout) = (spec.precision, Layout::new(spec, scheme));
    let (dim, now, next) = (layout.dim, layout.now, layout.next);
    let parameters = match precision {
        Precision::F32 => Parameters::values::<f32>(run)
            .into_iter()
            .map(f64::from)
            .collect(),
        Precision::F64 => Parameters::values::<f64>(run),
    };
    let code = |record: &dyn Fn(&mut Recorder)| {
        let mut recorder = Recorder::new(precision, false);
        record(&mut recorder);
        let count = recorder.ops.len();
        (statements(recorder, precision, &parameters), count)
    };
    let (start, _) = code(&|r| steps::start(r, spec, &layout, Variant::default()));
    let (step, operations) = code(&|r| steps::step(r, spec, &layout, scheme, Variant::default()));
    let (share, wanted) = match scheme {
        Scheme::RungeKutta(tableau) => (tableau.first(), "min(first, END)"),
        Scheme::Taylor(_) => (control::SHARE, "END"),
    };
    let mut text = format!(
        "const END: real = {end};\n@group(0) @binding(0) var<storage, read_write> data: array<real>;\n\
         @compute @workgroup_size({WORKGROUP})\nfn main(@builtin(global_invocation_id) id: vec3<u32>) {{\n\
         if (id.x >= {TRAJECTORIES}u) {{ return; }}\nlet at = id.x * {row}u;\n",
        end = literal(run.levels[0], precision),
        row = dim + 1,
    );
    for slot in 0..layout.slots {
        let _ = writeln!(text, "var f{slot}: real = 0.0;");
    }
    for c in 0..dim {
        let _ = writeln!(text, "f{} = data[at + {c}u];", now.y + c);
    }
    text += &start;
    for c in 0..dim {
        let _ = writeln!(text, "f{} = f{};", next.y + c, now.y + c);
        if matches!(scheme, Scheme::RungeKutta(_)) {
            let _ = writeln!(text, "f{} = f{};", next.k + c, layout.dense + c);
        }
    }
    let _ = writeln!(
        text,
        "let first = {} * sqrt(f{} / f{});\nf{} = first;\nf{} = {wanted};\n\
         var count = 0u;\nloop {{\nif (count >= {STEPS}u) {{ break; }}\ncount = count + 1u;",
        literal(share, precision),
        layout.seed,
        layout.seed + 1,
        layout.first_step,
        next.wanted,
    );
    for (from, to) in (next.y..next.end).zip(now.y..) {
        let _ = writeln!(text, "f{to} = f{from};");
    }
    text += &step;
    let _ = writeln!(
        text,
        "if ((f{} != 0.0) & (f{} >= END * (1.0 - 4.0 * EPSILON))) {{ break; }}\n}}",
        layout.accepted, next.t
    );
    for c in 0..dim {
        let _ = writeln!(text, "data[at + {c}u] = f{};", next.y + c);
    }
    let _ = writeln!(text, "data[at + {dim}u] = real(count);\n}}");
    let source = Source::new(&[
        Fragment {
            name: "constants",
            text: text::constants(precision),
        },
        Fragment {
            name: "shaders/real.wgsl",
            text: conditional(
                include_str!("../../../shaders/real.wgsl"),
                &[condition(precision)],
            ),
        },
        Fragment {
            name: "straight",
            text,
        },
    ]);
    (source, operations)
}

struct Timed {
    ends: Vec<f64>,
    seconds: f64,
    compiling: f64,
    steps: f64,
}

/// Ends and counts of steps by trajectory, and the fastest of the repeats.
fn timed(device: &Device, source: Source, precision: Precision, rows: &[f64], row: usize) -> Timed {
    source.validate(device.info.f64_arithmetic).expect("valid");
    let begin = Instant::now();
    let descriptor = wgpu::ShaderModuleDescriptor {
        label: None,
        source: wgpu::ShaderSource::Wgsl(source.text.into()),
    };
    // SAFETY: the loop is bounded by a counter, indices by the number of trajectories.
    let module = unsafe {
        (device.device)
            .create_shader_module_trusted(descriptor, wgpu::ShaderRuntimeChecks::unchecked())
    };
    let pipeline = device
        .device
        .create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: None,
            layout: None,
            module: &module,
            entry_point: Some("main"),
            compilation_options: Default::default(),
            cache: None,
        });
    let bytes = reals(rows.iter().copied(), precision);
    let size = bytes.len() as u64;
    let buffer = |usage| {
        device.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size,
            usage,
            mapped_at_creation: false,
        })
    };
    let data = buffer(BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC);
    let staging = device.device.create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: size + 64,
        usage: BufferUsages::MAP_READ | BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    let group = device.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &pipeline.get_bind_group_layout(0),
        entries: &[wgpu::BindGroupEntry {
            binding: 0,
            resource: data.as_entire_binding(),
        }],
    });
    let clock = Clock::new(device);
    let mut best = f64::INFINITY;
    let mut compiling = 0.0;
    let mut all = Vec::new();
    for k in 0..=REPEATS {
        device.queue.write_buffer(&data, 0, &bytes);
        read_back(
            device,
            &staging,
            device.device.create_command_encoder(&Default::default()),
            [(&data, 16)],
            |_| (),
        )
        .expect("written");
        let before = Instant::now();
        let mut encoder = device.device.create_command_encoder(&Default::default());
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                label: None,
                timestamp_writes: clock.as_ref().map(Clock::writes),
            });
            pass.set_pipeline(&pipeline);
            pass.set_bind_group(0, &group, &[]);
            pass.dispatch_workgroups((TRAJECTORIES as u32).div_ceil(WORKGROUP), 1, 1);
        }
        let read = |b: &[u8]| -> Vec<f64> {
            match precision {
                Precision::F32 => bytemuck::pod_collect_to_vec::<u8, f32>(b)
                    .into_iter()
                    .map(f64::from)
                    .collect(),
                Precision::F64 => bytemuck::pod_collect_to_vec::<u8, f64>(b),
            }
        };
        let mut stamped = 0.0;
        all = match &clock {
            Some(clock) => {
                let stamps = clock.resolve(&mut encoder);
                read_back(
                    device,
                    &staging,
                    encoder,
                    [(stamps, Clock::BYTES), (&data, bytes.len())],
                    |[s, d]| {
                        stamped = clock.seconds(s);
                        read(d)
                    },
                )
            }
            None => read_back(device, &staging, encoder, [(&data, bytes.len())], |[d]| {
                read(d)
            }),
        }
        .expect("read");
        let seconds = if stamped > 0.0 {
            stamped
        } else {
            before.elapsed().as_secs_f64()
        };
        match k {
            // Drivers compile late.
            0 => compiling = begin.elapsed().as_secs_f64(),
            _ => best = best.min(seconds),
        }
    }
    let steps = all.chunks(row).map(|r| r[row - 1]).sum::<f64>() / TRAJECTORIES as f64;
    Timed {
        ends: all
            .chunks(row)
            .flat_map(|r| r[..row - 1].to_vec())
            .collect(),
        seconds: best,
        compiling,
        steps,
    }
}

#[test]
#[ignore = "a measurement"]
fn taylor_against_runge_kutta() {
    let device = Device::open(&Selection::Any)
        .expect("opens")
        .expect("an adapter");
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/scenarios/pendulum.toml");
    let model = crate::scenario::load(path.as_ref(), &[]).expect("valid");
    let hamiltonian = Hamiltonian::derive(&model).expect("in the class");
    let riccati = Riccati::solve(&hamiltonian, &model).expect("a local solution");
    let system = System::new(&hamiltonian, &model);
    let rate = Program::lower(&system.graph, &system.inputs, &system.rate);
    let p = &riccati.p;
    let factor = p.clone().cholesky().expect("positive").l().transpose();
    let inverse = factor.try_inverse().expect("regular");
    let seeds: Vec<f64> = (0..TRAJECTORIES)
        .flat_map(|i| {
            let angle = std::f64::consts::TAU * i as f64 / TRAJECTORIES as f64;
            let unit =
                nalgebra::DVector::from_vec(vec![angle.cos(), angle.sin()]) * (2e-4f64).sqrt();
            let s = &inverse * unit;
            let costate = p * &s;
            [s[0], s[1], costate[0], costate[1], 1e-4]
        })
        .collect();
    let dim = rate.outputs.len();
    assert_eq!(seeds.len(), TRAJECTORIES * dim);
    let spec = |method, precision| Spec {
        rate: rate.clone(),
        guards: None,
        kinks: None,
        method,
        precision,
        by: By::Time,
        store: false,
    };
    let run = |rtol: f64| Run {
        levels: vec![4.0],
        rtol,
        atol: vec![1e-3 * rtol; dim],
        max_steps: STEPS,
        step: 0.0,
        first: None,
        ceiling: None,
        bounds: Vec::new(),
    };
    let mut exact = Cpu::new()
        .compile(&spec(Method::Dop853, Precision::F64))
        .expect("compiles");
    let exact = exact
        .integrate(&run(1e-15), &seeds)
        .expect("integrates")
        .end;
    println!("# {}, {TRAJECTORIES} trajectories", device.info.name);
    let rows: Vec<f64> = seeds
        .chunks(dim)
        .flat_map(|s| s.iter().copied().chain([0.0]))
        .collect();
    let tolerances: [(Precision, &[f64]); 2] = [
        (Precision::F32, &[1e-3, 1e-4, 1e-5, 1e-6]),
        (Precision::F64, &[1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13]),
    ];
    for (precision, tolerances) in tolerances {
        if precision == Precision::F64 && !device.info.f64_arithmetic {
            continue;
        }
        for method in [Method::Tsit5, Method::Dop853, Method::Taylor] {
            for &rtol in tolerances {
                let scheme = method.scheme(rtol);
                let (source, operations) = module(&spec(method, precision), scheme, &run(rtol));
                let got = timed(&device, source, precision, &rows, dim + 1);
                let error = |(a, b): (&f64, &f64)| (a - b).abs() / b.abs().max(1.0);
                let worst = got.ends.iter().zip(&exact).map(error).fold(0.0, f64::max);
                println!(
                    "{} {:>6} rtol {rtol:.0e}: {operations:>5} operations, {:>6.1} steps, compiled in {:.2} s, \
                     {:>9.0} trajectories/s, largest error {worst:.1e}",
                    precision.name(),
                    method.name(),
                    got.steps,
                    got.compiling,
                    TRAJECTORIES as f64 / got.seconds,
                );
            }
        }
    }
}
