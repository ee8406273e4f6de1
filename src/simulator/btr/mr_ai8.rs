//! MR-AI8 of BTR, the forerunner of METZ CONNECT's (its manual, sections 10.1 to 10.3): the same
//! measuring, without thresholds and Fahrenheit, and with at most 20 registers in a request.

use crate::engine::time::Time;
use crate::simulator::device::Stimulus;
use crate::simulator::metz_connect::Module;
use crate::simulator::metz_connect::analog_inputs::{AnalogInputs, REGISTERS};
use crate::simulator::metz_connect::channel::is_code_without_carel;
use crate::simulator::metz_connect::holding::HoldingRegisters;
use crate::simulator::pdu::{Exception, Request, check_span};

/// The eight inputs.
pub struct MrAi8 {
    inputs: AnalogInputs,
}

/// "max. 20 at once", of functions 3 and 16.
const REGISTERS_MAX: usize = 20;

impl MrAi8 {
    pub fn new(now: Time) -> MrAi8 {
        MrAi8 { inputs: AnalogInputs::new(now) }
    }
}

impl HoldingRegisters for MrAi8 {
    fn check(first: u16, count: usize) -> Result<(), Exception> {
        check_span(first, count, REGISTERS_MAX, REGISTERS)
    }

    fn read(&self, register: u16) -> u16 {
        self.inputs.read(register)
    }

    fn write(&mut self, now: Time, first: u16, words: &[u16]) -> Result<(), Exception> {
        // Bit 8 ("15-8: reserviert") and sensor 13 ("13-55: reserviert") are not there.
        self.inputs.check_codes(first, words, is_code_without_carel)?;
        for (register, word) in (first..).zip(words) {
            self.inputs.write(now, register, *word);
        }
        self.advance(now);
        Ok(())
    }
}

impl Module for MrAi8 {
    const VENDOR: &'static str = "BTR";
    /// Section 10.3 prints `MR-A18` and a length of 7 for it. Neither fits the other; the name on the
    /// front has six letters.
    const PRODUCT: &'static str = "MR-AI8";
    const VERSION: &'static str = "V1.0";
    const FUNCTIONS: &'static [u8] = &[3, 4, 6, 16];
    /// Section 10.2 has function 6 alone.
    const LINE_FUNCTIONS: &'static [u8] = &[6];

    fn serve(&mut self, now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::Read { function: 4, first, count } => self.inputs.read_values(first, count),
            _ => self.serve_holding(now, request),
        }
    }

    fn advance(&mut self, now: Time) {
        self.inputs.measure(now, false);
    }

    fn restart(&mut self, now: Time) {
        self.inputs.clear_offsets();
        self.inputs.restart(now);
        self.advance(now);
    }

    fn stimulate(&mut self, now: Time, stimulus: &Stimulus) -> Result<(), String> {
        self.inputs.stimulate(Self::PRODUCT, stimulus)?;
        self.advance(now);
        Ok(())
    }

    fn outputs(&self) -> Vec<(String, String)> {
        self.inputs.outputs()
    }

    fn eeprom(&self) -> Vec<u16> {
        self.inputs.eeprom()
    }

    fn load_eeprom(&mut self, mut words: &[u16]) {
        self.inputs.load_eeprom(&mut words);
    }
}

#[cfg(test)]
mod tests {
    use crate::simulator::device::{LineSettings, Model, Parity};
    use crate::simulator::testing::Bench;

    /// A bench on which the first measurement is done.
    fn bench() -> Bench {
        let mut bench = Bench::new(Model::BtrMrAi8);
        bench.wait(250);
        bench
    }

    fn zeros(function: &str, count: usize) -> String {
        format!("{function}{:02X}{}", 2 * count, "0000".repeat(count))
    }

    #[test]
    fn at_most_20_registers_are_read_and_written_at_once_section_10_1() {
        bench().check(&[
            ("03 0000 0014", &zeros("03", 20)),
            ("03 002C 0014", &zeros("03", 20)),
            ("03 0000 0015", "83 03"),
            ("03 0000 0000", "83 03"),
            ("03 002D 0014", "83 02"),
            (&format!("10 0018 0014 28 {}", "3F80".repeat(20)), "10 0018 0014"),
            ("03 0018 0014", &format!("03 28 {}", "3F80".repeat(20))),
            (&format!("10 0018 0015 2A {}", "0000".repeat(21)), "90 03"),
            ("10 003F 0002 04 0000 0000", "90 02"),
            ("04 0000 0010", &zeros("04", 16)),
            ("04 0003 0002", &zeros("04", 2)),
            ("04 0000 0011", "84 03"),
            ("04 000F 0002", "84 02"),
        ]);
    }

    #[test]
    fn there_are_no_thresholds_no_fahrenheit_and_no_other_functions_section_10_1() {
        bench().check(&[
            ("04 0046 0001", "84 02"),
            ("03 0040 0001", "83 02"),
            ("03 0044 0001", "83 02"),
            ("03 0046 0001", "83 02"),
            ("06 0044 0001", "86 02"),
            ("01 0000 0001", "81 01"),
            ("02 0000 0001", "82 01"),
            ("05 0000 FF00", "85 01"),
            ("0F 0000 0001 01 01", "8F 01"),
        ]);
    }

