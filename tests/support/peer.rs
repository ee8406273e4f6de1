//! The far end of a line: devices that hold registers, answer rightly, and misbehave once or always
//! when a test says so. Its frames are made here and not by the program's own code.

#![allow(dead_code, reason = "each test uses its own part of it")]

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use busker::edge::clock::Clock;
use busker::engine::time::{Duration, Time};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::pty::{OpenptFlags, openpt, ptsname, unlockpt};
use tempfile::TempDir;

/// What no device ever holds.
pub const LIE: u16 = 9999;

/// The configuration of one unit of which each reply could be that to each request.
pub const ALIKE: &str = "  one:
    bus: line
    unit: 1
    poll: {fast: 100ms}
    wire: {limits: {gap: 0}}
    points:
      a: {at: input 0, poll: fast}
      b: {at: input 100, poll: fast}
";

/// A request as it came.
#[derive(Clone, Debug)]
pub struct Asked {
    pub frame: Vec<u8>,
    pub unit: u8,
    pub function: u8,
    pub address: u16,
    /// How long the line had been silent before it: never less than it really was.
    pub silence: Duration,
    /// The connection it came on (the first has number 0), and how old that was.
    pub connection: usize,
    pub connected_for: Duration,
}

impl Asked {
    /// The second number of the request: the count of a read, the word of a write.
    pub fn argument(&self, framing: Framing) -> u16 {
        let pdu = pdu_of(&self.frame, framing);
        u16::from_be_bytes([pdu[3], pdu[4]])
    }
}

/// What the far end does when it is asked.
#[derive(Clone, Debug)]
pub enum Step {
    Say(Vec<u8>),
    Pause(u64),
    /// Says it just before it answers the next request.
    SayBeforeNext(Vec<u8>),
    /// Closes the connection.
    HangUp,
}

/// Makes something else of a request (and of the right reply to it, an empty one to a broadcast).
pub type Misbehave = fn(&Asked, Vec<u8>) -> Vec<Step>;

/// The same with a memory.
type Behaviour = Box<dyn FnMut(&Asked, Vec<u8>) -> Vec<Step> + Send>;

/// Unit, function of the read, and address of a register.
pub type Place = (u8, u8, u16);

/// The kind of frames on the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Framing {
    Rtu,
    Tcp,
}

#[derive(Default)]
struct State {
    registers: BTreeMap<Place, u16>,
    /// What each register has held, in the order of the changes.
    held: Vec<(Place, u16)>,
    once: Option<(Place, Misbehave)>,
    always: Option<Behaviour>,
    before_next: Vec<u8>,
    deaf_to_writes: bool,
    /// Which writes are obeyed; `None`: all.
    obeys: Option<fn(&Asked) -> bool>,
    asked: Vec<Asked>,
    connections: usize,
}

impl State {
    fn put(&mut self, place: Place, word: u16) {
        self.registers.insert(place, word);
        self.held.push((place, word));
    }
}

/// Devices on a pseudo-terminal (behind a symbolic link that stays) or a TCP port.
pub struct Peer {
    state: Arc<Mutex<State>>,
    framing: Framing,
    folder: TempDir,
    /// While a test holds the far end of a pseudo-terminal, the line is plugged in.
    plugged: Arc<Mutex<bool>>,
    port: u16,
}

impl Peer {
    /// On a pseudo-terminal.
    pub fn on_a_pseudo_terminal() -> Peer {
        let peer = Peer::new(Framing::Rtu, 0);
        peer.plug_in();
        peer
    }

