//! Flat arrays against [`Pieces::at`].

use super::terms::Terms;
use super::{
    Bend, Cell, Desk, Flat, Frame, Here, Node, Piece, Pieces, Region, Shape, highest_degree,
};

/// A number in [0, 1) from a counter (splitmix64).
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 * (-53f64).exp2()
    }
}

/// Cells of all sizes with polynomials of all shapes and degrees, all of V near 2, or near 3 on a
/// second sheet; some hold only near their points, and some of V is above the largest value wanted.
fn some_pieces(n: usize, turned: bool, random: &mut Random) -> Pieces {
    let region = Region {
        lo: (0..n).map(|i| -1.0 - i as f64).collect(),
        hi: (0..n).map(|i| 0.5 + 0.3 * i as f64).collect(),
        error: 1e-3,
        equal_cost: f64::INFINITY,
        floor: 1e-3,
        value_max: 3.1,
        beyond: 0.25,
        game: false,
    };
    let direction: Vec<f64> = (0..n).map(|i| 1.0 - 0.4 * i as f64).collect();
    let frame = if turned {
        let straight = Frame::steep(&region, &direction);
        // Within -0.1 to 0.1, so that the region lies within 0 to 1.
        let count = if n > 1 { Bend::count(n) } else { 0 };
        let phi = (0..count)
            .map(|k| 0.1 / count as f64 * (1.7 * k as f64).sin())
            .collect();
        let bend = Bend::new(n, n / 2, -0.1, 1.2, phi);
        Frame { bend, ..straight }
    } else {
        Frame::along(&region)
    };
    let (mut nodes, mut cells, mut pieces) = (Vec::new(), Vec::new(), Vec::new());
    let terms = Terms::new(n, highest_degree(n));
    let mut boxes = vec![(vec![0.0; n], vec![1.0; n], 0usize)];
    nodes.push(Node::Cell(0));
    let mut places = vec![0usize];
    while let (Some((lo, hi, depth)), Some(place)) = (boxes.pop(), places.pop()) {
        if depth < 3 || depth < 7 && random.next() < 0.6 {
            let axis = ((random.next() * n as f64) as usize).min(n - 1);
            let at = 0.5 * (lo[axis] + hi[axis]);
            let (below, above) = (nodes.len(), nodes.len() + 1);
            nodes.extend([Node::Cell(0), Node::Cell(0)]);
            nodes[place] = Node::Split {
                axis,
                at,
                below,
                above,
                reach: [0.0; 2],
            };
            let (mut left, mut right) = (hi.clone(), lo.clone());
            (left[axis], right[axis]) = (at, at);
            boxes.extend([(lo, left, depth + 1), (right, hi, depth + 1)]);
            places.extend([below, above]);
            continue;
        }
        nodes[place] = Node::Cell(cells.len());
        let first = pieces.len();
        let count = [0, 1, 1, 1, 1, 1, 2, 2][(random.next() * 8.0) as usize];
        for sheet in 0..count {
            let shape = Shape::ALL[(random.next() * 4.0) as usize].0;
            let degree = (random.next() * (highest_degree(n) + 1) as f64) as usize;
            let (w, slope) = shape.of(2.0 + f64::from(sheet));
            let coefficients: Vec<f64> = (0..terms.upto[degree])
                .map(|t| {
                    if t == 0 {
                        w
                    } else {
                        0.1 * slope * (random.next() - 0.5)
                    }
                })
                .collect();
            let enclosed = random.next() < 0.3;
            pieces.push(Piece {
                center: lo.iter().zip(&hi).map(|(a, b)| 0.5 * (a + b)).collect(),
                half: lo.iter().zip(&hi).map(|(a, b)| 0.55 * (b - a)).collect(),
                shape,
                coefficients,
                bound: 0.1 * random.next(),
                p_bound: random.next(),
                sheet,
                support: match enclosed {
                    true => (super::directions(n).iter())
                        .map(|_| [-0.9, 0.8 + 0.4 * random.next()])
                        .collect(),
                    false => Vec::new(),
                },
                // Without a draw of its own: others would be drawn.
                clearance: match enclosed && sheet == 0 && depth % 2 == 0 {
                    true => (0..super::margin_terms(n))
                        .map(|t| {
                            if t == 0 {
                                0.9
                            } else {
                                (1.7 * (t * n) as f64).sin()
                            }
                        })
                        .collect(),
                    false => Vec::new(),
                },
            });
        }
        cells.push(Cell {
            lo,
            hi,
            pieces: first..pieces.len(),
        });
    }
    Pieces::new(region, frame, nodes, cells, pieces)
        .expect("the numbers of coefficients are those of degrees")
}

fn states(pieces: &Pieces, count: usize, random: &mut Random) -> Vec<f64> {
    let region = &pieces.region;
    let n = pieces.states();
    // Some lie outside.
    (0..count * n)
        .map(|k| region.lo[k % n] + region.width(k % n) * (1.02 * random.next() - 0.01))
        .collect()
}

