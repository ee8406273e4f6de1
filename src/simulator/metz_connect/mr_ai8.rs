//! MR-AI8: eight inputs for voltage, resistance and temperature (Softwarebeschreibung Modbus RTU
//! V2.1, chapter MR-AI8, pages 48 to 58).

use crate::engine::time::Time;
use crate::simulator::device::{Stimulus, take_words};
use crate::simulator::metz_connect::Module;
use crate::simulator::metz_connect::analog_inputs::{AnalogInputs, INPUTS, REGISTERS};
use crate::simulator::metz_connect::channel::{Code, is_above};
use crate::simulator::metz_connect::holding::HoldingRegisters;
use crate::simulator::pdu::{Exception, Request, bits_reply, check_span, words_reply, write_reply};

/// The eight inputs.
pub struct MrAi8 {
    inputs: AnalogInputs,
    /// Register 68, and coil 0. EEPROM.
    fahrenheit: bool,
    /// Registers 70 to 101: on and off, two registers each, for each input. EEPROM.
    thresholds: [u16; 4 * INPUTS],
    /// Whether each value has passed its switch-on threshold and not fallen below the other.
    above: [bool; INPUTS],
}

const UNIT: u16 = 68;
const THRESHOLDS: (u16, u16) = (70, 101);
const THRESHOLD_STATES: u16 = 70;

impl MrAi8 {
    pub fn new(now: Time) -> MrAi8 {
        MrAi8 {
            inputs: AnalogInputs::new(now),
            fahrenheit: false,
            thresholds: [0; 4 * INPUTS],
            above: [false; INPUTS],
        }
    }

    /// Measures all inputs, and compares them with their thresholds.
    fn measure(&mut self, now: Time) {
        self.inputs.measure(now, self.fahrenheit);
        for (number, above) in self.above.iter_mut().enumerate() {
            let (format, value) = (self.inputs.code(number).format, self.inputs.value(number));
            let [on_high, on_low, off_high, off_low] = take_words(&mut &self.thresholds[4 * number..]);
            *above = is_above(format, value, [on_high, on_low], [off_high, off_low], *above);
        }
    }

    /// Discrete inputs 0 to 7: bit 8 of the code turns each over.
    fn threshold_states(&self) -> [bool; INPUTS] {
        std::array::from_fn(|number| self.above[number] != (self.inputs.raw_code(number) >> 8 & 1 == 1))
    }
}

impl HoldingRegisters for MrAi8 {
    /// Holding registers 0 to 63, 68 and 70 to 101 (page 50).
    fn check(first: u16, count: usize) -> Result<(), Exception> {
        let allowed = match first {
            UNIT => (UNIT, UNIT),
            70.. => THRESHOLDS,
            _ => REGISTERS,
        };
        check_span(first, count, 125, allowed)
    }

    fn read(&self, register: u16) -> u16 {
        match register {
            UNIT => self.fahrenheit.into(),
            70.. => self.thresholds[usize::from(register - THRESHOLDS.0)],
            _ => self.inputs.read(register),
        }
    }

    fn write(&mut self, now: Time, first: u16, words: &[u16]) -> Result<(), Exception> {
        self.inputs.check_codes(first, words, |word| Code::parse(word).is_some())?;
        for (register, word) in (first..).zip(words) {
            match register {
                UNIT => self.fahrenheit = word & 1 == 1,
                70.. => self.thresholds[usize::from(register - THRESHOLDS.0)] = *word,
                _ => self.inputs.write(now, register, *word),
            }
        }
        self.measure(now);
        Ok(())
    }
}

impl Module for MrAi8 {
    const PRODUCT: &'static str = "MR-AI8";
    const VERSION: &'static str = "V1.8";
    const FUNCTIONS: &'static [u8] = &[1, 2, 3, 4, 5, 6, 16];

