//! How often EEPROM may be written: a point not more than once in an interval, a device not more often
//! in a day than its budget, whatever a script does.

use std::collections::BTreeMap;

use crate::engine::device::PointIndex;
use crate::engine::settings::Eeprom;
use crate::engine::time::{Duration, Time};

const DAY: u64 = 24 * 3600 * 1_000_000;
/// What a write takes out of the budget.
const WRITE: u64 = 2 * DAY;

/// The writes of one device's persistent points.
#[derive(Clone, Debug)]
pub(super) struct Wear {
    rules: Eeprom,
    account: Account,
    /// While points are being written: how the account was before, and how many they are.
    writing: Option<(Account, u64)>,
    /// The points of which a value waits until they may be written again.
    pub(super) waiting: Vec<PointIndex>,
}

/// What writes have taken.
#[derive(Clone, Debug)]
struct Account {
    written_at: BTreeMap<PointIndex, Time>,
    /// What is left of the budget. Half of a day's writes fit into it, and half of them come in during a
    /// day, a little each microsecond: so no 24 hours see more than the whole, and no clock is needed
    /// that tells when a day begins.
    left: u64,
    left_at: Time,
}

impl Wear {
    /// A device that may be written as often as its `rules` say.
    pub(super) fn new(rules: Eeprom) -> Wear {
        let (left, left_at) = (Wear::full(rules), Time::default());
        let account = Account { written_at: BTreeMap::new(), left, left_at };
        Wear { rules, account, writing: None, waiting: Vec::new() }
    }

    fn full(rules: Eeprom) -> u64 {
        u64::from(rules.daily) * DAY
    }

    /// Goes on with so many writes taken out of the budget, after a restart. (What is left would not do: the
    /// budget may be another one by then.) When the points were written lately nobody knows any more: at most now.
    pub(super) fn recall(&mut self, now: Time, writes_spent: u32, lately: impl Iterator<Item = PointIndex>) {
        self.account.left = Wear::full(self.rules).saturating_sub(u64::from(writes_spent) * WRITE);
        self.account.left_at = now;
        self.account.written_at = lately.map(|point| (point, now)).collect();
    }

    /// Goes on by other rules. What was written stays written.
    pub(super) fn change_rules(&mut self, now: Time, rules: Eeprom) {
        let before = std::mem::replace(&mut self.rules, rules);
        let (full, other) = (Wear::full(before), Wear::full(rules));
        for account in self.writing.iter_mut().map(|(account, _)| account).chain([&mut self.account]) {
            let spent = full - account.left(before, now);
            (account.left, account.left_at) = (other.saturating_sub(spent), now);
        }
    }

    /// The point is being written, perhaps with others.
    pub(super) fn spend(&mut self, now: Time, point: PointIndex) {
        match &mut self.writing {
            Some((_, points)) => *points += 1,
            none => *none = Some((self.account.clone(), 1)),
        }
        let left = self.account.left(self.rules, now).saturating_sub(WRITE);
        self.account.written_at.insert(point, now);
        (self.account.left, self.account.left_at) = (left, now);
    }

    /// The write has ended; how many points' EEPROM it wore out. One that the device has not carried out was none.
    pub(super) fn end(&mut self, is_carried_out: bool) -> u64 {
        match self.writing.take() {
            Some((before, _)) if !is_carried_out => {
                self.account = before;
                0
            }
            Some((_, points)) => points,
            None => 0,
        }
    }

    /// From when on the point may be written, as far as its own interval goes.
    pub(super) fn allowed_at(&self, point: PointIndex) -> Time {
        self.account.written_at.get(&point).map_or(Time::default(), |at| *at + self.rules.interval)
    }

    /// From when on the device's budget allows another write.
    pub(super) fn budget_at(&self) -> Time {
        let missing = WRITE.saturating_sub(self.account.left);
        self.account.left_at + Duration::from_micros(missing.div_ceil(u64::from(self.rules.daily.max(1))))
    }

    /// Why nothing may be written now: the budget is spent.
    pub(super) fn spent(&self, now: Time) -> Option<String> {
        let until = self.budget_at();
        (now < until).then(|| {
            format!(
                "the EEPROM budget of this device is spent (`eeprom: {{daily: {}}}`: half of them at once, the \
                 others as the day goes on); the next write may come in {} s",
                self.rules.daily,
                (until - now).as_secs() + 1
            )
        })
    }

    /// Why nothing will be written until `then`, as far as that can be known: a write that is under way may turn out
    /// to be none.
    pub(super) fn spent_until(&self, now: Time, then: Time) -> Option<String> {
        let is_known = self.writing.is_none() && self.budget_at() > then;
        if is_known { self.spent(now) } else { None }
    }

    /// How many writes have been taken out of the budget, and have not come in again.
    pub(super) fn writes_spent(&self, now: Time) -> u32 {
        (Wear::full(self.rules) - self.account.left(self.rules, now)).div_ceil(WRITE) as u32
    }
}

