//! The threads that run buses. A line has one of its own, also behind a serial server; Modbus TCP connections
//! share one.
//!
//! Threads and not tasks: the silence between two frames is 2 ms, and a timer that is a millisecond late
//! costs a tenth of a fast line. A connection has no such silence; there it is a thread's waking up that
//! costs most, and one that serves many finds several replies each time.

use std::num::NonZeroU64;
use std::os::fd::OwnedFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rustix::buffer::spare_capacity;
use rustix::event::{PollFd, PollFlags, epoll, poll};
use tokio::sync::oneshot;

use crate::edge::bell::Bell;
use crate::edge::bus_runner::{BusRunner, Ears, LOOKS_MAX, Look, Saving};
use crate::edge::clock::Clock;
use crate::edge::guarded_link::{Woken, wait};
use crate::edge::link::{Lost, timespec};
use crate::edge::punctual::Punctual;
use crate::edge::state_files::Shelf;
use crate::edge::stir::Stir;
use crate::engine::bus::{Bus, Command, Event, Full, Inbox};
use crate::engine::health::BusReport;
use crate::engine::settings::{Link, Settings};
use crate::engine::time::{Duration, Time};
use crate::engine::topics::Message;

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
    shared: Mutex<Option<Arc<Shared>>>,
    clock: Clock,
    state: Arc<Shelf>,
    stir: Arc<Stir>,
}

