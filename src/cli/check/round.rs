//! What a device with a watchdog costs the wire: its polls, and what is read before its time because
//! nothing has been asked of it for a third of what the watchdog allows.

use super::budget::Planned;
use super::feeding::Beat;

/// So many requests are played. Few devices have so many reads that these were not enough.
const REQUESTS: usize = 5_000;

/// One of the requests that come again and again.
struct Turn {
    period: Option<f64>,
    /// How long it is on the wire.
    time: f64,
    /// When it last began.
    began: f64,
    /// What feeds a watchdog is the one that sorts first: none that changes the device, and the oldest.
    feeds: Option<bool>,
}

/// Seconds of wire in a second. The requests are played one after the other, as the running program has
/// them: what is due by its period, and else, `fed_every` after the last one, what was read longest ago.
/// `stretch`: so many times as long are the periods of polls.
pub fn load(reads: &[&Planned], beats: &[Beat], fed_every: f64, stretch: f64) -> f64 {
    let poll = |read: &&Planned| Turn {
        period: read.period.map(|period| period * stretch),
        time: read.time,
        began: 0.0,
        feeds: Some(read.alone),
    };
    let beat = |beat: &Beat| Turn { period: Some(beat.every), time: beat.time, began: 0.0, feeds: None };
    let mut turns: Vec<Turn> = reads.iter().map(poll).chain(beats.iter().map(beat)).collect();
    let frequent = turns.iter().filter_map(|turn| turn.period).any(|period| period <= fed_every);
    if frequent {
        return turns.iter().filter_map(|turn| Some(turn.time / turn.period?)).sum();
    }
    let (mut now, mut busy) = (0.0_f64, 0.0);
    for _ in 0..REQUESTS {
        let due = |turn: &Turn| turn.period.map_or(f64::INFINITY, |period| turn.began + period);
        let next = (0..turns.len()).min_by(|one, other| due(&turns[*one]).total_cmp(&due(&turns[*other])));
        let Some(next) = next else { return 0.0 };
        let is_due = due(&turns[next]) <= now + fed_every;
        let order = |turn: &Turn| (turn.feeds, turn.began);
        let oldest = (0..turns.len()).filter(|turn| turns[*turn].feeds.is_some()).min_by(|one, other| {
            let (one, other) = (order(&turns[*one]), order(&turns[*other]));
            one.0.cmp(&other.0).then(one.1.total_cmp(&other.1))
        });
        let (at, next) = match oldest {
            Some(oldest) if !is_due => (now + fed_every, oldest),
            _ => (due(&turns[next]).max(now), next),
        };
        let turn = &mut turns[next];
        // Where there is no time to spare, what was read before its time is read the later again.
        turn.began = match turn.period {
            Some(period) if !is_due && stretch > 1.0 => (turn.began + period).min(at + period / stretch),
            _ => at,
        };
        busy += turn.time;
        now = at;
    }
    if now > 0.0 { busy / now } else { 0.0 }
}
