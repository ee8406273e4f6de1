//! MR-TP: two relays of two stages each, for fans, pumps or blinds, six inputs and two transistor
//! outputs (Softwarebeschreibung Modbus RTU V2.1, pages 36 to 43).

mod blind;
mod relay;

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Stimulus, Toggle, take_words};
use crate::simulator::metz_connect::Module;
use crate::simulator::metz_connect::holding::HoldingRegisters;
use crate::simulator::metz_connect::mr_tp::blind::{Blind, Kind, Settings, level};
use crate::simulator::metz_connect::mr_tp::relay::{Relay, Stage};
use crate::simulator::metz_connect::watchdog::{WATCHDOG, Watchdog};
use crate::simulator::pdu::{Exception, Request, bits_reply, check_span, words_reply, write_reply};

/// The device.
pub struct MrTp {
    /// What the bus wants: bits 0 and 1 the transistor outputs, 2 to 5 the relays. It stays as it was
    /// written, also where something else rules: the relays themselves are told by the inputs 8 to 15.
    coils: u16,
    /// Register 1, "Jalousie-Kommando (im Low-Byte)".
    command: u16,
    eeprom: Eeprom,
    watchdog: Watchdog,
    /// Closed contacts.
    inputs: [bool; INPUTS],
    toggles: [Toggle; RELAYS],
    relays: [Relay; RELAYS],
    /// The level that rules each relay.
    causes: [u16; RELAYS],
    blinds: [Blind; RELAYS],
    wind_blew: bool,
}

/// What is marked "Speicherung im EEPROM", besides register 66.
#[derive(Clone, Copy, Debug)]
struct Eeprom {
    /// Register 2: the mode and the flags.
    mode: u16,
    /// Register 3, "Grundeinstellung für Coils 0-5". The page says no more; as in the other chapters
    /// the coils take it at a start and when the watchdog expires.
    coils: u16,
    /// Registers 4 to 7, in units of 10 ms.
    times: [u16; 4],
}

/// The modes of pages 40 and 41.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Mode {
    /// 0, "Modbus AUS": of the relays only.
    Toggles,
    /// 1, "Switch 0-1-2".
    Switch012,
    /// 2, "Switch 1-0-2".
    Switch102,
    /// 3, "Sunblind 1": one blind at each relay.
    TwoBlinds,
    /// 4, "Sunblind 2": one motor between both relays.
    OneBlind,
}

const INPUTS: usize = 6;
const RELAYS: usize = 2;
const COILS: usize = 6;
const COIL_BITS: u16 = 0x3F;
const TIME_UNIT: Duration = Duration::from_millis(10);
const COMMAND_MAX: u16 = 4;
/// The inputs of page 40 that move blinds.
const BUTTONS: [(usize, Stage); 4] = [(0, Stage::One), (1, Stage::Two), (3, Stage::One), (4, Stage::Two)];
const WIND_INPUT: usize = 2;
const DOOR_INPUT: usize = 5;
/// Bits of the mode register (page 42): whether there is a contact, and whether it opens to tell.
const WIND: u16 = 1 << 15;
const WIND_OPENS: u16 = 1 << 14;
const DOOR: u16 = 1 << 13;
const DOOR_OPENS: u16 = 1 << 12;
const FACTORY: Eeprom = Eeprom { mode: 1, coils: 0, times: [200, 50, 6000, 100] };

impl MrTp {
    /// Its switches stand up, which is off in the factory's mode 1.
    pub fn new(now: Time) -> MrTp {
        MrTp {
            coils: 0,
            command: 0,
            eeprom: FACTORY,
            watchdog: Watchdog::new(now),
            inputs: [false; INPUTS],
            toggles: [Toggle::Up; RELAYS],
            relays: [Relay::new(now), Relay::new(now)],
            causes: [level::BUTTONS; RELAYS],
            blinds: [Blind::default(), Blind::default()],
            wind_blew: false,
        }
    }

    /// Discrete inputs 0 to 15 and input register 0 (page 36).
    fn status(&self) -> u16 {
        let inputs = self.inputs.iter().enumerate().map(|(number, closed)| u16::from(*closed) << number);
        let mut status = inputs.sum::<u16>() | (self.coils & 3) << 6;
        for (number, relay) in self.relays.iter().enumerate() {
            status |= (Stage::bits(relay.stage()) | self.causes[number] << 2) << (8 + 4 * number);
        }
        status
    }

