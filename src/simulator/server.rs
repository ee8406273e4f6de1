//! Serves simulated devices on pseudo-terminals and sockets, on plain threads.
//!
//! ```no_run
//! use busker::simulator::{DeviceAt, Model, Options, Simulation};
//! let devices = [DeviceAt { model: Model::MrDo4, unit: 18 }];
//! let simulation = Simulation::new(&devices, Options::default())?;
//! let line = simulation.serve_pty(None)?;
//! println!("open {}", line.path().display());
//! simulation.command("unit 18 relay 1 hand on")?;
//! # Ok::<(), anyhow::Error>(())
//! ```

use std::collections::VecDeque;
use std::fmt;
use std::path::PathBuf;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use anyhow::{Context, anyhow};

use crate::edge::clock::Clock;
use crate::engine::time::{Duration, Time};
use crate::simulator::device::{DeviceAt, LineSettings, Place, Stimulus};
use crate::simulator::fault::Fault;
use crate::simulator::line::{Line, Transmission};
use crate::simulator::plain::Plain;
use crate::simulator::port::{PtyPort, TcpPort};
use crate::simulator::script::{Action, Step, parse_line};
use crate::simulator::store::Store;
use crate::simulator::wire::{Framing, Received};

/// How the line behaves.
#[derive(Clone, Debug)]
pub struct Options {
    pub line: LineSettings,
    /// From the end of a request to the beginning of its reply.
    pub turnaround: Duration,
    /// Whether requests and replies take the time that they would take on a wire of this bit rate.
    pub paced: bool,
    /// Whether the bit rate and parity that a program sets at a pseudo-terminal count, as on a wire: a device
    /// with others hears noise.
    pub heeds_settings: bool,
    /// Where the EEPROMs are kept; `None`: they are forgotten at the end.
    pub state_dir: Option<PathBuf>,
    pub faults: Vec<Fault>,
}

impl Default for Options {
    fn default() -> Options {
        Options {
            line: LineSettings::default(),
            turnaround: Duration::from_millis(5),
            paced: false,
            heeds_settings: false,
            state_dir: None,
            faults: Vec::new(),
        }
    }
}

/// A change that a person in front of a device would see.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Event {
    pub device: Place,
    /// `relay_1`.
    pub output: String,
    /// `ON`.
    pub state: String,
}

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {} {}", self.device, self.output, self.state)
    }
}

/// Simulated devices on one line that may have several doors. Dropping it stops its clockwork; each
/// door is stopped by dropping its own handle.
pub struct Simulation {
    shared: Arc<Shared>,
    clockwork: Option<JoinHandle<()>>,
}

impl Simulation {
    /// Switches the devices on. Errors: a unit that is there twice, a fault of a unit that is not
    /// there, a stored EEPROM that cannot be read.
    pub fn new(devices: &[DeviceAt], options: Options) -> anyhow::Result<Simulation> {
        Simulation::with_profiles(devices, Vec::new(), options)
    }

    /// The same, with devices that are nothing but their profiles, each at its unit.
    pub fn with_profiles(
        devices: &[DeviceAt],
        profiles: Vec<(Plain, u8)>,
        options: Options,
    ) -> anyhow::Result<Simulation> {
        let clock = Clock::start();
        let now = clock.now();
        let mut line = Line::new(now, options.line, options.turnaround, options.paced, devices)
            .map_err(|error| anyhow!(error))?;
        for (device, unit) in profiles {
            let at = Place { device: device.id().into(), unit };
            line.add(at, Box::new(device)).map_err(|error| anyhow!(error))?;
        }
        let mut store = match &options.state_dir {
            Some(directory) => Some(Store::open(directory).with_context(|| directory.display().to_string())?),
            None => None,
        };
        if let Some(store) = &mut store {
            for unit in line.units_mut() {
                if let Some(words) = store.load(&unit.at).with_context(|| format!("EEPROM of {}", unit.at))? {
                    unit.device
                        .load_eeprom(now, &words)
                        .map_err(|error| anyhow!("EEPROM of {}: {error}", unit.at))?;
                }
            }
        }
        for fault in &options.faults {
            line.add_fault(now, fault).map_err(|error| anyhow!(error))?;
        }
        line.changed_outputs();
        let shared = Arc::new(Shared {
            clock,
            heeds_settings: options.heeds_settings,
            state: Mutex::new(State {
                line,
                store,
                script: VecDeque::new(),
                stopping: false,
                listener: None,
            }),
            wake: Condvar::new(),
        });
        let for_clockwork = Arc::clone(&shared);
        let clockwork = std::thread::Builder::new()
            .name("simulator clockwork".into())
            .spawn(move || for_clockwork.run_clockwork())?;
        Ok(Simulation { shared, clockwork: Some(clockwork) })
    }

    /// Serves RTU on a new pseudo-terminal; its terminal side is at the handle's `path`, which is
    /// `link` where one is given (a symbolic link, removed at the end).
    pub fn serve_pty(&self, link: Option<PathBuf>) -> anyhow::Result<PtyPort> {
        PtyPort::open(Arc::clone(&self.shared), link)
    }

