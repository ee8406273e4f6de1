//! The time by which a bus gives its reads their turns: the clock's where it keeps up, and a slower one where it does
//! not.
//!
//! With each turn of a read this time goes on by as much as there is, on average, from one wanted read to the next. So
//! it goes on by a read's period whenever the bus has given as many turns as should fall into one, and who has one turn
//! in each period of this time has its fair share, whatever the requests cost: every period is stretched by the same
//! factor. It stands still while no read has a turn, so that nobody makes up for a silence in which all have waited.

use crate::engine::time::{Duration, Time};

/// The time of one bus.
#[derive(Clone, Copy, Debug)]
pub struct Pace {
    /// Where it stands, or stood when the bus had nothing to do any more.
    time: Time,
    /// By how much it may go on faster, since requests have taken longer than it went on meanwhile.
    owed: Duration,
    /// When nothing was due, if ever, and where it stood then.
    idle: Option<(Time, Time)>,
    /// And nothing has begun since: so long it goes with the clock.
    is_idle: bool,
    /// How many reads a second are wanted of the bus.
    wanted: f64,
    /// By this time nothing is due, and what will be next may have its turn.
    lets_ahead: bool,
    /// By how much periods are longer than they should be, on average.
    stretch: f64,
}

/// One moment, by the clock and by the bus's time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Moment {
    pub now: Time,
    /// By the bus's time.
    pub turns: Time,
    /// What is due until then, in the bus's time, may have its turn.
    pub until: Time,
}

impl Default for Pace {
    fn default() -> Pace {
        let nothing = Duration::ZERO;
        let (time, idle) = (Time::default(), None);
        Pace { time, owed: nothing, idle, is_idle: false, wanted: 0.0, lets_ahead: false, stretch: 1.0 }
    }
}

impl Pace {
    /// Each turn moves the average by this part of itself.
    const STEP: f64 = 1.0 / 32.0;
    /// Less than this is what comes and goes on a bus that keeps up.
    const BEHIND: f64 = 1.1;
    /// The longest request at 4800 Bd takes as long: what is wanted more often meanwhile has its turns behind it.
    const OWED_MOST: Duration = Duration::from_millis(600);
    /// What keeps a read behind for more of its periods is its device's own affair, such as the silence that it wants.
    const BEHIND_MOST: u32 = 2;
    /// A bus that had nothing to do within this time keeps up, whatever has kept it since.
    const KEEPS_UP: Duration = Duration::from_secs(2);

    pub fn at(&self, now: Time) -> Moment {
        let turns = if self.is_idle { self.clock(now) } else { self.time };
        Moment { now, turns, until: turns + self.owed }
    }

    /// What it would be if it had gone with the clock since the bus had nothing to do: where that is long ago, it goes
    /// slower for good.
    fn clock(&self, now: Time) -> Time {
        match self.idle {
            Some((at, time)) if self.keeps_up(now) => time + (now - at),
            _ => self.time,
        }
    }

    /// So many reads a second are wanted: more than can have their turns is no fault, less would put those with short
    /// periods at a disadvantage. And whether the one that goes next has to wait for nobody.
    pub fn want(&mut self, reads_a_second: f64, lets_ahead: bool) {
        (self.wanted, self.lets_ahead) = (reads_a_second, lets_ahead);
    }

    /// Whether a read that is not due by this time has its turn if it begins now.
    pub fn lets_ahead(&self) -> bool {
        self.lets_ahead
    }

    /// Whoever goes next has its turn, whether it is due by this time or not.
    pub fn let_ahead(&mut self) {
        self.lets_ahead = true;
    }

    /// Nothing is due.
    pub fn idle(&mut self, now: Time) {
        self.idle = Some((now, self.clock(now).max(self.time + self.owed)));
        (self.is_idle, self.owed) = (true, Duration::ZERO);
    }

    /// A request begins.
    pub fn busy(&mut self, now: Time) {
        self.lets_ahead = false;
        if self.is_idle {
            self.time = self.clock(now);
            (self.idle, self.is_idle) = (Some((now, self.time)), false);
        }
    }

    /// A read begins which somebody wants at once: from when on it counts its period, if it has one.
    pub fn begin(&mut self, now: Time, period: Option<Duration>) -> Time {
        self.busy(now);
        self.clock(now).min(self.time + period.unwrap_or_default())
    }

    /// A read begins in its turn that was due then, in the bus's time, after so many times its period. `of_device`: after
    /// how many those of its device come round, on average. From when on it counts its next one.
    pub fn begin_turn(
        &mut self,
        now: Time,
        due: Time,
        period: Duration,
        stretch: f64,
        of_device: impl FnOnce() -> f64,
    ) -> Time {
        self.busy(now);
        self.stretch = (self.stretch + (stretch - self.stretch) * Pace::STEP).max(1.0);
        let behind = self.time - due;
        if self.keeps_up(now) && behind >= period {
            // It was the device itself that kept it waiting: that is not made up for. But where that is usual, what others
            // of its reads have had of its turns meanwhile is, so that the device stretches them alike.
            let of_device = of_device();
            if of_device > Pace::BEHIND {
                let usual = period.mul_f64(of_device);
                let should_have_begun = due.before(period) + usual;
                if self.time - should_have_begun <= usual * Pace::BEHIND_MOST {
                    return should_have_begun.min(self.time);
                }
            }
            return self.time;
        }
        let until = self.time + self.owed;
        let ahead = due.min(until) - self.time;
        self.owed = self.owed.saturating_sub(ahead);
        self.time += ahead;
        if due <= until {
            // Each read loses by itself what is too much: put off together, those of a device that have long periods would
            // lose again and again what they have waited.
            return due + behind.saturating_sub(period * Pace::BEHIND_MOST);
        }
        // Nothing else is due. Where that is usual a little delay does not shift those after it: the period is kept on
        // average. What has waited for longer, or is ahead on a bus that cannot keep up, counts from here.
        let clock = self.clock(now).min(until + period).max(until);
        if due <= clock && clock - due < period { due } else { clock }
    }

    /// Whether it had nothing to do a short time ago.
    fn keeps_up(&self, now: Time) -> bool {
        self.idle.is_some_and(|(at, _)| self.is_idle || now - at <= Pace::KEEPS_UP)
    }

    /// A read that had its turn has taken so long.
    pub fn had_turn(&mut self, took: Duration) {
        let left = self.owed + took;
        let is_more = self.wanted * left.as_secs_f64() > 1.0;
        let step = if is_more { Duration::from_secs_f64(1.0 / self.wanted) } else { left };
        self.time += step;
        self.owed = left.saturating_sub(step).min(Pace::OWED_MOST);
    }

    /// What went out of turn has taken so long. All have waited for it, but turns are the fewer: each may move the time
    /// by what it is worth, though it takes less itself. Else this would hardly go on, and who is ahead would stay so.
    pub fn went_before(&mut self, took: Duration) {
        self.owed = (self.owed + took).min(Pace::OWED_MOST);
    }

    /// Whether periods are longer than they should be, and there was no moment within this time when nothing was due.
    pub fn is_behind(&self, now: Time, time: Duration) -> bool {
        self.stretch > Pace::BEHIND && self.idle.is_none_or(|(at, _)| now - at > time)
    }
}
