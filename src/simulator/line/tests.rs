//! Devices on one line: addresses, power, faults and times.

use super::*;
use crate::simulator::device::Model;
use crate::simulator::script::parse_line;

struct Table {
    line: Line,
    now: Time,
    framing: Framing,
}

impl Table {
    fn new(framing: Framing) -> Table {
        let devices = [(Model::MrDo4, 18), (Model::MrSi4, 20)].map(|(model, unit)| DeviceAt { model, unit });
        let line = Line::new(Time(0), LineSettings::default(), Duration::from_millis(5), false, &devices);
        Table { line: line.expect("different units"), now: Time::from_millis(100), framing }
    }

    fn act(&mut self, command: &str) {
        let step = parse_line(command).expect("a command").expect("not empty");
        self.line.act(self.now, &step.action).expect("a unit of this line");
    }

    fn ask(&mut self, unit: u8, pdu: &[u8]) -> Vec<Transmission> {
        let frame = Frame { transaction: 7, unit, pdu: pdu.to_vec() };
        self.line.hear(self.now, self.framing, &Received::Frame(frame), None)
    }
}

fn rtu(unit: u8, pdu: &[u8]) -> Vec<u8> {
    Frame { transaction: 0, unit, pdu: pdu.to_vec() }.encode(Framing::Rtu)
}

const READ_COILS: [u8; 5] = [1, 0, 0, 0, 4];

#[test]
fn each_device_answers_its_own_unit_only_after_the_turnaround() {
    let mut table = Table::new(Framing::Rtu);
    let transmissions = table.ask(18, &READ_COILS);
    assert_eq!(transmissions, [Transmission { at: Time::from_millis(105), bytes: rtu(18, &[1, 1, 0]) }]);
    assert_eq!(table.ask(20, &READ_COILS)[0].bytes, rtu(20, &[0x81, 1]));
    assert_eq!(table.ask(19, &READ_COILS), []);
}

#[test]
fn unit_0_is_obeyed_by_all_and_answered_by_none_on_a_serial_line() {
    let mut table = Table::new(Framing::Rtu);
    assert_eq!(table.ask(0, &[5, 0, 0, 0xFF, 0]), []);
    assert_eq!(table.ask(18, &READ_COILS)[0].bytes, rtu(18, &[1, 1, 1]));
    let mut table = Table::new(Framing::Tcp);
    assert_eq!(table.ask(0, &[5, 0, 0, 0xFF, 0])[0].bytes, [0, 7, 0, 0, 0, 3, 0, 0x85, 0x0B]);
}

#[test]
fn on_modbus_tcp_a_unit_that_is_not_there_is_answered_by_its_gateway() {
    let mut table = Table::new(Framing::Tcp);
    assert_eq!(table.ask(19, &READ_COILS)[0].bytes, [0, 7, 0, 0, 0, 3, 19, 0x81, 0x0B]);
    assert_eq!(table.ask(18, &READ_COILS)[0].bytes, [0, 7, 0, 0, 0, 4, 18, 1, 1, 0]);
}

#[test]
fn a_device_without_power_or_with_other_line_settings_hears_nothing() {
    let mut table = Table::new(Framing::Rtu);
    table.ask(18, &[6, 0, 1, 0, 8]);
    table.act("unit 18 power off");
    assert_eq!(table.ask(18, &READ_COILS), []);
    table.act("unit 18 power on");
    assert_eq!(table.ask(18, &READ_COILS)[0].bytes, rtu(18, &[1, 1, 8]));
    // The answer to the change still comes with the old settings (page 4).
    assert_eq!(table.ask(18, &[6, 0, 65, 0x53, 0x38])[0].bytes, rtu(18, &[6, 0, 65, 0x53, 0x38]));
    assert_eq!(table.ask(18, &READ_COILS), []);
}

#[test]
fn a_restart_on_request_is_followed_by_two_seconds_of_silence() {
    let mut table = Table::new(Framing::Rtu);
    table.act("unit 18 restart");
    table.now += Duration::from_millis(1999);
    assert_eq!(table.ask(18, &READ_COILS), []);
    table.now += Duration::from_millis(1);
    assert_eq!(table.ask(18, &READ_COILS).len(), 1);
}

#[test]
fn a_damaged_frame_is_counted_by_every_device_and_answered_by_none() {
    let mut table = Table::new(Framing::Rtu);
    assert_eq!(table.line.hear(table.now, Framing::Rtu, &Received::Damaged, None), []);
    assert_eq!(table.ask(20, &[8, 0, 12, 0, 0])[0].bytes, rtu(20, &[8, 0, 12, 0, 1]));
}

#[test]
fn faults_spoil_the_replies_of_their_unit_and_of_no_other() {
    let good = rtu(18, &[1, 1, 0]);
    let mut garbled = good.clone();
    garbled[3] ^= 0x10;
    let at = |millis| Time::from_millis(millis);
    for (fault, expected) in [
        ("silent", vec![]),
        ("slow=50ms", vec![(at(155), good.clone())]),
        ("late=1s", vec![(at(1105), good.clone())]),
        ("garbled", vec![(at(105), garbled)]),
        ("short", vec![(at(105), good[..4].to_vec())]),
        ("leading-zero", vec![(at(105), [&[0][..], &good].concat())]),
        ("echo", vec![(at(105), [rtu(18, &READ_COILS), good.clone()].concat())]),
        ("other-unit", vec![(at(105), rtu(19, &[1, 1, 0]))]),
        ("exception=6", vec![(at(105), rtu(18, &[0x81, 6]))]),
        ("silent,every=2", vec![(at(105), good.clone())]),
        (
            "dribble=2ms",
            good.iter().enumerate().map(|(n, byte)| (at(105 + 2 * n as u64), vec![*byte])).collect(),
        ),
    ] {
        let mut table = Table::new(Framing::Rtu);
        table.act(&format!("unit 18 fault {fault}"));
        let told: Vec<_> = table.ask(18, &READ_COILS).into_iter().map(|sent| (sent.at, sent.bytes)).collect();
        assert_eq!(told, expected, "{fault}");
        assert_eq!(table.ask(20, &[2, 0, 0, 0, 4])[0].bytes, rtu(20, &[2, 1, 0]), "{fault}: the neighbour");
        table.act("unit 18 fault none");
        assert_eq!(table.ask(18, &READ_COILS)[0].bytes, good, "{fault}: repaired");
    }
}

