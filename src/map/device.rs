//! A map in pieces on a GPU: V, p and their bounds at many states (`shaders/pieces.wgsl`).

use super::pieces::Here;
use super::swift::{Answer, Packed, Room, turns_into};
use super::{At, Unknown, Value, ValueMap};
use crate::backend::gpu::adapter::Device;
use crate::backend::gpu::emit::WORKGROUP;
use crate::backend::gpu::memory::{
    Use, bind, binding_limit, filled, layout, padded, pipelines, read_back, reals, staging, uses,
};
use crate::backend::gpu::shader::{Fragment, Source, conditional};
use crate::backend::gpu::{Gpu, text};
use crate::backend::{BackendError, Surface};
use crate::model::Precision;
use std::sync::Arc;

/// Why a map is not asked on a GPU.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    #[error(transparent)]
    Backend(#[from] BackendError),
    #[error(
        "the file holds no map in pieces (a scene with [map] error has one): scattered solutions are looked up on the CPU only"
    )]
    NoPieces,
    #[error(
        "V is that of a game, of whose map the GPU does not ask where a sheet ends: use --backend cpu"
    )]
    Game,
    #[error(
        "the map takes {bytes} bytes on the GPU, which has at most {limit} a buffer; use --backend cpu"
    )]
    TooLarge { bytes: usize, limit: u64 },
    #[error(
        "{count} of the states lie outside the region of the map in pieces, where the file's scattered solutions may know V: these are \
         looked up on the CPU only; leave them out or use --backend cpu"
    )]
    Outside { count: usize },
}

const BINDINGS: usize = 3;
/// Bindings that the kernel writes.
const WRITTEN: [usize; 2] = [1, 2];
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
    held: wgpu::BindGroup,
}

/// The whole text of the module.
fn source(packed: &Packed, precision: Precision) -> Source {
    let mut fragments = vec![
        Fragment {
            name: "constants",
            text: text::constants(precision) + &format!("const WORKGROUP: u32 = {WORKGROUP}u;\n"),
        },
        Fragment {
            name: "shaders/real.wgsl",
            text: conditional(
                include_str!("../../shaders/real.wgsl"),
                &[text::condition(precision)],
            ),
        },
    ];
    // In f64 rounding is far below any bound.
    let conditions: &[&str] = match precision {
        Precision::F32 => &["ROUNDED"],
        Precision::F64 => &[],
    };
    fragments.extend(asked(packed, precision, conditions));
    fragments.push(Fragment {
        name: "shaders/pieces_at.wgsl",
        text: include_str!("../../shaders/pieces_at.wgsl").to_owned(),
    });
    Source::new(&fragments)
}

/// The part of a module that knows the map.
fn asked(packed: &Packed, precision: Precision, conditions: &[&str]) -> [Fragment; 3] {
    let all = [packed.conditions(), conditions].concat();
    [
        Fragment {
            name: "map",
            text: packed.constants(precision),
        },
        Fragment {
            name: "shaders/pieces.wgsl",
            text: conditional(include_str!("../../shaders/pieces.wgsl"), &all),
        },
        Fragment {
            name: "shaders/blend.wgsl",
            text: conditional(include_str!("../../shaders/blend.wgsl"), &all),
        },
    ]
}

impl ValueMap {
    /// The map with second derivatives, for kernels that ask it themselves; `None` of a game, whose
    /// answers are checked one by one, and where there are no pieces.
    pub(crate) fn to_surface(&self, precision: Precision) -> Option<Surface> {
        let pieces = self.pieces.as_ref().filter(|_| !self.plan.game)?;
        let packed = Packed::new(pieces, &self.plan)?;
        Some(Surface {
            fragments: asked(&packed, precision, &["SECOND"]).to_vec(),
            reals: packed.reals,
            words: packed.words,
            states: self.states(),
            last: self.time,
        })
    }
}

