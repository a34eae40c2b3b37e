//! The whole, or a larger part, of some parts.

use super::super::{Provenance, RunError, in_json, write_errors};
use super::before::create_part;
use super::manifest::Manifest;
use super::merge::{MergeError, listed};
use super::source::Source;
use super::stream::{Counted, MOST_ROWS, Sinks, Stream};
use crate::backend::cpu::{Cpu, in_pool};
use crate::hdf5::ResultFile;
use crate::model::Model;
use crate::result::{RunRecord, ShardGroups, TrajectorySchema};
use crate::session::summary::{Quantiles, RunSummary, SolvedErrors, SolvedSummary};
use crate::session::{Session, SessionError, Wanted};
use crate::sweep::Plan;
use crate::value::blocks::{Joined, Seam, Wanting, edges, join};
use crate::value::{self, Answers, Grid, PointStatus, Request};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use std::path::{Path, PathBuf};

/// Rows that are held at once, of all files together; and at least of each.
const ROWS: usize = 1 << 19;
const LEAST_ROWS: usize = 256;

/// Shards that are missing, and those that are not finished; `None` where there are none.
pub(super) type Gaps<'a> = Option<(&'a [usize], &'a [usize])>;

pub(super) fn note_gaps(file: &ResultFile, gaps: Gaps<'_>) -> Result<(), RunError> {
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
    /// The same with rows that stay in the parts.
    Virtual(Gaps<'a>),
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

    let mut file = match into {
        Into::Part(manifest, _) => create_part(out, manifest)?,
        Into::Whole(_) | Into::Virtual(_) => ResultFile::create(out)?,
    };
    let mut groups = is_part.then(ShardGroups::default);
    let numbers = Numbers::new(&whole.seams, &joined);
    let counted = match into {
        Into::Virtual(_) => whole.write_elsewhere(&mut file, &numbers)?,
        _ => whole.write_rows(&mut file, &numbers, groups.as_mut())?,
    };
    let (equal_cost, folds) = edges(&whole.seams, &joined, &whole.request.grids);
    let edges = Answers {
        equal_cost,
        folds,
        ..Answers::default()
    };
    file.sheet_edges(&whole.schema, &edges)?;
    let lost = counted.status.get(PointStatus::NotMerged.name()).copied();
    if let (Into::Whole(None) | Into::Virtual(None), Some(count)) = (into, lost) {
        return Err(MergeError::NoRows { count }.into());
    }
    let is_whole = matches!(
        into,
        Into::Whole(None) | Into::Virtual(None) | Into::Part(_, true)
    );
    let summary = whole.summary(&joined, counted, &edges, (!is_whole, out));
    file.attribute("summary", in_json(&summary))?;
    write_errors(&file, &summary)?;
    if !is_whole {
        file.attribute("stopped", 1i64)?;
    }
    match into {
        Into::Part(manifest, _) => {
            let groups = groups.unwrap_or_default();
            file.shard(&whole.groups(groups))?;
            super::write_manifest(&file, manifest)?;
        }
        Into::Whole(gaps) | Into::Virtual(gaps) => {
            note_gaps(&file, gaps)?;
            super::write_whole(&file, whole.manifest)?;
        }
    }
    record(&sources[0], &summary, provenance).write(&file)?;
    Ok((file.finish()?, summary))
}

/// The record of a whole: what the first part was integrated by, and how long all took.
pub(super) fn record(first: &Source, summary: &RunSummary, provenance: &Provenance) -> RunRecord {
    let of = |name: &str| first.stored.attribute(name).unwrap_or_default();
    RunRecord {
        backend: of("backend"),
        adapter: of("adapter"),
        precision: of("precision"),
        method: of("method"),
        rtol: summary.rtol,
        atol: summary.atol,
        wall_seconds: summary.wall_seconds,
        ..provenance.record(&first.stored.scene.model)
    }
}

/// What all parts are of.
pub(super) struct Whole<'s> {
    pub sources: &'s [Source],
    pub manifest: &'s Manifest,
    pub model: &'s Model,
    pub plan: Plan,
    pub schema: TrajectorySchema,
    pub request: Request,
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

/// What numbers sheets of blocks have in the whole.
pub(super) struct Numbers<'j> {
    joined: &'j Joined,
    /// Places of blocks among the seams.
    seam_of: BTreeMap<i32, usize>,
}

impl<'j> Numbers<'j> {
    fn new(seams: &[Seam], joined: &'j Joined) -> Self {
        let blocks = seams.iter().enumerate();
        Self {
            joined,
            seam_of: blocks.map(|(k, seam)| (seam.block as i32, k)).collect(),
        }
    }

    /// Of a sheet of this block its number and that of its copies; `None` for a block that no part
    /// has.
    pub fn of_block(&self, block: i32) -> Option<impl Fn(i32) -> Option<(i32, i32)>> {
        let seam = *self.seam_of.get(&block)?;
        let number = move |of: &[Vec<i32>], sheet: i32| -> Option<i32> {
            of[seam].get(usize::try_from(sheet).ok()?).copied()
        };
        let joined = self.joined;
        Some(move |sheet: i32| match sheet {
            -1 => Some((-1, -1)),
            sheet => Some((
                number(&joined.sheet, sheet)?,
                number(&joined.lifted, sheet)?,
            )),
        })
    }
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
    pub fn at_once(&self) -> usize {
        (ROWS / self.sources.len()).clamp(LEAST_ROWS, MOST_ROWS)
    }

