//! How often EEPROM may be written: freely while a person sets a device up, and then
//! once a minute, whatever a script does.

use std::collections::BTreeMap;

use crate::engine::device::PointIndex;
use crate::engine::time::{Duration, Time};

/// So many writes of a point may follow one another.
const BURST: u32 = 20;
/// After them, one in this time. A register of 100,000 writes lasts 70 days of the worst script.
const INTERVAL: Duration = Duration::from_secs(60);

/// The writes of one device's persistent points.
#[derive(Clone, Debug, Default)]
pub(super) struct Wear {
    /// When as many writes as there were would have been due, one in each interval.
    due: BTreeMap<PointIndex, Time>,
}

impl Wear {
    /// The point is being written.
    pub(super) fn spend(&mut self, now: Time, point: PointIndex) {
        let due = self.due.entry(point).or_default();
        *due = (*due).max(now) + INTERVAL;
    }

    /// From when on the point may be written.
    pub(super) fn allowed_at(&self, point: PointIndex) -> Time {
        let ahead = INTERVAL * (BURST - 1);
        let due = self.due.get(&point).copied().unwrap_or_default();
        Time(due.0.saturating_sub(ahead.as_micros() as u64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_few_writes_are_free_and_a_flood_is_not() {
        let mut wear = Wear::default();
        let mut now = Time::from_millis(0);
        let mut writes = 0;
        while now < Time::from_millis(3_600_000) {
            if now >= wear.allowed_at(7) {
                wear.spend(now, 7);
                writes += 1;
            }
            now += Duration::from_millis(100);
        }
        assert_eq!(writes, BURST + 59);
        assert_eq!(wear.allowed_at(8), Time::default());
    }
}
