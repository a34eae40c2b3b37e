//! A trajectory as nodes joined by segments.

/// Nodes `z = (s, p)` in forward time and the durations between them. The first node is the target's.
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

    pub fn horizon(&self) -> f64 {
        self.durations.iter().sum()
    }

    /// Splits a segment in two equal ones; `middle` is the node between.
    pub fn split(&mut self, segment: usize, middle: &[f64]) {
        let half = 0.5 * self.durations[segment];
        self.durations[segment] = half;
        self.durations.insert(segment + 1, half);
        let at = (segment + 1) * self.width;
        self.nodes.splice(at..at, middle.iter().copied());
    }

    /// `self + factor * steps`, steps scaled by `scales`.
    pub fn moved(&self, steps: &[f64], scales: &[f64], factor: f64) -> Self {
        let mut moved = self.clone();
        for (node, step) in moved.nodes.chunks_mut(self.width).zip(steps.chunks(self.width)) {
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
