//! MR-Multi I/O 12DI/7AI/2AO/8DO: contacts, a pulse counter, analog inputs and outputs, relays
//! (Softwarebeschreibung Modbus RTU V2.1, pages 87 to 102).

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Hand, Signal, Stimulus, take_words};
use crate::simulator::metz_connect::Module;
use crate::simulator::metz_connect::analog_inputs::AnalogInputs;
use crate::simulator::metz_connect::channel::{Code, is_code_without_carel};
use crate::simulator::metz_connect::holding::HoldingRegisters;
use crate::simulator::metz_connect::pulse_input::{COUNTER_MASK, PulseInput};
use crate::simulator::metz_connect::watchdog::{WATCHDOG, Watchdog};
use crate::simulator::pdu::{Exception, Request, bits_reply, check_span, words_reply, write_reply};

/// The module.
pub struct MrMultiIo {
    /// E1 to E6 and I, with registers 0 to 13, 16 to 22 and 24 to 63, all in the EEPROM.
    analog_inputs: AnalogInputs<ANALOG_INPUTS>,
    /// Whose turn it is to be measured, and when.
    turn: usize,
    next_turn: Time,
    /// Register 68 and coil 32. EEPROM.
    fahrenheit: bool,
    watchdog: Watchdog,
    /// Digital inputs 1 to 11, bit 0 is input 1.
    contacts: u16,
    /// S0. With registers 82 to 95, all in the EEPROM.
    pulse_input: PulseInput,
    outputs: DigitalOutputs,
    /// Registers 74 and 75.
    volts: [u16; ANALOG_OUTPUTS],
    /// Registers 78 and 79. EEPROM.
    initial_volts: [u16; ANALOG_OUTPUTS],
}

/// The relays, bits 0 to 3, and the Photo-MOS outputs, bits 4 to 7.
#[derive(Clone, Copy, Debug, Default)]
struct DigitalOutputs {
    /// What the bus last asked for.
    commanded: u8,
    /// Register 73. EEPROM.
    initial: u8,
    /// Coils 16 to 19 and register 72: which relays a hand has switched. EEPROM.
    by_hand: u8,
    /// To what it has switched them.
    hand_states: u8,
}

const ANALOG_INPUTS: usize = 7;
const ANALOG_OUTPUTS: usize = 2;
const RELAYS: u8 = 0x0F;
const CONTACTS: u8 = 11;
/// The number of S0 among the digital inputs.
const S0: u8 = 12;
/// "Ein langer Tastendruck (> 1s)" (page 89).
const LONG_PRESS: Duration = Duration::from_secs(1);
/// I among the analog inputs, counted from 0.
const CURRENT_INPUT: usize = 6;
/// "Spannung 0-10V, Maximum 11.5 V" of the float (page 93).
const VOLTS_MAX: f64 = 11.5;
/// "Wert 32767 = 10,24 Volt", as MR-AO4's.
const STEPS_PER_VOLT: f64 = 3200.0;

/// "Etwa 0,2 Sekunden" for one measurement, and each input "im Abstand von etwa 1,8 Sekunden" (page
/// 91): nine turns, two of which measure nothing that has a register. That a new range of resistance
/// takes longer is said without ranges, and left out.
const TURN: Duration = Duration::from_millis(200);
const TURNS: usize = 9;

/// "(0 - 15)", "(0 - 47)", "(0 - 99)" of all functions (page 87), whatever is there: what has no
/// meaning reads as 0, and what has none or is "nur lesen" can be written without effect.
const DISCRETE_LAST: u16 = 15;
const COIL_LAST: u16 = 47;
const REGISTER_LAST: u16 = 99;
/// The page limits no quantity: these are the specification's for reading, and more than there are.
const BITS_MAX: usize = 2000;
const REGISTERS_MAX: usize = 125;
const FAHRENHEIT_COIL: u16 = 32;
const CODES: std::ops::RangeInclusive<u16> = 16..=21;
const CURRENT_CODE: u16 = 22;
const UNIT: u16 = 68;
const MODES: u16 = 72;

/// The registers that are marked "Speicherung im EEPROM".
const EEPROM: [(u16, u16); 8] =
    [(0, 13), (16, 22), (24, 63), (WATCHDOG, WATCHDOG), (UNIT, UNIT), (MODES, 73), (78, 79), (82, 95)];

