//! `busker profiles docs`: a page for people about each device, and the list of all of them.

mod modes;
mod page;
mod points;
mod things;
mod words;

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;

use super::super::{Failure, configuration, output};
use crate::engine::device::Device;
use crate::engine::profile::Library;

/// Write a page for people about each device, and the list of all devices
///
/// The pages are Markdown: `DIR/<manufacturer>/<device>.md`, and `DIR/README.md` for the list. A page
/// says what the device shows in Home Assistant, what to mind, what to copy into the configuration,
/// and every point with its place, range and factory setting.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  busker profiles docs --output docs/devices")]
pub struct Args {
    /// The folder to write into
    #[arg(long, value_name = "DIR", default_value = "docs/devices")]
    output: PathBuf,
}

pub fn run(args: &Args, library: &Library) -> Result<(), Failure> {
    let count = write_all(&args.output, library)?;
    output::print(&format!("{count} pages in {}\n", args.output.display()))
}

fn write_all(folder: &Path, library: &Library) -> Result<usize, Failure> {
    let files = files(library)?;
    for (path, text) in &files {
        let place = folder.join(path);
        write(&place, text).with_context(|| format!("cannot write `{}`", place.display()))?;
    }
    Ok(files.len())
}

fn write(place: &Path, text: &str) -> std::io::Result<()> {
    if let Some(folder) = place.parent() {
        fs::create_dir_all(folder)?;
    }
    fs::write(place, text)
}

/// Every file by its path below the folder.
fn files(library: &Library) -> Result<Vec<(String, String)>, Failure> {
    let (devices, faults) = super::load_all(library);
    if !faults.is_empty() {
        return Err(configuration::faults(faults).so("nothing was written"));
    }
    let mut files = vec![("README.md".to_string(), list(&devices))];
    files.extend(devices.iter().map(|device| (format!("{}.md", device.profile), page::page(device))));
    Ok(files)
}

