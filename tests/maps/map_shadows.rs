//! Maps to an error where guards cut off states: behind a guard, in its shadow, solutions would
//! leave it, and nothing is said there, although the same polynomial holds on both sides of the
//! shadow's edge.

use crate::common_commands;

use common_commands::{column_of, map_of, scratch};
use nalgebra::{Matrix2, Matrix3, SMatrix, SVector};
use std::f64::consts::{PI, TAU};

/// What a map says on both sides of the edge of a shadow.
#[derive(Debug, Default)]
struct Said {
    /// States whose solutions stay inside the guards, and of how many of them V is known.
    lit: usize,
    known: usize,
    /// States, inside the guards, of which it is not so, and of how many of them a value is told.
    dark: usize,
    told: usize,
    /// How far the solution of a state that is told leaves a guard, at most.
    deepest: f64,
}

impl Said {
    /// What is said at states spread over a region that is so many wide, of which the margins of
    /// the guards are told: at the state, and the least along its solution.
    fn of<const N: usize>(
        (name, scene): (&str, &str),
        half_widths: [f64; N],
        guards: impl Fn(&SVector<f64, N>) -> f64,
        along: impl Fn(&SVector<f64, N>) -> f64,
    ) -> Self {
        let folder = scratch(&format!("map_shadows_{name}"));
        let (stored, _) = map_of(&folder, name, scene);
        let map = stored.value_map().unwrap();
        // Powers of the root of x^(N + 1) = x + 1 spread them evenly.
        let root = (0..60).fold(1.5f64, |x, _| (x + 1.0).powf(1.0 / (N as f64 + 1.0)));
        let mut said = Self::default();
        for k in 1..=4000 {
            let place = |i: usize| (f64::from(k) * root.powi(-(i as i32 + 1))).fract();
            let x = SVector::<f64, N>::from_fn(|i, _| half_widths[i] * (2.0 * place(i) - 1.0));
            let is_known = map.at(x.as_slice()).lowest.is_ok();
            if guards(&x) < 0.0 {
                assert!(!is_known, "{x:?} is excluded");
                continue;
            }
            let margin = along(&x);
            if margin > 0.0 {
                said.lit += 1;
                said.known += usize::from(is_known);
            } else {
                said.dark += 1;
                said.told += usize::from(is_known);
                said.deepest = said.deepest.max(if is_known { -margin } else { 0.0 });
            }
        }
        println!("{name}: {said:?}");
        said
    }

    fn check(&self, known: f64, told: f64, deepest: f64) {
        assert!(self.lit > 1000 && self.dark > 60, "{self:?}");
        assert!(self.known as f64 > known * self.lit as f64, "{self:?}");
        assert!(self.told as f64 <= told * self.dark as f64, "{self:?}");
        assert!(self.deepest <= deepest, "{self:?}");
    }
}

/// V = |x|^2/2: solutions go straight to 0.
fn straight(states: &str, controls: &str, more: &str) -> String {
    let list = |names: &str| {
        names
            .chars()
            .map(|c| format!("{c} = {{}}, "))
            .collect::<String>()
    };
    let squares: Vec<String> = (states.chars().chain(controls.chars()))
        .map(|c| format!("{c}^2"))
        .collect();
    let pairs: Vec<String> = (states.chars().zip(controls.chars()))
        .map(|(x, u)| format!("{x} = \"{u}\""))
        .collect();
    let zeros: Vec<String> = (states.chars().chain(controls.chars()))
        .map(|c| format!("{c} = 0"))
        .collect();
    let sides: Vec<String> = states.chars().map(|c| format!("{c} = [-1, 1]")).collect();
    format!(
        "states = {{ {} }}\ncontrols = {{ {} }}\ndynamics = {{ {} }}\ncost = {{ running = \"0.5*({})\" }}\n\
         equilibrium = {{ {} }}\nregion = {{ {} }}\n{more}\n",
        list(states).trim_end_matches(", "),
        list(controls).trim_end_matches(", "),
        pairs.join(", "),
        squares.join(" + "),
        zeros.join(", "),
        sides.join(", "),
    )
}

