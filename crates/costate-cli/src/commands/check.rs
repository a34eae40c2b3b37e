//! `costate check` and `costate adapters`.

use crate::args::{CheckArgs, Reference};
use crate::common::load::load;
use crate::error::CliError;
use crate::terminal::{Printed, Terminal};
use crate::text;
use costate::backend::BackendError;
use costate::backend::adapters::{adapters, no_adapter};
use costate::low_level::attenuation;
use costate::low_level::hamiltonian::Hamiltonian;
use costate::low_level::local::{LinearAttenuation, Riccati, linear_law, show_eigenvalue};
use costate::low_level::model::{Guard, Horizon, Model};
use costate::low_level::{scenario, schema};
use costate::run;
use costate::scene::Scene;
use costate::session::summary::LinearSummary;
use costate::session::{Equations, Progress, SessionError, at_equilibrium};
use std::fmt::Write as _;
use std::io::Write as _;

pub fn check(args: &CheckArgs) -> Result<(), CliError> {
    let scene = load(&args.scene)?;
    let Scene {
        model, hamiltonian, ..
    } = &scene;
    let riccati = match model.horizon {
        Horizon::Infinite { .. } => {
            Some(Riccati::solve(hamiltonian, model).map_err(|e| at_equilibrium(model, &e))?)
        }
        Horizon::Finite { .. } => None,
    };
    run::check_laws(&scene)?;
    let rest = At::of(model, hamiltonian, riccati.as_ref());
    let smallest = (model.attenuation.as_ref())
        .map(|a| attenuation::linear(&scene, a))
        .transpose()
        .map_err(SessionError::from)?;
    let smallest = model.attenuation.as_ref().zip(smallest);
    if args.scene.quiet && !args.scene.json {
        return Ok(());
    }
    let terminal = Terminal::new(&args.scene);
    for note in &model.notes {
        terminal.note(note);
    }
    let equations = Equations::new(&scene);
    let mut out = Printed::new();
    if args.scene.json {
        writeln!(
            out,
            "{:#}",
            as_json(
                model,
                hamiltonian,
                &equations,
                riccati.as_ref().zip(rest.as_ref()),
                smallest.as_ref().map(|(_, l)| l)
            )
        )?;
    } else {
        write!(
            out,
            "{}",
            as_text(
                model,
                hamiltonian,
                &equations,
                riccati.as_ref().zip(rest.as_ref())
            )
        )?;
        if let Some((asked, linear)) = &smallest {
            let text = text::attenuation::star_text(&asked.parameter, linear);
            writeln!(
                out,
                "\nSmallest level of attenuation that the linearization allows\n  {text}"
            )?;
        }
    }
    Ok(())
}

fn names(model: &Model) -> Vec<&str> {
    model
        .states
        .iter()
        .map(|s| s.variable.name.as_str())
        .collect()
}

/// What is so at the equilibrium.
struct At {
    /// `[control][state]`: u = u_e - K (x - x_e) beside it.
    gain: Vec<Vec<f64>>,
    /// One a guard, the program's own included: positive inside.
    guards: Vec<f64>,
}

impl At {
    fn of(model: &Model, h: &Hamiltonian, riccati: Option<&Riccati>) -> Option<Self> {
        let slopes = linear_law(h, model, riccati?);
        let guards: Vec<_> = h.guards.iter().map(|g| g.condition.expr).collect();
        Some(Self {
            // Without -0.
            gain: (slopes.iter())
                .map(|row| row.iter().map(|slope| 0.0 - slope).collect())
                .collect(),
            guards: h.graph.eval(&guards, &h.point(model)),
        })
    }
}

