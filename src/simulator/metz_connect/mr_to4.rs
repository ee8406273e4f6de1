//! MR-TO4: four triacs with hand switches, each switched by the bus or by a pulse generator
//! (Softwarebeschreibung Modbus RTU V2.1, pages 10 to 13).

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Stimulus, take_words};
use crate::simulator::metz_connect::Module;
use crate::simulator::metz_connect::holding::HoldingRegisters;
use crate::simulator::metz_connect::switches::{OUTPUTS, Switches, named, read_coils};
use crate::simulator::metz_connect::watchdog::{WATCHDOG, Watchdog};
use crate::simulator::pdu::{Exception, Request, check_span};

/// The four triacs.
pub struct MrTo4 {
    switches: Switches,
    eeprom: Eeprom,
    watchdog: Watchdog,
    /// Registers 14 to 17, in thousandths of the period.
    durations: [u16; OUTPUTS],
    /// When the first period of each triac's pulses began.
    pulsing_since: [Time; OUTPUTS],
    /// The triacs as they stood when time last passed, if no hand has switched them.
    automatic: u8,
}

/// What is marked "Speicherung im EEPROM", besides register 66.
#[derive(Clone, Copy, Debug)]
struct Eeprom {
    /// Register 1.
    states: u8,
    /// Registers 2 to 5: 0 is "Direkte Steuerung über den Modbus", 1 "Impulsgenerator".
    modes: [u16; OUTPUTS],
    /// Registers 6 to 9.
    durations: [u16; OUTPUTS],
    /// Registers 10 to 13, in units of 10 ms.
    periods: [u16; OUTPUTS],
}

const PERIOD_UNIT: Duration = Duration::from_millis(10);
const PULSES: u16 = 1;
const DURATION_MAX: u16 = 1000;

impl MrTo4 {
    pub fn new(now: Time) -> MrTo4 {
        let eeprom =
            Eeprom { states: 0, modes: [0; OUTPUTS], durations: [0; OUTPUTS], periods: [0; OUTPUTS] };
        MrTo4 {
            switches: Switches::new(),
            eeprom,
            watchdog: Watchdog::new(now),
            durations: [0; OUTPUTS],
            pulsing_since: [now; OUTPUTS],
            automatic: 0,
        }
    }

    /// Coils 0 to 7 and register 0: bits 0 to 3 "Status Triac", bits 4 to 7 "manuell geschalten". In
    /// the pulse mode a triac's status follows its pulses, and what the bus wrote waits.
    fn status(&self) -> u8 {
        self.switches.status(self.automatic)
    }

    /// Takes what is loaded at the start and when the watchdog expires (pages 12 and 13).
    fn load_defaults(&mut self) {
        self.switches.commanded = self.eeprom.states;
        self.durations = self.eeprom.durations;
    }

    fn drive(&mut self, now: Time) {
        let is_on = |output: usize| {
            if self.eeprom.modes[output] == PULSES {
                self.is_pulse(now, output)
            } else {
                self.switches.commanded >> output & 1 == 1
            }
        };
        self.automatic = (0..OUTPUTS).map(|output| u8::from(is_on(output)) << output).sum();
    }

    /// Whether the pulse that each period begins with still lasts. A period of 0 has no pulses; the
    /// manual allows it and says no more.
    fn is_pulse(&self, now: Time, output: usize) -> bool {
        let period = (PERIOD_UNIT * self.eeprom.periods[output].into()).as_micros();
        let passed = now.since(self.pulsing_since[output]).as_micros();
        let duration = u128::from(self.durations[output]);
        passed.checked_rem(period).is_some_and(|passed| passed * u128::from(DURATION_MAX) < period * duration)
    }
}

impl HoldingRegisters for MrTo4 {
    fn check(first: u16, count: usize) -> Result<(), Exception> {
        let allowed = if first == WATCHDOG { (first, first) } else { (0, 17) };
        check_span(first, count, 125, allowed)
    }

    fn read(&self, register: u16) -> u16 {
        let at = |first: u16| usize::from(register - first);
        match register {
            0 => self.status().into(),
            1 => self.eeprom.states.into(),
            2..=5 => self.eeprom.modes[at(2)],
            6..=9 => self.eeprom.durations[at(6)],
            10..=13 => self.eeprom.periods[at(10)],
            14..=17 => self.durations[at(14)],
            _ => self.watchdog.time,
        }
    }