impl MrMultiIo {
    pub fn new(now: Time) -> MrMultiIo {
        MrMultiIo {
            analog_inputs: AnalogInputs::new(now).reaching(VOLTS_MAX, CURRENT_INPUT),
            turn: 0,
            next_turn: now + TURN,
            fahrenheit: false,
            watchdog: Watchdog::new(now),
            contacts: 0,
            pulse_input: PulseInput::new(now),
            outputs: DigitalOutputs::default(),
            volts: [0; ANALOG_OUTPUTS],
            initial_volts: [0; ANALOG_OUTPUTS],
        }
    }

    /// Discrete inputs 0 to 15 and register 70.
    fn digital_inputs(&self) -> u16 {
        self.contacts | u16::from(self.pulse_input.is_closed()) << (S0 - 1)
    }

    /// Coils 0 to 47.
    fn coils(&self) -> u64 {
        u64::from(self.outputs.states())
            | u64::from(self.outputs.by_hand) << 16
            | u64::from(self.fahrenheit) << FAHRENHEIT_COIL
    }

    fn write_coil(&mut self, coil: u16, on: bool) {
        match coil {
            0..=7 => self.outputs.commanded = self.outputs.commanded & !(1 << coil) | u8::from(on) << coil,
            FAHRENHEIT_COIL => self.fahrenheit = on,
            _ => {}
        }
    }

    /// An input register, 0 to 99.
    fn read_input(&self, register: u16) -> u16 {
        match register {
            0..=13 => self.analog_inputs.value(usize::from(register / 2))[usize::from(register % 2)],
            // "Input Registers / Holding Registers" (pages 89 and 96).
            70 | 82 | 83 => self.read(register),
            84..=87 => part(self.pulse_input.pulses, 87 - register),
            88 | 89 => part(self.pulse_input.meter_reading().into(), 89 - register),
            _ => 0,
        }
    }

    /// Writes one register; a code has been checked.
    fn put(&mut self, now: Time, register: u16, word: u16) {
        let pulses = &mut self.pulse_input;
        match register {
            0..=13 | 16..=22 | 24..=63 => self.analog_inputs.write(now, register, word),
            WATCHDOG => self.watchdog.time = word,
            UNIT => self.fahrenheit = word & 1 == 1,
            71 => self.outputs.commanded = word as u8,
            73 => self.outputs.initial = word as u8,
            74 | 75 => self.volts[usize::from(register - 74)] = word,
            78 | 79 => self.initial_volts[usize::from(register - 78)] = word,
            // "setzt gleichzeitig die Millisekundenzählung zurück".
            82 | 83 => {
                let seconds = u64::from(pulses.closed_for.as_secs() as u32);
                pulses.closed_for = Duration::from_secs(with_part(seconds, 83 - register, word));
            }
            // "die höchsten 16 Bits sind 0".
            84..=87 => {
                pulses.at_button = with_part(pulses.at_button, 87 - register, word) & COUNTER_MASK;
            }
            88 | 89 => pulses.initial = with_part(pulses.initial.into(), 89 - register, word) as u32,
            90 => pulses.pulses_per_unit = word,
            91 => pulses.current_factor = word,
            92 => pulses.voltage_factor = word,
            // "Flag in Bit 0", of WP and of TA.
            93 => pulses.factors_only_pulses = word & 1 == 1,
            94 => pulses.set_format(word),
            95 => pulses.button_enabled = word & 1 == 1,
            // Among others 65, which is only ever written alone, with its magic number (page 3).
            _ => {}
        }
    }

    /// What happens when the device is switched on and when the watchdog expires: "werden die Ausgänge
    /// in ihre Grundeinstellung (sicherer Zustand) geschaltet" (page 87). The table beneath has only the
    /// relays go to an "Inaktiv-Zustand"; registers 73, 78 and 79 would then be for nothing.
    fn load_initial_values(&mut self) {
        self.outputs.commanded = self.outputs.initial;
        self.volts = self.initial_volts;
    }
}

impl DigitalOutputs {
    /// Coils 0 to 7 and register 71, as the outputs are.
    fn states(&self) -> u8 {
        self.commanded & !self.by_hand | self.hand_states & self.by_hand
    }

    /// A long press changes between automatic and hand, a short one switches in hand operation (page 89).
    /// No page tells how a relay stands at first in hand operation: here it stays as it is.
    fn press(&mut self, relay: u8, held: Duration) {
        let bit = 1 << (relay - 1);
        if held > LONG_PRESS {
            self.hand_states = self.hand_states & !bit | self.commanded & bit;
            self.by_hand ^= bit;
        } else {
            self.hand_states ^= bit & self.by_hand;
        }
    }

