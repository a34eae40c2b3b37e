//! What a part says of the whole that it is of.

use super::super::Provenance;
use crate::model::Model;
use crate::result::Stored;
use crate::session::{Session, Shard, States, StatesAsked, Wanted};
use crate::sweep::Numerics;
use crate::value::may_use_sweep;
use serde::{Deserialize, Serialize};

/// What was asked for, beside the scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Asked {
    /// Whether the states are a list of the user's own, else those of the scene.
    pub listed: bool,
    /// The states of `[map]` alone.
    pub of_map: bool,
    /// One solution a state is enough.
    pub one_sheet: bool,
    /// Stored points of the trajectory from each state.
    pub samples: Option<usize>,
    /// First guesses also come from V on a grid.
    pub grid_guesses: bool,
    /// What tells the sweep that first guesses are taken from, if one is given.
    #[serde(default)]
    pub archive: Option<String>,
    /// States in all.
    pub rows: usize,
    /// How many of them, from the first on, belong to `/points`.
    pub points: usize,
    /// A hash of all states' bits.
    pub states: String,
    /// Of closed loops what they are of.
    #[serde(default)]
    pub loops: Option<Loops>,
    /// Of a sweep what is kept of its trajectories.
    #[serde(default)]
    pub kept: Option<String>,
}

/// Closed loops from the initial states of `[closed_loop]`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Loops {
    /// So many initial states at random.
    pub random: Option<usize>,
    /// Their seed.
    pub seed: u64,
    /// V at them is solved for.
    pub solve: bool,
    /// The laws' names.
    pub laws: Vec<String>,
    /// What laws and V are taken from: a hash.
    pub from: String,
}

impl Asked {
    /// All but the states themselves, in words.
    fn in_words(&self) -> String {
        if let Some(loops) = &self.loops {
            let states = match loops.random {
                Some(count) => format!("{count} random states of seed {}", loops.seed),
                None => "the scene's initial states".to_owned(),
            };
            let values = match loops.solve {
                true => ", V solved for",
                false => "",
            };
            return format!("laws {} from {states}{values}", loops.laws.join(", "));
        }
        if let Some(kept) = &self.kept {
            return format!("trajectories, {kept}");
        }
        let of = match (self.listed, self.of_map) {
            (true, _) => "of a list",
            (false, true) => "of [map]",
            (false, false) => "of [homotopy] and [map]",
        };
        let sheets = match self.one_sheet {
            true => "one solution each",
            false => "every sheet",
        };
        let mut words = format!("{of}, {sheets}");
        if let Some(samples) = self.samples {
            words += &format!(", trajectories of {samples} points");
        }
        if self.grid_guesses {
            words += ", guesses from a grid";
        }
        if let Some(archive) = &self.archive {
            words += &format!(", guesses from the sweep {archive}");
        }
        words
    }
}

/// What is divided.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// States that are solved for, in blocks.
    #[default]
    States,
    /// Variants of a study.
    Study,
    /// Initial states of closed loops.
    ClosedLoop,
    /// Levels of attenuation.
    Attenuation,
    /// A sweep, by parts of the surface of seeds.
    Sweep,
}

impl Kind {
    fn in_words(self) -> &'static str {
        match self {
            Self::States => "states that are solved for",
            Self::Study => "variants of a study",
            Self::ClosedLoop => "closed loops",
            Self::Attenuation => "levels of attenuation",
            Self::Sweep => "a sweep",
        }
    }
}

/// What a file is a part of: those of one whole differ in `shard` alone.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// What is divided.
    pub of: Kind,
    /// This part's number, from 0.
    pub shard: usize,
    /// How many parts there are.
    pub shards: usize,
    /// How many units of work there are in all.
    pub units: usize,
    /// The program's version.
    pub version: String,
    /// The commit that it was built from.
    pub revision: String,
    /// A hash of the scene's text with what `--set` replaced.
    pub scene: String,
    /// What was asked for beside it.
    pub asked: Asked,
    /// What integrated.
    pub backend: String,
    /// In which arithmetic.
    pub precision: String,
    /// By which method.
    pub method: String,
    /// The relative tolerance asked for.
    pub rtol: f64,
}

impl Manifest {
    /// Of a part of so many units, without what was asked for and how exactly.
    pub(super) fn begun(
        of: Kind,
        session: &Session<'_>,
        (shard, units): (Option<Shard>, usize),
        provenance: &Provenance,
    ) -> Self {
        Self {
            of,
            shard: shard.map_or(0, Shard::number),
            shards: shard.map_or(1, Shard::of),
            units,
            version: env!("CARGO_PKG_VERSION").to_owned(),
            revision: provenance.git_revision.clone(),
            scene: of_scene(&session.scene().model),
            backend: session.backend().name().to_owned(),
            ..Self::default()
        }
    }

    /// Of a part of the states that a session solves for.
    pub(in crate::run) fn of(
        session: &Session<'_>,
        wanted: &Wanted,
        states: &StatesAsked<'_>,
        provenance: &Provenance,
    ) -> Self {
        let StatesAsked {
            plan,
            targets,
            units,
        } = states;
        let (one_sheet, samples) = match &wanted.states {
            States::Listed(listed) => (listed.one_sheet, listed.samples),
            _ => (false, None),
        };
        let bits = targets.all();
        Self {
            asked: Asked {
                listed: targets.listed,
                of_map: wanted.states == States::OfMap,
                one_sheet,
                samples,
                grid_guesses: wanted.grid_guesses,
                archive: (wanted.archive.as_ref())
                    .filter(|_| may_use_sweep(plan))
                    .map(|given| given.of.clone()),
                rows: targets.count(),
                points: targets.points(),
                states: of_numbers(&bits),
                ..Asked::default()
            },
            precision: plan.spec.precision.name().to_owned(),
            method: plan.method().name().to_owned(),
            rtol: plan.rtol_asked,
            ..Self::begun(Kind::States, session, (wanted.shard, *units), provenance)
        }
    }

