// Block elimination of linearized multiple-shooting equations, mirroring
// src/shooting/elimination.rs: an invocation takes one path through a bounded number of its nodes.
// All that one node hands to the next is among the results.
//
// N is the number of states, M = 2 N that of a node's components; both are generated constants, as
// are the places of things in the buffers and NODES (src/backend/gpu/elimination.rs).

// The number of states again, 0; then [path]: segments, first segment.
@group(0) @binding(0) var<storage, read> paths: array<u32>;
// [path]: nodes done, backward and then forward.
@group(0) @binding(1) var<storage, read_write> progress: array<u32>;
// [segment]: Phi (M x M), defect (M).
@group(0) @binding(2) var<storage, read> segments: array<real>;
// [path]: residual of the end (N), G (N x N), s-part of the first step (N).
@group(0) @binding(3) var<storage, read> conditions: array<real>;
// [node]: W (N x M), L (N x N), c (N), step (M).
@group(0) @binding(4) var<storage, read_write> nodes: array<real>;

// N and M as a compiler does not know them: it would unroll all loops, which takes llvmpipe
// minutes.
var<private> states: u32;
var<private> components: u32;

alias Rows = array<real, ROWS>;
alias Square = array<real, SQUARE>;
alias Column = array<real, N>;
alias Node = array<real, M>;

fn not_a_number(i: u32) -> real {
    return sqrt(-1.0 - abs(conditions[i * CONDITION]));
}

// The end's condition: (-G I) d = e.
fn end_rows(i: u32, rows: ptr<function, Rows>, right: ptr<function, Column>) {
    let at = i * CONDITION;
    for (var r = 0u; r < states; r += 1u) {
        (*right)[r] = conditions[at + r];
        for (var j = 0u; j < states; j += 1u) {
            (*rows)[r * M + j] = -conditions[at + HESSIAN + r * N + j];
            (*rows)[r * M + N + j] = select(real(0.0), 1.0, r == j);
        }
    }
}

// W_{k+1} carried backward through the segment before: W_{k+1} Phi_k d_k = c_{k+1} - W_{k+1} r_k.
fn carried_rows(node: u32, segment: u32, rows: ptr<function, Rows>, right: ptr<function, Column>) {
    for (var r = 0u; r < states; r += 1u) {
        for (var j = 0u; j < components; j += 1u) {
            (*rows)[r * M + j] = 0.0;
        }
        var dot: real = 0.0;
        for (var q = 0u; q < components; q += 1u) {
            let w = nodes[node + r * M + q];
            dot += w * segments[segment + DEFECT + q];
            for (var j = 0u; j < components; j += 1u) {
                (*rows)[r * M + j] += w * segments[segment + q * M + j];
            }
        }
        (*right)[r] = nodes[node + RIGHT + r] - dot;
    }
}

// rows = L Q with orthonormal rows of Q in their place, by modified Gram-Schmidt, twice; then c
// from L c = right.
fn orthonormalize(node: u32, rows: ptr<function, Rows>, right: ptr<function, Column>) {
    for (var r = 0u; r < states; r += 1u) {
        var l: Column;
        for (var pass_ = 0u; pass_ < 2u; pass_ += 1u) {
            for (var q = 0u; q < r; q += 1u) {
                var dot: real = 0.0;
                for (var j = 0u; j < components; j += 1u) {
                    dot += (*rows)[r * M + j] * (*rows)[q * M + j];
                }
                l[q] += dot;
                for (var j = 0u; j < components; j += 1u) {
                    (*rows)[r * M + j] -= dot * (*rows)[q * M + j];
                }
            }
        }
        var square: real = 0.0;
        for (var j = 0u; j < components; j += 1u) {
            square += (*rows)[r * M + j] * (*rows)[r * M + j];
        }
        let norm = sqrt(square);
        l[r] = norm;
        var c = (*right)[r];
        for (var j = 0u; j < components; j += 1u) {
            (*rows)[r * M + j] /= norm;
            nodes[node + r * M + j] = (*rows)[r * M + j];
        }
        for (var q = 0u; q < states; q += 1u) {
            // Above the diagonal L is zero.
            nodes[node + LOWER + r * N + q] = l[q];
            if (q < r) {
                c -= l[q] * (*right)[q];
            }
        }
        c /= norm;
        (*right)[r] = c;
        nodes[node + RIGHT + r] = c;
    }
}

