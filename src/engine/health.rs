//! What a bus and its devices say of themselves: counters, states and reasons.

use crate::engine::modbus::{Discarded, RequestError};
use crate::engine::time::Time;

/// What happened on the wire, each error counted as what it was.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    pub requests: u64,
    pub answers: u64,
    pub timeouts: u64,
    pub checksum_errors: u64,
    pub wrong_frames: u64,
    pub exceptions: u64,
    pub late_replies: u64,
    pub foreign_frames: u64,
    pub echoes: u64,
    pub noise_bytes: u64,
    pub writes: u64,
    /// Writes to points in EEPROM.
    pub persistent_writes: u64,
}

impl Counters {
    /// Counts what was thrown away before a reply.
    pub fn count_discarded(&mut self, discarded: Discarded) {
        self.late_replies += u64::from(discarded.late_replies);
        self.foreign_frames += u64::from(discarded.foreign_frames);
        self.echoes += u64::from(discarded.echoes);
        self.noise_bytes += u64::from(discarded.noise_bytes);
        self.checksum_errors += u64::from(discarded.checksum_errors);
    }

    /// Counts how a request ended.
    pub fn count_result<T>(&mut self, result: &Result<T, RequestError>) {
        // It never reached the wire.
        if matches!(result, Err(RequestError::Impossible(_))) {
            return;
        }
        self.requests += 1;
        match result {
            Ok(_) => self.answers += 1,
            Err(RequestError::Exception(_)) => self.exceptions += 1,
            Err(RequestError::Timeout) => self.timeouts += 1,
            // Counted with what was thrown away.
            Err(RequestError::Checksum) => {}
            Err(RequestError::WrongFrame) => self.wrong_frames += 1,
            Err(RequestError::Link(_) | RequestError::Impossible(_)) => {}
        }
    }
}

/// A bus as it is now.
#[derive(Clone, Debug, PartialEq)]
pub struct BusReport {
    pub name: String,
    /// `serial /dev/ttyUSB0`, `tcp 192.168.1.20:502`
    pub link: String,
    pub up: bool,
    /// Why the link is down.
    pub reason: Option<String>,
    pub counters: Counters,
    /// The share of the last minute in which the wire was busy, 0 to 1.
    pub load: f64,
    pub devices: Vec<DeviceReport>,
}

/// A device as it is now.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceReport {
    pub name: String,
    pub title: String,
    pub profile: String,
    pub unit: u8,
    pub online: bool,
    /// Why it is offline, or what is wrong with it although it answers.
    pub reason: Option<String>,
    /// What the device said of itself: `METZ CONNECT GmbH MR-DO4 V1.4`.
    pub identity: Option<String>,
    pub counters: Counters,
    pub last_answer_at: Option<Time>,
    pub points: Vec<PointReport>,
}

/// A point as it was last told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PointReport {
    pub name: String,
    /// As published: `21.5`, `ON`, `None`.
    pub value: String,
    pub unit: Option<String>,
    /// Why it is `None`.
    pub reason: Option<String>,
    pub read_at: Option<Time>,
}
