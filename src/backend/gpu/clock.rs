//! Time stamps of compute passes: what the device computed, without submission, waiting and
//! transfers.

use super::adapter::Device;
use wgpu::BufferUsages;

/// Where a pass's beginning and end are stamped; none where the device has no time stamps.
#[derive(Debug)]
pub(super) struct Clock {
    stamps: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    /// Seconds a tick.
    period: f64,
}

impl Clock {
    /// Bytes of the two stamps.
    pub const BYTES: usize = 16;

    pub fn new(device: &Device) -> Option<Self> {
        if !device
            .device
            .features()
            .contains(wgpu::Features::TIMESTAMP_QUERY)
        {
            return None;
        }
        Some(Self {
            stamps: device.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("stamps"),
                ty: wgpu::QueryType::Timestamp,
                count: 2,
            }),
            resolved: device.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("stamps"),
                size: Self::BYTES as u64,
                usage: BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            }),
            period: f64::from(device.queue.get_timestamp_period()) * 1e-9,
        })
    }

    /// For the descriptor of the pass that is timed.
    pub fn writes(&self) -> wgpu::ComputePassTimestampWrites<'_> {
        wgpu::ComputePassTimestampWrites {
            query_set: &self.stamps,
            beginning_of_pass_write_index: Some(0),
            end_of_pass_write_index: Some(1),
        }
    }

    /// Behind the pass: leaves its stamps in the buffer that is returned.
    pub fn resolve(&self, encoder: &mut wgpu::CommandEncoder) -> &wgpu::Buffer {
        encoder.resolve_query_set(&self.stamps, 0..2, &self.resolved, 0);
        &self.resolved
    }

    /// Seconds between the stamps read back.
    pub fn seconds(&self, stamps: &[u8]) -> f64 {
        let at = |k: usize| {
            stamps[8 * k..]
                .first_chunk()
                .map_or(0, |b| u64::from_ne_bytes(*b))
        };
        at(1).saturating_sub(at(0)) as f64 * self.period
    }
}
