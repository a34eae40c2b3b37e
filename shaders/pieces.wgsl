// V in pieces at states, mirroring src/map/pieces/flat: the local solution about the equilibrium,
// and polynomials in cells, blended where these overlap (blend.wgsl). States are deviations from
// the reference point.
//
// What the arrays hold, and the constants that say where in them, are made in
// src/map/swift/packed.rs. Lines from `//if` to `//end` are kept where the condition holds; with
// SECOND second derivatives are told too, with ROUNDED bounds include what rounding may do: to the
// first order in EPSILON, twice the unit roundoff. A sum of terms is off by at most EPSILON times
// the sizes of all its partial sums (N. J. Higham, Accuracy and Stability of Numerical Algorithms,
// 2002, 3.3) and a monomial of degree d by d divisions and products; what a place is off by counts
// by the sum of the slopes' terms.

@group(1) @binding(0) var<storage, read> reals: array<real>;
@group(1) @binding(1) var<storage, read> words: array<u32>;

alias Place = array<real, N>;
//if SECOND
// Second derivatives: the triangle `i <= j`, row by row.
alias Triangle = array<real, PAIRS>;
//end

// What is known of a state.
const UNKNOWN: u32 = 0u;
const IN_PIECES: u32 = 1u;
const NEAR: u32 = 2u;
// Outside the region of the pieces.
const ELSEWHERE: u32 = 3u;
// To be asked elsewhere: more loop iterations than an invocation may spend.
const TOO_MUCH: u32 = 4u;

struct Said {
    how: u32,
    v: real,
    v_bound: real,
    p: Place,
    p_bound: Place,
//if SECOND
    h: Triangle,
//end
//if ROUNDED
    v_lost: real,
    p_lost: Place,
//end
    sheet: u32,
    // Pieces that were blended, and sheets over the state.
    pieces: u32,
    sheets: u32,
}

// A place, and what rounding may have moved it by.
struct Spot {
    at: Place,
//if ROUNDED
    off: Place,
//end
}

// What a piece says, in coordinates of the frame.
struct Told {
    known: bool,
    v: real,
    q: Place,
//if SECOND
    h: Triangle,
//end
//if ROUNDED
    v_lost: real,
    q_lost: Place,
//end
    v_bound: real,
    p_bound: Place,
    sheet: u32,
}

struct Polynomial {
    v: real,
    q: Place,
//if SECOND
    h: Triangle,
//end
//if ROUNDED
    v_lost: real,
    q_lost: Place,
//end
}

var<private> monomials: array<real, TERMS>;
// Loop iterations of this invocation so far, of which some devices allow only so many.
var<private> spent: u32;

// Fills the monomials (divided powers) that the table at `factors` makes of a place.
fn fill(factors: u32, count: u32, place: Place) {
    var y = place;
    monomials[0] = 1.0;
    for (var t = 1u; t < count; t += 1u) {
        let factor = factors + 3u * t;
        monomials[t] = monomials[words[factor]] * (y[words[factor + 1u]] / real(words[factor + 2u]));
    }
    spent += count;
}

struct Sum {
    v: real,
//if ROUNDED
    // Of its partial sums, and of its terms.
    partial: real,
    size: real,
//end
}

// The monomials' sum with coefficients from `first` on: the higher, smaller ones first.
fn summed(first: u32, count: u32) -> Sum {
    var sum: Sum;
    for (var left = count; left > 0u; left -= 1u) {
        let term = reals[first + left - 1u] * monomials[left - 1u];
        sum.v += term;
//if ROUNDED
        sum.partial += abs(sum.v);
        sum.size += abs(term);
//end
    }
    spent += count;
    return sum;
}

