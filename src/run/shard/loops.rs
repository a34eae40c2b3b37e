//! Parts of closed loops: some of the initial states of `[closed_loop]`.

use super::super::{Provenance, RunError};
use super::before::{Before, create_part, note_kept};
use super::manifest::{Loops as Asked, Manifest};
use super::source::Source;
use super::whole::{Gaps, note_gaps};
use super::{write_manifest, write_whole};
use crate::closed_loop::{Evaluation, Gathered, Initial, LawResult, Laws, Path as Flight, Setting};
use crate::files::{Draft, target};
use crate::hdf5::ResultFile;
use crate::model::{ClosedLoop, Method, Model, Precision};
use crate::result::{RunRecord, ShardGroups};
use crate::schema;
use crate::session::summary::RunSummary;
use crate::session::{Finished, LoopOptions, Loops, Resume, Session, SessionError, Shard, Sources};
use crate::sweep::{Choices, Numerics};
use std::path::{Path, PathBuf};
use std::time::Instant;

const PRECISIONS: [(&str, Precision); 2] = [("f32", Precision::F32), ("f64", Precision::F64)];
/// Initial states that are simulated between two looks at the time.
const PIECE: usize = 4096;

/// What came of it.
pub struct LoopsDone {
    /// The closed loops that are in the file; `None` where it was finished before, or has none.
    pub evaluation: Option<Evaluation>,
    /// Whether not all were done.
    pub stopped: bool,
    /// The file.
    pub path: PathBuf,
}

/// What is divided, and how much of it to do.
pub struct Divided<'a> {
    pub shard: Option<Shard>,
    pub resume: Resume,
    /// What laws and V are taken from, in a word that tells it from others.
    pub from: &'a str,
}

/// Simulates the scene's `[closed_loop]`, or a shard of it, keeping what is done.
///
/// # Errors
/// Those of the simulation, of what was kept before, and of writing.
pub fn loops(
    session: &Session<'_>,
    (from, options): (&Sources, &LoopOptions),
    divided: &Divided<'_>,
    path: &Path,
    provenance: &Provenance,
) -> Result<LoopsDone, RunError> {
    let path = target(path)?;
    drop(Draft::begin(&path)?);
    let loops = session.loops(from, options)?;
    let units = loops.units()?;
    let asked = Asked {
        random: options.random,
        seed: session.choices.seed,
        solve: options.solve,
        laws: loops.laws(),
        from: divided.from.to_owned(),
    };
    let states = (&*loops.initial.x, loops.initial.count());
    let numerics = loops.numerics();
    let manifest = Manifest::of_loops(
        session,
        (divided.shard, units),
        (asked, states, numerics),
        provenance,
    );
    let mut before = Before::at(&path, &manifest, divided.resume)?;
    if before.finished.is_some() {
        before.note_finished(session);
        before.clear(&manifest);
        return Ok(LoopsDone {
            evaluation: None,
            stopped: false,
            path,
        });
    }
    let part = Part {
        session,
        loops: &loops,
        numerics,
        manifest: &manifest,
        provenance,
    };
    let mut gathered = Gathered::new(loops.initial.clone());
    let mut done = Vec::new();
    for source in &before.sources {
        take(source, &mut gathered)?;
        done.extend(source.units_done());
    }
    if !done.is_empty() {
        let some = gathered.numbers().len();
        let note = format!("{some} initial states were done before");
        session.progress().note(&note);
    }
    let own = divided
        .shard
        .map_or_else(|| (0..units).collect(), |shard| shard.own(units));
    let left: Vec<usize> = own.into_iter().filter(|k| !done.contains(k)).collect();

    let of_piece = (PIECE * units / loops.initial.count().max(1)).max(1);
    let mut last = Instant::now();
    let mut stopped = false;
    for (k, piece) in left.chunks(of_piece).enumerate() {
        stopped = session.is_over();
        if stopped {
            break;
        }
        match loops.simulate(Some(piece), &mut gathered) {
            Err(_) if session.is_over() => {
                stopped = true;
                break;
            }
            simulated => simulated?,
        }
        done.extend_from_slice(piece);
        let is_last = (k + 1) * of_piece >= left.len();
        if before.every.is_some_and(|every| last.elapsed() >= every) && !is_last {
            let kept = part.write(&gathered, &done, (&before.unfinished, true));
            note_kept(session, &before.unfinished, kept.map(drop));
            last = Instant::now();
        }
    }

    let to = before.place(session, &manifest, stopped);
    let (path, evaluation) = match divided.shard.is_some() || stopped {
        true => part.write(&gathered, &done, (&to, stopped))?,
        false => part.whole(gathered, &to)?,
    };
    if let Some(evaluation) = &evaluation {
        loops.tell(evaluation);
    }
    if !stopped {
        before.clear(&manifest);
    }
    Ok(LoopsDone {
        evaluation,
        stopped,
        path,
    })
}

