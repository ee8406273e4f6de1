//! Where a bus leads, and how its port is set.

use super::{Resolver, file, read_part, told};
use crate::engine::configuration::words::{HostPort, Name};
use crate::engine::settings::{Direction, Line, Link, Parity, Rs485};
use crate::engine::time::Duration;
use crate::engine::yaml::At;

impl Resolver<'_> {
    pub(super) fn serial_port(&mut self, port: &At<String>, others: &[&At<String>]) {
        let path = port.as_str();
        if !path.starts_with('/') {
            self.faults.add(
                &port.place,
                format!("`{path}` is no path of a serial port; expected one like `/dev/serial/by-id/usb-…`"),
            );
        } else if path.starts_with("/dev/ttyUSB") || path.starts_with("/dev/ttyACM") {
            self.warnings.add(
                &port.place,
                format!(
                    "`{path}` may be another adapter after the next start; \
                     use its path under `/dev/serial/by-id/`"
                ),
            );
        }
        if let Some(other) = others.iter().find(|other| other.value == port.value) {
            let line = other.place.line();
            self.faults.add(
                &port.place,
                format!("`{path}` is the port of the bus in line {line} already; a port serves one bus"),
            );
        }
    }

    pub(super) fn link(&mut self, name: &At<Name>, bus: &file::Bus) -> Option<Link> {
        let links = [
            ("serial", bus.serial.as_ref().map(|link| link.get().map(|at| &at.place))),
            ("tcp", bus.tcp.as_ref().map(|link| link.get().map(|at| &at.place))),
            ("rtu_over_tcp", bus.rtu_over_tcp.as_ref().map(|link| link.get().map(|at| &at.place))),
        ];
        let mut given = links.into_iter().filter_map(|(key, link)| Some((key, link?)));
        match given.next() {
            None => self.faults.add(
                &name.place,
                format!(
                    "the bus `{}` leads nowhere; expected one of `serial`, `tcp` or `rtu_over_tcp`",
                    name.0
                ),
            ),
            Some((first, _)) => {
                for (other, place) in given {
                    self.faults.add(
                        place.unwrap_or(&name.place),
                        format!("`{other}` stands beside `{first}`; a bus has one link, keep one of them"),
                    );
                }
            }
        }
        let line = Line {
            baud: read_part(&bus.baud).map_or(19_200, |baud| baud.0),
            parity: read_part(&bus.parity).map_or(Parity::Even, |parity| parity.value),
            stop_bits: read_part(&bus.stop_bits).map_or(1, |stop_bits| stop_bits.0),
        };
        match (&bus.serial, &bus.tcp, &bus.rtu_over_tcp) {
            (Some(path), None, None) => {
                Some(Link::Serial { path: path.get()?.value.clone(), line, rs485: self.rs485(bus) })
            }
            (None, Some(address), None) => {
                self.no_line(bus);
                self.no_port(bus);
                let HostPort { host, port } = self.address(address.get()?);
                Some(Link::Tcp { host, port })
            }
            (None, None, Some(address)) => {
                self.no_port(bus);
                let HostPort { host, port } = self.address(address.get()?);
                Some(Link::RtuOverTcp { host, port, line })
            }
            _ => None,
        }
    }

    /// Notes the keys of a serial line on a bus that has none.
    fn no_line(&mut self, bus: &file::Bus) {
        let keys = [
            ("baud", read_part(&bus.baud).map(|baud| &baud.place)),
            ("parity", read_part(&bus.parity).map(|parity| &parity.place)),
            ("stop_bits", read_part(&bus.stop_bits).map(|stop_bits| &stop_bits.place)),
        ];
        for (key, place) in keys {
            if let Some(place) = place {
                self.faults.add(
                    place,
                    format!(
                        "Modbus TCP has no `{key}`; remove it, or write `rtu_over_tcp` \
                         if a serial server passes the frames of a line through"
                    ),
                );
            }
        }
    }

    /// Notes the keys of a serial port on a bus that has none.
    fn no_port(&mut self, bus: &file::Bus) {
        let place = match read_part(&bus.rs485) {
            Some(file::Rs485::Word(word)) => &word.place,
            Some(file::Rs485::Kernel(kernel)) => &kernel.place,
            None => return,
        };
        let message = "`rs485` is for a serial port of this machine; remove it: what is behind the network \
                       switches its own transceiver";
        self.faults.add(place, message);
    }

    fn rs485(&mut self, bus: &file::Bus) -> Rs485 {
        match read_part(&bus.rs485) {
            None => Rs485::Auto,
            Some(file::Rs485::Word(word)) => word.value,
            Some(file::Rs485::Kernel(kernel)) => {
                for delay in [&kernel.delay_before_send, &kernel.delay_after_send] {
                    self.within(Some(delay), Duration::ZERO, Direction::DELAY_MAX);
                    if delay.as_micros() % 1000 != 0 {
                        let found = told(delay.value);
                        self.faults.add(
                            &delay.place,
                            format!("{found} is no whole number of milliseconds, in which the kernel counts"),
                        );
                    }
                }
                Rs485::Kernel(Direction {
                    rts_on_send: kernel.rts_on_send,
                    delay_before_send: kernel.delay_before_send.value,
                    delay_after_send: kernel.delay_after_send.value,
                })
            }
        }
    }

    fn address(&mut self, address: &At<HostPort>) -> HostPort {
        if address.port == 0 {
            self.faults.add(&address.place, "nothing listens on port 0; Modbus TCP is usually on 502");
        }
        address.value.clone()
    }
}
