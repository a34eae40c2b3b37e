//! Parts put together to the whole.

use super::super::{Provenance, RunError, in_json};
use super::manifest::{Kind, Manifest};
use super::rows::{Layout, Rows, Sink};
use super::study;
use crate::backend::cpu::{Cpu, in_pool};
use crate::hdf5::ResultFile;
use crate::model::Model;
use crate::result::{RunRecord, ShardGroups, Stored, StoredError, TrajectorySchema};
use crate::schema;
use crate::session::summary::{Quantiles, RunSummary, SolvedErrors, SolvedSummary};
use crate::session::{Progress, Session, SessionError, Wanted};
use crate::sweep::Plan;
use crate::value::blocks::{Joined, Seam, Wanting, join, lines};
use crate::value::{self, Answers, Grid, PointStatus, Request};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use std::path::{Path, PathBuf};

/// Rows that are held at once, of all files together; and at least of each.
const ROWS: usize = 1 << 19;
const LEAST_ROWS: usize = 256;
const MOST_ROWS: usize = 8192;

/// What to do with what is not there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MergeOptions {
    /// Puts together what there is: states of shards that are missing have the status `not_merged`.
    pub partial: bool,
}

/// What came of it.
#[derive(Clone, Debug)]
pub struct Merged {
    /// The whole's file.
    pub path: PathBuf,
    /// How many files were put together.
    pub files: usize,
    /// How many shards there are of the whole.
    pub shards: usize,
    /// Shards that are missing.
    pub missing: Vec<usize>,
    /// Shards that were ended before they were done.
    pub unfinished: Vec<usize>,
    /// The numbers, as the file has them.
    pub summary: RunSummary,
    /// How long it took to put them together.
    pub seconds: f64,
}

/// Why files are not put together.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "its message says what each is")]
pub enum MergeError {
    #[error("no files to put together: name the results of the shards")]
    Nothing,
    #[error(
        "{path} is no part of a whole: it was not made with --shard", path = path.display()
    )]
    NoPart { path: PathBuf },
    #[error("{path} is a part that another version of costate has made: make it again with this one", path = path.display())]
    OtherVersion { path: PathBuf },
    #[error(
        "{path} and {other} are not of one whole: {what} differs ({a}; {b})",
        path = path.display(), other = other.display()
    )]
    Differs {
        path: PathBuf,
        other: PathBuf,
        what: &'static str,
        a: String,
        b: String,
    },
    #[error("shard {shard} is there twice: {path} and {other}", path = path.display(), other = other.display())]
    Twice {
        shard: usize,
        path: PathBuf,
        other: PathBuf,
    },
    #[error(
        "of {of} shards {} missing: {}; run them, or put together what there is with --partial",
        if missing.len() == 1 { "one is" } else { "some are" },
        listed(missing)
    )]
    Missing { missing: Vec<usize>, of: usize },
    #[error(
        "{path} is not finished: run its shard again with --resume, or put together what there is with --partial",
        path = path.display()
    )]
    Unfinished { path: PathBuf },
    #[error("{path}: /{group} is not as this program writes it", path = path.display())]
    Damaged { path: PathBuf, group: &'static str },
    #[error(
        "{path} cannot be gone on with: {what} was another ({then}, and now {now}); leave --resume out to begin anew",
        path = path.display()
    )]
    Other {
        path: PathBuf,
        what: &'static str,
        now: String,
        then: String,
    },
    #[error("{path} is both a part and the whole: name another --out", path = path.display())]
    OverPart { path: PathBuf },
}

/// Numbers, with ranges where several follow each other: `0, 3-7, 9`.
fn listed(numbers: &[usize]) -> String {
    let mut runs: Vec<(usize, usize)> = Vec::new();
    for &n in numbers {
        match runs.last_mut() {
            Some((_, last)) if *last + 1 == n => *last = n,
            _ => runs.push((n, n)),
        }
    }
    let text = |(a, b): &(usize, usize)| match b - a {
        0 => a.to_string(),
        1 => format!("{a}, {b}"),
        _ => format!("{a}-{b}"),
    };
    runs.iter().map(text).collect::<Vec<_>>().join(", ")
}

/// A part, open.
pub(super) struct Source {
    pub stored: Stored,
    pub manifest: Manifest,
    /// Numbers of its blocks, whether each is done, and how many states it has.
    number: Vec<i32>,
    done: Vec<i32>,
    states: Vec<i32>,
}

