// Policy iteration on a lattice of states, one invocation a node; the same steps in the same order
// as src/dynamic_programming/cpu.rs and lattice.rs. Generated: N, M, GUARDS and the other
// constants, the bounds of the controls, `motion_at` and `law_at`.

// Kind, integer and real arguments of a candidate; see `Candidate` in level.rs.
struct Candidate {
    kind: u32,
    index: u32,
    forward: u32,
    amount: f32,
}

@group(0) @binding(0) var<storage, read> candidates: array<Candidate>;
@group(0) @binding(1) var<storage, read> values: array<f32>;
@group(0) @binding(2) var<storage, read_write> next_values: array<f32>;
@group(0) @binding(3) var<storage, read> controls: array<f32>;
@group(0) @binding(4) var<storage, read_write> next_controls: array<f32>;
// Of each node the end of its best step, what it costs, and that with the value at its end.
@group(0) @binding(5) var<storage, read_write> steps: array<f32>;
@group(0) @binding(6) var<storage, read> known: array<u32>;
// The level's settings (see `load_settings`), the linearization's controls of all nodes, then the
// fixed set.
@group(0) @binding(7) var<storage, read> given: array<f32>;

var<private> axis_first: array<f32, N>;
var<private> axis_step: array<f32, N>;
var<private> axis_count: array<u32, N>;
var<private> axis_stride: array<u32, N>;
var<private> axis_periodic: array<u32, N>;
var<private> ceiling: f32;
var<private> cells: f32;
var<private> longest: f32;
var<private> bent_below: f32;
var<private> nodes: u32;

fn load_settings() {
    for (var i = 0u; i < N; i++) {
        axis_first[i] = given[i];
        axis_step[i] = given[N + i];
        axis_count[i] = u32(given[2u * N + i]);
        axis_stride[i] = u32(given[3u * N + i]);
        axis_periodic[i] = u32(given[4u * N + i]);
    }
    ceiling = given[5u * N];
    cells = given[5u * N + 1u];
    longest = given[5u * N + 2u];
    bent_below = given[5u * N + 3u];
    nodes = u32(given[5u * N + 4u]);
}

alias State = array<f32, N>;
alias Control = array<f32, M>;

const ABSENT: u32 = 0xffffffffu;
const VERTICES: u32 = 1u << N;
const STEP: u32 = N + 2u;
const SLACK: f32 = 1e-5;

struct Cell {
    inside: bool,
    lower: array<u32, N>,
    upper: array<u32, N>,
    before: array<u32, N>,
    after: array<u32, N>,
    fraction: array<f32, N>,
}

struct Vertices {
    index: array<u32, VERTICES>,
    value: array<f32, VERTICES>,
}

// A step: where it ends, what it costs itself and with the value there.
struct Trial {
    control: Control,
    foot: State,
    // Whether the model holds along it.
    valid: bool,
    cost: f32,
    total: f32,
}

fn state_of(node: u32) -> State {
    var s: State;
    for (var i = 0u; i < N; i++) {
        s[i] = axis_first[i] + axis_step[i] * f32(node / axis_stride[i] % axis_count[i]);
    }
    return s;
}

fn locate(s: State) -> Cell {
    var cell: Cell;
    cell.inside = true;
    for (var i = 0u; i < N; i++) {
        let count = axis_count[i];
        let stride = axis_stride[i];
        let periodic = axis_periodic[i] == 1u;
        var x = (s[i] - axis_first[i]) / axis_step[i];
        if (periodic) {
            x -= f32(count) * floor(x / f32(count));
        }
        let last = select(count - 1u, count, periodic);
        if (!is_finite(x) || x < -SLACK || x > f32(last) + SLACK) {
            cell.inside = false;
            return cell;
        }
        let k = min(u32(max(x, 0.0)), last - 1u);
        cell.fraction[i] = clamp(x - f32(k), 0.0, 1.0);
        cell.lower[i] = k * stride;
        cell.upper[i] = select(k + 1u, (k + 1u) % count, periodic) * stride;
        cell.before[i] = select(select(ABSENT, (k - 1u) * stride, k > 0u), (k + count - 1u) % count * stride, periodic);
        cell.after[i] = select(select(ABSENT, (k + 2u) * stride, k + 2u < count), (k + 2u) % count * stride, periodic);
    }
    return cell;
}

fn vertices_of(cell: Cell) -> Vertices {
    var place = cell;
    var v: Vertices;
    v.index[0] = 0u;
    for (var i = 0u; i < N; i++) {
        v.index[0] += place.lower[i];
    }
    for (var i = 0u; i < N; i++) {
        for (var j = 0u; j < (1u << i); j++) {
            v.index[j | (1u << i)] = v.index[j] + place.upper[i] - place.lower[i];
        }
    }
    for (var j = 0u; j < VERTICES; j++) {
        v.value[j] = values[v.index[j]];
    }
    return v;
}

