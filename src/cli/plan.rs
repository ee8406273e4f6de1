//! `busker plan`: what each device will be asked, as a table.

use serde::Serialize;

use super::configuration::{ConfigurationArgs, device_named};
use super::output::{print, print_json};
use super::{Failure, profiles};
use crate::engine::device::Device;
use crate::engine::plan::{self, Read, Tariff};
use crate::engine::settings::{DeviceSettings, Line, Link, Parity, Rs485};
use crate::engine::time::Duration;
use crate::engine::yaml::Scalar;

/// Show the reads that each device will be asked with
///
/// One line for each read: how often, the registers, and the points that it brings.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:\n  busker plan --config /etc/busker/busker.yaml\n  \
    busker plan --profile metz-connect/mr-ai8\n  busker plan --profile my-device.yaml")]
pub struct Args {
    #[command(flatten)]
    configuration: ConfigurationArgs,
    /// Only this device of the configuration
    #[arg(long, value_name = "NAME")]
    device: Option<String>,
    /// The plan of a profile, or of a profile's file, on a line of 19200 8E1, without a configuration
    #[arg(long, value_name = "ID|FILE", conflicts_with_all = ["config", "device"])]
    profile: Option<String>,
    /// What devices need to begin their answer; see `turnaround` on the status page or in the metrics
    #[arg(long, value_name = "TIME", default_value = "5ms", value_parser = <Duration as Scalar>::parse)]
    turnaround: Duration,
    /// Tell it as JSON
    #[arg(long)]
    json: bool,
}

/// One device's reads.
#[derive(Serialize)]
struct DevicePlan {
    device: String,
    reads: Vec<ReadRow>,
    #[serde(skip)]
    table: String,
}

#[derive(Serialize)]
struct ReadRow {
    poll: &'static str,
    table: &'static str,
    first: u16,
    last: u16,
    points: Vec<String>,
    /// The points that decide whether it is sent at all.
    sleeps_by: Vec<String>,
    /// How long it takes, in milliseconds.
    wire_ms: f64,
}

pub fn run(args: Args) -> Result<(), Failure> {
    let plans = match &args.profile {
        Some(id) => vec![of_profile(id, args.turnaround)?],
        None => of_configuration(&args)?,
    };
    if args.json {
        return print_json(&plans);
    }
    let mut text = String::new();
    for plan in &plans {
        if plans.len() > 1 || args.profile.is_none() {
            text.push_str(&format!("{}\n", plan.device));
        }
        text.push_str(&plan.table);
        text.push('\n');
    }
    print(&format!("{}\n", text.trim_end_matches('\n')))
}

fn of_profile(id: &str, turnaround: Duration) -> Result<DevicePlan, Failure> {
    let line = Line { baud: 19_200, parity: Parity::Even, stop_bits: 1 };
    let link = Link::Serial { path: String::new(), line, rs485: Rs485::Auto };
    let tariff = Tariff::of(&link, None);
    Ok(plan_of(id, &profiles::load(id)?, &link, tariff, turnaround, Duration::ZERO))
}

fn of_configuration(args: &Args) -> Result<Vec<DevicePlan>, Failure> {
    let settings = args.configuration.load()?;
    let devices: Vec<&DeviceSettings> = match &args.device {
        Some(name) => vec![device_named(&settings, name)?],
        None => settings.devices.iter().collect(),
    };
    Ok(devices
        .into_iter()
        .map(|device| {
            let bus = &settings.buses[device.bus];
            let tariff = Tariff::of(&bus.link, bus.gap);
            let on_bus: Vec<&DeviceSettings> =
                settings.devices.iter().filter(|other| other.bus == device.bus).collect();
            let rests = tariff.idle_rests(&on_bus.iter().map(|other| &*other.device).collect::<Vec<_>>());
            let of_device = on_bus.iter().zip(rests).find(|(other, _)| other.name == device.name);
            let idle_rest = of_device.map_or(Duration::ZERO, |(_, rest)| rest);
            plan_of(&device.name, &device.device, &bus.link, tariff, args.turnaround, idle_rest)
        })
        .collect())
}

/// `idle_rest`: [`Tariff::idle_rests`].
fn plan_of(
    name: &str,
    device: &Device,
    link: &Link,
    tariff: Tariff,
    turnaround: Duration,
    idle_rest: Duration,
) -> DevicePlan {
    let reads = plan::plan(device, tariff.cost(plan::planned_with(turnaround) + idle_rest), &[]);
    let taken = tariff.taken(link, turnaround);
    let row = |read: &Read| ReadRow {
        poll: read.poll.name(),
        table: read.span.table().name(),
        first: read.span.first(),
        last: read.span.last(),
        points: read.points.iter().map(|(point, _)| device.points[*point].name.clone()).collect(),
        sleeps_by: read.sleeps_by(device).iter().map(|point| device.points[*point].name.clone()).collect(),
        wire_ms: taken.of_read(read.span) as f64 / 1e6,
    };
    DevicePlan {
        device: name.to_string(),
        reads: reads.iter().map(row).collect(),
        table: plan::Table { device, reads: &reads }.to_string(),
    }
}
