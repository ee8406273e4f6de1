//! Several devices on one line: each answers its own unit only, and each may have faults.

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Addressed, DeviceAt, LineSettings, Overheard, SimulatedDevice, Stimulus};
use crate::simulator::fault::{Fault, FaultKind};
use crate::simulator::script::Action;
use crate::simulator::wire::{Frame, Framing, Received, character_time};

/// The line: devices, and how fast they are.
pub struct Line {
    settings: LineSettings,
    turnaround: Duration,
    /// Whether requests and replies take the time that they would take on a wire.
    paced: bool,
    units: Vec<Unit>,
}

/// One device with its address, its power and its faults.
pub struct Unit {
    pub at: DeviceAt,
    pub device: Box<dyn SimulatedDevice>,
    powered: bool,
    silent_until: Time,
    /// When the next restart of a [`FaultKind::Reboot`] is due.
    reboot_at: Option<Time>,
    faults: Vec<Fault>,
    /// How many requests this unit has got, for `every`.
    requests: u32,
    outputs_told: Vec<(String, String)>,
}

/// How long a reply takes.
#[derive(Clone, Copy, Debug)]
struct Pace {
    /// From the end of the request, silence included, to the device's answer.
    turnaround: Duration,
    /// How long the request was on the wire, where that is counted.
    request_time: Duration,
    /// How long each byte of the reply takes, where that is counted.
    per_byte: Duration,
}

/// Bytes to put on the line, and when.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Transmission {
    pub at: Time,
    pub bytes: Vec<u8>,
}

/// How long a device is silent after a restart on request. No manual names a time.
const BOOT_TIME: Duration = Duration::from_secs(2);
/// Modbus TCP specification: the gateway's answer for a unit that is not on its line.
const TARGET_FAILED_TO_RESPOND: u8 = 0x0B;

impl Line {
    /// An error says which unit is there twice.
    pub fn new(
        now: Time,
        settings: LineSettings,
        turnaround: Duration,
        paced: bool,
        devices: &[DeviceAt],
    ) -> Result<Line, String> {
        let mut units: Vec<Unit> = Vec::new();
        for at in devices {
            if let Some(other) = units.iter().find(|unit| unit.at.unit == at.unit) {
                return Err(format!("`{}` and `{at}` have the same unit; give each its own", other.at));
            }
            let device = at.model.build(now, settings);
            units.push(Unit {
                at: *at,
                outputs_told: device.outputs(),
                device,
                powered: true,
                silent_until: Time(0),
                reboot_at: None,
                faults: Vec::new(),
                requests: 0,
            });
        }
        Ok(Line { settings, turnaround, paced, units })
    }

    pub fn units(&self) -> &[Unit] {
        &self.units
    }

    pub fn settings(&self) -> LineSettings {
        self.settings
    }

    /// The unit's entry; the error names the units there are.
    pub fn unit(&mut self, number: u8) -> Result<&mut Unit, String> {
        let there: Vec<String> = self.units.iter().map(|unit| unit.at.unit.to_string()).collect();
        self.units
            .iter_mut()
            .find(|unit| unit.at.unit == number)
            .ok_or_else(|| format!("unit {number} is not on this line; there are {}", there.join(", ")))
    }

    /// Adds a fault to the unit it names, or to all.
    pub fn add_fault(&mut self, now: Time, fault: &Fault) -> Result<(), String> {
        let units = match fault.unit {
            Some(number) => std::slice::from_mut(self.unit(number)?),
            None => &mut self.units[..],
        };
        for unit in units {
            if let FaultKind::Reboot(period) = fault.kind {
                unit.reboot_at = Some(now + period);
            }
            unit.faults.push(fault.clone());
        }
        Ok(())
    }

    /// Does what a line of a script says; see [`crate::simulator::script`].
    pub fn act(&mut self, now: Time, action: &Action) -> Result<(), String> {
        match action {
            Action::Stimulate { unit, stimulus } => self.stimulate(now, *unit, stimulus),
            Action::Power { unit, on } => {
                let unit = self.unit(*unit)?;
                if *on && !unit.powered {
                    unit.device.restart(now);
                }
                unit.powered = *on;
                Ok(())
            }
            Action::Restart { unit } => {
                self.unit(*unit)?.restart(now);
                Ok(())
            }
            Action::Fault(fault) => self.add_fault(now, fault),
            Action::Repair { unit } => {
                let unit = self.unit(*unit)?;
                unit.faults.clear();
                unit.reboot_at = None;
                Ok(())
            }
        }
    }

    pub fn stimulate(&mut self, now: Time, unit: u8, stimulus: &Stimulus) -> Result<(), String> {
        let unit = self.unit(unit)?;
        if !unit.powered {
            return Err(format!("unit {} has no power", unit.at.unit));
        }
        unit.device.stimulate(now, stimulus)
    }

