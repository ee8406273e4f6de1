//! `busker demo`: simulated devices, a broker and the gateway in one process and its one child.

mod broker;
mod screen;
mod world;

use std::io::{ErrorKind, IsTerminal};
use std::net::SocketAddr;
use std::time::Duration;

use anyhow::{Context, bail};
use tokio::runtime::Runtime;
use tokio::signal::unix::{Signal, SignalKind, signal};

use super::{Failure, log};
use crate::edge::app::App;
use crate::edge::state_files::StateFiles;
use crate::engine::configuration;
use crate::engine::profile::Library;
use crate::engine::settings::Settings;
use crate::simulator::{DeviceAt, Model, Options, PtyPort, Simulation};
use broker::Mosquitto;
use screen::Screen;
use world::World;

/// Show all of it without hardware
///
/// Starts simulated devices on pseudo-terminals, a mosquitto on a free port and the gateway, and shows
/// what the devices say. Ends on interrupt, with everything that it has started.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:\n  busker demo --http 127.0.0.1:8485\n  busker demo --all")]
pub struct Args {
    /// Every device that there is, on three lines, instead of four devices on two
    #[arg(long)]
    all: bool,
    /// Where the broker listens, instead of a free port
    #[arg(long, value_name = "ADDRESS:PORT")]
    mqtt: Option<SocketAddr>,
    /// Where HTTP listens, instead of a free port
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:0")]
    http: SocketAddr,
}

/// The lines of a demo of few devices, each with the devices on it.
const FEW: [(&str, &[Model]); 2] =
    [("basement", &[Model::MrDo4, Model::MrAi8, Model::MrSi4]), ("attic", &[Model::Relay8])];

/// The lines of a demo of all devices, which are dealt to them in turn.
const LINES_OF_ALL: [&str; 3] = ["basement", "attic", "plant"];

/// The first device's unit; each further one has the next.
const FIRST_UNIT: u8 = 18;

/// How often the world moves on and the screen is looked at.
const TICK: Duration = Duration::from_millis(250);

pub fn run(args: Args) -> Result<(), Failure> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    // From here on a signal ends nothing by itself, so that nothing that is started is left behind.
    let mut stop = runtime.block_on(async { Stop::listen() })?;

    // A log would write across the table.
    if !std::io::stdout().is_terminal() {
        log::start();
    }
    let lines = start_lines(args.all)?;
    let mut mosquitto = Mosquitto::start(args.mqtt)?;
    let settings = settings(&lines, mosquitto.address(), args.http)?;
    let mut screen = Screen::new(&settings, &mosquitto);
    let app = App::start(settings, Library::shipped(), StateFiles::nowhere())?;
    let outcome = show(&runtime, &mut stop, &lines, &mut mosquitto, &app, &mut screen);
    app.stop();
    mosquitto.stop();
    screen.leave();
    Ok(outcome?)
}

/// Goes on until a signal comes, the reader of the output has gone, or the broker has ended.
fn show(
    runtime: &Runtime,
    stop: &mut Stop,
    lines: &[Line],
    mosquitto: &mut Mosquitto,
    app: &App,
    screen: &mut Screen,
) -> anyhow::Result<()> {
    let mut world = World::default();
    let mut ticks = runtime.block_on(async { tokio::time::interval(TICK) });
    let mut written = screen.begin(app.http_address());
    loop {
        match written {
            Err(error) if error.kind() == ErrorKind::BrokenPipe => return Ok(()),
            other => other.context("the screen cannot be written")?,
        }
        let stopped = runtime.block_on(async {
            tokio::select! {
                () = stop.wait() => true,
                _ = ticks.tick() => false,
            }
        });
        if stopped {
            return Ok(());
        }
        if let Some(last_words) = mosquitto.has_ended() {
            bail!("mosquitto has ended: {last_words}");
        }
        world.go_on(TICK, lines)?;
        written = screen.show(&app.report());
    }
}

fn start_lines(all: bool) -> anyhow::Result<Vec<Line>> {
    let on_lines: Vec<(&str, Vec<Model>)> = if all {
        let dealt = |line: usize| Model::ALL.into_iter().skip(line).step_by(LINES_OF_ALL.len()).collect();
        LINES_OF_ALL.into_iter().enumerate().map(|(line, name)| (name, dealt(line))).collect()
    } else {
        FEW.iter().map(|(name, models)| (*name, models.to_vec())).collect()
    };
    let mut units = FIRST_UNIT..;
    on_lines
        .into_iter()
        .map(|(name, models)| {
            Line::start(
                name,
                models.into_iter().zip(&mut units).map(|(model, unit)| DeviceAt { model, unit }).collect(),
            )
        })
        .collect()
}

/// The configuration, as a person would write it for these devices.
fn settings(lines: &[Line], broker: SocketAddr, http: SocketAddr) -> anyhow::Result<Settings> {
    let mut text = format!("mqtt: {{url: 'mqtt://{broker}'}}\nhttp: {{listen: '{http}'}}\n");
    text.push_str("buses:\n");
    for line in lines {
        text.push_str(&format!("  {}: {{serial: {}}}\n", line.name, line.port.path().display()));
    }
    text.push_str("devices:\n");
    for line in lines {
        for device in &line.devices {
            let (name, id) = (device_name(device.model), device.model.id());
            let entry = format!("  {name}: {{profile: {id}, bus: {}, unit: {}}}\n", line.name, device.unit);
            text.push_str(&entry);
        }
    }
    match configuration::load("demo", text.as_bytes(), &Library::shipped()) {
        Ok((settings, _)) => Ok(settings),
        Err(faults) => {
            let faults: Vec<String> = faults.iter().map(ToString::to_string).collect();
            bail!("the demo's own configuration is faulty:\n{}", faults.join("\n"))
        }
    }
}

/// `metz-connect/mr-do4` → `metz_connect_mr_do4`.
fn device_name(model: Model) -> String {
    model.id().replace(['/', '-'], "_")
}

/// One simulated line and what is on it.
struct Line {
    name: &'static str,
    devices: Vec<DeviceAt>,
    simulation: Simulation,
    port: PtyPort,
}

impl Line {
    fn start(name: &'static str, devices: Vec<DeviceAt>) -> anyhow::Result<Line> {
        // The times of a real wire, so that what is seen is what hardware would do.
        let options = Options { paced: true, ..Options::default() };
        let simulation = Simulation::new(&devices, options)?;
        let port = simulation.serve_pty(None)?;
        Ok(Line { name, devices, simulation, port })
    }
}

/// The signals that end the demo: an interrupt, a request to terminate, a closed terminal.
struct Stop {
    signals: [Signal; 3],
}

impl Stop {
    /// Only within a runtime.
    fn listen() -> std::io::Result<Stop> {
        let kinds = [SignalKind::interrupt(), SignalKind::terminate(), SignalKind::hangup()];
        let [interrupt, terminate, hangup] = kinds.map(signal);
        Ok(Stop { signals: [interrupt?, terminate?, hangup?] })
    }

    async fn wait(&mut self) {
        let [interrupt, terminate, hangup] = &mut self.signals;
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
            _ = hangup.recv() => {}
        }
    }
}
