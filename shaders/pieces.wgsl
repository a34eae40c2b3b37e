// V in pieces at states, mirroring src/map/swift.rs and src/map/pieces/flat: the local solution about the equilibrium, and
// polynomials in cells, blended where these overlap. States are deviations from the reference point.
//
// What the arrays hold, and the constants that say where in them, are made in src/map/swift/packed.rs.
// Lines from `//if` to `//end` are kept where the condition holds.

@group(0) @binding(0) var<storage, read> reals: array<real>;
@group(0) @binding(1) var<storage, read> words: array<u32>;

alias Vector = array<real, N>;

// What is known of a state.
const UNKNOWN: u32 = 0u;
const IN_PIECES: u32 = 1u;
const NEAR: u32 = 2u;
// Outside the region of the pieces.
const ELSEWHERE: u32 = 3u;

struct Said {
    how: u32,
    v: real,
    v_bound: real,
    p: Vector,
    p_bound: Vector,
    sheet: u32,
    // Pieces that were blended, and sheets over the state.
    pieces: u32,
    sheets: u32,
}

// What a piece says, in coordinates of the frame.
struct Told {
    known: bool,
    v: real,
    q: Vector,
    v_bound: real,
    p_bound: Vector,
    sheet: u32,
}

struct Polynomial {
    v: real,
    q: Vector,
}

var<private> monomials: array<real, TERMS>;

// The polynomial of divided powers with coefficients from `first` on, and its gradient.
fn polynomial(first: u32, degree: u32, place: Vector) -> Polynomial {
    var y = place;
    var sum: Polynomial;
    let count = words[UPTO + degree];
    monomials[0] = 1.0;
    sum.v = reals[first];
    for (var t = 1u; t < count; t += 1u) {
        let factor = FACTORS + 3u * t;
        monomials[t] = monomials[words[factor]] * (y[words[factor + 1u]] / real(words[factor + 2u]));
        sum.v += reals[first + t] * monomials[t];
    }
    if (degree > 0u) {
        let terms = words[UPTO + degree - 1u];
        for (var t = 0u; t < terms; t += 1u) {
            for (var i = 0u; i < N; i += 1u) {
                sum.q[i] += reals[first + words[FIRST + t * N + i]] * monomials[t];
            }
        }
    }
    return sum;
}

//if BEND
struct Shear {
    phi: real,
    // By all coordinates; 0 by the sheared one.
    slope: Vector,
}

// phi of the coordinates but the sheared one, and its gradient.
fn shear_at(place: Vector) -> Shear {
    var z = place;
    var y: Vector;
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
    monomials[0] = 1.0;
    shear.phi = reals[PHI];
    for (var t = 1u; t < BEND_TERMS; t += 1u) {
        let factor = BEND_FACTORS + 3u * t;
        monomials[t] = monomials[words[factor]] * (y[words[factor + 1u]] / real(words[factor + 2u]));
        shear.phi += reals[PHI + t] * monomials[t];
    }
    for (var t = 0u; t < BEND_BELOW; t += 1u) {
        for (var i = 0u; i < N - 1u; i += 1u) {
            shear.slope[axes[i]] += reals[PHI + words[BEND_FIRST + t * (N - 1u) + i]] * monomials[t];
        }
    }
    return shear;
}
//end

// What a piece says at a place; not known outside its points.
fn told(piece: u32, place: Vector) -> Told {
    var z = place;
    var answer: Told;
    var y: Vector;
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
    var slope: real = 1.0;
    answer.v = sum.v;
    switch words[head + 2u] {
        case ROOT: {
            answer.v = sum.v * sum.v;
            slope = 2.0 * sum.v;
        }
        case LOGARITHM: {
            answer.v = exponential(sum.v);
            slope = answer.v;
        }
        case RECIPROCAL: {
            answer.v = 1.0 / sum.v;
            slope = -(answer.v * answer.v);
        }
        default: {}
    }
    let size = max(abs(answer.v), FLOOR);
    answer.v_bound = reals[BOUNDS + 2u * piece] * size;
    let p_bound = reals[BOUNDS + 2u * piece + 1u] * size;
    for (var i = 0u; i < N; i += 1u) {
        let half = reals[box + N + i];
        answer.q[i] = sum.q[i] * (slope / half);
        answer.p_bound[i] = p_bound / half;
    }
    answer.sheet = words[head + 3u];
    answer.known = is_finite(answer.v);
    return answer;
}