    /// Serves Modbus TCP ([`Framing::Tcp`]) or RTU over TCP ([`Framing::Rtu`]) at `address`; with
    /// port 0 a free port is taken, which the handle's `address` tells.
    pub fn serve_tcp(&self, address: &str, framing: Framing) -> anyhow::Result<TcpPort> {
        TcpPort::open(Arc::clone(&self.shared), address, framing)
    }

    /// Does what one line of a script says, now or at its time.
    pub fn command(&self, line: &str) -> anyhow::Result<()> {
        match parse_line(line).map_err(|error| anyhow!(error))? {
            Some(step) => self.run_script(vec![step]),
            None => Ok(()),
        }
    }

    /// Does the steps, those without a delay at once; errors of later ones go to the listener.
    pub fn run_script(&self, steps: Vec<Step>) -> anyhow::Result<()> {
        let now = self.shared.clock.now();
        let mut state = self.shared.lock();
        for step in steps {
            if step.after.is_zero() {
                state.line.act(now, &step.action).map_err(|error| anyhow!(error))?;
            } else {
                state.script.push_back((now + step.after, step.action));
            }
        }
        state.script.make_contiguous().sort_by_key(|(at, _)| *at);
        state.settle();
        drop(state);
        self.shared.wake.notify_all();
        Ok(())
    }

    /// Changes the process side of a unit.
    pub fn stimulate(&self, unit: u8, stimulus: Stimulus) -> anyhow::Result<()> {
        self.run_script(vec![Step { after: Duration::ZERO, action: Action::Stimulate { unit, stimulus } }])
    }

    /// What a person in front of the unit sees now, by name: `relay_1` `ON`.
    pub fn outputs(&self, unit: u8) -> anyhow::Result<Vec<(String, String)>> {
        let mut state = self.shared.lock();
        state.line.advance(self.shared.clock.now());
        Ok(state.line.unit(unit).map_err(|error| anyhow!(error))?.device.outputs())
    }

    /// Calls `listener` with each change at an output, and with errors of scripts, as a text.
    pub fn listen(&self, listener: impl Fn(&Told) + Send + 'static) {
        self.shared.lock().listener = Some(Box::new(listener));
    }
}

impl Drop for Simulation {
    fn drop(&mut self) {
        self.shared.lock().stopping = true;
        self.shared.wake.notify_all();
        if let Some(clockwork) = self.clockwork.take() {
            // A clockwork that has panicked has told so already.
            let _ = clockwork.join();
        }
    }
}

/// What a listener is told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Told {
    Event(Event),
    /// A step of a script could not be done, or an EEPROM not be stored.
    Problem(String),
}

impl fmt::Display for Told {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Told::Event(event) => write!(f, "{event}"),
            Told::Problem(problem) => write!(f, "{problem}"),
        }
    }
}

/// What the doors and the clockwork share.
pub(super) struct Shared {
    pub(super) clock: Clock,
    pub(super) heeds_settings: bool,
    state: Mutex<State>,
    wake: Condvar,
}

type Listener = Box<dyn Fn(&Told) + Send>;

struct State {
    line: Line,
    store: Option<Store>,
    /// In the order of their times.
    script: VecDeque<(Time, Action)>,
    stopping: bool,
    listener: Option<Listener>,
}

/// How often the devices age while nobody asks them: watchdogs expire and say so.
const TICK: Duration = Duration::from_millis(50);

impl Shared {
    pub(super) fn line_settings(&self) -> LineSettings {
        self.lock().line.settings()
    }

    /// Takes what came through a door, and gives what goes back through it.
    pub(super) fn hear(
        &self,
        framing: Framing,
        received: &Received,
        sent_with: Option<LineSettings>,
    ) -> Vec<Transmission> {
        let mut state = self.lock();
        let transmissions = state.line.hear(self.clock.now(), framing, received, sent_with);
        state.settle();
        transmissions
    }

