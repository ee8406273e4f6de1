//! The relay board with eight relays (chapters 6, 6.1 of the manual).

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Stimulus, take_words};
use crate::simulator::fuehlersysteme::board::{AUTOMATIC, Board, Table};
use crate::simulator::fuehlersysteme::ranges::{number, number_above, number_below};
use crate::simulator::fuehlersysteme::relay::{Relay, Rules};

/// The board.
pub type Relay8 = Board<Relays>;

/// Its own tables.
pub struct Relays {
    settings: Settings,
    /// RWreg_01 to 08: 0, 1, or 11111 for automatic.
    fixed: [u16; RELAYS],
    /// RWreg_09: bits, or 11111.
    fixed_bits: u16,
    /// RWreg_11 to 18: measured values, or 11111.
    measured: [i16; RELAYS],
    /// RWreg_19.
    wanted: u8,
    relays: [Relay; RELAYS],
    /// The relays as they stood when time last passed: what a person in front of the board sees.
    shown: u8,
}

/// What is marked with a star, and so "auch gespeichert".
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Settings {
    off: [i16; RELAYS],
    on: [i16; RELAYS],
    hold: u8,
    on_delay: [u16; RELAYS],
    run_on: [u16; RELAYS],
    negate: u8,
    cycle: [u16; RELAYS],
}

const RELAYS: usize = 8;

const FACTORY: Settings = Settings {
    off: [0; RELAYS],
    on: [1; RELAYS],
    hold: 0,
    on_delay: [0; RELAYS],
    run_on: [0; RELAYS],
    negate: 0,
    cycle: [0; RELAYS],
};

impl Relays {
    /// Compares measured values with thresholds, and takes the bits of RWreg_19 where there are none.
    fn demand(&mut self, now: Time) {
        for relay in 0..RELAYS {
            let rules = self.rules(relay);
            let measured = self.measured[relay];
            // With the factory's thresholds 0 and 1 a measured 1 switches on and a 0 off, so a
            // threshold that is reached counts as passed.
            let on = if measured as u16 == AUTOMATIC {
                self.wanted >> relay & 1 == 1
            } else if measured >= self.settings.on[relay] {
                true
            } else if measured <= self.settings.off[relay] {
                false
            } else {
                self.relays[relay].is_demanded()
            };
            self.relays[relay].demand(now, on, rules);
        }
    }

    fn reset(&mut self, now: Time, bits: u8) {
        for relay in (0..RELAYS).filter(|relay| bits >> relay & 1 == 1) {
            let rules = self.rules(relay);
            self.relays[relay].reset(now, rules);
        }
    }

    fn rules(&self, relay: usize) -> Rules {
        let seconds = |registers: &[u16; RELAYS]| Duration::from_secs(registers[relay].into());
        Rules {
            on_delay: seconds(&self.settings.on_delay),
            run_on: seconds(&self.settings.run_on),
            hold: self.settings.hold >> relay & 1 == 1,
            negate: self.settings.negate >> relay & 1 == 1,
            cycle: seconds(&self.settings.cycle),
        }
    }

    /// The relays, bit 0 is relay 1. "Der Zustand von RWreg_01 bis _09 werden direkt in die Register
    /// Rreg_01 bis 09 übernommen"; where both say something, the relay's own register counts here.
    fn states(&self, now: Time) -> u8 {
        let is_on = |relay: usize| {
            if self.fixed[relay] != AUTOMATIC {
                self.fixed[relay] == 1
            } else if self.fixed_bits != AUTOMATIC {
                self.fixed_bits >> relay & 1 == 1
            } else {
                self.relays[relay].is_on(now, self.rules(relay))
            }
        };
        (0..RELAYS).map(|relay| u8::from(is_on(relay)) << relay).sum()
    }
}

impl Table for Relays {
    const HAS_SCRATCH: bool = true;

    fn new(now: Time) -> Relays {
        Relays {
            settings: FACTORY,
            fixed: [AUTOMATIC; RELAYS],
            fixed_bits: AUTOMATIC,
            measured: [AUTOMATIC as i16; RELAYS],
            wanted: 0,
            relays: [Relay::new(now); RELAYS],
            shown: 0,
        }
    }

    fn system_code(&self) -> u16 {
        0x5000
    }

    fn read_input(&self, now: Time, register: u16) -> Option<u16> {
        match register {
            1..=8 => Some(u16::from(self.states(now) >> (register - 1) & 1)),
            9 => Some(self.states(now).into()),
            _ => None,
        }
    }