impl Source {
    pub fn open(path: &Path) -> Result<Self, RunError> {
        let stored = Stored::open(path)?;
        let no_part = || MergeError::NoPart {
            path: path.to_owned(),
        };
        let manifest = match Manifest::read(&stored) {
            Some(manifest) => manifest,
            None if stored.has_attribute(super::MANIFEST) => {
                let path = path.to_owned();
                return Err(MergeError::OtherVersion { path }.into());
            }
            None => return Err(no_part().into()),
        };
        let group = stored.group(&schema::SHARD).ok_or_else(no_part)?;
        let (number, done, states) = (
            group.i32("number")?.1,
            group.i32("done")?.1,
            group.i32("states")?.1,
        );
        Ok(Self {
            manifest,
            number,
            done,
            states,
            stored,
        })
    }

    fn path(&self) -> PathBuf {
        self.stored.path.clone()
    }

    pub fn damaged(&self, group: &'static str) -> RunError {
        let path = self.path();
        MergeError::Damaged { path, group }.into()
    }

    /// Whether it is a part of the same, and the same one.
    ///
    /// # Errors
    /// [`MergeError::Other`] where it is not.
    pub fn is_of(&self, manifest: &Manifest) -> Result<(), MergeError> {
        let other = &self.manifest;
        let differs = manifest.differs(other).or_else(|| {
            let shard = |m: &Manifest| format!("{}/{}", m.shard, m.shards);
            let (a, b) = (shard(manifest), shard(other));
            (a != b).then_some(("shard", a, b))
        });
        let path = self.path();
        match differs {
            Some((what, now, then)) => Err(MergeError::Other {
                path,
                what,
                now,
                then,
            }),
            None => Ok(()),
        }
    }

    /// The numbers of its units.
    pub fn numbers(&self) -> Vec<usize> {
        self.number.iter().map(|k| (*k).max(0) as usize).collect()
    }

    /// The units that are done.
    pub fn done(&self) -> impl Iterator<Item = usize> {
        let blocks = self.number.iter().zip(&self.done);
        blocks
            .filter(|(_, done)| **done == 1)
            .map(|(k, _)| (*k).max(0) as usize)
    }

    fn is_finished(&self) -> bool {
        self.done.iter().all(|done| *done == 1)
    }

    fn seams(&self) -> Result<Vec<Seam>, RunError> {
        let Some(group) = self.stored.group(&schema::SHARD_SEAMS) else {
            return Ok(Vec::new());
        };
        let numbers = group.f64("value")?.values;
        let seams = Seam::all_from(&numbers).filter(|seams| {
            let blocks = seams.iter().map(|s| s.block as i64);
            blocks.eq(self.number.iter().map(|k| i64::from(*k)))
        });
        seams.ok_or_else(|| self.damaged("shard_seams"))
    }
}

/// Puts parts together to the whole: as one run would have written it, but for clocks and the
/// estimate of errors.
///
/// # Errors
/// Where the parts are not of one whole, or not all are there; of reading and writing.
pub fn merge(
    paths: &[PathBuf],
    out: &Path,
    options: MergeOptions,
    provenance: &Provenance,
    progress: &dyn Progress,
) -> Result<Merged, RunError> {
    let sources = (paths.iter())
        .map(|path| Source::open(path))
        .collect::<Result<Vec<_>, _>>()?;
    let first = sources.first().ok_or(MergeError::Nothing)?;
    let (missing, unfinished) = check(&sources, out, options)?;

    let session = Session::on(&first.stored.scene, Box::new(Cpu::new())).with_progress(progress);
    let gaps = (!missing.is_empty() || !unfinished.is_empty()).then_some((&*missing, &*unfinished));
    let (path, summary) = match first.manifest.of {
        Kind::States => assemble(&session, &sources, Into::Whole(gaps), out, provenance)?,
        Kind::Study => {
            let (file, summary) =
                study::assemble(&session, &sources, (gaps.is_some(), out), provenance)?;
            note_gaps(&file, gaps)?;
            (session.finish(file, provenance)?, summary)
        }
    };
    Ok(Merged {
        files: sources.len(),
        shards: first.manifest.shards,
        path,
        missing,
        unfinished,
        summary,
        seconds: provenance.seconds(),
    })
}

/// Shards that are missing, and those that are not finished; `None` where there are none.
type Gaps<'a> = Option<(&'a [usize], &'a [usize])>;

fn note_gaps(file: &ResultFile, gaps: Gaps<'_>) -> Result<(), RunError> {
    if let Some((missing, unfinished)) = gaps {
        file.attribute("shards_missing", listed(missing))?;
        file.attribute("shards_unfinished", listed(unfinished))?;
    }
    Ok(())
}

