// What is said of a batch of states, one invocation each; see pieces.wgsl and blend.wgsl.

// [component][state].
@group(0) @binding(0) var<storage, read> given: array<real>;
// [V, its bound, p, bounds of p][state].
@group(0) @binding(1) var<storage, read_write> values: array<real>;
// [how it is known, sheet, pieces, sheets][state].
@group(0) @binding(2) var<storage, read_write> kinds: array<u32>;

@compute @workgroup_size(WORKGROUP)
fn evaluate(@builtin(global_invocation_id) id: vec3<u32>) {
    let count = arrayLength(&given) / N;
    let k = id.x;
    if (k >= count) {
        return;
    }
    var s: Place;
    for (var i = 0u; i < N; i += 1u) {
        s[i] = given[i * count + k];
    }
    var said = chart(s);
    kinds[k] = said.how;
    kinds[count + k] = said.sheet;
    kinds[2u * count + k] = said.pieces;
    kinds[3u * count + k] = said.sheets;
    values[k] = said.v;
    values[count + k] = said.v_bound;
    for (var i = 0u; i < N; i += 1u) {
        values[(2u + i) * count + k] = said.p[i];
        values[(2u + N + i) * count + k] = said.p_bound[i];
    }
}