    fn mode(&self) -> Mode {
        Mode::from_word(self.eeprom.mode).unwrap_or(Mode::Toggles)
    }

    fn settings(&self) -> Settings {
        let [held, short, long, rotation] = self.eeprom.times.map(|time| TIME_UNIT * time.into());
        let kind = Kind::from_bits(self.eeprom.mode >> 8 & 7).unwrap_or(Kind::Time);
        Settings { kind, held, short, long, rotation }
    }

    /// Whether the contact at an input is there, by the flag `installed`, and active.
    fn is_active(&self, input: usize, installed: u16, opens: u16) -> bool {
        let flags = self.eeprom.mode;
        flags & installed != 0 && self.inputs[input] != (flags & opens != 0)
    }

    /// Does what is due, and drives the relays.
    fn settle(&mut self, now: Time) {
        let (mode, settings) = (self.mode(), self.settings());
        let wind = mode.blinds() > 0 && self.is_active(WIND_INPUT, WIND, WIND_OPENS);
        let wind_rises = wind && !self.wind_blew;
        self.wind_blew = wind;
        // "Wenn der optionale Tür-Kontakt aktiv ist, wird das Schließen der Jalousie verhindert", by
        // whatever has a lower priority; the pages name one such contact and do not say of which
        // blind, so it is, like the wind's, of both.
        let door = self.is_active(DOOR_INPUT, DOOR, DOOR_OPENS);
        for (number, blind) in self.blinds.iter_mut().enumerate().take(mode.blinds()) {
            let relay = &self.relays[number];
            if wind_rises {
                blind.wind_rises(now, relay, &settings);
            }
            blind.pass(now, relay, &settings);
        }
        for number in 0..RELAYS {
            // Both relays are the poles of one motor: what is said of the first is said of both, and
            // nothing of the second switch, which has no blind to move.
            let number_of_blind = if mode == Mode::OneBlind { 0 } else { number };
            let blind = &mut self.blinds[number_of_blind];
            let by_hand = mode.by_hand(self.toggles[number_of_blind]);
            let (cause, stage) = match (mode, by_hand) {
                (Mode::Toggles, _) | (_, Some(_)) => (level::TOGGLE, by_hand),
                // "Sonst 3: Kippschalter, 0: Modbus-Coils" (page 36).
                (Mode::Switch012 | Mode::Switch102, None) => {
                    (0, Stage::from_bits(self.coils >> (2 + 2 * number)))
                }
                (Mode::TwoBlinds | Mode::OneBlind, None) => blind.demand(self.command, wind),
            };
            if cause != level::BUTTONS {
                blind.forget_buttons();
            }
            let is_prevented =
                mode.blinds() > 0 && door && cause < level::CONTACTS && stage == Some(Stage::Two);
            let (cause, stage) = if is_prevented { (level::CONTACTS, None) } else { (cause, stage) };
            self.causes[number] = cause;
            self.relays[number].drive(now, stage);
        }
    }

    /// A contact changes, which in a mode with blinds may be a button.
    fn set_input(&mut self, now: Time, input: usize, closed: bool) {
        if self.inputs[input] == closed {
            return;
        }
        self.inputs[input] = closed;
        let settings = self.settings();
        let button = BUTTONS.iter().position(|(button, _)| *button == input);
        if let Some(number) = button.filter(|number| number / 2 < self.mode().blinds()) {
            let (blind, relay) = (&mut self.blinds[number / 2], &self.relays[number / 2]);
            let stage = BUTTONS[number].1;
            if closed {
                blind.press(now, stage, relay, &settings);
            } else {
                blind.release(now, stage, relay, &settings);
            }
        }
    }

    fn write_coil(&mut self, coil: usize, on: bool) {
        self.coils = self.coils & !(1 << coil) | u16::from(on) << coil;
    }

    /// What goes on under one mode or kind of pulse ends when another is set.
    fn forget_blinds(&mut self) {
        self.blinds = [Blind::default(), Blind::default()];
        self.wind_blew = false;
    }
}