/// What parts are put together to.
#[derive(Clone, Copy)]
pub(super) enum Into<'a> {
    /// The whole, and what is missing of it.
    Whole(Gaps<'a>),
    /// A part; whether it is finished.
    Part(&'a Manifest, bool),
}

/// Puts parts together, and in place.
pub(super) fn assemble(
    session: &Session<'_>,
    sources: &[Source],
    into: Into<'_>,
    out: &Path,
    provenance: &Provenance,
) -> Result<(PathBuf, RunSummary), RunError> {
    let progress = session.progress();
    let whole = Whole::new(session, sources)?;
    progress.step("sheets of the parts are joined");
    let (plan, model, request, seams) = (&whole.plan, whole.model, &whole.request, &whole.seams);
    let is_part = matches!(into, Into::Part(..));
    let joined = in_pool(|| joined((plan, model), request, seams, is_part))?;
    progress.step_ended();

    let mut file = ResultFile::create(out)?;
    let mut groups = is_part.then(ShardGroups::default);
    let counted = whole.write_rows(&mut file, &joined, groups.as_mut())?;
    let (edges, solutions) = whole.edges(&joined);
    file.sheet_edges(&whole.schema, &edges)?;
    let is_whole = matches!(into, Into::Whole(None) | Into::Part(_, true));
    let summary = whole.summary(&joined, counted, (&edges, solutions), (!is_whole, out));
    file.attribute("summary", in_json(&summary))?;
    if !is_whole {
        file.attribute("stopped", 1i64)?;
    }
    match into {
        Into::Part(manifest, _) => {
            let groups = groups.unwrap_or_default();
            file.shard(&whole.groups(groups))?;
            super::write_manifest(&file, manifest)?;
        }
        Into::Whole(gaps) => note_gaps(&file, gaps)?,
    }
    let record = |name: &str| sources[0].stored.attribute(name).unwrap_or_default();
    RunRecord {
        backend: record("backend"),
        adapter: record("adapter"),
        precision: record("precision"),
        method: record("method"),
        rtol: summary.rtol,
        atol: summary.atol,
        wall_seconds: summary.wall_seconds,
        ..provenance.record(model)
    }
    .write(&file)?;
    Ok((file.finish()?, summary))
}

/// Whether parts are of one whole; the shards that are missing, and those that are not finished.
fn check(
    sources: &[Source],
    out: &Path,
    options: MergeOptions,
) -> Result<(Vec<usize>, Vec<usize>), RunError> {
    let first = &sources[0].manifest;
    let same_file = |a: &Path| {
        let whole = |path: &Path| std::fs::canonicalize(path).ok();
        whole(a).is_some() && whole(a) == whole(out)
    };
    let mut at: BTreeMap<usize, PathBuf> = BTreeMap::new();
    for source in sources {
        let path = source.path();
        if same_file(&path) {
            return Err(MergeError::OverPart { path }.into());
        }
        if let Some((what, a, b)) = first.differs(&source.manifest) {
            let other = path;
            let path = sources[0].path();
            return Err(MergeError::Differs {
                path,
                other,
                what,
                a,
                b,
            }
            .into());
        }
        let shard = source.manifest.shard;
        if let Some(other) = at.insert(shard, path.clone()) {
            return Err(MergeError::Twice {
                shard,
                path: other,
                other: path,
            }
            .into());
        }
    }
    let of = first.shards;
    let missing: Vec<usize> = (0..of).filter(|k| !at.contains_key(k)).collect();
    let late = sources.iter().filter(|s| !s.is_finished());
    let unfinished: Vec<usize> = late.clone().map(|s| s.manifest.shard).collect();
    if options.partial {
        return Ok((missing, unfinished));
    }
    if !missing.is_empty() {
        return Err(MergeError::Missing { missing, of }.into());
    }
    match late.map(Source::path).next() {
        Some(path) => Err(MergeError::Unfinished { path }.into()),
        None => Ok((missing, unfinished)),
    }
}

/// What all parts are of.
struct Whole<'s> {
    sources: &'s [Source],
    manifest: &'s Manifest,
    model: &'s Model,
    plan: Plan,
    schema: TrajectorySchema,
    request: Request,
    map: bool,
    /// All seams, by block.
    seams: Vec<Seam>,
    /// Of each block the part that it is taken from: one in which it was searched to the end, if
    /// there is one.
    from: BTreeMap<i32, usize>,
}

/// The sheets' numbers over all parts.
fn joined(
    (plan, model): (&Plan, &Model),
    request: &Request,
    seams: &[Seam],
    is_part: bool,
) -> Result<Joined, SessionError> {
    let mut solver = value::solver(plan, &Cpu::new())?;
    let wanting = match is_part {
        false => Wanting::of(plan, model, request),
        true => Wanting::of(plan, model, request).in_no_time(),
    };
    Ok(join(plan, &mut solver, seams, &request.grids, wanting)?)
}

