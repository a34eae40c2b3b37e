//! Maps that are made to an error: against exact value functions, solved states and their own
//! check.

use crate::common_commands;
use crate::common_problems::{TwoWells, manufactured};

use common_commands::{costate, done, scratch, sections_of};
use costate::low_level::closed_loop::{Chart, Expansions};
use costate::low_level::map::pieces::Pieces;
use costate::low_level::map::{Coverage, Unknown, ValueMap};
use costate::low_level::model::MAP_ERROR_MAX;
use costate::low_level::result::Stored;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::Output;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};

fn folder() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| scratch("map"))
}

/// A shipped scene without the sections that are not about V, with a section [map] of these lines.
fn scene(name: &str, lines: &str) -> PathBuf {
    const LEFT_OUT: [&str; 7] = [
        "map",
        "homotopy",
        "shoot_out",
        "closed_loop",
        "report",
        "study",
        "attenuation",
    ];
    let kept = sections_of(name, |section| !LEFT_OUT.contains(&section));
    static SCENES: AtomicUsize = AtomicUsize::new(0);
    let path = folder().join(format!(
        "{name}-{}.toml",
        SCENES.fetch_add(1, Ordering::Relaxed)
    ));
    std::fs::write(&path, format!("{kept}\n[map]\n{lines}\n")).unwrap();
    path
}

fn run(scene: &Path, out: &Path) -> Output {
    let fixed = ["homotopy", "--backend", "cpu", "--json", "--out"].map(OsStr::new);
    costate(&[&fixed[..], &[out.as_ref(), scene.as_ref()]].concat())
}

/// What a run says in words, with its result in a file.
fn words(scene: &Path, out: &Path) -> String {
    let fixed = ["homotopy", "--backend", "cpu", "--out"].map(OsStr::new);
    done(costate(
        &[&fixed[..], &[out.as_ref(), scene.as_ref()]].concat(),
    ))
}

/// A map made: the file, and its summary's "map".
fn made(name: &str, lines: &str) -> (Stored, serde_json::Value) {
    let scene = scene(name, lines);
    let out = scene.with_extension("h5");
    let summary: serde_json::Value = serde_json::from_str(&done(run(&scene, &out))).unwrap();
    crate::common_commands::in_schema(&out);
    (Stored::open(&out).unwrap(), summary["map"].clone())
}

/// States spread evenly over a box, none of them on a grid.
fn spread<const N: usize>(region: [[f64; 2]; N], count: usize) -> Vec<[f64; N]> {
    let steps = [0.754_877_666, 0.569_840_290, 0.430_159_709, 0.324_717_957];
    (1..=count)
        .map(|k| {
            std::array::from_fn(|i| {
                let [lo, hi] = region[i];
                lo + (hi - lo) * (k as f64 * steps[i]).fract()
            })
        })
        .collect()
}

fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[((sorted.len() - 1) as f64 * share).round() as usize]
}

fn pieces(stored: &Stored) -> Pieces {
    stored
        .map_pieces()
        .unwrap()
        .expect("the file has a map in pieces")
}

#[test]
fn a_smooth_value_is_met_everywhere_with_true_bounds() {
    let (stored, summary) = made("manufactured", "error = 1e-4\nfloor = 1e-3\ncheck = 50");
    let map = stored.value_map().unwrap();
    let (mut errors, mut over, mut slopes) = (vec![], vec![], vec![]);
    for [x, y] in spread([[-1.5, 1.5]; 2], 1000) {
        // By hand.
        let v = x * x / 2.0 + (1.0 - x.cos()) / 2.0 + x * y / 2.0 + y * y + x * x * y * y / 4.0;
        let p = [
            x + 0.5 * x.sin() + 0.5 * y + 0.5 * x * y * y,
            x / 2.0 + 2.0 * y + x * x * y / 2.0,
        ];
        let here = map
            .at(&[x, y])
            .lowest
            .unwrap_or_else(|e| panic!("{x}, {y}: {e}"));
        errors.push((here.v - v).abs() / v.max(1e-3));
        slopes.push(
            (0..2).map(|i| (here.p[i] - p[i]).abs()).fold(0.0, f64::max) / v.max(1e-3).sqrt(),
        );
        if here.in_pieces {
            over.push((here.v - v).abs() / here.v_error);
        }
    }
    println!(
        "V {:.1e}, {:.1e}; p {:.1e}; over bound {:.2}, {:.2}; {summary}",
        quantile(&errors, 0.5),
        quantile(&errors, 1.0),
        quantile(&slopes, 1.0),
        quantile(&over, 0.99),
        quantile(&over, 1.0)
    );
    assert!(quantile(&errors, 1.0) < 1e-4);
    assert!(quantile(&slopes, 1.0) < 1e-2);
    assert!(over.len() > 900, "the pieces answer");
    assert!(quantile(&over, 0.99) <= 1.0 && quantile(&over, 1.0) <= 2.0);
    assert_eq!(summary["share_unmet"], 0.0);
    assert_eq!(summary["check"]["known"], 50);
}

