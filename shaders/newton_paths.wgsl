// Newton's method for multiple shooting on the device, the side of the paths, behind real.wgsl: an
// invocation takes one path (src/backend/gpu/newton.rs). Steps come from elimination.wgsl.
//
// N is the number of states, M = 2 N.

// N, 0; [path]: segments, first segment; [segment]: path.
@group(0) @binding(0) var<storage, read> table: array<u32>;
// [node]: (s, p).
@group(0) @binding(1) var<storage, read_write> nodes: array<real>;
// [path]: verdict, iterations.
@group(0) @binding(2) var<storage, read_write> verdicts: array<u32>;
// The tolerance, scales (M); [path]: at the end s (N) and there g(s) (N), the goal (N).
@group(0) @binding(3) var<storage, read> model: array<real>;
// As elimination.wgsl has them.
@group(0) @binding(4) var<storage, read_write> conditions: array<real>;
@group(0) @binding(5) var<storage, read> eliminated: array<real>;
@group(0) @binding(6) var<storage, read_write> progress: array<u32>;
// [path]: norm of the last step; negative before the first one.
@group(0) @binding(7) var<storage, read_write> norms: array<real>;

fn scale(c: u32) -> real {
    return model[1u + c];
}

// The equations' right-hand sides at the ends of a path, g(s) linearized where the host gave it; and
// what the elimination is to do.
fn condition(i: u32, is_open: bool) {
    let states = table[0];
    let segments = table[2u + 2u * i];
    let first = table[3u + 2u * i];
    let to = i * CONDITION;
    let begin = (first + i) * M;
    let last = begin + segments * M;
    let own = 1u + M + i * 3u * N;
    for (var r = 0u; r < states; r += 1u) {
        var e = (model[own + N + r] - nodes[last + N + r]) / scale(N + r);
        for (var j = 0u; j < states; j += 1u) {
            e += conditions[to + HESSIAN + r * N + j] * (nodes[last + j] - model[own + j]) / scale(j);
        }
        conditions[to + r] = e;
        conditions[to + WANTED + r] = (model[own + 2u * N + r] - nodes[begin + r]) / scale(r);
    }
    // Nodes done: all of a path that is not to be eliminated.
    progress[2u * i] = select(segments + 1u, 0u, is_open);
    progress[2u * i + 1u] = select(segments + 1u, 0u, is_open);
}

// Begins a stage: paths that met the tolerance of the one before go on.
@compute @workgroup_size(WORKGROUP)
fn open(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = id.x;
    if (i >= arrayLength(&norms)) {
        return;
    }
    let is_open = verdicts[2u * i] != FAILED;
    if (is_open) {
        verdicts[2u * i] = OPEN;
    }
    norms[i] = -1.0;
    condition(i, is_open);
}

// Takes Newton's step where it contracts and does not lead far from where the equations were
// linearized.
@compute @workgroup_size(WORKGROUP)
fn update(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = id.x;
    if (i >= arrayLength(&norms)) {
        return;
    }
    if (verdicts[2u * i] != OPEN) {
        condition(i, false);
        return;
    }
    let components = 2u * table[0];
    let first = table[3u + 2u * i] + i;
    let count = table[2u + 2u * i] + 1u;
    var norm: real = 0.0;
    var size: real = 0.0;
    var regular = true;
    for (var k = 0u; k < count; k += 1u) {
        for (var c = 0u; c < components; c += 1u) {
            let step = eliminated[(first + k) * NODE + STEP + c];
            regular = regular & is_finite(step);
            norm = max(norm, abs(step));
            size = max(size, abs(nodes[(first + k) * M + c] / scale(c)));
        }
    }
    var shift: real = 0.0;
    for (var c = 0u; c < table[0]; c += 1u) {
        shift = max(shift, abs(conditions[i * CONDITION + WANTED + c]));
    }
    verdicts[2u * i + 1u] += 1u;
    let before = norms[i];
    let near = norm <= MOST_STEP * max(size, shift);
    let contracts = (before < 0.0) | (norm < before) | (norm <= model[0] * size);
    if (!(regular & near & contracts)) {
        verdicts[2u * i] = FAILED;
        condition(i, false);
        return;
    }
    for (var k = 0u; k < count; k += 1u) {
        for (var c = 0u; c < components; c += 1u) {
            nodes[(first + k) * M + c] += eliminated[(first + k) * NODE + STEP + c] * scale(c);
        }
    }
    norms[i] = norm;
    let is_solved = norm <= model[0] * size;
    if (is_solved) {
        verdicts[2u * i] = SOLVED;
    }
    condition(i, !is_solved);
}