/// What was counted while rows were written.
#[derive(Default)]
struct Counted {
    status: BTreeMap<String, usize>,
    residual: f64,
    hamiltonian: Vec<f64>,
}

impl<'s> Whole<'s> {
    fn new(session: &'s Session<'_>, sources: &'s [Source]) -> Result<Self, RunError> {
        let model = &session.scene().model;
        let manifest = &sources[0].manifest;
        let mut from: BTreeMap<i32, (usize, i32)> = BTreeMap::new();
        for (k, source) in sources.iter().enumerate() {
            for (&block, &done) in source.number.iter().zip(&source.done) {
                let known = from.entry(block).or_insert((k, done));
                if done > known.1 {
                    *known = (k, done);
                }
            }
        }
        let from: BTreeMap<i32, usize> = from.into_iter().map(|(b, (k, _))| (b, k)).collect();
        let mut seams = Vec::new();
        for (k, source) in sources.iter().enumerate() {
            let own = source.seams()?.into_iter();
            seams.extend(own.filter(|seam| from.get(&(seam.block as i32)) == Some(&k)));
        }
        seams.sort_by_key(|seam| seam.block);
        let asked = &manifest.asked;
        let mut request = Request {
            one_sheet: asked.one_sheet,
            ..Request::default()
        };
        let mut map = false;
        if !asked.listed {
            let wanted = match asked.of_map {
                true => Wanted::map(),
                false => Wanted::homotopy(),
            };
            if let Some(targets) = session.targets(&wanted)? {
                (request, map) = (targets.request, targets.map);
            }
        }
        let choices = value::for_guesses(
            crate::sweep::Choices {
                rtol: Some(manifest.rtol),
                ..crate::sweep::Choices::default()
            },
            model.states.len(),
            asked.rows,
        );
        let plan = session.plan(choices)?;
        Ok(Self {
            schema: super::super::trajectory_schema(model, &plan),
            sources,
            manifest,
            model,
            plan,
            request,
            map,
            seams,
            from,
        })
    }

    /// Where two sheets cost the same, and folds, over all parts; and how many solutions there are.
    fn edges(&self, joined: &Joined) -> (Answers, usize) {
        let mut all = Answers::default();
        for (k, seam) in self.seams.iter().enumerate() {
            let number = |s: i32| joined.sheet[k][s as usize];
            all.equal_cost
                .extend(seam.crossings.iter().cloned().map(|mut one| {
                    one.renumber(number);
                    one
                }));
            all.folds.extend(seam.folds.iter().cloned());
        }
        all.equal_cost.extend(joined.crossings.iter().cloned());
        all.equal_cost.sort_by_key(|e| e.point.between);
        lines(&mut all.equal_cost, &self.request.grids);
        let solutions = self.seams.iter().map(|s| s.solutions).sum();
        (all, solutions)
    }

    /// The groups of a part that has these rows.
    fn groups(&self, rows: ShardGroups) -> ShardGroups {
        let of = |block: &i32, from: usize, column: fn(&Source) -> &[i32]| {
            let source = &self.sources[from];
            let place = source.number.iter().position(|own| own == block);
            place.map_or(0, |k| column(source)[k])
        };
        let blocks = || self.from.iter();
        ShardGroups {
            number: blocks().map(|(block, _)| *block).collect(),
            done: blocks()
                .map(|(block, k)| of(block, *k, |s| &s.done))
                .collect(),
            states: blocks()
                .map(|(block, k)| of(block, *k, |s| &s.states))
                .collect(),
            seams: self.seams.iter().flat_map(Seam::to_numbers).collect(),
            ..rows
        }
    }

    /// How many rows of each file are held at once.
    fn at_once(&self) -> usize {
        (ROWS / self.sources.len()).clamp(LEAST_ROWS, MOST_ROWS)
    }

    fn grid(&self) -> Option<&Grid> {
        self.request.grids.last().filter(|_| self.map)
    }