    fn serve(&mut self, now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::Read { function: 1, first, count } => {
                check_span(first, count.into(), 1, (0, 0))?;
                Ok(bits_reply(1, &[self.fahrenheit]))
            }
            Request::Read { function: 2, first, count } => {
                // The page speaks of "2 x Anzahl der Register" bytes: the words of function 4, put
                // there by mistake. Function 2 answers bits.
                check_span(first, count.into(), INPUTS, (0, 7))?;
                Ok(bits_reply(2, &self.threshold_states()[usize::from(first)..usize::from(first + count)]))
            }
            Request::Read { function: 4, first: THRESHOLD_STATES, count } => {
                let allowed = (THRESHOLD_STATES, THRESHOLD_STATES);
                check_span(THRESHOLD_STATES, count.into(), 2 * INPUTS, allowed)?;
                let states = self.threshold_states();
                let bits = states.iter().enumerate().map(|(number, on)| u16::from(*on) << number).sum();
                Ok(words_reply(4, &[bits]))
            }
            Request::Read { function: 4, first, count } => self.inputs.read_values(first, count),
            Request::WriteCoil { address, value } => {
                if value != 0 && value != 0xFF00 {
                    return Err(Exception::Value);
                }
                check_span(address, 1, 1, (0, 0))?;
                self.write(now, UNIT, &[u16::from(value != 0)])?;
                Ok(write_reply(5, address, value))
            }
            _ => self.serve_holding(now, request),
        }
    }

    fn advance(&mut self, now: Time) {
        self.measure(now);
    }

    fn restart(&mut self, now: Time) {
        self.inputs.clear_offsets();
        self.inputs.restart(now);
        self.above = [false; INPUTS];
        self.measure(now);
    }

    fn stimulate(&mut self, now: Time, stimulus: &Stimulus) -> Result<(), String> {
        self.inputs.stimulate(Self::PRODUCT, stimulus)?;
        self.measure(now);
        Ok(())
    }

    fn outputs(&self) -> Vec<(String, String)> {
        let states = self.threshold_states().into_iter().enumerate();
        let states = states.map(|(number, on)| {
            (format!("threshold_{}", number + 1), if on { "ON" } else { "OFF" }.to_string())
        });
        self.inputs.outputs().into_iter().chain(states).collect()
    }

    fn eeprom(&self) -> Vec<u16> {
        let mut words = self.inputs.eeprom();
        words.push(self.fahrenheit.into());
        words.extend(self.thresholds);
        words
    }

    fn load_eeprom(&mut self, mut words: &[u16]) {
        let words = &mut words;
        self.inputs.load_eeprom(words);
        self.fahrenheit = take_words::<1>(words) == [1];
        self.thresholds = take_words(words);
    }
}

#[cfg(test)]
mod tests {
    use crate::simulator::device::Model;
    use crate::simulator::testing::Bench;

    /// A bench on which the first measurement is done.
    fn bench() -> Bench {
        let mut bench = Bench::new(Model::MrAi8);
        bench.wait(250);
        bench
    }

    /// Writes the code of input 1, connects `signal`, waits for the measurement and reads the value.
    #[track_caller]
    fn check_value(code: u16, signal: &str, words: &str) {
        let mut bench = bench();
        bench.ask(&format!("06 0010 {code:04X}"));
        bench.act(&format!("input 1 {signal}")).expect("a signal");
        bench.wait(250);
        bench.check(&[("04 0000 0002", &format!("04 04 {words}"))]);
    }

    #[test]
    fn the_code_decides_type_and_unit_of_the_value_pages_51_to_55() {
        check_value(0x00, "volts 2.5", "4020 0000");
        check_value(0x00, "volts 12", "4123 D70A");
        check_value(0x01, "volts 2.5", "1F40 0000");
        check_value(0x20, "open", "40A0 0000");
        check_value(0x40, "ohms 107.8", "42D7 999A");
        check_value(0x41, "ohms 107.8", "0436 0000");
        check_value(0x44, "ohms 107.8", "0001 0000");
        check_value(0x80, "ohms 100", "0000 0000");
        check_value(0x81, "ohms 107.794", "00C8 0000");
        check_value(0x81, "ohms 80.306", "FE0C 0000");
        check_value(0x81, "open", "05DC 0000");
        check_value(0x85, "ohms 1077.94", "00C8 0000");
        check_value(0x99, "volts 2.9815", "00FA 0000");
        check_value(0x97, "ohms 20000", "00FA 0000");
        check_value(0x9B, "celsius 120", "044C 0000");
        check_value(0x8A, "celsius 21.5", "41AC 0000");
    }

