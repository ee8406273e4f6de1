//! What all METZ CONNECT devices have in common: the manual's chapter "Allgemein geltende Kommandos"
//! (Softwarebeschreibung Modbus RTU V2.1, pages 3 to 5), and the identification.
//!
//! [`MetzConnect`] is that common part around a [`Module`], which is one device's own chapter.

pub(super) mod analog_inputs;
pub(super) mod channel;
mod contacts;
pub(super) mod holding;
pub mod mr_ai8;
pub mod mr_aio42;
pub mod mr_ao4;
pub mod mr_ci4;
pub mod mr_di;
pub mod mr_dio42;
pub mod mr_do4;
pub mod mr_ld6;
pub mod mr_multi_io;
pub mod mr_si4;
pub mod mr_sm3;
pub mod mr_to4;
pub mod mr_tp;
mod pulse_input;
mod sensors;
mod switches;
mod watchdog;

use crate::engine::time::Time;
use crate::simulator::device::{
    Addressed, LineSettings, Overheard, Parity, SimulatedDevice, Stimulus, check_eeprom_length,
};
use crate::simulator::pdu::{Exception, Request, exception_reply, identification_reply, write_reply};

/// The chapter of one device: its registers, its process side, its EEPROM.
pub trait Module: Send {
    const VENDOR: &'static str = "METZ CONNECT GmbH";
    const PRODUCT: &'static str;
    const VERSION: &'static str;
    /// Its function codes, besides 8 and 43 which all of them have.
    const FUNCTIONS: &'static [u8];
    /// Those that write register 65.
    const LINE_FUNCTIONS: &'static [u8] = &[6, 16];
    /// Whether register 65 can be read, too. [`Module::serve`] then has any word there.
    const READS_LINE: bool = false;

    /// Answers a request with one of `FUNCTIONS`, for anything but register 65.
    fn serve(&mut self, now: Time, request: &Request) -> Result<Vec<u8>, Exception>;

    /// A valid message with this device's own address has come, whatever it says.
    fn message_for_this_device(&mut self, _now: Time) {}

    fn stimulate(&mut self, now: Time, stimulus: &Stimulus) -> Result<(), String>;

    // What follows is only there for modules in which time changes something, or which switch or store.

    fn advance(&mut self, _now: Time) {}
    fn restart(&mut self, _now: Time) {}
    fn outputs(&self) -> Vec<(String, String)> {
        Vec::new()
    }
    fn eeprom(&self) -> Vec<u16> {
        Vec::new()
    }
    /// Puts back as many words as [`Module::eeprom`] gives.
    fn load_eeprom(&mut self, _words: &[u16]) {}
}

/// A METZ CONNECT device.
pub struct MetzConnect<M> {
    module: M,
    /// Register 65, in the EEPROM.
    line: LineSettings,
    counters: Counters,
    /// After function 8/4: hears, and neither obeys nor answers.
    listen_only: bool,
}

/// Function 8, sub-functions 11 to 15 (page 5). They wrap, since they are told in one register.
#[derive(Clone, Copy, Debug, Default)]
struct Counters {
    bus_messages: u16,
    communication_errors: u16,
    exceptions: u16,
    device_messages: u16,
    unanswered: u16,
}

/// Bit rate and parity (page 3).
const LINE_REGISTER: u16 = 65;
/// Without this high byte register 65 is not written (page 3).
const LINE_MAGIC: u8 = 0x53;
const BAUD_RATES: [u32; 8] = [1200, 2400, 4800, 9600, 19200, 38400, 57600, 115_200];
const PARITIES: [Parity; 3] = [Parity::Even, Parity::Odd, Parity::None];

impl<M: Module> MetzConnect<M> {
    pub fn new(_now: Time, line: LineSettings, module: M) -> MetzConnect<M> {
        MetzConnect { module, line, counters: Counters::default(), listen_only: false }
    }

