//! The loop around [`crate::engine::bus::Bus`]: one thread per bus performs what the engine
//! decides.
//!
//! A thread and not a task: the silence between two frames is 2 ms, and a timer that is a
//! millisecond late costs a tenth of a fast line.

use std::num::NonZeroU64;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use tokio::sync::oneshot;

use crate::edge::bell::Bell;
use crate::edge::clock::Clock;
use crate::edge::guarded_link::{GuardedLink, Woken, wait};
use crate::edge::link::{Link, Lost};
use crate::edge::punctual::Punctual;
use crate::edge::state_files::StateFiles;
use crate::engine::bus::{Action, Bus, Command, Event, Full, Inbox, Severity};
use crate::engine::modbus::Reply;
use crate::engine::modbus::guard::Guard;
use crate::engine::settings::Settings;
use crate::engine::time::Time;
use crate::engine::topics::Message;

/// Looks that may wait for the thread.
const LOOKS_MAX: usize = 64;

/// Talks to a bus's thread. Dropping it does not stop the thread.
pub struct BusHandle {
    inbox: Arc<Mutex<Inbox>>,
    looks: SyncSender<Look>,
    bell: Bell,
    stop: Arc<AtomicBool>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

/// Something that looks at the bus on its thread.
type Look = Box<dyn FnOnce(&Bus, Time) + Send>;

/// Starts the thread of the bus number `index`. `publish` is called on that thread and must not
/// wait.
pub fn start(
    settings: Arc<Settings>,
    index: usize,
    clock: Clock,
    state: Arc<StateFiles>,
    publish: Box<dyn Fn(Message) + Send>,
) -> std::io::Result<BusHandle> {
    let inbox = Arc::<Mutex<Inbox>>::default();
    let thread_inbox = inbox.clone();
    let (looks, looks_in) = sync_channel(LOOKS_MAX);
    let bell = Bell::new()?;
    let stop = Arc::new(AtomicBool::new(false));
    let (thread_bell, thread_stop) = (bell.clone(), stop.clone());
    let thread =
        std::thread::Builder::new().name(format!("bus-{}", settings.buses[index].name)).spawn(move || {
            let bus = Bus::new(clock.now(), &settings, index, &state.memories());
            let port = Port::Closed;
            let (bell, stop) = (thread_bell, thread_stop);
            let (stopping, punctual) = (false, Punctual::default());
            BusThread {
                settings,
                index,
                clock,
                state,
                publish,
                bus,
                port,
                inbox: thread_inbox,
                looks: looks_in,
                bell,
                stop,
                stopping,
                punctual,
            }
            .run();
        })?;
    Ok(BusHandle { inbox, looks, bell, stop, thread: Mutex::new(Some(thread)) })
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

    /// Asks the bus to finish the request in flight, refuse what waits, say `offline` and end.
    pub fn shutdown(&self) {
        self.stop.store(true, Ordering::SeqCst);
        self.bell.ring();
    }

    /// Waits for the thread's end.
    pub fn join(&self) {
        let thread = self.thread.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).take();
        if let Some(thread) = thread {
            if thread.join().is_err() {
                tracing::error!("a bus thread ended in a panic");
            }
        }
    }
}

fn lock(inbox: &Mutex<Inbox>) -> MutexGuard<'_, Inbox> {
    // It is whole after every call, whoever panicked meanwhile.
    inbox.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The link, from closed to open and back.
enum Port {
    Closed,
    /// To be opened then.
    Waiting(Time),
    /// Being opened by a thread of its own, because that may take seconds.
    Opening(Receiver<Result<Link, Lost>>),
    Open(Box<GuardedLink>),
}

struct BusThread {
    settings: Arc<Settings>,
    index: usize,
    clock: Clock,
    state: Arc<StateFiles>,
    publish: Box<dyn Fn(Message) + Send>,
    bus: Bus,
    port: Port,
    inbox: Arc<Mutex<Inbox>>,
    looks: Receiver<Look>,
    bell: Bell,
    stop: Arc<AtomicBool>,
    stopping: bool,
    punctual: Punctual,
}

impl BusThread {
    fn run(mut self) {
        // By default the kernel may wake a thread 50 µs late to save power.
        if let Err(error) = rustix::thread::set_current_timer_slack(NonZeroU64::new(1)) {
            tracing::debug!("the timer slack stays as it is: {error}");
        }
        loop {
            self.perform();
            if self.bus.is_finished() {
                return;
            }
            if self.wait() {
                self.bell.silence();
                self.read_letters();
                self.stop_if_asked();
            }
            self.advance_port();
            if self.bus.wake_at().is_some_and(|at| self.clock.now() >= at) {
                self.handle(Event::Wake);
            }
        }
    }

    fn handle(&mut self, event: Event) {
        let now = self.clock.now();
        self.bus.set_date(now, self.clock.today());
        self.bus.handle(now, event);
        self.perform();
    }

