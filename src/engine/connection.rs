//! What is known of the connection to the broker: when to try again after a loss, whether somebody else
//! takes our place again and again, and how old a message may be that has just arrived.

use crate::engine::outbox::may_be_too_long;
use crate::engine::time::{Duration, Time};

/// Pauses between attempts begin here and double, to no more than somebody waits who has put the cable back in.
const PAUSE_FIRST: Duration = Duration::from_millis(500);
const PAUSE_LAST: Duration = Duration::from_secs(8);

/// A broker that closes the connection over a long message has done so at once, and lets us in again at once.
const ATTEMPTS_TOO_LONG: u32 = 1;

/// A connection that held this long was a good one: after it the pauses begin anew.
const GOOD_AFTER: Duration = Duration::from_secs(10);

/// The same for a place that somebody else wants: two gateways that give way to each other shall not
/// take the other's pause for a good connection. Nor shall one be away for long that only thinks so, since a broker
/// has closed its connection so often for another reason.
const PAUSE_LAST_CONTESTED: Duration = Duration::from_secs(30);
const GOOD_AFTER_CONTESTED: Duration = Duration::from_secs(60);

/// A broker that accepts us at once and closes the connection this soon, this often in a row, most likely
/// does so for the sake of another client with our identifier: MQTT 3.1.1 has no words for the reason. One
/// that is restarted is away for a while, or is not restarted so often.
const THROWN_OUT_WITHIN: Duration = Duration::from_secs(30);
const THROWN_OUT_TIMES: u32 = 4;

/// A broker that leaves a question unanswered for so long was stalled, or the way to it was.
const STALLED_AFTER: Duration = Duration::from_secs(3);

/// The broker is asked at least so often, so that no stall is unnoticed that is as long as this and the time above
/// together: less than a command's time to live.
const ASK_EVERY: Duration = Duration::from_secs(6);

/// What others had to say during a stall arrives within this time after it.
const STALE_UNTIL_AFTER: Duration = Duration::from_millis(500);

/// After a silence that ended the connection, others have said what they had to say within this time.
const LISTEN_AFTER_SILENCE: Duration = Duration::from_secs(1);

/// How a connection, or an attempt to make one, ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Loss {
    /// The broker closed it.
    Closed,
    /// Nothing came within a time limit.
    Silent,
    /// Anything else: refused, unreachable, not understood.
    Failed,
}

/// What follows from a loss.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AfterLoss {
    /// How long to wait before the next attempt.
    pub pause: Duration,
    /// The topic and the bytes of a message that the broker may have closed the connection for.
    pub suspect: Option<(String, usize)>,
}

/// The connection to one broker. Told what happens in the order in which it happens.
#[derive(Clone, Debug, Default)]
pub struct Connection {
    /// When it was made, while it is there.
    since: Option<Time>,
    /// Attempts that came to nothing, or to little, since the last good connection.
    attempts: u32,
    /// Attempts since the connection was lost.
    attempts_since_loss: u32,
    /// How often in a row the broker has accepted us and then closed the connection.
    thrown_out: u32,
    contested: bool,
    /// The oldest question that nothing has come after.
    asked_at: Option<Time>,
    /// When something was asked last, or the connection was made.
    last_asked: Time,
    /// The broker did not say that it is away, and may hold what others have told it meanwhile.
    was_silent: bool,
    /// Until when what arrives may come from a stall, and when that began.
    stale: Option<(Time, Time)>,
}

impl Connection {
    /// The broker has accepted us. Tells how long to wait before listening: a broker that comes back
    /// from a stall hands on what was sent to it before.
    pub fn made(&mut self, now: Time) -> Duration {
        self.since = Some(now);
        self.attempts_since_loss += 1;
        (self.asked_at, self.last_asked) = (None, now);
        let was_silent = std::mem::take(&mut self.was_silent);
        if was_silent { LISTEN_AFTER_SILENCE } else { Duration::ZERO }
    }

    /// Something was sent that the broker answers.
    pub fn asked(&mut self, now: Time) {
        // A program that stood still itself asks late.
        self.asked_at.get_or_insert(now.min(self.last_asked + ASK_EVERY));
        self.last_asked = now;
    }

