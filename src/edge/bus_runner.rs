//! Performs what [`crate::engine::bus::Bus`] decides: its letters, its link from closed to open and back, and
//! the messages that it publishes. It waits for nothing; its thread does ([`crate::edge::bus_thread`]).

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use crate::edge::bell::Bell;
use crate::edge::clock::Clock;
use crate::edge::guarded_link::{GuardedLink, Woken};
use crate::edge::link::{Link, Lost};
use crate::edge::lock::lock;
use crate::edge::log;
use crate::edge::recordings;
use crate::edge::state_files::Shelf;
use crate::edge::stir::Stir;
use crate::engine::bus::{Action, Bus, Event, Inbox, STOPPING};
use crate::engine::health::BusReport;
use crate::engine::modbus::Reply;
use crate::engine::modbus::guard::Guard;
use crate::engine::recorder::Recording;
use crate::engine::request::Request;
use crate::engine::settings::Settings;
use crate::engine::time::{Duration, Time};
use crate::engine::topics::Message;

/// How often a bus is told the date.
const DATE_EACH: Duration = Duration::from_secs(1);
/// So many messages find room that no memory is asked for.
const OUTGOING_KEPT: usize = 16;
/// Looks that may wait for a bus.
pub(super) const LOOKS_MAX: usize = 64;

/// Something that looks at the bus on its thread.
pub(super) type Look = Box<dyn FnOnce(&Bus, Time) + Send>;

/// The near end of a handle's ways to its bus.
pub(super) struct Ears {
    pub(super) inbox: Arc<Mutex<Inbox>>,
    pub(super) looks: Receiver<Look>,
    pub(super) bell: Bell,
    pub(super) stop: Arc<AtomicBool>,
    pub(super) stir: Arc<Stir>,
    pub(super) ended: SyncSender<Saving>,
}

/// Recordings that become files; a memory card may take seconds, and no line waits for it.
pub(super) type Saving = Vec<JoinHandle<()>>;

/// The link, from closed to open and back.
enum Port {
    Closed,
    /// To be opened then.
    Waiting(Time),
    /// Being opened by a thread of its own, because that may take seconds.
    Opening(Receiver<Result<Link, Lost>>),
    Open(Box<GuardedLink>),
}

/// A bus and its link. Whoever runs it calls [`BusRunner::begin`], waits for what comes first of bytes
/// ([`BusRunner::link`]), the bell and [`BusRunner::wake_at`], calls [`BusRunner::woken`] and
/// [`BusRunner::publish`], and so on until [`BusRunner::is_finished`].
pub(super) struct BusRunner {
    settings: Arc<Settings>,
    index: usize,
    clock: Clock,
    state: Arc<Shelf>,
    publish: Box<dyn Fn(Message) + Send>,
    /// What is to be published when the thread has time for it.
    outgoing: Vec<Message>,
    bus: Bus,
    port: Port,
    inbox: Arc<Mutex<Inbox>>,
    looks: Receiver<Look>,
    saving: Saving,
    bell: Bell,
    stop: Arc<AtomicBool>,
    stopping: bool,
    stir: Arc<Stir>,
    /// When the bus was last told the date.
    dated_at: Option<Time>,
    /// The link was opened since somebody asked.
    is_newly_open: bool,
    /// Whoever waits for the end hears of it, and of what is still being saved.
    ended: SyncSender<Saving>,
}

impl BusRunner {
    pub(super) fn new(
        settings: Arc<Settings>,
        index: usize,
        clock: Clock,
        state: Arc<Shelf>,
        publish: Box<dyn Fn(Message) + Send>,
        ears: Ears,
    ) -> BusRunner {
        let bus = Bus::new(clock.now(), &settings, index, &state.now().memories());
        let Ears { inbox, looks, bell, stop, stir, ended } = ears;
        BusRunner {
            settings,
            index,
            clock,
            state,
            publish,
            outgoing: Vec::new(),
            bus,
            port: Port::Closed,
            inbox,
            looks,
            saving: Saving::new(),
            bell,
            stop,
            stopping: false,
            stir,
            dated_at: None,
            is_newly_open: false,
            ended,
        }
    }

    pub(super) fn begin(&mut self) {
        self.perform();
    }

    pub(super) fn summary(&self) -> BusReport {
        self.bus.summary(self.clock.now())
    }

    pub(super) fn is_finished(&self) -> bool {
        self.bus.is_finished()
    }

    /// Publishes what there is to publish. To be called after [`BusRunner::begin`] and [`BusRunner::woken`],
    /// when nobody waits for an answer any more: whoever takes messages to the broker may take the core as well.
    pub(super) fn publish(&mut self) {
        self.outgoing.drain(..).for_each(&self.publish);
        // At the start every value was in it at once.
        self.outgoing.shrink_to(OUTGOING_KEPT);
    }

    /// The last thing that is done with it.
    pub(super) fn finish(mut self) {
        self.publish();
        // Perhaps nobody waits.
        let _ = self.ended.try_send(std::mem::take(&mut self.saving));
    }

    pub(super) fn clock(&self) -> Clock {
        self.clock
    }

    pub(super) fn bell(&self) -> &Bell {
        &self.bell
    }

