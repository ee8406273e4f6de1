//! `busker scan`: who answers on a line, and how that would stand in the configuration.

use std::collections::BTreeSet;
use std::io::{IsTerminal, Write};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::anyhow;

use super::reach::{self, Reach};
use super::{Failure, output};
use crate::edge::clock::Clock;
use crate::edge::link::{Lost, adapter};
use crate::edge::shutdown::{Heard, Signals};
use crate::engine::identity;
use crate::engine::profile::Library;
use crate::engine::scan::{self, Progress, Question, Report, Scan, Wanted};
use crate::engine::settings::{self, Line, Link, Parity, UNIT_OF_LINE_MAX};
use crate::engine::time::{Duration, Time};
use crate::engine::yaml::Scalar;

/// Find the devices on a line, and propose a configuration for them
///
/// Asks each unit who it is, and writes nothing. Of a serial line the bit rate and parity are found as
/// well: the likeliest first, slow ones last; once a unit has answered, all are asked with its settings.
/// Nobody else may speak on the line meanwhile: stop the service first. Ctrl-C ends it with what was
/// found so far. What is printed can stand in the configuration as it is.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  busker scan --serial /dev/ttyUSB0
  busker scan --serial /dev/ttyUSB0 --baud 19200 --parity even --units 1..32
  busker scan --tcp 192.168.1.20:502 --json")]
pub struct Args {
    #[command(flatten)]
    line: WhichLine,
    /// The units to ask: `1..32`, `7`, or several of them with commas [default: 1..247, and 255 on Modbus TCP]
    #[arg(long, value_name = "UNITS")]
    units: Option<String>,
    /// The line's bit rate, where it is known
    #[arg(long, value_name = "RATE", value_parser = clap::value_parser!(u32).range(300..=1_000_000), conflicts_with = "tcp")]
    baud: Option<u32>,
    /// The line's parity, where it is known: even, odd or none
    #[arg(long, value_parser = <Parity as Scalar>::parse, conflicts_with = "tcp")]
    parity: Option<Parity>,
    /// The line's stop bits, where they are known: 1 or 2
    #[arg(long, value_parser = clap::value_parser!(u8).range(1..=2), conflicts_with = "tcp")]
    stop_bits: Option<u8>,
    /// How long to wait for a unit that may not be there [default: 60 ms and five characters on a line, where what
    /// comes later is still noticed; 1s on Modbus TCP]
    #[arg(long, value_name = "TIME", value_parser = <Duration as Scalar>::parse)]
    timeout: Option<Duration>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, clap::Args)]
#[group(required = true, multiple = false)]
struct WhichLine {
    /// RTU on this serial port
    #[arg(long, value_name = "PORT")]
    serial: Option<String>,
    /// Modbus TCP at this address; without a port 502
    #[arg(long, value_name = "ADDRESS:PORT")]
    tcp: Option<String>,
    /// RTU through a serial server at this address, which has bit rate and parity of its own
    #[arg(long, value_name = "ADDRESS:PORT")]
    rtu_over_tcp: Option<String>,
}

pub fn run(args: Args) -> Result<(), Failure> {
    let library = Library::shipped();
    let link = args.link()?;
    let wanted = Wanted {
        lines: args.lines(&link),
        units: args.units(&link)?,
        known: identity::known(&library),
        nameless: identity::nameless(&library),
        timeout: args.timeout,
        of_server: !matches!(link, Link::Serial { .. }),
    };
    let interrupted = interrupted()?;
    let mut scan = Scan::new(wanted);
    let clock = Clock::start();
    let mut reach = Reach::new(link.clone(), clock);
    // What cannot be opened at all is told before anything is promised.
    if let Err(Lost(why)) = reach.at(scan.progress().line) {
        return Err(anyhow!("{why}").into());
    }
    eprintln!("{}", promise(&scan, &link.address()));
    let mut teller = Teller::new(clock);
    let ended = carry_out(&mut reach, &mut scan, &mut teller, &interrupted);
    teller.end();
    if matches!(ended, Ended::Interrupted) {
        eprintln!("interrupted; what was found so far:");
    }
    let report = scan.report(matches!(ended, Ended::Whole));
    tell(&report, &lasting(link), args.json)?;
    match ended {
        Ended::Lost(why) => Err(anyhow!("the scan ended early: {why}").into()),
        _ if report.is_empty() => Err(anyhow!("{}", report.why_empty()).into()),
        _ => Ok(()),
    }
}