    /// The manual gives the ranges and not what happens outside them: such a word is refused.
    fn write(&mut self, now: Time, first: u16, words: &[u16]) -> Result<(), Exception> {
        let is_allowed = |(register, word): (u16, &u16)| match register {
            2..=5 => *word <= PULSES,
            6..=9 | 14..=17 => *word <= DURATION_MAX,
            _ => true,
        };
        if !(first..).zip(words).all(is_allowed) {
            return Err(Exception::Value);
        }
        for (register, word) in (first..).zip(words) {
            let at = |first: u16| usize::from(register - first);
            match register {
                // "Bits 4-7 enthalten Coils 4-7 (nur Read)".
                0 => self.switches.commanded = *word as u8 & 0x0F,
                1 => self.eeprom.states = *word as u8 & 0x0F,
                2..=5 => {
                    if self.eeprom.modes[at(2)] != *word {
                        self.pulsing_since[at(2)] = now;
                    }
                    self.eeprom.modes[at(2)] = *word;
                }
                6..=9 => self.eeprom.durations[at(6)] = *word,
                10..=13 => {
                    if self.eeprom.periods[at(10)] != *word {
                        self.pulsing_since[at(10)] = now;
                    }
                    self.eeprom.periods[at(10)] = *word;
                }
                14..=17 => self.durations[at(14)] = *word,
                _ => self.watchdog.time = *word,
            }
        }
        self.drive(now);
        Ok(())
    }
}

impl Module for MrTo4 {
    const PRODUCT: &'static str = "MR-TO4";
    const VERSION: &'static str = "V1.5";
    const FUNCTIONS: &'static [u8] = &[1, 3, 5, 6, 15, 16];

    fn serve(&mut self, now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::Read { function: 1, first, count } => read_coils(self.status(), first, count),
            Request::WriteCoil { .. } | Request::WriteCoils { .. } => {
                let reply = self.switches.write_coils(request)?;
                self.drive(now);
                Ok(reply)
            }
            _ => self.serve_holding(now, request),
        }
    }

    fn message_for_this_device(&mut self, now: Time) {
        self.watchdog.feed(now);
    }

    fn advance(&mut self, now: Time) {
        if self.watchdog.expires(now) {
            self.load_defaults();
        }
        self.drive(now);
    }

    fn restart(&mut self, now: Time) {
        self.load_defaults();
        self.watchdog.feed(now);
        self.pulsing_since = [now; OUTPUTS];
        self.drive(now);
    }

    fn stimulate(&mut self, _now: Time, stimulus: &Stimulus) -> Result<(), String> {
        self.switches.stimulate(stimulus, "MR-TO4", "triacs")
    }

    fn outputs(&self) -> Vec<(String, String)> {
        let status = self.status();
        named("triac", status).chain(named("hand", status >> 4)).collect()
    }

    fn eeprom(&self) -> Vec<u16> {
        let Eeprom { states, modes, durations, periods } = self.eeprom;
        let mut words = vec![states.into(), self.watchdog.time];
        words.extend([modes, durations, periods].concat());
        words
    }

    fn load_eeprom(&mut self, mut words: &[u16]) {
        let words = &mut words;
        let [states, watchdog] = take_words(words);
        self.watchdog.time = watchdog;
        self.eeprom = Eeprom {
            states: states as u8 & 0x0F,
            modes: take_words(words),
            durations: take_words(words),
            periods: take_words(words),
        };
    }
}

#[cfg(test)]
mod tests {
    use crate::simulator::device::Model;
    use crate::simulator::testing::Bench;

    fn check(rows: &[(&str, &str)]) {
        Bench::new(Model::MrTo4).check(rows);
    }

    #[test]
    fn coils_are_those_of_pages_10_and_11() {
        check(&[
            ("0F 0000 0004 01 05", "0F 0000 0004"),
            ("01 0000 0008", "01 01 05"),
            ("05 0003 FF00", "05 0003 FF00"),
            ("01 0002 0002", "01 01 03"),
            ("03 0000 0001", "03 02 000D"),
            ("05 0004 FF00", "85 02"),
            ("05 0000 0001", "85 03"),
            ("0F 0003 0002 01 03", "8F 02"),
            ("0F 0000 0005 01 1F", "8F 03"),
            ("01 0000 0009", "81 03"),
            ("01 0007 0002", "81 02"),
            ("02 0000 0001", "82 01"),
            ("04 0000 0001", "84 01"),
        ]);
    }

