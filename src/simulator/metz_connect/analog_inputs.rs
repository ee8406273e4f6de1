//! Inputs for voltage, resistance and temperature: what the chapters MR-AI8 of METZ CONNECT (pages 48
//! to 57) and of BTR (section 10.1) agree on, MR-AIO4/2 (pages 62 to 69) with half as many, and MR-Multi
//! I/O (pages 91 to 95) with one of seven for current.

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Signal, Stimulus, take_words};
use crate::simulator::metz_connect::channel::{Code, Format, VOLTS_MAX, float, measure, quantity, raw_words};
use crate::simulator::pdu::{Exception, check_span, words_reply};

/// `N` inputs, with the registers from 0 to 63 that are about them.
pub struct AnalogInputs<const N: usize = INPUTS> {
    /// Two registers for each input from 0 on. Whether they are EEPROM, the devices do not agree on.
    offsets: [[u16; 2]; N],
    /// A register for each input from 16 on. EEPROM.
    codes: [u16; N],
    /// Registers 24 to 63: temperature and resistance of ten points, each a float. EEPROM.
    table: [u16; TABLE_WORDS],
    inputs: [Input; N],
    /// As far as voltages are measured.
    volts_max: f64,
    /// The input that measures current, counted from 0, where one does.
    current_input: Option<usize>,
}

#[derive(Clone, Copy, Debug)]
struct Input {
    signal: Signal,
    /// When the first measurement after a start or a new configuration is ready.
    ready_at: Time,
    /// The two registers of the measured value.
    words: [u16; 2],
    /// The same in volts, ohms or degrees Celsius.
    quantity: f64,
}

/// How many inputs MR-AI8 has.
pub const INPUTS: usize = 8;
/// The offsets, the codes and the table.
pub const REGISTERS: (u16, u16) = (0, 63);
const TABLE_WORDS: usize = 40;
const CODES: u16 = 16;
const TABLE: u16 = 24;
/// "Solange noch keine Messung erfolgt ist, ist der Messwert 0"; the manuals name no time for it.
const FIRST_MEASUREMENT: Duration = Duration::from_millis(250);

impl<const N: usize> AnalogInputs<N> {
    pub fn new(now: Time) -> AnalogInputs<N> {
        let ready_at = now + FIRST_MEASUREMENT;
        let input = Input { signal: Signal::Open, ready_at, words: [0; 2], quantity: 0.0 };
        AnalogInputs {
            offsets: [[0; 2]; N],
            codes: [0; N],
            table: [0; TABLE_WORDS],
            inputs: [input; N],
            volts_max: VOLTS_MAX,
            current_input: None,
        }
    }

    /// The same, of a device that measures voltages up to `volts_max`, and a current at one input.
    pub fn reaching(self, volts_max: f64, current_input: usize) -> AnalogInputs<N> {
        AnalogInputs { volts_max, current_input: Some(current_input), ..self }
    }

    /// One of the registers of offsets, codes and table.
    pub fn read(&self, register: u16) -> u16 {
        match register {
            TABLE.. => self.table[usize::from(register - TABLE)],
            CODES.. => self.codes[usize::from(register - CODES)],
            _ => self.offsets.as_flattened()[usize::from(register)],
        }
    }

    /// Writes one of the same registers; a code has been checked by [`AnalogInputs::check_codes`].
    pub fn write(&mut self, now: Time, register: u16, word: u16) {
        match register {
            TABLE.. => self.table[usize::from(register - TABLE)] = word,
            CODES.. => {
                let number = usize::from(register - CODES);
                // Another circuit or sensor has to measure first; bit 8 only turns a comparison.
                if (self.codes[number] ^ word) & 0xFF != 0 {
                    self.inputs[number].begin(now);
                }
                self.codes[number] = word;
            }
            _ => self.offsets.as_flattened_mut()[usize::from(register)] = word,
        }
    }

    /// Measures all inputs that are ready.
    pub fn measure(&mut self, now: Time, fahrenheit: bool) {
        for number in 0..N {
            if now >= self.inputs[number].ready_at {
                self.measure_one(number, fahrenheit);
            }
        }
    }

    /// Measures one input, whose turn it is.
    pub fn measure_one(&mut self, number: usize, fahrenheit: bool) {
        let (code, offset) = (self.code(number), self.offsets[number]);
        let input = &mut self.inputs[number];
        let value = measure(code, input.signal, &self.table, fahrenheit, self.volts_max);
        input.words = raw_words(code, value, offset);
        input.quantity = quantity(code, value, offset, fahrenheit);
    }

