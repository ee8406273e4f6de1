//! What the polls of a bus ask of its wire, and what watchdogs and heartbeats want besides: arithmetic,
//! from the plan and the wire's own charges.

use super::feeding::Wants;
use crate::engine::address::Span;
use crate::engine::device::Poll;
use crate::engine::plan::{self, Tariff, plan};
use crate::engine::settings::{Bus, DeviceSettings, Link};
use crate::engine::time::Duration;

/// One read of one device. Times are seconds.
pub struct Planned {
    /// The number of its device on this bus.
    pub device: usize,
    pub poll: Poll,
    pub span: Span,
    /// How often it is wanted; `None`: once.
    pub period: Option<f64>,
    /// The silence before it, both frames, the device's turnaround.
    pub time: f64,
    /// The silence that the device wants besides, in which others are asked.
    pub rest: f64,
}

/// All reads of one bus.
pub struct Budget {
    pub reads: Vec<Planned>,
    /// What each device wants besides, by its number on this bus.
    pub wants: Vec<Wants>,
    /// How long a request to a device that is silent keeps the bus: the wait for its answer, and on a
    /// serial line as long again for a late one.
    pub one_silent: f64,
    /// The longest time that an answer is waited for.
    pub timeout: f64,
}

impl Budget {
    pub fn of(bus: &Bus, devices: &[&DeviceSettings], turnaround: Duration) -> Budget {
        let tariff = Tariff::of(&bus.link, bus.gap);
        let taken = tariff.taken(&bus.link, turnaround);
        // As the running program plans them once it knows the device.
        let planned_with = plan::planned_with(turnaround);
        let (mut reads, mut wants) = (Vec::new(), Vec::new());
        let mut longest_timeout = bus.response_timeout;
        let rests = tariff.idle_rests(&devices.iter().map(|device| &*device.device).collect::<Vec<_>>());
        for (device, (settings, idle_rest)) in devices.iter().zip(rests).enumerate() {
            let wire = &settings.device.wire;
            longest_timeout = longest_timeout.max(wire.response_timeout.unwrap_or_default());
            wants.push(Wants::of(settings, taken));
            for read in plan(&settings.device, tariff.cost(planned_with + idle_rest), &[]) {
                let time = taken.time_of(read.span);
                let rest = wire.limits.delay;
                let period = match read.poll {
                    Poll::Fast => Some(wire.intervals.fast.as_secs_f64()),
                    Poll::Slow => Some(wire.intervals.slow.as_secs_f64()),
                    Poll::Once | Poll::Never => None,
                };
                let (poll, span) = (read.poll, read.span);
                let (time, rest) = (time.as_secs_f64(), rest.as_secs_f64());
                reads.push(Planned { device, poll, span, period, time, rest });
            }
        }
        let one_silent = match &bus.link {
            Link::Tcp { .. } => longest_timeout,
            Link::Serial { line, .. } | Link::RtuOverTcp { line, .. } => {
                line.characters(8) + longest_timeout * 2 + bus.gap.unwrap_or_else(|| line.frame_gap())
            }
        };
        Budget { reads, wants, one_silent: one_silent.as_secs_f64(), timeout: longest_timeout.as_secs_f64() }
    }

    /// Seconds of wire that the polls want in a second.
    pub fn load_of_polls(&self) -> f64 {
        self.reads.iter().filter_map(Planned::load).sum()
    }

    /// The most that watchdogs and heartbeats want of it, however seldom their devices are polled.
    pub fn load_of_feeding(&self) -> f64 {
        let of_device = |(device, wants): (usize, &Wants)| {
            let reads = self.reads.iter().filter(|read| read.device == device);
            let longest = reads.map(|read| read.time).fold(0.0, f64::max);
            wants.fed_every.map_or(0.0, |every| longest / every) + wants.load_of_beats()
        };
        self.wants.iter().enumerate().map(of_device).sum()
    }

    /// The longest request that may be on the wire when something comes.
    pub fn longest(&self) -> f64 {
        longest(self.reads.iter())
    }

    /// The longest to this device.
    pub fn longest_of(&self, device: usize) -> f64 {
        longest(self.reads.iter().filter(|read| read.device == device))
    }

    /// How many requests a device has to answer again and again: its reads, and a heartbeat.
    pub fn asked_again_and_again(&self, device: usize) -> usize {
        let reads = self.reads.iter().filter(|read| read.device == device && read.period.is_some());
        reads.count() + usize::from(!self.wants[device].beats.is_empty())
    }

    /// How long it takes to read everything once that is read again and again.
    pub fn round(&self) -> f64 {
        self.reads.iter().filter(|read| read.period.is_some()).map(|read| read.time + read.rest).sum()
    }
}

fn longest<'a>(reads: impl Iterator<Item = &'a Planned>) -> f64 {
    reads.map(|read| read.time + read.rest).fold(0.0, f64::max)
}

impl Planned {
    pub fn load(&self) -> Option<f64> {
        Some(self.time / self.period?)
    }
}
