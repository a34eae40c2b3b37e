//! The page.
use super::{Picture, Source};
use std::path::Path;
pub fn html(_s: &Source<'_>, _p: &[Picture], _d: &[String], _m: &[(String, String)], _f: &Path) -> String {
    String::new()
}
