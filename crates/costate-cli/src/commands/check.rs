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
use costate::session::{Equations, MechanismSummary, Progress, SessionError, at_equilibrium};
use std::io::Write as _;

/// Residuals of a mechanism's identities that are more than rounding of it.
const FAR: f64 = 1e-6;

pub fn check(args: &CheckArgs) -> Result<(), CliError> {
    let scene = load(&args.scene)?;
    let checked = Checked::of(&scene)?;
    if args.scene.print.quiet && !args.scene.print.json {
        return Ok(());
    }
    let terminal = Terminal::new(args.scene.print);
    checked.notes.iter().for_each(|note| terminal.note(note));
    let mut out = Printed::new();
    match args.scene.print.json {
        true => writeln!(out, "{:#}", checked.json())?,
        false => write!(out, "{}", checked.text())?,
    }
    Ok(())
}

/// A scene that is well-formed, and what follows from it.
pub struct Checked<'s> {
    scene: &'s Scene,
    equations: Equations,
    riccati: Option<Riccati>,
    rest: Option<At>,
    smallest: Option<LinearAttenuation>,
    mechanism: Option<MechanismSummary>,
    /// Remarks that a user should read.
    pub notes: Vec<String>,
}

impl<'s> Checked<'s> {
    /// Of a scene.
    ///
    /// # Errors
    /// What is wrong with its equilibrium, its laws or its levels of attenuation.
    pub fn of(scene: &'s Scene) -> Result<Self, CliError> {
        let Scene {
            model, hamiltonian, ..
        } = scene;
        let riccati = match model.horizon {
            Horizon::Infinite { .. } => {
                Some(Riccati::solve(hamiltonian, model).map_err(|e| at_equilibrium(model, &e))?)
            }
            Horizon::Finite { .. } => None,
        };
        run::check_laws(scene)?;
        let smallest = (model.attenuation.as_ref())
            .map(|a| attenuation::linear(scene, a))
            .transpose()
            .map_err(SessionError::from)?;
        let mechanism = MechanismSummary::new(scene);
        let far = (mechanism.iter().flat_map(|m| &m.identities))
            .filter(|identity| identity.residual.is_nan() || identity.residual > FAR);
        let far = far.map(|identity| {
            format!(
                "the mechanism's numbers have few digits: `{}` is off by {:.1e} of its terms somewhere in the region (masses or lengths far apart, or states near which the mechanism locks)",
                identity.name, identity.residual
            )
        });
        let notes = model.notes.iter().cloned().chain(far).collect();
        Ok(Self {
            scene,
            equations: Equations::new(scene),
            rest: At::of(model, hamiltonian, riccati.as_ref()),
            riccati,
            smallest,
            mechanism,
            notes,
        })
    }

    fn local(&self) -> Option<(&Riccati, &At)> {
        self.riccati.as_ref().zip(self.rest.as_ref())
    }

    /// For people.
    pub fn text(&self) -> String {
        let Scene {
            model, hamiltonian, ..
        } = self.scene;
        let mut text = as_text(model, hamiltonian, &self.equations, self.local());
        if let Some(mechanism) = &self.mechanism {
            text.push_str(&mechanism_text(mechanism));
        }
        if let Some((asked, linear)) = model.attenuation.as_ref().zip(self.smallest.as_ref()) {
            let star = text::attenuation::star_text(&asked.parameter, linear);
            text.push_str(&format!(
                "\nSmallest level of attenuation that the linearization allows\n  {star}\n"
            ));
        }
        text
    }

    /// For programs.
    pub fn json(&self) -> serde_json::Value {
        let Scene {
            model, hamiltonian, ..
        } = self.scene;
        as_json(
            model,
            hamiltonian,
            &self.equations,
            self.local(),
            self.smallest.as_ref(),
            self.mechanism.as_ref(),
        )
    }
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
    let mut lines = vec![format!("{}\n", model.title)];
    lines.extend(equations_text(model, equations));
    lines.extend(end_text(model, equations));
    lines.extend(guards_text(model, h, equations, local.map(|(_, at)| at)));
    if let Some((riccati, at)) = local {
        lines.extend(local_text(model, riccati, at));
    }
    lines.join("\n") + "\n"
}

/// The Hamiltonian, the optimal inputs and the equations of motion.
fn equations_text(model: &Model, equations: &Equations) -> Vec<String> {
    let mut lines = Vec::new();
    if !equations.shared.is_empty() {
        lines.push("Shared parts of the equations".to_owned());
        for (name, text) in &equations.shared {
            lines.push(format!("  {name} = {text}"));
        }
        lines.push(String::new());
    }
    lines.push("Hamiltonian (before inserting the controls)".to_owned());
    lines.push(format!("  H = {}\n", equations.hamiltonian));
    lines.push("Optimal control".to_owned());
    for (c, u) in model.controls.iter().zip(&equations.optimal_control) {
        lines.push(format!("  {}* = {}", c.variable.name, u));
    }
    if !model.disturbances.is_empty() {
        lines.push("\nWorst-case disturbance".to_owned());
        for (d, w) in model.disturbances.iter().zip(&equations.worst_disturbance) {
            lines.push(format!("  {}* = {}", d.name, w));
        }
    }
    lines.push("\nState equations".to_owned());
    for (name, rate) in names(model).iter().zip(&equations.state_equations) {
        lines.push(format!("  {name}' = {}", rate));
    }
    lines.push("\nAdjoint equations".to_owned());
    for (name, rate) in names(model).iter().zip(&equations.adjoint_equations) {
        lines.push(format!("  p_{name}' = {}", rate));
    }
    lines
}

