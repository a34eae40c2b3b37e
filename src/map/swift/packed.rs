//! A map in pieces with the local solution as two arrays, for kernels on a device
//! (`shaders/pieces.wgsl`).

use super::Around;
use crate::backend::gpu::text;
use crate::map::pieces::{BLEND, Flat, Pieces, SAME, Tables, Terms};
use crate::model::Precision;
use crate::sweep::Plan;
use std::fmt::Write;

/// Loop iterations after which an invocation gives a state up: a quarter of the most that Mesa's
/// llvmpipe allows a shader, whose invocations side by side also wait for each other.
const MOST_SPENT: usize = 16384;

/// The arrays, and what the shader's text must know of them.
#[derive(Default)]
pub(crate) struct Packed {
    pub reals: Vec<f64>,
    pub words: Vec<u32>,
    /// Where in them, and how many.
    counts: Vec<(&'static str, usize)>,
    numbers: Vec<(&'static str, f64)>,
    conditions: Vec<&'static str>,
    pub states: usize,
}

impl Packed {
    /// `None` where the local solution is a polynomial of too high a degree.
    pub fn new(pieces: &Pieces, plan: &Plan) -> Option<Self> {
        let n = pieces.states();
        let around = match &plan.local {
            Some(local) => Some(Around::<f64>::new(local, &plan.system.reference)?),
            None => None,
        };
        let mut this = Self {
            states: n,
            ..Self::default()
        };
        // Deviations from the reference point, of which f32 keeps the digits near it.
        let reference: Vec<f64> = (plan.system.reference.iter().copied().chain([0.0]))
            .take(pieces.states())
            .collect();
        Flat::<f64>::new(pieces).pack(&reference, &mut this);
        let degree = around.as_ref().map_or(0, |a| a.degree);
        let tables = Tables::new(&Terms::new(n, degree.max(pieces.terms.upto.len() - 1)));
        this.tables(["UPTO", "FACTORS", "RAISED", "RAISED_TWICE"], &tables);
        this.count("PAIRS", n * (n + 1) / 2);
        this.count("MOST_SPENT", MOST_SPENT);
        this.count("TERMS", *tables.upto.last()?);
        this.count("N", n);
        this.number("EDGE", 1.0 - BLEND);
        this.number("OVERLAP", 2.0 * BLEND);
        this.number("SAME", SAME);
        if plan.periods.iter().any(Option::is_some) {
            this.conditions.push("PERIODS");
            this.reals(
                "PERIOD",
                plan.periods
                    .iter()
                    .map(|p| p.unwrap_or(0.0))
                    .chain([0.0])
                    .take(n),
            );
        }
        if let Some(around) = &around {
            this.conditions.push("LOCAL");
            this.reals("LOCAL_MATRIX", around.matrix.iter().copied());
            this.reals("LOCAL", around.coefficients.iter().map(|c| c.0[0]));
            this.count("LOCAL_DEGREE", around.degree);
            this.number("SEED_VALUE", around.seed_value);
            let neglected = around.errors.neglected();
            this.count("NEGLECTED", neglected.len());
            this.reals("NEGLECTED_SIZES", neglected.iter().map(|(_, size)| *size));
            this.words(
                "NEGLECTED_DEGREES",
                neglected.iter().map(|(k, _)| *k as u32),
            );
        }
        Some(this)
    }

    pub fn count(&mut self, name: &'static str, count: usize) {
        self.counts.push((name, count));
    }

    pub fn number(&mut self, name: &'static str, number: f64) {
        self.numbers.push((name, number));
    }

    pub fn condition(&mut self, name: &'static str) {
        self.conditions.push(name);
    }

    /// Adds an array and where it begins.
    pub fn reals(&mut self, name: &'static str, values: impl IntoIterator<Item = f64>) {
        self.count(name, self.reals.len());
        self.reals.extend(values);
    }

    pub fn words(&mut self, name: &'static str, values: impl IntoIterator<Item = u32>) {
        self.count(name, self.words.len());
        self.words.extend(values);
    }

    pub fn tables(&mut self, [upto, factors, first, second]: [&'static str; 4], tables: &Tables) {
        self.words(upto, tables.upto.iter().map(|k| *k as u32));
        let factor = |(parent, axis, power): &(u16, u8, u8)| {
            [(*parent).into(), (*axis).into(), (*power).into()]
        };
        self.words(factors, tables.factors.iter().flat_map(factor));
        self.words(first, tables.first.iter().map(|t| (*t).into()));
        self.words(second, tables.second.iter().map(|t| (*t).into()));
    }

    /// The conditions of the shader's text.
    pub fn conditions(&self) -> &[&'static str] {
        &self.conditions
    }

    /// The constants of the shader's text.
    pub fn constants(&self, precision: Precision) -> String {
        let mut all = String::new();
        for (name, count) in &self.counts {
            let _ = writeln!(all, "const {name}: u32 = {count}u;");
        }
        for (name, number) in &self.numbers {
            let _ = writeln!(
                all,
                "const {name}: real = {};",
                text::literal(*number, precision)
            );
        }
        all
    }
}
