//! `busker profiles`: the device profiles there are, and whether one's own is right.

mod docs;
mod json;

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Subcommand;

use super::configuration::add_profiles;
use super::output::{self, Table, counted};
use super::{Failure, configuration};
use crate::engine::device::{Condition, Device, Encoding, Point, PointIndex, Poll, Unit, WriteRule};
use crate::engine::profile::{self, Library};
use crate::engine::yaml::Diagnostic;

/// List, show, check and document device profiles
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  busker profiles show metz-connect/mr-do4")]
pub struct Args {
    #[command(subcommand)]
    what: What,
    /// A folder of your own profiles, which win over the shipped ones
    #[arg(long, value_name = "DIR", global = true)]
    profiles: Vec<PathBuf>,
}

#[derive(Debug, Subcommand)]
enum What {
    /// The profiles there are
    #[command(after_help = "Example:\n  busker profiles list --json")]
    List {
        /// As JSON
        #[arg(long)]
        json: bool,
    },
    /// What a profile says, with every repetition written out
    #[command(after_help = "Example:\n  busker profiles show metz-connect/mr-do4 --json")]
    Show {
        /// The profile's name: its path without `.yaml`
        #[arg(value_name = "ID")]
        id: String,
        /// As JSON, with everything that is known of each point
        #[arg(long)]
        json: bool,
    },
    /// Every fault of profile files, with its place
    #[command(after_help = "Example:\n  busker profiles check my-device.yaml")]
    Check {
        /// The profiles
        #[arg(value_name = "FILE", required = true)]
        files: Vec<PathBuf>,
    },
    Docs(docs::Args),
    /// The JSON Schema of a profile file, for editors
    #[command(after_help = "Example:\n  busker profiles schema > profile.schema.json")]
    Schema,
}

pub fn run(args: Args) -> Result<(), Failure> {
    let mut library = Library::shipped();
    for folder in &args.profiles {
        add_profiles(&mut library, folder, folder)
            .with_context(|| format!("cannot read the profiles in `{}`", folder.display()))
            .map_err(Failure::WrongInput)?;
    }
    match args.what {
        What::List { json } => list(&library, json),
        What::Show { id, json } => show(&library, &id, json),
        What::Check { files } => check(library, &files),
        What::Docs(args) => docs::run(&args, &library),
        What::Schema => output::print(&schema()?),
    }
}

/// Every profile, and what is wrong with those that cannot be used.
fn load_all(library: &Library) -> (Vec<Device>, Vec<Diagnostic>) {
    let (mut devices, mut faults) = (Vec::new(), Vec::new());
    for id in library.ids() {
        match library.load(id) {
            Ok(device) => devices.push(device),
            Err(found) => faults.extend(found),
        }
    }
    (devices, faults)
}

fn list(library: &Library, json: bool) -> Result<(), Failure> {
    let (devices, faults) = load_all(library);
    if json {
        output::print_json(&devices.iter().map(json::summary).collect::<Vec<_>>())?;
    } else {
        let mut table = Table::new();
        table.row(["profile", "manufacturer", "model", "points"]).right(3);
        for device in &devices {
            let points = device.points.len().to_string();
            table.row([&device.profile, &device.manufacturer, &device.model, &points]).right(3);
        }
        output::print(&table.render())?;
    }
    if faults.is_empty() { Ok(()) } else { Err(configuration::faults(faults)) }
}

fn show(library: &Library, id: &str, json: bool) -> Result<(), Failure> {
    let device = known(library, id)?;
    if json { output::print_json(&json::device(&device)) } else { output::print(&page(&device)) }
}

fn check(mut library: Library, files: &[PathBuf]) -> Result<(), Failure> {
    let mut faults = Vec::new();
    let mut good = String::new();
    for file in files {
        let shown = file.display().to_string();
        let bytes = fs::read(file)
            .with_context(|| format!("cannot read the profile `{shown}`"))
            .map_err(Failure::WrongInput)?;
        add_shared_files_near(&mut library, file)?;
        let is_shared = file.parent().is_some_and(|folder| folder.ends_with("shared"));
        let found = if is_shared {
            library.check_shared(&shown, &bytes).map(|cases| format!("{cases} cases"))
        } else {
            library.check(&shown, &bytes).map(|device| summary(&device))
        };
        match found {
            Ok(what) => good += &format!("{shown}: no fault ({what})\n"),
            Err(found) => faults.extend(found),
        }
    }
    output::print(&good)?;
    if faults.is_empty() { Ok(()) } else { Err(configuration::faults(faults)) }
}

