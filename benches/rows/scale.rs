//! Many buses, devices and points in one process, and how cost grows with each.

use std::collections::BTreeSet;
use std::fs;
use std::time::Duration;

use super::tcp::{LATENCY, Reached, figures, forecast, forecast_figure, libmodbus, own, reach};
use super::{AT_ONCE, Bench};
use crate::clock::sleep;
use crate::machine::{Noise, Watch};
use crate::mqtt::Observer;
use crate::program::{Busker, Mosquitto};
use crate::report::{Figure, Growth, Target};
use crate::tcp::Servers;

/// How often the first register of a device changes.
const NEW_VALUE_EVERY: Duration = Duration::from_secs(1);

#[derive(Clone, Copy)]
struct Size {
    buses: usize,
    devices: usize,
    /// Of each device.
    points: usize,
    /// Registers of each point.
    words: usize,
}

/// With points as meters have them, of two registers each, a request is as long as in W6: what it costs apart from
/// its registers is the same, and so are the targets.
const WHOLE: Size = Size { buses: 32, devices: 1000, points: 50, words: 2 };

pub fn scale(bench: &mut Bench) -> anyhow::Result<()> {
    let size = |buses, devices, points, words| Size { buses, devices, points, words };
    if !bench.quick {
        for size in [
            size(8, 100, 10, 1),
            size(8, 100, 50, 1),
            size(8, 100, 100, 1),
            size(8, 10, 50, 1),
            size(8, 1000, 50, 1),
            size(1, 100, 50, 1),
            size(32, 1000, 50, 1),
        ] {
            let growth = run(size, Duration::from_secs(2))?.growth;
            eprintln!("        {}", growth.text());
            bench.grow(growth);
        }
    }
    let small = run(size(32, 100, 50, 2), bench.seconds(2, 1))?;
    let middle = run(size(32, 500, 50, 2), bench.seconds(2, 1))?;
    let mut whole = Vec::new();
    let mut noise = small.noise.worse(middle.noise);
    for _ in 0..if bench.quick { 1 } else { 2 } {
        let run = run(WHOLE, bench.seconds(4, 3))?;
        noise = noise.worse(run.noise);
        whole.push(run);
    }
    for run in [&small, &middle].into_iter().chain(whole.last()) {
        bench.grow(run.growth);
    }

    let of_busker: Vec<Reached> = whole.iter().map(|run| run.reached).collect();
    let of_libmodbus: Vec<Reached> = whole.iter().filter_map(|run| run.libmodbus).collect();
    let why = whole.iter().find_map(|run| run.why.clone());
    let slope = |from: &Growth, to: &Growth| (to.resident - from.resident) / (to.points - from.points) as f64;
    let slopes: Vec<(f64, f64)> = whole
        .iter()
        .map(|run| (slope(&small.growth, &middle.growth), slope(&middle.growth, &run.growth)))
        .collect();
    let mut all = figures("scale", &of_busker, &of_libmodbus, why);
    let per_point = whole.iter().map(|run| run.growth.resident / run.growth.points as f64 / 1000.0);
    all.extend([
        Figure::new("scale", "resident memory ÷ points", Target::AtMost(1.5), " kB")
            .reached(per_point)
            .remark(format!("{:.1} MB in all", whole.last().map_or(0.0, |run| run.growth.resident / 1e6))),
        Figure::new("scale", "memory a point, second half ÷ first half", Target::AtMost(1.25), "")
            .reached(slopes.iter().map(|(first, second)| second / first))
            .remark("linear: 1; with the square of the points: 3"),
        Figure::new("scale", "all devices announced after", Target::AtMost(10.0), " s")
            .reached(whole.iter().map(|run| run.growth.announced_after)),
    ]);
    let forecasts = whole.iter().map(|run| run.forecast);
    all.push(forecast_figure("scale", forecasts.collect()));
    bench.tell(noise, all);
    Ok(())
}

struct Run {
    growth: Growth,
    reached: Reached,
    /// Of the rate, ÷ what was measured.
    forecast: f64,
    libmodbus: Option<Reached>,
    why: Option<String>,
    noise: Noise,
}

fn run(size: Size, time: Duration) -> anyhow::Result<Run> {
    let servers = Servers::start(size.buses, LATENCY, NEW_VALUE_EVERY)?;
    let units = size.devices.div_ceil(size.buses);
    let beside = libmodbus(&servers, time.min(Duration::from_secs(2)), size.points * size.words, units);
    let (libmodbus, why) = match beside {
        Ok(reached) => (Some(reached), None),
        Err(error) => (None, Some(format!("{error:#}"))),
    };

    let folder = tempfile::tempdir()?;
    fs::create_dir(folder.path().join("bench"))?;
    let mut profile = String::from(
        "device: bench/device\nmanufacturer: Bench\nmodel: Device\nsource: invented for a benchmark\npoints:\n",
    );
    let kind = if size.words == 2 { "u32" } else { "u16" };
    for point in 0..size.points {
        let register = point * size.words;
        profile += &format!("  p{point}: {{at: holding {register}, type: {kind}, poll: fast}}\n");
    }
    fs::write(folder.path().join("bench/device.yaml"), profile)?;
    let mut text = format!("profiles: [{}]\nbuses:\n", folder.path().display());
    for (number, port) in servers.ports.iter().enumerate() {
        text += &format!("  bus_{number}: {{tcp: \"127.0.0.1:{port}\"}}\n");
    }
    text += "devices:\n";
    for number in 0..size.devices {
        let (bus, unit) = (number % size.buses, number / size.buses + 1);
        text += &format!(
            "  device_{number}: {{profile: bench/device, bus: bus_{bus}, unit: {unit}, poll: {{fast: {AT_ONCE}}}}}\n"
        );
    }

    let mosquitto = Mosquitto::start()?;
    let observer = Observer::start(mosquitto.port, "homeassistant/#")?;
    let mut busker = Busker::start(&mosquitto, &text)?;
    let mut announced = BTreeSet::new();
    let mut last_at = 0;
    busker.wait(60.0, "all devices to be announced", || {
        for message in observer.take() {
            let is_device = message.topic.contains("_device_");
            if is_device && !message.payload.is_empty() && announced.insert(message.topic) {
                last_at = message.at;
            }
        }
        announced.len() == size.devices
    })?;
    drop(observer);
    // What was announced is followed by the values.
    sleep(Duration::from_secs(2));
    let watch = Watch::start(own(&busker, &mosquitto))?;
    let reached = reach(&servers, &busker, time);
    let noise = watch.end(own(&busker, &mosquitto));
    let growth = Growth {
        buses: size.buses,
        devices: size.devices,
        points: size.devices * size.points,
        words: size.words,
        resident: busker.resident(),
        cpu_per_million: reached.cpu_per_million,
        registers_per_second: reached.registers_per_second,
        announced_after: (last_at - busker.started_at) as f64 / 1e9,
    };
    let forecast = forecast("scale", &mut busker, &servers, size.points * size.words, time)?;
    Ok(Run { growth, reached, forecast, libmodbus, why, noise })
}
