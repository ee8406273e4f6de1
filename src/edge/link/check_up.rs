//! Looks at a serial port without setting anything on it; and, when asked to, listens on its line.

use std::os::fd::AsFd;
use std::path::{Path, PathBuf};

use rustix::event::{PollFd, PollFlags, poll};
use rustix::fs::{FlockOperation, Mode, OFlags, flock, open};

use super::{Link, Lost, adapter, driver, serial::why_not_opened, timespec};
use crate::edge::clock::Clock;
use crate::engine::settings::Direction;
use crate::engine::time::Duration;

/// What there is to know of a port.
#[derive(Debug)]
pub struct CheckUp {
    /// Where its path leads, if that is a link.
    pub target: Option<PathBuf>,
    /// Its path under `/dev/serial/by-id`.
    pub stable_path: Option<PathBuf>,
    pub product: Option<String>,
    pub driver: Option<String>,
    /// In milliseconds.
    pub latency_timer: Option<u32>,
    pub opened: Result<Opened, Lost>,
}

/// What the driver says.
#[derive(Debug)]
pub struct Opened {
    /// How the kernel switches an RS485 transceiver.
    pub direction: Option<Direction>,
    /// Whether it could.
    pub can_switch: bool,
    /// `None`: the driver knows no such flag.
    pub low_latency: Option<bool>,
}

pub fn check_up(path: &Path) -> CheckUp {
    CheckUp {
        target: std::fs::canonicalize(path).ok().filter(|target| target != path),
        stable_path: adapter::stable_path(path, Path::new(adapter::BY_ID)),
        product: adapter::product(path),
        driver: adapter::driver(path),
        latency_timer: adapter::latency_timer(path),
        opened: ask(path),
    }
}

fn ask(path: &Path) -> Result<Opened, Lost> {
    let name = path.to_string_lossy();
    let why = |error| why_not_opened(&name, error);
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let port = open(path, flags, Mode::empty()).map_err(why)?;
    flock(&port, FlockOperation::NonBlockingLockExclusive).map_err(why)?;
    if !rustix::termios::isatty(&port) {
        return Err(Lost(format!("`{name}` is no serial port")));
    }
    let direction = driver::direction(&port).ok().flatten();
    // Where the kernel switches already, that it can is known, and nothing is touched.
    let can_switch = direction.is_some() || driver::can_switch(&port);
    Ok(Opened { direction, can_switch, low_latency: driver::low_latency(&port).ok() })
}

/// What comes on the line within `time`, at most `most` bytes.
pub fn listen(link: &Link, clock: Clock, time: Duration, most: usize) -> Result<Vec<u8>, Lost> {
    let end = clock.now() + time;
    let mut heard = Vec::new();
    let mut buffer = [0; 512];
    while heard.len() < most && clock.now() < end {
        let mut descriptors = [PollFd::from_borrowed_fd(link.as_fd(), PollFlags::IN)];
        match poll(&mut descriptors, Some(&timespec(clock.until(end)))) {
            Ok(_) | Err(rustix::io::Errno::INTR) => {}
            Err(error) => return Err(Lost(error.to_string())),
        }
        if let Some(count) = link.read(&mut buffer)? {
            heard.extend_from_slice(&buffer[..count]);
        }
    }
    Ok(heard)
}