    #[test]
    fn register_68_and_coil_0_choose_the_unit_of_sensors_and_not_of_the_table_page_49() {
        let mut bench = bench();
        // Input 1: PT100 as integer; input 2: table, linear, of ohms, as integer.
        bench.check(&[("10 0010 0002 04 0081 00F9", "10 0010 0002")]);
        bench.act("input 1 celsius 20").expect("a signal");
        bench.act("input 2 celsius 20").expect("a signal");
        bench.wait(250);
        bench.check(&[
            ("04 0000 0004", "04 08 00C8 0000 00C8 0000"),
            ("05 0000 FF00", "05 0000 FF00"),
            ("03 0044 0001", "03 02 0001"),
            ("04 0000 0004", "04 08 02A8 0000 00C8 0000"),
            ("06 0044 FFFE", "06 0044 FFFE"),
            ("01 0000 0001", "01 01 00"),
            ("04 0000 0001", "04 02 00C8"),
            ("05 0001 FF00", "85 02"),
            ("05 0000 1234", "85 03"),
            ("01 0000 0002", "81 03"),
            ("01 0001 0001", "81 02"),
        ]);
    }

    #[test]
    fn the_registers_are_those_of_pages_48_to_50_and_no_others() {
        let zeros =
            |function: &str, count: usize| format!("{function}{:02X}{}", 2 * count, "0000".repeat(count));
        bench().check(&[
            ("04 0000 0010", &zeros("04", 16)),
            ("04 0005 0001", "04 02 0000"),
            ("04 0046 0001", "04 02 0000"),
            ("04 000F 0002", "84 02"),
            ("04 0010 0001", "84 02"),
            ("04 0046 0002", "84 02"),
            ("04 0000 0011", "84 03"),
            ("03 0000 0040", &zeros("03", 64)),
            ("03 0044 0001", "03 02 0000"),
            ("03 0046 0020", &zeros("03", 32)),
            ("03 0000 0041", "83 02"),
            ("03 0040 0001", "83 02"),
            ("03 0041 0001", "83 02"),
            ("03 0044 0002", "83 02"),
            ("03 0045 0001", "83 02"),
            ("03 0046 0021", "83 02"),
            ("03 0000 007E", "83 03"),
            ("06 0040 0000", "86 02"),
            ("10 003F 0002 04 0000 0000", "90 02"),
            ("02 0000 0008", "02 01 00"),
            ("02 0007 0002", "82 02"),
            ("02 0000 0009", "82 03"),
            ("0F 0000 0001 01 01", "8F 01"),
        ]);
    }

    #[test]
    fn a_reserved_code_is_refused_and_nothing_of_its_request_written_pages_51_to_53() {
        bench().check(&[
            ("06 0010 0002", "86 03"),
            ("06 0010 0060", "86 03"),
            ("06 0010 009C", "86 03"),
            ("06 0010 0280", "86 03"),
            ("10 0010 0002 04 0081 00FC", "90 03"),
            ("03 0010 0002", "03 04 0000 0000"),
        ]);
    }

    #[test]
    fn a_value_is_0_until_it_has_been_measured_after_a_start_or_a_new_code_page_48() {
        let mut bench = Bench::new(Model::MrAi8);
        bench.act("input 1 volts 1").expect("a signal");
        // The offset does not make a value of what has not been measured.
        bench.check(&[("10 0000 0002 04 3F80 0000", "10 0000 0002"), ("04 0000 0002", "04 04 0000 0000")]);
        bench.wait(250);
        bench.check(&[("04 0000 0002", "04 04 4000 0000"), ("06 0010 0001", "06 0010 0001")]);
        bench.check(&[("04 0000 0002", "04 04 0000 0000")]);
        bench.wait(250);
        // The old offset's first word is now an integer: 0x3F80 steps.
        bench.check(&[("04 0000 0002", "04 04 4C00 0000")]);
    }

