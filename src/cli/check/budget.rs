//! What the polls of a bus ask of its wire: arithmetic, from the plan and the wire's own charges.

use crate::engine::device::Poll;
use crate::engine::plan::{self, Tariff, plan};
use crate::engine::settings::{Bus, DeviceSettings, Link};
use crate::engine::time::Duration;

/// One read of one device. Times are seconds.
pub struct Planned {
    /// The number of its device on this bus.
    pub device: usize,
    pub poll: Poll,
    /// How often it is wanted; `None`: once.
    pub period: Option<f64>,
    /// The silence before it, both frames, the device's turnaround.
    pub time: f64,
}

/// All reads of one bus.
pub struct Budget {
    pub reads: Vec<Planned>,
    /// How long a request to a device that is silent keeps the bus: the wait for its answer, and on a
    /// serial line as long again for a late one.
    pub one_silent: f64,
}

impl Budget {
    pub fn of(bus: &Bus, devices: &[&DeviceSettings], turnaround: Duration) -> Budget {
        let tariff = Tariff::of(&bus.link, bus.gap);
        // As the running program plans them once it knows the device.
        let planned_with = match plan::is_far(turnaround, plan::USUAL_TURNAROUND) {
            true => turnaround,
            false => plan::USUAL_TURNAROUND,
        };
        let mut reads = Vec::new();
        let mut longest_timeout = bus.response_timeout;
        for (device, settings) in devices.iter().enumerate() {
            let wire = &settings.device.wire;
            longest_timeout = longest_timeout.max(wire.response_timeout.unwrap_or_default());
            for read in plan(&settings.device, tariff.cost(planned_with), &[]) {
                let time = tariff.cost(turnaround).time_of(read.span) + wire.limits.delay;
                let period = match read.poll {
                    Poll::Fast => Some(wire.intervals.fast.as_secs_f64()),
                    Poll::Slow => Some(wire.intervals.slow.as_secs_f64()),
                    Poll::Once | Poll::Never => None,
                };
                reads.push(Planned { device, poll: read.poll, period, time: time.as_secs_f64() });
            }
        }
        let one_silent = match &bus.link {
            Link::Tcp { .. } => longest_timeout,
            Link::Serial { line, .. } | Link::RtuOverTcp { line, .. } => {
                line.characters(8) + longest_timeout * 2 + bus.gap.unwrap_or_else(|| line.frame_gap())
            }
        };
        Budget { reads, one_silent: one_silent.as_secs_f64() }
    }

    /// Seconds of wire that are wanted in a second; above 1 every period is longer by as much.
    pub fn load(&self) -> f64 {
        self.reads.iter().filter_map(Planned::load).sum()
    }

    /// The longest request that may be on the wire when something comes.
    pub fn longest(&self) -> f64 {
        self.reads.iter().map(|read| read.time).fold(0.0, f64::max)
    }

    /// How long it takes to read everything once that is read again and again.
    pub fn round(&self) -> f64 {
        self.reads.iter().filter(|read| read.period.is_some()).map(|read| read.time).sum()
    }
}

impl Planned {
    pub fn load(&self) -> Option<f64> {
        Some(self.time / self.period?)
    }
}