impl Threads {
    /// The threads stir when anything happens but that devices answer as they should.
    pub fn new(clock: Clock, state: Arc<Shelf>, stir: Arc<Stir>) -> Threads {
        Threads { shared: Mutex::default(), clock, state, stir }
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
        let shared = if shares { Some(self.shared()?) } else { None };
        let bell = match &shared {
            Some(shared) => shared.bell.clone(),
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
        match shared {
            Some(shared) => {
                lock(&shared.arrivals).push(runner);
                shared.bell.ring();
            }
            None => {
                std::thread::Builder::new().name(name).spawn(move || run_alone(runner))?;
            }
        }
        Ok(BusHandle { inbox, looks, bell, stop, first, ended: Mutex::new(Some(end)) })
    }

    /// The thread for connections, which begins with the first of them.
    fn shared(&self) -> std::io::Result<Arc<Shared>> {
        let mut shared = lock(&self.shared);
        if let Some(shared) = &*shared {
            return Ok(shared.clone());
        }
        let new = Arc::new(Shared {
            bell: Bell::new()?,
            arrivals: Mutex::default(),
            closing: AtomicBool::new(false),
        });
        let epoll = epoll::create(epoll::CreateFlags::CLOEXEC)?;
        epoll::add(&epoll, &new.bell, epoll::EventData::new_u64(BELL), epoll::EventFlags::IN)?;
        let thread = SharedThread {
            shared: new.clone(),
            epoll,
            clock: self.clock,
            runners: Vec::new(),
            next_number: 0,
            wake_at: None,
        };
        std::thread::Builder::new().name("connections".into()).spawn(move || thread.run())?;
        *shared = Some(new.clone());
        Ok(new)
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        if let Some(shared) = &*lock(&self.shared) {
            shared.closing.store(true, Ordering::SeqCst);
            shared.bell.ring();
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// By default the kernel may wake a thread 50 µs late to save power.
fn wake_punctually() {
    if let Err(error) = rustix::thread::set_current_timer_slack(NonZeroU64::new(1)) {
        tracing::debug!("the timer slack stays as it is: {error}");
    }
}

/// Runs a bus to its end.
fn run_alone(mut runner: BusRunner) {
    wake_punctually();
    let mut punctual = Punctual::default();
    runner.begin();
    runner.publish();
    while !runner.is_finished() {
        let woken = wait_alone(&mut runner, &mut punctual);
        if woken.bell {
            runner.bell().silence();
        }
        runner.woken(woken.bell, woken.link);
        runner.publish();
    }
    runner.finish();
}

/// Waits for whatever comes first.
fn wait_alone(runner: &mut BusRunner, punctual: &mut Punctual) -> Woken {
    let woken = match awake_at(runner, punctual) {
        Some(Awake { from, until }) if runner.clock().now() >= from => wait_awake(runner, until),
        Some(Awake { from, .. }) => sleep(runner, punctual, Some(from)),
        None => sleep(runner, punctual, None),
    };
    woken.unwrap_or_else(|lost| {
        runner.lose(lost);
        Woken { bell: true, link: true }
    })
}

/// A stretch of time in which a reply is waited for without sleeping.
struct Awake {
    from: Time,
    until: Time,
}

/// So long before its usual time, and so long behind it, a reply is waited for without sleeping.
const AWAKE_BEFORE: Duration = Duration::from_micros(60);
const AWAKE_BEHIND: Duration = Duration::from_micros(150);

/// When the reply under way will most likely come: a core that sleeps then would hear it some 50 µs late, which
/// is time of the wire, and of whoever waits for the value. `None` where that is not known, is over, or nobody
/// would gain by it.
fn awake_at(runner: &BusRunner, punctual: &Punctual) -> Option<Awake> {
    let expected_at = runner.link()?.reply_expected_at()?;
    let until = expected_at + AWAKE_BEHIND;
    let is_over = runner.clock().now() >= until || runner.wake_at().is_some_and(|at| at <= until);
    if is_over || punctual.is_calm(expected_at) {
        return None;
    }
    let begin = Time(expected_at.0.saturating_sub(AWAKE_BEFORE.as_micros() as u64));
    Some(Awake { from: punctual.sleep_until(begin), until })
}

/// Waits for the link and the bell until then, without sleeping.
fn wait_awake(runner: &BusRunner, until: Time) -> Result<Woken, Lost> {
    loop {
        let woken = wait(runner.link(), Some(runner.bell()), Some(Duration::ZERO))?;
        if woken != Woken::default() || runner.clock().now() >= until {
            return Ok(woken);
        }
        // Whoever hands over the bytes may have been put on this core.
        rustix::thread::sched_yield();
    }
}

/// Sleeps until something comes, it is time to go on, or `at_most` has come. Before a request is sent the rest
/// of that time is spun.
fn sleep(runner: &mut BusRunner, punctual: &mut Punctual, at_most: Option<Time>) -> Result<Woken, Lost> {
    let clock = runner.clock();
    let wake_at = runner.wake_at();
    let has_nothing_to_do = runner.link().is_some_and(|link| link.wake_at().is_none());
    let send_at = runner.link().and_then(|link| link.send_at());
    let exactly = send_at.filter(|at| Some(*at) == wake_at);
    let since = clock.now();
    let until = exactly.map(|at| punctual.sleep_until(at)).or(wake_at);
    let until = until.into_iter().chain(at_most).min();
    let woken = wait(runner.link(), Some(runner.bell()), until.map(|until| until - since))?;
    if has_nothing_to_do {
        punctual.rested(clock.now());
    }
    match (woken, until) {
        (Woken { link: true, .. }, _) => {
            let came_at = punctual.woken_by(since, clock.now());
            if let Some(link) = runner.link_mut() {
                link.woken_by(came_at);
            }
        }
        (Woken { bell: false, .. }, Some(until)) => {
            punctual.slept(since, until, clock.now());
            while exactly.is_some_and(|at| clock.now() < at) {
                // A command that comes now still goes before the poll.
                if runner.bell().rings() {
                    return Ok(Woken { bell: true, link: false });
                }
                std::hint::spin_loop();
            }
        }
        _ => {}
    }
    Ok(woken)
}

/// What others know of the thread for connections.
struct Shared {
    bell: Bell,
    arrivals: Mutex<Vec<BusRunner>>,
    /// No more buses come.
    closing: AtomicBool,
}

/// Stands for the bell where links have numbers.
const BELL: u64 = u64::MAX;
/// What `epoll` counts in.
const MILLISECOND: Duration = Duration::from_millis(1);
/// Links that are heard at one look.
const HEARD_MAX: usize = 64;

struct SharedThread {
    shared: Arc<Shared>,
    epoll: OwnedFd,
    clock: Clock,
    /// By their numbers.
    runners: Vec<Numbered>,
    next_number: u64,
    /// None of them wants to be woken before.
    wake_at: Option<Time>,
}

struct Numbered {
    number: u64,
    runner: BusRunner,
    wake_at: Option<Time>,
    is_heard: bool,
}

impl SharedThread {
    fn run(mut self) {
        wake_punctually();
        let mut heard = Vec::with_capacity(HEARD_MAX);
        loop {
            self.wait(&mut heard);
            let rung = heard.iter().any(|event| event.data.u64() == BELL);
            if rung {
                self.shared.bell.silence();
                self.welcome();
            }
            // Only those that have something to do are looked at: most of the time replies come, and there is
            // nothing else.
            for event in &heard {
                if let Some(at) = self.runner_of(event) {
                    self.runners[at].is_heard = true;
                    if !rung {
                        self.go_on(at, false);
                    }
                }
            }
            if rung || self.wake_at.is_some_and(|at| self.clock.now() >= at) {
                self.look_at_all(rung);
            }
            // All that answered have been asked again.
            for event in heard.drain(..) {
                if let Some(at) = self.runner_of(&event) {
                    self.runners[at].runner.publish();
                }
            }
            if self.runners.is_empty() && self.shared.closing.load(Ordering::SeqCst) {
                return;
            }
        }
    }

    /// Where the bus is that the event is about, if there still is one.
    fn runner_of(&self, event: &epoll::Event) -> Option<usize> {
        let number = event.data.u64();
        self.runners.binary_search_by_key(&number, |numbered| numbered.number).ok()
    }

    /// Waits for whatever comes first.
    fn wait(&self, heard: &mut Vec<epoll::Event>) {
        let timeout = self.wake_at.map(|at| self.clock.until(at));
        // `epoll` counts in milliseconds and rounds them up; what is left of one, `poll` waits for.
        let timeout = match timeout {
            Some(left) if left < MILLISECOND => {
                let links = &mut [PollFd::new(&self.epoll, PollFlags::IN)];
                let _ = poll(links, Some(&timespec(left)));
                Some(Duration::ZERO)
            }
            Some(long) => Some(Duration::from_millis(long.as_millis() as u64)),
            None => None,
        };
        // An interruption is as good as a time that has come; nothing else can fail here.
        let _ = epoll::wait(&self.epoll, spare_capacity(heard), timeout.map(timespec).as_ref());
    }

    /// Wakes everybody if the bell has `rung`, and those whose time has come.
    fn look_at_all(&mut self, rung: bool) {
        let now = self.clock.now();
        for at in 0..self.runners.len() {
            if rung || self.runners[at].wake_at.is_some_and(|at| now >= at) {
                self.go_on(at, rung);
                self.runners[at].runner.publish();
            }
        }
        while let Some(at) = self.runners.iter().position(|numbered| numbered.runner.is_finished()) {
            self.runners.remove(at).runner.finish();
        }
        self.wake_at = self.runners.iter().filter_map(|numbered| numbered.wake_at).min();
    }

    /// Lets one do what there is to do.
    fn go_on(&mut self, at: usize, rung: bool) {
        let numbered = &mut self.runners[at];
        numbered.runner.woken(rung, std::mem::take(&mut numbered.is_heard));
        numbered.settle(&self.epoll);
        // One that has ended is let go of at once.
        let wake_at = if numbered.runner.is_finished() { Some(Time(0)) } else { numbered.wake_at };
        self.wake_at = self.wake_at.into_iter().chain(wake_at).min();
    }

    /// Takes the buses that have come.
    fn welcome(&mut self) {
        for mut runner in lock(&self.shared.arrivals).drain(..) {
            runner.begin();
            let mut numbered = Numbered { number: self.next_number, runner, wake_at: None, is_heard: false };
            numbered.settle(&self.epoll);
            numbered.runner.publish();
            self.runners.push(numbered);
            self.next_number += 1;
        }
    }
}

impl Numbered {
    /// After the bus has done something: sees to it that it is woken for what comes next.
    fn settle(&mut self, epoll: &OwnedFd) {
        if self.runner.take_newly_open() {
            // A link that is closed leaves by itself.
            let heard = self.runner.link().map(|link| {
                epoll::add(epoll, link, epoll::EventData::new_u64(self.number), epoll::EventFlags::IN)
            });
            if let Some(Err(error)) = heard {
                self.runner.lose(Lost(error.to_string()));
                self.runner.begin();
            }
        }
        self.wake_at = self.runner.wake_at();
    }
}

#[cfg(test)]
#[path = "bus_thread_tests.rs"]
mod tests;
