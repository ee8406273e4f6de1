//! MR-CI4: four inputs for voltage or current (Softwarebeschreibung Modbus RTU V2.1, page 59).

use crate::engine::time::Time;
use crate::simulator::device::{Signal, Stimulus};
use crate::simulator::metz_connect::Module;
use crate::simulator::pdu::{Exception, Request, check_span, words_reply};

/// The four inputs and the eight DIP switches; nothing of them is stored.
pub struct MrCi4 {
    signals: [Signal; INPUTS],
    /// Bit 0 is switch 1.
    switches: u8,
}

/// What an input measures. The page names three ranges and eight switches and not which switch
/// chooses what: here each input has two, the first for current, the second for a zero at 4 mA.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Range {
    Voltage,
    Current,
    CurrentFrom4,
}

const INPUTS: usize = 4;
/// "Wert 32767 = 10,24 V".
const STEPS_PER_VOLT: f64 = 3200.0;
/// "Wert 32767 = 20,48 mA".
const STEPS_PER_MILLIAMP: f64 = 1600.0;
/// "Wert 0 = 4 mA, Wert 32767 = 20,38 mA": 2000 steps to 1 mA end at 20.384.
const STEPS_PER_MILLIAMP_FROM_4: f64 = 2000.0;

impl MrCi4 {
    pub fn new(_now: Time) -> MrCi4 {
        MrCi4 { signals: [Signal::Open; INPUTS], switches: 0 }
    }

    fn range(&self, input: usize) -> Range {
        match self.switches >> (2 * input) & 3 {
            0 | 2 => Range::Voltage,
            1 => Range::Current,
            _ => Range::CurrentFrom4,
        }
    }

    /// Volts or milliamperes, whichever the input is set to measure.
    fn measured(&self, input: usize) -> f64 {
        match (self.range(input), self.signals[input]) {
            (Range::Voltage, Signal::Volts(volts)) => volts,
            (Range::Current | Range::CurrentFrom4, Signal::Milliamps(milliamps)) => milliamps,
            _ => 0.0,
        }
    }

    /// Registers 0 to 3. The ranges begin at 0: what lies below is told as 0.
    fn value(&self, input: usize) -> u16 {
        let measured = self.measured(input);
        let steps = match self.range(input) {
            Range::Voltage => measured * STEPS_PER_VOLT,
            Range::Current => measured * STEPS_PER_MILLIAMP,
            Range::CurrentFrom4 => (measured - 4.0) * STEPS_PER_MILLIAMP_FROM_4,
        };
        steps.round().clamp(0.0, f64::from(i16::MAX)) as u16
    }

    /// Register 4: the switches, and above them "Spannung ≥ 2 V oder Strom ≥ 4 mA".
    fn status(&self) -> u16 {
        let is_live = |input: usize| {
            self.measured(input) >= if self.range(input) == Range::Voltage { 2.0 } else { 4.0 }
        };
        let live: u16 = (0..INPUTS).map(|input| u16::from(is_live(input)) << input).sum();
        live << 8 | u16::from(self.switches)
    }
}

impl Module for MrCi4 {
    const PRODUCT: &'static str = "MR-CI4";
    const VERSION: &'static str = "V1.4";
    /// 6 and 16 only for register 65, which page 3 gives to all devices.
    const FUNCTIONS: &'static [u8] = &[4, 6, 16];

