//! A link moves bytes: a serial port or a TCP connection, both as a descriptor that never blocks.

pub mod adapter;
pub mod check_up;
pub mod driver;
mod serial;
mod tcp;

use std::fmt;
use std::io::{self, ErrorKind, Read, Write};
use std::net::TcpStream;
use std::os::fd::{AsFd, BorrowedFd};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use crate::engine::settings;
use crate::engine::time::Duration;

/// An open link. Dropping it closes the descriptor at once, so that an adapter that comes back
/// finds its name free.
#[derive(Debug)]
pub enum Link {
    Serial(serial::Port),
    Tcp(TcpStream),
}

/// The link is of no use any more, and why, in words for people.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Lost(pub String);

impl fmt::Display for Lost {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl Link {
    /// Opens the port or connects; this may take seconds. The error says what is wrong and what
    /// would be right.
    pub fn open(settings: &settings::Link) -> Result<Link, Lost> {
        match settings {
            settings::Link::Serial { path, line, rs485 } => {
                serial::Port::open(path, *line, *rs485).map(Link::Serial)
            }
            settings::Link::Tcp { host, port } | settings::Link::RtuOverTcp { host, port, .. } => {
                tcp::connect(host, *port).map(Link::Tcp)
            }
        }
    }

    /// The same for who wants to know whether the settings are right: what comes with another parity is
    /// damaged.
    pub fn open_strict(settings: &settings::Link) -> Result<Link, Lost> {
        let link = Link::open(settings)?;
        if let (Link::Serial(port), settings::Link::Serial { line, .. }) = (&link, settings) {
            port.check_parity(line.parity).map_err(|error| Lost(error.to_string()))?;
        }
        Ok(link)
    }

    /// Reads what is there: `None` when nothing is.
    pub fn read(&self, buffer: &mut [u8]) -> Result<Option<usize>, Lost> {
        let read = match self {
            Link::Serial(port) => rustix::io::read(port, buffer).map_err(io::Error::from),
            // Asks the socket itself, which takes the kernel less than a file does.
            Link::Tcp(stream) => (&mut &*stream).read(buffer),
        };
        match read {
            // End of file: the adapter was unplugged, the other side closed.
            Ok(0) => Err(self.ended()),
            Ok(count) => Ok(Some(count)),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => Ok(None),
            Err(error) => Err(self.failed(error)),
        }
    }

    /// Writes all of a frame.
    pub fn write(&self, mut bytes: &[u8]) -> Result<(), Lost> {
        while !bytes.is_empty() {
            let written = match self {
                Link::Serial(port) => rustix::io::write(port, bytes).map_err(io::Error::from),
                Link::Tcp(stream) => (&mut &*stream).write(bytes),
            };
            match written {
                Ok(count) => bytes = &bytes[count..],
                Err(error) if error.kind() == ErrorKind::WouldBlock => self.wait_for_room()?,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(self.failed(error)),
            }
        }
        Ok(())
    }

    fn wait_for_room(&self) -> Result<(), Lost> {
        let full = Lost("nothing can be written to it".into());
        // A frame is so small that only a connection that takes nothing any more has no room for it. Its
        // thread may serve others, and does not wait.
        if matches!(self, Link::Tcp(_)) {
            return Err(full);
        }
        let mut descriptors = [PollFd::new(self, PollFlags::OUT)];
        match poll(&mut descriptors, Some(&timespec(WRITE_TIMEOUT))) {
            Ok(0) => Err(full),
            Ok(_) | Err(rustix::io::Errno::INTR) => Ok(()),
            Err(error) => Err(self.failed(error.into())),
        }
    }

    fn ended(&self) -> Lost {
        Lost(match self {
            Link::Serial(_) => "unplugged".into(),
            Link::Tcp(_) => "closed by the other side".into(),
        })
    }

    fn failed(&self, error: io::Error) -> Lost {
        use rustix::io::Errno;
        let unplugged = [Errno::IO, Errno::NODEV, Errno::NXIO];
        match (self, rustix::io::Errno::from_io_error(&error)) {
            (Link::Serial(_), Some(errno)) if unplugged.contains(&errno) => self.ended(),
            _ => Lost(error.to_string()),
        }
    }
}

/// A frame that the kernel does not take within this time is written to a dead link.
const WRITE_TIMEOUT: Duration = Duration::from_secs(2);

impl AsFd for Link {
    fn as_fd(&self) -> BorrowedFd<'_> {
        match self {
            Link::Serial(port) => port.as_fd(),
            Link::Tcp(stream) => stream.as_fd(),
        }
    }
}

/// The kernel's words for a duration.
pub fn timespec(duration: Duration) -> Timespec {
    Timespec { tv_sec: duration.as_secs() as i64, tv_nsec: duration.subsec_nanos().into() }
}
