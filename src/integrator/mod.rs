//! Runge-Kutta methods as data: one tableau serves every backend.

/// An explicit method whose last stage is the derivative at the new point ("first same as last").
pub struct Tableau {
    /// Order of the advanced solution.
    pub order: u32,
    /// Row i gives stage i + 1 from the stages before it; the last row is the solution's weights.
    pub a: &'static [&'static [f64]],
    /// Weights of the error estimate, or empty for a fixed-step method.
    pub error: &'static [f64],
    /// Weights of a second estimate, of lower order, or empty. With the mean squares e and c of both in the tolerance's
    /// norm the squared error is `e^2 / (e + c/100)`.
    pub companion: &'static [f64],
    /// Dense output: weight of stage j at fraction q of the step is `q * (d[j][0] + q*(d[j][1] + q*(d[j][2] + q*d[j][3])))`.
    pub dense: &'static [[f64; 4]],
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

    /// First step: this fraction of |y|/|y'| in the tolerance's norm. A high order takes long steps, and many small ones
    /// at the beginning would be most of the work of a short trajectory.
    pub const fn first(&self) -> f64 {
        if self.order > 5 { 0.1 } else { 0.01 }
    }

    /// Whether steps are chosen by an error estimate.
    pub const fn adaptive(&self) -> bool {
        !self.error.is_empty()
    }
}

/// The classical method of order 4 (Kutta 1901). Dense output is the cubic Hermite interpolant, of order 3 locally
/// like the method's own global error.
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
    dense: &[
        [1.0, -2.0 + 0.5, 1.0 - 1.0 / 3.0, 0.0],
        [0.0, 1.0, -2.0 / 3.0, 0.0],
        [0.0, 1.0, -2.0 / 3.0, 0.0],
        [0.0, 0.5, -1.0 / 3.0, 0.0],
        [0.0, -1.0, 1.0, 0.0],
    ],
};

/// Order 5(4) pair of Ch. Tsitouras, "Runge-Kutta pairs of order 5(4) satisfying only the first column simplifying
/// assumption", Computers & Mathematics with Applications 62 (2011), 770-775; dense output of order 4 from there.
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
    dense: &[
        [1.0, -2.763706197274826, 2.9132554618219126, -1.0530884977290216],
        [0.0, 0.13169999999999998, -0.2234, 0.1017],
        [0.0, 3.9302962368947516, -5.941033872131505, 2.490627285651253],
        [0.0, -12.411077166933676, 30.33818863028232, -16.548102889244902],
        [0.0, 37.50931341651104, -88.1789048947664, 47.37952196281928],
        [0.0, -27.896526289197286, 65.09189467479366, -34.87065786149661],
        [0.0, 1.5, -4.0, 2.5],
    ],
};

