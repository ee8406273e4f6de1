//! A device that is nothing but its profile: registers that hold what is written to them, within the
//! profile's rules. For trying out a profile before the device is there.
//!
//! Unlike every other simulated device it is no second reading of a manual: what is wrong in the
//! profile is wrong here. What a profile does not tell, it does not do: nothing is measured, switched or
//! calculated; watchdogs do not expire, and pauses between requests are not demanded.

mod cells;
mod rules;

use crate::engine::address::{Span, Table};
use crate::engine::codec;
use crate::engine::device::{Device, Identify, Point, Write, WriteRule};
use crate::engine::time::Time;
use crate::engine::value::Reading;
use crate::simulator::device::{Addressed, SimulatedDevice, Stimulus, check_eeprom_length};
use crate::simulator::pdu::{
    Exception, Request, bits_reply, exception_reply, identification_reply, words_reply, write_reply,
};
use cells::Cells;
use rules::{Verdict, judge};

/// The device.
pub struct Plain {
    device: Device,
    cells: Cells,
    /// From the first to the last address that the profile speaks of, for each table that it has.
    extents: Vec<Span>,
}

/// The specification (6.11): as many coils as fit in one request.
const COILS_WRITTEN_MAX: usize = 1968;
/// The bytes of a name in a reply that has to hold three of them.
const NAME_MAX: usize = 70;

impl Plain {
    /// A device fresh from the factory: what has no default is 0, or the first of its names.
    pub fn new(device: Device) -> Plain {
        let mut cells = Cells::default();
        let places = device.points.iter().flat_map(cells::places).map(|at| at.span);
        let identity = match &device.identify {
            Some(Identify::Word { at, .. }) => Some(*at),
            _ => None,
        };
        let spans: Vec<Span> = places.chain(identity).collect();
        spans.iter().for_each(|span| cells.add(*span));
        let extents = Table::ALL.into_iter().filter_map(|table| {
            let own = spans.iter().copied().filter(|span| span.table() == table);
            own.reduce(|all, span| all.hull(span).unwrap_or(all))
        });
        let extents = extents.collect();
        let mut plain = Plain { device, cells, extents };
        plain.initialise(|_| true);
        plain
    }

    /// The profile's identifier.
    pub fn id(&self) -> &str {
        &self.device.profile
    }

    /// Puts the points that `are` so to what the factory or the start sets them to.
    fn initialise(&mut self, are: impl Fn(&Point) -> bool) {
        // First those that decide, then those that are decided on.
        for with_cases in [false, true] {
            let mut changes = Vec::new();
            let known = self.known();
            for (index, point) in self.device.points.iter().enumerate() {
                if are(point) && point.plain().is_none() == with_cases {
                    changes.push((point.at, rules::initial(&self.device, index, &known)));
                }
            }
            for (at, field) in changes {
                self.cells.put(&self.device, at, &field);
            }
        }
        if let Some(Identify::Word { at, equals, .. }) = &self.device.identify {
            self.cells.set(*at, &[*equals]);
        }
    }

    /// The raw fields of all points, as the codec wants them.
    fn known(&self) -> Vec<Option<i128>> {
        let raw = |point: &Point| {
            let form = point.plain()?;
            match codec::raw(form, &self.cells.field(point.at)) {
                codec::Raw::Integer(raw) => Some(codec::meant(form, raw)),
                _ => None,
            }
        };
        self.device.points.iter().map(raw).collect()
    }

    /// What each point holds now, as the gateway would tell it if it read them all at one moment.
    pub fn texts(&self) -> Vec<String> {
        let known = self.known();
        (0..self.device.points.len()).map(|index| self.reading(index, &known).to_string()).collect()
    }

    fn reading(&self, index: usize, known: &[Option<i128>]) -> Reading {
        match codec::resolve(&self.device, index, known) {
            Ok(resolved) => codec::read(&resolved, &self.cells.field(self.device.points[index].at)),
            Err(missing) => Reading::Missing(missing),
        }
    }