    #[test]
    fn registers_are_0_to_17_and_66_with_the_factory_s_zeros_pages_12_and_13() {
        check(&[
            ("03 0000 0012", &format!("03 24 {}", "0000".repeat(18))),
            ("03 0011 0001", "03 02 0000"),
            ("03 0042 0001", "03 02 0000"),
            ("03 0012 0001", "83 02"),
            ("03 0000 0013", "83 02"),
            ("03 0041 0001", "83 02"),
            ("03 0041 0002", "83 02"),
            ("03 0042 0002", "83 02"),
            ("03 0000 007E", "83 03"),
            ("06 0012 0000", "86 02"),
            ("06 0042 1234", "06 0042 1234"),
            ("03 0042 0001", "03 02 1234"),
            ("06 0000 FFF3", "06 0000 FFF3"),
            ("06 0001 FFFC", "06 0001 FFFC"),
            ("03 0000 0002", "03 04 0003 000C"),
            ("10 000A 0004 08 0001 0002 0003 FFFF", "10 000A 0004"),
            ("03 000A 0004", "03 08 0001 0002 0003 FFFF"),
        ]);
    }

    #[test]
    fn modes_and_durations_outside_their_range_are_refused_and_nothing_of_their_request_written_page_12() {
        check(&[
            ("06 0002 0001", "06 0002 0001"),
            ("06 0003 0002", "86 03"),
            ("06 0006 03E8", "06 0006 03E8"),
            ("06 0009 03E9", "86 03"),
            ("06 000E 03E8", "06 000E 03E8"),
            ("06 0011 FFFF", "86 03"),
            ("10 0004 0003 06 0001 0001 03E9", "90 03"),
            (
                "03 0002 0010",
                &format!(
                    "03 20 0001 {} 03E8 {} 03E8 {}",
                    "0000".repeat(3),
                    "0000".repeat(7),
                    "0000".repeat(3)
                ),
            ),
        ]);
    }

    #[test]
    fn the_pulse_generator_switches_each_period_on_for_its_duration_page_12() {
        let mut bench = Bench::new(Model::MrTo4);
        // Triac 2: 2 s, of which 250 thousandths.
        bench.check(&[("06 000B 00C8", "06 000B 00C8"), ("06 000F 00FA", "06 000F 00FA")]);
        assert_eq!(bench.output("triac_2"), "OFF");
        bench.check(&[("06 0003 0001", "06 0003 0001")]);
        for (wait, state) in
            [(0, 1), (499, 1), (1, 0), (1499, 0), (1, 1), (499, 1), (1, 0), (1_000_000, 0), (1500, 1)]
        {
            bench.wait(wait);
            bench.check(&[("01 0001 0001", &format!("01 01 0{state}"))]);
        }
        // What the bus writes waits until it rules again; another duration counts at once.
        bench.check(&[("05 0001 0000", "05 0001 0000"), ("03 0000 0001", "03 02 0002")]);
        bench.wait(600);
        bench.check(&[
            ("03 0000 0001", "03 02 0000"),
            ("06 000F 0190", "06 000F 0190"),
            ("03 0000 0001", "03 02 0002"),
            ("06 0003 0000", "06 0003 0000"),
            ("03 0000 0001", "03 02 0000"),
        ]);
    }

    #[test]
    fn a_period_begins_with_the_mode_with_another_period_and_with_a_restart_page_12() {
        let mut bench = Bench::new(Model::MrTo4);
        // 1 s, of which a tenth, from the start as well.
        bench.check(&[
            ("06 000A 0064", "06 000A 0064"),
            ("06 0006 0064", "06 0006 0064"),
            ("06 000E 0064", "06 000E 0064"),
        ]);
        for begin in ["06 0002 0001", "06 000A 00C8", "06 000A 0064", "08 0001 0000"] {
            bench.wait(650);
            bench.check(&[("01 0000 0001", "01 01 00"), (begin, begin), ("01 0000 0001", "01 01 01")]);
            bench.wait(99);
            // The same word again changes nothing.
            bench.check(&[("06 0002 0001", "06 0002 0001"), ("01 0000 0001", "01 01 01")]);
            bench.wait(101);
            bench.check(&[("01 0000 0001", "01 01 00")]);
        }
    }

