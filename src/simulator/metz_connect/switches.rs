//! Four switched outputs as coils 0 to 7: their states, and who has switched them (pages 6, 7, 10, 11).

use crate::simulator::device::{Hand, Stimulus};
use crate::simulator::pdu::{Exception, Request, bits_reply, check_span, write_reply};

/// What the bus wants of the outputs, and what the hand switches say.
pub struct Switches {
    /// What the bus last asked for, bit 0 is output 1.
    pub commanded: u8,
    hands: [Hand; OUTPUTS],
}

/// How many outputs there are.
pub const OUTPUTS: usize = 4;

impl Switches {
    pub fn new() -> Switches {
        Switches { commanded: 0, hands: [Hand::Automatic; OUTPUTS] }
    }

    /// Bits 0 to 3 the outputs, bits 4 to 7 "manuell geschalten". `automatic` are the outputs as they
    /// are without hands.
    pub fn status(&self, automatic: u8) -> u8 {
        let mut status = 0;
        for (output, hand) in self.hands.iter().enumerate() {
            let (on, by_hand) = match hand {
                Hand::Automatic => (automatic >> output & 1 == 1, false),
                Hand::On => (true, true),
                Hand::Off => (false, true),
            };
            status |= u8::from(on) << output | u8::from(by_hand) << (output + OUTPUTS);
        }
        status
    }

    /// Answers functions 5 and 15, which reach only the outputs themselves.
    pub fn write_coils(&mut self, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::WriteCoil { address, value } => {
                if value != 0 && value != 0xFF00 {
                    return Err(Exception::Value);
                }
                check_span(address, 1, 1, (0, 3))?;
                self.command(address.into(), value != 0);
                Ok(write_reply(5, address, value))
            }
            Request::WriteCoils { first, ref values } => {
                check_span(first, values.len(), OUTPUTS, (0, 3))?;
                for (number, on) in values.iter().enumerate() {
                    self.command(usize::from(first) + number, *on);
                }
                Ok(write_reply(15, first, values.len() as u16))
            }
            _ => Err(Exception::Function),
        }
    }

    /// Turns a hand switch; `product` and `outputs` name the device in the error.
    pub fn stimulate(&mut self, stimulus: &Stimulus, product: &str, outputs: &str) -> Result<(), String> {
        match stimulus {
            Stimulus::Hand { relay: output @ 1..=4, position } => {
                self.hands[usize::from(*output) - 1] = *position;
                Ok(())
            }
            Stimulus::Hand { relay, .. } => Err(format!("relay {relay} is not there; {product} has 1 to 4")),
            _ => Err(format!("{product} has {outputs} with hand switches and nothing else to touch")),
        }
    }

    fn command(&mut self, output: usize, on: bool) {
        self.commanded = self.commanded & !(1 << output) | u8::from(on) << output;
    }
}

/// Answers function 1 from the eight bits of [`Switches::status`].
pub fn read_coils(status: u8, first: u16, count: u16) -> Result<Vec<u8>, Exception> {
    check_span(first, count.into(), 8, (0, 7))?;
    let bits: Vec<bool> = (first..first + count).map(|bit| status >> bit & 1 == 1).collect();
    Ok(bits_reply(1, &bits))
}

/// Four bits as what a person sees: `relay_1` `ON`.
pub fn named(name: &str, bits: u8) -> impl Iterator<Item = (String, String)> {
    (0..OUTPUTS).map(move |bit| {
        let state = if bits >> bit & 1 == 1 { "ON" } else { "OFF" };
        (format!("{name}_{}", bit + 1), state.to_string())
    })
}