/// How far the way from a state straight to 0 passes from a point of a plane.
fn passes<const N: usize>(x: &SVector<f64, N>, point: [f64; 2]) -> f64 {
    let share = (point[0] * x[0] + point[1] * x[1]) / (x[0] * x[0] + x[1] * x[1]);
    let share = share.clamp(0.0, 1.0);
    (share * x[0] - point[0]).hypot(share * x[1] - point[1])
}

#[test]
fn discs() {
    let centers = [[0.5, 0.0], [-0.2, 0.6]];
    let more = "guards = { disc = \"(x - 0.5)^2 + y^2 > 0.04\", other = \"(x + 0.2)^2 + (y - 0.6)^2 > 0.0225\" }\n\
                map = { error = 1e-3, states = 3000, check = 20 }";
    let margin = |far: [f64; 2]| (far[0] - 0.2).min(far[1] - 0.15);
    let said = Said::of(
        ("discs", &straight("xy", "uw", more)),
        [1.0; 2],
        |x| margin(centers.map(|c| (x[0] - c[0]).hypot(x[1] - c[1]))),
        |x| margin(centers.map(|c| passes(x, c))),
    );
    said.check(0.99, 0.01, 0.01);
}

#[test]
fn a_cylinder_in_three_states() {
    let more = "guards = { cylinder = \"(x - 0.5)^2 + y^2 > 0.04\" }\nmap = { error = 1e-3, states = 3000, check = 20 }";
    let said = Said::of(
        ("cylinder", &straight("xyz", "uws", more)),
        [1.0; 3],
        |x| (x[0] - 0.5).hypot(x[1]) - 0.2,
        |x| passes(x, [0.5, 0.0]) - 0.2,
    );
    said.check(0.98, 0.02, 0.05);
}

/// The least margin along the linear closed loop from a state, in small steps.
fn along_loop<const N: usize>(
    x: &SVector<f64, N>,
    closed_loop: &SMatrix<f64, N, N>,
    guards: impl Fn(&SVector<f64, N>) -> f64,
) -> f64 {
    let small = closed_loop * 0.005;
    // exp by its series.
    let (mut step, mut term) = (SMatrix::identity(), SMatrix::identity());
    for k in 1..8 {
        term = term * small / f64::from(k);
        step += term;
    }
    let mut at = *x;
    let mut least = f64::INFINITY;
    for _ in 0..3000 {
        least = least.min(guards(&at));
        at = step * at;
    }
    least
}

#[test]
fn a_limit_of_speed() {
    let scene = "states = { x = {}, v = {} }\ncontrols = { u = {} }\ndynamics = { x = \"v\", v = \"u\" }\n\
                 cost = { running = \"0.5*(x^2 + v^2 + u^2)\" }\nequilibrium = { x = 0, v = 0, u = 0 }\n\
                 region = { x = [-2, 2], v = [-2, 2] }\nguards = { slow = \"v < 0.8\", up = \"v > -0.8\" }\n\
                 map = { error = 1e-3, states = 2000, check = 20 }\n";
    // u = -x - sqrt(3) v.
    let closed_loop = Matrix2::new(0.0, 1.0, -1.0, -(3.0f64.sqrt()));
    let guards = |x: &SVector<f64, 2>| 0.8 - x[1].abs();
    let said = Said::of(("speed", scene), [2.0; 2], guards, |x| {
        along_loop(x, &closed_loop, guards)
    });
    said.check(0.99, 0.02, 0.01);
}

