//! W4 and W5: the way between MQTT and the wire, in both directions.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::Context;

use super::{AT_ONCE, Bench, Configured, REGISTERS, Rig, UNITS, W1_LINE, W1_TURNAROUND, points};
use crate::clock::{sleep, sleep_until};
use crate::machine::Watch;
use crate::report::{Figure, Target, greatest, median, quantile};
use crate::wire::{Behaviour, Transaction};

const W1: Behaviour =
    Behaviour { line: W1_LINE, turnaround: W1_TURNAROUND, strict: false, counting: false, first_piece: None };

/// Before the moment of a command is chosen: by then the one before has had its outcome, since a transaction in flight,
/// its write and the poll that reads it back take 91 ms.
const PAUSE: Duration = Duration::from_millis(100);

pub fn w4(bench: &mut Bench) -> anyhow::Result<()> {
    let units: Vec<u8> = (1..=UNITS).collect();
    let points = points(true).0.replacen("poll: fast", "poll: fast, write: 0..65535", 1);
    let mut rig = Rig::start(W1, &Configured { units: &units, points: &points, period: AT_ONCE }, &[])?;
    let transaction = from_one_to_the_next(&rig.wire.take()).context("the bus is not saturated")?;
    rig.observer.take();
    let watch = Watch::start(rig.own())?;
    let mut sent: BTreeMap<u16, i64> = BTreeMap::new();
    for phase in phases(if bench.quick { 128 } else { 512 }) {
        sleep(PAUSE);
        let wire = &rig.wire;
        let last_read = || wire.last().filter(|seen| seen.function == 3);
        rig.busker.wait(5.0, "a read behind the last command", || last_read().is_some())?;
        let last = last_read().context("nothing is asked any more")?;
        // The request behind the one that is in flight now, or will be at once, begins two transactions later.
        let moment = last.heard_at + 2 * transaction + (phase * transaction as f64) as i64;
        sleep_until(moment);
        let value = 2000 + sent.len() as u16;
        let unit = sent.len() % units.len() + 1;
        let at = rig.observer.publish(&format!("busker/unit_{unit}/p0/set"), &value.to_string())?;
        sent.insert(value, at);
    }
    // The last ones may still be on their way.
    sleep(Duration::from_secs(1));
    let transactions = rig.wire.take();
    let noise = watch.end(rig.own());

    let writes: Vec<_> = transactions.iter().filter(|seen| matches!(seen.function, 6 | 16)).collect();
    let mut latencies = Vec::new();
    let mut lost = 0;
    for (value, sent_at) in &sent {
        let mut matching = writes.iter().filter(|seen| seen.argument == *value);
        match matching.next() {
            Some(seen) => latencies.push((seen.heard_at - sent_at) as f64 / 1e6),
            None => lost += 1,
        }
        // A command that is written twice is as bad as none.
        lost += matching.count();
    }
    let messages = rig.observer.take();
    let done = messages
        .iter()
        .filter(|message| message.topic.ends_with("/outcome") && message.payload.contains("\"done\""))
        .count();
    // The observer is told of each command by the broker when the gateway is: from there on it waits.
    let passed_on: BTreeMap<u16, i64> = messages
        .iter()
        .filter(|message| message.topic.ends_with("/set"))
        .filter_map(|message| Some((message.payload.parse().ok()?, message.at)))
        .collect();
    let waits: Vec<f64> = writes
        .iter()
        .filter_map(|seen| Some((seen.heard_at - passed_on.get(&seen.argument)?) as f64 / 1e6))
        .collect();
    let ways: Vec<f64> =
        sent.iter().filter_map(|(value, at)| Some((passed_on.get(value)? - at) as f64 / 1e6)).collect();
    let silence = W1_LINE.silence();
    let violations =
        transactions.iter().filter_map(|seen| seen.silence).filter(|found| *found < silence).count() as u64;
    let collisions = (violations + rig.wire.collisions() + rig.wire.damaged()) as f64;

    // What is left to the polls when each command takes its write, and nothing else. Of all units: one that was written
    // to is read sooner for that, and others later.
    let (last, done_before) = transactions.split_last().context("nothing was asked")?;
    let first = done_before.first().context("only one thing was asked")?;
    let late: i64 = done_before.iter().map(|seen| seen.wire_late).sum();
    let elapsed = (last.heard_at - first.heard_at - late) as f64;
    let of = |function: u8| done_before.iter().filter(|seen| seen.function == function).count() as f64;
    let mean = elapsed * f64::from(UNITS) / of(3);
    let of_writes = (of(6) + of(16)) * W1_LINE.write(W1_TURNAROUND) as f64;
    let minimum = (W1_LINE.read(REGISTERS, W1_TURNAROUND) * i64::from(UNITS)) as f64;
    let ratio = mean / (minimum * elapsed / (elapsed - of_writes));
    let extra = transactions
        .iter()
        .filter(|seen| seen.function == 3 && usize::from(seen.argument) != REGISTERS)
        .count();

    let check = rig.busker.check("W4", W1_TURNAROUND)?;
    let forecast = check["buses"][0]["command_wait"].as_f64().context("`busker check` tells no wait")?;
    let count = sent.len();
    let late = quantile(&latencies, 0.95).unwrap_or(f64::INFINITY);
    let figures = [
        Figure::new("W4", "command to its first byte, p50", Target::AtMost(19.0), " ms")
            .reached(median(&latencies))
            .remark(format!(
                "{count} commands; a transaction takes {:.2} ms, the way through the broker {:.2}",
                transaction as f64 / 1e6,
                median(&ways).unwrap_or_default()
            )),
        Figure::new("W4", "command to its first byte, p95", Target::AtMost(36.0), " ms")
            .reached([late])
            .remark(format!("the latest {:.1} ms", greatest(&latencies).unwrap_or_default())),
        Figure::new("W4", "worst wait as `busker check` says ÷ the longest", Target::Between(0.95, 1.05), "")
            .reached([forecast * 1e3 / greatest(&waits).unwrap_or(f64::INFINITY)])
            .remark(format!(
                "without the way through the broker, at most {:.1} ms; `target/bench/W4.yaml`",
                greatest(&ways).unwrap_or_default()
            )),
        Figure::new("W4", "commands lost or written twice", Target::AtMost(0.0), "")
            .reached([lost as f64])
            .remark(format!("{done} of {count} outcomes say `done`")),
        Figure::new("W4", "collisions, requests without their silence", Target::AtMost(0.0), "")
            .reached([collisions]),
        Figure::new("W4", "cycle ÷ what the commands leave", Target::AtMost(1.02), "")
            .reached([ratio])
            .remark(format!("{extra} reads beside the polls")),
    ];
    bench.tell(noise, figures);
    Ok(())
}

