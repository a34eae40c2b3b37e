//! Taking the times: every variant once untimed, then all in turn, several times over.

use super::BenchError;
use super::comparison::Comparison;
use super::errors::{Errors, Quantiles};
use super::pareto;
use super::reference;
use super::variants::{self, Ladder, Missing, Series, Steps, Wanted};
use super::work::{Pass, Work};
use costate::backend::flops;
use costate::backend::{Backend, BackendError, Kernel, Status};
use costate::low_level::model::{Method, Precision};
use std::time::Instant;

/// Trajectories whose errors are looked at: the leading ones, which are spread like all.
const CHECKED: usize = 4096;

/// Errors of more than a tenth are nobody's choice, however soon they are there.
pub const USEFUL: f64 = 0.1;

/// What is measured, and how long.
#[derive(Clone, Debug)]
pub struct Options {
    pub wanted: Wanted,
    /// Timed passes of each variant.
    pub repeats: usize,
    /// Seconds for all passes, references not included: a quarter of it for the first ones, so that
    /// three rounds of timed passes have room. Rounds are whole, and one is always done.
    pub budget: f64,
}

/// One variant's figures.
#[derive(Clone, Debug)]
pub struct Row {
    pub series: Series,
    pub steps: Steps,
    /// Absolute tolerance in units of each component's scale, as a scenario gives it.
    pub atol: f64,
    /// Compiling the series' kernel, and the first pass, which may compile more (s).
    pub compile_seconds: f64,
    pub first_seconds: f64,
    /// Of all trajectories, seeds on the host to results on the host (s): each timed pass, in the
    /// order of the rounds.
    pub seconds: Vec<f64>,
    /// The same in kernels alone; empty where the backend does not know.
    pub kernel_seconds: Vec<f64>,
    /// Means over all trajectories.
    pub steps_taken: f64,
    pub steps_rejected: f64,
    /// Trajectories by status, in the order of [`Status::ALL`].
    pub statuses: [usize; Status::ALL.len()],
    pub errors: Errors,
    /// Floating-point operations a second, of those that the equations and the method need; NaN
    /// where not known.
    pub flops: f64,
    /// That as a share of what the device was measured to do.
    pub peak_share: f64,
    /// Share of the lanes' steps that were steps of a trajectory; not a number where the backend
    /// does not tell.
    pub occupancy: f64,
    /// Whether no variant is faster with a smaller worst e_V. One that loses trajectories or is of
    /// no use is never chosen.
    pub pareto: bool,
}

impl Row {
    /// Seconds of the median pass.
    pub fn median(&self) -> f64 {
        Quantiles::of(&self.seconds).median
    }

    pub fn kernel_median(&self) -> f64 {
        Quantiles::of(&self.kernel_seconds).median
    }

    /// Shortest and longest pass (s).
    pub fn spread(&self) -> [f64; 2] {
        spread(&self.seconds)
    }

    pub fn kernel_spread(&self) -> [f64; 2] {
        spread(&self.kernel_seconds)
    }

    /// Seconds and worst e_V, for choosing; not numbers where trajectories were lost or an error is
    /// of no use.
    pub fn choice(&self) -> (f64, f64) {
        let worst = self.errors.value.worst;
        if self.errors.complete() && worst <= USEFUL {
            (self.median(), worst)
        } else {
            (f64::NAN, f64::NAN)
        }
    }
}

fn spread(seconds: &[f64]) -> [f64; 2] {
    let least = seconds.iter().copied().reduce(f64::min);
    let most = seconds.iter().copied().reduce(f64::max);
    [least.unwrap_or(f64::NAN), most.unwrap_or(f64::NAN)]
}

/// How far two references are apart: no error below it can be told.
#[derive(Clone, Debug)]
pub struct Floor {
    pub methods: [Method; 2],
    pub trajectories: usize,
    pub errors: Errors,
}

/// A device and what it was measured to do.
#[derive(Clone, Debug)]
pub struct Device {
    pub backend: &'static str,
    pub adapter: String,
    /// Floating-point operations a second in f32 and f64; NaN where not known.
    pub peak: [f64; 2],
}