    fn serve(&mut self, _now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::Read { function, first, count } => {
                check_span(first, count.into(), 125, (0, 4))?;
                let mut words: Vec<u16> = (0..INPUTS).map(|input| self.value(input)).collect();
                words.push(self.status());
                Ok(words_reply(function, &words[usize::from(first)..usize::from(first + count)]))
            }
            Request::WriteRegister { .. } | Request::WriteRegisters { .. } => Err(Exception::Address),
            _ => Err(Exception::Function),
        }
    }

    fn stimulate(&mut self, _now: Time, stimulus: &Stimulus) -> Result<(), String> {
        match *stimulus {
            Stimulus::Input { input: input @ 1..=4, signal } => {
                if !matches!(signal, Signal::Open | Signal::Volts(_) | Signal::Milliamps(_)) {
                    return Err("an input of MR-CI4 takes volts, milliamps or open".into());
                }
                self.signals[usize::from(input) - 1] = signal;
                Ok(())
            }
            Stimulus::Input { input, .. } => Err(format!("input {input} is not there; MR-CI4 has 1 to 4")),
            Stimulus::Dip { switch: switch @ 1..=8, on } => {
                let bit = switch - 1;
                self.switches = self.switches & !(1 << bit) | u8::from(on) << bit;
                Ok(())
            }
            Stimulus::Dip { switch, .. } => Err(format!("switch {switch} is not there; MR-CI4 has 1 to 8")),
            _ => Err("MR-CI4 has inputs and DIP switches and nothing else to touch".into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::simulator::device::Model;
    use crate::simulator::testing::Bench;

    /// Sets input 3 to a range by its two switches, and reads its value and its bit of the status.
    #[track_caller]
    fn check_value(switches: [&str; 2], signal: &str, value: u16, is_live: bool) {
        let mut bench = Bench::new(Model::MrCi4);
        bench.act(&format!("dip 5 {}", switches[0])).expect("a switch");
        bench.act(&format!("dip 6 {}", switches[1])).expect("a switch");
        bench.act(&format!("input 3 {signal}")).expect("a signal");
        let dip = u16::from(switches[0] == "on") << 4 | u16::from(switches[1] == "on") << 5;
        let status = u16::from(is_live) << 10 | dip;
        bench.check(&[("04 0002 0003", &format!("04 06 {value:04X} 0000 {status:04X}"))]);
    }

    #[test]
    fn values_count_from_0_to_32767_over_three_ranges_and_status_tells_2_volts_and_4_milliamps_page_59() {
        for (signal, value, is_live) in [
            ("volts 0", 0, false),
            ("volts 1.999", 6397, false),
            ("volts 2", 6400, true),
            ("volts 10", 32_000, true),
            ("volts 10.24", 32_767, true),
            ("volts 12", 32_767, true),
            ("volts -1", 0, false),
            ("open", 0, false),
            ("milliamps 10", 0, false),
        ] {
            check_value(["off", "off"], signal, value, is_live);
        }
        for (signal, value, is_live) in [
            ("milliamps 3.99", 6384, false),
            ("milliamps 4", 6400, true),
            ("milliamps 20", 32_000, true),
            ("milliamps 20.48", 32_767, true),
            ("volts 10", 0, false),
        ] {
            check_value(["on", "off"], signal, value, is_live);
        }
        for (signal, value, is_live) in [
            ("milliamps 3", 0, false),
            ("milliamps 4", 0, true),
            ("milliamps 12", 16_000, true),
            ("milliamps 20", 32_000, true),
            ("milliamps 20.384", 32_767, true),
            ("open", 0, false),
        ] {
            check_value(["on", "on"], signal, value, is_live);
        }
    }

    #[test]
    fn registers_are_0_to_4_in_any_span_and_only_read_page_59() {
        let mut bench = Bench::new(Model::MrCi4);
        bench.act("input 1 volts 5").expect("a signal");
        bench.act("dip 8 on").expect("a switch");
        bench.check(&[
            ("04 0000 0005", "04 0A 3E80 0000 0000 0000 0180"),
            ("04 0004 0001", "04 02 0180"),
            ("04 0004 0002", "84 02"),
            ("04 0005 0001", "84 02"),
            ("04 0000 0006", "84 02"),
            ("04 0000 0000", "84 03"),
            ("04 0000 007E", "84 03"),
            ("03 0000 0001", "83 01"),
            ("02 0000 0001", "82 01"),
            ("06 0000 0000", "86 02"),
            ("06 0041 5315", "06 0041 5315"),
            ("10 0000 0001 02 0000", "90 02"),
            ("08 0001 0000", "08 0001 0000"),
            ("04 0000 0001", "04 02 3E80"),
        ]);
        for command in ["dip 0 on", "dip 9 off", "input 5 open", "input 1 ohms 100", "button"] {
            assert!(bench.act(command).is_err(), "{command}");
        }
    }
}