    fn run_clockwork(&self) {
        let mut state = self.lock();
        while !state.stopping {
            let now = self.clock.now();
            while state.script.front().is_some_and(|(at, _)| *at <= now) {
                if let Some((_, action)) = state.script.pop_front() {
                    if let Err(problem) = state.line.act(now, &action) {
                        state.tell(&Told::Problem(problem));
                    }
                }
            }
            state.line.advance(now);
            state.settle();
            let pause = match state.script.front() {
                Some((at, _)) => TICK.min(self.clock.until(*at)),
                None => TICK,
            };
            let waited = self.wake.wait_timeout(state, pause);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// A panic in one door must not stop the others: the state is whole between two calls.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    /// Tells what has changed, and stores what shall outlive the program.
    fn settle(&mut self) {
        for (device, output, state) in self.line.changed_outputs() {
            self.tell(&Told::Event(Event { device, output, state }));
        }
        let mut problems = Vec::new();
        if let Some(store) = &mut self.store {
            for unit in self.line.units() {
                if let Err(error) = store.save(&unit.at, &unit.device.eeprom()) {
                    problems.push(Told::Problem(format!("EEPROM of {}: {error}", unit.at)));
                }
            }
        }
        problems.iter().for_each(|problem| self.tell(problem));
    }

    fn tell(&self, told: &Told) {
        if let Some(listener) = &self.listener {
            listener(told);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};
    use std::net::TcpStream;

    use super::*;
    use crate::simulator::device::Model;
    use crate::simulator::wire::Frame;

    fn mr_do4() -> Simulation {
        let devices = [DeviceAt { model: Model::MrDo4, unit: 18 }];
        Simulation::new(&devices, Options::default()).expect("a simulation")
    }

    fn exchange(stream: &mut (impl Read + Write), framing: Framing, pdu: &[u8], reply: &[u8]) {
        let frame = |pdu: &[u8]| Frame { transaction: 0, unit: 18, pdu: pdu.to_vec() }.encode(framing);
        stream.write_all(&frame(pdu)).expect("sent");
        let wanted = frame(reply);
        let mut got = vec![0; wanted.len()];
        stream.read_exact(&mut got).expect("a reply");
        assert_eq!(got, wanted);
    }

    #[test]
    fn a_device_is_served_on_a_pseudo_terminal_and_on_sockets_at_once() {
        let directory = tempfile::tempdir().expect("a directory");
        let link = directory.path().join("line");
        let simulation = mr_do4();
        let mut pty = simulation.serve_pty(Some(link.clone())).expect("a pseudo-terminal");
        let tcp = simulation.serve_tcp("127.0.0.1:0", Framing::Tcp).expect("a socket");
        let rtu = simulation.serve_tcp("127.0.0.1:0", Framing::Rtu).expect("a socket");

        let mut line = std::fs::File::options().read(true).write(true).open(&link).expect("the line");
        exchange(&mut line, Framing::Rtu, &[5, 0, 1, 0xFF, 0], &[5, 0, 1, 0xFF, 0]);
        let mut stream = TcpStream::connect(tcp.address()).expect("connected");
        exchange(&mut stream, Framing::Tcp, &[1, 0, 0, 0, 4], &[1, 1, 2]);
        let mut stream = TcpStream::connect(rtu.address()).expect("connected");
        exchange(&mut stream, Framing::Rtu, &[1, 0, 0, 0, 4], &[1, 1, 2]);

        assert_eq!(simulation.outputs(18).expect("unit 18")[1], ("relay_2".into(), "ON".into()));
        pty.unplug();
        assert!(!link.exists());
        assert!(matches!(line.read(&mut [0; 8]), Ok(0) | Err(_)), "a hang-up");
        pty.replug().expect("a pseudo-terminal");
        let mut line = std::fs::File::options().read(true).write(true).open(&link).expect("the line");
        exchange(&mut line, Framing::Rtu, &[1, 0, 0, 0, 4], &[1, 1, 2]);
        drop(pty);
        assert!(!link.exists());
    }

    #[test]
    fn commands_act_at_once_or_later_and_the_listener_is_told() {
        let simulation = mr_do4();
        let (sender, told) = std::sync::mpsc::channel();
        simulation.listen(move |what| sender.send(what.to_string()).expect("somebody listens"));
        simulation.command("at 30ms unit 18 relay 9 hand on").expect("a command");
        simulation.command("unit 18 relay 1 hand on").expect("a command");
        let patience = Duration::from_secs(10);
        let next = || told.recv_timeout(patience).expect("to be told");
        assert_eq!(next(), "metz-connect/mr-do4@18 relay_1 ON");
        assert_eq!(next(), "metz-connect/mr-do4@18 hand_1 ON");
        assert_eq!(next(), "relay 9 is not there; MR-DO4 has 1 to 4");
        let error = simulation.command("unit 19 restart").unwrap_err();
        assert_eq!(error.to_string(), "unit 19 is not on this line; there are 18");
    }

    #[test]
    fn an_eeprom_in_a_state_directory_outlives_the_simulation() {
        let directory = tempfile::tempdir().expect("a directory");
        let options = || Options { state_dir: Some(directory.path().join("state")), ..Options::default() };
        let devices = [DeviceAt { model: Model::MrDo4, unit: 18 }];
        let simulation = Simulation::new(&devices, options()).expect("a simulation");
        let tcp = simulation.serve_tcp("127.0.0.1:0", Framing::Tcp).expect("a socket");
        let mut stream = TcpStream::connect(tcp.address()).expect("connected");
        exchange(&mut stream, Framing::Tcp, &[6, 0, 1, 0, 8], &[6, 0, 1, 0, 8]);
        drop((tcp, simulation));

        let simulation = Simulation::new(&devices, options()).expect("a simulation");
        assert_eq!(simulation.outputs(18).expect("unit 18")[3], ("relay_4".into(), "ON".into()));
        drop(simulation);
        let file = directory.path().join("state/metz-connect_mr-do4@18.eeprom");
        std::fs::write(&file, "zz").expect("written");
        assert!(Simulation::new(&devices, options()).is_err());
    }
}