// Solves a x = b by elimination with row exchanges, x in place of b. False where a pivot is 0 or
// not finite.
fn solve(a: ptr<function, Square>, b: ptr<function, Column>) -> bool {
    var regular = true;
    for (var k = 0u; k < states; k += 1u) {
        var pivot = k;
        var size: real = 0.0;
        for (var r = k; r < states; r += 1u) {
            let x = abs((*a)[r * N + k]);
            regular = regular & is_finite(x);
            pivot = select(pivot, r, x > size);
            size = max(size, x);
        }
        regular = regular & (size > 0.0);
        for (var j = 0u; j < states; j += 1u) {
            let x = (*a)[k * N + j];
            (*a)[k * N + j] = (*a)[pivot * N + j];
            (*a)[pivot * N + j] = x;
        }
        let x = (*b)[k];
        (*b)[k] = (*b)[pivot];
        (*b)[pivot] = x;
        for (var r = k + 1u; r < states; r += 1u) {
            let f = (*a)[r * N + k] / (*a)[k * N + k];
            for (var j = k; j < states; j += 1u) {
                (*a)[r * N + j] -= f * (*a)[k * N + j];
            }
            (*b)[r] -= f * (*b)[k];
        }
    }
    for (var back = 0u; back < states; back += 1u) {
        let k = states - 1u - back;
        var x = (*b)[k];
        for (var j = k + 1u; j < states; j += 1u) {
            x -= (*a)[k * N + j] * (*b)[j];
        }
        (*b)[k] = x / (*a)[k * N + k];
    }
    return regular;
}

// The first node's step: its s-part is given, its p-part meets the rows (A B).
fn first_step(i: u32, node: u32) {
    var a: Square;
    var b: Column;
    let wanted = i * CONDITION + WANTED;
    for (var r = 0u; r < states; r += 1u) {
        var x = nodes[node + RIGHT + r];
        for (var j = 0u; j < states; j += 1u) {
            x -= nodes[node + r * M + j] * conditions[wanted + j];
            a[r * N + j] = nodes[node + r * M + N + j];
        }
        b[r] = x;
    }
    let regular = solve(&a, &b);
    for (var j = 0u; j < states; j += 1u) {
        nodes[node + STEP + j] = conditions[wanted + j];
        if (regular) {
            nodes[node + STEP + N + j] = b[j];
        } else {
            nodes[node + STEP + N + j] = not_a_number(i);
        }
    }
}

// The step of a node from that of the one before, corrected onto its rows.
fn next_step(node: u32, segment: u32) {
    var step: Node;
    for (var r = 0u; r < components; r += 1u) {
        var x = segments[segment + DEFECT + r];
        for (var j = 0u; j < components; j += 1u) {
            x += segments[segment + r * M + j] * nodes[node - NODE + STEP + j];
        }
        step[r] = x;
    }
    for (var r = 0u; r < states; r += 1u) {
        var excess = nodes[node + RIGHT + r];
        for (var j = 0u; j < components; j += 1u) {
            excess -= nodes[node + r * M + j] * step[j];
        }
        for (var j = 0u; j < components; j += 1u) {
            step[j] += nodes[node + r * M + j] * excess;
        }
    }
    for (var r = 0u; r < components; r += 1u) {
        nodes[node + STEP + r] = step[r];
    }
}

@compute @workgroup_size(WORKGROUP)
fn backward(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = id.x;
    if (i >= arrayLength(&progress) / 2u) {
        return;
    }
    states = paths[0];
    components = 2u * states;
    let last = paths[2u + 2u * i];
    let first = paths[3u + 2u * i];
    let begin = progress[2u * i];
    let end = min(begin + NODES, last + 1u);
    for (var done = begin; done < end; done += 1u) {
        let k = last - done;
        let node = (first + i + k) * NODE;
        var rows: Rows;
        var right: Column;
        if (k == last) {
            end_rows(i, &rows, &right);
        } else {
            carried_rows(node + NODE, (first + k) * SEGMENT, &rows, &right);
        }
        orthonormalize(node, &rows, &right);
    }
    progress[2u * i] = end;
}

@compute @workgroup_size(WORKGROUP)
fn forward(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = id.x;
    if (i >= arrayLength(&progress) / 2u) {
        return;
    }
    states = paths[0];
    components = 2u * states;
    let last = paths[2u + 2u * i];
    let first = paths[3u + 2u * i];
    let begin = progress[2u * i + 1u];
    let end = min(begin + NODES, last + 1u);
    for (var k = begin; k < end; k += 1u) {
        let node = (first + i + k) * NODE;
        if (k == 0u) {
            first_step(i, node);
        } else {
            next_step(node, (first + k - 1u) * SEGMENT);
        }
    }
    progress[2u * i + 1u] = end;
}