    #[test]
    fn every_code_of_the_tables_is_taken_and_reserved_ones_are_refused_section_10_1() {
        let mut taken: Vec<u16> = vec![0, 1, 32, 33, 64, 65, 66, 67, 68];
        taken.extend(128..=153);
        taken.extend(240..=251);
        let mut bench = bench();
        for code in 0..=0x1FF {
            let request = format!("06 0017 {code:04X}");
            let reply = if taken.contains(&code) { request.clone() } else { "86 03".into() };
            bench.check(&[(&request, &reply)]);
        }
        bench.check(&[("10 0010 0002 04 0081 0181", "90 03"), ("03 0010 0001", "03 02 0000")]);
    }

    #[test]
    fn values_have_the_type_and_unit_of_their_code_section_10_1() {
        for (code, signal, words) in [
            (0x00, "volts 2.5", "4020 0000"),
            (0x01, "volts 10", "7D00 0000"),
            (0x20, "open", "40A0 0000"),
            (0x40, "ohms 107.8", "42D7 999A"),
            (0x41, "ohms 107.8", "0436 0000"),
            (0x43, "ohms 327670", "7FFF 0000"),
            (0x80, "celsius 21.5", "41AC 0000"),
            (0x81, "ohms 80.306", "FE0C 0000"),
            (0x99, "volts 2.9815", "00FA 0000"),
            (0x85, "open", "05DC 0000"),
        ] {
            let mut bench = bench();
            bench.ask(&format!("06 0011 {code:04X}"));
            bench.act(&format!("input 2 {signal}")).expect("a signal");
            bench.wait(250);
            bench.check(&[("04 0002 0002", &format!("04 04 {words}"))]);
        }
    }

    #[test]
    fn a_value_is_0_until_it_has_been_measured_section_10_1() {
        let mut bench = Bench::new(Model::BtrMrAi8);
        bench.act("input 8 volts 1").expect("a signal");
        bench.check(&[("04 000E 0002", "04 04 0000 0000")]);
        bench.wait(250);
        bench.check(&[("04 000E 0002", "04 04 3F80 0000"), ("06 0017 0001", "06 0017 0001")]);
        bench.check(&[("04 000E 0002", "04 04 0000 0000")]);
        bench.wait(250);
        bench.check(&[("04 000E 0002", "04 04 0C80 0000")]);
    }

    #[test]
    fn the_offset_is_added_in_the_value_s_own_format_and_forgotten_at_a_restart_section_10_1() {
        let mut bench = bench();
        bench.check(&[("06 0012 0081", "06 0012 0081"), ("06 0004 FFFB", "06 0004 FFFB")]);
        bench.act("input 3 celsius 20").expect("a signal");
        bench.act("input 1 volts 1").expect("a signal");
        bench.wait(250);
        bench.check(&[
            ("10 0000 0002 04 3F80 0000", "10 0000 0002"),
            ("04 0000 0006", "04 0C 4000 0000 0000 0000 00C3 0000"),
            ("08 0001 0000", "08 0001 0000"),
        ]);
        bench.wait(250);
        bench.check(&[
            ("04 0000 0006", "04 0C 3F80 0000 0000 0000 00C8 0000"),
            ("03 0000 0001", "03 02 0000"),
        ]);
    }

    #[test]
    fn codes_and_table_outlive_a_restart_section_10_1() {
        let mut bench = bench();
        bench.check(&[
            ("10 0018 0008 10 0000 0000 447A 0000 42C8 0000 44FA 0000", "10 0018 0008"),
            ("06 0010 00F8", "06 0010 00F8"),
        ]);
        let kept = bench.device.eeprom();
        let mut other = Bench::new(Model::BtrMrAi8);
        other.device.load_eeprom(other.now, &kept).expect("an EEPROM of the same device");
        other.act("input 1 ohms 1250").expect("a signal");
        other.wait(250);
        other.check(&[("03 0010 0001", "03 02 00F8"), ("04 0000 0002", "04 04 41C8 0000")]);
    }

    #[test]
    fn register_65_is_set_with_function_6_alone_section_10_2() {
        let mut bench = bench();
        bench.check(&[("10 0041 0001 02 5338", "90 02"), ("06 0041 0038", "86 03")]);
        assert_eq!(bench.device.line_settings(), Some(LineSettings::default()));
        bench.check(&[("06 0041 5338", "06 0041 5338")]);
        let settings = LineSettings { baud: 115_200, parity: Parity::None };
        assert_eq!(bench.device.line_settings(), Some(settings));
    }

    #[test]
    fn diagnostics_are_those_of_metz_connect_section_10_3() {
        bench().check(&[
            ("08 0000 1234", "08 0000 1234"),
            ("08 000A 0000", "08 000A 0000"),
            ("03 0040 0001", "83 02"),
            ("08 000D 0000", "08 000D 0001"),
            ("08 0004 0000", "silence"),
            ("04 0000 0001", "silence"),
            ("08 0001 FF00", "silence"),
            ("04 0000 0001", "04 02 0000"),
        ]);
    }
}
