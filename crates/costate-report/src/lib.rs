//! The report of a result file: one page of HTML with its pictures in it, and the pictures beside
//! it as SVG and PNG.
//!
//! Data flows one way: [`Source`] reads a [`Stored`] file once; each file of `pictures/` makes a
//! [`Picture`] of it, where the file has the data; `canvas` is what drawing code knows, with `svg`
//! and `raster` behind it; `page` puts all together. A picture that cannot be made is named in the
//! page with the reason, and stops nothing.

mod canvas;
mod colours;
pub mod contour;
mod equations;
mod flow;
mod frame;
mod hatch;
mod names;
mod page;
mod pictures;
pub mod plane;
mod raster;
mod shape;
mod source;
mod svg;
mod tables;
mod text;
mod ticks;

pub use source::{OptionsError, Source};

use canvas::{Anchor, Canvas, Rect, Style, TITLE};
use costate::low_level::files::{
    FileError, directory_of, make, write_bytes, write_text, write_together,
};
use costate::low_level::model::Report;
use costate::low_level::result::{Stored, StoredError};
use raster::{Raster, RasterError};
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use svg::Svg;

/// Width of pictures in pixels unless asked otherwise.
pub const DEFAULT_WIDTH: u32 = 900;
/// Room of a picture's title.
const TITLE_ROOM: f64 = 30.0;
const MARGIN: f64 = 8.0;

/// What is asked for on the command line. `choice` goes before the scene's `[report]`.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// The page; default: the result file's name with `_report.html`.
    pub out: Option<PathBuf>,
    pub choice: Report,
    /// Width of the pictures in pixels; default: [`DEFAULT_WIDTH`].
    pub width: Option<u32>,
}

/// What was written.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Written {
    pub page: PathBuf,
    /// Its size in bytes.
    pub bytes: usize,
    /// Where the pictures are.
    pub folder: PathBuf,
    /// Names of the pictures, in the page's order: `folder/NAME.svg` and `folder/NAME.png`.
    pub pictures: Vec<String>,
    /// Pictures that could not be made, with the reason.
    pub missing: Vec<(String, String)>,
}