/// Everything that was measured.
#[derive(Clone, Debug)]
pub struct Bench {
    pub devices: Vec<Device>,
    pub rows: Vec<Row>,
    pub missing: Vec<Missing>,
    pub floor: Floor,
    pub trajectories: usize,
    /// Trajectories whose errors were looked at, and those of them with errors of p.
    pub checked: usize,
    pub with_slopes: usize,
    /// Timed passes that all variants had.
    pub rounds: usize,
    pub reference_seconds: f64,
}

impl Bench {
    /// The fastest variant whose worst e_V is at most `wanted`.
    pub fn fastest(&self, wanted: f64) -> Option<&Row> {
        let points = self.rows.iter().map(Row::choice);
        pareto::fastest(points, wanted).map(|i| &self.rows[i])
    }

    pub fn trajectories_per_second(&self, row: &Row) -> f64 {
        self.trajectories as f64 / row.median()
    }

    pub fn kernel_trajectories_per_second(&self, row: &Row) -> f64 {
        self.trajectories as f64 / row.kernel_median()
    }
}

/// Told what is being done.
pub type Told<'a> = &'a mut dyn FnMut(&str);

/// A ladder on the way.
struct Runner {
    ladder: Ladder,
    kernel: Box<dyn Kernel>,
    compile_seconds: f64,
    /// Seconds of its latest first pass.
    last: f64,
    stopped: bool,
}

/// Measures a work on some backends.
///
/// # Errors
/// Device failures, and references that cannot be made. A kernel that a backend refuses is missing,
/// not an error.
pub fn measure(
    work: &Work,
    backends: &[Box<dyn Backend>],
    options: &Options,
    told: Told<'_>,
) -> Result<Bench, BenchError> {
    let begin = Instant::now();
    let checked = work.count().min(CHECKED);
    let comparison = Comparison::new(work, &options.wanted, checked, told)?;
    let floor = comparison.floor(work);
    let reference_seconds = begin.elapsed().as_secs_f64();

    let duration = comparison.median_duration();
    let (ladders, mut missing) = variants::ladders(backends, &options.wanted, duration);
    let devices = rated(backends, told)?;
    let runners = compiled(work, backends, ladders, &mut missing, told);
    let mut climb = Climb {
        work,
        backends,
        options,
        checked,
        runners,
        missing,
        rows: Vec::new(),
        owners: Vec::new(),
    };
    climb.first_passes(&comparison, told)?;
    if climb.rows.is_empty() {
        return Err(nothing_left(&climb.missing));
    }
    let rounds = climb.timed_rounds(told)?;
    let mut bench = Bench {
        devices,
        rows: climb.rows,
        missing: climb.missing,
        floor,
        trajectories: work.count(),
        checked,
        with_slopes: comparison.with_slopes(),
        rounds,
        reference_seconds,
    };
    bench.conclude(work);
    Ok(bench)
}

/// All ladders on the way, and what came of them.
struct Climb<'a> {
    work: &'a Work,
    backends: &'a [Box<dyn Backend>],
    options: &'a Options,
    /// Trajectories whose errors are looked at.
    checked: usize,
    runners: Vec<Runner>,
    missing: Vec<Missing>,
    rows: Vec<Row>,
    /// The runner of each row.
    owners: Vec<usize>,
}

