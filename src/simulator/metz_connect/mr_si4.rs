//! MR-SI4: four pulse inputs with 48-bit counters and calculated meter readings (Softwarebeschreibung
//! Modbus RTU V2.1, pages 16 to 20).

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Signal, Stimulus, take_words};
use crate::simulator::metz_connect::Module;
use crate::simulator::pdu::{Exception, Request, bits_reply, check_span, words_reply, write_reply};

/// The four inputs and the button.
pub struct MrSi4 {
    inputs: [Input; INPUTS],
}

/// One input with its counter and its settings. All of it outlives a restart: the table marks the
/// holding registers as EEPROM, and of the pulse counter the manual wants that it behaves exactly
/// like the meter behind it, which forgets nothing either.
#[derive(Clone, Copy, Debug)]
struct Input {
    /// IZ, 48 bits.
    pulses: u64,
    /// IT: the counter at the press of the button, 48 bits.
    at_button: u64,
    /// AZ.
    initial: u32,
    /// IE.
    pulses_per_unit: u16,
    /// WI and WU.
    current_factor: u16,
    voltage_factor: u16,
    /// WP: false is formula 0, true is formula 1.
    factors_only_pulses: bool,
    /// ZS, high and low byte.
    digits: u8,
    decimals: u8,
    /// TA.
    button_enabled: bool,
    contact: Contact,
}

/// What is connected to an input.
#[derive(Clone, Copy, Debug)]
struct Contact {
    closed: bool,
    /// When the closing of a pulse ends.
    opens_at: Option<Time>,
    last_counted: Option<Time>,
    /// Closings still to come, from this one on.
    next_pulse: Time,
    remaining: u64,
    every: Duration,
}

const OPEN: Contact = Contact {
    closed: false,
    opens_at: None,
    last_counted: None,
    next_pulse: Time(0),
    remaining: 0,
    every: PULSE_DISTANCE,
};
const INPUTS: usize = 4;
/// "Alle 60 Millisekunden kann ein Impuls vom Stromzähler kommen": what comes faster is not counted.
const PULSE_DISTANCE: Duration = Duration::from_millis(60);
/// How long a simulated pulse keeps the contact closed, as the S0 interface asks for.
const PULSE_LENGTH: Duration = Duration::from_millis(30);
const COUNTER_MASK: u64 = 0xFFFF_FFFF_FFFF;
const DIGITS_MAX: u8 = 9;
const DECIMALS_MAX: u8 = 3;
/// The first register of each block, and how many registers a value of it has.
const HOLDING_BLOCKS: [(u16, u16); 8] =
    [(0, 3), (12, 2), (20, 1), (24, 1), (28, 1), (32, 1), (36, 1), (40, 1)];
const INPUT_BLOCKS: [(u16, u16); 3] = [(0, 3), (12, 2), (20, 1)];
const HOLDING_LAST: u16 = 43;
const INPUT_LAST: u16 = 20;
/// The words that one input keeps in [`Module::eeprom`].
const EEPROM_WORDS: usize = 14;

impl MrSi4 {
    pub fn new(_now: Time) -> MrSi4 {
        let input = Input {
            pulses: 0,
            at_button: 0,
            initial: 0,
            pulses_per_unit: 1,
            current_factor: 1,
            voltage_factor: 1,
            factors_only_pulses: false,
            digits: 7,
            decimals: 1,
            button_enabled: true,
            contact: OPEN,
        };
        MrSi4 { inputs: [input; INPUTS] }
    }

    fn input_registers(&self) -> Vec<u16> {
        let counters = self.inputs.iter().flat_map(|input| words48(input.pulses));
        let readings = self.inputs.iter().flat_map(|input| words32(input.meter_reading()));
        let states = self.inputs.iter().enumerate();
        let states = states.map(|(number, input)| u16::from(input.contact.closed) << number).sum();
        counters.chain(readings).chain([states]).collect()
    }

    fn holding_registers(&self) -> Vec<u16> {
        let each = |word: fn(&Input) -> u16| self.inputs.iter().map(word).collect::<Vec<u16>>();
        let mut words: Vec<u16> = self.inputs.iter().flat_map(|input| words48(input.at_button)).collect();
        words.extend(self.inputs.iter().flat_map(|input| words32(input.initial)));
        words.extend(each(|input| input.pulses_per_unit));
        words.extend(each(|input| input.current_factor));
        words.extend(each(|input| input.voltage_factor));
        words.extend(each(|input| input.factors_only_pulses.into()));
        words.extend(each(|input| u16::from_be_bytes([input.digits, input.decimals])));
        words.extend(each(|input| input.button_enabled.into()));
        words
    }

