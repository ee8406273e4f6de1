//! W6: Modbus TCP beside a bare loop of libmodbus, with the same devices.

use std::process::Command;
use std::time::Duration;

use anyhow::Context;
use serde_json::Value;

use super::{AT_ONCE, Bench};
use crate::clock::{now, seconds_since, sleep};
use crate::machine::{self, Noise, Watch};
use crate::program::{Busker, Mosquitto};
use crate::report::{Figure, Target, median};
use crate::tcp::Servers;

const DEVICES: usize = 20;
const REGISTERS: usize = 100;
pub const LATENCY: Duration = Duration::from_millis(1);
/// How often the first register of a device changes.
const NEW_VALUE_EVERY: Duration = Duration::from_millis(100);

/// What one program reached.
#[derive(Clone, Copy, Default)]
pub struct Reached {
    pub registers_per_second: f64,
    pub cpu_per_million: f64,
}

pub fn w6(bench: &mut Bench) -> anyhow::Result<()> {
    let servers = Servers::start(DEVICES, LATENCY, NEW_VALUE_EVERY)?;
    let time = bench.seconds(4, 3);
    let (mut of_busker, mut of_libmodbus) = (Vec::new(), Vec::new());
    let (mut why, mut forecasts) = (None, Vec::new());
    let mut noise = Noise::default();
    for _ in 0..bench.runs() {
        // One beside the other, so that both meet the same machine.
        match libmodbus(&servers, time, REGISTERS, 1) {
            Ok(reached) => of_libmodbus.push(reached),
            Err(error) => why = Some(format!("{error:#}")),
        }
        let (reached, of_run, forecast) = busker(&servers, time)?;
        of_busker.push(reached);
        forecasts.push(forecast);
        noise = noise.worse(of_run);
    }
    bench.tell(
        noise,
        figures("W6", &of_busker, &of_libmodbus, why).into_iter().chain([forecast_figure("W6", forecasts)]),
    );
    Ok(())
}

/// The figures of a program beside the bare loop.
pub fn figures(
    row: &'static str,
    of_busker: &[Reached],
    of_libmodbus: &[Reached],
    why_not: Option<String>,
) -> Vec<Figure> {
    let rate = |reached: &Reached| reached.registers_per_second;
    let ratios = of_busker.iter().zip(of_libmodbus).map(|(ours, theirs)| rate(ours) / rate(theirs));
    // How long a second of a processor is varies with the machine; the bare loop's varies with it.
    let cpu_ratios = of_busker
        .iter()
        .zip(of_libmodbus)
        .map(|(ours, theirs)| ours.cpu_per_million / theirs.cpu_per_million);
    let cpu_ratio = median(&cpu_ratios.collect::<Vec<_>>());
    let half = |of: &[Reached], value: fn(&Reached) -> f64| {
        median(&of.iter().map(value).collect::<Vec<_>>()).unwrap_or_default()
    };
    let remark = why_not.unwrap_or_else(|| {
        format!(
            "{:.2} million a second, libmodbus {:.2} at {:.3} CPU s per million",
            half(of_busker, |reached| reached.registers_per_second) / 1e6,
            half(of_libmodbus, |reached| reached.registers_per_second) / 1e6,
            half(of_libmodbus, |reached| reached.cpu_per_million),
        )
    });
    vec![
        Figure::new(row, "registers a second ÷ bare libmodbus loop", Target::AtLeast(1.0), "")
            .reached(ratios)
            .remark(remark),
        Figure::new(row, "CPU seconds per million registers, with MQTT", Target::AtMost(0.15), "")
            .reached(of_busker.iter().map(|reached| reached.cpu_per_million))
            .remark(cpu_ratio.map_or_else(String::new, |ratio| {
                format!("{ratio:.2} of the bare loop's, which publishes nothing")
            })),
    ]
}

