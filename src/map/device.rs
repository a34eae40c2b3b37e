//! A map in pieces on a GPU: V, p and their bounds at many states (`shaders/pieces.wgsl`).

use super::pieces::Here;
use super::swift::{Answer, Packed};
use super::{At, Unknown, Value, ValueMap};
use crate::backend::BackendError;
use crate::backend::gpu::adapter::Device;
use crate::backend::gpu::emit::WORKGROUP;
use crate::backend::gpu::memory::{binding_limit, read_back, reals};
use crate::backend::gpu::shader::{Fragment, Source, conditional};
use crate::backend::gpu::{Gpu, text};
use crate::model::Precision;
use std::sync::Arc;
use wgpu::BufferUsages;

/// Why a map is not asked on a GPU.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    #[error(transparent)]
    Backend(#[from] BackendError),
    #[error(
        "the file holds no map in pieces (a scene with [map] error has one): scattered solutions are looked up on the CPU only"
    )]
    NoPieces,
    #[error("V is that of a game, of whose map the GPU does not ask where a sheet ends: use --backend cpu")]
    Game,
    #[error("the map takes {bytes} bytes on the GPU, which has at most {limit} a buffer; use --backend cpu")]
    TooLarge { bytes: usize, limit: u64 },
    #[error(
        "{count} of the states lie outside the region of the map in pieces, where the file's scattered solutions may know V: these are \
         looked up on the CPU only; leave them out or use --backend cpu"
    )]
    Outside { count: usize },
}

const BINDINGS: usize = 5;
/// Bindings that the kernel writes.
const WRITTEN: [usize; 2] = [3, 4];
/// States of a dispatch at most: some milliseconds of any hardware.
const STATES: usize = 1 << 16;
/// Numbers of a state in `kinds`.
const KINDS: usize = 4;

/// A map in pieces on a device.
pub struct DeviceMap<'m> {
    map: &'m ValueMap,
    device: Arc<Device>,
    precision: Precision,
    states: usize,
    layout: wgpu::BindGroupLayout,
    pipeline: wgpu::ComputePipeline,
    /// The map's reals and words.
    held: [wgpu::Buffer; 2],
}

/// The whole text of the module.
fn source(packed: &Packed, precision: Precision) -> Source {
    let condition = match precision {
        Precision::F32 => "F32",
        Precision::F64 => "F64",
    };
    let constants =
        text::constants(precision) + &packed.constants(precision) + &format!("const WORKGROUP: u32 = {WORKGROUP}u;\n");
    Source::new(&[
        Fragment {
            name: "constants",
            text: constants,
        },
        Fragment {
            name: "shaders/real.wgsl",
            text: conditional(include_str!("../../shaders/real.wgsl"), &[condition]),
        },
        Fragment {
            name: "shaders/pieces.wgsl",
            text: conditional(include_str!("../../shaders/pieces.wgsl"), packed.conditions()),
        },
        Fragment {
            name: "shaders/pieces_at.wgsl",
            text: include_str!("../../shaders/pieces_at.wgsl").to_owned(),
        },
    ])
}

