//! `costate report`: what is on the page, what the pictures are, and what is refused.

use crate::common_problems::TwoWells;
use costate::low_level::hdf5::{Dimension, Group, ResultFile, Variable};
use costate::low_level::model::Report;
use costate::low_level::result::Stored;
use costate::low_level::scenario;
use costate_report::contour::{self, Grid};
use costate_report::{Options, Source};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

/// A folder of this test run.
fn folder(name: &str) -> PathBuf {
    let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR"))
        .join("report")
        .join(name);
    let _ = std::fs::remove_dir_all(&path);
    std::fs::create_dir_all(&path).unwrap();
    path
}

fn costate(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_costate"))
        .args(args)
        .output()
        .unwrap()
}

/// The result of a scene of the repository, computed once.
fn result(name: &str) -> PathBuf {
    static DONE: OnceLock<std::sync::Mutex<Vec<String>>> = OnceLock::new();
    let mut done = DONE.get_or_init(Default::default).lock().unwrap();
    let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR"))
        .join("report")
        .join(format!("{name}.h5"));
    if !done.iter().any(|n| n == name) {
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        make("homotopy", name, &path);
        done.push(name.to_owned());
    }
    path
}

/// The result file of a command on a shipped scene.
fn make(command: &str, name: &str, path: &Path) {
    let scene = format!("{}/scenarios/{name}.toml", crate::ROOT);
    let out = path.to_str().unwrap();
    let run = costate(&[command, &scene, "--backend", "cpu", "--quiet", "--out", out]);
    assert!(
        run.status.success(),
        "{}",
        String::from_utf8_lossy(&run.stderr)
    );
}

/// The result of a sweep and more.
fn whole(name: &str) -> PathBuf {
    let path = folder(&format!("whole_{name}")).join("result.h5");
    make("run", name, &path);
    path
}

/// Writes a report and gives its summary and page.
fn reported(file: &Path, page: &Path, more: &[&str]) -> (serde_json::Value, String) {
    let args = [
        &[
            "report",
            file.to_str().unwrap(),
            "--json",
            "--out",
            page.to_str().unwrap(),
        ],
        more,
    ]
    .concat();
    let run = costate(&args);
    assert!(
        run.status.success(),
        "{}",
        String::from_utf8_lossy(&run.stderr)
    );
    let summary = serde_json::from_slice(&run.stdout).unwrap();
    (summary, std::fs::read_to_string(page).unwrap())
}

fn pictures(summary: &serde_json::Value) -> Vec<&str> {
    let list = summary["pictures"].as_array().unwrap();
    list.iter().map(|p| p.as_str().unwrap()).collect()
}

/// Asserts that every element is closed in its turn; HTML's void elements need not be.
fn assert_well_formed(text: &str, html: bool) {
    const VOID: [&str; 3] = ["meta", "br", "link"];
    let mut open: Vec<&str> = Vec::new();
    let mut rest = text;
    while let Some(start) = rest.find('<') {
        assert!(
            !rest[..start].contains('>'),
            "a stray '>' before {}",
            &rest[start..].chars().take(40).collect::<String>()
        );
        let end = start + rest[start..].find('>').expect("a tag that does not end");
        let tag = &rest[start + 1..end];
        assert!(!tag.contains('<'), "{tag}");
        assert_eq!(tag.matches('"').count() % 2, 0, "{tag}");
        rest = &rest[end + 1..];
        if tag.starts_with('!') {
            continue;
        }
        let name = tag
            .trim_start_matches('/')
            .split([' ', '/', '\n'])
            .next()
            .unwrap();
        if tag.starts_with('/') {
            assert_eq!(open.pop(), Some(name));
        } else if !(tag.ends_with('/') || html && VOID.contains(&name)) {
            open.push(name);
        }
        if name == "style" && !tag.starts_with('/') {
            // Style sheets have their own '>'.
            rest = &rest[rest.find("</style>").unwrap()..];
        }
    }
    assert!(open.is_empty(), "{open:?}");
    // Every '&' is an entity.
    for part in text.split('&').skip(1) {
        let entity = part.split(';').next().unwrap();
        assert!(["amp", "lt", "gt", "quot"].contains(&entity), "&{entity}");
    }
}

