//! The checksum at the end of each RTU frame.

/// The CRC-16 of Modbus (reversed polynomial 0xA001, start 0xFFFF; Modbus over serial line V1.02,
/// 6.2.2), its low byte to be sent first. Over a whole frame with its checksum it is 0.
pub fn crc(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xFFFF, |crc, byte| (crc >> 8) ^ TABLE[usize::from(crc as u8 ^ byte)])
}

const TABLE: [u16; 256] = {
    let mut table = [0; 256];
    let mut index = 0;
    while index < 256 {
        let mut entry = index as u16;
        let mut bit = 0;
        while bit < 8 {
            entry = if entry & 1 == 1 { (entry >> 1) ^ 0xA001 } else { entry >> 1 };
            bit += 1;
        }
        table[index] = entry;
        index += 1;
    }
    table
};

#[cfg(test)]
mod tests {
    use super::crc;

    #[test]
    fn the_checksum_is_that_of_published_frames() {
        // The check value of CRC-16/MODBUS, and the example of the serial line specification, 6.2.2.
        assert_eq!(crc(b"123456789"), 0x4B37);
        assert_eq!(crc(&[0x02, 0x07]), 0x1241);
        assert_eq!(crc(&[0x02, 0x07, 0x41, 0x12]), 0);
    }
}
