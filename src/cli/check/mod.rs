//! `busker check`: is the configuration right, and can each bus keep up with it?

mod advice;
mod budget;
mod feeding;
mod forecast;
mod rehearsal;

use std::collections::BTreeMap;
use std::num::NonZero;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use serde::Serialize;

use super::configuration::{self, ConfigurationArgs, Loaded};
use super::output::{self, Table, counted};
use super::{Failure, output::print_json};
use crate::edge::link::adapter;
use crate::engine;
use crate::engine::settings::{DeviceSettings, Settings};
use crate::engine::time::Duration;
use crate::engine::yaml::{Diagnostic, Scalar};
use budget::Budget;
use feeding::{Delays, Feeding};
use forecast::Forecast;

/// Check the configuration and the profiles that it uses
///
/// Tells every fault at once, each with its place, and then ends with exit code 2. For a good
/// configuration it tells how busy each bus will be and how often each device will really be read.
#[derive(clap::Args, Debug)]
#[command(after_help = "Example:\n  busker check --config /etc/busker/busker.yaml")]
pub struct Args {
    #[command(flatten)]
    configuration: ConfigurationArgs,
    /// What devices need to begin their answer, on Modbus TCP the whole round trip; see `turnaround` on the status
    /// page or in the metrics
    #[arg(long, value_name = "TIME", default_value = "5ms", value_parser = <Duration as Scalar>::parse)]
    turnaround: Duration,
    /// Tell it as JSON
    #[arg(long)]
    json: bool,
    /// Print the JSON Schema of the configuration instead
    #[arg(long)]
    schema: bool,
}

pub fn run(args: Args) -> Result<(), Failure> {
    if args.schema {
        return print_json(&engine::configuration::schema());
    }
    let file = args.configuration.config.display().to_string();
    match checked(&args)? {
        Ok(loaded) => {
            let summary = Summary::of(file, &loaded, args.turnaround);
            if args.json {
                return print_json(&summary);
            }
            for warning in &loaded.warnings {
                eprintln!("warning: {warning}");
            }
            output::print(&summary.text())
        }
        Err(faults) => {
            if args.json {
                let faults: Vec<Finding> = faults.iter().map(Finding::of).collect();
                print_json(&serde_json::json!({"file": file, "status": "faulty", "faults": faults}))?;
            }
            Err(configuration::faults(faults))
        }
    }
}

/// The configuration, and the files that it names.
fn checked(args: &Args) -> Result<Result<Loaded, Vec<Diagnostic>>, Failure> {
    let loaded = configuration::load(&args.configuration.config)?;
    Ok(loaded.and_then(|mut loaded| {
        let secret_faults = loaded.secret_faults();
        loaded.warnings.extend(secret_faults);
        let open_secrets = loaded.open_secrets();
        loaded.warnings.extend(open_secrets);
        let stable_paths = loaded.stable_paths(Path::new(adapter::BY_ID));
        loaded.warnings.extend(stable_paths);
        let faults = loaded.tls_faults();
        if faults.is_empty() { Ok(loaded) } else { Err(faults) }
    }))
}

/// What there is to say about a good configuration.
#[derive(Serialize)]
struct Summary {
    file: String,
    status: &'static str,
    /// What devices are taken to need to begin their answer, on Modbus TCP the whole round trip; in seconds.
    turnaround: f64,
    warnings: Vec<Finding>,
    buses: Vec<BusSummary>,
}

#[derive(Serialize)]
struct BusSummary {
    name: String,
    link: String,
    /// `19200 8E1`, where there is a line.
    line: Option<String>,
    /// As [`Forecast::load`]: the share of time that the rehearsal found the wire taken; above 1, how much longer
    /// every period is, or nearly so.
    load: f64,
    /// How long a command waits at most for a request in flight, in seconds: all devices answering.
    command_wait: f64,
    /// The same where a device is silent.
    command_wait_one_silent: f64,
    /// What to change where the polls want more than the wire carries.
    advice: Vec<String>,
    devices: Vec<DeviceSummary>,
}

