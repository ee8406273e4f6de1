//! A TCP connection, for Modbus TCP and for RTU frames through a serial server.

use std::net::{TcpStream, ToSocketAddrs};

use crate::edge::link::Lost;
use crate::engine::settings;
use crate::engine::time::Duration;

/// How long each address of a host is tried.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);

pub fn connect(host: &str, port: u16) -> Result<TcpStream, Lost> {
    let lost = |error: std::io::Error| {
        Lost(format!("`{}` cannot be reached: {error}", settings::host_and_port(host, port)))
    };
    let mut failure = Lost(format!("`{host}` has no address"));
    for address in (host, port).to_socket_addrs().map_err(lost)? {
        match TcpStream::connect_timeout(&address, CONNECT_TIMEOUT) {
            Ok(stream) => {
                // A request is one small packet and must not wait for a second.
                stream.set_nodelay(true).map_err(lost)?;
                stream.set_nonblocking(true).map_err(lost)?;
                return Ok(stream);
            }
            Err(error) => failure = lost(error),
        }
    }
    Err(failure)
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;
    use crate::edge::clock::Clock;
    use crate::edge::link::Link;

    #[test]
    fn a_server_that_takes_nothing_keeps_no_thread_waiting() {
        let server = TcpListener::bind("127.0.0.1:0").expect("a port");
        let port = server.local_addr().expect("a port").port();
        let link = Link::Tcp(connect("127.0.0.1", port).expect("it listens"));
        let clock = Clock::start();
        // Some megabytes fit into what the kernel keeps.
        let lost = loop {
            let began = clock.now();
            if let Err(lost) = link.write(&[0; 4096]) {
                break (lost, clock.now() - began);
            }
        };
        assert_eq!(lost.0, Lost("nothing can be written to it".into()));
        assert!(lost.1 < Duration::from_secs(1), "{:?}", lost.1);
    }
}
