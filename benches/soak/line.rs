//! A line of simulated devices in real time, on a pseudo-terminal or a TCP port: it paces, misbehaves, is
//! pulled out and hangs up, and writes down each request and its reply with their times.

use std::collections::VecDeque;
use std::net::{TcpListener, TcpStream};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};

use anyhow::{Context, anyhow};
use busker::edge::clock::Clock;
use busker::edge::lock::lock;
use busker::engine::time::{Duration, Time};
use busker::simulator::device::{Addressed, Place, SimulatedDevice, Stimulus};
use busker::simulator::line::{Line, Transmission};
use busker::simulator::script::Action;
use busker::simulator::wire::{Received, Receiver};
use busker::simulator::{Framing, LineSettings};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::pty::{OpenptFlags, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use crate::device::{Diary, Timepiece};

/// What a device answered to a read.
#[derive(Clone, Debug)]
pub struct Told {
    pub unit: u8,
    pub function: u8,
    pub first: u16,
    pub words: Vec<u16>,
    pub asked_at: Time,
    /// When its last byte is handed over.
    pub sent_at: Time,
    /// When the next request on the line was heard: by then this one had been answered or given up.
    pub next_asked_at: Option<Time>,
}

impl Told {
    /// Whether the gateway had asked for something else before this came: then it is late.
    pub fn is_late(&self) -> bool {
        self.next_asked_at.is_some_and(|next| next < self.sent_at)
    }
}

/// What has been told on a line lately, numbered from its beginning.
#[derive(Default)]
pub struct Log {
    pub told: VecDeque<Told>,
    /// The number of the oldest one.
    pub first: u64,
    pub requests: u64,
    pub late: u64,
}

/// So long is remembered what was told.
const REMEMBERED: Duration = Duration::from_secs(180);

/// One line; its threads end with it.
pub struct LiveLine {
    shared: Arc<Shared>,
    place: Where,
}

enum Where {
    /// A symbolic link to the pseudo-terminal.
    Terminal(PathBuf),
    Port(u16),
}

struct Shared {
    clock: Clock,
    framing: Framing,
    state: Mutex<State>,
    /// Whoever serves an older one ends.
    generation: AtomicU64,
    is_mute: AtomicBool,
    refuses: AtomicBool,
    ends: AtomicBool,
}

struct State {
    line: Line,
    spoken: Arc<Mutex<Option<Spoken>>>,
    /// What is still to be sent, and which unit owes it; `None`: it is noise.
    owed: Vec<(Option<u8>, Transmission)>,
    /// When each unit's last reply was sent, or will be.
    answered_at: [Time; 256],
    log: Log,
}

/// The words that a device has just told.
struct Spoken {
    function: u8,
    first: u16,
    words: Vec<u16>,
}

/// A device whose replies are written down.
struct Overheard {
    device: Timepiece,
    spoken: Arc<Mutex<Option<Spoken>>>,
}

impl LiveLine {
    /// A serial line; `path` becomes a link to its terminal.
    pub fn on_a_terminal(
        clock: Clock,
        path: PathBuf,
        units: &[u8],
        diary: &Diary,
    ) -> anyhow::Result<LiveLine> {
        let shared = Shared::new(clock, Framing::Rtu, units, diary)?;
        let line = LiveLine { shared, place: Where::Terminal(path) };
        line.plug_in()?;
        Ok(line)
    }

    /// Modbus TCP.
    pub fn on_tcp(clock: Clock, units: &[u8], diary: &Diary) -> anyhow::Result<LiveLine> {
        let shared = Shared::new(clock, Framing::Tcp, units, diary)?;
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let port = listener.local_addr()?.port();
        let of_thread = shared.clone();
        std::thread::Builder::new().name("server".into()).spawn(move || {
            for stream in listener.incoming().map_while(Result::ok) {
                if of_thread.ends.load(Ordering::SeqCst) {
                    return;
                }
                if of_thread.refuses.load(Ordering::SeqCst) || stream.set_nonblocking(true).is_err() {
                    continue;
                }
                // What follows is another connection, and the old one ends by itself.
                let generation = of_thread.next_generation();
                serve_connection(of_thread.clone(), stream, generation);
            }
        })?;
        Ok(LiveLine { shared, place: Where::Port(port) })
    }

    /// The link as a configuration says it.
    pub fn link(&self) -> String {
        match &self.place {
            Where::Terminal(path) => format!("serial: {}, baud: 19200, parity: even", path.display()),
            Where::Port(port) => format!("tcp: \"127.0.0.1:{port}\""),
        }
    }

    pub fn is_serial(&self) -> bool {
        matches!(self.place, Where::Terminal(_))
    }

    /// Does something to a device; what it still owes is lost.
    pub fn act(&self, unit: u8, action: &Action) -> anyhow::Result<()> {
        let mut state = self.shared.lock();
        let now = self.shared.clock.now();
        state.line.act(now, action).map_err(|error| anyhow!(error))?;
        state.owed.retain(|(owes, _)| *owes != Some(unit));
        Ok(())
    }

    /// Bytes that nobody sent.
    pub fn disturb(&self, bytes: Vec<u8>) {
        let at = self.shared.clock.now();
        self.shared.lock().owed.push((None, Transmission { at, bytes }));
    }

    /// The adapter is pulled out, or the connection ends.
    pub fn hang_up(&self) {
        if let Where::Terminal(path) = &self.place {
            let _ = std::fs::remove_file(path);
        }
        self.shared.next_generation();
        self.shared.lock().owed.clear();
    }

    /// The adapter is back; of a TCP server nothing has to be done.
    pub fn plug_in(&self) -> anyhow::Result<()> {
        let Where::Terminal(path) = &self.place else { return Ok(()) };
        let far = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        unlockpt(&far)?;
        let name = ptsname(&far, Vec::new())?.into_string()?;
        let flags = rustix::fs::OFlags::RDWR | rustix::fs::OFlags::NOCTTY | rustix::fs::OFlags::CLOEXEC;
        // Held open so that this side sees no hang-up when the program closes its own.
        let near = rustix::fs::open(&name, flags, rustix::fs::Mode::empty())?;
        let mut attributes = tcgetattr(&near)?;
        attributes.make_raw();
        tcsetattr(&near, OptionalActions::Now, &attributes)?;
        rustix::io::ioctl_fionbio(&far, true)?;
        let generation = self.shared.next_generation();
        let shared = self.shared.clone();
        replace_link(Path::new(&name), path)?;
        std::thread::Builder::new().name("terminal".into()).spawn(move || {
            serve(&shared, far.as_fd(), generation);
            drop::<(OwnedFd, OwnedFd)>((far, near));
        })?;
        Ok(())
    }

    /// Requests are taken, and nothing comes back.
    pub fn be_mute(&self, is_mute: bool) {
        self.shared.is_mute.store(is_mute, Ordering::SeqCst);
    }

    /// Connections are taken and closed.
    pub fn refuse(&self, refuses: bool) {
        self.shared.refuses.store(refuses, Ordering::SeqCst);
    }

    /// Looks into what was told.
    pub fn look<T>(&self, look: impl FnOnce(&Log) -> T) -> T {
        look(&self.shared.lock().log)
    }
}

impl Drop for LiveLine {
    fn drop(&mut self) {
        self.shared.ends.store(true, Ordering::SeqCst);
        self.hang_up();
        if let Where::Port(port) = self.place {
            // It wakes the listener, which then ends.
            let _ = TcpStream::connect(("127.0.0.1", port));
        }
    }
}

impl Shared {
    fn new(clock: Clock, framing: Framing, units: &[u8], diary: &Diary) -> anyhow::Result<Arc<Shared>> {
        let (settings, turnaround) = (LineSettings::default(), Duration::from_millis(5));
        let mut line =
            Line::new(clock.now(), settings, turnaround, true, &[]).map_err(|error| anyhow!(error))?;
        let spoken = Arc::new(Mutex::new(None));
        for unit in units {
            let device = Timepiece::new(*unit, diary.clone());
            let at = Place { unit: *unit, device: format!("device_{unit}") };
            let device = Overheard { device, spoken: spoken.clone() };
            line.add(at, Box::new(device)).map_err(|error| anyhow!(error))?;
        }
        let state =
            State { line, spoken, owed: Vec::new(), answered_at: [Time(0); 256], log: Log::default() };
        Ok(Arc::new(Shared {
            clock,
            framing,
            state: Mutex::new(state),
            generation: AtomicU64::new(0),
            is_mute: AtomicBool::new(false),
            refuses: AtomicBool::new(false),
            ends: AtomicBool::new(false),
        }))
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    fn next_generation(&self) -> u64 {
        self.generation.fetch_add(1, Ordering::SeqCst) + 1
    }
}

impl State {
    /// Hands what was received to the devices, and writes down what they tell.
    fn hear(&mut self, now: Time, framing: Framing, received: &Received, is_mute: bool) {
        let Received::Frame(frame) = received else { return };
        self.log.requests += 1;
        if let Some(last) = self.log.told.back_mut().filter(|last| last.next_asked_at.is_none()) {
            last.next_asked_at = Some(now);
            self.log.late += u64::from(last.is_late());
        }
        if is_mute {
            return;
        }
        let unit = frame.unit;
        let answered_at = &mut self.answered_at[usize::from(unit)];
        let mut sent_at = now;
        for mut answer in self.line.hear(now, framing, received, None) {
            // A device that is late does one thing after the other: nothing overtakes.
            answer.at = answer.at.max(*answered_at + Duration::from_millis(1));
            *answered_at = answer.at;
            sent_at = answer.at;
            self.owed.push((Some(unit), answer));
        }
        if let Some(Spoken { function, first, words }) = lock(&self.spoken).take() {
            self.log.told.push_back(Told {
                unit,
                function,
                first,
                words,
                asked_at: now,
                sent_at,
                next_asked_at: None,
            });
        }
        while self.log.told.front().is_some_and(|told| now.since(told.asked_at) > REMEMBERED) {
            self.log.told.pop_front();
            self.log.first += 1;
        }
    }
}

fn serve_connection(shared: Arc<Shared>, stream: TcpStream, generation: u64) {
    let served = std::thread::Builder::new().name("connection".into()).spawn(move || {
        // One small packet must not wait for a second.
        let _ = stream.set_nodelay(true);
        serve(&shared, stream.as_fd(), generation);
    });
    // Without a thread the connection ends, which the program sees.
    let _ = served;
}

/// Reads requests and writes replies at their times, as long as this is the line's way.
fn serve(shared: &Shared, stream: BorrowedFd<'_>, generation: u64) {
    let mut receiver = Receiver::new(shared.framing, LineSettings::default());
    let mut buffer = [0; 512];
    shared.lock().owed.clear();
    while shared.generation.load(Ordering::SeqCst) == generation {
        let next = shared.lock().owed.iter().map(|(_, transmission)| transmission.at).min();
        let due = next.into_iter().chain(receiver.deadline()).min();
        // Often enough to notice that something else is done to the line.
        let most = Duration::from_millis(20);
        let wait = due.map_or(most, |due| shared.clock.until(due).min(most));
        let mut descriptors = [PollFd::new(&stream, PollFlags::IN)];
        let timeout = Timespec { tv_sec: 0, tv_nsec: i64::from(wait.subsec_nanos()) };
        if poll(&mut descriptors, Some(&timeout)).is_ok_and(|ready| ready > 0) {
            match rustix::io::read(stream, &mut buffer) {
                Ok(0) => return,
                Ok(count) => receiver.push(shared.clock.now(), &buffer[..count]),
                Err(rustix::io::Errno::AGAIN | rustix::io::Errno::INTR) => {}
                Err(_) => return,
            }
        }
        let mut state = shared.lock();
        let now = shared.clock.now();
        while let Some(received) = receiver.next(now) {
            state.hear(now, shared.framing, &received, shared.is_mute.load(Ordering::SeqCst));
        }
        state.owed.sort_by_key(|(_, transmission)| transmission.at);
        let count = state.owed.iter().take_while(|(_, transmission)| transmission.at <= now).count();
        let due: Vec<_> = state.owed.drain(..count).collect();
        drop(state);
        for (_, transmission) in due {
            // Where nobody reads, bytes are lost, as on a wire.
            let _ = rustix::io::write(stream, &transmission.bytes);
        }
    }
}

/// At no moment is there no link.
fn replace_link(target: &Path, link: &Path) -> anyhow::Result<()> {
    let new = link.with_extension("new");
    std::os::unix::fs::symlink(target, &new).context("a link in a temporary folder")?;
    Ok(std::fs::rename(new, link)?)
}

impl SimulatedDevice for Overheard {
    fn request(&mut self, now: Time, addressed: Addressed, pdu: &[u8]) -> Option<Vec<u8>> {
        let reply = self.device.request(now, addressed, pdu)?;
        let words: Vec<u16> = match (reply.first(), reply.get(2..)) {
            (Some(1), Some(bytes)) => (0..16)
                .map(|bit| u16::from(bytes.get(bit / 8).copied().unwrap_or(0) >> (bit % 8) & 1))
                .collect(),
            (Some(3 | 4), Some(bytes)) => {
                bytes.chunks_exact(2).map(|word| u16::from_be_bytes([word[0], word[1]])).collect()
            }
            _ => return Some(reply),
        };
        let first = u16::from_be_bytes([pdu[1], pdu[2]]);
        *lock(&self.spoken) = Some(Spoken { function: reply[0], first, words });
        Some(reply)
    }

    fn advance(&mut self, now: Time) {
        self.device.advance(now);
    }

    fn restart(&mut self, now: Time) {
        self.device.restart(now);
    }

    fn stimulate(&mut self, now: Time, stimulus: &Stimulus) -> Result<(), String> {
        self.device.stimulate(now, stimulus)
    }

    fn outputs(&self) -> Vec<(String, String)> {
        self.device.outputs()
    }

    fn eeprom(&self) -> Vec<u16> {
        self.device.eeprom()
    }

    fn load_eeprom(&mut self, now: Time, words: &[u16]) -> Result<(), String> {
        self.device.load_eeprom(now, words)
    }
}
