//! The planner against tables and against brute force.

use proptest::prelude::*;

use super::*;
use crate::engine::address::Table as RegisterTable;
use crate::engine::device::{Condition, Forbidden, Limits, Point, Wire};
use crate::engine::settings::Parity;
use crate::engine::test_device::device_of;

const LINE: Line = Line { baud: 19200, parity: Parity::Even, stop_bits: 1 };

fn cost() -> Cost {
    Tariff::of_line(LINE, LINE.frame_gap()).cost(USUAL_TURNAROUND)
}

fn span(table: RegisterTable, first: u16, last: u16) -> Span {
    Span::new(table, first, last).expect("a span")
}

/// A device with one fast point for each `first, count`, and this wire.
fn device(places: &[(u16, u16)], change: impl FnOnce(&mut Wire)) -> Device {
    let points = places
        .iter()
        .enumerate()
        .map(|(index, (first, count))| {
            let span = Span::with_count(RegisterTable::Input, *first, *count).expect("a span");
            Point::new(&format!("p{index}"), Address { span, bits: None }, Poll::Fast)
        })
        .collect();
    let mut device = device_of(points);
    change(&mut device.wire);
    device
}

fn check(device: &Device, refused: &[Span], expected: &[&str]) {
    let reads: Vec<String> = plan(device, cost(), refused).iter().map(|read| read.span.to_string()).collect();
    assert_eq!(reads, expected);
}

#[test]
fn near_points_share_a_read_and_far_ones_do_not() {
    check(&device(&[(0, 1), (4, 1)], |_| {}), &[], &["input 0..4"]);
    check(&device(&[(0, 1), (200, 1)], |_| {}), &[], &["input 0", "input 200"]);
    check(&device(&[(0, 1), (4, 1)], |wire| wire.limits.gap = Some(2)), &[], &["input 0", "input 4"]);
    check(&device(&[(0, 1), (1, 1)], |wire| wire.limits.gap = Some(0)), &[], &["input 0..1"]);
}

#[test]
fn the_silence_that_a_device_wants_counts_as_far_as_nobody_else_is_asked_meanwhile() {
    let slow = device(&[(0, 1), (40, 1)], |wire| wire.limits.delay = Duration::from_millis(100));
    let often = |millis| device(&[(0, 20)], |wire| wire.intervals.fast = Duration::from_millis(millis));
    let tariff = Tariff::of_line(LINE, LINE.frame_gap());
    // A read of twenty registers takes some 37 ms.
    for (what, others, expected, reads) in [
        ("alone", vec![], 100, 1),
        ("hardly anything else", vec![often(1000)], 96, 1),
        ("half of the line", vec![often(150), often(150)], 50, 1),
        ("hardly any time", vec![often(80), often(80)], 6, 2),
        ("none", vec![often(1)], 0, 2),
    ] {
        let on_bus: Vec<&Device> = std::iter::once(&slow).chain(&others).collect();
        let rest = tariff.idle_rests(&on_bus)[0];
        assert_eq!(rest.as_millis(), expected, "{what}");
        assert_eq!(plan(&slow, tariff.cost(USUAL_TURNAROUND + rest), &[]).len(), reads, "{what}");
    }
}

#[test]
fn a_read_sleeps_while_none_of_its_points_lives() {
    let mut device = device(&[(0, 1), (200, 1), (201, 1), (400, 1), (401, 1)], |_| {});
    for living in [2, 3, 4] {
        device.points[living].when = vec![Condition { point: 0, values: vec![(1, "on".into())] }];
    }
    let reads = plan(&device, cost(), &[]);
    let deciding: Vec<Vec<PointIndex>> = reads.iter().map(|read| read.sleeps_by(&device)).collect();
    assert_eq!(deciding, [vec![], vec![], vec![0]]);
    let table = Table { device: &device, reads: &reads }.to_string();
    assert_eq!(
        table.lines().filter(|line| line.ends_with("  only while p0 allows it")).count(),
        1,
        "{table}"
    );
}

