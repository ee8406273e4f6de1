//! Units: which ones a link can have, and how people name several of them.

use std::ops::RangeInclusive;

use super::Link;

/// The highest unit of a serial line; 248 to 255 are reserved there.
pub const UNIT_OF_LINE_MAX: u8 = 247;

impl Link {
    /// The highest unit that a device can have.
    pub const fn units_most(&self) -> u8 {
        match self {
            Link::Tcp { .. } => u8::MAX,
            Link::Serial { .. } | Link::RtuOverTcp { .. } => UNIT_OF_LINE_MAX,
        }
    }
}

/// Reads `1..20` or `7`, of a bus whose highest unit is `most`.
pub fn units(text: &str, most: u8) -> Result<RangeInclusive<u8>, String> {
    let (first, last) = text.split_once("..").unwrap_or((text, text));
    match (first.trim().parse::<u8>(), last.trim().parse::<u8>()) {
        (Ok(first), Ok(last)) if 1 <= first && first <= last && last <= most => Ok(first..=last),
        _ => Err(format!("`{text}` names no units of this bus; expected them as in `1..{most}` or `7`")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_one_or_a_span_from_1_to_the_highest() {
        for (text, most, expected) in [
            ("7", 247, Ok(7..=7)),
            ("1..247", 247, Ok(1..=247)),
            (" 30 .. 32", 247, Ok(30..=32)),
            ("248..255", 255, Ok(248..=255)),
            ("248", 247, Err("`248` names no units of this bus; expected them as in `1..247` or `7`")),
            ("0..3", 247, Err("`0..3` names no units of this bus; expected them as in `1..247` or `7`")),
            ("5..3", 255, Err("`5..3` names no units of this bus; expected them as in `1..255` or `7`")),
            ("all", 255, Err("`all` names no units of this bus; expected them as in `1..255` or `7`")),
            ("1..300", 255, Err("`1..300` names no units of this bus; expected them as in `1..255` or `7`")),
        ] {
            assert_eq!(units(text, most), expected.map_err(String::from), "{text}");
        }
    }
}
