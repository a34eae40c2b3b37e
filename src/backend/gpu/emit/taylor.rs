//! A Taylor step: the code that the CPU records, as text.

use super::Emitter;
use crate::backend::cpu::code::Recorder;
use crate::backend::cpu::steps::Expansion;
use crate::backend::gpu::recorded::{Names, statements};
use crate::integrator::Scheme;
use std::fmt::Write;

/// Slots of the recorded code.
#[derive(Clone, Copy)]
struct Slots {
    dim: u32,
}

impl Slots {
    const T: u32 = 0;
    const FIRST_STEP: u32 = 1;
    /// The step that the expansion and the lane allow.
    const ALLOWED: u32 = 2;
    const BELOW: u32 = 3;
    const TOP: u32 = 4;
    const H: u32 = 5;
    const Y: u32 = 6;

    /// Where the new point is.
    fn new_y(self) -> u32 {
        Self::Y + self.dim
    }

    /// Where coefficient `j` of a component is, from the first on.
    fn coefficient(self, j: usize, c: usize) -> u32 {
        self.new_y() + j as u32 * self.dim + c as u32
    }
}

impl Names for Slots {
    fn load(&self, slot: u32, text: &mut String) -> String {
        match slot {
            Self::T => "lane.t".to_owned(),
            Self::FIRST_STEP => "lane.first_step".to_owned(),
            Self::ALLOWED => {
                let _ = writeln!(
                    text,
                    "let reach = reach_of(s{}, s{}, lane);\nlet allowed = select(lane.h, reach, reach * 1.001 < lane.h);",
                    Self::BELOW,
                    Self::TOP
                );
                "allowed".to_owned()
            }
            y => format!("lane.y.c{}", y - Self::Y),
        }
    }

    fn parameter(&self, index: u32) -> String {
        match index {
            0 => "run.rtol".to_owned(),
            c => format!("run.atol.c{}", c - 1),
        }
    }

    fn store(&self, slot: u32, value: &str) -> String {
        format!("let s{slot} = {value};")
    }
}

impl Emitter<'_> {
    /// A Taylor step and its dense output.
    pub(super) fn taylor(&self, order: usize, text: &mut String) {
        let list = |f: &dyn Fn(usize) -> String| (0..order).map(f).collect::<Vec<_>>();
        let _ = writeln!(
            text,
            "// New point, the step taken and the one that the expansion allows, squared error (0, or not a\n\
             // number), coefficients from the first on.\n\
             struct Step {{ y: Vector, h: real, reach: real, error: real, {}, }}",
            list(&|j| format!("a{j}: Vector")).join(", ")
        );
        let slots = Slots {
            dim: self.dim as u32,
        };
        let vector = |slot: &dyn Fn(usize) -> u32| {
            let components: Vec<String> = (0..self.dim).map(|c| format!("s{}", slot(c))).collect();
            format!("Vector({})", components.join(", "))
        };
        let _ = writeln!(
            text,
            "fn attempt(lane: Lane, run: Run) -> Step {{\n{}\
             let y = {};\n\
             let error = select(not_a_number(), 0.0, is_finite(total(y)) & (reach > 0.0));\n\
             return Step(y, s{}, reach, error, {});\n}}",
            statements(self.recorded(order), self.spec.precision, &slots),
            vector(&|c| slots.new_y() + c as u32),
            Slots::H,
            list(&|j| vector(&|c| slots.coefficient(j + 1, c))).join(", ")
        );
        self.dense_structure(text);
        let _ = writeln!(
            text,
            "fn densify(y: Vector, k0: Vector, step: Step, h: real) -> Dense {{\n    let h0 = real(1.0);"
        );
        for m in 1..order {
            let _ = writeln!(text, "    let h{m} = h{} * h;", m - 1);
        }
        let scaled = |m: usize| {
            let components: Vec<String> = (0..self.dim)
                .map(|c| format!("step.a{m}.c{c} * h{m}"))
                .collect();
            format!("Vector({})", components.join(", "))
        };
        let _ = writeln!(text, "    return Dense({});\n}}", list(&scaled).join(", "));
    }

    /// Coefficients, the step up to kinks, and the new point.
    fn recorded(&self, order: usize) -> Recorder {
        let slots = Slots {
            dim: self.dim as u32,
        };
        let mut recorder = Recorder::new(self.spec.precision, false);
        let r = &mut recorder;
        let y: Vec<_> = (0..self.dim)
            .map(|c| r.load(Slots::Y as usize + c))
            .collect();
        let rtol = r.parameter(0);
        let atol: Vec<_> = (0..self.dim).map(|c| r.parameter(1 + c)).collect();
        let expansion = Expansion::new(r, self.spec, order, (rtol, &atol), &y);
        r.store(expansion.last[0], Slots::BELOW as usize);
        r.store(expansion.last[1], Slots::TOP as usize);
        let allowed = r.load(Slots::ALLOWED as usize);
        let (t, first_step) = (
            r.load(Slots::T as usize),
            r.load(Slots::FIRST_STEP as usize),
        );
        let h = expansion.up_to_kinks(r, self.spec, allowed, (t, first_step));
        r.store(h, Slots::H as usize);
        for (c, y) in expansion.at(r, h).into_iter().enumerate() {
            r.store(y, slots.new_y() as usize + c);
        }
        for j in 1..=order {
            for c in 0..self.dim {
                let coefficient = expansion.coefficient(r, c, j);
                r.store(coefficient, slots.coefficient(j, c) as usize);
            }
        }
        recorder
    }

    /// Operations of a step that is written out; 0 of a Runge-Kutta step, whose stages call a function.
    pub fn written_out(&self) -> usize {
        match self.scheme {
            Scheme::RungeKutta(_) => 0,
            Scheme::Taylor(order) => self.recorded(order).ops.len(),
        }
    }
}