#[test]
fn a_gap_that_was_refused_is_not_bridged_again() {
    let device = device(&[(0, 1), (2, 1), (4, 1)], |_| {});
    check(&device, &[], &["input 0..4"]);
    let refused = plan(&device, cost(), &[])[0].refused();
    assert_eq!(refused, [span(RegisterTable::Input, 0, 2), span(RegisterTable::Input, 2, 4)]);
    check(&device, &refused[..1], &["input 0", "input 2..4"]);
}

#[test]
fn a_refused_read_is_halved_until_the_one_to_blame_is_alone() {
    let device = device(&(0..16).map(|first| (first, 1)).collect::<Vec<_>>(), |_| {});
    let mut refused = Vec::new();
    let mut refusals = 0;
    // Register 11 does not exist: whatever holds it is refused.
    while let Some(read) = plan(&device, cost(), &refused)
        .into_iter()
        .find(|read| read.points.len() > 1 && read.span.contains(Span::single(RegisterTable::Input, 11)))
    {
        refused.extend(read.refused());
        refusals += 1;
    }
    check(&device, &refused, &["input 0..7", "input 8..9", "input 10", "input 11", "input 12..15"]);
    assert_eq!(refusals, 4);
}

#[test]
fn limits_ranges_and_forbidden_spans_are_kept() {
    let ten: Vec<(u16, u16)> = (0..10).map(|first| (first, 1)).collect();
    check(
        &device(&ten, |wire| wire.limits = Limits { read_registers: 4, ..wire.limits }),
        &[],
        &["input 0..3", "input 4..7", "input 8..9"],
    );
    let forbid = |wire: &mut Wire| {
        wire.forbidden =
            vec![Forbidden { span: span(RegisterTable::Input, 1, 2), reason: "a test says so".into() }];
    };
    check(&device(&[(0, 1), (3, 1)], forbid), &[], &["input 0", "input 3"]);
    let ranges = |wire: &mut Wire| {
        wire.readable = vec![span(RegisterTable::Input, 0, 1), span(RegisterTable::Input, 2, 9)];
    };
    check(&device(&[(0, 1), (1, 1), (2, 1), (3, 1)], ranges), &[], &["input 0..1", "input 2..3"]);
}

#[test]
fn a_value_that_clears_when_read_travels_alone() {
    let mut device = device(&[(0, 1), (1, 1), (2, 1)], |_| {});
    device.points[1].read_clears = true;
    check(&device, &[], &["input 0", "input 1", "input 2"]);
}

#[test]
fn of_a_device_that_is_only_written_to_something_harmless_is_read_to_see_whether_it_is_there() {
    let mut device = device(&[(0, 1), (10, 2), (20, 1)], |_| {});
    device.points.iter_mut().for_each(|point| point.poll = Poll::Never);
    device.points[0].read_clears = true;
    check(&device, &[], &["input 20"]);
    device.wire.readable = vec![span(RegisterTable::Input, 8, 12)];
    check(&device, &[], &["input 10..11"]);
    assert!(plan(&device, cost(), &[])[0].points.is_empty());
    device.points[2].poll = Poll::Slow;
    assert_eq!(plan(&device, cost(), &[])[0].points.len(), 1, "it is polled anyway");
}

#[test]
fn a_value_in_two_places_is_read_from_the_cheaper_one() {
    let mut device = device(&(1..=8).map(|first| (first, 1)).collect::<Vec<_>>(), |_| {});
    for (bit, point) in device.points.iter_mut().enumerate() {
        point.also = Some(Address {
            span: Span::single(RegisterTable::Input, 9),
            bits: crate::engine::address::Bits::new(bit as u8, bit as u8),
        });
    }
    check(&device, &[], &["input 9"]);
}

