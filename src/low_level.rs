//! The rooms that [`Session`](crate::Session) is made of, one over the other: each imports only
//! from those below it. They are open to whoever wants to build something else of them, and
//! **promise nothing**: names and arguments change from version to version without notice.
//!
//! A sweep, for example, takes five steps, each a room:
//!
//! ```
//! use costate::backend::{BackendError, cpu::Cpu};
//! use costate::low_level::hamiltonian::Hamiltonian;
//! use costate::low_level::sweep::{Choices, Plan, sweep};
//!
//! let text = r#"
//! states = { x = {}, v = {} }
//! controls = { u = { min = -2, max = 2 } }
//! dynamics = { x = "v", v = "-x + x^3/6 + u" }
//! cost = { running = "0.5*(x^2 + v^2 + u^2)" }
//! equilibrium = { x = 0, v = 0, u = 0 }
//! region = { x = [-1, 1], v = [-1, 1] }
//! shoot_out = { value_max = 1.0, spacing = 0.1, samples = 50 }
//! "#;
//! // 1. Text to model; problems come with their places.
//! let model = costate::low_level::scenario::parse(text, "scene.toml", &[])?;
//! // 2. The Hamiltonian and its bicharacteristics, symbolically.
//! let hamiltonian = Hamiltonian::derive(&model).expect("affine dynamics, quadratic cost");
//! assert_eq!(hamiltonian.graph.show(hamiltonian.control[0]), "min(max(-p_v, -2), 2)");
//! // 3. A backend, and what it is to integrate: the local solution gives the seeds.
//! let backend = Cpu::new();
//! let plan = Plan::new(&model, &hamiltonian, &backend, Choices::default())?;
//! // 4. The sweep; blocks of trajectories come as they finish.
//! let mut stored = 0;
//! let report = sweep::<BackendError>(&plan, &backend, &mut |_, _| {}, &mut |block| {
//!     stored += block.count;
//!     Ok(())
//! })?;
//! assert_eq!(report.trajectories, stored);
//! assert_eq!(report.coverage.uncovered, 0);
//! // 5. |H| is 0 on the exact solution.
//! assert!(report.drift.iter().all(|h| *h < 1e-4));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

#[path = "attenuation/mod.rs"]
pub mod attenuation;
#[path = "backend/mod.rs"]
pub mod backend;
#[path = "closed_loop/mod.rs"]
pub mod closed_loop;
#[path = "diagnostics/mod.rs"]
pub mod diagnostics;
#[path = "dynamic_programming/mod.rs"]
pub mod dynamic_programming;
#[path = "expr/mod.rs"]
pub mod expr;
#[path = "feedback/mod.rs"]
pub mod feedback;
#[path = "files/mod.rs"]
pub mod files;
#[path = "hamiltonian/mod.rs"]
pub mod hamiltonian;
#[cfg(feature = "hdf5")]
#[path = "hdf5/mod.rs"]
pub mod hdf5;
#[path = "hybrid/mod.rs"]
pub mod hybrid;
#[path = "integrator/mod.rs"]
pub mod integrator;
#[path = "local/mod.rs"]
pub mod local;
#[path = "map/mod.rs"]
pub mod map;
#[path = "mechanism/mod.rs"]
pub mod mechanism;
#[path = "model/mod.rs"]
pub mod model;
#[path = "numeric/mod.rs"]
pub mod numeric;
#[path = "program/mod.rs"]
pub mod program;
#[cfg(feature = "hdf5")]
#[path = "result/mod.rs"]
pub mod result;
#[path = "scenario/mod.rs"]
pub mod scenario;
#[path = "schema/mod.rs"]
pub mod schema;
#[path = "shooting/mod.rs"]
pub mod shooting;
#[path = "study.rs"]
pub mod study;
#[path = "sweep/mod.rs"]
pub mod sweep;
#[path = "trajectories.rs"]
pub mod trajectories;
#[path = "value/mod.rs"]
pub mod value;
