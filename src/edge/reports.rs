//! Asks every bus how it is, and notices the one that does not answer.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use tokio::sync::oneshot;
use tokio::time::{Instant, timeout_at};

use crate::edge::lock::lock;
use crate::engine::health::{BrokerReport, BusHealth, BusReport, GatewayReport};
use crate::engine::recorder::Recording;
use crate::engine::time::Duration;

/// A bus thread answers between two requests on the wire. One that needs longer is stuck.
const ANSWER_WITHIN: Duration = Duration::from_secs(1);

/// Asks a bus, which answers through the channel.
pub type Ask = Box<dyn Fn(Detail) -> oneshot::Receiver<BusReport> + Send + Sync>;

/// Asks a bus for nothing but an answer.
pub type Call = Box<dyn Fn() -> oneshot::Receiver<()> + Send + Sync>;

/// Asks a bus what was last on its wire; nothing is recorded where it answers with nothing.
pub type AskRecording = Box<dyn Fn() -> oneshot::Receiver<Option<Recording>> + Send + Sync>;

/// How much is asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Detail {
    /// No points. They are most of a report, and few ask for them.
    Devices,
    Points,
    /// The readings as numbers, and no points. They are not kept: of a bus that is stuck there are none.
    Readings,
}

/// A bus that is asked how it is.
pub struct Watched {
    ask: Ask,
    call: Call,
    ask_recording: AskRecording,
    /// What it last said, for the time in which it says nothing.
    last: Mutex<BusReport>,
}

impl Watched {
    /// `first` is how the bus is before it has said anything.
    pub fn new(
        ask: impl Fn(Detail) -> oneshot::Receiver<BusReport> + Send + Sync + 'static,
        call: impl Fn() -> oneshot::Receiver<()> + Send + Sync + 'static,
        ask_recording: impl Fn() -> oneshot::Receiver<Option<Recording>> + Send + Sync + 'static,
        first: BusReport,
    ) -> Watched {
        Watched {
            ask: Box::new(ask),
            call: Box::new(call),
            ask_recording: Box::new(ask_recording),
            last: Mutex::new(first),
        }
    }
}

/// Knows how to reach everything that has something to report.
pub struct Reporter {
    broker: Box<dyn Fn() -> BrokerReport + Send + Sync>,
    buses: Mutex<Vec<Arc<Watched>>>,
    /// Why the newest configuration is not the one that runs.
    configuration_error: Mutex<Option<String>>,
    /// How many changes are at work. Not all buses are there meanwhile.
    changes: AtomicUsize,
}

/// As long as this is kept, what is reported is not to be told: not all buses are there.
pub struct Change(Arc<Reporter>);

