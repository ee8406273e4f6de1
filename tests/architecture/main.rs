//! The rules of the source tree that the compiler does not hold: who may use whom, what the engine
//! may not touch, how a file begins and how long it may grow.

use std::fs;
use std::path::{Path, PathBuf};

/// The modules of the engine in the order of the data's way: each uses only modules before it.
/// Within a paragraph of `engine/mod.rs` rustfmt sorts the names; the order within is this one.
const ENGINE_ORDER: &[&[&str]] = &[
    &["time", "value", "address"],
    &[
        "yaml",
        "device",
        "test_device",
        "codec",
        "units",
        "keys",
        "settings",
        "profile",
        "wanted",
        "configuration",
    ],
    &["modbus", "recorder", "plan", "pace", "schedule"],
    &["identity", "scan", "line_change", "state"],
    &["topics", "health", "feed", "homeassistant", "outbox", "connection"],
    &["members", "transaction", "command", "memory", "upkeep", "arrivals", "request", "bus", "reload"],
];

/// What would let the engine wait, ask the time, open something, or answer differently from run to
/// run. Whole words only.
const NOT_IN_THE_ENGINE: &[(&str, &str)] = &[
    ("std::fs", "the engine opens nothing"),
    ("std::io", "the engine reads and writes nothing"),
    ("std::net", "the engine opens nothing"),
    ("std::thread", "the engine runs where it is called"),
    ("std::process", "the engine never ends the program"),
    ("std::env", "the engine knows only what it is told"),
    ("tokio", "the engine never awaits"),
    ("rustix", "the engine opens nothing"),
    ("async", "the engine never awaits"),
    ("await", "the engine never awaits"),
    ("Instant", "time comes in as an argument"),
    ("SystemTime", "time comes in as an argument"),
    ("HashMap", "its order differs from run to run; use BTreeMap"),
    ("HashSet", "its order differs from run to run; use BTreeSet"),
    ("println", "the engine says things by returning them"),
    ("eprintln", "the engine says things by returning them"),
];

/// Files that may hold `unsafe`, each with its reason above it. The list only shrinks.
const UNSAFE_ALLOWED: &[&str] = &["src/edge/link/driver.rs"];

/// A simulated device that is nothing but its profile, and so no second reading of a manual.
const READS_PROFILES: &str = "src/simulator/plain";

/// A longer file has more than one job.
const LINES_MAX: usize = 700;

#[test]
fn an_engine_module_uses_only_modules_before_it() {
    let order: Vec<&str> = ENGINE_ORDER.iter().copied().flatten().copied().collect();
    let mut faults = Vec::new();
    for file in rust_files("src/engine") {
        let Some(own) = engine_module(&file.path) else { continue };
        let Some(own_rank) = order.iter().position(|module| *module == own) else {
            faults.push(format!("{}: `{own}` has no place in the order", file.path.display()));
            continue;
        };
        for (number, line) in file.code_lines() {
            for used in engine_modules_used(line) {
                match order.iter().position(|module| *module == used) {
                    Some(rank) if rank <= own_rank => {}
                    Some(_) => faults.push(format!(
                        "{}:{number}: `{own}` uses `{used}`, which comes after it",
                        file.path.display()
                    )),
                    None => faults.push(format!("{}:{number}: unknown module `{used}`", file.path.display())),
                }
            }
        }
    }
    none(&faults);
}

#[test]
fn the_door_of_the_engine_names_the_modules_in_that_order() {
    let text = fs::read_to_string(root().join("src/engine/mod.rs")).expect("the engine's door is readable");
    let mut paragraphs: Vec<Vec<&str>> = vec![Vec::new()];
    let shipped = text.lines().filter(|line| *line != "pub mod test_device;");
    for line in shipped {
        if let Some(module) = line.strip_prefix("pub mod ").and_then(|rest| rest.strip_suffix(';')) {
            paragraphs.last_mut().expect("there is always one").push(module);
        } else if line.is_empty() {
            paragraphs.push(Vec::new());
        }
    }
    paragraphs.retain(|modules| !modules.is_empty());
    let sorted: Vec<Vec<&str>> = ENGINE_ORDER
        .iter()
        .map(|modules| {
            let mut modules: Vec<&str> =
                modules.iter().copied().filter(|module| *module != "test_device").collect();
            modules.sort_unstable();
            modules
        })
        .collect();
    assert_eq!(paragraphs, sorted);
}

#[test]
fn the_engine_has_no_way_to_wait_to_open_or_to_ask_the_time() {
    let mut faults = Vec::new();
    for file in rust_files("src/engine") {
        for (number, line) in file.code_lines() {
            for (word, reason) in NOT_IN_THE_ENGINE {
                if has_word(line, word) {
                    faults.push(format!("{}:{number}: `{word}`: {reason}", file.path.display()));
                }
            }
        }
    }
    none(&faults);
}

#[test]
fn the_edge_and_the_simulator_are_not_used_by_what_lies_below_them() {
    let mut faults = Vec::new();
    for (folder, strangers) in [
        ("src/engine", ["crate::edge", "crate::simulator", "crate::cli"].as_slice()),
        ("src/edge", ["crate::simulator", "crate::cli"].as_slice()),
        // A second reading of the manuals, not of the profiles.
        ("src/simulator", ["crate::engine::profile", "crate::engine::device", "crate::cli"].as_slice()),
    ] {
        for file in rust_files(folder) {
            if file.path.to_string_lossy().starts_with(READS_PROFILES) {
                continue;
            }
            for (number, line) in file.code_lines() {
                for stranger in strangers {
                    if line.contains(stranger) {
                        faults.push(format!("{}:{number}: `{stranger}` is used", file.path.display()));
                    }
                }
            }
        }
    }
    none(&faults);
}

