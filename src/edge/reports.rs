//! Asks every bus how it is, and notices the one that does not answer.

use std::sync::{Mutex, PoisonError};

use tokio::sync::oneshot;
use tokio::time::{Instant, timeout_at};

use crate::edge::mqtt::BrokerState;
use crate::engine::health::{BusHealth, BusReport, GatewayReport};
use crate::engine::time::Duration;

/// A bus thread answers between two requests on the wire. One that needs longer is stuck.
const ANSWER_WITHIN: Duration = Duration::from_secs(1);

/// Asks a bus, which answers through the channel.
pub type Ask = Box<dyn Fn() -> oneshot::Receiver<BusReport> + Send + Sync>;

/// Knows how to reach everything that has something to report.
pub struct Reporter {
    broker: BrokerState,
    buses: Vec<Ask>,
    /// What each bus last said, for the time in which it says nothing.
    last: Mutex<Vec<BusReport>>,
}

impl Reporter {
    /// `first` is how each bus is before it has said anything.
    pub fn new(broker: BrokerState, buses: Vec<Ask>, first: Vec<BusReport>) -> Reporter {
        Reporter { broker, buses, last: Mutex::new(first) }
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
        GatewayReport { broker: self.broker.report(), buses }
    }
}
