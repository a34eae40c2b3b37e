//! Handing linear equations to a backend's eliminator.

use super::elimination::Factors;
use super::newton::{Elimination, Linear};
use crate::backend::{BackendError, Eliminator, Systems};

/// Eliminates the equations of paths with `n` states, each with the wanted step of its first state,
/// in batches of about `most` bytes.
pub(super) fn eliminate(
    eliminator: &mut dyn Eliminator,
    n: usize,
    problems: Vec<(Linear, Vec<f64>)>,
    most: usize,
) -> Result<Vec<Elimination>, BackendError> {
    let mut done = Vec::with_capacity(problems.len());
    let mut problems = problems.into_iter().peekable();
    while problems.peek().is_some() {
        let mut systems = Systems {
            states: n,
            ..Systems::default()
        };
        let mut batch = Vec::new();
        while let Some((linear, wanted)) = problems
            .next_if(|(l, _)| batch.is_empty() || 8 * (systems.phi.len() + l.phi.len()) <= most)
        {
            systems
                .segments
                .push((linear.phi.len() / (4 * n * n)) as u32);
            systems.phi.extend_from_slice(&linear.phi);
            systems.defects.extend_from_slice(&linear.residual.defects);
            systems.end.extend_from_slice(&linear.residual.end);
            systems.hessian.extend_from_slice(&linear.residual.hessian);
            systems.wanted.extend(wanted);
            batch.push(linear.phi);
        }
        let result = eliminator.eliminate(&systems)?;
        let mut first = 0;
        for phi in batch {
            let nodes = first..first + phi.len() / (4 * n * n) + 1;
            first = nodes.end;
            let of =
                |list: &[f64], each: usize| list[nodes.start * each..nodes.end * each].to_vec();
            let steps = of(&result.steps, 2 * n);
            let regular = steps.iter().all(|x| x.is_finite());
            done.push(Elimination {
                factors: Factors::from_parts(
                    n,
                    phi,
                    of(&result.w, 2 * n * n),
                    of(&result.l, n * n),
                ),
                step: regular.then_some((steps, 0.0)),
            });
        }
    }
    Ok(done)
}