/// Width, height, and how many pixels are not white and how many colours there are.
fn png(path: &Path) -> (u32, u32, usize, usize) {
    let decoder = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(path).unwrap()));
    let mut reader = decoder.read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    assert_eq!(info.color_type, png::ColorType::Rgb);
    let coloured = pixels.chunks(3).filter(|p| *p != [255, 255, 255]).count();
    let colours: std::collections::HashSet<&[u8]> = pixels.chunks(3).collect();
    (info.width, info.height, coloured, colours.len())
}

/// Everything that is said of a page and its pictures, whatever is on it.
fn assert_sound(summary: &serde_json::Value, page: &str, width: u32) {
    assert_well_formed(page, true);
    // Nothing is fetched: the only addresses are SVG's namespace and the pictures beside the page.
    assert_eq!(
        page.matches("http").count(),
        page.matches("xmlns=\"http://www.w3.org/2000/svg\"").count()
    );
    for word in ["<script", "<link", "src=", "@import", "url("] {
        assert!(!page.contains(word), "{word}");
    }
    assert!(page.len() < 2_000_000, "{}", page.len());
    let figures: Vec<&str> = page
        .split("<figure id=\"")
        .skip(1)
        .map(|p| p.split('"').next().unwrap())
        .collect();
    assert_eq!(figures, pictures(summary));
    let folder = PathBuf::from(summary["folder"].as_str().unwrap());
    for name in &figures {
        let svg = std::fs::read_to_string(folder.join(format!("{name}.svg"))).unwrap();
        assert_well_formed(&svg, false);
        assert!(svg.len() < 300_000, "{name}: {}", svg.len());
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{name}");
        assert!(page.contains(&svg), "{name} is on the page");
        let (w, h, coloured, colours) = png(&folder.join(format!("{name}.png")));
        assert_eq!(w, width, "{name}");
        assert!(
            svg.contains(&format!("width=\"{width}\" height=\"{h}\"")),
            "{name}: both are of one size"
        );
        // Axes alone would be less than this; a flat picture has few colours.
        assert!(
            coloured > (w * h / 100) as usize && colours > 20,
            "{name}: {coloured} pixels, {colours} colours"
        );
    }
    // No picture but these.
    let files = std::fs::read_dir(&folder).unwrap().count();
    assert_eq!(files, 2 * figures.len());
}

#[test]
fn a_page_has_what_its_file_has_data_for() {
    let file = whole("pendulum_rest");
    let page = file.with_file_name("page.html");
    let (summary, text) = reported(&file, &page, &[]);
    assert_eq!(
        pictures(&summary),
        [
            "phase",
            "contours",
            "surface",
            "slice",
            "histories",
            "errors"
        ]
    );
    assert_eq!(summary["missing"].as_array().unwrap().len(), 0);
    assert_sound(&summary, &text, costate_report::DEFAULT_WIDTH);
    // The equations as written, units, and how it went.
    for said in [
        "theta' = omega",
        "angular velocity ω (rad/s)",
        "<dt>Promised accuracy</dt><dd>met</dd>",
    ] {
        assert!(text.contains(said), "{said}");
    }
}

#[test]
fn solved_states_alone_give_fewer_pictures_and_any_width_is_had() {
    let file = result("hopf_lax");
    let page = folder("narrow").join("page.html");
    let (summary, text) = reported(&file, &page, &["--width", "500"]);
    assert_eq!(
        pictures(&summary),
        ["contours", "surface", "slice", "errors"]
    );
    assert_sound(&summary, &text, 500);
    // What the page that is replaced names is taken away, and nothing else.
    let pictures = page.with_extension("");
    let old = std::fs::read_to_string(&page).unwrap();
    std::fs::write(&page, old + "<a href=\"page/speed.svg\">SVG</a>").unwrap();
    for name in ["speed.svg", "mine.svg", "coverage.svg"] {
        std::fs::write(pictures.join(name), "old").unwrap();
    }
    let (summary, text) = reported(&file, &page, &["--width", "1200"]);
    assert!(!pictures.join("speed.svg").exists());
    for name in ["mine.svg", "coverage.svg"] {
        std::fs::remove_file(pictures.join(name)).unwrap();
    }
    assert_sound(&summary, &text, 1200);
}

