//! What runs now, for everybody who has to reach it: a new configuration exchanges it under them.

use std::sync::{Arc, Mutex, MutexGuard};

use crate::edge::bus_thread::BusHandle;
use crate::edge::clock::Clock;
use crate::edge::lock::lock;
use crate::edge::mqtt::{BrokerState, Mailbox, News};
use crate::edge::stir::Stir;
use crate::engine::bus::{Command, Event, Full, ended_at_once};
use crate::engine::health::BrokerReport;
use crate::engine::homeassistant;
use crate::engine::outbox::Outbox;
use crate::engine::profile::Library;
use crate::engine::request::{Decision, Desk};
use crate::engine::settings::{self, Settings};
use crate::engine::topics::Topics;

/// The running parts.
pub struct Plant {
    clock: Clock,
    stir: Arc<Stir>,
    parts: Mutex<Parts>,
}

struct Parts {
    settings: Arc<Settings>,
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
        parts.settings = Arc::new(settings);
        parts.buses = buses;
    }

    /// HTTP goes by these already, whatever becomes of the rest of a new configuration.
    pub fn set_http(&self, http: settings::Http) {
        Arc::make_mut(&mut self.parts().settings).http = http;
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
            News::Errand(errand) => {
                let decision = parts.desk.decide(self.clock.today(), errand);
                parts.carry_out(decision);
            }
        }
    }
}

impl Parts {
    fn carry_out(&self, decision: Decision) {
        match decision {
            Decision::Ask(bus, request) => {
                if self.hand_over(bus, Event::Request(request.clone())).is_err() {
                    self.mailbox.push(self.desk.no_room(&request));
                }
            }
            Decision::Obey(bus, command) => {
                let taken = self.hand_over(bus, Event::Command(command.clone()));
                if let Some(outcome) = ended_at_once(&command, &taken) {
                    self.mailbox.push(self.desk.outcome(&command.device, &command.point, &outcome));
                }
            }
            // Who finds no room reads at the next poll.
            Decision::Read { bus, device, point } => drop(self.hand_over(bus, Event::Get { device, point })),
            Decision::Answer(message) => self.mailbox.push(message),
            Decision::Warn(text) => tracing::warn!("{text}"),
            Decision::Mention(text) => tracing::debug!("{text}"),
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

    /// To the bus of this number. Returns the command whose place the event took.
    fn hand_over(&self, bus: usize, event: Event) -> Result<Option<Command>, Full> {
        self.buses.get(bus).map_or(Err(Full), |bus| bus.send(event))
    }
}
