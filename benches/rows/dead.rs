//! W3: what a dead unit costs the others, and when it is back.

use std::time::Duration;

use anyhow::bail;

use super::{AT_ONCE, Bench, Configured, Rig, UNITS, W1_LINE, W1_TURNAROUND, points};
use crate::clock::{now, sleep};
use crate::report::{Figure, Target, quantile};
use crate::wire::{Behaviour, Transaction};

const DEAD: u8 = UNITS;

pub fn w3(bench: &mut Bench) -> anyhow::Result<()> {
    // How soon a unit begins to answer is known only where the adapter does not hold back its first bytes.
    let behaviour = Behaviour {
        line: W1_LINE,
        turnaround: W1_TURNAROUND,
        strict: false,
        counting: false,
        first_piece: Some(8),
    };
    let points = points(true).0;
    let units: Vec<u8> = (1..=UNITS).collect();
    let without: Vec<u8> = units.iter().copied().filter(|unit| *unit != DEAD).collect();

    let rig = Rig::start(behaviour, &Configured { units: &without, points: &points, period: AT_ONCE }, &[])?;
    let (transactions, noise) = rig.measure(bench.seconds(8, 4))?;
    let alone = cycle(&transactions.iter().collect::<Vec<_>>());
    drop(rig);

    // Known: it has answered before it died, so that a probe of it may be short.
    let configured = Configured { units: &units, points: &points, period: AT_ONCE };
    let mut rig = Rig::start(behaviour, &configured, &[])?;
    rig.wire.set_dead(DEAD, true);
    // Three requests in vain, and the pauses between probes have grown to their full length.
    sleep(bench.seconds(8, 6));
    let (transactions, noise_known) = rig.measure(bench.seconds(16, 8))?;
    let known = cycle(&whole_pauses(&transactions)?);
    let (back_known, known_by_mqtt) = revive(&mut rig, bench.runs())?;
    drop(rig);

    // Never heard of: every other probe waits for the whole response timeout, and pauses are long.
    let mut rig = Rig::start(behaviour, &configured, &[DEAD])?;
    sleep(bench.seconds(12, 12));
    let (transactions, noise_unknown) = rig.measure(bench.seconds(44, 33))?;
    let unknown = cycle(&whole_pauses(&transactions)?);
    let (back_unknown, _) = revive(&mut rig, 1)?;

    let cost = |cycle: f64| (cycle / alone - 1.0) * 100.0;
    let noise = noise.worse(noise_known).worse(noise_unknown);
    let figures = [
        Figure::new("W3", "live units' cycle, the dead one known: more by", Target::AtMost(3.0), " %")
            .reached([cost(known)]),
        Figure::new("W3", "live units' cycle, the dead one never heard: more by", Target::AtMost(3.0), " %")
            .reached([cost(unknown)]),
        Figure::new("W3", "back after its return, known", Target::AtMost(2.0), " s")
            .reached([quantile(&back_known, 1.0).unwrap_or(f64::INFINITY)])
            .remark(format!("the latest of {}; MQTT said so after {known_by_mqtt:.2} s", back_known.len())),
        Figure::new("W3", "back after its return, never heard", Target::AtMost(15.0), " s")
            .reached(back_unknown),
    ];
    bench.tell(noise, figures);
    Ok(())
}

/// What is between two requests to the dead unit, and an even number of pauses: each costs what a probe
/// takes, long or short, and a part of one would cost too much or nothing.
fn whole_pauses(transactions: &[Transaction]) -> anyhow::Result<Vec<&Transaction>> {
    let followed = transactions.iter().take(transactions.len().saturating_sub(1));
    let is_probe = |(at, seen): (usize, &Transaction)| (seen.unit == DEAD).then_some(at);
    let probes: Vec<usize> = followed.enumerate().filter_map(is_probe).collect();
    let pauses = probes.len().saturating_sub(1) / 2 * 2;
    let (Some(first), true) = (probes.first(), pauses > 0) else {
        bail!("the dead unit was asked {} times only", probes.len());
    };
    // Both live requests at the ends are the first ones after a probe.
    Ok(transactions[first + 1..].iter().take(probes[pauses] + 1 - first).collect())
}

/// The mean cycle of the units that answer, in nanoseconds, less what the wire itself was late. Rare long
/// interruptions count as what they are, so it is no median.
fn cycle(transactions: &[&Transaction]) -> f64 {
    let live: Vec<&&Transaction> = transactions.iter().filter(|seen| seen.unit != DEAD).collect();
    let (Some(first), Some(last)) = (live.first(), live.last()) else { return f64::INFINITY };
    let late: i64 = transactions.iter().map(|seen| seen.wire_late).sum();
    let rounds = (live.len() - 1) as f64 / f64::from(UNITS - 1);
    (last.heard_at - first.heard_at - late) as f64 / rounds
}

/// Lets the dead unit answer again, several times; returns after how many seconds it was asked and
/// answered each time, and when at the latest MQTT knew it.
fn revive(rig: &mut Rig, times: usize) -> anyhow::Result<(Vec<f64>, f64)> {
    let mut after = Vec::new();
    let mut told: f64 = 0.0;
    let topic = format!("busker/unit_{DEAD}/availability");
    for number in 1..=times {
        rig.wire.take();
        rig.observer.take();
        let returned_at = now();
        rig.wire.set_dead(DEAD, false);
        let wire = &rig.wire;
        let is_back = |seen: &Transaction| seen.unit == DEAD && seen.ended_at.is_some();
        rig.busker.wait(20.0, "the dead unit to be asked", || wire.count(is_back) > 0)?;
        let answered = rig.wire.take().into_iter().find(is_back).and_then(|seen| seen.ended_at);
        after.extend(answered.map(|at| (at - returned_at) as f64 / 1e9));
        let observer = &rig.observer;
        let mut online = None;
        rig.busker.wait(20.0, "the dead unit to be online", || {
            let found = observer
                .take()
                .into_iter()
                .find(|message| message.topic == topic && message.payload == "online");
            online = online.or(found.map(|message| message.at));
            online.is_some()
        })?;
        told = told.max(online.map_or(0.0, |at| (at - returned_at) as f64 / 1e9));
        if number < times {
            // Dies again, at another moment of the pauses.
            rig.wire.set_dead(DEAD, true);
            sleep(Duration::from_millis(6000 + 700 * number as u64));
        }
    }
    Ok((after, told))
}