    /// What such presses lead to.
    fn set_hand(&mut self, relay: u8, position: Hand) {
        let bit = 1 << (relay - 1);
        self.by_hand = if position == Hand::Automatic { self.by_hand & !bit } else { self.by_hand | bit };
        self.hand_states =
            if position == Hand::On { self.hand_states | bit } else { self.hand_states & !bit };
    }
}

/// A register of a long value, counted from its last.
fn part(value: u64, from_last: u16) -> u16 {
    (value >> (16 * from_last)) as u16
}

/// The value with one of its registers written. No page forbids to write one alone.
fn with_part(value: u64, from_last: u16, word: u16) -> u64 {
    let shift = 16 * from_last;
    value & !(0xFFFF << shift) | u64::from(word) << shift
}

impl HoldingRegisters for MrMultiIo {
    fn check(first: u16, count: usize) -> Result<(), Exception> {
        check_span(first, count, REGISTERS_MAX, (0, REGISTER_LAST))
    }

    fn read(&self, register: u16) -> u16 {
        let pulses = &self.pulse_input;
        match register {
            0..=13 | 16..=22 | 24..=63 => self.analog_inputs.read(register),
            WATCHDOG => self.watchdog.time,
            UNIT => self.fahrenheit.into(),
            70 => self.digital_inputs(),
            71 => self.outputs.states().into(),
            MODES => self.outputs.by_hand.into(),
            73 => self.outputs.initial.into(),
            74 | 75 => self.volts[usize::from(register - 74)],
            78 | 79 => self.initial_volts[usize::from(register - 78)],
            82 | 83 => part(pulses.closed_for.as_secs(), 83 - register),
            84..=87 => part(pulses.at_button, 87 - register),
            88 | 89 => part(pulses.initial.into(), 89 - register),
            90 => pulses.pulses_per_unit,
            91 => pulses.current_factor,
            92 => pulses.voltage_factor,
            93 => pulses.factors_only_pulses.into(),
            94 => pulses.format(),
            95 => pulses.button_enabled.into(),
            _ => 0,
        }
    }

    fn write(&mut self, now: Time, first: u16, words: &[u16]) -> Result<(), Exception> {
        let is_allowed = |(register, word): (u16, &u16)| match register {
            CURRENT_CODE => Code::parse_current(*word).is_some(),
            register if CODES.contains(&register) => is_code_without_carel(*word),
            _ => true,
        };
        if !(first..).zip(words).all(is_allowed) {
            return Err(Exception::Value);
        }
        for (register, word) in (first..).zip(words) {
            self.put(now, register, *word);
        }
        Ok(())
    }
}

impl Module for MrMultiIo {
    const PRODUCT: &'static str = "MR-Multi IO";
    const VERSION: &'static str = "V1.2";
    /// The list of functions on page 87 leaves out 15, and the list of addresses below has it: "Write
    /// Multiple Coils (0 - 47)".
    const FUNCTIONS: &'static [u8] = &[1, 2, 3, 4, 5, 6, 15, 16];
    const READS_LINE: bool = true;