impl<'m> DeviceMap<'m> {
    /// # Errors
    /// Where there is no map in pieces, it does not fit the device, or the precision is not
    /// supported; device failures.
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
        let (bytes, limit) = (
            contents[0].len().max(contents[1].len()),
            binding_limit(&device),
        );
        if bytes as u64 > limit {
            return Err(DeviceError::TooLarge { bytes, limit });
        }
        let source = source(&packed, precision);
        source.validate(device.info.f64_arithmetic)?;
        let own = layout(&device, "pieces", uses(BINDINGS, &WRITTEN));
        let map_layout = layout(&device, "map", [Use::Read; 2]);
        let module = device
            .device
            .create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some("pieces"),
                source: wgpu::ShaderSource::Wgsl(source.text.into()),
            });
        let [pipeline] = pipelines(&device, &[&own, &map_layout], &module, ["evaluate"]);
        let held = contents.map(|bytes| filled(&device, "map", &bytes));
        let held = bind(&device, &map_layout, held.iter().map(|b| (b, None)));
        device.check()?;
        Ok(Self {
            map,
            states: packed.states,
            device,
            precision,
            layout: own,
            pipeline,
            held,
        })
    }

    /// What is known at states (absolute) `[state][component]`, with their times where time is an
    /// axis, on the lowest sheet, without second derivatives.
    ///
    /// # Errors
    /// Device failures; states of which only scattered solutions may know.
    fn each(
        &self,
        x: &[f64],
        mut tell: impl FnMut(usize, Answer<'_, f64>),
    ) -> Result<(), DeviceError> {
        let n = self.states;
        let (mut elsewhere, mut room) = (0, Room::new());
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
                    // Of more pieces and sheets than an invocation has time for.
                    4 => {
                        let swift = self.map.swift.as_ref().ok_or(DeviceError::NoPieces)?;
                        swift.each(&x[k * n..][..n], false, &mut room, |_, answer| {
                            elsewhere += usize::from(matches!(answer, Answer::Elsewhere));
                            tell(part * STATES + k, answer);
                        });
                    }
                    _ => return Err(BackendError::Unwritten { index: k }.into()),
                }
            }
        }
        // Of the map round the region the host is asked.
        if elsewhere > 0 && !self.map.pieces_alone && self.map.beyond.is_none() {
            return Err(DeviceError::Outside { count: elsewhere });
        }
        Ok(())
    }

    /// `[field][state]`: values and kinds.
    fn part(&self, x: &[f64]) -> Result<(Vec<f64>, Vec<u32>), BackendError> {
        let (n, device) = (self.states, &*self.device);
        let count = x.len() / n;
        let real = self.precision.bytes();
        let reference = self.map.plan.system.reference.as_slice();
        // Time is given as it is.
        let from = |i: usize| reference.get(i).copied().unwrap_or(0.0);
        // Whole periods are taken off here: of a state many of them away f32 keeps no digits.
        let near = |i: usize, x: f64| match (
            self.map.plan.periods.get(i).copied().flatten(),
            &self.map.pieces,
        ) {
            (Some(period), Some(pieces)) => {
                let bounds = [pieces.region.lo[i], pieces.region.hi[i]];
                x + turns_into(x, bounds, period) * period
            }
            _ => x,
        };
        let given = (0..n).flat_map(|i| {
            x.iter()
                .skip(i)
                .step_by(n)
                .map(move |x| near(i, *x) - from(i))
        });
        let sizes = [count * (2 + 2 * n) * real, count * KINDS * 4];
        let given = filled(device, "states", &reals(given, self.precision));
        // Sentinels: a slot that still holds one was not written.
        let [values, kinds] = sizes.map(|size| filled(device, "values", &vec![0xff; size]));
        let room = sizes.iter().map(|s| padded(*s)).sum();
        let staging = staging(device, "values", room);
        // States as large as they are: the shader takes their number from it.
        let buffers = [
            (&given, Some(count * n * real)),
            (&values, None),
            (&kinds, None),
        ];
        let bindings = bind(device, &self.layout, buffers);
        let mut encoder = device.device.create_command_encoder(&Default::default());
        {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            pass.set_pipeline(&self.pipeline);
            pass.set_bind_group(0, &bindings, &[]);
            pass.set_bind_group(1, &self.held, &[]);
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

    /// V, p and u on the lowest sheet at states `[state][component]`, with bounds; other sheets and
    /// second derivatives are not told. u follows from p on the CPU.
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
                let x = &x[k * n..][..n];
                let mut here = *here;
                // Of the local solution the device tells no bound of p, and of V not all of what is
                // rounded.
                if here.pieces == 0
                    && let Some((v, p)) = self.map.local_bounds(x, 0.5 * self.precision.epsilon())
                {
                    here.v_bound = here.v_bound.max(v);
                    here.p_bound[..n].copy_from_slice(&p);
                }
                let value = self.map.as_value(x, &here);
                found[k] = value.map(|(value, bound)| {
                    let hessian = vec![f64::NAN; n * n];
                    (Value { hessian, ..value }, bound)
                });
            }
            Answer::Unknown => {}
            Answer::Rough(_) | Answer::Elsewhere => why[k] = Unknown::Far,
        })?;
        // Pieces are smooth, and say something of states that a guard excludes too.
        for (k, excluded) in self.map.excluded(x).into_iter().flatten().enumerate() {
            if excluded {
                (found[k], why[k]) = (None, Unknown::Guard);
            }
        }
        self.map.add_controls(x, &mut found);
        let beyond = self.map.beyond.is_some();
        Ok((found.into_iter().zip(why).enumerate())
            .map(|(k, (value, why))| match why {
                Unknown::Far if beyond => self.map.at_time(&x[k * n..][..n], t[k]),
                _ => At {
                    lowest: value.map(|v| v.0).ok_or(why),
                    others: Vec::new(),
                },
            })
            .collect())
    }
}
