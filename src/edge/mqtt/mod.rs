//! The connection to the broker. One task does nothing but poll the client library, and brings what is for a bus
//! there at once; another feeds the library with what the outbox holds, and minds all else that comes in.

mod courier;
mod feeder;
mod losses;
mod mailbox;
mod poller;

use std::sync::{Arc, Mutex};

use rumqttc::{AsyncClient, LastWill, MqttOptions, NetworkOptions, QoS};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;

use self::courier::Courier;
pub use self::courier::News;
use self::feeder::{Feeder, Order};
use self::losses::Ends;
pub use self::mailbox::Mailbox;
use self::poller::Poller;
use crate::edge::clock::Clock;
use crate::edge::lock::lock;
use crate::edge::secrets::Secrets;
use crate::engine::arrivals::{Arrivals, Subscriptions};
use crate::engine::connection::Connection;
use crate::engine::health::BrokerReport;
use crate::engine::outbox::Outbox;
use crate::engine::settings::{Mqtt, Settings};
use crate::engine::time::Duration;
use crate::engine::topics::{OFFLINE, Topics};

/// Requests that the library may hold; the others wait in the outbox, where a newer value replaces an
/// older one.
const IN_FLIGHT: usize = 50;

/// A device with a thousand points is announced in 215 kB. Larger than anything sane, since a packet
/// above the limit ends the connection.
const PACKET_BYTES_MAX: usize = 16 * 1024 * 1024;

/// Orders that may wait; whoever gives more waits for the feeder.
const ORDERS_MAX: usize = 4;

/// How long the last messages may take when the program ends.
const GOODBYE: Duration = Duration::from_secs(3);

/// How the connection is, for whoever wants to tell.
#[derive(Clone)]
pub struct BrokerState {
    state: Arc<Mutex<BrokerReport>>,
    connection: Arc<Mutex<Connection>>,
    mailbox: Arc<Mailbox>,
    clock: Clock,
}

impl BrokerState {
    pub fn report(&self) -> BrokerReport {
        let mut report = lock(&self.state).clone();
        report.client_id_taken = lock(&self.connection).is_contested(self.clock.now());
        let outbox = self.mailbox.outbox();
        (report.waiting, report.dropped) = (outbox.waiting(), outbox.dropped());
        report.state_denied = outbox.is_denied(self.clock.now());
        report.kept_back = outbox.kept_back();
        report.not_arriving = outbox.not_arriving();
        report.announced_by_others = outbox.rivals();
        drop(outbox);
        report
    }
}

/// The running connection.
pub struct Broker {
    state: BrokerState,
    orders: mpsc::Sender<Order>,
    feeder: JoinHandle<()>,
}

impl Broker {
    /// Connects, and goes on connecting. `tell` is called from the runtime and must not wait.
    pub fn start(
        settings: &Settings,
        secrets: Secrets,
        clock: Clock,
        mailbox: Arc<Mailbox>,
        tell: impl Fn(News) + Send + Sync + 'static,
    ) -> Broker {
        let topics = Topics::of(&settings.mqtt);
        let options = options(&settings.mqtt, &topics, secrets);
        let client_id = options.client_id();
        mailbox.change(Outbox::disconnected);
        let (client, mut event_loop) = AsyncClient::new(options, IN_FLIGHT);
        event_loop.set_network_options(network());
        let state = Arc::new(Mutex::new(BrokerReport::default()));
        let connection = Arc::new(Mutex::new(Connection::default()));
        let (events_out, events) = mpsc::channel(IN_FLIGHT);
        let arrivals = Arrivals::new(settings, mailbox.look(Outbox::former_states));
        let courier = Arc::new(Courier::new(arrivals, tell));
        let poller = Poller {
            event_loop,
            courier: courier.clone(),
            seen: events_out,
            connection: connection.clone(),
            mqtt: settings.mqtt.clone(),
            ends: Ends {
                address: settings.mqtt.address(),
                client_id,
                base_topic: settings.mqtt.base_topic.clone(),
                websocket: settings.mqtt.websocket.is_some(),
            },
            unreadable: None,
            clock,
        };
        let poller = tokio::spawn(poller.run());
        let (orders, orders_heard) = mpsc::channel(ORDERS_MAX);
        let feeder = Feeder {
            client,
            clock,
            topics,
            courier,
            mailbox: mailbox.clone(),
            state: state.clone(),
            connection: connection.clone(),
            connected: false,
            told_up: None,
            subscriptions: Subscriptions::default(),
            awaits_answer: None,
            ending: false,
        };
        let feeder = tokio::spawn(async move {
            feeder.run(events, orders_heard).await;
            poller.abort();
        });
        let state = BrokerState { state, connection, mailbox, clock };
        Broker { state, orders, feeder }
    }

    pub fn state(&self) -> BrokerState {
        self.state.clone()
    }

    /// Other topics are listened to from now on, on the same connection. Waits until the broker has confirmed it.
    pub async fn listen_to(&self, settings: &Settings) {
        let former_states = self.state.mailbox.look(Outbox::former_states);
        let (told, confirmed) = oneshot::channel();
        // The other side is gone only with the program.
        let _ = self.orders.send(Order::ListenTo(Arrivals::new(settings, former_states), told)).await;
        // A broker that is away is asked when it is there again.
        let _ = tokio::time::timeout(GOODBYE, confirmed).await;
    }

    /// Sends what waits, then `offline`, and disconnects, so that no last will follows. Gives up after
    /// some seconds: then the last will says the same. What waits is in `rest`, if there is one.
    pub async fn finish(mut self, rest: Option<Arc<Mailbox>>) {
        // The other side is gone only if the feeder has ended already.
        let _ = self.orders.send(Order::End(rest)).await;
        if tokio::time::timeout(GOODBYE, &mut self.feeder).await.is_err() {
            tracing::warn!("the broker did not take the last messages in time");
            self.feeder.abort();
        }
    }
}

fn options(mqtt: &Mqtt, topics: &Topics, secrets: Secrets) -> MqttOptions {
    // The same after every start: a gateway that was cut off takes its own place again. And the same
    // for every gateway with this base topic: of two that would answer for the same devices, the broker
    // lets in one.
    let client = format!("{}_gateway", topics.instance());
    let address = match &mqtt.websocket {
        None => mqtt.host.clone(),
        // The library wants a whole URL.
        Some(path) => {
            let scheme = if mqtt.tls.is_some() { "wss" } else { "ws" };
            format!("{scheme}://{}{path}", mqtt.address())
        }
    };
    let mut options = MqttOptions::new(client, address, mqtt.port);
    // Told to the broker in whole seconds.
    options.set_keep_alive(Duration::from_secs(mqtt.keep_alive.as_millis().div_ceil(1000) as u64));
    // A command is for now: the broker shall not keep any for a gateway that is not there.
    options.set_clean_session(true);
    options.set_max_packet_size(PACKET_BYTES_MAX, PACKET_BYTES_MAX);
    options.set_last_will(LastWill::new(topics.bridge_state(), OFFLINE, QoS::AtLeastOnce, true));
    secrets.enter(&mut options, mqtt);
    options
}

/// What is told goes out at once. Otherwise the kernel holds it back while anything before it is not acknowledged:
/// the outcome of a command for 40 ms behind the confirmation that the command has come.
fn network() -> NetworkOptions {
    let mut network = NetworkOptions::new();
    network.set_tcp_nodelay(true);
    network
}
