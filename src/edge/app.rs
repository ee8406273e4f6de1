//! Starts what runs and ends it in order: one thread per bus, and a small runtime for the broker and
//! HTTP.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::Context;
use tokio::runtime::Runtime;
use tokio::task::JoinHandle;

use crate::edge::bus_thread::{self, BusHandle};
use crate::edge::clock::Clock;
use crate::edge::files;
use crate::edge::http::Http;
use crate::edge::mqtt::{Broker, Mailbox, News};
use crate::edge::reports::{Ask, Reporter};
use crate::edge::shutdown::{self, Signals};
use crate::edge::state_files::StateFiles;
use crate::engine::bus::{Bus, Command, Event};
use crate::engine::command::{Outcome, OutcomeKind};
use crate::engine::health::{self, GatewayReport};
use crate::engine::homeassistant::{self, Gateway};
use crate::engine::outbox::Outbox;
use crate::engine::profile::Library;
use crate::engine::request::{Decision, Desk};
use crate::engine::settings::Settings;
use crate::engine::time::Duration;
use crate::engine::topics::{Message, Topics};

/// How often the gateway looks at itself. What has changed for the worse or the better is told at
/// once, the rest each minute.
const LOOK_EVERY: Duration = Duration::from_secs(1);
const TELL_HEALTH_EVERY: Duration = Duration::from_secs(60);

/// How long the buses may take to finish what is in flight.
const BUSES_END_WITHIN: Duration = Duration::from_secs(10);

/// A running gateway.
pub struct App {
    runtime: Runtime,
    buses: Arc<Vec<BusHandle>>,
    broker: Broker,
    http: Option<Http>,
    reporter: Arc<Reporter>,
    watch: JoinHandle<()>,
    state: Arc<StateFiles>,
}

impl App {
    /// Starts everything, going on from what is remembered in `state`. By `library` a scan
    /// knows devices. An error means that nothing is left
    /// running.
    pub fn start(settings: Settings, library: Library, state: StateFiles) -> anyhow::Result<App> {
        let password = files::read_secret("password", &settings.mqtt.password)?;
        let token = files::read_token(&settings.http.token)?;
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .thread_name("edge")
            .enable_all()
            .build()
            .context("the runtime cannot be started")?;
        let clock = Clock::start();
        let settings = Arc::new(settings);
        let state = Arc::new(state);
        // What can fail comes before what cannot.
        let listener = match &settings.http.listen {
            Some(listen) => Some(runtime.block_on(Http::bind(listen))?),
            None => None,
        };
        let topics = Topics::new(&settings.mqtt.base_topic);
        let outbox =
            Outbox::new(topics.clone(), &settings.home_assistant.prefix, identities(&settings, &topics));
        let mailbox = Arc::new(Mailbox::new(outbox));
        introduce(&settings, &topics, &mailbox);
        let buses = Arc::new(start_buses(&settings, clock, &state, &mailbox)?);

        let _inside = runtime.enter();
        let desk = Desk::new(&settings, library);
        let route = Route::new(&settings, desk, clock, buses.clone(), mailbox.clone());
        let broker = Broker::start(&settings, password, clock, mailbox.clone(), move |news| route.tell(news));
        let memories = state.memories();
        let first = (0..buses.len())
            .map(|index| Bus::new(clock.now(), &settings, index, memories).report(clock.now()))
            .collect();
        let connection = broker.state();
        let reporter = Arc::new(Reporter::new(move || connection.report(), questions(&buses), first));
        let http = listener.map(|listener| Http::serve(listener, reporter.clone(), clock, token));
        let watch = tokio::spawn(watch(reporter.clone(), topics, mailbox));
        Ok(App { runtime, buses, broker, http, reporter, watch, state })
    }

    /// Where HTTP listens, if it does.
    pub fn http_address(&self) -> Option<SocketAddr> {
        self.http.as_ref().map(Http::address)
    }

    /// The gateway as it is now. Not from within a runtime.
    pub fn report(&self) -> GatewayReport {
        self.runtime.block_on(self.reporter.report())
    }

    /// Waits for SIGTERM or SIGINT.
    pub fn wait_for_signal(&self) -> anyhow::Result<()> {
        let name = self.runtime.block_on(async {
            let mut signals = Signals::listen().context("signals cannot be heard")?;
            anyhow::Ok(signals.wait().await)
        })?;
        tracing::info!("{name}: stopping");
        Ok(())
    }

    /// Ends in order: the buses finish what is in flight and say `offline`, then the gateway says it
    /// and disconnects.
    pub fn stop(self) {
        self.watch.abort();
        self.buses.iter().for_each(BusHandle::shutdown);
        self.runtime.block_on(async {
            let buses = self.buses.clone();
            let ended = tokio::task::spawn_blocking(move || buses.iter().for_each(BusHandle::join));
            if tokio::time::timeout(BUSES_END_WITHIN, ended).await.is_err() {
                tracing::warn!("a bus does not end; it is left alone");
            }
            self.broker.finish().await;
        });
        if let Some(http) = self.http {
            http.stop();
        }
        // A stuck bus's thread is not waited for again.
        self.runtime.shutdown_background();
        self.state.finish();
    }
}

/// Everything that Home Assistant may know of this gateway.
fn identities(settings: &Settings, topics: &Topics) -> Vec<String> {
    let buses = settings.buses.iter().map(|bus| topics.bus_identity(&bus.name));
    let devices = settings.devices.iter().map(|device| topics.identity(&device.name));
    buses.chain(devices).chain([topics.bridge_identity()]).collect()
}

