// Elementary functions of `real` (f32 or f64), mirroring src/backend/cpu/real.rs.
//
// WGSL's own are not usable: f64 has none (a driver returns NaN without a word) and f32's are
// allowed errors far above rounding. Shader compilers may re-associate: `(a + b) - a` may become
// `b`, `x - x` may become 0 and `!(x < y)` may become `x >= y` although x is not a number. So
// nothing here recovers a rounding error by subtraction, finiteness is read from bits, and
// conditions are asked in the positive.

struct SinCos {
    sine: real,
    cosine: real,
}

fn is_finite(x: real) -> bool {
    let largest = u32(2 * BIAS + 1);
    return (u32(bitcast<bits>(x) >> MANTISSA) & largest) != largest;
}

fn sin_cos(x: real) -> SinCos {
    let n = round(x * FRAC_2_PI);
    let r = ((x - n * PIO2_0) - n * PIO2_1) - n * PIO2_2;
    let z = r * r;
    let s = r + r * z * sin_polynomial(z);
    let c = (1.0 - 0.5 * z) + z * z * cos_polynomial(z);
    let quadrant = i32(n);
    let swap = (quadrant & 1) == 1;
    let a = select(s, c, swap);
    let b = select(c, s, swap);
    return SinCos(select(a, -a, (quadrant & 2) == 2), select(b, -b, ((quadrant + 1) & 2) == 2));
}

fn sine(x: real) -> real {
    return sin_cos(x).sine;
}

fn cosine(x: real) -> real {
    return sin_cos(x).cosine;
}

// `x = r + k log 2`.
struct SplitExp {
    // e^r - 1
    e: real,
    k: i32,
}

fn split(x: real) -> SplitExp {
    let bounded = min(max(x, UNDERFLOW), OVERFLOW);
    let n = round(bounded * LOG2_E);
    let r = (bounded - n * LN2_0) - n * LN2_1;
    return SplitExp(r + r * r * exp_polynomial(r), i32(n));
}

// 2^k for k within the exponent range.
fn power_of_two(k: i32) -> real {
    return bitcast<real>(bits(u32(k + BIAS)) << MANTISSA);
}

// 2^k x in two factors, so that neither under- nor overflows.
fn scaled(x: real, k: i32) -> real {
    let first = k >> 1u;
    return x * power_of_two(first) * power_of_two(k - first);
}

fn exponential(x: real) -> real {
    let s = split(x);
    let v = scaled(1.0 + s.e, s.k);
    let capped = select(v, v * v, x > OVERFLOW);
    return not_a_number_of(x, select(capped, 0.0, x < UNDERFLOW));
}

fn expm1_(x: real) -> real {
    let s = split(x);
    let v = scaled(1.0 + s.e, s.k) - 1.0;
    let capped = select(v, v * v, x > OVERFLOW);
    return not_a_number_of(x, select(select(capped, -1.0, x < UNDERFLOW), s.e, s.k == 0));
}

// `v`, or `x` where that is not a number.
fn not_a_number_of(x: real, v: real) -> real {
    return select(select(x, v, x <= 0.0), v, x > 0.0);
}

// log(2^k (1 + f)) with 1 + f between sqrt(1/2) and sqrt(2).
fn log_of(f: real, k: real) -> real {
    let s = f / (2.0 + f);
    let z = s * s;
    let half = 0.5 * f * f;
    let low = s * (half + z * log_polynomial(z)) + k * LN2_1;
    return k * LN2_0 + (f - (half - low));
}

fn logarithm(x: real) -> real {
    // Subnormals are scaled up first.
    let small = x < SMALLEST_NORMAL;
    let shifted = bitcast<bits>(select(x, x * SUBNORMAL_SCALE, small)) + ROOT_HALF_TO_ONE;
    let k = i32(shifted >> MANTISSA) - BIAS - select(0, i32(MANTISSA), small);
    let m = bitcast<real>((shifted & MANTISSA_MASK) + ROOT_HALF);
    let v = log_of(m - 1.0, real(k));
    // Infinity and NaN pass through; the root of a negative number is the NaN wanted, -1/0 the
    // infinity.
    let positive = select(x, v, x <= LARGEST);
    return select(select(positive, -1.0 / abs(x), x == 0.0), sqrt(x), x < 0.0);
}

fn log1p_(x: real) -> real {
    let near = abs(x) < 0.25;
    return select(logarithm(1.0 + x), log_of(x, 0.0), near);
}

fn arctangent(x: real) -> real {
    // Reduced to |y| <= tan(pi/8) by atan(x) = pi/4 + atan((x-1)/(x+1)), atan(x) = pi/2 -
    // atan(1/x).
    let size = abs(x);
    let high = size > 2.414213562373095;
    let middle = size > 0.41421356237309503;
    let n = select(select(size, size - 1.0, middle), -1.0, high);
    let d = select(select(1.0, size + 1.0, middle), size, high);
    let base = select(select(0.0, FRAC_PI_4, middle), FRAC_PI_2, high);
    let y = n / d;
    let z = y * y;
    let v = base + (y - y * z * atan_polynomial(z));
    return select(v, -v, x < 0.0);
}

fn sign_(x: real) -> real {
    return select(select(x, 1.0, x > 0.0), -1.0, x < 0.0);
}

fn step_(x: real) -> real {
    return select(real(0.0), 1.0, x > 0.0);
}

// The smaller one; not a number where either is not.
fn least(a: real, b: real) -> real {
    return select(select(a + b, b, b <= a), a, a < b);
}

fn greatest(a: real, b: real) -> real {
    return select(select(a + b, b, b >= a), a, a > b);
}