    fn perform(&mut self) {
        while let Some(action) = self.bus.next_action() {
            match action {
                Action::Send { request, not_before, timeout } => {
                    let begun = match &mut self.port {
                        Port::Open(link) => link.begin(&request, not_before, timeout),
                        _ => Err(Lost("the link is not open".into())),
                    };
                    self.line_said(begun);
                }
                Action::Withdraw => {
                    if let Port::Open(link) = &mut self.port {
                        if link.take_back() {
                            self.bus.handle(self.clock.now(), Event::Withdrawn);
                        }
                    }
                }
                Action::Publish(message) => (self.publish)(message),
                Action::Store(record) => self.state.store(record),
                Action::Reopen { after } => self.port = Port::Waiting(self.clock.now() + after),
                Action::Say(Severity::Info, text) => tracing::info!("{text}"),
                Action::Say(Severity::Warning, text) => tracing::warn!("{text}"),
            }
        }
    }

    /// Waits for whatever comes first; whether the bell has rung, and there may be letters.
    fn wait(&mut self) -> bool {
        let (link, port_wakes_at, send_at) = match &self.port {
            Port::Closed | Port::Opening(_) => (None, None, None),
            Port::Waiting(open_at) => (None, Some(*open_at), None),
            Port::Open(link) => (Some(&**link), link.wake_at(), link.send_at()),
        };
        let wake_at = port_wakes_at.into_iter().chain(self.bus.wake_at()).min();
        let exactly = send_at.filter(|at| Some(*at) == wake_at);
        let until = exactly.map(|at| self.punctual.sleep_until(at)).or(wake_at);
        let since = self.clock.now();
        let woken = match wait(link, Some(&self.bell), until.map(|until| until - since)) {
            Ok(woken) => woken,
            Err(lost) => {
                self.lose(lost);
                return true;
            }
        };
        match (woken, until) {
            (Woken { link: true, .. }, _) => {
                if let Port::Open(link) = &mut self.port {
                    link.woken_by(self.punctual.woken_by(since, self.clock.now()));
                }
            }
            (Woken { bell: false, .. }, Some(until)) => {
                self.punctual.slept(since, until, self.clock.now());
                while exactly.is_some_and(|at| self.clock.now() < at) {
                    std::hint::spin_loop();
                }
            }
            _ => {}
        }
        woken.bell
    }

    fn read_letters(&mut self) {
        // At most as many as can wait, so that a flood does not keep the line waiting.
        for _ in 0..Inbox::LIMIT {
            let event = lock(&self.inbox).take();
            let Some(event) = event else { break };
            self.handle(event);
        }
        if !lock(&self.inbox).is_empty() {
            self.bell.ring();
        }
        while let Ok(look) = self.looks.try_recv() {
            look(&self.bus, self.clock.now());
        }
    }

    fn stop_if_asked(&mut self) {
        if self.stopping || !self.stop.load(Ordering::SeqCst) {
            return;
        }
        self.stopping = true;
        self.handle(Event::Shutdown);
        if let Port::Open(link) = &mut self.port {
            if let Some(reply) = link.withdraw("busker stops") {
                self.handle(Event::Reply(reply));
            }
        }
    }

    fn advance_port(&mut self) {
        match &mut self.port {
            Port::Closed => {}
            Port::Waiting(open_at) if self.clock.now() < *open_at => {}
            Port::Waiting(_) => self.port = self.open(),
            Port::Opening(opened) => match opened.try_recv() {
                Ok(Ok(link)) => {
                    let bus = &self.settings.buses[self.index];
                    let guard = Guard::new(&bus.link, bus.gap);
                    self.port = Port::Open(Box::new(GuardedLink::new(link, guard, self.clock)));
                    self.handle(Event::LinkUp);
                }
                Ok(Err(lost)) => self.lose(lost),
                Err(TryRecvError::Empty) => {}
                Err(TryRecvError::Disconnected) => self.lose(Lost("it could not be opened".into())),
            },
            Port::Open(link) => {
                let said = link.advance();
                self.line_said(said);
            }
        }
    }

    fn open(&self) -> Port {
        let (sender, receiver) = sync_channel(1);
        let (settings, index, bell) = (self.settings.clone(), self.index, self.bell.clone());
        let opener = std::thread::Builder::new().name("open".into()).spawn(move || {
            // When the bus stops meanwhile, the link is closed again with the channel.
            let _ = sender.send(Link::open(&settings.buses[index].link));
            bell.ring();
        });
        if let Err(error) = opener {
            tracing::error!("no thread can be started: {error}");
        }
        Port::Opening(receiver)
    }

    fn line_said(&mut self, said: Result<Option<Reply>, Lost>) {
        match said {
            Ok(Some(reply)) => self.handle(Event::Reply(reply)),
            Ok(None) => {}
            Err(lost) => self.lose(lost),
        }
    }

    /// Closes the descriptor at once: as long as it is held, an adapter that comes back gets
    /// another name.
    fn lose(&mut self, Lost(reason): Lost) {
        self.port = Port::Closed;
        self.handle(Event::LinkDown(reason));
    }
}

impl Drop for BusThread {
    /// Also when it ends in a panic: what is sent to it now is refused, and not left to wait for ever.
    fn drop(&mut self) {
        lock(&self.inbox).close();
    }
}

#[cfg(test)]
#[path = "bus_thread_tests.rs"]
mod tests;
