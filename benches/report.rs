//! What was reached, as a table, as JSON, and as `docs/performance.md`.

use std::fmt::Write;

use serde_json::{Value, json};

use crate::machine::Noise;

/// One figure of one row.
#[derive(Clone, Debug)]
pub struct Figure {
    pub row: &'static str,
    pub what: String,
    pub target: Target,
    pub unit: &'static str,
    /// Of each run, or of the only one; empty: not measured.
    pub runs: Vec<f64>,
    pub remark: String,
    pub noise: Noise,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Target {
    AtMost(f64),
    AtLeast(f64),
    Between(f64, f64),
    /// Only told.
    None,
}

impl Figure {
    pub fn new(row: &'static str, what: impl Into<String>, target: Target, unit: &'static str) -> Figure {
        let (runs, remark, noise) = (Vec::new(), String::new(), Noise::default());
        Figure { row, what: what.into(), target, unit, runs, remark, noise }
    }

    pub fn reached(mut self, runs: impl IntoIterator<Item = f64>) -> Figure {
        self.runs = runs.into_iter().collect();
        self
    }

    pub fn remark(mut self, remark: impl Into<String>) -> Figure {
        self.remark = remark.into();
        self
    }

    /// The median of the runs.
    pub fn value(&self) -> Option<f64> {
        median(&self.runs)
    }

    pub fn verdict(&self) -> &'static str {
        let Some(value) = self.value() else { return "not measured" };
        let good = match self.target {
            Target::AtMost(bound) => value <= bound,
            Target::AtLeast(bound) => value >= bound,
            Target::Between(least, most) => (least..=most).contains(&value),
            Target::None => return "",
        };
        match (good, self.noise.is_too_much()) {
            (true, _) => "pass",
            (false, false) => "MISS",
            (false, true) => "MISS (noisy)",
        }
    }

    fn target_text(&self) -> String {
        match self.target {
            Target::AtMost(bound) => format!("≤ {bound}{}", self.unit),
            Target::AtLeast(bound) => format!("≥ {bound}{}", self.unit),
            Target::Between(least, most) => format!("{least}–{most}{}", self.unit),
            Target::None => "–".into(),
        }
    }

    fn value_text(&self) -> String {
        self.value().map_or("–".into(), |value| format!("{}{}", short(value), self.unit))
    }

    fn spread_text(&self) -> String {
        match (least(&self.runs), greatest(&self.runs)) {
            (Some(least), Some(greatest)) if self.runs.len() > 1 => {
                format!("{}–{}", short(least), short(greatest))
            }
            _ => String::new(),
        }
    }

    fn json(&self) -> Value {
        let target = match self.target {
            Target::AtMost(bound) => json!({"kind": "at_most", "bound": bound}),
            Target::AtLeast(bound) => json!({"kind": "at_least", "bound": bound}),
            Target::Between(least, most) => json!({"kind": "between", "least": least, "most": most}),
            Target::None => json!({"kind": "none", "bound": null}),
        };
        json!({
            "row": self.row,
            "what": self.what,
            "target": target,
            "unit": self.unit.trim(),
            "reached": self.value(),
            "runs": self.runs,
            "verdict": self.verdict(),
            "remark": self.remark,
            "noise": self.noise.json(),
        })
    }
}

/// How cost grows: a line of the last table.
#[derive(Clone, Copy, Debug)]
pub struct Growth {
    pub buses: usize,
    pub devices: usize,
    pub points: usize,
    /// Registers of each point.
    pub words: usize,
    /// Bytes.
    pub resident: f64,
    pub cpu_per_million: f64,
    pub registers_per_second: f64,
    pub announced_after: f64,
}

/// Everything that a run brought.
#[derive(Default)]
pub struct Report {
    pub machine: String,
    pub commit: String,
    pub figures: Vec<Figure>,
    pub growth: Vec<Growth>,
}

impl Report {
    /// For a terminal.
    pub fn table(&self) -> String {
        let mut text = String::new();
        let mut row = "";
        for figure in &self.figures {
            let name = if figure.row == row { "" } else { figure.row };
            if !name.is_empty() {
                let _ = writeln!(text, "{name}  ({})", figure.noise);
            }
            row = figure.row;
            let (target, value) = (figure.target_text(), figure.value_text());
            let _ = write!(text, "    {:52} {target:>14} {value:>12}  {:13}", figure.what, figure.verdict());
            let _ = writeln!(text, " {}  {}", figure.spread_text(), figure.remark);
        }
        for growth in &self.growth {
            let _ = writeln!(text, "    {}", growth.text());
        }
        let _ = write!(text, "{}", self.summary());
        text
    }

    pub fn json(&self) -> Value {
        json!({
            "machine": self.machine,
            "commit": self.commit,
            "figures": self.figures.iter().map(Figure::json).collect::<Vec<_>>(),
            "growth": self.growth.iter().map(|growth| json!({
                "buses": growth.buses,
                "devices": growth.devices,
                "points": growth.points,
                "registers_a_point": growth.words,
                "resident_bytes": growth.resident,
                "cpu_seconds_per_million_registers": growth.cpu_per_million,
                "registers_per_second": growth.registers_per_second,
                "announced_after_seconds": growth.announced_after,
            })).collect::<Vec<_>>(),
        })
    }

