//! `busker simulate`: simulated devices on pseudo-terminals and sockets.

use std::io::BufRead;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Context;

use super::profiles::load_file;
use super::{Failure, output};
use crate::edge::shutdown::Signals;
use crate::engine::time::Duration;
use crate::simulator::device::parse_unit;
use crate::simulator::script::{parse_duration, parse_script};
use crate::simulator::{DeviceAt, Fault, Framing, LineSettings, Options, Parity, Plain, Simulation, Told};

/// Serve simulated devices, as their manuals describe them
///
/// The devices share one line: each answers its own unit. What they measure is changed by commands,
/// from a script or as lines on standard input; what their outputs do is told on standard output.
///
/// A device of `--profile` follows no manual: its registers hold what is written or set, within the
/// rules of the profile.
#[derive(Debug, clap::Args)]
#[command(after_help = help())]
pub struct Args {
    /// The devices, each with its unit: `metz-connect/mr-do4@18`
    #[arg(value_name = "PROFILE@UNIT", required_unless_present = "profile")]
    devices: Vec<DeviceAt>,
    /// A device that is nothing but this profile, with its unit: `my-device.yaml@5`
    #[arg(long, value_name = "FILE@UNIT", value_parser = profile_at)]
    profile: Vec<(PathBuf, u8)>,
    /// Serve RTU on a pseudo-terminal, with a symbolic link to it here
    #[arg(long, value_name = "LINK", required_unless_present_any = ["tcp", "rtu_over_tcp"])]
    pty: Vec<PathBuf>,
    /// Serve Modbus TCP here; port 0 takes a free one
    #[arg(long, value_name = "ADDRESS:PORT")]
    tcp: Vec<String>,
    /// Serve RTU over TCP here, as serial servers do; port 0 takes a free one
    #[arg(long, value_name = "ADDRESS:PORT")]
    rtu_over_tcp: Vec<String>,
    /// The line's bit rate: how long the silence between frames is
    #[arg(long, value_name = "RATE", default_value_t = 19200, value_parser = clap::value_parser!(u32).range(300..=1_000_000))]
    baud: u32,
    /// The line's parity: even, odd or none
    #[arg(long, default_value = "even", value_parser = parity)]
    parity: Parity,
    /// How long a device thinks before it replies
    #[arg(long, value_name = "TIME", default_value = "5ms", value_parser = parse_duration)]
    turnaround: Duration,
    /// Let requests and replies take the time that they would take on a wire
    #[arg(long)]
    paced: bool,
    /// Let the bit rate and parity count that a program sets at the pseudo-terminal, as on a wire: a device with
    /// others hears noise. Parity is seen of programs that check it (INPCK), as `busker scan` and `busker line` do
    #[arg(long)]
    heed_settings: bool,
    /// Keep the EEPROMs in this directory
    #[arg(long, value_name = "DIR")]
    state_dir: Option<PathBuf>,
    /// Misbehave: `unit=19,silent`, `garbled,every=3`; see below
    #[arg(long, value_name = "FAULT")]
    fault: Vec<Fault>,
    /// Do the commands of this file at their times
    #[arg(long, value_name = "FILE")]
    script: Option<PathBuf>,
}

fn help() -> String {
    use crate::simulator::{Model, fault::KINDS, script::COMMANDS};
    let profiles = Model::ALL.map(|model| format!("  {model}\n")).concat();
    format!(
        "Devices:\n{profiles}\n\
         Commands, in a script and on standard input:\n{COMMANDS}\n\
         Faults, each for all units or with `unit=N`, for all requests or with `every=N`:\n  {KINDS}\n\n\
         Example:\n  \
         busker simulate metz-connect/mr-do4@18 metz-connect/mr-ai8@19 --pty /tmp/line --tcp 127.0.0.1:1502\n  \
         and then, on its standard input:\n  \
         unit 18 relay 2 hand on\n  \
         at 5s unit 19 input 1 ohms 107.8\n\n\
         A profile of one's own beside them, and a reading of it:\n  \
         busker simulate metz-connect/mr-do4@18 --profile my-device.yaml@19 --pty /tmp/line\n  \
         unit 19 set 'input 0' 215"
    )
}

fn profile_at(text: &str) -> Result<(PathBuf, u8), String> {
    let (file, unit) = text
        .rsplit_once('@')
        .ok_or_else(|| format!("`{text}` names no unit; write it as `my-device.yaml@5`"))?;
    Ok((file.into(), parse_unit(unit)?))
}

fn parity(name: &str) -> Result<Parity, String> {
    Parity::from_name(name).ok_or_else(|| "a parity is `even`, `odd` or `none`".into())
}

/// Serves until interrupted.
pub fn run(args: Args) -> Result<(), Failure> {
    let steps = match &args.script {
        Some(path) => {
            let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
            parse_script(&text).map_err(|errors| {
                let place = path.display();
                let faults = errors.iter().map(|(line, error)| format!("{place}:{line}: {error}")).collect();
                Failure::Faults { faults, so: Some("nothing was started") }
            })?
        }
        None => Vec::new(),
    };
    let plain = |(file, unit): &(PathBuf, u8)| Ok((Plain::new(load_file(file)?), *unit));
    let profiles = args.profile.iter().map(plain).collect::<Result<Vec<_>, Failure>>()?;
    let options = Options {
        line: LineSettings { baud: args.baud, parity: args.parity },
        turnaround: args.turnaround,
        paced: args.paced,
        heeds_settings: args.heed_settings,
        state_dir: args.state_dir,
        faults: args.fault,
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    // Before the first door is open: whoever has read its address may end this at once.
    let mut signals = runtime.block_on(async { Signals::listen() })?;
    let simulation =
        Simulation::with_profiles(&args.devices, profiles, options).map_err(Failure::wrong_input)?;
    simulation.listen(tell);
    let mut doors: Vec<Box<dyn std::any::Any>> = Vec::new();
    for link in args.pty {
        let port = simulation.serve_pty(Some(link))?;
        output::print(&format!("pty {}\n", port.path().display()))?;
        doors.push(Box::new(port));
    }
    let addresses = args.tcp.iter().map(|address| ("tcp", address, Framing::Tcp));
    let rtu = args.rtu_over_tcp.iter().map(|address| ("rtu_over_tcp", address, Framing::Rtu));
    for (name, address, framing) in addresses.chain(rtu) {
        let port = simulation.serve_tcp(address, framing)?;
        output::print(&format!("{name} {}\n", port.address()))?;
        doors.push(Box::new(port));
    }
    simulation.run_script(steps).map_err(Failure::wrong_input)?;
    let simulation = Arc::new(simulation);
    obey_standard_input(&simulation)?;
    runtime.block_on(signals.wait());
    Ok(())
}

fn tell(told: &Told) {
    match told {
        // Who reads no more loses nothing but lines about what he asked for himself.
        Told::Event(event) => drop(output::print(&format!("{event}\n"))),
        Told::Problem(problem) => eprintln!("error: {problem}"),
    }
}

/// Does each line of standard input. The thread ends with it, or with the program.
fn obey_standard_input(simulation: &Arc<Simulation>) -> anyhow::Result<()> {
    let simulation = Arc::downgrade(simulation);
    std::thread::Builder::new().name("standard input".into()).spawn(move || {
        for line in std::io::stdin().lock().lines() {
            let (Ok(line), Some(simulation)) = (line, simulation.upgrade()) else { return };
            if let Err(error) = simulation.command(&line) {
                eprintln!("error: {error}");
            }
        }
    })?;
    Ok(())
}
