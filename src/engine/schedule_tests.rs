//! Whose turn it is, on calculated time.

use super::*;
use crate::engine::address::Table;

fn polls(periods: &[Poll]) -> Polls {
    let reads = periods
        .iter()
        .enumerate()
        .map(|(index, poll)| {
            let span = Span::single(Table::Input, index as u16 * 100);
            Read { poll: *poll, span, points: vec![(index, Address { span, bits: None })], alone: false }
        })
        .collect();
    let intervals = Intervals { fast: Duration::from_millis(100), slow: Duration::from_millis(1000) };
    Polls::new(reads, intervals, |point| point == 2)
}

/// Runs the schedule on a wire where each read takes `cost`; returns how often each was read.
fn run(polls: &mut Polls, cost: Duration, until: Time) -> Vec<u32> {
    Line::default().run(polls, |_| cost, until)
}

#[derive(Default)]
struct Line {
    now: Time,
    pace: Pace,
}

impl Line {
    /// On from where it is; returns how often each was read.
    fn run(&mut self, polls: &mut Polls, cost: impl Fn(usize) -> Duration, until: Time) -> Vec<u32> {
        let mut counts = vec![0; polls.reads.len()];
        while self.now < until {
            let at = self.pace.at(self.now);
            let next = polls.most_urgent(at);
            let is_ahead = matches!(next, Some((_, Urgency::Overdue(urgency))) if urgency < 1.0);
            self.pace.want(polls.wanted(), is_ahead);
            let Some((index, _)) = next else {
                self.pace.idle(self.now);
                self.now = polls.due_at(self.pace.at(self.now)).expect("a period");
                continue;
            };
            self.ask(polls, index, cost(index));
            counts[index] += 1;
        }
        counts
    }

    /// After ten seconds.
    fn that_has_run(polls: &mut Polls, cost: impl Fn(usize) -> Duration) -> Line {
        let mut line = Line::default();
        line.run(polls, cost, Time::from_millis(10_000));
        line
    }

    fn ask(&mut self, polls: &mut Polls, index: usize, cost: Duration) {
        let was_turn = polls.begin(index, self.now, &mut self.pace).was_in_turn();
        polls.end(index);
        self.now += cost;
        if was_turn {
            self.pace.had_turn(cost);
        }
    }
}

#[test]
fn every_period_is_kept_on_a_bus_with_time_to_spare() {
    let mut polls = polls(&[Poll::Fast, Poll::Slow, Poll::Once]);
    assert_eq!(run(&mut polls, Duration::from_millis(5), Time::from_millis(10_000)), [100, 10, 1]);
}

#[test]
fn the_real_period_is_what_the_bus_keeps_and_not_what_was_asked_for() {
    let fast = |polls: &Polls, now| polls.real_period(Poll::Fast, now).map(|period| period.as_millis());
    let mut polls = polls(&[Poll::Fast, Poll::Fast, Poll::Slow]);
    polls.begin(0, Time::default(), &mut Pace::default());
    assert_eq!(fast(&polls, Time::from_millis(50)), None, "nothing has come round");
    run(&mut polls, Duration::from_millis(5), Time::from_millis(10_000));
    assert_eq!(fast(&polls, Time::from_millis(10_000)), Some(100));
    run(&mut polls, Duration::from_millis(100), Time::from_millis(100_000));
    assert!(fast(&polls, Time::from_millis(100_000)) >= Some(200));
    assert!(fast(&polls, Time::from_millis(700_000)) >= Some(600_000), "what is late counts");
    polls.want_all();
    assert_eq!(fast(&polls, Time::from_millis(700_000)), None);
}

#[test]
fn an_overloaded_bus_stretches_every_period_by_the_same_factor() {
    let mut polls = polls(&[Poll::Fast, Poll::Fast, Poll::Slow]);
    // Demand: 21 reads a second; the wire carries ten.
    let counts = run(&mut polls, Duration::from_millis(100), Time::from_millis(100_000));
    assert_eq!(counts.iter().sum::<u32>(), 1000);
    assert!(counts[0].abs_diff(counts[1]) <= 2, "{counts:?}");
    assert!((counts[0] / 10).abs_diff(counts[2]) <= 1, "{counts:?}");
    // Also where it is asked for only a little too much.
    let mut polls = self::polls(&[Poll::Fast, Poll::Fast, Poll::Slow]);
    let counts = run(&mut polls, Duration::from_millis(60), Time::from_millis(100_000));
    assert!((counts[0] / 10).abs_diff(counts[2]) <= 1 && counts[2] > 75, "{counts:?}");
    // And where one request takes as long as three periods of the others.
    let mut polls = self::polls(&[Poll::Fast, Poll::Fast, Poll::Slow]);
    let cost = |index| Duration::from_millis(if index == 2 { 300 } else { 40 });
    let counts = Line::default().run(&mut polls, cost, Time::from_millis(100_000));
    assert!((counts[0] / 10).abs_diff(counts[2]) <= 1 && counts[2] > 85, "{counts:?}");
}

