//! The relay board with eight relays (chapters 6, 6.1 and 7 to 9 of the manual).
//!
//! Not simulated: the operation as a master (address 255), which is no device on somebody's line.

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Addressed, SimulatedDevice, Stimulus, check_eeprom_length, take_words};
use crate::simulator::fuehlersysteme::relay::{Relay, Rules};
use crate::simulator::pdu::{Exception, Request, exception_reply, words_reply, write_reply};

/// The board.
pub struct Relay8 {
    settings: Settings,
    /// RWreg_01 to 08: 0, 1, or 11111 for automatic.
    fixed: [u16; RELAYS],
    /// RWreg_09: bits, or 11111.
    fixed_bits: u16,
    /// RWreg_11 to 18: measured values, or 11111.
    measured: [i16; RELAYS],
    /// RWreg_19.
    wanted: u8,
    /// RWreg_90 to 99.
    scratch: [u16; 10],
    /// Rreg_100 to 227, written through Wreg_500 to 627.
    special: [u16; SPECIALS],
    relays: [Relay; RELAYS],
    /// The relays as they stood when time last passed: what a person in front of the board sees.
    shown: u8,
}

/// What is marked with a star, and so "auch gespeichert".
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Settings {
    customer_code: u16,
    off: [i16; RELAYS],
    on: [i16; RELAYS],
    hold: u8,
    on_delay: [u16; RELAYS],
    run_on: [u16; RELAYS],
    negate: u8,
    cycle: [u16; RELAYS],
    /// RWreg_200 to 327. The table says "0 bis 327", chapter 7 "RWreg_200 ... (Aktor: ..._327)".
    master: [u16; SPECIALS],
}

const RELAYS: usize = 8;
const SPECIALS: usize = 128;
const AUTOMATIC: u16 = 11111;
const SYSTEM_CODE: u16 = 0x5000;
/// Rreg_79, told as day, month and year run together: the manual's own example.
const SOFTWARE: u16 = 1018;
const CUSTOMER_CODE_MAX: u16 = 0x7AFF;
/// "max. 10" three times in words, against ">= 0x000a" for the exception: ten are taken as allowed.
const REGISTERS_MAX: usize = 10;
/// "Ist es dem System nicht möglich innerhalb von 250ms zu antworten, so wird auch keine Antwort mehr
/// stattfinden."
const ANSWER_TIME: Duration = Duration::from_millis(250);

const FACTORY: Settings = Settings {
    customer_code: 0x5300,
    off: [0; RELAYS],
    on: [1; RELAYS],
    hold: 0,
    on_delay: [0; RELAYS],
    run_on: [0; RELAYS],
    negate: 0,
    cycle: [0; RELAYS],
    master: [0; SPECIALS],
};

/// What remains to be done when the reply is on its way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Restart {
    /// RWreg_79 = 10.
    Plain,
    /// RWreg_79 = 20.
    Factory,
}

/// What a write has come to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Written {
    /// A value was outside its range, was limited, and is used all the same.
    limited: bool,
    restart: Option<Restart>,
}

impl Relay8 {
    pub fn new(now: Time) -> Relay8 {
        Relay8 {
            settings: FACTORY,
            fixed: [AUTOMATIC; RELAYS],
            fixed_bits: AUTOMATIC,
            measured: [AUTOMATIC as i16; RELAYS],
            wanted: 0,
            scratch: [0; 10],
            special: [0; SPECIALS],
            relays: [Relay::new(now); RELAYS],
            shown: 0,
        }
    }

