//! MR-DO4: four relays with hand switches (Softwarebeschreibung Modbus RTU V2.1, pages 6 to 9).

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{Hand, Stimulus};
use crate::simulator::metz_connect::Module;
use crate::simulator::pdu::{Exception, Request, bits_reply, check_span, words_reply, write_reply};

/// The four relays.
pub struct MrDo4 {
    /// Register 1: each relay's state after a reset and when the communication fails. EEPROM.
    defaults: u8,
    /// Register 66: the watchdog in units of 10 ms, 0 is off. EEPROM.
    watchdog: u16,
    /// What the bus last asked of the relays, bit 0 is relay 1.
    commanded: u8,
    hands: [Hand; RELAYS],
    last_message: Time,
    watchdog_expired: bool,
}

const RELAYS: usize = 4;
const WATCHDOG_UNIT: Duration = Duration::from_millis(10);
const WATCHDOG_REGISTER: u16 = 66;

impl MrDo4 {
    pub fn new(now: Time) -> MrDo4 {
        MrDo4 {
            defaults: 0,
            watchdog: 0,
            commanded: 0,
            hands: [Hand::Automatic; RELAYS],
            last_message: now,
            watchdog_expired: false,
        }
    }

    /// Coils 0 to 7 and register 0: bits 0 to 3 the relays, bits 4 to 7 "manuell geschalten".
    fn status(&self) -> u8 {
        let mut status = 0;
        for (relay, hand) in self.hands.iter().enumerate() {
            let (on, by_hand) = match hand {
                Hand::Automatic => (self.commanded >> relay & 1 == 1, false),
                Hand::On => (true, true),
                Hand::Off => (false, true),
            };
            status |= u8::from(on) << relay | u8::from(by_hand) << (relay + RELAYS);
        }
        status
    }

    fn command(&mut self, relay: usize, on: bool) {
        self.commanded = self.commanded & !(1 << relay) | u8::from(on) << relay;
    }

    /// One of the registers 0, 1 and 66. Of 0 and 1 only bits 0 to 3 count (page 9).
    fn write(&mut self, register: u16, word: u16) {
        match register {
            0 => self.commanded = word as u8 & 0x0F,
            1 => self.defaults = word as u8 & 0x0F,
            _ => self.watchdog = word,
        }
    }

    fn read(&self, register: u16) -> u16 {
        match register {
            0 => u16::from(self.status()),
            1 => u16::from(self.defaults),
            _ => self.watchdog,
        }
    }
}

/// "Gültige Register Startadresse 0..1 oder 66, gültige Anzahl 2 oder 1" (pages 7 and 9).
fn check_registers(first: u16, count: usize) -> Result<(), Exception> {
    let allowed = if first == WATCHDOG_REGISTER { (first, first) } else { (0, 1) };
    check_span(first, count, 2, allowed)
}

impl Module for MrDo4 {
    const PRODUCT: &'static str = "MR-DO4";
    const VERSION: &'static str = "V1.4";
    const FUNCTIONS: &'static [u8] = &[1, 3, 5, 6, 15, 16];

    fn serve(&mut self, _now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::Read { function: 1, first, count } => {
                check_span(first, count.into(), 8, (0, 7))?;
                let status = self.status();
                let bits: Vec<bool> = (first..first + count).map(|bit| status >> bit & 1 == 1).collect();
                Ok(bits_reply(1, &bits))
            }
            Request::Read { function, first, count } => {
                check_registers(first, count.into())?;
                let words: Vec<u16> = (first..first + count).map(|register| self.read(register)).collect();
                Ok(words_reply(function, &words))
            }
            Request::WriteCoil { address, value } => {
                if value != 0 && value != 0xFF00 {
                    return Err(Exception::Value);
                }
                check_span(address, 1, 1, (0, 3))?;
                self.command(address.into(), value != 0);
                Ok(write_reply(5, address, value))
            }
            Request::WriteCoils { first, ref values } => {
                check_span(first, values.len(), 4, (0, 3))?;
                for (number, on) in values.iter().enumerate() {
                    self.command(usize::from(first) + number, *on);
                }
                Ok(write_reply(15, first, values.len() as u16))
            }
            Request::WriteRegister { address, word } => {
                check_registers(address, 1)?;
                self.write(address, word);
                Ok(write_reply(6, address, word))
            }
            Request::WriteRegisters { first, ref words } => {
                check_registers(first, words.len())?;
                for (register, word) in (first..).zip(words) {
                    self.write(register, *word);
                }
                Ok(write_reply(16, first, words.len() as u16))
            }
            Request::Diagnostics { .. } | Request::Encapsulated { .. } => Err(Exception::Function),
        }
    }

    fn message_for_this_device(&mut self, now: Time) {
        self.last_message = now;
        self.watchdog_expired = false;
    }

    fn advance(&mut self, now: Time) {
        let timeout = WATCHDOG_UNIT * self.watchdog.into();
        if self.watchdog > 0 && !self.watchdog_expired && now.since(self.last_message) >= timeout {
            self.watchdog_expired = true;
            self.commanded = self.defaults;
        }
    }

    fn restart(&mut self, now: Time) {
        self.commanded = self.defaults;
        self.last_message = now;
        self.watchdog_expired = false;
    }

    fn stimulate(&mut self, _now: Time, stimulus: &Stimulus) -> Result<(), String> {
        match stimulus {
            Stimulus::Hand { relay: relay @ 1..=4, position } => {
                self.hands[usize::from(*relay) - 1] = *position;
                Ok(())
            }
            Stimulus::Hand { relay, .. } => Err(format!("relay {relay} is not there; MR-DO4 has 1 to 4")),
            _ => Err("MR-DO4 has relays with hand switches and nothing else to touch".into()),
        }
    }

    fn outputs(&self) -> Vec<(String, String)> {
        let status = self.status();
        let name = |on: bool| if on { "ON" } else { "OFF" }.to_string();
        let relays =
            (0..RELAYS).map(|relay| (format!("relay_{}", relay + 1), name(status >> relay & 1 == 1)));
        let hands = (0..RELAYS)
            .map(|relay| (format!("hand_{}", relay + 1), name(status >> (relay + RELAYS) & 1 == 1)));
        relays.chain(hands).collect()
    }

    fn eeprom(&self) -> Vec<u16> {
        vec![self.defaults.into(), self.watchdog]
    }

    fn load_eeprom(&mut self, words: &[u16]) {
        if let [defaults, watchdog] = *words {
            self.defaults = defaults as u8 & 0x0F;
            self.watchdog = watchdog;
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
}