#[test]
fn of_values_in_two_places_each_is_read_where_it_lies_near_others() {
    // The second place of the first one is far from everything, that of the third one near the last.
    let mut device = device(&[(0, 1), (1, 1), (190, 1), (300, 1)], |_| {});
    let at = |first| Address { span: Span::single(RegisterTable::Input, first), bits: None };
    device.points[0].also = Some(at(500));
    device.points[2].also = Some(at(301));
    check(&device, &[], &["input 0..1", "input 300..301"]);
}

#[test]
fn thousands_of_points_of_one_device_are_planned_at_once() {
    // Looking at each pair of them once is some millions of steps; at all between them, too, a minute's work.
    let coils = (0..2000).map(|first| {
        let at = Address { span: Span::single(RegisterTable::Coil, first), bits: None };
        Point::new(&format!("p{first}"), at, Poll::Fast)
    });
    check(&device_of(coils.collect()), &[], &["coil 0..1999"]);
    let far = device(&(0..4000).map(|at| (at * 16, 1)).collect::<Vec<_>>(), |_| {});
    assert_eq!(plan(&far, cost(), &[]).len(), 4000);
}

/// Whether several points may travel in one read, rule by rule.
fn may_be_one_read(device: &Device, read: &Read, refused: &[Span]) -> bool {
    let wire = &device.wire;
    let limits = wire.limits;
    let limit = if read.span.table().is_bits() { limits.read_bits } else { limits.read_registers };
    let clearing = device.points.iter().filter(|point| point.read_clears).map(|point| point.at.span);
    read.span.count() <= u32::from(limit)
        && (wire.readable.is_empty() || wire.readable.iter().any(|range| range.contains(read.span)))
        && !wire
            .forbidden
            .iter()
            .map(|forbidden| forbidden.span)
            .chain(clearing)
            .any(|span| span.overlaps(read.span))
        && limits.gap.is_none_or(|widest| read.gaps().iter().all(|gap| gap.count() <= u32::from(widest)))
        && !refused.iter().any(|span| read.span.contains(*span))
}

/// Every way to share the points out among reads; the cost of the cheapest that keeps the rules.
fn brute_force(device: &Device, cost: Cost, refused: &[Span]) -> u64 {
    let mut points: Vec<(PointIndex, Address)> =
        device.points.iter().enumerate().map(|(index, point)| (index, point.at)).collect();
    points.sort_by_key(|(index, address)| (address.span, address.bits, *index));
    let cost_of = |read: &Vec<(PointIndex, Address)>| {
        let read = read_of(Poll::Fast, read);
        (read.points.len() == 1 || may_be_one_read(device, &read, refused)).then(|| cost.of_read(read.span))
    };
    let mut shared_out = vec![Vec::new()];
    for point in points {
        shared_out = shared_out
            .into_iter()
            .flat_map(|reads: Vec<Vec<_>>| {
                (0..=reads.len()).map(move |into| {
                    let mut reads = reads.clone();
                    match reads.get_mut(into) {
                        Some(read) => read.push(point),
                        None => reads.push(vec![point]),
                    }
                    reads
                })
            })
            .collect();
    }
    let costs = shared_out.iter().filter_map(|reads| reads.iter().map(cost_of).sum::<Option<u64>>());
    costs.min().expect("reading every point by itself is always possible")
}

/// Where the points of a random device are, and what must be kept.
#[derive(Clone, Debug)]
struct Random {
    is_bits: bool,
    places: Vec<(u16, u16)>,
    limit: u16,
    gap: Option<u16>,
    /// Where one readable range ends and the next one begins; none: everything is readable.
    readable: Vec<u16>,
    forbidden: Option<(u16, u16)>,
    refused: Option<(u16, u16)>,
    clearing: Option<usize>,
}

