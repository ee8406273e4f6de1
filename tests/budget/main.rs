//! What a bus does with its wire, on simulated time: as `busker check` forecasts it for lines, networks and watchdogs,
//! also of random configurations; with plans that follow the devices; and with fair turns for all, whatever befalls it.

mod commands;
mod dying;
mod feeding;
mod forecast;
mod network;
#[path = "../support/number.rs"]
mod number;
mod plain;
mod plans;
mod random;
mod turns;
mod wire;

use std::process::Command;

use busker::engine::configuration;
use busker::engine::profile::Library;
use busker::engine::settings::Settings;
use busker::engine::time::Duration;
use serde_json::Value as Json;

use number::number;

/// What a configuration without faults says.
#[track_caller]
fn settings(configuration: &str) -> Settings {
    let loaded = configuration::load("f", configuration.as_bytes(), &Library::shipped());
    loaded.unwrap_or_else(|faults| panic!("{faults:?}")).0
}

/// So far from the one to the other, where each decade is as long as the next: half way from 1 to 100 lies 10.
fn by_magnitude(part: f64, from: f64, to: f64) -> u64 {
    (from * libm::pow(to / from, part)) as u64
}

/// One line at 19200 Bd, whose devices follow; and how long they wait before they answer.
const LINE: &str = "buses:\n  line: {serial: /dev/serial/by-id/usb-A, baud: 19200, parity: even, response_timeout: 500ms}\n\
                    devices:\n";
const TURNAROUND: Duration = Duration::from_millis(5);

/// Points in so many registers, one beside the other: they are one read.
fn neighbours(count: usize) -> String {
    let points: Vec<String> = (0..count)
        .map(|number| format!("p{number}: {{at: holding {number}, type: u16, poll: fast}}"))
        .collect();
    points.join(", ")
}

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