    /// Writes `/points`, `/points_sheets`, `/map` and `/trajectories`, in the order in which states
    /// were asked for. Of a part all states go to `/points`, and `part` is told of them.
    fn write_rows(
        &self,
        file: &mut ResultFile,
        joined: &Joined,
        mut part: Option<&mut ShardGroups>,
    ) -> Result<Counted, RunError> {
        let mut streams = (self.sources.iter())
            .map(|source| Stream::open(source, self.at_once()))
            .collect::<Result<Vec<_>, _>>()?;
        let rows = self.manifest.asked.rows;
        let mut sinks = Sinks::new(self, file, &streams, part.is_some())?;
        let seam_of: BTreeMap<i32, usize> = (self.seams.iter().enumerate())
            .map(|(k, seam)| (seam.block as i32, k))
            .collect();
        let damaged = |k: usize| self.sources[k].damaged("shard_points");

        let mut heap = BinaryHeap::new();
        for (k, stream) in streams.iter_mut().enumerate() {
            if let Some(index) = self.next_of(stream, k)? {
                heap.push(Reverse((index, k)));
            }
        }
        let mut counted = Counted::default();
        let mut next = 0usize;
        while let Some(Reverse((index, k))) = heap.pop() {
            // Each state has one number, and each part has them in order.
            let index = usize::try_from(index).map_err(|_| damaged(k))?;
            if index < next || index >= rows {
                return Err(damaged(k));
            }
            if part.is_none() {
                self.nothing(&mut sinks, &mut counted, next..index)?;
            }
            next = index + 1;
            let stream = &mut streams[k];
            let block = stream.block()?;
            let seam = *seam_of.get(&block).ok_or_else(|| damaged(k))?;
            let number = |of: &[Vec<i32>], sheet: i32| -> Option<i32> {
                of[seam].get(usize::try_from(sheet).ok()?).copied()
            };
            let numbers = |sheet: i32| match sheet {
                -1 => Some((-1, -1)),
                sheet => Some((
                    number(&joined.sheet, sheet)?,
                    number(&joined.lifted, sheet)?,
                )),
            };
            if let Some(part) = &mut part {
                part.index.push(index as i32);
                part.block.push(block);
                part.sheet.push(stream.place.whole(2)?);
                part.again.push(stream.place.whole(3)?);
            }
            sinks
                .row(
                    self,
                    stream,
                    index,
                    &numbers,
                    (&mut counted, part.as_deref_mut()),
                )?
                .ok_or_else(|| damaged(k))?;
            stream.advance();
            if let Some(index) = self.next_of(stream, k)? {
                heap.push(Reverse((index, k)));
            }
        }
        if part.is_none() {
            self.nothing(&mut sinks, &mut counted, next..rows)?;
        }
        sinks.flush()?;
        Ok(counted)
    }

    /// The number of a part's next state that is taken from it; `None` where there is none.
    fn next_of(&self, stream: &mut Stream, k: usize) -> Result<Option<i32>, RunError> {
        while let Some(index) = stream.index()? {
            let block = stream.block()?;
            if self.from.get(&block) == Some(&k) {
                return Ok(Some(index));
            }
            stream.skip()?;
        }
        Ok(None)
    }

    /// States that no part has.
    fn nothing(
        &self,
        sinks: &mut Sinks,
        counted: &mut Counted,
        rows: std::ops::Range<usize>,
    ) -> Result<(), RunError> {
        for row in rows {
            sinks.nothing(self, row)?;
            let name = PointStatus::NotMerged.name().to_owned();
            *counted.status.entry(name).or_insert(0) += 1;
        }
        Ok(())
    }

    fn summary(
        &self,
        joined: &Joined,
        counted: Counted,
        (edges, solutions): (&Answers, usize),
        (stopped, out): (bool, &Path),
    ) -> RunSummary {
        let mut parts: Vec<RunSummary> = (self.sources.iter())
            .filter_map(|source| source.stored.run_summary().ok().flatten())
            .collect();
        let errors: Vec<SolvedErrors> = (parts.iter())
            .filter_map(|part| part.homotopy.as_ref()?.error_estimate.clone())
            .collect();
        let seconds: f64 = self.seams.iter().map(|s| s.seconds).sum();
        let distinct: i32 = self.groups(ShardGroups::default()).states.iter().sum();
        let wall: f64 = parts.iter().map(|part| part.wall_seconds).sum();
        let met = parts.iter().map(|part| part.error_met);
        let met: Vec<Option<bool>> = met.collect();
        let solved = SolvedSummary {
            states: self.manifest.asked.rows,
            distinct: distinct.max(0) as usize,
            status: counted.status,
            solutions,
            sheets: joined.sheets,
            equal_cost_points: edges.equal_cost.len(),
            fold_points: edges.folds.len(),
            largest_residual: counted.residual,
            hamiltonian_relative: Quantiles::of(&counted.hamiltonian),
            error_estimate: largest(&errors),
            integrations: self.seams.iter().map(|s| s.evaluations).sum(),
            seconds,
            states_per_second: f64::from(distinct) / seconds.max(1e-9),
        };
        let first = match parts.is_empty() {
            true => RunSummary::default(),
            false => parts.swap_remove(0),
        };
        RunSummary {
            title: self.model.title.clone(),
            file: out.display().to_string(),
            backend: self.manifest.backend.clone(),
            precision: self.manifest.precision.clone(),
            method: self.manifest.method.clone(),
            stopped,
            homotopy: Some(solved),
            wall_seconds: wall,
            error_met: match met.contains(&Some(false)) {
                true => Some(false),
                false => met.iter().copied().flatten().next(),
            },
            ..first
        }
    }
}