/// Solutions leave this region for the equilibrium outside it: V is known where they lead, within
/// its bounds, and the law goes there without a search.
#[test]
fn a_law_finds_its_way_where_solutions_leave_the_region() {
    let lines = "error = 1e-4\nfloor = 1e-3\ncheck = 50\nregion = { x = [0.5, 1.3], y = [-0.4, 0.9] }\n\
                 [closed_loop]\nfinal_time = 20.0\nsamples = 400\ninitial = { x = [0.5, 1.3], y = [-0.4, 0.9] }\nrandom = 300";
    let (stored, summary) = made("manufactured", lines);
    let beyond = stored
        .map_beyond()
        .unwrap()
        .expect("solutions leave the region");
    assert!(summary["pieces_beyond"].as_u64().unwrap() >= 1);
    let [x, y] = [0, 1].map(|i| [beyond.region.lo[i], beyond.region.hi[i]]);
    assert!(
        x[0] < 0.2 && x[1] < 2.0,
        "{x:?} reaches towards the equilibrium"
    );
    let map = stored.value_map().unwrap();
    let (mut over, mut outside) = (vec![], 0);
    for [x, y] in spread([x, y], 2000) {
        let inside = (0.5..=1.3).contains(&x) && (-0.4..=0.9).contains(&y);
        outside += usize::from(!inside);
        let Some(here) = map.at(&[x, y]).lowest.ok().filter(|here| here.in_pieces) else {
            assert!(!inside, "{x}, {y}");
            continue;
        };
        let v = x * x / 2.0 + (1.0 - x.cos()) / 2.0 + x * y / 2.0 + y * y + x * x * y * y / 4.0;
        assert_eq!(here.coverage == Coverage::Checked, inside, "{x}, {y}");
        if !inside {
            over.push((here.v - v).abs() / here.v_error);
        }
    }
    println!(
        "{} states, over bound {:.2}, {:.2}",
        over.len(),
        quantile(&over, 0.99),
        quantile(&over, 1.0)
    );
    // The way from the region narrows towards the equilibrium.
    assert!(
        2 * over.len() > outside,
        "of {outside} states outside {} are known",
        over.len()
    );
    assert!(quantile(&over, 0.99) <= 1.0 && quantile(&over, 1.0) <= 3.0);
    let told = done(costate(&[
        "evaluate".as_ref(),
        "--json".as_ref(),
        "--laws".as_ref(),
        "map".as_ref(),
        stored.path.as_os_str(),
    ]));
    let told: serde_json::Value = serde_json::from_str(&told).unwrap();
    let law = &told["laws"][0];
    assert_eq!(law["share_converged"], 1.0, "{law}");
    assert_eq!(law["fell_back"], 0, "{law}");
    assert_eq!(law["suboptimality"]["count"], 300, "{law}");
    assert!(
        law["suboptimality"]["max"].as_f64().unwrap() < 1e-5,
        "{law}"
    );
}

/// Round the region a piece that errs by much is for laws only: it is not told as V, and what is
/// said beside it is as without it.
#[test]
fn rough_pieces_round_the_region_are_for_laws_alone() {
    let lines =
        "error = 1e-6\nfloor = 1e-3\ncheck = 5\nregion = { x = [0.5, 1.3], y = [-0.4, 0.9] }";
    let (stored, _) = made("manufactured", lines);
    let scene = &stored.scene;
    let mut known = stored.known().unwrap();
    let beyond = known.beyond.as_mut().expect("solutions leave the region");
    let [x, y] = [0, 1].map(|i| [beyond.region.lo[i], beyond.region.hi[i]]);
    let places: Vec<[f64; 2]> = (spread([x, y], 4000).into_iter())
        .filter(|[x, y]| !((0.5..=1.3).contains(x) && (-0.4..=0.9).contains(y)))
        .collect();
    // A piece with many of them in its cell, and many beside it with which others are blended, made
    // a wrong one.
    let is_of = |beyond: &Pieces, x: &[f64; 2]| beyond.at(x).is_some_and(|said| said.v_bound > 1.0);
    let whole = beyond.clone();
    let counts = |k: usize| {
        let mut with = whole.clone();
        with.pieces[k].bound = 1e3;
        let without = with.clone().within(MAP_ERROR_MAX);
        let of: Vec<&[f64; 2]> = places.iter().filter(|x| is_of(&with, x)).collect();
        let beside = of.iter().filter(|x| without.at(&x[..]).is_some()).count();
        beside.min(of.len() - beside)
    };
    let rough = (0..beyond.pieces.len()).max_by_key(|k| counts(*k)).unwrap();
    beyond.pieces[rough].bound = 1e3;
    beyond.pieces[rough].coefficients[0] += 5.0;
    let after = beyond.clone();
    let without = beyond.clone().within(MAP_ERROR_MAX);
    let map = ValueMap::new(&scene.model, &scene.hamiltonian, known).unwrap();
    let mut answers = Expansions::default();
    map.expansions(2, places.as_flattened(), &mut answers);
    let (mut untold, mut beside) = (0, 0);
    for (k, [x, y]) in places.iter().enumerate() {
        let (here, several) = (map.at(&[*x, *y]).lowest, is_of(&after, &[*x, *y]));
        match here.ok().filter(|here| here.in_pieces) {
            Some(here) => {
                let alone = without
                    .at(&[*x, *y])
                    .expect("it is told without the rough piece")
                    .v;
                assert!(
                    (here.v - alone).abs() < 1e-12,
                    "{x}, {y}: {} is not {alone}",
                    here.v
                );
                assert!(
                    (answers.v[k] - alone).abs() < 1e-12,
                    "{x}, {y}: the law goes by another V"
                );
                beside += usize::from(several);
            }
            None if several => {
                assert!(answers.known[k], "{x}, {y}: a law has no answer");
                untold += 1;
            }
            None => {}
        }
    }
    println!(
        "{untold} states untold, {beside} beside them, of {}",
        places.len()
    );
    assert!(untold > 20 && beside > 0);
}