    /// On TCP: Modbus TCP, or RTU frames as a serial server passes them on.
    pub fn on_tcp(framing: Framing) -> Peer {
        let listener = TcpListener::bind("127.0.0.1:0").expect("loopback has free ports");
        let port = listener.local_addr().expect("a bound listener has an address").port();
        let peer = Peer::new(framing, port);
        let (state, plugged) = (peer.state.clone(), peer.plugged.clone());
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let stream = stream.expect("a connection comes");
                stream.set_nodelay(true).expect("a connection has this option");
                serve(&mut Line::Tcp(stream), framing, &state, &plugged);
            }
        });
        *peer.plugged.lock().expect("nobody panics with it") = true;
        peer
    }

    fn new(framing: Framing, port: u16) -> Peer {
        let folder = tempfile::tempdir().expect("a temporary folder");
        Peer { state: Arc::default(), framing, folder, plugged: Arc::default(), port }
    }

    /// The link as a configuration says it.
    pub fn link(&self) -> String {
        match (self.port, self.framing) {
            (0, _) => {
                format!("serial: {}, baud: 115200, parity: none", self.path().display())
            }
            (port, Framing::Tcp) => format!("tcp: \"127.0.0.1:{port}\""),
            (port, Framing::Rtu) => format!("rtu_over_tcp: \"127.0.0.1:{port}\", baud: 115200, parity: none"),
        }
    }

    /// The link as a command line says it.
    pub fn arguments(&self) -> Vec<String> {
        let text = match (self.port, self.framing) {
            (0, _) => format!("--serial {} --baud 115200 --parity none", self.path().display()),
            (port, Framing::Tcp) => format!("--tcp 127.0.0.1:{port}"),
            (port, Framing::Rtu) => format!("--rtu-over-tcp 127.0.0.1:{port} --baud 115200 --parity none"),
        };
        // The reply is what matters, and not how busy the machine is that runs the tests.
        format!("{text} --timeout 3s").split(' ').map(str::to_owned).collect()
    }

    /// Where the serial port is, as long as it is plugged in.
    pub fn path(&self) -> PathBuf {
        self.folder.path().join("line")
    }

    /// A new pseudo-terminal behind the same path.
    pub fn plug_in(&self) {
        let far = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)
            .expect("there are pseudo-terminals");
        unlockpt(&far).expect("a new pseudo-terminal");
        let name = ptsname(&far, Vec::new()).expect("it has a name");
        let name = name.into_string().expect("the kernel's names are plain");
        // Held open, or the far end would read errors until somebody opens it.
        let flags = rustix::fs::OFlags::RDWR | rustix::fs::OFlags::NOCTTY | rustix::fs::OFlags::CLOEXEC;
        let near = rustix::fs::open(&name, flags, rustix::fs::Mode::empty()).expect("it is there");
        let plugged = self.plugged.clone();
        *plugged.lock().expect("nobody panics with it") = true;
        let state = self.state.clone();
        replace_link(Path::new(&name), &self.path());
        std::thread::spawn(move || {
            let _near = near;
            serve(&mut Line::Pty(far), Framing::Rtu, &state, &plugged);
        });
    }

    /// The adapter is drawn out: both ends of the pseudo-terminal close, the name goes.
    pub fn unplug(&self) {
        let _ = std::fs::remove_file(self.path());
        *self.plugged.lock().expect("nobody panics with it") = false;
    }

    /// Sets what a unit holds, by the function code that reads it.
    pub fn hold(&self, unit: u8, function: u8, address: u16, word: u16) {
        self.lock().put((unit, function, address), word);
    }

    /// The same for several registers at once.
    pub fn hold_all(&self, unit: u8, function: u8, address: u16, words: &[u16]) {
        let mut state = self.lock();
        for (word, address) in words.iter().zip(address..) {
            state.put((unit, function, address), *word);
        }
    }

    /// What a register holds.
    pub fn holds(&self, place: Place) -> u16 {
        self.lock().registers.get(&place).copied().unwrap_or_default()
    }

    /// Everything that a register has held.
    pub fn history(&self, place: Place) -> Vec<u16> {
        let state = self.lock();
        let of_place = state.held.iter().filter(|(of, _)| *of == place);
        of_place.map(|(_, word)| *word).collect()
    }

    /// Misbehaves once, at the next request to this unit, function and address.
    pub fn misbehave_once(&self, unit: u8, function: u8, address: u16, how: Misbehave) {
        self.lock().once = Some(((unit, function, address), how));
    }

    /// Misbehaves at every request from now on.
    pub fn misbehave(&self, how: impl FnMut(&Asked, Vec<u8>) -> Vec<Step> + Send + 'static) {
        self.lock().always = Some(Box::new(how));
    }

    /// The end of [`Peer::misbehave`].
    pub fn behave(&self) {
        self.lock().always = None;
    }

    /// The units hear no write any more, and so neither obey nor confirm one.
    pub fn be_deaf_to_writes(&self) {
        self.lock().deaf_to_writes = true;
    }

    /// Of the writes only those are obeyed that fit; whether the others are refused is another matter.
    pub fn obey(&self, fits: fn(&Asked) -> bool) {
        self.lock().obeys = Some(fits);
    }

    /// Whether the misbehaviour of [`Peer::misbehave_once`] has happened.
    pub fn has_misbehaved(&self) -> bool {
        self.lock().once.is_none()
    }

    /// Every request so far.
    pub fn asked(&self) -> Vec<Asked> {
        self.lock().asked.clone()
    }

    /// How many connections there have been.
    pub fn connections(&self) -> usize {
        self.lock().connections
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().expect("nobody panics with it")
    }
}