/// An ellipsoid and two planes in three states: solutions wind about 0, so that shadows are curved
/// and far from what casts them.
#[test]
fn curved_shadows_in_three_states() {
    let scene = "states = { x = {}, v = {}, a = {} }\ncontrols = { u = {} }\n\
                 dynamics = { x = \"v\", v = \"a\", a = \"-x - 1.5*v - 0.5*a + u\" }\n\
                 cost = { running = \"0.5*(2*x^2 + v^2 + 0.3*a^2 + 0.5*u^2)\" }\n\
                 equilibrium = { x = 0, v = 0, a = 0, u = 0 }\nregion = { x = [-1, 1], v = [-1, 1], a = [-1.5, 1.5] }\n\
                 guards = { ball = \"((x - 0.45)/0.25)^2 + ((v + 0.35)/0.2)^2 + ((a - 0.1)/0.5)^2 > 1\", \
                 far = \"x + 0.3*v < 1.15\", low = \"a > -1.2\" }\nmap = { error = 1e-3, states = 3000, check = 20 }\n";
    // A solution of the Riccati equation A'P + PA - 2 PBB'P + Q = 0 (scipy's solve_continuous_are).
    let p = Matrix3::new(
        3.346_799_12,
        2.294_252_61,
        0.618_033_99,
        2.294_252_61,
        3.176_282_75,
        1.082_144_26,
        0.618_033_99,
        1.082_144_26,
        0.887_824_36,
    );
    let a = Matrix3::new(0.0, 1.0, 0.0, 0.0, 0.0, 1.0, -1.0, -1.5, -0.5);
    let bb = Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0);
    let q = Matrix3::new(2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.3);
    assert!((a.transpose() * p + p * a - p * bb * p + q).abs().max() < 1e-7);
    let guards = |x: &SVector<f64, 3>| {
        let ball = ((x[0] - 0.45) / 0.25).powi(2)
            + ((x[1] + 0.35) / 0.2).powi(2)
            + ((x[2] - 0.1) / 0.5).powi(2)
            - 1.0;
        ball.min(1.15 - x[0] - 0.3 * x[1]).min(x[2] + 1.2)
    };
    let said = Said::of(("curved", scene), [1.0, 1.0, 1.5], guards, |x| {
        along_loop(x, &(a - bb * p), guards)
    });
    assert!(said.dark > 800, "{said:?}");
    // The ball's margin is -1 at its middle.
    said.check(0.98, 0.03, 0.6);
}

/// A wall of a twentieth of the usual distance between samples of a trajectory: nothing passes
/// through it.
#[test]
fn a_thin_wall() {
    let more = "guards = { wall = \"((x - 1)/0.02)^2 + (y/0.5)^2 > 1\" }\nmap = { error = 1e-3, states = 1500, check = 20 }";
    let scene = straight("xy", "uw", more).replace("[-1, 1]", "[-2, 2]");
    // Behind the wall, in front of it, and past its end.
    let states = [
        [1.5, 0.3],
        [1.9, -0.6],
        [1.1, 0.0],
        [0.9, 0.1],
        [1.5, 1.5],
        [1.2, 0.8],
    ];
    let folder = scratch("map_shadows_solved");
    let statuses = column_of(&folder, "wall", &scene, ("x,y", &states), "status");
    let cut = "leaves_guard";
    assert_eq!(
        statuses,
        [cut, cut, cut, "converged", "converged", "converged"]
    );

    let margin = |x: f64, y: f64| ((x - 1.0) / 0.02).powi(2) + (y / 0.5).powi(2) - 1.0;
    let said = Said::of(
        ("wall", &scene),
        [2.0; 2],
        |x| margin(x[0], x[1]),
        // Of a parabola along the straight way.
        |x| {
            let (a, b) = (x[0] * x[0] / 4e-4 + x[1] * x[1] / 0.25, x[0] / 4e-4);
            let share = (b / a).clamp(0.0, 1.0);
            margin(share * x[0], share * x[1])
        },
    );
    // The wall's is, too.
    said.check(0.98, 0.02, 0.1);
}

/// A body on a circle, with limits on how fast it goes, round a post: where one way leaves the
/// guard, V is that of the other one.
struct Circle;

impl Circle {
    const SCENE: &str = "states = { th = { period = \"2*pi\" }, y = {}, z = {} }\n\
        controls = { u = { min = -1.2, max = 1.2 }, w = { min = -0.6, max = 0.6 }, s = {} }\n\
        dynamics = { th = \"u\", y = \"w\", z = \"s\" }\n\
        cost = { running = \"1 - cos(th) + 0.5*(u^2 + y^2 + w^2 + z^2 + s^2)\" }\n\
        equilibrium = { th = 0, y = 0, z = 0, u = 0, w = 0, s = 0 }\n\
        region = { th = [\"-pi\", \"pi\"], y = [-1, 1], z = [-1, 1] }\n\
        guards = { post = \"2*(1 - cos(th - 1.4)) + 2*(y - 0.1)^2 + (z + 0.1)^2 > 0.2\" }\n\
        map = { error = 1e-3, states = 3000, check = 20 }\nsheets = { value_max = 9 }\n";
    const FAST: [f64; 2] = [1.2, 0.6];

