//! MR-AO4 and MR-AOP4: four voltage outputs, without and with hand operation (Softwarebeschreibung
//! Modbus RTU V2.1, pages 44 to 47).

use crate::engine::time::Time;
use crate::simulator::device::{Stimulus, take_words};
use crate::simulator::metz_connect::Module;
use crate::simulator::metz_connect::holding::HoldingRegisters;
use crate::simulator::metz_connect::watchdog::{WATCHDOG, Watchdog};
use crate::simulator::pdu::{Exception, Request, bits_reply, check_span, words_reply};

/// The four outputs; "P" is hand operation.
pub struct AnalogOutputs<const HAND_OPERATION: bool> {
    /// Registers 0 to 3, as the bus wrote them, whatever the hand says: no page tells how a hand's
    /// value could be read.
    values: [i16; OUTPUTS],
    /// Registers 4 to 7. The pages do not name the EEPROM; "Grundeinstellungen" without it would be
    /// none, and page 62 has those of MR-AIO4/2 copied when the device is switched on.
    defaults: [i16; OUTPUTS],
    watchdog: Watchdog,
    /// Volts that a person has set.
    hands: [Option<f64>; OUTPUTS],
}

pub type MrAo4 = AnalogOutputs<false>;
pub type MrAop4 = AnalogOutputs<true>;

const OUTPUTS: usize = 4;
/// "Einheit = 10,24V / 2^15 = 1V / 3200".
const STEPS_PER_VOLT: f64 = 3200.0;
/// The reach of a hand's setting, which is the outputs' own.
const VOLTS_MAX: f64 = 10.24;

impl<const HAND_OPERATION: bool> AnalogOutputs<HAND_OPERATION> {
    pub fn new(now: Time) -> AnalogOutputs<HAND_OPERATION> {
        AnalogOutputs {
            values: [0; OUTPUTS],
            defaults: [0; OUTPUTS],
            watchdog: Watchdog::new(now),
            hands: [None; OUTPUTS],
        }
    }

    /// "1 = Handbetrieb, 0 = Automatikbetrieb" (page 46).
    fn by_hand(&self, first: u16, count: u16) -> Result<&[Option<f64>], Exception> {
        check_span(first, count.into(), OUTPUTS, (0, 3))?;
        Ok(&self.hands[usize::from(first)..usize::from(first + count)])
    }
}

impl<const HAND_OPERATION: bool> HoldingRegisters for AnalogOutputs<HAND_OPERATION> {
    /// "Gültige Register Startadresse 0..7 oder 66, gültige Anzahl an Register 1..8 oder 1".
    fn check(first: u16, count: usize) -> Result<(), Exception> {
        let allowed = if first == WATCHDOG { (first, first) } else { (0, 7) };
        check_span(first, count, 2 * OUTPUTS, allowed)
    }

    fn read(&self, register: u16) -> u16 {
        match usize::from(register) {
            output @ 0..=3 => self.values[output] as u16,
            output @ 4..=7 => self.defaults[output - OUTPUTS] as u16,
            _ => self.watchdog.time,
        }
    }

    fn write(&mut self, _now: Time, first: u16, words: &[u16]) -> Result<(), Exception> {
        for (register, word) in (usize::from(first)..).zip(words) {
            match register {
                output @ 0..=3 => self.values[output] = *word as i16,
                output @ 4..=7 => self.defaults[output - OUTPUTS] = *word as i16,
                _ => self.watchdog.time = *word,
            }
        }
        Ok(())
    }
}

impl<const HAND_OPERATION: bool> Module for AnalogOutputs<HAND_OPERATION> {
    const PRODUCT: &'static str = if HAND_OPERATION { "MR-AOP4" } else { "MR-AO4" };
    const VERSION: &'static str = if HAND_OPERATION { "V1.5" } else { "V1.4" };
    const FUNCTIONS: &'static [u8] = if HAND_OPERATION { &[1, 2, 3, 4, 6, 16] } else { &[3, 6, 16] };

