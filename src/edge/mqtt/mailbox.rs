//! What waits for the broker, where every thread can reach it.

use std::sync::{Mutex, MutexGuard};

use tokio::sync::Notify;

use crate::edge::lock::lock;
use crate::engine::outbox::Outbox;
use crate::engine::time::Time;
use crate::engine::topics::Message;

/// Where everybody puts messages for the broker, whether it is there or not.
pub struct Mailbox {
    outbox: Mutex<Outbox>,
    pub(super) news: Notify,
}

impl Mailbox {
    pub fn new(outbox: Outbox) -> Mailbox {
        Mailbox { outbox: Mutex::new(outbox), news: Notify::new() }
    }

    /// Never waits for the broker.
    pub fn push(&self, message: Message) {
        self.outbox().push(message);
        self.news.notify_one();
    }

    /// Does something with all that waits or is remembered.
    pub fn change<T>(&self, change: impl FnOnce(&mut Outbox) -> T) -> T {
        let result = change(&mut self.outbox());
        self.news.notify_one();
        result
    }

    /// From now on messages are put into this one.
    pub fn exchange(&self, outbox: Outbox) -> Outbox {
        std::mem::replace(&mut *self.outbox(), outbox)
    }

    /// Whether less is worth remembering than before: [`Outbox::settle`].
    pub fn settle(&self, now: Time) -> bool {
        self.outbox().settle(now)
    }

    /// Looks at what waits or is remembered.
    pub fn look<T>(&self, look: impl FnOnce(&Outbox) -> T) -> T {
        look(&self.outbox())
    }

    pub(super) fn outbox(&self) -> MutexGuard<'_, Outbox> {
        lock(&self.outbox)
    }
}
