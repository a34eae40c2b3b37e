//! Block elimination on the device against the host's, which is the reference.

use crate::common;

use common::any_gpu;
use costate::backend::{Backend, Eliminated, Systems};
use costate::low_level::model::Precision;
use costate::low_level::shooting::{Factors, Start};

/// A small generator (Steele, Lea, Flood 2014: splitmix64), uniform in [-1, 1).
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    fn list(&mut self, count: usize, size: f64) -> Vec<f64> {
        (0..count).map(|_| size * self.next()).collect()
    }
}

/// Systems like those of a regulated plant: each propagator is the identity with small random
/// entries, the end's matrix definite.
fn systems(n: usize, segments: &[u32]) -> Systems {
    let mut random = Random(n as u64);
    let m = 2 * n;
    let mut systems = Systems {
        states: n,
        segments: segments.to_vec(),
        ..Systems::default()
    };
    for count in segments {
        for _ in 0..*count {
            let mut phi = random.list(m * m, 0.3 / n as f64);
            for i in 0..m {
                phi[i * m + i] += 1.0;
            }
            systems.phi.extend(phi);
            systems.defects.extend(random.list(m, 1.0));
        }
        systems.end.extend(random.list(n, 1.0));
        let mut hessian = random.list(n * n, 0.3 / n as f64);
        for i in 0..n {
            hessian[i * n + i] += 1.0;
        }
        systems.hessian.extend(hessian);
        systems.wanted.extend(random.list(n, 1.0));
    }
    systems
}

/// Paths of different lengths, some of them only an end; longer ones than a dispatch takes among
/// them.
fn lengths(count: usize) -> Vec<u32> {
    (0..count).map(|i| [3, 0, 17, 1, 8, 40, 2][i % 7]).collect()
}

fn host(systems: &Systems) -> Eliminated {
    let n = systems.states;
    let m = 2 * n;
    let mut done = Eliminated::default();
    let mut first = 0;
    for (i, count) in systems.segments.iter().enumerate() {
        let range = first..first + *count as usize;
        first = range.end;
        let phi = systems.phi[range.start * m * m..range.end * m * m].to_vec();
        let factors = Factors::new(n, phi, &systems.hessian[i * n * n..][..n * n]);
        let (w, l) = factors.parts();
        done.w.extend_from_slice(w);
        done.l.extend_from_slice(l);
        let wanted = &systems.wanted[i * n..][..n];
        let defects = &systems.defects[range.start * m..range.end * m];
        let steps = factors.solve(defects, &systems.end[i * n..][..n], &Start::Step(wanted));
        done.steps
            .extend(steps.unwrap_or_else(|| vec![f64::NAN; (range.len() + 1) * m]));
    }
    done
}

fn device(systems: &Systems, precision: Precision) -> Eliminated {
    any_gpu()
        .eliminator(systems.states, precision)
        .unwrap()
        .expect("the device eliminates")
        .eliminate(systems)
        .unwrap()
}

/// Largest difference of any list relative to its largest entry; infinite where something is not a
/// number.
fn difference(a: &Eliminated, b: &Eliminated) -> f64 {
    let lists = [(&a.w, &b.w), (&a.l, &b.l), (&a.steps, &b.steps)];
    lists
        .into_iter()
        .map(|(a, b)| {
            assert_eq!(a.len(), b.len());
            let size = a.iter().fold(0.0f64, |most, x| most.max(x.abs()));
            (a.iter().zip(b))
                .map(|(a, b)| (a - b).abs() / size)
                .fold(0.0, |most, d| {
                    if d.is_nan() {
                        f64::INFINITY
                    } else {
                        d.max(most)
                    }
                })
        })
        .fold(0.0, f64::max)
}

/// Rounding of some 40 segments, amplified by the first node's equations, whose condition random
/// systems have in the hundreds.
fn allowed(precision: Precision) -> f64 {
    const AMPLIFICATION: f64 = 1000.0;
    AMPLIFICATION * precision.epsilon()
}

const PRECISIONS: [Precision; 2] = [Precision::F32, Precision::F64];

#[test]
fn device_agrees_with_host() {
    for n in [1, 2, 3, 4, 6, 8] {
        let systems = systems(n, &lengths(65));
        let reference = host(&systems);
        for precision in PRECISIONS {
            let found = device(&systems, precision);
            let worst = difference(&reference, &found);
            println!(
                "n = {n} {precision:?}: {worst:.2e}, allowed {:.2e}",
                allowed(precision)
            );
            assert!(
                worst <= allowed(precision),
                "n = {n} {precision:?}: {worst:e}"
            );
            assert_ne!(reference, found, "the host was compared with itself");
        }
    }
}

