// Trajectories leg by leg, behind block.wgsl, pieces.wgsl and blend.wgsl and mirroring
// src/closed_loop/charted.rs: at the beginning of a leg the map is asked, and the law `p = q + H s`
// is kept for the leg.
//
// `place_of`, `set_law` and `save_begin` are generated (src/backend/gpu/emit.rs).

// [trajectory][leg of this flight][vector as the leg begins, V], of the first `control.traced`
// trajectories. V is not a number where the map was not asked.
@group(0) @binding(7) var<storage, read_write> traces: array<real>;

// Whether a trajectory is on its way.
fn is_going(status: u32) -> bool {
    return (status == RUNNING) | (status == ASK) | (status == GIVEN);
}

// Sets the law, where it is not given, and begins the leg; a trajectory of which the map does not
// know is lost here.
fn begin_leg(i: u32, lane: ptr<function, Lane>, run: Run) {
    var v = not_a_number();
    if ((*lane).status == ASK) {
        let said = chart(place_of((*lane).y, (*lane).leg, run));
        (*lane).work += spent;
        if ((said.how != IN_PIECES) & (said.how != NEAR)) {
            (*lane).status = LOST;
            (*lane).t = 0.0;
            return;
        }
        set_law(lane, said);
        v = said.v;
    }
    if (i < control.traced) {
        trace((i * control.room + (*lane).begun) * (DIM + 1u), (*lane).y, v);
    }
    (*lane).begun += 1u;
    save_begin(i, (*lane).y);
    begin(lane, run);
}

// Goes on to the next leg, if there is one and this flight has room for it.
fn end_leg(lane: ptr<function, Lane>) {
    if ((*lane).leg + 1u < control.legs) {
        (*lane).leg += 1u;
        (*lane).status = select(ASK, PAUSED, (*lane).begun >= control.room);
    }
}

// Up to about `control.work` loop iterations of every trajectory still on its way.
@compute @workgroup_size(WORKGROUP)
fn sweep(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= control.count) {
        return;
    }
    let i = lists[control.list * control.stride + id.x];
    let run = load_run();
    var lane = load(i);
    if (!is_going(lane.status)) {
        return;
    }
    loop {
        // Neighbouring invocations ask together, and wait for the one that takes most steps.
        if (lane.status != RUNNING) {
            begin_leg(i, &lane, run);
        }
        loop {
            if (lane.status == RUNNING) {
                advance(i, &lane, run);
            }
            continuing {
                break if (lane.status != RUNNING) | (lane.work > control.work);
            }
        }
        if (lane.status == EVENT) {
            conclude(i, &lane, run);
        }
        if (lane.status == REACHED) {
            end_leg(&lane);
        }
        continuing {
            break if (!is_going(lane.status)) | (lane.work > control.work);
        }
    }
    save(i, lane);
}

// Lists the trajectories still on their way.
@compute @workgroup_size(WORKGROUP)
fn gather(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= control.count) {
        return;
    }
    let i = lists[control.list * control.stride + id.x];
    if (is_going(counters[i])) {
        let at = atomicAdd(&remaining, 1u);
        lists[(1u - control.list) * control.stride + at] = i;
    }
}
