//! MR-DO4 and MR-DOA4: four relays, with and without hand switches (Softwarebeschreibung Modbus RTU
//! V2.1, pages 6 to 9).

use crate::engine::time::Time;
use crate::simulator::device::Stimulus;
use crate::simulator::metz_connect::Module;
use crate::simulator::metz_connect::holding::HoldingRegisters;
use crate::simulator::metz_connect::switches::{Switches, named, read_coils};
use crate::simulator::metz_connect::watchdog::{WATCHDOG, Watchdog};
use crate::simulator::pdu::{Exception, Request, check_span};

/// The four relays. The chapter tells both devices together; all it says of MR-DOA4 alone is that
/// coils 4 to 7 are 0, which is why it has no hand switches here.
pub struct Relays<const HAND_SWITCHES: bool> {
    switches: Switches,
    /// Register 1: each relay's state after a reset and when the communication fails. EEPROM.
    defaults: u8,
    watchdog: Watchdog,
}

pub type MrDo4 = Relays<true>;
pub type MrDoa4 = Relays<false>;

impl<const HAND_SWITCHES: bool> Relays<HAND_SWITCHES> {
    pub fn new(now: Time) -> Relays<HAND_SWITCHES> {
        Relays { switches: Switches::new(), defaults: 0, watchdog: Watchdog::new(now) }
    }

    /// Coils 0 to 7 and register 0: bits 0 to 3 the relays, bits 4 to 7 "manuell geschalten".
    fn status(&self) -> u8 {
        self.switches.status(self.switches.commanded)
    }
}

impl<const HAND_SWITCHES: bool> HoldingRegisters for Relays<HAND_SWITCHES> {
    /// "Gültige Register Startadresse 0..1 oder 66, gültige Anzahl 2 oder 1" (pages 7 and 9).
    fn check(first: u16, count: usize) -> Result<(), Exception> {
        let allowed = if first == WATCHDOG { (first, first) } else { (0, 1) };
        check_span(first, count, 2, allowed)
    }

    fn read(&self, register: u16) -> u16 {
        match register {
            0 => self.status().into(),
            1 => self.defaults.into(),
            _ => self.watchdog.time,
        }
    }

    /// Of 0 and 1 only bits 0 to 3 count (page 9).
    fn write(&mut self, _now: Time, first: u16, words: &[u16]) -> Result<(), Exception> {
        for (register, word) in (first..).zip(words) {
            match register {
                0 => self.switches.commanded = *word as u8 & 0x0F,
                1 => self.defaults = *word as u8 & 0x0F,
                _ => self.watchdog.time = *word,
            }
        }
        Ok(())
    }
}

impl<const HAND_SWITCHES: bool> Module for Relays<HAND_SWITCHES> {
    /// Of both devices: page 9 gives this text for the whole chapter.
    const PRODUCT: &'static str = "MR-DO4";
    const VERSION: &'static str = "V1.4";
    const FUNCTIONS: &'static [u8] = &[1, 3, 5, 6, 15, 16];

