//! The guide to the form of profiles does what it says: each of its blocks is added to the file, loads
//! without a fault, and the program says what the guide shows.
//!
//! `BLESS=1` rewrites what is shown, and the file that the guide ends with.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Stdio};

use busker::engine::profile::Library;
use serde_json::Value;
use tempfile::TempDir;

use crate::support::find;
use crate::{read, root};

const GUIDE: &str = "device-profiles/README.md";
/// What all blocks are together.
const WHOLE: &str = "docs/acme-vc2.yaml";
const PROFILE: &str = "acme/vc2.yaml";
/// Where the guide's simulation listens; in the test it is a free port.
const ADDRESS: &str = "127.0.0.1:1502";

#[test]
fn every_step_of_the_guide_to_profiles_works_as_it_is_shown() {
    let text = read(GUIDE);
    let mut reader = Reader::new();
    let mut rewritten = String::new();
    let mut parts = text.split("\n```");
    rewritten.push_str(parts.next().unwrap_or_default());
    while let (Some(block), outside) = (parts.next(), parts.next()) {
        let (info, inside) = block.split_once('\n').unwrap_or((block, ""));
        let shown = reader.follow(info, &format!("{inside}\n"));
        rewritten.push_str(&format!("\n```{info}\n{}\n```", shown.trim_end()));
        rewritten.push_str(outside.unwrap_or_default());
    }
    let whole = profile_to_text(&reader.profile);
    if std::env::var_os("BLESS").is_some() {
        fs::write(root().join(GUIDE), &rewritten).expect("the guide can be written");
        fs::write(root().join(WHOLE), &whole).expect("the file can be written");
        return;
    }
    for (shown, now) in text.lines().zip(rewritten.lines()) {
        assert_eq!(shown, now, "{GUIDE} shows something else; `make goldens` rewrites it");
    }
    assert_eq!(text, rewritten);
    assert!(read(WHOLE) == whole, "{WHOLE} is not what the guide ends with; `make goldens` rewrites it");
    let device = Library::shipped().check(WHOLE, whole.as_bytes()).expect("a good profile");
    assert!(device.points.len() > 30 && !device.things.is_empty(), "{device:?}");
}

#[test]
fn the_reference_has_every_word_of_the_form() {
    let schema: Value = serde_json::from_str(&read("device-profiles/profile.schema.json")).expect("JSON");
    let mut words = Vec::new();
    keys_of(&schema, &mut words);
    assert!(words.len() > 60, "{words:?}");
    let text = read(GUIDE);
    let (_, reference) = text.split_once("\n# Reference\n").expect("the reference");
    for word in words {
        // `word`, `word: value`, `{word: value, …}`, `{…, word: value}`
        let is_told =
            [format!("`{word}`"), format!("`{word}: "), format!("{{{word}: "), format!(", {word}: ")];
        assert!(is_told.iter().any(|told| reference.contains(told)), "`{word}` is not in the reference");
    }
}

/// The keys of all maps with keys of their own.
fn keys_of(schema: &Value, found: &mut Vec<String>) {
    match schema {
        Value::Object(map) => {
            for (key, value) in map {
                if let ("properties", Value::Object(properties)) = (key.as_str(), value) {
                    found.extend(properties.keys().cloned());
                }
                keys_of(value, found);
            }
        }
        Value::Array(list) => list.iter().for_each(|value| keys_of(value, found)),
        _ => {}
    }
}

/// Somebody who does what the guide says.
struct Reader {
    folder: TempDir,
    profile: Vec<Entry>,
    simulation: Option<Simulation>,
}

impl Reader {
    fn new() -> Reader {
        let folder = tempfile::tempdir().expect("a temporary folder");
        fs::create_dir(folder.path().join("acme")).expect("a folder");
        Reader { folder, profile: Vec::new(), simulation: None }
    }

    /// Does what one block says; returns it with what the program said.
    fn follow(&mut self, info: &str, inside: &str) -> String {
        match info {
            "yaml" if inside.contains("\nbuses:") || inside.starts_with("buses:") => {
                let here = self.with_address(inside);
                self.write("my-busker.yaml", &here);
                let (good, said) = self.busker("check --config my-busker.yaml");
                assert!(good, "{said}\n{inside}");
            }
            "yaml" => {
                merge(&mut self.profile, tree(inside));
                self.write(PROFILE, &profile_to_text(&self.profile));
                let (good, said) = self.busker(&format!("profiles check {PROFILE}"));
                assert!(good, "{said}\n{}", profile_to_text(&self.profile));
            }
            "yaml wrong" => {
                let mut wrong = self.profile.clone();
                merge(&mut wrong, tree(inside));
                self.write(PROFILE, &profile_to_text(&wrong));
                let (good, _) = self.busker(&format!("profiles check {PROFILE}"));
                assert!(!good, "this is said to be wrong:\n{inside}");
            }
            "sh" => self.simulation = Some(Simulation::start(self.folder.path(), inside.trim())),
            "text" => {
                let simulation = self.simulation.as_mut().expect("a simulation is running");
                simulation.input.write_all(inside.as_bytes()).expect("it listens");
            }
            "console" => return self.talk(inside),
            other => panic!("a block of {other}, which this test does not know"),
        }
        inside.to_string()
    }

    fn write(&self, path: &str, text: &str) {
        fs::write(self.folder.path().join(path), text).expect("a file");
    }

    fn with_address(&self, text: &str) -> String {
        match &self.simulation {
            Some(simulation) => text.replace(ADDRESS, &simulation.address),
            None => text.to_string(),
        }
    }