fn tell(report: &Report, link: &Link, as_json: bool) -> Result<(), Failure> {
    if as_json {
        return output::print_json(&report.json(link));
    }
    report.notes().iter().for_each(|note| eprintln!("note: {note}"));
    report.configuration(link).map_or(Ok(()), |text| output::print(&text))
}

/// By the name that stays with the adapter.
fn lasting(mut link: Link) -> Link {
    if let Link::Serial { path, .. } = &mut link {
        if let Some(stable) = adapter::stable_path(Path::new(&*path), Path::new(adapter::BY_ID)) {
            *path = stable.display().to_string();
        }
    }
    link
}

impl Args {
    /// What is scanned, with any settings: it is opened with those of each question.
    fn link(&self) -> Result<Link, Failure> {
        let WhichLine { serial, tcp, rtu_over_tcp } = &self.line;
        let link = reach::link([serial, tcp, rtu_over_tcp], scan::SPECIFIED)?;
        link.ok_or_else(|| Failure::wrong("expected `--serial`, `--tcp` or `--rtu-over-tcp`"))
    }

    /// The settings to try: behind a server only its own, which nobody here can change.
    fn lines(&self, link: &Link) -> Vec<Line> {
        let lines = scan::lines(self.baud, self.parity, self.stop_bits);
        match link {
            Link::Serial { .. } => lines,
            Link::RtuOverTcp { .. } => lines.into_iter().take(1).collect(),
            Link::Tcp { .. } => Vec::new(),
        }
    }

    fn units(&self, link: &Link) -> Result<Vec<u8>, Failure> {
        let most = link.units_most();
        let Some(text) = &self.units else {
            // Of the units that only Modbus TCP has, 255 is a gateway itself.
            return Ok((1..=UNIT_OF_LINE_MAX).chain((most > UNIT_OF_LINE_MAX).then_some(most)).collect());
        };
        let mut units = BTreeSet::new();
        for part in text.split(',') {
            units.extend(
                settings::units(part.trim(), most)
                    .map_err(|why| Failure::wrong(format!("`--units`: {why}")))?,
            );
        }
        Ok(units.into_iter().collect())
    }
}

/// How it ended.
enum Ended {
    Whole,
    Interrupted,
    Lost(String),
}

/// Asks whatever the scan wants to know.
fn carry_out(reach: &mut Reach, scan: &mut Scan, teller: &mut Teller, interrupted: &AtomicBool) -> Ended {
    while let Some(question) = scan.next_question() {
        if interrupted.load(Ordering::Relaxed) {
            return Ended::Interrupted;
        }
        let told = ask(reach, scan, question);
        while let Some(news) = scan.next_news() {
            teller.say(&news);
        }
        if let Err(why) = told {
            return Ended::Lost(why);
        }
        teller.progress(&scan.progress());
    }
    Ended::Whole
}

/// Tells the scan what became of its question; `Err`: it ends.
fn ask(reach: &mut Reach, scan: &mut Scan, question: Question) -> Result<(), String> {
    let before = reach.open_with();
    let asked = match reach.at(question.line) {
        Ok(link) => link.ask(&question.request, question.timeout),
        Err(Lost(why)) => {
            let opens_as_before = before.is_some_and(|before| reach.at(before).is_ok());
            return scan.not_opened(&question, why, opens_as_before);
        }
    };
    match asked {
        Ok(reply) => scan.answered(&reply),
        Err(Lost(why)) => {
            reach.close();
            return scan.lost(question, why);
        }
    }
    Ok(())
}

/// What the whole takes, beforehand.
fn promise(scan: &Scan, place: &str) -> String {
    let (best, most) = (duration(scan.at_best()), duration(scan.at_most()));
    let settings = scan.settings();
    match settings {
        0 | 1 => format!(
            "asking {} units on {place}: at most {most}; Ctrl-C ends it with what was found",
            scan.units()
        ),
        _ => format!(
            "asking {} units on {place} with up to {settings} settings, the likeliest first: about {best} once one \
             has answered, at most {most} if none does; Ctrl-C ends it with what was found",
            scan.units()
        ),
    }
}