// Second differences along each axis on the line of vertices nearest to the point, the lesser of
// the two about the cell.
fn curvature_of(cell: Cell, at: Vertices) -> State {
    var place = cell;
    var v = at;
    var near = 0u;
    for (var i = 0u; i < N; i++) {
        near |= select(0u, 1u << i, place.fraction[i] >= 0.5);
    }
    var bend: State;
    for (var i = 0u; i < N; i++) {
        let low = near & ~(1u << i);
        let v0 = v.value[low];
        let v1 = v.value[near | (1u << i)];
        let base = v.index[low] - place.lower[i];
        let has_left = place.before[i] != ABSENT;
        let has_right = place.after[i] != ABSENT;
        let left = v1 - 2.0 * v0 + values[base + select(place.lower[i], place.before[i], has_left)];
        let right = values[base + select(place.lower[i], place.after[i], has_right)] - 2.0 * v1 + v0;
        let both = select(select(right, left, abs(left) < abs(right)), 0.0, left * right <= 0.0);
        bend[i] = select(select(0.0, right, has_right), select(left, both, has_right), has_left);
    }
    return bend;
}

// The least and the largest value.
fn range_of(at: Vertices) -> vec2<f32> {
    var v = at;
    var lo = v.value[0];
    var hi = v.value[0];
    for (var j = 1u; j < VERTICES; j++) {
        lo = min(lo, v.value[j]);
        hi = max(hi, v.value[j]);
    }
    return vec2<f32>(lo, hi);
}

fn interpolate(cell: Cell) -> f32 {
    var place = cell;
    let at = vertices_of(cell);
    var v = at.value;
    for (var q = 0u; q < N; q++) {
        let i = N - 1u - q;
        for (var j = 0u; j < (1u << i); j++) {
            v[j] += place.fraction[i] * (v[j | (1u << i)] - v[j]);
        }
    }
    let range = range_of(at);
    if (range.y >= bent_below) {
        return v[0];
    }
    var bend = curvature_of(cell, at);
    var value = v[0];
    for (var i = 0u; i < N; i++) {
        value -= 0.5 * place.fraction[i] * (1.0 - place.fraction[i]) * bend[i];
    }
    return clamp(value, range.x, range.y);
}

fn slope(cell: Cell) -> State {
    var place = cell;
    let at = vertices_of(cell);
    var v = at;
    var bend = curvature_of(cell, at);
    let range = range_of(at);
    let most = range.y - range.x;
    var p: State;
    for (var i = 0u; i < N; i++) {
        var sum = 0.0;
        for (var j = 0u; j < VERTICES; j++) {
            var weight = select(-1.0, 1.0, ((j >> i) & 1u) == 1u);
            for (var k = 0u; k < N; k++) {
                if (k != i) {
                    weight *= select(1.0 - place.fraction[k], place.fraction[k], ((j >> k) & 1u) == 1u);
                }
            }
            sum += weight * v.value[j];
        }
        let curved = select(0.0, clamp(0.5 * bend[i], -most, most), range.y < bent_below);
        p[i] = (sum - curved * (1.0 - 2.0 * place.fraction[i])) / axis_step[i];
    }
    return p;
}

fn is_valid(row: array<f32, WIDTH>) -> bool {
    var r = row;
    var valid = true;
    for (var c = 0u; c <= N; c++) {
        valid = valid && is_finite(r[c]);
    }
    for (var g = 0u; g < GUARDS; g++) {
        let value = r[N + 1u + g];
        valid = valid && select(value >= 0.0, value > 0.0, guard_strict[g] == 1u);
    }
    return valid;
}

// The value at the end of a step.
fn value_at(foot: State) -> f32 {
    let cell = locate(foot);
    if (!cell.inside) {
        return ceiling;
    }
    return interpolate(cell);
}

