//! MR-LD6: six inputs for leak sensors or electrodes, whose cables are watched, and two relays
//! (Softwarebeschreibung Modbus RTU V2.1, pages 103 to 109).

use crate::engine::time::Time;
use crate::simulator::device::{Signal, Stimulus, take_words};
use crate::simulator::metz_connect::Module;
use crate::simulator::metz_connect::holding::HoldingRegisters;
use crate::simulator::metz_connect::watchdog::{WATCHDOG, Watchdog};
use crate::simulator::pdu::{Exception, Request, bits_reply, check_span, words_reply, write_reply};

/// The device.
pub struct MrLd6 {
    /// Registers 1 to 36. EEPROM.
    settings: [u16; SETTINGS],
    watchdog: Watchdog,
    sensors: [Option<Sensor>; INPUTS],
    /// Input registers 0 and 1.
    leaks: u16,
    breaks: u16,
    /// Register 0 and the coils: which contacts are closed.
    relays: u16,
    /// Which relays are "Aktiv"; a level between two electrodes leaves that as it is.
    active: u16,
}

/// What is connected to an input, or nothing.
#[derive(Clone, Copy, Debug)]
struct Sensor {
    ohms: f64,
    /// At the Zener diode behind it.
    volts: f64,
}

/// What register 14 or 15 makes of a relay (page 107).
#[derive(Clone, Copy, PartialEq, Eq)]
enum Mode {
    /// 0, "Leckage-Meldung".
    Leak,
    /// 1 to 3, "Niveau-Wächter"; so far are the bits of its two inputs in the register of leaks.
    Level { shift: u16 },
    /// 4, "Kombinatorische Funktion für Eingänge".
    Matrix,
    /// "Sonst: Steuerung über den Modbus".
    Bus,
}

const INPUTS: usize = 6;
const RELAYS: usize = 2;
const SETTINGS: usize = 36;
/// "Read Input Registers (0 - 99)" and so on, "Read Coils (0 - 31)" (page 103): what no table gives a
/// meaning to is 0, and writing it does nothing.
const REGISTERS: (u16, u16) = (0, 99);
/// Of the discrete inputs page 103 says "(0 - 15)" and page 104 that there are 16 to 21, which as the
/// second of two registers would end with 31 like the coils.
const BITS: (u16, u16) = (0, 31);
const INPUT_REGISTERS: usize = 14;
/// The holding registers' numbers.
const POLARITY: usize = 1;
const SENSOR_THRESHOLDS: usize = 2;
const ZENER_THRESHOLDS: usize = 8;
const MODES: usize = 14;
const LEAK_ENABLES: usize = 16;
const ZENER_ENABLE: usize = 18;
const BREAK_ENABLES: usize = 19;
const MATRICES: usize = 21;
const MATRIX_LENGTH: usize = 8;
/// "Maximum: 10000 (= 1 MOhm)".
const RESISTANCE_MAX: f64 = 10_000.0;
/// No page says what an input without a sensor, or a sensor with its diode, has there. The device's
/// data sheet has pulses of 16 V, and diodes of 6.2 to 10 V.
const VOLTS_OPEN: f64 = 16.0;
const VOLTS_INTACT: f64 = 10.0;

impl MrLd6 {
    pub fn new(now: Time) -> MrLd6 {
        let mut settings = [0; SETTINGS];
        settings[SENSOR_THRESHOLDS - 1..][..INPUTS].fill(200);
        settings[ZENER_THRESHOLDS - 1..][..INPUTS].fill(110);
        settings[LEAK_ENABLES - 1..][..RELAYS].copy_from_slice(&[0b00_0111, 0b11_1000]);
        settings[ZENER_ENABLE - 1] = 0b11_1111;
        let mut device = MrLd6 {
            settings,
            watchdog: Watchdog::new(now),
            sensors: [None; INPUTS],
            leaks: 0,
            breaks: 0,
            relays: 0,
            active: 0,
        };
        device.settle();
        device
    }

    /// One of the registers 1 to 36.
    fn setting(&self, register: usize) -> u16 {
        self.settings[register - 1]
    }

    fn mode(&self, relay: usize) -> Mode {
        match self.setting(MODES + relay) {
            0 => Mode::Leak,
            level @ 1..=3 => Mode::Level { shift: 2 * (level - 1) },
            4 => Mode::Matrix,
            _ => Mode::Bus,
        }
    }

    /// SensorResist, in 100 Ω.
    fn resistance(&self, input: usize) -> u16 {
        let ohms = self.sensors[input].map_or(f64::INFINITY, |sensor| sensor.ohms);
        (ohms / 100.0).round().clamp(0.0, RESISTANCE_MAX) as u16
    }