impl Climb<'_> {
    /// Every variant once, with its errors, as far as the budget goes.
    fn first_passes(
        &mut self,
        comparison: &Comparison,
        told: Told<'_>,
    ) -> Result<(), BackendError> {
        let lengths = self.runners.iter().map(|r| r.ladder.steps.len());
        let deepest = lengths.max().unwrap_or(0);
        let mut compiling = 0.0;
        // All from rough to fine at once: what the budget cuts off are the slowest of each series.
        for depth in 0..deepest {
            for owner in 0..self.runners.len() {
                let runner = &self.runners[owner];
                let Some(&steps) = runner.ladder.steps.get(depth) else {
                    continue;
                };
                let expected = runner.last * growth(runner.ladder.series.method);
                let spent = depth > 0 && compiling + expected > self.options.budget;
                if runner.stopped || spent {
                    self.stop(owner, steps);
                    continue;
                }
                compiling += self.first_pass(owner, steps, comparison, told)?;
            }
        }
        Ok(())
    }

    /// The budget ends a ladder at some steps.
    fn stop(&mut self, owner: usize, steps: Steps) {
        let runner = &mut self.runners[owner];
        if !runner.stopped {
            let series = name(self.backends, runner.ladder.series);
            self.missing.push(Missing {
                what: format!("{series} from {}", setting(steps)),
                why: format!("the budget of {} s", self.options.budget),
            });
        }
        runner.stopped = true;
    }

    /// One variant for the first time: its row; the seconds that it took.
    fn first_pass(
        &mut self,
        owner: usize,
        steps: Steps,
        comparison: &Comparison,
        told: Told<'_>,
    ) -> Result<f64, BackendError> {
        let work = self.work;
        let runner = &mut self.runners[owner];
        let series = runner.ladder.series;
        told(&format!(
            "{} {}",
            name(self.backends, series),
            setting(steps)
        ));
        let mut pass = work.integrate(
            runner.kernel.as_mut(),
            &work.run(steps),
            &work.seeds,
            self.checked,
        )?;
        // The time without what a driver compiles in a first pass.
        runner.last = pass.kernel_seconds.unwrap_or(pass.seconds);
        pass.kept = reference::points(std::mem::take(&mut pass.kept));
        let errors = comparison.errors(work, series.method, &pass.kept);
        self.rows.push(row(work, runner, steps, &pass, errors));
        self.owners.push(owner);
        Ok(pass.seconds)
    }

    /// Rounds of timed passes, as many as the budget has room for.
    fn timed_rounds(&mut self, told: Told<'_>) -> Result<usize, BackendError> {
        let options = self.options;
        let round_seconds: f64 = (self.runners.iter())
            .map(|r| r.last * r.ladder.steps.len() as f64)
            .sum();
        let (mut rounds, mut spent) = (0, 0.0);
        while rounds < options.repeats.max(1)
            && (rounds == 0 || spent + round_seconds <= options.budget)
        {
            told(&format!(
                "round {} of {}: {} variants",
                rounds + 1,
                options.repeats,
                self.rows.len()
            ));
            // There and back, so that no variant always comes when the machine is warm.
            let order: Box<dyn Iterator<Item = usize>> = if rounds % 2 == 0 {
                Box::new(0..self.rows.len())
            } else {
                Box::new((0..self.rows.len()).rev())
            };
            for k in order {
                spent += self.timed_pass(k)?;
            }
            rounds += 1;
        }
        Ok(rounds)
    }

    /// One more pass of a row; its seconds.
    fn timed_pass(&mut self, k: usize) -> Result<f64, BackendError> {
        let (work, row) = (self.work, &mut self.rows[k]);
        let kernel = self.runners[self.owners[k]].kernel.as_mut();
        let pass = work.integrate(kernel, &work.run(row.steps), &work.seeds, 0)?;
        row.seconds.push(pass.seconds);
        row.kernel_seconds.extend(pass.kernel_seconds);
        Ok(pass.seconds)
    }
}

/// Why there is no row at all.
fn nothing_left(missing: &[Missing]) -> BenchError {
    let mut why: Vec<String> = missing
        .iter()
        .map(|m| format!("{}: {}", m.what, m.why))
        .collect();
    if why.is_empty() {
        why.push("the tolerances asked for are below what the precision resolves".to_owned());
    }
    BenchError::NothingLeft {
        why: why.join("; "),
    }
}

