//! Fits of one sheet in three variables and more: each track is left out in turn, which one
//! factorization tells.

use super::super::fit::{Shape, Tested, most_of_group};
use super::flow::Residual;
use super::patch::Patch;
use super::{
    Block, Builder, HOPELESS, LEAST_EQUATIONS, LEAST_TESTS, LOW, Piece, largest, mix, shortlist,
    thinned,
};

/// Points beside those fitted to that test a fit, at most.
const MOST_TESTS: usize = 150;
/// Points of a block that are looked at, about.
const MOST_POINTS: usize = 4096;
/// A residual of the equation along the flow counts as this share of an error: it may change its
/// sign within the block.
const RESIDUAL: f64 = 0.5;
/// Blocks that can be halved are fitted along the flow where they err by at most so many times what
/// is good.
const NEARLY_GOOD: f64 = 30.0;
/// Places that are fitted to, those that choose between fits, and those that bounds are of (at 0)
/// are not the same.
const FITTED_TO: f64 = 0.61;
const CHOSEN_BY: f64 = 0.37;
/// Errors of V, relative to itself, above which a polynomial of a low degree is looked for.
const ROUGH: f64 = 0.1;
/// So many degrees are tried.
const DEGREES: usize = 3;
/// The most that one error counts in the choice of an axis.
const WORST: f64 = 1e6;
/// No bound is below this share of the error asked for: so few points do not tell.
const LEAST_BOUND: f64 = 0.3;
/// The bound of a piece without points on one side is so many times larger.
const AT_EDGES: f64 = 2.0;