impl Mode {
    /// "Die Betriebsart wird mit den unteren Bits des Betriebsart-Registers ausgewählt."
    fn from_word(word: u16) -> Option<Mode> {
        match word & 0xFF {
            0 => Some(Mode::Toggles),
            1 => Some(Mode::Switch012),
            2 => Some(Mode::Switch102),
            3 => Some(Mode::TwoBlinds),
            4 => Some(Mode::OneBlind),
            _ => None,
        }
    }

    /// How many blinds there are.
    fn blinds(self) -> usize {
        match self {
            Mode::Toggles | Mode::Switch012 | Mode::Switch102 => 0,
            Mode::TwoBlinds => 2,
            Mode::OneBlind => 1,
        }
    }

    /// The stage that a switch sets. In its off position it leaves the relay to the levels below, or
    /// no position would be left for those; page 26 says of another device's switches that they "haben
    /// Priorität".
    fn by_hand(self, toggle: Toggle) -> Option<Stage> {
        match (self, toggle) {
            (Mode::Switch012, Toggle::Up) => None,
            (Mode::Switch012, Toggle::Middle) | (_, Toggle::Up) => Some(Stage::One),
            (_, Toggle::Down) => Some(Stage::Two),
            (_, Toggle::Middle) => None,
        }
    }
}

/// Whether the tables of pages 40 to 42 have a word's mode and its kind of pulse. The flags besides are
/// for blinds, and are kept in all modes.
fn is_mode(word: u16) -> bool {
    Mode::from_word(word).is_some() && Kind::from_bits(word >> 8 & 7).is_some()
}

impl HoldingRegisters for MrTp {
    /// "Gültige Register Startadresse 0 .. 7 oder 66, gültige Anzahl an Register 8 oder 1", and 1 to 8
    /// where they are written (pages 38 and 39).
    fn check(first: u16, count: usize) -> Result<(), Exception> {
        let allowed = if first == WATCHDOG { (first, first) } else { (0, 7) };
        check_span(first, count, 8, allowed)
    }

    fn read(&self, register: u16) -> u16 {
        match register {
            0 => self.coils,
            1 => self.command,
            2 => self.eeprom.mode,
            3 => self.eeprom.coils,
            4..=7 => self.eeprom.times[usize::from(register - 4)],
            _ => self.watchdog.time,
        }
    }

    /// The manual does not say what happens to a command, a mode or a kind of pulse that is in none of
    /// its tables: such a word is refused.
    fn write(&mut self, now: Time, first: u16, words: &[u16]) -> Result<(), Exception> {
        let is_allowed = |(register, word): (u16, &u16)| match register {
            1 => word & 0xFF <= COMMAND_MAX,
            2 => is_mode(*word),
            _ => true,
        };
        if !(first..).zip(words).all(is_allowed) {
            return Err(Exception::Value);
        }
        let (mode, command) = (self.eeprom.mode, self.command);
        for (register, word) in (first..).zip(words) {
            match register {
                // "Bits 6 – 15 haben keine Funktion."
                0 => self.coils = word & COIL_BITS,
                1 => self.command = word & 0xFF,
                2 => self.eeprom.mode = *word,
                3 => self.eeprom.coils = word & COIL_BITS,
                4..=7 => self.eeprom.times[usize::from(register - 4)] = *word,
                _ => self.watchdog.time = *word,
            }
        }
        if self.eeprom.mode != mode {
            self.forget_blinds();
        }
        if self.command != command {
            let (settings, blinds) = (self.settings(), self.mode().blinds());
            for (blind, relay) in self.blinds.iter_mut().zip(&self.relays).take(blinds) {
                blind.begin_command(now, self.command, relay, &settings);
            }
        }
        self.settle(now);
        Ok(())
    }
}

impl Module for MrTp {
    const PRODUCT: &'static str = "MR-TP";
    const VERSION: &'static str = "V1.2";
    /// Page 38 writes "15 (0x15)", which is 21; the specification's number for it is 15, 0x0F.
    const FUNCTIONS: &'static [u8] = &[1, 2, 3, 4, 5, 6, 15, 16];

