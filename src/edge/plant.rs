//! What runs now, for everybody who has to reach it: a new configuration exchanges it under them.

use std::sync::{Arc, Mutex, MutexGuard};

use crate::edge::bus_thread::BusHandle;
use crate::edge::clock::Clock;
use crate::edge::lock::lock;
use crate::edge::mqtt::{BrokerState, Mailbox, News};
use crate::edge::stir::Stir;
use crate::engine::bus::{Command, Event, Full, REPLACED};
use crate::engine::command::{Outcome, OutcomeKind, Wish};
use crate::engine::health::BrokerReport;
use crate::engine::homeassistant;
use crate::engine::outbox::Outbox;
use crate::engine::profile::Library;
use crate::engine::request::{Decision, Desk};
use crate::engine::settings::Settings;
use crate::engine::topics::{DeviceTopics, Message, Topics};

/// The running parts.
pub struct Plant {
    clock: Clock,
    stir: Arc<Stir>,
    parts: Mutex<Parts>,
}

struct Parts {
    settings: Arc<Settings>,
    topics: Topics,
    mailbox: Arc<Mailbox>,
    desk: Desk,
    /// In the order of the settings.
    buses: Vec<Arc<BusHandle>>,
    connection: Option<BrokerState>,
}

/// Of a gateway with these settings that has told nothing yet.
pub(super) fn outbox(settings: &Settings) -> Outbox {
    let (topics, home_assistant) = (Topics::of(&settings.mqtt), &settings.home_assistant);
    let identities = homeassistant::identities(settings);
    Outbox::new(topics, &home_assistant.prefix, identities).with_values(settings.mqtt.values)
}

impl Parts {
    fn new(settings: Settings, library: Library, stir: Arc<Stir>) -> Parts {
        Parts {
            desk: Desk::new(&settings, library),
            topics: Topics::of(&settings.mqtt),
            mailbox: Arc::new(Mailbox::new(outbox(&settings), stir)),
            buses: Vec::new(),
            connection: None,
            settings: Arc::new(settings),
        }
    }
}

impl Plant {
    /// As these settings want it, but with nothing running yet.
    pub fn new(settings: Settings, library: Library, clock: Clock) -> Plant {
        let stir = Arc::<Stir>::default();
        Plant { clock, parts: Mutex::new(Parts::new(settings, library, stir.clone())), stir }
    }

    /// The same mailbox and connection, and other settings.
    pub fn exchange(&self, settings: Settings, library: Library, buses: Vec<Arc<BusHandle>>) {
        let mut parts = self.parts();
        parts.desk = Desk::new(&settings, library);
        parts.topics = Topics::of(&settings.mqtt);
        parts.settings = Arc::new(settings);
        parts.buses = buses;
    }

    pub fn set_buses(&self, buses: Vec<Arc<BusHandle>>) {
        self.parts().buses = buses;
    }

    pub fn set_connection(&self, connection: BrokerState) {
        self.parts().connection = Some(connection);
    }

    pub fn clock(&self) -> Clock {
        self.clock
    }

    /// Who changes how the gateway is stirs this.
    pub fn stir(&self) -> &Arc<Stir> {
        &self.stir
    }

    pub fn settings(&self) -> Arc<Settings> {
        self.parts().settings.clone()
    }

    pub fn mailbox(&self) -> Arc<Mailbox> {
        self.parts().mailbox.clone()
    }

    pub fn buses(&self) -> Vec<Arc<BusHandle>> {
        self.parts().buses.clone()
    }

    pub fn broker(&self) -> BrokerReport {
        let connection = self.parts().connection.clone();
        connection.map(|connection| connection.report()).unwrap_or_default()
    }

    fn parts(&self) -> MutexGuard<'_, Parts> {
        lock(&self.parts)
    }

    /// Brings what the broker tells to the buses that it concerns.
    pub fn tell(&self, news: News) {
        if matches!(news, News::Up | News::Down) {
            self.stir.stir();
        }
        let mut parts = self.parts();
        match news {
            News::Up => parts.tell_all(&Event::BrokerUp),
            News::Down => parts.tell_all(&Event::BrokerDown),
            News::Get { device, point } => {
                // Who finds no room reads at the next poll.
                let _ = parts.tell_bus_of(&device.clone(), Event::Get { device, point });
            }
            News::Request { verb, payload, retained, stale } => {
                let decision = match stale {
                    Some(reason) if !retained => parts.desk.refuse(&verb, &payload, &reason),
                    _ => parts.desk.take(self.clock.today(), &verb, &payload, retained),
                };
                parts.carry_out(decision);
            }
            News::Set { device, point, payload, retained } => {
                parts.command(Command { device, point, payload, retained });
            }
        }
    }
}

impl Parts {
    fn command(&self, command: Command) {
        let device = command.device.clone();
        if let Some(outcome) = self.desk.refusal_of_set(&device, &command.payload) {
            // What is retained is nobody's wish of now.
            if !command.retained {
                self.tell_outcome(&device, &command.point, &outcome);
            }
            return;
        }
        let (command, kind, reason) = match self.tell_bus_of(&device, Event::Command(command.clone())) {
            Ok(None) => return,
            Ok(Some(older)) => (older, OutcomeKind::Expired, REPLACED),
            Err(Full) => (command, OutcomeKind::Refused, "too many commands of this bus wait already"),
        };
        self.tell_outcome(&device, &command.point, &Wish::parse(&command.payload).ended(kind, reason));
    }

    fn tell_outcome(&self, device: &str, point: &str, outcome: &Outcome) {
        let topic = self.topics_of(device).outcome(point);
        self.mailbox.push(Message::once(topic, outcome.to_json()));
    }

    fn carry_out(&self, decision: Decision) {
        match decision {
            Decision::Ask(bus, request) => {
                let taken = self.buses.get(bus).is_some_and(|bus| {
                    let event = Event::Request(request.clone());
                    bus.send(event).is_ok()
                });
                if !taken {
                    self.mailbox.push(request.refusal(&self.topics, "too much waits for the bus"));
                }
            }
            Decision::Answer(message) => self.mailbox.push(message),
            Decision::Warn(text) => tracing::warn!("{text}"),
            Decision::Ignore => {}
        }
    }

    fn tell_all(&self, event: &Event) {
        for bus in &self.buses {
            // A bus that has no room for this is stuck, and is reported as that: no flood fills it so far.
            if bus.send(event.clone()).is_err() {
                tracing::warn!("a bus does not take news of the broker");
            }
        }
    }

    fn topics_of(&self, device: &str) -> DeviceTopics {
        let bus = self.desk.bus_of(device).and_then(|bus| self.settings.buses.get(bus));
        self.topics.of_device(bus.map_or("", |bus| &bus.name), device)
    }

    /// Returns the command whose place the event took.
    fn tell_bus_of(&self, device: &str, event: Event) -> Result<Option<Command>, Full> {
        match self.desk.bus_of(device).map(|bus| self.buses.get(bus)) {
            Some(bus) => bus.map_or(Err(Full), |bus| bus.send(event)),
            None => {
                tracing::debug!("a message for `{device}`, which is no device of this gateway");
                Ok(None)
            }
        }
    }
}
