//! Random numbers by index, so that a draw does not depend on what was drawn before or on the
//! number of threads.

/// A random number for each index (SplitMix64: Steele, Lea, Flood, OOPSLA 2014).
pub fn random(seed: u64, index: u64) -> u64 {
    let mix = |z: u64| {
        let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    };
    mix(mix(seed.wrapping_add(0x9e37_79b9_7f4a_7c15))
        .wrapping_add(index.wrapping_mul(0x9e37_79b9_7f4a_7c15)))
}

/// A random number in [0, 1) for each index, of 53 bits.
pub fn uniform(seed: u64, index: u64) -> f64 {
    (random(seed, index) >> 11) as f64 / (1u64 << 53) as f64
}