impl Builder<'_> {
    /// The best piece for some of a block's points, with its error over the one asked for.
    pub(super) fn by_tracks(
        &self,
        block: &Block,
        points: &[u32],
        can_be_halved: bool,
    ) -> Option<(Piece, f64)> {
        // All the same, many points tell no more than some thousands.
        let some;
        let points = if points.len() > MOST_POINTS {
            some = a_share(points, MOST_POINTS);
            &some
        } else {
            points
        };
        let highest = self.highest_of(points.len())?;
        // Points in the piece tell its error, and where they are few others near it.
        let mut patch = self.patch(block, points);
        let nearest = self.nearest(&patch, LEAST_TESTS);
        patch.near = nearest.map_or(1.0, |far| far.max(1.0));
        let inside = |k: &u32| self.tells(&patch, *k);

        // Which function of V is smoothest here a low degree tells.
        let low = highest.min(LOW);
        let (first, shapes) = self.shapes_by_tracks(&patch, low)?;
        let hopeless = can_be_halved && first > HOPELESS * self.region.error;
        let degree = if hopeless { low } else { highest };
        let mine = self.drawn(points, self.most_points(degree), &inside);
        let enough =
            nearest.is_some() && mine.iter().filter(|k| inside(k)).count() >= LEAST_TESTS / 2;
        let good = self.habits.enough * self.region.error / self.habits.allowance;
        let (shape, mut fit) =
            self.best_by_tracks(&patch, &mine, (shapes, degree), (good, enough))?;
        if !hopeless {
            self.fit_along(
                patch.extent(),
                (&mine, &inside),
                (can_be_halved, good),
                (shape, &mut fit),
            );
            let errors = self.errors_beside(&patch, shape, &fit.coefficients);
            fit.errors = [0, 1].map(|i| fit.errors[i].max(errors[i]));
        }
        // What errs by much is halved if it can be.
        if self.without.is_some() && !(can_be_halved && fit.errors[0] > ROUGH) {
            self.tame(patch.extent(), (&mine, &inside), (shape, &mut fit));
        }
        let mut bounds = fit.errors.map(|e| self.habits.allowance * e);
        bounds[0] = bounds[0].max(LEAST_BOUND * self.region.error);
        let fitted = (shape, fit.coefficients);
        Some(self.piece_of(patch, fitted, enough.then_some(bounds)))
    }

    /// The distance from the middle, in half widths, within which so many points lie; `None` where
    /// there are not so many.
    fn nearest(&self, patch: &Patch<'_>, count: usize) -> Option<f64> {
        let n = self.cloud.variables;
        let mut far: Vec<f64> = (patch.points.iter())
            .map(|k| {
                let z = self.cloud.z(*k as usize);
                (0..n)
                    .map(|i| (z[i] - patch.center[i]).abs() / patch.half[i])
                    .fold(0.0, f64::max)
            })
            .collect();
        (far.len() >= count).then(|| *far.select_nth_unstable_by(count - 1, f64::total_cmp).1)
    }

    /// The functions of V worth fitting, by their errors at a low degree; and the least of these.
    fn shapes_by_tracks(&self, patch: &Patch<'_>, low: usize) -> Option<(f64, Vec<Shape>)> {
        let inside = |k: &u32| self.tells(patch, *k);
        let few = self.drawn(patch.points, self.most_points(low), &inside);
        let rough = self.data_of(patch, &few, low);
        let least = rough.least();
        let tried = (Shape::ALL.iter())
            .filter(|(shape, _)| shape.serves(least))
            .filter_map(|(shape, _)| {
                let tested = rough
                    .tested(*shape, low, (1, 0.0), |k| inside(&few[k]))
                    .pop()?;
                Some((tested.errors[0], *shape))
            });
        shortlist(tried)
    }

    /// The fit to some points that errs least, of some shapes and the highest degrees; where the
    /// points are enough to tell, no more are tried after a good one.
    fn best_by_tracks(
        &self,
        patch: &Patch<'_>,
        points: &[u32],
        (shapes, degree): (Vec<Shape>, usize),
        (good, enough): (f64, bool),
    ) -> Option<(Shape, Tested)> {
        let learned = self.data_of(patch, points, degree);
        let counts = |k: usize| self.tells(patch, points[k]);
        let mut best: Option<(Shape, Tested)> = None;
        for shape in shapes {
            for tested in learned.tested(shape, degree, (DEGREES, good), counts) {
                if best
                    .as_ref()
                    .is_none_or(|(_, b)| tested.errors[0] < b.errors[0])
                {
                    best = Some((shape, tested));
                }
            }
            if enough && best.as_ref().is_some_and(|(_, b)| b.errors[0] <= good) {
                break;
            }
        }
        best
    }

    /// Errors of a polynomial at points that it was not fitted to.
    fn errors_beside(&self, patch: &Patch<'_>, shape: Shape, coefficients: &[f64]) -> [f64; 2] {
        let beside: Vec<u32> = thinned(patch.points, MOST_TESTS)
            .into_iter()
            .filter(|k| self.tells(patch, *k))
            .collect();
        let data = self.data_of(patch, &beside, self.degree_of(coefficients));
        largest(&data.errors(shape, coefficients))
    }

    /// Fits again with the equation along the flow at places of the block, where a fit to points
    /// alone is not good enough but not far from it; takes the new fit if it errs less and solves
    /// the equation better.
    fn fit_along(
        &self,
        (center, half): (Vec<f64>, Vec<f64>),
        (points, inside): (&[u32], &impl Fn(&u32) -> bool),
        (can_be_halved, good): (bool, f64),
        (shape, fit): (Shape, &mut Tested),
    ) {
        let Some(flow) = self.flow.filter(|flow| flow.repeats()) else {
            return;
        };
        let degree = self.degree_of(&fit.coefficients).max(LOW);
        let fitted = (shape, fit.coefficients.clone());
        let (mut piece, _) = self.piece((center.clone(), half.clone()), fitted, None, &[]);
        let mut score = fit.errors[0].max(self.share_of_residual(&piece));
        if score <= good || (can_be_halved && score > NEARLY_GOOD * good) {
            return;
        }
        let places = self.places(&piece, &[], (self.terms.upto[degree], FITTED_TO));
        let along = self
            .along(&piece, &places, flow, &[])
            .into_iter()
            .flatten()
            .collect();
        let data = (self.data((&center, &half), points, degree, self.scale(points))).with(along);
        for tested in data.tested(shape, degree, (DEGREES, good), |k| inside(&points[k])) {
            piece.coefficients.clone_from(&tested.coefficients);
            let own = tested.errors[0].max(self.share_of_residual(&piece));
            // Where the points are too few to tell anything their error is 0.
            if own < score && tested.errors[0].is_finite() {
                (score, *fit) = (own, tested);
            }
        }
    }

    /// Takes a polynomial of a low degree instead of one that errs by much, if that errs less: what
    /// a high one says between few tracks may have any slope, which a law would take for V's. Of
    /// tracks so few each tells how far to trust the others.
    fn tame(
        &self,
        extent: (Vec<f64>, Vec<f64>),
        (points, inside): (&[u32], &impl Fn(&u32) -> bool),
        (shape, fit): (Shape, &mut Tested),
    ) {
        let (mut piece, _) = self.piece(extent, (shape, fit.coefficients.clone()), None, &[]);
        let mut least = fit.errors[0].max(self.share_of_residual(&piece));
        if least <= ROUGH {
            return;
        }
        let data = self.data(
            (&piece.center, &piece.half),
            points,
            LOW,
            self.scale(points),
        );
        for tested in data.tested(shape, LOW, (LOW, 0.0), |k| inside(&points[k])) {
            piece.coefficients.clone_from(&tested.coefficients);
            let of_points = largest(&data.errors(shape, &tested.coefficients));
            let own = of_points[0].max(self.share_of_residual(&piece));
            if own < least {
                let errors = [0, 1].map(|i| tested.errors[i].max(of_points[i]));
                (least, *fit) = (own, Tested { errors, ..tested });
            }
        }
    }

    /// What the residual of a piece counts beside errors of its points where fits are chosen;
    /// infinite off V's branch.
    fn share_of_residual(&self, piece: &Piece) -> f64 {
        match self.residual(piece, &[], CHOSEN_BY) {
            Residual {
                off_branch: true, ..
            } => f64::INFINITY,
            residual => RESIDUAL * residual.largest,
        }
    }

    /// A piece at whose edge points are missing errs more: beyond the outermost of them nothing
    /// tells.
    pub(super) fn bounded(&self, mut piece: Piece, at_edge: bool) -> Piece {
        if at_edge {
            piece.bound *= AT_EDGES;
            piece.p_bound *= AT_EDGES;
        }
        piece
    }

    /// Some of a list, as many inside as their share and as tell an error, and not more of a track
    /// than can be left out at once.
    fn drawn(&self, list: &[u32], most: usize, inside: &impl Fn(&u32) -> bool) -> Vec<u32> {
        let allowed = most_of_group(self.cloud.variables);
        let (within, beside): (Vec<u32>, Vec<u32>) = list.iter().partition(|k| inside(k));
        let few_a_track = |list: Vec<u32>| {
            let mut drawn = thinned(&list, 8 * most);
            drawn.sort_unstable_by_key(|k| (self.cloud.track[*k as usize], mix(*k)));
            let mut before = (u32::MAX, 0);
            drawn.retain(|k| {
                let track = self.cloud.track[*k as usize];
                before = if before.0 == track {
                    (track, before.1 + 1)
                } else {
                    (track, 0)
                };
                before.1 < allowed
            });
            drawn
        };
        // Those beside it keep its edges from being extrapolated to.
        let share = most * within.len() / list.len().max(1);
        let mut drawn = thinned(&few_a_track(within), share.max(LEAST_TESTS));
        drawn.extend(thinned(
            &few_a_track(beside),
            most.saturating_sub(drawn.len()),
        ));
        drawn
    }

    /// The axis along which a block is halved: that of the halves in which low polynomials err
    /// least.
    pub(super) fn axis_by_halves(&self, block: &Block, pieces: &[(Piece, Vec<u32>)]) -> usize {
        let wide = self.wide(block);
        let errors: Vec<Option<f64>> = match pieces {
            [(piece, points)] => {
                let most = (2.0
                    * self.habits.most_equations
                    * self.terms.upto[LOW.min(self.highest)] as f64)
                    as usize;
                let drawn = thinned(points, most);
                (wide.iter())
                    .map(|i| self.error_of_halves(block, piece, &drawn, *i))
                    .collect()
            }
            _ => vec![None; wide.len()],
        };
        let best = |score: &dyn Fn(usize) -> f64| {
            let order = (0..wide.len()).max_by(|a, b| score(*a).total_cmp(&score(*b)));
            order.map_or(0, |k| wide[k])
        };
        if errors.iter().all(Option::is_some) {
            best(&|k| -errors[k].unwrap_or(f64::INFINITY))
        } else {
            best(&|k| self.change(block, wide[k]))
        }
    }

    /// Sum of squares of the errors of low polynomials in the halves of a block; `None` where a
    /// half has too few points.
    fn error_of_halves(
        &self,
        block: &Block,
        piece: &Piece,
        points: &[u32],
        axis: usize,
    ) -> Option<f64> {
        let degree = LOW.min(self.highest);
        let at = 0.5 * (block.lo[axis] + block.hi[axis]);
        let (below, above): (Vec<u32>, Vec<u32>) =
            (points.iter().copied()).partition(|k| self.cloud.z(*k as usize)[axis] < at);
        let mut sum = 0.0;
        for half in [below, above] {
            if ((self.cloud.variables + 1) * half.len()) as f64
                <= LEAST_EQUATIONS * self.terms.upto[degree] as f64
            {
                return None;
            }
            let data = self.data(
                (&piece.center, &piece.half),
                &half,
                degree,
                self.scale(points),
            );
            let fitted = data.fitted(piece.shape, degree)?;
            sum += (data.errors(piece.shape, &fitted).iter())
                .map(|[v, p]| (v * v + p * p).min(WORST))
                .sum::<f64>();
        }
        Some(sum)
    }
}

