//! A device's points to the cheapest safe reads.
//!
//! Within one poll class and one table the points are sorted by address, and a dynamic programme
//! finds where to cut: a second request costs its frames, the silence and the device's turnaround;
//! reading over a gap costs its bytes. No cut and no read breaks a limit, leaves a readable range,
//! touches a forbidden span, splits a value, or holds what the device once refused to give in one.

use std::fmt;

use crate::engine::address::{self, Address, Span};
use crate::engine::device::{Device, PointIndex, Poll};
use crate::engine::settings::{Line, Link};
use crate::engine::time::Duration;

/// One read and what it is for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Read {
    pub poll: Poll,
    pub span: Span,
    /// The points in it, by address, each with the place from which this read takes it. None where it only asks whether
    /// the device is there.
    pub points: Vec<(PointIndex, Address)>,
    /// Reading it changes the device, so nothing else travels with it.
    pub alone: bool,
}

impl Read {
    /// What to hold against this read when the device has refused it. Read over gaps, each gap is
    /// suspect; without gaps the span is halved, so that a few refusals find the one point to blame.
    /// Empty for a single value: there is nothing to divide.
    pub fn refused(&self) -> Vec<Span> {
        let across = |before: Address, after: Address| {
            Span::new(self.span.table(), before.span.last(), after.span.first().max(before.span.last()))
        };
        let neighbours = || self.points.windows(2).map(|pair| (pair[0].1, pair[1].1));
        let distinct = |(before, after): &(Address, Address)| before.span.last() < after.span.first();
        let over_gaps: Vec<Span> = neighbours()
            .filter(|(before, after)| u32::from(before.span.last()) + 1 < u32::from(after.span.first()))
            .filter_map(|(before, after)| across(before, after))
            .collect();
        if !over_gaps.is_empty() {
            return over_gaps;
        }
        let boundaries: Vec<(Address, Address)> = neighbours().filter(distinct).collect();
        let middle = boundaries.get(boundaries.len() / 2);
        middle.and_then(|(before, after)| across(*before, *after)).into_iter().collect()
    }

    /// The points that decide whether this read is sent: it is not while none of its points lives.
    /// Empty if one of them always does.
    pub fn sleeps_by(&self, device: &Device) -> Vec<PointIndex> {
        let conditions = || self.points.iter().map(|(point, _)| &device.points[*point].when);
        if conditions().any(Vec::is_empty) {
            return Vec::new();
        }
        let mut deciding: Vec<PointIndex> = conditions().flatten().map(|condition| condition.point).collect();
        deciding.sort_unstable();
        deciding.dedup();
        deciding
    }

    /// The runs of addresses inside the span that no point needs.
    pub fn gaps(&self) -> Vec<Span> {
        let mut gaps = Vec::new();
        let mut next = u32::from(self.span.first());
        for (_, address) in &self.points {
            let first = u32::from(address.span.first());
            if first > next {
                gaps.extend(Span::new(self.span.table(), next as u16, (first - 1) as u16));
            }
            next = next.max(u32::from(address.span.last()) + 1);
        }
        gaps
    }
}

/// What a bus charges, whichever device is asked; in nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tariff {
    /// Everything about a read but its data and the device's turnaround: both frames' other characters,
    /// and the silence before them.
    request: u64,
    /// Each byte of data.
    byte: u64,
}

impl Tariff {
    pub fn of(link: &Link, gap: Option<Duration>) -> Tariff {
        match link.line() {
            Some(line) => Tariff::of_line(line, gap.unwrap_or_else(|| line.frame_gap())),
            // A round trip costs as much as some hundred registers.
            None => Tariff { request: 500_000, byte: 1000 },
        }
    }

    fn of_line(line: Line, gap: Duration) -> Tariff {
        // Request: unit, function, address, count, checksum. Answer: unit, function, count, checksum.
        let request = line.characters(8 + 5) + gap;
        Tariff { request: request.as_nanos() as u64, byte: line.characters(1).as_nanos() as u64 }
    }

    /// With a device that takes `turnaround` to begin its answer.
    pub fn cost(self, turnaround: Duration) -> Cost {
        Cost { request: self.request + turnaround.as_nanos() as u64, byte: self.byte }
    }

    /// What a request to such a device takes. On Modbus TCP that is the round trip, whatever it brings: what else
    /// a request is charged there when reads are cut is the work that it makes on both sides.
    pub fn taken(self, link: &Link, turnaround: Duration) -> Cost {
        match link.line() {
            Some(_) => self.cost(turnaround),
            None => Cost { request: turnaround.as_nanos() as u64, byte: 0 },
        }
    }