/// Keeps the name of a pseudo-terminal that is gone from being given to a new one.
pub struct Placeholder {
    _terminals: Vec<OwnedFd>,
}

impl Placeholder {
    pub fn take(name: &Path) -> Placeholder {
        let mut terminals = Vec::new();
        // The kernel gives the lowest number that is free.
        for _ in 0..64 {
            let terminal = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)
                .expect("there are pseudo-terminals");
            let its_name = ptsname(&terminal, Vec::new()).expect("it has a name");
            terminals.push(terminal);
            if its_name.to_string_lossy() == name.to_string_lossy() || name.exists() {
                break;
            }
        }
        Placeholder { _terminals: terminals }
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        self.unplug();
    }
}

/// At no moment is there no link.
fn replace_link(target: &Path, link: &Path) {
    let new = link.with_extension("new");
    symlink(target, &new).expect("a link in a temporary folder");
    std::fs::rename(new, link).expect("a link in a temporary folder");
}

/// The far end's side of a line.
enum Line {
    Pty(OwnedFd),
    Tcp(TcpStream),
}

impl Line {
    /// Bytes, or none after a while; `None`: the line is closed.
    fn read(&mut self) -> Option<Vec<u8>> {
        let mut descriptors = [PollFd::new(self, PollFlags::IN)];
        let ready = poll(&mut descriptors, Some(&Timespec { tv_sec: 0, tv_nsec: 20_000_000 }));
        if ready.expect("a descriptor can be polled") == 0 {
            return Some(Vec::new());
        }
        let mut buffer = [0; 512];
        let count = match self {
            Line::Pty(far) => rustix::io::read(far, &mut buffer).unwrap_or(0),
            Line::Tcp(stream) => stream.read(&mut buffer).unwrap_or(0),
        };
        if count == 0 { None } else { Some(buffer[..count].to_vec()) }
    }

    fn write(&mut self, bytes: &[u8]) {
        // The program may have closed its side.
        match self {
            Line::Pty(far) => drop(rustix::io::write(far, bytes)),
            Line::Tcp(stream) => drop(stream.write_all(bytes)),
        }
    }
}

impl AsFd for Line {
    fn as_fd(&self) -> BorrowedFd<'_> {
        match self {
            Line::Pty(far) => far.as_fd(),
            Line::Tcp(stream) => stream.as_fd(),
        }
    }
}

