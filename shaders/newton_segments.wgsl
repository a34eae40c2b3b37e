// Newton's method for multiple shooting on the device, the side of the segments, behind real.wgsl: an
// invocation takes one group of variation columns of one segment (src/backend/gpu/newton.rs).
//
// N is the number of states, M = 2 N, COLUMNS the variation columns of a group, GROUPS their number.

// N, 0; [path]: segments, first segment; [segment]: path.
@group(0) @binding(0) var<storage, read> table: array<u32>;
// [node]: (s, p).
@group(0) @binding(1) var<storage, read> nodes: array<real>;
// Scales (M); [segment]: duration.
@group(0) @binding(2) var<storage, read> given: array<real>;
// [path]: verdict, iterations.
@group(0) @binding(3) var<storage, read_write> verdicts: array<u32>;
// Of the integrator (block.wgsl), [field][trajectory].
@group(0) @binding(4) var<storage, read_write> state: array<real>;
@group(0) @binding(5) var<storage, read_write> counters: array<u32>;
@group(0) @binding(6) var<storage, read> ends: array<real>;
// [segment]: Phi (M x M), defect (M).
@group(0) @binding(7) var<storage, read_write> segments: array<real>;

// N, M and COLUMNS as a compiler does not know them: it would unroll all loops.
struct Place {
    count: u32,
    segment: u32,
    group: u32,
    path: u32,
    // Its first node, in components.
    node: u32,
    components: u32,
    columns: u32,
}

fn place(i: u32) -> Place {
    let count = arrayLength(&given) - M;
    let segment = min(i / GROUPS, count - 1u);
    let path = table[2u + arrayLength(&verdicts) + segment];
    let components = 2u * table[0];
    return Place(count, segment, i % GROUPS, path, (segment + path) * components, components, components / GROUPS);
}

// The vector of a group as it begins: y = z / r, the duration, r, columns of the identity.
@compute @workgroup_size(WORKGROUP)
fn prepare(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = id.x;
    let at = place(i);
    let stride = at.count * GROUPS;
    if (i >= stride) {
        return;
    }
    var size: real = 0.0;
    for (var c = 0u; c < at.components; c += 1u) {
        size = max(size, abs(nodes[at.node + c] / given[c]));
    }
    size = select(real(1.0), size, size > 0.0);
    for (var c = 0u; c < at.components; c += 1u) {
        state[i + c * stride] = nodes[at.node + c] / size;
    }
    state[i + at.components * stride] = given[M + at.segment];
    state[i + (at.components + 1u) * stride] = size;
    for (var c = 0u; c < at.columns; c += 1u) {
        for (var r = 0u; r < at.components; r += 1u) {
            let one = r == at.group * at.columns + c;
            state[i + (at.components + 2u + c * at.components + r) * stride] = select(real(0.0), 1.0, one);
        }
    }
}

// Segments of paths that are done are not integrated.
@compute @workgroup_size(WORKGROUP)
fn leave_out(@builtin(global_invocation_id) id: vec3<u32>) {
    let at = place(id.x);
    if (id.x >= at.count * GROUPS) {
        return;
    }
    if (verdicts[2u * at.path] != OPEN) {
        counters[id.x] = REACHED;
    }
}

// The propagator, scaled, and the defect, from what the groups ended with.
@compute @workgroup_size(WORKGROUP)
fn collect(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = id.x;
    let at = place(i);
    let stride = at.count * GROUPS;
    if (i >= stride) {
        return;
    }
    if (verdicts[2u * at.path] != OPEN) {
        return;
    }
    // All that write here write the same.
    if (counters[i] != REACHED) {
        verdicts[2u * at.path] = FAILED;
        return;
    }
    let to = at.segment * SEGMENT;
    var largest: real = 0.0;
    for (var c = 0u; c < at.columns; c += 1u) {
        let j = at.group * at.columns + c;
        for (var r = 0u; r < at.components; r += 1u) {
            let end = ends[i + (at.components + 2u + c * at.components + r) * stride];
            let entry = end * given[j] / given[r];
            segments[to + r * M + j] = entry;
            largest = max(largest, abs(entry));
        }
    }
    // To be split, which the host does.
    if (largest > GROWTH) {
        verdicts[2u * at.path] = FAILED;
    }
    if (at.group == 0u) {
        let size = ends[i + (at.components + 1u) * stride];
        for (var r = 0u; r < at.components; r += 1u) {
            let end = ends[i + r * stride] * size;
            segments[to + DEFECT + r] = (end - nodes[at.node + M + r]) / given[r];
        }
    }
}
