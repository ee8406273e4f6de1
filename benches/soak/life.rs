//! The life itself: what happens by chance, who looks on, and what it comes to.

use std::collections::BTreeMap;
use std::fmt::Write;

use anyhow::{Context, bail};
use busker::edge::clock::Clock;
use busker::engine::time::{Duration, Time};
use busker::simulator::script::Action;
use fastrand::Rng;
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::check::Checker;
use crate::device::{Diary, STORED, Store};
use crate::faults::FAULTS;
use crate::gate::Gate;
use crate::leak::{Growth, Sample};
use crate::line::LiveLine;
use crate::mqtt::Observer;
use crate::points::{self, Point, UNITS};
use crate::program::{Busker, Mosquitto};

/// So long everything is looked at before the first fault, and behind the last.
const CALM_BEFORE: Duration = Duration::from_secs(8);
const CALM_AFTER: Duration = Duration::from_secs(25);
/// All must be right again so long after the last fault.
const WELL_WITHIN: Duration = Duration::from_secs(90);
/// So many seconds, and at most half of the life, the program has to come to its size.
const WARM_UP: f64 = 120.0;

/// What is to be undone, and when.
enum Undo {
    PlugIn(usize),
    Unmute(usize),
    Accept(usize),
    OpenGate,
}

/// The program's way to the broker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Way {
    /// The program hears what is published.
    Open,
    /// It has not been heard of since the way was opened.
    Opening,
    Closed,
}

pub struct Life {
    random: Rng,
    clock: Clock,
    lines: [LiveLine; 2],
    diaries: [Diary; 2],
    broker: Mosquitto,
    gate: Gate,
    way: Way,
    observer: Observer,
    busker: Busker,
    http: String,
    checker: Checker,
    undo: Vec<(Time, Undo)>,
    happened: BTreeMap<&'static str, u64>,
    samples: Vec<Sample>,
    sampled_at: Time,
    /// The last value that was wanted of a holding register; none is wanted twice.
    sequence: u16,
    /// How many questions were asked that are answered at once, and which answer came last.
    questions: u64,
    answered: u64,
    asked_at: Time,
    _folder: TempDir,
}

/// What it comes to.
pub struct Report {
    pub text: String,
    pub json: Value,
    pub faults: Vec<String>,
}

impl Life {
    /// Starts everything, and waits until all is well.
    pub fn begin(seed: u64) -> anyhow::Result<Life> {
        let (clock, folder) = (Clock::start(), tempfile::tempdir()?);
        let diaries = [Diary::default(), Diary::default()];
        let lines = [
            LiveLine::on_a_terminal(clock, folder.path().join("line"), UNITS[0], &diaries[0])?,
            LiveLine::on_tcp(clock, UNITS[1], &diaries[1])?,
        ];
        let broker = Mosquitto::start()?;
        let gate = Gate::before(broker.port)?;
        let observer = Observer::start(broker.port, "#")?;
        let links: Vec<String> = lines.iter().map(LiveLine::link).collect();
        let mut busker = Busker::start_at(gate.port, &points::configuration(&links))?;
        let http = busker.http()?;
        let mut life = Life {
            random: Rng::with_seed(seed),
            clock,
            lines,
            diaries,
            broker,
            gate,
            way: Way::Open,
            observer,
            busker,
            http,
            checker: Checker::default(),
            undo: Vec::new(),
            happened: BTreeMap::new(),
            samples: Vec::new(),
            sampled_at: clock.now(),
            sequence: 0,
            questions: 0,
            answered: 0,
            asked_at: clock.now(),
            _folder: folder,
        };
        life.wait_until_well()?;
        Ok(life)
    }