/// Only where solutions that begin in the region leave it: points of its margin, to which they are
/// continued backward, are no reason for a map round it. A game has none wherever they go.
#[test]
fn there_is_no_map_round_a_region_that_solutions_stay_in() {
    // Each state goes straight to 0.
    let text = "states = { x = {}, y = {} }\ncontrols = { u = {}, w = {} }\ndynamics = { x = \"u\", y = \"-y + w\" }\n\
        cost = { running = \"x^2 + y^2 + u^2 + w^2\" }\nequilibrium = { x = 0, y = 0, u = 0, w = 0 }\n\
        region = { x = [-1, 1], y = [-1, 1] }\n[map]\nerror = 1e-3\ncheck = 5\n";
    let stays = folder().join("stays.toml");
    std::fs::write(&stays, text).unwrap();
    // From here the equilibrium is outside.
    let leaves = folder().join("leaves.toml");
    std::fs::write(&leaves, format!("{text}region = {{ x = [0.5, 1.0] }}\n")).unwrap();
    let game = scene(
        "folding_game",
        "error = 1e-2\ncheck = 5\nstates = 600\nregion = { x = [0.2, 0.8], y = [0.2, 0.8] }",
    );
    for (scene, has_one) in [(stays, false), (leaves, true), (game, false)] {
        let out = scene.with_extension("h5");
        let said = words(&scene, &out);
        assert_eq!(
            said.contains("solutions leave the region"),
            has_one,
            "{said}"
        );
        crate::common_commands::in_schema(&out);
        let stored = Stored::open(&out).unwrap();
        assert!(!pieces(&stored).pieces.is_empty());
        assert_eq!(stored.map_beyond().unwrap().is_some(), has_one, "{said}");
    }
}

/// p is the gradient of what the map says, also where cells are blended; V is continuous across
/// their faces.
#[test]
fn p_is_the_gradient_and_v_is_continuous() {
    let (stored, _) = made("manufactured", "error = 1e-6\ncheck = 1");
    let pieces = pieces(&stored);
    assert!(pieces.cells.len() > 3, "{} cells", pieces.cells.len());
    let step = 1e-5;
    for [x, y] in spread([[-1.4, 1.4]; 2], 2000) {
        let here = pieces.at(&[x, y]).unwrap();
        for (i, p) in here.p.iter().enumerate() {
            let beside = |sign: f64| {
                let mut at = [x, y];
                at[i] += sign * step;
                pieces.at(&at).unwrap().v
            };
            let difference = (beside(1.0) - beside(-1.0)) / (2.0 * step);
            // A jump of V at a face would be a difference of its size over 2e-5.
            assert!((difference - p).abs() < 1e-4, "{x}, {y}: {difference} {p}");
        }
    }
    // Across every face, at its middle.
    for cell in &pieces.cells {
        for i in 0..2 {
            let mut t = [
                0.5 * (cell.lo[0] + cell.hi[0]),
                0.5 * (cell.lo[1] + cell.hi[1]),
            ];
            t[i] = cell.hi[i];
            let v = |sign: f64| {
                let mut t = t;
                t[i] += sign * 1e-12;
                pieces.at(&pieces.frame.state(&t)).map(|said| said.v)
            };
            if let (Some(a), Some(b)) = (v(-1.0), v(1.0)) {
                assert!((a - b).abs() < 1e-10, "{a} {b}");
            }
        }
    }
}