impl Bench {
    /// What follows from all times: rates, and who is on the front.
    fn conclude(&mut self, work: &Work) {
        let points: Vec<(f64, f64)> = self.rows.iter().map(Row::choice).collect();
        let count = self.trajectories as f64;
        for (row, pareto) in self.rows.iter_mut().zip(pareto::front(&points)) {
            row.pareto = pareto;
            let spec = work.spec(row.series.method, row.series.precision);
            let attempts = (row.steps_taken + row.steps_rejected) * count;
            row.flops = flops::of_step(&spec, row.steps.rtol().unwrap_or(1.0)) * attempts
                / row.kernel_median();
            row.peak_share =
                row.flops / self.devices[row.series.device].peak[row.series.precision as usize];
        }
    }
}

/// The devices, each with its measured arithmetic rates.
fn rated(backends: &[Box<dyn Backend>], told: Told<'_>) -> Result<Vec<Device>, BackendError> {
    let mut devices = Vec::new();
    for backend in backends {
        told(&format!("arithmetic rate of {}", backend.adapter()));
        devices.push(Device {
            backend: backend.name(),
            adapter: backend.adapter(),
            peak: [
                peak(backend.as_ref(), Precision::F32)?,
                peak(backend.as_ref(), Precision::F64)?,
            ],
        });
    }
    Ok(devices)
}

fn peak(backend: &dyn Backend, precision: Precision) -> Result<f64, BackendError> {
    if !backend.supports(precision) {
        return Ok(f64::NAN);
    }
    Ok(backend.peak(precision)?.unwrap_or(f64::NAN))
}

fn compiled(
    work: &Work,
    backends: &[Box<dyn Backend>],
    ladders: Vec<Ladder>,
    missing: &mut Vec<Missing>,
    told: Told<'_>,
) -> Vec<Runner> {
    let mut runners = Vec::new();
    for ladder in ladders {
        let series = ladder.series;
        told(&format!("compiling {}", name(backends, series)));
        let begin = Instant::now();
        match backends[series.device].compile(&work.spec(series.method, series.precision)) {
            Ok(kernel) => runners.push(Runner {
                ladder,
                kernel,
                compile_seconds: begin.elapsed().as_secs_f64(),
                last: 0.0,
                stopped: false,
            }),
            Err(e) => missing.push(Missing {
                what: name(backends, series),
                why: e.to_string(),
            }),
        }
    }
    runners
}

fn row(work: &Work, runner: &Runner, steps: Steps, pass: &Pass, errors: Errors) -> Row {
    let count = work.count() as f64;
    Row {
        series: runner.ladder.series,
        steps,
        atol: written(work.plan.atol * steps.rtol().map_or(1.0, |rtol| rtol / work.plan.run.rtol)),
        compile_seconds: runner.compile_seconds,
        first_seconds: pass.seconds,
        seconds: Vec::new(),
        kernel_seconds: Vec::new(),
        steps_taken: pass.steps as f64 / count,
        steps_rejected: pass.rejected as f64 / count,
        statuses: pass.statuses,
        errors,
        flops: f64::NAN,
        peak_share: f64::NAN,
        occupancy: if pass.lane_steps == 0 {
            f64::NAN
        } else {
            (pass.steps + pass.rejected) as f64 / pass.lane_steps as f64
        },
        pareto: false,
    }
}

/// A number as one would write it: 1e-10 and not 1.0000000000000002e-10.
fn written(x: f64) -> f64 {
    format!("{x:.12e}").parse().unwrap_or(x)
}

/// By what the next rung takes longer, about: twice the steps, or a tenth of the tolerance at the
/// lowest order.
fn growth(method: Method) -> f64 {
    if method.adaptive() { 1.8 } else { 2.0 }
}

/// A series in words.
fn name(backends: &[Box<dyn Backend>], series: Series) -> String {
    let adapter = backends[series.device].adapter();
    format!(
        "{adapter} {} {}",
        series.precision.name(),
        series.method.name()
    )
}

/// Steps in words.
pub fn setting(steps: Steps) -> String {
    match steps {
        Steps::Tolerance(rtol) => format!("rtol {rtol:.0e}"),
        Steps::Fixed(step) => format!("step {step}"),
    }
}