/// The largest of the errors that parts have estimated: of medians, too.
fn largest(errors: &[SolvedErrors]) -> Option<SolvedErrors> {
    let of = |a: Option<f64>, b: Option<f64>| match (a, b) {
        (Some(a), Some(b)) => Some(a.max(b)),
        (a, b) => a.or(b),
    };
    let both = |a: Option<Quantiles>, b: Option<Quantiles>| match (a, b) {
        (Some(a), Some(b)) => Some(Quantiles {
            median: of(a.median, b.median),
            p99: of(a.p99, b.p99),
            max: of(a.max, b.max),
        }),
        (a, b) => a.or(b),
    };
    errors.iter().cloned().reduce(|a, b| SolvedErrors {
        states: a.states + b.states,
        failed: a.failed + b.failed,
        value: both(a.value, b.value),
        costate: both(a.costate, b.costate),
        control: both(a.control, b.control),
        met: match (a.met, b.met) {
            (Some(a), Some(b)) => Some(a && b),
            (a, b) => a.or(b),
        },
        seconds: a.seconds + b.seconds,
        ..a
    })
}

/// The rows of a part: its states, the solutions of each, and its trajectory.
struct Stream {
    place: Rows,
    points: Option<Rows>,
    solutions: Option<(Rows, Rows)>,
    trajectories: Option<Rows>,
    layouts: Layouts,
}

/// The variables of each group of a part.
#[derive(Clone, Default)]
struct Layouts {
    points: Option<Layout>,
    solutions: Option<Layout>,
    trajectories: Option<Layout>,
}

impl Stream {
    fn open(source: &Source, at_once: usize) -> Result<Self, RunError> {
        let stored = &source.stored;
        let damaged = |group| source.damaged(group);
        let rows = |own: &'static schema::Group| -> Result<Option<(Rows, Layout)>, StoredError> {
            let Some(group) = stored.group(own) else {
                return Ok(None);
            };
            let layout = Layout::of(&group, own)?;
            Ok(Some((Rows::new(&group, &layout, at_once)?, layout)))
        };
        let (place, _) = rows(&schema::SHARD_POINTS)?.ok_or_else(|| damaged("shard_points"))?;
        let points = rows(&schema::POINTS)?;
        let count = points.as_ref().map_or(0, |(rows, _)| rows.count);
        if count != place.count {
            return Err(damaged("shard_points"));
        }
        let (points, of_points) = points.unzip();
        let (solutions, of_solutions) = rows(&schema::POINTS_SHEETS)?.unzip();
        let (sheets, _) = rows(&schema::SHARD_SHEETS)?.unzip();
        let solutions = match (solutions, sheets) {
            (Some(solutions), Some(sheets)) if solutions.count == sheets.count => {
                Some((solutions, sheets))
            }
            (None, _) => None,
            _ => return Err(damaged("shard_sheets")),
        };
        let (trajectories, of_trajectories) = rows(&schema::TRAJECTORIES)?.unzip();
        Ok(Self {
            place,
            points,
            solutions,
            trajectories,
            layouts: Layouts {
                points: of_points,
                solutions: of_solutions,
                trajectories: of_trajectories,
            },
        })
    }

    /// The number of the present state among all; `None` at the end.
    fn index(&mut self) -> Result<Option<i32>, StoredError> {
        match self.place.at < self.place.count {
            true => self.place.whole(0).map(Some),
            false => Ok(None),
        }
    }

    fn block(&mut self) -> Result<i32, StoredError> {
        self.place.whole(1)
    }

    fn advance(&mut self) {
        self.place.advance();
        if let Some(points) = &mut self.points {
            points.advance();
        }
    }

    /// Passes over the present state with all that belongs to it.
    fn skip(&mut self) -> Result<(), StoredError> {
        if let (Some(points), Some(layout)) = (&mut self.points, &self.layouts.points) {
            let place = |name: &str| layout.place(name).unwrap_or(usize::MAX);
            let count = points.whole(place("sheets"))?;
            let value = points.reals(place("V"))?[0];
            if let Some((solutions, sheets)) = &mut self.solutions {
                (0..count).for_each(|_| {
                    solutions.advance();
                    sheets.advance();
                });
            }
            if let Some(trajectories) = self.trajectories.as_mut().filter(|_| value.is_finite()) {
                trajectories.advance();
            }
        }
        self.advance();
        Ok(())
    }
}

