//! Eight inputs for voltage, resistance and temperature: what the chapters MR-AI8 of METZ CONNECT
//! (pages 48 to 57) and of BTR (section 10.1) agree on.

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Signal, Stimulus, take_words};
use crate::simulator::metz_connect::channel::{Code, Format, measure, raw_words};
use crate::simulator::pdu::{Exception, check_span, words_reply};

/// The inputs, with registers 0 to 63.
pub struct AnalogInputs {
    /// Registers 0 to 15. Of all settings only these are not marked as EEPROM: a restart clears them.
    offsets: [u16; 2 * INPUTS],
    /// Registers 16 to 23. EEPROM.
    codes: [u16; INPUTS],
    /// Registers 24 to 63: temperature and resistance of ten points, each a float. EEPROM.
    table: [u16; TABLE_WORDS],
    inputs: [Input; INPUTS],
}

#[derive(Clone, Copy, Debug)]
struct Input {
    signal: Signal,
    /// When the first measurement after a start or a new configuration is ready.
    ready_at: Time,
    /// The two registers of the measured value.
    words: [u16; 2],
}

/// How many inputs there are.
pub const INPUTS: usize = 8;
/// The offsets, the codes and the table.
pub const REGISTERS: (u16, u16) = (0, 63);
const TABLE_WORDS: usize = 40;
const CODES: u16 = 16;
const TABLE: u16 = 24;
/// "Solange noch keine Messung erfolgt ist, ist der Messwert 0"; the manuals name no time for it.
const FIRST_MEASUREMENT: Duration = Duration::from_millis(250);

impl AnalogInputs {
    pub fn new(now: Time) -> AnalogInputs {
        let input = Input { signal: Signal::Open, ready_at: now + FIRST_MEASUREMENT, words: [0; 2] };
        AnalogInputs {
            offsets: [0; 2 * INPUTS],
            codes: [0; INPUTS],
            table: [0; TABLE_WORDS],
            inputs: [input; INPUTS],
        }
    }

    /// One of the registers 0 to 63.
    pub fn read(&self, register: u16) -> u16 {
        match register {
            TABLE.. => self.table[usize::from(register - TABLE)],
            CODES.. => self.codes[usize::from(register - CODES)],
            _ => self.offsets[usize::from(register)],
        }
    }

    /// Writes one of the registers 0 to 63; a code has been checked by [`check_codes`].
    pub fn write(&mut self, now: Time, register: u16, word: u16) {
        match register {
            TABLE.. => self.table[usize::from(register - TABLE)] = word,
            CODES.. => {
                let number = usize::from(register - CODES);
                // Another circuit or sensor has to measure first; bit 8 only turns a comparison.
                if (self.codes[number] ^ word) & 0xFF != 0 {
                    self.inputs[number].ready_at = now + FIRST_MEASUREMENT;
                }
                self.codes[number] = word;
            }
            _ => self.offsets[usize::from(register)] = word,
        }
    }

    /// Measures all inputs.
    pub fn measure(&mut self, now: Time, fahrenheit: bool) {
        for number in 0..INPUTS {
            let (code, input) = (self.code(number), self.inputs[number]);
            let offset = [self.offsets[2 * number], self.offsets[2 * number + 1]];
            self.inputs[number].words = if now < input.ready_at {
                [0; 2]
            } else {
                raw_words(code, measure(code, input.signal, &self.table, fahrenheit), offset)
            };
        }
    }

    /// Answers function 4 for registers 0 to 15.
    pub fn read_values(&self, first: u16, count: u16) -> Result<Vec<u8>, Exception> {
        check_span(first, count.into(), 2 * INPUTS, (0, 15))?;
        let words: Vec<u16> = self.inputs.iter().flat_map(|input| input.words).collect();
        Ok(words_reply(4, &words[usize::from(first)..usize::from(first + count)]))
    }

    /// The code register of an input, which counts from 0, as it was written.
    pub fn raw_code(&self, number: usize) -> u16 {
        self.codes[number]
    }

    /// What the code register says.
    pub fn code(&self, number: usize) -> Code {
        // Only allowed codes are ever written.
        Code::parse(self.codes[number]).unwrap_or_default()
    }

    /// The two registers of the measured value.
    pub fn value(&self, number: usize) -> [u16; 2] {
        self.inputs[number].words
    }

    pub fn restart(&mut self, now: Time) {
        self.offsets = [0; 2 * INPUTS];
        for input in &mut self.inputs {
            input.ready_at = now + FIRST_MEASUREMENT;
        }
    }

    pub fn stimulate(&mut self, stimulus: &Stimulus) -> Result<(), String> {
        match *stimulus {
            Stimulus::Input { input: number @ 1..=8, signal } => {
                if !matches!(signal, Signal::Open | Signal::Ohms(_) | Signal::Volts(_) | Signal::Celsius(_)) {
                    return Err("an input of MR-AI8 takes ohms, volts, celsius or open".into());
                }
                self.inputs[usize::from(number) - 1].signal = signal;
                Ok(())
            }
            Stimulus::Input { input, .. } => Err(format!("input {input} is not there; MR-AI8 has 1 to 8")),
            _ => Err("MR-AI8 has inputs and nothing else to touch".into()),
        }
    }

    /// What a person who could read registers would see.
    pub fn outputs(&self) -> Vec<(String, String)> {
        let text = |number: usize| {
            let [high, low] = self.value(number);
            match self.code(number).format {
                Format::Float => f32::from_bits(u32::from(high) << 16 | u32::from(low)).to_string(),
                Format::Integer { .. } => (high as i16).to_string(),
            }
        };
        (0..INPUTS).map(|number| (format!("input_{}", number + 1), text(number))).collect()
    }

    pub fn eeprom(&self) -> Vec<u16> {
        self.codes.iter().chain(&self.table).copied().collect()
    }

    /// Takes as many words as [`AnalogInputs::eeprom`] gives.
    pub fn load_eeprom(&mut self, words: &mut &[u16]) {
        self.codes = take_words(words);
        self.table = take_words(words);
    }
}

/// Refuses a write that holds a reserved code: it has no meaning that could be measured.
pub fn check_codes(first: u16, words: &[u16], is_code: impl Fn(u16) -> bool) -> Result<(), Exception> {
    let mut codes = (first..).zip(words).filter(|(register, _)| (CODES..TABLE).contains(register));
    if codes.all(|(_, word)| is_code(*word)) { Ok(()) } else { Err(Exception::Value) }
}
