//! The program's way to the broker, which can be closed: the connections end, and new ones too.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Mutex};

use busker::edge::lock::lock;

pub struct Gate {
    pub port: u16,
    state: Arc<Mutex<State>>,
}

struct State {
    is_open: bool,
    sockets: Vec<TcpStream>,
}

impl Gate {
    /// An open gate before the broker at `broker`.
    pub fn before(broker: u16) -> anyhow::Result<Gate> {
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let port = listener.local_addr()?.port();
        let state = Arc::new(Mutex::new(State { is_open: true, sockets: Vec::new() }));
        let of_thread = state.clone();
        std::thread::Builder::new().name("gate".into()).spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                // Whoever is not let through is closed here.
                let _ = let_through(&of_thread, client, broker);
            }
        })?;
        Ok(Gate { port, state })
    }

    pub fn close(&self) {
        let mut state = lock(&self.state);
        state.is_open = false;
        for socket in state.sockets.drain(..) {
            // It may have ended by itself.
            let _ = socket.shutdown(Shutdown::Both);
        }
    }

    pub fn open(&self) {
        lock(&self.state).is_open = true;
    }
}

fn let_through(state: &Mutex<State>, client: TcpStream, broker: u16) -> std::io::Result<()> {
    let mut state = lock(state);
    if !state.is_open {
        return Ok(());
    }
    let broker = TcpStream::connect(("127.0.0.1", broker))?;
    for (from, to) in [(client.try_clone()?, broker.try_clone()?), (broker.try_clone()?, client.try_clone()?)]
    {
        from.set_nodelay(true)?;
        std::thread::Builder::new().name("way".into()).spawn(move || pass_on(from, to))?;
    }
    state.sockets.extend([client, broker]);
    Ok(())
}

fn pass_on(mut from: TcpStream, mut to: TcpStream) {
    let mut bytes = vec![0; 1 << 16];
    loop {
        match from.read(&mut bytes) {
            Ok(count) if count > 0 && to.write_all(&bytes[..count]).is_ok() => {}
            _ => break,
        }
    }
    // The other side may have gone already.
    let _ = from.shutdown(Shutdown::Both);
    let _ = to.shutdown(Shutdown::Both);
}