    /// Of the silence that each of these devices wants before it is asked again (`delay`), the part that nobody
    /// else on their bus makes use of: it is lost with each request, as if the device took that much longer to
    /// answer. A device that has the line for itself loses all of it, one among others that keep the line
    /// busy none.
    pub fn idle_rests(self, devices: &[&Device]) -> Vec<Duration> {
        let rest = |device: &Device| device.wire.limits.delay;
        if devices.iter().all(|device| rest(device).is_zero()) {
            return vec![Duration::ZERO; devices.len()];
        }
        let cost = self.cost(USUAL_TURNAROUND);
        let loads: Vec<f64> = devices.iter().map(|device| load(device, cost)).collect();
        let idle = |own: usize| {
            let others = loads.iter().enumerate().filter(|(other, _)| *other != own).map(|(_, load)| load);
            (1.0 - others.sum::<f64>()).max(0.0)
        };
        devices.iter().enumerate().map(|(own, device)| rest(device).mul_f64(idle(own))).collect()
    }
}

/// Seconds of wire that the polls of a device want in a second.
fn load(device: &Device, cost: Cost) -> f64 {
    let intervals = &device.wire.intervals;
    let of_read = |read: &Read| {
        let period = match read.poll {
            Poll::Fast => intervals.fast,
            Poll::Slow => intervals.slow,
            Poll::Once | Poll::Never => return 0.0,
        };
        cost.time_of(read.span).as_secs_f64() / period.as_secs_f64().max(1e-6)
    };
    plan(device, cost, &[]).iter().map(of_read).sum()
}

/// What a read of one device costs, in nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cost {
    /// Everything about a request but its data: both frames' other characters, the silence before
    /// them, the device's turnaround.
    pub request: u64,
    /// Each byte of data.
    pub byte: u64,
}

impl Cost {
    /// How long reading `span` takes.
    pub fn of_read(self, span: Span) -> u64 {
        self.request + u64::from(data_bytes(span)) * self.byte
    }

    /// The same as a time.
    pub fn time_of(self, span: Span) -> Duration {
        Duration::from_nanos(self.of_read(span))
    }
}

/// So many times as slow, or as quick, as it was planned with, and a device's reads are planned anew.
const FAR: u32 = 2;

/// Whether a device is so much slower or quicker that another plan may be better.
pub fn is_far(turnaround: Duration, planned_with: Duration) -> bool {
    turnaround > planned_with * FAR || turnaround * FAR < planned_with
}

/// The turnaround for which the reads of a device that needs `turnaround` are planned, once it is known.
pub fn planned_with(turnaround: Duration) -> Duration {
    if is_far(turnaround, USUAL_TURNAROUND) { turnaround } else { USUAL_TURNAROUND }
}

/// The bytes of data in the answer to a read of `span`.
pub fn data_bytes(span: Span) -> u32 {
    if span.table().is_bits() { span.count().div_ceil(8) } else { span.count() * 2 }
}

/// What most devices need to begin their answer; the real one is known only on the wire.
pub const USUAL_TURNAROUND: Duration = Duration::from_millis(5);

/// The cheapest safe reads of `device`, by poll class, table and address. `refused` are spans that
/// the device has refused to give in one answer ([`Read::refused`]): no read of several points
/// contains one.
///
/// A device that is only ever written to has one read for no point: whatever it answers, it is there.
pub fn plan(device: &Device, cost: Cost, refused: &[Span]) -> Vec<Read> {
    let reads = of_what_is_polled(device, cost, refused);
    if reads.is_empty() { sign_of_life(device).into_iter().collect() } else { reads }
}

fn sign_of_life(device: &Device) -> Option<Read> {
    let harmless = device.points.iter().filter(|point| !point.read_clears);
    let readable = &device.wire.readable;
    // Outside of what it gives it may say nothing at all.
    let is_given = |span: Span| readable.is_empty() || readable.iter().any(|range| range.contains(span));
    let shortest = harmless.map(|point| point.at.span).min_by_key(|span| (!is_given(*span), span.count()));
    shortest.map(|span| Read { poll: Poll::Slow, span, points: Vec::new(), alone: false })
}