#[test]
fn noise_comes_before_the_reply_and_a_false_identity_in_it() {
    let mut table = Table::new(Framing::Rtu);
    table.act("unit 18 fault noisy");
    let bytes = table.ask(18, &READ_COILS).remove(0).bytes;
    assert_eq!((bytes.len(), &bytes[30..]), (36, &rtu(18, &[1, 1, 0])[..]));
    table.act("unit 18 fault none");
    table.act("unit 18 fault wrong-identity");
    let bytes = table.ask(18, &[43, 14, 1, 0]).remove(0).bytes;
    let text: String = bytes.iter().map(|byte| char::from(*byte)).collect();
    assert!(text.contains("METZ CONNECT GmbH") && text.contains("MR-DOX") && text.contains("V1.4"));
}

#[test]
fn a_device_that_reboots_again_and_again_loses_what_is_not_in_its_eeprom() {
    let mut table = Table::new(Framing::Rtu);
    table.act("unit 18 fault reboot=10s");
    table.ask(18, &[5, 0, 0, 0xFF, 0]);
    table.now += Duration::from_millis(9_999);
    assert_eq!(table.ask(18, &READ_COILS)[0].bytes, rtu(18, &[1, 1, 1]));
    table.now += Duration::from_millis(1);
    assert_eq!(table.ask(18, &READ_COILS), []);
    table.now += Duration::from_millis(2_000);
    assert_eq!(table.ask(18, &READ_COILS)[0].bytes, rtu(18, &[1, 1, 0]));
}

#[test]
fn a_paced_line_takes_the_time_of_the_bytes_of_request_and_reply() {
    let mut table = Table::new(Framing::Rtu);
    table.line.paced = true;
    // 8 and 6 characters of 11 bits at 19200 are 8.02 ms, and 5 ms turnaround.
    let at = table.ask(18, &READ_COILS)[0].at.since(table.now);
    assert_eq!(at.as_micros(), 13_020);
}

#[test]
fn changes_at_the_outputs_are_told_once() {
    let mut table = Table::new(Framing::Rtu);
    table.ask(18, &[5, 0, 1, 0xFF, 0]);
    let at = DeviceAt { model: Model::MrDo4, unit: 18 };
    assert_eq!(table.line.changed_outputs(), [(at.into(), "relay_2".into(), "ON".into())]);
    assert_eq!(table.line.changed_outputs(), []);
}

#[test]
fn two_devices_with_one_unit_are_refused() {
    let at = DeviceAt { model: Model::MrDo4, unit: 18 };
    let told = Line::new(Time(0), LineSettings::default(), Duration::ZERO, false, &[at, at]).err();
    let wanted =
        "`metz-connect/mr-do4@18` and `metz-connect/mr-do4@18` have the same unit; give each its own";
    assert_eq!(told.as_deref(), Some(wanted));
}

#[test]
fn a_relay_board_says_another_system_code_and_is_silent_when_it_cannot_answer_in_time() {
    let devices = [DeviceAt { model: Model::Relay8, unit: 7 }];
    let line = Line::new(Time(0), LineSettings::default(), Duration::ZERO, false, &devices);
    let mut table =
        Table { line: line.expect("one unit"), now: Time::from_millis(100), framing: Framing::Rtu };
    let read = [4, 0, 0, 0, 1];
    assert_eq!(table.ask(7, &read)[0].bytes, rtu(7, &[4, 2, 0x50, 0]));
    table.act("unit 7 fault wrong-identity");
    assert_eq!(table.ask(7, &read)[0].bytes, rtu(7, &[4, 2, 0x40, 0]));
    table.act("unit 7 fault slow=250ms");
    assert_eq!(table.ask(7, &read).len(), 1);
    table.act("unit 7 fault slow=1ms");
    assert_eq!(table.ask(7, &read), []);
}

#[test]
fn every_device_says_that_it_is_another_one_where_the_register_is_told_among_others() {
    let devices = [(Model::AnalogIn8, 7), (Model::Sensor, 8)].map(|(model, unit)| DeviceAt { model, unit });
    let line = Line::new(Time(0), LineSettings::default(), Duration::ZERO, false, &devices);
    let mut table =
        Table { line: line.expect("two units"), now: Time::from_millis(100), framing: Framing::Rtu };
    for (unit, true_code, false_code) in [(7, [0x40, 0x80], [0x50, 0x80]), (8, [0x10, 0], [0, 0])] {
        let code = |table: &mut Table| table.ask(unit, &[4, 0, 0, 0, 2])[0].bytes[3..5].to_vec();
        assert_eq!(code(&mut table), true_code);
        table.act(&format!("unit {unit} fault wrong-identity"));
        assert_eq!(code(&mut table), false_code);
        // Other registers are as they were.
        assert_eq!(table.ask(unit, &[4, 0, 79, 0, 1])[0].bytes, rtu(unit, &[4, 2, 3, 0xFA]));
    }
}
