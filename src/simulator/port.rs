//! The doors of a simulation: a pseudo-terminal, a socket. Moves bytes and keeps their times.

use std::collections::VecDeque;
use std::net::{SocketAddr, TcpListener};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::JoinHandle;

use anyhow::{Context, bail};
use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};
use rustix::io::Errno;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{ControlModes, InputModes, OptionalActions, tcgetattr, tcsetattr};

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{LineSettings, Parity};
use crate::simulator::line::Transmission;
use crate::simulator::server::Shared;
use crate::simulator::wire::{Framing, Received, Receiver};

/// A pseudo-terminal that is served until this is dropped.
pub struct PtyPort {
    shared: Arc<Shared>,
    link: Option<PathBuf>,
    /// `None` while unplugged.
    plugged: Option<Plugged>,
}

struct Plugged {
    terminal_path: PathBuf,
    /// Held open so that the controlling side sees no hang-up when a client closes it.
    _terminal: OwnedFd,
    // After the terminal: the thread ends, and the controlling side with it, when this is dropped.
    _thread: Thread,
}

impl PtyPort {
    pub(super) fn open(shared: Arc<Shared>, link: Option<PathBuf>) -> anyhow::Result<PtyPort> {
        let mut port = PtyPort { shared, link, plugged: None };
        port.replug()?;
        Ok(port)
    }

    /// What a client opens: the link, or `/dev/pts/N` where there is none.
    pub fn path(&self) -> &Path {
        match (&self.link, &self.plugged) {
            (Some(link), _) => link,
            (None, Some(plugged)) => &plugged.terminal_path,
            (None, None) => Path::new("/dev/null"),
        }
    }

    /// Takes the adapter out: a client that has it open gets a hang-up, and the link is gone.
    pub fn unplug(&mut self) {
        if let Some(plugged) = self.plugged.take() {
            if let Some(link) = &self.link {
                // Only a link that is still ours.
                if std::fs::read_link(link).is_ok_and(|target| target == plugged.terminal_path) {
                    let _ = std::fs::remove_file(link);
                }
            }
        }
    }

    /// Puts the adapter back in, at the same link and perhaps another `/dev/pts/N`.
    pub fn replug(&mut self) -> anyhow::Result<()> {
        if self.plugged.is_some() {
            return Ok(());
        }
        let controller = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)
            .context("no pseudo-terminal")?;
        grantpt(&controller)?;
        unlockpt(&controller)?;
        let name = ptsname(&controller, Vec::new())?.into_string()?;
        let terminal_path = PathBuf::from(name);
        let flags = rustix::fs::OFlags::RDWR | rustix::fs::OFlags::NOCTTY | rustix::fs::OFlags::CLOEXEC;
        let terminal = rustix::fs::open(&terminal_path, flags, rustix::fs::Mode::empty())
            .with_context(|| terminal_path.display().to_string())?;
        let mut attributes = tcgetattr(&terminal)?;
        attributes.make_raw();
        tcsetattr(&terminal, OptionalActions::Now, &attributes)?;
        rustix::io::ioctl_fionbio(&controller, true)?;
        if let Some(link) = &self.link {
            make_link(&terminal_path, link)?;
        }
        let shared = Arc::clone(&self.shared);
        let thread = Thread::spawn("simulated line", move |stop| {
            let counts = shared.heeds_settings;
            serve(&shared, controller.as_fd(), stop, Framing::Rtu, counts);
        })?;
        self.plugged = Some(Plugged { terminal_path, _terminal: terminal, _thread: thread });
        Ok(())
    }
}

impl Drop for PtyPort {
    fn drop(&mut self) {
        self.unplug();
    }
}

/// Links `link` to `target`, and replaces a link that an earlier run has left.
fn make_link(target: &Path, link: &Path) -> anyhow::Result<()> {
    match std::fs::symlink_metadata(link) {
        Ok(there) if there.file_type().is_symlink() => std::fs::remove_file(link)?,
        Ok(_) => bail!("`{}` is there and no symbolic link; name another place", link.display()),
        Err(_) => {}
    }
    std::os::unix::fs::symlink(target, link).with_context(|| format!("link `{}`", link.display()))
}

/// A listening socket that is served until this is dropped.
pub struct TcpPort {
    address: SocketAddr,
    _thread: Thread,
}

impl TcpPort {
    pub(super) fn open(shared: Arc<Shared>, address: &str, framing: Framing) -> anyhow::Result<TcpPort> {
        let listener = TcpListener::bind(address).with_context(|| format!("listen on `{address}`"))?;
        let address = listener.local_addr()?;
        let thread = Thread::spawn("simulated listener", move |stop| {
            let mut connections = Vec::new();
            while wait(listener.as_fd(), stop, None) == Woken::Readable {
                let Ok((stream, _)) = listener.accept() else { continue };
                if stream.set_nodelay(true).and_then(|()| stream.set_nonblocking(true)).is_err() {
                    continue;
                }
                let shared = Arc::clone(&shared);
                let connection = Thread::spawn("simulated connection", move |stop| {
                    serve(&shared, stream.as_fd(), stop, framing, false);
                });
                connections.retain(|connection: &Thread| !connection.is_finished());
                connections.extend(connection.ok());
            }
        })?;
        Ok(TcpPort { address, _thread: thread })
    }