/// V, and the fold behind which there is none, in closed form (see the scene).
#[test]
fn nothing_is_said_behind_the_fold_of_a_game() {
    let (stored, summary) = made("folding_game", "error = 1e-4\ncheck = 100");
    let map = stored.value_map().unwrap();
    let floor = pieces(&stored).region.floor;
    let (b, r, e, k, gamma) = (1.0f64, 1.0f64, 1.0f64, 0.3f64, 0.85f64);
    let s = b * b / r - gamma.powi(-2);
    let fold = ((-1.0 / s - 1.0) / e).sqrt();
    let (mut inside, mut known, mut behind, mut said) = (0, 0, 0, 0);
    let (mut errors, mut over) = (vec![], vec![]);
    for [x, y] in spread([[-1.5, 1.5], [-1.0, 1.0]], 1000) {
        let z = x + k * y * y;
        let here = map.at(&[x, y]).lowest.ok();
        if z.abs() > fold {
            behind += 1;
            said += usize::from(here.is_some());
            continue;
        }
        inside += 1;
        let Some(here) = here else { continue };
        known += 1;
        let power = |a: f64| a.powf(1.5);
        let first =
            (-0.5 * z * z + (power(1.0 + s + s * e * z * z) - power(1.0 + s)) / (3.0 * s * e)) / s;
        let v = first + 0.5 * (2f64.sqrt() - 1.0) * y * y;
        errors.push((here.v - v).abs() / v.max(floor));
        over.push((here.v - v).abs() / here.v_error.max(1e-12));
    }
    println!(
        "{known} of {inside} known, {said} of {behind} behind the fold; V {:.1e} {:.1e} {:.1e}; over bound {:.2} {:.2}; {summary}",
        quantile(&errors, 0.5),
        quantile(&errors, 0.99),
        quantile(&errors, 1.0),
        quantile(&over, 0.99),
        quantile(&over, 1.0)
    );
    assert!(behind > 100 && said == 0, "{said} of {behind}");
    assert!(known * 100 >= 95 * inside);
    assert!(quantile(&errors, 0.99) < 1e-3);
    assert!(quantile(&over, 0.99) <= 2.0);
}

/// Two wells on a finite horizon: V(x, 0) by Hopf and Lax, with a line where two sheets cost the
/// same.
#[test]
fn two_sheets_meet_where_they_cost_the_same() {
    let (stored, _) = made(
        "hopf_lax",
        "error = 1e-4\nfloor = 1e-2\ncheck = 1\ntime = false\nregion = { x = [-1.0, 1.0], y = [-0.5, 0.5] }",
    );
    let pieces = pieces(&stored);
    let wells = TwoWells::with(2.0);
    let (mut worst, mut over) = (0.0f64, vec![]);
    for [x, y] in spread([[-1.0, 1.0], [-0.5, 0.5]], 1000) {
        let v = wells.at(&[x, y]).v;
        let here = pieces
            .at(&[x, y])
            .unwrap_or_else(|| panic!("{x}, {y} is not known"));
        worst = worst.max((here.v - v).abs() / v.abs().max(1e-2));
        over.push((here.v - v).abs() / here.v_bound);
    }
    println!(
        "V {worst:.1e}, over bound {:.2} {:.2}",
        quantile(&over, 0.99),
        quantile(&over, 1.0)
    );
    assert!(worst < 1e-4);
    assert!(quantile(&over, 0.99) <= 1.0 && quantile(&over, 1.0) <= 3.0);
    // Where both wells cost the same the map's two sheets do.
    let ridge = wells.equal_cost();
    let u = |x: f64| pieces.at(&[x, 0.1]).unwrap().p[0];
    assert!(
        u(ridge - 1e-5) * u(ridge + 1e-5) < 0.0,
        "{} {}",
        u(ridge - 1e-5),
        u(ridge + 1e-5)
    );
    let sheet = |x: f64| pieces.at(&[x, 0.1]).unwrap().sheet;
    assert_ne!(sheet(ridge - 1e-5), sheet(ridge + 1e-5));
}

/// Where V falls by a factor of six over a tenth of the compressor's box, and the corner of its
/// contour picture: V = 4.681 at (1, 2.1, 0.12, 1.524) (solved; checked by collocation).
#[test]
fn a_steep_corner_of_the_compressor() {
    let region = "region = { Phi = [1.0, 1.01], Psi = [2.09, 2.105], R = [0.115, 0.125], gamma = [1.515, 1.535] }";
    let (stored, summary) = made(
        "moore_greitzer",
        &format!("error = 1e-2\nstates = 4000\ncheck = 10\n{region}"),
    );
    let map = stored.value_map().unwrap();
    let here = map
        .at(&[1.0, 2.1, 0.12, 1.524])
        .lowest
        .expect("it is known");
    println!("V = {} +- {:.1e}; {summary}", here.v, here.v_error);
    assert!(
        (here.v - 4.681_02).abs() <= here.v_error.max(5e-6),
        "{} +- {}",
        here.v,
        here.v_error
    );
    assert!(here.v_error < 0.1 * here.v);
    assert_eq!(summary["check"]["known"], summary["check"]["solved"]);
    assert!(summary["check"]["V_error"]["median"].as_f64().unwrap() < 1e-2);
    // Outside the region of the map nothing else is in the file.
    assert_eq!(
        map.at(&[1.3, 2.0, 0.1, 1.6]).lowest.unwrap_err(),
        Unknown::Far
    );
}