    /// `docs/performance.md`
    pub fn document(&self) -> String {
        let mut text = String::from(INTRODUCTION);
        let _ = writeln!(text, "## The last full run\n\nOn {}; commit {}.\n", self.machine, self.commit);
        let _ = writeln!(text, "| row | figure | target | reached | | runs | remark |");
        let _ = writeln!(text, "|---|---|---|---|---|---|---|");
        for figure in &self.figures {
            let _ = writeln!(
                text,
                "| {} | {} | {} | {} | {} | {} | {} |",
                figure.row,
                figure.what,
                figure.target_text(),
                figure.value_text(),
                figure.verdict(),
                figure.spread_text(),
                figure.remark
            );
        }
        let _ = writeln!(text, "\n{}\n### What else the machine did\n", self.summary());
        let mut row = "";
        for figure in self.figures.iter().filter(|figure| !figure.runs.is_empty()) {
            if figure.row != row {
                let _ = writeln!(text, "* {}: {}", figure.row, figure.noise);
            }
            row = figure.row;
        }
        let _ = writeln!(text, "\n## How cost grows\n\n{GROWTH}");
        let _ = writeln!(
            text,
            "| buses | devices | points | registers a point | resident | kB a point | CPU s per million registers | registers a second | all announced after |"
        );
        let _ = writeln!(text, "|---|---|---|---|---|---|---|---|---|");
        for growth in &self.growth {
            let Growth { buses, devices, points, words, resident, cpu_per_million, .. } = growth;
            let _ = writeln!(
                text,
                "| {buses} | {devices} | {points} | {words} | {:.1} MB | {:.2} | {cpu_per_million:.3} | {:.0} | {:.2} s |",
                resident / 1e6,
                resident / 1e3 / *points as f64,
                growth.registers_per_second,
                growth.announced_after
            );
        }
        text
    }

    fn summary(&self) -> String {
        let count = |wanted: &str| self.figures.iter().filter(|figure| figure.verdict() == wanted).count();
        let misses = count("MISS") + count("MISS (noisy)");
        let with_target = self.figures.iter().filter(|figure| figure.target != Target::None).count();
        format!(
            "{} of {with_target} figures reach their target, {misses} miss it ({} of these while the machine was too noisy to tell), {} were not measured.\n",
            count("pass"),
            count("MISS (noisy)"),
            count("not measured"),
        )
    }
}

impl Growth {
    pub fn text(&self) -> String {
        format!(
            "{} buses, {} devices, {} points of {} words: {:.1} MB, {:.3} CPU s per million registers, {:.0} registers a second, announced after {:.2} s",
            self.buses,
            self.devices,
            self.points,
            self.words,
            self.resident / 1e6,
            self.cpu_per_million,
            self.registers_per_second,
            self.announced_after
        )
    }
}

const INTRODUCTION: &str = "\
# Performance

`make bench` writes this page after each full run; `make bench ROWS=W1,W8` and `make bench QUICK=1` only print \
their tables. All of it goes to `target/bench.json` as well.

The release build is measured against a paced wire: a thread on a pseudo-terminal that charges each character at \
its bit rate with start, parity and stop bits, and the device's turnaround, and that spins before each moment that \
matters. The silence before a request is looked at, not added. A figure is a ratio to what the wire needs at least \
for the same work, worked out from the specification's numbers, or to a bare loop of libmodbus that runs beside it. \
By how much the wire itself missed its times is taken off. What the pseudo-terminal needs to pass bytes on is not: \
real adapters take their time as well. Modbus TCP devices have processors of their own: what stands for them has a \
core for itself, and spins while a reply is due; the program, the broker and the bare loop share the others.

Where a row has several runs, the median counts, and all of them lie in the range beside it. Each row tells how \
late a thread woke meanwhile that slept as the program does, and how much of the machine others took; a miss \
while that was too much is called noisy.

";

const GROWTH: &str = "\
Modbus TCP devices that answer after a millisecond, polled as fast as possible; a register of each device changes \
once a second. Memory is what is resident after the first rounds.
";

pub fn median(values: &[f64]) -> Option<f64> {
    quantile(values, 0.5)
}

/// The value below which so much of them lies.
pub fn quantile(values: &[f64], share: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let at = share * sorted.len().checked_sub(1)? as f64;
    let (below, above) = (sorted[at.floor() as usize], sorted[at.ceil() as usize]);
    Some(below + (above - below) * at.fract())
}

pub fn greatest(values: &[f64]) -> Option<f64> {
    values.iter().copied().reduce(f64::max)
}

fn least(values: &[f64]) -> Option<f64> {
    values.iter().copied().reduce(f64::min)
}

/// Four digits, and whole numbers as they are.
fn short(value: f64) -> String {
    match value.abs() {
        size if size >= 1000.0 || value.fract() == 0.0 => format!("{value:.0}"),
        size if size >= 100.0 => format!("{value:.1}"),
        size if size >= 10.0 => format!("{value:.2}"),
        size if size >= 0.1 => format!("{value:.4}"),
        _ => format!("{value:.5}"),
    }
}