    /// Lives for so many seconds, then waits until all is well, and says what it comes to.
    pub fn live(mut self, seconds: f64) -> anyhow::Result<Report> {
        self.samples.clear();
        self.pass(CALM_BEFORE)?;
        let calm_before = std::mem::take(&mut self.samples);
        let began_at = self.clock.now();
        let end = began_at + Duration::from_secs_f64(seconds);
        let mut told_at = began_at;
        while self.clock.now() < end {
            let pause = Duration::from_millis(self.random.u64(20..500));
            self.pass(pause)?;
            self.something_happens()?;
            if self.clock.now() - told_at >= Duration::from_secs(10) {
                told_at = self.clock.now();
                self.progress((told_at - began_at).as_secs_f64(), seconds);
            }
        }
        let warm_up = self.since_start(began_at) + (seconds / 2.0).min(WARM_UP);
        let samples: Vec<Sample> =
            std::mem::take(&mut self.samples).into_iter().filter(|sample| sample.at > warm_up).collect();
        self.mend()?;
        let mended_at = self.clock.now();
        self.wait_until_well()?;
        let well_after = self.clock.now() - mended_at;
        self.samples.clear();
        self.pass(CALM_AFTER)?;
        self.wait_until_well()?;
        let calm_after: Vec<Sample> = self.samples.split_off(self.samples.len() / 2);
        let changes: Vec<_> = self.diaries.iter().map(Diary::changes).collect();
        self.checker.commands_ended(&changes);
        Ok(self.report(seconds, well_after, Growth::of(&samples, &calm_before, &calm_after)))
    }

    /// Lets time pass, while somebody looks on.
    fn pass(&mut self, time: Duration) -> anyhow::Result<()> {
        let until = self.clock.now() + time;
        loop {
            self.look()?;
            let now = self.clock.now();
            if now >= until {
                return Ok(());
            }
            std::thread::sleep((until - now).min(Duration::from_millis(25)));
        }
    }

    /// Checks what has come, measures the program, and undoes what has lasted long enough.
    fn look(&mut self) -> anyhow::Result<()> {
        let now = self.clock.now();
        for message in self.observer.take() {
            if message.topic == "busker/bridge/response/pause" {
                let answer: Value = serde_json::from_str(&message.payload).unwrap_or_default();
                self.answered = answer["transaction"].as_u64().unwrap_or_default();
                continue;
            }
            self.checker.message(now, &message.topic, &message.payload, &self.lines);
        }
        if now - self.sampled_at >= Duration::from_secs(1) {
            self.sampled_at = now;
            self.samples.push(Sample::of(self.busker.process(), (now - Time(0)).as_secs_f64()));
            if !self.busker.runs() {
                bail!("the program has ended; it said:\n{}", self.busker.log());
            }
        }
        if self.way == Way::Opening {
            if self.answered == self.questions {
                self.way = Way::Open;
            } else if now - self.asked_at >= Duration::from_secs(1) {
                // It was not there yet.
                self.ask()?;
            }
        }
        while let Some(at) = self.undo.iter().position(|(at, _)| *at <= now) {
            let (_, undo) = self.undo.swap_remove(at);
            self.undo(undo)?;
        }
        Ok(())
    }

    fn undo(&mut self, undo: Undo) -> anyhow::Result<()> {
        match undo {
            Undo::PlugIn(line) => self.lines[line].plug_in()?,
            Undo::Unmute(line) => self.lines[line].be_mute(false),
            Undo::Accept(line) => self.lines[line].refuse(false),
            Undo::OpenGate => {
                self.gate.open();
                self.way = Way::Opening;
                self.ask()?;
            }
        }
        Ok(())
    }

    fn later(&mut self, most_millis: u64, undo: Undo) {
        let time = Duration::from_millis(self.random.u64(50..most_millis));
        self.undo.push((self.clock.now() + time, undo));
    }

    fn count(&mut self, what: &'static str) {
        *self.happened.entry(what).or_default() += 1;
    }