/// About so many of a list, drawn by a hash.
fn a_share(list: &[u32], most: usize) -> Vec<u32> {
    let share = most as f64 / list.len() as f64 * f64::from(u32::MAX);
    list.iter()
        .copied()
        .filter(|k| f64::from(mix(*k)) <= share)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::super::fit::{Shape, Tested};
    use super::super::super::{Frame, Region};
    use super::super::{Builder, Cloud, Flow};
    use crate::backend::cpu::Cpu;
    use crate::hamiltonian::Hamiltonian;
    use crate::sweep::{Choices, Plan};
    use crate::value::Clearance;

    /// Of V = |x|^2/2.
    const STRAIGHT: &str = r#"
        states = { a = {}, b = {}, c = {} }
        controls = { u = {}, v = {}, w = {} }
        dynamics = { a = "u", b = "v", c = "w" }
        cost = { running = "0.5*(a^2 + b^2 + c^2 + u^2 + v^2 + w^2)" }
        equilibrium = { a = 0, b = 0, c = 0, u = 0, v = 0, w = 0 }
        region = { a = [-2, 2], b = [-2, 2], c = [-2, 2] }
    "#;

    /// All points lie in a plane, and the polynomial rises beside it, where the points do not show
    /// it: the equation does.
    #[test]
    fn what_the_equation_contradicts_gets_a_low_degree() {
        let model = crate::scenario::parse(STRAIGHT, "test.toml", &[]).expect("a scene");
        let hamiltonian = Hamiltonian::derive(&model).expect("a Hamiltonian");
        let choices = Choices {
            unasked: true,
            ..Choices::default()
        };
        let plan = Plan::new(&model, &hamiltonian, &Cpu::new(), choices).expect("a plan");
        let flow = Flow::of(&plan, false).expect("V solves the equation");
        let region = Region {
            lo: vec![1.0; 3],
            hi: vec![2.0; 3],
            error: 1e-3,
            equal_cost: f64::INFINITY,
            floor: 1e-3,
            value_max: f64::INFINITY,
            beyond: 0.1,
            game: false,
        };
        let frame = Frame::along(&region);
        let mut cloud = Cloud {
            variables: 3,
            ..Cloud::default()
        };
        for k in 0..60u32 {
            let x = [
                1.5,
                1.0 + f64::from(k % 8) / 7.0,
                1.0 + f64::from(k / 8) / 7.0,
            ];
            let v = 0.5 * x.iter().map(|x| x * x).sum::<f64>();
            cloud.add(&frame, (&x, &x), (v, Clearance::default()), (k, 0, false));
        }
        // Those round which it is made for laws lie elsewhere.
        let inner = Region {
            lo: vec![5.0; 3],
            hi: vec![6.0; 3],
            ..region.clone()
        };
        let builder = Builder::new(&cloud, &region, (&frame, Some(&inner)), Some(&flow), None);
        let points: Vec<u32> = (0..60).collect();
        let extent = (vec![0.5; 3], vec![0.5; 3]);
        // In variables y = 2 (x - 1.5): V, and what does not show at the points.
        let wild = |excess: f64| {
            let mut coefficients = vec![0.0; builder.terms.upto[4]];
            let data = [
                3.375,
                0.75,
                0.75,
                0.75,
                0.125 + excess,
                0.0,
                0.0,
                0.125,
                0.0,
                0.125,
            ];
            coefficients[..10].copy_from_slice(&data);
            coefficients
        };
        let slopes = |coefficients: Vec<f64>| -> Vec<f64> {
            let (piece, _) = builder.piece(extent.clone(), (Shape::Value, coefficients), None, &[]);
            let (_, q) = piece.value(&builder.terms, &[0.9, 0.3, -0.3]);
            q[..3].to_vec()
        };
        for (excess, is_kept) in [(0.0, true), (40.0, false)] {
            let coefficients = wild(excess);
            let errors = [1e-6; 2];
            let mut fit = Tested {
                coefficients,
                errors,
            };
            builder.tame(
                extent.clone(),
                (&points, &|_| true),
                (Shape::Value, &mut fit),
            );
            assert_eq!(fit.coefficients.len() == builder.terms.upto[4], is_kept);
            let slopes = slopes(fit.coefficients);
            let off = slopes
                .iter()
                .zip([1.95, 1.65, 1.35])
                .map(|(q, p)| (q - p).abs());
            let off = off.fold(0.0, f64::max);
            println!("{excess}: p errs by {off:.2}");
            assert!(off < 0.5 && (off < 1e-9) == is_kept);
        }
    }
}