    #[test]
    fn the_offset_has_the_value_s_own_format_and_is_forgotten_at_a_restart_page_50() {
        let mut bench = bench();
        bench.check(&[("06 0011 0081", "06 0011 0081"), ("06 0002 FFFB", "06 0002 FFFB")]);
        bench.act("input 2 celsius 20").expect("a signal");
        bench.wait(250);
        bench.check(&[("04 0002 0002", "04 04 00C3 0000"), ("06 0002 7FFF", "06 0002 7FFF")]);
        bench.check(&[("04 0002 0001", "04 02 7FFF"), ("08 0001 0000", "08 0001 0000")]);
        bench.wait(250);
        bench.check(&[("03 0002 0001", "03 02 0000"), ("04 0002 0001", "04 02 00C8")]);
    }

    #[test]
    fn a_threshold_switches_above_its_upper_and_below_its_lower_value_page_57() {
        let mut bench = bench();
        // Input 3 and input 4 PT100 as integers, input 4 turned over; on at 25.0, off at 20.0.
        bench.check(&[
            ("10 0012 0002 04 0081 0181", "10 0012 0002"),
            ("10 004E 0008 10 00FA 0000 00C8 0000 00FA 0000 00C8 0000", "10 004E 0008"),
        ]);
        for (celsius, states) in [
            ("24", "08"),
            ("25", "08"),
            ("25.1", "04"),
            ("22", "04"),
            ("20", "04"),
            ("19.9", "08"),
            ("22", "08"),
        ] {
            bench.act(&format!("input 3 celsius {celsius}")).expect("a signal");
            bench.act(&format!("input 4 celsius {celsius}")).expect("a signal");
            bench.wait(250);
            bench.check(&[
                ("02 0000 0008", &format!("02 01 {states}")),
                ("04 0046 0001", &format!("04 02 00{states}")),
            ]);
        }
        bench.act("input 3 celsius 30").expect("a signal");
        bench.check(&[("02 0002 0001", "02 01 01")]);
        // As floats: on at 1.0, off at 0.5 volts of input 1.
        bench.check(&[("10 0046 0004 08 3F80 0000 3F00 0000", "10 0046 0004")]);
        for (volts, state) in [("1.0", "00"), ("1.01", "01"), ("0.5", "01"), ("0.49", "00")] {
            bench.act(&format!("input 1 volts {volts}")).expect("a signal");
            bench.check(&[("02 0000 0001", &format!("02 01 {state}"))]);
        }
    }

    #[test]
    fn the_interpolation_table_makes_temperatures_of_ohms_and_volts_page_56() {
        let mut bench = bench();
        // Two points, 0 °C at 1000 Ω and 100 °C at 2000 Ω; then the end.
        bench.check(&[
            ("10 0018 0008 10 0000 0000 447A 0000 42C8 0000 44FA 0000", "10 0018 0008"),
            ("06 0010 00F8", "06 0010 00F8"),
        ]);
        bench.act("input 1 ohms 1250").expect("a signal");
        bench.wait(250);
        bench.check(&[("04 0000 0002", "04 04 41C8 0000"), ("06 0010 00F9", "06 0010 00F9")]);
        bench.wait(250);
        bench.check(&[("04 0000 0002", "04 04 00FA 0000")]);
    }

    #[test]
    fn all_settings_but_the_offsets_outlive_a_restart_page_50() {
        let mut bench = bench();
        bench.check(&[
            ("10 0010 0008 10 0080 0081 0082 0083 0084 0085 0086 0087", "10 0010 0008"),
            ("06 003F 1234", "06 003F 1234"),
            ("06 0044 0001", "06 0044 0001"),
            ("06 0065 4321", "06 0065 4321"),
        ]);
        let kept = bench.device.eeprom();
        let mut other = Bench::new(Model::MrAi8);
        other.device.load_eeprom(other.now, &kept).expect("an EEPROM of the same device");
        other.check(&[
            ("03 0010 0008", "03 10 0080 0081 0082 0083 0084 0085 0086 0087"),
            ("03 003F 0001", "03 02 1234"),
            ("03 0044 0001", "03 02 0001"),
            ("03 0065 0001", "03 02 4321"),
        ]);
    }
}