    /// ZenerVoltage, in 100 mV.
    fn voltage(&self, input: usize) -> u16 {
        let volts = self.sensors[input].map_or(VOLTS_OPEN, |sensor| sensor.volts);
        (volts * 10.0).round().clamp(0.0, u16::MAX.into()) as u16
    }

    fn input_registers(&self) -> [u16; INPUT_REGISTERS] {
        let mut words = [0; INPUT_REGISTERS];
        words[0] = self.leaks;
        words[1] = self.breaks;
        for input in 0..INPUTS {
            words[2 + input] = self.resistance(input);
            words[8 + input] = self.voltage(input);
        }
        words
    }

    /// Compares what is measured and lets the relays follow. The manual gives no time that measuring
    /// takes.
    fn settle(&mut self) {
        for input in 0..INPUTS {
            let bit = 1 << input;
            // "Wenn SensorResist < SensorThresh", "Hysterese ± 5 %": below 95 % it comes, above 105 %
            // it goes (page 104); likewise 102.5 % and 97.5 % of ZenerThresh.
            let resistance = 1000 * u32::from(self.resistance(input));
            let threshold = u32::from(self.setting(SENSOR_THRESHOLDS + input));
            if resistance < 950 * threshold {
                self.leaks |= bit;
            } else if resistance > 1050 * threshold {
                self.leaks &= !bit;
            }
            let voltage = 1000 * u32::from(self.voltage(input));
            let threshold = u32::from(self.setting(ZENER_THRESHOLDS + input));
            if self.setting(ZENER_ENABLE) & bit == 0 || voltage < 975 * threshold {
                self.breaks &= !bit;
            } else if voltage > 1025 * threshold {
                self.breaks |= bit;
            }
        }
        (0..RELAYS).for_each(|relay| self.settle_relay(relay));
    }

    fn settle_relay(&mut self, relay: usize) {
        let inverted = self.setting(POLARITY) >> relay & 1 == 1;
        let was_active = self.active >> relay & 1 == 1;
        let active = match self.mode(relay) {
            Mode::Leak => {
                let leaks = self.leaks & self.setting(LEAK_ENABLES + relay);
                let breaks = self.breaks & self.setting(BREAK_ENABLES + relay);
                leaks | breaks != 0
            }
            // "Aktiv-Zustand, wenn beide Elektroden berührt werden, … Zustand beibehalten, wenn nur
            // eine": touched is what page 104 calls a leak (page 106).
            Mode::Level { shift } => match self.leaks >> shift & 3 {
                0 => false,
                3 => true,
                _ => was_active,
            },
            // "Der Wert in den Registern entspricht dem Schaltzustand des jeweiligen Relais" (page
            // 108): closed or open, whatever the polarity calls it. Page 108 has "Bits 0…8", and its
            // formula for the bit ends with 7.
            Mode::Matrix => {
                let inputs = usize::from(self.leaks);
                let row = self.setting(MATRICES + MATRIX_LENGTH * relay + inputs / 8);
                (row >> (inputs % 8) & 1 == 1) != inverted
            }
            Mode::Bus => (self.relays >> relay & 1 == 1) != inverted,
        };
        self.active = with_bit(self.active, relay, active);
        self.relays = with_bit(self.relays, relay, active != inverted);
    }

    /// "Grundeinstellung ist der Inaktiv-Zustand", at a start, when the watchdog expires, and when
    /// the bus takes a relay over.
    fn make_inactive(&mut self, relay: usize) {
        if self.mode(relay) == Mode::Bus {
            self.relays = with_bit(self.relays, relay, self.setting(POLARITY) >> relay & 1 == 1);
        }
    }

    /// A coil. One that is "nur lesbar" in its relay's mode stays as it is; the manual names no
    /// exception for it, and a request for both relays has to be good for the other.
    fn write_coil(&mut self, coil: usize, on: bool) {
        if coil < RELAYS && self.mode(coil) == Mode::Bus {
            self.relays = with_bit(self.relays, coil, on);
        }
    }

    fn write_setting(&mut self, register: usize, word: u16) {
        let before = [self.mode(0), self.mode(1)];
        // Bits besides those that the tables name are not kept.
        let mask = match register {
            POLARITY => 0b11,
            LEAK_ENABLES..MATRICES => 0b11_1111,
            MATRICES.. => 0b1_1111_1111,
            _ => u16::MAX,
        };
        self.settings[register - 1] = word & mask;
        for relay in (0..RELAYS).filter(|relay| before[*relay] != Mode::Bus) {
            self.make_inactive(relay);
        }
    }
}

fn with_bit(word: u16, bit: usize, on: bool) -> u16 {
    word & !(1 << bit) | u16::from(on) << bit
}

impl HoldingRegisters for MrLd6 {
    fn check(first: u16, count: usize) -> Result<(), Exception> {
        check_span(first, count, 125, REGISTERS)
    }