#[test]
fn files_that_are_no_report_s_are_not_replaced() {
    let file = result("hopf_lax");
    let page = folder("others").join("page.html");
    let pictures = page.with_extension("");
    std::fs::create_dir_all(&pictures).unwrap();
    for own in [page.clone(), pictures.join("contours.svg")] {
        std::fs::write(&own, "my notes on costate").unwrap();
        let arguments = [
            "report",
            file.to_str().unwrap(),
            "--out",
            page.to_str().unwrap(),
        ];
        let refused = costate(&arguments);
        let error = String::from_utf8_lossy(&refused.stderr);
        assert_eq!(refused.status.code(), Some(2), "{error}");
        assert!(error.contains("no part of an earlier report"), "{error}");
        assert_eq!(
            std::fs::read_to_string(&own).unwrap(),
            "my notes on costate"
        );
        assert!(!pictures.join("surface.svg").exists());
        std::fs::remove_file(&own).unwrap();
    }
}

/// V of the scene `hopf_lax`, and whether the end on the left is the cheapest.
fn hopf_lax(x: f64, y: f64) -> (f64, bool) {
    let wells = TwoWells::with(2.0);
    (wells.at(&[x, y]).v, wells.ways(x)[0].end < 0.0)
}

#[test]
fn contours_of_an_exact_solution() {
    let file = result("hopf_lax");
    let stored = Stored::open(&file).unwrap();
    let source = Source::new(&stored, &Report::default()).unwrap();
    let plane = source.plane().unwrap().unwrap();
    assert_eq!(plane.sheets(), [0, 1]);
    let grid = Grid {
        x: &plane.x,
        y: &plane.y,
        values: &plane.v,
        cut: &plane.cut,
    };
    let fine = plane.x[1] - plane.x[0];
    let mut points = 0;
    for level in [-1.1, -1.0, -0.9, -0.8, -0.7, -0.6] {
        for line in contour::lines(&grid, level) {
            for pair in line.points.windows(2) {
                // The cheapest well is the same at both ends, but for the cell in which it changes.
                let sides = pair
                    .iter()
                    .map(|p| hopf_lax(p[0], p[1]).1)
                    .collect::<Vec<_>>();
                assert!(
                    sides[0] == sides[1] || pair.iter().all(|p| (p[0] - 0.2).abs() < 1.5 * fine),
                    "{pair:?}"
                );
                assert!((pair[0][0] - pair[1][0]).abs() <= fine * (1.0 + 1e-9));
            }
            for [x, y] in &line.points {
                // Solved states are 0.15 apart. Within a cell of one sheet V is off by a term of
                // third order, at most V''' h^3 / 12 or so with |V'''| < 6 here; where both sheets
                // are, by one of second, V'' h^2 / 2 with V'' < 1.
                let apart = (x - 0.2).abs() < 0.15;
                let tolerance = if apart {
                    0.5 * 0.15f64.powi(2)
                } else {
                    0.5 * 0.15f64.powi(3)
                };
                assert!(
                    (hopf_lax(*x, *y).0 - level).abs() < tolerance,
                    "{x} {y} {level}"
                );
                points += 1;
            }
        }
    }
    assert!(points > 1000, "{points}");
}

