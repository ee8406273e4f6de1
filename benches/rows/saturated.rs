//! W1, W2, W8: a serial line as busy as it can be; and W7, where it is not.

use std::time::Duration;

use anyhow::Context;

use super::{AT_ONCE, Bench, Configured, REGISTERS, Rig, UNITS, W1_LINE, W1_TURNAROUND, points};
use crate::clock::sleep;
use crate::frames::Line;
use crate::machine::Noise;
use crate::report::{Figure, Target, greatest, median};
use crate::wire::{Behaviour, Transaction};

const W1: Behaviour =
    Behaviour { line: W1_LINE, turnaround: W1_TURNAROUND, strict: false, counting: false, first_piece: None };

pub fn w1(bench: &mut Bench) -> anyhow::Result<()> {
    let measured = run(bench, "W1", W1, true)?;
    let noise = measured.noise;
    let figures = [
        measured.ratio("W1", 1.01),
        measured.violations("W1"),
        Figure::new("W1", "longest wait of a unit, in cycles", Target::AtMost(1.1), "")
            .reached(measured.waits.clone()),
        measured.forecast("W1"),
    ];
    bench.tell(noise, figures);
    Ok(())
}

pub fn w1_strict(bench: &mut Bench) -> anyhow::Result<()> {
    let measured = run(bench, "W1-strict", Behaviour { strict: true, ..W1 }, true)?;
    let figures = [measured.ratio("W1-strict", 1.01), measured.violations("W1-strict")];
    bench.tell(measured.noise, figures);
    Ok(())
}

pub fn w2(bench: &mut Bench) -> anyhow::Result<()> {
    let measured = run(bench, "W2", W1, false)?;
    let figures = [measured.ratio("W2", 1.03), measured.violations("W2"), measured.forecast("W2")];
    bench.tell(measured.noise, figures);
    Ok(())
}

pub fn w8(bench: &mut Bench) -> anyhow::Result<()> {
    let line = Line::new(115_200, "none", 10);
    let behaviour = Behaviour { line, turnaround: Duration::from_millis(1), ..W1 };
    let measured = run(bench, "W8", behaviour, true)?;
    let figures = [measured.ratio("W8", 1.03), measured.violations("W8"), measured.forecast("W8")];
    bench.tell(measured.noise, figures);
    Ok(())
}

pub fn w7(bench: &mut Bench) -> anyhow::Result<()> {
    let units: Vec<u8> = (1..=UNITS).collect();
    let points = points(true).0;
    let rig = Rig::start(W1, &Configured { units: &units, points: &points, period: "10s" }, &[])?;
    sleep(bench.seconds(8, 2));
    let time = bench.seconds(60, 20);
    let before = rig.busker.cpu_seconds();
    let (transactions, noise) = rig.measure(time)?;
    let share = (rig.busker.cpu_seconds() - before) / time.as_secs_f64() * 100.0;
    let resident = rig.busker.resident() / 1e6;
    let check = rig.busker.check("W7", W1.turnaround)?;
    let load = check["buses"][0]["load"].as_f64().context("`busker check` tells no load")?;
    let of_request = W1.line.read(REGISTERS, W1.turnaround) as f64 / 1e9;
    let busy = transactions.len() as f64 * of_request / time.as_secs_f64();
    let figures =
        [
            Figure::new("W7", "load as `busker check` says ÷ measured", Target::Between(0.95, 1.05), "")
                .reached([load / busy])
                .remark("`target/bench/W7.yaml`"),
            Figure::new("W7", "share of a core", Target::AtMost(0.03), " %")
                .reached([share])
                .remark(format!("{} requests in {} s", transactions.len(), time.as_secs())),
            Figure::new("W7", "resident memory", Target::AtMost(7.0), " MB").reached([resident]),
        ];
    bench.tell(noise, figures);
    Ok(())
}

/// What several runs brought, a value for each.
#[derive(Default)]
struct Measured {
    ratios: Vec<f64>,
    means: Vec<f64>,
    waits: Vec<f64>,
    violations: Vec<f64>,
    cpu: Vec<f64>,
    /// What `busker check` says of the cycle, ÷ the cycle.
    forecasts: Vec<f64>,
    shortest: f64,
    unheard: usize,
    noise: Noise,
}

