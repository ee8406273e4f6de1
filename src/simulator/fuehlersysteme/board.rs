//! What the devices of FuehlerSysteme have in common: the requests (chapters 8 and 9), and the
//! registers that every table of chapters 3 and 6 has, with chapter 7 behind them.
//!
//! Not simulated: the operation as a master (address 255), which is no device on somebody's line.

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Addressed, SimulatedDevice, Stimulus, check_eeprom_length, take_words};
use crate::simulator::pdu::{Exception, Request, exception_reply, words_reply, write_reply};

/// One board's own tables: its registers between the common ones, its process side, what it stores.
pub trait Table: Send {
    /// Whether RWreg_90 to 99 are in its table.
    const HAS_SCRATCH: bool;
    /// How many registers there are from RWreg_200, from Rreg_100 and from Wreg_500 on: the boards of
    /// chapter 6 have them to RWreg_327, Rreg_227 and Wreg_627. An even number.
    const SPECIALS: u16 = 128;
    /// Whether RWreg_79 takes numbers that mean nothing: the range is "10, 20" in chapter 6.
    const RESTART_TAKES_ALL: bool = false;

    /// A board fresh from the factory.
    fn new(now: Time) -> Self;
    /// Rreg_00.
    fn system_code(&self) -> u16;
    /// An Rreg; `None` is a hole.
    fn read_input(&self, now: Time, register: u16) -> Option<u16>;
    /// This Rreg has just been told on the bus.
    fn told(&mut self, _now: Time, _register: u16) {}
    /// An RWreg; `None` is a hole.
    fn read_holding(&self, register: u16) -> Option<u16>;
    /// The word that is used in place of one that is written to an RWreg.
    fn limit(&self, register: u16, word: u16) -> u16;
    /// Writes a limited word.
    fn write(&mut self, now: Time, register: u16, word: u16);
    fn advance(&mut self, now: Time);
    /// Starts anew with what is stored.
    fn restart(&mut self, now: Time);
    /// Puts what is stored back to what it left the factory with.
    fn forget(&mut self);
    fn stimulate(&mut self, now: Time, stimulus: &Stimulus) -> Result<(), String>;
    fn outputs(&self) -> Vec<(String, String)>;
    /// What is marked with a star, and so "auch gespeichert".
    fn eeprom(&self) -> Vec<u16>;
    /// Takes as many words as [`Table::eeprom`] gives.
    fn load_eeprom(&mut self, words: &mut &[u16]);
}

/// A board.
pub struct Board<T> {
    table: T,
    /// RWreg_00. Stored.
    customer_code: u16,
    /// RWreg_200 to 327. Stored. One table says "0 bis 327", chapter 7 "RWreg_200 ... (Aktor: ..._327)".
    master: Vec<u16>,
    /// RWreg_90 to 99.
    scratch: [u16; 10],
    /// Rreg_100 to 227, written through Wreg_500 to 627.
    special: Vec<u16>,
}

/// The word that gives a fixed value back to the board itself.
pub const AUTOMATIC: u16 = 11111;
const MASTER: u16 = 200;
const SPECIAL: u16 = 100;
const SPECIAL_WRITTEN: u16 = 500;
/// Rreg_79, told as day, month and year run together: the manual's own example.
const SOFTWARE: u16 = 1018;
const CUSTOMER_CODE: u16 = 0x5300;
const CUSTOMER_CODE_MAX: u16 = 0x7AFF;
/// "max. 10" three times in words, against ">= 0x000a" for the exception: ten are taken as allowed.
const REGISTERS_MAX: usize = 10;
/// "Ist es dem System nicht möglich innerhalb von 250ms zu antworten, so wird auch keine Antwort mehr
/// stattfinden."
const ANSWER_TIME: Duration = Duration::from_millis(250);

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

impl<T: Table> Board<T> {
    pub fn new(now: Time) -> Board<T> {
        Board {
            table: T::new(now),
            customer_code: CUSTOMER_CODE,
            master: vec![0; T::SPECIALS.into()],
            scratch: [0; 10],
            special: vec![0; T::SPECIALS.into()],
        }
    }