    /// Answers, with the counters already advanced for the request itself.
    fn answer(&mut self, now: Time, pdu: &[u8]) -> Result<Option<Vec<u8>>, Exception> {
        let function = pdu.first().copied().unwrap_or(0);
        if function != 8 && function != 43 && !M::FUNCTIONS.contains(&function) {
            return Err(Exception::Function);
        }
        let request = Request::parse(pdu)?;
        match &request {
            Request::Diagnostics { sub_function, data } => self.diagnose(now, *sub_function, data),
            // Each chapter's last page: only "Geräte ID Code lesen: 0x01" is told.
            Request::Encapsulated { interface, data } => {
                let objects = [M::VENDOR, M::PRODUCT, M::VERSION].map(str::as_bytes);
                identification_reply(*interface, data, &objects).map(Some)
            }
            Request::WriteRegister { address: LINE_REGISTER, word } => {
                self.set_line(*word)?;
                Ok(Some(write_reply(function, LINE_REGISTER, *word)))
            }
            Request::WriteRegisters { first: LINE_REGISTER, words }
                if words.len() == 1 && M::LINE_FUNCTIONS.contains(&function) =>
            {
                self.set_line(words[0])?;
                Ok(Some(write_reply(function, LINE_REGISTER, 1)))
            }
            _ => {
                let mut reply = self.module.serve(now, &request)?;
                if M::READS_LINE {
                    self.tell_line(&request, &mut reply);
                }
                Ok(Some(reply))
            }
        }
    }

    /// Puts register 65 where it stands in the reply to a read. Its high byte is the magic number of
    /// writes, of which the manual does not say that it can be read: here it is 0.
    fn tell_line(&self, request: &Request, reply: &mut [u8]) {
        let Request::Read { function: 3 | 4, first, .. } = *request else { return };
        let Some(before) = LINE_REGISTER.checked_sub(first) else { return };
        if let Some(word) = reply.get_mut(2 + 2 * usize::from(before)..).and_then(|rest| rest.get_mut(..2)) {
            word.copy_from_slice(&self.line_code().to_be_bytes());
        }
    }

    /// Bit rate and parity as register 65 codes them.
    fn line_code(&self) -> u16 {
        let parity = PARITIES.iter().position(|parity| *parity == self.line.parity).map_or(0, |at| at + 1);
        // A bit rate that register 65 has no code for is the line's own: 0, "not set".
        let baud = BAUD_RATES.iter().position(|baud| *baud == self.line.baud).map_or(0, |at| at + 1);
        (parity << 4 | baud) as u16
    }

    /// Register 65, "Bitrate einstellen über Modbus-Kommando" (page 3). Codes that are in no table
    /// are refused; the manual itself says only that nothing happens without the magic number.
    fn set_line(&mut self, word: u16) -> Result<(), Exception> {
        let [magic, codes] = word.to_be_bytes();
        let (parity, baud) = (usize::from(codes >> 4), usize::from(codes & 0x0F));
        if magic != LINE_MAGIC || parity > PARITIES.len() || baud > BAUD_RATES.len() {
            return Err(Exception::Value);
        }
        // "Wenn Parität oder Bitrate 0 ist, erfolgt keine Einstellung und Speicherung."
        if parity > 0 && baud > 0 {
            self.line = LineSettings { baud: BAUD_RATES[baud - 1], parity: PARITIES[parity - 1] };
        }
        Ok(())
    }

    /// "Test des Kommunikationssystems" (page 5).
    fn diagnose(&mut self, now: Time, sub_function: u16, data: &[u8]) -> Result<Option<Vec<u8>>, Exception> {
        let echo = || {
            let mut reply = vec![8];
            reply.extend(sub_function.to_be_bytes());
            reply.extend(data);
            reply
        };
        let count = match sub_function {
            0 => return Ok(Some(echo())),
            1 => {
                if data != [0, 0] && data != [0xFF, 0] {
                    return Err(Exception::Value);
                }
                let was_listening_only = self.listen_only;
                self.restart(now);
                // The specification (6.8): no answer to what ended the listening.
                return Ok(if was_listening_only { None } else { Some(echo()) });
            }
            4 | 10..=15 if data != [0, 0] => return Err(Exception::Value),
            4 => {
                self.listen_only = true;
                return Ok(None);
            }
            10 => {
                self.counters = Counters::default();
                return Ok(Some(echo()));
            }
            11 => self.counters.bus_messages,
            12 => self.counters.communication_errors,
            13 => self.counters.exceptions,
            14 => self.counters.device_messages,
            15 => self.counters.unanswered,
            // The specification's diagram for function 8: an unknown sub-function is exception 1.
            _ => return Err(Exception::Function),
        };
        Ok(Some(write_reply(8, sub_function, count)))
    }
}

