//! Which adapters the work is divided among.

use costate::backend::BackendError;
use costate::backend::adapters::{AdapterInfo, no_adapter};
use costate::low_level::model::Precision;

/// What becomes of the adapters found, by their numbers in the list of `costate adapters`.
#[derive(Debug, Default, PartialEq)]
pub struct Chosen {
    /// Those that do a shard each.
    pub adapters: Vec<usize>,
    /// Those that are left out, and why.
    pub left_out: Vec<(usize, &'static str)>,
}

/// Those that can do the same work, the best kind first; `precision`: what is asked for, if anything
/// is.
///
/// # Errors
/// Where there is none, as for a single adapter.
pub fn choose(found: &[AdapterInfo], precision: Option<Precision>) -> Result<Chosen, BackendError> {
    // The list begins with the best one.
    let best = found.first().ok_or_else(no_adapter)?;
    let why_not = |info: &AdapterInfo| {
        if best.hardware && !info.hardware {
            return Some("it is a software adapter, and there is hardware");
        }
        if info.api != best.api {
            return Some("its devices are there by another interface already");
        }
        // What is asked for by nobody depends on what the adapter has: parts of one whole are of one
        // precision.
        match precision {
            Some(Precision::F32) => None,
            Some(Precision::F64) if !info.f64_arithmetic => Some("it has no f64 arithmetic"),
            None if best.f64_arithmetic && !info.f64_arithmetic => {
                Some("it has no f64 arithmetic, and others do (--precision f32 takes all)")
            }
            _ => None,
        }
    };
    let mut chosen = Chosen::default();
    for (number, info) in found.iter().enumerate() {
        match why_not(info) {
            None => chosen.adapters.push(number),
            Some(why) => chosen.left_out.push((number, why)),
        }
    }
    // The best one is left out for its arithmetic alone, and then so are all.
    if chosen.adapters.is_empty() {
        let adapter = best.name.clone();
        return Err(BackendError::NoF64 { adapter });
    }
    Ok(chosen)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn adapter(api: &str, kind: &'static str, f64_arithmetic: bool) -> AdapterInfo {
        AdapterInfo {
            name: "one".to_owned(),
            api: api.to_owned(),
            driver: String::new(),
            hardware: kind != "software",
            kind,
            f64_arithmetic,
            max_binding: 1 << 30,
            max_buffer: 1 << 30,
        }
    }

    fn left_out(chosen: &Chosen) -> Vec<usize> {
        chosen.left_out.iter().map(|(number, _)| *number).collect()
    }

    #[test]
    fn software_does_its_shard_where_there_is_nothing_else() {
        let card = || adapter("Vulkan", "discrete", true);
        let software = || adapter("Vulkan", "software", true);
        let chosen = choose(&[card(), card(), software()], None).unwrap();
        assert_eq!(chosen.adapters, [0, 1]);
        assert_eq!(left_out(&chosen), [2]);
        let chosen = choose(&[software(), software()], None).unwrap();
        assert_eq!(chosen.adapters, [0, 1]);
        assert!(chosen.left_out.is_empty());
    }

    #[test]
    fn a_device_does_one_shard() {
        let [vulkan, other] = ["Vulkan", "Dx12"].map(|api| adapter(api, "discrete", true));
        let chosen = choose(&[vulkan.clone(), vulkan, other.clone(), other], None).unwrap();
        assert_eq!(chosen.adapters, [0, 1]);
        assert_eq!(left_out(&chosen), [2, 3]);
    }

    #[test]
    fn all_shards_are_of_one_precision() {
        let [with, without] = [true, false].map(|f64| adapter("Vulkan", "discrete", f64));
        let found = [with, without.clone()];
        for precision in [None, Some(Precision::F64)] {
            let chosen = choose(&found, precision).unwrap();
            assert_eq!(chosen.adapters, [0]);
            assert_eq!(left_out(&chosen), [1]);
        }
        let all = choose(&found, Some(Precision::F32)).unwrap();
        assert_eq!(all.adapters, [0, 1]);

        // What one adapter is refused for, all are.
        let found = [without.clone(), without];
        assert_eq!(choose(&found, None).unwrap().adapters, [0, 1]);
        let refused = choose(&found, Some(Precision::F64));
        assert!(matches!(refused, Err(BackendError::NoF64 { .. })));
        assert!(matches!(choose(&[], None), Err(BackendError::NoAdapter)));
    }
}
