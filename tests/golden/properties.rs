//! Properties that hold for every shipped profile, whatever the registers hold and whatever line it
//! is on.

use std::collections::BTreeMap;

use busker::engine::address::{Span, Table};
use busker::engine::codec::{self, Resolved};
use busker::engine::device::{Device, Encoding, Names, Poll, Write, WriteRule};
use busker::engine::plan::{Cost, Read, plan};
use busker::engine::value::Reading;
use proptest::prelude::*;

use crate::shipped;

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn what_is_read_can_be_written_back_and_reads_the_same(
        pick in any::<prop::sample::Index>(),
        selected in any::<prop::sample::Index>(),
        words in prop::collection::vec(words_with_edges(), 4),
    ) {
        let writable: Vec<(&Device, usize, &Write)> = shipped().iter().flat_map(|(_, device)| writable(device)).collect();
        let (device, index, write) = *pick.get(&writable);
        let known = some_state(device, index, &selected);
        let resolved = codec::resolve(device, index, &known)
            .map_err(|missing| TestCaseError::fail(format!("{}: {missing}", device.points[index].name)))?;
        let point = &device.points[index];
        let words = cut_to_size(device, index, &resolved, &words);
        let reading = codec::read(&resolved, &words);
        let told = reading.to_string();
        match codec::encode(point, &write.rule, &resolved, &told) {
            Ok(written) => {
                prop_assert!(may_be_written(&resolved, &write.rule, &reading), "{} took {told}", point.name);
                let back = codec::read(&resolved, &written);
                prop_assert_eq!(&back, &reading, "{}: {:04X?} as {}", &point.name, &written, &told);
            }
            Err(reason) => {
                prop_assert!(!may_be_written(&resolved, &write.rule, &reading), "{}: {}", point.name, reason);
            }
        }
    }

    #[test]
    fn each_polled_point_is_in_exactly_one_read_and_no_read_breaks_a_rule(
        pick in any::<prop::sample::Index>(),
        request in 100u64..100_000,
        byte in 1u64..10_000,
        narrower in 0u16..130,
        gap in prop::option::of(0u16..20),
        refused in prop::collection::vec((0u16..110, 1u16..6), 0..4),
    ) {
        let mut device = pick.get(shipped()).1.clone();
        // Also where the device allows less than it does; its widest value must still fit.
        let widest = device.points.iter().map(|point| point.at.span.count() as u16).max().unwrap_or(1);
        let limits = &mut device.wire.limits;
        limits.read_registers = limits.read_registers.min(narrower.max(widest));
        limits.read_bits = limits.read_bits.min(narrower.max(1));
        limits.gap = gap;
        let refused: Vec<Span> = Table::ALL
            .iter()
            .flat_map(|table| refused.iter().filter_map(|(first, count)| Span::with_count(*table, *first, *count)))
            .collect();
        let reads = plan(&device, Cost { request, byte }, &refused);
        check_reads(&device, &reads, &refused)?;
    }
}

/// Any word, and more often those at the ends of types and the sentinels.
fn words_with_edges() -> impl Strategy<Value = u16> {
    prop_oneof![
        4 => any::<u16>(),
        2 => 0u16..12,
        1 => prop::sample::select(vec![0x7FFF, 0x8000, 0xFFFF, 0x7F80, 0x4120, 11111, 1018, 0x5300]),
    ]
}

fn writable(device: &Device) -> impl Iterator<Item = (&Device, usize, &Write)> {
    let writes = device.points.iter().enumerate();
    writes
        .filter_map(|(index, point)| Some((index, point.write.as_ref()?)))
        .filter(|(_, write)| !matches!(write.rule, WriteRule::Press { .. }))
        .map(move |(index, write)| (device, index, write))
}

