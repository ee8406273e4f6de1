//! `make soak`: a life of faults in real time. The built program stands between a paced serial line, a
//! Modbus TCP server and a real mosquitto, all of which misbehave; afterwards every published value is one
//! that its device told in answer to the request under way, every command has exactly one outcome, and
//! neither memory nor threads nor descriptors have grown.
//!
//! Options: `--minutes N` (10 unless said), `--seed N` (by chance unless said, and printed). Writes
//! `soak.json` beside the program's folder.

mod check;
#[path = "../clock.rs"]
#[allow(dead_code, reason = "the benchmark uses the rest")]
mod clock;
#[path = "../../tests/soak/device.rs"]
#[allow(dead_code, reason = "the soak on simulated time uses the rest")]
mod device;
#[path = "../../tests/soak/faults.rs"]
mod faults;
mod gate;
mod leak;
mod life;
mod line;
#[path = "../machine.rs"]
#[allow(dead_code, reason = "the benchmark uses the rest")]
mod machine;
#[path = "../mqtt.rs"]
#[allow(dead_code, reason = "the benchmark uses the rest")]
mod mqtt;
mod points;
#[path = "../program.rs"]
#[allow(dead_code, reason = "the benchmark uses the rest")]
mod program;

use anyhow::{Context, bail};

use crate::life::Life;

const MINUTES: f64 = 10.0;

fn main() -> anyhow::Result<()> {
    let (mut minutes, mut seed) = (MINUTES, fastrand::u64(1..1_000_000));
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut number = || arguments.next().with_context(|| format!("`{argument}` wants a number"));
        match argument.as_str() {
            "--minutes" => minutes = number()?.parse().context("`--minutes` wants a number")?,
            "--seed" => seed = number()?.parse().context("`--seed` wants a whole number")?,
            other => bail!("`{other}` is neither `--minutes` nor `--seed`"),
        }
    }
    if !(0.5..=10_000.0).contains(&minutes) {
        bail!("{minutes} minutes; expected at least half a minute");
    }
    let program = program::program()?;
    println!("{}\n{minutes} minutes with seed {seed}: {}", machine::description(), program.display());
    let report = Life::begin(seed)?.live(minutes * 60.0)?;
    let folder = program.parent().and_then(std::path::Path::parent).context("a target folder")?;
    std::fs::write(folder.join("soak.json"), format!("{:#}\n", report.json))?;
    println!("{}", report.text);
    if !report.faults.is_empty() {
        bail!("{} things were wrong (seed {seed}): {:#?}", report.faults.len(), report.faults);
    }
    Ok(())
}