    /// Gives the commands again and returns them with their answers.
    fn talk(&self, inside: &str) -> String {
        let mut told = String::new();
        for exchange in inside.split("$ busker ").skip(1) {
            let (command, shown) = exchange.split_once('\n').unwrap_or((exchange, ""));
            let here = self.with_address(command);
            // What was typed into a simulation may come a moment later.
            let same = || Some(self.busker(&here).1).filter(|said| said.trim_end() == shown.trim_end());
            let said = match &self.simulation {
                Some(_) if std::env::var_os("BLESS").is_none() => find(same),
                _ => same(),
            };
            let said = said.unwrap_or_else(|| self.busker(&here).1);
            told.push_str(&format!("$ busker {command}\n{said}"));
        }
        told
    }

    /// Whether the program is content, and what it says.
    fn busker(&self, arguments: &str) -> (bool, String) {
        let output = Command::new(env!("CARGO_BIN_EXE_busker"))
            .args(words(arguments))
            .current_dir(self.folder.path())
            .output()
            .expect("the program starts");
        let said = [output.stdout, output.stderr].concat();
        (output.status.success(), String::from_utf8(said).expect("text"))
    }
}

/// The words of a command line, in which single quotes keep words together.
fn words(line: &str) -> Vec<String> {
    let mut words = Vec::new();
    for (at, part) in line.split('\'').enumerate() {
        match at % 2 {
            0 => words.extend(part.split_whitespace().map(str::to_string)),
            _ => words.push(part.to_string()),
        }
    }
    words
}

/// `busker simulate` on a free port.
struct Simulation {
    child: Child,
    input: ChildStdin,
    address: String,
}

impl Simulation {
    fn start(folder: &Path, command: &str) -> Simulation {
        let arguments = command.strip_prefix("busker ").expect("a command of this program");
        let mut child = Command::new(env!("CARGO_BIN_EXE_busker"))
            .args(words(&arguments.replace(ADDRESS, "127.0.0.1:0")))
            .current_dir(folder)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("the program starts");
        let input = child.stdin.take().expect("it was asked for");
        let mut lines = BufReader::new(child.stdout.take().expect("it was asked for")).lines();
        let first = lines.next().expect("it says where it listens").expect("text");
        let address = first.strip_prefix("tcp ").expect("an address").to_string();
        Simulation { child, input, address }
    }
}

impl Drop for Simulation {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A key of a block of YAML with what belongs to it, as text.
#[derive(Clone, Debug)]
struct Entry {
    key: String,
    /// Comments before it, and its own line.
    lines: Vec<String>,
    /// Entries below it, or lines that are none.
    below: Below,
}

#[derive(Clone, Debug)]
enum Below {
    Entries(Vec<Entry>),
    Lines(Vec<String>),
}

/// The entries of `text`, which all begin in the first column.
fn tree(text: &str) -> Vec<Entry> {
    let mut entries: Vec<Entry> = Vec::new();
    let mut comments = Vec::new();
    let mut below: Vec<Vec<String>> = Vec::new();
    for line in text.lines().filter(|line| !line.trim().is_empty()) {
        if line.starts_with('#') {
            comments.push(line.to_string());
        } else if line.starts_with(' ') {
            below.last_mut().expect("an entry comes first").push(line[2..].to_string());
        } else {
            let key = line.split(':').next().unwrap_or_default().to_string();
            let lines = std::mem::take(&mut comments).into_iter().chain([line.to_string()]).collect();
            entries.push(Entry { key, lines, below: Below::Lines(Vec::new()) });
            below.push(Vec::new());
        }
    }
    for (entry, below) in entries.iter_mut().zip(below) {
        let own = entry.lines.last().map_or("", |line| line.split(" #").next().unwrap_or_default());
        let is_map = own.trim_end().ends_with(':') && below.first().is_some_and(|line| begins_an_entry(line));
        entry.below = match is_map {
            true => Below::Entries(tree(&below.join("\n"))),
            false => Below::Lines(below),
        };
    }
    entries
}

fn begins_an_entry(line: &str) -> bool {
    line.starts_with('#') || line.starts_with(|c: char| c.is_ascii_alphabetic())
}

/// Adds `new` to `old`; what has the same name takes its place, or joins it if both hold entries.
fn merge(old: &mut Vec<Entry>, new: Vec<Entry>) {
    for entry in new {
        let Some(known) = old.iter_mut().find(|known| known.key == entry.key) else {
            old.push(entry);
            continue;
        };
        match (&mut known.below, entry) {
            (Below::Entries(old), Entry { below: Below::Entries(new), .. }) => merge(old, new),
            (_, entry) => *known = entry,
        }
    }
}

fn tree_to_text(entries: &[Entry]) -> String {
    let mut text = String::new();
    for entry in entries {
        text.push_str(&(entry.lines.join("\n") + "\n"));
        let below = match &entry.below {
            Below::Entries(entries) => tree_to_text(entries),
            Below::Lines(lines) => lines.iter().map(|line| format!("{line}\n")).collect(),
        };
        text.extend(below.lines().map(|line| format!("  {line}\n")));
    }
    text
}

/// A whole profile, its sections in their usual order.
fn profile_to_text(profile: &[Entry]) -> String {
    const SECTIONS: [&str; 5] = ["wire", "points", "things", "left_out", "home_assistant"];
    let place = |entry: &Entry| SECTIONS.iter().position(|section| *section == entry.key);
    let head: Vec<Entry> = profile.iter().filter(|entry| place(entry).is_none()).cloned().collect();
    let mut sections: Vec<&Entry> = profile.iter().filter(|entry| place(entry).is_some()).collect();
    sections.sort_by_key(|entry| place(entry));
    let sections =
        sections.into_iter().map(|entry| format!("\n{}", tree_to_text(std::slice::from_ref(entry))));
    tree_to_text(&head) + &sections.collect::<String>()
}
