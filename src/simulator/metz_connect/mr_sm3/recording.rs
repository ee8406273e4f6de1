//! The curves of the voltages that MR-SM3 records, registers 256 to 895 and 127 (pages 83 and 84).

use crate::engine::time::{Duration, Time};
use crate::simulator::device::PhaseQuantity;
use crate::simulator::metz_connect::mr_sm3::grid::{PHASES, Phase};

/// What a phase carries now, and what it carried before its last change, which a curve may still show.
#[derive(Clone, Copy, Debug)]
pub struct Source {
    now: Phase,
    before: Phase,
    changed_at: Time,
}

/// One recording after the other, until it is stopped.
///
/// The manual names the number of samples and the time that they last. Here a running recorder shows
/// the last recording that is whole, and so do its registers when it is stopped.
pub struct Recorder {
    started: Time,
    /// Bit 1 of register 127. It is not marked as EEPROM.
    is_long: bool,
    /// What was recorded last, when it is stopped.
    stopped: Option<[[i16; SAMPLES]; PHASES]>,
}

/// How many samples a recording has.
pub const SAMPLES: usize = 128;
const IS_STOPPED: u16 = 1;
const IS_LONG: u16 = 2;
const SHORT: Duration = Duration::from_millis(100);
const LONG: Duration = Duration::from_millis(200);

impl Source {
    /// The phase with this number, which counts from 0.
    pub fn new(number: usize) -> Source {
        let phase = Phase::of_net(number);
        Source { now: phase, before: phase, changed_at: Time::default() }
    }

    pub fn now(&self) -> &Phase {
        &self.now
    }

    pub fn set(&mut self, now: Time, quantity: PhaseQuantity, amount: f64) -> Result<(), String> {
        let mut phase = self.now;
        phase.set(quantity, amount)?;
        // What is set at the same time is one change.
        if now > self.changed_at {
            self.before = self.now;
            self.changed_at = now;
        }
        self.now = phase;
        Ok(())
    }

    /// The voltage at one moment, in microseconds.
    fn volts_at(&self, micros: f64) -> f64 {
        let phase = if micros < self.changed_at.0 as f64 { &self.before } else { &self.now };
        phase.volts_at(micros)
    }
}

impl Recorder {
    pub fn new(now: Time) -> Recorder {
        Recorder { started: now, is_long: false, stopped: None }
    }

    /// Register 127.
    pub fn status(&self) -> u16 {
        let stopped = if self.stopped.is_some() { IS_STOPPED } else { 0 };
        stopped | if self.is_long { IS_LONG } else { 0 }
    }

    /// Bit 0 is only read: the fault bits of register 126 start and stop.
    pub fn set_status(&mut self, word: u16) {
        self.is_long = word & IS_LONG != 0;
    }

    /// A recorder that stands still keeps what it has.
    pub fn stop(&mut self, sources: &[Source; PHASES], at: Time) {
        if self.stopped.is_none() {
            let samples = |phase| std::array::from_fn(|number| self.sample(sources, at, phase, number));
            self.stopped = Some(std::array::from_fn(samples));
        }
    }

    pub fn resume(&mut self) {
        self.stopped = None;
    }

    /// A sample in tenths of a volt; 0 before the first recording is whole.
    pub fn sample(&self, sources: &[Source; PHASES], now: Time, phase: usize, number: usize) -> i16 {
        if let Some(stopped) = &self.stopped {
            return stopped[phase][number];
        }
        let duration = if self.is_long { LONG } else { SHORT }.as_micros() as u64;
        let whole = now.since(self.started).as_micros() as u64 / duration;
        let Some(before) = whole.checked_sub(1) else { return 0 };
        let micros =
            (self.started.0 + before * duration) as f64 + duration as f64 * number as f64 / SAMPLES as f64;
        (sources[phase].volts_at(micros) * 10.0).round() as i16
    }
}
