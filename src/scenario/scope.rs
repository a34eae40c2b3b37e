//! The names of a scene: what each stands for and what may use it.

use crate::expr::{Fun, Id};
use crate::model::Span;
use rustc_hash::FxHashMap;

/// A set of the kinds of symbols an expression depends on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Kinds(u8);

impl Kinds {
    pub const NONE: Self = Self(0);
    pub const PARAMETER: Self = Self(1);
    pub const STATE: Self = Self(2);
    pub const CONTROL: Self = Self(4);
    pub const DISTURBANCE: Self = Self(8);
    pub const ALL: Self = Self(15);

    pub const fn and(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    pub const fn within(self, allowed: Self) -> bool {
        self.0 & !allowed.0 == 0
    }

    /// Noun of a kind in `self` that is not in `allowed`.
    pub fn outside(self, allowed: Self) -> Option<&'static str> {
        [
            (Self::STATE, "a state"),
            (Self::CONTROL, "a control"),
            (Self::DISTURBANCE, "a disturbance"),
        ]
        .into_iter()
        .chain([(Self::PARAMETER, "a parameter")])
        .find(|(kind, _)| kind.within(self) && !kind.within(allowed))
        .map(|(_, noun)| noun)
    }
}

/// In which section a name is declared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Role {
    Parameter,
    State,
    Control,
    Disturbance,
    Definition,
    /// What follows from the mechanism.
    Quantity,
}

impl Role {
    pub fn noun(self) -> &'static str {
        match self {
            Role::Parameter => "a parameter",
            Role::State => "a state",
            Role::Control => "a control",
            Role::Disturbance => "a disturbance",
            Role::Definition => "a definition",
            Role::Quantity => "a quantity of the mechanism",
        }
    }

    /// The kinds that a name of this role depends on by itself.
    pub fn kinds(self) -> Kinds {
        match self {
            Role::Parameter => Kinds::PARAMETER,
            Role::State => Kinds::STATE,
            Role::Control => Kinds::CONTROL,
            Role::Disturbance => Kinds::DISTURBANCE,
            Role::Definition | Role::Quantity => Kinds::NONE,
        }
    }
}

/// What a declared name stands for at the moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Meaning {
    Known {
        expr: Id,
        kinds: Kinds,
    },
    /// Declared further down than what is being read.
    Later,
    /// Being read.
    Current,
    /// Its own expression is wrong, which has been reported.
    Broken,
}

/// A declared name.
#[derive(Clone, Debug)]
pub(super) struct Entry {
    pub role: Role,
    /// The key that declares it.
    pub span: Span,
    pub meaning: Meaning,
}

/// All declared names.
#[derive(Debug, Default)]
pub(super) struct Scope {
    entries: FxHashMap<String, Entry>,
    order: Vec<String>,
}

impl Scope {
    pub fn get(&self, name: &str) -> Option<&Entry> {
        self.entries.get(name)
    }

    /// Adds a name that is not there yet.
    pub fn declare(&mut self, name: &str, entry: Entry) {
        self.order.push(name.to_owned());
        self.entries.insert(name.to_owned(), entry);
    }

    /// Changes the meaning of a name if it is declared with this role.
    pub fn set(&mut self, name: &str, role: Role, meaning: Meaning) {
        if let Some(entry) = self.entries.get_mut(name).filter(|e| e.role == role) {
            entry.meaning = meaning;
        }
    }

    /// Names in the order of their declaration, those of `role` only if given.
    pub fn names(&self, role: Option<Role>) -> impl Iterator<Item = &str> {
        self.order
            .iter()
            .map(String::as_str)
            .filter(move |n| role.is_none_or(|r| self.entries[*n].role == r))
    }
}

/// Names which the expression language keeps for itself.
pub(super) fn reserved() -> impl Iterator<Item = &'static str> {
    functions().chain(["pi"])
}

/// Names of the functions an expression may call.
pub(super) fn functions() -> impl Iterator<Item = &'static str> {
    (Fun::CALLABLE.iter().map(|(name, _)| *name)).chain(["atan2"])
}
