//! Quantiles by nearest rank.

/// The smallest of `sorted` values (ascending) that at least a `share` of them do not exceed; NaN
/// of nothing.
pub fn nearest_rank(sorted: &[f64], share: f64) -> f64 {
    let rank = (share * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.max(1) - 1).copied().unwrap_or(f64::NAN)
}

/// Median, 99 % and largest of what is a number, by the nearest of the sorted values; NaN of
/// nothing.
pub fn median_p99_max(values: &[f64]) -> [f64; 3] {
    let mut sorted: Vec<f64> = values.iter().copied().filter(|v| !v.is_nan()).collect();
    sorted.sort_by(f64::total_cmp);
    [0.5, 0.99, 1.0].map(|share| {
        let k = (sorted.len().saturating_sub(1) as f64 * share).round() as usize;
        sorted.get(k).copied().unwrap_or(f64::NAN)
    })
}
