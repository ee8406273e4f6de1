//! Asks every bus how it is, and notices the one that does not answer.

use std::sync::{Mutex, PoisonError};

use tokio::sync::oneshot;
use tokio::time::{Instant, timeout_at};

use crate::engine::health::{BrokerReport, BusHealth, BusReport, GatewayReport};
use crate::engine::time::Duration;

/// A bus thread answers between two requests on the wire. One that needs longer is stuck.
const ANSWER_WITHIN: Duration = Duration::from_secs(1);

/// Asks a bus, which answers through the channel.
pub type Ask = Box<dyn Fn() -> oneshot::Receiver<BusReport> + Send + Sync>;

/// Knows how to reach everything that has something to report.
pub struct Reporter {
    broker: Box<dyn Fn() -> BrokerReport + Send + Sync>,
    buses: Vec<Ask>,
    /// What each bus last said, for the time in which it says nothing.
    last: Mutex<Vec<BusReport>>,
}

impl Reporter {
    /// `first` is how each bus is before it has said anything.
    pub fn new(
        broker: impl Fn() -> BrokerReport + Send + Sync + 'static,
        buses: Vec<Ask>,
        first: Vec<BusReport>,
    ) -> Reporter {
        Reporter { broker: Box::new(broker), buses, last: Mutex::new(first) }
    }

    /// The gateway as it is now; takes a second if a bus is stuck, and no longer if several are.
    pub async fn report(&self) -> GatewayReport {
        let deadline = Instant::now() + ANSWER_WITHIN;
        let answers: Vec<oneshot::Receiver<BusReport>> = self.buses.iter().map(|ask| ask()).collect();
        let mut buses = Vec::new();
        for (index, answer) in answers.into_iter().enumerate() {
            let answer = timeout_at(deadline, answer).await.ok().and_then(Result::ok);
            let responding = answer.is_some();
            let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(report) = answer {
                last[index] = report;
            }
            buses.push(BusHealth { report: last[index].clone(), responding });
        }
        GatewayReport { broker: (self.broker)(), buses }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::health::{Counters, Status};

    fn bus(name: &str, requests: u64) -> BusReport {
        BusReport {
            name: name.into(),
            link: "tcp".into(),
            line: None,
            up: true,
            reason: None,
            paused: false,
            counters: Counters { requests, ..Counters::default() },
            load: 0.0,
            devices: Vec::new(),
        }
    }

    #[test]
    fn a_bus_that_does_not_answer_is_stuck_and_told_as_it_last_was() {
        let kept = Mutex::new(Vec::new());
        let good: Ask = Box::new(|| {
            let (answer, receiver) = oneshot::channel();
            answer.send(bus("good", 7)).expect("somebody listens");
            receiver
        });
        // As long as the sender lives there is hope.
        let silent: Ask = Box::new(move || {
            let (answer, receiver) = oneshot::channel();
            kept.lock().expect("nobody panicked").push(answer);
            receiver
        });
        let gone: Ask = Box::new(|| oneshot::channel().1);
        let broker = || BrokerReport { connected: true, ..BrokerReport::default() };
        let first = vec![bus("silent", 1), bus("good", 2), bus("gone", 3)];
        let reporter = Reporter::new(broker, vec![silent, good, gone], first);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let report = runtime.expect("a runtime").block_on(reporter.report());
        let told: Vec<(&str, bool, u64)> = report
            .buses
            .iter()
            .map(|bus| (bus.report.name.as_str(), bus.responding, bus.report.counters.requests))
            .collect();
        assert_eq!(told, [("silent", false, 1), ("good", true, 7), ("gone", false, 3)]);
        assert_eq!(report.status(), Status::Lost);
    }
}