    /// The grid of `/map`.
    pub fn grid(&self) -> Option<&Grid> {
        self.request.grids.last().filter(|_| self.map)
    }

    /// Writes `/points`, `/points_sheets`, `/map` and `/trajectories`, in the order in which states
    /// were asked for. Of a part all states go to `/points`, and `part` is told of them.
    fn write_rows(
        &self,
        file: &mut ResultFile,
        numbers: &Numbers<'_>,
        part: Option<&mut ShardGroups>,
    ) -> Result<Counted, RunError> {
        let mut streams = self.streams()?;
        let mut sinks = Sinks::new(self, file, &streams, None, part.is_some())?;
        let mut counted = Counted::default();
        self.write_in_order((&mut sinks, &mut streams), numbers, 0, (&mut counted, part))?;
        sinks.flush()?;
        Ok(counted)
    }

    /// The same for the states from the `next`-th on that the streams have come to.
    pub fn write_in_order(
        &self,
        (sinks, streams): (&mut Sinks, &mut [Stream]),
        numbers: &Numbers<'_>,
        mut next: usize,
        (counted, mut part): (&mut Counted, Option<&mut ShardGroups>),
    ) -> Result<(), RunError> {
        let rows = self.manifest.asked.rows;
        let damaged = |k: usize| self.sources[k].damaged("shard_points");

        let mut heap = BinaryHeap::new();
        for (k, stream) in streams.iter_mut().enumerate() {
            if let Some(index) = self.next_of(stream, k)? {
                heap.push(Reverse((index, k)));
            }
        }
        while let Some(Reverse((index, k))) = heap.pop() {
            // Each state has one number, and each part has them in order.
            let index = usize::try_from(index).map_err(|_| damaged(k))?;
            if index < next || index >= rows {
                return Err(damaged(k));
            }
            if part.is_none() {
                self.nothing(sinks, counted, next..index)?;
            }
            next = index + 1;
            let stream = &mut streams[k];
            let block = stream.block()?;
            let of = numbers.of_block(block).ok_or_else(|| damaged(k))?;
            let mut place = index;
            if let Some(part) = &mut part {
                place = part.index.len();
                part.index.push(index as i32);
                part.block.push(block);
                part.sheet.push(stream.place.whole(2)?);
                part.again.push(stream.place.whole(3)?);
            }
            sinks
                .row(
                    self,
                    stream,
                    (index, place),
                    &of,
                    (&mut *counted, part.as_deref_mut()),
                )?
                .ok_or_else(|| damaged(k))?;
            stream.advance()?;
            if let Some(index) = self.next_of(stream, k)? {
                heap.push(Reverse((index, k)));
            }
        }
        if part.is_none() {
            self.nothing(sinks, counted, next..rows)?;
        }
        Ok(())
    }

    /// Whether a block is taken from this part.
    pub fn is_from(&self, block: i32, k: usize) -> bool {
        self.from.get(&block) == Some(&k)
    }

    /// The number of a part's next state that is taken from it; `None` where there is none.
    fn next_of(&self, stream: &mut Stream, k: usize) -> Result<Option<i32>, RunError> {
        while let Some(index) = stream.index()? {
            let block = stream.block()?;
            if self.is_from(block, k) {
                return Ok(Some(index));
            }
            stream.skip()?;
        }
        match stream.is_complete(&self.sources[k]) {
            true => Ok(None),
            false => Err(self.sources[k].damaged("points")),
        }
    }

    /// States that no part has.
    pub fn nothing(
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
        edges: &Answers,
        (stopped, out): (bool, &Path),
    ) -> RunSummary {
        let mut parts: Vec<RunSummary> = (self.sources.iter())
            .filter_map(|source| source.stored.run_summary().ok().flatten())
            .collect();
        let errors = (parts.iter())
            .filter_map(|part| part.homotopy.as_ref()?.error_estimate.clone())
            .reduce(SolvedErrors::largest);
        let seconds: f64 = self.seams.iter().map(|s| s.seconds).sum();
        let distinct: i32 = self.groups(ShardGroups::default()).states.iter().sum();
        let wall: f64 = parts.iter().map(|part| part.wall_seconds).sum();
        let solved = SolvedSummary {
            states: self.manifest.asked.rows,
            distinct: distinct.max(0) as usize,
            status: counted.status,
            solutions: self.seams.iter().map(|s| s.solutions).sum(),
            sheets: joined.sheets,
            equal_cost_points: edges.equal_cost.len(),
            fold_points: edges.folds.len(),
            largest_residual: counted.residual,
            hamiltonian_relative: Quantiles::of(&counted.hamiltonian),
            error_estimate: errors,
            integrations: self.seams.iter().map(|s| s.evaluations).sum(),
            seconds,
            states_per_second: f64::from(distinct) / seconds.max(1e-9),
        };
        let first = match parts.is_empty() {
            true => RunSummary::default(),
            false => parts.swap_remove(0),
        };
        let mut all = RunSummary {
            title: self.model.title.clone(),
            file: out.display().to_string(),
            backend: self.manifest.backend.clone(),
            precision: self.manifest.precision.clone(),
            method: self.manifest.method.clone(),
            stopped,
            homotopy: Some(solved),
            wall_seconds: wall,
            ..first
        };
        all.error_met = all.met();
        all
    }
}
