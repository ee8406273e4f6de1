//! What a bus and its devices say of themselves: counters, states and reasons.

mod broker;
mod bulletin;
mod json;
mod readout;
mod spread;

pub use broker::BrokerReport;
pub use bulletin::{Bulletin, info};
pub use json::{device_json, drift_json, point_json, seconds};
pub use readout::{Readout, ReadoutValue};
pub use spread::{Percentiles, Spread, SpreadReport, Timing, TimingReport};

use crate::engine::device::{Category, Point, Poll};
use crate::engine::modbus::{Discarded, RequestError};
use crate::engine::time::{Duration, Time};

/// How often the health of the gateway and of each device is told, changed or not.
pub const TOLD_EVERY: Duration = Duration::from_secs(60);

/// The codes of the specification end with 11.
const EXCEPTION_CODES: usize = 12;

/// How much a line of the log matters. Each is said once when something breaks and once when it heals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Severity {
    Info,
    Warning,
}

/// What happened on the wire, each error counted as what it was.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    pub requests: u64,
    pub answers: u64,
    pub timeouts: u64,
    pub checksum_errors: u64,
    /// Requests that were damaged because another spoke at the same time.
    pub collisions: u64,
    pub wrong_frames: u64,
    pub exceptions: u64,
    /// The same by code; in the first place those of a code that the specification does not know.
    pub exceptions_by_code: [u32; EXCEPTION_CODES],
    pub late_replies: u64,
    pub foreign_frames: u64,
    pub echoes: u64,
    pub noise_bytes: u64,
    pub writes: u64,
    /// Writes to points in EEPROM, since the installation and not only since the start.
    pub persistent_writes: u64,
}

impl Counters {
    /// Each counter with its name, in JSON and in metrics.
    pub fn list(&self) -> [(&'static str, u64); 13] {
        [
            ("requests", self.requests),
            ("answers", self.answers),
            ("timeouts", self.timeouts),
            ("checksum_errors", self.checksum_errors),
            ("collisions", self.collisions),
            ("wrong_frames", self.wrong_frames),
            ("exceptions", self.exceptions),
            ("late_replies", self.late_replies),
            ("foreign_frames", self.foreign_frames),
            ("echoes", self.echoes),
            ("noise_bytes", self.noise_bytes),
            ("writes", self.writes),
            ("persistent_writes", self.persistent_writes),
        ]
    }

    /// The exceptions that there were, by code: `2`, `6`, `other`.
    pub fn exceptions_by_code(&self) -> impl Iterator<Item = (String, u64)> + '_ {
        let counted = self.exceptions_by_code.iter().enumerate().filter(|(_, count)| **count > 0);
        counted
            .map(|(code, count)| (if code == 0 { "other".into() } else { code.to_string() }, (*count).into()))
    }

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
            Err(RequestError::Exception(code) | RequestError::Unreachable(code)) => {
                self.exceptions += 1;
                let known = usize::from(*code);
                self.exceptions_by_code[if known < EXCEPTION_CODES { known } else { 0 }] += 1;
            }
            Err(RequestError::Timeout) => self.timeouts += 1,
            // Counted with what was thrown away.
            Err(RequestError::Checksum) => {}
            Err(RequestError::Collision) => self.collisions += 1,
            Err(RequestError::WrongFrame) => self.wrong_frames += 1,
            Err(RequestError::Link(_) | RequestError::Impossible(_)) => {}
        }
    }
}

/// A bus as it is now.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BusReport {
    pub name: String,
    /// `serial /dev/ttyUSB0`, `tcp 192.168.1.20:502`
    pub link: String,
    /// `19200 8E1`; nothing where no serial line is known of.
    pub line: Option<String>,
    pub up: bool,
    /// Why the link is down, or what is wrong with the line although it is up.
    pub reason: Option<String>,
    /// It is down because somebody wants it so, for a time.
    pub paused: bool,
    pub counters: Counters,
    /// The share of the last minute in which the wire was busy, 0 to 1.
    pub load: f64,
    pub timing: TimingReport,
    pub devices: Vec<DeviceReport>,
}

impl BusReport {
    /// By poll class, the period that is the farthest from what is wanted: all others are kept better.
    pub fn periods(&self) -> Vec<PeriodReport> {
        let stretch = |period: &PeriodReport| {
            period.real.map_or(0.0, |real| real.as_secs_f64() / period.wanted.as_secs_f64())
        };
        let worst = |class: Poll| {
            let of_class = self.devices.iter().flat_map(|device| &device.periods);
            let of_class = of_class.filter(|period| period.class == class);
            of_class.max_by(|one, other| stretch(one).total_cmp(&stretch(other))).copied()
        };
        [Poll::Fast, Poll::Slow].into_iter().filter_map(worst).collect()
    }
}