    /// V of the way along one variable: `p^2 = 2 l` where no limit is met, and else `p = (l +
    /// c^2/2)/c` with the limit c.
    fn values(turn: f64, y: f64, z: f64) -> f64 {
        let [c, d] = Self::FAST;
        let free = 2.0 * (0.5 * c).asin();
        let [slow, rest] = [turn.min(free), (turn - free).max(0.0)];
        let round = 4.0 * (1.0 - (0.5 * slow).cos())
            + (rest * (1.0 + 0.5 * c * c) - ((free + rest).sin() - free.sin())) / c;
        let [near, far] = [y.abs().min(d), y.abs().max(d)];
        let across =
            0.5 * near * near + ((far.powi(3) - d.powi(3)) / 6.0 + 0.5 * d * d * (far - d)) / d;
        round + across + 0.5 * z * z
    }

    /// The least margin of the guard on the way with `turn` left, in the direction of th's sign.
    fn along(turn: f64, sign: f64, y: f64, z: f64) -> f64 {
        let [c, d] = Self::FAST;
        let free = 2.0 * (0.5 * c).asin();
        let ([turning, crossing], [mut least, steps]) = (
            [(turn - free).max(0.0) / c, (y.abs() - d).max(0.0) / d],
            [f64::INFINITY, 4000.0],
        );
        for step in 0..=steps as u32 {
            let t = 14.0 * (f64::from(step) / steps).powf(1.5);
            let angle = match t < turning {
                true => turn - c * t,
                false => 4.0 * ((0.25 * turn.min(free)).tan() * (turning - t).exp()).atan(),
            };
            let beside = match t < crossing {
                true => y.abs() - d * t,
                false => y.abs().min(d) * (crossing - t).exp(),
            };
            least = least.min(Self::guard(
                sign * angle,
                beside.copysign(y),
                z * (-t).exp(),
            ));
        }
        least
    }

    fn guard(th: f64, y: f64, z: f64) -> f64 {
        2.0 * (1.0 - (th - 1.4).cos()) + 2.0 * (y - 0.1).powi(2) + (z + 0.1).powi(2) - 0.2
    }

    /// V by either way, with the least margin.
    fn ways([th, y, z]: [f64; 3]) -> [(f64, f64); 2] {
        let down = th.rem_euclid(TAU);
        [(down, 1.0), (TAU - down, -1.0)]
            .map(|(turn, sign)| (Self::values(turn, y, z), Self::along(turn, sign, y, z)))
    }
}