#[test]
fn every_file_says_its_job_first() {
    let silent = all_rust_files().into_iter().filter(|file| !file.text.starts_with("//! "));
    none(
        &silent.map(|file| format!("{} does not begin with `//! `", file.path.display())).collect::<Vec<_>>(),
    );
}

#[test]
fn no_source_file_has_more_than_one_job() {
    let long = rust_files("src").into_iter().filter(|file| file.text.lines().count() > LINES_MAX);
    none(
        &long
            .map(|file| format!("{} is longer than {LINES_MAX} lines", file.path.display()))
            .collect::<Vec<_>>(),
    );
}

#[test]
fn nothing_is_unsafe() {
    let unsafe_keyword = concat!("un", "safe");
    let mut faults = Vec::new();
    for file in all_rust_files() {
        if UNSAFE_ALLOWED.iter().any(|allowed| file.path == Path::new(allowed)) {
            continue;
        }
        for (number, line) in file.code_lines() {
            // The lint's name as well: a file that allows it is one that may hold it.
            if has_word(line, unsafe_keyword) || has_word(line, &format!("{unsafe_keyword}_code")) {
                faults.push(format!("{}:{number}: {line}", file.path.display()));
            }
        }
    }
    none(&faults);
}

#[test]
fn the_scans_find_what_they_look_for() {
    assert!(has_word("use std::fs;", "std::fs"));
    assert!(has_word("pub async fn wait()", "async"));
    assert!(!has_word("let asynchronous = 1;", "async"));
    assert!(!has_word("let instant_answer = Instants;", "Instant"));
    assert_eq!(engine_modules_used("use crate::engine::yaml::Node;"), ["yaml"]);
    assert_eq!(engine_modules_used("use crate::engine::{address::Span, codec};"), ["address", "codec"]);
    assert_eq!(engine_modules_used("    let x = crate::engine::plan::plan(device);"), ["plan"]);
    assert_eq!(engine_module(Path::new("src/engine/modbus/rtu.rs")), Some("modbus".to_string()));
    assert_eq!(engine_module(Path::new("src/engine/mod.rs")), None);
}

struct SourceFile {
    /// From the root of the repository.
    path: PathBuf,
    text: String,
}

impl SourceFile {
    /// Numbered lines without comments. Texts in quotes are kept: none of the words has a reason to
    /// stand in one.
    fn code_lines(&self) -> impl Iterator<Item = (usize, &str)> {
        self.text
            .lines()
            .enumerate()
            .map(|(index, line)| (index + 1, line.split("//").next().unwrap_or_default()))
            .filter(|(_, line)| !line.trim().is_empty())
    }
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn all_rust_files() -> Vec<SourceFile> {
    let mut files = rust_files("src");
    files.extend(rust_files("tests"));
    files
}

fn rust_files(folder: &str) -> Vec<SourceFile> {
    let mut files = Vec::new();
    let mut folders = vec![root().join(folder)];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).expect("a folder of the repository is readable") {
            let path = entry.expect("an entry of it as well").path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let text = fs::read_to_string(&path).expect("a source file is UTF-8");
                let path = path.strip_prefix(root()).expect("it lies in the repository").to_path_buf();
                files.push(SourceFile { path, text });
            }
        }
    }
    assert!(!files.is_empty(), "no source file found in {folder}");
    files.sort_by(|a, b| a.path.cmp(&b.path));
    files
}

/// The module of the engine that a file belongs to, its tests included; `None` for the engine's own `mod.rs`.
fn engine_module(path: &Path) -> Option<String> {
    let inside = path.strip_prefix("src/engine").expect("a file of the engine");
    let first = Path::new(inside.components().next()?.as_os_str());
    let name = first.file_stem()?.to_str()?;
    // `plan_tests.rs` is the part of `plan.rs` that tests it.
    let name = name.strip_suffix("_tests").unwrap_or(name);
    if name == "mod" { None } else { Some(name.to_string()) }
}

/// The modules of the engine named in one line, in `crate::engine::a::…` or `crate::engine::{a, b::c}`.
fn engine_modules_used(line: &str) -> Vec<String> {
    let mut used = Vec::new();
    for (at, path) in line.match_indices("crate::engine::") {
        let rest = &line[at + path.len()..];
        match rest.strip_prefix('{') {
            Some(list) => {
                used.extend(list.split(['}', ';']).next().unwrap_or_default().split(',').map(first_word))
            }
            None => used.push(first_word(rest)),
        }
    }
    used.retain(|module| !module.is_empty());
    used
}

fn first_word(text: &str) -> String {
    text.trim().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect()
}

/// Whether `word` stands in `line` with no letter, digit or underscore beside it.
fn has_word(line: &str, word: &str) -> bool {
    let part_of_a_name = |c: char| c.is_alphanumeric() || c == '_';
    line.match_indices(word).any(|(at, _)| {
        !line[..at].chars().next_back().is_some_and(part_of_a_name)
            && !line[at + word.len()..].chars().next().is_some_and(part_of_a_name)
    })
}

fn none(faults: &[String]) {
    assert!(faults.is_empty(), "\n{}\n", faults.join("\n"));
}