fn of_what_is_polled(device: &Device, cost: Cost, refused: &[Span]) -> Vec<Read> {
    let mut places: Vec<Address> = device.points.iter().map(|point| point.at).collect();
    let mut best = plan_at(device, &places, cost, refused);
    // The same value may stand in two places (relay states as coils and as bits of a register), and the places of
    // one decide which are best for others: so all that have the same two tables are moved, what lies side by side in
    // both, and each by itself, until nothing of it makes the reads cheaper.
    let moves = moves_to_second_places(device);
    loop {
        let before = total(&best, cost);
        for moved in &moves {
            let mut elsewhere = places.clone();
            for index in moved {
                let point = &device.points[*index];
                let Some(also) = point.also else { continue };
                elsewhere[*index] = if places[*index] == also { point.at } else { also };
            }
            let candidate = plan_at(device, &elsewhere, cost, refused);
            if total(&candidate, cost) < total(&best, cost) {
                (best, places) = (candidate, elsewhere);
            }
        }
        if total(&best, cost) == before {
            return best;
        }
    }
}

fn total(reads: &[Read], cost: Cost) -> u64 {
    reads.iter().map(|read| cost.of_read(read.span)).sum()
}

/// Sets of points with a second place that are worth moving there together.
fn moves_to_second_places(device: &Device) -> Vec<Vec<PointIndex>> {
    let seconds =
        || device.points.iter().enumerate().filter_map(|(index, point)| Some((index, point, point.also?)));
    let mut groups: Vec<(_, Vec<PointIndex>)> = Vec::new();
    let mut runs: Vec<Vec<PointIndex>> = Vec::new();
    for (index, point, also) in seconds() {
        let key = (point.poll, point.at.span.table(), also.span.table());
        match groups.iter_mut().find(|(other, _)| *other == key) {
            Some((_, members)) => members.push(index),
            None => groups.push((key, vec![index])),
        }
        let is_beside = |last: &PointIndex| {
            let before = &device.points[*last];
            before.poll == point.poll
                && adjoin(before.at.span, point.at.span)
                && before.also.is_some_and(|before| adjoin(before.span, also.span))
        };
        match runs.last_mut() {
            Some(run) if run.last().is_some_and(is_beside) => run.push(index),
            _ => runs.push(vec![index]),
        }
    }
    let mut moves: Vec<Vec<PointIndex>> = groups.into_iter().map(|(_, members)| members).collect();
    moves.extend(runs);
    moves.extend(seconds().map(|(index, ..)| vec![index]));
    moves.sort_by_key(|moved| std::cmp::Reverse(moved.len()));
    moves.dedup();
    moves
}

/// Whether one of them begins where the other ends, or in it.
fn adjoin(one: Span, other: Span) -> bool {
    let (first, second) = if one.first() <= other.first() { (one, other) } else { (other, one) };
    one.table() == other.table() && u32::from(second.first()) <= u32::from(first.last()) + 1
}

fn plan_at(device: &Device, places: &[Address], cost: Cost, refused: &[Span]) -> Vec<Read> {
    let mut reads = Vec::new();
    for poll in [Poll::Fast, Poll::Slow, Poll::Once] {
        let mut wanted: Vec<(PointIndex, Address)> = (0..device.points.len())
            .filter(|index| device.points[*index].poll == poll)
            .map(|index| (index, places[index]))
            .collect();
        wanted.sort_by_key(|(index, address)| (address.span, address.bits, *index));
        let (alone, together): (Vec<_>, Vec<_>) =
            wanted.into_iter().partition(|(index, _)| device.points[*index].read_clears);
        let mut of_class = together_by_span(poll, alone, true);
        for table in address::Table::ALL {
            let of_table: Vec<_> =
                together.iter().copied().filter(|(_, address)| address.span.table() == table).collect();
            of_class.extend(cut(device, poll, &of_table, cost, refused));
        }
        of_class.sort_by_key(|read| read.span);
        reads.extend(of_class);
    }
    reads
}

/// Points whose reading changes the device: one read for each span, shared only by fields of the
/// same register.
fn together_by_span(poll: Poll, points: Vec<(PointIndex, Address)>, alone: bool) -> Vec<Read> {
    let mut reads: Vec<Read> = Vec::new();
    for (index, address) in points {
        match reads.last_mut() {
            Some(read) if read.span == address.span => read.points.push((index, address)),
            _ => reads.push(Read { poll, span: address.span, points: vec![(index, address)], alone }),
        }
    }
    reads
}