    /// Lets time pass in every device.
    pub fn advance(&mut self, now: Time) {
        for unit in self.units.iter_mut().filter(|unit| unit.powered) {
            while let Some(reboot_at) = unit.reboot_at.filter(|at| *at <= now) {
                unit.device.advance(reboot_at);
                unit.restart(reboot_at);
                let period = unit.faults.iter().find_map(|fault| match fault.kind {
                    FaultKind::Reboot(period) => Some(period.max(BOOT_TIME)),
                    _ => None,
                });
                unit.reboot_at = period.map(|period| reboot_at + period);
            }
            unit.device.advance(now);
        }
    }

    /// What has changed at the devices' outputs since the last call: unit, name, state.
    pub fn changed_outputs(&mut self) -> Vec<(DeviceAt, String, String)> {
        let mut changed = Vec::new();
        for unit in &mut self.units {
            let outputs = unit.device.outputs();
            for (now, before) in outputs.iter().zip(&unit.outputs_told) {
                if now != before {
                    changed.push((unit.at, now.0.clone(), now.1.clone()));
                }
            }
            unit.outputs_told = outputs;
        }
        changed
    }

    /// Takes what came over the line, and gives the replies in the order of their times.
    pub fn hear(&mut self, now: Time, framing: Framing, received: &Received) -> Vec<Transmission> {
        self.advance(now);
        let Received::Frame(frame) = received else {
            self.listening(now).for_each(|unit| unit.device.overhear(Overheard::Damaged));
            return Vec::new();
        };
        // On Modbus TCP, unit 0 is an ordinary address, and where there is one device it and 255
        // mean that device.
        let mut meant = frame.unit;
        if framing == Framing::Tcp && matches!(meant, 0 | 255) && self.units.len() == 1 {
            meant = self.units[0].at.unit;
        }
        let broadcast = meant == 0 && framing == Framing::Rtu;
        let known = self.units.iter().any(|unit| unit.at.unit == meant);
        let pace = self.pace(framing, frame);
        let mut transmissions = Vec::new();
        for unit in self.listening(now) {
            if broadcast {
                unit.device.request(now, Addressed::Broadcast, &frame.pdu);
            } else if unit.at.unit == meant {
                transmissions.extend(unit.answer(now, framing, frame, pace));
            } else {
                unit.device.overhear(Overheard::Foreign);
            }
        }
        if framing == Framing::Tcp && !known {
            let pdu = vec![frame.pdu.first().copied().unwrap_or(0) | 0x80, TARGET_FAILED_TO_RESPOND];
            transmissions
                .push(Transmission { at: now, bytes: Frame { pdu, ..frame.clone() }.encode(framing) });
        }
        transmissions
    }

    fn pace(&self, framing: Framing, request: &Frame) -> Pace {
        let per_byte = match framing {
            Framing::Rtu if self.paced => character_time(self.settings),
            _ => Duration::ZERO,
        };
        // Address and checksum come to the PDU. The silence behind it the receiver has waited for.
        let request_time = per_byte * (request.pdu.len() as u32 + 3);
        Pace { turnaround: self.turnaround, request_time, per_byte }
    }

    /// The units that have power and settings which fit the line.
    fn listening(&mut self, now: Time) -> impl Iterator<Item = &mut Unit> {
        let settings = self.settings;
        self.units.iter_mut().filter(move |unit| {
            unit.powered
                && now >= unit.silent_until
                && unit.device.line_settings().is_none_or(|own| own == settings)
        })
    }
}

impl Unit {
    fn restart(&mut self, now: Time) {
        self.device.restart(now);
        self.silent_until = now + BOOT_TIME;
    }

    /// Answers a request for this unit, through its faults.
    fn answer(&mut self, now: Time, framing: Framing, request: &Frame, pace: Pace) -> Vec<Transmission> {
        self.requests += 1;
        let faults = self.faults.iter().filter(|fault| self.requests % fault.every == 0);
        let kinds: Vec<FaultKind> = faults.map(|fault| fault.kind.clone()).collect();
        let mut turnaround = pace.turnaround;
        let mut refusal = None;
        for kind in &kinds {
            match kind {
                FaultKind::Silent => return Vec::new(),
                FaultKind::Exception(code) => refusal = Some(*code),
                FaultKind::Slow(more) => turnaround += *more,
                _ => {}
            }
        }
        let pdu = match refusal {
            Some(code) => Some(vec![request.pdu[0] | 0x80, code]),
            None => self.device.request(now, Addressed::Unit, &request.pdu),
        };
        let Some(mut pdu) = pdu else { return Vec::new() };
        if self.device.gives_up_after().is_some_and(|limit| turnaround > limit) {
            return Vec::new();
        }
        if kinds.contains(&FaultKind::WrongIdentity) {
            falsify_identity(request, &mut pdu);
        }
        self.transmit(now + turnaround + pace.request_time, framing, request, pdu, &kinds, pace.per_byte)
    }