// The polynomial of divided powers with coefficients from `first` on, and its derivatives.
fn polynomial(first: u32, degree: u32, place: Spot) -> Polynomial {
    var sum: Polynomial;
    let count = words[UPTO + degree];
    fill(FACTORS, count, place.at);
    let value = summed(first, count);
    sum.v = value.v;
//if ROUNDED
    var off = place.off;
    let powers = 2.0 * real(degree) + 2.0;
    sum.v_lost = EPSILON * (value.partial + powers * value.size);
//end
    if (degree > 0u) {
//if ROUNDED
        var sizes: Place;
//end
        let terms = words[UPTO + degree - 1u];
        for (var t = terms; t > 0u; t -= 1u) {
            for (var i = 0u; i < N; i += 1u) {
                let term = reals[first + words[RAISED + (t - 1u) * N + i]] * monomials[t - 1u];
                sum.q[i] += term;
//if ROUNDED
                sum.q_lost[i] += EPSILON * abs(sum.q[i]);
                sizes[i] += abs(term);
//end
            }
        }
        spent += terms * (N + 1u);
//if ROUNDED
        for (var i = 0u; i < N; i += 1u) {
            sum.q_lost[i] += EPSILON * powers * sizes[i];
            sum.v_lost += sizes[i] * off[i];
        }
//end
    }
//if SECOND
    if (degree > 1u) {
        let terms = words[UPTO + degree - 2u];
        for (var t = 0u; t < terms; t += 1u) {
            for (var pair = 0u; pair < PAIRS; pair += 1u) {
                sum.h[pair] += reals[first + words[RAISED_TWICE + t * PAIRS + pair]] * monomials[t];
            }
        }
        spent += terms * (PAIRS + 1u);
    }
//end
//if ROUNDED
    // What the place is off by, times the terms of the slopes' slopes.
    if (degree > 1u) {
        let terms = words[UPTO + degree - 2u];
        for (var t = 0u; t < terms; t += 1u) {
            var pair = 0u;
            for (var i = 0u; i < N; i += 1u) {
                for (var j = i; j < N; j += 1u) {
                    let size = abs(reals[first + words[RAISED_TWICE + t * PAIRS + pair]] * monomials[t]);
                    sum.q_lost[i] += size * off[j];
                    sum.q_lost[j] += select(size * off[i], real(0.0), i == j);
                    pair += 1u;
                }
            }
        }
        spent += terms * (PAIRS + N + 1u);
    }
//end
    return sum;
}

//if BEND ROUNDED
// As of the polynomials of pieces; phi is of the third degree.
const BEND_POWERS: real = 8.0;
//end
//if BEND
struct Shear {
    phi: real,
    // By all coordinates; 0 by the sheared one.
    slope: Place,
//end
//if BEND SECOND
    curvature: Triangle,
//end
//if BEND ROUNDED
    // What rounding may do to phi and to its slopes, and the sizes of the slopes' terms.
    lost: real,
    slope_lost: Place,
    slope_size: Place,
//end
//if BEND
}

// phi of the coordinates but the sheared one, and its derivatives.
fn shear_at(place: Spot) -> Shear {
    var z = place.at;
    var y: Place;
    var axes: array<u32, N>;
    var k = 0u;
    for (var i = 0u; i < N; i += 1u) {
        if (i != BEND_AXIS) {
            y[k] = z[i];
            axes[k] = i;
            k += 1u;
        }
    }
    var shear: Shear;
    fill(BEND_FACTORS, BEND_TERMS, y);
    let sum = summed(PHI, BEND_TERMS);
    shear.phi = sum.v;
    for (var t = 0u; t < BEND_BELOW; t += 1u) {
        for (var i = 0u; i < N - 1u; i += 1u) {
            let term = reals[PHI + words[BEND_RAISED + t * (N - 1u) + i]] * monomials[t];
            shear.slope[axes[i]] += term;
//end
//if BEND ROUNDED
            shear.slope_size[axes[i]] += abs(term);
            shear.slope_lost[axes[i]] += EPSILON * (abs(shear.slope[axes[i]]) + BEND_POWERS * abs(term));
//end
//if BEND
        }
    }
    spent += BEND_BELOW * N;
//end
//if BEND SECOND
    for (var t = 0u; t < BEND_TWICE_BELOW; t += 1u) {
        var own = t * ((N - 1u) * N / 2u);
        for (var i = 0u; i < N - 1u; i += 1u) {
            for (var j = i; j < N - 1u; j += 1u) {
                shear.curvature[pair_of(axes[i], axes[j])] += reals[PHI + words[BEND_RAISED_TWICE + own]] * monomials[t];
                own += 1u;
            }
        }
    }
    spent += BEND_TWICE_BELOW * PAIRS;
//end
//if BEND ROUNDED
    var off = place.off;
    shear.lost = EPSILON * (sum.partial + BEND_POWERS * sum.size);
    for (var i = 0u; i < N - 1u; i += 1u) {
        shear.lost += shear.slope_size[axes[i]] * off[axes[i]];
    }
    for (var t = 0u; t < BEND_TWICE_BELOW; t += 1u) {
        var own = t * ((N - 1u) * N / 2u);
        for (var i = 0u; i < N - 1u; i += 1u) {
            for (var j = i; j < N - 1u; j += 1u) {
                let size = abs(reals[PHI + words[BEND_RAISED_TWICE + own]] * monomials[t]);
                shear.slope_lost[axes[i]] += size * off[axes[j]];
                shear.slope_lost[axes[j]] += select(size * off[axes[i]], real(0.0), i == j);
                own += 1u;
            }
        }
    }
//end
//if BEND
    return shear;
}
//end

