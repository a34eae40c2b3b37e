// The integrator, mirroring src/backend/cpu/block/: an invocation follows one trajectory through a
// bounded number of attempted steps and keeps it in storage buffers in between (sweep.wgsl; with
// LEGS legs.wgsl, of which the law of a trajectory is set anew at the beginning of each).
//
// `Vector`, `Inputs`, `Step`, `attempt`, `interpolate` and what else is not here are generated
// (src/backend/gpu/emit.rs). Lines from `//if` to `//end` are kept where the condition holds.

struct Control {
    // Entries of the list of trajectories still on their way, and which of the two lists it is.
    count: u32,
    list: u32,
    // Trajectories of the batch.
    stride: u32,
    // Loop iterations an invocation may spend in this dispatch.
    work: u32,
    max_steps: u32,
    levels: u32,
//if LEGS
    // Legs of a trajectory in all, those that it may fly in this flight, and how many of the first
    // are traced.
    legs: u32,
    room: u32,
    traced: u32,
//end
}

@group(0) @binding(0) var<uniform> control: Control;
// See the offsets among the generated constants.
@group(0) @binding(1) var<storage, read> settings: array<real>;
// [field][trajectory]: y, k, t, h, before, first_step; with kinks also resume, sides; of legs y at
// the beginning.
@group(0) @binding(2) var<storage, read_write> state: array<real>;
// [field][trajectory]: status, next_level, steps, rejected, first_level; of legs the leg and how
// many were begun instead of that.
@group(0) @binding(3) var<storage, read_write> counters: array<u32>;
// [list][entry]: trajectories still on their way.
@group(0) @binding(4) var<storage, read_write> lists: array<u32>;
// Entries of the list being written.
@group(0) @binding(5) var<storage, read_write> remaining: atomic<u32>;
// [component, then time][trajectory].
@group(0) @binding(6) var<storage, read_write> ends: array<real>;
//if STORE
// [trajectory][level][time, then components but the coordinate].
@group(0) @binding(7) var<storage, read_write> samples: array<real>;
//end

fn not_a_number() -> real {
    return sqrt(-1.0 - abs(settings[0]));
}

// A trajectory between steps.
struct Lane {
    y: Vector,
    // Derivative at y.
    k: Vector,
    t: real,
    h: real,
    // Base-2 logarithm of the squared error of the step before; of Taylor steps how far that one
    // reached.
    before: f32,
    first_step: real,
    status: u32,
    next_level: u32,
    steps: u32,
    rejected: u32,
    // The level after those passed; kept here because it is read at every step.
    level: real,
    // Loop iterations spent in this dispatch.
    work: u32,
//if KINKS
    // Step size to go on with behind a kink; 0 where none is ahead.
    resume: real,
    // Values of the kinks at y.
    sides: Sides,
//end
//if LEGS
    // The leg, and how many were begun in this flight.
    leg: u32,
    begun: u32,
//end
}

fn level(k: u32) -> real {
    return settings[LEVELS + min(k, control.levels - 1u)];
}

// A step that does not pass the end where the end is a time.
fn limited(run: Run, t: real, h: real) -> real {
//if BY_TIME
    let left = run.last - t;
    // Stretched a little, so that no tiny step is left at the end.
    return select(h, left, h * 1.001 >= left);
//end
//if BY_COMPONENT
    return h;
//end
}

struct Decision {
    accepted: bool,
    finite: bool,
    next_h: real,
    before: f32,
//if KINKS
    resume: real,
    // Values of the kinks at the end of the step.
    sides: Sides,
//end
}

