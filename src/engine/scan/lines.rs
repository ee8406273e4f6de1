//! With which settings a line of which nothing is known is tried, and how long a unit is waited for there.

use crate::engine::settings::{Line, Parity};
use crate::engine::time::Duration;

/// What the specification asks for.
pub const SPECIFIED: Line = Line { baud: 19_200, parity: Parity::Even, stop_bits: 1 };

/// The likeliest first: what the specification asks for (19200, even; METZ CONNECT's and BTR's devices leave
/// the factory so), then what makers of small devices set (9600, no parity), then what else the switches of
/// FuehlerSysteme's boards know. The slow ones come last, since each unit takes longer there.
const TRIED: [(u32, Parity); 24] = [
    (19_200, Parity::Even),
    (9600, Parity::None),
    (9600, Parity::Even),
    (19_200, Parity::None),
    (38_400, Parity::Even),
    (38_400, Parity::None),
    (115_200, Parity::None),
    (115_200, Parity::Even),
    (57_600, Parity::None),
    (57_600, Parity::Even),
    (9600, Parity::Odd),
    (19_200, Parity::Odd),
    (38_400, Parity::Odd),
    (57_600, Parity::Odd),
    (115_200, Parity::Odd),
    (4800, Parity::None),
    (4800, Parity::Even),
    (4800, Parity::Odd),
    (2400, Parity::Even),
    (2400, Parity::None),
    (2400, Parity::Odd),
    (1200, Parity::Even),
    (1200, Parity::None),
    (1200, Parity::Odd),
];
const PARITIES: [Parity; 3] = [Parity::Even, Parity::None, Parity::Odd];

/// The settings to try, in their order; what is known of them is not tried otherwise. One stop bit does for
/// devices that are set to two: a receiver looks at the first.
pub fn lines(baud: Option<u32>, parity: Option<Parity>, stop_bits: Option<u8>) -> Vec<Line> {
    let line = |baud, parity| Line { baud, parity, stop_bits: stop_bits.unwrap_or(1) };
    let fits = |(_, tried): &(u32, Parity)| parity.is_none_or(|parity| parity == *tried);
    let known = TRIED.into_iter().filter(fits);
    match baud {
        None => known.map(|(baud, parity)| line(baud, parity)).collect(),
        Some(wanted) if TRIED.iter().any(|(baud, _)| *baud == wanted) => {
            known.filter(|(baud, _)| *baud == wanted).map(|(baud, parity)| line(baud, parity)).collect()
        }
        Some(wanted) => {
            let parities = PARITIES.into_iter().filter(|tried| fits(&(wanted, *tried)));
            parities.map(|parity| line(wanted, parity)).collect()
        }
    }
}

/// A device begins its answer within this time, and an adapter hands its first bytes over: METZ CONNECT's
/// take 5 ms, FuehlerSysteme's "mostly less than 50 ms". What comes later is not lost: it says whose it is,
/// and that unit is asked again.
const BEGINS_WITHIN: Duration = Duration::from_millis(60);
/// So many characters are there before an adapter hands the first one over.
const CHARACTERS_HELD_BACK: u32 = 5;

/// How long a unit that may not be there is waited for.
pub fn short_timeout(line: Line) -> Duration {
    BEGINS_WITHIN + line.characters(CHARACTERS_HELD_BACK)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn told(lines: &[Line]) -> String {
        lines.iter().map(Line::to_string).collect::<Vec<_>>().join(", ")
    }

    #[test]
    fn the_likeliest_settings_come_first_and_slow_ones_last() {
        let all = lines(None, None, None);
        assert_eq!(told(&all[..4]), "19200 8E1, 9600 8N1, 9600 8E1, 19200 8N1");
        assert!(all[18..].iter().all(|line| line.baud < 4800), "{}", told(&all));
        let mut once = all.clone();
        once.sort_by_key(|line| (line.baud, line.parity as u8));
        once.dedup();
        assert_eq!(once.len(), 24, "each once");
    }

    #[test]
    fn what_is_known_is_not_tried_otherwise() {
        for (baud, parity, stop_bits, expected) in [
            (Some(9600), None, None, "9600 8N1, 9600 8E1, 9600 8O1"),
            (Some(9600), Some(Parity::Odd), Some(2), "9600 8O2"),
            (Some(7200), None, None, "7200 8E1, 7200 8N1, 7200 8O1"),
            (Some(7200), Some(Parity::None), None, "7200 8N1"),
        ] {
            assert_eq!(told(&lines(baud, parity, stop_bits)), expected);
        }
        assert_eq!(lines(None, Some(Parity::None), None).len(), 8);
    }

    #[test]
    fn a_slow_line_is_waited_for_longer() {
        let at = |baud| short_timeout(Line { baud, parity: Parity::Even, stop_bits: 1 }).as_millis();
        assert_eq!([at(1200), at(9600), at(115_200)], [105, 65, 60]);
    }
}
