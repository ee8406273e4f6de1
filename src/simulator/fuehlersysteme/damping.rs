//! The mean of an input's last measurements, which the manual calls damping.
//!
//! It says "Anzahl Messwerte für Mittelwertbildung" of the sensors' RWreg_27 (page 6) and only
//! "Dämpfung/Mittelwertbildung" of the analog inputs (page 19), where it is taken as the same. How often
//! they measure it does not say: here ten times a second.

use std::collections::VecDeque;

use crate::engine::time::{Duration, Time};

/// The last measurements of one input.
#[derive(Clone, Debug)]
pub struct Damping {
    /// The newest at the back.
    measurements: VecDeque<f64>,
    /// As many as the register allows at most.
    kept: usize,
    measured_at: Time,
}

const MEASURED_EVERY: Duration = Duration::from_millis(100);

impl Damping {
    pub fn new(now: Time, kept: u16) -> Damping {
        Damping { measurements: VecDeque::new(), kept: kept.into(), measured_at: now }
    }

    /// Measures what has been there since the last measurement.
    pub fn advance(&mut self, now: Time, amount: f64) {
        let times = now.since(self.measured_at).as_millis() / MEASURED_EVERY.as_millis();
        self.measured_at += Duration::from_millis((times * MEASURED_EVERY.as_millis()) as u64);
        self.measurements.extend(std::iter::repeat_n(amount, times.min(self.kept as u128) as usize));
        let surplus = self.measurements.len().saturating_sub(self.kept);
        self.measurements.drain(..surplus);
    }

    /// The mean of so many, or of as many as there are.
    pub fn mean(&self, count: u16) -> f64 {
        let newest = || self.measurements.iter().rev().take(count.max(1).into());
        newest().sum::<f64>() / newest().count().max(1) as f64
    }

    /// When the mean of what is kept next changes, if `amount` stays.
    pub fn changes_at(&self, amount: f64) -> Option<Time> {
        let settled = self.measurements.len() == self.kept
            && self.measurements.iter().all(|measured| *measured == amount);
        (!settled).then_some(self.measured_at + MEASURED_EVERY)
    }
}
