//! The `costate` program: see `costate --help`.

use std::process::ExitCode;

fn main() -> ExitCode {
    costate::cli::main()
}