/// With few states a map says where it is not good enough, and nothing where it is bad: there
/// another error may be allowed.
#[test]
fn a_budget_that_is_spent_is_said() {
    let made = |name: &str, more: &str| {
        let scene = scene(
            "moore_greitzer",
            &format!("error = 1e-6\nstates = 300\ncheck = 5{more}"),
        );
        let out = scene.with_extension(name);
        let said = words(&scene, &out);
        crate::common_commands::in_schema(&out);
        let stored = Stored::open(&out).unwrap();
        assert!(stored.group("map_check").is_some() && stored.group("map").is_none());
        (said, pieces(&stored))
    };
    let (said, strict) = made("budget.h5", "");
    assert!(said.contains("not met in"), "{said}");
    assert!(
        said.contains("nothing is said in") && said.contains("above 2.0e-2"),
        "{said}"
    );
    assert!(!strict.pieces.is_empty() && strict.pieces.iter().all(|p| p.bound <= MAP_ERROR_MAX));
    let (_, lenient) = made("lenient.h5", "\nerror_max = 0.5");
    assert_eq!(strict.cells.len(), lenient.cells.len());
    assert!(lenient.pieces.len() > strict.pieces.len());
    assert!(
        lenient.pieces.iter().all(|p| p.bound <= 0.5)
            && lenient.pieces.iter().any(|p| p.bound > 0.1)
    );
}

/// The first search too: states up to the budget, batches up to the seconds.
#[test]
fn the_first_search_keeps_within_the_budget() {
    for states in [1, 6] {
        let (_, summary) = made(
            "manufactured",
            &format!("error = 1e-4\nstates = {states}\ncheck = 1"),
        );
        let solved = summary["states"].as_u64().unwrap() + summary["failed"].as_u64().unwrap();
        assert!(solved <= states, "{summary}");
        assert!(summary["first_search"]["states"].as_u64().unwrap() <= states);
        assert!(summary["first_search"]["wanted"].as_u64().unwrap() > 250);
    }
    let scene = scene("manufactured", "error = 1e-4\nseconds = 1e-6\ncheck = 100");
    let said = words(&scene, &scene.with_extension("h5"));
    assert!(
        said.contains("the budget ended the first search after 8 of its"),
        "{said}"
    );
    assert!(
        said.contains("check with 16 of 100 (`seconds` leaves no more time) fresh states"),
        "{said}"
    );
    // One that is large enough ends nothing.
    for seconds in ["", "seconds = 1e300\n"] {
        let (_, all) = made("manufactured", &format!("error = 1e-4\n{seconds}check = 2"));
        assert_eq!(all["first_search"]["states"], all["first_search"]["wanted"]);
        assert_eq!(all["share_unmet"], 0.0, "{all}");
    }
}

/// States that are hard to solve for are given up, and that is said.
#[test]
fn seconds_end_a_search_that_goes_on_and_on() {
    const HARD: &str = r#"
        states = { a = { period = 6.283185307179586 }, b = { period = 6.283185307179586 }, c = {}, va = {}, vb = {}, vc = {} }
        controls = { u = { min = -1, max = 1 }, v = { min = -1, max = 1 } }
        equilibrium = { a = 0, b = 0, c = 0, va = 0, vb = 0, vc = 0, u = 0, v = 0 }
        region = { a = [-3.2, 3.2], b = [-3.2, 3.2], c = [-3, 3], va = [-8, 8], vb = [-8, 8], vc = [-5, 5] }
        map = { error = 1e-2, seconds = 1e-3, check = 100 }
        [dynamics]
        a = "va"
        b = "vb"
        c = "vc"
        va = "5*sin(a) + u"
        vb = "5*sin(b) + v - 0.1*va*vb"
        vc = "-c^3 + 0.3*u + sin(a - b)"
        [cost]
        running = "sin(a/2)^2 + sin(b/2)^2 + c^2 + 0.5*(va^2 + vb^2 + vc^2 + u^2 + v^2)"
    "#;
    let scene = folder().join("hard.toml");
    std::fs::write(&scene, HARD).unwrap();
    let out = scene.with_extension("h5");
    let said = words(&scene, &out);
    assert!(
        said.contains("the budget ended the first search after 0 of its"),
        "{said}"
    );
    assert!(
        said.contains("no fresh state could be solved for in `seconds`"),
        "{said}"
    );
    assert!(
        said.contains("nothing is said in 100.00 % of the region"),
        "{said}"
    );
    // Nothing is known to those who ask, and they are told so.
    let asked = costate(&[
        "value".as_ref(),
        out.as_os_str(),
        "--at".as_ref(),
        "a=0.1".as_ref(),
    ]);
    assert_eq!(asked.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&asked.stderr).contains("knows V nowhere"));
}

