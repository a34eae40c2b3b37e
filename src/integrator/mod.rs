//! Integration methods as data: one tableau serves every backend.

mod dop853;

pub use dop853::DOP853;

/// An explicit method whose last stage is the derivative at the new point ("first same as last").
#[derive(Clone, Copy)]
pub struct Tableau {
    /// Order of the advanced solution.
    pub order: u32,
    /// Row i gives stage i + 1 from the stages before it; the last row is the solution's weights.
    pub a: &'static [&'static [f64]],
    /// Weights of the error estimate, or empty for a fixed-step method.
    pub error: &'static [f64],
    /// Weights of a second estimate, of lower order, or empty. With the mean squares e and c of
    /// both in the tolerance's norm the squared error is `e^2 / (e + c/100)`.
    pub companion: &'static [f64],
    /// Further stages that only dense output takes, like rows of `a`.
    pub extra: &'static [&'static [f64]],
    /// Dense output: weight of stage j at fraction q of the step is the sum of `d[j][i]` times
    /// basis polynomial i. All stages, the further ones included, have as many coefficients.
    pub dense: &'static [&'static [f64]],
    /// The basis polynomials: coefficients of q, q^2, ... of each; empty where polynomial i is
    /// `q^(i+1)`.
    pub basis: &'static [&'static [f64]],
}

impl Tableau {
    /// Stages, the one at the new point included.
    pub const fn stages(&self) -> usize {
        self.a.len() + 1
    }

    /// The error falls with the step to the power of this one's inverse.
    pub const fn exponent(&self) -> f64 {
        if self.order > 5 { 1.0 / 8.0 } else { 1.0 / 5.0 }
    }

    /// First step: this fraction of |y|/|y'| in the tolerance's norm. A high order takes long
    /// steps, and many small ones at the beginning would be most of the work of a short trajectory.
    pub const fn first(&self) -> f64 {
        if self.order > 5 { 0.1 } else { control::SHARE }
    }

    /// Powers of dense output.
    pub const fn degree(&self) -> usize {
        self.dense[0].len()
    }

    /// Coefficient of `q^(m+1)` in basis polynomial i of the dense output.
    pub fn power(&self, i: usize, m: usize) -> f64 {
        match self.basis.get(i) {
            Some(polynomial) => polynomial[m],
            None => f64::from(u8::from(i == m)),
        }
    }

    /// Whether steps are chosen by an error estimate.
    pub const fn adaptive(&self) -> bool {
        !self.error.is_empty()
    }
}

/// The classical method of order 4 (Kutta 1901). Dense output is the cubic Hermite interpolant, of
/// order 3 locally like the method's own global error.
pub static RK4: Tableau = Tableau {
    order: 4,
    a: &[
        &[0.5],
        &[0.0, 0.5],
        &[0.0, 0.0, 1.0],
        &[1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0],
    ],
    error: &[],
    companion: &[],
    // y0 + q h k1 + (3q^2 - 2q^3)(y1 - y0 - h k1) ... collected by stage, with k5 = f(y1):
    // h00 cancels; y1 - y0 = h (k1 + 2 k2 + 2 k3 + k4)/6.
    extra: &[],
    basis: &[],
    dense: &[
        &[1.0, -2.0 + 0.5, 1.0 - 1.0 / 3.0, 0.0],
        &[0.0, 1.0, -2.0 / 3.0, 0.0],
        &[0.0, 1.0, -2.0 / 3.0, 0.0],
        &[0.0, 0.5, -1.0 / 3.0, 0.0],
        &[0.0, -1.0, 1.0, 0.0],
    ],
};

/// Order 5(4) pair of Ch. Tsitouras, "Runge-Kutta pairs of order 5(4) satisfying only the first
/// column simplifying assumption", Computers & Mathematics with Applications 62 (2011), 770-775;
/// dense output of order 4 from there.
pub static TSIT5: Tableau = Tableau {
    order: 5,
    a: &[
        &[0.161],
        &[-0.008480655492356989, 0.335480655492357],
        &[2.8971530571054935, -6.359448489975075, 4.3622954328695815],
        &[
            5.325864828439257,
            -11.748883564062828,
            7.4955393428898365,
            -0.09249506636175525,
        ],
        &[
            5.86145544294642,
            -12.92096931784711,
            8.159367898576159,
            -0.071584973281401,
            -0.028269050394068383,
        ],
        &[
            0.09646076681806523,
            0.01,
            0.4798896504144996,
            1.379008574103742,
            -3.290069515436081,
            2.324710524099774,
        ],
    ],
    error: &[
        -0.00178001105222577714,
        -0.0008164344596567469,
        0.007880878010261995,
        -0.1447110071732629,
        0.5823571654525552,
        -0.45808210592918697,
        0.015151515151515152,
    ],
    companion: &[],
    extra: &[],
    basis: &[],
    dense: &[
        &[
            1.0,
            -2.763706197274826,
            2.9132554618219126,
            -1.0530884977290216,
        ],
        &[0.0, 0.13169999999999998, -0.2234, 0.1017],
        &[
            0.0,
            3.9302962368947516,
            -5.941033872131505,
            2.490627285651253,
        ],
        &[
            0.0,
            -12.411077166933676,
            30.33818863028232,
            -16.548102889244902,
        ],
        &[0.0, 37.50931341651104, -88.1789048947664, 47.37952196281928],
        &[
            0.0,
            -27.896526289197286,
            65.09189467479366,
            -34.87065786149661,
        ],
        &[0.0, 1.5, -4.0, 2.5],
    ],
};