fn random() -> impl Strategy<Value = Random> {
    (
        any::<bool>(),
        prop::collection::vec((0u16..60, 1u16..4), 1..8),
        4u16..30,
        prop::option::of(0u16..12),
        prop::collection::vec(0u16..60, 0..4),
        prop::option::of((0u16..60, 0u16..4)),
        prop::option::of((0u16..60, 0u16..4)),
        prop::option::of(0usize..12),
    )
        .prop_map(|(is_bits, places, limit, gap, readable, forbidden, refused, clearing)| Random {
            is_bits,
            places,
            limit,
            gap,
            readable,
            forbidden,
            refused,
            clearing,
        })
}

impl Random {
    fn table(&self) -> RegisterTable {
        if self.is_bits { RegisterTable::Coil } else { RegisterTable::Input }
    }

    fn span(&self, (first, more): (u16, u16)) -> Span {
        span(self.table(), first, first + more)
    }

    /// The device, and what it refuses.
    fn device(&self, delay: Duration) -> (Device, Vec<Span>) {
        // Two values never share a register; and of bits each is a value.
        let mut free = 0;
        let mut places = self.places.clone();
        if self.is_bits {
            // As far apart as their bytes make a difference.
            places.iter_mut().for_each(|(first, count)| (*first, *count) = (*first * 9, 1));
        }
        places.sort_unstable();
        places.retain(|(first, count)| {
            *first >= free && {
                free = first + count;
                true
            }
        });
        let far = if self.is_bits { 9 } else { 1 };
        let spans: Vec<Span> = places.iter().map(|(first, count)| self.span((*first, count - 1))).collect();
        let points = spans.iter().enumerate().map(|(index, span)| {
            Point::new(&format!("p{index}"), Address { span: *span, bits: None }, Poll::Fast)
        });
        let mut device = device_of(points.collect());
        if let Some(point) = self.clearing.and_then(|index| device.points.get_mut(index)) {
            point.read_clears = true;
        }
        let wire = &mut device.wire;
        (wire.limits.read_registers, wire.limits.read_bits) = (self.limit, self.limit * far);
        wire.limits.gap = self.gap.map(|gap| gap * far);
        wire.limits.delay = delay;
        // What lies in two ranges is a value by itself, as it is for the profile's check.
        let mut ends = self.readable.clone();
        ends.sort_unstable();
        ends.dedup();
        wire.readable = ends
            .iter()
            .zip(ends.iter().skip(1).chain([&70]))
            .map(|(first, next)| span(self.table(), first * far, next * far - 1))
            .collect();
        // The profile's check refuses points inside a forbidden span, so only what is free is forbidden.
        let far_span = |(first, more): (u16, u16)| self.span((first * far, more * far));
        wire.forbidden = self
            .forbidden
            .map(far_span)
            .into_iter()
            .filter(|forbidden| !spans.iter().any(|span| span.overlaps(*forbidden)))
            .map(|span| Forbidden { span, reason: String::new() })
            .collect();
        (device, self.refused.map(far_span).into_iter().collect())
    }
}

proptest! {
    #[test]
    fn no_plan_is_cheaper_and_each_point_is_read_once(
        random in random(),
        turnaround in 0u64..80,
        delay in prop_oneof![Just(0u64), 1u64..100],
        others in 0usize..4,
    ) {
        let (device, refused) = random.device(Duration::from_millis(delay));
        // On a line with others that are asked meanwhile a pause costs less.
        let other = self::device(&[(0, 10)], |_| {});
        let on_bus: Vec<&Device> = std::iter::once(&device).chain(std::iter::repeat_n(&other, others)).collect();
        let tariff = Tariff::of_line(LINE, LINE.frame_gap());
        let idle_rest = tariff.idle_rests(&on_bus)[0];
        prop_assert_eq!(idle_rest == device.wire.limits.delay, others == 0 || delay == 0);
        let cost = tariff.cost(Duration::from_millis(turnaround) + idle_rest);
        let reads = plan(&device, cost, &refused);
        prop_assert_eq!(total(&reads, cost), brute_force(&device, cost, &refused));
        let mut read_points: Vec<PointIndex> =
            reads.iter().flat_map(|read| read.points.iter().map(|(point, _)| *point)).collect();
        read_points.sort_unstable();
        prop_assert_eq!(read_points, (0..device.points.len()).collect::<Vec<_>>());
        for read in &reads {
            prop_assert!(read.points.iter().all(|(_, address)| read.span.contains(address.span)));
            prop_assert!(read.points.len() == 1 || may_be_one_read(&device, read, &refused));
            prop_assert!(!device.wire.forbidden.iter().any(|forbidden| forbidden.span.overlaps(read.span)));
        }
    }
}