/// A device as it is now.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DeviceReport {
    pub name: String,
    pub title: String,
    pub profile: String,
    pub manufacturer: String,
    pub model: String,
    pub unit: u8,
    pub online: bool,
    /// It is offline since it has been asked and is not there. A device that has only just been asked, or is being
    /// read for the first time, may be.
    pub is_missed: bool,
    /// Why it is offline, or what is wrong with it although it answers.
    pub reason: Option<String>,
    /// What the device said of itself: `METZ CONNECT GmbH MR-DO4 V1.4`.
    pub identity: Option<String>,
    pub counters: Counters,
    /// The share of the last minute in which the wire was busy with it, 0 to 1.
    pub load: f64,
    pub last_answer_at: Option<Time>,
    pub timing: TimingReport,
    pub periods: Vec<PeriodReport>,
    pub points: Vec<PointReport>,
    /// What can be told as numbers and is true now; only where that is asked for.
    pub readings: Vec<Readout>,
    pub things: Vec<ThingReport>,
    /// Settings that are not what the configuration wants.
    pub drift: Vec<Drift>,
}

/// A setting that does not hold what is wanted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Drift {
    pub point: String,
    pub wanted: String,
    pub found: Option<String>,
    /// What keeps it so, where it is known.
    pub reason: Option<String>,
}

/// How often a device is read: as it was asked for, and as it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeriodReport {
    pub class: Poll,
    pub wanted: Duration,
    /// `None`: not yet measured.
    pub real: Option<Duration>,
}

/// A point as it was last told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PointReport {
    pub name: String,
    /// What people call it.
    pub title: String,
    pub role: Role,
    /// As published: `21.5`, `ON`, `None`. Of an event: its type, if it has happened.
    pub value: String,
    /// The value is `[1.5,null,…]`.
    pub is_list: bool,
    pub unit: Option<String>,
    /// Why it is `None`: a word for programs and a text for people.
    pub missing: Option<(&'static str, String)>,
    /// Of an event: when it happened.
    pub read_at: Option<Time>,
    /// So long after it was read it should have been read again; `None`: it is read once, or on request.
    pub good_for: Option<Duration>,
}

/// What a point is to a person who looks at the device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    Value,
    Event,
    Setting,
    Diagnostic,
}

impl Role {
    pub fn of(point: &Point) -> Role {
        let looks = &point.presentation;
        if point.event.is_some() {
            return Role::Event;
        }
        match looks.category {
            Some(Category::Config) => Role::Setting,
            Some(Category::Diagnostic) => Role::Diagnostic,
            None if point.persistent => Role::Setting,
            None if looks.enabled == Some(false) || point.poll == Poll::Once => Role::Diagnostic,
            None => Role::Value,
        }
    }

    pub const fn name(self) -> &'static str {
        match self {
            Role::Value => "value",
            Role::Event => "event",
            Role::Setting => "setting",
            Role::Diagnostic => "diagnostic",
        }
    }
}

/// How far a reading can be believed to be the present one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Freshness {
    /// Read as often as it should be.
    Fresh,
    /// Read once, or when somebody asked: it was true then.
    Kept,
    /// It should have been read again.
    Old,
    /// There is none.
    Missing,
}

impl Freshness {
    pub const fn name(self) -> &'static str {
        match self {
            Freshness::Fresh => "fresh",
            Freshness::Kept => "kept",
            Freshness::Old => "old",
            Freshness::Missing => "missing",
        }
    }
}

impl PointReport {
    /// `is_heard`: whether the bus that tells this has just answered for itself.
    pub fn freshness(&self, now: Time, is_heard: bool) -> Freshness {
        match (self.read_at, self.good_for) {
            _ if self.missing.is_some() => Freshness::Missing,
            _ if !is_heard => Freshness::Old,
            (Some(read_at), Some(good_for)) if now - read_at <= good_for => Freshness::Fresh,
            (_, Some(_)) => Freshness::Old,
            (_, None) => Freshness::Kept,
        }
    }
}

/// A reading of this period is good until three turns have been missed, and a second for what a retry
/// takes: a device that has fallen silent is offline by then.
pub fn good_for(period: Duration) -> Duration {
    period * 3 + Duration::from_secs(1)
}

/// A thing made of several points, as its points say.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ThingReport {
    pub name: String,
    pub title: String,
    /// `cover`, `climate`
    pub kind: &'static str,
    pub state: Option<String>,
    /// Why there is no state: a word for programs and a text for people.
    pub missing: Option<(&'static str, String)>,
    /// The names of the points that its state is made of.
    pub made_of: Vec<String>,
    /// The names of a climate's points with the present and the wanted temperature.
    pub temperature: Option<String>,
    pub target: Option<String>,
}

