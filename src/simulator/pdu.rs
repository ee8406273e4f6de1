//! Requests and replies as a device sees them: bytes in, bytes out.
//!
//! Written from the Modbus application protocol specification, and sharing nothing with the
//! gateway's own encoder: two readings that agree are worth more than one that is used twice.

/// Why a device refuses. These are the three that the manuals of the simulated devices know.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exception {
    /// The function code is none of the device's.
    Function = 1,
    /// The address, or the span from it, is none of the device's.
    Address = 2,
    /// The quantity or the value is not allowed, or the request's length does not fit.
    Value = 3,
}

/// A request PDU taken apart. Lengths and byte counts are already known to fit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Request {
    /// Functions 1 to 4.
    Read { function: u8, first: u16, count: u16 },
    /// Function 5; the value is still as it came, `0xFF00` and `0x0000` are the allowed ones.
    WriteCoil { address: u16, value: u16 },
    /// Function 6.
    WriteRegister { address: u16, word: u16 },
    /// Function 15.
    WriteCoils { first: u16, values: Vec<bool> },
    /// Function 16.
    WriteRegisters { first: u16, words: Vec<u16> },
    /// Function 8.
    Diagnostics { sub_function: u16, data: Vec<u8> },
    /// Function 43; `interface` is 14 for the device identification.
    Encapsulated { interface: u8, data: Vec<u8> },
}

impl Request {
    /// Takes a PDU apart. The caller has already refused functions that its device lacks; one that is
    /// unknown even here is `Exception::Function`, a wrong length `Exception::Value`.
    pub fn parse(pdu: &[u8]) -> Result<Request, Exception> {
        let (&function, data) = pdu.split_first().ok_or(Exception::Function)?;
        let word = |at: usize| match data.get(at..at + 2) {
            Some(bytes) => Ok(u16::from_be_bytes([bytes[0], bytes[1]])),
            None => Err(Exception::Value),
        };
        let exactly = |length: usize| if data.len() == length { Ok(()) } else { Err(Exception::Value) };
        match function {
            1..=4 => {
                exactly(4)?;
                Ok(Request::Read { function, first: word(0)?, count: word(2)? })
            }
            5 => {
                exactly(4)?;
                Ok(Request::WriteCoil { address: word(0)?, value: word(2)? })
            }
            6 => {
                exactly(4)?;
                Ok(Request::WriteRegister { address: word(0)?, word: word(2)? })
            }
            8 => Ok(Request::Diagnostics { sub_function: word(0)?, data: data[2..].to_vec() }),
            15 => {
                let count = usize::from(word(2)?);
                let bytes = counted_bytes(data, count.div_ceil(8))?;
                let values = (0..count).map(|bit| bytes[bit / 8] >> (bit % 8) & 1 == 1).collect();
                Ok(Request::WriteCoils { first: word(0)?, values })
            }
            16 => {
                let count = usize::from(word(2)?);
                let bytes = counted_bytes(data, count * 2)?;
                let words = bytes.chunks_exact(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]]));
                Ok(Request::WriteRegisters { first: word(0)?, words: words.collect() })
            }
            43 => {
                let (&interface, data) = data.split_first().ok_or(Exception::Value)?;
                Ok(Request::Encapsulated { interface, data: data.to_vec() })
            }
            _ => Err(Exception::Function),
        }
    }
}

/// The values of function 15 or 16, if their byte count says `length` and as many follow.
fn counted_bytes(data: &[u8], length: usize) -> Result<&[u8], Exception> {
    match data.get(4) {
        Some(&told) if usize::from(told) == length && length > 0 && data.len() == 5 + length => {
            Ok(&data[5..])
        }
        _ => Err(Exception::Value),
    }
}

/// The first of `count` addresses, if 1 to `most` are asked and all lie in `first..=last`: the
/// specification checks the quantity (exception 3) before the addresses (exception 2).
pub fn check_span(first: u16, count: usize, most: usize, allowed: (u16, u16)) -> Result<(), Exception> {
    if count == 0 || count > most {
        return Err(Exception::Value);
    }
    let last = usize::from(first) + count - 1;
    if first < allowed.0 || last > usize::from(allowed.1) { Err(Exception::Address) } else { Ok(()) }
}

