//! Results against references: each with the one of another method, and the references with each
//! other.

use super::BenchError;
use super::errors::{Errors, Meter, compare};
use super::measure::{Floor, Told};
use super::reference::{self, Reference, Slopes};
use super::variants::Wanted;
use super::work::Work;
use costate::backend::Trajectories;
use costate::low_level::model::Method;

/// Trajectories with slopes of p, which take neighbours.
const WITH_SLOPES: usize = 1024;
/// Trajectories of a reference that only tells how far the other one can be trusted.
const FLOOR_CHECKED: usize = 512;

/// What results are compared with.
pub struct Comparison {
    meter: Meter,
    /// One a method, in the order of [`reference::METHODS`].
    references: Vec<Reference>,
    slopes: Slopes,
}

impl Comparison {
    /// Integrates the references of the first `checked` trajectories.
    ///
    /// # Errors
    /// References that cannot be made, or that pass no level to compare at.
    pub fn new(
        work: &Work,
        wanted: &Wanted,
        checked: usize,
        told: Told<'_>,
    ) -> Result<Self, BenchError> {
        let meter = Meter::new(work);
        let methods = reference::METHODS;
        let mut references = Vec::new();
        for (k, method) in methods.into_iter().enumerate() {
            told(&format!("reference: {}", method.name()));
            // The second one is for what is measured by the first one's method, else only to tell
            // how far they are apart.
            let all = k == 0 || wanted.methods.contains(&methods[0]);
            let count = if all { checked } else { FLOOR_CHECKED };
            references.push(Reference::new(work, &meter, method, count)?);
        }
        if references.iter().any(|r| r.samples() == 0) {
            return Err(BenchError::NoReference { seeds: checked });
        }
        told("slopes of p");
        let slopes = Slopes::new(work, &references[0], WITH_SLOPES)?;
        Ok(Self {
            meter,
            references,
            slopes,
        })
    }

    /// How far the references are apart.
    pub fn floor(&self, work: &Work) -> Floor {
        let [first, second] = [&self.references[0], &self.references[1]];
        Floor {
            methods: [first.method, second.method],
            trajectories: first.result.count().min(second.result.count()),
            errors: self.with(work, first, &second.result),
        }
    }

    /// Errors of what a method gave, by a reference of another method.
    pub fn errors(&self, work: &Work, method: Method, result: &Trajectories) -> Errors {
        let other = usize::from(method == reference::METHODS[0]);
        self.with(work, &self.references[other], result)
    }

    /// Duration of the median trajectory, in the scene's unit of time.
    pub fn median_duration(&self) -> f64 {
        self.references[0].median_duration()
    }

    /// Trajectories whose errors of p can be told.
    pub fn with_slopes(&self) -> usize {
        self.slopes.count
    }

    fn with(&self, work: &Work, reference: &Reference, result: &Trajectories) -> Errors {
        compare(work, &self.meter, reference, Some(&self.slopes), result)
    }
}