/// The cheapest partition of sorted points of one table: `cheapest[end]` is the cost of reading the
/// first `end` points, and where the last of those reads begins.
///
/// A read only grows from point to point, and what forbids it forbids each longer one: so each beginning
/// looks no further than that, and a device with thousands of points is planned in no time.
fn cut(
    device: &Device,
    poll: Poll,
    points: &[(PointIndex, Address)],
    cost: Cost,
    refused: &[Span],
) -> Vec<Read> {
    let Some((_, first)) = points.first() else { return Vec::new() };
    let rules = Rules::of(device, first.span.table(), refused);
    let mut cheapest: Vec<(u64, usize)> = vec![(u64::MAX, 0); points.len() + 1];
    cheapest[0] = (0, 0);
    for begin in 0..points.len() {
        let mut span = points[begin].1.span;
        for end in begin + 1..=points.len() {
            let next = points[end - 1].1.span;
            // The points are sorted, so that no later one closes this gap.
            let gap = u32::from(next.first()).saturating_sub(u32::from(span.last()) + 1);
            span = span.hull(next).unwrap_or(span);
            let is_single = end == begin + 1;
            if !is_single && !rules.allow(span, gap) {
                break;
            }
            let total = cheapest[begin].0.saturating_add(cost.of_read(span));
            if total <= cheapest[end].0 {
                cheapest[end] = (total, begin);
            }
        }
    }
    let mut reads = Vec::new();
    let mut end = points.len();
    while end > 0 {
        let begin = cheapest[end].1;
        reads.push(read_of(poll, &points[begin..end]));
        end = begin;
    }
    reads.reverse();
    reads
}

fn read_of(poll: Poll, points: &[(PointIndex, Address)]) -> Read {
    let mut span = points[0].1.span;
    for (_, address) in points {
        span = span.hull(address.span).unwrap_or(span);
    }
    Read { poll, span, points: points.to_vec(), alone: false }
}

/// What several points of one table must keep to travel in one read. (A single one always may: the profile's
/// check has seen to that.)
struct Rules<'d> {
    limit: u32,
    widest_gap: Option<u32>,
    /// A read lies within one of them, if there are any in the profile.
    readable: Option<Vec<Span>>,
    /// No read touches one.
    untouchable: Vec<Span>,
    /// No read holds one as a whole.
    refused: &'d [Span],
}

impl<'d> Rules<'d> {
    fn of(device: &Device, table: address::Table, refused: &'d [Span]) -> Rules<'d> {
        let wire = &device.wire;
        let of_table = |span: &Span| span.table() == table;
        let forbidden = wire.forbidden.iter().map(|forbidden| forbidden.span);
        let clearing = device.points.iter().filter(|point| point.read_clears).map(|point| point.at.span);
        let limits = &wire.limits;
        Rules {
            limit: u32::from(if table.is_bits() { limits.read_bits } else { limits.read_registers }),
            widest_gap: limits.gap.map(u32::from),
            readable: (!wire.readable.is_empty())
                .then(|| wire.readable.iter().copied().filter(of_table).collect()),
            untouchable: forbidden.chain(clearing).filter(of_table).collect(),
            refused,
        }
    }

    /// `gap`: the unused addresses before its last point; those before the others were allowed.
    fn allow(&self, read: Span, gap: u32) -> bool {
        read.count() <= self.limit
            && self.widest_gap.is_none_or(|widest| gap <= widest)
            && self.readable.as_ref().is_none_or(|ranges| ranges.iter().any(|range| range.contains(read)))
            && !self.untouchable.iter().any(|span| span.overlaps(read))
            && !self.refused.iter().any(|span| read.contains(*span))
    }
}

/// The plan as a table for people, a line a read.
pub struct Table<'p> {
    pub device: &'p Device,
    pub reads: &'p [Read],
}

impl fmt::Display for Table<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for read in self.reads {
            let unit = if read.span.table().is_bits() { "bits" } else { "regs" };
            let range = format!("{}..{}", read.span.first(), read.span.last());
            write!(f, "{:5} {:9}", read.poll.name(), read.span.table())?;
            write!(f, "{range:>13} {:>4} {unit}  ", read.span.count())?;
            let name = |index: usize| self.device.points[read.points[index].0].name.as_str();
            match read.points.len() {
                0 => write!(f, "whether it is there")?,
                1 => write!(f, "{}", name(0))?,
                count => write!(f, "{} .. {} ({count})", name(0), name(count - 1))?,
            }
            write!(f, "{}", if read.alone { "  alone: reading changes it" } else { "" })?;
            let deciding = read.sleeps_by(self.device);
            let name = |at: usize| self.device.points[deciding[at]].name.as_str();
            match deciding.len() {
                0 => {}
                1 => write!(f, "  only while {} allows it", name(0))?,
                2 => write!(f, "  only while {} or {} allows it", name(0), name(1))?,
                count => write!(f, "  only while {} .. {} allow it", name(0), name(count - 1))?,
            }
            writeln!(f)?;
        }
        Ok(())
    }
}

#[cfg(test)]
#[path = "plan_tests.rs"]
mod tests;
