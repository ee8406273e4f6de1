//! One port or address by hand: as arguments name it, and opened with one line's settings after the other.

use crate::edge::clock::Clock;
use crate::edge::guarded_link::GuardedLink;
use crate::edge::link::{Link, Lost};
use crate::engine::modbus::guard::Guard;
use crate::engine::settings::{self, Line, Rs485};
use crate::engine::time::Duration;

use super::Failure;

/// One port or address, opened with one line's settings after the other.
pub struct Reach {
    link: settings::Link,
    clock: Clock,
    /// Silence behind each opening.
    pub connect_delay: Duration,
    /// With the settings that it was opened with.
    open: Option<(Option<Line>, GuardedLink)>,
}

impl Reach {
    pub fn new(link: settings::Link, clock: Clock) -> Reach {
        Reach { link, clock, connect_delay: Duration::ZERO, open: None }
    }

    /// The link, open with these settings (of Modbus TCP none) and strict about parity.
    pub fn at(&mut self, line: Option<Line>) -> Result<&mut GuardedLink, Lost> {
        // What is open with others is closed first, since a port is open only once.
        let open = match self.open.take().filter(|(open, _)| *open == line) {
            Some(open) => open,
            None => (line, self.opened(line)?),
        };
        Ok(&mut self.open.insert(open).1)
    }

    /// The settings that it is open with; `None`: it is not.
    pub fn open_with(&self) -> Option<Option<Line>> {
        self.open.as_ref().map(|(line, _)| *line)
    }

    /// Forgets a link that is of no use any more.
    pub fn close(&mut self) {
        self.open = None;
    }

    fn opened(&self, line: Option<Line>) -> Result<GuardedLink, Lost> {
        use settings::Link::{RtuOverTcp, Serial};
        let mut link = self.link.clone();
        if let (Serial { line: set, .. } | RtuOverTcp { line: set, .. }, Some(line)) = (&mut link, line) {
            *set = line;
        }
        let opened = Link::open_strict(&link)?;
        std::thread::sleep(self.connect_delay);
        Ok(GuardedLink::new(opened, Guard::new(&link, None), self.clock))
    }
}

/// The link that is named by `--serial`, `--tcp` or `--rtu-over-tcp`, in this order; `None`: none is.
pub fn link(
    [serial, tcp, rtu_over_tcp]: [&Option<String>; 3],
    line: Line,
) -> Result<Option<settings::Link>, Failure> {
    Ok(Some(match (serial, tcp, rtu_over_tcp) {
        (Some(path), ..) => settings::Link::Serial { path: path.clone(), line, rs485: Rs485::Auto },
        (_, Some(address), _) => {
            let (host, port) = read_address(address)?;
            settings::Link::Tcp { host, port }
        }
        (.., Some(address)) => {
            let (host, port) = read_address(address)?;
            settings::Link::RtuOverTcp { host, port, line }
        }
        _ => return Ok(None),
    }))
}

fn read_address(address: &str) -> Result<(String, u16), Failure> {
    match address.rsplit_once(':') {
        Some((host, port)) if !host.is_empty() && (!host.contains(':') || host.ends_with(']')) => {
            let number =
                port.parse().map_err(|_| Failure::wrong(format!("`{port}` in `{address}` is no port")))?;
            Ok((host.trim_matches(['[', ']']).to_owned(), number))
        }
        None if !address.is_empty() => Ok((address.to_owned(), 502)),
        _ => Err(Failure::wrong(format!("`{address}` is no address; expected one like `192.168.1.20:502`"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_is_a_host_and_perhaps_a_port() {
        let parts = |text: &str| read_address(text).ok();
        assert_eq!(parts("192.168.1.20:1502"), Some(("192.168.1.20".into(), 1502)));
        assert_eq!(parts("plc.local"), Some(("plc.local".into(), 502)));
        assert_eq!(parts("[::1]:502"), Some(("::1".into(), 502)));
        for wrong in ["", ":502", "host:port", "host:70000", "::1"] {
            assert_eq!(parts(wrong), None, "{wrong}");
        }
    }
}