fn as_text(
    model: &Model,
    h: &Hamiltonian,
    equations: &Equations,
    local: Option<(&Riccati, &At)>,
) -> String {
    let mut t = String::new();
    let mut line = |text: String| {
        // Writing to a String cannot fail.
        let _ = writeln!(t, "{text}");
    };
    line(format!("{}\n", model.title));
    if !equations.shared.is_empty() {
        line("Shared parts of the equations".into());
        for (name, text) in &equations.shared {
            line(format!("  {name} = {text}"));
        }
        line(String::new());
    }
    line("Hamiltonian (before inserting the controls)".into());
    line(format!("  H = {}\n", equations.hamiltonian));
    line("Optimal control".into());
    for (c, u) in model.controls.iter().zip(&equations.optimal_control) {
        line(format!("  {}* = {}", c.variable.name, u));
    }
    if !model.disturbances.is_empty() {
        line("\nWorst-case disturbance".into());
        for (d, w) in model.disturbances.iter().zip(&equations.worst_disturbance) {
            line(format!("  {}* = {}", d.name, w));
        }
    }
    line("\nState equations".into());
    for (name, rate) in names(model).iter().zip(&equations.state_equations) {
        line(format!("  {name}' = {}", rate));
    }
    line("\nAdjoint equations".into());
    for (name, rate) in names(model).iter().zip(&equations.adjoint_equations) {
        line(format!("  p_{name}' = {}", rate));
    }
    match &model.horizon {
        Horizon::Infinite { x, u, .. } => {
            line("\nEquilibrium".into());
            for (name, v) in names(model).iter().zip(x) {
                line(format!("  {name} = {v}"));
            }
            for (c, v) in model.controls.iter().zip(u) {
                line(format!("  {} = {v}", c.variable.name));
            }
        }
        Horizon::Finite { final_time, .. } => {
            line(format!("\nTerminal cost at t = {final_time}"));
            line(format!(
                "  phi = {}",
                equations.terminal_cost.as_deref().unwrap_or_default()
            ));
            for (name, slope) in names(model).iter().zip(&equations.terminal_costate) {
                line(format!("  p_{name} = {slope}"));
            }
        }
    }
    if !h.guards.is_empty() {
        line(match local {
            Some(_) => "\nGuards, and the left sides at the equilibrium".into(),
            None => "\nGuards".into(),
        });
    }
    for (k, guard) in h.guards.iter().enumerate() {
        let sign = if guard.strict { ">" } else { ">=" };
        let value = local.map_or(String::new(), |(_, at)| format!(" ({:.8})", at.guards[k]));
        let added = if k < model.guards.len() {
            ""
        } else {
            ", added by the program"
        };
        line(format!(
            "  {}: {} {sign} 0{value}{added}",
            guard.name, equations.guards[k]
        ));
    }
    if let Some((r, at)) = local {
        line(format!(
            "\nRiccati solution P (V = 1/2 s'P s near the equilibrium; relative residual {:.1e})",
            r.residual
        ));
        for row in r.p.row_iter() {
            line(format!(
                "  {}",
                row.iter().map(|v| format!("{v:>14.8}")).collect::<String>()
            ));
        }
        line("\nLocal gain K: u = u_e - K (x - x_e) to first order, with u_e, x_e at the equilibrium".into());
        for (control, row) in model.controls.iter().zip(&at.gain) {
            let row: String = row.iter().map(|v| format!("{v:>14.8}")).collect();
            line(format!("  {row}  ({})", control.variable.name));
        }
        line("\nClosed-loop eigenvalues".into());
        for e in &r.eigenvalues {
            line(format!("  {}", show_eigenvalue(*e)));
        }
    }
    t
}

fn as_json(
    model: &Model,
    h: &Hamiltonian,
    equations: &Equations,
    local: Option<(&Riccati, &At)>,
    smallest: Option<&LinearAttenuation>,
) -> serde_json::Value {
    let riccati = local.map(|(riccati, _)| riccati);
    let guard = |(k, guard): (usize, &Guard)| {
        serde_json::json!({
            "name": guard.name, "expression": equations.guards[k], "strict": guard.strict,
            "at_equilibrium": local.map(|(_, at)| at.guards[k]),
        })
    };
    serde_json::json!({
        "title": model.title,
        "states": names(model),
        "controls": model.controls.iter().map(|c| &c.variable.name).collect::<Vec<_>>(),
        "disturbances": model.disturbances.iter().map(|d| &d.name).collect::<Vec<_>>(),
        "shared": equations.shared,
        "hamiltonian": equations.hamiltonian,
        "optimal_control": equations.optimal_control,
        "worst_disturbance": equations.worst_disturbance,
        "state_equations": equations.state_equations,
        "adjoint_equations": equations.adjoint_equations,
        "reference": model.reference(),
        "riccati": riccati.map(|r| r.p.row_iter().map(|row| row.iter().copied().collect::<Vec<_>>()).collect::<Vec<_>>()),
        "riccati_residual": riccati.map(|r| r.residual),
        "gain": local.map(|(_, at)| &at.gain),
        "guards": h.guards.iter().enumerate().map(guard).collect::<Vec<_>>(),
        "attenuation": smallest.map(LinearSummary::from),
        "closed_loop_eigenvalues": riccati.map(|r| r.eigenvalues.iter().map(|e| [e.re, e.im]).collect::<Vec<_>>()),
    })
}

/// `costate reference`.
pub fn reference(what: Reference) -> Result<(), CliError> {
    let text = match what {
        Reference::Scene => scenario::reference(),
        Reference::File => schema::markdown(),
    };
    std::io::stdout().lock().write_all(text.as_bytes())?;
    Ok(())
}

pub fn list_adapters(json: bool) -> Result<(), CliError> {
    let found = adapters();
    let mut out = Printed::new();
    if json {
        let list: Vec<_> = (found.iter())
            .map(|a| {
                serde_json::json!({
                    "name": a.name, "api": a.api, "driver": a.driver, "kind": a.kind, "hardware": a.hardware,
                    "f64": a.f64_arithmetic, "max_binding_bytes": a.max_binding, "max_buffer_bytes": a.max_buffer,
                })
            })
            .collect();
        writeln!(out, "{:#}", serde_json::Value::Array(list))?;
        return Ok(());
    }
    if found.is_empty() {
        let why = match no_adapter() {
            BackendError::NotBuilt => "this was built without the feature `gpu`",
            _ => "no GPU adapter was found",
        };
        writeln!(out, "{why}; `--backend auto` computes on the CPU")?;
    }
    for a in &found {
        let f64_text = if a.f64_arithmetic {
            "f32 and f64"
        } else {
            "f32 only"
        };
        writeln!(
            out,
            "{} ({}, {}): {f64_text}, buffers up to {} MiB",
            a.name,
            a.api,
            a.kind,
            a.max_buffer >> 20
        )?;
    }
    let cpu = costate::backend::cpu::Cpu::new();
    writeln!(
        out,
        "{}: f32 and f64 (--backend cpu)",
        costate::backend::Backend::adapter(&cpu)
    )?;
    Ok(())
}