    /// Of a part of what a scene asks for, of so many units.
    pub(in crate::run) fn of_units(
        of: Kind,
        session: &Session<'_>,
        (shard, units): (Option<Shard>, usize),
        provenance: &Provenance,
    ) -> Self {
        let (model, choices) = (&session.scene().model, &session.choices);
        let precision = choices.precision.or(model.integrator.precision);
        let method = choices.method.or(model.integrator.method);
        Self {
            asked: Asked {
                rows: units,
                ..Asked::default()
            },
            precision: precision.map_or("auto", |p| p.name()).to_owned(),
            method: method.map_or("auto", |method| method.name()).to_owned(),
            rtol: choices.rtol.unwrap_or(model.integrator.rtol),
            ..Self::begun(of, session, (shard, units), provenance)
        }
    }

    /// Of a part of closed loops, of so many units; from states (`[state][component]`), and how
    /// many.
    pub(in crate::run) fn of_loops(
        session: &Session<'_>,
        (shard, units): (Option<Shard>, usize),
        (loops, (states, count), numerics): (Loops, (&[f64], usize), Numerics),
        provenance: &Provenance,
    ) -> Self {
        let (model, choices) = (&session.scene().model, &session.choices);
        let method = choices.method.or(model.integrator.method);
        Self {
            asked: Asked {
                rows: count,
                states: of_numbers(states),
                loops: Some(loops),
                ..Asked::default()
            },
            precision: numerics.precision.name().to_owned(),
            method: method.map_or("auto", |method| method.name()).to_owned(),
            rtol: numerics.rtol_asked,
            ..Self::begun(Kind::ClosedLoop, session, (shard, units), provenance)
        }
    }

    /// That of a file; `None` where it is no part of anything.
    #[must_use]
    pub fn read(stored: &Stored) -> Option<Self> {
        serde_json::from_str(&stored.attribute(super::MANIFEST)?).ok()
    }

    /// That of a whole; `None` where a file does not tell what it is the whole of.
    #[must_use]
    pub fn of_whole(stored: &Stored) -> Option<Self> {
        serde_json::from_str(&stored.attribute(super::WHOLE)?).ok()
    }

    /// The same of all that it is a part of.
    #[must_use]
    pub fn whole(&self) -> Self {
        Self {
            shard: 0,
            shards: 1,
            ..self.clone()
        }
    }

    /// What tells another part of another whole, in words, with both; `None` where they are of one.
    #[must_use]
    pub fn differs(&self, other: &Self) -> Option<(&'static str, String, String)> {
        let a = self.named();
        let b = other.named();
        (a.into_iter().zip(b))
            .find(|((_, a), (_, b))| a != b)
            .map(|((what, a), (_, b))| (what, a, b))
    }

    /// What is the same in all parts, in words.
    fn named(&self) -> [(&'static str, String); 12] {
        let asked = &self.asked;
        [
            ("kind of work", self.of.in_words().to_owned()),
            ("version of costate", self.version.clone()),
            ("commit that costate was built from", self.revision.clone()),
            ("scene (with --set)", self.scene.clone()),
            ("number of shards", self.shards.to_string()),
            ("number of states", asked.rows.to_string()),
            ("list of states", asked.states.clone()),
            ("what is asked of the states", asked.in_words()),
            (
                "backend and precision",
                format!("{}, {}", self.backend, self.precision),
            ),
            (
                "method and tolerance",
                format!("{}, {:e}", self.method, self.rtol),
            ),
            (
                "what laws and V are taken from",
                asked
                    .loops
                    .as_ref()
                    .map_or_else(String::new, |l| l.from.clone()),
            ),
            ("number of units", self.units.to_string()),
        ]
    }
}

/// Of a scene's text and what replaces its parameters.
fn of_scene(model: &Model) -> String {
    let replaced = model.overrides.iter().map(|(n, v)| format!("\n{n}={v}"));
    let text: String = std::iter::once(model.text.clone())
        .chain(replaced)
        .collect();
    hash_of(text.bytes())
}

/// Of the bits of numbers.
fn of_numbers(numbers: &[f64]) -> String {
    hash_of(numbers.iter().flat_map(|x| x.to_bits().to_le_bytes()))
}

/// FNV-1a of 64 bits (Fowler, Noll, Vo; draft-eastlake-fnv), in hexadecimal: tells apart what was
/// not meant to be alike.
pub(in crate::run) fn hash_of(bytes: impl IntoIterator<Item = u8>) -> String {
    let hash = (bytes.into_iter()).fold(0xcbf2_9ce4_8422_2325u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    });
    format!("{hash:016x}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hashes_are_those_of_the_reference() {
        assert_eq!(hash_of(*b""), "cbf29ce484222325");
        assert_eq!(hash_of(*b"foobar"), "85944171f73967e8");
    }

    #[test]
    fn parts_of_one_whole_differ_in_their_number_alone() {
        let one = Manifest {
            shards: 4,
            ..Manifest::default()
        };
        let other = Manifest {
            shard: 2,
            ..one.clone()
        };
        assert_eq!(one.differs(&other), None);
        let more = Manifest { shards: 8, ..other };
        let (what, a, b) = one.differs(&more).expect("another count");
        assert_eq!(
            (what, a.as_str(), b.as_str()),
            ("number of shards", "4", "8")
        );
    }
}