// Accepts or rejects a lane's step and chooses its next size.
fn decide(lane: Lane, step: Step) -> Decision {
    var decided: Decision;
    let finite = is_finite(step.error);
    decided.finite = finite;
//if FIXED
    decided.accepted = finite;
    decided.next_h = lane.h;
    decided.before = lane.before;
//end
//if TAYLOR
    // The next expansion says how far it reaches.
    decided.accepted = finite;
    decided.next_h = select(lane.h * real(SHRINK), LARGEST, finite);
    decided.before = select(lane.before, f32(step.reach), finite);
//end
//if ADAPTIVE RUNGE_KUTTA
    let accepted = select(false, step.error < 1.0, finite);
    // Squared errors: the exponents are halved.
    let log_e = log2(max(select(1.0, f32(step.error), finite), LEAST_SQUARED_ERROR));
    let pi = HALF_BETA * lane.before - HALF_ALPHA * log_e;
    let factor = SAFETY * exp2(select(-HALF_REFUSED * log_e, pi, accepted));
    let bounded = max(min(factor, select(1.0, GROW, accepted)), SHRINK);
    decided.accepted = accepted;
    decided.next_h = lane.h * real(select(SHRINK, bounded, finite));
    decided.before = select(lane.before, log_e, accepted);
//end
//if KINKS
    meet_kinks(&decided, lane, step);
//end
    return decided;
}

//if KINKS
// Refuses a step with a kink well inside, in favour of one that ends there.
fn meet_kinks(decided: ptr<function, Decision>, lane: Lane, step: Step) {
    let sides = kink_values(inputs_of(step.y));
    let q = first_kink(lane.sides, sides);
    let accepted = (*decided).accepted;
    // A share of the step that kinks have not shortened, and no less than the floor: what is left
    // of shorter ones is lost in rounding.
    let near = max(AT_KINK * max(lane.h, lane.resume), FLOOR * max(lane.t, lane.first_step));
    let inside = accepted & (lane.h * q > near) & (lane.h * (1.0 - q) > near);
    let crosses = select(accepted & (q < 2.0), false, inside);
    // The end of the shorter step is to lie behind the kink, not before it.
    let shorter = lane.h * q + 0.1 * near;
    let grown = max((*decided).next_h, lane.resume);
    (*decided).accepted = select(accepted, false, inside);
    (*decided).next_h = select(select((*decided).next_h, grown, crosses), shorter, inside);
    (*decided).resume = select(select(lane.resume, 0.0, crosses), max(lane.resume, lane.h), inside);
    (*decided).sides = sides;
}
//end

// The lane's step as attempted: a Taylor step finds out how far it goes.
fn take(lane: ptr<function, Lane>, run: Run) -> Step {
    let step = attempt(*lane, run);
//if TAYLOR
    (*lane).h = step.h;
//end
    return step;
}

// One attempted step. A step that ends the trajectory in its middle, once in a trajectory, is left
// to `conclude`.
//
// Some devices run both sides of a condition and every loop at least once. So what is rare stands
// outside the loop over steps, and loops ask at their end whether to go on.
fn advance(i: u32, lane: ptr<function, Lane>, run: Run) {
    let step = take(lane, run);
    let decided = decide(*lane, step);
    (*lane).work += 1u;
    if (decided.accepted) {
//if LEGS
        if (ends_leg(*lane, step, run)) {
            (*lane).y = step.y;
            (*lane).t += (*lane).h;
            (*lane).steps += 1u;
            (*lane).status = REACHED;
            return;
        }
//end
        if (eventful(*lane, step, run)) {
            (*lane).status = EVENT;
            return;
        }
//if STORE
        let dense = densify((*lane).y, (*lane).k, step, (*lane).h);
        let passed = pass_levels(i, lane, step, dense, 1.0, run);
        if (passed.out_of_work) {
            return;
        }
//end
//if STORE BOUNDS
        if (passed.outside) {
            leave(lane, step, dense, passed.last);
            return;
        }
//end
        commit(lane, step, decided, run);
    } else {
        (*lane).rejected += 1u;
        (*lane).h = decided.next_h;
//if KINKS
        // A kink refuses a step whose error is accepted: that error counts.
        (*lane).before = decided.before;
        (*lane).resume = decided.resume;
//end
//if ADAPTIVE
        if ((*lane).h < FLOOR * max((*lane).t, (*lane).first_step)) {
            (*lane).status = select(NOT_FINITE, STEP_FLOOR, decided.finite);
        }
//end
//if FIXED
        (*lane).status = NOT_FINITE;
//end
    }
    if ((*lane).status == RUNNING) {
        if ((*lane).steps + (*lane).rejected >= control.max_steps) {
            (*lane).status = STEP_LIMIT;
        }
    }
}

