//! One part of several that a piece of work is divided into, each done by a process of its own.

use std::fmt;
use std::str::FromStr;

/// Most parts.
const MOST: usize = 1_000_000;

/// One part of several: number `m` of `n`, counted from 0.
///
/// Work is divided into units that depend on nothing but what is asked for; which shard does a unit
/// depends on its number alone (see [`owner`](Self::owner)).
///
/// ```
/// use costate::session::Shard;
/// let shard: Shard = "3/8".parse()?;
/// assert_eq!((shard.number(), shard.of()), (3, 8));
/// assert!("8/8".parse::<Shard>().is_err());
/// # Ok::<(), costate::session::ShardError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Shard {
    number: usize,
    of: usize,
}

/// Why there is no such shard.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ShardError {
    /// Not two numbers.
    #[error("`{text}` is not of the form m/n: a shard's number, from 0, and how many there are")]
    Malformed {
        /// What was given.
        text: String,
    },
    /// A number that there is not.
    #[error("there is no shard {number} of {of}: they are numbered from 0 to {}", of.saturating_sub(1))]
    Outside {
        /// The number.
        number: usize,
        /// How many there are.
        of: usize,
    },
    /// None, or more than there may be.
    #[error("work is divided into 1 to {MOST} shards, not into {of}")]
    Count {
        /// How many were asked for.
        of: usize,
    },
}

impl Shard {
    /// Number `number` (from 0) of `of` shards.
    ///
    /// # Errors
    /// [`ShardError::Count`] and [`ShardError::Outside`].
    pub fn new(number: usize, of: usize) -> Result<Self, ShardError> {
        if !(1..=MOST).contains(&of) {
            return Err(ShardError::Count { of });
        }
        if number >= of {
            return Err(ShardError::Outside { number, of });
        }
        Ok(Self { number, of })
    }

    /// Its number, from 0.
    #[must_use]
    pub fn number(self) -> usize {
        self.number
    }

    /// How many there are.
    #[must_use]
    pub fn of(self) -> usize {
        self.of
    }

    /// Which of `of` shards does each of so many units: they are dealt out in turn, in an order in
    /// which no two neighbours need stand together (that of their numbers' hashes).
    #[must_use]
    pub fn owner(units: usize, of: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..units).collect();
        order.sort_by_key(|unit| (mixed(*unit as u64), *unit));
        let mut owner = vec![0; units];
        for (place, unit) in order.into_iter().enumerate() {
            owner[unit] = place % of;
        }
        owner
    }

    /// The units, of so many, that this one does.
    #[must_use]
    pub fn own(self, units: usize) -> Vec<usize> {
        let owner = Self::owner(units, self.of);
        (0..units)
            .filter(|unit| owner[*unit] == self.number)
            .collect()
    }
}

/// A number's bits mixed: the finalizer of SplitMix64 (Steele, Lea, Flood, OOPSLA 2014).
fn mixed(number: u64) -> u64 {
    let mut z = number.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

impl FromStr for Shard {
    type Err = ShardError;

    fn from_str(text: &str) -> Result<Self, ShardError> {
        let malformed = || ShardError::Malformed {
            text: text.to_owned(),
        };
        let number = |text: &str| {
            let is_plain = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
            is_plain.then(|| text.parse().ok()).flatten()
        };
        let (m, n) = text.split_once('/').ok_or_else(malformed)?;
        let (m, n) = number(m).zip(number(n)).ok_or_else(malformed)?;
        Self::new(m, n)
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.number, self.of)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_unit_has_one_owner_and_shares_are_alike() {
        for (units, of) in [(0, 3), (5, 8), (1000, 7), (64, 64)] {
            let mut all: Vec<usize> = (0..of)
                .flat_map(|number| {
                    let own = Shard::new(number, of).unwrap().own(units);
                    assert!(own.len() == units / of || own.len() == units / of + 1);
                    own
                })
                .collect();
            all.sort_unstable();
            assert_eq!(all, (0..units).collect::<Vec<_>>());
        }
        // Neighbours are scattered.
        let owner = Shard::owner(1000, 4);
        let together = owner.windows(2).filter(|pair| pair[0] == pair[1]).count();
        assert!((150..350).contains(&together), "{together}");
    }

    #[test]
    fn what_is_no_shard_is_refused() {
        for text in ["", "3", "3/", "/4", "a/4", "-1/4", "+1/4", "1/4/8", "1 /4"] {
            let malformed = ShardError::Malformed {
                text: text.to_owned(),
            };
            assert_eq!(text.parse::<Shard>(), Err(malformed));
        }
        assert_eq!("0/0".parse::<Shard>(), Err(ShardError::Count { of: 0 }));
        let outside = ShardError::Outside { number: 4, of: 4 };
        assert_eq!("4/4".parse::<Shard>(), Err(outside));
        assert_eq!("3/4".parse::<Shard>().unwrap().to_string(), "3/4");
    }
}