impl<'m> DeviceMap<'m> {
    /// # Errors
    /// Where there is no map in pieces, it does not fit the device, or the precision is not supported; device failures.
    pub fn new(map: &'m ValueMap, gpu: &Gpu, precision: Precision) -> Result<Self, DeviceError> {
        gpu.require(precision)?;
        let pieces = map.pieces.as_ref().ok_or(DeviceError::NoPieces)?;
        if map.plan.game {
            return Err(DeviceError::Game);
        }
        let packed = Packed::new(pieces, &map.plan).ok_or(DeviceError::NoPieces)?;
        let device = gpu.device();
        let contents = [
            reals(packed.reals.iter().copied(), precision),
            bytemuck::cast_slice(&packed.words).to_vec(),
        ];
        let (bytes, limit) = (contents[0].len().max(contents[1].len()), binding_limit(&device));
        if bytes as u64 > limit {
            return Err(DeviceError::TooLarge { bytes, limit });
        }
        let source = source(&packed, precision);
        source.validate(device.info.f64_arithmetic)?;
        let entries: Vec<wgpu::BindGroupLayoutEntry> = (0..BINDINGS)
            .map(|k| wgpu::BindGroupLayoutEntry {
                binding: k as u32,
                visibility: wgpu::ShaderStages::COMPUTE,
                ty: wgpu::BindingType::Buffer {
                    ty: wgpu::BufferBindingType::Storage {
                        read_only: !WRITTEN.contains(&k),
                    },
                    has_dynamic_offset: false,
                    min_binding_size: None,
                },
                count: None,
            })
            .collect();
        let layout = (device.device).create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("pieces"),
            entries: &entries,
        });
        let module = device.device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some("pieces"),
            source: wgpu::ShaderSource::Wgsl(source.text.into()),
        });
        let pipeline_layout = (device.device).create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: None,
            bind_group_layouts: &[Some(&layout)],
            ..Default::default()
        });
        let pipeline = (device.device).create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some("pieces"),
            layout: Some(&pipeline_layout),
            module: &module,
            entry_point: Some("evaluate"),
            compilation_options: Default::default(),
            cache: None,
        });
        let held = contents.map(|bytes| filled(&device, &bytes));
        device.check()?;
        Ok(Self {
            map,
            states: packed.states,
            device,
            precision,
            layout,
            pipeline,
            held,
        })
    }

    /// What is known at states (absolute) `[state][component]`, with their times where time is an axis, on the lowest sheet, without second derivatives.
    ///
    /// # Errors
    /// Device failures; states of which only scattered solutions may know.
    fn each(&self, x: &[f64], mut tell: impl FnMut(usize, Answer<'_, f64>)) -> Result<(), DeviceError> {
        let n = self.states;
        let mut elsewhere = 0;
        for (part, x) in x.chunks(STATES * n).enumerate() {
            let count = x.len() / n;
            let (values, kinds) = self.part(x)?;
            for k in 0..count {
                let of = |field: usize| kinds[field * count + k];
                let mut here = Here::blank();
                match of(0) {
                    // As the constants of the shader.
                    1 | 2 => {
                        let value = |field: usize| values[field * count + k];
                        here.v = value(0);
                        here.v_bound = value(1);
                        for i in 0..n {
                            here.p[i] = value(2 + i);
                            here.p_bound[i] = value(2 + n + i);
                        }
                        here.sheet = of(1) as i32;
                        here.pieces = of(2);
                        here.sheets = of(3);
                        tell(part * STATES + k, Answer::Known(&here));
                    }
                    0 => tell(part * STATES + k, Answer::Unknown),
                    3 => {
                        elsewhere += 1;
                        tell(part * STATES + k, Answer::Elsewhere);
                    }
                    _ => return Err(BackendError::Unwritten { index: k }.into()),
                }
            }
        }
        if elsewhere > 0 && !self.map.pieces_alone {
            return Err(DeviceError::Outside { count: elsewhere });
        }
        Ok(())
    }

    /// `[field][state]`: values and kinds.
    fn part(&self, x: &[f64]) -> Result<(Vec<f64>, Vec<u32>), BackendError> {
        let (n, device) = (self.states, &*self.device);
        let count = x.len() / n;
        let real = match self.precision {
            Precision::F32 => 4,
            Precision::F64 => 8,
        };
        let reference = self.map.plan.system.reference.as_slice();
        // Time is given as it is.
        let from = |i: usize| reference.get(i).copied().unwrap_or(0.0);
        let given = (0..n).flat_map(|i| x.iter().skip(i).step_by(n).map(move |x| x - from(i)));
        let sizes = [count * (2 + 2 * n) * real, count * KINDS * 4];
        let given = filled(device, &reals(given, self.precision));
        // Sentinels: a slot that still holds one was not written.
        let [values, kinds] = sizes.map(|size| filled(device, &vec![0xff; size]));
        let staging = device.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("pieces"),
            size: sizes.iter().map(|s| s.next_multiple_of(16)).sum::<usize>() as u64,
            usage: BufferUsages::MAP_READ | BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let buffers = [&self.held[0], &self.held[1], &given, &values, &kinds];
        // As large as what is in it: the shader takes the number of states from it.
        let exact = |k: usize| std::num::NonZeroU64::new((count * n * real) as u64).filter(|_| k == 2);
        let entries: Vec<wgpu::BindGroupEntry<'_>> = (buffers.iter().enumerate())
            .map(|(k, buffer)| wgpu::BindGroupEntry {
                binding: k as u32,
                resource: wgpu::BindingResource::Buffer(wgpu::BufferBinding {
                    buffer,
                    offset: 0,
                    size: exact(k),
                }),
            })
            .collect();
        let bindings = device.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &self.layout,
            entries: &entries,
        });
        let mut encoder = device.device.create_command_encoder(&Default::default());
        {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            pass.set_pipeline(&self.pipeline);
            pass.set_bind_group(0, &bindings, &[]);
            pass.dispatch_workgroups((count as u32).div_ceil(WORKGROUP), 1, 1);
        }
        let wanted = [(&values, sizes[0]), (&kinds, sizes[1])];
        read_back(device, &staging, encoder, wanted, |[values, kinds]| {
            let values = match self.precision {
                Precision::F32 => bytemuck::pod_collect_to_vec::<u8, f32>(values)
                    .into_iter()
                    .map(f64::from)
                    .collect(),
                Precision::F64 => bytemuck::pod_collect_to_vec(values),
            };
            (values, bytemuck::pod_collect_to_vec(kinds))
        })
    }

    /// V, p and u on the lowest sheet at states `[state][component]`, with bounds; other sheets and second derivatives are not
    /// told. u follows from p on the CPU.
    ///
    /// # Errors
    /// Device failures; states of which only scattered solutions may know.
    pub fn at_many(&self, x: &[f64]) -> Result<Vec<At>, DeviceError> {
        self.at_times(x, &vec![0.0; x.len() / self.map.states()])
    }

    /// The same at times of a finite horizon, one a state; of a map of V(x, 0) that at all times.
    ///
    /// # Errors
    /// As [`DeviceMap::at_many`].
    pub fn at_times(&self, x: &[f64], t: &[f64]) -> Result<Vec<At>, DeviceError> {
        let n = self.map.states();
        let mut found: Vec<Option<(Value, Vec<f64>)>> = vec![None; x.len() / n];
        let mut why = vec![Unknown::Uncertain; found.len()];
        self.each(&self.map.places(x, |k| t[k]), |k, answer| match answer {
            Answer::Known(here) => {
                let value = self.map.as_value(&x[k * n..][..n], here);
                found[k] = value.map(|(value, bound)| {
                    let hessian = vec![f64::NAN; n * n];
                    (Value { hessian, ..value }, bound)
                });
            }
            Answer::Unknown => {}
            Answer::Elsewhere => why[k] = Unknown::Far,
        })?;
        self.map.add_controls(x, &mut found);
        Ok((found.into_iter().zip(why))
            .map(|(value, why)| At {
                lowest: value.map(|v| v.0).ok_or(why),
                others: Vec::new(),
            })
            .collect())
    }
}

/// A storage buffer with these bytes.
fn filled(device: &Device, bytes: &[u8]) -> wgpu::Buffer {
    let buffer = device.device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("pieces"),
        size: bytes.len().next_multiple_of(16).max(16) as u64,
        usage: BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC,
        mapped_at_creation: false,
    });
    device.queue.write_buffer(&buffer, 0, bytes);
    buffer
}