    /// Writes registers that have been checked to be whole values.
    fn write(&mut self, first: u16, written: &[u16]) {
        let mut words = self.holding_registers();
        let first = usize::from(first);
        words[first..first + written.len()].copy_from_slice(written);
        for (number, input) in self.inputs.iter_mut().enumerate() {
            let single = |block: usize| words[20 + 4 * block + number];
            input.at_button = words[3 * number..3 * number + 3]
                .iter()
                .fold(0, |value, word| value << 16 | u64::from(*word));
            input.initial = u32::from(words[12 + 2 * number]) << 16 | u32::from(words[13 + 2 * number]);
            input.pulses_per_unit = single(0);
            input.current_factor = single(1);
            input.voltage_factor = single(2);
            // "nur Bit 0 gilt", of WP and of TA.
            input.factors_only_pulses = single(3) & 1 == 1;
            let [digits, decimals] = single(4).to_be_bytes();
            // "größere Werte werden auf 9 begrenzt", "auf 3 begrenzt".
            input.digits = digits.min(DIGITS_MAX);
            input.decimals = decimals.min(DECIMALS_MAX);
            input.button_enabled = single(5) & 1 == 1;
        }
    }
}

impl Input {
    /// BZ, by the manual's "Details zur Berechnung": everything in a wide integer, the division by IE
    /// behind all multiplications, the digits cut off last.
    fn meter_reading(&self) -> u32 {
        let factors = u128::from(self.current_factor) * u128::from(self.voltage_factor);
        // IZ and IT are uint48_t, and so is their difference before it is made wider.
        let counted = u128::from(self.pulses.wrapping_sub(self.at_button) & COUNTER_MASK);
        let power = |exponent: u8| 10u128.pow(exponent.into());
        let scaled = counted * factors * power(self.decimals);
        // The manual allows every IE and does not say what 0 gives: here the pulses then count nothing.
        let counted = scaled.checked_div(u128::from(self.pulses_per_unit)).unwrap_or(0);
        let initial = u128::from(self.initial) * if self.factors_only_pulses { 1 } else { factors };
        ((counted + initial) % power(self.digits)) as u32
    }

    fn advance(&mut self, now: Time) {
        while self.contact.remaining > 0 && self.contact.next_pulse <= now {
            let at = self.contact.next_pulse;
            self.close(at);
            let contact = &mut self.contact;
            contact.remaining -= 1;
            contact.next_pulse = at + contact.every;
            contact.opens_at = Some(at + PULSE_LENGTH.min(contact.every / 2));
        }
        if self.contact.opens_at.is_some_and(|opens_at| opens_at <= now) {
            self.contact.closed = false;
            self.contact.opens_at = None;
        }
    }

    /// The contact closes: that is what is counted.
    fn close(&mut self, now: Time) {
        self.contact.closed = true;
        if self.contact.last_counted.is_none_or(|last| now.since(last) >= PULSE_DISTANCE) {
            self.pulses = self.pulses.wrapping_add(1) & COUNTER_MASK;
            self.contact.last_counted = Some(now);
        }
    }
}

/// Whether a span begins and ends at the border of a value: "Diese Daten können nur komplett
/// übertragen werden".
fn check_whole(first: u16, count: u16, blocks: &[(u16, u16)]) -> Result<(), Exception> {
    let is_border = |register: u16| {
        let block = blocks.iter().rev().find(|(start, _)| *start <= register);
        block.is_some_and(|(start, width)| (register - start) % width == 0)
    };
    if is_border(first) && is_border(first + count) { Ok(()) } else { Err(Exception::Address) }
}

fn words48(value: u64) -> [u16; 3] {
    [(value >> 32) as u16, (value >> 16) as u16, value as u16]
}

fn words32(value: u32) -> [u16; 2] {
    [(value >> 16) as u16, value as u16]
}

impl Module for MrSi4 {
    const PRODUCT: &'static str = "MR-SI4";
    const VERSION: &'static str = "V2.1";
    const FUNCTIONS: &'static [u8] = &[2, 3, 4, 6, 16];