    fn serve(&mut self, now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        let last_coil = COILS as u16 - 1;
        let bits = |word: u16, first: u16, count: u16| {
            (first..first + count).map(|bit| word >> bit & 1 == 1).collect::<Vec<bool>>()
        };
        match *request {
            Request::Read { function: 1, first, count } => {
                check_span(first, count.into(), COILS, (0, last_coil))?;
                Ok(bits_reply(1, &bits(self.coils, first, count)))
            }
            Request::Read { function: 2, first, count } => {
                check_span(first, count.into(), 16, (0, 15))?;
                Ok(bits_reply(2, &bits(self.status(), first, count)))
            }
            Request::Read { function: 4, first, count } => {
                check_span(first, count.into(), 1, (0, 0))?;
                Ok(words_reply(4, &[self.status()]))
            }
            Request::WriteCoil { address, value } => {
                if value != 0 && value != 0xFF00 {
                    return Err(Exception::Value);
                }
                check_span(address, 1, 1, (0, last_coil))?;
                self.write_coil(address.into(), value != 0);
                self.settle(now);
                Ok(write_reply(5, address, value))
            }
            Request::WriteCoils { first, ref values } => {
                check_span(first, values.len(), COILS, (0, last_coil))?;
                for (coil, on) in (usize::from(first)..).zip(values) {
                    self.write_coil(coil, *on);
                }
                self.settle(now);
                Ok(write_reply(15, first, values.len() as u16))
            }
            _ => self.serve_holding(now, request),
        }
    }

    fn message_for_this_device(&mut self, now: Time) {
        self.watchdog.feed(now);
    }

    fn advance(&mut self, now: Time) {
        // One thing after the other, since each may begin what ends before now.
        loop {
            let settings = self.settings();
            let blinds = self.blinds.iter().filter_map(|blind| blind.wakes_at(&settings));
            let relays = self.relays.iter().filter_map(Relay::wakes_at);
            let next = blinds.chain(relays).chain(self.watchdog.expires_at()).min();
            let Some(due) = next.filter(|due| *due <= now) else { return };
            if self.watchdog.expires(due) {
                self.coils = self.eeprom.coils;
            }
            self.settle(due);
        }
    }

    fn restart(&mut self, now: Time) {
        self.relays.iter_mut().for_each(|relay| relay.drive(now, None));
        self.coils = self.eeprom.coils;
        self.command = 0;
        self.watchdog.feed(now);
        self.forget_blinds();
        self.settle(now);
    }

    fn stimulate(&mut self, now: Time, stimulus: &Stimulus) -> Result<(), String> {
        match *stimulus {
            Stimulus::Input { input: input @ 1..=6, signal } => {
                let closed = signal.contact().ok_or("an input of MR-TP takes a contact")?;
                self.set_input(now, usize::from(input) - 1, closed);
            }
            Stimulus::Input { input, .. } => {
                return Err(format!("input {input} is not there; MR-TP has 1 to 6"));
            }
            Stimulus::Toggle { toggle: toggle @ 1..=2, position } => {
                self.toggles[usize::from(toggle) - 1] = position;
            }
            Stimulus::Toggle { toggle, .. } => {
                return Err(format!("toggle {toggle} is not there; MR-TP has 1 and 2"));
            }
            _ => return Err("MR-TP has inputs and two toggle switches and nothing else to touch".into()),
        }
        self.settle(now);
        Ok(())
    }

    fn outputs(&self) -> Vec<(String, String)> {
        let transistor = |number: usize| if self.coils >> number & 1 == 1 { "ON" } else { "OFF" };
        let transistors =
            (0..2).map(|number| (format!("output_{}", number + 1), transistor(number).to_string()));
        let relays = self.relays.iter().enumerate().map(|(number, relay)| {
            let stage = match relay.stage() {
                None => "OFF",
                Some(Stage::One) => "STAGE 1",
                Some(Stage::Two) => "STAGE 2",
            };
            (format!("relay_{}", number + 1), stage.to_string())
        });
        transistors.chain(relays).collect()
    }

    fn eeprom(&self) -> Vec<u16> {
        let Eeprom { mode, coils, times } = self.eeprom;
        let mut words = vec![mode, coils, self.watchdog.time];
        words.extend(times);
        words
    }

    fn load_eeprom(&mut self, mut words: &[u16]) {
        let words = &mut words;
        let [mode, coils, watchdog] = take_words(words);
        self.watchdog.time = watchdog;
        let mode = if is_mode(mode) { mode } else { FACTORY.mode };
        self.eeprom = Eeprom { mode, coils: coils & COIL_BITS, times: take_words(words) };
    }
}

#[cfg(test)]
mod tests;