/// Where optimal trajectories end: the equilibrium, or the terminal cost.
fn end_text(model: &Model, equations: &Equations) -> Vec<String> {
    let mut lines = Vec::new();
    match &model.horizon {
        Horizon::Infinite { x, u, .. } => {
            lines.push("\nEquilibrium".to_owned());
            for (name, v) in names(model).iter().zip(x) {
                lines.push(format!("  {name} = {v}"));
            }
            for (c, v) in model.controls.iter().zip(u) {
                lines.push(format!("  {} = {v}", c.variable.name));
            }
        }
        Horizon::Finite { final_time, .. } => {
            lines.push(format!("\nTerminal cost at t = {final_time}"));
            lines.push(format!(
                "  phi = {}",
                equations.terminal_cost.as_deref().unwrap_or_default()
            ));
            for (name, slope) in names(model).iter().zip(&equations.terminal_costate) {
                lines.push(format!("  p_{name} = {slope}"));
            }
        }
    }
    lines
}

fn guards_text(
    model: &Model,
    h: &Hamiltonian,
    equations: &Equations,
    at: Option<&At>,
) -> Vec<String> {
    let mut lines = Vec::new();
    if !h.guards.is_empty() {
        lines.push(match at {
            Some(_) => "\nGuards, and the left sides at the equilibrium".to_owned(),
            None => "\nGuards".to_owned(),
        });
    }
    for (k, guard) in h.guards.iter().enumerate() {
        let sign = if guard.strict { ">" } else { ">=" };
        let value = at.map_or(String::new(), |at| format!(" ({:.8})", at.guards[k]));
        let added = if k < model.guards.len() {
            ""
        } else {
            ", added by the program"
        };
        lines.push(format!(
            "  {}: {} {sign} 0{value}{added}",
            guard.name, equations.guards[k]
        ));
    }
    if !model.events.is_empty() {
        let names: Vec<&str> = model.events.iter().map(|e| e.name.as_str()).collect();
        lines.push(format!(
            "\nEvents of `costate simulate` (V knows nothing of them): {}",
            names.join(", ")
        ));
    }
    lines
}

/// V, the feedback and the motion to first order about the equilibrium.
fn local_text(model: &Model, riccati: &Riccati, at: &At) -> Vec<String> {
    let numbers = |row: &mut dyn Iterator<Item = &f64>| -> String {
        row.map(|v| format!("{v:>14.8}")).collect()
    };
    let mut lines = vec![format!(
        "\nRiccati solution P (V = 1/2 s'P s near the equilibrium; relative residual {:.1e})",
        riccati.residual
    )];
    for row in riccati.p.row_iter() {
        lines.push(format!("  {}", numbers(&mut row.iter())));
    }
    lines.push(
        "\nLocal gain K: u = u_e - K (x - x_e) to first order, with u_e, x_e at the equilibrium"
            .to_owned(),
    );
    for (control, row) in model.controls.iter().zip(&at.gain) {
        let row = numbers(&mut row.iter());
        lines.push(format!("  {row}  ({})", control.variable.name));
    }
    lines.push("\nClosed-loop eigenvalues".to_owned());
    for e in &riccati.eigenvalues {
        lines.push(format!("  {}", show_eigenvalue(*e)));
    }
    lines
}

/// What the equations of a mechanism are made of, and whether they agree with each other.
fn mechanism_text(mechanism: &MechanismSummary) -> String {
    let mut lines = vec![
        format!(
            "\nMechanism of {}: {}",
            text::counted(mechanism.coordinates.len(), "coordinate"),
            mechanism.coordinates.join(", ")
        ),
        format!(
            "  accelerations take {} operations, x' and p' together {}",
            mechanism.forward_operations, mechanism.characteristic_operations
        ),
        "  identities at random states, relative residuals".to_owned(),
    ];
    for identity in &mechanism.identities {
        lines.push(format!("    {}: {:.1e}", identity.name, identity.residual));
    }
    lines.join("\n") + "\n"
}

fn as_json(
    model: &Model,
    h: &Hamiltonian,
    equations: &Equations,
    local: Option<(&Riccati, &At)>,
    smallest: Option<&LinearAttenuation>,
    mechanism: Option<&MechanismSummary>,
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
        "events": model.events.iter().map(|e| &e.name).collect::<Vec<_>>(),
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
        "mechanism": mechanism,
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
