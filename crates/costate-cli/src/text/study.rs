//! A study as text.

use crate::common::columns::columns;
use costate::low_level::model::Model;
use costate::low_level::study::Variant;
use costate::low_level::value::PointStatus;

/// The table of a study, in columns.
pub fn table(model: &Model, variants: &[Variant]) -> String {
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
