//! "Did you mean".

/// The candidate most like `name`, if one is like enough: a difference in case only, or at most one
/// edit in three characters. Names of one letter are never guessed.
pub(crate) fn nearest<'c>(
    name: &str,
    candidates: impl IntoIterator<Item = &'c str>,
) -> Option<&'c str> {
    let length = name.chars().count();
    if length > 64 {
        return None;
    }
    let lower = name.to_lowercase();
    candidates
        .into_iter()
        .filter(|c| *c != name)
        .filter_map(|c| {
            let candidate = c.to_lowercase();
            if candidate == lower {
                return Some((0, c));
            }
            let distance = strsim::damerau_levenshtein(&lower, &candidate);
            let longest = length.max(c.chars().count());
            (longest >= 2 && distance <= (longest / 3).max(1) && distance < longest)
                .then_some((distance, c))
        })
        .min_by_key(|(distance, _)| *distance)
        .map(|(_, c)| c)
}

/// "did you mean `...`?" of the candidate most like a name, if one is like enough.
pub fn did_you_mean<'c>(
    name: &str,
    candidates: impl IntoIterator<Item = &'c str>,
) -> Option<String> {
    nearest(name, candidates).map(|c| format!("did you mean `{c}`?"))
}