#[derive(Serialize)]
struct DeviceSummary {
    name: String,
    title: String,
    profile: String,
    unit: u8,
    points: usize,
    /// By poll class.
    polls: BTreeMap<&'static str, PollSummary>,
    /// Its watchdog and heartbeats.
    feeding: Vec<Feeding>,
}

#[derive(Serialize)]
struct PollSummary {
    reads: usize,
    /// The time on the wire of all its reads, in seconds.
    seconds: f64,
    /// Wanted, in seconds; none for what is read once.
    period: Option<f64>,
    /// What the bus can keep, in seconds.
    real_period: Option<f64>,
}

#[derive(Serialize)]
struct Finding {
    file: String,
    line: usize,
    column: usize,
    message: String,
}

impl Finding {
    fn of(diagnostic: &Diagnostic) -> Finding {
        let (line, column) = diagnostic.place.line_and_column();
        Finding { file: diagnostic.place.file().into(), line, column, message: diagnostic.message.clone() }
    }
}

impl Summary {
    fn of(file: String, loaded: &Loaded, turnaround: Duration) -> Summary {
        let settings = &loaded.settings;
        Summary {
            file,
            status: "good",
            turnaround: turnaround.as_secs_f64(),
            warnings: loaded.warnings.iter().map(Finding::of).collect(),
            buses: BusSummary::all(settings, turnaround),
        }
    }

    fn text(&self) -> String {
        let mut text = format!(
            "{} is good\nThe figures hold for devices that begin their answers after {}.\n",
            self.file,
            told(self.turnaround)
        );
        for bus in &self.buses {
            let line = bus.line.as_ref().map_or(String::new(), |line| format!(" {line}"));
            text.push_str(&format!("\nbus {}: {}{line}\n", bus.name, bus.link));
            let busy = match bus.load > 1.0 {
                true => "busy all the time".to_string(),
                false => format!("busy {} % of the time", digits(bus.load * 100.0)),
            };
            text.push_str(&format!(
                "  {busy}; a command waits at most {}, {} while a device is silent\n",
                told(bus.command_wait),
                told(bus.command_wait_one_silent),
            ));
            if bus.load > 1.0 {
                let advice = bus.advice.join("; or ");
                let slower = digits(bus.load);
                text.push_str(&format!(
                    "  too slow: every period is about {slower} times as long as wanted; {advice}\n"
                ));
            }
            let mut table = Table::new();
            for device in &bus.devices {
                let mut cells = vec![
                    format!("  {}", device.name),
                    format!("unit {}", device.unit),
                    device.profile.clone(),
                    counted(device.points, "point"),
                ];
                cells.extend(device.polls.iter().map(|(name, poll)| poll.text(name)));
                table.row(cells);
            }
            text.push_str(&table.render());
            for device in &bus.devices {
                for feeding in &device.feeding {
                    text.push_str(&format!("  {}\n", feeding.text(&device.name)));
                }
            }
        }
        text
    }
}

impl PollSummary {
    fn text(&self, name: &str) -> String {
        let reads = counted(self.reads, "read");
        match (self.period, self.real_period) {
            (Some(wanted), Some(real)) if real > wanted => {
                format!("{name}: {reads} in {}, wanted in {}", told(real), told(wanted))
            }
            (Some(wanted), _) => format!("{name}: {reads} in {}", told(wanted)),
            (None, _) => format!("{name}: {reads}"),
        }
    }
}

