//! Reading a result file: its scene, and its groups as arrays.

use super::column::StoredColumn;
use super::elsewhere::{VIRTUAL, absent, given_order, taken};
use super::record::RunRecord;
use crate::diagnostics::ScenarioErrors;
use crate::files;
use crate::scene::Scene;
use crate::schema;
use crate::session::summary::RunSummary;
use crate::trajectories::{SolvedGrid, SolvedStates, StatedErrors, SweptTrajectories};
use rust_hdf5::{DatatypeMessage, H5Dataset, H5File, Hdf5Error};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Why a file could not be used as a result file.
#[derive(Debug, thiserror::Error)]
pub enum StoredError {
    #[error("cannot read {path}: {source}", path = path.display())]
    Read {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("{path} is a directory: name the result file in it", path = path.display())]
    Directory { path: PathBuf },
    #[error("{path} is not a result file (HDF5): {reason}{hint}", path = path.display())]
    NotHdf5 {
        path: PathBuf,
        reason: String,
        hint: &'static str,
    },
    #[error("{path} is not a result file of costate: it has no attribute `scenario`", path = path.display())]
    NoScenario { path: PathBuf },
    /// The scene in the file is not one for this version.
    #[error("the scene stored in {path} cannot be read: {errors}", path = path.display())]
    Scenario {
        path: PathBuf,
        errors: Box<ScenarioErrors>,
    },
    #[error("{path}: `/{object}`: {reason}", path = path.display())]
    Object {
        path: PathBuf,
        object: String,
        reason: String,
    },
    #[error(
        "{path} reads its numbers from {part}, which is another file than the one that was merged: merge the parts again",
        path = path.display()
    )]
    OtherPart { path: PathBuf, part: String },
    #[error(
        "{path} reads its numbers from {part}, which is gone, and HDF5 would take the file of that name in the present folder for it: run this in another folder, or merge the parts again",
        path = path.display()
    )]
    InPlaceOf { path: PathBuf, part: String },
    #[error("{path} has no group /{group}{hint}", path = path.display())]
    NoGroup {
        path: PathBuf,
        group: String,
        hint: &'static str,
    },
}

/// Why a file is none of HDF5. What the HDF5 layer says is of use only where the file begins as
/// one.
fn no_hdf5(path: &Path, error: &Hdf5Error) -> String {
    let begins = match files::beginning(path) {
        Ok(begins) => begins,
        Err(e) => return e.to_string(),
    };
    if files::is_hdf5(&begins) {
        return format!("it begins as one, but is damaged or cut short ({error})");
    }
    let what = match (begins.is_empty(), std::str::from_utf8(&begins)) {
        (true, _) => "it is empty",
        (_, Ok(_)) => "it is a text",
        (_, Err(e)) if e.error_len().is_none() => "it is a text",
        _ => "it begins otherwise",
    };
    what.to_owned()
}

/// Whether a file's end is missing, in words: HDF5 refuses it then, although all that is read of it
/// may be there.
fn cut_short(path: &Path) -> Option<String> {
    let told = files::length_told(&files::beginning(path).ok()?)?;
    let there = std::fs::metadata(path).ok()?.len();
    (there < told).then(|| {
        format!("it begins as one, but is damaged or cut short ({there} bytes of {told} are there)")
    })
}

/// An array of a file, row-major.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Array {
    pub shape: Vec<usize>,
    pub values: Vec<f64>,
}

/// A result file open for reading, with its scene read again: the scenario's text and the `--set`
/// of the run that made it are in the file.
pub struct Stored {
    pub path: PathBuf,
    /// How messages call it.
    name: PathBuf,
    pub scene: Scene,
    file: H5File,
    /// Files of parts that its rows lie in and that are not there.
    absent: Vec<String>,
    /// Held, so that parts stay open once they are: each variable would open all of them anew.
    _held: Option<H5Dataset>,
}

impl std::fmt::Debug for Stored {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Stored")
            .field("path", &self.path)
            .finish_non_exhaustive()
    }
}