// Whether a guard or the last level ends the trajectory in an accepted step.
fn eventful(lane: Lane, step: Step, run: Run) -> bool {
    let over = coordinate(step.y, lane.t + lane.h) >= run.last;
//if GUARDS
    return select(true, over, guards_hold(inputs_of(step.y)));
//end
//if UNGUARDED
    return over;
//end
}

//if LEGS
// Whether an accepted step ends where the leg does, as most legs' only one does: then nothing is to
// be located in it.
fn ends_leg(lane: Lane, step: Step, run: Run) -> bool {
    let ends = lane.t + lane.h == run.last;
//end
//if LEGS GUARDS
    return select(false, ends, guards_hold(inputs_of(step.y)));
//end
//if LEGS UNGUARDED
    return ends;
//end
//if LEGS
}
//end

// Moves on to the end of an accepted step.
fn commit(lane: ptr<function, Lane>, step: Step, decided: Decision, run: Run) {
//if TAYLOR
    let floor = FLOOR * max((*lane).t, (*lane).first_step);
//end
    (*lane).steps += 1u;
    (*lane).before = decided.before;
    (*lane).t += (*lane).h;
    (*lane).y = step.y;
//if RUNGE_KUTTA
    (*lane).k = step.LAST_STAGE;
//end
//if KINKS
    (*lane).resume = decided.resume;
    (*lane).sides = decided.sides;
//end
//if BOUNDS
    if (within(step.y, run)) {
    } else {
        (*lane).status = LEFT_REGION;
        return;
    }
//end
//if CEILING
    if (step.y.CEILING_COMPONENT >= run.ceiling) {
        (*lane).status = REACHED;
        return;
    }
//end
//if TAYLOR
    if ((*lane).h < floor) {
        (*lane).status = STEP_FLOOR;
        return;
    }
//end
    (*lane).h = limited(run, (*lane).t, decided.next_h);
}

//if TAYLOR
// The exponent of a number that is not negative; above BIAS where it is not finite.
fn exponent_of(x: real) -> i32 {
    return i32(bitcast<bits>(x) >> MANTISSA) - BIAS;
}

// Base-2 logarithm of a number that is not negative, whatever its size: coefficients of high order
// exceed f32's range. What is below LEAST_LOG2 stops no step.
fn log2_of(x: real) -> f32 {
    let one = bits(u32(BIAS)) << MANTISSA;
    let m = bitcast<real>((bitcast<bits>(x) & MANTISSA_MASK) | one);
    return max(f32(exponent_of(x)) + log2(f32(m)), LEAST_LOG2);
}

// The step at which the last coefficients of an expansion are as large as the tolerance, from the
// largest of them in units of it; 0 where they are not finite. Where a solution is a polynomial they
// say nothing: steps grow by a bounded factor.
fn reach_of(below: real, top: real, lane: Lane) -> real {
    let finite = max(exponent_of(below), exponent_of(top)) <= BIAS;
    let a = exp2(-TO_LAST_BUT_ONE * log2_of(below));
    let b = exp2(-TO_LAST * log2_of(top));
    let most = select(lane.first_step * real(BEGIN), real(lane.before) * real(GROW), lane.before > 0.0);
    return select(0.0, min(real(TAYLOR_SAFETY * min(a, b)), most), finite);
}
//end

