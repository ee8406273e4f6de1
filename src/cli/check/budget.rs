//! What the polls of a bus ask of its wire, and what watchdogs and heartbeats want besides: arithmetic,
//! from the plan and the wire's own charges.

use super::feeding::Wants;
use super::round;
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
    /// Reading it changes the device: a watchdog is fed by another one, if there is any.
    pub alone: bool,
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
                let (poll, alone) = (read.poll, read.alone);
                let (time, rest) = (time.as_secs_f64(), rest.as_secs_f64());
                reads.push(Planned { device, poll, period, alone, time, rest });
            }
        }
        let one_silent = match &bus.link {
            Link::Tcp { .. } => longest_timeout,
            Link::Serial { line, .. } | Link::RtuOverTcp { line, .. } => {
                line.characters(8) + longest_timeout * 2 + bus.gap.unwrap_or_else(|| line.frame_gap())
            }
        };
        Budget { reads, wants, one_silent: one_silent.as_secs_f64() }
    }

    /// Seconds of wire that are wanted in a second; above 1 every period is longer by as much.
    pub fn load(&self) -> f64 {
        // The sum of nothing is a negative zero.
        let load = self.load_at(1.0) + 0.0;
        // Where feeding alone is too much, no stretch of the polls makes room for it.
        if load <= 1.0 || self.load_of_feeding() >= 1.0 { load } else { self.stretch() }
    }

    /// The same of the polls alone.
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

    /// What is wanted of the wire while every period is so many times as long: watchdogs and heartbeats do
    /// not wait longer for that.
    fn load_at(&self, stretch: f64) -> f64 {
        let of_device = |(device, wants): (usize, &Wants)| {
            let reads = self.reads.iter().filter(|read| read.device == device);
            let stretch = stretch.max(self.rests(device, stretch));
            match wants.fed_every {
                None => reads.filter_map(Planned::load).sum::<f64>() / stretch + wants.load_of_beats(),
                Some(every) => round::load(&reads.collect::<Vec<_>>(), &wants.beats, every, stretch),
            }
        };
        self.wants.iter().enumerate().map(of_device).sum()
    }

    /// How many times as long every period is on a bus that cannot keep up.
    fn stretch(&self) -> f64 {
        let (mut kept, mut missed) = (1e6, 1.0);
        while kept / missed > 1.0001 {
            let between = f64::sqrt(kept * missed);
            if self.load_at(between) <= 1.0 { kept = between } else { missed = between }
        }
        kept
    }

    /// The longest request that may be on the wire when something comes.
    pub fn longest(&self) -> f64 {
        self.reads.iter().map(|read| read.time + read.rest).fold(0.0, f64::max)
    }

    /// How many times as long every period of a device is: as of all on its bus, or because it wants more
    /// silence than its periods leave it.
    pub fn stretch_of(&self, device: usize) -> f64 {
        let load = self.load().max(1.0);
        load.max(self.rests(device, load))
    }

    /// How much of the time a device is asked, wants silence, or waits behind it for the request that is on the wire
    /// then; above 1 its periods are longer by as much. `stretch`: so many times as long are those of the others.
    fn rests(&self, device: usize, stretch: f64) -> f64 {
        let own = || self.reads.iter().filter(|read| read.device == device && read.rest > 0.0);
        let filled = |more: f64| -> f64 {
            own().filter_map(|read| Some((read.time + read.rest + more) / read.period?)).sum()
        };
        let alone = filled(0.0);
        if alone <= 0.0 {
            return 0.0;
        }
        let own_share = own().filter_map(Planned::load).sum::<f64>() / alone.max(stretch);
        // (Those that want silence as well fall into step with it, each in the other's silence.)
        let others = self.reads.iter().filter(|read| read.device != device && read.rest == 0.0);
        let asked: Vec<(f64, f64)> =
            others.filter_map(|read| Some((1.0 / read.period?, read.time))).collect();
        let share = asked.iter().map(|(often, time)| often * time / stretch).sum::<f64>()
            / (1.0 - own_share).max(0.1);
        let rest = own().map(|read| read.rest).fold(0.0, f64::max);
        filled(overshoot(&asked, rest) * share.min(1.0))
    }

    /// How long it takes to read everything once that is read again and again.
    pub fn round(&self) -> f64 {
        self.reads.iter().filter(|read| read.period.is_some()).map(|read| read.time + read.rest).sum()
    }
}

/// Requests follow one another without a pause, each so often and so long as it is told here: how long the last one
/// that begins within `time` goes on behind it, on average.
fn overshoot(requests: &[(f64, f64)], time: f64) -> f64 {
    const STEPS: usize = 100;
    let all: f64 = requests.iter().map(|(often, _)| often).sum();
    if all <= 0.0 {
        return 0.0;
    }
    let step = time / STEPS as f64;
    // By how much of the time is left.
    let mut behind = vec![0.0; STEPS + 1];
    for left in 1..=STEPS {
        let of_request = |(often, takes): &(f64, f64)| {
            let steps = (takes / step).round() as usize;
            let over = match left.checked_sub(steps.max(1)) {
                Some(left) => behind[left],
                None => takes - left as f64 * step,
            };
            often / all * over.max(0.0)
        };
        behind[left] = requests.iter().map(of_request).sum();
    }
    behind[STEPS]
}

impl Planned {
    pub fn load(&self) -> Option<f64> {
        Some(self.time / self.period?)
    }
}