    /// Where it listens, with the port that it really has.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

/// A thread that is told to stop and waited for when this is dropped.
struct Thread {
    stop: Arc<OwnedFd>,
    thread: Option<JoinHandle<()>>,
}

impl Thread {
    fn spawn(name: &str, run: impl FnOnce(BorrowedFd<'_>) + Send + 'static) -> anyhow::Result<Thread> {
        let stop = Arc::new(eventfd(0, EventfdFlags::CLOEXEC)?);
        let for_thread = Arc::clone(&stop);
        let thread = std::thread::Builder::new().name(name.into()).spawn(move || run(for_thread.as_fd()))?;
        Ok(Thread { stop, thread: Some(thread) })
    }

    fn is_finished(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }
}

impl Drop for Thread {
    fn drop(&mut self) {
        // The number stays in the descriptor: whoever polls it from now on is told at once.
        let _ = rustix::io::write(&self.stop, &1u64.to_ne_bytes());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Why a wait ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Woken {
    Readable,
    Time,
    Stop,
}

/// Waits for bytes, the end, or `timeout`.
fn wait(input: BorrowedFd<'_>, stop: BorrowedFd<'_>, timeout: Option<Duration>) -> Woken {
    let mut descriptors = [PollFd::new(&stop, PollFlags::IN), PollFd::new(&input, PollFlags::IN)];
    let timeout = timeout.map(|timeout| Timespec {
        tv_sec: timeout.as_secs() as i64,
        tv_nsec: i64::from(timeout.subsec_nanos()) as _,
    });
    match poll(&mut descriptors, timeout.as_ref()) {
        Ok(_) if !descriptors[0].revents().is_empty() => Woken::Stop,
        Ok(_) if !descriptors[1].revents().is_empty() => Woken::Readable,
        Ok(_) | Err(Errno::INTR) => Woken::Time,
        Err(_) => Woken::Stop,
    }
}

/// What the program at the other side of a pseudo-terminal has set. Linux takes the flag of the parity itself
/// away there; whether it is checked stays, and says it for programs that check it.
fn settings_at(controller: BorrowedFd<'_>) -> Option<LineSettings> {
    let attributes = tcgetattr(controller).ok()?;
    let is_checked = attributes.input_modes.contains(InputModes::INPCK);
    let parity = match (is_checked, attributes.control_modes.contains(ControlModes::PARODD)) {
        (false, _) => Parity::None,
        (true, false) => Parity::Even,
        (true, true) => Parity::Odd,
    };
    Some(LineSettings { baud: attributes.output_speed(), parity })
}

/// Reads requests and writes replies at their times, until `stop` or until the peer is gone. `counts`: with which
/// settings a request was sent.
fn serve(shared: &Shared, stream: BorrowedFd<'_>, stop: BorrowedFd<'_>, framing: Framing, counts: bool) {
    let mut receiver = Receiver::new(framing, shared.line_settings());
    let mut outgoing: VecDeque<Transmission> = VecDeque::new();
    let mut buffer = [0; 512];
    loop {
        let due: Option<Time> =
            receiver.deadline().into_iter().chain(outgoing.front().map(|next| next.at)).min();
        match wait(stream, stop, due.map(|due| shared.clock.until(due))) {
            Woken::Stop => return,
            Woken::Time => {}
            Woken::Readable => match rustix::io::read(stream, &mut buffer) {
                Ok(0) => return,
                Ok(count) => receiver.push(shared.clock.now(), &buffer[..count]),
                Err(Errno::AGAIN | Errno::INTR) => {}
                Err(_) => return,
            },
        }
        while let Some(received) = receiver.next(shared.clock.now()) {
            let settings = if counts { settings_at(stream) } else { None };
            outgoing.extend(shared.hear(framing, &received, settings));
            outgoing.make_contiguous().sort_by_key(|transmission| transmission.at);
            if received == Received::NotModbus {
                return;
            }
        }
        while outgoing.front().is_some_and(|next| next.at <= shared.clock.now()) {
            let Some(next) = outgoing.pop_front() else { break };
            // Nobody reads what does not fit any more: on a wire those bytes would be lost.
            match rustix::io::write(stream, &next.bytes) {
                Ok(count) if count == next.bytes.len() || framing == Framing::Rtu => {}
                Err(Errno::AGAIN) if framing == Framing::Rtu => {}
                _ => return,
            }
        }
    }
}