#[test]
fn comparator_catches_a_perturbation() {
    let systems = systems(2, &lengths(7));
    let reference = host(&systems);
    let limit = allowed(Precision::F64);
    assert_eq!(difference(&reference, &reference), 0.0);
    let change = |f: &dyn Fn(&mut Eliminated)| {
        let mut other = reference.clone();
        f(&mut other);
        difference(&reference, &other)
    };
    let off = 1e-9;
    assert!(change(&|e| *e.w.last_mut().unwrap() += off) > limit);
    assert!(change(&|e| e.l[0] += off) > limit);
    assert!(
        change(&|e| e.steps[5] -= 1e-9 * reference.steps.iter().fold(0.0f64, |a, x| a.max(x.abs())))
            > limit
    );
    assert!(change(&|e| e.steps[5] = f64::NAN) > limit);
}

/// The linear equations themselves hold, whatever the host says.
#[test]
fn equations_are_solved() {
    let n = 3;
    let m = 2 * n;
    let systems = systems(n, &lengths(14));
    let found = device(&systems, Precision::F64);
    let (mut segment, mut node) = (0, 0);
    for (i, count) in systems.segments.iter().enumerate() {
        let nodes: Vec<&[f64]> = found.steps[node * m..]
            .chunks(m)
            .take(*count as usize + 1)
            .collect();
        let size = nodes.concat().iter().fold(0.0f64, |a, x| a.max(x.abs()));
        let near = |a: f64, b: f64| {
            assert!(
                (a - b).abs() <= allowed(Precision::F64) * size,
                "path {i}: {a} {b}"
            )
        };
        for j in 0..n {
            near(nodes[0][j], systems.wanted[i * n + j]);
            let last = nodes[nodes.len() - 1];
            let slope: f64 = (0..n)
                .map(|q| systems.hessian[i * n * n + j * n + q] * last[q])
                .sum();
            near(last[n + j] - slope, systems.end[i * n + j]);
        }
        for pair in nodes.windows(2) {
            let phi = &systems.phi[segment * m * m..][..m * m];
            for r in 0..m {
                let carried: f64 = (0..m).map(|j| phi[r * m + j] * pair[0][j]).sum();
                near(pair[1][r], carried + systems.defects[segment * m + r]);
            }
            segment += 1;
        }
        node += nodes.len();
    }
}

/// A part of a batch's paths.
fn part(systems: &Systems, from: usize, to: usize) -> (Systems, std::ops::Range<usize>) {
    let n = systems.states;
    let m = 2 * n;
    let before: usize = systems.segments[..from].iter().map(|s| *s as usize).sum();
    let inside: usize = systems.segments[from..to].iter().map(|s| *s as usize).sum();
    let of = |list: &[f64], first: usize, last: usize, each: usize| {
        list[first * each..last * each].to_vec()
    };
    let part = Systems {
        states: n,
        segments: systems.segments[from..to].to_vec(),
        phi: of(&systems.phi, before, before + inside, m * m),
        defects: of(&systems.defects, before, before + inside, m),
        end: of(&systems.end, from, to, n),
        hessian: of(&systems.hessian, from, to, n * n),
        wanted: of(&systems.wanted, from, to, n),
    };
    (part, before + from..before + inside + to)
}

#[test]
fn results_do_not_depend_on_the_batch() {
    let n = 3;
    let systems = systems(n, &lengths(65));
    for precision in PRECISIONS {
        let whole = device(&systems, precision);
        let mut eliminator = any_gpu().eliminator(n, precision).unwrap().unwrap();
        for (from, to) in [(0, 1), (64, 65), (1, 2), (0, 63), (2, 65), (0, 65)] {
            let (part, nodes) = part(&systems, from, to);
            let found = eliminator.eliminate(&part).unwrap();
            let same = |a: &[f64], b: &[f64], each: usize| {
                let bits = |list: &[f64]| list.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
                bits(a) == bits(&b[nodes.start * each..nodes.end * each])
            };
            let case = format!("{precision:?} {from}..{to}");
            assert!(same(&found.w, &whole.w, 2 * n * n), "{case}: W");
            assert!(same(&found.l, &whole.l, n * n), "{case}: L");
            assert!(same(&found.steps, &whole.steps, 2 * n), "{case}: steps");
        }
    }
}

#[test]
fn a_singular_path_leaves_the_others_alone() {
    let n = 2;
    let m = 2 * n;
    let regular = systems(n, &[2, 3, 0]);
    let mut systems = regular.clone();
    // The second path's first propagator ignores p, so that no p of the first node meets the end's
    // condition.
    for r in 0..m {
        systems.phi[2 * m * m + r * m + n..][..n].fill(0.0);
    }
    for precision in PRECISIONS {
        let found = device(&systems, precision);
        let paths = [0..3 * m, 3 * m..7 * m, 7 * m..8 * m];
        let finite = paths.map(|range| found.steps[range].iter().all(|x| x.is_finite()));
        assert_eq!(finite, [true, false, true], "{precision:?}");
    }
}

#[test]
fn an_empty_batch_is_empty() {
    let systems = systems(2, &[]);
    assert_eq!(device(&systems, Precision::F32), Eliminated::default());
}