/// What the cheapest reads of all combinations of places cost. Points that stand side by side in both places are moved
/// together; `None` where a poll class has more than `most_runs` of such, which are too many to try.
///
/// No read serves two poll classes, so that the best of all is the sum of the best of each.
fn best_of_all_second_places(device: &Device, cost: Cost, most_runs: usize) -> Option<u64> {
    let best_of = |poll| {
        let mut only_this = device.clone();
        for point in only_this.points.iter_mut().filter(|point| point.poll != poll) {
            point.poll = Poll::Never;
        }
        best_of_class(&only_this, poll, cost, most_runs)
    };
    [Poll::Fast, Poll::Slow, Poll::Once].into_iter().map(best_of).sum()
}

fn best_of_class(device: &Device, poll: Poll, cost: Cost, most_runs: usize) -> Option<u64> {
    let mut runs: Vec<Vec<PointIndex>> = Vec::new();
    for (index, point) in device.points.iter().enumerate().filter(|(_, point)| point.poll == poll) {
        let Some(also) = point.also else { continue };
        let is_beside = |last: &PointIndex| {
            let before = &device.points[*last];
            let first = |address: Address| (address.span.table(), address.span.first());
            let step = |before: Address, next: Address| {
                first(before).0 == first(next).0
                    && first(before).1.abs_diff(first(next).1) <= before.span.count() as u16
            };
            step(before.at, point.at) && before.also.is_some_and(|before| step(before, also))
        };
        match runs.last_mut() {
            Some(run) if run.last().is_some_and(is_beside) => run.push(index),
            _ => runs.push(vec![index]),
        }
    }
    if runs.len() > most_runs {
        return None;
    }
    let costs = (0u32..1 << runs.len()).map(|chosen| {
        let mut places: Vec<Address> = device.points.iter().map(|point| point.at).collect();
        for index in
            runs.iter().enumerate().filter(|(number, _)| chosen & 1 << number != 0).flat_map(|(_, run)| run)
        {
            places[*index] = device.points[*index].also.expect("it has one");
        }
        total(&plan_at(device, &places, cost, &[]), cost)
    });
    costs.min()
}

#[test]
fn of_every_shipped_device_the_second_places_are_chosen_best() {
    let library = crate::engine::profile::Library::shipped();
    let mut looked_at = 0;
    for id in library.ids() {
        let device = library.load(id).expect("a good profile");
        for baud in [9_600, 19_200, 115_200] {
            for turnaround in [1, 5, 40] {
                let line = Line { baud, ..LINE };
                let cost = Tariff::of_line(line, line.frame_gap()).cost(Duration::from_millis(turnaround));
                // Thousands of combinations are looked at once only.
                let most_runs = if (baud, turnaround) == (19_200, 5) { 12 } else { 8 };
                let Some(best) = best_of_all_second_places(&device, cost, most_runs) else { continue };
                let found = total(&plan(&device, cost, &[]), cost);
                assert_eq!(found, best, "{id} at {baud}, {turnaround} ms");
                looked_at += usize::from(device.points.iter().any(|point| point.also.is_some()));
            }
        }
    }
    // Of all devices that have any, two are too large for most settings.
    assert!(looked_at > 10 * 9, "{looked_at}");
}
