//! Quantiles by nearest rank.

/// The smallest of `sorted` values (ascending) that at least a `share` of them do not exceed; NaN
/// of nothing.
pub fn nearest_rank(sorted: &[f64], share: f64) -> f64 {
    let rank = (share * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.max(1) - 1).copied().unwrap_or(f64::NAN)
}
