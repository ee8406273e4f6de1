//! A bus's thread and its handle, on a pseudo-terminal whose far end the test holds.

use std::os::fd::OwnedFd;
use std::sync::mpsc::{Receiver, channel};

use rustix::pty::{OpenptFlags, openpt, ptsname, unlockpt};

use super::*;
use crate::engine::configuration;
use crate::engine::modbus::crc::crc;
use crate::engine::profile::Library;
use crate::engine::time::Duration;

const PATIENCE: Duration = Duration::from_secs(10);

/// A bus with one device, whose only point is `input 0`.
fn settings(serial: &str, response_timeout: &str) -> Arc<Settings> {
    let text = format!(
        "home_assistant: {{discovery: false}}
buses: {{line: {{serial: {serial}, baud: 115200, parity: none, response_timeout: {response_timeout}}}}}
devices: {{one: {{bus: line, unit: 1, points: {{a: {{at: input 0, poll: fast}}}}}}}}
"
    );
    let loaded = configuration::load("busker.yaml", text.as_bytes(), &Library::shipped());
    Arc::new(loaded.expect("a good configuration").0)
}

/// The far end of a pseudo-terminal, and the near end's path.
fn line() -> (OwnedFd, String) {
    let far = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).expect("a pseudo-terminal");
    unlockpt(&far).expect("a pseudo-terminal");
    let path = ptsname(&far, Vec::new()).expect("its name").into_string().expect("plain letters");
    (far, path)
}

fn nowhere() -> Arc<StateFiles> {
    Arc::new(StateFiles::nowhere())
}

fn run(settings: Arc<Settings>) -> (BusHandle, Receiver<Message>) {
    let (sender, messages) = channel();
    // The test may have heard enough.
    let publish = move |message| drop(sender.send(message));
    let bus = Threads::default()
        .start(settings, 0, Clock::start(), nowhere(), Box::new(publish))
        .expect("a thread");
    (bus, messages)
}

/// Waits for a request; the terminal has no other end until the thread has opened it.
fn hear_request(far: &OwnedFd) {
    let mut heard = 0;
    let clock = Clock::start();
    let end = clock.now() + PATIENCE;
    while heard < 8 {
        assert!(clock.now() < end, "no request came");
        match rustix::io::read(far, &mut [0; 8]) {
            Ok(count) => heard += count,
            Err(_) => std::thread::sleep(Duration::from_millis(1)),
        }
    }
}

fn answer(far: &OwnedFd, word: u16) {
    let mut frame = [&[1, 4, 2][..], &word.to_be_bytes()].concat();
    frame.extend(crc(&frame).to_le_bytes());
    rustix::io::write(far, &frame).expect("the line is open");
}

fn wait_for(messages: &Receiver<Message>, topic: &str, payload: &str) {
    loop {
        let message = messages.recv_timeout(PATIENCE).expect("the message comes");
        if (message.topic.as_str(), message.payload.as_str()) == (topic, payload) {
            return;
        }
    }
}

#[test]
fn the_bus_can_be_looked_at_while_a_request_is_in_flight() {
    let (far, path) = line();
    let (bus, messages) = run(settings(&path, "30s"));
    hear_request(&far);
    let report = bus.inspect(|bus, now| bus.report(now)).blocking_recv().expect("the thread lives");
    assert!(report.up);
    assert_eq!(report.counters.requests, 0, "the request is still on its way");
    answer(&far, 21);
    wait_for(&messages, "busker/one/a", "21");
    bus.shutdown();
    bus.join();
}

#[test]
fn at_the_end_the_request_in_flight_is_finished_and_offline_is_the_last_word() {
    let (far, path) = line();
    let (bus, messages) = run(settings(&path, "30s"));
    hear_request(&far);
    bus.shutdown();
    // The thread has seen it: what it was asked for before is answered first.
    bus.inspect(|_, _| ()).blocking_recv().expect("the thread waits for the reply");
    answer(&far, 22);
    bus.join();
    let told: Vec<Message> = messages.iter().collect();
    assert!(told.iter().any(|message| message.topic == "busker/one/a" && message.payload == "22"));
    let availability = told.iter().rfind(|message| message.topic == "busker/one/availability");
    assert_eq!(availability.map(|message| message.payload.as_str()), Some("offline"));
}

#[test]
fn a_bus_without_its_port_says_why_and_ends_at_once() {
    let (bus, _messages) = run(settings("/dev/no-such", "1s"));
    let clock = Clock::start();
    loop {
        let report = bus.inspect(|bus, now| bus.report(now)).blocking_recv().expect("the thread lives");
        if report.reason.as_deref() == Some("`/dev/no-such` is not there; is the adapter plugged in?") {
            break;
        }
        assert!(clock.now() < Time(0) + PATIENCE, "{:?}", report.reason);
    }
    bus.shutdown();
    bus.join();
}

#[test]
fn what_does_not_fit_into_the_inbox_is_refused_and_not_waited_for() {
    let (held, hold) = channel::<()>();
    let hold = Mutex::new(hold);
    // The thread hangs in its first message until the test lets go.
    let publish = move |_| {
        let _ = hold.lock().expect("one thread").recv();
    };
    let bus = Threads::default()
        .start(settings("/dev/no-such", "1s"), 0, Clock::start(), nowhere(), Box::new(publish))
        .expect("a thread");
    let taken = (0..=Inbox::LIMIT).filter(|_| bus.send(Event::BrokerUp).is_ok()).count();
    assert_eq!(taken, Inbox::LIMIT);
    assert_eq!(bus.send(Event::BrokerUp), Err(Full));
    let looks: Vec<_> = (0..LOOKS_MAX).map(|_| bus.inspect(|_, _| ())).collect();
    assert!(bus.inspect(|_, _| ()).blocking_recv().is_err(), "a question is refused as well");
    drop(looks);
    drop(held);
    bus.shutdown();
    bus.join();
}
