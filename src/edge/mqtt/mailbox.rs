//! What waits for the broker, where every thread can reach it.

use std::sync::{Arc, Mutex, MutexGuard};

use tokio::sync::Notify;

use crate::edge::lock::lock;
use crate::edge::stir::Stir;
use crate::engine::outbox::Outbox;
use crate::engine::time::Time;
use crate::engine::topics::Message;

/// Where everybody puts messages for the broker, whether it is there or not.
pub struct Mailbox {
    outbox: Mutex<Outbox>,
    pub(super) news: Notify,
    /// Stirred by what is worth remembering.
    stir: Arc<Stir>,
}

impl Mailbox {
    pub fn new(outbox: Outbox, stir: Arc<Stir>) -> Mailbox {
        Mailbox { outbox: Mutex::new(outbox), news: Notify::new(), stir }
    }

    /// Never waits for the broker.
    pub fn push(&self, message: Message) {
        self.change(|outbox| outbox.push(message));
    }

    /// Does something with all that waits or is remembered.
    pub fn change<T>(&self, change: impl FnOnce(&mut Outbox) -> T) -> T {
        let mut outbox = self.outbox();
        let result = change(&mut outbox);
        let is_worth_remembering = outbox.is_worth_remembering();
        drop(outbox);
        self.news.notify_one();
        if is_worth_remembering {
            self.stir.stir();
        }
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
