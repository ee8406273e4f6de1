//! A way to the broker that can be made bad: it holds bytes back, cuts connections in the middle of a
//! packet, refuses, or leads elsewhere.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use crate::support;

/// How often somebody who waits in `read` looks whether the way has changed.
const LOOK_EVERY: Duration = Duration::from_millis(10);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Way {
    Open,
    /// Nothing passes, in either direction, and nobody is told.
    Held,
    /// Nothing passes to the broker.
    HeldToBroker,
    /// Connections are taken and closed.
    Refused,
    /// What has come is passed on, and then the connection is closed.
    LastWords,
}

#[derive(Debug)]
struct State {
    way: Way,
    upstream: u16,
    /// Each connection ends after so many bytes to the broker.
    cut_to_broker: Option<usize>,
    /// Each connection ends after so many bytes from the broker.
    cut_from_broker: Option<usize>,
    /// Both sides of each connection that is there, by its number.
    pairs: Vec<(usize, [TcpStream; 2])>,
    accepted: usize,
    /// What has passed to the broker since somebody last forgot it.
    told: Vec<u8>,
}

type Shared = Arc<(Mutex<State>, Condvar)>;

/// Listens on a port of its own for as long as the test runs.
pub struct Proxy {
    pub port: u16,
    shared: Shared,
}

impl Proxy {
    pub fn to(upstream: u16) -> Proxy {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let port = listener.local_addr().expect("its address").port();
        let state = State {
            way: Way::Open,
            upstream,
            cut_to_broker: None,
            cut_from_broker: None,
            pairs: Vec::new(),
            accepted: 0,
            told: Vec::new(),
        };
        let shared: Shared = Arc::new((Mutex::new(state), Condvar::new()));
        let own = shared.clone();
        thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                take(&own, client);
            }
        });
        Proxy { port, shared }
    }

    /// Nothing passes any longer, as if a cable were pulled.
    pub fn hold(&self) {
        self.set(|state| state.way = Way::Held);
    }

    /// What the broker says passes, and nothing that is said to it.
    pub fn hold_to_broker(&self) {
        self.set(|state| state.way = Way::HeldToBroker);
    }

    pub fn open(&self) {
        self.set(|state| {
            state.way = Way::Open;
            (state.cut_to_broker, state.cut_from_broker) = (None, None);
        });
    }

    /// Connections end, and new ones are closed at once.
    pub fn refuse(&self) {
        self.set(|state| state.way = Way::Refused);
        self.cut();
    }

    /// Passes on what is held, and ends all connections with it; new ones are closed at once.
    pub fn pass_last_words(&self) {
        self.set(|state| state.way = Way::LastWords);
        // Each pump ends its own connection.
        let ended = support::find(|| self.state().pairs.is_empty().then_some(()));
        ended.expect("the connections end");
        self.set(|state| state.way = Way::Refused);
    }

    /// Ends the connections that there are; new ones are taken.
    pub fn cut(&self) {
        for socket in self.state().pairs.drain(..).flat_map(|(_, both)| both) {
            // It may have gone already.
            let _ = socket.shutdown(Shutdown::Both);
        }
    }

    /// From now on each connection ends after so many bytes in a direction.
    pub fn cut_after(&self, to_broker: Option<usize>, from_broker: Option<usize>) {
        self.set(|state| (state.cut_to_broker, state.cut_from_broker) = (to_broker, from_broker));
    }

    pub fn lead_to(&self, upstream: u16) {
        self.set(|state| state.upstream = upstream);
        self.cut();
    }

    /// Connections so far.
    pub fn accepted(&self) -> usize {
        self.state().accepted
    }

    pub fn forget_told(&self) {
        self.state().told.clear();
    }

    /// Waits until `what` has passed to the broker, whether that takes it or not.
    #[track_caller]
    pub fn wait_until_told(&self, what: &[u8]) {
        let is_told = || self.state().told.windows(what.len()).any(|part| part == what);
        support::find(|| is_told().then_some(())).expect("the gateway tells it");
    }

    /// Waits until `what` lies on one of the sides of a connection that is held.
    #[track_caller]
    pub fn wait_until_held(&self, what: &[u8]) {
        let lies = |socket: &TcpStream| {
            let mut bytes = vec![0; 1 << 16];
            // Nothing to see is an error with a time limit, and means the same.
            let length = socket.peek(&mut bytes).unwrap_or(0);
            bytes[..length].windows(what.len()).any(|part| part == what)
        };
        let sides = || -> Vec<TcpStream> {
            let state = self.state();
            let sides = state.pairs.iter().flat_map(|(_, both)| both);
            sides.map(|socket| socket.try_clone().expect("a descriptor")).collect()
        };
        support::find(|| sides().iter().any(lies).then_some(())).expect("it comes to the proxy");
    }

    fn state(&self) -> MutexGuard<'_, State> {
        lock(&self.shared)
    }

    fn set(&self, change: impl FnOnce(&mut State)) {
        change(&mut self.state());
        self.shared.1.notify_all();
    }
}

