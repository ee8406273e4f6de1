//! The names of kept recordings, and which of them must go so that the folder does not grow.

use crate::engine::time::Date;

/// All recordings of all buses together; beyond it the oldest go.
const BYTES_MAX: u64 = 64 * 1024 * 1024;

/// A file in the folder of recordings.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Kept {
    pub name: String,
    pub bytes: u64,
}

/// `basement-20261126T235021Z.pcapng`; a second one of the same second gets a number.
pub fn name(bus: &str, date: Date, others: &[Kept]) -> String {
    let time: String = date.to_string().chars().filter(|c| !matches!(c, '-' | ':')).collect();
    let numbered = (2..).map(|number| format!("{bus}-{time}-{number}.pcapng"));
    let mut names = std::iter::once(format!("{bus}-{time}.pcapng")).chain(numbered);
    let is_free = |name: &String| others.iter().all(|other| other.name != *name);
    names.find(is_free).unwrap_or_default()
}

/// Of `others`, those that must go when a file of `bytes` comes to the bus, so that it has not more
/// than `keep`, and all together are not too large. Files that are no recordings are left alone.
pub fn superfluous(bus: &str, bytes: u64, others: &[Kept], keep: usize) -> Vec<String> {
    // Names of buses have no hyphen in them.
    let mut recordings: Vec<(&str, &str, u64)> = others
        .iter()
        .filter(|kept| kept.name.ends_with(".pcapng"))
        .filter_map(|kept| kept.name.split_once('-').map(|(bus, time)| (time, bus, kept.bytes)))
        .collect();
    // By their times, the newest first.
    recordings.sort_unstable_by(|a, b| b.cmp(a));
    let (mut of_bus, mut total) = (1, bytes);
    let goes = |(time, other, bytes): (&str, &str, u64)| {
        of_bus += usize::from(other == bus);
        total += bytes;
        let too_many = other == bus && of_bus > keep;
        (too_many || total > BYTES_MAX).then(|| format!("{other}-{time}"))
    };
    recordings.into_iter().filter_map(goes).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kept(files: &[(&str, u64)]) -> Vec<Kept> {
        files.iter().map(|(name, bytes)| Kept { name: (*name).into(), bytes: *bytes }).collect()
    }

    #[test]
    fn a_file_is_named_by_its_bus_and_its_time() {
        let date = Date(1_795_737_021);
        let first = "basement-20261126T235021Z.pcapng";
        let second = "basement-20261126T235021Z-2.pcapng";
        assert_eq!(name("basement", date, &[]), first);
        assert_eq!(name("basement", date, &kept(&[(first, 1)])), second);
        assert_eq!(
            name("basement", date, &kept(&[(first, 1), (second, 1)])),
            "basement-20261126T235021Z-3.pcapng"
        );
        assert_eq!(name("base", date, &kept(&[(first, 1)])), "base-20261126T235021Z.pcapng");
    }

    #[test]
    fn the_oldest_of_the_bus_go_and_nothing_else() {
        let others = kept(&[
            ("attic-20200101T000000Z.pcapng", 9),
            ("basement-20260103T000000Z.pcapng", 9),
            ("basement-20260101T000000Z.pcapng", 9),
            ("basement-20260102T000000Z.pcapng", 9),
            ("basement-20200101T000000Z.txt", 9),
            ("notes.pcapng", 9),
        ]);
        for (keep, expected) in [
            (4, &[][..]),
            (3, &["basement-20260101T000000Z.pcapng"]),
            (2, &["basement-20260102T000000Z.pcapng", "basement-20260101T000000Z.pcapng"]),
        ] {
            assert_eq!(superfluous("basement", 9, &others, keep), expected, "keep {keep}");
        }
    }

    #[test]
    fn all_together_do_not_grow_without_bound() {
        let others = kept(&[
            ("attic-20260101T000000Z.pcapng", BYTES_MAX / 2),
            ("basement-20260102T000000Z.pcapng", BYTES_MAX / 2),
        ]);
        assert_eq!(superfluous("plant", 1, &others, 10), ["attic-20260101T000000Z.pcapng"]);
    }
}
