//! `costate check-least`: V on a grid as an independent check of the solved states of a result
//! file.

use crate::args::CheckLeastArgs;
use crate::common::columns::columns;
use crate::common::{grid, note_ended_early, print_json};
use crate::error::CliError;
use crate::error::GridRefusal;
use crate::terminal::Terminal;
use costate::low_level::dynamic_programming::{GridValue, refuse};
use costate::low_level::model::Model;
use costate::low_level::numeric::quantile::nearest_rank;
use costate::low_level::result::Stored;
use costate::low_level::value::{Claims, Comparison, Flown, Led};
use costate::run::claims;
use costate::session::{LeastOptions, Session, SessionError};
use std::time::Instant;

/// States of a list that are printed; the summary of `--json` has them all.
const SHOWN: usize = 10;

pub fn check_least(args: &CheckLeastArgs) -> Result<(), CliError> {
    let clock = Instant::now();
    let stored = Stored::open(&args.file)?;
    let terminal = Terminal::new(args.print);
    note_ended_early(&stored, &terminal);
    let model = &stored.scene.model;
    refuse(model, &stored.path.display().to_string()).map_err(SessionError::from)?;
    let claims = claims(&stored)?;
    if claims.v.is_empty() {
        let path = stored.path.clone();
        return Err(match stored.has_attribute("stopped") {
            true => GridRefusal::NoneDone { path }.into(),
            false => GridRefusal::NoStates { path }.into(),
        });
    }
    let options = LeastOptions {
        nodes: grid::counts(&args.nodes, model)?,
        margin: args.margin,
        seconds: args.seconds,
        apart: args.apart,
    };
    let session = Session::on(&stored.scene, args.numerics.open(model)?)
        .choosing(args.numerics.choices(0))
        .with_progress(&terminal);
    let (grid, comparison) = session.check_least(&claims, &options)?;
    let said = Said {
        args,
        model,
        claims: &claims,
        grid: &grid,
        comparison: &comparison,
        seconds: clock.elapsed().as_secs_f64(),
    };
    terminal.say(&said.text())?;
    if args.print.json {
        print_json(&said.json())?;
    }
    match said.undercut().len() {
        0 => Ok(()),
        states => Err(CliError::NotLeast {
            states,
            silent: !args.print.quiet,
        }),
    }
}

/// What there is to say.
struct Said<'a> {
    args: &'a CheckLeastArgs,
    model: &'a Model,
    claims: &'a Claims,
    grid: &'a GridValue,
    comparison: &'a Comparison,
    seconds: f64,
}

