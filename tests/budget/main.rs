//! What a bus does with its wire, on simulated time: as `busker check` forecasts it, and with plans that
//! follow the devices.

mod commands;
mod dying;
mod feeding;
mod forecast;
mod network;
mod plain;
mod plans;
mod random;
mod turns;
mod wire;

use std::process::Command;

use serde_json::Value as Json;

/// What `busker check --json` says of this configuration.
fn check(configuration: &str, arguments: &[&str]) -> Json {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("busker.yaml");
    std::fs::write(&path, configuration).expect("a file");
    let mut command = Command::new(env!("CARGO_BIN_EXE_busker"));
    let output = command.args(["check", "--json", "--config"]).arg(&path).args(arguments).output();
    let output = output.expect("the program starts");
    serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {output:?}"))
}