impl<M: Module> SimulatedDevice for MetzConnect<M> {
    fn request(&mut self, now: Time, addressed: Addressed, pdu: &[u8]) -> Option<Vec<u8>> {
        self.counters.bus_messages = self.counters.bus_messages.wrapping_add(1);
        self.counters.device_messages = self.counters.device_messages.wrapping_add(1);
        self.module.advance(now);
        let ends_listening = pdu.starts_with(&[8, 0, 1]);
        let reply = if self.listen_only && !ends_listening {
            None
        } else {
            // Elsewhere the manual says of such a timer: it starts anew with each valid message to
            // the device, only the address matters (pages 13, 26 and 103). A broadcast is not addressed
            // to it.
            if addressed == Addressed::Unit {
                self.module.message_for_this_device(now);
            }
            self.answer(now, pdu).unwrap_or_else(|exception| {
                // "Fehlerrückmeldungen die das Gerät … zurückgemeldet hat": to all is to nobody.
                if addressed == Addressed::Unit {
                    self.counters.exceptions = self.counters.exceptions.wrapping_add(1);
                }
                Some(exception_reply(pdu.first().copied().unwrap_or(0), exception))
            })
        };
        let reply = reply.filter(|_| addressed == Addressed::Unit);
        if reply.is_none() && !ends_listening {
            self.counters.unanswered = self.counters.unanswered.wrapping_add(1);
        }
        reply
    }

    fn overhear(&mut self, heard: Overheard) {
        let counter = match heard {
            Overheard::Foreign => &mut self.counters.bus_messages,
            Overheard::Damaged => &mut self.counters.communication_errors,
        };
        *counter = counter.wrapping_add(1);
    }

    fn advance(&mut self, now: Time) {
        self.module.advance(now);
    }

    fn restart(&mut self, now: Time) {
        self.counters = Counters::default();
        self.listen_only = false;
        self.module.restart(now);
    }

    fn stimulate(&mut self, now: Time, stimulus: &Stimulus) -> Result<(), String> {
        self.module.advance(now);
        self.module.stimulate(now, stimulus)
    }

    fn outputs(&self) -> Vec<(String, String)> {
        self.module.outputs()
    }

    fn eeprom(&self) -> Vec<u16> {
        let mut words = vec![self.line_code()];
        words.extend(self.module.eeprom());
        words
    }

    fn load_eeprom(&mut self, now: Time, words: &[u16]) -> Result<(), String> {
        check_eeprom_length(words, self.eeprom().len())?;
        if self.set_line(words[0] | u16::from(LINE_MAGIC) << 8).is_err() {
            return Err(format!("`{:04X}` is no code for bit rate and parity", words[0]));
        }
        self.module.load_eeprom(&words[1..]);
        self.restart(now);
        Ok(())
    }

    fn line_settings(&self) -> Option<LineSettings> {
        Some(self.line)
    }
}

#[cfg(test)]
mod tests {
    use crate::simulator::device::{Addressed, LineSettings, Model, Overheard, Parity};
    use crate::simulator::testing::Bench;

    #[test]
    fn identification_gives_vendor_product_and_version_in_one_reply() {
        let metz_connect = "METZ CONNECT GmbH";
        for (model, vendor, product, version) in [
            (Model::MrDo4, metz_connect, "MR-DO4", "V1.4"),
            (Model::MrSi4, metz_connect, "MR-SI4", "V2.1"),
            (Model::MrAi8, metz_connect, "MR-AI8", "V1.8"),
            (Model::MrDi4, metz_connect, "MR-DI4", "V1.4"),
            (Model::MrDi10, metz_connect, "MR-DI10", "V1.4"),
            (Model::MrDoa4, metz_connect, "MR-DO4", "V1.4"),
            (Model::MrDio42, metz_connect, "MR-DIO4/2", "V2.0"),
            (Model::MrAo4, metz_connect, "MR-AO4", "V1.4"),
            (Model::MrAop4, metz_connect, "MR-AOP4", "V1.5"),
            (Model::MrTo4, metz_connect, "MR-TO4", "V1.5"),
            (Model::MrTp, metz_connect, "MR-TP", "V1.2"),
            (Model::MrLd6, metz_connect, "MR-LD6", "V1.1"),
            (Model::MrCi4, metz_connect, "MR-CI4", "V1.4"),
            (Model::MrAio42, metz_connect, "MR-AIO4/2", "V1.4"),
            (Model::MrSm3, metz_connect, "MR-SM3", "V1.2"),
            (Model::MrMultiIo, metz_connect, "MR-Multi IO", "V1.2"),
            (Model::BtrMrAi8, "BTR", "MR-AI8", "V1.0"),
        ] {
            let hex = |text: &str| text.bytes().map(|byte| format!("{byte:02X}")).collect::<String>();
            let mut bench = Bench::new(model);
            let object = |text: &str| format!("{:02X}{}", text.len(), hex(text));
            let reply =
                format!("2B0E0101000003 00{} 01{} 02{}", object(vendor), object(product), object(version));
            bench.check(&[
                ("2B 0E 01 00", &reply),
                ("2B 0E 01 07", &reply),
                ("2B 0E 02 00", "AB 03"),
                ("2B 0E 04 00", "AB 03"),
                ("2B 0E 01", "AB 03"),
            ]);
        }
    }

