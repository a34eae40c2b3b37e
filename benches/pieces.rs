//! How fast a map in pieces says V, p and u, and flies closed loops.
//!
//! `cargo bench --bench pieces`: of a small map of the compressor, made first. `-- FILE.h5 [STATES
//! [SCENE.toml]]`: of a run whose scene has `[map] error`; closed loops are those of the scene's
//! `[closed_loop]`. Random states of the map's region, all threads.

use costate::backend::cpu::Cpu;
use costate::low_level::closed_loop::{Chart, Initial, Laws, Setting};
use costate::low_level::hamiltonian::Hamiltonian;
use costate::low_level::map::ValueMap;
use costate::low_level::map::pieces::Region;
use costate::low_level::model::{Model, Outside};
use costate::low_level::result::Stored;
use costate::low_level::sweep::Choices;
use rayon::prelude::*;
use std::path::PathBuf;
use std::process::Command;
use std::time::Instant;

const REPEATS: usize = 5;
/// Of the map that is made: enough that loops meet what they meet in a larger one.
const MADE: &str = "error = 1e-3\nfloor = 1e-3\nstates = 400\ncheck = 1\nseconds = 120";

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1).filter(|a| !a.starts_with("--"));
    let file = args.next().map(PathBuf::from);
    let count: usize = args.next().map_or(Ok(500_000), |n| n.parse())?;
    let file = match file {
        Some(file) => file,
        None => made()?,
    };
    let stored = Stored::open(&file)?;
    let map = stored.value_map()?;
    let Some(pieces) = stored.map_pieces()? else {
        println!("{} holds no map in pieces", file.display());
        return Ok(());
    };
    let n = pieces.states();
    let x = states(&pieces.region, count);
    println!(
        "{} pieces of {n} variables, {count} states, {} threads; states a second, best of {REPEATS}",
        pieces.pieces.len(),
        rayon::current_num_threads()
    );
    let known = x.par_chunks(n).filter(|x| pieces.at(x).is_some()).count();
    let one_by_one = rate(count, || {
        x.par_chunks(n).filter(|x| pieces.at(x).is_some()).count()
    });
    println!("one by one, V and p:       {one_by_one:>12.0}   ({known} known)");
    let together = rate(count, || map.many(&x).v.len());
    println!("at once, f64, V, p and u:  {together:>12.0}");
    let single = &x[..n * (count / 50).max(1)];
    let full = rate(single.len() / n, || {
        single
            .par_chunks(n)
            .filter(|x| map.local(x).is_some())
            .count()
    });
    println!("one by one, with d2V/dx2:  {full:>12.0}");
    match args.next() {
        Some(scene) => loops(
            &costate::low_level::scenario::load(scene.as_ref(), &[])?,
            &map,
            &pieces.region,
            count / 25,
        )?,
        None => loops(&stored.scene.model, &map, &pieces.region, count / 25)?,
    }
    Ok(())
}

/// Closed loops under the law of the map from random states of its region.
fn loops(
    model: &Model,
    map: &ValueMap,
    region: &Region,
    count: usize,
) -> Result<(), Box<dyn std::error::Error>> {
    let Some(scene) = &model.closed_loop else {
        println!("the scene has no [closed_loop]: no loops are flown");
        return Ok(());
    };
    let hamiltonian = Hamiltonian::derive(model).map_err(|problems| format!("{problems:?}"))?;
    let cpu = Cpu::new();
    let initial = Initial {
        x: states(region, count),
        axes: Vec::new(),
        ..Initial::new(model, scene, None, 0)?
    };
    for (name, outside) in [("nearest", Outside::Nearest), ("search", Outside::Search)] {
        let scene = costate::low_level::model::ClosedLoop {
            outside,
            ..scene.clone()
        };
        let laws = Laws::new(model, &hamiltonian, scene.track);
        let setting = Setting::new(&laws, &scene, &cpu, Choices::default())?;
        let chart: &dyn Chart = map;
        let law = [laws.chart("map")];
        let mut home = 0.0;
        let flown = rate(count, || {
            let flown =
                setting.evaluate(&law, initial.clone(), Some(chart), None, &cpu, &mut |_| {});
            home = flown.map_or(f64::NAN, |e| e.laws[0].share_converged());
            count
        });
        println!(
            "closed loops, {name:<8}     {flown:>12.0}   ({:.2} % come home; {} to t = {}, {} periods)",
            100.0 * home,
            setting.leg_method.name(),
            scene.final_time,
            scene.samples
        );
    }
    Ok(())
}

/// The map of a part of the compressor's box, of which loops are flown.
fn made() -> Result<PathBuf, Box<dyn std::error::Error>> {
    let shipped = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../scenarios/moore_greitzer_map.toml"
    );
    let text = std::fs::read_to_string(shipped)?;
    let sections = text
        .find("[shoot_out]")
        .ok_or("the scene has [shoot_out]")?;
    let region = "{ Phi = [1.0, 1.4], Psi = [1.6, 2.2], R = [0.0, 0.2], gamma = [1.3, 1.75] }";
    let loops = "final_time = 40.0\nsamples = 200";
    let whole = format!(
        "{}\n[map]\n{MADE}\nregion = {region}\n[closed_loop]\n{loops}\nrandom = 1\ninitial = {region}\n",
        &text[..sections]
    );
    let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
    let (scene, file) = (folder.join("pieces.toml"), folder.join("pieces.h5"));
    std::fs::write(&scene, whole)?;
    let output = Command::new(env!("CARGO_BIN_EXE_costate"))
        .args(["homotopy", "--backend", "cpu", "--out"])
        .args([&file, &scene])
        .output()?;
    if !output.status.success() {
        return Err(String::from_utf8_lossy(&output.stderr).into_owned().into());
    }
    Ok(file)
}

/// Random states `[state][component]`.
fn states(region: &Region, count: usize) -> Vec<f64> {
    let (lo, hi) = (&region.lo, &region.hi);
    let n = lo.len();
    (0..count * n)
        .map(|k| lo[k % n] + (hi[k % n] - lo[k % n]) * uniform(k as u64))
        .collect()
}

fn rate(count: usize, mut work: impl FnMut() -> usize) -> f64 {
    let mut best = f64::INFINITY;
    let before = processor_seconds();
    for _ in 0..REPEATS {
        let clock = Instant::now();
        std::hint::black_box(work());
        best = best.min(clock.elapsed().as_secs_f64());
    }
    let spent = processor_seconds()
        .zip(before)
        .map(|(after, before)| after - before);
    if let Some(spent) = spent.filter(|s| *s > 0.0) {
        let threads = rayon::current_num_threads() as f64;
        let free = (count * REPEATS) as f64 * threads / spent;
        println!("  by the processor time, {threads} cores to itself: {free:.0}");
    }
    count as f64 / best
}

/// Processor time of this process on all threads, where the system tells it (Linux, in ticks of 10
/// ms): on a machine that does other work too the clock on the wall says little.
fn processor_seconds() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    let fields: Vec<&str> = stat.rsplit(')').next()?.split_whitespace().collect();
    let ticks = |k: usize| fields.get(k)?.parse::<f64>().ok();
    Some((ticks(11)? + ticks(12)?) / 100.0)
}

/// A number in [0, 1) from a counter (splitmix64).
fn uniform(k: u64) -> f64 {
    let mut z = k.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 * (-53f64).exp2()
}
