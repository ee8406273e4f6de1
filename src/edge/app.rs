//! Starts what runs and ends it in order: the threads of the buses, and a small runtime for the broker and
//! HTTP.

use std::net::SocketAddr;
use std::sync::Arc;

use anyhow::Context;
use tokio::task::JoinHandle;
use tokio::time::sleep;

use crate::edge::bus_thread::{BusHandle, Threads};
use crate::edge::clock::Clock;
use crate::edge::files;
use crate::edge::http::Http;
use crate::edge::mqtt::{Broker, Mailbox};
use crate::edge::plant::Plant;
use crate::edge::reports::{Detail, Reporter, Watched};
use crate::edge::runtime::Runtime;
use crate::edge::secrets::Secrets;
use crate::edge::shutdown::{self, Heard, Signals};
use crate::edge::state_files::{Shelf, StateFiles};
use crate::engine::health::{self, Bulletin, GatewayReport};
use crate::engine::homeassistant;
use crate::engine::profile::Library;
use crate::engine::reload;
use crate::engine::settings::Settings;
use crate::engine::time::{Duration, Time};

/// How long the buses may take to finish what is in flight.
pub(super) const BUSES_END_WITHIN: Duration = Duration::from_secs(10);

/// A running gateway.
pub struct App {
    pub(super) runtime: Runtime,
    pub(super) clock: Clock,
    pub(super) plant: Arc<Plant>,
    pub(super) broker: Option<Broker>,
    pub(super) keys: Keys,
    pub(super) http: Option<Http>,
    pub(super) reporter: Arc<Reporter>,
    pub(super) state: Arc<Shelf>,
    pub(super) threads: Threads,
    pub(super) watch: JoinHandle<()>,
}

/// Secrets that the settings only name, since they stand in files: they may change while the settings do not.
pub(super) struct Keys {
    pub(super) password: Option<String>,
    pub(super) token: Option<String>,
}

impl Keys {
    pub(super) fn read(settings: &Settings) -> anyhow::Result<Keys> {
        Ok(Keys {
            password: files::read_secret("password", &settings.mqtt.password)?,
            token: files::read_token(&settings.http.token)?,
        })
    }
}

impl App {
    /// Starts everything, going on from what is remembered in `state`. By `library` a scan
    /// knows devices. An error means that nothing is left running.
    pub fn start(settings: Settings, library: Library, state: StateFiles) -> anyhow::Result<App> {
        App::start_on(App::runtime()?, settings, library, state)
    }

    /// What an app runs on.
    pub fn runtime() -> anyhow::Result<Runtime> {
        Runtime::start().context("the runtime cannot be started")
    }

    /// The same on a runtime on which signals are heard already.
    pub fn start_on(
        runtime: Runtime,
        settings: Settings,
        library: Library,
        state: StateFiles,
    ) -> anyhow::Result<App> {
        let (keys, secrets) = (Keys::read(&settings)?, Secrets::read(&settings.mqtt)?);
        let clock = Clock::start();
        let state = Arc::new(Shelf::new(state));
        // What can fail comes before what cannot.
        let listener = match &settings.http.listen {
            Some(listen) => Some(runtime.block_on(Http::bind(listen))?),
            None => None,
        };
        let plant = Arc::new(Plant::new(settings, library, clock));
        recall(&plant, &state.now());
        introduce(&plant.settings(), &plant.mailbox());
        let threads = Threads::new(clock, state.clone(), plant.stir().clone());
        let buses = start_buses(&threads, &plant)?;
        plant.set_buses(buses.clone());

        let _inside = runtime.enter();
        let broker = connect(&plant, secrets, clock);
        let of_reporter = plant.clone();
        let reporter = Arc::new(Reporter::new(move || of_reporter.broker(), watched(&buses)));
        let http =
            listener.map(|listener| Http::serve(listener, reporter.clone(), clock, keys.token.clone()));
        let watch = tokio::spawn(watch(reporter.clone(), plant.clone(), state.clone()));
        Ok(App { runtime, clock, plant, broker: Some(broker), keys, http, reporter, state, threads, watch })
    }

    /// Where HTTP listens, if it does.
    pub fn http_address(&self) -> Option<SocketAddr> {
        self.http.as_ref().map(Http::address)
    }

    /// The gateway as it is now. Not from within a runtime.
    pub fn report(&self) -> GatewayReport {
        self.runtime.block_on(self.reporter.report(Detail::Points))
    }

    /// Waits for a signal.
    pub fn wait(&self, signals: &mut Signals) -> Heard {
        self.runtime.block_on(signals.wait())
    }

    /// Ends in order: the buses finish what is in flight and say `offline`, then the gateway says it
    /// and disconnects.
    pub fn stop(self) {
        self.watch.abort();
        end_buses(&self.runtime, self.plant.buses());
        // Also what is told only now.
        store_what_is_told(&self.plant, &self.state.now(), self.clock.now());
        if let Some(broker) = self.broker {
            self.runtime.block_on(broker.finish(None));
        }
        if let Some(http) = self.http {
            http.stop();
        }
        drop(self.runtime);
        self.state.now().finish();
    }
}

/// What Home Assistant and the broker still have of earlier runs, whatever the broker has forgotten.
fn recall(plant: &Plant, state: &StateFiles) {
    let wanted = reload::topics_of_devices(&plant.settings());
    plant.mailbox().change(|outbox| outbox.recall(state.take_announced(), state.take_trees(), &wanted));
    remember_topics(plant, state);
}