    fn answer(
        &mut self,
        now: Time,
        addressed: Addressed,
        pdu: &[u8],
    ) -> Result<(Vec<u8>, Option<Restart>), Vec<u8>> {
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
                let words =
                    self.read(now, function, first, count).ok_or_else(|| refuse(Exception::Address))?;
                if function == 4 && addressed == Addressed::Unit {
                    (first..first + count).for_each(|register| self.table.told(now, register));
                }
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

    /// The words of function 3 or 4; `None` where one of them is not there.
    fn read(&self, now: Time, function: u8, first: u16, count: u16) -> Option<Vec<u16>> {
        let last = first.checked_add(count - 1)?;
        let read = |register: u16| {
            if function == 3 { self.read_holding(register) } else { self.read_input(now, register) }
        };
        (first..=last).map(read).collect()
    }

    fn read_input(&self, now: Time, register: u16) -> Option<u16> {
        match register {
            0 => Some(self.table.system_code()),
            79 => Some(SOFTWARE),
            _ => match special::<T>(SPECIAL, register) {
                Some(at) => Some(self.special[at]),
                None => self.table.read_input(now, register),
            },
        }
    }

    /// `None`: a hole, or a register that can only be written.
    fn read_holding(&self, register: u16) -> Option<u16> {
        match register {
            0 => Some(self.customer_code),
            // Both kinds of restart are over before anybody can ask.
            79 => Some(0),
            90..=99 if T::HAS_SCRATCH => Some(self.scratch[usize::from(register - 90)]),
            _ => match special::<T>(MASTER, register) {
                Some(at) => Some(self.master[at]),
                None => self.table.read_holding(register),
            },
        }
    }

    /// Writes all registers, limited to their ranges; none of them where one is not there.
    fn write(&mut self, now: Time, first: u16, words: &[u16]) -> Result<Written, Exception> {
        let last = usize::from(first) + words.len() - 1;
        let is_there = |register: u16| {
            self.read_holding(register).is_some() || special::<T>(SPECIAL_WRITTEN, register).is_some()
        };
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
        let used = self.limit(register, word);
        let mut restart = None;
        match register {
            0 => self.customer_code = used,
            79 => {
                restart = match used {
                    10 => Some(Restart::Plain),
                    20 => Some(Restart::Factory),
                    _ => None,
                }
            }
            90..=99 => self.scratch[usize::from(register - 90)] = used,
            SPECIAL_WRITTEN.. => self.special[usize::from(register - SPECIAL_WRITTEN)] = used,
            MASTER.. => self.master[usize::from(register - MASTER)] = used,
            _ => self.table.write(now, register, used),
        }
        Written { limited: used != word, restart }
    }

    /// "Werden Werte übertragen, welche außerhalb des Messbereiches liegen, werden diese auf den
    /// Messbereich begrenzt und verwendet."
    fn limit(&self, register: u16, word: u16) -> u16 {
        match register {
            // The note beside it wants a letter in the high byte; the range, which is what is
            // checked, begins at 0.
            0 => word.min(CUSTOMER_CODE_MAX),
            // No measuring range to be limited to: another number does nothing.
            79 if !matches!(word, 0 | 10 | 20) && !T::RESTART_TAKES_ALL => 0,
            79 | 90..=99 | MASTER.. => word,
            _ => self.table.limit(register, word),
        }
    }

    /// Chapter 7, "Sonderfall nur Gerätebezogener Datentransfer": pairs of RWreg_200 to 327 that name
    /// the device itself (255 reads an Rreg, 254 an RWreg) are always carried out.
    fn copy_registers(&mut self, now: Time) {
        for pair in (0..self.master.len()).step_by(2) {
            let [from, source] = self.master[pair].to_be_bytes().map(u16::from);
            let [to, target] = self.master[pair + 1].to_be_bytes().map(u16::from);
            // "Verwendete Adr. 00 sowie Reg. 00 haben hierbei keine Funktionen." A target of 79
            // would restart the device for ever.
            if from < 254 || to < 254 || source == 0 || target == 0 || target == 79 {
                continue;
            }
            let word = if from == 255 { self.read_input(now, source) } else { self.read_holding(source) };
            let Some(word) = word else { continue };
            self.special[pair] = word;
            self.special[pair + 1] = self.customer_code;
            if let Some(at) = special::<T>(SPECIAL, target) {
                self.special[at] = word;
                // "… und auch der Kundencode weitergegeben und in das darauffolgende Register eingetragen".
                if let Some(next) = self.special.get_mut(at + 1) {
                    *next = self.customer_code;
                }
            } else if self.read_holding(target).is_some_and(|there| there != word) {
                self.write_one(now, target, word);
            }
        }
    }
}

/// The place of a register among those of chapter 7 that begin at `first`.
fn special<T: Table>(first: u16, register: u16) -> Option<usize> {
    let at = register.checked_sub(first)?;
    (at < T::SPECIALS).then_some(at.into())
}

impl<T: Table> SimulatedDevice for Board<T> {
    fn request(&mut self, now: Time, addressed: Addressed, pdu: &[u8]) -> Option<Vec<u8>> {
        self.advance(now);
        let reply = match self.answer(now, addressed, pdu) {
            Ok((reply, restart)) => {
                if restart == Some(Restart::Factory) {
                    self.customer_code = CUSTOMER_CODE;
                    self.master.fill(0);
                    self.table.forget();
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
        self.table.advance(now);
        self.copy_registers(now);
        // What has been copied shows at once.
        self.table.advance(now);
    }

    fn restart(&mut self, now: Time) {
        self.scratch = [0; 10];
        self.special.fill(0);
        self.table.restart(now);
        self.advance(now);
    }

    fn stimulate(&mut self, now: Time, stimulus: &Stimulus) -> Result<(), String> {
        self.advance(now);
        self.table.stimulate(now, stimulus)?;
        self.advance(now);
        Ok(())
    }

    fn outputs(&self) -> Vec<(String, String)> {
        self.table.outputs()
    }

    fn eeprom(&self) -> Vec<u16> {
        let mut words = vec![self.customer_code];
        words.extend(self.table.eeprom());
        words.extend(&self.master);
        words
    }

    fn load_eeprom(&mut self, now: Time, mut words: &[u16]) -> Result<(), String> {
        check_eeprom_length(words, self.eeprom().len())?;
        let words = &mut words;
        [self.customer_code] = take_words(words);
        self.table.load_eeprom(words);
        self.master.copy_from_slice(words);
        self.restart(now);
        Ok(())
    }

    fn identity_register(&self) -> Option<(u8, u16, u16)> {
        Some((4, 0, 0x1000))
    }

    fn gives_up_after(&self) -> Option<Duration> {
        Some(ANSWER_TIME)
    }
}
