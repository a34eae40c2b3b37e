//! `costate study`, and the study of a run.

use super::alone::Alone;
use super::columns::columns;
use super::report::Terminal;
use super::run::axes;
use super::{CliError, RunArgs};
use costate::backend::Backend;
use costate::hdf5::ResultFile;
use costate::model::Model;
use costate::scene::Scene;
use costate::study::{Variant, study as studied};
use costate::sweep::Choices;
use costate::value::PointStatus;

pub(super) fn study(args: &RunArgs) -> Result<(), CliError> {
    let asks = |model: &Model| model.study.as_ref().map(drop).ok_or(CliError::NoStudy);
    let (begun, mut file) = Alone::begin(args, "_study", asks)?;
    let Alone {
        scene,
        backend,
        terminal,
        clock,
        ..
    } = &begun;
    let model = &scene.model;
    let choices = args.numerics.choices(args.seed);
    let variants = write(&mut file, scene, backend.as_ref(), choices, terminal)?;
    let path = begun.finish(file)?;
    terminal.say(&table(model, &variants))?;
    terminal.say(&format!(
        "{:.2} s, written to {}",
        clock.elapsed().as_secs_f64(),
        path.display()
    ))?;
    if args.scene.json {
        super::print(&format!("{:#}\n", as_json(model, &variants)))?;
    }
    Ok(())
}

/// Makes the scene's study and writes its groups.
pub(super) fn write(
    file: &mut ResultFile,
    scene: &Scene,
    backend: &dyn Backend,
    choices: Choices,
    terminal: &Terminal,
) -> Result<Vec<Variant>, CliError> {
    let Some(asked) = &scene.model.study else {
        return Ok(Vec::new());
    };
    let bar = terminal.progress();
    let mut told = |done: usize, of: usize| bar.say(&format!("study: {done} of {of} variants"));
    let variants = studied(scene, backend, choices, &mut told)?;
    bar.clear();
    file.study(&axes(&scene.model), asked, &variants)?;
    Ok(variants)
}

/// The table of a study, in columns.
pub(super) fn table(model: &Model, variants: &[Variant]) -> String {
    let Some(asked) = &model.study else {
        return String::new();
    };
    let mut rows: Vec<Vec<String>> = vec![
        (asked.vary.iter().map(|(name, _)| name.clone()))
            .chain(["V".to_owned()])
            .chain(asked.records.iter().map(|r| r.name.clone()))
            .collect(),
    ];
    for v in variants {
        let numbers = v.parameters.iter().chain([&v.value]).chain(&v.records);
        let mut row: Vec<String> = numbers.map(|x| format!("{:.6}", x)).collect();
        for (cell, value) in row.iter_mut().zip(&v.parameters) {
            *cell = value.to_string();
        }
        if v.status != PointStatus::Converged {
            row.push(v.status.name().replace('_', " "));
        }
        rows.push(row);
    }
    columns(&rows, &[])
}

pub(super) fn as_json(model: &Model, variants: &[Variant]) -> serde_json::Value {
    let Some(asked) = &model.study else {
        return serde_json::Value::Null;
    };
    let rows: Vec<serde_json::Value> = (variants.iter())
        .map(|v| {
            let mut row = serde_json::Map::new();
            for ((name, _), value) in asked.vary.iter().zip(&v.parameters) {
                row.insert(name.clone(), (*value).into());
            }
            row.insert("V".to_owned(), v.value.into());
            row.insert("status".to_owned(), v.status.name().into());
            for (record, value) in asked.records.iter().zip(&v.records) {
                row.insert(record.name.clone(), (*value).into());
            }
            row.into()
        })
        .collect();
    rows.into()
}