#[test]
fn a_plane_without_a_map_is_told_by_what_is_around_it() {
    let file = whole("linear_quadratic");
    let stored = Stored::open(&file).unwrap();
    let choice = Report {
        slice: vec![(stored.scene.model.states[3].variable.name.clone(), 0.1)],
        ..Report::default()
    };
    let source = Source::new(&stored, &choice).unwrap();
    assert_eq!(source.axes, [0, 1]);
    let plane = source.plane().unwrap().unwrap();
    let p =
        costate::low_level::local::Riccati::solve(&stored.scene.hamiltonian, &stored.scene.model)
            .unwrap()
            .p;
    let at = stored.scene.model.reference();
    let mut known = 0;
    for (i, x) in plane.x.iter().enumerate() {
        for (j, y) in plane.y.iter().enumerate() {
            let v = plane.v[i * plane.y.len() + j];
            let mut d: Vec<f64> = source.base.iter().zip(at).map(|(b, r)| b - r).collect();
            (d[0], d[1]) = (x - at[0], y - at[1]);
            let exact = 0.5
                * (0..4)
                    .map(|a| (0..4).map(|b| d[a] * p[(a, b)] * d[b]).sum::<f64>())
                    .sum::<f64>();
            if v.is_finite() {
                // Both interpolations are exact for a quadratic V; the sweep promises 30 rtol, rtol
                // = 1e-6 or less, and p's error, as large, counts times a distance of the region's
                // size.
                assert!(
                    (v - exact).abs() <= 1e-4 * plane.limit,
                    "{x} {y}: {v} {exact}"
                );
                known += 1;
            }
        }
    }
    assert!(known > plane.v.len() / 10, "{known} of {}", plane.v.len());
}

const SCENE: &str = r#"
title = "A & B <scene>"
[states]
x = { unit = "m", long_name = "place" }
v = { unit = "m/s" }
w = {}
[controls]
u = { min = -2, max = 2 }
[dynamics]
x = "v"
v = "-x + u"
w = "-w"
[cost]
running = "0.5*(x^2 + v^2 + w^2 + u^2)"
[equilibrium]
x = 0
v = 0
w = 0
u = 0
[region]
x = [-1, 1]
v = [-1, 1]
w = [0, 2]
"#;

/// A result file with nothing but its scene and what `fill` writes.
fn written(name: &str, fill: impl FnOnce(&mut ResultFile)) -> PathBuf {
    let path = folder(name).join("result.h5");
    let mut file = ResultFile::create(&path).unwrap();
    file.attribute("scenario", SCENE).unwrap();
    file.attribute("scenario_file", "scene.toml").unwrap();
    fill(&mut file);
    file.finish().unwrap();
    path
}

