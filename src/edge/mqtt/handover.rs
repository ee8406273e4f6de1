//! A connection is exchanged for another one, and no command falls between the two or comes twice.
//!
//! The broker lets in one client of an identifier, so the old connection has to go before the new one can come.
//! Meanwhile a third one stands in for them. A broker hands the same messages to all in the same order: markers
//! among them say where the stand-in begins to take commands, at which the old one stops, and where it ends, at
//! which the new one begins. A broker keeps messages in order only within one quality of service, so there are
//! two of each.

use std::sync::{Arc, Mutex};

use rumqttc::{
    AsyncClient, ClientError, Event, EventLoop, MqttOptions, Packet, QoS, SubscribeFilter,
    SubscribeReasonCode,
};
use tokio::sync::Notify;
use tokio::task::JoinHandle;

use super::feeder::{News, news_of};
use super::lock;
use crate::engine::time::Duration;
use crate::engine::topics::Topics;

/// Who does not stand in by then does not, and the old one is not waited for any longer.
const WITHIN: Duration = Duration::from_secs(2);

/// Commands that wait until the old connection is known to take no more.
const HELD_MAX: usize = 1000;

/// One exchange, as all who take part in it see it.
pub(super) struct Handover {
    pub(super) topic: String,
    /// Nobody else's markers are meant.
    number: u64,
    /// By quality of service.
    stages: Mutex<[Stage; 2]>,
    changed: Notify,
}

/// The number of a stage.
pub(super) fn quality(qos: QoS) -> usize {
    usize::from(qos != QoS::AtMostOnce)
}

/// Both markers are told, at their qualities.
pub(super) fn tell_marker(client: &AsyncClient, topic: &str, marker: &str) -> Result<(), ClientError> {
    [QoS::AtMostOnce, QoS::AtLeastOnce]
        .into_iter()
        .try_for_each(|qos| client.try_publish(topic, qos, false, marker))
}

enum Stage {
    /// The stand-in is not there yet.
    Prepared,
    /// It takes commands, which are held until the old connection takes none.
    Begun(Vec<News>),
    /// It takes commands, and nobody else does.
    StandsIn,
    /// The new connection takes over where it finds the marker.
    Ends,
    /// There is no stand-in, or none any more.
    Off,
}

impl Handover {
    pub(super) fn new(topics: &Topics, number: u64) -> Handover {
        let stages = Mutex::new([Stage::Prepared, Stage::Prepared]);
        Handover { topic: topics.handover(), number, stages, changed: Notify::new() }
    }

    fn begins(&self) -> String {
        format!("{:x} begins", self.number)
    }

    pub(super) fn ends(&self) -> String {
        format!("{:x} ends", self.number)
    }

    /// Whether from this marker on the old connection takes no commands. Those that were held are told.
    pub(super) fn silences(&self, quality: usize, marker: &str, tell: impl Fn(News)) -> bool {
        marker == self.begins() && self.stand_in(quality, tell)
    }

    /// Whether nobody stands in for a connection that waits for its marker.
    pub(super) fn is_off(&self) -> bool {
        matches!(*lock(&self.stages), [Stage::Off, _] | [_, Stage::Off])
    }

    /// The old connection takes nothing more; `false` if nobody stands in for it.
    fn stand_in(&self, quality: usize, tell: impl Fn(News)) -> bool {
        let mut stages = lock(&self.stages);
        let stage = &mut stages[quality];
        match std::mem::replace(stage, Stage::StandsIn) {
            // The old one has found the marker first.
            Stage::Prepared => {}
            // Told before anything newer.
            Stage::Begun(held) => held.into_iter().for_each(tell),
            Stage::StandsIn => {}
            other => *stage = other,
        }
        let stands_in = matches!(*stage, Stage::StandsIn);
        drop(stages);
        self.changed.notify_one();
        stands_in
    }

    fn begun(&self, quality: usize) {
        let stage = &mut lock(&self.stages)[quality];
        if matches!(stage, Stage::Prepared) {
            *stage = Stage::Begun(Vec::new());
        }
    }

    fn take(&self, quality: usize, news: News, tell: impl Fn(News)) {
        match &mut lock(&self.stages)[quality] {
            Stage::Begun(held) if held.len() < HELD_MAX => held.push(news),
            Stage::StandsIn => tell(news),
            Stage::Begun(_) | Stage::Prepared | Stage::Ends | Stage::Off => {}
        }
    }

