//! The thread that all Modbus TCP connections share: it waits for all of them at a time, and goes on with those that
//! have something.

use std::os::fd::OwnedFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use rustix::buffer::spare_capacity;
use rustix::event::{PollFd, PollFlags, epoll, poll};

use super::wake_punctually;
use crate::edge::bell::Bell;
use crate::edge::bus_runner::BusRunner;
use crate::edge::clock::Clock;
use crate::edge::doze::Awake;
use crate::edge::guarded_link::{GuardedLink, Woken};
use crate::edge::link::{Lost, timespec};
use crate::edge::lock::lock;
use crate::edge::punctual::{Leisure, Punctual};
use crate::engine::time::{Duration, Time};

/// Reaches the thread that runs the buses of all connections.
pub(super) struct Connections {
    bell: Bell,
    /// Buses that the thread has not yet taken.
    arrivals: Mutex<Vec<BusRunner>>,
    /// No more buses come.
    closing: AtomicBool,
}

impl Connections {
    /// Starts the thread, without a bus.
    pub(super) fn start(clock: Clock) -> std::io::Result<Arc<Connections>> {
        let bell = Bell::new()?;
        let shared = Connections { bell, arrivals: Mutex::default(), closing: AtomicBool::new(false) };
        let shared = Arc::new(shared);
        let epoll = epoll::create(epoll::CreateFlags::CLOEXEC)?;
        epoll::add(&epoll, &shared.bell, epoll::EventData::new_u64(BELL), epoll::EventFlags::IN)?;
        let thread = Thread {
            shared: shared.clone(),
            epoll,
            clock,
            runners: Vec::new(),
            next_number: 0,
            wake_at: None,
            punctual: Punctual::default(),
        };
        std::thread::Builder::new().name("connections".into()).spawn(move || thread.run())?;
        Ok(shared)
    }

    /// Wakes the thread; all its buses share this bell.
    pub(super) fn bell(&self) -> &Bell {
        &self.bell
    }

    /// Gives a bus to the thread.
    pub(super) fn take(&self, runner: BusRunner) {
        lock(&self.arrivals).push(runner);
        self.bell.ring();
    }

    /// The thread ends with its last bus.
    pub(super) fn close(&self) {
        self.closing.store(true, Ordering::SeqCst);
        self.bell.ring();
    }
}

/// Stands for the bell where links have numbers.
const BELL: u64 = u64::MAX;
/// What `epoll` counts in.
const MILLISECOND: Duration = Duration::from_millis(1);
/// Links that are heard at one look.
const HEARD_MAX: usize = 64;

/// Of more links than these some reply is always near.
const DOZES_WITH: usize = 64;

struct Thread {
    shared: Arc<Connections>,
    epoll: OwnedFd,
    clock: Clock,
    /// By their numbers.
    runners: Vec<Numbered>,
    next_number: u64,
    /// None of them wants to be woken before.
    wake_at: Option<Time>,
    punctual: Punctual,
}

/// A bus, and the number by which `epoll` knows its link.
struct Numbered {
    number: u64,
    runner: BusRunner,
    wake_at: Option<Time>,
    /// Its link has bytes that have not been looked at.
    is_heard: bool,
    /// When the reply under way will most likely come, where that is known and somebody would gain by it.
    expected_at: Option<Time>,
    leisure: Leisure,
}

impl Thread {
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
        let first = self.runners.first()?.number;
        // Until one of them ends, it is where it was put.
        let guess = number.checked_sub(first)? as usize;
        if self.runners.get(guess).is_some_and(|numbered| numbered.number == number) {
            return Some(guess);
        }
        self.runners.binary_search_by_key(&number, |numbered| numbered.number).ok()
    }

    /// Waits for whatever comes first.
    fn wait(&mut self, heard: &mut Vec<epoll::Event>) {
        let since = self.clock.now();
        let Some(awake) = self.awake(since) else { return self.sleep(heard, self.wake_at) };
        self.sleep(heard, Some(awake.from));
        let now = self.clock.now();
        // Of a long time it has slept only whole milliseconds.
        if heard.is_empty() && now >= awake.from {
            self.punctual.slept(since, awake.from, now);
            self.wait_awake(heard, awake.until);
        }
    }

    /// When to be awake for the next reply, if that is worth it.
    fn awake(&self, now: Time) -> Option<Awake> {
        if self.runners.len() > DOZES_WITH {
            return None;
        }
        let expected = self.runners.iter().filter_map(|numbered| numbered.expected_at);
        Awake::for_the_next(expected, self.wake_at, &self.punctual, now)
    }

    /// Waits for links and the bell until then, without sleeping.
    fn wait_awake(&self, heard: &mut Vec<epoll::Event>, until: Time) {
        while heard.is_empty() && self.clock.now() < until {
            // Whoever hands over the bytes may have been put on this core.
            rustix::thread::sched_yield();
            let _ = epoll::wait(&self.epoll, spare_capacity(heard), Some(&timespec(Duration::ZERO)));
        }
    }

    /// Sleeps until something comes, or this time.
    fn sleep(&self, heard: &mut Vec<epoll::Event>, until: Option<Time>) {
        let timeout = until.map(|at| self.clock.until(at));
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
        numbered.runner.woken(Woken { bell: rung, link: std::mem::take(&mut numbered.is_heard) });
        numbered.settle(&self.epoll, self.clock);
        // One that has ended is let go of at once.
        let wake_at = if numbered.runner.is_finished() { Some(Time(0)) } else { numbered.wake_at };
        self.wake_at = self.wake_at.into_iter().chain(wake_at).min();
    }

    /// Takes the buses that have come.
    fn welcome(&mut self) {
        for mut runner in lock(&self.shared.arrivals).drain(..) {
            runner.begin();
            let mut numbered = Numbered::new(self.next_number, runner);
            numbered.settle(&self.epoll, self.clock);
            numbered.runner.publish();
            self.runners.push(numbered);
            self.next_number += 1;
        }
    }
}

impl Numbered {
    fn new(number: u64, runner: BusRunner) -> Numbered {
        let leisure = Leisure::default();
        Numbered { number, runner, wake_at: None, is_heard: false, expected_at: None, leisure }
    }

    /// After the bus has done something: sees to it that it is woken for what comes next.
    fn settle(&mut self, epoll: &OwnedFd, clock: Clock) {
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
        if self.runner.link().is_some_and(|link| link.wake_at().is_none()) {
            self.leisure.rested(clock.now());
        }
        let expected_at = self.runner.link().and_then(GuardedLink::reply_expected_at);
        self.expected_at = expected_at.filter(|at| !self.leisure.is_calm(*at));
    }
}