/// The groups of the whole on their way.
struct Sinks {
    points: Option<Sink>,
    solutions: Option<Sink>,
    map: Option<(Sink, Vec<usize>)>,
    trajectories: Option<Sink>,
    value_max: Option<f64>,
    names: Layouts,
    /// States that go to `/points`: the first ones.
    listed: usize,
}

impl Sinks {
    fn new(
        whole: &Whole<'_>,
        file: &mut ResultFile,
        streams: &[Stream],
        is_part: bool,
    ) -> Result<Self, RunError> {
        let (schema, at_once) = (&whole.schema, MOST_ROWS);
        let any = |of: fn(&Layouts) -> &Option<Layout>| {
            streams.iter().find_map(|s| of(&s.layouts).clone())
        };
        let names = Layouts {
            points: any(|l| &l.points),
            solutions: any(|l| &l.solutions),
            trajectories: any(|l| &l.trajectories),
        };
        let asked = &whole.manifest.asked;
        let count = if is_part { asked.rows } else { asked.points };
        let points = match &names.points {
            Some(layout) if count > 0 => {
                let writer = file.points_later(schema, count)?;
                Some(Sink::new(writer, layout.clone(), at_once, None))
            }
            _ => None,
        };
        let solutions = match &names.solutions {
            Some(layout) if count > 0 => {
                let writer = file.points_sheets_later(schema, count)?;
                Some(Sink::new(writer, layout.clone(), at_once, None))
            }
            _ => None,
        };
        let map = match (whole.grid().filter(|_| !is_part), &names.points) {
            (Some(grid), Some(of_points)) => {
                let (layout, places) = of_points.part_of(&schema::MAP);
                let slab = grid.len() / grid.axes[0].len();
                let writer = file.map_later(schema, grid)?;
                Some((Sink::new(writer, layout, at_once, Some(slab)), places))
            }
            _ => None,
        };
        let trajectories = match (&names.trajectories, whole.manifest.asked.samples) {
            (Some(layout), Some(samples)) => {
                let schema = TrajectorySchema {
                    samples,
                    ..schema.clone()
                };
                let writer = file.group(&schema.group()?)?;
                Some(Sink::new(writer, layout.clone(), at_once / 8, None))
            }
            _ => None,
        };
        let of_map = whole.model.map.as_ref();
        Ok(Self {
            points,
            solutions,
            map,
            trajectories,
            value_max: of_map.and_then(|m| m.value_max),
            names,
            listed: count,
        })
    }

    /// A state of a part that is missing.
    fn nothing(&mut self, whole: &Whole<'_>, row: usize) -> Result<(), RunError> {
        let sink = match row < self.listed {
            true => self.points.as_mut(),
            false => self.map.as_mut().map(|(sink, _)| sink),
        };
        let Some(sink) = sink else { return Ok(()) };
        sink.nothing();
        sink.set_wholes("sheet", -1);
        sink.set_wholes("lifted_sheet", -1);
        sink.set_wholes("status", PointStatus::NotMerged as i32);
        let mut first = 0;
        for grid in &whole.request.grids {
            if (first..first + grid.len()).contains(&row) {
                sink.set_reals("x0", &grid.point(row - first));
            }
            first += grid.len();
        }
        Ok(sink.flush_if_full()?)
    }