#[test]
fn the_other_way_round() {
    // Those behind the post, and next to them, among others.
    let states: Vec<[f64; 3]> = (0..24)
        .map(|k| {
            [
                2.0 + 0.1 * f64::from(k),
                0.3 * (f64::from(k)).sin(),
                0.02 * f64::from(k) - 0.3,
            ]
        })
        .map(|[th, y, z]| [if th > PI { th - TAU } else { th }, y, z])
        .collect();
    let folder = scratch("map_shadows_ways");
    let values = column_of(&folder, "solved", Circle::SCENE, ("th,y,z", &states), "V");
    let mut cut = 0;
    for (x, value) in states.iter().zip(values) {
        let mut ways = Circle::ways(*x);
        ways.sort_by(|a, b| a.0.total_cmp(&b.0));
        cut += usize::from(ways[0].1 < 0.0);
        let (least, _) = ways.into_iter().find(|(_, margin)| *margin > 0.0).unwrap();
        let value: f64 = value.parse().unwrap();
        assert!(
            (value - least).abs() < 1e-9 * least,
            "{x:?}: {value} instead of {least}"
        );
    }
    assert!(cut > 4, "{cut}");

    let (stored, _) = map_of(&folder, "circle", Circle::SCENE);
    let map = stored.value_map().unwrap();
    let (mut known, mut asked, mut of_other, mut wrong) = (0, 0, 0, 0);
    for k in 1..=2000 {
        let place = |root: f64| 2.0 * (f64::from(k) * root).fract() - 1.0;
        let x = [
            PI * place(0.819_172_5),
            place(0.671_043_6),
            place(0.549_700_5),
        ];
        let ways = Circle::ways(x);
        let free = || ways.iter().filter(|(_, margin)| *margin > 0.0);
        // Within a thousandth of an edge sampling does not tell.
        if Circle::guard(x[0], x[1], x[2]) < 0.0
            || ways.iter().any(|(_, margin)| margin.abs() < 1e-3)
            || free().count() == 0
        {
            continue;
        }
        let least = free()
            .map(|(value, _)| *value)
            .fold(f64::INFINITY, f64::min);
        asked += 1;
        let Ok(told) = map.at(&x).lowest else {
            continue;
        };
        known += 1;
        of_other += usize::from(ways.iter().any(|(value, _)| *value < least));
        wrong += usize::from((told.v - least).abs() > 3.0 * told.v_error + 1e-9);
    }
    println!(
        "the other way round: {known} of {asked} known, {wrong} of them wrong, {of_other} by the dearer way"
    );
    assert!(asked > 1000 && of_other > 100);
    assert!(10 * known > 8 * asked);
    assert!(wrong <= known / 1000, "{wrong} of {known}");
}

/// Solutions of the game go straight to 0, too.
#[test]
fn a_game() {
    let scene = "states = { x = {}, y = {} }\ncontrols = { u = {}, w = {} }\ndisturbances = { d = {}, e = {} }\n\
                 dynamics = { x = \"u + d\", y = \"w + e\" }\n\
                 cost = { running = \"0.5*(x^2 + y^2 + u^2 + w^2 - 4*d^2 - 4*e^2)\" }\n\
                 equilibrium = { x = 0, y = 0, u = 0, w = 0 }\nregion = { x = [-1, 1], y = [-1, 1] }\n\
                 guards = { disc = \"(x - 0.5)^2 + y^2 > 0.04\" }\nmap = { error = 1e-3, states = 1500, check = 20 }\n";
    let said = Said::of(
        ("game", scene),
        [1.0; 2],
        |x| (x[0] - 0.5).hypot(x[1]) - 0.2,
        |x| passes(x, [0.5, 0.0]) - 0.2,
    );
    said.check(0.99, 0.01, 0.01);
}

/// Nothing that a guard excludes has a solution, and no flight undercuts one by a way that a guard
/// cuts off.
#[test]
fn guards_hold_for_all_that_solve_says() {
    let folder = scratch("map_shadows_solve");
    let status = |name: &str, scene: &str, (header, states): (&str, &[[f64; 2]])| {
        column_of(&folder, name, scene, (header, states), "status")
    };
    // The equilibrium lies on the boundary; the local solution reaches beyond it.
    let half = straight("xy", "uw", "guards = { half = \"x >= 0\" }");
    let found = status(
        "half",
        &half,
        (
            "x,y",
            &[[-0.1, 0.05], [-0.06, 0.0], [0.0, 0.1], [0.05, -0.1]],
        ),
    );
    assert_eq!(
        found,
        ["outside_guard", "outside_guard", "converged", "converged"]
    );

    // A wall between the state and 0, thinner than the steps of a flight; and a guard that is not
    // the same one period later.
    let circle = |guard: &str| {
        format!(
            "states = {{ th = {{ period = \"2*pi\" }}, y = {{}} }}\ncontrols = {{ u = {{}}, w = {{}} }}\n\
             dynamics = {{ th = \"u\", y = \"w\" }}\ncost = {{ running = \"1 - cos(th) + 0.5*(u^2 + y^2 + w^2)\" }}\n\
             equilibrium = {{ th = 0, y = 0, u = 0, w = 0 }}\nregion = {{ th = [\"-pi\", \"pi\"], y = [-1, 1] }}\n\
             guards = {{ g = \"{guard}\" }}\n"
        )
    };
    let behind = [1.732_184_278_348_262_8, 0.586_047_316_196_068_2];
    let wall = circle("2*(1 - cos(th - 1.4)) > 0.002499479210067507");
    let found = column_of(&folder, "wall", &wall, ("th,y", &[behind]), "V");
    // p = 2 sin(th/2) along the circle, the other way round.
    let round = 4.0 * (1.0 + (0.5 * behind[0]).cos()) + 0.5 * behind[1] * behind[1];
    assert!(
        (found[0].parse::<f64>().unwrap() - round).abs() < 1e-8,
        "{found:?} instead of {round}"
    );
    let states = ("th,y", [behind, [1.916, 0.3137]]);
    for (name, guard) in [
        ("thin", wall.clone()),
        ("turning", circle("(th - 1.4)^2 + y^2 > 0.1")),
    ] {
        let found = status(name, &guard, (states.0, &states.1[1..]));
        assert_eq!(found, ["converged"], "{name}");
    }
    assert_eq!(status("wall", &wall, ("th,y", &[behind])), ["converged"]);
}