    fn serve(&mut self, now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::Read { function: 1, first, count } => read_coils(self.status(), first, count),
            Request::WriteCoil { .. } | Request::WriteCoils { .. } => self.switches.write_coils(request),
            _ => self.serve_holding(now, request),
        }
    }

    fn message_for_this_device(&mut self, now: Time) {
        self.watchdog.feed(now);
    }

    fn advance(&mut self, now: Time) {
        if self.watchdog.expires(now) {
            self.switches.commanded = self.defaults;
        }
    }

    fn restart(&mut self, now: Time) {
        self.switches.commanded = self.defaults;
        self.watchdog.feed(now);
    }

    fn stimulate(&mut self, _now: Time, stimulus: &Stimulus) -> Result<(), String> {
        if HAND_SWITCHES {
            self.switches.stimulate(stimulus, "MR-DO4", "relays")
        } else {
            Err("MR-DOA4 has relays without hand switches and nothing to touch".into())
        }
    }

    fn outputs(&self) -> Vec<(String, String)> {
        let status = self.status();
        let hands = HAND_SWITCHES.then(|| named("hand", status >> 4));
        named("relay", status).chain(hands.into_iter().flatten()).collect()
    }

    fn eeprom(&self) -> Vec<u16> {
        vec![self.defaults.into(), self.watchdog.time]
    }

    fn load_eeprom(&mut self, words: &[u16]) {
        if let [defaults, watchdog] = *words {
            self.defaults = defaults as u8 & 0x0F;
            self.watchdog.time = watchdog;
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::simulator::device::Model;
    use crate::simulator::testing::Bench;

    fn check(rows: &[(&str, &str)]) {
        Bench::new(Model::MrDo4).check(rows);
    }

    #[test]
    fn coils_0_to_7_are_read_in_any_span_of_1_to_8_page_6() {
        check(&[
            ("0F 0000 0004 01 05", "0F 0000 0004"),
            ("01 0000 0008", "01 01 05"),
            ("01 0002 0001", "01 01 01"),
            ("01 0007 0001", "01 01 00"),
            ("01 0007 0002", "81 02"),
            ("01 0008 0001", "81 02"),
            ("01 0000 0009", "81 03"),
            ("01 0000 0000", "81 03"),
        ]);
    }

    #[test]
    fn only_coils_0_to_3_can_be_written_and_only_on_and_off_page_7() {
        check(&[
            ("05 0003 FF00", "05 0003 FF00"),
            ("01 0000 0008", "01 01 08"),
            ("05 0003 0000", "05 0003 0000"),
            ("01 0000 0008", "01 01 00"),
            ("05 0004 FF00", "85 02"),
            ("05 0000 0001", "85 03"),
            ("0F 0002 0002 01 03", "0F 0002 0002"),
            ("01 0000 0008", "01 01 0C"),
            ("0F 0002 0003 01 07", "8F 02"),
            ("0F 0000 0005 01 1F", "8F 03"),
            ("0F 0000 0004 02 0000", "8F 03"),
        ]);
    }

    #[test]
    fn registers_are_0_1_and_66_and_not_across_pages_7_and_9() {
        check(&[
            ("10 0000 0002 04 0005 000A", "10 0000 0002"),
            ("03 0000 0002", "03 04 0005 000A"),
            ("03 0001 0001", "03 02 000A"),
            ("03 0042 0001", "03 02 0000"),
            ("03 0001 0002", "83 02"),
            ("03 0000 0003", "83 03"),
            ("03 0002 0001", "83 02"),
            ("03 0041 0001", "83 02"),
            ("03 0042 0002", "83 02"),
            ("06 0002 0000", "86 02"),
            ("10 0041 0002 04 5315 0000", "90 02"),
            ("06 0042 FFFF", "06 0042 FFFF"),
            ("03 0042 0001", "03 02 FFFF"),
        ]);
    }

    #[test]
    fn only_bits_0_to_3_of_registers_0_and_1_count_page_9() {
        check(&[
            ("06 0000 FFF3", "06 0000 FFF3"),
            ("06 0001 FFFC", "06 0001 FFFC"),
            ("03 0000 0002", "03 04 0003 000C"),
        ]);
    }

    #[test]
    fn other_functions_are_refused_with_exception_1() {
        check(&[
            ("02 0000 0001", "82 01"),
            ("04 0000 0001", "84 01"),
            ("11", "91 01"),
            ("16 0000 0000 0000", "96 01"),
            ("2B 0D 00", "AB 01"),
        ]);
    }

    #[test]
    fn a_relay_switched_by_hand_says_so_and_does_not_obey_the_bus_page_6() {
        let mut bench = Bench::new(Model::MrDo4);
        bench.act("relay 2 hand on").expect("a hand switch");
        bench.act("relay 3 hand off").expect("a hand switch");
        bench.check(&[
            ("01 0000 0008", "01 01 62"),
            ("0F 0000 0004 01 0C", "0F 0000 0004"),
            ("03 0000 0001", "03 02 006A"),
        ]);
        bench.act("relay 2 hand automatic").expect("a hand switch");
        bench.act("relay 3 hand automatic").expect("a hand switch");
        bench.check(&[("01 0000 0008", "01 01 0C")]);
        assert!(bench.act("relay 5 hand on").is_err());
        assert!(bench.act("input 1 ohms 100").is_err());
    }

    #[test]
    fn a_watchdog_that_no_message_feeds_puts_the_relays_into_their_defaults_page_8() {
        let mut bench = Bench::new(Model::MrDo4);
        // 500 ms, defaults: relay 4 alone.
        bench.check(&[("06 0042 0032", "06 0042 0032"), ("10 0000 0002 04 0003 0008", "10 0000 0002")]);
        bench.wait(499);
        // Any message to the device will do, even one that it refuses; one to others will not.
        bench.check(&[("04 0000 0001", "84 01")]);
        bench.wait(499);
        assert_eq!(bench.output("relay_1"), "ON");
        bench.send(crate::simulator::device::Addressed::Broadcast, "05 0000 FF00");
        bench.wait(1);
        assert_eq!((bench.output("relay_1"), bench.output("relay_4")), ("OFF".into(), "ON".into()));
        bench.check(&[("05 0000 FF00", "05 0000 FF00"), ("01 0000 0004", "01 01 09")]);
        bench.wait(500);
        bench.check(&[("01 0000 0004", "01 01 08")]);
    }

    #[test]
    fn defaults_and_watchdog_outlive_a_restart_and_the_relays_take_the_defaults_page_8() {
        let mut bench = Bench::new(Model::MrDo4);
        bench.check(&[
            ("10 0000 0002 04 0003 0004", "10 0000 0002"),
            ("06 0042 0007", "06 0042 0007"),
            ("08 0001 0000", "08 0001 0000"),
            ("03 0000 0002", "03 04 0004 0004"),
            ("03 0042 0001", "03 02 0007"),
        ]);
        let kept = bench.device.eeprom();
        let mut other = Bench::new(Model::MrDo4);
        other.device.load_eeprom(other.now, &kept).expect("an EEPROM of the same device");
        other.check(&[("03 0000 0002", "03 04 0004 0004")]);
        assert!(other.device.load_eeprom(other.now, &kept[1..]).is_err());
    }

    #[test]
    fn mr_doa4_is_mr_do4_with_coils_4_to_7_always_0_page_6() {
        let mut bench = Bench::new(Model::MrDoa4);
        assert!(bench.act("relay 2 hand on").is_err());
        bench.check(&[
            ("0F 0000 0004 01 0F", "0F 0000 0004"),
            ("01 0000 0008", "01 01 0F"),
            ("01 0004 0004", "01 01 00"),
            ("01 0007 0001", "01 01 00"),
            ("05 0004 FF00", "85 02"),
            ("06 0000 00F5", "06 0000 00F5"),
            ("06 0001 0002", "06 0001 0002"),
            ("03 0000 0002", "03 04 0005 0002"),
            ("06 0042 0064", "06 0042 0064"),
        ]);
        bench.wait(1000);
        bench.check(&[("01 0000 0008", "01 01 02")]);
        bench.act("restart").expect("a restart");
        bench.check(&[("03 0042 0001", "03 02 0064"), ("03 0000 0001", "03 02 0002")]);
    }
}