    fn serve(&mut self, now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::Read { function: function @ 1..=2, first, count } => {
                let (bits, last) = if function == 1 {
                    (self.coils(), COIL_LAST)
                } else {
                    (self.digital_inputs().into(), DISCRETE_LAST)
                };
                check_span(first, count.into(), BITS_MAX, (0, last))?;
                let bits: Vec<bool> = (first..first + count).map(|bit| bits >> bit & 1 == 1).collect();
                Ok(bits_reply(function, &bits))
            }
            Request::Read { function: 4, first, count } => {
                Self::check(first, count.into())?;
                let words = (first..first + count).map(|register| self.read_input(register));
                Ok(words_reply(4, &words.collect::<Vec<u16>>()))
            }
            Request::WriteCoil { address, value } => {
                if value != 0 && value != 0xFF00 {
                    return Err(Exception::Value);
                }
                check_span(address, 1, 1, (0, COIL_LAST))?;
                self.write_coil(address, value != 0);
                Ok(write_reply(5, address, value))
            }
            Request::WriteCoils { first, ref values } => {
                check_span(first, values.len(), BITS_MAX, (0, COIL_LAST))?;
                for (coil, on) in (first..).zip(values) {
                    self.write_coil(coil, *on);
                }
                Ok(write_reply(15, first, values.len() as u16))
            }
            _ => self.serve_holding(now, request),
        }
    }

    fn message_for_this_device(&mut self, now: Time) {
        self.watchdog.feed(now);
    }

    fn advance(&mut self, now: Time) {
        self.pulse_input.advance(now);
        while self.next_turn <= now {
            if self.turn < ANALOG_INPUTS {
                self.analog_inputs.measure_one(self.turn, self.fahrenheit);
            }
            self.turn = (self.turn + 1) % TURNS;
            self.next_turn += TURN;
        }
        if self.watchdog.expires(now) {
            self.load_initial_values();
        }
    }

    fn restart(&mut self, now: Time) {
        self.analog_inputs.restart(now);
        (self.turn, self.next_turn) = (0, now + TURN);
        self.pulse_input.restart(now);
        // Of the time that S0 was closed only whole seconds have a register, and so outlive a restart.
        self.pulse_input.closed_for = Duration::from_secs(self.pulse_input.closed_for.as_secs());
        self.watchdog.feed(now);
        self.load_initial_values();
        // A relay's mode is stored, and to what it was switched by hand is not.
        self.outputs.hand_states = self.outputs.initial;
    }

    /// The signal says which inputs are meant: contacts are connected to the digital ones, of which S0
    /// is the twelfth, and all else to E1 to E6 and I, which is the seventh.
    fn stimulate(&mut self, now: Time, stimulus: &Stimulus) -> Result<(), String> {
        let product = Self::PRODUCT;
        match *stimulus {
            Stimulus::Button => self.pulse_input.press_button(),
            Stimulus::Hand { relay: relay @ 1..=4, position } => self.outputs.set_hand(relay, position),
            Stimulus::Press { relay: relay @ 1..=4, held } => self.outputs.press(relay, held),
            Stimulus::Hand { relay, .. } | Stimulus::Press { relay, .. } => {
                return Err(format!("relay {relay} is not there; {product} has 1 to 4"));
            }
            Stimulus::Input { input: S0, signal } => self.pulse_input.connect(now, signal, product)?,
            Stimulus::Input { input: input @ 1..=CONTACTS, signal: Signal::Contact(closed) } => {
                let bit = input - 1;
                self.contacts = self.contacts & !(1 << bit) | u16::from(closed) << bit;
            }
            Stimulus::Input { signal: Signal::Contact(_), input } => {
                return Err(format!("contact {input} is not there; {product} has 1 to 12"));
            }
            Stimulus::Input { signal: Signal::Pulses { .. } | Signal::Counter(_), .. } => {
                return Err(format!("only input 12 of {product}, S0, counts"));
            }
            Stimulus::Input { .. } => self.analog_inputs.stimulate(product, stimulus)?,
            _ => return Err(format!("{product} has inputs, four relays and a button to touch")),
        }
        Ok(())
    }

    /// The outputs with their lights, and the red light of the watchdog (page 87).
    fn outputs(&self) -> Vec<(String, String)> {
        let light = |on: bool| if on { "ON" } else { "OFF" }.to_string();
        let named = |name: &str, bits: u8| -> Vec<(String, String)> {
            (0..4).map(|bit| (format!("{name}_{}", bit + 1), light(bits >> bit & 1 == 1))).collect()
        };
        let states = self.outputs.states();
        let volts = |(number, word): (usize, &u16)| {
            // A negative value gives none, as MR-AO4's.
            let volts = f64::from((*word as i16).max(0)) / STEPS_PER_VOLT;
            (format!("output_{}", number + 1), format!("{volts:.3} V"))
        };
        let mut outputs = named("relay", states);
        outputs.extend(named("photomos", states >> 4));
        outputs.extend(named("hand", self.outputs.by_hand));
        outputs.extend(self.volts.iter().enumerate().map(volts));
        outputs.extend(self.analog_inputs.outputs());
        outputs.push(("counter".into(), self.pulse_input.pulses.to_string()));
        outputs.push(("red_light".into(), light(self.watchdog.has_expired())));
        outputs
    }

    fn eeprom(&self) -> Vec<u16> {
        let stored = EEPROM.iter().flat_map(|(low, high)| *low..=*high).map(|register| self.read(register));
        let pulses = (0..4).rev().map(|from_last| part(self.pulse_input.pulses, from_last));
        pulses.chain(stored).collect()
    }

    fn load_eeprom(&mut self, mut words: &[u16]) {
        let pulses: [u16; 4] = take_words(&mut words);
        let pulses = pulses.iter().fold(0, |value, word| value << 16 | u64::from(*word));
        self.pulse_input.pulses = pulses & COUNTER_MASK;
        for (register, word) in EEPROM.iter().flat_map(|(low, high)| *low..=*high).zip(words) {
            if register == MODES {
                self.outputs.by_hand = *word as u8 & RELAYS;
            } else {
                // The time says when an input is measured anew, and the restart that follows says it again.
                self.put(Time::default(), register, *word);
            }
        }
    }
}

#[cfg(test)]
mod tests;