fn take(shared: &Shared, client: TcpStream) {
    let (number, way, upstream) = {
        let mut state = lock(shared);
        state.accepted += 1;
        (state.accepted, state.way, state.upstream)
    };
    if let Way::Refused | Way::LastWords = way {
        return;
    }
    let Ok(broker) = TcpStream::connect(("127.0.0.1", upstream)) else { return };
    for socket in [&client, &broker] {
        socket.set_read_timeout(Some(LOOK_EVERY)).expect("the time is positive");
        socket.set_nodelay(true).expect("a TCP socket");
    }
    let clone = |socket: &TcpStream| socket.try_clone().expect("a descriptor");
    lock(shared).pairs.push((number, [clone(&client), clone(&broker)]));
    for (from, to, to_broker) in [(clone(&client), clone(&broker), true), (broker, client, false)] {
        let shared = shared.clone();
        thread::spawn(move || {
            pump(&shared, &from, &to, to_broker);
            // The other side may have gone already.
            let _ = from.shutdown(Shutdown::Both);
            let _ = to.shutdown(Shutdown::Both);
            lock(&shared).pairs.retain(|(other, _)| *other != number);
        });
    }
}

/// Passes on what comes, until one side ends or the way does.
fn pump(shared: &Shared, mut from: &TcpStream, mut to: &TcpStream, to_broker: bool) {
    let (mut bytes, mut passed) = ([0; 4096], 0);
    let is_held = |state: &mut State| state.way == Way::Held || (to_broker && state.way == Way::HeldToBroker);
    loop {
        let way = {
            let state = lock(shared);
            let waited = shared.1.wait_while(state, is_held);
            waited.unwrap_or_else(PoisonError::into_inner).way
        };
        // Only looked at, since it may be held while we wait here: then it stays where `wait_until_held` looks.
        match from.peek(&mut bytes) {
            Ok(0) => return,
            Ok(_) => {}
            Err(error)
                if matches!(error.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut) =>
            {
                // Only when nothing more has come: what was read first may have been something else.
                if way == Way::LastWords && !to_broker {
                    return;
                }
                continue;
            }
            Err(_) => return,
        }
        let limit = {
            let state = lock(shared);
            let state = shared.1.wait_while(state, is_held);
            let state = state.unwrap_or_else(PoisonError::into_inner);
            if to_broker { state.cut_to_broker } else { state.cut_from_broker }
        };
        let Ok(length) = from.read(&mut bytes) else { return };
        let allowed = limit.map_or(length, |limit| limit.saturating_sub(passed).min(length));
        if to.write_all(&bytes[..allowed]).is_err() || limit.is_some_and(|limit| passed + allowed >= limit) {
            return;
        }
        passed += allowed;
        if to_broker {
            lock(shared).told.extend(&bytes[..allowed]);
        }
    }
}

fn lock(shared: &Shared) -> MutexGuard<'_, State> {
    shared.0.lock().unwrap_or_else(PoisonError::into_inner)
}