fn serve(line: &mut Line, framing: Framing, state: &Mutex<State>, plugged: &Mutex<bool>) {
    let clock = Clock::start();
    let connection = {
        let mut state = state.lock().expect("nobody panics with it");
        state.connections += 1;
        state.connections - 1
    };
    let mut heard = Vec::new();
    let (mut busy_until, mut silence) = (Time::default(), Duration::ZERO);
    while *plugged.lock().expect("nobody panics with it") {
        let Some(bytes) = line.read() else { return };
        if bytes.is_empty() {
            continue;
        }
        if heard.is_empty() {
            silence = clock.now() - busy_until;
        }
        busy_until = clock.now();
        heard.extend(bytes);
        while let Some(asked) = take_request(&mut heard, framing) {
            let connected_for = clock.now() - Time::default();
            let asked = Asked { silence, connection, connected_for, ..asked };
            let steps = steps(&asked, framing, &mut state.lock().expect("nobody panics with it"));
            for step in steps {
                match step {
                    Step::Say(bytes) => {
                        // Before, or the program might have heard it before this is told the time.
                        busy_until = clock.now();
                        line.write(&bytes);
                    }
                    Step::Pause(millis) => std::thread::sleep(Duration::from_millis(millis)),
                    Step::SayBeforeNext(bytes) => {
                        state.lock().expect("nobody panics with it").before_next = bytes;
                    }
                    Step::HangUp => return,
                }
            }
        }
    }
}

fn steps(asked: &Asked, framing: Framing, state: &mut State) -> Vec<Step> {
    state.asked.push(asked.clone());
    let place = (asked.unit, asked.function, asked.address);
    let once = state.once.take_if(|(at, _)| *at == place);
    let mut steps = Vec::new();
    if !state.before_next.is_empty() {
        steps.extend([Step::Say(std::mem::take(&mut state.before_next)), Step::Pause(15)]);
    }
    let reply = right_reply(asked, framing, state);
    steps.extend(match (once, &mut state.always) {
        (Some((_, how)), _) => how(asked, reply),
        (None, Some(how)) => how(asked, reply),
        (None, None) if reply.is_empty() => Vec::new(),
        (None, None) => vec![Step::Say(reply)],
    });
    steps
}

fn right_reply(asked: &Asked, framing: Framing, state: &mut State) -> Vec<u8> {
    let pdu = pdu_of(&asked.frame, framing);
    if state.deaf_to_writes && matches!(asked.function, 5 | 6 | 15 | 16) {
        return Vec::new();
    }
    if matches!(asked.function, 5 | 6 | 15 | 16) && state.obeys.is_some_and(|obeys| !obeys(asked)) {
        return reply(asked, framing, &pdu[..5]);
    }
    let number = |at: usize| u16::from_be_bytes([pdu[at], pdu[at + 1]]);
    match asked.function {
        1..=4 => {
            let words: Vec<u16> = (0..number(3))
                .map(|offset| (asked.unit, asked.function, asked.address + offset))
                .map(|key| state.registers.get(&key).copied().unwrap_or(0))
                .collect();
            reply(asked, framing, &read_pdu(asked.function, &words))
        }
        5 => {
            state.put((asked.unit, 1, asked.address), u16::from(number(3) == 0xFF00));
            reply(asked, framing, &pdu)
        }
        6 => {
            state.put((asked.unit, 3, asked.address), number(3));
            reply(asked, framing, &pdu)
        }
        15 => {
            for number in 0..number(3) {
                let bit = pdu[6 + usize::from(number / 8)] >> (number % 8) & 1;
                state.put((asked.unit, 1, asked.address + number), bit.into());
            }
            reply(asked, framing, &pdu[..5])
        }
        16 => {
            for (word, address) in pdu[6..].chunks(2).zip(asked.address..) {
                state.put((asked.unit, 3, address), u16::from_be_bytes([word[0], word[1]]));
            }
            reply(asked, framing, &pdu[..5])
        }
        8 => reply(asked, framing, &pdu),
        17 => reply(asked, framing, &[17, 3, b'B', b'1', 0xFF]),
        43 => {
            let objects = [&b"\x00\x04ACME"[..], b"\x01\x03RA1", b"\x02\x041.23"].concat();
            reply(asked, framing, &[&[43, 14, 1, 1, 0, 0, 3], &objects[..]].concat())
        }
        function => reply(asked, framing, &[function | 0x80, 1]),
    }
}

