//! A device whose every reading says when it was taken: what comes too late, or from another place, is
//! seen to do so.

use std::sync::{Arc, Mutex};

use busker::engine::time::{Duration, Time};
use busker::simulator::Stimulus;
use busker::simulator::device::{Addressed, SimulatedDevice};

/// The input registers are in two blocks of this size, so that requests for them look alike.
pub const BLOCK: u16 = 4;
/// Where the blocks begin.
pub const BLOCKS: [u16; 2] = [0, 100];
/// Coils, and holding registers, that hold what is written to them.
pub const STORED: u16 = 2;
/// For how long an input register keeps a value.
const STEP: Duration = Duration::from_millis(4);
/// By so many steps the registers of all devices lie apart: more than any request lasts.
const APART: u64 = 700;

/// What an input register held between `from` and `to`, as steps of [`at`].
pub fn held(unit: u8, address: u16, from: Time, to: Time, value: u16) -> bool {
    let first = at(unit, address, from);
    let ago = value.wrapping_sub(first);
    u64::from(ago) <= (to.since(from).as_micros() / STEP.as_micros()) as u64 + 1
}

fn at(unit: u8, address: u16, now: Time) -> u16 {
    let block = if address < BLOCKS[1] { 0 } else { 1 };
    let register = u64::from(address - BLOCKS[block]) + block as u64 * u64::from(BLOCK);
    let salt = (u64::from(unit / 2) * u64::from(2 * BLOCK) + register) * APART;
    (now.0 / STEP.as_micros() as u64 + salt) as u16
}

/// What is written to, and since when it holds what.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Store {
    Coil(u16),
    Holding(u16),
}

/// A change of something stored.
#[derive(Clone, Copy, Debug)]
pub struct Change {
    pub at: Time,
    pub unit: u8,
    pub store: Store,
    pub value: u16,
    /// By a request, and not by a restart.
    pub written: bool,
}

/// What happened in all devices, as only they know it.
#[derive(Clone, Default)]
pub struct Diary(Arc<Mutex<Vec<Change>>>);

impl Diary {
    /// What `store` holds now.
    pub fn value(&self, unit: u8, store: Store) -> u16 {
        let changes = self.changes();
        let last = changes.iter().rev().find(|change| (change.unit, change.store) == (unit, store));
        last.map_or(0, |change| change.value)
    }

    pub fn changes(&self) -> Vec<Change> {
        self.0.lock().expect("nobody panicked").clone()
    }

    /// Whether `store` held `value` at some time between `from` and `to`.
    pub fn held(&self, unit: u8, store: Store, from: Time, to: Time, value: u16) -> bool {
        for change in self.0.lock().expect("nobody panicked").iter().rev() {
            if (change.unit, change.store) != (unit, store) || change.at > to {
                continue;
            }
            if change.value == value {
                return true;
            }
            if change.at <= from {
                return false;
            }
        }
        value == 0
    }

    fn note(&self, change: Change) {
        self.0.lock().expect("nobody panicked").push(change);
    }
}

pub struct Timepiece {
    unit: u8,
    diary: Diary,
    coils: [u16; STORED as usize],
    holdings: [u16; STORED as usize],
}

impl Timepiece {
    pub fn new(unit: u8, diary: Diary) -> Timepiece {
        Timepiece { unit, diary, coils: [0; STORED as usize], holdings: [0; STORED as usize] }
    }

    fn write(&mut self, now: Time, store: Store, value: u16) -> bool {
        let place = match store {
            Store::Coil(number) => self.coils.get_mut(usize::from(number)),
            Store::Holding(number) => self.holdings.get_mut(usize::from(number)),
        };
        let Some(place) = place else { return false };
        *place = value;
        self.diary.note(Change { at: now, unit: self.unit, store, value, written: true });
        true
    }

    fn reading(&self, function: u8, address: u16, now: Time) -> Option<u16> {
        match function {
            1 => self.coils.get(usize::from(address)).copied(),
            3 => self.holdings.get(usize::from(address)).copied(),
            4 => BLOCKS
                .iter()
                .any(|block| (*block..block + BLOCK).contains(&address))
                .then(|| at(self.unit, address, now)),
            _ => None,
        }
    }

    /// Exception 2 is the only one it knows.
    fn answer(&mut self, now: Time, pdu: &[u8]) -> Option<Vec<u8>> {
        let &[function, high, low, second_high, second_low] = pdu else { return None };
        let address = u16::from_be_bytes([high, low]);
        let second = u16::from_be_bytes([second_high, second_low]);
        match function {
            1..=4 => {
                let words = (address..address + second).map(|address| self.reading(function, address, now));
                let words = words.collect::<Option<Vec<u16>>>()?;
                Some(match function {
                    1 => {
                        let bits = words.iter().rev().fold(0, |bits, bit| bits << 1 | *bit as u8);
                        vec![1, 1, bits]
                    }
                    _ => {
                        let bytes = words.iter().flat_map(|word| word.to_be_bytes());
                        [function, second as u8 * 2].into_iter().chain(bytes).collect()
                    }
                })
            }
            5 => self.write(now, Store::Coil(address), u16::from(second == 0xFF00)).then(|| pdu.to_vec()),
            6 => self.write(now, Store::Holding(address), second).then(|| pdu.to_vec()),
            _ => None,
        }
    }
}

impl SimulatedDevice for Timepiece {
    fn request(&mut self, now: Time, _: Addressed, pdu: &[u8]) -> Option<Vec<u8>> {
        Some(self.answer(now, pdu).unwrap_or_else(|| vec![pdu[0] | 0x80, 2]))
    }

    fn advance(&mut self, _: Time) {}

    fn restart(&mut self, now: Time) {
        for number in 0..STORED {
            for store in [Store::Coil(number), Store::Holding(number)] {
                self.diary.note(Change { at: now, unit: self.unit, store, value: 0, written: false });
            }
        }
        (self.coils, self.holdings) = Default::default();
    }

    fn stimulate(&mut self, _: Time, _: &Stimulus) -> Result<(), String> {
        Err("nothing is connected to it".into())
    }

    fn outputs(&self) -> Vec<(String, String)> {
        Vec::new()
    }

    fn eeprom(&self) -> Vec<u16> {
        Vec::new()
    }

    fn load_eeprom(&mut self, _: Time, _: &[u16]) -> Result<(), String> {
        Ok(())
    }
}
