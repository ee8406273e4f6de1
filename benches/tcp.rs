//! Modbus TCP devices that answer each read a fixed time after it came, all on one thread. Every listener
//! is one gateway, behind which every unit is there.
//!
//! Devices have processors of their own, which answer when they want to and not when the machine that asks
//! has time. So the thread has a core for itself, where there are two, and spins while a reply is due.

use std::collections::VecDeque;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::buffer::spare_capacity;
use rustix::event::{Timespec, epoll};

use crate::clock::{now, prefer_this_thread, wake_exactly};
use crate::cores::Apart;

pub struct Servers {
    pub ports: Vec<u16>,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    /// What the program runs on, and everything else that this thread starts.
    _others: Option<Apart>,
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
        let times =
            Times { latency: latency.as_nanos() as i64, new_value_every: new_value_every.as_nanos() as i64 };
        let mut devices = Devices::new(listeners, shared.clone(), times)?;
        let others = Apart::split();
        let own_core = others.as_ref().map(Apart::kept_free);
        let thread = std::thread::Builder::new().name("servers".into()).spawn(move || {
            wake_exactly();
            prefer_this_thread();
            let has_own_core = own_core.is_some_and(|core| core.take());
            devices.serve(has_own_core);
        })?;
        Ok(Servers { ports, shared, thread: Some(thread), _others: others })
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

struct Devices {
    listeners: Vec<TcpListener>,
    /// By their numbers; one that is gone leaves its place empty.
    connections: Vec<Option<Connection>>,
    epoll: OwnedFd,
    /// When each connection speaks next. All wait equally long: what came first is first.
    due: VecDeque<(i64, usize)>,
    shared: Arc<Shared>,
    times: Times,
}

struct Connection {
    stream: TcpStream,
    /// Puts off the moments at which its values change, so that not all change at once.
    offset: i64,
    reply: Vec<u8>,
}

/// Every request that is asked here has so many bytes, and one is under way at a time.
const REQUEST: usize = 12;
/// Nothing is due: whether it is time to end is looked at so often.
const IDLE: i64 = 50_000_000;

impl Devices {
    fn new(listeners: Vec<TcpListener>, shared: Arc<Shared>, times: Times) -> anyhow::Result<Devices> {
        let epoll = epoll::create(epoll::CreateFlags::CLOEXEC)?;
        for (number, listener) in listeners.iter().enumerate() {
            let data = epoll::EventData::new_u64(number as u64);
            epoll::add(&epoll, listener, data, epoll::EventFlags::IN)?;
        }
        let (connections, due) = (Vec::new(), VecDeque::new());
        Ok(Devices { listeners, connections, epoll, due, shared, times })
    }

    fn serve(&mut self, has_own_core: bool) {
        let mut called = Vec::with_capacity(64);
        while !self.shared.stop.load(Ordering::Relaxed) {
            let timeout = match self.due.front() {
                Some(_) if has_own_core => 0,
                Some((due, _)) => (due - now()).clamp(0, IDLE),
                None => IDLE,
            };
            let timeout = Timespec { tv_sec: 0, tv_nsec: timeout };
            let _ = epoll::wait(&self.epoll, spare_capacity(&mut called), Some(&timeout));
            for event in called.drain(..) {
                let number = event.data.u64() as usize;
                match number.checked_sub(self.listeners.len()) {
                    None => self.accept(number),
                    Some(number) => self.hear(number),
                }
            }
            while self.due.front().is_some_and(|(due, _)| *due <= now()) {
                if let Some((_, number)) = self.due.pop_front() {
                    self.speak(number);
                }
            }
        }
    }

    fn accept(&mut self, listener: usize) {
        let Ok((stream, _)) = self.listeners[listener].accept() else { return };
        let number = self.connections.len();
        let data = epoll::EventData::new_u64((self.listeners.len() + number) as u64);
        let ready = stream.set_nodelay(true).and_then(|()| stream.set_nonblocking(true));
        if ready.is_ok() && epoll::add(&self.epoll, &stream, data, epoll::EventFlags::IN).is_ok() {
            let offset = number as i64 * 13_000_000;
            self.connections.push(Some(Connection { stream, offset, reply: Vec::new() }));
        }
    }

    fn hear(&mut self, number: usize) {
        let Some(connection) = &mut self.connections[number] else { return };
        let mut request = [0; REQUEST];
        match connection.stream.read(&mut request) {
            Ok(REQUEST) => {
                let count = connection.answer(request, self.times.new_value_every);
                self.shared.registers.fetch_add(u64::from(count), Ordering::Relaxed);
                self.shared.requests.fetch_add(1, Ordering::Relaxed);
                self.due.push_back((now() + self.times.latency, number));
            }
            Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => {}
            // It has gone, or asks what nobody asks here.
            _ => self.connections[number] = None,
        }
    }

    fn speak(&mut self, number: usize) {
        let Some(connection) = &mut self.connections[number] else { return };
        if connection.stream.write_all(&connection.reply).is_err() {
            self.connections[number] = None;
        }
    }
}

impl Connection {
    /// Makes the reply, and says how many registers are in it.
    fn answer(&mut self, request: [u8; REQUEST], new_value_every: i64) -> u16 {
        let count = u16::from_be_bytes([request[10], request[11]]).min(125);
        let offset = self.offset + i64::from(request[6]) * 29_000_000;
        let value = ((now() + offset) / new_value_every) as u16;
        self.reply.clear();
        self.reply.extend_from_slice(&request[..4]);
        self.reply.extend((count * 2 + 3).to_be_bytes());
        self.reply.extend([request[6], request[7], count as u8 * 2]);
        for register in 0..count {
            let word = if register == 0 { value } else { 1000 + register };
            self.reply.extend(word.to_be_bytes());
        }
        count
    }
}