    /// Puts a reply on the line from `start` on, spoilt by the faults `kinds`.
    fn transmit(
        &self,
        mut start: Time,
        framing: Framing,
        request: &Frame,
        pdu: Vec<u8>,
        kinds: &[FaultKind],
        mut per_byte: Duration,
    ) -> Vec<Transmission> {
        let mut frame = Frame { transaction: request.transaction, unit: request.unit, pdu };
        let mut dribbled = false;
        let mut before = Vec::new();
        for kind in kinds {
            match kind {
                FaultKind::Late(more) => start += *more,
                FaultKind::OtherUnit => frame.unit = frame.unit % 247 + 1,
                FaultKind::Dribble(pause) => {
                    dribbled = true;
                    per_byte = *pause;
                }
                FaultKind::Garbled if framing == Framing::Tcp => {
                    frame.transaction = frame.transaction.wrapping_add(1);
                }
                FaultKind::Noisy => before.extend((0..30u8).map(|number| number.wrapping_mul(73) ^ 0xA5)),
                FaultKind::LeadingZero => before.push(0),
                FaultKind::Echo => before.extend(request.encode(framing)),
                _ => {}
            }
        }
        let mut bytes = frame.encode(framing);
        for kind in kinds {
            match kind {
                FaultKind::Garbled if framing == Framing::Rtu => {
                    let middle = bytes.len() / 2;
                    bytes[middle] ^= 0x10;
                }
                FaultKind::Short => bytes.truncate(bytes.len().saturating_sub(2)),
                _ => {}
            }
        }
        // Noise on a socket is not noise but another protocol; there it is left out.
        if framing == Framing::Rtu {
            before.append(&mut bytes);
            bytes = before;
        }
        if dribbled {
            let pieces = bytes.iter().enumerate();
            return pieces
                .map(|(number, byte)| Transmission {
                    at: start + per_byte * number as u32,
                    bytes: vec![*byte],
                })
                .collect();
        }
        // A paced reply is handed over when its last byte would have come, as an adapter does it.
        vec![Transmission { at: start + per_byte * bytes.len() as u32, bytes }]
    }
}

/// Says that the device is another one: the last letter of its product name, or the system code in
/// the first input register of a FuehlerSysteme device.
fn falsify_identity(request: &Frame, pdu: &mut [u8]) {
    match request.pdu[..] {
        [43, 14, ..] if pdu[0] == 43 => {
            // Seven bytes, then object 0 with its length, then object 1 with its length.
            let vendor_length = usize::from(pdu.get(8).copied().unwrap_or(0));
            let product = 9 + vendor_length;
            let product_length = usize::from(pdu.get(product + 1).copied().unwrap_or(0));
            if let Some(letter) = pdu.get_mut(product + 1 + product_length) {
                *letter = b'X';
            }
        }
        [4, 0, 0, ..] if pdu[0] == 4 && pdu.len() >= 4 && pdu[2] == 0x50 => pdu[2] = 0x40,
        _ => {}
    }
}

#[cfg(test)]
mod tests {
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
            let devices =
                [(Model::MrDo4, 18), (Model::MrSi4, 20)].map(|(model, unit)| DeviceAt { model, unit });
            let line = Line::new(Time(0), LineSettings::default(), Duration::from_millis(5), false, &devices);
            Table { line: line.expect("different units"), now: Time::from_millis(100), framing }
        }

        fn act(&mut self, command: &str) {
            let step = parse_line(command).expect("a command").expect("not empty");
            self.line.act(self.now, &step.action).expect("a unit of this line");
        }

        fn ask(&mut self, unit: u8, pdu: &[u8]) -> Vec<Transmission> {
            let frame = Frame { transaction: 7, unit, pdu: pdu.to_vec() };
            self.line.hear(self.now, self.framing, &Received::Frame(frame))
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
        // The answer to the change still comes with the old settings (page 5).
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
        assert_eq!(table.line.hear(table.now, Framing::Rtu, &Received::Damaged), []);
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
            let told: Vec<_> =
                table.ask(18, &READ_COILS).into_iter().map(|sent| (sent.at, sent.bytes)).collect();
            assert_eq!(told, expected, "{fault}");
            assert_eq!(
                table.ask(20, &[2, 0, 0, 0, 4])[0].bytes,
                rtu(20, &[2, 1, 0]),
                "{fault}: the neighbour"
            );
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
        assert_eq!(table.line.changed_outputs(), [(at, "relay_2".into(), "ON".into())]);
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
}