/// Maps that say nothing say why, those whose first search was cut that a sheet may have been
/// missed, and V that is 0 everywhere is known.
#[test]
fn what_is_empty_says_why() {
    const SPRING: &str = r#"
        states = { x = {}, v = {} }
        controls = { u = { min = -2, max = 2 } }
        dynamics = { x = "v", v = "-x + x^3/6 + u" }
        cost = { running = "0.5*(x^2 + v^2 + u^2)" }
        equilibrium = { x = 0, v = 0, u = 0 }
        region = { x = [-1, 1], v = [-1, 1] }
    "#;
    const NOTHING: &str = r#"
        states = { x = {} }
        controls = { u = {} }
        dynamics = { x = "u" }
        cost = { running = "0.5*u^2", terminal = "0", final_time = 1 }
        region = { x = [-1, 1] }
        map = { error = 1e-3, states = 2000, check = 20 }
    "#;
    let said = |name: &str, scene: &str| {
        let path = folder().join(name).with_extension("toml");
        std::fs::write(&path, scene).unwrap();
        let out = path.with_extension("h5");
        (words(&path, &out), out)
    };
    let at = |file: &Path, at: &str| {
        costate(&[
            "value".as_ref(),
            file.as_os_str(),
            "--at".as_ref(),
            at.as_ref(),
        ])
    };
    let low = "map = { error = 1e-3, check = 20, value_max = 1e-12 }";
    let guarded = "guards = { g = \"x < 0.3\" }\nmap = { error = 1e-3, check = 20, region = { x = [0.5, 1] } }";
    for (name, lines, why) in [
        ("low", low, "V is above `value_max` at every state"),
        ("guarded", guarded, "guards exclude every state"),
    ] {
        let (said, file) = said(name, &format!("{SPRING}{lines}"));
        assert!(said.contains(why), "{said}");
        assert!(!said.contains("budget"), "{said}");
        let asked = at(&file, "x=0.6,v=0.1");
        assert_eq!(asked.status.code(), Some(2));
        assert!(String::from_utf8_lossy(&asked.stderr).contains("knows V nowhere"));
    }
    let (words, file) = said(
        "cut",
        &format!("{SPRING}map = {{ error = 1e-2, check = 20, states = 100 }}"),
    );
    assert!(
        words.contains("the budget ended the first search"),
        "{words}"
    );
    let shown = done(at(&file, "x=0.6,v=0.1"));
    assert!(shown.contains("a cheaper sheet may be missing"), "{shown}");
    let (_, file) = said("nothing", NOTHING);
    crate::common_commands::in_schema(&file);
    let value = Stored::open(&file).unwrap().value_map().unwrap();
    let known = value
        .at_time(&[0.3], 0.5)
        .lowest
        .expect("V is 0 everywhere");
    assert!(known.v.abs() <= 1e-12 && known.v_error < 1e-3, "{known:?}");
}

#[test]
fn the_seed_draws_other_states_for_the_check() {
    let scene = scene("manufactured", "error = 1e-3\ncheck = 7");
    let checked = |seed: &str| {
        let out = scene.with_extension(format!("{seed}.h5"));
        let arguments = ["homotopy", "--backend", "cpu", "--seed", seed, "--out"].map(OsStr::new);
        done(costate(
            &[&arguments[..], &[out.as_ref(), scene.as_ref()]].concat(),
        ));
        let stored = Stored::open(&out).unwrap();
        let x = stored.group("map_check").unwrap().f64("x0").unwrap().values;
        (x, pieces(&stored).cells)
    };
    let ((a, cells), (b, same), (again, _)) = (checked("0"), checked("1"), checked("1"));
    assert!(a.iter().zip(&b).all(|(a, b)| a != b) && b == again && cells == same);
    assert!(b.iter().all(|x| (-2.0..=2.0).contains(x)), "{b:?}");
}

/// The sum of numbers, as if of twice the digits.
fn sum(terms: &[f64]) -> f64 {
    let (mut sum, mut rest) = (0.0f64, 0.0);
    for term in terms {
        let next = sum + term;
        let back = next - sum;
        rest += (sum - (next - back)) + (term - back);
        sum = next;
    }
    sum + rest
}

