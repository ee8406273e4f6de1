//! Framing: bytes and times to frames, and frames to bytes, for RTU and for Modbus TCP.

use crate::engine::time::{Duration, Time};
use crate::simulator::device::{LineSettings, Parity};

/// How requests and replies are packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Framing {
    /// Address, PDU, checksum; a frame ends when the line has been silent for 3.5 characters.
    Rtu,
    /// A header with transaction and length before the unit and the PDU.
    Tcp,
}

/// One request or reply with its address.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    /// Modbus TCP only: the client's number for this request; 0 on RTU.
    pub transaction: u16,
    pub unit: u8,
    pub pdu: Vec<u8>,
}

impl Frame {
    pub fn encode(&self, framing: Framing) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(self.pdu.len() + 7);
        match framing {
            Framing::Rtu => {
                bytes.push(self.unit);
                bytes.extend(&self.pdu);
                let checksum = checksum(&bytes);
                bytes.extend(checksum.to_le_bytes());
            }
            Framing::Tcp => {
                bytes.extend(self.transaction.to_be_bytes());
                bytes.extend([0, 0]);
                bytes.extend((self.pdu.len() as u16 + 1).to_be_bytes());
                bytes.push(self.unit);
                bytes.extend(&self.pdu);
            }
        }
        bytes
    }
}

/// The checksum of the serial line specification (2.5.1.2), sent with its low byte first.
pub fn checksum(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xFFFF, |crc, byte| {
        (0..8).fold(crc ^ u16::from(*byte), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0xA001 } else { crc >> 1 })
    })
}

/// How long one character takes: a start bit, eight data bits, and parity and stop bits to make
/// eleven; without parity these devices send one stop bit, so ten.
pub fn character_time(line: LineSettings) -> Duration {
    let bits = if line.parity == Parity::None { 10 } else { 11 };
    Duration::from_nanos(bits * 1_000_000_000 / u64::from(line.baud.max(1)))
}

/// The silence that ends a frame: 3.5 characters, and 1.75 ms above 19200 (specification, 2.5.1.1).
pub fn silence(line: LineSettings) -> Duration {
    if line.baud > 19200 { Duration::from_micros(1750) } else { character_time(line) * 7 / 2 }
}

/// What a receiver made of the bytes so far.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Received {
    Frame(Frame),
    /// A checksum did not fit, or there were too few bytes.
    Damaged,
    /// The peer speaks something else; the connection is useless.
    NotModbus,
}

/// Collects bytes until they are frames.
#[derive(Clone, Debug)]
pub struct Receiver {
    framing: Framing,
    silence: Duration,
    bytes: Vec<u8>,
    last_byte_at: Time,
}

/// Longer than any frame of either framing; more bytes than this without a silence are thrown away.
const BYTES_MAX: usize = 512;

impl Receiver {
    pub fn new(framing: Framing, line: LineSettings) -> Receiver {
        Receiver { framing, silence: silence(line), bytes: Vec::new(), last_byte_at: Time(0) }
    }

    pub fn push(&mut self, now: Time, bytes: &[u8]) {
        // The silence is looked for only when nothing more is there to be read: a thread that was kept
        // waiting reads the halves of a frame far apart, however close together they came.
        self.bytes.extend(bytes);
        self.last_byte_at = now;
        if self.framing == Framing::Rtu && self.bytes.len() > BYTES_MAX {
            self.bytes.truncate(BYTES_MAX);
        }
    }

    /// When to call [`Receiver::next`] although no byte has come.
    pub fn deadline(&self) -> Option<Time> {
        (self.framing == Framing::Rtu && !self.bytes.is_empty()).then(|| self.last_byte_at + self.silence)
    }