impl BusSummary {
    /// Of all buses, in the order of the configuration. Each takes a while, so all processors work on them.
    fn all(settings: &Settings, turnaround: Duration) -> Vec<BusSummary> {
        let next = AtomicUsize::new(0);
        let work = || {
            let taken = std::iter::from_fn(|| Some(next.fetch_add(1, Ordering::Relaxed)));
            let buses = taken.take_while(|index| *index < settings.buses.len());
            buses.map(|index| (index, BusSummary::of(settings, index, turnaround))).collect()
        };
        let threads = std::thread::available_parallelism().map_or(1, NonZero::get).min(settings.buses.len());
        let mut buses: Vec<(usize, BusSummary)> = std::thread::scope(|scope| {
            let others: Vec<_> = (1..threads).map(|_| scope.spawn(work)).collect();
            let mut buses: Vec<_> = work();
            for other in others {
                buses.extend(other.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)));
            }
            buses
        });
        buses.sort_by_key(|(index, _)| *index);
        buses.into_iter().map(|(_, bus)| bus).collect()
    }

    fn of(settings: &Settings, index: usize, turnaround: Duration) -> BusSummary {
        let bus = &settings.buses[index];
        let devices: Vec<&DeviceSettings> =
            settings.devices.iter().filter(|device| device.bus == index).collect();
        let devices = devices.as_slice();
        let budget = Budget::of(bus, devices, turnaround);
        let forecast = Forecast::of(settings, index, devices, turnaround, &budget);
        let load = forecast.load;
        let summary = |(number, settings): (usize, &&DeviceSettings)| {
            let mut polls: BTreeMap<&'static str, PollSummary> = BTreeMap::new();
            for read in budget.reads.iter().filter(|read| read.device == number) {
                let real_period = read.period.map(|period| forecast.real_period(number, read.poll, period));
                let empty = PollSummary { reads: 0, seconds: 0.0, period: read.period, real_period };
                let poll = polls.entry(read.poll.name()).or_insert(empty);
                poll.reads += 1;
                poll.seconds += read.time;
            }
            let periods = polls.values().filter_map(|poll| poll.real_period);
            let every = periods.reduce(f64::min).map(|every| every.max(forecast.longest_wait(settings.unit)));
            let delays = Delays::of(bus, number, every, load, &budget);
            DeviceSummary {
                name: settings.name.clone(),
                title: settings.title.clone(),
                profile: settings.device.profile.clone(),
                unit: settings.unit,
                points: settings.device.points.len(),
                polls,
                feeding: feeding::of_device(settings, delays),
            }
        };
        BusSummary {
            name: bus.name.clone(),
            link: bus.link.to_string(),
            line: bus.link.line().map(|line| line.to_string()),
            load,
            command_wait: budget.longest(),
            command_wait_one_silent: budget.one_silent.max(budget.longest()),
            advice: if load > 1.0 {
                advice::of_bus(settings, index, devices, turnaround, &budget)
            } else {
                Vec::new()
            },
            devices: devices.iter().enumerate().map(summary).collect(),
        }
    }
}

/// Seconds for people: `37.4 ms`, `1.52 s`, `10 min`.
fn told(seconds: f64) -> String {
    match seconds {
        seconds if seconds < 1.0 => format!("{} ms", digits(seconds * 1000.0)),
        seconds if seconds < 120.0 => format!("{} s", digits(seconds)),
        seconds => format!("{} min", digits(seconds / 60.0)),
    }
}

/// Three digits: who compares a forecast with what is measured wants no more, and rounding must not make it wrong.
fn digits(number: f64) -> String {
    let decimals = match number {
        number if number >= 99.95 => return format!("{number:.0}"),
        number if number >= 9.995 => 1,
        _ => 2,
    };
    let text = format!("{number:.decimals$}");
    text.trim_end_matches('0').trim_end_matches('.').to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_told_is_no_further_from_what_was_worked_out_than_half_a_percent() {
        for (seconds, expected) in [
            (0.0, "0 ms"),
            (0.005_502, "5.5 ms"),
            (0.037_4, "37.4 ms"),
            (0.099_96, "100 ms"),
            (0.5, "500 ms"),
            (1.0, "1 s"),
            (1.049, "1.05 s"),
            (9.996, "10 s"),
            (66.66, "66.7 s"),
            (90.0, "90 s"),
            (600.0, "10 min"),
            (252.0, "4.2 min"),
        ] {
            assert_eq!(told(seconds), expected);
        }
    }
}