    /// Answers function 4 for the two registers of each value from 0 on.
    pub fn read_values(&self, first: u16, count: u16) -> Result<Vec<u8>, Exception> {
        check_span(first, count.into(), 2 * N, (0, 2 * N as u16 - 1))?;
        let words: Vec<u16> = self.inputs.iter().flat_map(|input| input.words).collect();
        Ok(words_reply(4, &words[usize::from(first)..usize::from(first + count)]))
    }

    /// The code register of an input, which counts from 0, as it was written.
    pub fn raw_code(&self, number: usize) -> u16 {
        self.codes[number]
    }

    /// What the code register says.
    pub fn code(&self, number: usize) -> Code {
        let parse = if self.measures_current(number) { Code::parse_current } else { Code::parse };
        // Only allowed codes are ever written.
        parse(self.codes[number]).unwrap_or_default()
    }

    fn measures_current(&self, number: usize) -> bool {
        self.current_input == Some(number)
    }

    /// The two registers of the measured value.
    pub fn value(&self, number: usize) -> [u16; 2] {
        self.inputs[number].words
    }

    /// The value in volts, ohms or degrees Celsius; 0 where nothing has been measured yet.
    pub fn quantity(&self, number: usize) -> f64 {
        self.inputs[number].quantity
    }

    /// Of MR-AI8's settings only the offsets are not marked as EEPROM (page 50): a restart clears them.
    pub fn clear_offsets(&mut self) {
        self.offsets = [[0; 2]; N];
    }

    pub fn restart(&mut self, now: Time) {
        self.inputs.iter_mut().for_each(|input| input.begin(now));
    }

    pub fn stimulate(&mut self, device: &str, stimulus: &Stimulus) -> Result<(), String> {
        match *stimulus {
            Stimulus::Input { input, signal } if (1..=N).contains(&input.into()) => {
                let number = usize::from(input) - 1;
                match (self.measures_current(number), signal) {
                    (_, Signal::Open)
                    | (false, Signal::Ohms(_) | Signal::Volts(_) | Signal::Celsius(_))
                    | (true, Signal::Milliamps(_)) => self.inputs[number].signal = signal,
                    (false, _) => {
                        return Err(format!("an input of {device} takes ohms, volts, celsius or open"));
                    }
                    (true, _) => return Err(format!("input {input} of {device} takes milliamps or open")),
                }
                Ok(())
            }
            Stimulus::Input { input, .. } => {
                Err(format!("input {input} is not there; {device} has 1 to {N}"))
            }
            _ => Err(format!("{device} has inputs and nothing else to touch")),
        }
    }

    /// What a person who could read registers would see.
    pub fn outputs(&self) -> Vec<(String, String)> {
        let text = |number: usize| {
            let words = self.value(number);
            match self.code(number).format {
                Format::Float => float(words).to_string(),
                Format::Integer { .. } => (words[0] as i16).to_string(),
            }
        };
        (0..N).map(|number| (format!("input_{}", number + 1), text(number))).collect()
    }

    pub fn eeprom(&self) -> Vec<u16> {
        self.codes.iter().chain(&self.table).copied().collect()
    }

    /// Takes as many words as [`AnalogInputs::eeprom`] gives.
    pub fn load_eeprom(&mut self, words: &mut &[u16]) {
        self.codes = take_words(words);
        self.table = take_words(words);
    }

    /// Refuses a write that holds a reserved code: it has no meaning that could be measured.
    pub fn check_codes(
        &self,
        first: u16,
        words: &[u16],
        is_code: impl Fn(u16) -> bool,
    ) -> Result<(), Exception> {
        let registers = CODES..CODES + N as u16;
        let mut codes = (first..).zip(words).filter(|(register, _)| registers.contains(register));
        if codes.all(|(_, word)| is_code(*word)) { Ok(()) } else { Err(Exception::Value) }
    }
}

impl Input {
    /// Forgets what was measured: the device has started, or the input has a new configuration.
    fn begin(&mut self, now: Time) {
        self.ready_at = now + FIRST_MEASUREMENT;
        self.words = [0; 2];
        self.quantity = 0.0;
    }
}
