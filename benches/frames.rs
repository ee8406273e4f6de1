//! The wire's own arithmetic, from the specification and not from the program that is measured.

use std::time::Duration;

/// The characters of a serial line.
#[derive(Clone, Copy, Debug)]
pub struct Line {
    pub baud: u32,
    /// Start bit, data, parity and stop bits.
    pub bits: u32,
    /// `even` or `none`, as a configuration says it.
    pub parity: &'static str,
}

impl Line {
    pub const fn new(baud: u32, parity: &'static str, bits: u32) -> Line {
        Line { baud, bits, parity }
    }

    /// How long so many characters take, in nanoseconds.
    pub fn characters(self, count: usize) -> i64 {
        count as i64 * i64::from(self.bits) * 1_000_000_000 / i64::from(self.baud)
    }

    /// The silence before each request: 3.5 characters, and 1.75 ms above 19200 baud (Modbus over serial
    /// line V1.02, 2.5.1.1).
    pub fn silence(self) -> i64 {
        if self.baud > 19_200 { 1_750_000 } else { self.characters(7) / 2 }
    }

    /// What reading so many registers takes at least, in nanoseconds: the silence, eight characters of
    /// request, the turnaround, and five characters of reply with two for each register.
    pub fn read(self, registers: usize, turnaround: Duration) -> i64 {
        self.silence() + self.characters(8 + 5 + 2 * registers) + turnaround.as_nanos() as i64
    }

    /// What writing one register takes at least: both frames have eight characters.
    pub fn write(self, turnaround: Duration) -> i64 {
        self.silence() + self.characters(8 + 8) + turnaround.as_nanos() as i64
    }

    /// The least time in which these registers can be read: over all ways to cut the list into reads, each
    /// from its first register to its last.
    pub fn read_at_best(self, registers: &[usize], turnaround: Duration) -> i64 {
        let mut best = vec![0; registers.len() + 1];
        for end in 1..=registers.len() {
            best[end] = (0..end)
                .map(|begin| {
                    let span = registers[end - 1] - registers[begin] + 1;
                    best[begin] + self.read(span, turnaround)
                })
                .min()
                .unwrap_or_default();
        }
        best[registers.len()]
    }
}

/// The checksum of the serial line specification (2.5.1.2), sent with its low byte first.
pub fn checksum(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xFFFF, |sum, byte| {
        (0..8).fold(sum ^ u16::from(*byte), |sum, _| if sum & 1 == 1 { sum >> 1 ^ 0xA001 } else { sum >> 1 })
    })
}
