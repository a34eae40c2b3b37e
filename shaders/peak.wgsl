// How fast the device multiplies and adds: chains of multiply-adds, independent of each other, as
// many as hide the latency of one. `real`, ROUNDS and WORKGROUP come from Rust
// (src/backend/gpu/peak.rs).

@group(0) @binding(0) var<storage, read_write> data: array<real>;

// Half of the multiply-adds of a loop iteration: four chains of four.
fn links(chains: vec4<real>, a: vec4<real>, b: vec4<real>) -> vec4<real> {
    let c0 = fma(chains, a, b);
    let c1 = fma(c0, a, b);
    let c2 = fma(c1, a, b);
    return fma(c2, a, b);
}

@compute @workgroup_size(WORKGROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    // Read from the buffer, so that nothing is known when the shader is compiled.
    let a = vec4<real>(data[0]);
    let b = vec4<real>(data[1]);
    let seed = data[2u + id.x];
    var first = vec4<real>(seed, seed + b.x, seed - b.x, a.x);
    var second = first + b;
    for (var i = 0u; i < ROUNDS; i++) {
        first = links(first, a, b);
        second = links(second, a, b);
    }
    let sum = first + second;
    data[2u + id.x] = sum.x + sum.y + sum.z + sum.w;
}
