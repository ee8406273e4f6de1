//! MR-DIO4/2: two channels of two inputs and a relay with a hand switch, each in one of ten modes
//! (Softwarebeschreibung Modbus RTU V2.1, pages 21 to 35).

mod channel;
mod damper;
mod fire_damper;
mod mode;
mod movement;

use crate::engine::time::Time;
use crate::simulator::device::{Stimulus, take_words};
use crate::simulator::metz_connect::holding::HoldingRegisters;
use crate::simulator::metz_connect::mr_dio42::channel::{
    Channel, FACTORY, Settings, logic_from_word, logic_without,
};
use crate::simulator::metz_connect::mr_dio42::damper::Alarm;
use crate::simulator::metz_connect::mr_dio42::mode::{Mode, Position};
use crate::simulator::metz_connect::mr_dio42::movement::TENTH;
use crate::simulator::metz_connect::switches::named;
use crate::simulator::metz_connect::watchdog::{WATCHDOG, Watchdog};
use crate::simulator::metz_connect::{LINE_REGISTER, Module, contacts};
use crate::simulator::pdu::{Exception, Request, bits_reply, check_span, words_reply, write_reply};

/// The two channels.
pub struct MrDio42 {
    channels: [Channel; CHANNELS],
    /// What is connected to the inputs; a channel sees it when it looks.
    contacts: [bool; INPUTS],
    /// RelayDefault. EEPROM.
    defaults: u8,
    watchdog: Watchdog,
    /// When the modes for dampers next read and update their registers.
    next_tick: Time,
    /// InputReg as it was last, InputRegToggelLH and InputRegToggelHL.
    told: u16,
    toggled_by_rise: u16,
    toggled_by_fall: u16,
}

const CHANNELS: usize = 2;
const INPUTS: usize = 4;
const INPUT_BITS: u16 = 0x000F;
/// Addresses 0 to 15 of discrete inputs and of coils, which fill one register each.
const BITS_LAST: u16 = 15;
const INPUT_LAST: u16 = 2;
const HOLDING_LAST: u16 = 19;
const RELAY_BITS: u8 = 0b11;
/// The first coil of RelaySet and of FaultReset.
const RELAY_SET: usize = 4;
const FAULT_RESET: usize = 8;

impl MrDio42 {
    pub fn new(now: Time) -> MrDio42 {
        MrDio42 {
            channels: [Channel::new(now), Channel::new(now)],
            contacts: [false; INPUTS],
            defaults: 0,
            watchdog: Watchdog::new(now),
            next_tick: now + TENTH,
            told: 0,
            toggled_by_rise: 0,
            toggled_by_fall: 0,
        }
    }

    /// Discrete inputs 0 to 15, and InputReg: inputs, and the faults of Fire_Damper.
    fn discrete_inputs(&self) -> u16 {
        let mut word = 0;
        for (number, channel) in self.channels.iter().enumerate() {
            let [first, second] = channel.seen;
            word |= (u16::from(first) | u16::from(second) << 1) << (2 * number);
            if let Some(fault) = channel.fire_damper.fault {
                word |= (1 << 8 | 1 << (10 + 2 * fault as usize)) << number;
            }
        }
        word
    }

    /// Coils 0 to 15, and OutputReg. Coils 6, 7 and 10 to 15 have no name and read 0.
    fn coils(&self) -> u16 {
        let mut word = 0;
        for (number, channel) in self.channels.iter().enumerate() {
            let bits = u16::from(channel.relay)
                | u16::from(channel.by_hand) << 2
                | u16::from(channel.wanted) << RELAY_SET
                | u16::from(channel.fire_damper.reset_asked) << FAULT_RESET;
            word |= bits << number;
        }
        word
    }

    /// Writes a coil. Those that the table gives nothing to write to, or no name, take it and do nothing.
    fn write_coil(&mut self, coil: usize, on: bool) {
        match coil {
            0 | 1 => self.channels[coil].command(on),
            4 | 5 => self.channels[coil - RELAY_SET].command(on),
            8 | 9 if on => self.channels[coil - FAULT_RESET].reset_faults(),
            _ => {}
        }
    }

