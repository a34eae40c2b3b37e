//! Commands that do one part of a scene, into a result file of its own.

use crate::args::{NumericsArgs, RunArgs, SceneArgs};
use crate::common::load::load;
use crate::common::{Kind, check_out, provenance};
use crate::error::CliError;
use crate::error::GridRefusal;
use crate::terminal::Terminal;
use costate::backend::Backend;
use costate::low_level::hdf5::ResultFile;
use costate::low_level::model::Model;
use costate::run::{Provenance, output_of};
use costate::scene::Scene;
use costate::session::{Session, SessionError};
use std::path::{Path, PathBuf};

/// Such a command, begun: the scene is read, and the result file has its hidden name.
pub struct Alone {
    pub scene: Scene,
    path: PathBuf,
    pub terminal: Terminal,
    pub provenance: Provenance,
    numerics: NumericsArgs,
    seed: u64,
}

impl Alone {
    /// `ending` is that of the file's name unless the user gives one; `asks` refuses a scene
    /// without the part.
    pub fn begin(
        args: &RunArgs,
        ending: &str,
        asks: impl FnOnce(&Model) -> Result<(), SessionError>,
    ) -> Result<(Self, Box<dyn Backend>, ResultFile), CliError> {
        if args.grid_guesses {
            return Err(GridRefusal::Nothing.into());
        }
        let begun = Self::read(
            (&args.scene, &args.numerics, args.seed),
            args.out.as_deref(),
            asks,
        )?;
        let backend = begun.numerics.open(&begun.scene.model)?;
        let file = begun.create(args.out.as_deref(), ending)?;
        Ok((begun, backend, file))
    }

    /// The scene alone.
    pub fn read(
        (scene, numerics, seed): (&SceneArgs, &NumericsArgs, u64),
        out: Option<&Path>,
        asks: impl FnOnce(&Model) -> Result<(), SessionError>,
    ) -> Result<Self, CliError> {
        let provenance = provenance();
        check_out(out, &[Kind::Result], &[&scene.scenario])?;
        let path = scene.scenario.clone();
        let terminal = Terminal::new(scene.print);
        let scene = load(scene)?;
        asks(&scene.model)?;
        Ok(Self {
            scene,
            path,
            terminal,
            provenance,
            numerics: numerics.clone(),
            seed,
        })
    }

    /// Where the result goes; the scene's title is said.
    pub fn path(&self, out: Option<&Path>, ending: &str) -> Result<PathBuf, CliError> {
        self.terminal.say(&self.scene.model.title)?;
        let own = || output_of(&self.path, ending);
        Ok(out.map_or_else(own, Path::to_path_buf))
    }

    /// The result file, with its hidden name.
    pub fn create(&self, out: Option<&Path>, ending: &str) -> Result<ResultFile, CliError> {
        Ok(ResultFile::create(self.path(out, ending)?)?)
    }

    pub fn session(&self, backend: Box<dyn Backend>) -> Session<'_> {
        Session::on(&self.scene, backend)
            .choosing(self.numerics.choices(self.seed))
            .with_progress(&self.terminal)
    }

    /// Puts the file in place, with the record of the run; its path.
    pub fn finish(&self, session: &Session<'_>, file: ResultFile) -> Result<PathBuf, CliError> {
        Ok(session.finish(file, &self.provenance)?)
    }
}
