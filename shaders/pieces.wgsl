// V in pieces at states, mirroring src/map/pieces/flat: the local solution about the equilibrium, and polynomials in cells,
// blended where these overlap (blend.wgsl). States are deviations from the reference point.
//
// What the arrays hold, and the constants that say where in them, are made in src/map/swift/packed.rs.
// Lines from `//if` to `//end` are kept where the condition holds; with SECOND second derivatives are told too.

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
    sheet: u32,
    // Pieces that were blended, and sheets over the state.
    pieces: u32,
    sheets: u32,
}

// What a piece says, in coordinates of the frame.
struct Told {
    known: bool,
    v: real,
    q: Place,
//if SECOND
    h: Triangle,
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
}

var<private> monomials: array<real, TERMS>;
// Loop iterations of this invocation so far, of which some devices allow only so many.
var<private> spent: u32;

// Fills the monomials (divided powers) that the table at `factors` makes of a place; their sum with coefficients from `first` on.
fn summed(first: u32, factors: u32, count: u32, place: Place) -> real {
    var y = place;
    var sum = reals[first];
    monomials[0] = 1.0;
    for (var t = 1u; t < count; t += 1u) {
        let factor = factors + 3u * t;
        monomials[t] = monomials[words[factor]] * (y[words[factor + 1u]] / real(words[factor + 2u]));
        sum += reals[first + t] * monomials[t];
    }
    spent += count;
    return sum;
}

// The polynomial of divided powers with coefficients from `first` on, and its derivatives.
fn polynomial(first: u32, degree: u32, place: Place) -> Polynomial {
    var sum: Polynomial;
    sum.v = summed(first, FACTORS, words[UPTO + degree], place);
    if (degree > 0u) {
        let terms = words[UPTO + degree - 1u];
        for (var t = 0u; t < terms; t += 1u) {
            for (var i = 0u; i < N; i += 1u) {
                sum.q[i] += reals[first + words[RAISED + t * N + i]] * monomials[t];
            }
        }
        spent += terms * (N + 1u);
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
    return sum;
}

//if BEND
struct Shear {
    phi: real,
    // By all coordinates; 0 by the sheared one.
    slope: Place,
//end
//if BEND SECOND
    curvature: Triangle,
//end
//if BEND
}

// phi of the coordinates but the sheared one, and its derivatives.
fn shear_at(place: Place) -> Shear {
    var z = place;
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
    shear.phi = summed(PHI, BEND_FACTORS, BEND_TERMS, y);
    for (var t = 0u; t < BEND_BELOW; t += 1u) {
        for (var i = 0u; i < N - 1u; i += 1u) {
            shear.slope[axes[i]] += reals[PHI + words[BEND_RAISED + t * (N - 1u) + i]] * monomials[t];
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
fn told(piece: u32, place: Place) -> Told {
    var z = place;
    var answer: Told;
    var y: Place;
    let box = PLACES + piece * 2u * N;
    for (var i = 0u; i < N; i += 1u) {
        y[i] = (z[i] - reals[box + i]) / reals[box + N + i];
    }
    let head = HEADS + 5u * piece;
    let support = words[head + 4u];
    if (support != EVERYWHERE) {
        var inside = true;
        for (var d = 0u; d < DIRECTIONS; d += 1u) {
            var at: real = 0.0;
            for (var i = 0u; i < N; i += 1u) {
                at += reals[DIRECTION + d * N + i] * y[i];
            }
            let extent = SUPPORTS + 2u * (support + d);
            inside = inside & (at >= reals[extent]) & (at <= reals[extent + 1u]);
        }
        if (!inside) {
            return answer;
        }
    }
    var sum = polynomial(COEFFICIENTS + words[head], words[head + 1u], y);
    // Derivatives of V by the function of it that is a polynomial.
    var slope: real = 1.0;
//if SECOND
    var bend: real = 0.0;
//end
    answer.v = sum.v;
    switch words[head + 2u] {
        case ROOT: {
            answer.v = sum.v * sum.v;
            slope = 2.0 * sum.v;
//if SECOND
            bend = 2.0;
//end
        }
        case LOGARITHM: {
            answer.v = exponential(sum.v);
            slope = answer.v;
//if SECOND
            bend = answer.v;
//end
        }
        case RECIPROCAL: {
            answer.v = 1.0 / sum.v;
            slope = -(answer.v * answer.v);
//if SECOND
            bend = 2.0 * answer.v * answer.v * answer.v;
//end
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
    }
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
    answer.known = is_finite(answer.v);
    return answer;
}