/// What the point's selectors hold: any value that their names or ranges give, and with which the point
/// lives.
fn some_state(device: &Device, index: usize, selected: &prop::sample::Index) -> Vec<Option<i128>> {
    let mut known = vec![None; device.points.len()];
    for selector in device.points[index].selectors() {
        let point = &device.points[selector];
        let names = point.plain().map(|form| form.names.list()).unwrap_or_default();
        let mut possible: Vec<i128> = names.iter().map(|(raw, _)| *raw).collect();
        if let Some(WriteRule::Range { min, max, .. }) = point.write.as_ref().map(|write| &write.rule) {
            possible.extend(min.units..=max.units);
        }
        for condition in device.points[index].when.iter().filter(|condition| condition.point == selector) {
            possible.retain(|raw| condition.holds(*raw));
        }
        if let Encoding::Cases { by, cases } = &device.points[index].encoding {
            let has_reading = |raw: &i128| cases.iter().any(|case| case.key == *raw && case.form.is_some());
            possible.retain(|raw| *by != selector || has_reading(raw));
        }
        known[selector] = Some(*selected.get(&possible));
    }
    known
}

/// As many words as the point has, and of a field of bits no more than it holds.
fn cut_to_size(device: &Device, index: usize, resolved: &Resolved<'_>, words: &[u16]) -> Vec<u16> {
    let at = device.points[index].at;
    if at.span.table().is_bits() {
        return vec![words[0] & 1];
    }
    match at.bits {
        Some(bits) => vec![bits.extract(words[0])],
        None => words[..usize::from(resolved.form.kind.registers())].to_vec(),
    }
}

/// What the rule says, in the plainest words: the codec has to come to the same.
fn may_be_written(resolved: &Resolved<'_>, rule: &WriteRule, reading: &Reading) -> bool {
    let within = |number: f64| {
        codec::limits(resolved, rule)
            .is_none_or(|limits| limits.min.to_f64() <= number && number <= limits.max.to_f64())
    };
    match (reading, rule) {
        (Reading::Missing(_), _) => false,
        (Reading::Name(name), WriteRule::Names(names)) => names.contains(name),
        (Reading::Number(number), _) => {
            !matches!(resolved.form.names, Names::All(_)) && within(number.to_f64())
        }
        (Reading::Float(number), _) => within(*number),
        _ => true,
    }
}

fn check_reads(device: &Device, reads: &[Read], refused: &[Span]) -> Result<(), TestCaseError> {
    let wire = &device.wire;
    let mut times_read: BTreeMap<usize, u32> = BTreeMap::new();
    for read in reads {
        let limit =
            if read.span.table().is_bits() { wire.limits.read_bits } else { wire.limits.read_registers };
        prop_assert!(read.span.count() <= u32::from(limit), "{} is too long", read.span);
        let readable = wire.readable.is_empty() || wire.readable.iter().any(|span| span.contains(read.span));
        prop_assert!(readable, "{} is not readable", read.span);
        prop_assert!(!wire.forbidden.iter().any(|forbidden| forbidden.span.overlaps(read.span)));
        let is_refused = |span: &&Span| read.points.len() > 1 && read.span.contains(**span);
        prop_assert_eq!(refused.iter().find(is_refused), None, "{} was refused", read.span);
        for gap in read.gaps() {
            let widest = wire.limits.gap.map_or(u32::MAX, u32::from);
            prop_assert!(gap.count() <= widest, "{gap} is bridged");
        }
        for (index, place) in &read.points {
            let point = &device.points[*index];
            *times_read.entry(*index).or_default() += 1;
            prop_assert!(*place == point.at || Some(*place) == point.also, "{} is elsewhere", point.name);
            prop_assert!(read.span.contains(place.span), "{} is split", point.name);
            prop_assert_eq!(read.poll, point.poll);
            prop_assert!(!point.read_clears || read.alone && read.span == place.span);
        }
    }
    for (index, point) in device.points.iter().enumerate() {
        let times = times_read.get(&index).copied().unwrap_or(0);
        prop_assert_eq!(times, u32::from(point.poll != Poll::Never), "{}", &point.name);
    }
    Ok(())
}

#[test]
fn a_selector_is_itself_understood_without_another() {
    for (id, device) in shipped() {
        for point in &device.points {
            for selector in point.selectors() {
                let selector = &device.points[selector];
                assert!(matches!(selector.encoding, Encoding::Plain(_)), "{id}: {}", selector.name);
                assert!(selector.is_read(), "{id}: {} is not read", selector.name);
                assert!(selector.selectors().is_empty(), "{id}: {} waits itself", selector.name);
            }
        }
    }
}
