//! The executable `costate`.

use std::process::ExitCode;

fn main() -> ExitCode {
    ExitCode::from(costate_cli::run_command(std::env::args_os()))
}
