//! Commands that wait for their turn: bounded, the newest value of a point wins, none waits for ever.

use crate::engine::command::Wish;
use crate::engine::device::PointIndex;
use crate::engine::time::{Duration, Time};

/// Why a command was not carried out.
pub const REPLACED: &str = "a newer value took its place";

/// What a command is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    Point(PointIndex),
    /// An index into the device's things.
    Thing(usize),
    /// A point whose setting is not as it is wanted; nobody waits for the outcome.
    Setting(PointIndex),
}

/// A command that has not begun.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Waiting {
    pub device: usize,
    pub target: Target,
    pub wanted: Wish,
    pub deadline: Time,
    /// Since when it could begin, for all that the bus does not decide.
    pub came_at: Time,
    is_press: bool,
}

impl Waiting {
    /// How long a value may wait for a device that is away.
    const TIME_TO_LIVE: Duration = Duration::from_secs(10);
    /// A button that works late surprises.
    const PRESS_TIME_TO_LIVE: Duration = Duration::from_secs(3);

    /// A command that may begin at `from`.
    pub fn new(from: Time, device: usize, target: Target, wanted: Wish, is_press: bool) -> Waiting {
        let mut waiting = Waiting { device, target, wanted, deadline: from, came_at: from, is_press };
        waiting.put_off(from);
        waiting
    }

    /// Puts the deadline off, for a command that may not begin before `from`.
    pub fn put_off(&mut self, from: Time) {
        self.deadline = self.deadline_from(from);
        self.came_at = from;
    }

    /// Its deadline if it may not begin before `from`.
    pub fn deadline_from(&self, from: Time) -> Time {
        from + if self.is_press { Waiting::PRESS_TIME_TO_LIVE } else { Waiting::TIME_TO_LIVE }
    }
}

/// First come, first served; one value for each point or thing.
#[derive(Debug, Default)]
pub struct WaitingCommands {
    queue: Vec<Waiting>,
}

impl WaitingCommands {
    /// More than this many points waiting at once means that nothing is obeyed any more.
    const LIMIT: usize = 1000;

    /// Adds a command; returns those that it displaces, and why.
    pub fn push(&mut self, command: Waiting) -> Vec<(Waiting, &'static str)> {
        let mut displaced = Vec::new();
        let same = |other: &Waiting| other.device == command.device && other.target == command.target;
        if let Some(at) = self.queue.iter().position(same) {
            displaced.push((std::mem::replace(&mut self.queue[at], command), REPLACED));
            return displaced;
        }
        if self.queue.len() == WaitingCommands::LIMIT {
            displaced.push((self.queue.remove(0), "1000 commands of this bus wait already"));
        }
        self.queue.push(command);
        displaced
    }

    /// Takes the first one that is `ready`.
    pub fn take_first(&mut self, ready: impl Fn(&Waiting) -> bool) -> Option<Waiting> {
        let at = self.queue.iter().position(ready)?;
        Some(self.queue.remove(at))
    }

    pub fn take_expired(&mut self, now: Time) -> Vec<Waiting> {
        let (expired, kept) =
            std::mem::take(&mut self.queue).into_iter().partition(|command| command.deadline <= now);
        self.queue = kept;
        expired
    }

    pub fn take_all(&mut self) -> Vec<Waiting> {
        std::mem::take(&mut self.queue)
    }

    /// Puts back what [`WaitingCommands::take_all`] took.
    pub fn put_all(&mut self, commands: Vec<Waiting>) {
        self.queue = commands;
    }

    pub fn iter_mut(&mut self) -> impl Iterator<Item = &mut Waiting> {
        self.queue.iter_mut()
    }

    pub fn iter(&self) -> impl Iterator<Item = &Waiting> {
        self.queue.iter()
    }

    pub fn next_deadline(&self) -> Option<Time> {
        self.queue.iter().map(|command| command.deadline).min()
    }
}