/// Closed loops of two laws from a grid of 9 x 7 initial states: the second diverges from x > 0.5.
fn closed_loops(file: &mut ResultFile) {
    let both = ["law", "initial"];
    let group = Group::new("closed_loop")
        .dimension(Dimension::names("law", ["lqr", "other"]))
        .dimension(Dimension::index("initial", 63))
        .dimension(Dimension::names("state", ["x", "v", "w"]))
        .variable(Variable::f64("x0", ["initial", "state"]))
        .variable(Variable::f64("V", ["initial"]))
        .variable(Variable::f64("J", both))
        .variable(Variable::f64("suboptimality", both))
        .variable(Variable::i32("converged", both))
        .variable(Variable::i32("status", both))
        .variable(Variable::f64("t_end", both))
        .variable(Variable::f64("lowest_v", both).long_name("min(v)"))
        .variable(Variable::f64("never", both).long_name("max(1/0)"))
        .attribute("axes", "x v")
        .attribute("counts", vec![9, 7]);
    let states: Vec<[f64; 3]> = (0..63)
        .map(|k| {
            [
                f64::from(k / 7) / 4.0 - 1.0,
                f64::from(k % 7) / 3.0 - 1.0,
                0.5,
            ]
        })
        .collect();
    let twice = |f: &dyn Fn(usize, &[f64; 3]) -> f64| -> Vec<f64> {
        (0..2)
            .flat_map(|l| states.iter().map(move |s| f(l, s)))
            .collect()
    };
    let mut writer = file.group(&group).unwrap();
    writer.write("x0", &states.concat()).unwrap();
    writer.write("V", &vec![1.0; 63]).unwrap();
    writer
        .write("J", &twice(&|l, s| 1.0 + l as f64 * s[0].abs()))
        .unwrap();
    writer
        .write(
            "suboptimality",
            &twice(&|l, s| 1e-9 + l as f64 * 0.1 * s[0].abs()),
        )
        .unwrap();
    let converged: Vec<i32> = twice(&|l, s| f64::from(u8::from(l == 0 || s[0] <= 0.5)))
        .iter()
        .map(|c| *c as i32)
        .collect();
    writer.write("converged", &converged).unwrap();
    writer.write("status", &vec![0; 126]).unwrap();
    writer.write("t_end", &vec![5.0; 126]).unwrap();
    writer
        .write(
            "lowest_v",
            &twice(&|l, s| s[1].min(0.0) - s[0] * s[0] - 0.3 * l as f64),
        )
        .unwrap();
    writer.write("never", &vec![f64::NAN; 126]).unwrap();
    drop(writer);
    let laws = Group::new("closed_loop_laws")
        .dimension(Dimension::names("law", ["lqr", "other"]))
        .variable(Variable::text(
            "source",
            "law",
            ["local solution", "a file"],
        ))
        .variable(Variable::f64("share_converged", ["law"]));
    file.group(&laws)
        .unwrap()
        .write("share_converged", &vec![1.0, 0.75])
        .unwrap();
    let study = Group::new("study")
        .dimension(Dimension::index("variant", 3))
        .dimension(Dimension::names("state", ["x", "v", "w"]))
        .variable(Variable::text("state_units", "state", ["m", "m/s", "1"]))
        .variable(Variable::f64("Phi0", ["variant"]))
        .variable(Variable::f64("x0", ["variant", "state"]).unit("see state_units"));
    let mut writer = file.group(&study).unwrap();
    writer.write("Phi0", &vec![1.1, 1.2, 1.3]).unwrap();
    writer
        .write("x0", &(0..9).map(f64::from).collect::<Vec<_>>())
        .unwrap();
    drop(writer);
    let sets = Group::new("operating_sets")
        .dimension(Dimension::names("law", ["lqr", "other"]))
        .dimension(Dimension::names("set", ["safe"]))
        .variable(Variable::text("condition", "set", ["lowest_v >= -0.5"]))
        .variable(Variable::f64("share", ["law", "set"]));
    file.group(&sets)
        .unwrap()
        .write("share", &vec![0.6, 0.3125])
        .unwrap();
    let contours = Group::new("operating_contours")
        .dimension(Dimension::index("vertex", 3))
        .dimension(Dimension::names("axis", ["x", "v"]))
        .variable(Variable::i32("law", ["vertex"]))
        .variable(Variable::i32("set", ["vertex"]))
        .variable(Variable::i32("line", ["vertex"]))
        .variable(Variable::i32("place", ["vertex"]))
        .variable(Variable::f64("x", ["vertex", "axis"]));
    let mut writer = file.group(&contours).unwrap();
    for (name, column) in [
        ("law", [0, 0, 0]),
        ("set", [0; 3]),
        ("line", [0; 3]),
        ("place", [0, 1, 2]),
    ] {
        writer.write(name, &column.to_vec()).unwrap();
    }
    writer
        .write("x", &vec![-0.7, 0.0, 0.0, -0.5, 0.7, 0.0])
        .unwrap();
}

#[test]
fn closed_loops_are_mapped_law_by_law() {
    let file = written("loops", closed_loops);
    let page = file.with_file_name("loops.html");
    let (summary, text) = reported(&file, &page, &[]);
    assert_eq!(
        pictures(&summary),
        ["closed_loop_lowest_v", "closed_loop_suboptimality"]
    );
    assert_sound(&summary, &text, costate_report::DEFAULT_WIDTH);
    // What cannot be drawn is named with the reason.
    assert_eq!(summary["missing"][0]["name"], "closed_loop_never");
    assert!(text.contains("closed_loop_never: it has no values"));
    for said in [
        "A &amp; B &lt;scene&gt;",
        "lowest v: min(v) at w = 0.5",
        "does not converge",
        "safe: lowest_v &gt;= -0.5",
        "0.3125",
        "local solution",
        "<th>variant</th><th>Phi0</th><th>x0 x</th><th>x0 v</th><th>x0 w</th></tr>\n<tr><td>0</td><td>1.1</td><td>0</td><td>1</td>",
    ] {
        assert!(text.contains(said), "{said}");
    }
}