/// Why there is no report.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    #[error(transparent)]
    Options(#[from] OptionsError),
    #[error(transparent)]
    Stored(#[from] StoredError),
    #[error(transparent)]
    Output(#[from] FileError),
    #[error(transparent)]
    Raster(#[from] RasterError),
    #[error("{path} is there and is no part of an earlier report: name another --out", path = path.display())]
    NotOurs { path: PathBuf },
    #[error("no picture `{name}`: {reason}")]
    Picture { name: String, reason: String },
}

/// Something that can be drawn at any size, on any thread.
pub trait Drawing: Send + Sync {
    /// Height that suits a width.
    fn height(&self, width: f64) -> f64;

    fn draw(&self, canvas: &mut dyn Canvas, area: Rect);
}

/// A picture and what is said about it.
pub struct Picture {
    /// Name of its files.
    pub name: String,
    pub title: String,
    /// What is seen, and how to read it.
    pub caption: String,
    pub drawing: Box<dyn Drawing>,
}

impl Picture {
    fn size(&self, width: f64) -> [f64; 2] {
        [
            width,
            (TITLE_ROOM + self.drawing.height(width - 2.0 * MARGIN) + MARGIN).round(),
        ]
    }

    fn draw(&self, canvas: &mut dyn Canvas) {
        let [width, height] = canvas.size();
        let title = text::shortened(&self.title, TITLE, width - 2.0 * MARGIN);
        canvas.text(
            [MARGIN, 0.5 * TITLE_ROOM + 1.0],
            &title,
            Style::new(Anchor::Start).size(TITLE),
        );
        let area = Rect::new(MARGIN, TITLE_ROOM, width - MARGIN, height - MARGIN);
        self.drawing.draw(canvas, area);
    }

    /// As SVG text, so wide.
    pub fn svg(&self, width: f64) -> String {
        let mut canvas = Svg::new(self.size(width));
        self.draw(&mut canvas);
        canvas.finish(&self.title)
    }

    /// As the bytes of a PNG file, so wide.
    ///
    /// # Errors
    /// Where encoding fails.
    pub fn png(&self, width: f64) -> Result<Vec<u8>, RasterError> {
        let mut canvas = Raster::new(self.size(width))?;
        self.draw(&mut canvas);
        canvas.png()
    }
}

/// The page's name for a result file: `out/x.h5` -> `out/x_report.html`.
pub fn default_page(file: &Path) -> PathBuf {
    let stem = file
        .file_stem()
        .map(|s| s.to_string_lossy().into_owned())
        .unwrap_or_default();
    file.with_file_name(format!("{stem}_report.html"))
}

/// Writes the report of a result file: the page, and a folder of its name (without `.html`) with
/// the pictures. Pictures of an earlier report of that name are replaced.
///
/// # Errors
/// [`ReportError::Options`] where the options do not fit the scene; else where nothing can be
/// written. What cannot be drawn is no error: it is in [`Written::missing`] and on the page.
pub fn write(stored: &Stored, options: &Options) -> Result<Written, ReportError> {
    let source = Source::new(stored, &options.choice)?;
    let (pictures, mut missing) = pictures::all(&source);
    let page = options
        .out
        .clone()
        .unwrap_or_else(|| default_page(&stored.path));
    let folder = page.with_extension("");
    let folder = if folder == page {
        page.with_extension("pictures")
    } else {
        folder
    };
    // Drawing takes long: a command that is killed meanwhile leaves the report that was there, and
    // else nothing.
    let width = f64::from(options.width.unwrap_or(DEFAULT_WIDTH));
    let (drawn, pixels): (Vec<String>, Vec<_>) = (pictures.par_iter())
        .map(|picture| rayon::join(|| picture.svg(width), || picture.png(width)))
        .unzip();
    let mut files: Vec<(String, Vec<u8>)> = Vec::new();
    for ((picture, svg), png) in pictures.iter().zip(&drawn).zip(pixels) {
        files.push((format!("{}.svg", picture.name), svg.clone().into_bytes()));
        let name = format!("{}.png", picture.name);
        match png {
            Ok(bytes) => files.push((name, bytes)),
            Err(e) => missing.push((name, e.to_string())),
        }
    }
    let html = page::html(&source, &pictures, &drawn, &missing, &folder);

    let mut placed: Vec<(PathBuf, Vec<u8>)> = (files.into_iter())
        .map(|(name, bytes)| (folder.join(name), bytes))
        .collect();
    // The page last: where it is new its pictures are there.
    placed.push((page.clone(), html.clone().into_bytes()));
    let old = earlier_report(&page);
    refuse_others(&page, &old, &placed)?;
    write_together(&placed, directory_of(&page))?;
    // The page names it, and there may be no pictures.
    make(&folder)?;
    clear(&folder, &old, &placed);
    Ok(Written {
        page,
        bytes: html.len(),
        folder,
        pictures: pictures.into_iter().map(|p| p.name).collect(),
        missing,
    })
}

/// One picture of a result file by its name; `None` where the file has no data for it.
///
/// # Errors
/// As [`write()`]; [`ReportError::Picture`] where the data do not make a picture.
pub fn single(stored: &Stored, name: &str) -> Result<Option<Picture>, ReportError> {
    let source = Source::new(stored, &Report::default())?;
    pictures::named(&source, name).map_err(|reason| ReportError::Picture {
        name: name.to_owned(),
        reason,
    })
}

/// The pictures of the smallest level of attenuation.
pub const ATTENUATION_PICTURES: [&str; 2] = ["coverage", "validity"];

/// What was written beside a result file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Beside {
    /// The SVG files.
    pub pictures: Vec<String>,
    /// Pictures that could not be made, with the reason.
    pub missing: Vec<(String, String)>,
}

/// Writes single pictures of a result file beside it, as `out/x_NAME.svg` and `.png`; those that
/// the file has no data for are left out.
///
/// # Errors
/// As [`write()`].
pub fn write_beside(stored: &Stored, names: &[&str]) -> Result<Beside, ReportError> {
    let source = Source::new(stored, &Report::default())?;
    let stem =
        (stored.path.file_stem()).map_or_else(String::new, |s| s.to_string_lossy().into_owned());
    let mut done = Beside::default();
    for name in names {
        let picture = match pictures::named(&source, name) {
            Ok(Some(picture)) => picture,
            Ok(None) => continue,
            Err(reason) => {
                done.missing.push(((*name).to_owned(), reason));
                continue;
            }
        };
        let path = stored.path.with_file_name(format!("{stem}_{name}.svg"));
        if path.exists() && !is_ours(&path) {
            let reason = format!("{} is there and is none of ours", path.display());
            done.missing.push(((*name).to_owned(), reason));
            continue;
        }
        let width = f64::from(DEFAULT_WIDTH);
        write_text(&path, &picture.svg(width))?;
        write_bytes(&path.with_extension("png"), &picture.png(width)?)?;
        done.pictures.push(path.display().to_string());
    }
    Ok(done)
}

/// The text of the page that is replaced; empty where it is none of ours.
fn earlier_report(page: &Path) -> String {
    /// How pages began before they named what made them, and what they had.
    const OLDER_HEAD: &str = "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
        <meta name=\"viewport\"";
    const OLDER: [&str; 3] = ["<dt>Version</dt>", "<dt>Command</dt>", "<figure id=\""];
    let text = std::fs::read_to_string(page).unwrap_or_default();
    let older = text.starts_with(OLDER_HEAD) && OLDER.iter().all(|mark| text.contains(mark));
    match text.starts_with(page::HEAD) || older {
        true => text,
        false => String::new(),
    }
}

/// Refuses to replace files that no earlier report has made.
fn refuse_others(page: &Path, old: &str, placed: &[(PathBuf, Vec<u8>)]) -> Result<(), ReportError> {
    for (path, _) in placed.iter().filter(|(path, _)| path.exists()) {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let ours = match path == page {
            true => !old.is_empty(),
            // A PNG goes with its SVG.
            false => old.contains(&format!("/{name}\"")) || is_ours(&path.with_extension("svg")),
        };
        if !ours {
            return Err(ReportError::NotOurs { path: path.clone() });
        }
    }
    Ok(())
}

/// Whether a picture was drawn by this program.
#[must_use]
pub fn is_ours(svg: &Path) -> bool {
    const MARK: &str = "<!-- costate report -->";
    let text = std::fs::read(svg).unwrap_or_default();
    String::from_utf8_lossy(&text).contains(MARK)
}

/// Takes away pictures of the report that was replaced which the new one does not have: those that
/// its page names. The folder may hold other things.
fn clear(folder: &Path, old: &str, new: &[(PathBuf, Vec<u8>)]) {
    let Ok(entries) = std::fs::read_dir(folder) else {
        return;
    };
    let name_of = |path: &Path| path.file_name().map(|n| n.to_string_lossy().into_owned());
    for path in entries.filter_map(|e| Some(e.ok()?.path())) {
        let picture = path.extension().is_some_and(|e| e == "svg" || e == "png");
        let name = name_of(&path).unwrap_or_default();
        let named = old.contains(&format!("/{name}\""));
        if picture && named && !new.iter().any(|(own, _)| *own == path) {
            // What cannot be removed is no reason to stop.
            let _ = std::fs::remove_file(&path);
        }
    }
}