impl Drop for Change {
    fn drop(&mut self) {
        self.0.changes.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Reporter {
    pub fn new(
        broker: impl Fn() -> BrokerReport + Send + Sync + 'static,
        buses: Vec<Arc<Watched>>,
    ) -> Reporter {
        Reporter {
            broker: Box::new(broker),
            buses: Mutex::new(buses),
            configuration_error: Mutex::default(),
            changes: AtomicUsize::new(0),
        }
    }

    /// The buses are being exchanged, until the change is dropped.
    pub fn change(reporter: &Arc<Reporter>) -> Change {
        reporter.changes.fetch_add(1, Ordering::Relaxed);
        Change(reporter.clone())
    }

    pub fn is_changing(&self) -> bool {
        self.changes.load(Ordering::Relaxed) > 0
    }

    /// Other buses are asked from now on.
    pub fn replace(&self, buses: Vec<Arc<Watched>>) {
        *lock(&self.buses) = buses;
    }

    /// Of the buses only these are asked from now on.
    pub fn keep(&self, wanted: impl Fn(&str) -> bool) {
        lock(&self.buses).retain(|bus| wanted(&lock(&bus.last).name));
    }

    pub fn set_configuration_error(&self, error: Option<String>) {
        *lock(&self.configuration_error) = error;
    }

    /// What was last on the wire of this bus.
    pub async fn recording(&self, bus: &str) -> Result<Recording, NoRecording> {
        let named = |watched: &&Arc<Watched>| lock(&watched.last).name == bus;
        let watched = lock(&self.buses).iter().find(named).cloned().ok_or(NoRecording::NoSuchBus)?;
        let answer = timeout_at(Instant::now() + ANSWER_WITHIN, (watched.ask_recording)()).await;
        answer.ok().and_then(Result::ok).ok_or(NoRecording::Stuck)?.ok_or(NoRecording::Off)
    }

    /// Whether every bus answers, which costs far less than a report; takes a second if one is stuck.
    pub async fn all_respond(&self) -> bool {
        let deadline = Instant::now() + ANSWER_WITHIN;
        let answers: Vec<oneshot::Receiver<()>> = lock(&self.buses).iter().map(|bus| (bus.call)()).collect();
        for answer in answers {
            if !matches!(timeout_at(deadline, answer).await, Ok(Ok(()))) {
                return false;
            }
        }
        true
    }

    /// The gateway as it is now; takes a second if a bus is stuck, and no longer if several are.
    pub async fn report(&self, detail: Detail) -> GatewayReport {
        let deadline = Instant::now() + ANSWER_WITHIN;
        let watched = lock(&self.buses).clone();
        let answers: Vec<oneshot::Receiver<BusReport>> =
            watched.iter().map(|bus| (bus.ask)(detail)).collect();
        let mut buses = Vec::new();
        for (bus, answer) in watched.iter().zip(answers) {
            let answer = timeout_at(deadline, answer).await.ok().and_then(Result::ok);
            let responding = answer.is_some();
            let mut last = lock(&bus.last);
            let report = match (answer, detail) {
                (Some(report), Detail::Points) => {
                    *last = report.clone();
                    report
                }
                (Some(report), Detail::Devices | Detail::Readings) => {
                    keep_points(&mut last, report.clone());
                    report
                }
                (None, Detail::Points) => last.clone(),
                (None, Detail::Devices | Detail::Readings) => without_points(last.clone()),
            };
            buses.push(BusHealth { report, responding });
        }
        let configuration_error = lock(&self.configuration_error).clone();
        GatewayReport { broker: (self.broker)(), buses, configuration_error }
    }
}

/// Why there is no recording of a bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NoRecording {
    NoSuchBus,
    Off,
    /// The bus does not answer.
    Stuck,
}

/// What was last said of the points is kept for when the bus is stuck.
fn keep_points(last: &mut BusReport, mut report: BusReport) {
    let before = std::mem::take(&mut last.devices);
    report.devices.iter_mut().for_each(|device| device.readings = Vec::new());
    for (device, before) in report.devices.iter_mut().zip(before) {
        if device.name == before.name {
            (device.points, device.things) = (before.points, before.things);
        }
    }
    *last = report;
}

fn without_points(mut report: BusReport) -> BusReport {
    for device in &mut report.devices {
        (device.points, device.things) = Default::default();
    }
    report
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::health::{Counters, Status};

    fn bus(name: &str, requests: u64) -> BusReport {
        BusReport {
            name: name.into(),
            up: true,
            counters: Counters { requests, ..Counters::default() },
            ..BusReport::default()
        }
    }

    #[test]
    fn a_bus_that_does_not_answer_is_stuck_and_told_as_it_last_was() {
        let kept = Mutex::new(Vec::new());
        let good: Ask = Box::new(|_| {
            let (answer, receiver) = oneshot::channel();
            answer.send(bus("good", 7)).expect("somebody listens");
            receiver
        });
        // As long as the sender lives there is hope.
        let silent: Ask = Box::new(move |_| {
            let (answer, receiver) = oneshot::channel();
            kept.lock().expect("nobody panicked").push(answer);
            receiver
        });
        let gone: Ask = Box::new(|_| oneshot::channel().1);
        let broker = || BrokerReport { connected: true, ..BrokerReport::default() };
        let asks = [(silent, bus("silent", 1)), (good, bus("good", 2)), (gone, bus("gone", 3))];
        let no_recording = || oneshot::channel().1;
        let watched = asks.map(|(ask, first)| {
            // It answers a call as it answers a question.
            let ask = Arc::new(ask);
            let of_call = ask.clone();
            let call = move || {
                let (answer, receiver) = oneshot::channel();
                let mut asked = of_call(Detail::Devices);
                match asked.try_recv() {
                    Ok(_) => answer.send(()).expect("somebody listens"),
                    Err(oneshot::error::TryRecvError::Empty) => std::mem::forget(answer),
                    Err(oneshot::error::TryRecvError::Closed) => {}
                }
                receiver
            };
            Arc::new(Watched::new(move |detail| ask(detail), call, no_recording, first))
        });
        let reporter = Reporter::new(broker, watched.to_vec());
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        for (which, responds) in [(0, false), (1, true), (2, false)] {
            reporter.replace(vec![watched[which].clone(), watched[1].clone()]);
            assert_eq!(runtime.block_on(reporter.all_respond()), responds);
        }
        reporter.replace(watched.to_vec());
        let report = runtime.block_on(reporter.report(Detail::Devices));
        let told: Vec<(&str, bool, u64)> = report
            .buses
            .iter()
            .map(|bus| (bus.report.name.as_str(), bus.responding, bus.report.counters.requests))
            .collect();
        assert_eq!(told, [("silent", false, 1), ("good", true, 7), ("gone", false, 3)]);
        assert_eq!(report.status(), Status::Lost);
    }
}