#[test]
fn what_is_not_as_expected_is_named_and_stops_nothing() {
    let file = written("broken", |file| {
        closed_loops(file);
        // No t, x or V in it.
        let group = Group::new("trajectories")
            .dimension(Dimension::index("trajectory", 2))
            .variable(Variable::f64("nothing", ["trajectory"]));
        file.group(&group)
            .unwrap()
            .write("nothing", &vec![0.0; 2])
            .unwrap();
    });
    let stored = Stored::open(&file).unwrap();
    let written = costate_report::write(&stored, &Options::default()).unwrap();
    assert_eq!(
        written.pictures,
        ["closed_loop_lowest_v", "closed_loop_suboptimality"]
    );
    let missing: Vec<&str> = written.missing.iter().map(|(n, _)| n.as_str()).collect();
    assert!(
        missing.contains(&"phase") && missing.contains(&"histories"),
        "{missing:?}"
    );
    let text = std::fs::read_to_string(&written.page).unwrap();
    assert!(text.contains("Not shown") && text.contains("/trajectories/V"));
    assert_eq!(written.page.file_name().unwrap(), "result_report.html");
}

/// V, p and u over the only state: a line each on a smooth sheet, also where the series about the
/// equilibrium says V, and two where the cheapest way changes its side.
#[test]
fn a_scene_of_one_state_has_curves() {
    let smooth = "dynamics = { x = \"sin(x) + u\" }\ncost = { running = \"x^2 + u^2\" }\nequilibrium = { x = 0, u = 0 }\n";
    let wells = "dynamics = { x = \"u\" }\n\
                 cost = { running = \"0.5*u^2\", terminal = \"x^4/4 - x^2\", final_time = 2.0 }\n";
    for (name, problem, lines) in [("smooth", smooth, 1), ("wells", wells, 2)] {
        let folder = folder(&format!("curve-{name}"));
        let scene = folder.join("scene.toml");
        std::fs::write(
            &scene,
            format!(
                "states = {{ x = {{}} }}\ncontrols = {{ u = {{}} }}\n{problem}region = {{ x = [-2, 2] }}\n\
                 map = {{ error = 1e-3, time = false, check = 5 }}\n"
            ),
        )
        .unwrap();
        let file = folder.join("result.h5");
        let made = [
            "homotopy",
            "--backend",
            "cpu",
            "--quiet",
            scene.to_str().unwrap(),
            "--out",
            file.to_str().unwrap(),
        ];
        assert_eq!(costate(&made).status.code(), Some(0));
        let (summary, _) = reported(&file, &folder.join("page.html"), &[]);
        assert_eq!(pictures(&summary), ["curve"]);
        let svg = std::fs::read_to_string(folder.join("page/curve.svg")).unwrap();
        assert_eq!(
            svg.matches("stroke-width=\"1.9\"").count(),
            3 * lines,
            "{name}"
        );
    }
}

#[test]
fn an_empty_result_gives_a_page_without_pictures() {
    let file = written("empty", |_| {});
    let page = file.with_file_name("page.html");
    let (summary, text) = reported(
        &file,
        &page,
        &["--slice", "w=1/2", "--axes", "v,x", "--levels", "exp(-1),2"],
    );
    assert!(pictures(&summary).is_empty());
    assert_sound(&summary, &text, costate_report::DEFAULT_WIDTH);
}

