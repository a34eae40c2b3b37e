//! Feedback laws that are fitted to the optimal trajectories: networks, their training and their export.

mod network;
mod weights;

pub use network::{Activation, Layer, Network};
pub use weights::NetworkError;
