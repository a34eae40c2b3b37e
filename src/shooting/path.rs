//! A trajectory as nodes joined by segments.

/// Nodes `z = (s, p)` in forward time and the durations between them. The first node is the
/// target's.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Path {
    /// Components of a node, `2n`.
    pub width: usize,
    /// `[node][2n]`.
    pub nodes: Vec<f64>,
    /// One a segment.
    pub durations: Vec<f64>,
}

impl Path {
    pub fn new(first: &[f64]) -> Self {
        Self {
            width: first.len(),
            nodes: first.to_vec(),
            durations: Vec::new(),
        }
    }

    /// Adds a segment that ends at a node.
    pub fn push(&mut self, duration: f64, node: &[f64]) {
        self.durations.push(duration);
        self.nodes.extend_from_slice(node);
    }

    /// Adds segments that end at nodes `[segment][2n]`.
    pub fn append(&mut self, nodes: &[f64], durations: &[f64]) {
        self.durations.extend_from_slice(durations);
        self.nodes.extend_from_slice(nodes);
    }

    pub fn segments(&self) -> usize {
        self.durations.len()
    }

    pub fn node(&self, k: usize) -> &[f64] {
        &self.nodes[k * self.width..][..self.width]
    }

    /// States of the first node, as deviations.
    pub fn start(&self) -> &[f64] {
        &self.nodes[..self.width / 2]
    }

    /// Adjoints of the first node.
    pub fn adjoint(&self) -> &[f64] {
        &self.nodes[self.width / 2..self.width]
    }

    pub fn last(&self) -> &[f64] {
        self.node(self.segments())
    }

    /// Sum of the durations, to the last bit: rounding errors are summed beside it (Neumaier 1974).
    pub fn horizon(&self) -> f64 {
        let (mut sum, mut lost) = (0.0f64, 0.0f64);
        for d in &self.durations {
            let next = sum + d;
            lost += if sum >= *d {
                (sum - next) + d
            } else {
                (d - next) + sum
            };
            sum = next;
        }
        sum + lost
    }

    /// Stretches all segments alike so that the horizon is `time` to the last bit; halving them
    /// keeps it so.
    pub fn set_horizon(&mut self, time: f64) {
        let factor = time / self.horizon();
        if factor == 1.0 || !factor.is_finite() {
            return;
        }
        self.durations.iter_mut().for_each(|d| *d *= factor);
        // What rounding has left goes to the longest segment, where it is the least change.
        for _ in 0..4 {
            let left = time - self.horizon();
            let longest = (self.durations.iter_mut()).max_by(|a, b| a.total_cmp(b));
            match longest {
                Some(d) if left != 0.0 => *d += left,
                _ => return,
            }
        }
    }

    /// Splits segments, in rising order, in two equal ones each; `middles` are the nodes between.
    pub fn split(&mut self, segments: &[usize], middles: &[f64]) {
        let mut split = Path::new(self.node(0));
        let mut next = segments.iter().zip(middles.chunks(self.width)).peekable();
        for k in 0..self.segments() {
            let mut duration = self.durations[k];
            if let Some((_, middle)) = next.next_if(|(segment, _)| **segment == k) {
                duration *= 0.5;
                split.push(duration, middle);
            }
            split.push(duration, self.node(k + 1));
        }
        *self = split;
    }

    /// `self + factor * steps`, steps scaled by `scales`.
    pub fn moved(&self, steps: &[f64], scales: &[f64], factor: f64) -> Self {
        let mut moved = self.clone();
        for (node, step) in moved
            .nodes
            .chunks_mut(self.width)
            .zip(steps.chunks(self.width))
        {
            for ((z, d), scale) in node.iter_mut().zip(step).zip(scales) {
                *z += factor * d * scale;
            }
        }
        moved
    }

    /// Largest scaled component of any node.
    pub fn size(&self, scales: &[f64]) -> f64 {
        (self.nodes.chunks(self.width))
            .flat_map(|node| node.iter().zip(scales).map(|(z, s)| (z / s).abs()))
            .fold(0.0, f64::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn path(durations: &[f64]) -> Path {
        let mut path = Path::new(&[0.0, 0.0]);
        durations.iter().for_each(|d| path.push(*d, &[0.0, 0.0]));
        path
    }

    #[test]
    fn durations_add_up_to_the_horizon_to_the_last_bit() {
        for time in [0.1, 0.7, 1.3, 2.7, 20.0, 1e-3] {
            for count in [1, 3, 30, 64, 400] {
                // As an archive in single precision had them.
                let rough = |k: usize| {
                    f64::from((time * (1.0 + (k as f64).sin() / 3.0)) as f32) / count as f64
                };
                let mut path = path(&(0..count).map(rough).collect::<Vec<_>>());
                path.set_horizon(time);
                assert_eq!(path.horizon(), time, "{count} segments");
                path.split(&(0..count).collect::<Vec<_>>(), &vec![0.0; 2 * count]);
                assert_eq!(path.segments(), 2 * count);
                assert_eq!(path.horizon(), time, "{count} segments, split");
            }
        }
    }
}