/// A part on its way into a file.
struct Part<'p> {
    session: &'p Session<'p>,
    loops: &'p Loops<'p>,
    numerics: Numerics,
    manifest: &'p Manifest,
    provenance: &'p Provenance,
}

impl Part<'_> {
    fn write(
        &self,
        gathered: &Gathered,
        done: &[usize],
        (to, stopped): (&Path, bool),
    ) -> Result<(PathBuf, Option<Evaluation>), RunError> {
        let mut file = create_part(to, self.manifest)?;
        let numbers = gathered.numbers();
        let evaluation = (!numbers.is_empty()).then(|| self.loops.evaluated_in_part(gathered));
        if let Some(evaluation) = &evaluation {
            evaluation.write(&self.session.scene().model, &mut file)?;
        }
        let number = |k: &usize| i32::try_from(*k).unwrap_or(i32::MAX);
        let mut done = done.to_vec();
        done.sort_unstable();
        file.shard(&ShardGroups {
            number: done.iter().map(number).collect(),
            done: vec![1; done.len()],
            states: vec![0; done.len()],
            index: numbers.iter().map(number).collect(),
            block: vec![-1; numbers.len()],
            sheet: vec![-1; numbers.len()],
            again: vec![0; numbers.len()],
            ..ShardGroups::default()
        })?;
        write_manifest(&file, self.manifest)?;
        if stopped {
            file.attribute("stopped", 1i64)?;
        }
        self.record().write(&file)?;
        Ok((file.finish()?, evaluation))
    }

    fn whole(
        &self,
        gathered: Gathered,
        to: &Path,
    ) -> Result<(PathBuf, Option<Evaluation>), RunError> {
        let mut file = ResultFile::create(to)?;
        let evaluation = self.loops.evaluated(gathered);
        evaluation.write(&self.session.scene().model, &mut file)?;
        write_whole(&file, self.manifest)?;
        self.record().write(&file)?;
        Ok((file.finish()?, Some(evaluation)))
    }

    fn record(&self) -> RunRecord {
        RunRecord {
            precision: self.numerics.precision.name().to_owned(),
            method: self.numerics.method.name().to_owned(),
            rtol: self.numerics.rtol,
            atol: self.numerics.atol,
            ..self.session.record(self.provenance)
        }
    }
}