impl ThingReport {
    /// No fresher than what it is made of.
    pub fn freshness(&self, device: &DeviceReport, now: Time, is_heard: bool) -> Freshness {
        if self.state.is_none() {
            return Freshness::Missing;
        }
        let parts = device.points.iter().filter(|point| self.made_of.contains(&point.name));
        // A point that is missing decides nothing while another one's row holds.
        let known = parts.map(|point| point.freshness(now, is_heard)).filter(|of| *of != Freshness::Missing);
        known.max().unwrap_or(Freshness::Missing)
    }
}

/// The whole gateway as it is now.
#[derive(Clone, Debug, PartialEq)]
pub struct GatewayReport {
    pub broker: BrokerReport,
    pub buses: Vec<BusHealth>,
    /// Why the newest configuration is not the one that runs.
    pub configuration_error: Option<String>,
}

#[derive(Clone, Debug, PartialEq)]
pub struct BusHealth {
    /// The newest report there is.
    pub report: BusReport,
    /// Whether the bus has just answered for itself; a bus that does not is stuck.
    pub responding: bool,
}

impl BusHealth {
    /// Nothing on this bus can be reached. One dead device is no lost bus, even if it is the only one; nor is a bus
    /// whose devices have still to be read, as at the end of a pause.
    fn is_lost(&self) -> bool {
        let devices = &self.report.devices;
        !self.report.paused
            && (!self.report.up || (devices.len() > 1 && devices.iter().all(|device| device.is_missed)))
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Status {
    Ok,
    /// Something does not answer; the rest works.
    Degraded,
    /// The broker or a whole bus is lost, or a bus is stuck.
    Lost,
}

impl Status {
    pub const fn name(self) -> &'static str {
        match self {
            Status::Ok => "ok",
            Status::Degraded => "degraded",
            Status::Lost => "lost",
        }
    }
}

impl GatewayReport {
    pub fn status(&self) -> Status {
        let mut devices = self.buses.iter().flat_map(|bus| &bus.report.devices);
        if !self.broker.connected || self.buses.iter().any(|bus| bus.is_lost() || !bus.responding) {
            Status::Lost
        } else if self.broker.client_id_taken
            || self.broker.state_denied
            || self.broker.misses_something()
            || devices.any(|device| !device.online)
            || self.buses.iter().any(|bus| bus.report.paused)
        {
            Status::Degraded
        } else {
            Status::Ok
        }
    }

    /// Whether every bus has answered for itself.
    pub fn all_respond(&self) -> bool {
        self.buses.iter().all(|bus| bus.responding)
    }