// Kutta's third-order method under a constant control.
fn fly(start: State, control: Control) -> Trial {
    var s = start;
    var k1 = motion_at(start, control);
    var speed = 0.0;
    for (var i = 0u; i < N; i++) {
        speed = max(speed, abs(k1[i] / axis_step[i]));
    }
    let time = min(longest, cells / max(speed, SMALLEST_NORMAL));
    var place: State;
    for (var i = 0u; i < N; i++) {
        place[i] = s[i] + 0.5 * time * k1[i];
    }
    var k2 = motion_at(place, control);
    for (var i = 0u; i < N; i++) {
        place[i] = s[i] + time * (2.0 * k2[i] - k1[i]);
    }
    var k3 = motion_at(place, control);
    var valid = is_valid(k1) && is_valid(k2);
    for (var c = 0u; c <= N; c++) {
        valid = valid && is_finite(k3[c]);
    }
    var trial: Trial;
    trial.control = control;
    trial.valid = valid;
    for (var i = 0u; i < N; i++) {
        // A place that no lattice has: the step is not taken.
        trial.foot[i] = select(NOWHERE, s[i] + time * (k1[i] + 4.0 * k2[i] + k3[i]) / 6.0, valid);
    }
    trial.cost = select(ceiling, time * (k1[N] + 4.0 * k2[N] + k3[N]) / 6.0, valid);
    if (valid) {
        trial.total = min(ceiling, trial.cost + value_at(trial.foot));
    } else {
        trial.total = ceiling;
    }
    return trial;
}

fn neighbour(node: u32, axis: u32, forward: bool) -> u32 {
    let count = axis_count[axis];
    let stride = axis_stride[axis];
    let periodic = axis_periodic[axis] == 1u;
    let k = node / stride % count;
    var next = k;
    if (forward) {
        next = select(select(k, 0u, periodic), k + 1u, k + 1u < count);
    } else {
        next = select(select(k, count - 1u, periodic), k - 1u, k > 0u);
    }
    return node - k * stride + next * stride;
}

fn bounded(control: Control) -> Control {
    var u = control;
    for (var c = 0u; c < M; c++) {
        u[c] = clamp(u[c], lower_bound[c], upper_bound[c]);
    }
    return u;
}

fn control_of(node: u32) -> Control {
    var u: Control;
    for (var c = 0u; c < M; c++) {
        u[c] = controls[node * M + c];
    }
    return u;
}

fn given_at(first: u32) -> Control {
    var u: Control;
    for (var c = 0u; c < M; c++) {
        u[c] = given[first + c];
    }
    return u;
}

// u*(s, p) with the gradient at a share of the present step.
fn by_costate(s: State, present: Trial, share: f32) -> Control {
    var start = s;
    var step = present;
    var place: State;
    var p: State;
    for (var i = 0u; i < N; i++) {
        place[i] = start[i] + share * (step.foot[i] - start[i]);
    }
    if (step.valid) {
        let cell = locate(place);
        if (cell.inside) {
            p = slope(cell);
        }
    }
    return law_at(s, p);
}

fn propose(k: u32, node: u32, s: State, present: Trial, best: Trial) -> Control {
    let candidate = candidates[k];
    switch candidate.kind {
        case 1u: {
            return by_costate(s, present, candidate.amount);
        }
        case 2u: {
            return given_at(SETTINGS + node * M);
        }
        case 3u: {
            return control_of(neighbour(node, candidate.index, candidate.forward == 1u));
        }
        case 4u: {
            return given_at(SETTINGS + (nodes + candidate.index) * M);
        }
        case 5u: {
            var u = best.control;
            u[candidate.index] += candidate.amount;
            return u;
        }
        default: {
            return control_of(node);
        }
    }
}

@compute @workgroup_size(WORKGROUP)
fn improve(@builtin(global_invocation_id) id: vec3<u32>) {
    load_settings();
    let node = id.x;
    if (node >= nodes) {
        return;
    }
    let s = state_of(node);
    let present = fly(s, bounded(control_of(node)));
    var best = present;
    // The first candidate is the present control.
    for (var k = 1u; k < arrayLength(&candidates); k++) {
        let trial = fly(s, bounded(propose(k, node, s, present, best)));
        if (trial.total < best.total) {
            best = trial;
        }
    }
    for (var c = 0u; c < M; c++) {
        next_controls[node * M + c] = best.control[c];
    }
    for (var i = 0u; i < N; i++) {
        steps[node * STEP + i] = best.foot[i];
    }
    steps[node * STEP + N] = best.cost;
    steps[node * STEP + N + 1u] = best.total;
}

@compute @workgroup_size(WORKGROUP)
fn accept(@builtin(global_invocation_id) id: vec3<u32>) {
    load_settings();
    let node = id.x;
    if (node < nodes) {
        next_values[node] = select(steps[node * STEP + N + 1u], values[node], known[node] == 1u);
    }
}

@compute @workgroup_size(WORKGROUP)
fn evaluate(@builtin(global_invocation_id) id: vec3<u32>) {
    load_settings();
    let node = id.x;
    if (node >= nodes) {
        return;
    }
    if (known[node] == 1u) {
        next_values[node] = values[node];
        return;
    }
    var foot: State;
    for (var i = 0u; i < N; i++) {
        foot[i] = steps[node * STEP + i];
    }
    next_values[node] = min(ceiling, steps[node * STEP + N] + value_at(foot));
}
