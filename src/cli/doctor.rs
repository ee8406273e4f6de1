//! `busker doctor`: the adapter of a serial port, and what is heard on its line.

use std::path::{Path, PathBuf};

use serde::Serialize;

use super::Failure;
use super::characters::Characters;
use super::configuration::ConfigurationArgs;
use super::output::{self, counted};
use crate::edge::clock::Clock;
use crate::edge::link::check_up::{self, CheckUp, Opened};
use crate::edge::link::{Link, Lost};
use crate::engine::modbus::rtu_bytes::{frame, sort};
use crate::engine::modbus::{Call, names::QUERY, pdu};
use crate::engine::settings::{self, Direction, Line, Rs485};
use crate::engine::time::Duration;
use crate::engine::yaml::Scalar;

/// Look at a serial port: its adapter, its driver, and the noise on its line
///
/// Tells whether the port can be opened, the name that stays with its adapter, how long the adapter keeps
/// bytes back, and who switches between sending and listening. Then it listens, while nobody is asked: what
/// is heard is noise or another master. Nothing is sent unless `--send` asks for it. With `--listen 0s` not
/// even the port's settings are touched. Ends with exit code 1 if something is wrong.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  busker doctor --serial /dev/ttyUSB0 --baud 19200 --parity even
  busker doctor --config /etc/busker/busker.yaml")]
pub struct Args {
    #[command(flatten)]
    which: Which,
    #[command(flatten)]
    characters: Characters,
    /// How long to listen on each line
    #[arg(long, value_name = "TIME", default_value = "2s", value_parser = <Duration as Scalar>::parse)]
    listen: Duration,
    /// Also send one request, to find out whether the line returns what is sent. It is a loopback query
    /// (function 8) to unit 248, an address that no device may have
    #[arg(long)]
    send: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, clap::Args)]
#[group(required = true, multiple = false)]
struct Which {
    /// This serial port
    #[arg(long, value_name = "PORT")]
    serial: Option<String>,
    /// The serial ports of this configuration
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

/// The first of the addresses that are reserved (Modbus over serial line V1.02, 2.2).
const NOBODY: u8 = 248;
/// A line that babbles is heard enough of.
const HEARD_MAX: usize = 8192;
/// How long after the request's last bit it may come back: adapters keep bytes back.
const ECHO_WAIT: Duration = Duration::from_millis(200);

/// A port with its line.
struct Patient {
    bus: Option<String>,
    path: String,
    link: settings::Link,
    line: Line,
    rs485: Rs485,
}

#[derive(Serialize)]
struct Report {
    port: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    bus: Option<String>,
    findings: Vec<Finding>,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
struct Finding {
    what: &'static str,
    state: State,
    found: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    advice: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum State {
    Good,
    /// It works, and could be better.
    Hint,
    Bad,
}

impl Finding {
    fn good(what: &'static str, found: impl Into<String>) -> Finding {
        Finding { what, state: State::Good, found: found.into(), advice: None }
    }

    fn hint(what: &'static str, found: impl Into<String>, advice: impl Into<String>) -> Finding {
        Finding { what, state: State::Hint, found: found.into(), advice: Some(advice.into()) }
    }