    /// Whether that was the last of the qualities.
    fn end(&self, quality: usize) -> bool {
        let mut stages = lock(&self.stages);
        stages[quality] = Stage::Ends;
        matches!(*stages, [Stage::Ends, Stage::Ends])
    }

    fn off(&self) {
        *lock(&self.stages) = [Stage::Off, Stage::Off];
        self.changed.notify_one();
    }
}

/// Takes commands while a connection is exchanged.
pub(super) struct StandIn {
    pub(super) handover: Arc<Handover>,
    task: JoinHandle<()>,
}

impl StandIn {
    /// `options` are those of the new connection, without a last will. Only within a runtime.
    pub(super) fn start(
        mut options: MqttOptions,
        topics: &Topics,
        handover: Arc<Handover>,
        tell: impl Fn(News) + Send + 'static,
    ) -> StandIn {
        options.set_client_id(format!("{}_stand_in", options.client_id()));
        let (client, event_loop) = AsyncClient::new(options, 10);
        let (of_task, topics) = (handover.clone(), topics.clone());
        let task = tokio::spawn(async move {
            if stand_in(client, event_loop, &of_task, &topics, tell).await.is_none() {
                of_task.off();
            }
        });
        StandIn { handover, task }
    }

    /// Waits until it takes commands and the old connection does not. `false`: it does not come to that. Where the
    /// old one has not found the marker it is at another broker, and there it may take what comes.
    pub(super) async fn stands_in(&self, tell: impl Fn(News)) -> bool {
        // What changes between a look and the waiting is kept for that.
        let is_decided =
            || lock(&self.handover.stages).iter().all(|stage| matches!(stage, Stage::StandsIn | Stage::Off));
        let decided = async {
            while !is_decided() {
                self.handover.changed.notified().await;
            }
        };
        if tokio::time::timeout(WITHIN, decided).await.is_err() {
            let is_late = lock(&self.handover.stages).iter().any(|stage| matches!(stage, Stage::Prepared));
            if is_late {
                self.handover.off();
            }
        }
        [0, 1].into_iter().all(|quality| self.handover.stand_in(quality, &tell))
    }

    /// Whether it has come to its end.
    pub(super) fn has_ended(&self) -> bool {
        self.task.is_finished()
    }
}

impl Drop for StandIn {
    fn drop(&mut self) {
        self.task.abort();
        // Whoever waits for its marker waits no longer.
        if !matches!(*lock(&self.handover.stages), [Stage::Ends, Stage::Ends]) {
            self.handover.off();
        }
    }
}

/// Until the marker of the end; `None` if the connection does not last until then.
async fn stand_in(
    client: AsyncClient,
    mut event_loop: EventLoop,
    handover: &Handover,
    topics: &Topics,
    tell: impl Fn(News),
) -> Option<()> {
    let mut takes = [false; 2];
    loop {
        match event_loop.poll().await.ok()? {
            Event::Incoming(Packet::ConnAck(_)) => {
                let filters = topics.commands().into_iter().chain([handover.topic.clone()]);
                let filters = filters.map(|filter| SubscribeFilter::new(filter, QoS::AtLeastOnce));
                client.try_subscribe_many(filters).ok()?;
            }
            Event::Incoming(Packet::SubAck(answer)) => {
                if answer.return_codes.contains(&SubscribeReasonCode::Failure) {
                    return None;
                }
                tell_marker(&client, &handover.topic, &handover.begins()).ok()?;
            }
            Event::Incoming(Packet::Publish(publish)) => {
                let payload = String::from_utf8_lossy(&publish.payload).into_owned();
                let quality = quality(publish.qos);
                if publish.topic == handover.topic {
                    takes[quality] |= payload == handover.begins();
                    if takes[quality] {
                        handover.begun(quality);
                    }
                    if payload == handover.ends() && handover.end(quality) {
                        client.try_disconnect().ok()?;
                        while event_loop.poll().await.is_ok() {}
                        return Some(());
                    }
                } else if takes[quality] && !publish.retain {
                    if let Some(news) = news_of(topics, &publish.topic, payload, false, None) {
                        handover.take(quality, news, &tell);
                    }
                }
            }
            _ => {}
        }
    }
}
