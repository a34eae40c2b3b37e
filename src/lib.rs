//! costate: value functions and optimal feedback of nonlinear systems over a region, by
//! bicharacteristics.
//!
//! A [`Scene`] is a problem, read from text. A [`Session`] answers questions about it. This page is
//! a tour of the questions; every example on it runs.
//!
//! # V at a state
//!
//! ```
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use costate::{Scene, Session};
//!
//! let text = r#"
//!     states = { x = {}, v = {} }
//!     controls = { u = { min = -2, max = 2 } }
//!     dynamics = { x = "v", v = "-x + x^3/6 + u" }
//!     cost = { running = "0.5*(x^2 + v^2 + u^2)" }
//!     equilibrium = { x = 0, v = 0, u = 0 }
//!     region = { x = [-1, 1], v = [-1, 1] }
//! "#;
//! let scene = Scene::parse(text, "scene.toml")?;
//! let solved = Session::new(&scene).solve(&[0.5, -0.2])?;
//! let answer = solved.answer(0).expect("solved");
//! println!("V = {}, p = {:?}, u = {:?}", answer.value, answer.p, answer.u);
//! # assert!((answer.u[0] + answer.p[1]).abs() < 1e-9); // u* = -p_v
//! # Ok(())
//! # }
//! ```
//!
//! A state without an answer is no error: [`Solved::status`] tells why there is none.
//!
//! # V over a region, and the closed loop of its law
//!
//! A scene with `[map] error` asks for V in the whole region, with a bound of its error. The map
//! gives V, p and u at any state; so it is a feedback law, which can be simulated.
//!
//! ```
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use costate::session::{LoopOptions, Sources};
//! use costate::{Scene, Session};
//!
//! let text = r#"
//!     states = { x = {} }
//!     controls = { u = {} }
//!     dynamics = { x = "x - x^3 + u" }
//!     cost = { running = "0.5*(x^2 + u^2)" }
//!     equilibrium = { x = 0, u = 0 }
//!     region = { x = [-0.9, 0.9] }
//!     map = { error = 1e-3 }
//!     closed_loop = { final_time = 6, initial = { x = [-0.8, 0.8, 9] } }
//! "#;
//! let scene = Scene::parse(text, "scene.toml")?;
//! let session = Session::new(&scene);
//!
//! let map = session.map()?.map;
//! let here = map.at(&[0.5]).lowest?;
//! println!("V = {} within {}, u = {:?}", here.v, here.v_error, here.u);
//!
//! let sources = Sources { map: Some(map), ..Sources::default() };
//! let loops = session.closed_loop(&sources, &LoopOptions::default())?;
//! for law in &loops.laws {
//!     println!("{}: J/V - 1 = {:?}", law.name, loops.spread(law));
//! }
//! # let of_map = loops.laws.iter().find(|law| law.name == "map").unwrap();
//! # assert!(loops.spread(of_map).unwrap().worst < 1e-3);
//! # assert_eq!(of_map.share_converged(), 1.0);
//! # Ok(())
//! # }
//! ```
//!
//! # A fitted law
//!
//! `[feedback]` asks for a network, fitted to optimal trajectories: those of a sweep here.
//! [`Samples`] also takes solved states, and [`Session::fit`] a map.
//!
//! ```
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use costate::{Samples, Scene, Session};
//!
//! let text = r#"
//!     states = { x = {}, v = {} }
//!     controls = { u = {} }
//!     dynamics = { x = "v", v = "u" }
//!     cost = { running = "0.5*(x^2 + u^2)" }
//!     equilibrium = { x = 0, v = 0, u = 0 }
//!     region = { x = [-1, 1], v = [-1, 1] }
//!     shoot_out = { value_max = 1.0, spacing = 0.2, samples = 20 }
//!     feedback = { small = { fit = "u", hidden = [3], iterations = 30, starts = 2 } }
//! "#;
//! let scene = Scene::parse(text, "scene.toml")?;
//! let session = Session::new(&scene);
//! let swept = session.sweep()?;
//! let samples = Samples::new((2, 1), Some(&swept.trajectories), None);
//! let fitted = session.fit(&samples, None)?;
//! let law = &fitted.laws[0];
//! println!("error of u, of its range: {:.1e}", law.quality.u.mean_of_range);
//! println!("{}", law.c_header(&scene));
//! # assert!(law.quality.u.mean_of_range < 0.01);
//! # assert!(law.c_header(&scene).contains("small_"));
//! # Ok(())
//! # }
//! ```
//!
//! # A study of parameters
//!
//! [`Scene::with`] gives the scene with other values of its parameters; what follows from them
//! follows.
//!
//! ```
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use costate::{Scene, Session};
//!
//! let text = r#"
//!     parameters = { r = 1.0 }
//!     states = { x = {} }
//!     controls = { u = {} }
//!     dynamics = { x = "u" }
//!     cost = { running = "0.5*(x^2 + r*u^2)" }
//!     equilibrium = { x = 0, u = 0 }
//!     region = { x = [-1, 1] }
//! "#;
//! let scene = Scene::parse(text, "scene.toml")?;
//! for r in [0.5, 1.0, 2.0] {
//!     let variant = scene.with(&[("r", r)])?;
//!     let solved = Session::new(&variant).solve(&[0.6])?;
//!     let value = solved.answer(0).expect("solved").value;
//!     println!("r = {r}: V = {value}");
//! #   assert!((value - 0.5 * f64::sqrt(r) * 0.36).abs() < 1e-8);
//! }
//! # Ok(())
//! # }
//! ```
//!
//! # Another backend
//!
//! [`Session::on`] takes any [`Backend`](backend::Backend): all cores of the CPU
//! ([`Cpu`](backend::cpu::Cpu)), a GPU (`backend::gpu::Gpu`, feature `gpu`), or one of your own,
//! which need not do everything itself. This one counts the kernels that are compiled:
//!
//! ```
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use costate::backend::cpu::Cpu;
//! use costate::backend::{Backend, BackendError, Kernel, Spec};
//! use costate::{Method, Precision, Scene, Session};
//! use std::sync::Arc;
//! use std::sync::atomic::{AtomicUsize, Ordering};
//!
//! struct Counting(Cpu, Arc<AtomicUsize>);
//!
//! impl Backend for Counting {
//!     fn name(&self) -> &'static str {
//!         "counting"
//!     }
//!     fn adapter(&self) -> String {
//!         self.0.adapter()
//!     }
//!     fn supports(&self, precision: Precision) -> bool {
//!         self.0.supports(precision)
//!     }
//!     fn offers(&self, method: Method) -> bool {
//!         self.0.offers(method)
//!     }
//!     fn compile(&self, spec: &Spec) -> Result<Box<dyn Kernel>, BackendError> {
//!         self.1.fetch_add(1, Ordering::Relaxed);
//!         self.0.compile(spec)
//!     }
//! }
//!
//! # let text = r#"
//! #     states = { x = {} }
//! #     controls = { u = {} }
//! #     dynamics = { x = "u" }
//! #     cost = { running = "0.5*(x^2 + u^2)" }
//! #     equilibrium = { x = 0, u = 0 }
//! #     region = { x = [-1, 1] }
//! # "#;
//! # let scene = Scene::parse(text, "scene.toml")?;
//! let count = Arc::new(AtomicUsize::new(0));
//! let backend = Counting(Cpu::new(), count.clone());
//! let solved = Session::on(&scene, Box::new(backend)).solve(&[0.6])?;
//! println!("{} kernels were compiled", count.load(Ordering::Relaxed));
//! # assert!((solved.answer(0).unwrap().value - 0.18).abs() < 1e-8);
//! # assert!(count.load(Ordering::Relaxed) > 0);
//! # Ok(())
//! # }
//! ```
//!
//! # Result files
//!
//! With the feature `hdf5`, `run` has the whole of `costate run` as `Session::run`: everything that
//! a scene asks for, into a result file, with a typed summary. The program `costate` and the
//! report are crates of their own, in `crates/`.
//!
//! What all this is made of is in [`low_level`], which promises nothing.