struct Weight {
    positive: bool,
    w: real,
    dw: Vector,
}

// The weight of a cell at a place, with its gradient.
fn weight(cell: u32, place: Vector) -> Weight {
    var z = place;
    var share: Weight;
    var f: Vector;
    var d: Vector;
    let box = CELLS + cell * 2u * N;
    share.positive = true;
    share.w = 1.0;
    for (var i = 0u; i < N; i += 1u) {
        let half = reals[box + N + i];
        let offset = (z[i] - reals[box + i]) / half;
        let t = (abs(offset) - EDGE) / OVERLAP;
        f[i] = 1.0;
        if (t >= 1.0) {
            share.positive = false;
        } else if (t > 0.0) {
            let rest = 1.0 - t;
            let scale = OVERLAP * half;
            f[i] = 1.0 - t * t * t * (10.0 - 15.0 * t + 6.0 * t * t);
            d[i] = -30.0 * t * t * rest * rest * select(real(1.0), real(-1.0), offset < 0.0) / scale;
        }
        share.w *= f[i];
    }
    for (var i = 0u; i < N; i += 1u) {
        var product = d[i];
        for (var k = 0u; k < N; k += 1u) {
            if (k != i) {
                product *= f[k];
            }
        }
        share.dw[i] = product;
    }
    return share;
}

// The lowest sheet's blend at a place of the frame, in its coordinates.
fn blended(place: Vector) -> Said {
    var z = place;
    var said: Said;
    var node = 0u;
    loop {
        let axis = words[NODES + 3u * node];
        if (axis >= N) {
            break;
        }
        node = words[NODES + 3u * node + select(2u, 1u, z[axis] < reals[SPLITS + 3u * node])];
    }
    let own = words[NODES + 3u * node + 1u];
    if (!weight(own, z).positive) {
        return said;
    }
    var first: Told;
    for (var piece = words[OWNED + own]; piece < words[OWNED + own + 1u]; piece += 1u) {
        let here = told(piece, z);
        if (here.known & (here.v <= VALUE_MAX)) {
            said.sheets += 1u;
            if (!first.known | (here.v < first.v)) {
                first = here;
            }
        }
    }
    if (!first.known) {
        return said;
    }
    said.how = IN_PIECES;
    said.sheet = first.sheet;
    said.v_bound = first.v_bound;
    said.p_bound = first.p_bound;
    // Sums of weights, and of weights times what a piece says more than the first one: the differences are small.
    var total: real = 0.0;
    var more: real = 0.0;
    var total_slope: Vector;
    var more_slope: Vector;
    var stack: array<u32, DEPTH>;
    var height = 1u;
    while (height > 0u) {
        height -= 1u;
        let at = stack[height];
        let axis = words[NODES + 3u * at];
        if (axis < N) {
            // The one below is looked at first.
            if (z[axis] > reals[SPLITS + 3u * at + 1u]) {
                stack[height] = words[NODES + 3u * at + 2u];
                height += 1u;
            }
            if (z[axis] < reals[SPLITS + 3u * at + 2u]) {
                stack[height] = words[NODES + 3u * at + 1u];
                height += 1u;
            }
            continue;
        }
        let cell = words[NODES + 3u * at + 1u];
        var share = weight(cell, z);
        if (!share.positive) {
            continue;
        }
        var best = first;
        if (cell != own) {
            best.known = false;
            let begin = words[OWNED + cell];
            let end = words[OWNED + cell + 1u];
            for (var piece = begin; piece < end; piece += 1u) {
                let here = told(piece, z);
                if (here.known & (!best.known | (abs(here.v - first.v) < abs(best.v - first.v)))) {
                    best = here;
                }
            }
            // The piece of the same sheet, if the neighbour has one.
            let alone = (said.sheets == 1u) & (end == begin + 1u);
            let same = abs(best.v - first.v) <= SAME * (best.v_bound + first.v_bound);
            if (!(best.known & (alone | same))) {
                continue;
            }
        }
        let off = best.v - first.v;
        total += share.w;
        more += share.w * off;
        said.v_bound = max(said.v_bound, best.v_bound);
        for (var i = 0u; i < N; i += 1u) {
            total_slope[i] += share.dw[i];
            more_slope[i] += share.w * (best.q[i] - first.q[i]) + share.dw[i] * off;
            said.p_bound[i] = max(said.p_bound[i], best.p_bound[i]);
        }
        said.pieces += 1u;
    }
    let blend = more / total;
    said.v = first.v + blend;
    for (var i = 0u; i < N; i += 1u) {
        said.p[i] = first.q[i] + (more_slope[i] - blend * total_slope[i]) / total;
    }
    return said;
}