/// The reply to function 1 or 2: the first bit is the lowest of the first byte.
pub fn bits_reply(function: u8, bits: &[bool]) -> Vec<u8> {
    let mut bytes = vec![0; bits.len().div_ceil(8)];
    for (number, _) in bits.iter().enumerate().filter(|(_, on)| **on) {
        bytes[number / 8] |= 1 << (number % 8);
    }
    let mut reply = vec![function, bytes.len() as u8];
    reply.extend(bytes);
    reply
}

/// The reply to function 3 or 4: the high byte first.
pub fn words_reply(function: u8, words: &[u16]) -> Vec<u8> {
    let mut reply = vec![function, (words.len() * 2) as u8];
    reply.extend(words.iter().flat_map(|word| word.to_be_bytes()));
    reply
}

/// The reply to function 5, 6, 15 or 16: the function and two words.
pub fn write_reply(function: u8, address: u16, second: u16) -> Vec<u8> {
    let mut reply = vec![function];
    reply.extend(address.to_be_bytes());
    reply.extend(second.to_be_bytes());
    reply
}

/// The reply to function 43/14 with code 1, the basic identification in one piece: vendor, product, version.
pub fn identification_reply(interface: u8, data: &[u8], objects: &[&[u8]; 3]) -> Result<Vec<u8>, Exception> {
    if interface != 14 {
        return Err(Exception::Function);
    }
    let [code, object] = data else { return Err(Exception::Value) };
    // The conformity level 1, which is told, has nothing else.
    if *code != 1 {
        return Err(Exception::Value);
    }
    // The specification (6.21): an unknown first object begins at the start again.
    let first = if usize::from(*object) < objects.len() { usize::from(*object) } else { 0 };
    let mut reply = vec![43, 14, 1, 1, 0, 0, (objects.len() - first) as u8];
    for (number, text) in objects.iter().enumerate().skip(first) {
        reply.extend([number as u8, text.len() as u8]);
        reply.extend(*text);
    }
    Ok(reply)
}

/// The reply that refuses.
pub fn exception_reply(function: u8, exception: Exception) -> Vec<u8> {
    vec![function | 0x80, exception as u8]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_whose_length_or_byte_count_does_not_fit_is_refused_with_exception_3() {
        for pdu in [
            &[3, 0, 0, 0][..],
            &[3, 0, 0, 0, 1, 0],
            &[6, 0, 0, 1],
            &[15, 0, 0, 0, 4, 2, 1],
            &[15, 0, 0, 0, 9, 1, 1],
            &[16, 0, 0, 0, 2, 4, 0, 1, 0],
            &[16, 0, 0, 0, 0, 0],
            &[43],
        ] {
            assert_eq!(Request::parse(pdu), Err(Exception::Value), "{pdu:02X?}");
        }
        assert_eq!(Request::parse(&[7]), Err(Exception::Function));
        assert_eq!(Request::parse(&[]), Err(Exception::Function));
    }

    #[test]
    fn coils_fill_bytes_from_the_lowest_bit() {
        let nine = [true, false, false, true, false, false, false, false, true];
        assert_eq!(bits_reply(1, &nine), [1, 2, 0b1001, 1]);
        assert_eq!(
            Request::parse(&[15, 0, 3, 0, 9, 2, 0b1001, 1]),
            Ok(Request::WriteCoils { first: 3, values: nine.to_vec() })
        );
    }

    #[test]
    fn the_quantity_is_checked_before_the_address() {
        assert_eq!(check_span(100, 9, 8, (0, 7)), Err(Exception::Value));
        assert_eq!(check_span(7, 2, 8, (0, 7)), Err(Exception::Address));
        assert_eq!(check_span(65535, 8, 8, (0, 65535)), Err(Exception::Address));
        assert_eq!(check_span(0, 8, 8, (0, 7)), Ok(()));
    }
}