/// A group of a [`Stored`] file.
pub struct StoredGroup<'s> {
    stored: &'s Stored,
    name: String,
    /// `None` for a group that this version does not know.
    schema: Option<&'static schema::Group>,
}

impl Stored {
    /// Opens a result file and reads its scene.
    ///
    /// # Errors
    /// [`StoredError`] where it cannot be read, is no result file, or holds a scene that this
    /// version refuses.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, StoredError> {
        let path = path.as_ref();
        // The HDF5 layer's own message for a missing file does not say so.
        std::fs::File::open(path).map_err(|source| StoredError::Read {
            path: path.to_owned(),
            source,
        })?;
        if path.is_dir() {
            return Err(StoredError::Directory {
                path: path.to_owned(),
            });
        }
        if let Some(reason) = cut_short(path) {
            return Err(StoredError::NotHdf5 {
                path: path.to_owned(),
                reason,
                hint: "",
            });
        }
        let file =
            (H5File::options().no_locking().open(path)).map_err(|e| StoredError::NotHdf5 {
                path: path.to_owned(),
                reason: no_hdf5(path, &e),
                hint: if path.extension().is_some_and(|e| e == "toml") {
                    "; this may be a scene: `costate run` makes a result file of it"
                } else {
                    ""
                },
            })?;
        let Ok(text) = file.attr_string("scenario") else {
            return Err(StoredError::NoScenario {
                path: path.to_owned(),
            });
        };
        // Without the parameters that a run was given its scene is another one.
        let names = file.attr_names().unwrap_or_default();
        let set = match file.attr_string("set") {
            Ok(set) => set,
            Err(e) if names.iter().any(|name| name == "set") => {
                return Err(StoredError::Object {
                    path: path.to_owned(),
                    object: "set".to_owned(),
                    reason: e.to_string(),
                });
            }
            Err(_) => String::new(),
        };
        let overrides = RunRecord::overrides(&set);
        let name = file
            .attr_string("scenario_file")
            .unwrap_or_else(|_| "scenario".to_owned());
        let wrong = |errors| StoredError::Scenario {
            path: path.to_owned(),
            errors: Box::new(errors),
        };
        let scene = Scene::parse_with(&text, &name, &overrides).map_err(wrong)?;
        let this = Self {
            path: path.to_owned(),
            name: path.to_owned(),
            scene,
            file,
            absent: Vec::new(),
            _held: None,
        };
        Ok(Self {
            absent: absent(&this)?,
            _held: held(&this),
            ..this
        })
    }

    /// Opens a result that will have another name when it is complete, by which messages call it.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub(crate) fn open_draft(draft: &files::Draft) -> Result<Self, StoredError> {
        Ok(Self {
            name: draft.path().to_owned(),
            ..Self::open(draft.hidden())?
        })
    }

    /// How messages call the file.
    pub(crate) fn name(&self) -> PathBuf {
        self.name.clone()
    }

    /// The files of parts that its rows lie in and that are not there: nothing is known of them.
    pub fn absent_parts(&self) -> &[String] {
        &self.absent
    }

    /// A root attribute that is a text.
    pub fn attribute(&self, name: &str) -> Option<String> {
        self.file.attr_string(name).ok()
    }

    /// Whether there is a root attribute of this name.
    pub fn has_attribute(&self, name: &str) -> bool {
        let names = self.file.attr_names().unwrap_or_default();
        names.iter().any(|own| own == name)
    }

    /// The run's summary as `--json` prints it; empty where the file has none.
    pub fn summary(&self) -> serde_json::Value {
        let text = self.attribute("summary").unwrap_or_default();
        serde_json::from_str(&text).unwrap_or_default()
    }

    /// The same with its types; `None` where the file has none.
    ///
    /// # Errors
    /// [`StoredError::Object`] where it is not as this program writes it.
    pub fn run_summary(&self) -> Result<Option<RunSummary>, StoredError> {
        let Some(text) = self.attribute("summary") else {
            return Ok(None);
        };
        let summary = serde_json::from_str(&text);
        summary.map(Some).map_err(|e| StoredError::Object {
            path: self.name(),
            object: "summary".to_owned(),
            reason: format!("not as this version writes it: {e}"),
        })
    }

    /// The names of its groups.
    pub fn groups(&self) -> Vec<String> {
        self.file.root_group().group_names().unwrap_or_default()
    }

    /// Whether a group is in the file.
    pub fn has(&self, group: impl AsRef<str>) -> bool {
        self.file.root_group().group(group.as_ref()).is_ok()
    }

    /// Whether any of these groups is in the file.
    pub fn has_any(&self, groups: &[&schema::Group]) -> bool {
        groups.iter().any(|group| self.has(group))
    }

    /// A group; `None` where the file has none of that name. What is read from it is checked
    /// against the [schema](crate::schema).
    pub fn group(&self, name: impl AsRef<str>) -> Option<StoredGroup<'_>> {
        let name = name.as_ref();
        self.has(name).then(|| StoredGroup {
            stored: self,
            name: name.to_owned(),
            schema: schema::group(name),
        })
    }

    /// `/trajectories`; `None` where it is absent. Of a file that has values alone t, p, u and H are
    /// empty.
    ///
    /// # Errors
    /// [`StoredError::Object`] where it is not as this program writes it.
    pub fn trajectories(&self) -> Result<Option<SweptTrajectories>, StoredError> {
        let Some(group) = self.group(&schema::TRAJECTORIES) else {
            return Ok(None);
        };
        let (n, m) = (
            self.scene.model.states.len(),
            self.scene.model.controls.len(),
        );
        let v = group.f64("V")?;
        let &[count, samples] = v.shape.as_slice() else {
            return Err(group.error("V", "not trajectory x sample"));
        };
        let full = |name: &str, shape: &[usize]| match group.attribute(None, "stored") {
            Some(_) => Ok(Vec::new()),
            None => group.shaped(name, shape),
        };
        let found = SweptTrajectories {
            count,
            samples,
            t: full("t", &[count, samples])?,
            x: group.shaped("x", &[count, samples, n])?,
            p: full("p", &[count, samples, n])?,
            u: full("u", &[count, samples, m])?,
            h: full("H", &[count, samples])?,
            status: group.i32("status")?.1,
            sheet: group.i32("sheet")?.1,
            v: v.values,
        };
        Ok(Some(match given_order(&group, count)? {
            Some(order) => found.in_order(&order),
            None => found,
        }))
    }

    /// `/points` in the order in which the states were given, of V(x, t) those at t = 0; `None` where
    /// it is absent. States without a solution have NaN.
    ///
    /// # Errors
    /// [`StoredError::Object`] where it is not as this program writes it, or has rows of later
    /// times alone.
    pub fn points(&self) -> Result<Option<SolvedStates>, StoredError> {
        let Some(group) = self.group(&schema::POINTS) else {
            return Ok(None);
        };
        let x = group.f64("x0")?;
        let count = x.shape.first().copied().unwrap_or(0);
        let mut points = self.solutions(&group, count)?;
        points.x = x.values;
        points.point = (0..count as i32).collect();
        let widths = (
            self.scene.model.states.len(),
            self.scene.model.controls.len(),
        );
        if let Some(order) = given_order(&group, count)? {
            points = points.taken(widths, &order);
        }
        if !self.absent.is_empty() {
            points.forget_sheets();
        }
        let Some(times) = self.times(&group)? else {
            return Ok(Some(points));
        };
        let name = self.scene.model.time_name();
        if times.len() != count {
            return Err(group.error(name, "not as many as there are states"));
        }
        let kept: Vec<usize> = (0..count).filter(|k| times[*k] == 0.0).collect();
        if kept.is_empty() && count > 0 {
            return Err(group.error(name, &self.later("no row")));
        }
        Ok(Some(points.taken(widths, &kept)))
    }

    /// Errors of a group's values, if these were interpolated.
    fn stated_errors(
        &self,
        group: &StoredGroup<'_>,
        shape: &[usize],
    ) -> Result<Vec<StatedErrors>, StoredError> {
        if !group.has("V_error") {
            return Ok(Vec::new());
        }
        let (of_v, of_p) = (
            group.shaped("V_error", shape)?,
            group.shaped("p_error", shape)?,
        );
        Ok(of_v
            .into_iter()
            .zip(of_p)
            .map(|(v, p)| StatedErrors { v, p })
            .collect())
    }

    /// Times of a group's rows, or along its axis; `None` where it has none, and all is of t = 0.
    fn times(&self, group: &StoredGroup<'_>) -> Result<Option<Vec<f64>>, StoredError> {
        let name = self.scene.model.time_name();
        if self.scene.model.final_time().is_none() || !group.has(name) {
            return Ok(None);
        }
        Ok(Some(group.f64(name)?.values))
    }

    /// Why values of later times are of no use where V(x, 0) is wanted.
    fn later(&self, what: &str) -> String {
        let name = self.scene.model.time_name();
        format!("{what} is at {name} = 0, and V is wanted there: ask for it with {name} = 0 too")
    }

    /// `/points_sheets`: every solution found at the states of `/points`; `None` where it is
    /// absent.
    ///
    /// # Errors
    /// [`StoredError::Object`] where it is not as this program writes it.
    pub fn points_sheets(&self) -> Result<Option<SolvedStates>, StoredError> {
        let (Some(group), Some(points)) = (self.group(&schema::POINTS_SHEETS), self.points()?)
        else {
            return Ok(None);
        };
        let (_, point) = group.i32("point")?;
        let n = self.scene.model.states.len();
        let mut entries = self.solutions(&group, point.len())?;
        // The place of each row of /points among the states that were read.
        let mut places: Vec<(i32, usize)> = points.point.iter().copied().zip(0..).collect();
        places.sort_unstable();
        let mut at = Vec::with_capacity(point.len());
        for &k in &point {
            let row = places.binary_search_by_key(&k, |(row, _)| *row).ok();
            let place = row.map(|row| places[row].1);
            let x = place.and_then(|k| points.x.get(k * n..(k + 1) * n));
            let (Some(place), Some(x)) = (place, x) else {
                return Err(group.error("point", "names a point that /points does not have"));
            };
            entries.x.extend_from_slice(x);
            at.push(place);
        }
        entries.point = point;
        // As the states come; without those of parts that are not there.
        let mut order: Vec<usize> = (0..entries.count)
            .filter(|k| self.absent.is_empty() || !entries.v[*k].is_nan())
            .collect();
        order.sort_by_key(|k| at[*k]);
        Ok(Some(
            entries.taken((n, self.scene.model.controls.len()), &order),
        ))
    }

    fn solutions(
        &self,
        group: &StoredGroup<'_>,
        count: usize,
    ) -> Result<SolvedStates, StoredError> {
        let (n, m) = (
            self.scene.model.states.len(),
            self.scene.model.controls.len(),
        );
        Ok(SolvedStates {
            count,
            v: group.shaped("V", &[count])?,
            p: group.shaped("p", &[count, n])?,
            u: group.shaped("u", &[count, m])?,
            sheet: group.i32("sheet")?.1,
            status: group.codes("status", count)?,
            errors: self.stated_errors(group, &[count])?,
            ..SolvedStates::default()
        })
    }

    /// `/map`, of V(x, t) at t = 0; `None` where it is absent.
    ///
    /// # Errors
    /// [`StoredError::Object`] where it is not as this program writes it, or is of later times
    /// alone.
    pub fn map(&self) -> Result<Option<SolvedGrid>, StoredError> {
        let Some(group) = self.group(&schema::MAP) else {
            return Ok(None);
        };
        let mut axes = Vec::new();
        for state in &self.scene.model.states {
            axes.push(group.f64(&state.variable.name)?.values);
        }
        let (n, m) = (
            self.scene.model.states.len(),
            self.scene.model.controls.len(),
        );
        let times = self.times(&group)?;
        let lengths = axes.iter().chain(&times).map(Vec::len);
        let counts: Vec<usize> = lengths.collect();
        let nodes: usize = counts.iter().product();
        let with = |last: usize| [counts.as_slice(), &[last]].concat();
        let map = SolvedGrid {
            v: group.shaped("V", &counts)?,
            p: group.shaped("p", &with(n))?,
            u: group.shaped("u", &with(m))?,
            sheet: group.codes("sheet", nodes)?,
            status: group.codes("status", nodes)?,
            errors: self.stated_errors(&group, &counts)?,
            axes,
        };
        let Some(times) = times else {
            return Ok(Some(map));
        };
        // The time runs fastest.
        let Some(first) = times.iter().position(|t| *t == 0.0) else {
            return Err(group.error(self.scene.model.time_name(), &self.later("nothing")));
        };
        let kept: Vec<usize> = (first..nodes).step_by(times.len()).collect();
        Ok(Some(SolvedGrid {
            v: taken(&map.v, 1, &kept),
            p: taken(&map.p, n, &kept),
            u: taken(&map.u, m, &kept),
            sheet: taken(&map.sheet, 1, &kept),
            status: taken(&map.status, 1, &kept),
            errors: taken(&map.errors, 1, &kept),
            axes: map.axes,
        }))
    }
}

