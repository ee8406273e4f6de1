//! Whatever a slip of the fingers makes of a good file: loading it ends, without a panic, and each
//! fault begins with a place that is in the file.

use std::fs;

use busker::engine::configuration;
use busker::engine::profile::Library;
use busker::engine::yaml::Diagnostic;
use proptest::prelude::*;

/// What gets typed where it does not belong.
const TYPED: &[&str] = &[
    "",
    " ",
    "\n",
    "\t",
    ":",
    ": ",
    "- ",
    "#",
    "[",
    "]",
    "{",
    "}",
    ",",
    "\"",
    "'",
    "|\n",
    ">",
    "&a ",
    "*a",
    "!",
    "%",
    "@",
    "?",
    "<<: ",
    "---\n",
    "...",
    "null",
    "~",
    "-1",
    "65536",
    "99999999999999999999999",
    "0x",
    "1e99",
    "..",
    "1..8",
    "1 bit",
    "°",
    "\u{2028}",
    "\u{85}",
    "\r\n",
    "\r",
    "\u{0}",
    "\u{feff}",
    "for: 1..999\n",
    "coil 65535",
    "input 0.15",
    "u64",
    "text 125",
    "shared/measuring",
];

fn files() -> Vec<Vec<u8>> {
    let mut files: Vec<Vec<u8>> = Vec::new();
    for path in [
        "device-profiles/metz-connect/mr-do4.yaml",
        "device-profiles/metz-connect/mr-ai8.yaml",
        "device-profiles/metz-connect/mr-si4.yaml",
        "device-profiles/fuehlersysteme/relay8.yaml",
        "tests/bad-profiles/many-faults-at-once/profile.yaml",
        "tests/bad-configs/many-faults/busker.yaml",
    ] {
        files.push(fs::read(path).expect("a file of the project"));
    }
    files
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_input_makes_the_loading_panic(
        file in 0usize..6,
        edits in prop::collection::vec((any::<prop::sample::Index>(), 0usize..12, 0usize..TYPED.len()), 1..6),
    ) {
        let mut bytes = files().remove(file);
        for (at, removed, typed) in edits {
            let at = at.index(bytes.len() + 1);
            let end = (at + removed).min(bytes.len());
            bytes.splice(at..end, TYPED[typed].bytes());
        }
        let library = Library::shipped();
        let lines = bytes.split(|byte| *byte == b'\n').count();
        let faults = [
            library.check("f.yaml", &bytes).err().unwrap_or_default(),
            configuration::load("f.yaml", &bytes, &library).err().unwrap_or_default(),
        ];
        for fault in faults.concat() {
            prop_assert!(is_in_the_file(&fault, lines), "{fault}");
        }
    }
}

/// `f.yaml:LINE:COLUMN: message`, the line with its number, and a caret under it.
fn is_in_the_file(fault: &Diagnostic, lines: usize) -> bool {
    let shown = fault.to_string();
    let shown: Vec<&str> = shown.split('\n').collect();
    let line = fault.place.line();
    let is_placed = fault.place.file() != "f.yaml" || (1..=lines).contains(&line);
    is_placed
        && shown.len() == 5
        && shown[0].starts_with(&format!("{}: ", fault.place))
        && shown[2].starts_with(&format!("{line} |"))
        && shown[3].trim_end().ends_with('^')
}