/// A guard that leaves a hundred and twenty-eighth of the region: states are searched for and
/// counted where it holds.
#[test]
fn a_small_part_of_the_region() {
    let more = "guards = { near = \"x^2 + y^2 < 0.01\" }\nmap = { error = 1e-3, states = 500, check = 20 }";
    let folder = scratch("map_shadows_near");
    let (stored, summary) = map_of(&folder, "near", &straight("xy", "uw", more));
    assert_eq!(summary["share_unknown"], 0.0, "{summary}");
    let map = stored.value_map().unwrap();
    for k in 0..100 {
        let (radius, angle) = (0.099 * (f64::from(k) + 0.5) / 100.0, 2.4 * f64::from(k));
        let value = map
            .at(&[radius * angle.cos(), radius * angle.sin()])
            .lowest
            .unwrap();
        assert!((value.v - 0.5 * radius * radius).abs() < 1e-9, "{value:?}");
        assert!(
            map.at(&[0.11 * angle.cos(), 0.11 * angle.sin()])
                .lowest
                .is_err()
        );
    }
}

/// Just in front of a post: the trajectories of the manifold end at it between two of their levels,
/// and the way round whole periods is the dearer one.
#[test]
fn in_front_of_a_post() {
    let folder = scratch("map_shadows_front");
    let (center, radius) = ([1.2, 0.1], 0.3);
    let scene = "states = { th = { period = \"2*pi\" }, y = {} }\ncontrols = { u = {}, w = {} }\n\
                 dynamics = { th = \"u\", y = \"w\" }\ncost = { running = \"1 - cos(th) + 0.5*(u^2 + y^2 + w^2)\" }\n\
                 equilibrium = { th = 0, y = 0, u = 0, w = 0 }\nregion = { th = [\"-pi\", \"pi\"], y = [-1, 1] }\n\
                 guards = { post = \"(th - 1.2)^2 + (y - 0.1)^2 > 0.09\" }\n";
    // Along the solution tan(th/4) and y fall as exp(-t).
    let keeps = |[th, y]: [f64; 2]| {
        let at = |t: f64| [4.0 * ((th / 4.0).tan() * (-t).exp()).atan(), y * (-t).exp()];
        (0..4000)
            .map(|k| at(0.003 * f64::from(k)))
            .map(|[th, y]| (th - center[0]).hypot(y - center[1]) - radius)
            .fold(f64::INFINITY, f64::min)
    };
    let states: Vec<[f64; 2]> = (0..300)
        .map(|k| {
            let (turn, far) = (
                (f64::from(k) * 0.618_034).fract(),
                (f64::from(k) * 0.754_878).fract(),
            );
            let r = radius + 0.002 + 0.25 * far;
            [
                center[0] + r * (TAU * turn).cos(),
                center[1] + r * (TAU * turn).sin(),
            ]
        })
        .filter(|x| keeps(*x) > 1e-3)
        .collect();
    let found = column_of(&folder, "front", scene, ("th,y", &states), "V");
    assert!(states.len() > 150);
    for ([th, y], v) in states.iter().zip(&found) {
        let right = 4.0 * (1.0 - (0.5 * th).cos()) + 0.5 * y * y;
        let v: f64 = v.parse().unwrap();
        assert!(
            (v - right).abs() < 1e-7,
            "{th}, {y}: {v} instead of {right}"
        );
    }
}

