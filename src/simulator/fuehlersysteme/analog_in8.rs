//! The analog board with eight inputs (chapter 6.3 of the manual).

use crate::engine::time::Time;
use crate::simulator::device::{Signal, Stimulus, take_words};
use crate::simulator::fuehlersysteme::board::{AUTOMATIC, Board, Table};
use crate::simulator::fuehlersysteme::damping::Damping;
use crate::simulator::fuehlersysteme::ranges::{Terminal, number, number_above, number_below};

/// The board.
pub type AnalogIn8 = Board<Inputs>;

/// Its own tables.
pub struct Inputs {
    settings: Settings,
    /// RWreg_01 to 08: hundredths of a volt or a milliampere, or 11111.
    fixed: [u16; INPUTS],
    inputs: [Input; INPUTS],
}

/// What is marked with a star, and so "auch gespeichert".
#[derive(Clone, Copy, Debug)]
struct Settings {
    /// RWreg_11 to 18.
    damping: [u16; INPUTS],
    /// RWreg_21 to 28 and 31 to 38.
    zero: [i16; INPUTS],
    end: [i16; INPUTS],
    /// RWreg_41 to 48: 0 is analog, 1 digital, 2 digital and negated.
    function: [u16; INPUTS],
    /// RWreg_49 and 50.
    hold_until_told: u8,
    hold_until_reset: u8,
}

/// What is connected to an input, and what has come of it.
#[derive(Clone, Debug)]
struct Input {
    signal: Signal,
    /// In hundredths.
    measured: Damping,
    /// "bei < 1 V als (LOW) und bei > 2,5 V als (HIGH) erkannt"; in between it stays what it was.
    is_high: bool,
    /// Was on under RWreg_49 and has not been told since; under RWreg_50 and has not been reset.
    held_until_told: bool,
    held_until_reset: bool,
}

const INPUTS: usize = 8;
/// Which inputs the factory made for current, a bit each: as in the manual's own example.
const CURRENT_INPUTS: u8 = 0x80;
const FIXED_MAX: u16 = 2000;
const DAMPING_MAX: u16 = 60;
const LOW_BELOW: f64 = 100.0;
const HIGH_ABOVE: f64 = 250.0;
/// What the DIP switch lets an open contact give; the manual says only "high".
const HIGH: f64 = 1000.0;

const FACTORY: Settings = Settings {
    damping: [10; INPUTS],
    zero: [0; INPUTS],
    end: [1000; INPUTS],
    function: [0; INPUTS],
    hold_until_told: 0,
    hold_until_reset: 0,
};

impl Inputs {
    /// Hundredths of a volt or a milliampere at the terminal.
    fn at_terminal(&self, input: usize) -> f64 {
        match self.inputs[input].signal {
            Signal::Volts(amount) | Signal::Milliamps(amount) => amount * 100.0,
            // A contact bridges the input to ground; see `HIGH`.
            Signal::Contact(false) => HIGH,
            _ => 0.0,
        }
    }

    fn is_digital(&self, input: usize) -> bool {
        self.settings.function[input] != 0
    }

    /// Whether a digital input is on now, whatever is held.
    fn is_on(&self, input: usize) -> bool {
        self.inputs[input].is_high != (self.settings.function[input] == 2)
    }

    /// Rreg_01 to 08.
    fn value(&self, input: usize) -> u16 {
        if self.is_digital(input) {
            let held = self.inputs[input].held_until_told || self.inputs[input].held_until_reset;
            return u16::from(self.is_on(input) || held);
        }
        let terminal = Terminal::numbered(CURRENT_INPUTS, input);
        if self.fixed[input] != AUTOMATIC {
            return terminal.limit(self.fixed[input].into());
        }
        terminal.limit(self.inputs[input].measured.mean(self.settings.damping[input]))
    }

    /// Rreg_11 to 18: the value within its span; of a digital input, which has none, 0 or 1 as well.
    fn calculated(&self, input: usize) -> u16 {
        let value = self.value(input);
        if self.is_digital(input) {
            return value;
        }
        let (zero, end) = (f64::from(self.settings.zero[input]), f64::from(self.settings.end[input]));
        let part = Terminal::numbered(CURRENT_INPUTS, input).part(value);
        (zero + (end - zero) * part).round() as i16 as u16
    }

    /// Looks at the levels of the digital inputs, which no damping delays.
    fn look(&mut self) {
        for number in 0..INPUTS {
            let fixed = Some(self.fixed[number]).filter(|fixed| *fixed != AUTOMATIC);
            let electric = fixed.map_or_else(|| self.at_terminal(number), f64::from);
            let is_high =
                if self.inputs[number].is_high { electric >= LOW_BELOW } else { electric > HIGH_ABOVE };
            self.inputs[number].is_high = is_high;
            let is_on = self.is_on(number);
            let holds = |bits: u8| self.is_digital(number) && bits >> number & 1 == 1;
            let (until_told, until_reset) =
                (holds(self.settings.hold_until_told), holds(self.settings.hold_until_reset));
            let input = &mut self.inputs[number];
            input.held_until_told = until_told && (input.held_until_told || is_on);
            input.held_until_reset = until_reset && (input.held_until_reset || is_on);
        }
    }

    /// RWreg_51 to 59.
    fn reset(&mut self, bits: u8) {
        for input in (0..INPUTS).filter(|input| bits >> input & 1 == 1) {
            self.inputs[input].held_until_reset = false;
        }
    }
}

impl Table for Inputs {
    /// The table goes from 79 on to 200, although chapter 7 speaks of RWreg_90 to 99 without exception.
    const HAS_SCRATCH: bool = false;