impl Measured {
    fn ratio(&self, row: &'static str, target: f64) -> Figure {
        let mean = median(&self.means).unwrap_or_default();
        let cpu = median(&self.cpu).unwrap_or_default();
        let unheard = match self.unheard {
            0 => String::new(),
            count => format!("; {count} requests unanswered"),
        };
        Figure::new(row, "cycle ÷ wire minimum", Target::AtMost(target), "")
            .reached(self.ratios.clone())
            .remark(format!("mean cycle {mean:.4}; {cpu:.2} % of a core{unheard}"))
    }

    /// `busker check` on this row's configuration.
    fn forecast(&self, row: &'static str) -> Figure {
        Figure::new(row, "forecast of `busker check` ÷ cycle", Target::Between(0.95, 1.05), "")
            .reached(self.forecasts.clone())
            .remark(format!("`target/bench/{row}.yaml`"))
    }

    fn violations(&self, row: &'static str) -> Figure {
        let worst = greatest(&self.violations).unwrap_or_default();
        Figure::new(row, "requests without their silence", Target::AtMost(0.0), "")
            .reached([worst])
            .remark(format!("the shortest was {:.0} µs more than needed", self.shortest))
    }
}

/// Several runs, each with a program of its own.
fn run(bench: &Bench, row: &'static str, behaviour: Behaviour, gapless: bool) -> anyhow::Result<Measured> {
    let units: Vec<u8> = (1..=UNITS).collect();
    let (points, registers) = points(gapless);
    let optimum = match gapless {
        true => behaviour.line.read(REGISTERS, behaviour.turnaround),
        false => behaviour.line.read_at_best(&registers, behaviour.turnaround),
    };
    let mut measured = Measured { shortest: f64::MAX, ..Measured::default() };
    for _ in 0..bench.runs() {
        let configured = Configured { units: &units, points: &points, period: AT_ONCE };
        let rig = Rig::start(behaviour, &configured, &[])?;
        let time = bench.seconds(5, 3);
        let before = rig.busker.cpu_seconds();
        let (transactions, noise) = rig.measure(time)?;
        let cpu = rig.busker.cpu_seconds() - before;
        measured.cpu.push(cpu / time.as_secs_f64() * 100.0);
        measured.noise = measured.noise.worse(noise);
        let minimum = (optimum * units.len() as i64) as f64;
        let cycles: Vec<f64> = cycles(&transactions).iter().map(|cycle| *cycle as f64).collect();
        let cycle = median(&cycles).unwrap_or(f64::INFINITY);
        measured.ratios.push(cycle / minimum);
        measured.means.push(cycles.iter().sum::<f64>() / cycles.len() as f64 / minimum);
        let check = rig.busker.check(row, behaviour.turnaround)?;
        let fast = &check["buses"][0]["devices"][0]["polls"]["fast"];
        let forecast = fast["real_period"].as_f64().context("`busker check` tells no period")?;
        measured.forecasts.push(forecast * 1e9 / cycle);
        measured.waits.push(longest_wait(&transactions) as f64 / cycle);
        let silence = behaviour.line.silence();
        let spare: Vec<i64> =
            transactions.iter().filter_map(|seen| seen.silence).map(|found| found - silence).collect();
        let violations = spare.iter().filter(|spare| **spare < 0).count() as u64 + rig.wire.collisions();
        measured.violations.push((violations + rig.wire.damaged()) as f64);
        measured.shortest = measured.shortest.min(spare.iter().min().map_or(0.0, |ns| *ns as f64 / 1e3));
        measured.unheard += transactions.iter().filter(|seen| seen.ended_at.is_none()).count();
    }
    Ok(measured)
}

/// From one read of the first place to its next, less what the wire itself was late.
fn cycles(transactions: &[Transaction]) -> Vec<i64> {
    let Some(first) = transactions.first() else { return Vec::new() };
    let (mut began, mut late, mut cycles) = (None, 0, Vec::new());
    for seen in transactions {
        if seen.unit == first.unit && seen.address == first.address && seen.function == first.function {
            cycles.extend(began.map(|began| seen.heard_at - began - late));
            (began, late) = (Some(seen.heard_at), 0);
        }
        late += seen.wire_late;
    }
    cycles
}

fn longest_wait(transactions: &[Transaction]) -> i64 {
    let mut last = [None; 256];
    let mut longest = 0;
    for seen in transactions {
        if let Some(before) = last[usize::from(seen.unit)].replace(seen.heard_at) {
            longest = longest.max(seen.heard_at - before);
        }
    }
    longest
}
