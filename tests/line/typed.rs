//! What tests of a verb as somebody types it share: simulated devices, a terminal, and what was said.

use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::process::Output;

use busker::simulator::{DeviceAt, LineSettings, Model, Options, Parity, PtyPort, Simulation};
use rustix::pty::{OpenptFlags, openpt, ptsname, unlockpt};
use serde_json::Value;

/// Simulated devices on a pseudo-terminal; those of a line with a bit rate and parity hear only who speaks with these.
pub fn simulated(
    line: Option<(u32, Parity)>,
    devices: &[(Model, u8)],
    faults: &[&str],
) -> (Simulation, PtyPort) {
    let devices: Vec<DeviceAt> =
        devices.iter().map(|(model, unit)| DeviceAt { model: *model, unit: *unit }).collect();
    let usual = Options::default();
    let options = Options {
        line: line.map_or(usual.line, |(baud, parity)| LineSettings { baud, parity }),
        heeds_settings: line.is_some(),
        faults: faults.iter().map(|fault| fault.parse().expect("a fault")).collect(),
        ..usual
    };
    let simulation = Simulation::new(&devices, options).expect("devices");
    let port = simulation.serve_pty(None).expect("a pseudo-terminal");
    (simulation, port)
}

pub fn path(port: &PtyPort) -> String {
    port.path().display().to_string()
}

/// The far end of a line or terminal of which a test does everything by hand, and the near one's path.
pub fn terminal() -> (OwnedFd, PathBuf) {
    let far =
        openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).expect("a pseudo-terminal");
    unlockpt(&far).expect("a pseudo-terminal");
    let path = ptsname(&far, Vec::new()).expect("its name").into_string().expect("plain letters");
    (far, path.into())
}

/// The JSON that was printed.
#[track_caller]
pub fn found(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {output:?}"))
}

/// Everything that was printed.
pub fn said(output: &Output) -> String {
    String::from_utf8_lossy(&[&output.stdout[..], &output.stderr[..]].concat()).into_owned()
}

/// How it ended, and that it said this.
#[track_caller]
pub fn check(output: &Output, code: i32, says: &str) {
    assert_eq!(output.status.code(), Some(code), "{output:?}");
    assert!(said(output).contains(says), "`{says}` in {}", said(output));
}