    #[test]
    fn a_duration_of_0_or_1000_is_never_and_always_and_a_period_of_0_never_page_12() {
        let mut bench = Bench::new(Model::MrTo4);
        bench.check(&[
            ("10 000A 0004 08 0001 0001 0000 FFFF", "10 000A 0004"),
            ("10 000E 0004 08 0000 03E8 03E8 0001", "10 000E 0004"),
            ("10 0002 0004 08 0001 0001 0001 0001", "10 0002 0004"),
            ("01 0000 0004", "01 01 0A"),
        ]);
        for millis in [5, 4, 1, 13] {
            bench.wait(millis);
            bench.check(&[("01 0000 0003", "01 01 02")]);
        }
        // One thousandth of 655.35 s.
        bench.wait(632);
        bench.check(&[("01 0003 0001", "01 01 01")]);
        bench.wait(1);
        bench.check(&[("01 0003 0001", "01 01 00")]);
    }

    #[test]
    fn a_triac_switched_by_hand_says_so_and_obeys_neither_the_bus_nor_pulses_page_10() {
        let mut bench = Bench::new(Model::MrTo4);
        bench.act("triac 1 hand off").expect("a hand switch");
        bench.act("triac 4 hand on").expect("a hand switch");
        bench.check(&[
            ("10 000D 0002 04 0064 03E8", "10 000D 0002"),
            ("10 0002 0001 02 0001", "10 0002 0001"),
            ("05 0000 FF00", "05 0000 FF00"),
            ("01 0000 0008", "01 01 98"),
            ("03 0000 0001", "03 02 0098"),
        ]);
        assert_eq!((bench.output("triac_4"), bench.output("hand_4")), ("ON".into(), "ON".into()));
        bench.act("triac 4 hand automatic").expect("a hand switch");
        bench.check(&[("01 0000 0008", "01 01 10")]);
        assert!(bench.act("triac 5 hand on").is_err());
        assert!(bench.act("input 1 contact closed").is_err());
    }

    #[test]
    fn a_watchdog_that_no_message_feeds_loads_the_states_and_the_durations_page_13() {
        let mut bench = Bench::new(Model::MrTo4);
        bench.check(&[
            ("10 0000 0002 04 0003 0008", "10 0000 0002"),
            ("10 0006 0004 08 0001 0002 0003 0004", "10 0006 0004"),
            ("10 000E 0004 08 000A 000B 000C 000D", "10 000E 0004"),
            ("06 0042 0032", "06 0042 0032"),
        ]);
        bench.wait(499);
        bench.check(&[("03 000E 0004", "03 08 000A 000B 000C 000D")]);
        bench.wait(500);
        bench.check(&[
            ("03 0000 0001", "03 02 0008"),
            ("03 000E 0004", "03 08 0001 0002 0003 0004"),
            ("06 000E 0005", "06 000E 0005"),
            ("03 000E 0001", "03 02 0005"),
        ]);
    }

    #[test]
    fn settings_outlive_a_restart_which_loads_the_states_and_the_durations_pages_12_and_13() {
        let mut bench = Bench::new(Model::MrTo4);
        bench.check(&[
            (
                "10 0000 0012 24 0003 0004 0001 0000 0000 0000 03E8 0002 0003 0004 0064 0005 0006 0007 0000 0009 000A 000B",
                "10 0000 0012",
            ),
            ("06 0042 0007", "06 0042 0007"),
        ]);
        let kept = bench.device.eeprom();
        let after =
            "03 24 0005 0004 0001 0000 0000 0000 03E8 0002 0003 0004 0064 0005 0006 0007 03E8 0002 0003 0004";
        bench.check(&[
            ("08 0001 0000", "08 0001 0000"),
            ("03 0000 0012", after),
            ("03 0042 0001", "03 02 0007"),
        ]);
        let mut other = Bench::new(Model::MrTo4);
        other.device.load_eeprom(other.now, &kept).expect("an EEPROM of the same device");
        other.check(&[("03 0000 0012", after), ("03 0042 0001", "03 02 0007")]);
    }
}
