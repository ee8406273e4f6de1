//! The bus on simulated time: each transcript is what happens to a bus and all that it does about it.
//!
//! A line is a time and a text. `happens` lines are the input; the test plays them and writes the
//! whole transcript anew; it must equal the file. `BLESS=1` rewrites the files; read the diff.

mod devices;
mod fairness;
mod play;
mod properties;

use std::path::PathBuf;

#[test]
fn every_transcript_is_as_it_was() {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/transcripts");
    let mut files: Vec<PathBuf> = std::fs::read_dir(&folder)
        .expect("the folder of transcripts")
        .map(|entry| entry.expect("a directory entry").path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "txt"))
        .collect();
    files.sort();
    assert!(files.len() >= 10, "transcripts are missing from {}", folder.display());
    let mut changed = Vec::new();
    for file in files {
        let before = std::fs::read_to_string(&file).expect("a readable transcript");
        let after = play::replay(&before);
        if let Some(wrong) = after.lines().find(|line| line.contains("WRONG")) {
            changed.push(format!("{}: {wrong}", file.display()));
        }
        if before != after {
            if std::env::var_os("BLESS").is_some() {
                std::fs::write(&file, &after).expect("a writable transcript");
            } else {
                changed.push(format!("{}\n{}", file.display(), first_difference(&before, &after)));
            }
        }
    }
    assert!(changed.is_empty(), "{}", changed.join("\n\n"));
}

fn first_difference(before: &str, after: &str) -> String {
    let numbered = before.lines().zip(after.lines()).enumerate();
    let (number, (was, is)) = numbered
        .into_iter()
        .find(|(_, (was, is))| was != is)
        .unwrap_or((before.lines().count().min(after.lines().count()), ("(end)", "(more lines)")));
    format!("line {}:\n  was: {was}\n  is:  {is}", number + 1)
}