/// The first variable of a virtual file that is read of many.
fn held(stored: &Stored) -> Option<H5Dataset> {
    let group = stored.group(&schema::POINTS)?;
    stored
        .has_attribute(VIRTUAL)
        .then(|| group.open("V").ok())?
}

impl StoredGroup<'_> {
    /// The datasets in it.
    pub fn names(&self) -> Vec<String> {
        let group = self.stored.file.root_group().group(&self.name);
        group.and_then(|g| g.dataset_names()).unwrap_or_default()
    }

    pub fn has(&self, name: &str) -> bool {
        self.names().iter().any(|n| n == name)
    }

    /// Numbers of any type, as f64.
    ///
    /// # Errors
    /// [`StoredError::Object`] where there is no such dataset of numbers.
    pub fn f64(&self, name: &str) -> Result<Array, StoredError> {
        let dataset = self.dataset(name)?;
        // Only what loses nothing is converted: 64-bit integers are not.
        let integers = || {
            let whole = dataset.read_numeric_as::<i64>()?;
            Ok(whole.into_iter().map(|v| v as f64).collect())
        };
        let values = dataset.read_numeric_as::<f64>().or_else(|_| integers());
        let values = values.map_err(|e: Hdf5Error| self.hdf5(name, &e))?;
        Ok(Array {
            shape: dataset.shape(),
            values,
        })
    }

    /// Integers and their shape.
    ///
    /// # Errors
    /// [`StoredError::Object`] where there is no such dataset of integers.
    pub fn i32(&self, name: &str) -> Result<(Vec<usize>, Vec<i32>), StoredError> {
        let dataset = self.dataset(name)?;
        let values = dataset
            .read_numeric_as::<i32>()
            .map_err(|e| self.hdf5(name, &e))?;
        Ok((dataset.shape(), values))
    }

    /// So many integers; none where the group has no dataset of that name.
    ///
    /// # Errors
    /// [`StoredError::Object`] where it has another number of them.
    pub fn codes(&self, name: &str, count: usize) -> Result<Vec<i32>, StoredError> {
        if count == 0 || !self.has(name) {
            return Ok(Vec::new());
        }
        let codes = self.i32(name)?.1;
        if codes.len() != count {
            return Err(self.error(name, "not as many as there are states"));
        }
        Ok(codes)
    }

    /// What the codes of a variable mean, in words; none where it has no codes.
    pub fn meanings(&self, name: &str) -> BTreeMap<i32, String> {
        let values = || -> Option<Vec<i32>> {
            let attribute = self.dataset(name).ok()?.attr("flag_values").ok()?;
            attribute.read_numeric_as::<i32>().ok()
        };
        let meanings = self.attribute(Some(name), "flag_meanings");
        let meanings = meanings.unwrap_or_default();
        let words = meanings.split_whitespace().map(|w| w.replace('_', " "));
        values()
            .unwrap_or_default()
            .into_iter()
            .zip(words)
            .collect()
    }

    /// Texts.
    ///
    /// # Errors
    /// [`StoredError::Object`] where there is no such dataset of texts.
    pub fn texts(&self, name: &str) -> Result<Vec<String>, StoredError> {
        let dataset = self.dataset(name)?;
        // The reader takes zeros for references to no text.
        let is_text = matches!(dataset.datatype(), Ok(DatatypeMessage::VarLenString { .. }));
        if !is_text {
            return Err(self.error(name, "it has no texts"));
        }
        dataset.read_vlen_strings().map_err(|e| self.hdf5(name, &e))
    }

    /// A text attribute of a dataset, or of the group itself.
    pub fn attribute(&self, variable: Option<&str>, name: &str) -> Option<String> {
        match variable {
            Some(variable) => self
                .dataset(variable)
                .ok()?
                .attr(name)
                .ok()?
                .read_string()
                .ok(),
            None => {
                let group = self.stored.file.root_group().group(&self.name).ok()?;
                group.attr_string(name).ok()
            }
        }
    }

    /// Numbers of a given shape.
    ///
    /// # Errors
    /// [`StoredError::Object`] where the shape differs; a dataset with no elements may be absent.
    pub fn shaped(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>, StoredError> {
        if shape.contains(&0) {
            return Ok(Vec::new());
        }
        let array = self.f64(name)?;
        if array.shape != shape {
            let reason = format!("its shape is {:?}, not {shape:?}", array.shape);
            return Err(self.error(name, &reason));
        }
        Ok(array.values)
    }

    /// A variable of which rows are read as they are wanted.
    ///
    /// # Errors
    /// [`StoredError::Object`] where there is no such dataset.
    pub fn column(&self, name: &str) -> Result<StoredColumn, StoredError> {
        let dataset = self.dataset(name)?;
        let object = format!("{}/{name}", self.name);
        Ok(StoredColumn::new(&self.stored.path, object, dataset))
    }

    /// An error that names a dataset of this group.
    pub fn error(&self, name: &str, reason: &str) -> StoredError {
        StoredError::Object {
            path: self.stored.path.clone(),
            object: format!("{}/{name}", self.name),
            reason: reason.to_owned(),
        }
    }

    fn dataset(&self, name: &str) -> Result<H5Dataset, StoredError> {
        let dataset = self.open(name).map_err(|e| self.hdf5(name, &e))?;
        self.check_shape(name, &dataset.shape())?;
        Ok(dataset)
    }

    fn open(&self, name: &str) -> Result<H5Dataset, Hdf5Error> {
        self.stored.file.dataset(&format!("{}/{name}", self.name))
    }

    /// Refuses a variable whose shape is not that of the dimensions which the schema gives it.
    fn check_shape(&self, name: &str, shape: &[usize]) -> Result<(), StoredError> {
        let own = self.schema.and_then(|schema| schema.variable(name));
        let Some(own) = own.filter(|own| own.name == name) else {
            return Ok(());
        };
        let mut dimensions: Vec<&str> = Vec::new();
        for dimension in own.dimensions {
            match *dimension {
                "<state>" => {
                    let model = &self.stored.scene.model;
                    dimensions.extend(model.states.iter().map(|s| s.variable.name.as_str()));
                    let time = Some(model.time_name())
                        .filter(|t| model.final_time().is_some() && self.has(t));
                    dimensions.extend(time);
                }
                "<argument>" if self.has("argument") => dimensions.push("argument"),
                "<argument>" => dimensions.push("state"),
                name => dimensions.push(name),
            }
        }
        // Coordinates that a file of before does not have say nothing.
        let length = |d: &&str| self.open(d).ok().and_then(|c| c.shape().first().copied());
        let lengths: Vec<Option<usize>> = dimensions.iter().map(length).collect();
        let fits = shape.len() == lengths.len()
            && shape
                .iter()
                .zip(&lengths)
                .all(|(found, own)| own.is_none_or(|own| own == *found));
        if fits {
            return Ok(());
        }
        let over = match dimensions.is_empty() {
            true => "a single value".to_owned(),
            false => dimensions.join(" x "),
        };
        Err(self.error(name, &format!("its shape is {shape:?}, not {over}")))
    }

    fn hdf5(&self, name: &str, error: &Hdf5Error) -> StoredError {
        self.error(name, &error.to_string())
    }
}
