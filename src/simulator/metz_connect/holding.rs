//! Functions 3, 6 and 16, which differ between devices only in the registers behind them.

use crate::engine::time::Time;
use crate::simulator::pdu::{Exception, Request, words_reply, write_reply};

/// A device's holding registers, all but 65.
pub trait HoldingRegisters {
    /// Whether `count` registers from `first` on are all there and may be asked for in one request.
    fn check(first: u16, count: usize) -> Result<(), Exception>;

    /// A register that `check` has let pass.
    fn read(&self, register: u16) -> u16;

    /// Writes registers that `check` has let pass: all of them, or none where a word is refused.
    fn write(&mut self, now: Time, first: u16, words: &[u16]) -> Result<(), Exception>;

    /// Answers functions 3, 6 and 16, and refuses all others.
    fn serve_holding(&mut self, now: Time, request: &Request) -> Result<Vec<u8>, Exception> {
        match *request {
            Request::Read { function: function @ 3, first, count } => {
                Self::check(first, count.into())?;
                let words: Vec<u16> = (first..first + count).map(|register| self.read(register)).collect();
                Ok(words_reply(function, &words))
            }
            Request::WriteRegister { address, word } => {
                Self::check(address, 1)?;
                self.write(now, address, &[word])?;
                Ok(write_reply(6, address, word))
            }
            Request::WriteRegisters { first, ref words } => {
                Self::check(first, words.len())?;
                self.write(now, first, words)?;
                Ok(write_reply(16, first, words.len() as u16))
            }
            _ => Err(Exception::Function),
        }
    }
}