/// How long a transaction takes on this wire with all that belongs to it: from the first byte of a read to that of the
/// next one, usually.
fn from_one_to_the_next(transactions: &[Transaction]) -> Option<i64> {
    let times = transactions.windows(2).map(|pair| (pair[1].heard_at - pair[0].heard_at) as f64);
    median(&times.collect::<Vec<_>>()).map(|time| time as i64)
}

/// Where in a transaction each of so many commands comes: every one in a slice of its own, so that all of it is covered
/// evenly and once, and neighbours in time are far apart. By chance, the median of some hundred commands would be more
/// than a millisecond beside what it is. The number is a power of two.
fn phases(count: u32) -> impl Iterator<Item = f64> {
    let slice = 1.0 / f64::from(count);
    let reversed = move |number: u32| f64::from(number.reverse_bits()) / (f64::from(u32::MAX) + 1.0);
    (0..count).map(move |number| reversed(number) + slice / 2.0)
}

pub fn w5(bench: &mut Bench) -> anyhow::Result<()> {
    let units: Vec<u8> = (1..=UNITS).collect();
    let points = points(true).0;
    let mut halves = Vec::new();
    let mut tenths = Vec::new();
    let mut count = 0;
    let mut missing = 0;
    let mut noise = crate::machine::Noise::default();
    for _ in 0..bench.runs() {
        let configured = Configured { units: &units, points: &points, period: AT_ONCE };
        let rig = Rig::start(Behaviour { counting: true, ..W1 }, &configured, &[])?;
        let (transactions, of_run) = rig.measure(bench.seconds(6, 4))?;
        sleep(Duration::from_millis(200));
        let heard: BTreeMap<(String, String), i64> = rig
            .observer
            .take()
            .into_iter()
            .map(|message| ((message.topic, message.payload), message.at))
            .collect();
        let mut latencies = Vec::new();
        for seen in &transactions {
            let (Some(told), Some(ended_at)) = (seen.told, seen.ended_at) else { continue };
            match heard.get(&(format!("busker/unit_{}/p0", seen.unit), told.to_string())) {
                Some(at) => latencies.push((at - ended_at) as f64 / 1e6),
                None => missing += 1,
            }
        }
        count += latencies.len();
        halves.extend(median(&latencies));
        tenths.extend(quantile(&latencies, 0.9));
        noise = noise.worse(of_run);
    }
    let figures = [
        Figure::new("W5", "last byte to message, p50", Target::AtMost(0.6), " ms")
            .reached(halves)
            .remark(format!("{count} messages, {missing} missing")),
        Figure::new("W5", "last byte to message, p90", Target::None, " ms").reached(tenths),
    ];
    bench.tell(noise, figures);
    Ok(())
}