/// Parts whose sum is a product of three numbers, the last one given with what its rounding lost.
fn product(a: f64, b: f64, [c, less]: [f64; 2]) -> [f64; 5] {
    let pair = |a: f64, b: f64| [a * b, a.mul_add(b, -(a * b))];
    let [high, low] = pair(a, b);
    let ([x, y], [z, w]) = (pair(high, c), pair(low, c));
    [x, y, z, w, high * less]
}

/// Not even rounding takes V and p further from what is exact than they say, down to 1e-9 from the
/// equilibrium.
#[test]
fn rounding_is_within_the_errors_said() {
    let path = folder().join("integrator.toml");
    let text = "states = { x = {}, v = {} }\ncontrols = { u = {} }\ndynamics = { x = \"v\", v = \"u\" }\n\
        cost = { running = \"0.5*(x^2 + v^2 + u^2)\" }\nequilibrium = { x = 0, v = 0, u = 0 }\n\
        region = { x = [-1, 1], v = [-1, 1] }\n[map]\nerror = 1e-4\ncheck = 5\n";
    std::fs::write(&path, text).unwrap();
    let out = path.with_extension("h5");
    done(run(&path, &out));
    let map = Stored::open(&out).unwrap().value_map().unwrap();
    let root = 3.0f64.sqrt();
    // V = (r x^2 + 2 x v + r v^2) / 2 with r the root of 3.
    let root = [root, -root.mul_add(root, -3.0) / (2.0 * root)];
    let places: Vec<[f64; 2]> = spread([[-9.0, 0.0], [0.0, 6.3]], 1000)
        .into_iter()
        .map(|[size, angle]| [angle.cos(), angle.sin()].map(|c| c * 10f64.powf(size)))
        .collect();
    let many = map.at_many(&places.concat(), true);
    let (mut known, mut tight) = ([0, 0], 0.0f64);
    for ([x, v], told) in places.iter().zip(many) {
        for at in [map.at(&[*x, *v]), told] {
            let here = at.lowest.unwrap();
            known[usize::from(here.in_pieces)] += 1;
            let half = root.map(|r| -0.5 * r);
            let terms = [
                &[here.v][..],
                &product(*x, *x, half),
                &product(*v, *v, half),
                &product(*x, *v, [-1.0, 0.0]),
            ];
            let off = sum(&terms.concat()).abs();
            assert!(
                off <= here.v_error,
                "V at {x:e}, {v:e}: off by {off:e}, said {:e}",
                here.v_error
            );
            // No more than is needed near the equilibrium, either.
            tight = tight.max(if here.in_pieces {
                0.0
            } else {
                here.v_error / here.v
            });
            let minus = root.map(|r| -r);
            let of_p = |p: f64, along: f64, other: f64| {
                let terms = [&[p, -other][..], &product(along, 1.0, minus)];
                sum(&terms.concat()).abs()
            };
            let off = of_p(here.p[0], *x, *v).max(of_p(here.p[1], *v, *x));
            let said = here.p_error * here.p[0].abs().max(here.p[1].abs());
            assert!(
                off <= said,
                "p at {x:e}, {v:e}: off by {off:e}, said {said:e}"
            );
            assert!(off <= here.u_error || (here.u[0] + here.p[1]).abs() <= here.u_error);
        }
    }
    println!("{known:?}; V_error / V up to {tight:.1e} near the equilibrium");
    assert!(known[0] > 100 && known[1] > 100, "{known:?}");
    assert!(tight < 1e-12);
}

/// Where the series about the equilibrium answers, its errors of V and p are those of the terms
/// that it leaves out.
#[test]
fn the_series_errors_hold_for_p_too() {
    let (stored, _) = made("manufactured", "error = 1e-4\nfloor = 1e-3\ncheck = 3");
    let map = stored.value_map().unwrap();
    let (mut worst, mut count) = ([0.0f64; 2], 0);
    for [size, angle] in spread([[-6.0, 0.0], [0.0, 6.3]], 2000) {
        let [x, y] = [angle.cos(), angle.sin()].map(|c| c * 10f64.powf(size));
        for at in [map.at(&[x, y]), map.at_many(&[x, y], true).remove(0)] {
            let here = at.lowest.unwrap();
            if here.in_pieces {
                continue;
            }
            let p = manufactured::at(&[x, y]).p;
            // Without the cancellation of 1 - cos(x).
            let v =
                x * x / 2.0 + (x / 2.0).sin().powi(2) + x * y / 2.0 + y * y + x * x * y * y / 4.0;
            let off = (here.p[0] - p[0]).abs().max((here.p[1] - p[1]).abs());
            let largest = here.p[0].abs().max(here.p[1].abs());
            worst[0] = worst[0].max((here.v - v).abs() / (here.v_error + 4.0 * f64::EPSILON * v));
            worst[1] = worst[1].max(off / (largest * (here.p_error + 4.0 * f64::EPSILON)));
            count += 1;
        }
    }
    println!(
        "over the errors said: V {:.2}, p {:.2}, of {count}",
        worst[0], worst[1]
    );
    assert!(
        count > 500 && worst.iter().all(|w| *w <= 1.0),
        "{worst:?} of {count}"
    );
}

