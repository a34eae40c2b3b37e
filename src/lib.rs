//! costate: value functions and optimal feedback of nonlinear systems over a region, by
//! bicharacteristics.
//!
//! [`Scene`] is a problem, read from text; [`Session`] answers questions about it:
//!
//! ```
//! use costate::{Scene, Session};
//!
//! let scene = Scene::parse(
//!     r#"
//!     states = { x = {}, v = {} }
//!     controls = { u = { min = -2, max = 2 } }
//!     dynamics = { x = "v", v = "-x + x^3/6 + u" }
//!     cost = { running = "0.5*(x^2 + v^2 + u^2)" }
//!     equilibrium = { x = 0, v = 0, u = 0 }
//!     region = { x = [-1, 1], v = [-1, 1] }
//!     "#,
//!     "scene.toml",
//! )?;
//! let solved = Session::new(&scene).solve(&[0.5, -0.2])?;
//! let answer = solved.answer(0).expect("solved");
//! println!("V = {}, p = {:?}, u = {:?}", answer.value, answer.p, answer.u);
//! # assert!((answer.u[0] + answer.p[1]).abs() < 1e-9); // u* = -p_v
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! [`Session::map`] makes a map of V over a region, [`Scene::with`] changes parameters. What they
//! are made of are the rooms below, which promise less. A sweep, for example, takes five steps,
//! each a room of this crate:
//!
//! ```
//! use costate::backend::{BackendError, cpu::Cpu};
//! use costate::hamiltonian::Hamiltonian;
//! use costate::sweep::{Choices, Plan, sweep};
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
//! let model = costate::scenario::parse(text, "scene.toml", &[])?;
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
//!
//! Writing the blocks to HDF5 is [`result`]'s. The program, pictures and speed measurements are
//! crates of their own, in `crates/`.
pub mod attenuation;
pub mod backend;
pub mod closed_loop;
pub mod diagnostics;
pub mod dynamic_programming;
pub mod expr;
pub mod feedback;
pub mod files;
pub mod hamiltonian;
#[cfg(feature = "hdf5")]
pub mod hdf5;
pub mod integrator;
pub mod local;
pub mod map;
pub mod model;
pub mod numeric;
pub mod program;
#[cfg(feature = "hdf5")]
pub mod result;
#[cfg(feature = "hdf5")]
pub mod run;
pub mod scenario;
pub mod scene;
pub mod session;
pub mod shooting;
pub mod study;
pub mod sweep;
pub mod trajectories;
pub mod value;

pub use scene::Scene;
pub use session::{Mapped, Session, SessionError, Solved};