    fn answer(&mut self, now: Time, pdu: &[u8]) -> Result<(Vec<u8>, Option<Restart>), Vec<u8>> {
        let function = pdu.first().copied().unwrap_or(0);
        let refuse = |exception| exception_reply(function, exception);
        // The four codes of chapter 8. The manual has no word for others: exception 1 is the rule.
        if !matches!(function, 3 | 4 | 6 | 16) {
            return Err(refuse(Exception::Function));
        }
        let check_count = |count: usize| match count {
            1..=REGISTERS_MAX => Ok(()),
            _ => Err(refuse(Exception::Value)),
        };
        match Request::parse(pdu).map_err(refuse)? {
            Request::Read { function, first, count } => {
                check_count(count.into())?;
                let register = |number: u32| match u16::try_from(number) {
                    Ok(number) if function == 3 => self.read_holding(number),
                    Ok(number) => self.read_input(now, number),
                    Err(_) => None,
                };
                let first = u32::from(first);
                let words: Option<Vec<u16>> = (first..first + u32::from(count)).map(register).collect();
                let words = words.ok_or_else(|| refuse(Exception::Address))?;
                Ok((words_reply(function, &words), None))
            }
            Request::WriteRegister { address, word } => {
                let written = self.write(now, address, &[word]).map_err(refuse)?;
                if written.limited {
                    // The manual prints 0x84 here, the exception of function 4.
                    return Err(exception_reply(4, Exception::Value));
                }
                Ok((write_reply(6, address, word), written.restart))
            }
            Request::WriteRegisters { first, words } => {
                check_count(words.len())?;
                let written = self.write(now, first, &words).map_err(refuse)?;
                if written.limited {
                    return Err(refuse(Exception::Value));
                }
                Ok((write_reply(16, first, words.len() as u16), written.restart))
            }
            _ => Err(refuse(Exception::Function)),
        }
    }

    fn read_input(&self, now: Time, register: u16) -> Option<u16> {
        match register {
            0 => Some(SYSTEM_CODE),
            1..=8 => Some(u16::from(self.states(now) >> (register - 1) & 1)),
            9 => Some(self.states(now).into()),
            79 => Some(SOFTWARE),
            100..=227 => Some(self.special[usize::from(register - 100)]),
            _ => None,
        }
    }

    /// `None`: a hole, or a register that can only be written.
    fn read_holding(&self, register: u16) -> Option<u16> {
        let at = |first: u16| usize::from(register - first);
        let settings = &self.settings;
        Some(match register {
            0 => settings.customer_code,
            1..=8 => self.fixed[at(1)],
            9 => self.fixed_bits,
            11..=18 => self.measured[at(11)] as u16,
            19 => self.wanted.into(),
            21..=28 => settings.off[at(21)] as u16,
            31..=38 => settings.on[at(31)] as u16,
            40 => settings.hold.into(),
            // The reset commands are 0 again at once, and so are the two kinds of restart.
            41..=49 | 79 => 0,
            51..=58 => settings.on_delay[at(51)],
            61..=68 => settings.run_on[at(61)],
            69 => settings.negate.into(),
            71..=78 => settings.cycle[at(71)],
            90..=99 => self.scratch[at(90)],
            200..=327 => settings.master[at(200)],
            _ => return None,
        })
    }

    /// Writes all registers, limited to their ranges; none of them where one is not there.
    fn write(&mut self, now: Time, first: u16, words: &[u16]) -> Result<Written, Exception> {
        let last = usize::from(first) + words.len() - 1;
        let is_there = |register: u16| self.read_holding(register).is_some() || is_write_only(register);
        if last > 0xFFFF || !(first..=last as u16).all(is_there) {
            return Err(Exception::Address);
        }
        let mut written = Written::default();
        for (register, word) in (first..).zip(words) {
            let one = self.write_one(now, register, *word);
            written.limited |= one.limited;
            written.restart = written.restart.or(one.restart);
        }
        self.copy_registers(now);
        Ok(written)
    }

    fn write_one(&mut self, now: Time, register: u16, word: u16) -> Written {
        let at = |first: u16| usize::from(register - first);
        let used = self.limit(register, word);
        let mut restart = None;
        match register {
            0 => self.settings.customer_code = used,
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
            71..=78 => self.settings.cycle[at(71)] = used,
            79 => {
                restart = match used {
                    10 => Some(Restart::Plain),
                    20 => Some(Restart::Factory),
                    _ => None,
                }
            }
            90..=99 => self.scratch[at(90)] = used,
            200..=327 => self.settings.master[at(200)] = used,
            _ => self.special[at(500)] = used,
        }
        self.demand(now);
        Written { limited: used != word, restart }
    }