#[test]
fn what_lies_outside_the_region_is_named() {
    let (stored, _) = made("manufactured", "error = 1e-2\ncheck = 1");
    let file = stored.path.to_str().unwrap().to_owned();
    drop(stored);
    let said = done(costate(&["value", &file, "--at", "x=0.1,y=-2.5"]));
    assert!(
        said.contains("y = -2.5 lies outside the region of the map, from -2 to 2"),
        "{said}"
    );
    let json = done(costate(&["value", &file, "--at", "x=2.75", "--json"]));
    assert!(json.contains("x = 2.75 lies outside"), "{json}");
    let inside = done(costate(&["value", &file, "--at", "x=1.25"]));
    assert!(!inside.contains("outside"), "{inside}");
}

/// Where two sheets of the pendulum cost the same the map has them do so, too, to the distance
/// asked for; and no sheet ends before. Places on the line with the jump of p there: `costate
/// homotopy` of a grid, `/equal_cost`, located to 1e-9 of V (117 to 184).
#[test]
fn the_line_of_equal_cost_is_where_it_is() {
    const LINE: [[f64; 4]; 14] = [
        [-3.9, 0.104413342, -258.312, -63.835],
        [-2.25, 9.982368602, 53.888, 34.79],
        [-1.8, 9.362178284, 44.689, 36.367],
        [-1.301203909, 8.8, 41.453, 38.957],
        [-0.85, 8.313962734, 47.146, 41.963],
        [-0.429636638, 7.8, 60.802, 45.164],
        [0.0, 7.148571923, 82.909, 48.641],
        [0.4, 6.386314478, 109.796, 51.892],
        [0.8, 5.451197394, 140.949, 55.005],
        [1.110949057, 4.6, 166.643, 57.247],
        [1.45, 3.550928932, 194.565, 59.45],
        [1.784802379, 2.4, 220.507, 61.328],
        [2.1, 1.224399454, 242.123, 62.791],
        [2.4, 0.036288174, 259.161, 63.888],
    ];
    // In widths of the region: 1e-6 along omega, a quarter of that along theta.
    let (stored, summary) = made(
        "pendulum",
        "error = 1e-4\nvalue_max = 185.0\nequal_cost = 4e-8\ncheck = 20",
    );
    let map = pieces(&stored);
    println!("{summary}");
    for [theta, omega, a, b] in LINE {
        let size = f64::hypot(a, b);
        // p along its jump: that of the first sheet is larger by it, and is that on the side where
        // that sheet is the lower.
        let along = |t: f64| {
            let x = [
                (theta + t * a / size).clamp(-3.9, 2.4),
                (omega + t * b / size).clamp(-11.0, 14.0),
            ];
            let said = map.at(&x).unwrap_or_else(|| panic!("{x:?} is not known"));
            (said.p[0] * a + said.p[1] * b) / size
        };
        let jump = along(-1e-6) - along(1e-6);
        assert!(
            (jump / size - 1.0).abs() < 1e-3,
            "{theta}, {omega}: {jump} of {size}"
        );
    }
    // Solved; next to the line, where the lower sheet's points are few.
    let here = map.at(&[-1.55, 9.0]).unwrap();
    assert!((here.v / 141.953_592_185 - 1.0).abs() < 1e-4, "{}", here.v);
}

/// Six states, with next to no budget: what is said keeps to its bounds.
#[test]
fn six_states() {
    let region = "region = { phi = [-0.3, 0.3], theta = [-0.3, 0.3], psi = [-0.3, 0.3], w1 = [-0.2, 0.2], w2 = [-0.2, 0.2], w3 = [-0.2, 0.2] }";
    let (stored, summary) = made(
        "satellite",
        &format!("error = 2e-2\nstates = 120\ncheck = 12\n{region}"),
    );
    println!("{summary}");
    let check = stored.group("map_check").expect("the check is in the file");
    let read = |name: &str| check.f64(name).unwrap().values;
    let (solved, said, bound) = (read("V_solved"), read("V_said"), read("V_bound"));
    let known: Vec<usize> = (0..12).filter(|k| said[*k].is_finite()).collect();
    assert!(known.len() >= 6, "{} of 12 are known", known.len());
    for k in known {
        let off = (said[k] - solved[k]).abs();
        assert!(
            off <= bound[k] && off < 2e-2 * solved[k].max(1e-3),
            "{} for {}, bound {}",
            said[k],
            solved[k],
            bound[k]
        );
    }
}
