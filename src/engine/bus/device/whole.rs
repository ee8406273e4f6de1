//! All values of a device in one message, for who wants them together: as they were told on their own
//! topics, and not more often than once in a second, but when the device comes.

use crate::engine::device::ThingKind;
use crate::engine::time::{Duration, Time};
use crate::engine::topics::Message;

use super::{Context, DeviceState};

/// What changes in this time is told together.
const INTERVAL: Duration = Duration::from_secs(1);

/// Whether the message is due, and since when it may be told.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Whole {
    changed: bool,
    not_before: Time,
    told_at: Time,
}

impl Whole {
    /// Something of it has been told on its own topic.
    pub(super) fn has_changed(&mut self) {
        self.changed = true;
    }

    /// The same as before has been told on its own topic, since it was told long ago: each of many points at a
    /// time of its own, and this message once.
    pub(super) fn is_told_again(&mut self, now: Time, republish: Duration) {
        self.changed |= now - self.told_at + INTERVAL >= republish;
    }
}

impl DeviceState {
    /// When the message is told, if something has changed.
    pub(in crate::engine::bus) fn whole_due_at(&self) -> Option<Time> {
        self.told.whole.changed.then_some(self.told.whole.not_before)
    }

    /// Tells the message, if it is due.
    pub(in crate::engine::bus) fn tell_whole(&mut self, now: Time, context: &mut Context) {
        if self.whole_due_at().is_some_and(|due| now >= due) {
            self.publish_whole(now, context);
        }
    }

    /// Tells the message, if there is one, although the last may have been told just now.
    pub(super) fn tell_whole_at_once(&mut self, now: Time, context: &mut Context) {
        if context.telling.json && self.told.whole.changed {
            self.publish_whole(now, context);
        }
    }

    fn publish_whole(&mut self, now: Time, context: &mut Context) {
        self.told.whole = Whole { changed: false, not_before: now + INTERVAL, told_at: now };
        let topics = context.topics_of(&self.settings.name);
        context.publish(Message::retained(topics.json(), self.whole_json()));
    }

    /// `{"flow":21.50,"relay_1":"ON","mode":"direct","pressure":null}`. Made here and not by a library, which
    /// would drop the last zero of a number.
    fn whole_json(&self) -> String {
        let device = &self.settings.device;
        let points = device.points.iter().enumerate();
        let points =
            points.filter(|(_, point)| !point.is_button() && point.event.is_none()).map(|(index, point)| {
                let told = self.values.told(index).map_or("null".into(), |reading| reading.to_json());
                (&point.name, told)
            });
        let things = device.things.iter().filter(|thing| thing.kind != ThingKind::Button).map(|thing| {
            let state = self.state_of(thing).map_or_else(|_| "null".into(), quoted);
            (&thing.name, state)
        });
        let members: Vec<String> =
            points.chain(things).map(|(name, value)| format!("{}:{value}", quoted(name))).collect();
        format!("{{{}}}", members.join(","))
    }
}

fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}