/// Order 8(5,3) method of E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I (1993), II.10
/// (DOP853). Dense output is the cubic Hermite interpolant: this tableau is for steps that end where a value is wanted.
pub static DOP853: Tableau = Tableau {
    order: 8,
    a: &[
        &[0.05260015195876773],
        &[0.0197250569845379, 0.0591751709536137],
        &[0.02958758547680685, 0.0, 0.08876275643042054],
        &[0.2413651341592667, 0.0, -0.8845494793282861, 0.924834003261792],
        &[0.037037037037037035, 0.0, 0.0, 0.17082860872947386, 0.12546768756682242],
        &[
            0.037109375,
            0.0,
            0.0,
            0.17025221101954405,
            0.06021653898045596,
            -0.017578125,
        ],
        &[
            0.03709200011850479,
            0.0,
            0.0,
            0.17038392571223998,
            0.10726203044637328,
            -0.015319437748624402,
            0.008273789163814023,
        ],
        &[
            0.6241109587160757,
            0.0,
            0.0,
            -3.3608926294469414,
            -0.868219346841726,
            27.59209969944671,
            20.154067550477894,
            -43.48988418106996,
        ],
        &[
            0.47766253643826434,
            0.0,
            0.0,
            -2.4881146199716677,
            -0.590290826836843,
            21.230051448181193,
            15.279233632882423,
            -33.28821096898486,
            -0.020331201708508627,
        ],
        &[
            -0.9371424300859873,
            0.0,
            0.0,
            5.186372428844064,
            1.0914373489967295,
            -8.149787010746927,
            -18.52006565999696,
            22.739487099350505,
            2.4936055526796523,
            -3.0467644718982196,
        ],
        &[
            2.273310147516538,
            0.0,
            0.0,
            -10.53449546673725,
            -2.0008720582248625,
            -17.9589318631188,
            27.94888452941996,
            -2.8589982771350235,
            -8.87285693353063,
            12.360567175794303,
            0.6433927460157636,
        ],
        &[
            0.054293734116568765,
            0.0,
            0.0,
            0.0,
            0.0,
            4.450312892752409,
            1.8915178993145003,
            -5.801203960010585,
            0.3111643669578199,
            -0.1521609496625161,
            0.20136540080403034,
            0.04471061572777259,
        ],
    ],
    error: &[
        0.01312004499419488,
        0.0,
        0.0,
        0.0,
        0.0,
        -1.2251564463762044,
        -0.4957589496572502,
        1.6643771824549864,
        -0.35032884874997366,
        0.3341791187130175,
        0.08192320648511571,
        -0.022355307863886294,
        0.0,
    ],
    companion: &[
        -0.18980075407240762,
        0.0,
        0.0,
        0.0,
        0.0,
        4.450312892752409,
        1.8915178993145003,
        -5.801203960010585,
        -0.4226823213237919,
        -0.1521609496625161,
        0.20136540080403034,
        0.02265179219836082,
        0.0,
    ],
    dense: &[
        [1.0, -1.8371187976502936, 0.8914125317668624, 0.0],
        [0.0, 0.0, -0.0, 0.0],
        [0.0, 0.0, -0.0, 0.0],
        [0.0, 0.0, -0.0, 0.0],
        [0.0, 0.0, -0.0, 0.0],
        [0.0, 13.350938678257227, -8.900625785504818, 0.0],
        [0.0, 5.674553697943501, -3.7830357986290006, 0.0],
        [0.0, -17.403611880031754, 11.60240792002117, 0.0],
        [0.0, 0.9334931008734597, -0.6223287339156398, 0.0],
        [0.0, -0.45648284898754826, 0.3043218993250322, 0.0],
        [0.0, 0.604096202412091, -0.4027308016080607, 0.0],
        [0.0, 0.13413184718331778, -0.08942123145554517, 0.0],
        [0.0, -1.0, 1.0, 0.0],
    ],
};

impl crate::model::Method {
    pub fn tableau(self) -> &'static Tableau {
        match self {
            crate::model::Method::Rk4 => &RK4,
            crate::model::Method::Tsit5 => &TSIT5,
            crate::model::Method::Dop853 => &DOP853,
        }
    }
}

/// Step control, shared by all backends.
///
/// With `e` the RMS over components of error / (atol + rtol |y|), a step is accepted when `e <= 1` and the next one is
/// `h * clamp(SAFETY * e^-ALPHA * e_before^BETA, SHRINK, GROW)` (PI control, Hairer & Wanner, Solving ODEs II, IV.2).
pub mod control {
    pub const SAFETY: f64 = 0.9;
    /// Exponents in units of the method's [`super::Tableau::exponent`].
    pub const ALPHA: f64 = 0.7;
    pub const BETA: f64 = 0.4;
    /// A kink within this share of a step from one of its ends counts as met: its error is of the second order in it.
    /// In f32 what is much nearer is lost in rounding.
    pub const fn at_kink(epsilon: f64) -> f64 {
        if epsilon > 1e-10 { 1e-4 } else { 1e-6 }
    }
    /// Weight of a companion estimate's mean square.
    pub const COMPANION: f64 = 0.01;
    pub const SHRINK: f64 = 0.2;
    pub const GROW: f64 = 5.0;
    /// The step floor in units of rounding of the time or the first step.
    pub const FLOOR_ULPS: f64 = 16.0;
    /// Smallest error remembered for the next step, so that one lucky step does not throw the next one.
    pub const LEAST_ERROR: f64 = 1e-4;
}
