//! MR-DI4 and MR-DI10: contacts (Softwarebeschreibung Modbus RTU V2.1, pages 14 and 15). The two
//! pages differ in nothing but the number of inputs.

use crate::engine::time::Time;
use crate::simulator::device::Stimulus;
use crate::simulator::metz_connect::{Module, contacts};
use crate::simulator::pdu::{Exception, Request, bits_reply, check_span, words_reply};

/// So many contacts, each closed or open; nothing of them is stored.
pub struct MrDi<const INPUTS: usize> {
    closed: [bool; INPUTS],
}

pub type MrDi4 = MrDi<4>;
pub type MrDi10 = MrDi<10>;

impl<const INPUTS: usize> MrDi<INPUTS> {
    pub fn new(_now: Time) -> MrDi<INPUTS> {
        MrDi { closed: [false; INPUTS] }
    }
}

impl<const INPUTS: usize> Module for MrDi<INPUTS> {
    const PRODUCT: &'static str = if INPUTS == 4 { "MR-DI4" } else { "MR-DI10" };
    const VERSION: &'static str = "V1.4";
    /// 6 and 16 only for register 65, which page 3 gives to all devices.
    const FUNCTIONS: &'static [u8] = &[2, 4, 6, 16];

    fn serve(&mut self, _now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::Read { function: 2, first, count } => {
                check_span(first, count.into(), INPUTS, (0, INPUTS as u16 - 1))?;
                Ok(bits_reply(2, &self.closed[usize::from(first)..usize::from(first + count)]))
            }
            Request::Read { function, first, count } => {
                check_span(first, count.into(), 1, (0, 0))?;
                let inputs = self.closed.iter().enumerate();
                let states = inputs.map(|(number, closed)| u16::from(*closed) << number).sum();
                Ok(words_reply(function, &[states]))
            }
            Request::WriteRegister { .. } | Request::WriteRegisters { .. } => Err(Exception::Address),
            _ => Err(Exception::Function),
        }
    }

    fn stimulate(&mut self, _now: Time, stimulus: &Stimulus) -> Result<(), String> {
        let Stimulus::Input { input, signal } = *stimulus else {
            return Err(format!("{} has inputs and nothing else to touch", Self::PRODUCT));
        };
        contacts::connect(&mut self.closed, input, signal, Self::PRODUCT)
    }
}

#[cfg(test)]
mod tests {
    use crate::simulator::device::Model;
    use crate::simulator::testing::Bench;

    /// A bench with the contacts of some inputs closed.
    fn bench(model: Model, closed: &[u8]) -> Bench {
        let mut bench = Bench::new(model);
        for input in closed {
            bench.act(&format!("input {input} contact closed")).expect("a contact");
        }
        bench
    }

    #[test]
    fn contacts_of_mr_di4_are_read_in_any_span_of_1_to_4_and_all_in_one_register_page_14() {
        let mut bench = bench(Model::MrDi4, &[1, 4]);
        bench.check(&[
            ("02 0000 0004", "02 01 09"),
            ("02 0003 0001", "02 01 01"),
            ("02 0001 0003", "02 01 04"),
            ("02 0003 0002", "82 02"),
            ("02 0004 0001", "82 02"),
            ("02 0000 0005", "82 03"),
            ("02 0000 0000", "82 03"),
            ("04 0000 0001", "04 02 0009"),
            ("04 0001 0001", "84 02"),
            ("04 0000 0002", "84 03"),
        ]);
        bench.act("input 1 contact open").expect("a contact");
        bench.check(&[("02 0000 0004", "02 01 08"), ("04 0000 0001", "04 02 0008")]);
    }

    #[test]
    fn contacts_of_mr_di10_fill_one_or_two_bytes_page_15() {
        bench(Model::MrDi10, &[2, 9, 10]).check(&[
            ("02 0000 000A", "02 02 0203"),
            ("02 0000 0008", "02 01 02"),
            ("02 0001 0009", "02 02 8101"),
            ("02 0009 0001", "02 01 01"),
            ("02 0009 0002", "82 02"),
            ("02 000A 0001", "82 02"),
            ("02 0000 000B", "82 03"),
            ("04 0000 0001", "04 02 0302"),
            ("04 0001 0001", "84 02"),
            ("04 0000 0002", "84 03"),
        ]);
    }

    #[test]
    fn the_only_register_to_be_written_is_65_pages_3_14_and_15() {
        for model in [Model::MrDi4, Model::MrDi10] {
            Bench::new(model).check(&[
                ("06 0041 5315", "06 0041 5315"),
                ("10 0041 0001 02 5315", "10 0041 0001"),
                ("06 0041 0015", "86 03"),
                ("06 0000 0001", "86 02"),
                ("06 0042 0001", "86 02"),
                ("10 0000 0001 02 0001", "90 02"),
                ("10 0041 0002 04 5315 0000", "90 02"),
                ("01 0000 0001", "81 01"),
                ("03 0000 0001", "83 01"),
                ("05 0000 FF00", "85 01"),
            ]);
        }
    }

    #[test]
    fn an_input_takes_contacts_and_nothing_else() {
        let mut bench = bench(Model::MrDi4, &[3]);
        assert!(bench.act("input 0 contact closed").is_err());
        assert!(bench.act("input 5 contact closed").is_err());
        assert!(bench.act("input 3 volts 5").is_err());
        assert!(bench.act("relay 1 hand on").is_err());
        bench.check(&[("02 0000 0004", "02 01 04")]);
        bench.act("restart").expect("a restart");
        bench.check(&[("02 0000 0004", "02 01 04")]);
        bench.act("input 3 open").expect("a contact");
        bench.check(&[("02 0000 0004", "02 01 00")]);
    }
}
