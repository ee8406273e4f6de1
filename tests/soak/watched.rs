//! A device that is its profile, and writes down what each of its points held since when, and what was
//! written to it.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use busker::engine::address::{Span, Table};
use busker::engine::device::Device;
use busker::engine::time::{Duration, Time};
use busker::simulator::device::{Addressed, SimulatedDevice};
use busker::simulator::{Plain, Stimulus};

/// What happened in all devices, as only they know it.
#[derive(Clone, Default)]
pub struct Ledger(Arc<Mutex<BTreeMap<u8, Pages>>>);

/// What happened in one.
#[derive(Clone, Default)]
pub struct Pages {
    /// For each point what it held from when on.
    pub texts: Vec<Vec<Held>>,
    pub writes: Vec<Write>,
}

/// What a point held from then on.
#[derive(Clone, Debug)]
pub struct Held {
    pub since: Time,
    text: String,
    cause: Cause,
}

/// Why a point holds something else than before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Cause {
    Written,
    /// It is cleared by reading.
    Read,
    /// Somebody at the device, or its restart.
    Itself,
}

/// A write that reached the device.
#[derive(Clone, Debug)]
pub struct Write {
    pub at: Time,
    pub span: Span,
    #[expect(dead_code, reason = "it is told when something is wrong")]
    pub words: Vec<u16>,
    /// The device has said no.
    pub refused: bool,
    /// Nothing that it keeps in EEPROM was changed by it.
    pub in_vain: bool,
}

impl Ledger {
    pub fn of<R>(&self, unit: u8, look: impl FnOnce(&mut Pages) -> R) -> R {
        look(self.0.lock().expect("nobody panicked").entry(unit).or_default())
    }
}

impl Pages {
    /// Whether the point held this at some time between the two.
    pub fn held(&self, point: usize, from: Time, to: Time, text: &str) -> bool {
        for held in self.texts[point].iter().rev() {
            if held.since > to {
                continue;
            }
            if held.text == text {
                return true;
            }
            // Over TCP a request is heard when it is sent: what is cleared by it was held then, as was what changes at
            // the device at that very moment. What was written was not: whoever asked knows of it.
            if held.since < from || (held.since == from && held.cause == Cause::Written) {
                return false;
            }
        }
        false
    }

    /// Whether one of `points` changed in `within` before `to`, and nobody had written it.
    pub fn touched(&self, points: &[usize], to: Time, within: Duration) -> bool {
        let is_new = |held: &Held| held.since <= to && to.since(held.since) < within;
        let by_itself = |held: &Held| held.cause == Cause::Itself && is_new(held);
        points.iter().any(|point| self.texts[*point].iter().any(by_itself))
    }

    pub fn holds(&self, point: usize) -> &str {
        self.texts[point].last().map_or("", |held| &held.text)
    }
}

pub struct Watched {
    plain: Plain,
    device: Arc<Device>,
    unit: u8,
    ledger: Ledger,
    clears: bool,
    /// What no firmware has, or not this one.
    holes: Holes,
}

/// Addresses that a device does not have, now.
pub type Holes = Arc<Mutex<Vec<Span>>>;

impl Watched {
    pub fn new(now: Time, unit: u8, device: Arc<Device>, ledger: Ledger, holes: Holes) -> Watched {
        let clears = device.points.iter().any(|point| point.read_clears);
        let watched = Watched { plain: Plain::new((*device).clone()), device, unit, ledger, clears, holes };
        watched.note(now, Cause::Written);
        watched
    }

    fn note(&self, now: Time, cause: Cause) {
        let texts = self.plain.texts();
        self.ledger.of(self.unit, |pages| {
            pages.texts.resize(texts.len(), Vec::new());
            for (history, text) in pages.texts.iter_mut().zip(texts) {
                if history.last().is_none_or(|last| last.text != text) {
                    history.push(Held { since: now, text, cause });
                }
            }
        });
    }
}

/// The span that a request asks for, and what it writes there.
fn span_of(pdu: &[u8]) -> Option<(Span, Option<Vec<u16>>)> {
    let &[function, high, low, second_high, second_low, ..] = pdu else { return None };
    let first = u16::from_be_bytes([high, low]);
    let second = u16::from_be_bytes([second_high, second_low]);
    let words = || pdu[6..].chunks(2).map(|two| u16::from_be_bytes([two[0], two[1]])).collect();
    let table = match function {
        1 | 5 | 15 => Table::Coil,
        2 => Table::Discrete,
        3 | 6 | 16 => Table::Holding,
        4 => Table::Input,
        _ => return None,
    };
    Some(match function {
        1..=4 => (Span::with_count(table, first, second)?, None),
        5 | 6 => (Span::single(table, first), Some(vec![second])),
        15 => {
            (Span::with_count(table, first, second)?, Some(pdu[6..].iter().map(|b| u16::from(*b)).collect()))
        }
        _ => (Span::with_count(table, first, second)?, Some(words())),
    })
}

impl SimulatedDevice for Watched {
    fn request(&mut self, now: Time, addressed: Addressed, pdu: &[u8]) -> Option<Vec<u8>> {
        let asked = span_of(pdu);
        if let Some((span, _)) = &asked {
            let wire = &self.device.wire;
            for forbidden in &wire.forbidden {
                assert!(!forbidden.span.overlaps(*span), "{span} is forbidden: {}", self.device.profile);
            }
        }
        let is_hole =
            |span: &Span| self.holes.lock().expect("nobody panicked").iter().any(|hole| hole.overlaps(*span));
        if asked.as_ref().is_some_and(|(span, _)| is_hole(span)) {
            return Some(vec![pdu[0] | 0x80, 2]);
        }
        let before = self.plain.eeprom();
        let answer = self.plain.request(now, addressed, pdu);
        let refused = answer.as_ref().is_some_and(|answer| answer[0] & 0x80 != 0);
        if let Some((span, Some(words))) = asked {
            let in_vain = before == self.plain.eeprom();
            let write = Write { at: now, span, words, refused, in_vain };
            self.ledger.of(self.unit, |pages| pages.writes.push(write));
            self.note(now, Cause::Written);
        } else if self.clears {
            self.note(now, Cause::Read);
        }
        answer
    }

    fn advance(&mut self, _: Time) {}

    fn restart(&mut self, now: Time) {
        self.plain.restart(now);
        self.note(now, Cause::Itself);
    }

    fn stimulate(&mut self, now: Time, stimulus: &Stimulus) -> Result<(), String> {
        self.plain.stimulate(now, stimulus)?;
        self.note(now, Cause::Itself);
        Ok(())
    }

    fn outputs(&self) -> Vec<(String, String)> {
        Vec::new()
    }

    fn eeprom(&self) -> Vec<u16> {
        self.plain.eeprom()
    }

    fn load_eeprom(&mut self, now: Time, words: &[u16]) -> Result<(), String> {
        self.plain.load_eeprom(now, words)
    }

    fn identity_register(&self) -> Option<(u8, u16, u16)> {
        self.plain.identity_register()
    }
}
