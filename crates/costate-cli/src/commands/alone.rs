//! Commands that do one part of a scene, into a result file of its own.

use crate::args::{NumericsArgs, RunArgs};
use crate::common::load::load;
use crate::common::{Kind, check_out, provenance};
use crate::error::CliError;
use crate::error::GridRefusal;
use crate::terminal::Terminal;
use costate::backend::Backend;
use costate::low_level::hdf5::ResultFile;
use costate::low_level::model::Model;
use costate::low_level::result::RunRecord;
use costate::run::{Provenance, output_of};
use costate::scene::Scene;
use costate::session::{Session, SessionError};
use std::path::PathBuf;

/// Such a command, begun: the scene is read, and the result file has its hidden name.
pub struct Alone {
    pub scene: Scene,
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
        let provenance = provenance();
        check_out(
            args.out.as_deref(),
            &[Kind::Result],
            &[&args.scene.scenario],
        )?;
        if args.grid_guesses {
            return Err(GridRefusal::Nothing.into());
        }
        let scene = load(&args.scene)?;
        asks(&scene.model)?;
        let backend = args.numerics.open(&scene.model)?;
        let terminal = Terminal::new(args.scene.print);
        terminal.say(&scene.model.title)?;
        let own = || output_of(&args.scene.scenario, ending);
        let file = ResultFile::create(args.out.clone().unwrap_or_else(own))?;
        let begun = Self {
            scene,
            terminal,
            provenance,
            numerics: args.numerics.clone(),
            seed: args.seed,
        };
        Ok((begun, backend, file))
    }

    pub fn session(&self, backend: Box<dyn Backend>) -> Session<'_> {
        Session::on(&self.scene, backend)
            .choosing(self.numerics.choices(self.seed))
            .with_progress(&self.terminal)
    }

    /// Puts the file in place, with the record of the run; its path.
    pub fn finish(&self, session: &Session<'_>, file: ResultFile) -> Result<PathBuf, CliError> {
        let model = &self.scene.model;
        let record = RunRecord {
            rtol: self.numerics.rtol.unwrap_or(model.integrator.rtol),
            atol: model.integrator.atol,
            ..session.record(&self.provenance)
        };
        record.write(&file)?;
        Ok(file.finish()?)
    }
}
