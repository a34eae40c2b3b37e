//! Commands that do one part of a scene, into a result file of its own.

use super::check::load;
use super::report::Terminal;
use super::run::output_of;
use super::{CliError, RunArgs};
use costate::backend::Backend;
use costate::hdf5::ResultFile;
use costate::model::Model;
use costate::result::RunRecord;
use costate::scene::Scene;
use std::path::PathBuf;
use std::time::{Instant, SystemTime};

/// Such a command, begun: the scene is read, and the result file has its hidden name.
pub(super) struct Alone {
    pub scene: Scene,
    pub backend: Box<dyn Backend>,
    pub terminal: Terminal,
    rtol: f64,
    started: SystemTime,
    pub clock: Instant,
}

impl Alone {
    /// `ending` is that of the file's name unless the user gives one; `asks` refuses a scene
    /// without the part.
    pub fn begin(
        args: &RunArgs,
        ending: &str,
        asks: impl FnOnce(&Model) -> Result<(), CliError>,
    ) -> Result<(Self, ResultFile), CliError> {
        let (started, clock) = (SystemTime::now(), Instant::now());
        super::check_out(
            args.out.as_deref(),
            &[super::Kind::Result],
            &[&args.scene.scenario],
        )?;
        if args.grid_guesses {
            return Err(super::grid::GridRefusal::Nothing.into());
        }
        let scene = load(&args.scene)?;
        asks(&scene.model)?;
        let backend = args.numerics.open(&scene.model)?;
        let terminal = Terminal::new(&args.scene);
        terminal.say(&scene.model.title)?;
        let path = (args.out.clone()).unwrap_or_else(|| output_of(&args.scene.scenario, ending));
        let file = ResultFile::create(&path)?;
        let begun = Self {
            rtol: args.numerics.rtol.unwrap_or(scene.model.integrator.rtol),
            scene,
            backend,
            terminal,
            started,
            clock,
        };
        Ok((begun, file))
    }

    /// Puts the file in place, with the record of the run; its path.
    pub fn finish(&self, file: ResultFile) -> Result<PathBuf, CliError> {
        let model = &self.scene.model;
        let record = RunRecord {
            backend: self.backend.name().to_owned(),
            adapter: self.backend.adapter(),
            rtol: self.rtol,
            atol: model.integrator.atol,
            wall_seconds: self.clock.elapsed().as_secs_f64(),
            ..super::begun(model, self.started)
        };
        record.write(&file)?;
        Ok(file.finish()?)
    }
}
