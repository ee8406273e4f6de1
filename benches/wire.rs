//! A serial line that keeps time to the microsecond: a thread on a pseudo-terminal that spins over the
//! last stretch before each moment that matters. What the simulator charges for characters is right as
//! well, but it may be late by what a sleeping core needs to wake up, and that would be charged to the
//! program.
//!
//! A request is charged for its characters, the device for its turnaround, the reply for its characters;
//! the reply is handed over when its last character would have come, as many adapters do it. The silence
//! before a request is not added here but looked at: it is the program's to keep.

use std::collections::BTreeMap;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::Context;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use crate::clock::{now, pause_until, prefer_this_thread, wake_exactly};
use crate::frames::{Line, checksum};

/// How the devices on a line behave.
#[derive(Clone, Copy, Debug)]
pub struct Behaviour {
    pub line: Line,
    pub turnaround: Duration,
    /// Units ignore a request that comes without the silence before it.
    pub strict: bool,
    /// With each reply to a read, the unit's first register holds the next number.
    pub counting: bool,
    /// The first so many characters of a reply are handed over when they have come, as adapters do whose
    /// buffer is smaller than the reply; `None`: all at its end.
    pub first_piece: Option<usize>,
}

/// One request and what became of it. Times are nanoseconds of the monotonic clock.
#[derive(Clone, Copy, Debug)]
pub struct Transaction {
    pub unit: u8,
    pub function: u8,
    pub address: u16,
    /// What a write writes; the count of a read.
    pub argument: u16,
    /// When its first byte was on the wire.
    pub heard_at: i64,
    /// When the last byte of the reply was, and with it the bytes were handed over; `None`: no reply.
    pub ended_at: Option<i64>,
    /// How long the line had been silent before; `None` for the first request.
    pub silence: Option<i64>,
    /// By how much the wire itself missed its time, with which the program has nothing to do.
    pub wire_late: i64,
    /// The first register as the reply told it.
    pub told: Option<u16>,
}

/// The line and its devices, until it is dropped.
pub struct Wire {
    path: PathBuf,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    _terminal: OwnedFd,
}

struct Shared {
    stop: AtomicBool,
    collisions: AtomicU64,
    damaged: AtomicU64,
    dead: Vec<AtomicBool>,
    log: Mutex<Vec<Transaction>>,
}

/// So long after a reply the next request is waited for without sleeping.
const ATTENTIVE: i64 = 4_000_000;
/// So long before the end of the silence it begins to be waited for so. Earlier ones are heard too, some
/// 50 µs late: on a machine of two cores, the kernel's thread that passes on the reply needs one of them.
const ATTENTIVE_BEFORE: i64 = 300_000;
/// A sleep ends so long before the moment that it is for.
const EARLY: i64 = 500_000;
const REGISTERS: usize = 512;

