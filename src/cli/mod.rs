//! The command line: one verb per file.
//!
//! A new verb is a file `src/cli/VERB.rs` and two lines here: `mod VERB;` and its line in `verbs!`.
//! The file holds
//!
//! * `pub struct Args`, derived from `clap::Args`: its doc comment is the verb's help, and
//!   `#[command(after_help = "Example:\n  busker VERB …")]` ends that help with an example;
//! * `pub fn run(args: Args) -> Result<(), Failure>`.
//!
//! Data goes to standard output through [`output`], everything else to standard error. A verb never
//! ends the process by itself and never prints its own failure: it returns a [`Failure`], and
//! `main.rs` prints it and chooses the exit code.

mod by_hand;
mod characters;
mod check;
pub mod configuration;
mod demo;
mod diagnose;
mod doctor;
mod identify;
mod line;
pub mod log;
pub mod output;
mod plan;
mod profiles;
mod reach;
mod read;
mod run;
mod scan;
mod settings;
mod simulate;
mod write;

use clap::{Parser, Subcommand};

/// One line per verb: its module, which is also its name on the command line, and its variant.
macro_rules! verbs {
    ($($module:ident $Variant:ident,)*) => {
        #[derive(Subcommand)]
        enum Verb {
            $($Variant($module::Args),)*
        }

        /// Parses the arguments and runs the verb. A wrong argument ends the process with exit code 2.
        pub fn run() -> Result<(), Failure> {
            match CommandLine::parse().verb {
                $(Verb::$Variant(args) => $module::run(args),)*
            }
        }
    };
}

verbs! {
    check Check,
    diagnose Diagnose,
    demo Demo,
    doctor Doctor,
    identify Identify,
    line Line,
    plan Plan,
    profiles Profiles,
    read Read,
    run Run,
    scan Scan,
    settings Settings,
    simulate Simulate,
    write Write,
}

/// Connects Modbus devices to Home Assistant and to anything that speaks MQTT.
#[derive(Parser)]
#[command(
    name = "busker",
    version,
    disable_help_subcommand = true,
    after_help = "Example:\n  busker run --config /etc/busker/busker.yaml"
)]
struct CommandLine {
    #[command(subcommand)]
    verb: Verb,
}

/// Why a verb did not do what was asked; `main.rs` turns it into text and an exit code.
#[derive(Debug)]
pub enum Failure {
    /// The input was right, and it failed all the same.
    Failed(anyhow::Error),
    /// What was asked makes no sense: an unknown device, a value out of range.
    WrongInput(anyhow::Error),
    /// Faults in files, rendered, each beginning with its place. `so` ends the last line with what
    /// did not happen for their sake, where something was to happen.
    Faults { faults: Vec<String>, so: Option<&'static str> },
}

impl Failure {
    pub fn wrong_input(error: impl Into<anyhow::Error>) -> Failure {
        Failure::WrongInput(error.into())
    }

    /// A wrong input that is one sentence.
    pub fn wrong(message: impl std::fmt::Display) -> Failure {
        Failure::WrongInput(anyhow::anyhow!("{message}"))
    }

    /// The same failure, with what did not happen for the sake of faults.
    pub fn so(self, what: &'static str) -> Failure {
        match self {
            Failure::Faults { faults, .. } => Failure::Faults { faults, so: Some(what) },
            other => other,
        }
    }

    /// The same failure, with what it means for what was wanted.
    pub fn context(self, what: impl std::fmt::Display + Send + Sync + 'static) -> Failure {
        match self {
            Failure::Failed(error) => Failure::Failed(error.context(what)),
            Failure::WrongInput(error) => Failure::WrongInput(error.context(what)),
            other => other,
        }
    }

    /// All of it as a text of its own, for where nobody reads standard error.
    pub fn to_text(&self) -> String {
        match self {
            Failure::Failed(error) | Failure::WrongInput(error) => format!("{error:#}"),
            Failure::Faults { faults, .. } => {
                let faults: Vec<&str> = faults.iter().map(|fault| fault.trim_end()).collect();
                faults.join("\n\n")
            }
        }
    }

    pub fn exit_code(&self) -> u8 {
        match self {
            Failure::Failed(_) => 1,
            Failure::WrongInput(_) | Failure::Faults { .. } => 2,
        }
    }
}

impl<E: Into<anyhow::Error>> From<E> for Failure {
    fn from(error: E) -> Failure {
        Failure::Failed(error.into())
    }
}
