//! The strangers: where they are, and how they are run.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Mutex;

/// The Python that has pymodbus; `None` where it cannot be had.
pub fn pymodbus() -> Option<PathBuf> {
    get("get-pymodbus", "pymodbus")
}

/// mbpoll; `None` where it cannot be had.
pub fn mbpoll() -> Option<PathBuf> {
    get("get-mbpoll", "mbpoll")
}

/// A file of this folder.
pub fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/strangers").join(name)
}

fn get(script: &str, name: &str) -> Option<PathBuf> {
    // Two tests at once would fill the same folder.
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
    let _guard = ONE_AT_A_TIME.lock();
    let output = Command::new(file(script)).stderr(Stdio::inherit()).output().expect("a script that starts");
    if output.status.success() {
        let path = String::from_utf8(output.stdout).expect("a path");
        return Some(PathBuf::from(path.trim()));
    }
    assert!(std::env::var("CI").as_deref() != Ok("true"), "{name} cannot be had, and CI is true");
    eprintln!(
        "NOT TESTED: {name} cannot be had here (tests/strangers/{script} failed): this test shows nothing"
    );
    None
}