    fn something_happens(&mut self) -> anyhow::Result<()> {
        let line = self.random.usize(..self.lines.len());
        let unit = UNITS[line][self.random.usize(..UNITS[line].len())];
        match self.random.u16(0..1000) {
            0..50 => {
                let kind = FAULTS[self.random.usize(..FAULTS.len())];
                let fault =
                    format!("unit={unit},{kind}").parse().map_err(|error: String| anyhow::anyhow!(error))?;
                self.lines[line].act(unit, &Action::Repair { unit })?;
                self.lines[line].act(unit, &Action::Fault(fault))?;
                self.count("faults of devices");
            }
            50..220 => self.lines[line].act(unit, &Action::Repair { unit })?,
            220..228 => {
                self.lines[line].act(unit, &Action::Power { unit, on: false })?;
                self.count("devices without power");
            }
            228..305 => self.lines[line].act(unit, &Action::Power { unit, on: true })?,
            305..320 => {
                self.lines[line].act(unit, &Action::Restart { unit })?;
                self.count("restarts of devices");
            }
            320..335 => self.lose_line(line),
            335..385 => {
                if self.lines[line].is_serial() {
                    let noise = (0..self.random.usize(1..40)).map(|_| self.random.u8(..)).collect();
                    self.lines[line].disturb(noise);
                    self.count("bursts of noise");
                }
            }
            385..391 => self.lose_broker(false)?,
            391..396 => self.lose_broker(true)?,
            396..450 => self.look_at_http()?,
            _ => {
                // A burst, as a slider gives it, or one.
                for _ in 0..if self.random.u8(..5) == 0 { 10 } else { 1 } {
                    self.command(line, unit)?;
                }
            }
        }
        Ok(())
    }

    fn lose_line(&mut self, line: usize) {
        if self.lines[line].is_serial() {
            let is_away = |(_, undo): &(Time, Undo)| matches!(undo, Undo::PlugIn(_));
            if !self.undo.iter().any(is_away) {
                self.lines[line].hang_up();
                self.later(5000, Undo::PlugIn(line));
                self.count("adapters pulled out");
            }
            return;
        }
        match self.random.u8(..3) {
            0 => {
                self.lines[line].be_mute(true);
                self.later(6000, Undo::Unmute(line));
                self.count("mute connections");
            }
            1 => {
                self.lines[line].refuse(true);
                self.later(4000, Undo::Accept(line));
                self.lines[line].hang_up();
                self.count("refused connections");
            }
            _ => {
                self.lines[line].hang_up();
                self.count("connections that ended");
            }
        }
    }

    /// The way to the broker ends, or the broker does with all that it remembers.
    fn lose_broker(&mut self, is_killed: bool) -> anyhow::Result<()> {
        if self.way != Way::Open {
            return Ok(());
        }
        self.synchronise()?;
        self.gate.close();
        self.way = Way::Closed;
        self.checker.closings += 1;
        // What the broker has got from the program before is still passed on.
        self.pass(Duration::from_millis(100))?;
        if is_killed {
            self.broker.start_anew()?;
            self.observer = Observer::start(self.broker.port, "#")?;
        }
        self.later(4000, Undo::OpenGate);
        self.count(if is_killed { "restarts of the broker" } else { "cuts of the way to the broker" });
        Ok(())
    }

    /// Waits until the program has got every command: what it answers at once comes behind them.
    fn synchronise(&mut self) -> anyhow::Result<()> {
        let from = self.clock.now();
        self.ask()?;
        while self.answered < self.questions {
            self.pass(Duration::from_millis(30))?;
            if self.clock.now() - from > Duration::from_secs(60) {
                bail!("the program answers nothing over MQTT; it said:\n{}", self.busker.log());
            }
        }
        Ok(())
    }

    /// Asks something that is answered without a look at any bus.
    fn ask(&mut self) -> anyhow::Result<()> {
        self.questions += 1;
        self.asked_at = self.clock.now();
        let question = json!({"bus": "nowhere", "for": "0s", "transaction": self.questions});
        self.observer.publish("busker/bridge/request/pause", &question.to_string())?;
        Ok(())
    }

    fn command(&mut self, line: usize, unit: u8) -> anyhow::Result<()> {
        if self.way != Way::Open {
            return Ok(());
        }
        let number = self.random.u16(..STORED);
        let store = match self.sequence < u16::MAX && self.random.u8(..4) > 0 {
            true => Store::Holding(number),
            false => Store::Coil(number),
        };
        let value = match store {
            Store::Holding(_) => {
                self.sequence += 1;
                self.sequence
            }
            Store::Coil(_) => self.random.u16(..2),
        };
        let (topic, wanted) =
            (points::topic(line, unit, Point::Stored(store)), points::payload(store, value));
        self.checker.command(self.clock.now(), &topic, store, &wanted);
        self.observer.publish(&format!("{topic}/set"), &wanted)?;
        Ok(())
    }

