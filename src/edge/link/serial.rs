//! A serial port, raw: eight data bits, no flow control, no line discipline.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::Path;

use rustix::fs::{FlockOperation, Mode, OFlags, flock, open};
use rustix::io::Errno;
use rustix::termios::{self, ControlModes, InputModes, OptionalActions, QueueSelector, SpecialCodeIndex};

use crate::edge::link::{Lost, adapter, driver};
use crate::engine::settings::{Direction, Line, Parity, Rs485};

/// An open port that no other program can open.
#[derive(Debug)]
pub struct Port {
    descriptor: OwnedFd,
}

impl Port {
    pub fn open(path: &str, line: Line, rs485: Rs485) -> Result<Port, Lost> {
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let descriptor = open(path, flags, Mode::empty()).map_err(|error| why_not_opened(path, error))?;
        // Two locks: programs that know only one of them are kept out as well.
        flock(&descriptor, FlockOperation::NonBlockingLockExclusive)
            .map_err(|error| why_not_opened(path, error))?;
        configure(&descriptor, line).map_err(|error| match error {
            Errno::NOTTY => Lost(format!("`{path}` is no serial port")),
            error => Lost(format!("`{path}` does not take {} baud: {error}", line.baud)),
        })?;
        termios::ioctl_tiocexcl(&descriptor).map_err(|error| why_not_opened(path, error))?;
        let port = Port { descriptor };
        switch_direction(&port.descriptor, path, rs485)?;
        // It only makes a reply be heard sooner; many drivers have nothing to hurry.
        if let Err(error) = driver::set_low_latency(&port.descriptor) {
            tracing::debug!("`{path}`: its driver knows no low latency: {error}");
        }
        Ok(port)
    }

    /// From here on a byte whose parity is wrong is read as 0, and spoils its frame. Otherwise a device with
    /// another parity, which does not check ours, would be heard as if it had the right one.
    pub fn check_parity(&self, parity: Parity) -> Result<(), Errno> {
        let mut settings = termios::tcgetattr(&self.descriptor)?;
        settings.input_modes.set(InputModes::INPCK, parity != Parity::None);
        termios::tcsetattr(&self.descriptor, OptionalActions::Now, &settings)
    }
}

impl AsFd for Port {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.descriptor.as_fd()
    }
}

impl Drop for Port {
    fn drop(&mut self) {
        // A terminal that somebody else holds open would stay exclusive. On an unplugged one it
        // fails, and does not matter.
        let _ = termios::ioctl_tiocnxcl(&self.descriptor);
    }
}

fn configure(descriptor: &OwnedFd, line: Line) -> Result<(), Errno> {
    let mut settings = termios::tcgetattr(descriptor)?;
    settings.make_raw();
    // A read returns what is there, and 0 only when the adapter is gone.
    settings.special_codes[SpecialCodeIndex::VMIN] = 1;
    settings.special_codes[SpecialCodeIndex::VTIME] = 0;
    settings.input_modes &= !(InputModes::INPCK | InputModes::IXOFF | InputModes::IXANY);
    let modes = &mut settings.control_modes;
    *modes &= !(ControlModes::CSIZE
        | ControlModes::PARENB
        | ControlModes::PARODD
        | ControlModes::CSTOPB
        | ControlModes::CRTSCTS);
    *modes |= ControlModes::CS8 | ControlModes::CREAD | ControlModes::CLOCAL;
    *modes |= match line.parity {
        Parity::None => ControlModes::empty(),
        Parity::Even => ControlModes::PARENB,
        Parity::Odd => ControlModes::PARENB | ControlModes::PARODD,
    };
    if line.stop_bits == 2 {
        *modes |= ControlModes::CSTOPB;
    }
    settings.set_speed(line.baud)?;
    termios::tcsetattr(descriptor, OptionalActions::Now, &settings)?;
    // The kernel reports no error for a speed that the driver refused.
    if termios::tcgetattr(descriptor)?.output_speed() != line.baud {
        return Err(Errno::INVAL);
    }
    termios::tcflush(descriptor, QueueSelector::IOFlush)
}

fn switch_direction(descriptor: &OwnedFd, path: &str, rs485: Rs485) -> Result<(), Lost> {
    let wanted = match rs485 {
        // Never switched on unasked: where RTS has another meaning, an adapter that switches by itself
        // would be broken.
        Rs485::Auto => return Ok(()),
        Rs485::Kernel(direction) => Some(direction),
        // A driver that cannot switch does not.
        Rs485::None if !matches!(driver::direction(descriptor), Ok(Some(_))) => return Ok(()),
        Rs485::None => None,
    };
    let refused = |why: String| {
        let driver = adapter::driver(Path::new(path)).map_or(String::new(), |name| format!(" `{name}`"));
        Lost(format!("`{path}`: its driver{driver} {why}"))
    };
    match driver::set_direction(descriptor, wanted) {
        Ok(set) if set == wanted => Ok(()),
        Ok(Some(set)) if wanted.is_some() => {
            let Direction { rts_on_send, delay_before_send, delay_after_send } = set;
            let on_send = if rts_on_send { "on" } else { "off" };
            Err(refused(format!(
                "takes `rs485` only in part: RTS is {on_send} on send, {} ms before and {} ms after it; \
                 write that, or leave `rs485` out if the adapter switches by itself",
                delay_before_send.as_millis(),
                delay_after_send.as_millis(),
            )))
        }
        Ok(_) | Err(Errno::NOTTY | Errno::INVAL) => Err(refused(
            "cannot switch an RS485 transceiver; most adapters do it by themselves: leave `rs485` out".into(),
        )),
        Err(error) => Err(refused(format!("does not switch the RS485 transceiver: {error}"))),
    }
}

pub(super) fn why_not_opened(path: &str, error: Errno) -> Lost {
    Lost(match error {
        Errno::NOENT | Errno::NODEV | Errno::NXIO | Errno::IO => {
            format!("`{path}` is not there; is the adapter plugged in?")
        }
        Errno::ACCESS | Errno::PERM => {
            format!("no permission to open `{path}`; add the user to the group that owns it (`dialout`)")
        }
        Errno::BUSY | Errno::WOULDBLOCK => format!("`{path}` is in use by another program"),
        error => format!("`{path}` cannot be opened: {error}"),
    })
}