/// What is known of the gateway before anything has happened.
fn introduce(settings: &Settings, topics: &Topics, mailbox: &Mailbox) {
    mailbox.push(Message::retained(topics.bridge_info(), health::info_json(settings).to_string()));
    if settings.home_assistant.discovery {
        let gateway = Gateway::new(&settings.mqtt.base_topic, &settings.home_assistant);
        mailbox.push(homeassistant::announce_bridge(&gateway).message());
        for bus in &settings.buses {
            mailbox.push(homeassistant::announce_bus(&gateway, &bus.name).message());
        }
    }
}

fn start_buses(
    settings: &Arc<Settings>,
    clock: Clock,
    state: &Arc<StateFiles>,
    mailbox: &Arc<Mailbox>,
) -> anyhow::Result<Vec<BusHandle>> {
    let mut buses: Vec<BusHandle> = Vec::new();
    for (index, bus) in settings.buses.iter().enumerate() {
        let mailbox = mailbox.clone();
        let publish = Box::new(move |message| mailbox.push(message));
        match bus_thread::start(settings.clone(), index, clock, state.clone(), publish) {
            Ok(handle) => buses.push(handle),
            Err(error) => {
                buses.iter().for_each(BusHandle::shutdown);
                buses.iter().for_each(BusHandle::join);
                return Err(error).with_context(|| format!("bus {} cannot be started", bus.name));
            }
        }
    }
    Ok(buses)
}

fn questions(buses: &Arc<Vec<BusHandle>>) -> Vec<Ask> {
    (0..buses.len())
        .map(|index| {
            let buses = buses.clone();
            let ask: Ask = Box::new(move || buses[index].inspect(|bus, now| bus.report(now)));
            ask
        })
        .collect()
}

/// Brings what the broker tells to the buses that it concerns.
struct Route {
    /// Device to bus.
    bus_of: BTreeMap<String, usize>,
    topics: Topics,
    desk: Mutex<Desk>,
    clock: Clock,
    buses: Arc<Vec<BusHandle>>,
    mailbox: Arc<Mailbox>,
}

impl Route {
    fn new(
        settings: &Settings,
        desk: Desk,
        clock: Clock,
        buses: Arc<Vec<BusHandle>>,
        mailbox: Arc<Mailbox>,
    ) -> Route {
        let topics = Topics::new(&settings.mqtt.base_topic);
        let bus_of = settings.devices.iter().map(|device| (device.name.clone(), device.bus)).collect();
        Route { bus_of, topics, desk: Mutex::new(desk), clock, buses, mailbox }
    }

    fn tell(&self, news: News) {
        match news {
            News::Up => self.tell_all(Event::BrokerUp),
            News::Down => self.tell_all(Event::BrokerDown),
            News::Get { device, point } => {
                self.tell_bus_of(&device.clone(), Event::Get { device, point });
            }
            News::Request { verb, payload, retained } => self.request(&verb, &payload, retained),
            News::Set { device, point, payload, retained } => {
                let refused = Outcome::new(OutcomeKind::Refused, &payload, "too many commands wait");
                let topic = self.topics.outcome(&device, &point);
                let command = Command { device: device.clone(), point, payload, retained };
                if !self.tell_bus_of(&device, Event::Command(command)) {
                    self.mailbox.push(Message::once(topic, refused.to_json()));
                }
            }
        }
    }

    fn request(&self, verb: &str, payload: &str, retained: bool) {
        let mut desk = self.desk.lock().unwrap_or_else(PoisonError::into_inner);
        match desk.take(self.clock.today(), verb, payload, retained) {
            Decision::Ask(bus, request) => {
                if self.buses[bus].send(Event::Request(request.clone())).is_err() {
                    self.mailbox.push(request.refusal(&self.topics, "too much waits for the bus"));
                }
            }
            Decision::Answer(message) => self.mailbox.push(message),
            Decision::Warn(text) => tracing::warn!("{text}"),
            Decision::Ignore => {}
        }
    }

    fn tell_all(&self, event: Event) {
        for bus in self.buses.iter() {
            // A bus with a full inbox is stuck, and is reported as that.
            if bus.send(event.clone()).is_err() {
                tracing::warn!("a bus does not take news of the broker");
            }
        }
    }

    /// `false` if the bus has no room for it.
    fn tell_bus_of(&self, device: &str, event: Event) -> bool {
        match self.bus_of.get(device) {
            Some(bus) => self.buses[*bus].send(event).is_ok(),
            None => {
                tracing::debug!("a message for `{device}`, which is no device of this gateway");
                true
            }
        }
    }
}

/// Looks at the gateway again and again: tells its health, and feeds systemd's watchdog while every
/// bus answers.
async fn watch(reporter: Arc<Reporter>, topics: Topics, mailbox: Arc<Mailbox>) {
    let every = shutdown::watchdog_interval().map_or(LOOK_EVERY, |interval| interval.min(LOOK_EVERY));
    let mut ticks = tokio::time::interval(every);
    let rounds = TELL_HEALTH_EVERY.as_millis() / every.as_millis().max(1);
    let mut told: Option<Vec<bool>> = None;
    for round in 0u128.. {
        ticks.tick().await;
        let report = reporter.report().await;
        if report.buses.iter().all(|bus| bus.responding) {
            shutdown::feed_watchdog();
        }
        let states = states(&report);
        if round % rounds.max(1) == 0 || told.as_ref() != Some(&states) {
            mailbox.push(Message::retained(topics.bridge_health(), report.to_json().to_string()));
            told = Some(states);
        }
    }
}

/// What is worth telling at once.
fn states(report: &GatewayReport) -> Vec<bool> {
    let buses = report.buses.iter().flat_map(|bus| [bus.report.up, bus.responding]);
    let devices = report.devices().map(|(_, device)| device.online);
    buses.chain(devices).chain([report.broker.connected]).collect()
}