    /// When something is to be asked for the question's own sake, while the connection is there.
    pub fn asks_at(&self) -> Option<Time> {
        self.is_made().then(|| self.last_asked + ASK_EVERY)
    }

    /// Whether the broker owes an answer.
    pub fn waits(&self) -> bool {
        self.asked_at.is_some()
    }

    /// Anything has come from the broker.
    pub fn heard(&mut self, now: Time) {
        // Or has not even asked.
        let asked_at = self.asked_at.take().unwrap_or(self.last_asked + ASK_EVERY);
        if now.since(asked_at) >= STALLED_AFTER {
            self.stale = Some((now + STALE_UNTIL_AFTER, asked_at));
        }
    }

    /// How old a message may be that comes from somebody else and has arrived just now, if that is
    /// more than the usual.
    pub fn stale_for(&self, now: Time) -> Option<Duration> {
        let (_, since) = self.stale.filter(|(until, _)| now < *until)?;
        Some(now - since)
    }

    /// It is lost, or could not be made. `longest`: topic and bytes of the longest message that was on its way
    /// and is not confirmed. `seed` is any number that varies, so that many gateways do not come back to a
    /// restarted broker in the same moment.
    pub fn lost(&mut self, now: Time, loss: Loss, longest: Option<(String, usize)>, seed: u64) -> AfterLoss {
        let held = self.since.take().map(|since| now - since);
        let is_closed = held.is_some() && loss == Loss::Closed;
        let suspect = longest.filter(|(_, bytes)| is_closed && may_be_too_long(*bytes));
        match held {
            Some(held) if is_closed && suspect.is_none() => {
                let is_thrown_out_again = self.thrown_out > 0 && held < THROWN_OUT_WITHIN;
                let at_once = self.attempts_since_loss == 1;
                self.thrown_out = if is_thrown_out_again && at_once { self.thrown_out + 1 } else { 1 };
            }
            Some(_) => self.thrown_out = 0,
            None => self.attempts_since_loss += 1,
        }
        if held.is_some() {
            self.attempts_since_loss = 0;
        }
        if held.is_some_and(|held| held >= self.good_after()) {
            (self.attempts, self.contested) = (0, false);
        }
        self.contested |= self.thrown_out >= THROWN_OUT_TIMES;
        self.was_silent = loss == Loss::Silent;
        (self.asked_at, self.stale) = (None, None);
        let pause = pause(self.attempts, self.contested, seed);
        self.attempts += 1;
        if suspect.is_some() {
            // Which message that is, is found out in a few attempts.
            self.attempts = self.attempts.min(ATTEMPTS_TOO_LONG);
        }
        AfterLoss { pause, suspect }
    }

    /// Whether the broker has accepted us and not gone since.
    pub fn is_made(&self) -> bool {
        self.since.is_some()
    }

    /// Whether another client with our identifier takes our place again and again.
    pub fn is_contested(&self, now: Time) -> bool {
        let is_good = self.since.is_some_and(|since| now - since >= self.good_after());
        self.contested && !is_good
    }

    fn good_after(&self) -> Duration {
        if self.contested { GOOD_AFTER_CONTESTED } else { GOOD_AFTER }
    }
}