impl Wire {
    pub fn start(behaviour: Behaviour) -> anyhow::Result<Wire> {
        let controller = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)
            .context("no pseudo-terminal")?;
        grantpt(&controller)?;
        unlockpt(&controller)?;
        let path = PathBuf::from(ptsname(&controller, Vec::new())?.into_string()?);
        let flags = rustix::fs::OFlags::RDWR | rustix::fs::OFlags::NOCTTY | rustix::fs::OFlags::CLOEXEC;
        // Held open so that the controlling side sees no hang-up when the program closes it.
        let terminal = rustix::fs::open(&path, flags, rustix::fs::Mode::empty())?;
        let mut attributes = tcgetattr(&terminal)?;
        attributes.make_raw();
        tcsetattr(&terminal, OptionalActions::Now, &attributes)?;
        rustix::io::ioctl_fionbio(&controller, true)?;
        let shared = Arc::new(Shared {
            stop: AtomicBool::new(false),
            collisions: AtomicU64::new(0),
            damaged: AtomicU64::new(0),
            dead: (0..=255).map(|_| AtomicBool::new(false)).collect(),
            log: Mutex::new(Vec::new()),
        });
        let of_thread = shared.clone();
        let thread = std::thread::Builder::new().name("wire".into()).spawn(move || {
            wake_exactly();
            prefer_this_thread();
            let mut line = LineThread::new(of_thread, behaviour, controller);
            if let Err(error) = line.run() {
                eprintln!("the wire broke: {error}");
            }
        })?;
        Ok(Wire { path, shared, thread: Some(thread), _terminal: terminal })
    }

    /// What the program opens.
    pub fn path(&self) -> &PathBuf {
        &self.path
    }

    pub fn set_dead(&self, unit: u8, dead: bool) {
        self.shared.dead[usize::from(unit)].store(dead, Ordering::SeqCst);
    }

    /// Takes what has happened since this was last called.
    pub fn take(&self) -> Vec<Transaction> {
        std::mem::take(&mut *self.log())
    }

    /// The last of what has happened since the last [`Wire::take`].
    pub fn last(&self) -> Option<Transaction> {
        self.log().last().copied()
    }

    /// How many of what has happened since the last [`Wire::take`] are as `wanted`.
    pub fn count(&self, wanted: impl Fn(&Transaction) -> bool) -> usize {
        self.log().iter().filter(|transaction| wanted(transaction)).count()
    }

    /// How often somebody spoke into a request or a reply.
    pub fn collisions(&self) -> u64 {
        self.shared.collisions.load(Ordering::SeqCst)
    }

    /// How many requests could not be understood.
    pub fn damaged(&self) -> u64 {
        self.shared.damaged.load(Ordering::SeqCst)
    }

    fn log(&self) -> std::sync::MutexGuard<'_, Vec<Transaction>> {
        self.shared.log.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Wire {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::SeqCst);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct LineThread {
    shared: Arc<Shared>,
    behaviour: Behaviour,
    controller: OwnedFd,
    registers: BTreeMap<u8, Vec<u16>>,
    /// The end of the last byte that was on the line.
    silent_since: Option<i64>,
}

impl LineThread {
    fn new(shared: Arc<Shared>, behaviour: Behaviour, controller: OwnedFd) -> LineThread {
        LineThread { shared, behaviour, controller, registers: BTreeMap::new(), silent_since: None }
    }

    fn run(&mut self) -> anyhow::Result<()> {
        let mut request = Vec::with_capacity(256);
        while !self.shared.stop.load(Ordering::Relaxed) {
            request.clear();
            let Some(heard_at) = self.hear(&mut request)? else { continue };
            self.serve(&request, heard_at)?;
        }
        Ok(())
    }

    /// Waits for a whole request; `None` after a while without one.
    fn hear(&mut self, request: &mut Vec<u8>) -> anyhow::Result<Option<i64>> {
        let silent_since = self.silent_since.unwrap_or_default();
        let attentive_from = silent_since + self.behaviour.line.silence() - ATTENTIVE_BEFORE;
        let attentive_until = silent_since + ATTENTIVE;
        let mut heard_at = None;
        loop {
            self.read(request)?;
            let time = now();
            if !request.is_empty() {
                let since = *heard_at.get_or_insert(time);
                if is_whole(request) {
                    return Ok(Some(since));
                }
                // The rest of it must be on its way; a real line would have fallen silent long ago.
                if time - since > 20_000_000 {
                    self.shared.damaged.fetch_add(1, Ordering::SeqCst);
                    self.silent_since = Some(time);
                    return Ok(None);
                }
            } else if time > attentive_until {
                if !self.wait(50_000_000)? {
                    return Ok(None);
                }
            } else if time < attentive_from {
                self.wait(attentive_from - time)?;
            } else {
                // Whoever passes on the program's bytes may have been put on this core.
                rustix::thread::sched_yield();
            }
        }
    }

    /// Sleeps until there are bytes; `false`: none came in this time.
    fn wait(&self, nanos: i64) -> anyhow::Result<bool> {
        let mut descriptors = [PollFd::new(&self.controller, PollFlags::IN)];
        let timeout = Timespec { tv_sec: 0, tv_nsec: nanos };
        Ok(poll(&mut descriptors, Some(&timeout))? > 0)
    }

