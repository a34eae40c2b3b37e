// What the pieces around a state say together, and what is said of a state: behind pieces.wgsl,
// mirroring src/map/pieces/flat/blend.rs and src/map/swift.rs.

struct Weight {
    positive: bool,
    w: real,
    dw: Place,
//if ROUNDED
    // What rounding may do to w and to its slopes.
    w_lost: real,
    dw_lost: Place,
//end
//if SECOND
    ddw: Triangle,
//end
}

// The weight of a cell at a place, with its derivatives.
fn weight(cell: u32, place: Spot) -> Weight {
    var z = place.at;
    var share: Weight;
    var f: Place;
    var d: Place;
//if SECOND
    var dd: Place;
//end
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
//if SECOND
            dd[i] = -60.0 * t * rest * (rest - t) / (scale * scale);
//end
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
//if ROUNDED
    // The polynomial's terms are up to 31 in all, its slope's 30, its second derivative at most 6,
    // in units of the overlap.
    var off = place.off;
    var way: real = 0.0;
    for (var i = 0u; i < N; i += 1u) {
        let half = reals[box + N + i];
        way += (off[i] + EPSILON * (abs(reals[box + i]) + abs(z[i]))) / (OVERLAP * half);
    }
    for (var i = 0u; i < N; i += 1u) {
        let half = reals[box + N + i];
        let moved = off[i] + EPSILON * (abs(reals[box + i]) + abs(z[i]));
        share.w_lost += abs(share.dw[i]) * moved + select(real(0.0), 31.0 * EPSILON, f[i] < 1.0);
        share.dw_lost[i] = select(real(0.0), (6.0 * way + 60.0 * EPSILON) / (OVERLAP * half), f[i] < 1.0);
    }
//end
//if SECOND
    var pair = 0u;
    for (var i = 0u; i < N; i += 1u) {
        for (var j = i; j < N; j += 1u) {
            var product = select(d[i] * d[j], dd[i], i == j);
            for (var k = 0u; k < N; k += 1u) {
                if ((k != i) & (k != j)) {
                    product *= f[k];
                }
            }
            share.ddw[pair] = product;
            pair += 1u;
        }
    }
//end
    return share;
}

// Nodes of the tree that are still to be looked at.
struct Walk {
    stack: array<u32, DEPTH>,
    height: u32,
}

const NO_CELL: u32 = 0xffffffffu;

// The next cell that may reach over a place; the walk is a function of its own so that neighbouring
// invocations come to their cells together.
fn next_cell(walk: ptr<function, Walk>, place: Spot) -> u32 {
    var z = place.at;
    var cell = NO_CELL;
    while ((cell == NO_CELL) & ((*walk).height > 0u)) {
        (*walk).height -= 1u;
        let at = (*walk).stack[(*walk).height];
        let axis = words[NODES + 3u * at];
        if (axis < N) {
            // The one below is looked at first.
            if (z[axis] > reals[SPLITS + 3u * at + 1u]) {
                (*walk).stack[(*walk).height] = words[NODES + 3u * at + 2u];
                (*walk).height += 1u;
            }
            if (z[axis] < reals[SPLITS + 3u * at + 2u]) {
                (*walk).stack[(*walk).height] = words[NODES + 3u * at + 1u];
                (*walk).height += 1u;
            }
        } else {
            cell = words[NODES + 3u * at + 1u];
        }
        spent += 1u;
    }
    return cell;
}

