//! Multibody systems on expressions: the recursive algorithms of mechanics, run once on the graph,
//! give programs whose length grows as the number of bodies.
//!
//! A [`Tree`] is a mechanism in numbers. Its [`Motion`] is where everything is, as expressions of
//! coordinates and rates; [`Articulated`] gives accelerations from forces, [`Motion::joint_forces`]
//! forces from accelerations. Formulas: M. Hardt, Multibody dynamical algorithms, numerical optimal
//! control, with detailed studies in the control of jet engine compressors and biped walking, 1999,
//! chapters II to IV; R. Featherstone, Rigid Body Dynamics Algorithms, 2008.

pub mod algebra;
mod contact;
mod forward;
mod inverse;
mod motion;
mod system;
#[cfg(test)]
mod tests;
mod tree;

pub use contact::{Constraint, Held};
pub use forward::{Accelerations, Articulated, Load, Wrench};
pub use motion::{Frame, Motion, Point};
pub use system::{Energy, Link, Mechanism, Named, Posed};
pub use tree::{Body, Impossible, Inertia, Joint, Mount, Tree};