/// `acme/ra8, 57 points, 2 things`
fn summary(device: &Device) -> String {
    let mut parts = vec![device.profile.clone(), counted(device.points.len(), "point")];
    if !device.things.is_empty() {
        parts.push(counted(device.things.len(), "thing"));
    }
    parts.join(", ")
}

/// The device of a shipped profile, or of a profile's file, which ends in `.yaml`.
pub fn load(profile: &str) -> Result<Device, Failure> {
    if profile.ends_with(".yaml") {
        load_file(Path::new(profile))
    } else {
        known(&Library::shipped(), profile)
    }
}

fn known(library: &Library, id: &str) -> Result<Device, Failure> {
    if !library.contains(id) {
        return Err(Failure::wrong(library.unknown(id)));
    }
    library.load(id).map_err(configuration::faults)
}

/// The device of a profile's file that need not be in any folder of profiles.
pub fn load_file(file: &Path) -> Result<Device, Failure> {
    let shown = file.display().to_string();
    let bytes = fs::read(file)
        .with_context(|| format!("cannot read the profile `{shown}`"))
        .map_err(Failure::WrongInput)?;
    let mut library = Library::shipped();
    add_shared_files_near(&mut library, file)?;
    library.check(&shown, &bytes).map_err(configuration::faults)
}

/// The files in `shared/` beside a profile, or beside its manufacturer's folder.
pub(super) fn add_shared_files_near(library: &mut Library, file: &Path) -> Result<(), Failure> {
    let folder = file.parent().unwrap_or(Path::new(""));
    for root in [folder.join(".."), folder.to_path_buf()] {
        let shared = root.join("shared");
        if shared.is_dir() {
            add_profiles(library, &root, &shared)
                .with_context(|| format!("cannot read the files in `{}`", shared.display()))
                .map_err(Failure::WrongInput)?;
        }
    }
    Ok(())
}

fn schema() -> Result<String, Failure> {
    Ok(serde_json::to_string_pretty(&profile::schema())? + "\n")
}

/// What a person wants to know of a profile on one page.
fn page(device: &Device) -> String {
    let mut table = Table::new();
    table.row(["point", "at", "type", "unit", "access", "poll", "only while", "remarks"]);
    for point in &device.points {
        let (kind, unit) = match &point.encoding {
            Encoding::Plain(form) => {
                let kind = match (form.elements, &point.refers) {
                    (1, None) => form.kind.name(),
                    (1, Some(span)) => format!("refers to {span}"),
                    (elements, _) => format!("{elements} × {}", form.kind.name()),
                };
                (kind, unit_text(device, &form.unit))
            }
            Encoding::Cases { by, .. } => {
                let by = &device.points[*by];
                let how = if by.refers.is_some() { "like" } else { "by" };
                (format!("{how} {}", by.name), String::new())
            }
        };
        let at = point.at.to_string();
        let access = access(point).to_string();
        let poll = match point.poll {
            Poll::Never if point.is_read_on_request() => "on request".into(),
            Poll::Never => String::new(),
            poll => poll.name().into(),
        };
        let (when, remarks) = (when_text(device, &point.when), remarks(device, point));
        table.row([point.name.clone(), at, kind, unit, access, poll, when, remarks]);
    }
    let mut page = format!(
        "{}: {} {}\n{}\n\n{}",
        device.profile,
        device.manufacturer,
        device.model,
        device.source.trim(),
        table.render()
    );
    page += &things_text(device);
    if let Some(line) = &device.line {
        page += &format!("\nline:\n  unit: {}\n  settings: {}\n", line.unit_by, line.settings);
    }
    if !device.left_out.is_empty() {
        page += "\nleft out:\n";
    }
    for left_out in &device.left_out {
        page += &format!("  {}: {}\n", left_out.span, left_out.reason.trim());
    }
    page
}

/// `mode is direct or motor, enabled is ON`
fn when_text(device: &Device, when: &[Condition]) -> String {
    let each = |condition: &Condition| {
        let names: Vec<&str> = condition.values.iter().map(|(_, name)| name.as_str()).collect();
        format!("{} is {}", device.points[condition.point].name, names.join(" or "))
    };
    when.iter().map(each).collect::<Vec<_>>().join(", ")
}

