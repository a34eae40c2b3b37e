//! The elementary functions on the device, and messages for shaders that do not validate.

use super::adapter::Device;
use super::memory::reals;
use super::shader::{Fragment, Source, conditional};
use super::text::{self, primitive};
use crate::backend::BackendError;
use crate::backend::adapters::Selection;
use crate::model::Precision;
use crate::program::Primitive;

fn device() -> Device {
    Device::open(&Selection::Any)
        .expect("an adapter")
        .expect("an adapter; install a software one such as llvmpipe")
}

const REAL: &str = include_str!("../../../shaders/real.wgsl");

/// Values of a WGSL expression in `a` and `b` at points.
fn evaluate(
    device: &Device,
    precision: Precision,
    expression: &str,
    points: &[(f64, f64)],
) -> Vec<f64> {
    let entry = format!(
        "@group(0) @binding(0) var<storage, read_write> data: array<real>;\n\
         @compute @workgroup_size(64)\nfn main(@builtin(global_invocation_id) id: vec3<u32>) {{\n\
         if (id.x >= {n}u) {{ return; }}\n\
         let a = data[2u * id.x];\nlet b = data[2u * id.x + 1u];\ndata[2u * id.x] = {expression};\n}}\n",
        n = points.len()
    );
    let name = match precision {
        Precision::F32 => "F32",
        Precision::F64 => "F64",
    };
    let source = Source::new(&[
        Fragment {
            name: "constants",
            text: text::constants(precision),
        },
        Fragment {
            name: "shaders/real.wgsl",
            text: conditional(REAL, &[name]),
        },
        Fragment {
            name: "entry",
            text: entry,
        },
    ]);
    source.validate(device.info.f64_arithmetic).unwrap();
    let module = device
        .device
        .create_shader_module(wgpu::ShaderModuleDescriptor {
            label: None,
            source: wgpu::ShaderSource::Wgsl(source.text.into()),
        });
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
    let bytes = reals(points.iter().flat_map(|(a, b)| [*a, *b]), precision);
    let buffer = |usage| {
        let size = bytes.len() as u64;
        device.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size,
            usage,
            mapped_at_creation: false,
        })
    };
    use wgpu::BufferUsages;
    let data = buffer(BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC);
    let staging = buffer(BufferUsages::MAP_READ | BufferUsages::COPY_DST);
    device.queue.write_buffer(&data, 0, &bytes);
    let bindings = device.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &pipeline.get_bind_group_layout(0),
        entries: &[wgpu::BindGroupEntry {
            binding: 0,
            resource: data.as_entire_binding(),
        }],
    });
    let mut encoder = device.device.create_command_encoder(&Default::default());
    {
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, &bindings, &[]);
        pass.dispatch_workgroups((points.len() as u32).div_ceil(64), 1, 1);
    }
    encoder.copy_buffer_to_buffer(&data, 0, &staging, 0, bytes.len() as u64);
    device.queue.submit([encoder.finish()]);
    staging.map_async(wgpu::MapMode::Read, .., |outcome| outcome.unwrap());
    device
        .device
        .poll(wgpu::PollType::wait_indefinitely())
        .unwrap();
    device.check().unwrap();
    let view = staging.get_mapped_range(..).unwrap();
    let bytes: &[u8] = &view;
    let all: Vec<f64> = match precision {
        Precision::F32 => bytemuck::cast_slice::<u8, f32>(bytes)
            .iter()
            .map(|x| f64::from(*x))
            .collect(),
        Precision::F64 => bytemuck::cast_slice::<u8, f64>(bytes).to_vec(),
    };
    all.into_iter().step_by(2).collect()
}

fn rounded(x: f64, precision: Precision) -> f64 {
    match precision {
        Precision::F32 => f64::from(x as f32),
        Precision::F64 => x,
    }
}

/// Largest error of a primitive over `points` in units of rounding of the exact value (or of
/// `floor`), and where.
fn worst(
    device: &Device,
    precision: Precision,
    f: Primitive,
    points: &[f64],
    floor: f64,
) -> (f64, f64) {
    let points: Vec<(f64, f64)> = points
        .iter()
        .map(|x| (rounded(*x, precision), 0.0))
        .collect();
    let got = evaluate(device, precision, &format!("{}(a)", primitive(f)), &points);
    let mut most = (0.0, 0.0);
    for ((x, _), got) in points.iter().zip(got) {
        let want = f.apply(*x);
        let error = (got - want).abs() / (precision.epsilon() * want.abs().max(floor));
        // A NaN is the worst of all.
        if error.is_nan() || error > most.0 {
            most = (if error.is_nan() { f64::INFINITY } else { error }, *x);
        }
    }
    most
}

