//! Protocol data units: a call to bytes, and the bytes of a reply, checked against the call, to an
//! answer. Page and section numbers are of the Modbus application protocol V1.1b3.

use crate::engine::address::{Span, Table};
use crate::engine::modbus::{Answer, Call, Identification, RequestError};

/// The longest protocol data unit: function code and 252 bytes (4.1).
pub const LENGTH_MAX: usize = 253;

/// Most requests are no longer: function code, address, and a count or a value.
const USUAL_LENGTH: usize = 5;

/// The request's bytes, function code first. `Err` with the reason when the specification has no
/// frame for it.
pub fn encode(call: &Call) -> Result<Vec<u8>, &'static str> {
    let mut pdu = Vec::with_capacity(USUAL_LENGTH);
    pdu.push(call.function());
    match call {
        Call::Read(span) => {
            pdu.extend(span.first().to_be_bytes());
            pdu.extend(read_quantity(*span)?.to_be_bytes());
        }
        Call::WriteCoil { address, on } => {
            pdu.extend(address.to_be_bytes());
            pdu.extend(coil_word(*on).to_be_bytes());
        }
        Call::WriteRegister { address, word } => {
            pdu.extend(address.to_be_bytes());
            pdu.extend(word.to_be_bytes());
        }
        Call::WriteCoils { address, values } => {
            pdu.extend(address.to_be_bytes());
            pdu.extend(write_quantity(Table::Coil, *address, values.len())?.to_be_bytes());
            let bytes = pack_bits(values);
            pdu.push(bytes.len() as u8);
            pdu.extend(bytes);
        }
        Call::WriteRegisters { address, words } => {
            pdu.extend(address.to_be_bytes());
            pdu.extend(write_quantity(Table::Holding, *address, words.len())?.to_be_bytes());
            pdu.push(words.len() as u8 * 2);
            pdu.extend(words.iter().flat_map(|word| word.to_be_bytes()));
        }
        Call::Diagnostics { function, data } => {
            pdu.extend(function.to_be_bytes());
            pdu.extend(data.iter().flat_map(|word| word.to_be_bytes()));
        }
        Call::ReadIdentification { code, object } => pdu.extend([MEI_IDENTIFICATION, *code, *object]),
        Call::ReportServerId => {}
    }
    if pdu.len() > LENGTH_MAX { Err("longer than a Modbus frame") } else { Ok(pdu) }
}

/// What the reply says, if it is a reply to `call` in every part: function, byte count, and the
/// address, value, quantity or sub-function that must come back. With `any_exception` an exception
/// of another function is taken for the answer too.
///
/// `Err` is [`RequestError::Exception`], [`RequestError::Unreachable`] or [`RequestError::WrongFrame`].
pub fn decode(call: &Call, any_exception: bool, pdu: &[u8]) -> Result<Answer, RequestError> {
    let (&function, data) = pdu.split_first().ok_or(RequestError::WrongFrame)?;
    if function & EXCEPTION != 0 {
        return Err(match data {
            [code] if any_exception || function == call.function() | EXCEPTION => match code {
                10 | 11 => RequestError::Unreachable(*code),
                code => RequestError::Exception(*code),
            },
            _ => RequestError::WrongFrame,
        });
    }
    if function != call.function() {
        return Err(RequestError::WrongFrame);
    }
    let answer = match call {
        Call::Read(span) => read_answer(*span, data),
        Call::WriteCoil { address, on } => confirmed(data, *address, coil_word(*on)),
        Call::WriteRegister { address, word } => confirmed(data, *address, *word),
        Call::WriteCoils { address, values } => confirmed(data, *address, values.len() as u16),
        Call::WriteRegisters { address, words } => confirmed(data, *address, words.len() as u16),
        Call::Diagnostics { function, data: asked } => diagnostics(*function, asked, data),
        Call::ReadIdentification { code, .. } => identification(*code, data).map(Answer::Identification),
        Call::ReportServerId => counted(data).map(|bytes| Answer::ServerId(bytes.to_vec())),
    };
    answer.ok_or(RequestError::WrongFrame)
}