/// What a read of these words (bits: 0 or 1) is answered with.
pub fn read_pdu(function: u8, words: &[u16]) -> Vec<u8> {
    let bytes: Vec<u8> = match function {
        1 | 2 => words
            .chunks(8)
            .map(|bits| bits.iter().enumerate().map(|(place, bit)| (*bit as u8) << place).sum())
            .collect(),
        _ => words.iter().flat_map(|word| word.to_be_bytes()).collect(),
    };
    [&[function, bytes.len() as u8], &bytes[..]].concat()
}

/// An answer to a read of one input register that is none of the device's.
pub fn lie(asked: &Asked) -> Vec<u8> {
    rtu(asked.unit, &read_pdu(4, &[LIE]))
}

/// A refusal.
pub fn exception(asked: &Asked, framing: Framing, code: u8) -> Vec<u8> {
    reply(asked, framing, &[asked.function | 0x80, code])
}

/// The frame that carries `pdu` as the answer; empty to a broadcast.
pub fn reply(asked: &Asked, framing: Framing, pdu: &[u8]) -> Vec<u8> {
    match framing {
        Framing::Rtu if asked.unit == 0 => Vec::new(),
        Framing::Rtu => rtu(asked.unit, pdu),
        Framing::Tcp => {
            let length = (pdu.len() as u16 + 1).to_be_bytes();
            [&asked.frame[..2], &[0, 0], &length, &[asked.unit], pdu].concat()
        }
    }
}

/// The frame with a bit of it turned over.
pub fn garbled(mut frame: Vec<u8>) -> Vec<u8> {
    let middle = frame.len() / 2;
    frame[middle] ^= 0x10;
    frame
}

/// An RTU frame.
pub fn rtu(unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut frame = [&[unit], pdu].concat();
    let mut crc = 0xFFFF_u16;
    for byte in &frame {
        crc ^= u16::from(*byte);
        for _ in 0..8 {
            let odd = crc & 1 == 1;
            crc >>= 1;
            if odd {
                crc ^= 0xA001;
            }
        }
    }
    frame.extend(crc.to_le_bytes());
    frame
}

fn pdu_of(frame: &[u8], framing: Framing) -> Vec<u8> {
    match framing {
        Framing::Rtu => frame[1..frame.len() - 2].to_vec(),
        Framing::Tcp => frame[7..].to_vec(),
    }
}

fn take_request(heard: &mut Vec<u8>, framing: Framing) -> Option<Asked> {
    let length = match framing {
        Framing::Tcp => 6 + usize::from(u16::from_be_bytes([*heard.get(4)?, *heard.get(5)?])),
        Framing::Rtu => match heard.get(1)? {
            1..=6 | 8 => 8,
            15 | 16 => 9 + usize::from(*heard.get(6)?),
            17 => 4,
            43 => 7,
            other => panic!("the program asked with function {other}"),
        },
    };
    if heard.len() < length {
        return None;
    }
    let frame: Vec<u8> = heard.drain(..length).collect();
    let at = if framing == Framing::Tcp { 6 } else { 0 };
    let address = frame.get(at + 2..at + 4).map_or(0, |bytes| u16::from_be_bytes([bytes[0], bytes[1]]));
    let (unit, function) = (frame[at], frame[at + 1]);
    let (silence, connected_for) = (Duration::ZERO, Duration::ZERO);
    Some(Asked { unit, function, address, frame, silence, connected_for, connection: 0 })
}