    fn new(now: Time) -> Inputs {
        let input = Input {
            signal: Signal::Open,
            measured: Damping::new(now, DAMPING_MAX),
            is_high: false,
            held_until_told: false,
            held_until_reset: false,
        };
        Inputs {
            settings: FACTORY,
            fixed: [AUTOMATIC; INPUTS],
            inputs: std::array::from_fn(|_| input.clone()),
        }
    }

    fn system_code(&self) -> u16 {
        0x4000 | u16::from(CURRENT_INPUTS)
    }

    fn read_input(&self, _now: Time, register: u16) -> Option<u16> {
        match register {
            1..=8 => Some(self.value(usize::from(register - 1))),
            11..=18 => Some(self.calculated(usize::from(register - 11))),
            _ => None,
        }
    }

    /// "bis das zugehörige Rreg_01 bis 08 oder Rreg_11 bis 18 einmalig abgerufen wurde".
    fn told(&mut self, _now: Time, register: u16) {
        if let 1..=8 | 11..=18 = register {
            self.inputs[usize::from(register % 10 - 1)].held_until_told = false;
        }
    }

    fn read_holding(&self, register: u16) -> Option<u16> {
        let at = |first: u16| usize::from(register - first);
        let settings = &self.settings;
        Some(match register {
            1..=8 => self.fixed[at(1)],
            11..=18 => settings.damping[at(11)],
            21..=28 => settings.zero[at(21)] as u16,
            31..=38 => settings.end[at(31)] as u16,
            41..=48 => settings.function[at(41)],
            49 => settings.hold_until_told.into(),
            50 => settings.hold_until_reset.into(),
            // The reset commands are 0 again at once.
            51..=59 => 0,
            _ => return None,
        })
    }

    fn limit(&self, register: u16, word: u16) -> u16 {
        let at = |first: u16| usize::from(register - first);
        match register {
            1..=8 if word == AUTOMATIC => word,
            1..=8 => word.min(FIXED_MAX),
            11..=18 => word.min(DAMPING_MAX),
            // "Nullpunktwerte… kleiner Endpunktwerte…": each bounds the other's range.
            21..=28 => number_below(word, self.settings.end[at(21)]),
            31..=38 => number_above(word, self.settings.zero[at(31)]),
            41..=48 => word.min(2),
            49 | 50 | 59 => word.min(255),
            51..=58 => word.min(1),
            _ => number(word),
        }
    }

    fn write(&mut self, _now: Time, register: u16, word: u16) {
        let at = |first: u16| usize::from(register - first);
        let settings = &mut self.settings;
        match register {
            1..=8 => self.fixed[at(1)] = word,
            11..=18 => settings.damping[at(11)] = word,
            21..=28 => settings.zero[at(21)] = word as i16,
            31..=38 => settings.end[at(31)] = word as i16,
            41..=48 => {
                // "bei Stromeingang automatisch '0'", without a word of an exception.
                let is_voltage = Terminal::numbered(CURRENT_INPUTS, at(41)) == Terminal::Voltage;
                settings.function[at(41)] = if is_voltage { word } else { 0 };
            }
            49 => settings.hold_until_told = word as u8,
            50 => settings.hold_until_reset = word as u8,
            51..=58 => self.reset((word as u8) << at(51)),
            _ => self.reset(word as u8),
        }
        self.look();
    }

    fn advance(&mut self, now: Time) {
        for number in 0..INPUTS {
            let amount = self.at_terminal(number);
            self.inputs[number].measured.advance(now, amount);
        }
        self.look();
    }

    fn restart(&mut self, now: Time) {
        let signals = self.inputs.each_ref().map(|input| input.signal);
        *self = Inputs { settings: self.settings, ..Inputs::new(now) };
        for (input, signal) in self.inputs.iter_mut().zip(signals) {
            input.signal = signal;
        }
        self.look();
    }

    fn forget(&mut self) {
        self.settings = FACTORY;
    }

    fn stimulate(&mut self, _now: Time, stimulus: &Stimulus) -> Result<(), String> {
        match *stimulus {
            Stimulus::Input { input: number @ 1..=8, signal } => {
                let input = usize::from(number) - 1;
                match (Terminal::numbered(CURRENT_INPUTS, input), signal) {
                    (_, Signal::Open)
                    | (Terminal::Voltage, Signal::Volts(_) | Signal::Contact(_))
                    | (Terminal::Current, Signal::Milliamps(_)) => self.inputs[input].signal = signal,
                    (Terminal::Voltage, _) => {
                        return Err(format!(
                            "input {number} is for voltage; it takes volts, a contact or open"
                        ));
                    }
                    (Terminal::Current, _) => {
                        return Err(format!("input {number} is for current; it takes milliamps or open"));
                    }
                }
                Ok(())
            }
            Stimulus::Input { input, .. } => {
                Err(format!("input {input} is not there; the analog board has 1 to 8"))
            }
            _ => Err("the analog board has inputs and nothing else to touch".into()),
        }
    }

    fn outputs(&self) -> Vec<(String, String)> {
        Vec::new()
    }

    fn eeprom(&self) -> Vec<u16> {
        let settings = &self.settings;
        let mut words = vec![settings.hold_until_told.into(), settings.hold_until_reset.into()];
        words.extend([settings.zero, settings.end].concat().iter().map(|number| *number as u16));
        words.extend([settings.damping, settings.function].concat());
        words
    }

    fn load_eeprom(&mut self, words: &mut &[u16]) {
        let [hold_until_told, hold_until_reset] = take_words(words);
        self.settings = Settings {
            hold_until_told: hold_until_told as u8,
            hold_until_reset: hold_until_reset as u8,
            zero: take_words(words).map(|word| word as i16),
            end: take_words(words).map(|word| word as i16),
            damping: take_words(words),
            function: take_words(words),
        };
    }
}

#[cfg(test)]
mod tests;