/// Puts parts of closed loops together.
///
/// # Errors
/// Of reading and writing.
pub(super) fn assemble(
    session: &Session<'_>,
    sources: &[Source],
    (gaps, out): (Gaps<'_>, &Path),
    provenance: &Provenance,
) -> Result<(PathBuf, RunSummary), RunError> {
    let scene = session.scene();
    let (model, first) = (&scene.model, &sources[0]);
    let manifest = &first.manifest;
    let damaged = || first.damaged("closed_loop");
    let (Some(asked), Some(of)) = (&model.closed_loop, &manifest.asked.loops) else {
        return Err(damaged());
    };
    let initial = Initial::new(model, asked, of.random, of.seed).map_err(SessionError::Loop)?;
    let mut gathered = Gathered::new(initial);
    for source in sources {
        take(source, &mut gathered)?;
    }

    let choices = Choices {
        precision: named(&PRECISIONS, &manifest.precision),
        method: named(&Method::ALL, &manifest.method),
        rtol: Some(manifest.rtol),
        ..Choices::default()
    };
    let laws = Laws::new(model, &scene.hamiltonian, asked.track);
    let backend = session.backend();
    let setting = Setting::new(&laws, asked, backend, choices).map_err(SessionError::Loop)?;
    let (initial, values, laws) = gathered.all(asked.samples, model.controls.len());
    let recorded = |name: &str| first.stored.attribute(name).unwrap_or_default();
    let (backend_name, adapter) = (recorded("backend"), recorded("adapter"));
    let mut evaluation = setting.evaluated(initial, values, laws, backend);
    (evaluation.backend, evaluation.adapter) = (backend_name.clone(), adapter.clone());
    let mut file = ResultFile::create(out)?;
    evaluation.write(model, &mut file)?;
    note_gaps(&file, gaps)?;
    if gaps.is_some() {
        file.attribute("stopped", 1i64)?;
    }
    write_whole(&file, manifest)?;
    let numerics = setting.numerics;
    RunRecord {
        backend: backend_name,
        adapter,
        precision: numerics.precision.name().to_owned(),
        method: numerics.method.name().to_owned(),
        rtol: numerics.rtol,
        atol: numerics.atol,
        ..provenance.record(model)
    }
    .write(&file)?;
    let path = file.finish()?;
    session
        .progress()
        .finished(Finished::ClosedLoop(&evaluation));
    let summary = RunSummary {
        title: model.title.clone(),
        file: path.display().to_string(),
        stopped: gaps.is_some(),
        ..RunSummary::default()
    };
    Ok((path, summary))
}

/// What has a name in a list; `None` for `auto`.
fn named<T: Copy>(all: &[(&'static str, T)], name: &str) -> Option<T> {
    all.iter().find(|(own, _)| *own == name).map(|(_, of)| *of)
}

/// Takes what a part has.
fn take(source: &Source, to: &mut Gathered) -> Result<(), RunError> {
    let damaged = || source.damaged("shard_points");
    let index = source.stored.group(&schema::SHARD_POINTS);
    let index = index.ok_or_else(damaged)?.i32("index")?.1;
    let numbers = (index.iter())
        .map(|k| {
            usize::try_from(*k)
                .ok()
                .filter(|k| *k < to.initial().count())
        })
        .collect::<Option<Vec<usize>>>()
        .filter(|numbers| numbers.windows(2).all(|pair| pair[0] < pair[1]))
        .ok_or_else(damaged)?;
    if numbers.is_empty() {
        return Ok(());
    }
    let model = &source.stored.scene.model;
    let asked = model
        .closed_loop
        .as_ref()
        .ok_or_else(|| source.damaged("closed_loop"))?;
    let part = to.initial().some(&numbers);
    let (values, laws) = read(source, (model, asked), &part)?;
    to.take(&numbers, &values, laws);
    Ok(())
}

/// V at the initial states of a part, and what came of each law.
fn read(
    source: &Source,
    (model, asked): (&Model, &ClosedLoop),
    part: &Initial,
) -> Result<(Vec<f64>, Vec<LawResult>), RunError> {
    let stored = &source.stored;
    let group =
        |own: &'static schema::Group| stored.group(own).ok_or_else(|| source.damaged(own.name));
    let (states, of_laws) = (
        group(&schema::CLOSED_LOOP)?,
        group(&schema::CLOSED_LOOP_LAWS)?,
    );
    let (names, sources) = (of_laws.texts("law")?, of_laws.texts("source")?);
    let (laws, count, kept) = (names.len(), part.count(), part.kept());
    let (n, m, points) = (model.states.len(), model.controls.len(), asked.samples + 1);

    // The states are those of the scene.
    let x = states.shaped("x0", &[count, n])?;
    if !x
        .iter()
        .zip(&part.x)
        .all(|(a, b)| a.to_bits() == b.to_bits())
    {
        return Err(source.damaged("closed_loop"));
    }
    let values = states.shaped("V", &[count])?;
    let both = |name: &str| states.shaped(name, &[laws, count]);
    let (cost, t_end) = (both("J")?, both("t_end")?);
    let codes = |name: &str| states.codes(name, laws * count);
    let (converged, status, fallback) = (codes("converged")?, codes("status")?, codes("fallback")?);
    let records = (asked.records.iter())
        .map(|record| both(&record.name))
        .collect::<Result<Vec<_>, _>>()?;
    let of_law = |name: &str| of_laws.shaped(name, &[laws]);
    let (seconds, updates) = (of_law("seconds")?, of_law("updates")?);
    let flights = match kept.is_empty() {
        true => None,
        false => Some(group(&schema::CLOSED_LOOP_TRAJECTORIES)?),
    };
    let along = |name: &str, width: &[usize]| {
        let shape = [&[laws, kept.len(), points][..], width].concat();
        flights
            .as_ref()
            .map_or(Ok(Vec::new()), |flights| flights.shaped(name, &shape))
    };
    let (t, x) = (along("t", &[])?, along("x", &[n])?);
    let u = if m > 0 { along("u", &[m])? } else { Vec::new() };

    let law = |k: usize| {
        let own = |all: &[f64]| all[k * count..(k + 1) * count].to_vec();
        let whole = |all: &[i32]| all[k * count..(k + 1) * count].to_vec();
        let flight = |place: usize| {
            let at = k * kept.len() + place;
            let some =
                |all: &[f64], width: usize| all[at * points * width..][..points * width].to_vec();
            Flight {
                initial: kept[place],
                t: some(&t, 1),
                x: some(&x, n),
                u: if m > 0 { some(&u, m) } else { Vec::new() },
                ..Flight::default()
            }
        };
        LawResult {
            name: names[k].clone(),
            source: sources.get(k).cloned().unwrap_or_default(),
            cost: own(&cost),
            records: (0..count)
                .flat_map(|i| records.iter().map(move |r| r[k * count + i]))
                .collect(),
            converged: whole(&converged).iter().map(|c| *c == 1).collect(),
            status: whole(&status),
            t_end: own(&t_end),
            fallback: whole(&fallback)
                .iter()
                .map(|c| (*c).max(0) as u32)
                .collect(),
            updates: updates[k] as usize,
            seconds: seconds[k],
            paths: (0..kept.len()).map(flight).collect(),
            ..LawResult::default()
        }
    };
    Ok((values, (0..laws).map(law).collect()))
}