fn grid(lo: f64, hi: f64) -> Vec<f64> {
    (0..=20_000)
        .map(|i| lo + (hi - lo) * f64::from(i) / 20_000.0)
        .collect()
}

fn accuracy(precision: Precision) {
    let device = device();
    let tiny: Vec<f64> = grid(-0.99, 0.99).iter().map(|x| x.powi(7)).collect();
    let positive: Vec<f64> = grid(-60.0, 60.0).iter().map(|x| x.exp()).collect();
    let near = grid(-40.0, 40.0);
    use Primitive::{Abs, Atan, Cos, Exp, Expm1, Log, Log1p, Sign, Sin, Sqrt, Step};
    // Bounds are the CPU's, which has tests like these.
    let cases: [(Primitive, &[f64], f64, f64); 14] = [
        (Sin, &near, 0.5, 2.0),
        (Cos, &near, 0.5, 2.0),
        (Sin, &tiny, 1e-30, 2.0),
        (Exp, &grid(-80.0, 80.0), 1e-35, 2.0),
        (Expm1, &grid(-5.0, 5.0), 1e-30, 3.0),
        (Expm1, &tiny, 1e-30, 3.0),
        (Log, &positive, 1e-30, 2.0),
        (Log1p, &tiny, 1e-30, 3.0),
        (Log1p, &positive, 1e-30, 3.0),
        (Atan, &grid(-30.0, 30.0), 1e-30, 3.0),
        (Sqrt, &positive, 1e-30, 1.0),
        (Abs, &near, 1e-30, 1e-9),
        (Sign, &near, 1e-30, 1e-9),
        (Step, &near, 1e-30, 1e-9),
    ];
    let failed: Vec<String> = (cases.iter())
        .map(|(f, points, floor, bound)| (f, worst(&device, precision, *f, points, *floor), bound))
        .filter(|(_, (error, _), bound)| *error >= **bound)
        .map(|(f, (error, x), bound)| {
            format!("{f:?}: {error:.3e} units of rounding at {x:e}, allowed {bound}")
        })
        .collect();
    assert!(failed.is_empty(), "{}", failed.join("\n"));
}

#[test]
fn functions_are_accurate_in_f32() {
    accuracy(Precision::F32);
}

#[test]
fn functions_are_accurate_in_f64() {
    accuracy(Precision::F64);
}

