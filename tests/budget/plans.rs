//! Reads are planned anew when a device answers much later, or sooner, than they were planned for.

use std::collections::BTreeMap;

use busker::engine::time::{Duration, Time};

use super::wire::Wire;

/// Two clusters with a gap that is worth reading over only for a slow device, another of the slow polls
/// far away, and what is read once.
const CONFIGURATION: &str = "\
buses:
  line: {serial: /dev/serial/by-id/usb-A, baud: 19200, parity: even, response_timeout: 500ms}
devices:
  meter:
    bus: line
    unit: 1
    poll: {fast: 400ms, slow: 2s}
    points:
      near: {at: holding 0, type: u16, poll: fast}
      far: {at: holding 16, type: u16, poll: fast}
      once: {at: holding 300, type: u16, poll: once}
      quiet: {at: holding 200, type: u16, poll: slow}
      quieter: {at: holding 216, type: u16, poll: slow}
";

struct Life {
    wire: Wire,
    /// How often each register has been read.
    reads: BTreeMap<u16, usize>,
}

impl Life {
    /// Lets time pass, in which the device answers after so many milliseconds; each register must be
    /// read in its time. Returns the reads, by their first and last register.
    fn pass(&mut self, seconds: u64, turnaround: u64) -> Vec<(u16, u16)> {
        self.wire.set_turnaround(Duration::from_millis(turnaround));
        self.wire.asked.retain(|asked| self.wire.now.since(asked.at) < Duration::from_secs(3));
        self.wire.run_until(self.wire.now + Duration::from_secs(seconds));
        for (register, most) in [(0, 600), (16, 600), (200, 2_400), (216, 2_400)] {
            let holds = |asked: &&super::wire::Asked| {
                asked.function == 3 && (asked.address..asked.address + asked.argument).contains(&register)
            };
            let times: Vec<Time> = self.wire.asked.iter().filter(holds).map(|asked| asked.at).collect();
            self.reads.insert(register, times.len());
            for pair in times.windows(2) {
                let apart = pair[1].since(pair[0]);
                assert!(apart <= Duration::from_millis(most), "{register} at {}: {apart:?}", pair[1]);
            }
        }
        let mut last: Vec<(u16, u16)> = self
            .wire
            .asked
            .iter()
            .filter(|asked| self.wire.now.since(asked.at) < Duration::from_secs(3))
            .map(|asked| (asked.address, asked.address + asked.argument - 1))
            .collect();
        last.sort_unstable();
        last.dedup();
        last
    }

    fn says(&self, point: &str) -> &str {
        &self.wire.published[&format!("busker/meter/{point}")]
    }
}

#[test]
fn a_plan_follows_the_device_and_loses_no_reading() {
    let wire = Wire::new(CONFIGURATION, Duration::from_millis(5));
    let mut life = Life { wire, reads: BTreeMap::new() };
    let apart = [(0, 0), (16, 16), (200, 200), (216, 216)];
    let together = [(0, 16), (200, 216)];

    life.wire.hold(1, 0, 1);
    assert_eq!(life.pass(60, 5), apart);
    assert_eq!(life.says("near"), "1");
    // What is not far from usual changes nothing.
    assert_eq!(life.pass(60, 9), apart);
    assert!(life.wire.said.is_empty(), "{:?}", life.wire.said);

    life.wire.hold(1, 0, 2);
    assert_eq!(life.pass(60, 60), together);
    assert_eq!(life.says("near"), "2");
    assert_eq!(life.wire.said.len(), 1, "{:?}", life.wire.said);
    assert!(life.wire.said[0].ends_with("and is read with 3 requests instead of 5"), "{:?}", life.wire.said);
    // Once it is known, nothing goes to and fro.
    assert_eq!(life.pass(120, 45), together);
    assert_eq!(life.pass(120, 90), together);
    assert_eq!(life.wire.said.len(), 1, "{:?}", life.wire.said);

    // What the single read brought long ago, and brings again, is news: meanwhile it was another value.
    life.wire.hold(1, 0, 1);
    assert_eq!(life.pass(120, 4), apart);
    assert_eq!(life.says("near"), "1");
    assert_eq!(life.wire.said.len(), 2, "{:?}", life.wire.said);
    // What is read once is not read again for it.
    let once = life.wire.ever.iter().filter(|asked| asked.address == 300).count();
    assert_eq!(once, 1);
}

#[test]
fn what_a_device_refuses_stays_refused_whatever_the_plan() {
    let mut wire = Wire::new(CONFIGURATION, Duration::from_millis(60));
    // No read over the gap, which the device does not have.
    wire.forbid(1, 8);
    wire.run_until(Time::from_millis(120_000));
    let is_over_gap = |asked: &&super::wire::Asked| asked.address == 0 && asked.argument > 1;
    let refused = wire.ever.iter().filter(is_over_gap).count();
    assert_eq!(refused, 1, "{:?}", wire.said);
    let before = wire.ever.len();
    wire.run_until(Time::from_millis(180_000));
    assert_eq!(wire.ever[before..].iter().filter(is_over_gap).count(), 0);
    assert!(wire.ever[before..].iter().any(|asked| asked.address == 200 && asked.argument == 17));
    assert_eq!(wire.published["busker/meter/near"], "0");
    assert_eq!(wire.published["busker/meter/far"], "0");
}

#[test]
fn while_a_register_is_refused_it_gets_no_new_neighbours() {
    let mut wire = Wire::new(CONFIGURATION, Duration::from_millis(5));
    wire.fail(1, 16);
    wire.run_until(Time::from_millis(10_000));
    wire.set_turnaround(Duration::from_millis(60));
    wire.run_until(Time::from_millis(200_000));
    assert_eq!(wire.published["busker/meter/far"], "None");
    assert_eq!(wire.published["busker/meter/near"], "0", "it has not been taken along");
}

#[test]
fn where_a_device_wants_silence_reading_over_a_gap_pays_sooner_unless_others_need_the_line() {
    for (others, expected) in [(0, vec![(0, 40)]), (6, vec![(0, 0), (40, 40)])] {
        let mut configuration = String::from(
            "buses:\n  line: {serial: /dev/serial/by-id/usb-A, baud: 19200, parity: even}\ndevices:\n  \
             slow: {bus: line, unit: 1, poll: {fast: 400ms}, points: {near: {at: holding 0, poll: fast}, \
             far: {at: holding 40, poll: fast}}, wire: {limits: {delay: 100ms}}}\n",
        );
        for unit in 2..others + 2 {
            configuration += &format!(
                "  unit_{unit}: {{bus: line, unit: {unit}, poll: {{fast: 100ms}}, points: {{p: {{at: holding 0, \
                 poll: fast}}}}}}\n"
            );
        }
        let mut wire = Wire::new(&configuration, Duration::from_millis(5));
        wire.run_until(Time::from_millis(20_000));
        let of_slow = wire.ever.iter().filter(|asked| asked.unit == 1);
        let mut reads: Vec<(u16, u16)> =
            of_slow.map(|asked| (asked.address, asked.address + asked.argument - 1)).collect();
        reads.sort_unstable();
        reads.dedup();
        assert_eq!(reads, expected, "with {others} others");
    }
}