    fn serve(&mut self, _now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::Read { function: 2, first, count } => {
                check_span(first, count.into(), INPUTS, (0, 3))?;
                let inputs = &self.inputs[usize::from(first)..usize::from(first + count)];
                let states: Vec<bool> = inputs.iter().map(|input| input.contact.closed).collect();
                Ok(bits_reply(2, &states))
            }
            Request::Read { function, first, count } => {
                // The table of function 4 says "start 0, quantity 21", the list behind it "(0-20)" and
                // "nur komplett": every whole value within the span can be read.
                let (words, last, blocks) = if function == 4 {
                    (self.input_registers(), INPUT_LAST, &INPUT_BLOCKS[..])
                } else {
                    (self.holding_registers(), HOLDING_LAST, &HOLDING_BLOCKS[..])
                };
                check_span(first, count.into(), 125, (0, last))?;
                check_whole(first, count, blocks)?;
                Ok(words_reply(function, &words[usize::from(first)..usize::from(first + count)]))
            }
            Request::WriteRegister { address, word } => {
                // "06 Write Single Register (20-43)": the registers before are parts of long values.
                check_span(address, 1, 1, (20, HOLDING_LAST))?;
                self.write(address, &[word]);
                Ok(write_reply(6, address, word))
            }
            Request::WriteRegisters { first, ref words } => {
                check_span(first, words.len(), 123, (0, HOLDING_LAST))?;
                check_whole(first, words.len() as u16, &HOLDING_BLOCKS)?;
                self.write(first, words);
                Ok(write_reply(16, first, words.len() as u16))
            }
            _ => Err(Exception::Function),
        }
    }

    fn advance(&mut self, now: Time) {
        self.inputs.iter_mut().for_each(|input| input.advance(now));
    }

    fn restart(&mut self, now: Time) {
        // A meter goes on pulsing while the device starts; what came without power is not counted.
        for input in &mut self.inputs {
            while input.contact.remaining > 0 && input.contact.next_pulse <= now {
                input.contact.remaining -= 1;
                input.contact.next_pulse += input.contact.every;
            }
            input.contact.last_counted = None;
        }
    }

    fn stimulate(&mut self, now: Time, stimulus: &Stimulus) -> Result<(), String> {
        match *stimulus {
            Stimulus::Button => {
                for input in self.inputs.iter_mut().filter(|input| input.button_enabled) {
                    input.at_button = input.pulses;
                }
                Ok(())
            }
            Stimulus::Input { input: number @ 1..=4, signal } => {
                let input = &mut self.inputs[usize::from(number) - 1];
                match signal {
                    Signal::Open | Signal::Contact(false) => {
                        input.contact = Contact { last_counted: input.contact.last_counted, ..OPEN };
                    }
                    Signal::Contact(true) => {
                        if !input.contact.closed {
                            input.close(now);
                        }
                        input.contact.remaining = 0;
                        input.contact.opens_at = None;
                    }
                    Signal::Pulses { count, every } if !every.is_zero() => {
                        input.contact.remaining = count;
                        input.contact.every = every;
                        input.contact.next_pulse = now;
                        input.advance(now);
                    }
                    Signal::Counter(count) if count <= COUNTER_MASK => input.pulses = count,
                    Signal::Pulses { .. } => {
                        return Err("pulses need a distance, such as `every 80ms`".into());
                    }
                    Signal::Counter(_) => return Err(format!("a counter ends at {COUNTER_MASK}")),
                    _ => return Err("an input of MR-SI4 takes a contact, pulses or a counter".into()),
                }
                Ok(())
            }
            Stimulus::Input { input, .. } => Err(format!("input {input} is not there; MR-SI4 has 1 to 4")),
            _ => Err("MR-SI4 has inputs and a button, no relays".into()),
        }
    }

    fn outputs(&self) -> Vec<(String, String)> {
        let inputs = self.inputs.iter().enumerate();
        inputs.map(|(number, input)| (format!("counter_{}", number + 1), input.pulses.to_string())).collect()
    }

    fn eeprom(&self) -> Vec<u16> {
        let mut words: Vec<u16> = self.inputs.iter().flat_map(|input| words48(input.pulses)).collect();
        words.extend(self.holding_registers());
        words
    }

    fn load_eeprom(&mut self, mut words: &[u16]) {
        if words.len() == INPUTS * EEPROM_WORDS {
            for input in &mut self.inputs {
                let counter = take_words::<3>(&mut words);
                input.pulses = counter.iter().fold(0, |value, word| value << 16 | u64::from(*word));
            }
            self.write(0, words);
        }
    }
}

#[cfg(test)]
mod tests;
