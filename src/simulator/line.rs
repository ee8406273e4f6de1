//! Several devices on one line: each answers its own unit only, and each may have faults.

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{
    Addressed, DeviceAt, LineSettings, Overheard, Place, SimulatedDevice, Stimulus,
};
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
    pub at: Place,
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
        let mut line = Line { settings, turnaround, paced, units: Vec::new() };
        for at in devices {
            line.add((*at).into(), at.model.build(now, settings))?;
        }
        Ok(line)
    }

    /// Puts one more device on the line. An error says that its unit is there already.
    pub fn add(&mut self, at: Place, device: Box<dyn SimulatedDevice>) -> Result<(), String> {
        if let Some(other) = self.units.iter().find(|unit| unit.at.unit == at.unit) {
            return Err(format!("`{}` and `{at}` have the same unit; give each its own", other.at));
        }
        self.units.push(Unit {
            at,
            outputs_told: device.outputs(),
            device,
            powered: true,
            silent_until: Time(0),
            reboot_at: None,
            faults: Vec::new(),
            requests: 0,
        });
        Ok(())
    }

    pub fn units(&self) -> &[Unit] {
        &self.units
    }

    pub fn units_mut(&mut self) -> &mut [Unit] {
        &mut self.units
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
    pub fn changed_outputs(&mut self) -> Vec<(Place, String, String)> {
        let mut changed = Vec::new();
        for unit in &mut self.units {
            let outputs = unit.device.outputs();
            for (now, before) in outputs.iter().zip(&unit.outputs_told) {
                if now != before {
                    changed.push((unit.at.clone(), now.0.clone(), now.1.clone()));
                }
            }
            unit.outputs_told = outputs;
        }
        changed
    }

    /// Takes what came over the line, and gives the replies in the order of their times. `sent_with` are the
    /// settings of who sent it, where those count: a device with others hears only that something was there.
    pub fn hear(
        &mut self,
        now: Time,
        framing: Framing,
        received: &Received,
        sent_with: Option<LineSettings>,
    ) -> Vec<Transmission> {
        self.advance(now);
        if let Some(sent_with) = sent_with {
            let settings = self.settings;
            let others = self.units.iter_mut().filter(|unit| unit.hears(now));
            for unit in others.filter(|unit| unit.device.line_settings().unwrap_or(settings) != sent_with) {
                unit.device.overhear(Overheard::Damaged);
            }
        }
        let Received::Frame(frame) = received else {
            self.listening(now, sent_with).for_each(|unit| unit.device.overhear(Overheard::Damaged));
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
        for unit in self.listening(now, sent_with) {
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

    /// The units that have power and settings which fit those of the line, or of who sends on it.
    fn listening(&mut self, now: Time, sent_with: Option<LineSettings>) -> impl Iterator<Item = &mut Unit> {
        let settings = self.settings;
        let heard = sent_with.unwrap_or(settings);
        self.units.iter_mut().filter(move |unit| {
            // Those that have none of their own have the line's.
            unit.hears(now) && unit.device.line_settings().unwrap_or(settings) == heard
        })
    }
}

impl Unit {
    fn hears(&self, now: Time) -> bool {
        self.powered && now >= self.silent_until
    }

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
            falsify_identity(request, self.device.identity_register(), &mut pdu);
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

/// Says that the device is another one: in the last letter of its product name, or in the register that
/// says what it is.
fn falsify_identity(request: &Frame, register: Option<(u8, u16, u16)>, pdu: &mut [u8]) {
    if let ([43, 14, ..], Some(43)) = (&request.pdu[..], pdu.first()) {
        // Seven bytes, then object 0 with its length, then object 1 with its length.
        let vendor_length = usize::from(pdu.get(8).copied().unwrap_or(0));
        let product = 9 + vendor_length;
        let product_length = usize::from(pdu.get(product + 1).copied().unwrap_or(0));
        if let Some(letter) = pdu.get_mut(product + 1 + product_length) {
            *letter = b'X';
        }
    }
    let (Some((function, register, bit)), [asked, high, low, ..]) = (register, &request.pdu[..]) else {
        return;
    };
    let at = usize::from(register.wrapping_sub(u16::from_be_bytes([*high, *low]))) * 2 + 2;
    if *asked == function && pdu.first() == Some(&function) {
        if let Some(word) = pdu.get_mut(at..at + 2) {
            let [high, low] = bit.to_be_bytes();
            word[0] ^= high;
            word[1] ^= low;
        }
    }
}

#[cfg(test)]
mod tests;
