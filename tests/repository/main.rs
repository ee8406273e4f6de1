//! What stands in the repository beside the program is true: the README's commands, the start
//! configuration, its schema, the service unit.

mod guide;
mod seldom;
#[path = "../support/mod.rs"]
mod support;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Who runs each command that README.md shows.
const README_COMMANDS: &[(&str, RunBy)] = &[
    ("make demo", RunBy::Test("tests/demo/main.rs")),
    ("make test", RunBy::Gate),
    ("cargo build --release", RunBy::Gate),
    ("busker check --config deploy/busker.yaml", RunBy::Here),
];

enum RunBy {
    /// This file.
    Here,
    /// `.ci/run`
    Gate,
    /// Another test, which names it in its first lines.
    Test(&'static str),
}

#[test]
fn every_command_of_the_readme_is_run_by_a_test() {
    let readme = read("README.md");
    let mut shown = Vec::new();
    for block in readme.split("```sh\n").skip(1) {
        let block = block.split("```").next().expect("split gives at least one part");
        shown.extend(block.lines().filter(|line| !line.trim().is_empty()));
    }
    let known: Vec<&str> = README_COMMANDS.iter().map(|(command, _)| *command).collect();
    assert_eq!(shown, known);
    for (command, by) in README_COMMANDS {
        match by {
            RunBy::Here => {
                let arguments: Vec<&str> = command.split(' ').skip(1).collect();
                good(&busker(&arguments));
            }
            RunBy::Test(file) => assert!(read(file).contains(command), "{file} does not run `{command}`"),
            RunBy::Gate => assert!(read(".ci/run").contains(command), ".ci/run does not run `{command}`"),
        }
    }
}

#[test]
fn the_links_of_the_documents_lead_somewhere() {
    let documents =
        ["README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "deploy/README.md", "device-profiles/README.md"];
    let in_docs = ["docs", "docs/decisions"].map(|folder| {
        let files = std::fs::read_dir(root().join(folder)).expect("the folder is there");
        files.map(move |file| format!("{folder}/{}", file.expect("a file").file_name().to_string_lossy()))
    });
    let in_docs = in_docs.into_iter().flatten().filter(|name| name.ends_with(".md"));
    for document in documents.map(String::from).into_iter().chain(in_docs) {
        let text = read(&document);
        for link in text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            let target = link.split('#').next().unwrap_or_default();
            if !target.is_empty() && !target.contains("://") {
                let path = root().join(&document).with_file_name(target);
                assert!(path.exists(), "{document} links to {target}, which is not there");
            }
        }
    }
}

#[test]
fn the_start_configuration_is_accepted_also_with_every_comment_taken_away() {
    let text = read("deploy/busker.yaml");
    let mut uncommented = String::new();
    let mut examples = 0;
    for line in text.lines() {
        let indentation = line.len() - line.trim_start().len();
        match line.trim_start().strip_prefix("# ") {
            Some(comment) if is_an_entry(comment) => {
                examples += 1;
                uncommented.push_str(&format!("{}{comment}\n", &line[..indentation]));
            }
            _ => uncommented.push_str(&format!("{line}\n")),
        }
    }
    assert!(examples > 10, "only {examples} commented entries were found");
    let folder = tempfile::tempdir().expect("a temporary folder");
    // The folder of the example does not exist on every machine.
    let uncommented = uncommented.replace("/etc/busker/device-profiles", "profiles");
    fs::create_dir(folder.path().join("profiles")).expect("a folder");
    let path = folder.path().join("busker.yaml");
    fs::write(&path, uncommented).expect("a file");
    good(&busker(&["check", "--config", &path.display().to_string()]));
}

/// Whether a comment is an entry that was commented out: `username: busker`.
fn is_an_entry(comment: &str) -> bool {
    let key = comment.trim_start().split(':').next().unwrap_or_default();
    comment.contains(": ") && key.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_')
        || comment == "points:"
}

#[test]
fn the_schema_of_the_configuration_is_up_to_date() {
    let output = busker(&["check", "--schema"]);
    good(&output);
    let generated = String::from_utf8(output.stdout).expect("JSON is UTF-8");
    let path = root().join("deploy/busker.schema.json");
    if std::env::var_os("BLESS").is_some() {
        fs::write(&path, &generated).expect("the schema can be written");
    }
    let stored = fs::read_to_string(&path).unwrap_or_default();
    assert!(stored == generated, "deploy/busker.schema.json is out of date; run `make goldens`");
}

#[test]
fn systemd_accepts_the_service_unit() {
    let analyze = Command::new("systemd-analyze").arg("--version").output();
    if analyze.is_err() {
        eprintln!("no systemd-analyze here: the unit is not verified");
        return;
    }
    let unit = read("systemd/busker.service");
    // The program need not be installed for the unit to be right.
    let here = unit.replace("/usr/bin/busker", env!("CARGO_BIN_EXE_busker"));
    assert_ne!(here, unit, "the unit starts /usr/bin/busker");
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("busker.service");
    fs::write(&path, here).expect("a file");
    let output = Command::new("systemd-analyze").args(["verify", "--man=no"]).arg(&path).output();
    let output = output.expect("systemd-analyze runs");
    // A word that it does not understand is a line on standard error and no failure.
    let about_the_unit: Vec<String> = String::from_utf8_lossy(&output.stderr)
        .lines()
        .filter(|line| line.contains("busker.service"))
        .map(str::to_string)
        .collect();
    assert!(output.status.success() && about_the_unit.is_empty(), "{about_the_unit:?} {output:?}");
}

#[test]
fn every_verb_helps_with_an_example_and_refuses_what_it_does_not_know() {
    let help = busker(&["--help"]);
    good(&help);
    let help = String::from_utf8(help.stdout).expect("help is UTF-8");
    let verbs: Vec<&str> = help
        .split("Commands:\n")
        .nth(1)
        .expect("verbs are listed")
        .lines()
        .take_while(|line| line.starts_with("  "))
        .filter_map(|line| line.split_whitespace().next())
        .collect();
    assert!(verbs.contains(&"check"), "{verbs:?}");
    for verb in verbs {
        let help = busker(&[verb, "--help"]);
        good(&help);
        let text = String::from_utf8_lossy(&help.stdout).into_owned();
        assert!(text.contains(&format!("busker {verb}")) && text.contains("Example"), "{verb}: {text}");
        let refused = busker(&[verb, "--no-such-option"]);
        assert_eq!(refused.status.code(), Some(2), "{verb}");
        assert!(refused.stdout.is_empty(), "{verb}");
    }
    assert_eq!(busker(&["no-such-verb"]).status.code(), Some(2));
}

fn busker(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_busker"))
        .args(arguments)
        .current_dir(root())
        .output()
        .expect("the program starts")
}

fn good(output: &Output) {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).to_path_buf()
}

fn read(path: &str) -> String {
    fs::read_to_string(root().join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}