/// How long a reply is, as far as its first bytes tell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Length {
    /// This many bytes, function code included.
    Whole(usize),
    /// At least one more byte is needed to know.
    Unknown,
    /// It is no reply to this call.
    Never,
}

/// The length of a reply to `call` that begins with `pdu`, function code first. It looks only at
/// what decides the length: [`decode`] may still refuse the whole.
pub fn reply_length(call: &Call, any_exception: bool, pdu: &[u8]) -> Length {
    let Some(&function) = pdu.first() else { return Length::Unknown };
    let exception = function & EXCEPTION != 0 && (any_exception || function == call.function() | EXCEPTION);
    if exception {
        return Length::Whole(2);
    }
    if function != call.function() {
        return Length::Never;
    }
    match call {
        Call::Read(span) => match pdu.get(1) {
            None => Length::Unknown,
            Some(&count) if usize::from(count) == read_bytes(*span) => Length::Whole(2 + read_bytes(*span)),
            Some(_) => Length::Never,
        },
        Call::Diagnostics { function, data } => within_frame(3 + 2 * diagnostics_words(*function, data)),
        Call::ReadIdentification { .. } => identification_length(pdu),
        Call::ReportServerId => match pdu.get(1) {
            None => Length::Unknown,
            Some(&count) => within_frame(2 + usize::from(count)),
        },
        _ => Length::Whole(5),
    }
}

/// The lengths that a frame of another conversation may have, request or reply, if it begins with
/// `pdu`. For functions that are not known here there is none.
pub fn foreign_lengths(pdu: &[u8]) -> impl Iterator<Item = usize> {
    let at = |index: usize| pdu.get(index).map(|byte| usize::from(*byte));
    let lengths = match pdu.first() {
        Some(function) if function & EXCEPTION != 0 => [Some(2), None],
        Some(1..=4) => [at(1).map(|count| 2 + count), Some(5)],
        Some(5 | 6 | 8) => [Some(5), None],
        Some(15 | 16) => [Some(5), at(5).map(|count| 6 + count)],
        Some(17) => [at(1).map(|count| 2 + count), Some(1)],
        Some(43) => match identification_length(pdu) {
            Length::Whole(length) => [Some(length), Some(4)],
            _ => [Some(4), None],
        },
        _ => [None, None],
    };
    lengths.into_iter().flatten().filter(|length| *length <= LENGTH_MAX)
}

/// Whether `pdu`, as long as one of [`foreign_lengths`], is a master's request. Of functions 5, 6 and 8 the
/// confirmation looks the same, and is taken for the request.
pub fn is_request(pdu: &[u8]) -> bool {
    match pdu {
        // An answer is as long as its second byte says.
        [1..=4, count, ..] => pdu.len() == 5 && *count != 3,
        [5 | 6 | 8, ..] => true,
        [15 | 16, ..] => pdu.len() > 5,
        [17] => true,
        [43, MEI_IDENTIFICATION, ..] => pdu.len() == 4,
        _ => false,
    }
}

const EXCEPTION: u8 = 0x80;

/// The MODBUS Encapsulated Interface type of Read Device Identification (6.21).
const MEI_IDENTIFICATION: u8 = 0x0E;

/// The value of a coil in function 5 (6.5).
const fn coil_word(on: bool) -> u16 {
    if on { 0xFF00 } else { 0x0000 }
}

/// At most 2000 bits and 125 registers in one read (6.1 to 6.4).
fn read_quantity(span: Span) -> Result<u16, &'static str> {
    match (span.table().is_bits(), span.count()) {
        (true, 2001..) => Err("more than 2000 bits in one read"),
        (false, 126..) => Err("more than 125 registers in one read"),
        (_, count) => Ok(count as u16),
    }
}

/// 1 to 1968 coils and 1 to 123 registers in one write (6.11, 6.12).
fn write_quantity(table: Table, address: u16, count: usize) -> Result<u16, &'static str> {
    let (most, too_many) = match table.is_bits() {
        true => (1968, "more than 1968 coils in one write"),
        false => (123, "more than 123 registers in one write"),
    };
    if count > most {
        return Err(too_many);
    }
    let span = Span::with_count(table, address, count as u16);
    span.map(|span| span.count() as u16).ok_or("a write of nothing, or past address 65535")
}

