//! Commands that wait for their turn: bounded, the newest value of a point wins, none waits for ever.

use crate::engine::device::{Point, PointIndex, WriteRule};
use crate::engine::time::{Duration, Time};

/// A command that has not begun.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Waiting {
    pub device: usize,
    pub point: PointIndex,
    pub wanted: String,
    pub deadline: Time,
}

impl Waiting {
    /// How long a value may wait for a device that is away.
    const TIME_TO_LIVE: Duration = Duration::from_secs(10);
    /// A button that works late surprises.
    const PRESS_TIME_TO_LIVE: Duration = Duration::from_secs(3);

    /// A command that may begin at `from`.
    pub fn new(from: Time, device: usize, point: PointIndex, wanted: String, details: &Point) -> Waiting {
        Waiting { device, point, wanted, deadline: from + Waiting::time_to_live(details) }
    }

    /// Puts the deadline off, for a command that may not begin before `from`.
    pub fn put_off(&mut self, from: Time, details: &Point) {
        self.deadline = from + Waiting::time_to_live(details);
    }

    fn time_to_live(details: &Point) -> Duration {
        let press = details.write.as_ref().is_some_and(|write| matches!(write.rule, WriteRule::Press { .. }));
        if press { Waiting::PRESS_TIME_TO_LIVE } else { Waiting::TIME_TO_LIVE }
    }
}

/// First come, first served; one value for each point.
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
        let same = |other: &Waiting| other.device == command.device && other.point == command.point;
        if let Some(at) = self.queue.iter().position(same) {
            displaced.push((std::mem::replace(&mut self.queue[at], command), "a newer value took its place"));
            return displaced;
        }
        if self.queue.len() == WaitingCommands::LIMIT {
            displaced.push((self.queue.remove(0), "too many commands wait"));
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

    pub fn iter(&self) -> impl Iterator<Item = &Waiting> {
        self.queue.iter()
    }

    pub fn next_deadline(&self) -> Option<Time> {
        self.queue.iter().map(|command| command.deadline).min()
    }
}