    fn look_at_http(&mut self) -> anyhow::Result<()> {
        let pages = ["/", "/health", "/metrics", "/api/devices", "/api/buses"];
        let page = pages[self.random.usize(..pages.len())];
        let agent: ureq::Agent = ureq::Agent::config_builder()
            .http_status_as_error(false)
            .timeout_global(Some(Duration::from_secs(20)))
            .build()
            .into();
        let mut answer = agent.get(format!("http://{}{page}", self.http)).call().context("HTTP answers")?;
        answer.body_mut().read_to_string().context("a page")?;
        self.count("looks at HTTP");
        Ok(())
    }

    /// The end of all faults.
    fn mend(&mut self) -> anyhow::Result<()> {
        for (_, undo) in std::mem::take(&mut self.undo) {
            self.undo(undo)?;
        }
        for (line, unit) in points::units() {
            self.lines[line].act(unit, &Action::Power { unit, on: true })?;
            self.lines[line].act(unit, &Action::Repair { unit })?;
        }
        Ok(())
    }

    fn wait_until_well(&mut self) -> anyhow::Result<()> {
        let from = self.clock.now();
        loop {
            self.pass(Duration::from_millis(100))?;
            let holds = |line: usize, unit: u8, store: Store| self.diaries[line].value(unit, store);
            match self.checker.is_well(self.clock.now(), holds) {
                Ok(()) => return Ok(()),
                Err(why) if self.clock.now() - from > WELL_WITHIN => {
                    bail!("all should be well again: {why}; the program said:\n{}", self.busker.log());
                }
                Err(_) => {}
            }
        }
    }

    fn since_start(&self, time: Time) -> f64 {
        (time - Time(0)).as_secs_f64()
    }

    fn progress(&self, passed: f64, of: f64) {
        let sample = self.samples.last().copied().unwrap_or_default();
        eprintln!(
            "[{passed:5.0} of {of:.0} s] {} values, {} commands, {} wrong; {:.1} MB, {} threads, {} descriptors",
            self.checker.values,
            self.checker.commands,
            self.checker.wrongs,
            sample.resident / 1e6,
            sample.threads,
            sample.descriptors,
        );
    }

    fn report(self, seconds: f64, well_after: Duration, growth: Growth) -> Report {
        let checker = &self.checker;
        let mut faults = checker.wrong.clone();
        faults.extend(growth.faults());
        let requests: u64 = self.lines.iter().map(|line| line.look(|log| log.requests)).sum();
        let late: u64 = self.lines.iter().map(|line| line.look(|log| log.late)).sum();
        let json = json!({
            "seconds": seconds,
            "requests": requests,
            "late_replies_sent": late,
            "values_checked": checker.values,
            "values_unknown": checker.nones,
            "commands": checker.commands,
            "outcomes": checker.kinds,
            "happened": self.happened,
            "well_again_after_seconds": well_after.as_secs_f64(),
            "growth": growth.json(),
            "wrong": faults,
        });
        let mut text = String::new();
        let mut line = |what: &str, value: String| {
            let _ = writeln!(text, "{what:34} {value}");
        };
        line("requests on the wire", requests.to_string());
        line("late replies sent", late.to_string());
        line("values checked", format!("{} ({} times `None`)", checker.values, checker.nones));
        line("commands", checker.commands.to_string());
        for (kind, count) in &checker.kinds {
            line(&format!("  outcome `{kind}`"), count.to_string());
        }
        for (what, count) in &self.happened {
            line(what, count.to_string());
        }
        line("all well again after", format!("{:.1} s", well_after.as_secs_f64()));
        line(
            "memory",
            format!(
                "{:+.0} kB along the line in {:.0} s ({:.1} to {:.1} MB)",
                growth.memory / 1024.0,
                growth.seconds,
                growth.first / 1e6,
                growth.last / 1e6
            ),
        );
        line("threads", format!("{} before, {} after", growth.threads.0, growth.threads.1));
        line("descriptors", format!("{} before, {} after", growth.descriptors.0, growth.descriptors.1));
        line("wrong", faults.len().to_string());
        Report { text, json, faults }
    }
}
