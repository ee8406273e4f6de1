//! MR-SI4: four pulse inputs with 48-bit counters and calculated meter readings (Softwarebeschreibung
//! Modbus RTU V2.1, pages 16 to 20).

use crate::engine::time::Time;
use crate::simulator::device::{Stimulus, take_words};
use crate::simulator::metz_connect::Module;
use crate::simulator::metz_connect::pulse_input::PulseInput;
use crate::simulator::pdu::{Exception, Request, bits_reply, check_span, words_reply, write_reply};

/// The four inputs and the button.
pub struct MrSi4 {
    inputs: [PulseInput; INPUTS],
}

const INPUTS: usize = 4;
/// The first register of each block, and how many registers a value of it has.
const HOLDING_BLOCKS: [(u16, u16); 8] =
    [(0, 3), (12, 2), (20, 1), (24, 1), (28, 1), (32, 1), (36, 1), (40, 1)];
const INPUT_BLOCKS: [(u16, u16); 3] = [(0, 3), (12, 2), (20, 1)];
const HOLDING_LAST: u16 = 43;
const INPUT_LAST: u16 = 20;
/// The words that one input keeps in [`Module::eeprom`].
const EEPROM_WORDS: usize = 14;

impl MrSi4 {
    pub fn new(now: Time) -> MrSi4 {
        MrSi4 { inputs: [PulseInput::new(now); INPUTS] }
    }

    fn input_registers(&self) -> Vec<u16> {
        let counters = self.inputs.iter().flat_map(|input| words48(input.pulses));
        let readings = self.inputs.iter().flat_map(|input| words32(input.meter_reading()));
        let states = self.inputs.iter().enumerate();
        let states = states.map(|(number, input)| u16::from(input.is_closed()) << number).sum();
        counters.chain(readings).chain([states]).collect()
    }

    fn holding_registers(&self) -> Vec<u16> {
        let each = |word: fn(&PulseInput) -> u16| self.inputs.iter().map(word).collect::<Vec<u16>>();
        let mut words: Vec<u16> = self.inputs.iter().flat_map(|input| words48(input.at_button)).collect();
        words.extend(self.inputs.iter().flat_map(|input| words32(input.initial)));
        words.extend(each(|input| input.pulses_per_unit));
        words.extend(each(|input| input.current_factor));
        words.extend(each(|input| input.voltage_factor));
        words.extend(each(|input| input.factors_only_pulses.into()));
        words.extend(each(PulseInput::format));
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
            input.set_format(single(4));
            input.button_enabled = single(5) & 1 == 1;
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
                let states: Vec<bool> = inputs.iter().map(PulseInput::is_closed).collect();
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
        self.inputs.iter_mut().for_each(|input| input.restart(now));
    }

    fn stimulate(&mut self, now: Time, stimulus: &Stimulus) -> Result<(), String> {
        match *stimulus {
            Stimulus::Button => {
                self.inputs.iter_mut().for_each(PulseInput::press_button);
                Ok(())
            }
            Stimulus::Input { input: number @ 1..=4, signal } => {
                self.inputs[usize::from(number) - 1].connect(now, signal, Self::PRODUCT)
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