    /// Every device with its bus.
    pub fn devices(&self) -> impl Iterator<Item = (&BusReport, &DeviceReport)> {
        self.buses.iter().flat_map(|bus| bus.report.devices.iter().map(|device| (&bus.report, device)))
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn device(name: &str, online: bool) -> DeviceReport {
        DeviceReport {
            name: name.into(),
            title: name.into(),
            profile: "test".into(),
            unit: 1,
            online,
            is_missed: !online,
            reason: (!online).then(|| "no answer in time".into()),
            counters: Counters { timeouts: 3, ..Counters::default() },
            last_answer_at: Some(Time::from_millis(1000)),
            periods: vec![PeriodReport { class: Poll::Fast, wanted: Duration::from_secs(1), real: None }],
            points: vec![flow()],
            ..DeviceReport::default()
        }
    }

    /// A point that is read each second.
    fn flow() -> PointReport {
        PointReport {
            name: "flow".into(),
            title: "Flow".into(),
            role: Role::Value,
            value: "21.5".into(),
            is_list: false,
            unit: Some("°C".into()),
            missing: None,
            read_at: Some(Time::from_millis(1500)),
            good_for: Some(good_for(Duration::from_secs(1))),
        }
    }

    pub(super) fn gateway(connected: bool, up: bool, responding: bool, online: &[bool]) -> GatewayReport {
        let devices = online.iter().enumerate().map(|(index, online)| device(&format!("d{index}"), *online));
        let report = BusReport {
            name: "cellar".into(),
            up,
            load: 0.123_456,
            devices: devices.collect(),
            ..BusReport::default()
        };
        let broker = BrokerReport { connected, ..BrokerReport::default() };
        GatewayReport { broker, buses: vec![BusHealth { report, responding }], configuration_error: None }
    }

    #[test]
    fn the_gateway_is_lost_with_its_broker_or_a_bus_and_only_degraded_with_a_device() {
        for (connected, up, responding, online, expected) in [
            (true, true, true, &[true, true][..], Status::Ok),
            (true, true, true, &[true, false], Status::Degraded),
            (true, true, true, &[false], Status::Degraded),
            (true, true, true, &[false, false], Status::Lost),
            (false, true, true, &[true, true], Status::Lost),
            (true, false, true, &[true], Status::Lost),
            (true, true, false, &[true], Status::Lost),
            (true, true, true, &[], Status::Ok),
        ] {
            let report = gateway(connected, up, responding, online);
            assert_eq!(report.status(), expected, "{report:?}");
            assert_eq!(report.to_json()["status"], expected.name());
        }
        let mut report = gateway(true, true, true, &[false, false]);
        report.buses[0].report.devices[1].is_missed = false;
        assert_eq!(report.status(), Status::Degraded, "one of them is being read");
    }

    #[test]
    fn reports_are_told_by_name_and_as_lists() {
        let report = gateway(true, true, true, &[false]);
        let health = report.to_json();
        assert_eq!(health["buses"]["cellar"]["load"], 0.12346);
        assert_eq!(health["devices"]["d0"]["reason"], "no answer in time");
        assert_eq!(health["devices"]["d0"]["timeouts"], 3);
        assert_eq!(report.buses_json()[0]["name"], "cellar");
        assert_eq!(report.buses_json()[0]["devices"], json!(["d0"]));
        let device = &report.devices_json(Time::from_millis(2000))[0];
        assert_eq!(device["last_answer_seconds_ago"], 1.0);
        assert_eq!(device["points"][0]["value"], "21.5");
        assert_eq!(device["points"][0]["read_seconds_ago"], 0.5);
    }

    #[test]
    fn only_what_was_read_in_time_on_a_bus_that_is_heard_is_fresh() {
        let missing = Some(("offline", "the device is offline".to_string()));
        for (what, point, seconds, is_heard, expected) in [
            ("just read", flow(), 2, true, Freshness::Fresh),
            ("three turns missed", flow(), 6, true, Freshness::Old),
            ("a stuck bus", flow(), 2, false, Freshness::Old),
            ("lost, if only just", PointReport { missing, ..flow() }, 2, true, Freshness::Missing),
            ("on request", PointReport { good_for: None, ..flow() }, 9000, true, Freshness::Kept),
            ("never read", PointReport { read_at: None, ..flow() }, 2, true, Freshness::Old),
        ] {
            assert_eq!(point.freshness(Time::from_millis(seconds * 1000), is_heard), expected, "{what}");
        }
    }

    #[test]
    fn a_thing_is_no_fresher_than_what_it_is_made_of() {
        let late = PointReport { name: "late".into(), read_at: Some(Time::default()), ..flow() };
        let lost =
            PointReport { name: "lost".into(), missing: Some(("exception", "exception 4".into())), ..flow() };
        let device = DeviceReport { points: vec![flow(), late, lost], ..DeviceReport::default() };
        let thing = |state: Option<&str>, made_of: &[&str]| ThingReport {
            name: "blind".into(),
            title: "Blind".into(),
            kind: "cover",
            state: state.map(str::to_string),
            missing: None,
            made_of: made_of.iter().map(|name| name.to_string()).collect(),
            temperature: None,
            target: None,
        };
        for (thing, expected) in [
            (thing(Some("open"), &["flow"]), Freshness::Fresh),
            (thing(Some("open"), &["flow", "late"]), Freshness::Old),
            (thing(Some("open"), &["flow", "lost"]), Freshness::Fresh),
            (thing(None, &["flow"]), Freshness::Missing),
        ] {
            assert_eq!(thing.freshness(&device, Time::from_millis(5000), true), expected, "{thing:?}");
        }
    }

    #[test]
    fn a_list_is_told_as_text_and_as_numbers_and_what_is_missing_stays_missing() {
        let point = PointReport { value: "[1.5,null,-2]".into(), is_list: true, ..flow() };
        let told = json::point_json(&point, Time::from_millis(2000), true);
        assert_eq!(told["list"], json!([1.5, null, -2]));
        assert_eq!(told["value"], "[1.5,null,-2]");
        let unread = PointReport {
            value: "None".into(),
            missing: Some(("not_yet_read", "not yet read".into())),
            read_at: None,
            ..flow()
        };
        let told = json::point_json(&unread, Time::from_millis(2000), true);
        assert_eq!(told["read_seconds_ago"], json!(null), "an age that is not known is no 0");
        assert_eq!(told["missing"], "not_yet_read");
    }
}