    fn read_holding(&self, register: u16) -> Option<u16> {
        let at = |first: u16| usize::from(register - first);
        let settings = &self.settings;
        Some(match register {
            1..=8 => self.fixed[at(1)],
            9 => self.fixed_bits,
            11..=18 => self.measured[at(11)] as u16,
            19 => self.wanted.into(),
            21..=28 => settings.off[at(21)] as u16,
            31..=38 => settings.on[at(31)] as u16,
            40 => settings.hold.into(),
            // The reset commands are 0 again at once.
            41..=49 => 0,
            51..=58 => settings.on_delay[at(51)],
            61..=68 => settings.run_on[at(61)],
            69 => settings.negate.into(),
            71..=78 => settings.cycle[at(71)],
            _ => return None,
        })
    }

    fn limit(&self, register: u16, word: u16) -> u16 {
        let at = |first: u16| usize::from(register - first);
        match register {
            1..=9 | 11..=18 if word == AUTOMATIC => word,
            1..=8 | 41..=48 => word.min(1),
            9 | 19 | 40 | 49 | 69 => word.min(255),
            11..=18 => number(word),
            // "Ausschaltschwelle… kleiner Einschaltschwelle…": each bounds the other's range.
            21..=28 => number_below(word, self.settings.on[at(21)]),
            31..=38 => number_above(word, self.settings.off[at(31)]),
            51..=58 | 61..=68 => word.min(1800),
            71..=78 => word.min(60),
            _ => word,
        }
    }

    fn write(&mut self, now: Time, register: u16, used: u16) {
        let at = |first: u16| usize::from(register - first);
        match register {
            1..=8 => self.fixed[at(1)] = used,
            9 => self.fixed_bits = used,
            11..=18 => {
                self.measured[at(11)] = used as i16;
                // "wenn != 11111 RWreg_19 Bit_0 = 0".
                if used != AUTOMATIC {
                    self.wanted &= !(1 << at(11));
                }
            }
            19 => {
                self.wanted = used as u8;
                // "wird ein Bit gesetzt so geht das jeweilige RWreg_11 bis _18 auf 11111".
                for relay in (0..RELAYS).filter(|relay| used >> relay & 1 == 1) {
                    self.measured[relay] = AUTOMATIC as i16;
                }
            }
            21..=28 => self.settings.off[at(21)] = used as i16,
            31..=38 => self.settings.on[at(31)] = used as i16,
            40 => self.settings.hold = used as u8,
            41..=48 => self.reset(now, u8::from(used == 1) << at(41)),
            49 => self.reset(now, used as u8),
            51..=58 => self.settings.on_delay[at(51)] = used,
            61..=68 => self.settings.run_on[at(61)] = used,
            69 => self.settings.negate = used as u8,
            _ => self.settings.cycle[at(71)] = used,
        }
        self.demand(now);
    }

    fn advance(&mut self, now: Time) {
        for relay in 0..RELAYS {
            let rules = self.rules(relay);
            self.relays[relay].advance(now, rules);
        }
        self.shown = self.states(now);
    }

    fn restart(&mut self, now: Time) {
        *self = Relays { settings: self.settings, ..Relays::new(now) };
    }

    fn forget(&mut self) {
        self.settings = FACTORY;
    }

    fn stimulate(&mut self, _now: Time, _stimulus: &Stimulus) -> Result<(), String> {
        Err("the relay board has relays and nothing to touch".into())
    }

    fn outputs(&self) -> Vec<(String, String)> {
        let name = |relay: usize| if self.shown >> relay & 1 == 1 { "ON" } else { "OFF" }.to_string();
        (0..RELAYS).map(|relay| (format!("relay_{}", relay + 1), name(relay))).collect()
    }

    fn eeprom(&self) -> Vec<u16> {
        let settings = &self.settings;
        let mut words = vec![settings.hold.into(), settings.negate.into()];
        words.extend(settings.off.map(|number| number as u16));
        words.extend(settings.on.map(|number| number as u16));
        words.extend([settings.on_delay, settings.run_on, settings.cycle].concat());
        words
    }

    fn load_eeprom(&mut self, words: &mut &[u16]) {
        let [hold, negate] = take_words(words);
        self.settings = Settings {
            hold: hold as u8,
            negate: negate as u8,
            off: take_words(words).map(|word| word as i16),
            on: take_words(words).map(|word| word as i16),
            on_delay: take_words(words),
            run_on: take_words(words),
            cycle: take_words(words),
        };
    }
}

#[cfg(test)]
mod tests;