    fn serve(&mut self, now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::Read { function: function @ 1..=2, first, count } => {
                let states: Vec<bool> = self.by_hand(first, count)?.iter().map(Option::is_some).collect();
                Ok(bits_reply(function, &states))
            }
            // Page 46 tells one byte of bits for all three functions; function 4 answers words, and
            // its four addresses are taken as one output each.
            Request::Read { function: 4, first, count } => {
                let states = self.by_hand(first, count)?.iter().map(|hand| u16::from(hand.is_some()));
                Ok(words_reply(4, &states.collect::<Vec<u16>>()))
            }
            _ => self.serve_holding(now, request),
        }
    }

    fn message_for_this_device(&mut self, now: Time) {
        self.watchdog.feed(now);
    }

    fn advance(&mut self, now: Time) {
        if self.watchdog.expires(now) {
            self.values = self.defaults;
        }
    }

    fn restart(&mut self, now: Time) {
        self.values = self.defaults;
        self.watchdog.feed(now);
    }

    fn stimulate(&mut self, _now: Time, stimulus: &Stimulus) -> Result<(), String> {
        match *stimulus {
            Stimulus::HandVolts { output: output @ 1..=4, volts } if HAND_OPERATION => {
                if volts.is_some_and(|volts| !(0.0..=VOLTS_MAX).contains(&volts)) {
                    return Err(format!("an output of MR-AOP4 is set by hand to 0 to {VOLTS_MAX} volts"));
                }
                self.hands[usize::from(output) - 1] = volts;
                Ok(())
            }
            Stimulus::HandVolts { output, .. } if HAND_OPERATION => {
                Err(format!("output {output} is not there; MR-AOP4 has 1 to 4"))
            }
            _ if HAND_OPERATION => {
                Err("MR-AOP4 has outputs with hand operation and nothing else to touch".into())
            }
            _ => Err("MR-AO4 has outputs without hand operation and nothing to touch".into()),
        }
    }

    /// Volts at the terminals; a negative value gives none.
    fn outputs(&self) -> Vec<(String, String)> {
        let volts = |output: usize| {
            self.hands[output].unwrap_or_else(|| f64::from(self.values[output].max(0)) / STEPS_PER_VOLT)
        };
        (0..OUTPUTS)
            .map(|output| (format!("output_{}", output + 1), format!("{:.3} V", volts(output))))
            .collect()
    }

    fn eeprom(&self) -> Vec<u16> {
        let mut words = self.defaults.map(|value| value as u16).to_vec();
        words.push(self.watchdog.time);
        words
    }

    fn load_eeprom(&mut self, mut words: &[u16]) {
        self.defaults = take_words(&mut words).map(|word| word as i16);
        [self.watchdog.time] = take_words(&mut words);
    }
}

#[cfg(test)]
mod tests {
    use crate::simulator::device::{Addressed, Model};
    use crate::simulator::testing::Bench;

    #[test]
    fn registers_0_to_7_are_read_in_any_span_of_1_to_8_and_66_alone_pages_44_and_46() {
        for model in [Model::MrAo4, Model::MrAop4] {
            Bench::new(model).check(&[
                ("10 0000 0008 10 0000 0001 7FFF FFFF 0C80 8000 0002 1234", "10 0000 0008"),
                ("03 0000 0008", "03 10 0000 0001 7FFF FFFF 0C80 8000 0002 1234"),
                ("03 0002 0003", "03 06 7FFF FFFF 0C80"),
                ("03 0007 0001", "03 02 1234"),
                ("03 0007 0002", "83 02"),
                ("03 0008 0001", "83 02"),
                ("03 0000 0009", "83 03"),
                ("03 0000 0000", "83 03"),
                ("03 0042 0001", "03 02 0000"),
                ("03 0042 0002", "83 02"),
                ("03 0041 0001", "83 02"),
                ("06 0003 7D00", "06 0003 7D00"),
                ("06 0042 FFFF", "06 0042 FFFF"),
                ("03 0042 0001", "03 02 FFFF"),
                ("06 0008 0000", "86 02"),
                ("10 0007 0002 04 0000 0000", "90 02"),
                ("10 0042 0001 02 0000", "10 0042 0001"),
                ("10 0041 0002 04 5315 0000", "90 02"),
                ("10 0000 0009 12 000000000000000000000000000000000000", "90 03"),
                ("05 0000 FF00", "85 01"),
                ("0F 0000 0001 01 01", "8F 01"),
            ]);
        }
    }

    #[test]
    fn a_register_counts_3200_steps_to_a_volt_page_44() {
        let mut bench = Bench::new(Model::MrAo4);
        bench.check(&[("10 0000 0004 08 3E80 7FFF FFFF 0001", "10 0000 0004")]);
        for (output, volts) in [
            ("output_1", "5.000 V"),
            ("output_2", "10.240 V"),
            ("output_3", "0.000 V"),
            ("output_4", "0.000 V"),
        ] {
            assert_eq!(bench.output(output), volts, "{output}");
        }
    }

