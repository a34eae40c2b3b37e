//! The coordinates of a `[mechanism]`, which make states: known before anything else is read.

use crate::model::Span;
use crate::scenario::reader::Value;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// What follows a coordinate's name in that of its rate.
pub(in super::super) const RATE: &str = "_rate";

/// Most links of a chain.
pub(super) const MOST_LINKS: u32 = 200;

/// How a body may move against its parent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Revolute,
    Prismatic,
    Planar,
    Spherical,
    Floating,
    Fixed,
}

impl Kind {
    pub const NAMES: [(&'static str, Self); 6] = [
        ("revolute", Self::Revolute),
        ("prismatic", Self::Prismatic),
        ("planar", Self::Planar),
        ("spherical", Self::Spherical),
        ("floating", Self::Floating),
        ("fixed", Self::Fixed),
    ];

    /// What is added to a body's name for each coordinate.
    pub fn coordinates(self) -> &'static [&'static str] {
        match self {
            Self::Revolute | Self::Prismatic => &[""],
            Self::Planar => &["_x", "_y", ""],
            Self::Spherical => &["_yaw", "_pitch", "_roll"],
            Self::Floating => &["_x", "_y", "_z", "_yaw", "_pitch", "_roll"],
            Self::Fixed => &[],
        }
    }
}

/// States that a mechanism makes: all coordinates, then all rates, in the order of the bodies.
pub(in super::super) struct Generated {
    pub states: Vec<GeneratedState>,
    /// What stands for a state's table where the scene has none.
    pub empty: Value<'static>,
}

/// A state, and the key of the body that makes it.
pub(in super::super) struct GeneratedState {
    pub name: String,
    pub span: Span,
    pub is_rate: bool,
}

/// The number that a whole number is written as.
fn whole(value: &Value<'_>) -> Option<u32> {
    match value.get_ref() {
        DeValue::Integer(number) => number.as_str().parse().ok(),
        _ => None,
    }
}

/// The names of the links that an entry of `[mechanism.bodies]` makes.
pub(super) fn links(name: &str, chain: Option<u32>) -> Vec<String> {
    match chain {
        Some(count) => (1..=count).map(|k| format!("{name}{k}")).collect(),
        None => vec![name.to_owned()],
    }
}

impl Generated {
    /// Of a file. What is wrong with it is reported where it is read.
    pub fn of(root: &DeTable<'_>) -> Self {
        let mut coordinates = Vec::new();
        let bodies = (root.get("mechanism"))
            .and_then(|m| m.get_ref().as_table())
            .and_then(|m| m.get("bodies"))
            .and_then(|b| b.get_ref().as_table());
        let dependent = (root.get("mechanism"))
            .and_then(|m| m.get_ref().as_table())
            .and_then(|m| m.get("dependent"))
            .and_then(|d| d.get_ref().as_table());
        let is_dependent = |name: &str| dependent.is_some_and(|d| d.contains_key(name));
        for (key, body) in bodies.into_iter().flat_map(DeTable::iter) {
            let Some(table) = body.get_ref().as_table() else {
                continue;
            };
            let kind = (table.get("joint"))
                .and_then(|j| j.get_ref().as_str())
                .and_then(|j| Kind::NAMES.iter().find(|(name, _)| *name == j));
            // One that is wrong is reported once, where it stands.
            let kind = kind.map_or(Kind::Revolute, |(_, kind)| *kind);
            let chain = table
                .get("chain")
                .map(|c| whole(c).unwrap_or(0).min(MOST_LINKS));
            for link in links(key.get_ref(), chain) {
                let all = kind
                    .coordinates()
                    .iter()
                    .map(|tail| format!("{link}{tail}"));
                let free = all.filter(|name| !is_dependent(name));
                coordinates.extend(free.map(|name| (name, key.span())));
            }
        }
        let state = |is_rate: bool| {
            move |(name, span): &(String, Span)| GeneratedState {
                name: format!("{name}{}", if is_rate { RATE } else { "" }),
                span: span.clone(),
                is_rate,
            }
        };
        Self {
            states: (coordinates.iter().map(state(false)))
                .chain(coordinates.iter().map(state(true)))
                .collect(),
            empty: Spanned::new(0..0, DeValue::Table(DeTable::new())),
        }
    }

    /// Whether a state is the rate of a coordinate.
    pub fn is_rate(&self, name: &str) -> bool {
        self.states.iter().any(|s| s.is_rate && s.name == name)
    }

    /// Whether a state's rate follows from the mechanism.
    pub fn contains(&self, name: &str) -> bool {
        self.states.iter().any(|s| s.name == name)
    }
}