    #[test]
    fn diagnostics_echo_any_data_and_refuse_other_sub_functions_page_5() {
        Bench::new(Model::MrDo4).check(&[
            ("08 0000 1234", "08 0000 1234"),
            ("08 0000 0102030405", "08 0000 0102030405"),
            ("08 0000", "08 0000"),
            ("08 0002 0000", "88 01"),
            ("08 000A 0001", "88 03"),
            ("08 0001 1234", "88 03"),
            ("08 00", "88 03"),
        ]);
    }

    #[test]
    fn diagnostic_counters_count_and_are_cleared_page_5() {
        let mut bench = Bench::new(Model::MrDo4);
        bench.check(&[("08 000A 0000", "08 000A 0000"), ("03 0005 0001", "83 02")]);
        bench.device.overhear(Overheard::Foreign);
        bench.device.overhear(Overheard::Damaged);
        assert_eq!(bench.send(Addressed::Broadcast, "05 0000 FF00"), "silence");
        bench.check(&[
            // The refused read, the foreign message, the broadcast and this one.
            ("08 000B 0000", "08 000B 0004"),
            ("08 000C 0000", "08 000C 0001"),
            ("08 000D 0000", "08 000D 0001"),
            ("08 000E 0000", "08 000E 0006"),
            ("08 000F 0000", "08 000F 0001"),
            ("08 0001 FF00", "08 0001 FF00"),
            ("08 000B 0000", "08 000B 0001"),
            ("08 000D 0000", "08 000D 0000"),
        ]);
    }

    #[test]
    fn an_exception_that_is_not_sent_is_not_counted_page_5() {
        let mut bench = Bench::new(Model::MrDo4);
        assert_eq!(bench.send(Addressed::Broadcast, "05 0009 FF00"), "silence");
        bench.check(&[("08 000D 0000", "08 000D 0000"), ("08 000F 0000", "08 000F 0001")]);
    }

    #[test]
    fn a_device_that_only_listens_neither_obeys_nor_answers_until_it_is_restarted_page_5() {
        Bench::new(Model::MrDo4).check(&[
            ("08 0004 0000", "silence"),
            ("05 0000 FF00", "silence"),
            ("08 0000 1234", "silence"),
            ("08 0001 0000", "silence"),
            ("01 0000 0001", "01 01 00"),
        ]);
    }

    #[test]
    fn register_65_sets_bit_rate_and_parity_only_with_its_magic_number_page_3() {
        let settings = |baud, parity| Some(LineSettings { baud, parity });
        for (request, reply, now) in [
            // The manual's example: even parity, 19200.
            ("06 0041 5315", "06 0041 5315", settings(19200, Parity::Even)),
            ("06 0041 5338", "06 0041 5338", settings(115_200, Parity::None)),
            ("10 0041 0001 02 5321", "10 0041 0001", settings(1200, Parity::Odd)),
            ("06 0041 0038", "86 03", settings(19200, Parity::Even)),
            ("06 0041 5339", "86 03", settings(19200, Parity::Even)),
            ("06 0041 5341", "86 03", settings(19200, Parity::Even)),
            // One of both is 0: nothing is set.
            ("06 0041 5308", "06 0041 5308", settings(19200, Parity::Even)),
            ("06 0041 5330", "06 0041 5330", settings(19200, Parity::Even)),
        ] {
            let mut bench = Bench::new(Model::MrDo4);
            bench.check(&[(request, reply)]);
            assert_eq!(bench.device.line_settings(), now, "{request}");
            let kept = bench.device.eeprom();
            let mut other = Bench::new(Model::MrDo4);
            other.device.load_eeprom(other.now, &kept).expect("an EEPROM of the same device");
            assert_eq!(other.device.line_settings(), now, "{request} kept");
        }
    }
}