    fn read(&self, into: &mut Vec<u8>) -> anyhow::Result<()> {
        let mut buffer = [0; 256];
        match rustix::io::read(&self.controller, &mut buffer) {
            Ok(count) => into.extend_from_slice(&buffer[..count]),
            Err(rustix::io::Errno::AGAIN | rustix::io::Errno::INTR) => {}
            Err(error) => return Err(error.into()),
        }
        Ok(())
    }

    fn serve(&mut self, request: &[u8], heard_at: i64) -> anyhow::Result<()> {
        let line = self.behaviour.line;
        let silence = self.silent_since.map(|since| heard_at - since);
        let request_end = heard_at + line.characters(request.len());
        self.silent_since = Some(request_end);
        let (content, sum) = request.split_at(request.len() - 2);
        if checksum(content).to_le_bytes() != *sum {
            self.shared.damaged.fetch_add(1, Ordering::SeqCst);
            return Ok(());
        }
        let word = |at: usize| u16::from_be_bytes([content[at], content[at + 1]]);
        let mut transaction = Transaction {
            unit: content[0],
            function: content[1],
            address: word(2),
            argument: word(4),
            heard_at,
            ended_at: None,
            silence,
            wire_late: 0,
            told: None,
        };
        let too_early = silence.is_some_and(|silence| silence < line.silence());
        let is_dead = self.shared.dead[usize::from(content[0])].load(Ordering::Relaxed);
        let is_ignored = is_dead || (self.behaviour.strict && too_early);
        if !is_ignored {
            let (reply, told) = self.reply(content);
            transaction.told = told;
            let begins_at = request_end + self.behaviour.turnaround.as_nanos() as i64;
            let first = self.behaviour.first_piece.unwrap_or_default().min(reply.len() - 1);
            if first > 0 {
                pause_until(begins_at + line.characters(first), EARLY);
                rustix::io::write(&self.controller, &reply[..first])?;
            }
            let due = begins_at + line.characters(reply.len());
            pause_until(due, EARLY);
            let mut strays = Vec::new();
            self.read(&mut strays)?;
            if !strays.is_empty() {
                self.shared.collisions.fetch_add(1, Ordering::SeqCst);
            }
            let ended_at = now();
            rustix::io::write(&self.controller, &reply[first..])?;
            transaction.wire_late = ended_at - due;
            transaction.ended_at = Some(ended_at);
            self.silent_since = Some(ended_at);
        }
        self.shared.log.lock().unwrap_or_else(PoisonError::into_inner).push(transaction);
        Ok(())
    }

    /// The reply with its checksum, and the first register that it tells.
    fn reply(&mut self, request: &[u8]) -> (Vec<u8>, Option<u16>) {
        let word = |at: usize| u16::from_be_bytes([request[at], request[at + 1]]);
        let (unit, function, address, argument) = (request[0], request[1], usize::from(word(2)), word(4));
        let registers = self.registers.entry(unit).or_insert_with(|| vec![1000; REGISTERS]);
        let mut reply = vec![unit, function];
        let mut told = None;
        match function {
            3 | 4 if address + usize::from(argument) <= REGISTERS => {
                if self.behaviour.counting {
                    registers[0] = registers[0].wrapping_add(1);
                }
                told = registers.get(address).copied();
                reply.push(argument as u8 * 2);
                let told = &registers[address..address + usize::from(argument)];
                reply.extend(told.iter().flat_map(|word| word.to_be_bytes()));
            }
            6 if address < REGISTERS => {
                registers[address] = argument;
                reply.extend(&request[2..6]);
            }
            16 if address + usize::from(argument) <= REGISTERS => {
                for (number, bytes) in request[7..].chunks_exact(2).enumerate() {
                    registers[address + number] = u16::from_be_bytes([bytes[0], bytes[1]]);
                }
                reply.extend(&request[2..6]);
            }
            _ => reply = vec![unit, function | 0x80, 2],
        }
        reply.extend(checksum(&reply).to_le_bytes());
        (reply, told)
    }
}

fn is_whole(request: &[u8]) -> bool {
    match request {
        [_, 15 | 16, _, _, _, _, bytes, ..] => request.len() >= usize::from(*bytes) + 9,
        [_, 15 | 16, ..] => false,
        _ => request.len() >= 8,
    }
}
