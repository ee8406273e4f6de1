//! When a recording is worth a file: some time after something went wrong on the bus, or when somebody
//! asks; and not too often, for the file lands on a memory card.

use std::collections::VecDeque;

use crate::engine::time::{Duration, Time};

/// So many requests more, or so much time, and what followed is on the tape too.
const REQUESTS_AFTER: u32 = 20;
const TIME_AFTER: Duration = Duration::from_secs(5);
/// While something goes wrong again and again, the pause between two files doubles until it is so many
/// times the shortest.
const PAUSE_GROWS_TO: u32 = 16;
/// So many files are made on request in so long: whoever may speak to the broker could ask without end.
pub const ASKED_MAX: usize = 10;
const ASKED_WITHIN: Duration = Duration::from_secs(3600);

/// Waits for trouble.
#[derive(Clone, Debug)]
pub struct Watch {
    is_on: bool,
    /// The shortest time between two files.
    interval: Duration,
    trouble: Option<Trouble>,
    pause: Duration,
    saved_at: Option<Time>,
    /// When files were made on request, the last hour's.
    asked: VecDeque<Time>,
}

/// Something went wrong, and what follows is waited for.
#[derive(Clone, Debug)]
struct Trouble {
    why: String,
    requests_left: u32,
    deadline: Time,
}

impl Watch {
    /// `None`: no trouble is worth a file.
    pub fn new(interval: Option<Duration>) -> Watch {
        let is_on = interval.is_some();
        let interval = interval.unwrap_or_default();
        Watch { is_on, interval, trouble: None, pause: interval, saved_at: None, asked: VecDeque::new() }
    }

    /// Something went wrong. `why` is asked for only where it will be told.
    pub fn trouble(&mut self, now: Time, why: impl FnOnce() -> String) {
        let is_too_early = self.saved_at.is_some_and(|saved_at| now < saved_at + self.pause);
        if self.is_on && self.trouble.is_none() && !is_too_early {
            let deadline = now + TIME_AFTER;
            self.trouble = Some(Trouble { why: why(), requests_left: REQUESTS_AFTER, deadline });
        }
    }

    pub fn request_ended(&mut self) {
        if let Some(trouble) = &mut self.trouble {
            trouble.requests_left = trouble.requests_left.saturating_sub(1);
        }
    }

    /// When to look again although no request ends.
    pub fn due_at(&self) -> Option<Time> {
        self.trouble.as_ref().map(|trouble| trouble.deadline)
    }

    /// Why the tape is to be saved now, if it is. `at_once`: there will be nothing to follow.
    pub fn take(&mut self, now: Time, at_once: bool) -> Option<String> {
        let trouble = self.trouble.as_ref()?;
        if !at_once && trouble.requests_left > 0 && now < trouble.deadline {
            return None;
        }
        // Calm for as long as the pause lasted: this is another fault.
        let was_calm = self.saved_at.is_none_or(|saved_at| now >= saved_at + self.pause * 2 + TIME_AFTER);
        let longest = self.interval * PAUSE_GROWS_TO;
        self.pause = if was_calm { self.interval } else { (self.pause * 2).min(longest) };
        self.saved_at = Some(now);
        self.trouble.take().map(|trouble| trouble.why)
    }

    /// Somebody asks for a file. An error: too many have been made, and how long it takes until one may be
    /// made again.
    pub fn ask(&mut self, now: Time) -> Result<(), Duration> {
        self.asked.retain(|at| now < *at + ASKED_WITHIN);
        match self.asked.front() {
            Some(first) if self.asked.len() >= ASKED_MAX => Err(*first + ASKED_WITHIN - now),
            _ => {
                self.asked.push_back(now);
                Ok(())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MINUTE: u64 = 60_000_000;

    /// The times, in minutes, at which files are made when something goes wrong at the given ones.
    fn files(interval: u64, troubles: impl IntoIterator<Item = u64>) -> Vec<u64> {
        let mut watch = Watch::new(Some(Duration::from_secs(interval * 60)));
        let mut files = Vec::new();
        for minute in troubles {
            watch.trouble(Time(minute * MINUTE), || "trouble".into());
            if let Some(due) = watch.due_at() {
                assert_eq!(watch.take(Time(due.0 - 1), false), None);
                assert_eq!(watch.take(due, false).as_deref(), Some("trouble"));
                files.push(minute);
            }
        }
        files
    }

    #[test]
    fn while_trouble_lasts_files_become_rare_and_after_calm_the_next_is_kept_again() {
        assert_eq!(files(15, 0..600), [0, 16, 47, 108, 229, 470]);
        assert_eq!(files(15, [0, 1, 14, 1440, 1441, 2880]), [0, 1440, 2880]);
        assert_eq!(files(15, [0, 20, 40, 200, 230]), [0, 20, 200, 230]);
        // A whole year of nothing but trouble, with the shortest interval.
        let year = files(1, 0..365 * 1440).len();
        assert!(year < 366 * 90, "{year}");
    }

    #[test]
    fn who_asks_without_end_gets_some_files_an_hour() {
        let mut watch = Watch::new(None);
        let minute = |minute: u64| Time(minute * MINUTE);
        let made = (0..600).filter(|at| watch.ask(minute(*at)).is_ok());
        let expected = (0..10).flat_map(|hour| (0..10).map(move |at| hour * 60 + at));
        assert_eq!(made.collect::<Vec<u64>>(), expected.collect::<Vec<u64>>());
        assert_eq!(
            watch.ask(minute(599)),
            Err(Duration::from_secs(60)),
            "the first of the last hour was at 540"
        );
    }

    #[test]
    fn what_follows_is_waited_for_by_requests_and_by_time() {
        let mut watch = Watch::new(Some(Duration::from_secs(900)));
        watch.trouble(Time(0), || "the first".into());
        watch.trouble(Time(1), || panic!("the first one is told"));
        for _ in 0..REQUESTS_AFTER - 1 {
            watch.request_ended();
            assert_eq!(watch.take(Time(2), false), None);
        }
        watch.request_ended();
        assert_eq!(watch.take(Time(2), false).as_deref(), Some("the first"));
        assert_eq!((watch.take(Time(3), true), watch.due_at()), (None, None));
    }

    #[test]
    fn at_the_end_nothing_is_waited_for() {
        let mut watch = Watch::new(Some(Duration::from_secs(900)));
        assert_eq!(watch.take(Time(0), true), None);
        watch.trouble(Time(0), || "trouble".into());
        assert_eq!(watch.take(Time(0), true).as_deref(), Some("trouble"));
    }

    #[test]
    fn a_watch_that_is_off_never_wants_a_file() {
        let mut watch = Watch::new(None);
        watch.trouble(Time(0), || panic!("nobody wants to know"));
        assert_eq!((watch.due_at(), watch.take(Time(MINUTE), true)), (None, None));
    }
}