    fn input_register(&self, register: u16) -> u16 {
        match register {
            0 => self.discrete_inputs(),
            1 => self.toggled_by_rise,
            _ => self.toggled_by_fall,
        }
    }

    fn is_default_on(&self, channel: usize) -> bool {
        self.defaults >> channel & 1 == 1
    }

    fn contacts_of(&self, channel: usize) -> [bool; 2] {
        [self.contacts[2 * channel], self.contacts[2 * channel + 1]]
    }

    /// Every 100 ms.
    fn tick(&mut self, now: Time) {
        let silence = self.watchdog.silence(now);
        for number in 0..CHANNELS {
            let contacts = self.contacts_of(number);
            self.channels[number].tick(now, contacts, silence);
        }
        self.conclude();
    }

    /// What follows from the inputs and the bus at once, in the modes that wait for nothing.
    fn settle(&mut self) {
        for number in 0..CHANNELS {
            let contacts = self.contacts_of(number);
            let channel = &mut self.channels[number];
            if !channel.settings.mode.is_for_dampers() {
                channel.seen = contacts;
            }
        }
        self.conclude();
    }

    /// Lets the logic decide, switches relays that need not wait, and notes what has changed.
    fn conclude(&mut self) {
        let inputs = self.discrete_inputs() & INPUT_BITS;
        let closing = inputs & !self.told;
        for channel in &mut self.channels {
            channel.decide(inputs, closing);
            if !channel.settings.mode.is_for_dampers() {
                channel.switch();
            }
        }
        let word = self.discrete_inputs();
        self.toggled_by_rise ^= word & !self.told;
        self.toggled_by_fall ^= !word & self.told;
        self.told = word;
    }

    fn set_mode(&mut self, now: Time, number: usize, mode: Mode) {
        if self.channels[number].settings.mode != mode {
            let (contacts, default) = (self.contacts_of(number), self.is_default_on(number));
            self.channels[number].settings.mode = mode;
            self.channels[number].start(now, contacts, default);
        }
    }

    /// Inputs of a channel that has a damper are no longer there for the other one's logic (page 23).
    fn reserve_inputs(&mut self) {
        for (number, other) in [(0, 1), (1, 0)] {
            if self.channels[other].settings.mode.is_for_dampers() {
                let logic = &mut self.channels[number].settings.logic;
                *logic = logic_without(*logic, 0b11 << (2 * other));
            }
        }
    }

    fn check_word(&self, register: u16, word: u16) -> Result<(), Exception> {
        let mode = |first: u16| self.channels[usize::from(register - first)].settings.mode;
        let is_allowed = match register {
            2 | 3 => Mode::from_word(word).is_some(),
            10 | 11 => mode(10).motor().is_none() || Position::from_drive(word).is_some(),
            // Alarm codes are "gemeldet und rückgesetzt": the one to be written is OK.
            16 | 17 => !mode(16).has_alarm_code() || word == Alarm::Ok as u16,
            18 | 19 => logic_from_word(word).is_some(),
            _ => true,
        };
        if is_allowed { Ok(()) } else { Err(Exception::Value) }
    }

    fn write_register(&mut self, now: Time, register: u16, word: u16) {
        let at = usize::from(register % 2);
        let channel = &mut self.channels[at];
        let motor = channel.settings.mode.motor();
        match register {
            0 => {
                // "Bits 0…1 = Beabsichtigter Schaltzustand", "Bits 8…9 = Alarm löschen" (page 22).
                for coil in [0, 1, 8, 9] {
                    self.write_coil(coil, word >> coil & 1 == 1);
                }
            }
            1 => self.defaults = word as u8 & RELAY_BITS,
            2 | 3 => {
                if let Some(mode) = Mode::from_word(word) {
                    self.set_mode(now, at, mode);
                }
            }
            4 | 5 => channel.settings.drive_time = word,
            6 | 7 => channel.settings.turn_off_time = word,
            8 | 9 => {
                channel.settings.heartbeat = word;
                // Setting it to 0 does not start it; but then nothing counts.
                channel.damper.feed(now);
            }
            10 | 11 => {
                if let (Some(motor), Some(drive)) = (motor, Position::from_drive(word)) {
                    channel.damper.write_drive(now, motor, drive);
                }
            }
            16 | 17 if channel.settings.mode.has_alarm_code() => channel.damper.acknowledge(now, motor),
            18 | 19 => channel.settings.logic = logic_from_word(word).unwrap_or_default(),
            WATCHDOG => self.watchdog.time = word,
            // 12 to 15 only report.
            _ => {}
        }
    }
}