#[test]
fn nobody_makes_up_for_a_silence_in_which_all_have_waited() {
    // How often the fast reads have their turns in a second, and the slow one.
    for (cost, fast, slow) in [(5, 11, 1), (60, 9, 1)] {
        let mut polls = polls(&[Poll::Fast, Poll::Fast, Poll::Slow]);
        let cost = |_| Duration::from_millis(cost);
        let mut line = Line::that_has_run(&mut polls, cost);
        // The line was silent for ten seconds, and nothing was done meanwhile.
        line.now += Duration::from_secs(10);
        let until = line.now + Duration::from_secs(1);
        let counts = line.run(&mut polls, cost, until);
        assert!(counts[..2].iter().all(|count| *count <= fast) && counts[2] >= slow, "{counts:?}");
    }
}

#[test]
fn a_device_that_was_kept_away_takes_no_more_than_its_share_when_it_is_back() {
    // On a bus that keeps up, on one that does without it, and on one that never does.
    for cost in [5, 60, 150] {
        let mut polls = polls(&[Poll::Fast, Poll::Fast, Poll::Slow]);
        let cost = |_| Duration::from_millis(cost);
        let mut line = Line::that_has_run(&mut polls, cost);
        polls.pause(0, Time::from_millis(20_000));
        line.run(&mut polls, cost, Time::from_millis(20_000));
        let counts = line.run(&mut polls, cost, Time::from_millis(30_000));
        assert!(counts[0].abs_diff(counts[1]) <= 2, "{counts:?}");
    }
}

#[test]
fn what_was_wanted_at_once_has_its_next_turn_no_later_than_usual() {
    let mut polls = polls(&[Poll::Fast, Poll::Fast, Poll::Slow]);
    let cost = |_| Duration::from_millis(60);
    let mut line = Line::that_has_run(&mut polls, cost);
    polls.want(0);
    let until = line.now + Duration::from_millis(600);
    let counts = line.run(&mut polls, cost, until);
    assert!(counts[0] >= 4, "{counts:?}");
}

#[test]
fn nothing_waits_on_a_bus_that_cannot_keep_up_while_nothing_else_is_due() {
    let mut polls = polls(&[Poll::Fast]);
    let mut line = Line::default();
    // Some take much longer than the period, and some hardly longer.
    for cost in [104, 160, 160].into_iter().cycle().take(300) {
        let at = line.pace.at(line.now);
        assert!(polls.most_urgent(at).is_some(), "{at:?}: due at {:?}", polls.due_at(at));
        line.pace.want(polls.wanted(), true);
        line.ask(&mut polls, 0, Duration::from_millis(cost));
    }
}

#[test]
fn what_was_asked_in_vain_is_due_at_once_but_behind_whatever_else_is_due() {
    let mut polls = polls(&[Poll::Fast, Poll::Fast, Poll::Slow]);
    let mut line = Line::default();
    line.run(&mut polls, |_| Duration::from_millis(5), Time::from_millis(5_000));
    let (now, mut pace) = (Time::from_millis(5_300), line.pace);
    polls.begin(2, now, &mut pace);
    polls.try_again(2, now, false);
    assert_eq!(polls.due_at(pace.at(now)), Some(Time::default()));
    // The others have waited for more than twice their period.
    let order: Vec<usize> = std::iter::from_fn(|| {
        let (index, _) = polls.most_urgent(pace.at(now))?;
        polls.begin(index, now, &mut pace);
        Some(index)
    })
    .collect();
    assert_eq!(order, [0, 1, 2]);
    // That is also so for what goes only because nothing else is due on a bus that cannot keep up.
    let mut ahead = self::polls(&[Poll::Fast, Poll::Fast]);
    for (index, at) in [(0, 5_000), (0, 5_100), (1, 5_100)] {
        ahead.begin(index, Time::from_millis(at), &mut pace);
        ahead.end(index);
    }
    ahead.try_again(1, Time::from_millis(5_100), false);
    let most_urgent = |polls: &Polls, at| polls.most_urgent(pace.at(Time::from_millis(at)));
    assert_eq!(most_urgent(&ahead, 5_199).map(|(index, _)| index), Some(1));
    let Some((0, Urgency::Overdue(urgency))) = most_urgent(&ahead, 5_201) else {
        panic!("{:?}", most_urgent(&ahead, 5_201));
    };
    assert!(urgency < 1.0, "{urgency}");
    // Unless somebody knows that it has to go first, or the device has not answered it since it connected; and what has
    // no period has nothing to be due by.
    polls.try_again(1, now, true);
    assert_eq!(most_urgent(&polls, 5_300), Some((1, Urgency::Wanted)));
    let mut new = self::polls(&[Poll::Fast]);
    new.begin(0, now, &mut { pace });
    new.try_again(0, now, false);
    assert_eq!(most_urgent(&new, 5_300), Some((0, Urgency::Wanted)));
    let mut polls = self::polls(&[Poll::Once]);
    polls.begin(0, now, &mut { pace });
    polls.try_again(0, now, false);
    assert_eq!(most_urgent(&polls, 5_300).map(|(index, _)| index), Some(0));
}

