//! Reads pcapng files by the draft (draft-ietf-opsawg-pcapng) and by nobody's code, and is strict: what
//! is not as it should be panics.

/// A file with one section and one interface.
#[derive(Debug)]
pub struct Pcapng {
    pub comment: String,
    pub link_type: u16,
    pub interface: String,
    pub description: String,
    pub packets: Vec<Packet>,
}

#[derive(Debug)]
pub struct Packet {
    /// Since 1970, in microseconds.
    pub time: u64,
    /// Sent by us.
    pub is_outbound: bool,
    pub comments: Vec<String>,
    /// Before the protocol unit: each a number and its padded bytes.
    pub tags: Vec<(u16, Vec<u8>)>,
    /// The protocol unit.
    pub bytes: Vec<u8>,
}

impl Packet {
    pub fn tag(&self, number: u16) -> &[u8] {
        &self.tags.iter().find(|(found, _)| *found == number).expect("the tag").1
    }
}

pub fn read(file: &[u8]) -> Pcapng {
    let mut blocks = blocks(file).into_iter();
    let (kind, section) = blocks.next().expect("a section");
    assert_eq!(kind, 0x0A0D_0D0A);
    assert_eq!(word(section, 0), 0x1A2B_3C4D, "the byte order");
    assert_eq!(section[4..16], [1, 0, 0, 0, 255, 255, 255, 255, 255, 255, 255, 255], "version and length");
    let of_section = options(&section[16..]);
    let (kind, interface) = blocks.next().expect("an interface");
    assert_eq!(kind, 1);
    assert_eq!(interface[2..8], [0; 6], "reserved, and no limit");
    let of_interface = options(&interface[8..]);
    Pcapng {
        comment: text(&of_section, 1).remove(0),
        link_type: u16::from_le_bytes([interface[0], interface[1]]),
        interface: text(&of_interface, 2).remove(0),
        description: text(&of_interface, 3).remove(0),
        packets: blocks.map(|(kind, block)| packet(kind, block)).collect(),
    }
}

fn packet(kind: u32, block: &[u8]) -> Packet {
    assert_eq!((kind, word(block, 0)), (6, 0), "a packet of the only interface");
    let length = word(block, 12) as usize;
    assert_eq!(word(block, 16) as usize, length, "all of it is there");
    let data = &block[20..20 + length];
    let options = options(&block[20 + length.next_multiple_of(4)..]);
    let flags = options.iter().find(|(code, _)| *code == 2).expect("the direction");
    let (tags, bytes) = tags(data);
    Packet {
        time: u64::from(word(block, 4)) << 32 | u64::from(word(block, 8)),
        is_outbound: match flags.1.as_slice() {
            [1, 0, 0, 0] => false,
            [2, 0, 0, 0] => true,
            other => panic!("{other:?} is no direction"),
        },
        comments: text(&options, 1),
        tags,
        bytes,
    }
}

/// Each block's kind and body.
fn blocks(mut file: &[u8]) -> Vec<(u32, &[u8])> {
    let mut blocks = Vec::new();
    while !file.is_empty() {
        let length = word(file, 4) as usize;
        assert_eq!(length % 4, 0, "a block is whole words long");
        assert_eq!(word(file, length - 4) as usize, length, "its length stands at both ends");
        blocks.push((word(file, 0), &file[8..length - 4]));
        file = &file[length..];
    }
    blocks
}

fn options(mut bytes: &[u8]) -> Vec<(u16, Vec<u8>)> {
    let mut options = Vec::new();
    loop {
        let [code_low, code_high, low, high, rest @ ..] = bytes else { panic!("options without an end") };
        let (code, length) = (u16::from_le_bytes([*code_low, *code_high]), u16::from_le_bytes([*low, *high]));
        if code == 0 {
            assert_eq!((length, rest), (0, &[][..]), "the end is the end");
            return options;
        }
        let length = usize::from(length);
        options.push((code, rest[..length].to_vec()));
        let (padding, behind) = rest[length..].split_at(length.next_multiple_of(4) - length);
        assert!(padding.iter().all(|byte| *byte == 0), "it is filled up with zeros");
        bytes = behind;
    }
}

/// The tags of an "upper protocol unit", and what follows them.
fn tags(mut data: &[u8]) -> (Vec<(u16, Vec<u8>)>, Vec<u8>) {
    let mut tags = Vec::new();
    loop {
        let [number_high, number_low, high, low, rest @ ..] = data else { panic!("tags without an end") };
        let number = u16::from_be_bytes([*number_high, *number_low]);
        let length = usize::from(u16::from_be_bytes([*high, *low]));
        if number == 0 {
            assert_eq!(length, 0);
            return (tags, rest.to_vec());
        }
        assert_eq!(length % 4, 0, "a tag is whole words long");
        tags.push((number, rest[..length].to_vec()));
        data = &rest[length..];
    }
}

fn text(options: &[(u16, Vec<u8>)], code: u16) -> Vec<String> {
    let found = options.iter().filter(|(found, _)| *found == code);
    found.map(|(_, value)| String::from_utf8(value.clone()).expect("a text")).collect()
}

fn word(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
}