/// What is unusual about a point.
fn remarks(device: &Device, point: &Point) -> String {
    let mut remarks = Vec::new();
    if point.persistent {
        remarks.push("EEPROM".to_string());
    }
    if point.read_clears {
        remarks.push("reading clears it".into());
    }
    remarks.extend(point.event.as_ref().map(|event| format!("event {event}")));
    if let Some(write) = &point.write {
        if write.at != point.at {
            remarks.push(format!("written at {}", write.at));
        }
        if matches!(write.rule, WriteRule::Press { .. }) {
            remarks.push("button".into());
        }
        if !write.settle.is_zero() {
            remarks.push(format!("settles in {} ms", write.settle.as_millis()));
        }
        let names = point.plain().map_or(&[][..], |form| form.names.list());
        let between = write.on_change.and_then(|raw| names.iter().find(|(value, _)| *value == raw));
        remarks.extend(between.map(|(_, name)| format!("acts on change, {name} between")));
    }
    remarks.extend(point.heartbeat.map(|time| format!("heartbeat within {}", device.points[time].name)));
    if device.wire.watchdog.is_some_and(|watchdog| device.points[watchdog].name == point.name) {
        remarks.push("watchdog".into());
    }
    remarks.join(", ")
}

/// Each thing with what makes its states and what its commands write.
fn things_text(device: &Device) -> String {
    let row = |row: &[(PointIndex, String)], sign: &str| {
        let each = row.iter().map(|(point, value)| format!("{}{sign}{value}", device.points[*point].name));
        each.collect::<Vec<_>>()
    };
    let mut text = String::new();
    for thing in &device.things {
        let when = match when_text(device, &thing.when) {
            when if when.is_empty() => when,
            when => format!(", only while {when}"),
        };
        text += &format!("\n{} {}{when}\n", thing.kind.name(), thing.name);
        let mut table = Table::new();
        for (word, point) in [("temperature", thing.temperature), ("target", thing.target)] {
            if let Some(point) = point {
                table.row(["", word, &device.points[point].name]);
            }
        }
        for state in &thing.states {
            table.row(["", &format!("is {}", state.name), &row(&state.row, " is ").join(", ")]);
        }
        for command in &thing.commands {
            table.row(["", &format!("do {}", command.name), &row(&command.orders, " = ").join(", then ")]);
        }
        text += &table.render();
    }
    text
}

fn unit_text(device: &Device, unit: &Unit) -> String {
    match unit {
        Unit::None => String::new(),
        Unit::Fixed(unit) => unit.clone(),
        Unit::By(point) => format!("by {}", device.points[*point].name),
    }
}

