//! `costate export`: a value function, or a fitted law, as a C header.

use crate::args::ExportArgs;
use crate::common::load::loaded;
use crate::common::{Kind, check_out, note_ended_early};
use crate::error::{CliError, ExportError};
use crate::terminal::Terminal;
use costate::low_level::feedback::{Known, Law, header, value_header};
use costate::low_level::files::write_text;
use costate::low_level::hamiltonian::System;
use costate::low_level::local::{LocalPolynomial, Riccati};
use costate::low_level::model::Horizon;
use costate::low_level::result::{Stored, StoredMapError};
use costate::run::{fitted_laws, output_of};
use costate::scene::Scene;
use serde_json::{Value, json};
use std::io::Write;
use std::path::Path;

/// A header, and what is said of it.
struct Made {
    /// What its names begin with.
    name: String,
    text: String,
    said: String,
    summary: Value,
}

pub fn export(args: &ExportArgs) -> Result<(), CliError> {
    check_out(args.out.as_deref(), &[Kind::Header], &[&args.file])?;
    let scene = args
        .file
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("toml"));
    if !scene && !args.set.is_empty() {
        let path = args.file.clone();
        return Err(ExportError::SetOfResult { path }.into());
    }
    let (name, path) = (args.name.as_deref(), args.file.clone());
    let terminal = Terminal::new(args.print);
    let made = match (&args.law, args.local) {
        (Some(_), _) if scene => return Err(ExportError::SceneOfLaw { path }.into()),
        (Some(wanted), _) => law(name, wanted.as_deref(), &opened(&path, &terminal)?)?,
        (None, false) if scene => return Err(ExportError::Scene { path }.into()),
        (None, false) => map(name.unwrap_or("map"), &opened(&path, &terminal)?)?,
        (None, true) => {
            let name = name.unwrap_or("local");
            if scene {
                local(name, &loaded(&path, &args.set)?, args.degree)?
            } else {
                let stored = Stored::open(&path)?;
                local(name, &stored.scene, args.degree)?
            }
        }
    };
    let name = &made.name;
    let path = args.out.clone().unwrap_or_else(|| {
        let beside = if scene {
            output_of(&args.file, "")
        } else {
            args.file.clone()
        };
        let stem = beside
            .file_stem()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        beside.with_file_name(format!("{stem}_{name}.h"))
    });
    write_text(&path, &made.text)?;
    if args.print.json {
        let mut summary = made.summary;
        summary["file"] = json!(path.display().to_string());
        summary["name"] = json!(name);
        summary["bytes"] = json!(made.text.len());
        writeln!(std::io::stdout(), "{summary:#}")?;
    }
    terminal.say(&format!(
        "{}\n  {:.1} kB of C, written to {}",
        made.said,
        made.text.len() as f64 / 1e3,
        path.display()
    ))?;
    Ok(())
}

/// A C header of a result file's map in pieces; its names begin with `name`.
///
/// # Errors
/// Where the file has no map in pieces.
pub fn map_header(name: &str, stored: &Stored) -> Result<String, CliError> {
    Ok(map(name, stored)?.text)
}

/// A C header of the series about a scene's equilibrium, with u of a degree.
///
/// # Errors
/// Where there is no equilibrium, or no such series.
pub fn local_header(name: &str, scene: &Scene, degree: usize) -> Result<String, CliError> {
    Ok(local(name, scene, degree)?.text)
}

/// A result file, of which is said whether its run was ended early.
fn opened(path: &Path, terminal: &Terminal) -> Result<Stored, CliError> {
    let stored = Stored::open(path)?;
    note_ended_early(&stored, terminal);
    Ok(stored)
}

fn map(name: &str, stored: &Stored) -> Result<Made, CliError> {
    let path = &stored.path;
    let missing = || ExportError::NoMap { path: path.clone() };
    if !stored.has_map() {
        return Err(missing().into());
    }
    let map = stored.value_map()?;
    let nothing = || StoredMapError::EmptyMap { path: path.clone() };
    let (pieces, local, system) = map.in_parts().ok_or_else(nothing)?;
    let numbers: usize = pieces.pieces.iter().map(|p| p.coefficients.len()).sum();
    let (p, c) = (pieces.pieces.len(), pieces.cells.len());
    Ok(Made {
        name: name.to_owned(),
        text: value_header(
            name,
            Known::Map(pieces, local.as_ref()),
            system,
            &stored.scene.model,
        ),
        said: format!("map: {p} pieces in {c} cells, {numbers} coefficients"),
        summary: json!({ "kind": "map", "pieces": p, "cells": c, "coefficients": numbers }),
    })
}

/// A law that was fitted into a result file, as `costate fit` writes its header; `wanted` may be
/// left out where there is one.
fn law(name: Option<&str>, wanted: Option<&str>, stored: &Stored) -> Result<Made, CliError> {
    let path = stored.path.clone();
    let mut laws = fitted_laws(stored)?;
    let names: Vec<String> = laws.iter().map(|law| law.name.clone()).collect();
    let found = match wanted {
        _ if laws.is_empty() => Err(ExportError::NoLaw { path }),
        None if laws.len() == 1 => Ok(0),
        None => Err(ExportError::WhichLaw { path, laws: names }),
        Some(wanted) => {
            (names.iter().position(|n| n == wanted)).ok_or_else(|| ExportError::OtherLaws {
                path,
                name: wanted.to_owned(),
                laws: names.clone(),
            })
        }
    };
    let stored_law = laws.swap_remove(found?);
    let name = name.map_or(stored_law.name, str::to_owned);
    let law = Law::from_toml(&stored_law.text, &stored_law.file).map_err(ExportError::from)?;
    let form = law
        .closed_form(&stored.scene.model, &stored.scene.hamiltonian)
        .map_err(ExportError::from)?;
    let sizes = law
        .network
        .layers
        .iter()
        .map(|l| l.weights.len() + l.bias.len());
    let weights: usize = sizes.sum();
    Ok(Made {
        text: header(&name, &law, &form, &stored.scene.model),
        said: format!("law {name}: {}, {weights} weights", form.outputs.join(", ")),
        summary: json!({
            "kind": "law", "fitted": law.meaning.name(), "outputs": form.outputs, "parameters": weights,
        }),
        name,
    })
}

fn local(name: &str, scene: &Scene, degree: usize) -> Result<Made, CliError> {
    let Scene {
        model, hamiltonian, ..
    } = scene;
    if matches!(model.horizon, Horizon::Finite { .. }) {
        return Err(ExportError::Finite.into());
    }
    let system = System::new(hamiltonian, model);
    let riccati = Riccati::solve(hamiltonian, model).map_err(ExportError::from)?;
    let polynomial =
        LocalPolynomial::new(&system, model, &riccati, degree + 1).map_err(ExportError::from)?;
    let terms = polynomial.coefficients.len();
    Ok(Made {
        name: name.to_owned(),
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
