//! Modbus TCP devices that answer each read a fixed time after it came, all on one thread. Every listener
//! is one gateway, behind which every unit is there.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use crate::clock::{now, prefer_this_thread, wake_exactly};

pub struct Servers {
    pub ports: Vec<u16>,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    stop: AtomicBool,
    registers: AtomicU64,
    requests: AtomicU64,
}

impl Servers {
    /// The first register of every unit counts up `new_value_every`; the others stay.
    pub fn start(count: usize, latency: Duration, new_value_every: Duration) -> anyhow::Result<Servers> {
        let mut listeners = Vec::new();
        for _ in 0..count {
            let listener = TcpListener::bind("127.0.0.1:0")?;
            listener.set_nonblocking(true)?;
            listeners.push(listener);
        }
        let ports = listeners
            .iter()
            .map(|listener| Ok(listener.local_addr()?.port()))
            .collect::<anyhow::Result<_>>()?;
        let shared = Arc::new(Shared::default());
        let of_thread = shared.clone();
        let thread = std::thread::Builder::new().name("servers".into()).spawn(move || {
            wake_exactly();
            prefer_this_thread();
            let times = Times {
                latency: latency.as_nanos() as i64,
                new_value_every: new_value_every.as_nanos() as i64,
            };
            serve(&listeners, &of_thread, times);
        })?;
        Ok(Servers { ports, shared, thread: Some(thread) })
    }

    /// How many registers were told so far.
    pub fn registers(&self) -> u64 {
        self.shared.registers.load(Ordering::Relaxed)
    }

    pub fn requests(&self) -> u64 {
        self.shared.requests.load(Ordering::Relaxed)
    }
}

impl Drop for Servers {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

#[derive(Clone, Copy)]
struct Times {
    latency: i64,
    new_value_every: i64,
}

struct Connection {
    /// Puts off the moments at which its values change, so that not all change at once.
    offset: i64,
    stream: TcpStream,
    heard: Vec<u8>,
    /// What to say, and when.
    reply: Option<(i64, Vec<u8>)>,
}

fn serve(listeners: &[TcpListener], shared: &Shared, times: Times) {
    let mut connections: Vec<Connection> = Vec::new();
    while !shared.stop.load(Ordering::Relaxed) {
        let readable = wait(listeners, &connections);
        let (of_listeners, of_connections) = readable.split_at(listeners.len());
        let mut gone = Vec::new();
        for (index, connection) in connections.iter_mut().enumerate() {
            let heard = !of_connections[index] || connection.hear(shared, times);
            if !(heard && connection.speak()) {
                gone.push(index);
            }
        }
        gone.into_iter().rev().for_each(|index| drop(connections.swap_remove(index)));
        for (listener, _) in listeners.iter().zip(of_listeners).filter(|(_, called)| **called) {
            if let Ok((stream, _)) = listener.accept() {
                let ready = stream.set_nodelay(true).and_then(|()| stream.set_nonblocking(true));
                if ready.is_ok() {
                    let offset = connections.len() as i64 * 13_000_000;
                    connections.push(Connection { offset, stream, heard: Vec::new(), reply: None });
                }
            }
        }
    }
}

/// Sleeps until somebody speaks or a reply is due; tells who can be read.
fn wait(listeners: &[TcpListener], connections: &[Connection]) -> Vec<bool> {
    let due = connections.iter().filter_map(|connection| Some(connection.reply.as_ref()?.0)).min();
    let until = due.map_or(50_000_000, |due| (due - now()).clamp(0, 50_000_000));
    let descriptor = |fd| PollFd::from_borrowed_fd(fd, PollFlags::IN);
    let all = listeners.iter().map(AsFd::as_fd).chain(connections.iter().map(|connection| connection.fd()));
    let mut descriptors: Vec<PollFd<'_>> = all.map(descriptor).collect();
    let timeout = Timespec { tv_sec: 0, tv_nsec: until };
    let _ = poll(&mut descriptors, Some(&timeout));
    descriptors.iter().map(|descriptor| !descriptor.revents().is_empty()).collect()
}

impl Connection {
    fn fd(&self) -> BorrowedFd<'_> {
        self.stream.as_fd()
    }

    /// `false` when the other side has gone.
    fn hear(&mut self, shared: &Shared, times: Times) -> bool {
        let mut buffer = [0; 1024];
        match self.stream.read(&mut buffer) {
            Ok(0) => return false,
            Ok(count) => self.heard.extend_from_slice(&buffer[..count]),
            Err(error) => return error.kind() == std::io::ErrorKind::WouldBlock,
        }
        // One request is under way at a time, and every one that is asked here has twelve bytes.
        if self.heard.len() < 12 {
            return true;
        }
        let request: Vec<u8> = self.heard.drain(..12).collect();
        let count = u16::from_be_bytes([request[10], request[11]]).min(125);
        let offset = self.offset + i64::from(request[6]) * 29_000_000;
        let value = ((now() + offset) / times.new_value_every) as u16;
        let mut reply = request[..4].to_vec();
        reply.extend((count * 2 + 3).to_be_bytes());
        reply.extend([request[6], request[7], count as u8 * 2]);
        reply.extend(
            (0..count).flat_map(|register| if register == 0 { value } else { 1000 + register }.to_be_bytes()),
        );
        shared.registers.fetch_add(u64::from(count), Ordering::Relaxed);
        shared.requests.fetch_add(1, Ordering::Relaxed);
        self.reply = Some((now() + times.latency, reply));
        true
    }

    fn speak(&mut self) -> bool {
        match self.reply.take_if(|(due, _)| *due <= now()) {
            Some((_, reply)) => self.stream.write_all(&reply).is_ok(),
            None => true,
        }
    }
}
