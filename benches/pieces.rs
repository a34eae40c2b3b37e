//! How fast a map in pieces says V, p and u, and flies closed loops.
//!
//! `cargo bench --bench pieces -- FILE.h5 [STATES]`: random states of the map's region, all threads. The file is that of a run
//! whose scene has `[map] error`.

use costate::map::ValueMap;
use costate::output::Stored;
use rayon::prelude::*;
use std::time::Instant;

const REPEATS: usize = 5;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1).filter(|a| !a.starts_with("--"));
    let Some(file) = args.next() else {
        println!("no file: cargo bench --bench pieces -- FILE.h5 [STATES]");
        return Ok(());
    };
    let count: usize = args.next().map_or(Ok(500_000), |n| n.parse())?;
    let stored = Stored::open(file.as_ref())?;
    let map = ValueMap::new(&stored)?;
    let Some(pieces) = stored.map_pieces()? else {
        println!("{file} holds no map in pieces");
        return Ok(());
    };
    let (lo, hi) = (&pieces.region.lo, &pieces.region.hi);
    let n = lo.len();
    let x: Vec<f64> = (0..count * n)
        .map(|k| lo[k % n] + (hi[k % n] - lo[k % n]) * uniform(k as u64))
        .collect();
    println!(
        "{} pieces of {n} variables, {count} states, {} threads; states a second, best of {REPEATS}",
        pieces.pieces.len(),
        rayon::current_num_threads()
    );
    let known = x.par_chunks(n).filter(|x| pieces.at(x).is_some()).count();
    let one_by_one = rate(count, || x.par_chunks(n).filter(|x| pieces.at(x).is_some()).count());
    println!("one by one, V and p:       {one_by_one:>12.0}   ({known} known)");
    let together = rate(count, || map.many(&x).v.len());
    println!("at once, f64, V, p and u:  {together:>12.0}");
    let single = &x[..n * (count / 50).max(1)];
    let full = rate(single.len() / n, || {
        single.par_chunks(n).filter(|x| map.local(x).is_some()).count()
    });
    println!("one by one, with d2V/dx2:  {full:>12.0}");
    Ok(())
}

fn rate(count: usize, mut work: impl FnMut() -> usize) -> f64 {
    let mut best = f64::INFINITY;
    let before = processor_seconds();
    for _ in 0..REPEATS {
        let clock = Instant::now();
        std::hint::black_box(work());
        best = best.min(clock.elapsed().as_secs_f64());
    }
    let spent = processor_seconds().zip(before).map(|(after, before)| after - before);
    if let Some(spent) = spent.filter(|s| *s > 0.0) {
        let threads = rayon::current_num_threads() as f64;
        let free = (count * REPEATS) as f64 * threads / spent;
        println!("  by the processor time, {threads} cores to itself: {free:.0}");
    }
    count as f64 / best
}

/// Processor time of this process on all threads, where the system tells it (Linux, in ticks of 10 ms): on a machine that does
/// other work too the clock on the wall says little.
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