    fn bad(what: &'static str, found: impl Into<String>, advice: impl Into<String>) -> Finding {
        Finding { state: State::Bad, ..Finding::hint(what, found, advice) }
    }
}

pub fn run(args: Args) -> Result<(), Failure> {
    let mut reports = Vec::new();
    for patient in args.patients()? {
        let port = patient.path.clone();
        let findings = examine(&patient, args.listen, args.send);
        reports.push(Report { port, bus: patient.bus, findings });
    }
    if args.json {
        output::print_json(&reports)?;
    } else {
        output::print(&reports.iter().map(Report::text).collect::<Vec<_>>().join("\n"))?;
    }
    let is_bad = |report: &&Report| report.findings.iter().any(|finding| finding.state == State::Bad);
    let bad: Vec<String> = reports.iter().filter(is_bad).map(|report| format!("`{}`", report.port)).collect();
    match bad.is_empty() {
        true => Ok(()),
        false => Err(anyhow::anyhow!("not all is well with {}", bad.join(", ")).into()),
    }
}

impl Args {
    fn patients(&self) -> Result<Vec<Patient>, Failure> {
        if let Some(path) = &self.which.serial {
            let line = self.characters.line();
            return Ok(vec![Patient::new(None, path, line, Rs485::Auto)]);
        }
        let config = self.which.config.clone().unwrap_or_default();
        let settings = ConfigurationArgs { config }.load()?;
        let serial = settings.buses.iter().filter_map(|bus| match &bus.link {
            settings::Link::Serial { path, line, rs485 } => {
                Some(Patient::new(Some(bus.name.clone()), path, *line, *rs485))
            }
            _ => None,
        });
        let patients: Vec<Patient> = serial.collect();
        match patients.is_empty() {
            true => Err(Failure::wrong("this configuration has no serial port")),
            false => Ok(patients),
        }
    }
}

impl Patient {
    fn new(bus: Option<String>, path: &str, line: Line, rs485: Rs485) -> Patient {
        let link = settings::Link::Serial { path: path.into(), line, rs485 };
        Patient { bus, path: path.into(), link, line, rs485 }
    }
}

impl Report {
    fn text(&self) -> String {
        let bus = self.bus.as_ref().map_or(String::new(), |bus| format!(", bus {bus}"));
        let mut table = output::Table::new();
        for finding in &self.findings {
            let mark = match finding.state {
                State::Good => "  ok",
                State::Hint => "  hint",
                State::Bad => "  bad",
            };
            let advice = finding.advice.as_ref().map_or(String::new(), |advice| format!("; {advice}"));
            table.row([mark.into(), finding.what.to_string(), format!("{}{advice}", finding.found)]);
        }
        format!("{}{bus}\n{}", self.port, table.render())
    }
}

fn examine(patient: &Patient, time: Duration, send: bool) -> Vec<Finding> {
    let found = check_up::check_up(Path::new(&patient.path));
    let mut findings = of_adapter(&patient.path, &found);
    let opened = match &found.opened {
        Ok(opened) => opened,
        Err(Lost(why)) => {
            findings.push(Finding::bad("port", why.clone(), "nothing more can be found out"));
            return findings;
        }
    };
    findings.push(Finding::good("port", "can be opened"));
    findings.extend(of_driver(patient.rs485, opened));
    if !time.is_zero() || send {
        match on_the_line(patient, time, send) {
            Ok(heard) => findings.extend(heard),
            Err(Lost(why)) => findings.push(Finding::bad("line", why, "nothing was heard")),
        }
    }
    findings
}

/// What is known without opening the port.
fn of_adapter(path: &str, found: &CheckUp) -> Vec<Finding> {
    let mut findings = Vec::new();
    if let Some(target) = &found.target {
        findings.push(Finding::good("leads to", target.display().to_string()));
    }
    let may_change = ["/dev/ttyUSB", "/dev/ttyACM"].iter().any(|name| path.starts_with(name));
    match &found.stable_path {
        Some(stable) if stable == Path::new(path) => {
            findings.push(Finding::good("name", "stays with the adapter"));
        }
        Some(stable) => findings.push(Finding::hint(
            "name",
            "may be another adapter's after the next start",
            format!("use `{}`, which stays with it", stable.display()),
        )),
        None if may_change => findings.push(Finding::hint(
            "name",
            "may be another adapter's after the next start",
            "nothing under /dev/serial/by-id leads to it; a udev rule can give it a name",
        )),
        None => {}
    }
    findings.extend(found.product.as_ref().map(|product| Finding::good("adapter", product)));
    findings.extend(found.driver.as_ref().map(|driver| Finding::good("driver", driver)));
    findings.extend(found.latency_timer.map(|millis| match millis {
        0..=1 => Finding::good("latency timer", format!("{millis} ms")),
        _ => Finding::hint(
            "latency timer",
            format!("{millis} ms: so long the end of a reply may be kept back"),
            "`busker run` asks for 1 ms when it opens the port",
        ),
    }));
    findings
}

fn of_driver(wanted: Rs485, opened: &Opened) -> Vec<Finding> {
    let latency = opened.low_latency.map(|on| match on {
        true => Finding::good("low latency", "on"),
        false => Finding::good("low latency", "off; `busker run` asks for it when it opens the port"),
    });
    let told = |direction: Direction| {
        let Direction { rts_on_send, delay_before_send, delay_after_send } = direction;
        format!(
            "the kernel switches: RTS is {} on send, {} ms before and {} ms after it",
            if rts_on_send { "on" } else { "off" },
            delay_before_send.as_millis(),
            delay_after_send.as_millis()
        )
    };
    let direction = match (wanted, opened.direction, opened.can_switch) {
        (Rs485::Kernel(_), None, false) => Finding::bad(
            "RS485",
            "the driver cannot switch the transceiver, as `rs485: kernel` wants it to",
            "most adapters do it by themselves: leave `rs485` out",
        ),
        (Rs485::None, Some(direction), _) => {
            Finding::good("RS485", format!("{}; `rs485: none` ends that", told(direction)))
        }
        (_, Some(direction), _) => Finding::good("RS485", told(direction)),
        (Rs485::Kernel(_), None, true) => {
            Finding::good("RS485", "the driver can switch the transceiver, and will when the port is opened")
        }
        (_, None, true) => Finding::good(
            "RS485",
            "the driver can switch a transceiver by RTS, and does not; where none switches by itself: \
             `rs485: kernel`",
        ),
        (_, None, false) => Finding::good(
            "RS485",
            "the driver cannot switch a transceiver; the adapter has to do it by itself",
        ),
    };
    latency.into_iter().chain([direction]).collect()
}

fn on_the_line(patient: &Patient, time: Duration, send: bool) -> Result<Vec<Finding>, Lost> {
    let clock = Clock::start();
    let link = Link::open(&patient.link)?;
    let mut findings = Vec::new();
    if !time.is_zero() {
        let heard = check_up::listen(&link, clock, time, HEARD_MAX)?;
        findings.push(of_noise(&heard, time));
    }
    if send {
        let query = Call::Diagnostics { function: 0, data: vec![QUERY] };
        let request = frame(NOBODY, &pdu::encode(&query).map_err(|reason| Lost(reason.into()))?);
        link.write(&request)?;
        let wait = patient.line.characters(request.len() as u32) + ECHO_WAIT;
        let heard = check_up::listen(&link, clock, wait, HEARD_MAX)?;
        findings.push(of_echo(&request, &heard));
    }
    Ok(findings)
}

/// What is heard while this program asks nobody.
fn of_noise(heard: &[u8], time: Duration) -> Finding {
    let sorted = sort(heard, &[], None, &[]).discarded;
    let seconds = time.as_secs_f64();
    let others = sorted.requests_of_others;
    if others.count > 0 {
        let requests = counted(others.count as usize, "request");
        let found = format!("{requests} of another master in {seconds} s, the last to unit {}", others.unit);
        return Finding::bad("noise", found, "a Modbus RTU line has one master; unplug the other");
    }
    match (sorted.foreign_frames, sorted.noise_bytes) {
        (0, 0) => Finding::good("noise", format!("none in {seconds} s")),
        (0, bytes) => Finding::bad(
            "noise",
            format!("{} in {seconds} s that belong to no frame", counted(bytes as usize, "byte")),
            "look at baud and parity, at the termination at both ends and the bias of the line, and for A and B \
             swapped",
        ),
        (frames, _) => Finding::bad(
            "noise",
            format!("{} in {seconds} s, though nobody was asked", counted(frames as usize, "whole frame")),
            "another master speaks on this line, or a device speaks unasked",
        ),
    }
}

/// What is heard after a request that nobody answers.
fn of_echo(request: &[u8], heard: &[u8]) -> Finding {
    let copies = heard.windows(request.len()).filter(|window| *window == request).count();
    match (copies, heard.len()) {
        (0, 0) => Finding::good("echo", "none: the line does not return what is sent"),
        (0, bytes) => Finding::bad(
            "echo",
            format!("not what was sent came back, but {}", counted(bytes, "other byte")),
            "another speaks at the same time, or the line is not terminated or biased as it should be",
        ),
        _ => Finding::good("echo", "the line returns what is sent; collisions will be noticed by that"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn told(finding: &Finding) -> String {
        format!("{:?} {}", finding.state, finding.found)
    }

    #[test]
    fn what_is_heard_unasked_is_noise_or_somebody_who_speaks() {
        let request = frame(7, &[3, 0, 0, 0, 2]);
        let reply = frame(7, &[3, 4, 0, 1, 0, 2]);
        for (heard, expected) in [
            (vec![], "Good none in 2 s"),
            (vec![0, 0xFF, 0x13], "Bad 3 bytes in 2 s that belong to no frame"),
            ([request, reply.clone()].concat(), "Bad 1 request of another master in 2 s, the last to unit 7"),
            (reply, "Bad 1 whole frame in 2 s, though nobody was asked"),
        ] {
            assert_eq!(told(&of_noise(&heard, Duration::from_secs(2))), expected);
        }
    }

    #[test]
    fn an_echo_is_what_was_sent_and_nothing_else() {
        let request = frame(NOBODY, &[8, 0, 0, 0xA5, 0x37]);
        for (heard, expected) in [
            (vec![], "Good none: the line does not return what is sent"),
            (
                [vec![0], request.clone()].concat(),
                "Good the line returns what is sent; collisions will be noticed by that",
            ),
            (request[..5].to_vec(), "Bad not what was sent came back, but 5 other bytes"),
        ] {
            assert_eq!(told(&of_echo(&request, &heard)), expected);
        }
    }

    #[test]
    fn the_adapter_is_told_with_what_could_be_better() {
        let plain = || CheckUp {
            target: None,
            stable_path: None,
            product: None,
            driver: None,
            latency_timer: None,
            opened: Err(Lost("not opened".into())),
        };
        let stable = || Some(PathBuf::from("/dev/serial/by-id/usb-A1"));
        for (path, found, expected) in [
            ("/dev/ttyAMA0", plain(), &[][..]),
            ("/dev/ttyUSB0", plain(), &["Hint may be another adapter's after the next start"]),
            (
                "/dev/ttyUSB0",
                CheckUp { stable_path: stable(), ..plain() },
                &["Hint may be another adapter's after the next start"],
            ),
            (
                "/dev/serial/by-id/usb-A1",
                CheckUp { stable_path: stable(), ..plain() },
                &["Good stays with the adapter"],
            ),
            ("/dev/ttyAMA0", CheckUp { latency_timer: Some(1), ..plain() }, &["Good 1 ms"]),
            (
                "/dev/ttyAMA0",
                CheckUp { latency_timer: Some(16), ..plain() },
                &["Hint 16 ms: so long the end of a reply may be kept back"],
            ),
        ] {
            let findings: Vec<String> = of_adapter(path, &found).iter().map(told).collect();
            assert_eq!(findings, expected, "{path}");
        }
    }

    #[test]
    fn who_switches_the_transceiver_is_told_against_what_is_wanted() {
        let opened = |direction, can_switch| Opened { direction, can_switch, low_latency: None };
        let usual = Direction::default();
        for (wanted, opened, expected) in [
            (Rs485::Auto, opened(None, false), "Good the driver cannot switch"),
            (
                Rs485::Auto,
                opened(None, true),
                "Good the driver can switch a transceiver by RTS, and does not",
            ),
            (
                Rs485::Auto,
                opened(Some(usual), true),
                "Good the kernel switches: RTS is on on send, 0 ms before",
            ),
            (Rs485::Kernel(usual), opened(None, false), "Bad the driver cannot switch the transceiver, as"),
            (
                Rs485::Kernel(usual),
                opened(None, true),
                "Good the driver can switch the transceiver, and will",
            ),
            (Rs485::None, opened(Some(usual), true), "Good the kernel switches"),
        ] {
            let findings = of_driver(wanted, &opened);
            assert!(told(&findings[0]).starts_with(expected), "{wanted:?}: {:?}", findings[0]);
        }
    }
}