impl Account {
    /// What is left of the budget now.
    fn left(&self, rules: Eeprom, now: Time) -> u64 {
        let passed = now.since(self.left_at).as_micros() as u64;
        let refilled = passed.saturating_mul(u64::from(rules.daily));
        self.left.saturating_add(refilled).min(Wear::full(rules))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RULES: Eeprom = Eeprom { interval: Duration::from_secs(60), daily: 200 };

    /// How often a script that never rests can write in so many hours.
    fn writes_in(hours: u64, points: usize, wear: &mut Wear) -> u32 {
        let mut writes = 0;
        for second in 0..hours * 3600 {
            let now = Time::from_millis(second * 1000);
            for point in 0..points {
                if now >= wear.allowed_at(point) && wear.spent(now).is_none() {
                    wear.spend(now, point);
                    writes += wear.end(true) as u32;
                }
            }
        }
        writes
    }

    #[test]
    fn a_point_is_written_once_in_its_interval() {
        assert_eq!(writes_in(1, 1, &mut Wear::new(RULES)), 60);
        let free = Eeprom { interval: Duration::ZERO, daily: 10_000 };
        assert_eq!(writes_in(1, 1, &mut Wear::new(free)), 3600);
    }

    #[test]
    fn a_device_is_written_as_often_as_its_budget_says_and_then_as_it_fills_again() {
        // Half of the budget at once, and the other half as it comes in.
        assert_eq!(writes_in(24, 20, &mut Wear::new(RULES)), 200 - 1);
        let mut wear = Wear::new(RULES);
        wear.recall(Time::default(), 100 - 3, [].into_iter());
        let writes = writes_in(1, 20, &mut wear);
        assert_eq!(writes, 3 + 100 / 24);
        let now = Time::from_millis(3_600_000);
        assert_eq!(wear.writes_spent(now), 100);
        let told = wear.spent(now).expect("nothing is left");
        assert!(told.contains("`eeprom: {daily: 200}`") && told.contains("may come in "), "{told}");
        assert!(wear.spent(wear.budget_at()).is_none());
    }

    #[test]
    fn a_budget_that_is_changed_is_less_by_what_was_written() {
        let writes_at_once = |daily: u32| {
            let mut few = Wear::new(Eeprom { daily: 8, ..RULES });
            for point in 0..4 {
                few.spend(Time::default(), point);
            }
            assert!(few.spent(Time::default()).is_some(), "half of 8 are written");
            let mut changed = Wear::new(Eeprom { daily, ..RULES });
            changed.recall(Time::default(), few.writes_spent(Time::default()), [].into_iter());
            let mut writes = 0;
            while changed.spent(Time::default()).is_none() {
                changed.spend(Time::default(), writes);
                writes += 1;
            }
            writes
        };
        assert_eq!([8, 500, 20, 4].map(writes_at_once), [0, 246, 6, 0]);
    }

    #[test]
    fn what_begins_anew_late_has_no_more_left_for_that_and_spares_the_same_points() {
        let now = Time::from_millis(30 * 24 * 3_600_000);
        let mut wear = Wear::new(RULES);
        wear.recall(now, 100, [3].into_iter());
        assert!(wear.spent(now).is_some());
        assert_eq!([3, 4].map(|point| wear.allowed_at(point)), [now + RULES.interval, Time::default()]);
    }

    #[test]
    fn rules_that_change_on_the_way_leave_what_was_written() {
        let at = |seconds: u64| Time::from_millis(seconds * 1000);
        let mut wear = Wear::new(Eeprom { daily: 8, ..RULES });
        for point in 0..4 {
            wear.spend(at(0), point);
            assert_eq!(wear.end(true), 1);
        }
        // A quarter of a day brings a quarter of the day's second half.
        let now = at(6 * 3600);
        wear.change_rules(now, Eeprom { interval: Duration::from_secs(7 * 3600), daily: 500 });
        assert_eq!((wear.writes_spent(now), wear.allowed_at(1)), (3, at(7 * 3600)));
        // Again and again: nothing is lost by it, and nothing gained.
        for _ in 0..9 {
            wear.change_rules(now, Eeprom { daily: 8, ..RULES });
            assert_eq!((wear.writes_spent(now), wear.spent(now)), (3, None));
            wear.change_rules(now, RULES);
        }
        // One that is under way may still be none.
        wear.spend(now, 9);
        wear.change_rules(now, Eeprom { daily: 8, ..RULES });
        assert_eq!((wear.writes_spent(now), wear.end(false)), (4, 0));
        assert_eq!((wear.writes_spent(now), wear.allowed_at(9)), (3, Time::default()));
    }

    #[test]
    fn that_nothing_is_left_is_known_before_as_far_as_it_can_be_known() {
        let mut wear = Wear::new(Eeprom { daily: 2, ..RULES });
        let now = Time::default();
        wear.spend(now, 1);
        let full = wear.budget_at();
        assert_eq!(wear.spent_until(now, now), None, "the device may be too busy for it");
        wear.end(true);
        assert_eq!(full, now + Duration::from_secs(24 * 3600));
        assert_eq!(wear.spent_until(now, full), None);
        assert_eq!(wear.spent_until(now, Time(full.0 - 1)), wear.spent(now));
    }

    #[test]
    fn what_the_device_did_not_do_wears_nothing() {
        let mut wear = Wear::new(RULES);
        let at = |seconds: u64| Time::from_millis(seconds * 1000);
        wear.spend(at(5), 1);
        assert_eq!(wear.end(true), 1);
        let before = wear.clone();
        for point in [1, 2] {
            wear.spend(at(100), point);
        }
        assert_eq!((wear.allowed_at(1), wear.writes_spent(at(100))), (at(160), 3));
        wear.waiting = vec![7];
        assert_eq!(wear.end(false), 0);
        assert_eq!((wear.allowed_at(1), wear.allowed_at(2)), (at(65), Time::default()));
        assert_eq!(wear.writes_spent(at(100)), before.writes_spent(at(100)));
        assert_eq!(wear.waiting, [7], "what came meanwhile is kept");
        assert_eq!(wear.end(true), 0, "nothing is being written");
    }
}
