//! Faulty files and exactly what is said of them: one folder per fault, holding the file and
//! `error.txt`. Adding a fault is adding a folder; `BLESS=1 cargo test --test bad_inputs` writes the
//! messages, which a person then reads.

mod anything;

use std::fs;
use std::path::{Path, PathBuf};

use busker::engine::configuration;
use busker::engine::profile::Library;
use busker::engine::yaml::Diagnostic;

#[test]
fn each_fault_of_a_profile_is_told_in_these_words() {
    check_folders("tests/bad-profiles", |folder| {
        let mut library = Library::shipped();
        for (path, bytes) in files_below(&folder.join("shared")) {
            let shown = format!("shared/{path}");
            library.add(&shown, &shown, bytes);
        }
        let bytes = fs::read(folder.join("profile.yaml")).expect("a profile.yaml");
        library.check("profile.yaml", &bytes).err().map(|faults| rendered(&faults))
    });
}

#[test]
fn each_fault_of_a_configuration_is_told_in_these_words() {
    check_folders("tests/bad-configs", |folder| {
        let bytes = fs::read(folder.join("busker.yaml")).expect("a busker.yaml");
        configuration::load("busker.yaml", &bytes, &Library::shipped()).err().map(|faults| rendered(&faults))
    });
}

/// Compares what `faults_of` says of each folder with the folder's `error.txt`; `None` is a file
/// without a fault, which has no place here.
fn check_folders(parent: &str, faults_of: impl Fn(&Path) -> Option<String>) {
    let bless = std::env::var_os("BLESS").is_some();
    let mut folders: Vec<PathBuf> = fs::read_dir(parent)
        .expect("the folder of faults")
        .map(|entry| entry.expect("an entry").path())
        .filter(|path| path.is_dir())
        .collect();
    folders.sort();
    assert!(!folders.is_empty(), "no faults below {parent}");
    let mut wrong = Vec::new();
    for folder in folders {
        let Some(found) = faults_of(&folder) else {
            wrong.push(format!("{}: not refused", folder.display()));
            continue;
        };
        let error = folder.join("error.txt");
        if bless {
            fs::write(&error, &found).expect("error.txt is written");
        }
        let expected = fs::read_to_string(&error).unwrap_or_default();
        if found != expected {
            wrong.push(format!("{}:\n--- expected\n{expected}--- found\n{found}", folder.display()));
        }
    }
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
}

/// As a person sees them, with an empty line between two.
fn rendered(faults: &[Diagnostic]) -> String {
    faults.iter().map(Diagnostic::to_string).collect::<Vec<_>>().join("\n")
}

fn files_below(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let Ok(entries) = fs::read_dir(folder) else { return Vec::new() };
    entries
        .map(|entry| entry.expect("an entry").path())
        .map(|path| {
            let name = path.file_name().expect("a name").to_string_lossy().into_owned();
            (name, fs::read(&path).expect("a file"))
        })
        .collect()
}
