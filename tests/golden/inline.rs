//! A device whose points stand in the configuration takes every word of a profile.

use std::fs;
use std::path::{Path, PathBuf};

use busker::engine::configuration;
use busker::engine::profile::Library;

/// What a profile says of the device and what a device of the configuration does not say.
const OF_PROFILES_ONLY: [&str; 7] =
    ["device:", "manufacturer:", "model:", "source:", "identify:", "line:", "left_out:"];

#[test]
fn a_device_of_the_configuration_is_what_a_profile_with_the_same_words_is() {
    let mut files = Vec::new();
    for folder in ["device-profiles", "tests/transcripts"] {
        profiles_below(&Path::new(env!("CARGO_MANIFEST_DIR")).join(folder), &mut files);
    }
    assert!(files.iter().any(|file| file.ends_with("damper.yaml")), "{files:?}");
    for file in files {
        let text = fs::read_to_string(&file).expect("a profile");
        let shown = file.display().to_string();
        let expected = Library::shipped().check(&shown, text.as_bytes()).expect("a good profile");
        let configuration = format!(
            "buses: {{plant: {{tcp: 'h:502'}}}}\ndevices:\n  pump:\n    bus: plant\n    unit: 1\n{}",
            sections_of_a_device(&text)
        );
        let loaded = configuration::load(&shown, configuration.as_bytes(), &Library::shipped());
        let (settings, _) = loaded.unwrap_or_else(|faults| panic!("{}\n{configuration}", faults[0]));
        let device = &settings.devices[0].device;
        assert_eq!(device.points, expected.points, "{shown}");
        assert_eq!(device.things, expected.things, "{shown}");
        assert_eq!(device.wire, expected.wire, "{shown}");
    }
}

/// `points`, `things`, `wire` and `home_assistant` of a profile, as they stand under a device.
fn sections_of_a_device(profile: &str) -> String {
    let mut text = String::new();
    let mut is_wanted = false;
    for line in profile.lines() {
        let begins_section = line.starts_with(|c: char| c.is_ascii_lowercase());
        if begins_section {
            is_wanted = !OF_PROFILES_ONLY.iter().any(|key| line.starts_with(key));
        }
        if is_wanted {
            text.push_str(&format!("    {line}\n"));
        }
    }
    text
}

/// Every profile, but not the files that profiles share.
fn profiles_below(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).expect("the folder is there") {
        let path = entry.expect("it can be listed").path();
        if path.is_dir() && !path.ends_with("shared") {
            profiles_below(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "yaml") {
            found.push(path);
        }
    }
}