    fn answer(&mut self, addressed: Addressed, pdu: &[u8]) -> Result<Vec<u8>, Exception> {
        let function = pdu.first().copied().unwrap_or(0);
        if !self.has_function(function) {
            return Err(Exception::Function);
        }
        match Request::parse(pdu)? {
            Request::Read { function, first, count } => {
                let (table, span) = self.readable(function, first, count)?;
                let words = self.cells.words(span);
                if addressed == Addressed::Unit {
                    self.clear_what_was_told(span);
                }
                let bits: Vec<bool> = words.iter().map(|word| *word != 0).collect();
                Ok(if table.is_bits() { bits_reply(function, &bits) } else { words_reply(function, &words) })
            }
            Request::WriteCoil { address, value } => {
                let bit = match value {
                    0xFF00 => 1,
                    0 => 0,
                    _ => return Err(Exception::Value),
                };
                self.write(function, Table::Coil, address, &[bit])?;
                Ok(write_reply(function, address, value))
            }
            Request::WriteRegister { address, word } => {
                self.write(function, Table::Holding, address, &[word])?;
                Ok(write_reply(function, address, word))
            }
            Request::WriteCoils { first, values } => {
                let bits: Vec<u16> = values.into_iter().map(u16::from).collect();
                check_count(bits.len(), COILS_WRITTEN_MAX)?;
                self.write(function, Table::Coil, first, &bits)?;
                Ok(write_reply(function, first, bits.len() as u16))
            }
            Request::WriteRegisters { first, words } => {
                check_count(words.len(), self.device.wire.limits.write_registers.into())?;
                self.write(function, Table::Holding, first, &words)?;
                Ok(write_reply(function, first, words.len() as u16))
            }
            Request::Encapsulated { interface, data } => match &self.device.identify {
                Some(Identify::Names { vendor, product }) => {
                    identification_reply(interface, &data, &[cut(vendor), cut(product), b"0"])
                }
                _ => Err(Exception::Function),
            },
            Request::Diagnostics { .. } => Err(Exception::Function),
        }
    }

    /// A function is there where something can be read or written by it.
    fn has_function(&self, function: u8) -> bool {
        match function {
            43 => matches!(self.device.identify, Some(Identify::Names { .. })),
            1..=4 => self.extents.iter().any(|extent| extent.table().read_function() == function),
            _ => self.writable().any(|(_, write)| works_with(write, function)),
        }
    }

    /// The span of a read, if the device gives it.
    fn readable(&self, function: u8, first: u16, count: u16) -> Result<(Table, Span), Exception> {
        let table = Table::ALL.into_iter().find(|table| table.read_function() == function);
        let table = table.ok_or(Exception::Function)?;
        let wire = &self.device.wire;
        let most = if table.is_bits() { wire.limits.read_bits } else { wire.limits.read_registers };
        check_count(count.into(), most.into())?;
        let span = Span::with_count(table, first, count).ok_or(Exception::Address)?;
        let in_one = wire.readable.is_empty() || wire.readable.iter().any(|there| there.contains(span));
        let whole = (span.first()..=span.last()).all(|address| self.is_there(Span::single(table, address)));
        if in_one && whole { Ok((table, span)) } else { Err(Exception::Address) }
    }

    /// Whether there is anything at this one address: a point, or something unknown between points.
    fn is_there(&self, single: Span) -> bool {
        let wire = &self.device.wire;
        if wire.forbidden.iter().any(|forbidden| forbidden.span.overlaps(single)) {
            return false;
        }
        let around = if wire.readable.is_empty() { &self.extents } else { &wire.readable };
        // A profile that forbids to read over gaps says that there are holes.
        let is_gap = wire.limits.gap != Some(0) && around.iter().any(|span| span.contains(single));
        is_gap || self.cells.has(single)
    }

    fn clear_what_was_told(&mut self, told: Span) {
        let cleared: Vec<_> = self
            .device
            .points
            .iter()
            .filter(|point| point.read_clears && point.at.span.overlaps(told))
            .map(|point| point.at)
            .collect();
        for at in cleared {
            let zeros = vec![0; self.cells.field(at).len()];
            self.cells.put(&self.device, at, &zeros);
        }
    }

    fn writable(&self) -> impl Iterator<Item = (usize, &Write)> {
        let points = self.device.points.iter().enumerate();
        points.filter_map(|(index, point)| Some((index, point.write.as_ref()?)))
    }

    /// Writes all of it or, where something is refused, nothing. A value of several registers is
    /// written whole; bits of a register that nobody may write stay what they are.
    fn write(&mut self, function: u8, table: Table, first: u16, words: &[u16]) -> Result<(), Exception> {
        let span = Span::with_count(table, first, words.len() as u16).ok_or(Exception::Address)?;
        let within = |write: &Write| span.contains(write.at.span) && works_with(write, function);
        let written: Vec<(usize, &Write)> = self.writable().filter(|(_, write)| within(write)).collect();
        let is_written = |address: u16| {
            written.iter().any(|(_, write)| write.at.span.contains(Span::single(table, address)))
        };
        if !(span.first()..=span.last()).all(is_written) {
            return Err(Exception::Address);
        }
        let known = self.known();
        let (mut changes, mut limited) = (Vec::new(), false);
        for (_, write) in &written {
            let field = codec::words_at(write.at, first, words).ok_or(Exception::Address)?;
            // Several buttons may share a register: one that takes the word is enough.
            let mut verdicts = written
                .iter()
                .filter(|(_, other)| other.at == write.at)
                .map(|(index, other)| judge(&self.device, *index, &other.rule, &field, &known));
            let verdict = verdicts
                .clone()
                .find(|verdict| matches!(verdict, Verdict::Taken(_)))
                .or_else(|| verdicts.next())
                .unwrap_or(Verdict::Refused);
            match verdict {
                Verdict::Taken(field) => changes.push((write.at, field)),
                Verdict::Limited(field) if self.device.wire.quirks.clamps_with_exception => {
                    limited = true;
                    changes.push((write.at, field));
                }
                _ => return Err(Exception::Value),
            }
        }
        for (at, field) in changes {
            self.cells.put(&self.device, at, &field);
        }
        if limited { Err(Exception::Value) } else { Ok(()) }
    }
}