impl HoldingRegisters for MrDio42 {
    /// "Read Holding Registers (0 - 19, 65, 66)", and the same for writing (page 21).
    fn check(first: u16, count: usize) -> Result<(), Exception> {
        let allowed = if first >= LINE_REGISTER { (LINE_REGISTER, WATCHDOG) } else { (0, HOLDING_LAST) };
        check_span(first, count, 125, allowed)
    }

    fn read(&self, register: u16) -> u16 {
        let channel = &self.channels[usize::from(register % 2)];
        let settings = &channel.settings;
        let [drive, position, second_position, alarm] = channel.report();
        match register {
            0 => self.coils(),
            1 => self.defaults.into(),
            2 | 3 => settings.mode as u16,
            4 | 5 => settings.drive_time,
            6 | 7 => settings.turn_off_time,
            8 | 9 => settings.heartbeat,
            10 | 11 => drive,
            12 | 13 => position,
            14 | 15 => second_position,
            16 | 17 => alarm,
            18 | 19 => settings.logic,
            WATCHDOG => self.watchdog.time,
            // 65 belongs to what all devices have in common.
            _ => 0,
        }
    }

    /// The manual gives the values and not what happens with others: such a word is refused.
    fn write(&mut self, now: Time, first: u16, words: &[u16]) -> Result<(), Exception> {
        // "dann nur in dieses Register schreiben" (page 24): 65 never comes here alone.
        if first == LINE_REGISTER {
            return Err(Exception::Address);
        }
        for (register, word) in (first..).zip(words) {
            self.check_word(register, *word)?;
        }
        for (register, word) in (first..).zip(words) {
            self.write_register(now, register, *word);
        }
        self.reserve_inputs();
        self.settle();
        Ok(())
    }
}

impl Module for MrDio42 {
    const PRODUCT: &'static str = "MR-DIO4/2";
    const VERSION: &'static str = "V2.0";
    const FUNCTIONS: &'static [u8] = &[1, 2, 3, 4, 5, 6, 15, 16];
    const READS_LINE: bool = true;

