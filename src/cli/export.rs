//! `costate export`: a value function as a C header.

use super::report::Terminal;
use super::run::default_output;
use super::{CliError, ExportArgs};
use crate::feedback::{Known, value_header};
use crate::hamiltonian::{Hamiltonian, System};
use crate::local::{LocalError, LocalPolynomial, Riccati};
use crate::map::ValueMap;
use crate::model::{Horizon, Model};
use crate::output::{Stored, write_text};
use serde_json::{Value, json};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Why nothing was exported.
#[derive(Debug, thiserror::Error)]
pub(super) enum ExportError {
    #[error(
        "{path} has no map in pieces: give the scene [map] with error = ... and run it again (--local exports the series about the equilibrium)", path = path.display()
    )]
    NoMap { path: PathBuf },
    #[error("{path} is a scene, and a map is in a result file: run it first (--local exports the series about the equilibrium)", path = path.display())]
    Scene { path: PathBuf },
    #[error("a finite horizon has no equilibrium, and so no series about it")]
    Finite,
    #[error(transparent)]
    Local(#[from] LocalError),
}

/// A header, and what is said of it.
struct Made {
    text: String,
    said: String,
    summary: Value,
}

pub(super) fn export(args: &ExportArgs) -> Result<(), CliError> {
    super::check_out(args.out.as_deref(), &["h"], &[&args.file])?;
    let scene = args.file.extension().is_some_and(|e| e.eq_ignore_ascii_case("toml"));
    if !scene && !args.set.is_empty() {
        return Err(CliError::SetOfResult);
    }
    let name = args.name.as_deref().unwrap_or(if args.local { "local" } else { "map" });
    let made = match (scene, args.local) {
        (true, false) => {
            return Err(ExportError::Scene {
                path: args.file.clone(),
            }
            .into());
        }
        (true, true) => {
            let (model, hamiltonian) = super::check::derived(crate::scenario::load(&args.file, &args.set)?)?;
            local(name, &model, &hamiltonian, args.degree)?
        }
        (false, true) => {
            let stored = Stored::open(&args.file)?;
            local(name, &stored.model, &stored.hamiltonian, args.degree)?
        }
        (false, false) => map(name, &args.file)?,
    };
    let path = args.out.clone().unwrap_or_else(|| {
        let beside = if scene {
            default_output(&args.file)
        } else {
            args.file.clone()
        };
        let stem = beside.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        beside.with_file_name(format!("{stem}_{name}.h"))
    });
    if let Some(directory) = path.parent().filter(|d| !d.as_os_str().is_empty()) {
        std::fs::create_dir_all(directory).map_err(|source| CliError::OutDir {
            path: directory.to_owned(),
            source,
        })?;
    }
    write_text(&path, &made.text)?;
    if args.json {
        let mut summary = made.summary;
        summary["file"] = json!(path.display().to_string());
        summary["name"] = json!(name);
        summary["bytes"] = json!(made.text.len());
        writeln!(std::io::stdout(), "{summary:#}")?;
    }
    Terminal::with(args.quiet, args.json).say(&format!(
        "{}\n  {:.1} kB of C, written to {}",
        made.said,
        made.text.len() as f64 / 1e3,
        path.display()
    ))?;
    Ok(())
}

fn map(name: &str, path: &Path) -> Result<Made, CliError> {
    let stored = Stored::open(path)?;
    let missing = || ExportError::NoMap { path: path.to_owned() };
    if !stored.has("map_pieces") {
        return Err(missing().into());
    }
    let map = ValueMap::new(&stored)?;
    let (pieces, local, system) = map.in_parts().ok_or_else(missing)?;
    let numbers: usize = pieces.pieces.iter().map(|p| p.coefficients.len()).sum();
    let (p, c) = (pieces.pieces.len(), pieces.cells.len());
    Ok(Made {
        text: value_header(name, Known::Map(pieces, local.as_ref()), system, &stored.model),
        said: format!("map: {p} pieces in {c} cells, {numbers} coefficients"),
        summary: json!({ "kind": "map", "pieces": p, "cells": c, "coefficients": numbers }),
    })
}

fn local(name: &str, model: &Model, hamiltonian: &Hamiltonian, degree: usize) -> Result<Made, CliError> {
    if matches!(model.horizon, Horizon::Finite { .. }) {
        return Err(ExportError::Finite.into());
    }
    let system = System::new(hamiltonian, model);
    let riccati = Riccati::solve(hamiltonian, model).map_err(ExportError::from)?;
    let polynomial = LocalPolynomial::new(&system, model, &riccati, degree + 1).map_err(ExportError::from)?;
    let terms = polynomial.coefficients.len();
    Ok(Made {
        text: value_header(name, Known::Local(&polynomial), &system, model),
        said: format!(
            "series about the equilibrium: V of degree {}, u of degree {degree}, {terms} coefficients; counts as known up to V = {:.3e} \
             of the quadratic part",
            polynomial.degree, polynomial.reach
        ),
        summary: json!({
            "kind": "local", "degree": degree, "V_degree": polynomial.degree, "coefficients": terms,
            "V_reach": polynomial.reach,
        }),
    })
}