/// Whether a function writes this place.
fn works_with(write: &Write, function: u8) -> bool {
    let is_coil = write.at.span.table().is_bits();
    match (write.with, function) {
        (Some(only), _) => only.code() == function,
        (None, 5) => is_coil && write.at.span.count() == 1,
        (None, 15) => is_coil,
        (None, 6) => !is_coil && write.at.span.count() == 1,
        (None, 16) => !is_coil,
        _ => false,
    }
}

fn cut(name: &str) -> &[u8] {
    &name.as_bytes()[..name.len().min(NAME_MAX)]
}

fn check_count(count: usize, most: usize) -> Result<(), Exception> {
    if (1..=most).contains(&count) { Ok(()) } else { Err(Exception::Value) }
}

impl SimulatedDevice for Plain {
    fn request(&mut self, _now: Time, addressed: Addressed, pdu: &[u8]) -> Option<Vec<u8>> {
        let reply = self.answer(addressed, pdu).unwrap_or_else(|exception| {
            let function = pdu.first().copied().unwrap_or(0);
            let varies = self.device.wire.quirks.exception_function_varies;
            // The quirk is that of a device that answers 0x84 to function 6 and a wrong value.
            let told = if varies && function == 6 && exception == Exception::Value { 4 } else { function };
            exception_reply(told, exception)
        });
        (addressed == Addressed::Unit).then_some(reply)
    }

    fn advance(&mut self, _now: Time) {}

    /// What is read alone is the world's, what is persistent is in the EEPROM.
    fn restart(&mut self, _now: Time) {
        self.initialise(|point| point.write.is_some() && !point.persistent);
    }

    fn stimulate(&mut self, _now: Time, stimulus: &Stimulus) -> Result<(), String> {
        let Stimulus::Set { span, words } = stimulus else {
            return Err("a device that is simulated from its profile has registers alone: `set`".into());
        };
        let table = span.table();
        let is_there = |address: u16| self.is_there(Span::single(table, address));
        if !(span.first()..=span.last()).all(is_there) {
            let there: Vec<String> = self.extents.iter().map(Span::to_string).collect();
            return Err(format!("`{span}` is not there; this device has {}", there.join(", ")));
        }
        if table.is_bits() && words.iter().any(|word| *word > 1) {
            return Err(format!("a {table} is 0 or 1"));
        }
        self.cells.set(*span, words);
        self.cells.spread(&self.device, *span);
        Ok(())
    }

    /// The points that can be written, as the gateway would tell them.
    fn outputs(&self) -> Vec<(String, String)> {
        let known = self.known();
        let shown = self.writable().filter(|(_, write)| !matches!(write.rule, WriteRule::Press { .. }));
        let text = |index: usize| match self.reading(index, &known) {
            Reading::Missing(missing) => missing.to_string(),
            reading => reading.to_string(),
        };
        shown.map(|(index, _)| (self.device.points[index].name.clone(), text(index))).collect()
    }

    fn eeprom(&self) -> Vec<u16> {
        let persistent = self.device.points.iter().filter(|point| point.persistent);
        persistent.flat_map(|point| self.cells.field(point.at)).collect()
    }

    fn load_eeprom(&mut self, now: Time, words: &[u16]) -> Result<(), String> {
        check_eeprom_length(words, self.eeprom().len())?;
        let mut words = words;
        for point in self.device.points.iter().filter(|point| point.persistent) {
            let (field, others) = words.split_at(self.cells.field(point.at).len());
            self.cells.put(&self.device, point.at, field);
            words = others;
        }
        self.restart(now);
        Ok(())
    }

    fn identity_register(&self) -> Option<(u8, u16, u16)> {
        match &self.device.identify {
            Some(Identify::Word { at, mask, .. }) => {
                // Its highest bit that counts.
                let bit = mask & 1u16.rotate_right(1 + mask.leading_zeros());
                Some((at.table().read_function(), at.first(), bit))
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests;