// Takes the lane's step again and ends the trajectory at the first guard or the last level in it.
fn conclude(i: u32, lane: ptr<function, Lane>, run: Run) {
    let step = take(lane, run);
    let dense = densify((*lane).y, (*lane).k, step, (*lane).h);
    var most: real = 1.0;
    var ended = RUNNING;
//if GUARDS
    if (guards_hold(inputs_of(step.y))) {
    } else {
        most = last_inside(lane, step, dense);
        ended = GUARD;
    }
//end
    let passed = pass_levels(i, lane, step, dense, most, run);
    (*lane).status = RUNNING;
    if (passed.out_of_work) {
        return;
    }
//if STORE BOUNDS
    if (passed.outside) {
        leave(lane, step, dense, passed.last);
        return;
    }
//end
    if ((*lane).next_level == control.levels) {
        most = passed.last;
        ended = REACHED;
    }
    if (ended == RUNNING) {
        // This copy of the step may be rounded differently: then it ends short of the event, and
        // the next one meets it.
        commit(lane, step, decide(*lane, step), run);
        return;
    }
    (*lane).y = interpolate((*lane).y, dense, step, (*lane).h, most);
//if BY_COMPONENT
    // A level that ends the trajectory is met by definition.
    if (ended == REACHED) {
        (*lane).y.COORDINATE = run.last;
    }
//end
    (*lane).t += most * (*lane).h;
    (*lane).steps += 1u;
    (*lane).status = ended;
}

//if STORE BOUNDS
// Ends a trajectory at a stored point outside the region.
fn leave(lane: ptr<function, Lane>, step: Step, dense: Dense, q: real) {
    (*lane).y = interpolate((*lane).y, dense, step, (*lane).h, q);
    (*lane).t += q * (*lane).h;
    (*lane).steps += 1u;
    (*lane).status = LEFT_REGION;
}
//end

struct Passed {
    // Fraction of the step at the last level passed.
    last: real,
    // The point stored there is outside the region.
    outside: bool,
    // The dispatch's work is used up: the step must be taken again for the levels left.
    out_of_work: bool,
}

// Whether the lane's next level is passed where the coordinate has come to `finish`.
fn is_passed(lane: Lane, finish: real) -> bool {
    return (lane.next_level < control.levels) & (lane.level <= finish);
}

// The levels up to the fraction `most` of an accepted step.
fn pass_levels(i: u32, lane: ptr<function, Lane>, step: Step, dense: Dense, most: real, run: Run) -> Passed {
    let t = (*lane).t;
    let h = (*lane).h;
    let begin = coordinate((*lane).y, t);
    let finish = coordinate(step.y, t + h);
    var pending = is_passed(*lane, finish);
    var last: real = 1.0;
    var outside = false;
    var out_of_work = false;
    loop {
        if (pending) {
//if BY_TIME
            let q = select(((*lane).level - begin) / (finish - begin), 1.0, (*lane).level == finish);
//end
//if BY_COMPONENT
            let q = locate(lane, dense, h, begin, finish);
//end
            pending = q <= most;
            if (pending) {
//if STORE
                let stored = store_sample(i, lane, step, dense, q);
//end
//if STORE BOUNDS
                if ((*lane).next_level + 1u < control.levels) {
                    if (within(stored, run)) {
                    } else {
                        outside = true;
                    }
                }
//end
                last = q;
                (*lane).next_level += 1u;
                (*lane).level = level((*lane).next_level);
                pending = select(is_passed(*lane, finish), false, outside);
            }
            if ((*lane).work > control.work) {
                out_of_work = pending;
                pending = false;
            }
        }
        continuing {
            break if !pending;
        }
    }
    return Passed(last, outside, out_of_work);
}

