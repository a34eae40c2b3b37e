//! Feedback laws that are fitted to the optimal trajectories: networks, their training and their
//! export.
//!
//! [`fit`] takes samples of optimal trajectories ([`Samples`]) and what a scene's `[feedback]` asks
//! for, trains a [`Network`] by Levenberg-Marquardt, and returns a [`Law`] with what it is worth on
//! trajectories it has not seen.

mod cholesky;
mod exports;
mod fit;
mod header;
mod law;
mod network;
mod onnx;
mod quality;
mod regression;
mod samples;
mod shape;
mod training;
mod units;
mod weights;

pub use exports::{Exports, Fitted};
pub use fit::{Data, FitError, FittedLaw, fit};
pub use header::{Known, header, value_header};
pub use law::{ClosedForm, Law, LawError, Meaning, Optimal, Polynomial};
pub use network::{Activation, Layer, Network};
pub use onnx::{OnnxError, onnx};
pub use quality::{Errors, Loss, Quality, Residual};
pub use samples::{Optimality, Samples, Selection, Sets};
pub use training::Step;
pub use weights::NetworkError;