#![warn(missing_docs)]

/// `Debug` for what is too large to print: its name alone, so that what holds it can derive it.
macro_rules! opaque {
    ($($name:ident $(<$life:lifetime>)?),+) => {$(
        impl std::fmt::Debug for $name $(<$life>)? {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.debug_struct(stringify!($name)).finish_non_exhaustive()
            }
        }
    )+};
}
pub(crate) use opaque;

#[allow(
    missing_docs,
    reason = "it promises nothing; what matters is documented"
)]
pub mod low_level;
#[cfg(feature = "hdf5")]
pub mod run;
pub mod scene;
pub mod session;

// Rooms name each other `crate::ROOM`.
use low_level::{
    attenuation, closed_loop, diagnostics, dynamic_programming, expr, feedback, files, hamiltonian,
    hybrid, integrator, local, map, mechanism, model, numeric, program, scenario, schema, shooting,
    study, sweep, trajectories, value,
};
#[cfg(feature = "hdf5")]
use low_level::{hdf5, result};

pub use low_level::backend;

pub use attenuation::Attenuated;
pub use closed_loop::{Evaluation, LawResult, Weights};
pub use diagnostics::ScenarioErrors;
pub use feedback::{Fitted, FittedLaw, Samples};
pub use map::{At, Unknown, Value, ValueMap};
pub use model::{Method, Precision};
#[cfg(feature = "hdf5")]
pub use result::{Stored, StoredError};
pub use scenario::LoadError;
pub use scene::Scene;
pub use session::{Mapped, Session, SessionError, Solved, Swept};
pub use study::Variant;
pub use sweep::Choices;
pub use trajectories::SweptTrajectories;
pub use value::{Entry, PointStatus};
