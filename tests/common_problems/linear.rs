//! Linear-quadratic problems: Riccati and Lyapunov equations by methods that are none of the
//! engine's.

use super::{Exact, parameter};
use costate::low_level::model::Model;
use nalgebra::{DMatrix, DVector};

/// `x' = a x + b u`, `L = (x'q x + u'r u)/2`.
pub struct Linear {
    pub a: DMatrix<f64>,
    pub b: DMatrix<f64>,
    pub q: DMatrix<f64>,
    pub r: DMatrix<f64>,
}

pub fn diagonal(entries: &[f64]) -> DMatrix<f64> {
    DMatrix::from_diagonal(&DVector::from_row_slice(entries))
}

/// S with `a'S + S a + q = 0`, as a linear system of n^2 unknowns: `x'S x/2` is what `x' = a x`
/// costs from x on, with `L = x'q x/2`.
pub fn lyapunov(a: &DMatrix<f64>, q: &DMatrix<f64>) -> DMatrix<f64> {
    let n = a.nrows();
    let identity = DMatrix::<f64>::identity(n, n);
    let operator = identity.kronecker(&a.transpose()) + a.transpose().kronecker(&identity);
    let solved = operator
        .lu()
        .solve(&-DVector::from_column_slice(q.as_slice()));
    DMatrix::from_column_slice(n, n, solved.expect("a stable a").as_slice())
}

impl Linear {
    /// The two masses of `scenarios/linear_quadratic.toml`.
    pub fn masses(model: &Model) -> Self {
        let q = |name| parameter(model, name);
        let (m1, m2, k, kc, d) = (q("m1"), q("m2"), q("k"), q("kc"), q("d"));
        #[rustfmt::skip]
        let a = DMatrix::from_row_slice(4, 4, &[
            0.0, 1.0, 0.0, 0.0,
            -(k + kc) / m1, -d / m1, kc / m1, 0.0,
            0.0, 0.0, 0.0, 1.0,
            kc / m2, 0.0, -(k + kc) / m2, -d / m2,
        ]);
        Self {
            a,
            b: DMatrix::from_row_slice(4, 2, &[0.0, 0.0, 1.0 / m1, 0.0, 0.0, 0.0, 0.0, 1.0 / m2]),
            q: diagonal(&[q("q_x"), q("q_v"), q("q_x"), q("q_v")]),
            r: diagonal(&[q("r1"), q("r2")]),
        }
    }

    /// What the law `u = -gain x` costs: `x'S x/2`.
    pub fn cost(&self, gain: &DMatrix<f64>) -> DMatrix<f64> {
        let q = &self.q + gain.transpose() * &self.r * gain;
        lyapunov(&(&self.a - &self.b * gain), &q)
    }

    /// P and the optimal gain by Kleinman's iteration (IEEE Trans. Automatic Control 13, 1968)
    /// from a gain that stabilizes.
    pub fn optimal_from(&self, mut gain: DMatrix<f64>) -> (DMatrix<f64>, DMatrix<f64>) {
        let Self { a, b, q, r } = self;
        let inverse = r.clone().try_inverse().expect("R > 0");
        let mut p = DMatrix::zeros(a.nrows(), a.nrows());
        for _ in 0..30 {
            p = self.cost(&gain);
            gain = &inverse * b.transpose() * &p;
        }
        let residual = a.transpose() * &p + &p * a - &p * b * &gain + q;
        // What a few dozen roundings of the largest terms leave.
        let scale = p.norm() * (1.0 + a.norm());
        assert!(
            residual.norm() < 1e-13 * scale,
            "Kleinman's iteration converges: {:e} of {scale:e}",
            residual.norm()
        );
        (p, gain)
    }

    /// As [`Self::optimal_from`], from none, which a stable a allows.
    pub fn optimal(&self) -> (DMatrix<f64>, DMatrix<f64>) {
        self.optimal_from(DMatrix::zeros(self.b.ncols(), self.a.nrows()))
    }

    /// P with a time left, for V = x'Px/2 with the terminal cost x'(end)x/2, and its derivative by
    /// the time left: the Riccati equation by Runge and Kutta's method, which is stable in this
    /// direction. Its error, (rate step)^4, is below 1e-14 for rates of a few.
    pub fn with_time(&self, end: DMatrix<f64>, left: f64) -> [DMatrix<f64>; 2] {
        let Self { a, b, q, r } = self;
        let effort = b * r.clone().try_inverse().expect("R > 0") * b.transpose();
        let rate = |p: &DMatrix<f64>| q + a.transpose() * p + p * a - p * &effort * p;
        let steps = (4000.0 * left).ceil() as usize;
        let h = left / steps.max(1) as f64;
        let mut p = end;
        for _ in 0..steps {
            let k1 = rate(&p);
            let k2 = rate(&(&p + 0.5 * h * &k1));
            let k3 = rate(&(&p + 0.5 * h * &k2));
            let k4 = rate(&(&p + h * &k3));
            p += (k1 + 2.0 * (k2 + k3) + k4) * (h / 6.0);
        }
        let slope = rate(&p);
        [p, slope]
    }
}