    /// The present state of a part with all that belongs to it. `None` where its sheets are none of
    /// its block's.
    fn row(
        &mut self,
        whole: &Whole<'_>,
        stream: &mut Stream,
        row: usize,
        numbers: &dyn Fn(i32) -> Option<(i32, i32)>,
        (counted, mut part): (&mut Counted, Option<&mut ShardGroups>),
    ) -> Result<Option<()>, RunError> {
        let (Some(rows), Some(layout)) = (&mut stream.points, &self.names.points) else {
            return Ok(None);
        };
        let place = |name: &str| layout.place(name).unwrap_or(usize::MAX);
        let (v, sheets, status) = (place("V"), place("sheets"), place("status"));
        let value = rows.reals(v)?[0];
        let count = rows.whole(sheets)?;
        let mut code = rows.whole(status)?;
        let Some((sheet, lifted)) = numbers(stream.place.whole(2)?) else {
            return Ok(None);
        };
        if row < self.listed {
            if let Some(sink) = &mut self.points {
                let all: Vec<usize> = (0..layout.names.len()).collect();
                sink.take(rows, &all)?;
                sink.set_wholes("sheet", sheet);
                sink.set_wholes("lifted_sheet", lifted);
                sink.flush_if_full()?;
            }
        } else if let Some((sink, places)) = &mut self.map {
            sink.take(rows, places)?;
            sink.set_wholes("sheet", sheet);
            sink.set_wholes("lifted_sheet", lifted);
            if self.value_max.is_some_and(|most| value > most) {
                code = PointStatus::AboveMax as i32;
                for name in ["V", "p", "u"] {
                    sink.forget(name);
                }
                for name in ["sheet", "lifted_sheet"] {
                    sink.set_wholes(name, -1);
                }
                sink.set_wholes("winding", 0);
                sink.set_wholes("status", code);
            }
            sink.flush_if_full()?;
        }
        let status = (PointStatus::ALL.iter())
            .find(|(s, _)| *s as i32 == rows.whole(status).unwrap_or(code))
            .map_or("?", |(_, name)| name);
        *counted.status.entry(status.to_owned()).or_insert(0) += 1;

        for _ in 0..count {
            let (Some((solutions, of)), Some(layout)) =
                (&mut stream.solutions, &self.names.solutions)
            else {
                return Ok(None);
            };
            let Some((sheet, lifted)) = numbers(of.whole(0)?) else {
                return Ok(None);
            };
            let place = |name: &str| layout.place(name).unwrap_or(usize::MAX);
            let is_counted = stream.place.whole(3)? == 0;
            let residual = solutions.reals(place("residual"))?[0];
            counted.residual = counted.residual.max(residual);
            let h = solutions.reals(place("H"))?[0].abs();
            let p = solutions.reals(place("p"))?.to_vec();
            let winding = solutions.wholes(place("winding"))?.to_vec();
            if let Some(x) = stream.points.as_mut().filter(|_| is_counted) {
                let x = x.reals(
                    self.names
                        .points
                        .as_ref()
                        .and_then(|l| l.place("x0"))
                        .unwrap_or(0),
                )?;
                counted
                    .hamiltonian
                    .push(relative(&whole.plan, x, &winding, &p, h));
            }
            if row < self.listed
                && let Some(sink) = &mut self.solutions
            {
                let all: Vec<usize> = (0..layout.names.len()).collect();
                sink.take(solutions, &all)?;
                let point = part.as_ref().map_or(row, |part| part.index.len() - 1);
                if let Some(part) = &mut part {
                    part.entry_sheet.push(of.whole(0)?);
                }
                sink.set_wholes("point", point as i32);
                sink.set_wholes("sheet", sheet);
                sink.set_wholes("lifted_sheet", lifted);
                sink.flush_if_full()?;
            }
            solutions.advance();
            of.advance();
        }
        if value.is_finite()
            && let (Some(sink), Some(rows)) = (&mut self.trajectories, &mut stream.trajectories)
        {
            let all: Vec<usize> = (0..self
                .names
                .trajectories
                .as_ref()
                .map_or(0, |l| l.names.len()))
                .collect();
            sink.take(rows, &all)?;
            sink.set_wholes("sheet", sheet);
            sink.flush_if_full()?;
            rows.advance();
        }
        Ok(Some(()))
    }

    fn flush(&mut self) -> Result<(), RunError> {
        let map = self.map.as_mut().map(|(sink, _)| sink);
        for sink in [
            self.points.as_mut(),
            self.solutions.as_mut(),
            map,
            self.trajectories.as_mut(),
        ]
        .into_iter()
        .flatten()
        {
            sink.flush()?;
        }
        Ok(())
    }
}

/// |H| relative to the running cost at a solution's beginning.
fn relative(plan: &Plan, x: &[f64], winding: &[i32], p: &[f64], h: f64) -> f64 {
    let running = plan.system.rate[2 * plan.system.states];
    let s: Vec<f64> = (0..x.len())
        .map(|i| {
            let turns = f64::from(winding[i]) * plan.periods[i].unwrap_or(0.0);
            x[i] - plan.system.reference[i] + turns
        })
        .collect();
    let cost = plan.system.eval(&[running], &s, p)[0].abs();
    if cost > 0.0 { h / cost } else { h }
}

#[cfg(test)]
mod tests {
    use super::listed;

    #[test]
    fn numbers_are_listed_as_ranges() {
        assert_eq!(listed(&[]), "");
        assert_eq!(listed(&[3]), "3");
        assert_eq!(listed(&[0, 1, 3, 4, 5, 9]), "0, 1, 3-5, 9");
    }
}