    fn read(&self, register: u16) -> u16 {
        match register {
            0 => self.relays,
            WATCHDOG => self.watchdog.time,
            _ => self.settings.get(usize::from(register) - 1).copied().unwrap_or(0),
        }
    }

    fn write(&mut self, _now: Time, first: u16, words: &[u16]) -> Result<(), Exception> {
        for (register, word) in (first..).zip(words) {
            match usize::from(register) {
                0 => (0..RELAYS).for_each(|relay| self.write_coil(relay, word >> relay & 1 == 1)),
                setting @ 1..=SETTINGS => self.write_setting(setting, *word),
                _ if register == WATCHDOG => self.watchdog.time = *word,
                _ => {}
            }
        }
        self.settle();
        Ok(())
    }
}

impl Module for MrLd6 {
    const PRODUCT: &'static str = "MR-LD6";
    const VERSION: &'static str = "V1.1";
    /// Page 103 names functions 1, 3, 4, 6 and 16, and in the list below them 2, 5 and 15 as well.
    const FUNCTIONS: &'static [u8] = &[1, 2, 3, 4, 5, 6, 15, 16];

    fn serve(&mut self, now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::Read { function: function @ 1..=2, first, count } => {
                check_span(first, count.into(), 32, BITS)?;
                let discrete_inputs = u32::from(self.breaks) << 16 | u32::from(self.leaks);
                let word = if function == 1 { self.relays.into() } else { discrete_inputs };
                let bits: Vec<bool> = (first..first + count).map(|bit| word >> bit & 1 == 1).collect();
                Ok(bits_reply(function, &bits))
            }
            Request::Read { function: 4, first, count } => {
                check_span(first, count.into(), 125, REGISTERS)?;
                let words = self.input_registers();
                let word = |register: u16| words.get(usize::from(register)).copied().unwrap_or(0);
                Ok(words_reply(4, &(first..first + count).map(word).collect::<Vec<u16>>()))
            }
            Request::WriteCoil { address, value } => {
                if value != 0 && value != 0xFF00 {
                    return Err(Exception::Value);
                }
                check_span(address, 1, 1, BITS)?;
                self.write_coil(address.into(), value != 0);
                self.settle();
                Ok(write_reply(5, address, value))
            }
            Request::WriteCoils { first, ref values } => {
                check_span(first, values.len(), 32, BITS)?;
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
        if self.watchdog.expires(now) {
            (0..RELAYS).for_each(|relay| self.make_inactive(relay));
            self.settle();
        }
    }

    fn restart(&mut self, now: Time) {
        self.watchdog.feed(now);
        (self.leaks, self.breaks, self.active) = (0, 0, 0);
        (0..RELAYS).for_each(|relay| self.make_inactive(relay));
        self.settle();
    }

    fn stimulate(&mut self, _now: Time, stimulus: &Stimulus) -> Result<(), String> {
        let Stimulus::Input { input, signal } = *stimulus else {
            return Err("MR-LD6 has inputs and nothing else to touch".into());
        };
        let Some(sensor) = usize::from(input).checked_sub(1).and_then(|number| self.sensors.get_mut(number))
        else {
            return Err(format!("input {input} is not there; MR-LD6 has 1 to 6"));
        };
        let dry = Sensor { ohms: f64::INFINITY, volts: VOLTS_INTACT };
        *sensor = match signal {
            Signal::Open => None,
            Signal::Ohms(ohms) => Some(Sensor { ohms, ..sensor.unwrap_or(dry) }),
            Signal::Volts(volts) => Some(Sensor { volts, ..sensor.unwrap_or(dry) }),
            _ => {
                return Err("an input of MR-LD6 takes the ohms of a sensor and the volts at its diode".into());
            }
        };
        self.settle();
        Ok(())
    }

    fn outputs(&self) -> Vec<(String, String)> {
        let state = |on: bool| if on { "ON" } else { "OFF" }.to_string();
        let relay = |relay: usize| (format!("relay_{}", relay + 1), state(self.relays >> relay & 1 == 1));
        // "Der Timer abläuft, … und die rote LED leuchtet", "nur bei Steuerung der Relais über den
        // Modbus" (page 103).
        let is_watched = (0..RELAYS).any(|relay| self.mode(relay) == Mode::Bus);
        let led = ("red_led".to_string(), state(is_watched && self.watchdog.has_expired()));
        (0..RELAYS).map(relay).chain([led]).collect()
    }

    fn eeprom(&self) -> Vec<u16> {
        let mut words = self.settings.to_vec();
        words.push(self.watchdog.time);
        words
    }

    fn load_eeprom(&mut self, mut words: &[u16]) {
        let words = &mut words;
        let settings: [u16; SETTINGS] = take_words(words);
        [self.watchdog.time] = take_words(words);
        for (register, word) in (1..).zip(settings) {
            self.write_setting(register, word);
        }
    }
}

#[cfg(test)]
mod tests;