/// `x'Px/2`.
pub fn form(p: &DMatrix<f64>, x: &[f64]) -> f64 {
    let x = DVector::from_column_slice(x);
    0.5 * (p * &x).dot(&x)
}

/// `V = x'Px/2`, `u = -gain x`.
pub fn quadratic(p: &DMatrix<f64>, gain: &DMatrix<f64>, x: &[f64]) -> Exact {
    let x = DVector::from_column_slice(x);
    let costate = p * &x;
    Exact {
        v: 0.5 * costate.dot(&x),
        u: (-(gain * &x)).as_slice().to_vec(),
        p: costate.as_slice().to_vec(),
    }
}

/// `scenarios/finite_horizon.toml`: `x' = v`, `v' = u`, `L = u^2/2`, terminal cost
/// `s (x^2 + v^2)/2`. The rest of the way without control ends in `(y, v) = (x + v T, v)`, of which
/// V is a quadratic form.
#[derive(Clone, Copy, Debug)]
pub struct Cart {
    /// s.
    pub weight: f64,
}

impl Cart {
    pub fn of(model: &Model) -> Self {
        Self {
            weight: parameter(model, "s"),
        }
    }

    /// With a time T left.
    pub fn at(self, x: &[f64], left: f64) -> Exact {
        let rest = 1.0 / self.weight;
        let (y, v) = (x[0] + x[1] * left, x[1]);
        let d = (left.powi(3) / 3.0 + rest) * (left + rest) - left.powi(4) / 4.0;
        let (a, b, c) = (
            (left + rest) / d,
            -left * left / (2.0 * d),
            (left.powi(3) / 3.0 + rest) / d,
        );
        // V = (a y^2 + 2 b y v + c v^2)/2 and dy/dx = 1, dy/dv = T.
        let (p_y, p_v) = (a * y + b * v, b * y + c * v);
        let p = vec![p_y, p_y * left + p_v];
        Exact {
            v: 0.5 * (p_y * y + p_v * v),
            u: vec![-p[1]],
            p,
        }
    }
}

/// The text of a scene: a chain of masses, each tied to its place and to its neighbours, pushed at
/// its ends; `cubic` is the share of the third order in the springs between them, 0 for a linear
/// chain.
pub fn chain(masses: usize, cubic: f64) -> String {
    let section = |name: &str, line: &dyn Fn(usize) -> String| {
        let lines: Vec<String> = (0..masses).map(line).collect();
        format!("[{name}]\n{}\n", lines.join("\n"))
    };
    let ends = match masses {
        1 => vec![0],
        _ => vec![0, masses - 1],
    };
    let neighbour = |i: usize, other: Option<usize>| {
        other.filter(|k| *k < masses).map_or_else(String::new, |k| {
            format!(" + (x{k} - x{i}) + {cubic:?}*(x{k} - x{i})^3")
        })
    };
    let dynamics = |i: usize| {
        let (left, right) = (neighbour(i, i.checked_sub(1)), neighbour(i, Some(i + 1)));
        let force = match ends.contains(&i) {
            true => format!(" + u{i}"),
            false => String::new(),
        };
        format!("x{i} = \"v{i}\"\nv{i} = \"-x{i} - 0.1*v{i}{left}{right}{force}\"")
    };
    let each = |line: &dyn Fn(&usize) -> String| ends.iter().map(line).collect::<String>();
    let squares: Vec<String> = (0..masses)
        .map(|i| format!("x{i}^2 + v{i}^2"))
        .chain(ends.iter().map(|i| format!("u{i}^2")))
        .collect();
    [
        section("states", &|i| format!("x{i} = {{}}\nv{i} = {{}}")),
        format!("[controls]\n{}", each(&|i| format!("u{i} = {{}}\n"))),
        section("dynamics", &dynamics),
        format!("[cost]\nrunning = \"0.5*({})\"\n", squares.join(" + ")),
        section("equilibrium", &|i| format!("x{i} = 0\nv{i} = 0")),
        each(&|i| format!("u{i} = 0\n")),
        section("region", &|i| format!("x{i} = [-1, 1]\nv{i} = [-1, 1]")),
    ]
    .concat()
}
