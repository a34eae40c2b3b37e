//! One file a command: arguments to a call of the library, and its result to text.

pub mod adapters;
pub mod alone;
pub mod attenuation;
pub mod bench;
pub mod check;
pub mod check_least;
pub mod evaluate;
pub mod export;
pub mod fit;
#[cfg(feature = "urdf")]
pub mod import;
pub mod mechanism;
pub mod merge;
#[cfg(feature = "report")]
pub mod report;
pub mod run;
pub mod simulate;
pub mod study;
pub mod value;
