//! `busker identify`: who a device is, by its own word, and which profiles that fits.

use std::sync::Arc;

use anyhow::anyhow;

use super::by_hand::ByHand;
use super::{Failure, output};
use crate::engine::device::Device;
use crate::engine::identity::{self, Interview};
use crate::engine::modbus::names::{hexadecimal, object_name};

/// Ask a device who it is, and which profile describes it
///
/// Asks for all its names (function 43/14) and its server id (17), and reads the registers by which
/// profiles know devices that do not tell their names. Nothing is written. With --config and
/// --device, or with --profile, it ends with 1 if the device is another one than its profile says.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  busker identify --serial /dev/ttyUSB0 --baud 19200 --parity even --unit 18
  busker identify --config busker.yaml --device heating_relays")]
pub struct Args {
    #[command(flatten)]
    device: ByHand,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: Args) -> Result<(), Failure> {
    let mut known = identity::known(&args.device.library()?);
    let mut asked = args.device.open()?;
    let unit = asked.unit();
    let device = asked.device().cloned();
    if let Some(Device { profile, identify: Some(identify), .. }) = &device {
        // A file of a profile may be none of those that everybody knows.
        if !known.iter().any(|(id, _)| id == profile) {
            Arc::make_mut(&mut known).push((profile.clone(), identify.clone()));
        }
    }
    let interview = match device.as_ref().and_then(|device| device.identify.clone()) {
        // A profile that goes by nothing says nothing about who should be there.
        None => Interview::of_stranger(known),
        own => Interview::of_device(own, known),
    };
    let interview = asked.interview(interview)?;
    let fitting: Vec<&str> = interview.fitting().into_iter().map(|(id, _)| id).collect();
    let matches = device.as_ref().map(|device| Match::new(device, &interview));
    match args.json {
        true => {
            // As a program is told it over MQTT, with the profiles that fit.
            let mut found = interview.json(("unit", unit.into()), device.as_ref());
            found["profiles"] = fitting.into();
            output::print_json(&found)?;
        }
        false => output::print(&as_text(&interview, &fitting, matches.as_ref()))?,
    }
    if !interview.was_heard() {
        let why = interview.why_unheard();
        return Err(anyhow!("unit {unit} answers nothing that fits: {why}").into());
    }
    match matches {
        Some(Match { id, found: Some(Err(reason)) }) => {
            Err(anyhow!("unit {unit} is no {id}: {reason}").into())
        }
        _ => Ok(()),
    }
}

/// Whether the device is the one that its profile describes.
struct Match {
    id: String,
    /// What it said, or what is wrong with that; `None`: the profile goes by nothing.
    found: Option<Result<String, String>>,
}

impl Match {
    fn new(device: &Device, interview: &Interview) -> Match {
        let found = device.identify.as_ref().map(|identify| interview.check(identify));
        Match { id: device.profile.clone(), found }
    }
}

fn as_text(interview: &Interview, fitting: &[&str], matches: Option<&Match>) -> String {
    let mut table = output::Table::new();
    for (number, text) in interview.objects() {
        table.row([object_name(*number).replace('_', " "), text.clone()]);
    }
    if let Some(error) = interview.objects_error() {
        table.row(["identification".into(), format!("({error})")]);
    }
    match interview.server_id() {
        Some(Ok(bytes)) => table.row(["server id".into(), hexadecimal(bytes)]),
        Some(Err(error)) => table.row(["server id".into(), format!("({error})")]),
        None => &mut table,
    };
    match fitting {
        _ if !interview.was_heard() => {}
        [] => drop(table.row(["fits", "(no profile that goes by what it says)"])),
        fitting => drop(table.row(["fits", &fitting.join(", ")])),
    }
    if let Some(Match { id, found }) = matches {
        let told = match found {
            None => format!("{id} goes by nothing that could be asked"),
            Some(Ok(_)) => format!("yes, it is a {id}"),
            Some(Err(reason)) => format!("no {id}: {reason}"),
        };
        table.row(["its profile".into(), told]);
    }
    table.render()
}
