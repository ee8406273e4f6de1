//! A recording as the file that Wireshark opens: pcapng, one interface (the bus), one packet for each
//! frame, and the notes as its comments.
//!
//! There is a link type for whole protocol units without anything below them, each of which names the
//! dissector that shall read it: so Wireshark decodes Modbus RTU and Modbus TCP without a setting, and
//! no wire is made up. pcapng: draft-ietf-opsawg-pcapng; the link type and its tags: LINKTYPE_WIRESHARK_UPPER_PDU
//! in the list of tcpdump.org, and `epan/exported_pdu.h` of Wireshark.

use crate::engine::recorder::Recording;
use crate::engine::recorder::frames::{Frame, frames};
use crate::engine::time::Duration;

/// Upper protocol units of Wireshark.
const LINK_TYPE: u16 = 252;

/// Block types.
const SECTION: u32 = 0x0A0D_0D0A;
const INTERFACE: u32 = 1;
const PACKET: u32 = 6;

/// Options of any block, of a section, of an interface, of a packet.
const COMMENT: u16 = 1;
const APPLICATION: u16 = 4;
const NAME: u16 = 2;
const DESCRIPTION: u16 = 3;
const FLAGS: u16 = 2;

const INBOUND: u32 = 1;
const OUTBOUND: u32 = 2;

/// Tags before a protocol unit.
const DISSECTOR: u16 = 12;
const SOURCE: u16 = 20;
const DESTINATION: u16 = 21;
const PORT_KIND: u16 = 24;
const SOURCE_PORT: u16 = 25;
const DESTINATION_PORT: u16 = 26;

/// The columns "source" and "destination" show addresses: a unit's is `0.0.0.18`, that of an unknown
/// sender `0.0.0.0`, and the gateway's this one.
const GATEWAY: [u8; 4] = [127, 0, 0, 1];
/// By them a request is told from an answer: what goes to the port of Modbus, and what comes from it.
const PORT_OF_MODBUS: u32 = 502;
const PORT_OF_GATEWAY: u32 = 50_200;
const TCP: u32 = 2;

impl Recording {
    /// The file, and how many frames are in it. `now` is the time since 1970 at which it was made.
    pub fn to_pcapng(&self, now: Duration) -> (Vec<u8>, usize) {
        let frames = frames(self);
        let mut file = Vec::new();
        let made_by = concat!("busker ", env!("CARGO_PKG_VERSION"));
        let about = format!("bus {}, {}: {}", self.bus, self.link, self.why);
        let mut section = Vec::new();
        section.extend(0x1A2B_3C4D_u32.to_le_bytes());
        section.extend([1, 0, 0, 0]);
        // The length of the section: to the end of the file.
        section.extend((-1_i64).to_le_bytes());
        option(&mut section, COMMENT, about.as_bytes());
        option(&mut section, APPLICATION, made_by.as_bytes());
        end_options(&mut section);
        block(&mut file, SECTION, &section);

        let mut interface = Vec::new();
        interface.extend(LINK_TYPE.to_le_bytes());
        // Reserved; and packets of any length. Times are in microseconds unless said.
        interface.extend([0; 6]);
        option(&mut interface, NAME, self.bus.as_bytes());
        option(&mut interface, DESCRIPTION, self.link.as_bytes());
        end_options(&mut interface);
        block(&mut file, INTERFACE, &interface);

        for frame in &frames {
            let time = now.saturating_sub(self.made_at - frame.time);
            block(&mut file, PACKET, &packet(frame, time, self.is_tcp));
        }
        (file, frames.len())
    }
}

fn packet(frame: &Frame, time: Duration, is_tcp: bool) -> Vec<u8> {
    let unit = [0, 0, 0, frame.unit.unwrap_or_default()];
    let (from, to, from_port, to_port, way) = match frame.is_sent {
        true => (GATEWAY, unit, PORT_OF_GATEWAY, PORT_OF_MODBUS, OUTBOUND),
        false => (unit, GATEWAY, PORT_OF_MODBUS, PORT_OF_GATEWAY, INBOUND),
    };
    let mut data = Vec::with_capacity(64 + frame.bytes.len());
    tag(&mut data, DISSECTOR, if is_tcp { b"mbtcp" } else { b"mbrtu" });
    tag(&mut data, SOURCE, &from);
    tag(&mut data, DESTINATION, &to);
    tag(&mut data, PORT_KIND, &TCP.to_be_bytes());
    tag(&mut data, SOURCE_PORT, &from_port.to_be_bytes());
    tag(&mut data, DESTINATION_PORT, &to_port.to_be_bytes());
    data.extend([0; 4]);
    data.extend(&frame.bytes);

    let micros = time.as_micros() as u64;
    let length = data.len() as u32;
    let mut packet = Vec::with_capacity(48 + data.len());
    let of_interface = 0;
    for word in [of_interface, (micros >> 32) as u32, micros as u32, length, length] {
        packet.extend(word.to_le_bytes());
    }
    packet.extend(&data);
    pad(&mut packet);
    for note in &frame.notes {
        option(&mut packet, COMMENT, note.as_bytes());
    }
    option(&mut packet, FLAGS, &way.to_le_bytes());
    end_options(&mut packet);
    packet
}

/// `body` is a multiple of four bytes.
fn block(file: &mut Vec<u8>, kind: u32, body: &[u8]) {
    let length = (body.len() as u32 + 12).to_le_bytes();
    file.extend(kind.to_le_bytes());
    file.extend(length);
    file.extend(body);
    file.extend(length);
}

fn option(block: &mut Vec<u8>, code: u16, value: &[u8]) {
    // A longer text is no note.
    let value = &value[..value.len().min(usize::from(u16::MAX))];
    block.extend(code.to_le_bytes());
    block.extend((value.len() as u16).to_le_bytes());
    block.extend(value);
    pad(block);
}

fn end_options(block: &mut Vec<u8>) {
    block.extend([0; 4]);
}

/// A tag's numbers have their high byte first, and its length is that of the padded value.
fn tag(data: &mut Vec<u8>, code: u16, value: &[u8]) {
    data.extend(code.to_be_bytes());
    data.extend((value.len().next_multiple_of(4) as u16).to_be_bytes());
    data.extend(value);
    pad(data);
}

fn pad(bytes: &mut Vec<u8>) {
    bytes.resize(bytes.len().next_multiple_of(4), 0);
}