/// Stores where something is told from now on, and what is to be taken back.
pub(super) fn remember_topics(plant: &Plant, state: &StateFiles) {
    let told_on = reload::topics_of_devices(&plant.settings());
    state.store_trees(&plant.mailbox().look(|outbox| outbox.trees(told_on)));
}

/// Stores what Home Assistant may have, and what is to be taken back at the broker as far as that has not arrived.
fn store_what_is_told(plant: &Plant, state: &StateFiles, now: Time) {
    let mailbox = plant.mailbox();
    let has_less_to_take_back = mailbox.settle(now);
    mailbox.look(|outbox| state.store_announced(&outbox.ledger()));
    if has_less_to_take_back {
        remember_topics(plant, state);
    }
}

/// What is known of the gateway before anything has happened.
pub(super) fn introduce(settings: &Settings, mailbox: &Mailbox) {
    mailbox.push(health::info(settings));
    homeassistant::introduction(settings).into_iter().for_each(|message| mailbox.push(message));
}

/// Starts the plant's buses. An error means that none of them runs.
fn start_buses(threads: &Threads, plant: &Plant) -> anyhow::Result<Vec<Arc<BusHandle>>> {
    let settings = plant.settings();
    let mut buses: Vec<Arc<BusHandle>> = Vec::new();
    for index in 0..settings.buses.len() {
        match start_bus(threads, &settings, index, plant.mailbox()) {
            Ok(handle) => buses.push(handle),
            Err(error) => {
                buses.iter().for_each(|bus| bus.shutdown());
                buses.iter().for_each(|bus| bus.join());
                return Err(error);
            }
        }
    }
    Ok(buses)
}

/// Starts the bus number `index` of the settings, which tells what it has to tell through `mailbox`.
pub(super) fn start_bus(
    threads: &Threads,
    settings: &Arc<Settings>,
    index: usize,
    mailbox: Arc<Mailbox>,
) -> anyhow::Result<Arc<BusHandle>> {
    let started = threads.start(settings.clone(), index, Box::new(move |message| mailbox.push(message)));
    let name = &settings.buses[index].name;
    started.map(Arc::new).with_context(|| format!("bus {name} cannot be started"))
}

/// Ends these buses: what is in flight is finished, and `offline` is said.
pub(super) fn end_buses(runtime: &Runtime, buses: Vec<Arc<BusHandle>>) {
    buses.iter().for_each(|bus| bus.shutdown());
    runtime.block_on(async {
        let ended = tokio::task::spawn_blocking(move || buses.iter().for_each(|bus| bus.join()));
        if tokio::time::timeout(BUSES_END_WITHIN, ended).await.is_err() {
            tracing::warn!("a bus does not end; it is left alone");
        }
    });
}

/// Connects to the plant's broker. Only within a runtime.
pub(super) fn connect(plant: &Arc<Plant>, secrets: Secrets, clock: Clock) -> Broker {
    let of_route = plant.clone();
    let route = move |news| of_route.tell(news);
    let broker = Broker::start(&plant.settings(), secrets, clock, plant.mailbox(), route);
    plant.set_connection(broker.state());
    broker
}

/// How the buses are asked how they are, and what is told before they have answered.
pub(super) fn watched(buses: &[Arc<BusHandle>]) -> Vec<Arc<Watched>> {
    let of_bus = |bus: &Arc<BusHandle>| {
        let first = bus.first_summary();
        let (bus, of_call, of_recording) = (bus.clone(), bus.clone(), bus.clone());
        let call = move || of_call.inspect(|_, _| ());
        let ask_recording =
            move || of_recording.inspect(|bus, now| bus.recording(now, "on request over HTTP"));
        let ask = move |detail| {
            bus.inspect(move |bus, now| match detail {
                Detail::Devices => bus.summary(now),
                Detail::Points => bus.report(now),
                Detail::Readings => bus.readings(now),
            })
        };
        Arc::new(Watched::new(ask, call, ask_recording, first))
    };
    buses.iter().map(of_bus).collect()
}

/// Looks at the gateway when something stirs, and now and then when nothing does: tells its health, and feeds
/// systemd's watchdog while every bus answers.
pub(super) async fn watch(reporter: Arc<Reporter>, plant: Arc<Plant>, state: Arc<Shelf>) {
    let clock = plant.clock();
    let mut bulletin = Bulletin::new(&plant.settings(), shutdown::watchdog_interval());
    let mut has_stirred = true;
    loop {
        let now = clock.now();
        store_what_is_told(&plant, &state.now(), now);
        let wants_report = has_stirred || bulletin.wants_report(now, &plant.broker());
        let all_respond = if !wants_report && reporter.all_respond().await {
            true
        } else {
            let report = reporter.report(Detail::Devices).await;
            // Who changes the buses stirs at the end, and has to come to that: this must wait, too, where there
            // is no bus that could be waited for.
            if reporter.is_changing() {
                bulletin.doubt();
            } else {
                let mailbox = plant.mailbox();
                let messages = bulletin.messages(now, &plant.settings(), &report);
                messages.into_iter().for_each(|message| mailbox.push(message));
            }
            report.all_respond()
        };
        if all_respond {
            shutdown::feed_watchdog();
        }
        has_stirred = stirs(&plant, now, bulletin.next_look(now), bulletin.pause()).await;
    }
}

/// Waits until something stirs (`true`), though not less than `pause` after the look at `looked_at`; or until
/// `next`.
async fn stirs(plant: &Plant, looked_at: Time, next: Time, pause: Duration) -> bool {
    let clock = plant.clock();
    tokio::select! {
        () = sleep(clock.until(next)) => false,
        () = plant.stir().stirred() => {
            sleep(clock.until(looked_at + pause)).await;
            true
        }
    }
}
