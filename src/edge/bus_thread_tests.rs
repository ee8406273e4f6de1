//! A bus's thread and its handle, on a pseudo-terminal whose far end the test holds.

use std::future::Future;
use std::io::{Read, Write};
use std::net::TcpListener;
use std::os::fd::OwnedFd;
use std::pin::pin;
use std::sync::mpsc::{Receiver, channel};
use std::task::{Context, Waker};

use rustix::pty::{OpenptFlags, openpt, ptsname, unlockpt};

use super::*;
use crate::edge::state_files::StateFiles;
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

/// Threads that stir `stir` and keep nothing.
fn threads(stir: Arc<Stir>) -> Threads {
    Threads::new(Clock::start(), Arc::new(Shelf::new(StateFiles::nowhere())), stir)
}

fn run(settings: Arc<Settings>) -> (BusHandle, Receiver<Message>) {
    run_with(&threads(Arc::default()), settings)
}

fn run_with(threads: &Threads, settings: Arc<Settings>) -> (BusHandle, Receiver<Message>) {
    let (sender, messages) = channel();
    // The test may have heard enough.
    let publish = move |message| drop(sender.send(message));
    let bus = threads.start(settings, 0, Box::new(publish)).expect("a thread");
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
    let threads = threads(Arc::default());
    let bus = threads.start(settings("/dev/no-such", "1s"), 0, Box::new(publish)).expect("a thread");
    let get = || Event::Get { device: "thermometer".into(), point: "temperature".into() };
    let taken = (0..=Inbox::LIMIT).filter(|_| bus.send(get()).is_ok()).count();
    assert_eq!(taken, Inbox::LIMIT);
    assert_eq!(bus.send(get()), Err(Full));
    assert_eq!(bus.send(Event::BrokerDown), Ok(None), "news of the gateway itself have room all the same");
    let looks: Vec<_> = (0..LOOKS_MAX).map(|_| bus.inspect(|_, _| ())).collect();
    assert!(bus.inspect(|_, _| ()).blocking_recv().is_err(), "a question is refused as well");
    drop(looks);
    drop(held);
    bus.shutdown();
    bus.join();
}

/// Answers `input 0` with 7 until the connection is closed.
fn serve(listener: TcpListener) {
    let (mut stream, _) = listener.accept().expect("the bus connects");
    let mut request = [0; 12];
    while stream.read_exact(&mut request).is_ok() {
        let reply = [&request[..4], &[0, 5, request[6], 4, 2, 0, 7]].concat();
        if stream.write_all(&reply).is_err() {
            return;
        }
    }
}

#[test]
fn connections_share_a_thread_and_end_one_by_one() {
    let mut text = String::from("home_assistant: {discovery: false}\nbuses:\n");
    let mut devices = String::from("devices:\n");
    for name in ["one", "two", "three"] {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        text +=
            &format!("  {name}: {{tcp: \"127.0.0.1:{}\"}}\n", listener.local_addr().expect("bound").port());
        devices += &format!(
            "  {name}: {{bus: {name}, unit: 1, poll: {{fast: 1ms}}, points: {{a: {{at: input 0, poll: fast}}}}}}\n"
        );
        std::thread::spawn(move || serve(listener));
    }
    let text = text + &devices;
    let loaded = configuration::load("busker.yaml", text.as_bytes(), &Library::shipped());
    let settings = Arc::new(loaded.expect("a good configuration").0);
    let threads = threads(Arc::default());
    let mut buses = Vec::new();
    let (told_on, thread_of) = channel();
    for index in 0..3 {
        let (sender, messages) = channel();
        let told_on = told_on.clone();
        let publish = move |message| {
            let _ = told_on.send(std::thread::current().id());
            drop(sender.send(message));
        };
        let bus = threads.start(settings.clone(), index, Box::new(publish)).expect("a thread");
        buses.push((bus, messages));
    }
    for (name, (_, messages)) in ["one", "two", "three"].iter().zip(&buses) {
        wait_for(messages, &format!("busker/{name}/a"), "7");
    }
    let ids: Vec<std::thread::ThreadId> = thread_of.try_iter().collect();
    assert!(ids.iter().all(|id| *id == ids[0] && *id != std::thread::current().id()));
    // Two end, in another order than they began; the third goes on, also when nobody can start another.
    drop(threads);
    for (bus, messages) in [buses.remove(1), buses.remove(0)] {
        bus.shutdown();
        bus.join();
        assert!(messages.iter().any(|message| message.payload == "offline"));
        assert!(bus.inspect(|_, _| ()).blocking_recv().is_err(), "it has ended");
    }
    let (last, _) = &buses[0];
    let requests = || last.inspect(|bus, now| bus.summary(now).counters.requests).blocking_recv();
    let before = requests().expect("it goes on");
    let clock = Clock::start();
    while requests().expect("it goes on") <= before {
        assert!(clock.now() < Time(0) + PATIENCE, "nothing is read any more");
    }
    last.shutdown();
    last.join();
}

#[test]
fn a_bus_is_stirred_by_what_happens_to_devices_and_not_by_what_they_tell() {
    let (far, path) = line();
    let stir = Arc::<Stir>::default();
    let is_stirred = || pin!(stir.stirred()).poll(&mut Context::from_waker(Waker::noop())).is_ready();
    let (bus, messages) = run_with(&threads(stir.clone()), settings(&path, "30s"));
    hear_request(&far);
    answer(&far, 21);
    wait_for(&messages, "busker/one/availability", "online");
    // What else comes with it is told by now.
    bus.inspect(|_, _| ()).blocking_recv().expect("the thread lives");
    assert!(is_stirred());
    hear_request(&far);
    answer(&far, 22);
    wait_for(&messages, "busker/one/a", "22");
    bus.inspect(|_, _| ()).blocking_recv().expect("the thread lives");
    assert!(!is_stirred());
    drop(far);
    wait_for(&messages, "busker/one/availability", "offline");
    assert!(is_stirred());
    bus.shutdown();
    bus.join();
}