/// d2V/dx2 by differences of p: rounding is 1e-9 of p, and the narrowest overlap 1e4 times as wide.
fn differences(pieces: &Pieces, x: &[f64]) -> Vec<f64> {
    let n = x.len();
    let mut hessian = vec![f64::NAN; n * n];
    for j in 0..n {
        let step = 1e-7 * pieces.region.width(j);
        let at = |sign: f64| {
            let mut x = x.to_vec();
            x[j] += sign * step;
            pieces.at(&x)
        };
        if let (Some(a), Some(b)) = (at(-1.0), at(1.0)) {
            (0..n).for_each(|i| hessian[i * n + j] = (b.p[i] - a.p[i]) / (2.0 * step));
        }
    }
    hessian
}

fn all<T: crate::backend::cpu::real::Real>(
    flat: &Flat<T>,
    x: &[T],
    second: bool,
) -> Vec<Option<Here<T>>> {
    let mut said = Vec::new();
    flat.each::<false>(x, second, &mut Desk::new(), |k, here| {
        assert_eq!(k, said.len());
        said.push(here.copied());
    });
    said
}

/// The same sums in another order: a few ulp of the largest term, which is about V (or p times what
/// the frame turns and scales it by).
const ROUNDING: f64 = 1e-12;

#[test]
fn flat_arrays_say_the_same() {
    let mut random = Random(1);
    for n in 1..=6 {
        for turned in [false, true] {
            let pieces = some_pieces(n, turned, &mut random);
            let flat = Flat::<f64>::new(&pieces);
            let x = states(&pieces, 4001, &mut random);
            let said = all(&flat, &x, true);
            let (mut known, mut blended, mut several, mut unlike) = (0, 0, 0, 0);
            for (x, here) in x.chunks(n).zip(&said) {
                let wanted = pieces.at(x);
                assert_eq!(wanted.is_some(), here.is_some(), "{n} {x:?}");
                let (Some(wanted), Some(here)) = (wanted, here) else {
                    continue;
                };
                known += 1;
                blended += usize::from(wanted.pieces > 1);
                several += usize::from(here.sheets > 1);
                assert_eq!(here.sheets as usize, pieces.sheets(x).len());
                assert_eq!(
                    (here.sheet, here.pieces as usize),
                    (wanted.sheet, wanted.pieces)
                );
                let largest = |p: &[f64]| p.iter().fold(1.0f64, |a, p| a.max(p.abs()));
                assert!((here.v - wanted.v).abs() <= ROUNDING * wanted.v.abs());
                assert!((here.v_bound - wanted.v_bound).abs() <= ROUNDING * wanted.v_bound);
                let size = largest(&wanted.p);
                for i in 0..n {
                    assert!(
                        (here.p[i] - wanted.p[i]).abs() <= 10.0 * ROUNDING * size,
                        "{n} {x:?}"
                    );
                    assert!(
                        (here.p_bound[i] - wanted.p_bound[i]).abs() <= ROUNDING * wanted.p_bound[i]
                    );
                }
                // Not where another cell begins or ends in between.
                let hessian = differences(&pieces, x);
                let size = largest(&hessian);
                unlike += usize::from((0..n * n).any(|k| {
                    let off = (here.hessian[k] - hessian[k]).abs();
                    off.is_nan() || off > 1e-4 * size
                }));
            }
            assert!(
                known > 1000 && blended > 200 && several > 20,
                "{known} {blended} {several}"
            );
            assert!(unlike * 50 < known, "{unlike} of {known}");
        }
    }
}

#[test]
fn states_do_not_depend_on_their_company() {
    let mut random = Random(2);
    for n in [2, 4] {
        let pieces = some_pieces(n, true, &mut random);
        let flat = Flat::<f64>::new(&pieces);
        let x = states(&pieces, 345, &mut random);
        let together = all(&flat, &x, true);
        for (k, x) in x.chunks(n).enumerate() {
            let alone = all(&flat, x, true);
            let bits = |here: &Here<f64>| {
                let hessian = &here.hessian[..n * n];
                (here.p[..n]
                    .iter()
                    .chain(hessian)
                    .chain([&here.v, &here.v_bound]))
                .map(|v| v.to_bits())
                .collect::<Vec<_>>()
            };
            assert_eq!(alone[0].as_ref().map(bits), together[k].as_ref().map(bits));
        }
    }
}

/// As a device would have them.
#[test]
fn single_precision_is_as_good_as_it_can_be() {
    let mut random = Random(3);
    let n = 4;
    let pieces = some_pieces(n, true, &mut random);
    let flat = Flat::<f32>::new(&pieces);
    let x = states(&pieces, 4000, &mut random);
    let rounded: Vec<f32> = x.iter().map(|x| *x as f32).collect();
    let (mut known, mut unlike) = (0, 0);
    for (x, here) in x.chunks(n).zip(all(&flat, &rounded, false)) {
        let (Some(wanted), Some(here)) = (pieces.at(x), here) else {
            continue;
        };
        known += 1;
        // Rounded by 6e-8, a state moves by up to a hundred times that in the narrowest cells, over
        // each of which V changes by about 1.
        let off = (f64::from(here.v) - wanted.v).abs();
        unlike += usize::from(off > 1e-4 * wanted.v);
    }
    // Beside an edge another piece may be asked.
    assert!(known > 2000 && unlike * 500 < known, "{unlike} of {known}");
}
