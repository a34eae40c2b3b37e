//! Symbolic expressions: a hash-consed graph, differentiation, evaluation and printing.
//!
//! Every expression is a node of one [`Graph`]; equal sub-expressions are the same node, so common
//! subexpressions are shared by construction and a program lowered from the graph computes each
//! once.
//!
//! ```
//! use costate::low_level::expr::{Graph, Kind};
//! let mut g = Graph::new();
//! let x = g.symbol("x", Kind::State);
//! let s = g.unary(costate::low_level::expr::Fun::Sin, x);
//! let y = g.mul(x, s);
//! let dy = g.diff(y, x);
//! assert_eq!(g.show(dy), "sin(x) + x*cos(x)");
//! ```

mod degree;
mod deviation;
mod differentiate;
mod evaluate;
mod gradient;
mod graph;
mod hessian;
mod polynomial;
mod print;
mod sensitivity;

pub use deviation::Deviation;
pub use evaluate::Values;
pub use graph::{Fun, Graph, Id, Kind, Node, Op, Symbol};
pub use polynomial::{NotPolynomial, Polynomial};
pub use print::ShownTogether;