    #[test]
    fn mr_ao4_has_functions_3_6_and_16_and_no_hand_operation_page_44() {
        let mut bench = Bench::new(Model::MrAo4);
        bench.check(&[("01 0000 0001", "81 01"), ("02 0000 0001", "82 01"), ("04 0000 0001", "84 01")]);
        assert!(bench.act("output 1 hand 5").is_err());
    }

    #[test]
    fn mr_aop4_tells_hand_operation_as_coils_as_discrete_inputs_and_as_input_registers_page_46() {
        let mut bench = Bench::new(Model::MrAop4);
        bench.check(&[("06 0002 3E80", "06 0002 3E80"), ("01 0000 0004", "01 01 00")]);
        bench.act("output 1 hand 2.5").expect("hand operation");
        bench.act("output 3 hand 10").expect("hand operation");
        bench.check(&[
            ("01 0000 0004", "01 01 05"),
            ("02 0000 0004", "02 01 05"),
            ("04 0000 0004", "04 08 0001 0000 0001 0000"),
            ("01 0002 0001", "01 01 01"),
            ("02 0001 0003", "02 01 02"),
            ("04 0003 0001", "04 02 0000"),
            ("01 0003 0002", "81 02"),
            ("02 0004 0001", "82 02"),
            ("04 0003 0002", "84 02"),
            ("01 0000 0005", "81 03"),
            ("04 0000 0005", "84 03"),
            // The bus's value waits for the hand to let go.
            ("03 0002 0001", "03 02 3E80"),
        ]);
        assert_eq!(bench.output("output_1"), "2.500 V");
        assert_eq!(bench.output("output_3"), "10.000 V");
        bench.act("output 3 hand automatic").expect("hand operation");
        bench.check(&[("01 0000 0004", "01 01 01")]);
        assert_eq!(bench.output("output_3"), "5.000 V");
        for command in ["output 0 hand 5", "output 5 hand automatic", "output 1 hand 11", "relay 1 hand on"] {
            assert!(bench.act(command).is_err(), "{command}");
        }
    }

    #[test]
    fn a_watchdog_that_no_message_feeds_puts_the_outputs_to_their_defaults_pages_44_and_46() {
        for model in [Model::MrAo4, Model::MrAop4] {
            let mut bench = Bench::new(model);
            bench.check(&[
                ("10 0000 0006 0C 0001 0002 0003 0004 0064 FF9C", "10 0000 0006"),
                ("06 0042 0032", "06 0042 0032"),
            ]);
            bench.wait(499);
            // Even a message that is refused feeds it; one to others does not.
            bench.check(&[("2B 0E 04 00", "AB 03")]);
            bench.wait(499);
            bench.check(&[("03 0000 0004", "03 08 0001 0002 0003 0004")]);
            bench.wait(400);
            bench.send(Addressed::Broadcast, "06 0003 0005");
            bench.wait(100);
            bench.check(&[("03 0000 0004", "03 08 0064 FF9C 0000 0000")]);
            // It has been fed again, and what is written now stays.
            bench.check(&[("06 0000 0001", "06 0000 0001")]);
            bench.wait(499);
            bench.check(&[("03 0000 0001", "03 02 0001")]);
        }
    }

    #[test]
    fn defaults_and_watchdog_outlive_a_restart_and_the_outputs_take_the_defaults_pages_44_and_46() {
        for model in [Model::MrAo4, Model::MrAop4] {
            let mut bench = Bench::new(model);
            bench.check(&[
                ("10 0003 0005 0A 0063 0001 0002 0003 7FFF", "10 0003 0005"),
                ("06 0042 0007", "06 0042 0007"),
                ("08 0001 0000", "08 0001 0000"),
                ("03 0000 0008", "03 10 0001 0002 0003 7FFF 0001 0002 0003 7FFF"),
                ("03 0042 0001", "03 02 0007"),
            ]);
            let kept = bench.device.eeprom();
            let mut other = Bench::new(model);
            other.device.load_eeprom(other.now, &kept).expect("an EEPROM of the same device");
            other.check(&[("03 0003 0001", "03 02 7FFF"), ("03 0042 0001", "03 02 0007")]);
        }
    }
}
