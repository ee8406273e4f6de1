//! The rows of the benchmark in their order, and what they share.

mod commands;
mod dead;
mod saturated;
mod scale;
mod tcp;

use std::time::Duration;

use crate::clock::sleep;
use crate::frames::Line;
use crate::machine::{self, Noise, Watch};
use crate::mqtt::Observer;
use crate::program::{Busker, Mosquitto};
use crate::report::{Figure, Growth, Report};
use crate::wire::{Behaviour, Transaction, Wire};

type Row = (&'static str, &'static str, fn(&mut Bench) -> anyhow::Result<()>);

pub const ROWS: &[Row] = &[
    ("W1", "19200 8E1, ten units with twenty registers each, as fast as possible", saturated::w1),
    ("W1-strict", "the same, with units that ignore a request without its silence", saturated::w1_strict),
    ("W2", "the same registers in four clusters of five, with gaps of three", saturated::w2),
    ("W3", "one unit of ten is dead", dead::w3),
    ("W4", "commands while polls saturate the bus", commands::w4),
    ("W5", "from the reply's last byte to the message at the subscriber", commands::w5),
    ("W6", "Modbus TCP, twenty devices with a hundred registers each", tcp::w6),
    ("W7", "ten units every ten seconds", saturated::w7),
    ("W8", "115200 8N1, turnaround 1 ms", saturated::w8),
    ("scale", "32 buses, 1,000 devices, 50,000 points in one process", scale::scale),
];

const W1_LINE: Line = Line::new(19_200, "even", 11);
const W1_TURNAROUND: Duration = Duration::from_millis(5);
const UNITS: u8 = 10;
const REGISTERS: usize = 20;
/// As fast as possible: the shortest period that a configuration may ask for.
const AT_ONCE: &str = "1ms";

/// What a row gets: how much time to take, and where its figures go.
pub struct Bench<'r> {
    quick: bool,
    report: &'r mut Report,
}

impl Bench<'_> {
    pub fn new(quick: bool, report: &mut Report) -> Bench<'_> {
        Bench { quick, report }
    }

    fn seconds(&self, full: u64, quick: u64) -> Duration {
        Duration::from_secs(if self.quick { quick } else { full })
    }

    fn runs(&self) -> usize {
        if self.quick { 1 } else { 3 }
    }

    fn tell(&mut self, noise: Noise, figures: impl IntoIterator<Item = Figure>) {
        self.report.figures.extend(figures.into_iter().map(|figure| Figure { noise, ..figure }));
    }

    fn grow(&mut self, growth: Growth) {
        self.report.growth.push(growth);
    }

    /// The row stays in the table, and says why there is nothing in it.
    pub fn failed(&mut self, row: &'static str, error: &anyhow::Error) {
        let why = format!("{error:#}").lines().next().unwrap_or_default().to_string();
        let figure = Figure::new(row, "the whole row", crate::report::Target::AtMost(0.0), "").remark(why);
        self.report.figures.push(figure);
    }
}

/// The program on a paced wire, with a broker and somebody who listens. Ended in this order.
struct Rig {
    busker: Busker,
    observer: Observer,
    mosquitto: Mosquitto,
    wire: Wire,
}

/// What is configured for each unit.
struct Configured<'c> {
    units: &'c [u8],
    points: &'c str,
    period: &'c str,
}

impl Rig {
    /// Returns when each of the first units, which answer, has been read three times.
    fn start(behaviour: Behaviour, configured: &Configured<'_>, dead: &[u8]) -> anyhow::Result<Rig> {
        let wire = Wire::start(behaviour)?;
        dead.iter().for_each(|unit| wire.set_dead(*unit, true));
        let mosquitto = Mosquitto::start()?;
        let observer = Observer::start(mosquitto.port, "busker/#")?;
        let Line { baud, parity, .. } = behaviour.line;
        let mut text = format!(
            "buses:\n  line: {{serial: {}, baud: {baud}, parity: {parity}, response_timeout: 500ms}}\ndevices:\n",
            wire.path().display()
        );
        for unit in configured.units {
            text += &format!(
                "  unit_{unit}: {{bus: line, unit: {unit}, poll: {{fast: {}}}, points: {{{}}}}}\n",
                configured.period, configured.points
            );
        }
        let busker = Busker::start(&mosquitto, &text)?;
        let mut rig = Rig { busker, observer, mosquitto, wire };
        let alive: Vec<u8> = configured.units.iter().copied().filter(|unit| !dead.contains(unit)).collect();
        let rounds = if configured.period == AT_ONCE { 3 } else { 1 };
        let wire = &rig.wire;
        let all_read = || {
            let reads = |unit: u8| wire.count(|seen| seen.unit == unit && seen.ended_at.is_some());
            alive.iter().all(|unit| reads(*unit) >= rounds)
        };
        rig.busker.wait(30.0, "each unit to be read", all_read)?;
        Ok(rig)
    }

    /// Seconds of processor time of all that belongs to the measurement.
    fn own(&self) -> f64 {
        machine::cpu_seconds(std::process::id()) + self.busker.cpu_seconds() + self.mosquitto.cpu_seconds()
    }

    /// What happens on the wire in this time, while the machine is watched.
    fn measure(&self, time: Duration) -> anyhow::Result<(Vec<Transaction>, Noise)> {
        self.wire.take();
        self.observer.take();
        let watch = Watch::start(self.own())?;
        sleep(time);
        let transactions = self.wire.take();
        Ok((transactions, watch.end(self.own())))
    }
}

/// Twenty points in clusters: one in `gapless`, with gaps of three registers between fives otherwise.
fn points(gapless: bool) -> (String, Vec<usize>) {
    let registers: Vec<usize> =
        (0..REGISTERS).map(|number| if gapless { number } else { number / 5 * 8 + number % 5 }).collect();
    let point = |(number, register): (usize, &usize)| {
        format!("p{number}: {{at: holding {register}, type: u16, poll: fast}}")
    };
    (registers.iter().enumerate().map(point).collect::<Vec<_>>().join(", "), registers)
}