#[test]
fn bad_options_and_files_are_the_users() {
    let file = written("refused", |_| {});
    let file = file.to_str().unwrap();
    let no_result = folder("no_result").join("text.h5");
    std::fs::write(&no_result, "no HDF5").unwrap();
    let cases: [(&[&str], &str); 11] = [
        (&["report", file, "--slice", "z=1"], "no state `z`"),
        (&["report", file, "--slice", "w=3"], "outside the region"),
        (&["report", file, "--slice", "w=nan"], "nan"),
        (&["report", file, "--slice", "x=0", "--axes", "x,v"], "axes"),
        (&["report", file, "--slice", "w"], "NAME=VALUE"),
        (&["report", file, "--axes", "x,x"], "two different states"),
        (&["report", file, "--axes", "x"], "two states"),
        (
            &["report", file, "--axes", "x,velocity"],
            "no state `velocity`",
        ),
        (&["report", file, "--levels", "1,exp(q)"], "q"),
        (
            &["report", no_result.to_str().unwrap()],
            "not a result file",
        ),
        (&["report", "/nowhere/result.h5"], "cannot read"),
    ];
    for (args, said) in cases {
        let run = costate(args);
        let error = String::from_utf8_lossy(&run.stderr);
        assert_eq!(run.status.code(), Some(2), "{args:?}: {error}");
        assert!(error.contains(said), "{args:?}: {error}");
    }
    assert!(
        !Path::new(file)
            .with_file_name("result_report.html")
            .exists(),
        "nothing is written"
    );
}

#[test]
fn the_scenes_section_is_read_and_refused_with_places() {
    let with = |section: &str| {
        scenario::parse(
            &format!("{SCENE}\n[report]\n{section}\n"),
            "scene.toml",
            &[],
        )
    };
    let model =
        with("levels = [\"exp(-4)\", 2, 1]\nslice = { w = 0.12 }\naxes = [\"v\", \"x\"]").unwrap();
    let report = model.report.unwrap();
    assert_eq!(report.levels, [(-4.0f64).exp(), 2.0, 1.0]);
    assert_eq!(report.slice, [("w".to_owned(), 0.12)]);
    assert_eq!(report.axes, Some(["v".to_owned(), "x".to_owned()]));
    let first = SCENE.lines().count() + 3;
    for (section, said) in [
        ("slices = { w = 1 }", "unknown key `slices`"),
        ("slice = { q = 1 }", "unknown name `q`"),
        ("slice = { w = 7 }", "outside the region"),
        (
            "slice = { x = 0 }\naxes = [\"x\", \"v\"]",
            "one of the picture's axes",
        ),
        ("axes = [\"x\"]", "names of two states"),
        ("axes = [\"x\", \"u\"]", "which is no state"),
        ("axes = [\"x\", \"x\"]", "the same"),
        ("levels = [\"x\"]", "x"),
    ] {
        let error = with(section).unwrap_err().to_string();
        assert!(
            error.contains(said) && error.contains(&format!("scene.toml:{first}:")),
            "{section}: {error}"
        );
    }
}

/// A mechanism is on the page as it is written, and a page without its figure says why.
#[test]
fn a_mechanism_is_shown_as_it_is_written() {
    let folder = folder("mechanism");
    let scene = format!("{}/scenarios/compass_gait.toml", crate::ROOT);
    for (samples, drawn) in [("20", true), ("0", false)] {
        let file = folder.join(format!("gait_{samples}.h5"));
        let out = file.to_str().unwrap();
        let run = costate(&[
            "simulate",
            &scene,
            "--quiet",
            "--samples",
            samples,
            "--out",
            out,
        ]);
        assert!(run.status.success());
        let (summary, page) = reported(&file, &folder.join("page.html"), &[]);
        assert!(
            page.contains("body hip = { joint = &quot;prismatic&quot;"),
            "{page}"
        );
        assert!(page.contains("contact foot ="));
        assert!(!page.contains("stance' = stance") && !page.contains("stance&#39; = stance"));
        assert_eq!(pictures(&summary).contains(&"figures"), drawn);
        assert_eq!(page.contains("no trajectory is stored"), !drawn);
    }
}
