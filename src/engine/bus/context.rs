//! What everything on a bus shares.

use std::collections::VecDeque;

use super::{Action, Severity};
use crate::engine::homeassistant::Gateway;
use crate::engine::settings::Settings;
use crate::engine::time::{Date, Duration, Time};
use crate::engine::topics::{DeviceTopics, Message};

/// Where and in which way a gateway tells what it knows; it may change while its buses go on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Telling {
    pub(super) gateway: Gateway,
    pub(super) discovery: bool,
    /// Whether each device tells all its values in one message too.
    pub(super) json: bool,
}

impl Telling {
    pub fn of(settings: &Settings) -> Telling {
        Telling {
            gateway: Gateway::new(&settings.mqtt, &settings.home_assistant),
            discovery: settings.home_assistant.discovery,
            json: settings.mqtt.json,
        }
    }

    /// Whether what one announces stands where the other one does.
    pub(super) fn announces_where(&self, other: &Telling) -> bool {
        let place = |telling: &'_ Telling| {
            let Telling { gateway, discovery, .. } = telling;
            (*discovery, gateway.prefix.clone(), gateway.topics.base().to_string())
        };
        place(self) == place(other)
    }
}

/// Where messages go, how they are told, and the actions that wait to be taken.
pub(super) struct Context {
    pub(super) actions: VecDeque<Action>,
    pub(super) telling: Telling,
    pub(super) bus_name: String,
    pub(super) republish: Duration,
    /// Some device has something new to be stored.
    pub(super) has_to_remember: bool,
    /// A moment, and its date as far as that is known.
    pub(super) date: Option<(Time, Date)>,
}

impl Context {
    pub(super) fn new(settings: &Settings, bus_name: &str) -> Context {
        Context {
            actions: VecDeque::from([Action::Reopen { after: Duration::ZERO }]),
            telling: Telling::of(settings),
            bus_name: bus_name.to_string(),
            republish: settings.republish,
            has_to_remember: false,
            date: None,
        }
    }

    pub(super) fn publish(&mut self, message: Message) {
        self.actions.push_back(Action::Publish(message));
    }

    pub(super) fn topics_of(&self, device: &str) -> DeviceTopics {
        self.telling.gateway.topics.of_device(&self.bus_name, device)
    }

    /// The date at a time.
    pub(super) fn date_of(&self, time: Time) -> Option<Date> {
        let (known_at, date) = self.date?;
        // One of the two differences is nothing.
        Some(Date((date + time.since(known_at)).0.saturating_sub(known_at.since(time).as_secs())))
    }

    pub(super) fn say(&mut self, severity: Severity, text: String) {
        self.actions.push_back(Action::Say(severity, text));
    }
}