    /// "Werden Werte übertragen, welche außerhalb des Messbereiches liegen, werden diese auf den
    /// Messbereich begrenzt und verwendet."
    fn limit(&self, register: u16, word: u16) -> u16 {
        let number = word as i16;
        let at = |first: u16| usize::from(register - first);
        match register {
            // The note beside it wants a letter in the high byte; the range, which is what is
            // checked, begins at 0.
            0 => word.min(CUSTOMER_CODE_MAX),
            1..=9 | 11..=18 if word == AUTOMATIC => word,
            1..=8 | 41..=48 => word.min(1),
            9 | 19 | 40 | 49 | 69 => word.min(255),
            11..=18 => number.clamp(-9999, 9999) as u16,
            // "Ausschaltschwelle… kleiner Einschaltschwelle…": each bounds the other's range.
            21..=28 => number.clamp(-9999, self.settings.on[at(21)] - 1) as u16,
            31..=38 => number.clamp(self.settings.off[at(31)] + 1, 9999) as u16,
            51..=58 | 61..=68 => word.min(1800),
            71..=78 => word.min(60),
            // No measuring range to be limited to: another number does nothing.
            79 if !matches!(word, 0 | 10 | 20) => 0,
            _ => word,
        }
    }

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

    /// Chapter 7, "Sonderfall nur Gerätebezogener Datentransfer": pairs of RWreg_200 to 327 that name
    /// the device itself (255 reads an Rreg, 254 an RWreg) are always carried out.
    fn copy_registers(&mut self, now: Time) {
        for pair in (0..SPECIALS).step_by(2) {
            let [from, source] = self.settings.master[pair].to_be_bytes().map(u16::from);
            let [to, target] = self.settings.master[pair + 1].to_be_bytes().map(u16::from);
            // "Verwendete Adr. 00 sowie Reg. 00 haben hierbei keine Funktionen." A target of 79
            // would restart the device for ever.
            if from < 254 || to < 254 || source == 0 || target == 0 || target == 79 {
                continue;
            }
            let word = if from == 255 { self.read_input(now, source) } else { self.read_holding(source) };
            let Some(word) = word else { continue };
            self.special[pair] = word;
            self.special[pair + 1] = self.settings.customer_code;
            if (100..=227).contains(&target) {
                self.special[usize::from(target - 100)] = word;
            } else if self.read_holding(target).is_some_and(|there| there != word) {
                self.write_one(now, target, word);
            }
        }
    }
}

/// Wreg_500 to 627.
fn is_write_only(register: u16) -> bool {
    (500..500 + SPECIALS as u16).contains(&register)
}

impl SimulatedDevice for Relay8 {
    fn request(&mut self, now: Time, addressed: Addressed, pdu: &[u8]) -> Option<Vec<u8>> {
        self.advance(now);
        let reply = match self.answer(now, pdu) {
            Ok((reply, restart)) => {
                if restart == Some(Restart::Factory) {
                    self.settings = FACTORY;
                }
                if restart.is_some() {
                    self.restart(now);
                }
                reply
            }
            Err(refusal) => refusal,
        };
        self.advance(now);
        (addressed == Addressed::Unit).then_some(reply)
    }

    fn advance(&mut self, now: Time) {
        for relay in 0..RELAYS {
            let rules = self.rules(relay);
            self.relays[relay].advance(now, rules);
        }
        self.copy_registers(now);
        self.shown = self.states(now);
    }

    fn restart(&mut self, now: Time) {
        *self = Relay8 { settings: self.settings, ..Relay8::new(now) };
        self.advance(now);
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
        let mut words = vec![settings.customer_code, settings.hold.into(), settings.negate.into()];
        words.extend(settings.off.map(|number| number as u16));
        words.extend(settings.on.map(|number| number as u16));
        words.extend([settings.on_delay, settings.run_on, settings.cycle].concat());
        words.extend(settings.master);
        words
    }

    fn load_eeprom(&mut self, now: Time, mut words: &[u16]) -> Result<(), String> {
        check_eeprom_length(words, self.eeprom().len())?;
        let words = &mut words;
        let [customer_code, hold, negate] = take_words(words);
        self.settings = Settings {
            customer_code,
            hold: hold as u8,
            negate: negate as u8,
            off: take_words(words).map(|word| word as i16),
            on: take_words(words).map(|word| word as i16),
            on_delay: take_words(words),
            run_on: take_words(words),
            cycle: take_words(words),
            master: take_words(words),
        };
        // Somebody may have edited the file: what no write could have left is brought into range.
        for (off, on) in self.settings.off.iter_mut().zip(&mut self.settings.on) {
            *on = (*on).clamp(-9998, 9999);
            *off = (*off).clamp(-9999, *on - 1);
        }
        self.restart(now);
        Ok(())
    }

    fn gives_up_after(&self) -> Option<Duration> {
        Some(ANSWER_TIME)
    }
}

#[cfg(test)]
mod tests;