#[test]
fn what_was_taken_back_is_due_as_it_was() {
    let mut polls = polls(&[Poll::Fast]);
    // On a bus that cannot keep up its period is over by the clock alone.
    let mut pace = Pace::default();
    polls.begin(0, Time::default(), &mut pace);
    let now = Time::from_millis(100);
    let before = polls.most_urgent(pace.at(now));
    assert!(matches!(before, Some((0, Urgency::Overdue(_)))), "{before:?}");
    let place = polls.begin(0, now, &mut pace);
    polls.take_back(0, place);
    assert_eq!(polls.most_urgent(pace.at(now)), before);
    assert_eq!(polls.real_period(Poll::Fast, now), None);
}

#[test]
fn a_read_is_well_known_when_it_comes_often_and_has_been_answered_often() {
    let mut polls = polls(&[Poll::Fast, Poll::Once]);
    for answers in 1..=40 {
        (0..2).for_each(|index| polls.know_better(index));
        assert_eq!([0, 1].map(|index| polls.is_well_known(index)), [answers >= 32, false]);
    }
    polls.try_again(0, Time::default(), true);
    let again = (1..).find(|_| {
        polls.know_better(0);
        polls.is_well_known(0)
    });
    assert_eq!(again, Some(8));
    polls.want_all();
    assert!(!polls.is_well_known(0));
}

#[test]
fn another_plan_keeps_what_is_known_of_the_reads_that_it_replaces() {
    let read = |poll, points: &[u16]| {
        let places = points
            .iter()
            .map(|at| (usize::from(*at), Address { span: Span::single(Table::Input, *at), bits: None }));
        let span = Span::new(Table::Input, points[0], points[points.len() - 1]).expect("a span");
        Read { poll, span, points: places.collect(), alone: false }
    };
    let intervals = Intervals { fast: Duration::from_millis(100), slow: Duration::from_millis(1000) };
    let apart = || vec![read(Poll::Fast, &[0]), read(Poll::Fast, &[9]), read(Poll::Slow, &[3])];
    let together = || vec![read(Poll::Fast, &[0, 9]), read(Poll::Slow, &[3])];
    let mut polls = Polls::new(apart(), intervals, |_| false);
    let mut pace = Pace::default();
    pace.idle(Time::default());
    let mut begin = |polls: &mut Polls, index, at| {
        polls.begin(index, Time::from_millis(at), &mut pace);
        polls.end(index);
        pace.idle(Time::from_millis(at));
        pace
    };
    let begun = [(0, 10), (1, 40), (2, 60)].map(|(index, at)| begin(&mut polls, index, at));
    assert!(polls.has_reads(&apart()) && !polls.has_reads(&together()));
    polls.rearrange(together(), intervals, |_| false);
    assert!(polls.has_reads(&together()) && polls.first_round_is_over());
    // Due when the first of them would have been, and not at once.
    assert_eq!(polls.due_at(begun[2].at(Time::from_millis(60))), Some(Time::from_millis(110)));
    let pace = begin(&mut polls, 0, 110);
    polls.rearrange(apart(), intervals, |_| false);
    assert_eq!(polls.due_at(pace.at(Time::from_millis(110))), Some(Time::from_millis(210)));
    assert_eq!(polls.most_urgent(pace.at(Time::from_millis(209))), None);
    // What has not been answered yet is still wanted.
    polls.want(9);
    polls.rearrange(together(), intervals, |_| false);
    assert_eq!(polls.most_urgent(pace.at(Time::from_millis(120))), Some((0, Urgency::Wanted)));
}

#[test]
fn selectors_come_before_what_depends_on_them() {
    let polls = polls(&[Poll::Fast, Poll::Fast, Poll::Slow]);
    assert_eq!(polls.most_urgent(Pace::default().at(Time::default())), Some((2, Urgency::WantedSelector)));
}