/// The data bytes that answer a read.
fn read_bytes(span: Span) -> usize {
    let count = span.count() as usize;
    if span.table().is_bits() { count.div_ceil(8) } else { count * 2 }
}

fn read_answer(span: Span, data: &[u8]) -> Option<Answer> {
    let bytes = counted(data).filter(|bytes| bytes.len() == read_bytes(span))?;
    Some(if span.table().is_bits() {
        let bit = |index: usize| bytes[index / 8] >> (index % 8) & 1 == 1;
        Answer::Bits((0..span.count() as usize).map(bit).collect())
    } else {
        Answer::Words(words(bytes))
    })
}

/// The bytes behind a byte count that is right.
fn counted(data: &[u8]) -> Option<&[u8]> {
    let (&count, bytes) = data.split_first()?;
    if bytes.len() == usize::from(count) { Some(bytes) } else { None }
}

fn words(bytes: &[u8]) -> Vec<u16> {
    bytes.chunks_exact(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect()
}

fn confirmed(data: &[u8], address: u16, value: u16) -> Option<Answer> {
    let [a, b, c, d] = *data else { return None };
    let same = u16::from_be_bytes([a, b]) == address && u16::from_be_bytes([c, d]) == value;
    if same { Some(Answer::Written) } else { None }
}

/// The sub-function must come back, and as many words as [`diagnostics_words`] says.
fn diagnostics(function: u16, asked: &[u16], data: &[u8]) -> Option<Answer> {
    let (sub_function, rest) = data.split_at_checked(2)?;
    let expected = 2 * diagnostics_words(function, asked);
    if sub_function != function.to_be_bytes() || rest.len() != expected {
        return None;
    }
    let returned = words(rest);
    // Sub-function 0 returns the query: anything else is another's reply, or a bad line.
    if function == 0 && returned != asked { None } else { Some(Answer::Diagnostics(returned)) }
}

/// The words in a reply to function 8: as many as were sent, but a counter even if none was (6.8).
fn diagnostics_words(function: u16, asked: &[u16]) -> usize {
    if function == 0 { asked.len() } else { asked.len().max(1) }
}

/// Type, code, conformity, more follows, next object, number of objects; then number, length and
/// text of each (6.21).
fn identification(code: u8, data: &[u8]) -> Option<Identification> {
    let [MEI_IDENTIFICATION, echoed, conformity, more, next, count, rest @ ..] = data else { return None };
    if *echoed != code {
        return None;
    }
    let mut rest = rest;
    let mut objects = Vec::new();
    for _ in 0..*count {
        let [number, length, tail @ ..] = rest else { return None };
        let (text, tail) = tail.split_at_checked(usize::from(*length))?;
        objects.push((*number, String::from_utf8_lossy(text).into_owned()));
        rest = tail;
    }
    let next = match more {
        0x00 => None,
        0xFF => Some(*next),
        _ => return None,
    };
    if rest.is_empty() { Some(Identification { conformity: *conformity, next, objects }) } else { None }
}

fn identification_length(pdu: &[u8]) -> Length {
    if pdu.get(1).is_some_and(|kind| *kind != MEI_IDENTIFICATION) {
        return Length::Never;
    }
    let Some(count) = pdu.get(6) else { return Length::Unknown };
    let mut at = 7;
    for _ in 0..*count {
        match pdu.get(at + 1) {
            None if at + 2 > LENGTH_MAX => return Length::Never,
            None => return Length::Unknown,
            Some(length) => at += 2 + usize::from(*length),
        }
    }
    within_frame(at)
}

fn within_frame(length: usize) -> Length {
    if length > LENGTH_MAX { Length::Never } else { Length::Whole(length) }
}

fn pack_bits(values: &[bool]) -> Vec<u8> {
    let byte = |bits: &[bool]| bits.iter().rev().fold(0, |byte, on| byte << 1 | u8::from(*on));
    values.chunks(8).map(byte).collect()
}

#[cfg(test)]
#[path = "pdu_tests.rs"]
mod tests;