impl Said<'_> {
    fn names(&self) -> Vec<&str> {
        self.model
            .states
            .iter()
            .map(|s| s.variable.name.as_str())
            .collect()
    }

    fn state(&self, claim: usize) -> &[f64] {
        let n = self.model.states.len();
        &self.claims.x[claim * n..][..n]
    }

    fn undercut(&self) -> Vec<&Flown> {
        self.comparison
            .flown
            .iter()
            .filter(|f| f.undercut)
            .collect()
    }

    fn led(&self, to: Led) -> usize {
        self.comparison.flown.iter().filter(|f| f.led == to).count()
    }

    /// Median difference with its sign; 90 % and the worst without.
    fn quantiles(&self) -> [f64; 3] {
        let mut signed: Vec<f64> = self
            .comparison
            .differences
            .iter()
            .flatten()
            .copied()
            .collect();
        signed.sort_by(f64::total_cmp);
        let mut sizes: Vec<f64> = signed.iter().map(|d| d.abs()).collect();
        sizes.sort_by(f64::total_cmp);
        [
            nearest_rank(&signed, 0.5),
            nearest_rank(&sizes, 0.9),
            nearest_rank(&sizes, 1.0),
        ]
    }

    /// Claims from which the grid is apart, the largest difference first.
    fn apart(&self) -> Vec<(usize, f64)> {
        let all = self.comparison.differences.iter().enumerate();
        let mut list: Vec<(usize, f64)> = all.filter_map(|(k, d)| Some((k, (*d)?))).collect();
        list.retain(|(_, d)| d.abs() > self.args.apart);
        list.sort_by(|a, b| b.1.abs().total_cmp(&a.1.abs()));
        list
    }

    fn nodes(&self) -> Vec<usize> {
        self.grid
            .grid
            .lattice
            .axes
            .iter()
            .map(|a| a.count)
            .collect()
    }

    fn verdict(&self) -> String {
        let (flown, known, all) = (
            self.comparison.flown.len(),
            self.comparison.differences.iter().flatten().count(),
            self.claims.v.len(),
        );
        let below = self.apart().iter().filter(|(_, d)| *d < 0.0).count();
        match self.undercut().len() {
            0 if known == 0 => {
                format!("the grid does not reach any of the {all} states: it says nothing")
            }
            0 => {
                let unexplained = match below {
                    0 => String::new(),
                    n => format!(
                        "; at {n} the grid is lower by more than {}, which no flight of its own bears out",
                        self.args.apart
                    ),
                };
                format!(
                    "nothing costs less than V from any of the {flown} states that were flown from{unexplained}"
                )
            }
            n => format!("V is not the least at {n} of the {flown} states that were flown from"),
        }
    }

    fn text(&self) -> String {
        let (comparison, grid) = (self.comparison, self.grid);
        let nodes: Vec<String> = self.nodes().iter().map(usize::to_string).collect();
        let known = comparison.differences.iter().flatten().count();
        let [median, most, worst] = self.quantiles();
        let mut lines = vec![
            self.model.title.clone(),
            format!(
                "V on a grid of {} nodes, {} beyond the region, on the {} in {:.2} s{}",
                nodes.join(" x "),
                self.args.margin,
                grid.backend,
                grid.seconds,
                rounds(grid)
            ),
            format!(
                "{} {} states, {known} of them known to the grid",
                self.claims.v.len(),
                if self.claims.error.iter().all(|e| *e == 0.0) {
                    "solved"
                } else {
                    "interpolated"
                }
            ),
        ];
        if known > 0 {
            lines.push(format!(
                "(grid - V) / V: median {}; in size 90 % {}, worst {}",
                percent(median, true),
                percent(most, false),
                percent(worst, false)
            ));
            lines.push(self.apart_text());
            lines.push(format!(
                "greedy paths from {} states, {} came home: {} lead to the same V (to 1e-6), {} to a dearer extremal, {} to a cheaper one, {} to none",
                comparison.flown.len(),
                comparison.flown.iter().filter(|f| f.cost.is_some()).count(),
                self.led(Led::Same),
                self.led(Led::Dearer),
                self.led(Led::Lower),
                self.led(Led::Nowhere)
            ));
        }
        lines.extend(self.undercut_text());
        lines.push(format!("{:.2} s: {}", self.seconds, self.verdict()));
        lines.join("\n")
    }

    fn apart_text(&self) -> String {
        let list = self.apart();
        let mut text = format!(
            "apart by more than {} of V: {} states",
            self.args.apart,
            list.len()
        );
        if list.is_empty() {
            return text;
        }
        let head = self
            .names()
            .into_iter()
            .chain(["V", "grid", "difference", "its flight"]);
        let mut rows: Vec<Vec<String>> = vec![head.map(str::to_owned).collect()];
        for (claim, difference) in list.iter().take(SHOWN) {
            let mut row: Vec<String> = self.state(*claim).iter().map(|x| short(*x)).collect();
            row.push(short(self.claims.v[*claim]));
            row.push(self.comparison.grid[*claim].map_or_else(String::new, short));
            row.push(percent(*difference, true));
            row.push(self.flight(*claim));
            rows.push(row);
        }
        text.push_str(&indented(&columns(&rows, &[])));
        text.push_str(&and_more(list.len()));
        text
    }

    /// What the greedy path from a state cost.
    fn flight(&self, claim: usize) -> String {
        let flown = self.comparison.flown.iter().find(|f| f.claim == claim);
        match flown.map(|f| f.cost) {
            None => "not flown".to_owned(),
            Some(None) => "led nowhere".to_owned(),
            Some(Some(cost)) => short(cost),
        }
    }

    /// Every state at which something cheaper was found.
    fn undercut_text(&self) -> Option<String> {
        let list = self.undercut();
        if list.is_empty() {
            return None;
        }
        let names = self.names();
        let costates: Vec<String> = names.iter().map(|n| format!("p_{n}")).collect();
        let head = names.iter().copied().chain(["V in the file", "cheaper"]);
        let head = head.chain(costates.iter().map(String::as_str));
        let mut rows: Vec<Vec<String>> = vec![head.map(str::to_owned).collect()];
        for flown in &list {
            let mut row: Vec<String> = self.state(flown.claim).iter().map(|x| short(*x)).collect();
            row.push(format!("{:.10}", self.claims.v[flown.claim]));
            match &flown.found {
                Some((value, p)) if flown.led == Led::Lower => {
                    row.push(format!("{value:.10}"));
                    row.extend(p.iter().map(|p| format!("{p:.8}")));
                }
                _ => row.push(format!(
                    "{} (flown, not solved for)",
                    flown.cost.map_or_else(String::new, short)
                )),
            }
            rows.push(row);
        }
        Some(format!(
            "cheaper than V in the file:{}",
            indented(&columns(&rows, &[]))
        ))
    }

    fn json(&self) -> serde_json::Value {
        let [median, most, worst] = self.quantiles();
        let apart: Vec<_> = (self.apart().into_iter())
            .map(|(claim, difference)| {
                serde_json::json!({
                    "x": self.state(claim), "V": self.claims.v[claim], "grid": self.comparison.grid[claim],
                    "difference": difference,
                })
            })
            .collect();
        let nowhere: Vec<_> = (self
            .comparison
            .flown
            .iter()
            .filter(|f| f.led == Led::Nowhere))
        .map(|flown| {
            serde_json::json!({
                "x": self.state(flown.claim), "V": self.claims.v[flown.claim], "flown": flown.cost,
            })
        })
        .collect();
        let undercut: Vec<_> = (self.undercut().into_iter())
            .map(|flown| {
                let found = flown.found.as_ref().filter(|_| flown.led == Led::Lower);
                serde_json::json!({
                    "x": self.state(flown.claim), "V": self.claims.v[flown.claim], "flown": flown.cost,
                    "cheaper": found.map(|(value, _)| value), "p": found.map(|(_, p)| p),
                })
            })
            .collect();
        serde_json::json!({
            "file": self.args.file.display().to_string(),
            "states": self.claims.v.len(),
            "known": self.comparison.differences.iter().flatten().count(),
            "grid": {
                "nodes": self.nodes(), "margin": self.args.margin, "backend": self.grid.backend,
                "seconds": self.grid.seconds, "rounds": self.grid.changes.len(), "last_change": self.grid.changes.last(),
            },
            "difference": { "median": median, "p90": most, "worst": worst },
            "apart": { "threshold": self.args.apart, "states": apart },
            "greedy": {
                "states": self.comparison.flown.len(),
                "home": self.comparison.flown.iter().filter(|f| f.cost.is_some()).count(),
                "same": self.led(Led::Same), "dearer": self.led(Led::Dearer),
                "cheaper": self.led(Led::Lower), "none": nowhere,
            },
            "undercut": undercut,
            "verdict": self.verdict(),
            "seconds": self.seconds,
        })
    }
}

fn rounds(grid: &GridValue) -> String {
    let last = grid.changes.last();
    last.map_or_else(String::new, |last| {
        format!(
            ", {} rounds, the last change {last:.0e}",
            grid.changes.len()
        )
    })
}

fn percent(share: f64, signed: bool) -> String {
    if signed {
        format!("{:+.2} %", 100.0 * share)
    } else {
        format!("{:.2} %", 100.0 * share)
    }
}

fn short(x: f64) -> String {
    format!("{x:.6}")
}

fn indented(table: &str) -> String {
    table.lines().map(|line| format!("\n  {line}")).collect()
}

fn and_more(count: usize) -> String {
    match count.saturating_sub(SHOWN) {
        0 => String::new(),
        more => format!("\n  and {more} more (--json has them all)"),
    }
}