//if SECOND
// Where in a triangle an entry is.
fn pair_of(a: u32, b: u32) -> u32 {
    let i = min(a, b);
    let j = max(a, b);
    return i * (2u * N - i - 1u) / 2u + j;
}
//end

// What a piece says at a place; not known outside its points.
fn told(piece: u32, place: Spot) -> Told {
    var z = place.at;
    var answer: Told;
    var y: Place;
    var own: Spot;
    let box = PLACES + piece * 2u * N;
    for (var i = 0u; i < N; i += 1u) {
        y[i] = (z[i] - reals[box + i]) / reals[box + N + i];
    }
    own.at = y;
//if ROUNDED
    var off = place.off;
    for (var i = 0u; i < N; i += 1u) {
        own.off[i] = (off[i] + EPSILON * abs(reals[box + i])) / reals[box + N + i] + 2.0 * EPSILON * abs(y[i]);
    }
//end
    let head = HEADS + 5u * piece;
    let support = words[head + 4u];
    if (support != EVERYWHERE) {
        var inside = true;
        for (var d = 0u; d < DIRECTIONS; d += 1u) {
            var at: real = 0.0;
            for (var i = 0u; i < N; i += 1u) {
                at += reals[DIRECTION + d * N + i] * y[i];
            }
            let extent = SUPPORTS + support + 2u * d;
            inside = inside & (at >= reals[extent]) & (at <= reals[extent + 1u]);
        }
        if (MARGINS > 0u) {
            // The polynomial of the guards' margins along trajectories.
            let own = SUPPORTS + support + 2u * DIRECTIONS;
            var margin = reals[own];
            var square = own + N;
            for (var i = 0u; i < N; i += 1u) {
                var slope = reals[own + 1u + i];
                for (var j = i; j < N; j += 1u) {
                    square += 1u;
                    slope += reals[square] * y[j];
                }
                margin += y[i] * slope;
            }
            inside = inside & (margin >= 0.0);
        }
        if (!inside) {
            return answer;
        }
    }
    var sum = polynomial(COEFFICIENTS + words[head], words[head + 1u], own);
    // Derivatives of V by the function of it that is a polynomial.
    var slope: real = 1.0;
    var bend: real = 0.0;
    // A polynomial that crosses 0 comes to a branch of the function on which no V lies.
    var on_branch = true;
    answer.v = sum.v;
    switch words[head + 2u] {
        case ROOT: {
            on_branch = sum.v >= 0.0;
            answer.v = sum.v * sum.v;
            slope = 2.0 * sum.v;
            bend = 2.0;
        }
        case LOGARITHM: {
            answer.v = exponential(sum.v);
            slope = answer.v;
            bend = answer.v;
        }
        case RECIPROCAL: {
            on_branch = sum.v > 0.0;
            answer.v = 1.0 / sum.v;
            slope = -(answer.v * answer.v);
            bend = 2.0 * answer.v * answer.v * answer.v;
        }
        default: {}
    }
    let size = max(abs(answer.v), LEAST_SIZE);
    answer.v_bound = reals[BOUNDS + 2u * piece] * size;
    let p_bound = reals[BOUNDS + 2u * piece + 1u] * size;
    for (var i = 0u; i < N; i += 1u) {
        let half = reals[box + N + i];
        answer.q[i] = sum.q[i] * (slope / half);
        answer.p_bound[i] = p_bound / half;
//if ROUNDED
        let lost = abs(slope) * sum.q_lost[i] + abs(bend * sum.q[i]) * sum.v_lost;
        answer.q_lost[i] = lost / half + 4.0 * EPSILON * abs(answer.q[i]);
//end
    }
//if ROUNDED
    // The argument of the exponential is reduced with a rounding of its size.
    answer.v_lost = (abs(slope) + 0.5 * abs(bend) * sum.v_lost) * sum.v_lost + 2.0 * EPSILON * (1.0 + abs(sum.v)) * abs(answer.v);
//end
//if SECOND
    var pair = 0u;
    for (var i = 0u; i < N; i += 1u) {
        for (var j = i; j < N; j += 1u) {
            let bent = bend * sum.q[i] * sum.q[j];
            answer.h[pair] = (slope * sum.h[pair] + bent) / (reals[box + N + i] * reals[box + N + j]);
            pair += 1u;
        }
    }
//end
    answer.sheet = words[head + 3u];
    answer.known = on_branch & is_finite(answer.v);
    return answer;
}