#[test]
fn special_values_are_kept() {
    let device = device();
    let (inf, nan) = (f64::INFINITY, f64::NAN);
    for precision in [Precision::F32, Precision::F64] {
        let check = |expression: &str, cases: &[(f64, f64, f64)]| {
            let points: Vec<(f64, f64)> = cases.iter().map(|(a, b, _)| (*a, *b)).collect();
            for (got, (a, b, want)) in evaluate(&device, precision, expression, &points)
                .iter()
                .zip(cases)
            {
                let same = got == want || (got.is_nan() && want.is_nan());
                assert!(
                    same,
                    "{precision:?} {expression} at a = {a}, b = {b}: {got} instead of {want}"
                );
            }
        };
        check(
            "exponential(a)",
            &[
                (inf, 0.0, inf),
                (-inf, 0.0, 0.0),
                (nan, 0.0, nan),
                (1e4, 0.0, inf),
                (0.0, 0.0, 1.0),
            ],
        );
        check(
            "expm1_(a)",
            &[
                (inf, 0.0, inf),
                (-inf, 0.0, -1.0),
                (nan, 0.0, nan),
                (0.0, 0.0, 0.0),
            ],
        );
        check(
            "logarithm(a)",
            &[
                (inf, 0.0, inf),
                (0.0, 0.0, -inf),
                (-1.0, 0.0, nan),
                (nan, 0.0, nan),
                (1.0, 0.0, 0.0),
            ],
        );
        check(
            "log1p_(a)",
            &[
                (inf, 0.0, inf),
                (-1.0, 0.0, -inf),
                (-2.0, 0.0, nan),
                (nan, 0.0, nan),
            ],
        );
        check("arctangent(a)", &[(nan, 0.0, nan), (0.0, 0.0, 0.0)]);
        let half_pi = rounded(std::f64::consts::FRAC_PI_2, precision);
        check(
            "arctangent(a)",
            &[(inf, 0.0, half_pi), (-inf, 0.0, -half_pi)],
        );
        check(
            "sine(a)",
            &[(nan, 0.0, nan), (inf, 0.0, nan), (-inf, 0.0, nan)],
        );
        check(
            "cosine(a)",
            &[(nan, 0.0, nan), (inf, 0.0, nan), (0.0, 0.0, 1.0)],
        );
        check(
            "sign_(a)",
            &[
                (nan, 0.0, nan),
                (0.0, 0.0, 0.0),
                (inf, 0.0, 1.0),
                (-inf, 0.0, -1.0),
            ],
        );
        check(
            "step_(a)",
            &[(0.0, 0.0, 0.0), (inf, 0.0, 1.0), (-1.0, 0.0, 0.0)],
        );
        let pairs = [
            (nan, 1.0, nan),
            (1.0, nan, nan),
            (1.0, 2.0, 1.0),
            (2.0, 1.0, 1.0),
            (3.0, 3.0, 3.0),
            (inf, -inf, -inf),
        ];
        check("least(a, b)", &pairs);
        let pairs = [
            (nan, 1.0, nan),
            (1.0, nan, nan),
            (1.0, 2.0, 2.0),
            (2.0, 1.0, 2.0),
            (3.0, 3.0, 3.0),
            (inf, -inf, inf),
        ];
        check("greatest(a, b)", &pairs);
        let largest = match precision {
            Precision::F32 => f64::from(f32::MAX),
            Precision::F64 => f64::MAX,
        };
        let finite = [
            (nan, 0.0, 0.0),
            (inf, 0.0, 0.0),
            (-inf, 0.0, 0.0),
            (largest, 0.0, 1.0),
            (-largest, 0.0, 1.0),
            (-0.0, 0.0, 1.0),
        ];
        check("select(real(0.0), 1.0, is_finite(a))", &finite);
    }
}

#[test]
fn shader_errors_name_fragment_and_line() {
    let fragment = |name, text: &str| Fragment {
        name,
        text: text.to_owned(),
    };
    let good = "fn twice(x: f32) -> f32 {\n    return x + x;\n}\n";
    for (bad, wanted) in [
        ("fn f() -> f32 {\n    return twice(1.0)\n}\n", 3), // does not parse
        ("fn f() -> f32 {\n    return thrice(1.0);\n}\n", 2), // unknown name
        ("\n\nfn f() -> f32 {\n    return twice(1u);\n}\n", 3), // wrong type: told of the function
    ] {
        let source = Source::new(&[
            fragment("first", good),
            fragment("model", bad),
            fragment("last", "const X = 1;\n"),
        ]);
        match source.validate(false) {
            Err(BackendError::Shader {
                fragment,
                line,
                message,
            }) => {
                assert_eq!((fragment.as_str(), line), ("model", wanted), "{message}");
                assert!(!message.is_empty());
            }
            other => panic!("{bad:?} gave {other:?}"),
        }
    }
    assert!(
        Source::new(&[fragment("first", good)])
            .validate(false)
            .is_ok()
    );
    // A capability that was not asked for; the type has no place of its own in the text.
    let double = Source::new(&[fragment(
        "model",
        "fn f(x: f64) -> f64 {\n    return x;\n}\n",
    )]);
    assert!(double.validate(true).is_ok());
    assert!(matches!(
        double.validate(false),
        Err(BackendError::Shader { .. })
    ));
}

#[test]
fn literals_give_the_same_number() {
    for x in [
        0.1,
        -1.0 / 3.0,
        1e-300,
        6.02e23,
        0.0,
        -0.0,
        f64::MIN_POSITIVE,
        12_345_678.9,
    ] {
        let number = text::literal(x, Precision::F64);
        assert_eq!(
            number
                .trim_matches(['(', ')'])
                .trim_end_matches("lf")
                .parse::<f64>()
                .unwrap(),
            x
        );
        let number = text::literal(x, Precision::F32);
        assert_eq!(
            number.trim_matches(['(', ')']).parse::<f32>().unwrap(),
            x as f32
        );
    }
}
