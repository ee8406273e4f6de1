//! The thread of one line: it sleeps, and yet is awake to the microsecond when a request is to be sent or a reply comes.

use super::wake_punctually;
use crate::edge::bus_runner::BusRunner;
use crate::edge::doze::Awake;
use crate::edge::guarded_link::{Woken, wait};
use crate::edge::link::Lost;
use crate::edge::punctual::{Leisure, Punctual};
use crate::engine::time::{Duration, Time};

/// Runs a bus to its end.
pub(super) fn run(mut runner: BusRunner) {
    wake_punctually();
    let mut rhythm = Rhythm::default();
    runner.begin();
    runner.publish();
    while !runner.is_finished() {
        let woken = wait_for_anything(&mut runner, &mut rhythm);
        if woken.bell {
            runner.bell().silence();
        }
        runner.woken(woken);
        runner.publish();
    }
    runner.finish();
}

/// What the thread knows of its own waking up, and of how much there is to do.
#[derive(Default)]
struct Rhythm {
    punctual: Punctual,
    leisure: Leisure,
}

/// Waits for whatever comes first of the link, the bell and the time to go on.
fn wait_for_anything(runner: &mut BusRunner, rhythm: &mut Rhythm) -> Woken {
    let woken = match awake_at(runner, rhythm) {
        Some(Awake { from, until }) if runner.clock().now() >= from => wait_awake(runner, until),
        Some(Awake { from, .. }) => sleep(runner, rhythm, Some(from)),
        None => sleep(runner, rhythm, None),
    };
    woken.unwrap_or_else(|lost| {
        runner.lose(lost);
        Woken { bell: true, link: true }
    })
}

/// So long before its usual time, and so long behind it, a reply is waited for without sleeping.
const AWAKE_BEFORE: Duration = Duration::from_micros(60);
const AWAKE_BEHIND: Duration = Duration::from_micros(150);

/// When the reply under way will most likely come: a core that sleeps then would hear it some 50 µs late, which
/// is time of the wire, and of whoever waits for the value. `None` where that is not known, is over, or nobody
/// would gain by it.
fn awake_at(runner: &BusRunner, rhythm: &Rhythm) -> Option<Awake> {
    let expected_at = runner.link()?.reply_expected_at()?;
    let until = expected_at + AWAKE_BEHIND;
    let is_over = runner.clock().now() >= until || runner.wake_at().is_some_and(|at| at <= until);
    if is_over || rhythm.leisure.is_calm(expected_at) {
        return None;
    }
    Some(Awake { from: rhythm.punctual.sleep_until(expected_at.before(AWAKE_BEFORE)), until })
}

/// Waits for the link and the bell until then, without sleeping.
fn wait_awake(runner: &BusRunner, until: Time) -> Result<Woken, Lost> {
    loop {
        let woken = wait(runner.link(), Some(runner.bell()), Some(Duration::ZERO))?;
        if woken != Woken::default() || runner.clock().now() >= until {
            return Ok(woken);
        }
        // Whoever hands over the bytes may have been put on this core.
        rustix::thread::sched_yield();
    }
}

/// Sleeps until something comes, it is time to go on, or `at_most` has come. Before a request is sent the rest
/// of that time is spun.
fn sleep(runner: &mut BusRunner, rhythm: &mut Rhythm, at_most: Option<Time>) -> Result<Woken, Lost> {
    let clock = runner.clock();
    let wake_at = runner.wake_at();
    let has_nothing_to_do = runner.link().is_some_and(|link| link.wake_at().is_none());
    let send_at = runner.link().and_then(|link| link.send_at());
    let exactly = send_at.filter(|at| Some(*at) == wake_at);
    let since = clock.now();
    let until = exactly
        .filter(|at| !rhythm.leisure.is_calm(*at))
        .map(|at| rhythm.punctual.sleep_until(at))
        .or(wake_at);
    let until = until.into_iter().chain(at_most).min();
    let woken = wait(runner.link(), Some(runner.bell()), until.map(|until| until - since))?;
    if has_nothing_to_do {
        rhythm.leisure.rested(clock.now());
    }
    match (woken, until) {
        (Woken { link: true, .. }, _) => {
            let came_at = rhythm.punctual.woken_by(since, clock.now());
            if let Some(link) = runner.link_mut() {
                link.woken_by(came_at);
            }
        }
        (Woken { bell: false, .. }, Some(until)) => {
            rhythm.punctual.slept(since, until, clock.now());
            while exactly.is_some_and(|at| clock.now() < at) {
                // A command that comes now still goes before the poll.
                if runner.bell().rings() {
                    return Ok(Woken { bell: true, link: false });
                }
                std::hint::spin_loop();
            }
        }
        _ => {}
    }
    Ok(woken)
}