// The lowest sheet's blend at a place of the frame, in its coordinates.
fn blended(place: Spot) -> Said {
    var z = place.at;
    var said: Said;
    var node = 0u;
    loop {
        let axis = words[NODES + 3u * node];
        if (axis >= N) {
            break;
        }
        node = words[NODES + 3u * node + select(2u, 1u, z[axis] < reals[SPLITS + 3u * node])];
        spent += 1u;
    }
    let own = words[NODES + 3u * node + 1u];
    if (!weight(own, place).positive) {
        return said;
    }
    var first: Told;
    let sole = words[OWNED + own + 1u] == words[OWNED + own] + 1u;
    for (var piece = words[OWNED + own]; piece < words[OWNED + own + 1u]; piece += 1u) {
        let here = told(piece, place);
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
    // Sums of weights, and of weights times what a piece says more than the first one: the
    // differences are small.
    var total: real = 0.0;
    var more: real = 0.0;
    var total_slope: Place;
    var more_slope: Place;
//if ROUNDED
    // Of what is blended: what each piece lost at most, how far pieces are apart, and what the
    // weights lost.
    var v_lost = first.v_lost;
    var q_lost = first.q_lost;
    var apart: real = 0.0;
    var slopes_apart: Place;
    var w_lost: real = 0.0;
    var dw_lost: Place;
    var dw_size: Place;
//end
//if SECOND
    var total_bend: Triangle;
    var more_bend: Triangle;
//end
    var walk: Walk;
    walk.height = 1u;
    loop {
        let cell = next_cell(&walk, place);
        if (cell == NO_CELL) {
            break;
        }
        if (spent > MOST_SPENT) {
            said.how = TOO_MUCH;
            break;
        }
        var share = weight(cell, place);
        if (!share.positive) {
            continue;
        }
        var best = first;
        if (cell != own) {
            best.known = false;
            let begin = words[OWNED + cell];
            let end = words[OWNED + cell + 1u];
            for (var piece = begin; piece < end; piece += 1u) {
                let here = told(piece, place);
                if (here.known & (!best.known | (abs(here.v - first.v) < abs(best.v - first.v)))) {
                    best = here;
                }
            }
            // The piece of the same sheet, if the neighbour has one.
            let alone = sole & (end == begin + 1u);
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
//if ROUNDED
        v_lost = max(v_lost, best.v_lost);
        apart = max(apart, abs(off));
        w_lost += share.w_lost;
        for (var i = 0u; i < N; i += 1u) {
            q_lost[i] = max(q_lost[i], best.q_lost[i]);
            slopes_apart[i] = max(slopes_apart[i], abs(best.q[i] - first.q[i]));
            dw_lost[i] += share.dw_lost[i];
            dw_size[i] += abs(share.dw[i]);
        }
//end
//if SECOND
        var pair = 0u;
        for (var i = 0u; i < N; i += 1u) {
            for (var j = i; j < N; j += 1u) {
                let cross = share.dw[i] * (best.q[j] - first.q[j]) + share.dw[j] * (best.q[i] - first.q[i]);
                total_bend[pair] += share.ddw[pair];
                more_bend[pair] += share.w * (best.h[pair] - first.h[pair]) + cross + share.ddw[pair] * off;
                pair += 1u;
            }
        }
//end
        said.pieces += 1u;
    }
    let blend = more / total;
    var slope: Place;
    said.v = first.v + blend;
    for (var i = 0u; i < N; i += 1u) {
        slope[i] = (more_slope[i] - blend * total_slope[i]) / total;
        said.p[i] = first.q[i] + slope[i];
    }
//if ROUNDED
    // V is a mean of what is `apart` at most, p one of slopes with the weights' slopes times that.
    said.v_lost = v_lost + (2.0 * w_lost / total + 16.0 * EPSILON) * apart + EPSILON * abs(said.v);
    for (var i = 0u; i < N; i += 1u) {
        let uneven = 2.0 * (dw_size[i] * (v_lost + (w_lost / total + 16.0 * EPSILON) * apart) + dw_lost[i] * apart);
        let even = (2.0 * w_lost / total + 16.0 * EPSILON) * slopes_apart[i];
        said.p_lost[i] = q_lost[i] + even + uneven / total + EPSILON * abs(said.p[i]);
    }
//end
//if SECOND
    var pair = 0u;
    for (var i = 0u; i < N; i += 1u) {
        for (var j = i; j < N; j += 1u) {
            let cross = slope[i] * total_slope[j] + slope[j] * total_slope[i];
            said.h[pair] = first.h[pair] + (more_bend[pair] - cross - blend * total_bend[pair]) / total;
            pair += 1u;
        }
    }
//end
    return said;
}

// Derivatives by states of those by coordinates `L s` (or those of the frame), whose rows are at
// `matrix`.
fn by_states(slope: Place, matrix: u32, sizes: bool) -> Place {
    var q = slope;
    var p: Place;
    for (var j = 0u; j < N; j += 1u) {
        for (var i = 0u; i < N; i += 1u) {
            let part = reals[matrix + i * N + j] * q[i];
            p[j] += select(part, abs(part), sizes);
        }
    }
    return p;
}

//if SECOND
// The same of second derivatives.
fn bent_by_states(bend: Triangle, matrix: u32) -> Triangle {
    var h = bend;
    var all: Triangle;
    var pair = 0u;
    for (var a = 0u; a < N; a += 1u) {
        for (var b = a; b < N; b += 1u) {
            var sum: real = 0.0;
            for (var i = 0u; i < N; i += 1u) {
                var half: real = 0.0;
                for (var j = 0u; j < N; j += 1u) {
                    half += h[pair_of(i, j)] * reals[matrix + j * N + b];
                }
                sum += reals[matrix + i * N + a] * half;
            }
            all[pair] = sum;
            pair += 1u;
        }
    }
    return all;
}
//end

//if ROUNDED
// What derivatives by states lose, from what those by coordinates lost.
fn lost_by_states(lost: Place, slope: Place, matrix: u32) -> Place {
    var given = lost;
    var q = slope;
    var p: Place;
    for (var j = 0u; j < N; j += 1u) {
        for (var i = 0u; i < N; i += 1u) {
            p[j] += abs(reals[matrix + i * N + j]) * (given[i] + real(N + 1u) * EPSILON * abs(q[i]));
        }
    }
    return p;
}
//end

// What is said of a state.
fn chart(state: Place) -> Said {
    var s = state;
    var said: Said;
    spent = 0u;
//if ROUNDED
    // Of what the state was rounded to, and of whole periods.
    var off: Place;
    for (var i = 0u; i < N; i += 1u) {
        off[i] = EPSILON * abs(s[i]);
    }
//end
//if PERIODS
    for (var i = 0u; i < N; i += 1u) {
        let period = reals[PERIOD + i];
        if (period > 0.0) {
            let whole = round(s[i] / period) * period;
            s[i] -= whole;
//end
//if PERIODS ROUNDED
            off[i] += EPSILON * abs(whole);
//end
//if PERIODS
        }
    }
//end
//if LOCAL
    var local: Spot;
    var square: real = 0.0;
    for (var i = 0u; i < N; i += 1u) {
        var own: real = 0.0;
        for (var j = 0u; j < N; j += 1u) {
            own += reals[LOCAL_MATRIX + i * N + j] * s[j];
        }
        square += own * own;
        local.at[i] = own;
    }
    if (0.5 * square <= SEED_VALUE) {
//end
//if LOCAL ROUNDED
        for (var i = 0u; i < N; i += 1u) {
            for (var j = 0u; j < N; j += 1u) {
                let entry = abs(reals[LOCAL_MATRIX + i * N + j]);
                local.off[i] += entry * (off[j] + real(N + 1u) * EPSILON * abs(s[j]));
            }
        }
//end
//if LOCAL
        let sum = polynomial(LOCAL, LOCAL_DEGREE, local);
        said.how = NEAR;
        said.v = sum.v;
        said.p = by_states(sum.q, LOCAL_MATRIX, false);
//end
//if LOCAL SECOND
        said.h = bent_by_states(sum.h, LOCAL_MATRIX);
//end
//if LOCAL
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
//end
//if LOCAL ROUNDED
        said.v_bound += sum.v_lost;
        said.p_bound = lost_by_states(sum.q_lost, sum.q, LOCAL_MATRIX);
//end
//if LOCAL
        return said;
    }
    s = state;
//end
//if PERIODS
    s = state;
    for (var i = 0u; i < N; i += 1u) {
        let period = reals[PERIOD + i];
        if ((period > 0.0) & ((s[i] < reals[LO + i]) | (s[i] > reals[HI + i]))) {
            let whole = ceil((reals[LO + i] - s[i]) / period) * period;
            s[i] += whole;
//end
//if PERIODS ROUNDED
            off[i] += EPSILON * abs(whole);
//end
//if PERIODS
        }
    }
//end
    var place: Spot;
    var inside = true;
    for (var i = 0u; i < N; i += 1u) {
        var z: real = 0.0;
        inside = inside & (s[i] >= reals[LO + i]) & (s[i] <= reals[HI + i]);
        for (var j = 0u; j < N; j += 1u) {
            z += reals[MATRIX + i * N + j] * (s[j] - reals[ORIGIN + j]);
        }
        place.at[i] = z;
    }
    if (!inside) {
        said.how = ELSEWHERE;
        return said;
    }
//if ROUNDED
    for (var i = 0u; i < N; i += 1u) {
        for (var j = 0u; j < N; j += 1u) {
            let origin = reals[ORIGIN + j];
            let steps = real(N + 2u) * EPSILON * abs(s[j] - origin);
            place.off[i] += abs(reals[MATRIX + i * N + j]) * (off[j] + EPSILON * abs(origin) + steps);
        }
    }
//end
//if BEND
    var shear = shear_at(place);
    let along = place.at[BEND_AXIS] + shear.phi - BEND_LOWEST;
//end
//if BEND ROUNDED
    let terms = abs(place.at[BEND_AXIS]) + abs(shear.phi) + abs(BEND_LOWEST);
    place.off[BEND_AXIS] = (place.off[BEND_AXIS] + shear.lost + 2.0 * EPSILON * (terms + abs(along))) / BEND_WIDTH;
//end
//if BEND
    place.at[BEND_AXIS] = along / BEND_WIDTH;
//end
    said = blended(place);
//if BEND
    let steep = said.p[BEND_AXIS] / BEND_WIDTH;
//end
//if BEND SECOND
    // J'hJ and what the curvature of phi adds, where J is the identity but for its row of the axis.
    var row: Place;
    var old = said.h;
    for (var i = 0u; i < N; i += 1u) {
        row[i] = select(shear.slope[i], real(1.0), i == BEND_AXIS) / BEND_WIDTH;
    }
    var pair = 0u;
    for (var i = 0u; i < N; i += 1u) {
        for (var j = i; j < N; j += 1u) {
            var sum = row[i] * row[j] * old[pair_of(BEND_AXIS, BEND_AXIS)] + steep * shear.curvature[pair];
            if ((i != BEND_AXIS) & (j != BEND_AXIS)) {
                sum += old[pair];
            }
            if (i != BEND_AXIS) {
                sum += old[pair_of(i, BEND_AXIS)] * row[j];
            }
            if (j != BEND_AXIS) {
                sum += old[pair_of(j, BEND_AXIS)] * row[i];
            }
            said.h[pair] = sum;
            pair += 1u;
        }
    }
//end
//if BEND
    let uncertain = said.p_bound[BEND_AXIS] / BEND_WIDTH;
    for (var i = 0u; i < N; i += 1u) {
        said.p[i] += steep * shear.slope[i];
        said.p_bound[i] += uncertain * abs(shear.slope[i]);
//end
//if BEND ROUNDED
        if (i != BEND_AXIS) {
            let lost = (said.p_lost[BEND_AXIS] / BEND_WIDTH + 2.0 * EPSILON * abs(steep)) * abs(shear.slope[i]);
            said.p_lost[i] += lost + abs(steep) * shear.slope_lost[i] + EPSILON * abs(said.p[i]);
        }
//end
//if BEND
    }
//end
//if BEND ROUNDED
    said.p_lost[BEND_AXIS] = said.p_lost[BEND_AXIS] / BEND_WIDTH + 2.0 * EPSILON * abs(steep);
//end
//if BEND
    said.p[BEND_AXIS] = steep;
    said.p_bound[BEND_AXIS] = uncertain;
//end
    said.p_bound = by_states(said.p_bound, MATRIX, true);
//if ROUNDED
    let lost = lost_by_states(said.p_lost, said.p, MATRIX);
    said.v_bound += said.v_lost;
    for (var i = 0u; i < N; i += 1u) {
        said.p_bound[i] += lost[i];
    }
//end
    said.p = by_states(said.p, MATRIX, false);
//if SECOND
    said.h = bent_by_states(said.h, MATRIX);
//end
    return said;
}