//if BY_COMPONENT
// Fraction of the step at which the coordinate takes the lane's level, by Newton's method kept
// within a bracket.
fn locate(lane: ptr<function, Lane>, dense: Dense, h: real, begin: real, finish: real) -> real {
    let level = (*lane).level;
    let guess = (level - begin) / (finish - begin);
    var lo: real = 0.0;
    var hi: real = 1.0;
    var q = select(guess, 1.0, level >= finish);
    var left = select(30u, 1u, level >= finish);
    loop {
        let at = along(dense, q);
        let residual = (begin - level) + at.way * h;
        let above = residual > 0.0;
        hi = select(hi, q, above);
        lo = select(q, lo, above);
        let newton = q - residual / (at.slope * h);
        // A root at a bracket's end may be missed by rounding; halving the bracket then would lead
        // away from it.
        let inside = (newton >= lo - 4.0 * EPSILON) & (newton <= hi + 4.0 * EPSILON);
        let next = select(0.5 * (lo + hi), newton, inside);
        left = select(left - 1u, 0u, abs(next - q) <= 2.0 * EPSILON);
        q = next;
        (*lane).work += 1u;
        continuing {
            break if left == 0u;
        }
    }
    // The end of the step is found without a search.
    q = select(q, 1.0, level >= finish);
    return q;
}
//end

//if GUARDS
// Largest fraction of the step, to rounding, up to which the guards hold.
fn last_inside(lane: ptr<function, Lane>, step: Step, dense: Dense) -> real {
    var lo: real = 0.0;
    var hi: real = 1.0;
    loop {
        let middle = 0.5 * (lo + hi);
        let holds = guards_hold(inputs_of(interpolate((*lane).y, dense, step, (*lane).h, middle)));
        lo = select(lo, middle, holds);
        hi = select(middle, hi, holds);
        (*lane).work += 1u;
        continuing {
            break if hi - lo <= 4.0 * EPSILON;
        }
    }
    return lo;
}
//end

//if STORE
fn store_sample(i: u32, lane: ptr<function, Lane>, step: Step, dense: Dense, q: real) -> Vector {
    let at = (i * control.levels + (*lane).next_level) * SAMPLE;
    samples[at] = (*lane).t + q * (*lane).h;
    let y = interpolate((*lane).y, dense, step, (*lane).h, q);
    store_vector(at + 1u, y);
    return y;
}
//end

// Derivative, first step and first level at the lane's vector, at time 0.
fn begin(lane: ptr<function, Lane>, run: Run) {
    (*lane).k = rate(inputs_of((*lane).y));
    (*lane).t = 0.0;
    (*lane).before = 0.0;
    (*lane).steps = 0u;
    (*lane).rejected = 0u;
    (*lane).next_level = 0u;
//if KINKS
    (*lane).resume = 0.0;
    (*lane).sides = kink_values(inputs_of((*lane).y));
//end
    let first_coordinate = coordinate((*lane).y, 0.0);
    loop {
        if ((*lane).next_level >= control.levels) {
            break;
        }
        if (level((*lane).next_level) > first_coordinate) {
            break;
        }
        (*lane).next_level += 1u;
    }
    (*lane).level = level((*lane).next_level);
    (*lane).status = RUNNING;
    if (is_finite(total((*lane).k))) {
        if ((*lane).next_level == control.levels) {
            (*lane).status = REACHED;
        }
    } else {
        (*lane).status = NOT_FINITE;
    }
//if ADAPTIVE
    let first = FIRST * norm((*lane).y, (*lane).y, run) / norm((*lane).k, (*lane).y, run);
    // At rest there is nothing to follow, but a finite step keeps the arithmetic going to the step
    // limit.
    (*lane).first_step = FIRST;
    if (is_finite(first)) {
        (*lane).first_step = select(FIRST, first, first > 0.0);
    }
//end
//if FIXED
    (*lane).first_step = run.step;
//end
//if TAYLOR
    (*lane).h = limited(run, 0.0, LARGEST);
//end
//if RUNGE_KUTTA
    // Of an adaptive method 0 where the first step is not given.
    (*lane).h = limited(run, 0.0, select((*lane).first_step, run.step, run.step > 0.0));
//end
}