// Derivatives by states of those by coordinates `L s` (or those of the frame), whose rows are at `matrix`.
fn by_states(slope: Vector, matrix: u32, sizes: bool) -> Vector {
    var q = slope;
    var p: Vector;
    for (var j = 0u; j < N; j += 1u) {
        for (var i = 0u; i < N; i += 1u) {
            let part = reals[matrix + i * N + j] * q[i];
            p[j] += select(part, abs(part), sizes);
        }
    }
    return p;
}

// What is said of a state.
fn chart(state: Vector) -> Said {
    var s = state;
    var said: Said;
//if PERIODS
    for (var i = 0u; i < N; i += 1u) {
        let period = reals[PERIOD + i];
        if (period > 0.0) {
            s[i] -= round(s[i] / period) * period;
        }
    }
//end
//if LOCAL
    var own: Vector;
    var square: real = 0.0;
    for (var i = 0u; i < N; i += 1u) {
        for (var j = 0u; j < N; j += 1u) {
            own[i] += reals[LOCAL_MATRIX + i * N + j] * s[j];
        }
        square += own[i] * own[i];
    }
    if (0.5 * square <= SEED_VALUE) {
        let sum = polynomial(LOCAL, LOCAL_DEGREE, own);
        said.how = NEAR;
        said.v = sum.v;
        said.p = by_states(sum.q, LOCAL_MATRIX, false);
        said.sheets = 1u;
        said.sheet = 0xffffffffu;
        let radius = sqrt(square);
        for (var k = 0u; k < NEGLECTED; k += 1u) {
            var error = reals[NEGLECTED_SIZES + k];
            for (var j = 0u; j < words[NEGLECTED_DEGREES + k]; j += 1u) {
                error *= radius;
            }
            said.v_bound = max(said.v_bound, error);
        }
        return said;
    }
    s = state;
//end
//if PERIODS
    s = state;
    for (var i = 0u; i < N; i += 1u) {
        let period = reals[PERIOD + i];
        if ((period > 0.0) & ((s[i] < reals[LO + i]) | (s[i] > reals[HI + i]))) {
            s[i] += ceil((reals[LO + i] - s[i]) / period) * period;
        }
    }
//end
    var z: Vector;
    var inside = true;
    for (var i = 0u; i < N; i += 1u) {
        inside = inside & (s[i] >= reals[LO + i]) & (s[i] <= reals[HI + i]);
        for (var j = 0u; j < N; j += 1u) {
            z[i] += reals[MATRIX + i * N + j] * (s[j] - reals[ORIGIN + j]);
        }
    }
    if (!inside) {
        said.how = ELSEWHERE;
        return said;
    }
//if BEND
    var shear = shear_at(z);
    z[BEND_AXIS] = (z[BEND_AXIS] + shear.phi - BEND_LOWEST) / BEND_WIDTH;
//end
    said = blended(z);
//if BEND
    let steep = said.p[BEND_AXIS] / BEND_WIDTH;
    let uncertain = said.p_bound[BEND_AXIS] / BEND_WIDTH;
    for (var i = 0u; i < N; i += 1u) {
        said.p[i] += steep * shear.slope[i];
        said.p_bound[i] += uncertain * abs(shear.slope[i]);
    }
    said.p[BEND_AXIS] = steep;
    said.p_bound[BEND_AXIS] = uncertain;
//end
    said.p = by_states(said.p, MATRIX, false);
    said.p_bound = by_states(said.p_bound, MATRIX, true);
    return said;
}