/// `r`, `w` or `rw`.
fn access(point: &Point) -> &'static str {
    match (point.is_read(), point.write.is_some()) {
        (_, false) => "r",
        (true, true) => "rw",
        (false, true) => "w",
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn the_schema_that_is_checked_in_is_the_programs() {
        let path = "device-profiles/profile.schema.json";
        let generated = schema().expect("JSON");
        if std::env::var_os("BLESS").is_some() {
            fs::write(path, &generated).expect("the schema is written");
        }
        let checked_in = fs::read_to_string(path).unwrap_or_default();
        assert!(checked_in == generated, "{path} is old; `busker profiles schema > {path}` writes it anew");
    }

    #[test]
    fn each_shipped_profile_is_shown_on_a_page() {
        let library = Library::shipped();
        for id in library.ids() {
            let device = library.load(id).expect("a good profile");
            let page = page(&device);
            assert!(device.points.iter().all(|point| page.contains(&point.name)), "{page}");
        }
    }

    /// The page of a profile has these lines, whatever the widths of its columns.
    #[track_caller]
    fn check_page(file: &str, expected: &[&str]) {
        let page = page(&load_file(Path::new(file)).expect("a good profile"));
        let words = |line: &str| line.split_whitespace().collect::<Vec<_>>().join(" ");
        let lines: Vec<String> = page.lines().map(words).collect();
        for expected in expected {
            assert!(lines.iter().any(|line| line == expected), "{expected:?} is not in\n{page}");
        }
    }

    #[test]
    fn a_page_shows_modes_things_events_and_arrays() {
        check_page(
            "tests/transcripts/damper.yaml",
            &[
                "relay coil 0 bool rw fast mode is direct",
                "drive holding 1 u16 rw fast mode is motor settles in 100 ms, heartbeat within receive_time",
                "cover damper, only while mode is motor",
                "is opening position is running, drive is open",
                "do close drive = close",
                "do press drive = open, then alarm = ok",
            ],
        );
        check_page(
            "tests/transcripts/blind.yaml",
            &[
                "relay discrete 8..9 u16 rw fast written at coil 2..3, settles in 600 ms",
                "order holding 1.0..7 u16 rw fast acts on change, locked between",
                "pressed input 0.0 bool r fast event pressed",
            ],
        );
        check_page(
            "tests/transcripts/recorder.yaml",
            &[
                "curve input 10..14 5 × i16 V r on request recording is stopped",
                "of holding 1 refers to input 1..9 rw slow",
                "minimum input 3 like of r slow",
            ],
        );
    }

    fn shown(id: &str, point: &str) -> serde_json::Value {
        let device = json::device(&Library::shipped().load(id).expect("a good profile"));
        let points = device["points"].as_array().expect("points");
        points.iter().find(|shown| shown["name"] == point).expect("the point").clone()
    }

    /// Compares the keys that stand in `expected`; there may be more.
    fn check_shown(id: &str, point: &str, expected: serde_json::Value) {
        let shown = shown(id, point);
        for (key, value) in expected.as_object().expect("a map") {
            assert_eq!(shown.get(key), Some(value), "{id} {point} {key}");
        }
    }

    #[test]
    fn a_point_is_told_with_all_that_is_known_of_it() {
        check_shown(
            "metz-connect/mr-do4",
            "relay_1",
            json!({
                "table": "coil", "address": 0, "count": 1, "elements": 1, "bits": null, "type": "bool",
                "scale": 1, "offset": 0, "unit": null, "access": "rw", "write_at": null, "write_with": null,
                "persistent": false, "read_clears": false, "poll": "fast", "min": null, "max": null,
                "default": null, "values": {"0": "OFF", "1": "ON"}, "invalid": {}, "by": null, "cases": null,
                "when": null, "decimals_by": null, "unit_by": null, "like": null,
            }),
        );
        check_shown(
            "metz-connect/mr-do4",
            "watchdog",
            json!({"type": "u16", "scale": 0.01, "unit": "s", "min": 0, "max": 65535, "persistent": true}),
        );
        check_shown(
            "metz-connect/mr-si4",
            "meter_2_digits",
            json!({"address": 37, "bits": [8, 15], "min": 0, "max": 9, "default": 7}),
        );
        check_shown(
            "metz-connect/mr-si4",
            "meter_2_start",
            json!({"address": 14, "count": 2, "decimals_by": "meter_2_decimals", "write_with": 16}),
        );
        check_shown(
            "fuehlersysteme/relay8",
            "relay_1_release",
            json!({"access": "w", "poll": "never", "press": 1, "self_clearing": true}),
        );
    }

    #[test]
    fn a_point_with_cases_is_told_case_by_case() {
        let value = shown("metz-connect/mr-ai8", "channel_3_value");
        assert_eq!(value["by"], "channel_3_code");
        let pt100 = &value["cases"]["pt100_integer"];
        assert_eq!((&pt100["type"], &pt100["scale"]), (&json!("i16"), &json!(0.1)));
        assert_eq!((&pt100["min"], &pt100["max"]), (&json!(-500), &json!(1500)));
        assert_eq!(pt100["unit_by"], "temperature_unit");
        // The manual's 10.24 V would be 32768, which the signed register cannot hold.
        assert_eq!(value["cases"]["voltage_integer"]["max"], 32767);
        // An offset may be as large as the measuring range is wide.
        let offset = shown("metz-connect/mr-ai8", "channel_3_offset");
        assert_eq!(offset["cases"]["pt100_integer"]["min"], -2000);
        assert_eq!(offset["entity"]["platform"], "number");
    }

    #[test]
    fn faults_of_a_file_end_with_exit_code_2() {
        let faulty = || vec![PathBuf::from("tests/bad-profiles/many-faults-at-once/profile.yaml")];
        match check(Library::shipped(), &faulty()) {
            Err(Failure::Faults { faults, so: None }) => assert_eq!(faults.len(), 6, "{faults:?}"),
            other => panic!("{other:?}"),
        }
        let failure = check(Library::shipped(), &faulty()).expect_err("faults");
        assert_eq!(failure.exit_code(), 2);
        let failure = show(&Library::shipped(), "metz-connect/mr-do5", false).expect_err("unknown");
        assert_eq!(failure.exit_code(), 2);
    }
}
