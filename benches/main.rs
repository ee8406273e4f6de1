//! `make bench`: the release build against paced wires, each figure a ratio to what is possible.
//!
//! Options: `--rows W1,W8` runs only these, `--quick` takes about a minute. A full run writes
//! `docs/performance.md`; every run writes `target/bench.json`.

mod clock;
mod cores;
mod frames;
mod machine;
mod mqtt;
#[allow(dead_code, reason = "the soak uses the rest")]
mod program;
mod report;
mod rows;
mod tcp;
mod wire;

use std::path::Path;
use std::process::Command;

use anyhow::{Context, bail};

use crate::report::Report;
use crate::rows::{Bench, ROWS};

fn main() -> anyhow::Result<()> {
    let mut quick = false;
    let mut wanted: Vec<String> = Vec::new();
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--quick" => quick = true,
            "--rows" => {
                let names = arguments.next().context("`--rows` wants names like W1,W8")?;
                wanted.extend(names.split(',').filter(|name| !name.is_empty()).map(str::to_lowercase));
            }
            other => bail!("`{other}` is neither `--quick` nor `--rows`"),
        }
    }
    if let Some(unknown) = wanted.iter().find(|name| !ROWS.iter().any(|row| row.0.to_lowercase() == **name)) {
        let known: Vec<&str> = ROWS.iter().map(|row| row.0).collect();
        bail!("there is no row `{unknown}`; the rows are {}", known.join(", "));
    }
    let is_full = wanted.is_empty() && !quick;
    program::program()?;

    let mut report = Report { machine: machine::description(), commit: commit(), ..Report::default() };
    let chosen: Vec<_> =
        ROWS.iter().filter(|row| wanted.is_empty() || wanted.contains(&row.0.to_lowercase())).collect();
    let began_at = clock::now();
    for (number, (name, what, run)) in chosen.iter().enumerate() {
        eprintln!(
            "[{:3.0} s] {}/{} {name}: {what}",
            clock::seconds_since(began_at),
            number + 1,
            chosen.len()
        );
        let mut bench = Bench::new(quick, &mut report);
        if let Err(error) = run(&mut bench) {
            eprintln!("        {name} was not measured to its end: {error:#}");
            bench.failed(name, &error);
        }
    }
    println!("{}\n{}", report.machine, report.table());

    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folder = program::program()?.parent().and_then(Path::parent).context("a target folder")?.to_owned();
    std::fs::write(folder.join("bench.json"), format!("{:#}\n", report.json()))?;
    if is_full {
        std::fs::write(root.join("docs/performance.md"), report.document())?;
    }
    eprintln!("[{:3.0} s] done", clock::seconds_since(began_at));
    Ok(())
}

/// What was measured.
fn commit() -> String {
    let git = |arguments: &[&str]| {
        let output =
            Command::new("git").arg("-C").arg(env!("CARGO_MANIFEST_DIR")).args(arguments).output().ok()?;
        output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_string())
    };
    let commit = git(&["rev-parse", "--short", "HEAD"]).unwrap_or_else(|| "unknown".into());
    let changed =
        git(&["status", "--porcelain", "src", "Cargo.lock"]).is_some_and(|changes| !changes.is_empty());
    if changed { format!("{commit} with changes") } else { commit }
}
