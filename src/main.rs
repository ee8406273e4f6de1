//! Parses the arguments, runs one verb, prints what went wrong, sets the exit code.

use std::process::ExitCode;

use busker::cli::{self, Failure};

fn main() -> ExitCode {
    match cli::run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            tell(&failure);
            ExitCode::from(failure.exit_code())
        }
    }
}

/// The one place that prints a failure: its chain from the consequence down to the cause.
fn tell(failure: &Failure) {
    match failure {
        Failure::Failed(error) | Failure::WrongInput(error) => {
            eprintln!("error: {error}");
            for cause in error.chain().skip(1) {
                eprintln!("  because: {cause}");
            }
        }
        Failure::Faults { faults, so } => {
            for fault in faults {
                eprintln!("{}\n", fault.trim_end());
            }
            let count = faults.len();
            let consequence = so.map(|so| format!(", {so}")).unwrap_or_default();
            eprintln!("error: {count} {}{consequence}", if count == 1 { "fault" } else { "faults" });
        }
    }
}
