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
    let mut counts = vec![0; polls.reads.len()];
    let mut now = Time::default();
    let mut pace = Pace::default();
    while now < until {
        match polls.most_urgent(now) {
            Some((index, _)) => {
                polls.begin(index, now, &mut pace);
                polls.end(index);
                counts[index] += 1;
                now += cost;
            }
            None => {
                pace.idle(now);
                now = polls.due_at().expect("a period");
            }
        }
    }
    counts
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
    // Demand: 21 reads a second; the wire carries ten. Both classes get a little under half.
    let counts = run(&mut polls, Duration::from_millis(100), Time::from_millis(100_000));
    assert_eq!(counts.iter().sum::<u32>(), 1000);
    let fast_stretch = 1000.0 / f64::from(counts[0]);
    let slow_stretch = 100.0 / f64::from(counts[2]);
    assert!((fast_stretch / slow_stretch - 1.0).abs() < 0.1, "{counts:?}");
    // Also where it is asked for only a little too much.
    let mut polls = self::polls(&[Poll::Fast, Poll::Fast, Poll::Slow]);
    let counts = run(&mut polls, Duration::from_millis(60), Time::from_millis(100_000));
    let stretches = [1000.0 / f64::from(counts[0]), 100.0 / f64::from(counts[2])];
    assert!(stretches.iter().all(|stretch| (1.15..1.45).contains(stretch)), "{counts:?}");
}

#[test]
fn nothing_waits_on_a_bus_that_cannot_keep_up_while_nothing_else_is_due() {
    let mut polls = polls(&[Poll::Fast]);
    let (mut now, mut pace) = (Time::default(), Pace::default());
    // Some take much longer than the period, and some hardly longer.
    for cost in [104, 160, 160].into_iter().cycle().take(300) {
        assert!(polls.most_urgent(now).is_some(), "{now:?}: due at {:?}", polls.due_at());
        polls.begin(0, now, &mut pace);
        polls.end(0);
        now += Duration::from_millis(cost);
    }
}

#[test]
fn what_was_asked_in_vain_is_due_at_once_but_behind_whatever_else_is_due() {
    let mut polls = polls(&[Poll::Fast, Poll::Fast, Poll::Slow]);
    run(&mut polls, Duration::from_millis(5), Time::from_millis(5_000));
    let now = Time::from_millis(5_300);
    polls.begin(2, now, &mut Pace::default());
    polls.try_again(2, now, false);
    assert_eq!(polls.due_at(), Some(Time::default()));
    // The others have waited for more than twice their period.
    let order: Vec<usize> = std::iter::from_fn(|| {
        let (index, _) = polls.most_urgent(now)?;
        polls.begin(index, now, &mut Pace::default());
        Some(index)
    })
    .collect();
    assert_eq!(order, [0, 1, 2]);
    // That is also so for what has had more than its share of a bus that cannot keep up.
    let mut ahead = self::polls(&[Poll::Fast, Poll::Fast]);
    let mut behind = Pace { idle_at: None, stretch: 2.0 };
    for at in [0, 100] {
        ahead.begin(0, Time::from_millis(5_000 + at), &mut behind);
        ahead.end(0);
    }
    ahead.end(1);
    ahead.begin(1, Time::from_millis(5_100), &mut behind);
    ahead.try_again(1, Time::from_millis(5_100), false);
    assert_eq!(ahead.most_urgent(Time::from_millis(5_199)).map(|(index, _)| index), Some(1));
    let Some((0, Urgency::Overdue(urgency))) = ahead.most_urgent(Time::from_millis(5_201)) else {
        panic!("{:?}", ahead.most_urgent(Time::from_millis(5_201)));
    };
    assert!(urgency < 1.0, "{urgency}");
    // Unless somebody knows that it has to go first, or the device has not answered it since it connected; and what has
    // no period has nothing to be due by.
    polls.try_again(1, now, true);
    assert_eq!(polls.most_urgent(now), Some((1, Urgency::Wanted)));
    let mut new = self::polls(&[Poll::Fast]);
    new.begin(0, now, &mut Pace::default());
    new.try_again(0, now, false);
    assert_eq!(new.most_urgent(now), Some((0, Urgency::Wanted)));
    let mut polls = self::polls(&[Poll::Once]);
    polls.begin(0, now, &mut Pace::default());
    polls.try_again(0, now, false);
    assert_eq!(polls.most_urgent(now).map(|(index, _)| index), Some(0));
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
    for (index, at) in [(0, 10), (1, 40), (2, 60)] {
        polls.begin(index, Time::from_millis(at), &mut Pace::default());
        polls.end(index);
    }
    assert!(polls.has_reads(&apart()) && !polls.has_reads(&together()));
    polls.rearrange(together(), intervals, |_| false);
    assert!(polls.has_reads(&together()) && polls.first_round_is_over());
    // Due when the first of them would have been, and not at once.
    assert_eq!(polls.due_at(), Some(Time::from_millis(110)));
    polls.begin(0, Time::from_millis(110), &mut Pace::default());
    polls.rearrange(apart(), intervals, |_| false);
    assert_eq!(polls.due_at(), Some(Time::from_millis(210)));
    assert_eq!(polls.most_urgent(Time::from_millis(209)), None);
    // What has not been answered yet is still wanted.
    polls.want(9);
    polls.rearrange(together(), intervals, |_| false);
    assert_eq!(polls.most_urgent(Time::from_millis(120)), Some((0, Urgency::Wanted)));
}

#[test]
fn selectors_come_before_what_depends_on_them() {
    let polls = polls(&[Poll::Fast, Poll::Fast, Poll::Slow]);
    assert_eq!(polls.most_urgent(Time::default()), Some((2, Urgency::WantedSelector)));
}