/// Registers a second as `busker check` foretells them ÷ those that were measured, where devices answer as the program
/// has measured meanwhile: on Modbus TCP that is the whole round trip, which is the device's own time and the way to it.
/// This comes after all else, since the program makes a page of every reading to tell it.
pub fn forecast(
    row: &str,
    busker: &mut Busker,
    servers: &Servers,
    registers: usize,
    time: Duration,
) -> anyhow::Result<f64> {
    // The first page takes longer than any later one.
    busker.turnarounds()?;
    let before = busker.turnarounds()?;
    // What was read while a page was made is in this rate as it is in the round trips.
    let (began_at, registers_before) = (now(), servers.registers());
    sleep(time);
    let turnaround = busker.turnarounds()?.since(before).context("it tells no turnaround")?;
    let measured = (servers.registers() - registers_before) as f64 / seconds_since(began_at);
    let check = busker.check(row, turnaround)?;
    let buses = check["buses"].as_array().context("`busker check` tells of no bus")?;
    let devices = buses.iter().filter_map(|bus| bus["devices"].as_array()).flatten();
    let period = |device: &Value| device["polls"]["fast"]["real_period"].as_f64();
    let rates: Option<Vec<f64>> = devices.map(|device| Some(registers as f64 / period(device)?)).collect();
    let rate: f64 = rates.context("`busker check` tells no period")?.iter().sum();
    Ok(rate / measured)
}

pub fn forecast_figure(row: &'static str, forecasts: Vec<f64>) -> Figure {
    let what = "registers a second as `busker check` says ÷ measured";
    Figure::new(row, what, Target::Between(0.95, 1.05), "").reached(forecasts).remark(format!(
        "with the round trip that the program has measured meanwhile; `target/bench/{row}.yaml`"
    ))
}

/// What it reached, how noisy it was, and what was forecast.
fn busker(servers: &Servers, time: Duration) -> anyhow::Result<(Reached, Noise, f64)> {
    let points = (0..REGISTERS)
        .map(|register| format!("p{register}: {{at: holding {register}, type: u16, poll: fast}}"))
        .collect::<Vec<_>>()
        .join(", ");
    let mut text = String::from("buses:\n");
    for (number, port) in servers.ports.iter().enumerate() {
        text += &format!("  bus_{number}: {{tcp: \"127.0.0.1:{port}\"}}\n");
    }
    text += "devices:\n";
    for number in 0..servers.ports.len() {
        text += &format!(
            "  device_{number}: {{bus: bus_{number}, unit: 1, poll: {{fast: {AT_ONCE}}}, points: {{{points}}}}}\n"
        );
    }
    let mosquitto = Mosquitto::start()?;
    let mut busker = Busker::start(&mosquitto, &text)?;
    let asked = servers.requests();
    busker.wait(20.0, "the devices to be read", || servers.requests() - asked > DEVICES as u64 * 100)?;
    // Discovery and the first values are out by then.
    sleep(Duration::from_secs(1));
    let watch = Watch::start(own(&busker, &mosquitto))?;
    let reached = reach(servers, &busker, time);
    let noise = watch.end(own(&busker, &mosquitto));
    let forecast = forecast("W6", &mut busker, servers, REGISTERS, time)?;
    Ok((reached, noise, forecast))
}

/// Seconds of processor time of all that belongs to the measurement.
pub fn own(busker: &Busker, mosquitto: &Mosquitto) -> f64 {
    machine::cpu_seconds(std::process::id()) + busker.cpu_seconds() + mosquitto.cpu_seconds()
}

/// What a running program reads in this time.
pub fn reach(servers: &Servers, busker: &Busker, time: Duration) -> Reached {
    let (began_at, registers, cpu) = (now(), servers.registers(), busker.cpu_seconds());
    sleep(time);
    let registers = (servers.registers() - registers) as f64;
    Reached {
        registers_per_second: registers / seconds_since(began_at),
        cpu_per_million: (busker.cpu_seconds() - cpu) / registers * 1e6,
    }
}

/// The bare loop with the same devices. An error says why there is none.
pub fn libmodbus(
    servers: &Servers,
    time: Duration,
    registers: usize,
    units: usize,
) -> anyhow::Result<Reached> {
    let program = std::env::var("BUSKER_LIBMODBUS_LOOP").ok().filter(|path| !path.is_empty());
    let program = program.context("libmodbus is not there: scripts/get-libmodbus-loop says why")?;
    let (before, began_at) = (servers.registers(), now());
    let output = Command::new(program)
        .args([time.as_secs().to_string(), registers.to_string(), units.to_string()])
        .args(servers.ports.iter().map(u16::to_string))
        .output()
        .context("the loop of libmodbus cannot be started")?;
    let took = seconds_since(began_at);
    let told = String::from_utf8_lossy(&output.stdout);
    let cpu: f64 =
        told.trim().parse().with_context(|| String::from_utf8_lossy(&output.stderr).into_owned())?;
    let read = (servers.registers() - before) as f64;
    Ok(Reached { registers_per_second: read / took, cpu_per_million: cpu / read * 1e6 })
}
