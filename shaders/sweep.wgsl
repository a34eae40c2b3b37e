// Whole trajectories, behind block.wgsl.

// A trajectory at its seed.
@compute @workgroup_size(WORKGROUP)
fn start(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = id.x;
    if (i >= control.stride) {
        return;
    }
    var lane: Lane;
    lane.y = load_seed(i);
    begin(&lane, load_run());
    save(i, lane);
    counters[i + 4u * control.stride] = lane.next_level;
    lists[i] = i;
}

// Up to `control.work` loop iterations of every trajectory still on its way.
@compute @workgroup_size(WORKGROUP)
fn sweep(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= control.count) {
        return;
    }
    let i = lists[control.list * control.stride + id.x];
    let run = load_run();
    var lane = load(i);
    if (lane.status != RUNNING) {
        return;
    }
    loop {
        advance(i, &lane, run);
        continuing {
            break if (lane.status != RUNNING) | (lane.work > control.work);
        }
    }
    if (lane.status == EVENT) {
        conclude(i, &lane, run);
    }
    save(i, lane);
    if (lane.status == RUNNING) {
        let at = atomicAdd(&remaining, 1u);
        lists[(1u - control.list) * control.stride + at] = i;
    }
}
