//! The threads that run buses. A line has one of its own, also behind a serial server; Modbus TCP connections
//! share one.
//!
//! Threads and not tasks: the silence between two frames is 2 ms, and a timer that is a millisecond late
//! costs a tenth of a fast line. A connection has no such silence; there it is a thread's waking up that
//! costs most, and one that serves many finds several replies each time.

mod alone;
mod connections;

use std::num::NonZeroU64;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};

use tokio::sync::oneshot;

use crate::edge::bell::Bell;
use crate::edge::bus_runner::{BusRunner, Ears, LOOKS_MAX, Look, Saving};
use crate::edge::clock::Clock;
use crate::edge::lock::lock;
use crate::edge::state_files::Shelf;
use crate::edge::stir::Stir;
use crate::engine::bus::{Bus, Command, Event, Full, Inbox};
use crate::engine::health::BusReport;
use crate::engine::settings::{Link, Settings};
use crate::engine::time::Time;
use crate::engine::topics::Message;

use connections::Connections;

/// Talks to a bus's thread. Dropping it does not stop the thread.
pub struct BusHandle {
    inbox: Arc<Mutex<Inbox>>,
    looks: SyncSender<Look>,
    bell: Bell,
    stop: Arc<AtomicBool>,
    first: BusReport,
    ended: Mutex<Option<Receiver<Saving>>>,
}

impl BusHandle {
    /// Hands an event to the bus; returns the command whose place it took, if it did.
    pub fn send(&self, event: Event) -> Result<Option<Command>, Full> {
        let result = lock(&self.inbox).push(event);
        self.bell.ring();
        result
    }

    /// Runs `look` on the bus's thread, at once, even while a request is in flight. The receiver
    /// fails if the thread has ended or too much waits for it.
    pub fn inspect<T: Send + 'static>(
        &self,
        look: impl FnOnce(&Bus, Time) -> T + Send + 'static,
    ) -> oneshot::Receiver<T> {
        let (sender, receiver) = oneshot::channel();
        let look = move |bus: &Bus, now: Time| {
            // Nobody may be waiting for it any more.
            let _ = sender.send(look(bus, now));
        };
        // What does not fit drops the sender, which the receiver notices.
        let _ = self.looks.try_send(Box::new(look));
        self.bell.ring();
        receiver
    }

    /// How the bus was before anything happened, without points.
    pub fn first_summary(&self) -> BusReport {
        self.first.clone()
    }

    /// Asks the bus to finish the request in flight, refuse what waits, say `offline` and end.
    pub fn shutdown(&self) {
        self.stop.store(true, Ordering::SeqCst);
        self.bell.ring();
    }

    /// Waits for the bus's end, and until what it recorded is saved.
    pub fn join(&self) {
        let Some(ended) = lock(&self.ended).take() else { return };
        match ended.recv() {
            Ok(saving) => saving.into_iter().for_each(|saving| drop(saving.join())),
            Err(_) => tracing::error!("a bus ended in a panic"),
        }
    }
}

/// The threads of a gateway's buses. After it is dropped each ends with its last bus.
pub struct Threads {
    /// The one that all Modbus TCP connections share.
    connections: Mutex<Option<Arc<Connections>>>,
    clock: Clock,
    state: Arc<Shelf>,
    stir: Arc<Stir>,
}

impl Threads {
    /// The threads stir when anything happens but that devices answer as they should.
    pub fn new(clock: Clock, state: Arc<Shelf>, stir: Arc<Stir>) -> Threads {
        Threads { connections: Mutex::default(), clock, state, stir }
    }

    /// Starts the bus number `index` of the settings, which goes on from what is kept in the state. `publish` is called
    /// on its thread and must not wait.
    pub fn start(
        &self,
        settings: Arc<Settings>,
        index: usize,
        publish: Box<dyn Fn(Message) + Send>,
    ) -> std::io::Result<BusHandle> {
        let inbox = Arc::<Mutex<Inbox>>::default();
        let (looks, looks_in) = sync_channel(LOOKS_MAX);
        let (ended, end) = sync_channel(1);
        let stop = Arc::new(AtomicBool::new(false));
        let shares = matches!(settings.buses[index].link, Link::Tcp { .. });
        let connections = if shares { Some(self.connections()?) } else { None };
        let bell = match &connections {
            Some(connections) => connections.bell().clone(),
            None => Bell::new()?,
        };
        let ears = Ears {
            inbox: inbox.clone(),
            looks: looks_in,
            bell: bell.clone(),
            stop: stop.clone(),
            stir: self.stir.clone(),
            ended,
        };
        let name = format!("bus-{}", settings.buses[index].name);
        // Not on the thread: what lives long lies better beside what lives long.
        let runner = BusRunner::new(settings, index, self.clock, self.state.clone(), publish, ears);
        let first = runner.summary();
        match connections {
            Some(connections) => connections.take(runner),
            None => drop(std::thread::Builder::new().name(name).spawn(move || alone::run(runner))?),
        }
        Ok(BusHandle { inbox, looks, bell, stop, first, ended: Mutex::new(Some(end)) })
    }

    /// The thread for connections, which begins with the first of them.
    fn connections(&self) -> std::io::Result<Arc<Connections>> {
        let mut connections = lock(&self.connections);
        let running = match &*connections {
            Some(running) => running.clone(),
            None => Connections::start(self.clock)?,
        };
        *connections = Some(running.clone());
        Ok(running)
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        if let Some(connections) = &*lock(&self.connections) {
            connections.close();
        }
    }
}

/// By default the kernel may wake a thread 50 µs late to save power.
fn wake_punctually() {
    if let Err(error) = rustix::thread::set_current_timer_slack(NonZeroU64::new(1)) {
        tracing::debug!("the timer slack stays as it is: {error}");
    }
}

#[cfg(test)]
#[path = "bus_thread_tests.rs"]
mod tests;