/// What a kernel runs at each step.
#[derive(Clone, Copy)]
pub enum Scheme {
    RungeKutta(&'static Tableau),
    /// Taylor polynomials of this degree.
    Taylor(usize),
}

impl Scheme {
    /// Whether steps are chosen by the tolerance.
    pub fn adaptive(self) -> bool {
        match self {
            Scheme::RungeKutta(tableau) => tableau.adaptive(),
            Scheme::Taylor(_) => true,
        }
    }

    /// Powers of dense output.
    pub fn degree(self) -> usize {
        match self {
            Scheme::RungeKutta(tableau) => tableau.degree(),
            Scheme::Taylor(order) => order,
        }
    }
}

impl crate::model::Method {
    /// The tableau of a Runge-Kutta method.
    pub fn tableau(self) -> Option<&'static Tableau> {
        match self {
            crate::model::Method::Rk4 => Some(&RK4),
            crate::model::Method::Tsit5 => Some(&TSIT5),
            crate::model::Method::Dop853 => Some(&DOP853),
            crate::model::Method::Taylor => None,
        }
    }

    /// The scheme for a relative tolerance.
    pub fn scheme(self, rtol: f64) -> Scheme {
        self.tableau().map_or_else(
            || Scheme::Taylor(control::taylor_order(rtol)),
            Scheme::RungeKutta,
        )
    }

    /// Whether steps are chosen by the tolerance.
    pub fn adaptive(self) -> bool {
        self.tableau().is_none_or(Tableau::adaptive)
    }
}

/// Step control, shared by all backends.
///
/// With `e` the RMS over components of error / (atol + rtol |y|), a step is accepted when `e < 1`
/// and the next one is `h * clamp(SAFETY * e^-ALPHA * e_before^BETA, SHRINK, GROW)` (PI control,
/// Hairer & Wanner, Solving ODEs II, IV.2).
pub mod control {
    pub const SAFETY: f64 = 0.9;
    /// Exponents in units of the method's [`super::Tableau::exponent`].
    pub const ALPHA: f64 = 0.7;
    pub const BETA: f64 = 0.4;
    /// A kink within this share of a step from one of its ends counts as met: its error is of the
    /// second order in it. In f32 what is much nearer is lost in rounding.
    pub const fn at_kink(epsilon: f64) -> f64 {
        if epsilon > 1e-10 { 1e-4 } else { 1e-6 }
    }
    /// First step of methods of moderate order: this fraction of |y|/|y'|.
    pub const SHARE: f64 = 0.01;
    /// Weight of a companion estimate's mean square.
    pub const COMPANION: f64 = 0.01;
    /// The order of Taylor's method at which the work for a tolerance is least: steps are then
    /// about `radius / e^2` (Jorba & Zou, "A software package for the numerical integration of ODEs
    /// by means of high-order Taylor methods", Experimental Mathematics 14 (2005), section 3).
    pub fn taylor_order(rtol: f64) -> usize {
        ((-0.5 * rtol.ln()).ceil() as usize + 1).clamp(4, 24)
    }
    /// Share taken of the step at which the last Taylor term would be as large as the tolerance
    /// (section 3 there).
    pub fn taylor_safety(order: usize) -> f64 {
        (-0.7 / (order as f64 - 1.0)).exp()
    }
    pub const SHRINK: f64 = 0.2;
    pub const GROW: f64 = 5.0;
    /// The step floor in units of rounding of the time or the first step.
    pub const FLOOR_ULPS: f64 = 16.0;
    /// Smallest error remembered for the next step, so that one lucky step does not throw the next
    /// one.
    pub const LEAST_ERROR: f64 = 1e-4;
}
