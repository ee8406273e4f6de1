//! Nanoseconds of the monotonic clock, and how to wait for one of them.

use std::num::NonZeroU64;
use std::time::Duration;

use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, Timespec, clock_gettime};

pub fn now() -> i64 {
    let time = clock_gettime(ClockId::Monotonic);
    time.tv_sec * 1_000_000_000 + time.tv_nsec
}

/// Sleeps until `early` before `time` and spins the rest.
pub fn pause_until(time: i64, early: i64) {
    if now() < time - early {
        sleep_until(time - early);
    }
    while now() < time {
        std::hint::spin_loop();
    }
}

pub fn sleep_until(time: i64) {
    let time = Timespec { tv_sec: time / 1_000_000_000, tv_nsec: time % 1_000_000_000 };
    // A signal only ends it early, which the caller sees.
    let _ = clock_nanosleep_absolute(ClockId::Monotonic, &time);
}

pub fn sleep(duration: Duration) {
    sleep_until(now() + duration.as_nanos() as i64);
}

pub fn seconds_since(time: i64) -> f64 {
    (now() - time) as f64 / 1e9
}

/// By default the kernel may wake a thread 50 µs late to save power.
pub fn wake_exactly() {
    if let Some(least) = NonZeroU64::new(1) {
        // Where it is not allowed, the calibration beside each row shows it.
        let _ = rustix::thread::set_current_timer_slack(Some(least));
    }
}

/// The measuring side comes before everything else on the machine where that is allowed; the program that
/// is measured does not.
pub fn prefer_this_thread() {
    // On Linux a priority is a thread's own; without the right to it, the wire's own lateness shows.
    let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), -19);
}