    fn serve(&mut self, now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::Read { function: function @ (1 | 2), first, count } => {
                check_span(first, count.into(), 2000, (0, BITS_LAST))?;
                let word = if function == 1 { self.coils() } else { self.discrete_inputs() };
                let bits: Vec<bool> = (first..first + count).map(|bit| word >> bit & 1 == 1).collect();
                Ok(bits_reply(function, &bits))
            }
            Request::Read { function: 4, first, count } => {
                check_span(first, count.into(), 125, (0, INPUT_LAST))?;
                let registers = first..first + count;
                let words: Vec<u16> = registers.map(|register| self.input_register(register)).collect();
                Ok(words_reply(4, &words))
            }
            Request::WriteCoil { address, value } => {
                if value != 0 && value != 0xFF00 {
                    return Err(Exception::Value);
                }
                check_span(address, 1, 1, (0, BITS_LAST))?;
                self.write_coil(address.into(), value != 0);
                self.settle();
                Ok(write_reply(5, address, value))
            }
            Request::WriteCoils { first, ref values } => {
                check_span(first, values.len(), 1968, (0, BITS_LAST))?;
                // Relay and RelaySet are two names for one wish; of both in one request the later wins.
                for (coil, on) in (usize::from(first)..).zip(values) {
                    self.write_coil(coil, *on);
                }
                self.settle();
                Ok(write_reply(15, first, values.len() as u16))
            }
            _ => self.serve_holding(now, request),
        }
    }

    fn message_for_this_device(&mut self, now: Time) {
        self.watchdog.feed(now);
    }

    fn advance(&mut self, now: Time) {
        while self.next_tick <= now {
            let at = self.next_tick;
            self.next_tick += TENTH;
            self.tick(at);
        }
        if self.watchdog.expires(now) {
            // In Input_Logic_Control "findet keine Änderung statt" (page 34), and in Fire_Damper the
            // default holds "nur nach dem Einschalten" (page 26).
            for number in 0..CHANNELS {
                if self.channels[number].settings.mode == Mode::DirectControl {
                    let default = self.is_default_on(number);
                    self.channels[number].command(default);
                }
            }
            self.settle();
        }
    }

    fn restart(&mut self, now: Time) {
        self.watchdog.feed(now);
        self.next_tick = now + TENTH;
        for number in 0..CHANNELS {
            let (contacts, default) = (self.contacts_of(number), self.is_default_on(number));
            let channel = &mut self.channels[number];
            channel.relay = false;
            channel.by_hand = false;
            channel.start(now, contacts, default);
        }
        // What the device sees first is no change.
        self.told = self.discrete_inputs();
        (self.toggled_by_rise, self.toggled_by_fall) = (0, 0);
        self.settle();
    }

    fn stimulate(&mut self, _now: Time, stimulus: &Stimulus) -> Result<(), String> {
        match *stimulus {
            Stimulus::Input { input, signal } => {
                contacts::connect(&mut self.contacts, input, signal, Self::PRODUCT)?;
            }
            Stimulus::Hand { relay: relay @ 1..=2, position } => {
                self.channels[usize::from(relay) - 1].hand = position;
            }
            Stimulus::Hand { relay, .. } => {
                return Err(format!("relay {relay} is not there; {} has 1 and 2", Self::PRODUCT));
            }
            _ => {
                return Err(format!(
                    "{} has inputs, relays with hand switches and nothing else to touch",
                    Self::PRODUCT
                ));
            }
        }
        self.settle();
        Ok(())
    }

    /// The relays, whether a hand switch has switched them, and the red LED that is lit while the
    /// watchdog has expired (page 26).
    fn outputs(&self) -> Vec<(String, String)> {
        let coils = self.coils() as u8;
        let led = if self.watchdog.has_expired() { "ON" } else { "OFF" };
        let outputs = named("relay", coils).take(CHANNELS).chain(named("hand", coils >> 2).take(CHANNELS));
        outputs.chain([("red_led".to_string(), led.to_string())]).collect()
    }

    fn eeprom(&self) -> Vec<u16> {
        let each =
            |word: fn(&Settings) -> u16| self.channels.iter().map(move |channel| word(&channel.settings));
        let mut words = vec![self.defaults.into(), self.watchdog.time];
        words.extend(each(|settings| settings.mode as u16));
        words.extend(each(|settings| settings.drive_time));
        words.extend(each(|settings| settings.turn_off_time));
        words.extend(each(|settings| settings.heartbeat));
        words.extend(each(|settings| settings.logic));
        words
    }

    /// Words that no register takes are as from the factory.
    fn load_eeprom(&mut self, mut words: &[u16]) {
        let words = &mut words;
        let [defaults, watchdog] = take_words(words);
        self.defaults = defaults as u8 & RELAY_BITS;
        self.watchdog.time = watchdog;
        let [modes, drive_times, turn_off_times, heartbeats, logics]: [[u16; CHANNELS]; 5] =
            [0; 5].map(|_| take_words(words));
        for (number, channel) in self.channels.iter_mut().enumerate() {
            channel.settings = Settings {
                mode: Mode::from_word(modes[number]).unwrap_or(FACTORY.mode),
                drive_time: drive_times[number],
                turn_off_time: turn_off_times[number],
                heartbeat: heartbeats[number],
                logic: logic_from_word(logics[number]).unwrap_or(FACTORY.logic),
            };
        }
        self.reserve_inputs();
    }
}

#[cfg(test)]
mod tests;
