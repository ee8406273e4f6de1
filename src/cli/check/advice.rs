//! What to change on a bus that is asked for more than its wire carries: in figures, since "less often"
//! helps nobody.

use std::collections::BTreeMap;

use super::budget::Budget;
use super::forecast::Forecast;
use crate::engine::configuration::BAUD_RATES;
use crate::engine::device::Poll;
use crate::engine::settings::{DeviceSettings, Line, Link, Settings};
use crate::engine::time::Duration;

/// So much of the wire the polls shall take at most: commands and repeats want some as well.
const COMFORTABLE: f64 = 0.9;
/// Devices and adapters that are faster are rare.
const BAUD_MOST: u32 = 115_200;

/// What would make the bus of this number keep its periods.
pub fn of_bus(
    settings: &Settings,
    index: usize,
    devices: &[&DeviceSettings],
    turnaround: Duration,
    budget: &Budget,
) -> Vec<String> {
    let mut advice = vec![slower(devices, budget)];
    advice.extend(faster_line(settings, index, devices, turnaround));
    advice
}

/// Polls less often: the class and period that ask for most, if that is enough, or everything.
fn slower(devices: &[&DeviceSettings], budget: &Budget) -> String {
    // By class and period in microseconds.
    let mut groups: BTreeMap<(&str, u64), f64> = BTreeMap::new();
    for read in &budget.reads {
        if let (Some(period), Some(load)) = (read.period, read.load()) {
            *groups.entry((read.poll.name(), (period * 1e6) as u64)).or_default() += load;
        }
    }
    let heaviest = groups.iter().max_by(|one, other| one.1.total_cmp(other.1));
    let Some((&(class, period), &load)) = heaviest else { return String::new() };
    // What is fed is asked the more beside its polls the less it is polled.
    let for_polls = COMFORTABLE - budget.load_of_feeding();
    let left = for_polls - (budget.load_of_polls() - load);
    let period = Duration::from_micros(period);
    if for_polls <= 0.0 {
        return "allow watchdogs and heartbeats more time: they take the whole wire".into();
    }
    if left <= 0.0 {
        let factor = budget.load_of_polls() / for_polls;
        return format!("poll everything {:.1} times less often", (factor * 10.0).ceil() / 10.0);
    }
    let others = groups.keys().filter(|(other, _)| *other == class).count() > 1;
    let whose = if others { of_these(devices, class, period) } else { String::new() };
    format!(
        "poll the class `{class}`{whose} every {} instead of {}",
        text(round_up(period.mul_f64(load / left))),
        text(period)
    )
}

/// ` of relays and dampers`
fn of_these(devices: &[&DeviceSettings], class: &str, period: Duration) -> String {
    let is_theirs = |settings: &&&DeviceSettings| {
        let intervals = settings.device.wire.intervals;
        period == if class == Poll::Fast.name() { intervals.fast } else { intervals.slow }
    };
    let names: Vec<&str> = devices.iter().filter(is_theirs).map(|settings| settings.name.as_str()).collect();
    match names.split_last() {
        Some((last, rest)) if !rest.is_empty() && rest.len() < 5 => {
            format!(" of {} and {last}", rest.join(", "))
        }
        Some((last, [])) => format!(" of {last}"),
        _ => format!(" of the {} devices that have it at {}", names.len(), text(period)),
    }
}

/// The slowest usual rate at which the bus keeps its periods, if there is one.
fn faster_line(
    settings: &Settings,
    index: usize,
    devices: &[&DeviceSettings],
    turnaround: Duration,
) -> Option<String> {
    let line = settings.buses[index].link.line()?;
    let faster = BAUD_RATES.into_iter().filter(|baud| (line.baud + 1..=BAUD_MOST).contains(baud));
    let load_at = |baud: u32| {
        let mut other = settings.clone();
        if let Link::Serial { line, .. } | Link::RtuOverTcp { line, .. } = &mut other.buses[index].link {
            *line = Line { baud, ..*line };
        }
        let budget = Budget::of(&other.buses[index], devices, turnaround);
        // What even the polls alone do not leave room for need not be tried.
        let is_worth_it = budget.load_of_polls() <= COMFORTABLE;
        is_worth_it.then(|| (baud, Forecast::of(&other, index, devices, turnaround, &budget).load))
    };
    let (baud, load) = faster.filter_map(load_at).find(|(_, load)| *load <= COMFORTABLE)?;
    Some(format!(
        "raise `baud` to {baud} where all devices can: the bus is then busy {:.0} % of the time",
        load * 100.0
    ))
}

/// To two digits: nobody polls every 417 ms.
pub fn round_up(time: Duration) -> Duration {
    let micros = time.as_micros() as u64;
    let mut unit = 1;
    while micros / unit >= 100 {
        unit *= 10;
    }
    Duration::from_micros(micros.div_ceil(unit) * unit)
}

/// The same for what must not be more.
pub fn round_down(time: Duration) -> Duration {
    let micros = time.as_micros() as u64;
    let mut unit = 1;
    while micros / unit >= 100 {
        unit *= 10;
    }
    Duration::from_micros(micros / unit * unit)
}

/// As it stands in a configuration: `400ms`, `1.5s`.
pub fn text(time: Duration) -> String {
    let seconds = time.as_secs_f64();
    if seconds < 1.0 { format!("{}ms", seconds * 1000.0) } else { format!("{seconds}s") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn periods_are_advised_in_figures_that_a_person_would_type() {
        for (micros, up, down) in [
            (416_700, "420ms", "410ms"),
            (400_000, "400ms", "400ms"),
            (1_013_000, "1.1s", "1s"),
            (950, "0.95ms", "0.95ms"),
            (12_345_000, "13s", "12s"),
        ] {
            let time = Duration::from_micros(micros);
            assert_eq!((text(round_up(time)).as_str(), text(round_down(time)).as_str()), (up, down));
        }
    }
}
