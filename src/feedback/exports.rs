//! Fitted laws, and their files: weights, C header, ONNX model.

use super::fit::FittedLaw;
use super::header::header;
use super::onnx::onnx;
use crate::files::{FileError, write_bytes, write_text};
use crate::model::Model;
use crate::scene::Scene;
use std::path::{Path, PathBuf};

/// All laws that have been fitted.
#[derive(Clone, Debug, Default)]
pub struct Fitted {
    pub laws: Vec<FittedLaw>,
    /// Names of those for which the time did not suffice.
    pub left_out: Vec<String>,
}

/// What was written of a law beside the result file.
#[derive(Clone, Debug, Default)]
pub struct Exports {
    pub files: Vec<PathBuf>,
    /// Why there is no ONNX model.
    pub without_onnx: Option<String>,
}

impl Fitted {
    /// Writes the files of each law, `STEM_NAME.toml`, `.h` and `.onnx`, to `directory`; `model` is
    /// the scene's.
    ///
    /// # Errors
    /// Those of writing.
    pub fn export(
        &self,
        directory: &Path,
        stem: &str,
        model: &Model,
    ) -> Result<Vec<Exports>, FileError> {
        self.laws
            .iter()
            .map(|law| law.export(directory, stem, model))
            .collect()
    }
}

impl FittedLaw {
    /// The law as a C header; `scene` is the one it was fitted for.
    #[must_use]
    pub fn c_header(&self, scene: &Scene) -> String {
        header(&self.name, &self.law, &self.form, &scene.model)
    }

    fn export(&self, directory: &Path, stem: &str, model: &Model) -> Result<Exports, FileError> {
        let path = |extension: &str| directory.join(format!("{stem}_{}.{extension}", self.name));
        let title = model.title.replace(['\n', '\r'], " ");
        let toml = format!(
            "# Law `{}` of the scene: {title}\n{}",
            self.name,
            self.law.to_toml()
        );
        let mut files = vec![path("toml"), path("h")];
        write_text(&files[0], &toml)?;
        write_text(&files[1], &header(&self.name, &self.law, &self.form, model))?;
        let without_onnx = match onnx(&self.name, &self.law, &self.form, model) {
            Ok(bytes) => {
                files.push(path("onnx"));
                write_bytes(&files[2], &bytes)?;
                None
            }
            Err(e) => {
                // One that is there is of another law.
                let _ = std::fs::remove_file(path("onnx"));
                Some(e.to_string())
            }
        };
        Ok(Exports {
            files,
            without_onnx,
        })
    }
}