fn list(devices: &[Device]) -> String {
    let mut text = String::from(
        "# Supported devices

<!-- Written by `busker profiles docs` from the profiles; do not edit. -->

Each page says what the device shows in Home Assistant, what to mind, and what to copy into the configuration.
Your device is not here? Its manual and an evening are enough:
[device-profiles/README.md](../../device-profiles/README.md).
",
    );
    let mut manufacturer = "";
    for device in devices {
        if device.manufacturer != manufacturer {
            manufacturer = &device.manufacturer;
            let _ = writeln!(
                text,
                "\n## {manufacturer}\n\n| Device | Main values and controls | Points |\n|---|---|---:|"
            );
        }
        let shown: Vec<String> = page::main_entities(device).into_iter().map(|(_, names)| names).collect();
        let _ = writeln!(
            text,
            "| [{}]({}.md) | {} | {} |",
            device.model,
            device.profile,
            shown.join(", "),
            device.points.len()
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    const FOLDER: &str = "docs/devices";

    #[test]
    fn the_pages_that_are_checked_in_are_the_programs_and_their_links_lead_somewhere() {
        let files = files(&Library::shipped()).expect("good profiles");
        for (path, text) in &files {
            let place = Path::new(FOLDER).join(path);
            if std::env::var_os("BLESS").is_some() {
                write(&place, text).expect("the page can be written");
            }
            let checked_in = fs::read_to_string(&place).unwrap_or_default();
            let old = place.display();
            assert!(
                checked_in == *text,
                "{old} is old; `busker profiles docs` or `make goldens` writes it anew"
            );
        }
        let known: BTreeSet<PathBuf> = files.iter().map(|(path, _)| Path::new(FOLDER).join(path)).collect();
        let mut there = BTreeSet::new();
        files_below(Path::new(FOLDER), &mut there);
        assert_eq!(there, known, "a page of no shipped profile is to be removed");
        files.iter().for_each(|(path, text)| check_links(path, text));
    }

    fn files_below(folder: &Path, found: &mut BTreeSet<PathBuf>) {
        for entry in fs::read_dir(folder).expect("the folder is there") {
            let path = entry.expect("it can be listed").path();
            if path.is_dir() {
                files_below(&path, found);
            } else {
                found.insert(path);
            }
        }
    }

    #[test]
    fn the_pages_are_written_where_they_are_wanted() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let output = folder.path().join("pages");
        write_all(&output, &Library::shipped()).expect("they are written");
        let mut there = BTreeSet::new();
        files_below(&output, &mut there);
        for (path, text) in files(&Library::shipped()).expect("good profiles") {
            let place = output.join(path);
            assert_eq!(fs::read_to_string(&place).ok(), Some(text), "{}", place.display());
            assert!(there.remove(&place));
        }
        assert!(there.is_empty(), "{there:?}");
    }

    fn check_links(path: &str, text: &str) {
        for link in text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            let there = match link.strip_prefix('#') {
                Some(heading) => text.lines().any(|line| is_heading(line, heading)),
                None => Path::new(FOLDER).join(path).with_file_name(link).exists(),
            };
            assert!(there, "{path} links to {link}, which is not there");
        }
    }

    /// Whether `line` is the heading that a link to `#heading` leads to.
    fn is_heading(line: &str, heading: &str) -> bool {
        let title = line.strip_prefix("## ").or_else(|| line.strip_prefix("### "));
        title.is_some_and(|title| title.to_lowercase().replace(' ', "-") == heading)
    }

    #[test]
    fn the_configuration_of_each_page_is_accepted_as_it_stands_and_with_its_wishes() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("busker.yaml");
        let library = Library::shipped();
        for id in library.ids() {
            let page = page::page(&library.load(id).expect("a good profile"));
            let copied = page.split("```yaml\n").nth(1).and_then(|rest| rest.split("```").next());
            let copied = copied.expect("there is something to copy");
            let with_wishes: String = copied
                .lines()
                .map(|line| line.replacen("    # ", "    ", usize::from(line.starts_with("    # "))) + "\n")
                .collect();
            assert_ne!(copied, with_wishes, "{id}");
            for text in [copied, &with_wishes] {
                fs::write(&path, text).expect("a file");
                let loaded = configuration::load(&path).expect("it can be read");
                let loaded = loaded.unwrap_or_else(|faults| panic!("{id}: {}\n{text}", faults[0]));
                assert_eq!(loaded.warnings, [], "{id}");
                let [device] = loaded.settings.devices.as_slice() else { panic!("{id}: one device") };
                assert_eq!(device.device.profile, id);
            }
        }
    }

    #[test]
    fn each_point_stands_in_the_list_of_addresses_and_each_left_out_span_with_its_reason() {
        let library = Library::shipped();
        for id in library.ids() {
            let device = library.load(id).expect("a good profile");
            let page = page::page(&device);
            let (_, list) = page.split_once("## Every point and its address\n").expect("the list");
            for point in &device.points {
                let row = format!("| `{}` | ", point.name);
                let rows: Vec<&str> = list.lines().filter(|line| line.starts_with(&row)).collect();
                let [row] = rows.as_slice() else { panic!("{id} {}: {rows:?}", point.name) };
                assert!(row.contains(&format!("| {}", point.at)), "{id} {row}");
            }
            for left_out in &device.left_out {
                let told = format!("* {}: {}\n", left_out.span, left_out.reason.trim());
                assert!(page.contains(&told), "{id} {told}");
            }
        }
    }

    #[test]
    fn what_is_not_always_there_stands_under_the_operating_modes() {
        let library = Library::shipped();
        for id in library.ids() {
            let device = library.load(id).expect("a good profile");
            let page = page::page(&device);
            let modes =
                page.split("\n## Operating modes\n").nth(1).and_then(|rest| rest.split("\n## ").next());
            let deciding = device.points.iter().flat_map(|point| &point.when);
            for condition in deciding.chain(device.things.iter().flat_map(|thing| &thing.when)) {
                let decider = &device.points[condition.point];
                let modes = modes.unwrap_or_else(|| panic!("{id} has modes"));
                for (raw, name) in &condition.values {
                    let row = |line: &str| {
                        line.starts_with(&format!("| `{name}`")) && line.contains(&format!("| {raw} |"))
                    };
                    assert!(modes.lines().any(row), "{id}: {} {name}", decider.name);
                }
            }
            for thing in &device.things {
                let told = page.lines().any(|line| line.contains(&format!("`{}`", thing.name)));
                assert!(told, "{id} {}", thing.name);
            }
        }
    }

    /// The page holds each of `expected`.
    #[track_caller]
    fn check_page(id: &str, expected: &[&str]) {
        check_page_of(&Library::shipped().load(id).expect("a good profile"), expected);
    }

    #[track_caller]
    fn check_page_of(device: &Device, expected: &[&str]) {
        let page = page::page(device);
        for expected in expected {
            assert!(page.contains(expected), "{}: {expected:?} is not in\n{page}", device.profile);
        }
    }

    /// The page of a profile that is no shipped one.
    #[track_caller]
    fn check_page_of_file(path: &str, expected: &[&str]) {
        let bytes = fs::read(path).expect("the file");
        check_page_of(&Library::shipped().check(path, &bytes).expect("a good profile"), expected);
    }

    #[test]
    fn a_page_says_what_is_there_in_which_mode_and_what_several_points_are_together() {
        check_page_of_file(
            "tests/transcripts/damper.yaml",
            &[
                "* **Selections**: Mode\n",
                "In some [operating modes](#operating-modes):\n\n* **Covers**: Damper\n* **Switches**: Relay\n",
                "* **Heartbeat.** The device wants `drive` to be written again and again, at the latest after \
                 `receive_time`",
                "### `mode`: Mode\n",
                "| `direct` | 0 |  | `relay` |\n",
                "| `motor` | 1 | cover `damper`; button `acknowledge` | `drive`, `position`, `alarm` |\n",
                "A cover, `damper`. There while `mode` is `motor`.\n",
                "on `busker/damper/damper`, is the first of these that holds:\n",
                "| `opening` | `position` is `running`, and `drive` is `open` |\n",
                "Pressed by a message on `busker/damper/acknowledge/set`:\n",
                "| `press` | `open` to `drive` (1 in holding 1), then `ok` to `alarm` (1 in holding 3) |\n",
                "shows `drive`, `position` as part of it and not by themselves.",
                "| part of `damper` | `mode` is `motor` |  | `open`, `close` | yes, read back after 100 ms, repeated by busker \
                 within `receive_time` | holding 1 |",
            ],
        );
    }

    #[test]
    fn a_page_says_what_is_an_event_what_is_fetched_and_what_one_register_makes_of_another() {
        check_page_of_file(
            "tests/transcripts/blind.yaml",
            &[
                "`busker/blind/pressed` gets `{\"event_type\":\"pressed\"}`",
                "| `pressed` | `pressed` | input 0.0 |\n",
                "yes, the same again with `locked` between",
                "yes, read back after 600 ms, at coil 2..3 | discrete 8..9 |",
            ],
        );
        check_page_of_file(
            "tests/transcripts/recorder.yaml",
            &[
                "send an empty message to `busker/recorder/curve/get`",
                "| `curve` | 5 V | 2 | `recording` is `stopped` | input 10..14 |\n",
                "as the point that `of` names: [table 1](#table-1)",
            ],
        );
    }

    #[test]
    fn a_page_says_what_the_manual_says() {
        check_page(
            "metz-connect/mr-do4",
            &[
                "# METZ CONNECT MR-DO4\n",
                "expects `METZ CONNECT GmbH` and `MR-DO4`",
                "* **Switches**: Relay 1 to 4\n",
                "* **Watchdog.** `watchdog` is a time.",
                "From the factory it is 0 s.",
                "* **EEPROM.** 5 settings",
                "| A question must lie within | coil 0..7; holding 0..1; holding 66 |",
                "| 8 points every 500 ms, 5 points every 30 s |",
                "| `watchdog` | Watchdog time | number | s | 0 to 655.35 in steps of 0.01 | 0 | yes | EEPROM | holding 66 |",
                "| `relay_3` | Relay 3 | coil 2, also holding 0.2 |",
            ],
        );
        check_page(
            "metz-connect/mr-ai8",
            &[
                "| as `channel_N_code` says: [table 1](#table-1) |",
                "| `pt100_integer` | 129 | °C or °F, as `temperature_unit` says | -50 to 150 in steps of 0.1 |",
                // An offset may be as large as the measuring range is wide.
                "| `pt100_integer` | 129 | °C or °F, as `temperature_unit` says | -200 to 200 in steps of 0.1 |",
            ],
        );
        check_page(
            "fuehlersysteme/relay8",
            &[
                "it reads input 0 and expects 20480",
                "* **Buttons act at once** and ask nothing back: `relay_1_release` to `relay_8_release`, `release_all`,",
                "| An answer is awaited | at least 300 ms; longer if the bus says so |",
                "| A value out of range | the device takes the nearest",
                "| Relay 1 to 8 | binary sensor | `ON`, `OFF` |  | no | input 1 to 8, also input 9.0 to 9.7 |",
                "| 0 to 255; or `automatic` | `automatic` |",
                "| a letter and a number, as `R017` | `S000` |",
            ],
        );
        check_page(
            "metz-connect/mr-si4",
            &["`meter_N_decimals` says how many digits stand behind the dot", "yes, with function 16 only"],
        );
    }
}