/// V(x, 0) behind a post, where the way to the other well is the answer: the nearer well's must not
/// be told there.
#[test]
fn a_post_before_one_of_two_wells() {
    let folder = scratch("map_shadows_wells");
    let time = 1.5;
    let (center, radius) = ([0.7, 0.2], 0.2f64);
    let scene = "states = { x = {}, y = {} }\ncontrols = { u = {}, w = {} }\ndynamics = { x = \"u\", y = \"w\" }\n\
                 cost = { running = \"0.5*(u^2 + w^2)\", terminal = \"x^4/4 - x^2 + 0.1*x + 0.5*y^2\", final_time = 1.5 }\n\
                 region = { x = [-2, 2], y = [-1, 1] }\nguards = { post = \"(x - 0.7)^2 + (y - 0.2)^2 > 0.04\" }\n\
                 map = { error = 3e-3, states = 650, check = 10, time = false }\n";
    let (stored, _) = map_of(&folder, "wells", scene);
    let map = stored.value_map().unwrap();
    // Hopf and Lax: straight ways to ends z where the terminal cost and (x - z)^2 / (2 T) are
    // stationary.
    let least = |x: [f64; 2]| -> f64 {
        let slope = |z: f64| z.powi(3) - 2.0 * z + 0.1 + (z - x[0]) / time;
        let grid: Vec<f64> = (-400..=400).map(|k| 0.01 * f64::from(k) + 0.0012).collect();
        let crossings = grid.windows(2).filter(|w| slope(w[0]) * slope(w[1]) <= 0.0);
        let ends = crossings.map(|w| {
            let (mut lo, mut hi) = (w[0], w[1]);
            for _ in 0..60 {
                let middle = 0.5 * (lo + hi);
                if slope(lo) * slope(middle) <= 0.0 {
                    hi = middle
                } else {
                    lo = middle
                }
            }
            [0.5 * (lo + hi), x[1] / (1.0 + time)]
        });
        let costs = ends.filter_map(|z| {
            let way = [z[0] - x[0], z[1] - x[1]];
            let length = way[0] * way[0] + way[1] * way[1];
            let share = ((center[0] - x[0]) * way[0] + (center[1] - x[1]) * way[1]) / length;
            let share = share.clamp(0.0, 1.0);
            let near = (x[0] + share * way[0] - center[0]).hypot(x[1] + share * way[1] - center[1]);
            let cost = z[0].powi(4) / 4.0 - z[0] * z[0] + 0.1 * z[0] + 0.5 * z[1] * z[1];
            (near > radius).then_some(cost + length / (2.0 * time))
        });
        costs.fold(f64::INFINITY, f64::min)
    };
    let (mut known, mut all, mut wrong) = (0, 0, Vec::new());
    for k in 1..=3000 {
        let x = [
            4.0 * (f64::from(k) * 0.754_877_666).fract() - 2.0,
            2.0 * (f64::from(k) * 0.569_840_291).fract() - 1.0,
        ];
        let right = least(x);
        if (x[0] - center[0]).hypot(x[1] - center[1]) < radius {
            continue;
        }
        all += 1;
        let Ok(here) = map.at(&x).lowest else {
            continue;
        };
        known += 1;
        if (here.v - right).abs() > 3.0 * here.v_error + 1e-6 {
            wrong.push((x, here.v, right));
        }
    }
    println!("{known} known of {all}, wrong: {wrong:?}");
    assert!(known > all / 2);
    assert!(
        wrong.len() <= known / 500,
        "{} of {known}: {:?}",
        wrong.len(),
        wrong.first()
    );
}