/// Doubles with each attempt up to a bound, and varies by a quarter.
fn pause(attempts: u32, contested: bool, seed: u64) -> Duration {
    let last = if contested { PAUSE_LAST_CONTESTED } else { PAUSE_LAST };
    let full = PAUSE_FIRST.saturating_mul(1 << attempts.min(10)).min(last);
    // The middle of a product with a large odd number is as good as random.
    let spread = (seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40) as u32 % 256;
    full - full / 4 * spread / 256
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: u64) -> Time {
        Time::from_millis(seconds * 1000)
    }

    /// With nothing on its way.
    fn lose(connection: &mut Connection, now: Time, loss: Loss) -> Duration {
        connection.lost(now, loss, None, 0).pause
    }

    #[test]
    fn the_pause_between_attempts_grows_to_a_bound_and_varies() {
        for (attempts, contested, longest) in [
            (0, false, 500),
            (1, false, 1000),
            (2, false, 2000),
            (4, false, 8000),
            (40, false, 8000),
            (2, true, 2000),
            (40, true, 30_000),
        ] {
            let pauses: Vec<Duration> =
                (0..100).map(|seed| pause(attempts, contested, seed * 1017)).collect();
            let longest = Duration::from_millis(longest);
            assert!(pauses.iter().all(|pause| *pause <= longest && *pause >= longest * 3 / 4), "{pauses:?}");
            assert!(pauses.iter().min() != pauses.iter().max());
        }
    }

    #[test]
    fn after_a_good_connection_the_pauses_begin_anew_and_after_a_short_one_they_grow() {
        for (held, expected) in [(9, 2000), (10, 500)] {
            let mut connection = Connection::default();
            lose(&mut connection, at(0), Loss::Failed);
            lose(&mut connection, at(1), Loss::Failed);
            connection.made(at(2));
            let pause = lose(&mut connection, at(2 + held), Loss::Failed);
            assert_eq!(pause, Duration::from_millis(expected), "held {held} s");
        }
    }

    #[test]
    fn a_long_message_is_suspected_where_the_broker_closed_what_it_had_accepted() {
        for (made, loss, bytes, is_suspect) in [
            (true, Loss::Closed, Some(9000), true),
            (true, Loss::Closed, Some(20), false),
            (true, Loss::Closed, None, false),
            (true, Loss::Silent, Some(9000), false),
            (true, Loss::Failed, Some(9000), false),
            (false, Loss::Closed, Some(9000), false),
        ] {
            let mut connection = Connection::default();
            if made {
                connection.made(at(0));
            }
            let longest = bytes.map(|bytes| ("busker/boiler/info".to_string(), bytes));
            let suspect = connection.lost(at(1), loss, longest.clone(), 0).suspect;
            assert_eq!(suspect, longest.filter(|_| is_suspect), "made: {made}, {loss:?}, {bytes:?} bytes");
        }
    }

    #[test]
    fn while_it_is_found_out_which_message_is_too_long_the_pauses_stay_short_and_nobody_else_is_blamed() {
        let (mut connection, mut pauses) = (Connection::default(), Vec::new());
        for second in 0..8 {
            connection.made(at(second * 2));
            let long = Some(("busker/boiler/info".to_string(), 9000));
            pauses.push(connection.lost(at(second * 2), Loss::Closed, long, 0).pause.as_millis());
        }
        assert_eq!(pauses, [500, 1000, 1000, 1000, 1000, 1000, 1000, 1000]);
        assert!(!connection.is_contested(at(20)));
    }

    /// `held`: how long each connection was, in seconds, with the broker reachable at once or only at
    /// the second attempt.
    fn check_contested(losses: &[(u64, Loss, bool)], expected: bool) {
        let (mut connection, mut now) = (Connection::default(), 0);
        for (held, loss, at_once) in losses {
            if !at_once {
                lose(&mut connection, at(now), Loss::Failed);
            }
            connection.made(at(now));
            now += held;
            lose(&mut connection, at(now), *loss);
            now += 1;
        }
        assert_eq!(connection.is_contested(at(now)), expected, "{losses:?}");
    }

    #[test]
    fn a_place_is_contested_when_the_broker_gives_it_away_again_and_again() {
        let thrown_out = (1, Loss::Closed, true);
        let after_long = (86_400, Loss::Closed, true);
        check_contested(&[after_long, thrown_out, thrown_out, thrown_out], true);
        check_contested(&[after_long, thrown_out, thrown_out], false);
        // A broker that is restarted three times is away meanwhile.
        let restarted = (1, Loss::Closed, false);
        check_contested(&[restarted, restarted, restarted, restarted, thrown_out], false);
        check_contested(&[thrown_out, thrown_out, thrown_out, (31, Loss::Closed, true)], false);
        check_contested(&[thrown_out, thrown_out, thrown_out, (1, Loss::Silent, true), thrown_out], false);
    }

    #[test]
    fn a_contested_place_is_given_up_for_longer_until_it_is_kept_for_long() {
        let mut connection = Connection::default();
        let (mut now, mut pauses) = (0, Vec::new());
        for _ in 0..11 {
            connection.made(at(now));
            pauses.push(lose(&mut connection, at(now + 20), Loss::Closed).as_secs());
            now += 30;
        }
        // The first few may have been anything.
        assert_eq!(pauses, [0, 0, 0, 0, 1, 2, 4, 8, 16, 30, 30]);
        connection.made(at(now));
        assert!(connection.is_contested(at(now + 59)));
        assert!(!connection.is_contested(at(now + 60)));
        assert_eq!(lose(&mut connection, at(now + 60), Loss::Closed), PAUSE_FIRST);
        assert!(!connection.is_contested(at(now + 61)));
    }

    #[test]
    fn what_comes_after_a_silence_may_be_as_old_as_the_silence() {
        let mut connection = Connection::default();
        connection.made(at(8));
        assert!(!connection.waits());
        connection.asked(at(10));
        connection.asked(at(14));
        assert!(connection.waits());
        assert_eq!(connection.stale_for(at(12)), None, "nothing has arrived");
        connection.heard(at(16));
        assert_eq!(connection.stale_for(at(16)), Some(Duration::from_secs(6)));
        assert_eq!(connection.stale_for(at(17)), None);
        connection.asked(at(18));
        connection.heard(at(20));
        assert_eq!(connection.stale_for(at(20)), None, "two seconds are no stall");
    }

    #[test]
    fn the_broker_is_asked_so_often_that_nothing_can_be_as_old_as_a_command_may_be() {
        let mut connection = Connection::default();
        assert_eq!(connection.asks_at(), None, "there is no connection");
        connection.made(at(10));
        assert_eq!(connection.asks_at(), Some(at(16)));
        connection.asked(at(12));
        assert_eq!(connection.asks_at(), Some(at(18)));
        // Whatever comes in time shows only that this is no stall, not that nothing is to be asked.
        connection.heard(at(13));
        connection.heard(at(18));
        assert_eq!((connection.asks_at(), connection.stale_for(at(18))), (Some(at(18)), None));
        lose(&mut connection, at(19), Loss::Closed);
        assert_eq!(connection.asks_at(), None);
        assert!(ASK_EVERY + STALLED_AFTER < Duration::from_secs(10));
    }

    #[test]
    fn a_program_that_stood_still_knows_that_it_has_not_asked() {
        let mut connection = Connection::default();
        connection.made(at(10));
        connection.heard(at(18));
        assert_eq!(connection.stale_for(at(18)), None, "the question may be a little late");
        connection.heard(at(19));
        assert_eq!(connection.stale_for(at(19)), Some(Duration::from_secs(3)));
        // And what comes with it, until the question is answered.
        connection.heard(at(20));
        assert!(connection.stale_for(at(20)).is_some());
        connection.asked(at(20));
        connection.heard(at(21));
        assert_eq!(connection.stale_for(at(21)), Some(Duration::from_secs(5)));
        assert_eq!(connection.stale_for(Time(at(21).0 + 500_000)), None);
        // It may find the time to ask before it looks at what has come.
        connection.asked(at(30));
        connection.heard(at(30));
        assert_eq!(connection.stale_for(at(30)), Some(Duration::from_secs(4)));
    }

    #[test]
    fn after_a_silence_that_ended_the_connection_one_listens_a_little_later() {
        let second = Duration::from_secs(1);
        for (losses, expected) in [
            (&[][..], Duration::ZERO),
            (&[Loss::Silent], second),
            (&[Loss::Closed], Duration::ZERO),
            (&[Loss::Failed, Loss::Silent, Loss::Silent], second),
            // A broker that was away holds nothing.
            (&[Loss::Silent, Loss::Failed], Duration::ZERO),
        ] {
            let mut connection = Connection::default();
            connection.made(at(0));
            for loss in losses {
                lose(&mut connection, at(30), *loss);
            }
            assert_eq!(connection.made(at(60)), expected, "{losses:?}");
            assert_eq!(connection.made(at(61)), Duration::ZERO, "once");
        }
    }
}
