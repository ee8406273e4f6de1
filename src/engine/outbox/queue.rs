//! What waits for its turn: announcements before everything else, each in the order in which it came.

use std::collections::VecDeque;
use std::sync::Arc;

use crate::engine::topics::Message;

/// Messages told once that may wait; more push out the oldest. A script that has lost its way gives thousands of
/// commands in a moment, and the outcome of each is told.
pub(super) const ONCE_MAX: usize = 5000;

/// The empty queue keeps room for so many.
const KEPT: usize = 1024;

#[derive(Clone, Debug, PartialEq)]
pub(super) enum Queued {
    /// Whatever the topic's newest payload is when its turn comes.
    Newest(Arc<str>),
    /// Boxed, since there are few of them and may be fifty thousand of the others.
    Once(Box<Message>),
    /// The topic shall be forgotten by the broker.
    Removal(String),
}

impl Queued {
    pub(super) fn topic(&self) -> &str {
        match self {
            Queued::Newest(topic) => topic,
            Queued::Removal(topic) => topic,
            Queued::Once(message) => &message.topic,
        }
    }

    fn is_once(&self) -> bool {
        matches!(self, Queued::Once(_))
    }
}

/// Which of two queues something waits in. All that concerns one topic waits in one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Lane {
    /// What devices there are: few messages, and without them the values are of little use. Behind all
    /// values of a thousand devices they would wait for minutes.
    Announcements,
    Others,
}

#[derive(Clone, Debug, Default)]
pub(super) struct Queue {
    announcements: VecDeque<Queued>,
    others: VecDeque<Queued>,
    once_waiting: usize,
}

impl Queue {
    pub(super) fn is_empty(&self) -> bool {
        self.len() == 0
    }

    pub(super) fn len(&self) -> usize {
        self.announcements.len() + self.others.len()
    }

    /// Whether one more message that is told once would be too many.
    pub(super) fn is_full(&self) -> bool {
        self.once_waiting >= ONCE_MAX
    }

    pub(super) fn push_back(&mut self, lane: Lane, queued: Queued) {
        self.once_waiting += usize::from(queued.is_once());
        self.lane(lane).push_back(queued);
    }

    pub(super) fn push_front(&mut self, lane: Lane, queued: Queued) {
        self.once_waiting += usize::from(queued.is_once());
        self.lane(lane).push_front(queued);
    }

    pub(super) fn pop_front(&mut self) -> Option<Queued> {
        let next = self.announcements.pop_front().or_else(|| self.others.pop_front());
        match &next {
            Some(queued) => self.once_waiting -= usize::from(queued.is_once()),
            // After a start or a reconnect everything was in it at once.
            None => {
                self.announcements.shrink_to(KEPT);
                self.others.shrink_to(KEPT);
            }
        }
        next
    }

    /// Drops the oldest message that is told once.
    pub(super) fn drop_oldest_once(&mut self) {
        for lane in [Lane::Others, Lane::Announcements] {
            let lane = self.lane(lane);
            if let Some(at) = lane.iter().position(Queued::is_once) {
                lane.remove(at);
                self.once_waiting -= 1;
                return;
            }
        }
    }

    /// Takes out the value of this topic that waits.
    pub(super) fn take_newest(&mut self, lane: Lane, topic: &str) -> Option<Queued> {
        let lane = self.lane(lane);
        let is_wanted = |queued: &Queued| matches!(queued, Queued::Newest(waiting) if **waiting == *topic);
        let at = lane.iter().position(is_wanted)?;
        lane.remove(at)
    }

    /// Drops all that concerns this topic.
    pub(super) fn forget(&mut self, lane: Lane, topic: &str) {
        let lane = self.lane(lane);
        let before = lane.iter().filter(|queued| queued.is_once()).count();
        lane.retain(|queued| queued.topic() != topic);
        let after = lane.iter().filter(|queued| queued.is_once()).count();
        self.once_waiting -= before - after;
    }

    /// Takes everything.
    pub(super) fn take_all(&mut self) -> impl Iterator<Item = Queued> + use<> {
        let Queue { announcements, others, .. } = std::mem::take(self);
        announcements.into_iter().chain(others)
    }

    fn lane(&mut self, lane: Lane) -> &mut VecDeque<Queued> {
        match lane {
            Lane::Announcements => &mut self.announcements,
            Lane::Others => &mut self.others,
        }
    }
}