/// `40 s`, `12 min`
fn duration(time: Duration) -> String {
    match time.as_secs() {
        0 => "1 s".into(),
        seconds @ 1..=99 => format!("{seconds} s"),
        seconds => format!("{} min", seconds.div_ceil(60)),
    }
}

/// Turns true when somebody interrupts.
fn interrupted() -> anyhow::Result<Arc<AtomicBool>> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let mut signals = runtime.block_on(async { Signals::listen() })?;
    let interrupted = Arc::new(AtomicBool::new(false));
    let told = Arc::clone(&interrupted);
    std::thread::Builder::new().name("signals".into()).spawn(move || {
        // A terminal that is closed ends it as well.
        let (Heard::Stop(_) | Heard::Reload) = runtime.block_on(signals.wait());
        told.store(true, Ordering::Relaxed);
    })?;
    Ok(interrupted)
}

/// Tells on standard error how far the scan is: on a terminal in one line that changes, elsewhere seldom.
struct Teller {
    clock: Clock,
    on_terminal: bool,
    begun: Time,
    told_at: Time,
    /// How long the line on the terminal is.
    shown: usize,
}

const ON_A_TERMINAL: Duration = Duration::from_millis(200);
const ELSEWHERE: Duration = Duration::from_secs(30);

impl Teller {
    fn new(clock: Clock) -> Teller {
        let now = clock.now();
        Teller { clock, on_terminal: std::io::stderr().is_terminal(), begun: now, told_at: now, shown: 0 }
    }

    fn progress(&mut self, progress: &Progress) {
        let now = self.clock.now();
        let every = if self.on_terminal { ON_A_TERMINAL } else { ELSEWHERE };
        if now < self.told_at + every {
            return;
        }
        self.told_at = now;
        let rate = f64::from(progress.questions) / (now - self.begun).as_secs_f64().max(0.001);
        let at = progress.line.map_or_else(String::new, |line| format!(" at {line}"));
        let unit = progress.unit.map_or_else(String::new, |unit| format!("unit {unit}"));
        let text =
            format!("{unit}{at}, {rate:.1} questions a second, at most {} more", duration(progress.at_most));
        if self.on_terminal {
            self.replace(&text);
        } else {
            eprintln!("{text}");
        }
    }

    fn say(&mut self, text: &str) {
        self.end();
        eprintln!("{text}");
    }

    /// Takes the changing line away.
    fn end(&mut self) {
        if self.shown > 0 {
            self.replace("");
            self.shown = 0;
        }
    }

    fn replace(&mut self, text: &str) {
        let width = self.shown;
        // Whoever cannot be told loses nothing but this.
        let _ = write!(std::io::stderr(), "\r{text:<width$}{}", if text.is_empty() { "\r" } else { "" });
        self.shown = text.chars().count();
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::engine::settings::Rs485;

    #[derive(clap::Parser)]
    struct Typed {
        #[command(flatten)]
        args: Args,
    }

    #[test]
    fn units_are_spans_and_single_ones() {
        let link = Link::Serial { path: "line".into(), line: scan::SPECIFIED, rs485: Rs485::Auto };
        let server = Link::Tcp { host: "plc".into(), port: 502 };
        let check = |link: &Link, text: Option<&str>, expected: Option<Vec<u8>>| {
            let mut words = vec!["scan", "--serial", "line"];
            words.extend(text.iter().flat_map(|text| ["--units", text]));
            let args = Typed::parse_from(words).args;
            assert_eq!(args.units(link).ok(), expected, "{text:?}");
        };
        check(&link, Some("7"), Some(vec![7]));
        check(&link, Some("30..32, 1..2,31"), Some(vec![1, 2, 30, 31, 32]));
        check(&server, Some("246..248"), Some(vec![246, 247, 248]));
        check(&link, None, Some((1..=247).collect()));
        check(&server, None, Some((1..=247).chain([255]).collect()));
        for wrong in ["", "0", "5..3", "246..248", "1..300", "all", "1,,2"] {
            check(&link, Some(wrong), None);
        }
    }

    #[test]
    fn a_time_is_told_as_people_do() {
        for (seconds, told) in [(0, "1 s"), (99, "99 s"), (100, "2 min"), (600, "10 min")] {
            assert_eq!(duration(Duration::from_secs(seconds)), told);
        }
    }
}
