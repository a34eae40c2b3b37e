//! Fitted laws as text.

use costate::low_level::feedback::{Exports, Fitted, FittedLaw, Network, Quality};

/// One paragraph a law.
pub fn text(fitted: &Fitted) -> String {
    let each: Vec<String> = fitted.laws.iter().map(law_text).collect();
    each.join("\n")
}

/// The files of each, a line a law.
pub fn files(fitted: &Fitted, exports: &[Exports]) -> String {
    let mut lines = Vec::new();
    for (law, exports) in fitted.laws.iter().zip(exports) {
        let files = exports.files.iter().map(|f| f.display().to_string());
        let files = files.collect::<Vec<_>>().join(", ");
        lines.push(format!("law {}: written to {files}", law.name));
        if let Some(reason) = &exports.without_onnx {
            lines.push(format!("  no ONNX model: {reason}"));
        }
    }
    lines.join("\n")
}

fn law_text(l: &FittedLaw) -> String {
    let mut lines = heading(l);
    lines.extend(accuracy(&l.quality));
    lines.extend(of_loss(l));
    if l.narrow_units > 0 {
        lines.push(format!(
            "  warning: {} hidden unit{} rise over less than the distance between samples: between these nothing holds the law \
             (more samples, fewer units, or another seed)",
            l.narrow_units,
            if l.narrow_units == 1 { "" } else { "s" }
        ));
    }
    lines.push(format!(
        "  {:.1} s, {} starts, best after {} steps (seed {})",
        l.seconds, l.starts, l.iterations, l.seed
    ));
    lines.join("\n")
}

/// Sizes of a network's layers, inputs first: `2-16-16-1`.
fn sizes(network: &Network) -> String {
    let layers = network.layers.iter().map(|layer| layer.bias.len());
    let sizes = std::iter::once(network.inputs.len()).chain(layers);
    let sizes: Vec<String> = sizes.map(|size| size.to_string()).collect();
    sizes.join("-")
}

/// The network, and the data that it was fitted to.
fn heading(l: &FittedLaw) -> Vec<String> {
    let what = match l.form.value {
        Some(_) => "V; u = u*(x, dV/dx)".to_owned(),
        None => l.form.outputs.join(", "),
    };
    let base = if l.law.base.is_some() {
        " beside the local solution"
    } else {
        ""
    };
    vec![
        format!(
            "law {}: {what}: a {} {} network{base}, {} weights, {:.0} flops a call",
            l.name,
            sizes(&l.law.network),
            l.law.network.activation.name(),
            l.parameters,
            l.flops
        ),
        format!(
            "  data: {} of {} samples in the box, {} of them not optimal; {} + {} + {} samples of {} + {} + {} trajectories \
             (training, validation, test)",
            l.selection.selected,
            l.selection.offered,
            l.selection.not_optimal,
            l.sets[0],
            l.sets[1],
            l.sets[2],
            l.trajectories[0],
            l.trajectories[1],
            l.trajectories[2]
        ),
    ]
}

/// Errors of u, and of V, p and H where V was fitted.
fn accuracy(q: &Quality) -> Vec<String> {
    let mut lines = vec![format!(
        "  u on test trajectories: mean error {:.2e}, largest {:.2e} (of mean |u|); mean error {:.2e} of the range",
        q.u.mean, q.u.max, q.u.mean_of_range
    )];
    if let (Some(v), Some(p), Some(h)) = (&q.v, &q.p, &q.hjb) {
        lines.push(format!(
            "  V: mean error {:.2e}, largest {:.2e} (of mean V); p: mean error {:.2e}, largest {:.2e} (of mean |p|)",
            v.mean, v.max, p.mean, p.max
        ));
        lines.push(format!(
            "  |H(x, dV/dx)| over the mean running cost {:.3e}: median {:.1e}, 90 % {:.1e}, 99 % {:.1e}, largest {:.1e}",
            h.scale, h.median, h.q90, h.q99, h.max
        ));
    }
    lines
}

/// What the law costs more than u*, and where most.
fn of_loss(l: &FittedLaw) -> Vec<String> {
    let Some(loss) = &l.quality.loss else {
        return Vec::new();
    };
    let named = |values: &mut dyn Iterator<Item = String>| -> String {
        let pairs = l.form.x.iter().zip(values);
        let pairs = pairs.map(|(x, value)| format!("{} {value}", l.form.graph.show(*x)));
        pairs.collect::<Vec<_>>().join(", ")
    };
    let mut at = loss.at.iter().map(|x| format!("= {x:.4}"));
    let mut worst = (loss.worst.iter()).map(|[lower, upper]| format!("[{lower:.4}, {upper:.4}]"));
    vec![
        format!(
            "  loss on test trajectories, H(x, p, u) - H(x, p, u*) over the mean running cost {:.3e}: mean {:.1e}, 99 % {:.1e}, largest {:.1e}",
            loss.scale, loss.mean, loss.q99, loss.max
        ),
        format!(
            "    largest at {}; the largest hundredth within {}",
            named(&mut at),
            named(&mut worst)
        ),
    ]
}