    pub(super) fn link(&self) -> Option<&GuardedLink> {
        if let Port::Open(link) = &self.port { Some(link) } else { None }
    }

    pub(super) fn link_mut(&mut self) -> Option<&mut GuardedLink> {
        if let Port::Open(link) = &mut self.port { Some(link) } else { None }
    }

    /// Whether this is another link than when this was last asked.
    pub(super) fn take_newly_open(&mut self) -> bool {
        std::mem::take(&mut self.is_newly_open)
    }

    /// When to go on although nothing came.
    pub(super) fn wake_at(&self) -> Option<Time> {
        let of_port = match &self.port {
            Port::Closed | Port::Opening(_) => None,
            Port::Waiting(open_at) => Some(*open_at),
            Port::Open(link) => link.wake_at(),
        };
        of_port.into_iter().chain(self.bus.wake_at()).min()
    }

    /// Does what there is to do: the bell has rung, the link has bytes, or it is time to go on.
    pub(super) fn woken(&mut self, woken: Woken) {
        if woken.bell {
            self.read_letters();
            self.stop_if_asked();
        }
        // The bell rings also for a link that has opened. Where it is only the bus's time that has come, there
        // is nothing to be read.
        let is_links_turn = match &self.port {
            Port::Open(link) => woken.link || link.wake_at().is_some_and(|at| self.clock.now() >= at),
            Port::Closed | Port::Waiting(_) | Port::Opening(_) => true,
        };
        if is_links_turn {
            self.advance_port();
        }
        // What came has told the bus the time. (If it was nothing whole, the thread asks again when to go on.)
        if !woken.link && self.bus.wake_at().is_some_and(|at| self.clock.now() >= at) {
            self.handle(Event::Wake);
        }
        self.perform();
    }

    fn handle(&mut self, event: Event) {
        let now = self.clock.now();
        // Somebody may set the clock; once in a second is often enough to notice it.
        if self.dated_at.is_none_or(|dated_at| now - dated_at >= DATE_EACH) {
            self.bus.set_date(now, self.clock.today());
            self.dated_at = Some(now);
        }
        self.bus.handle(now, event);
        self.perform();
    }

    fn perform(&mut self) {
        while let Some(action) = self.bus.next_action() {
            match action {
                Action::Send { request, not_before, timeout } => {
                    let begun = match &mut self.port {
                        Port::Open(link) => link.begin(&request, not_before, timeout, self.bus.tape()),
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
                Action::Publish(message) => {
                    if message.says_how_a_device_is() {
                        self.stir.stir();
                    }
                    self.outgoing.push(message);
                }
                Action::Store(record) => self.state.now().store(record),
                Action::Record { recording, request, keep } => self.record(*recording, request, keep),
                Action::Reopen { after } => {
                    self.port = Port::Waiting(self.clock.now() + after);
                    self.stir.stir();
                }
                Action::Say(severity, text) => {
                    log::say(severity, &text);
                    self.stir.stir();
                }
            }
        }
    }

    fn read_letters(&mut self) {
        // At most as many as strangers can send, so that a flood does not keep the line waiting.
        for _ in 0..Inbox::LIMIT {
            let event = lock(&self.inbox).take();
            let Some(event) = event else { break };
            self.handle(event);
        }
        if !lock(&self.inbox).is_empty() {
            self.bell.ring();
        }
        while let Ok(look) = self.looks.try_recv() {
            // Whoever looks takes for told what has happened until then.
            self.publish();
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
            if let Some(reply) = link.withdraw(STOPPING) {
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
                    self.is_newly_open = true;
                    self.stir.stir();
                    self.handle(Event::LinkUp);
                }
                Ok(Err(lost)) => self.lose(lost),
                Err(TryRecvError::Empty) => {}
                Err(TryRecvError::Disconnected) => self.lose(Lost("it could not be opened".into())),
            },
            Port::Open(link) => {
                let said = link.advance(self.bus.tape());
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

    /// Makes a file of a recording, on a thread of its own.
    fn record(&mut self, recording: Recording, request: Option<Request>, keep: usize) {
        self.saving.retain(|saving| !saving.is_finished());
        let (inbox, bell, clock) = (self.inbox.clone(), self.bell.clone(), self.clock);
        let folder = self.state.now().recordings().map(Path::to_path_buf);
        let asked = request.clone();
        let saving = std::thread::Builder::new().name("recording".into()).spawn(move || {
            let result = match folder {
                Some(folder) => recordings::save(&folder, &recording, clock, keep),
                None => Err("nothing is kept".into()),
            };
            // When the bus has ended, nobody asks any more.
            let _ = lock(&inbox).push(Event::Recorded(request, result));
            bell.ring();
        });
        match saving {
            Ok(saving) => self.saving.push(saving),
            Err(error) => {
                self.handle(Event::Recorded(asked, Err(format!("no thread can be started: {error}"))));
            }
        }
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
    pub(super) fn lose(&mut self, Lost(reason): Lost) {
        self.port = Port::Closed;
        self.stir.stir();
        self.handle(Event::LinkDown(reason));
    }
}

impl Drop for BusRunner {
    /// Also when it ends in a panic: what is sent to it now is refused, and not left to wait for ever.
    fn drop(&mut self) {
        lock(&self.inbox).close();
    }
}
