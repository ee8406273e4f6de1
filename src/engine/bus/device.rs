//! One device on the bus: what it is, what is known of it, and what has been told of it.
//!
//! Its modules are its life: it is asked, and answers or not; what it says is told; and it obeys.

// Whether it is there, and what it is asked next.
mod asking;
mod patience;
mod presence;
mod turnaround;

// What it answers.
mod fetching;
mod reading;
mod withheld;

// What is told of it.
mod reporting;
mod telling;
mod whole;

// What is written to it, and what it keeps.
mod beats;
mod keeping;
mod obeying;
mod requested;
mod wear;

use crate::engine::address::Span;
use crate::engine::device::{Device, Point, PointIndex};
use crate::engine::health::Counters;
use crate::engine::plan::{self, Read, Tariff};
use crate::engine::schedule::Polls;
use crate::engine::settings::{DeviceSettings, Eeprom};
use crate::engine::state::Values;
use crate::engine::time::{Duration, Time};
use crate::engine::upkeep::Upkeep;

use super::load::Load;
use super::waiting::Target;
use super::{Context, Severity};
pub(super) use asking::{Polled, Turn};
use beats::Beats;
pub(super) use beats::Need;
use keeping::Keeping;
use obeying::Retained;
use patience::Patience;
pub use patience::{FAILURES_UNTIL_OFFLINE, LEFT_ALONE_LEAST};
use telling::Told;
use turnaround::Turnaround;
use wear::Wear;
use withheld::Withheld;

pub(super) struct DeviceState {
    settings: DeviceSettings,
    presence: Presence,
    identity: Option<String>,
    /// The configuration knows it no more, or knows it otherwise: nothing more is begun with it.
    pub(super) is_leaving: bool,

    /// What a request to it costs.
    tariff: Tariff,
    /// What is lost with each request of the silence that it wants.
    pub(super) idle_rest: Duration,
    turnaround: Turnaround,
    polls: Polls,
    /// What the device has refused to give in one answer.
    refused: Vec<Span>,
    withheld: Withheld,

    patience: Patience,
    /// How long a request may wait, as the bus and the profile ask for it.
    full_timeout: Duration,
    /// Nothing is asked before.
    paused_until: Time,
    /// It may be slow until then: it has been written to, or seemed to be slow.
    busy_until: Time,
    served_at: Time,
    /// That was because somebody wanted it at once.
    pub(super) was_asked_out_of_turn: bool,
    last_answer_end: Time,
    last_answer_at: Option<Time>,

    values: Values,
    told: Told,

    beats: Beats,
    wear: Wear,
    upkeep: Upkeep,
    keeping: Keeping,
    retained: Retained,

    counters: Counters,
    /// Its share of the wire.
    load: Load,
}

#[derive(Clone, Debug, PartialEq)]
enum Presence {
    /// Not heard of since the link came up, or fallen silent.
    Absent { reason: String },
    /// Something answers, but it is not the device that the profile describes.
    Mismatch { reason: String },
    /// Identified and being read.
    Present,
}

impl DeviceState {
    pub(super) fn new(
        settings: DeviceSettings,
        tariff: Tariff,
        idle_rest: Duration,
        eeprom: Eeprom,
    ) -> DeviceState {
        let values = Values::new(&settings.device);
        let turnaround = Turnaround::default();
        let reads = plan::plan(&settings.device, tariff.cost(turnaround.planned_with() + idle_rest), &[]);
        let polls = Polls::new(reads, settings.device.wire.intervals, |point| values.is_selector(point));
        DeviceState {
            presence: Presence::Absent { reason: "not yet asked".into() },
            identity: None,
            is_leaving: false,
            tariff,
            idle_rest,
            turnaround,
            polls,
            refused: Vec::new(),
            withheld: Withheld::default(),
            patience: Patience::default(),
            full_timeout: Duration::ZERO,
            paused_until: Time::default(),
            busy_until: Time::default(),
            served_at: Time::default(),
            was_asked_out_of_turn: false,
            last_answer_end: Time::default(),
            last_answer_at: None,
            values,
            told: Told::nothing(&settings.device),
            beats: Beats::new(&settings.device),
            wear: Wear::new(eeprom),
            upkeep: Upkeep::default(),
            keeping: Keeping::default(),
            retained: Retained::default(),
            counters: Counters::default(),
            load: Load::default(),
            settings,
        }
    }

    /// The cheapest reads, as far as it is known what they cost and what the device refuses.
    fn plan(&self) -> Vec<Read> {
        let cost = self.tariff.cost(self.turnaround.planned_with() + self.idle_rest);
        plan::plan(&self.settings.device, cost, &self.refused)
    }

    pub(super) fn name(&self) -> &str {
        &self.settings.name
    }

    pub(super) fn unit(&self) -> u8 {
        self.settings.unit
    }

    pub(super) fn device(&self) -> &Device {
        &self.settings.device
    }

    pub(super) fn details(&self, point: PointIndex) -> &Point {
        &self.settings.device.points[point]
    }

    pub(super) fn known(&self) -> &[Option<i128>] {
        self.values.known()
    }

    pub(super) fn served_at(&self) -> Time {
        self.served_at
    }

    pub(super) fn is_present(&self) -> bool {
        self.presence == Presence::Present
    }

    /// Why it is not there, if it is not.
    fn reason(&self) -> Option<String> {
        match &self.presence {
            Presence::Absent { reason } | Presence::Mismatch { reason } => Some(reason.clone()),
            Presence::Present => None,
        }
    }

    /// The same for people: a device that is there is not online before everything has been read once.
    fn why_not_online(&self) -> Option<String> {
        self.reason().or_else(|| (!self.told.is_available()).then(|| "being read".into()))
    }

    /// Whether its outputs fall to their safe state when nobody speaks to it, or writes to it.
    pub(super) fn wants_feeding(&self) -> bool {
        let device = &self.settings.device;
        device.wire.watchdog.is_some() || device.points.iter().any(|point| point.heartbeat.is_some())
    }

    pub(super) fn has_settings(&self) -> bool {
        !self.settings.wanted.is_empty()
    }
}
