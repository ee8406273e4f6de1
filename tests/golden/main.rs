//! What came of each shipped profile, in files that a reviewer reads beside the manual.
//!
//! `tests/golden/<profile>/` holds `points.txt` (the expanded points), `plan.txt` (what is read),
//! `readings.txt` (registers and what they say; the registers are written by hand) and
//! `discovery.json` (what Home Assistant is told). `BLESS=1` rewrites them; read the difference.
//! `manual.tsv` is a second reading of the manual, written by hand alone.

mod coverage;
mod discovery;
mod inline;
mod manual;
mod measuring;
mod points;
mod properties;
mod readings;
mod rows;

use std::fs;
use std::path::PathBuf;
use std::sync::LazyLock;

use busker::engine::device::Device;
use busker::engine::plan::{Read, Table, Tariff, USUAL_TURNAROUND, plan};
use busker::engine::profile::Library;
use busker::engine::settings::{Line, Link, Parity, Rs485};

#[test]
fn the_points_are_those_of_the_manual() {
    for (id, device) in shipped() {
        compare(id, "points.txt", &points::table(device));
    }
}

#[test]
fn the_plan_reads_them_in_the_fewest_safe_requests() {
    for (id, device) in shipped() {
        compare(id, "plan.txt", &Table { device, reads: &usual_plan(device) }.to_string());
    }
}

#[test]
fn the_readings_are_what_the_manual_says() {
    for (id, device) in shipped() {
        let file = fs::read_to_string(place(id, "readings.txt")).unwrap_or_default();
        compare(id, "readings.txt", &readings::answered(device, &file));
    }
}

#[test]
fn every_point_and_every_case_of_every_profile_has_a_golden_reading() {
    for (id, device) in shipped() {
        let file = fs::read_to_string(place(id, "readings.txt")).unwrap_or_default();
        assert_eq!(readings::without_a_reading(device, &file), Vec::<String>::new(), "{id}");
    }
}

#[test]
fn home_assistant_is_told_what_a_person_wants_to_see() {
    for (id, device) in shipped() {
        compare(id, "discovery.json", &discovery::told(device));
    }
}

#[test]
fn there_are_no_goldens_of_devices_that_are_gone() {
    let known: Vec<&String> = shipped().iter().map(|(id, _)| id).collect();
    for manufacturer in folders(&place("", "")) {
        for model in folders(&place(&manufacturer, "")) {
            let id = format!("{manufacturer}/{model}");
            assert!(known.contains(&&id), "tests/golden/{id} is of no shipped profile");
        }
    }
}

/// Every shipped profile by its identifier.
fn shipped() -> &'static [(String, Device)] {
    static SHIPPED: LazyLock<Vec<(String, Device)>> = LazyLock::new(|| {
        let library = Library::shipped();
        let load = |id| match library.load(id) {
            Ok(device) => (id.to_string(), device),
            Err(faults) => panic!("{id}: {}", faults[0]),
        };
        library.ids().into_iter().map(load).collect()
    });
    &SHIPPED
}

/// The plan on the line that these devices leave the factory with.
fn usual_plan(device: &Device) -> Vec<Read> {
    let line = Line { baud: 19_200, parity: Parity::Even, stop_bits: 1 };
    let link = Link::Serial { path: String::new(), line, rs485: Rs485::Auto };
    plan(device, Tariff::of(&link, None).cost(USUAL_TURNAROUND), &[])
}

/// Holds `actual` against the golden file, or rewrites the file.
#[track_caller]
fn compare(id: &str, file: &str, actual: &str) {
    let path = place(id, file);
    if std::env::var_os("BLESS").is_some() {
        fs::create_dir_all(path.parent().expect("a file has a folder")).expect("the folder can be made");
        fs::write(&path, actual).expect("the golden can be written");
        return;
    }
    let expected = fs::read_to_string(&path).unwrap_or_default();
    if expected == actual {
        return;
    }
    let line = expected.lines().zip(actual.lines()).take_while(|(a, b)| a == b).count();
    let of = |text: &str| text.lines().nth(line).unwrap_or("(the end)").to_string();
    panic!(
        "tests/golden/{id}/{file} differs in line {}\n  golden: {}\n  now:    {}\n`make goldens` rewrites it",
        line + 1,
        of(&expected),
        of(actual)
    );
}

fn place(id: &str, file: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(id).join(file)
}

fn folders(path: &PathBuf) -> Vec<String> {
    let entries = fs::read_dir(path).expect("the folder is there");
    entries
        .map(|entry| entry.expect("it can be listed"))
        .filter(|entry| entry.path().is_dir())
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .collect()
}