    /// The next thing received, if there is one by now.
    pub fn next(&mut self, now: Time) -> Option<Received> {
        match self.framing {
            Framing::Rtu => {
                if self.bytes.is_empty() || now.since(self.last_byte_at) < self.silence {
                    return None;
                }
                Some(decode_rtu(&std::mem::take(&mut self.bytes)))
            }
            Framing::Tcp => {
                let header = self.bytes.get(..7)?;
                let length = usize::from(u16::from_be_bytes([header[4], header[5]]));
                if header[2..4] != [0, 0] || !(2..=254).contains(&length) {
                    self.bytes.clear();
                    return Some(Received::NotModbus);
                }
                let frame = Frame {
                    transaction: u16::from_be_bytes([header[0], header[1]]),
                    unit: header[6],
                    pdu: self.bytes.get(7..6 + length)?.to_vec(),
                };
                self.bytes.drain(..6 + length);
                Some(Received::Frame(frame))
            }
        }
    }
}

fn decode_rtu(bytes: &[u8]) -> Received {
    match bytes.split_last_chunk::<2>() {
        Some((content, sum)) if content.len() >= 2 && checksum(content) == u16::from_le_bytes(*sum) => {
            Received::Frame(Frame { transaction: 0, unit: content[0], pdu: content[1..].to_vec() })
        }
        _ => Received::Damaged,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAME: [u8; 4] = [0x02, 0x07, 0x41, 0x12];

    #[test]
    fn the_checksum_is_that_of_the_specification() {
        // Serial line specification, 6.2.2: the frame 02 07 has the checksum 1241, low byte 41 first.
        assert_eq!(checksum(&FRAME[..2]), 0x1241);
        assert_eq!(Frame { transaction: 0, unit: 2, pdu: vec![7] }.encode(Framing::Rtu), FRAME);
    }

    #[test]
    fn an_rtu_frame_ends_with_a_silence_of_three_and_a_half_characters() {
        let line = LineSettings::default();
        assert_eq!(silence(line).as_micros(), 2005);
        assert_eq!(silence(LineSettings { baud: 115_200, ..line }).as_micros(), 1750);
        // FuehlerSysteme, chapter 8: 9600 without parity, "ca. 3,3 ms"; 3.5 × 10 bits are 3.65.
        assert_eq!(silence(LineSettings { baud: 9600, parity: Parity::None }).as_micros(), 3645);
        let mut receiver = Receiver::new(Framing::Rtu, line);
        receiver.push(Time(0), &FRAME[..2]);
        receiver.push(Time(1000), &FRAME[2..4]);
        assert_eq!(receiver.next(Time(2999)), None);
        let frame = Frame { transaction: 0, unit: 2, pdu: vec![7] };
        assert_eq!(receiver.deadline(), Some(Time(1000) + silence(line)));
        assert_eq!(receiver.next(Time(3006)), Some(Received::Frame(frame)));
        assert_eq!(receiver.next(Time(9999)), None);
    }

    #[test]
    fn an_rtu_frame_with_a_wrong_checksum_or_a_byte_too_many_is_damaged() {
        for bytes in [&FRAME[..3], &FRAME[..1], &[2, 7, 0x41, 0x12, 0x55], &[2, 7, 0x41, 0x13]] {
            assert_eq!(decode_rtu(bytes), Received::Damaged, "{bytes:02X?}");
        }
    }

    #[test]
    fn tcp_frames_are_taken_apart_by_their_length_however_they_arrive() {
        let bytes = [0, 9, 0, 0, 0, 6, 18, 3, 0, 0, 0, 1, 0, 10, 0, 0, 0, 2, 19, 7];
        let mut receiver = Receiver::new(Framing::Tcp, LineSettings::default());
        let mut frames = Vec::new();
        for byte in bytes {
            receiver.push(Time(0), &[byte]);
            frames.extend(receiver.next(Time(0)));
        }
        assert_eq!(
            frames,
            [
                Received::Frame(Frame { transaction: 9, unit: 18, pdu: vec![3, 0, 0, 0, 1] }),
                Received::Frame(Frame { transaction: 10, unit: 19, pdu: vec![7] }),
            ]
        );
        receiver.push(Time(0), b"GET / HTTP/1.1");
        assert_eq!(receiver.next(Time(0)), Some(Received::NotModbus));
    }
}
