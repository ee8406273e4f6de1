//! What tests of the whole program share: a broker of their own, the built program, and somebody who
//! watches the topics. Each takes free ports and ends with the test.

#![allow(dead_code, unused_imports, reason = "each test uses its own part of it")]

mod broker;
mod gateway;
mod running;
mod watcher;

use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Child;
use std::sync::{Condvar, Mutex};
use std::time::Duration;

use busker::edge::clock::Clock;
use busker::edge::lock::lock;
use busker::engine::time::Time;
use rustix::process::{Pid, Signal, WaitOptions, kill_process, waitpid};
use tempfile::TempDir;

pub use broker::Broker;
pub use gateway::{Gateway, busker, program};
pub use running::{Ended, Running};
pub use watcher::{Received, Watcher};

/// Far longer than anything takes; only a failing test waits for it.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// Looks until there is something; fails with `what` after [`PATIENCE`].
#[track_caller]
pub fn wait_for<T>(what: &str, look: impl FnMut() -> Option<T>) -> T {
    find(look).unwrap_or_else(|| panic!("waited in vain for {what}"))
}

/// Looks until there is something, for as long as [`PATIENCE`].
pub fn find<T>(mut look: impl FnMut() -> Option<T>) -> Option<T> {
    let clock = Clock::start();
    while clock.now() < Time::default() + PATIENCE {
        if let Some(found) = look() {
            return Some(found);
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    None
}

/// A port that nobody listens on at this moment.
pub fn free_port() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").expect("loopback has free ports");
    listener.local_addr().expect("a bound listener has an address").port()
}

pub fn temporary_folder() -> TempDir {
    tempfile::tempdir().expect("a temporary folder")
}

/// A file that only lives as long as the test.
pub fn temporary_file(folder: &TempDir, name: &str, text: &str) -> PathBuf {
    let path = folder.path().join(name);
    fs::write(&path, text).expect("a temporary file can be written");
    path
}

/// Ends a program, which may have ended by itself.
fn end(child: &mut Child) {
    let _ = child.kill();
    let _ = child.wait();
}

/// Stops a program, and waits until it stands: its other threads run on until one of them has had the signal, and
/// would do what it is asked meanwhile.
fn stall(child: &Child) {
    let pid = Pid::from_child(child);
    kill_process(pid, Signal::STOP).expect("the signal is sent");
    let stands = waitpid(Some(pid), WaitOptions::UNTRACED).expect("it is ours");
    assert!(stands.is_some_and(|(_, status)| status.stopped()), "it has ended instead: {stands:?}");
}

/// What a thread collects for a test that waits for it.
type Collected<T> = (Mutex<Vec<T>>, Condvar);

/// Looks whenever something has been added, until there is what is looked for or [`PATIENCE`] ends.
fn wait_on<T, F>(collected: &Collected<T>, look: impl Fn(&[T]) -> Option<F>) -> Option<F> {
    let (all, changed) = collected;
    let mut found = None;
    let waited = changed.wait_timeout_while(lock(all), PATIENCE, |all| {
        found = look(all);
        found.is_none()
    });
    drop(waited);
    found
}

fn collect<T>(collected: &Collected<T>, one: T) {
    lock(&collected.0).push(one);
    collected.1.notify_all();
}
