//! A link and its guard: moves bytes between the two, stamps them, and keeps the guard's times.

use std::os::fd::{AsFd, BorrowedFd};

use rustix::event::{PollFd, PollFlags, poll};

use crate::edge::bell::Bell;
use crate::edge::clock::Clock;
use crate::edge::expectation::{ANY, Expectation};
use crate::edge::link::{Link, Lost, timespec};
use crate::engine::modbus::guard::Guard;
use crate::engine::modbus::{Reply, Request, RequestError};
use crate::engine::recorder::Tape;
use crate::engine::time::{Duration, Time};

/// Reads in a row before anything else has its turn; a line that babbles must not stop the rest.
const READS_MAX: usize = 8;

pub struct GuardedLink {
    link: Link,
    guard: Guard,
    clock: Clock,
    /// A request that has begun and is not yet sent, and when it may be.
    not_before: Option<Time>,
    /// When what is there to be read came, if that is known to be earlier than now.
    came_at: Option<Time>,
    expectation: Expectation,
    /// What was last read from it. Not made anew, and filled with zeros, for each read.
    buffer: [u8; 512],
}

impl GuardedLink {
    pub fn new(link: Link, guard: Guard, clock: Clock) -> GuardedLink {
        GuardedLink {
            link,
            guard,
            clock,
            not_before: None,
            came_at: None,
            expectation: Expectation::default(),
            buffer: [0; 512],
        }
    }

    /// Takes a request; it is sent now or by [`GuardedLink::advance`] when its time has come. A reply at
    /// once: it cannot be asked.
    pub fn begin(
        &mut self,
        request: &Request,
        not_before: Time,
        timeout: Duration,
        tape: &mut Tape,
    ) -> Result<Option<Reply>, Lost> {
        let now = self.clock.now();
        let reply = self.guard.begin(now, request, timeout);
        if reply.is_some() {
            self.not_before = None;
            return usable(reply);
        }
        self.not_before = Some(not_before);
        if now < not_before.max(self.guard.earliest_send(now)) {
            return Ok(None);
        }
        match &self.guard {
            // What is still to be read belongs to older transactions, and says so.
            Guard::Tcp(_) => self.send_or_wake(now, tape),
            Guard::Rtu(_) => self.advance(tape),
        }
    }

    /// When to call [`GuardedLink::advance`] although nothing came.
    pub fn wake_at(&self) -> Option<Time> {
        self.send_at().or_else(|| self.guard.wake_at())
    }

    /// When the request that has begun is to be sent, as exactly as can be.
    pub fn send_at(&self) -> Option<Time> {
        self.not_before.map(|time| time.max(self.guard.earliest_send(self.clock.now())))
    }

    /// When the reply to the request on the wire is likely to come, where that is known.
    pub fn reply_expected_at(&self) -> Option<Time> {
        if self.not_before.is_some() { None } else { self.expectation.at() }
    }

    /// What is there to be read came by this time at the latest.
    pub fn woken_by(&mut self, time: Time) {
        self.came_at = Some(time);
    }

    /// Does what is due: reads, sends, tells the guard the time. Never waits. What is sent and what
    /// comes goes on the tape.
    pub fn advance(&mut self, tape: &mut Tape) -> Result<Option<Reply>, Lost> {
        let mut came_at = self.came_at.take();
        for _ in 0..READS_MAX {
            let Some(count) = self.link.read(&mut self.buffer)? else { break };
            let time = came_at.take().unwrap_or_else(|| self.clock.now());
            let bytes = &self.buffer[..count];
            tape.heard(time, bytes);
            let reply = self.guard.received(time, bytes);
            if reply.is_some() {
                self.expectation.answered(time);
                return usable(reply);
            }
        }
        self.send_or_wake(self.clock.now(), tape)
    }

    fn send_or_wake(&mut self, now: Time, tape: &mut Tape) -> Result<Option<Reply>, Lost> {
        match self.not_before {
            Some(not_before) if now >= not_before.max(self.guard.earliest_send(now)) => {
                self.not_before = None;
                self.link.write(self.guard.frame())?;
                self.guard.sent(now);
                self.expectation.asked(question(&self.guard), now);
                tape.sent(now, self.guard.frame());
                Ok(None)
            }
            Some(_) => Ok(None),
            None if self.guard.wake_at().is_some_and(|at| now >= at) => usable(self.guard.wake(now)),
            None => Ok(None),
        }
    }

    /// Takes a request back that is not yet sent, as if it had never begun; `false` if it is on the wire.
    pub fn take_back(&mut self) -> bool {
        self.not_before.take().is_some()
    }

    /// Ends a request that is not yet sent; one on the wire goes on.
    pub fn withdraw(&mut self, reason: &str) -> Option<Reply> {
        self.not_before.take()?;
        self.guard.link_lost(self.clock.now(), reason)
    }

    /// Asks one question and waits for its reply: for verbs that talk to one device by hand.
    pub fn ask(&mut self, request: &Request, timeout: Duration) -> Result<Reply, Lost> {
        let mut tape = Tape::new(0);
        if let Some(reply) = self.begin(request, Time(0), timeout, &mut tape)? {
            return Ok(reply);
        }
        loop {
            if let Some(reply) = self.advance(&mut tape)? {
                return Ok(reply);
            }
            wait(Some(self), None, self.wake_at().map(|at| self.clock.until(at)))?;
        }
    }
}

impl AsFd for GuardedLink {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.link.as_fd()
    }
}

/// By what a question is known when it is asked again. On a line each takes a time of its own; on a network the
/// length of a frame takes none.
fn question(guard: &Guard) -> &[u8] {
    match guard {
        Guard::Rtu(guard) => guard.frame(),
        Guard::Tcp(_) => &ANY,
    }
}

/// A reply that names the link as the fault is no reply but the link's end.
fn usable(reply: Option<Reply>) -> Result<Option<Reply>, Lost> {
    match reply {
        Some(Reply { result: Err(RequestError::Link(reason)), .. }) => Err(Lost(reason)),
        reply => Ok(reply),
    }
}

/// What ended a wait; neither: the time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Woken {
    pub bell: bool,
    pub link: bool,
}

/// Waits until bytes come, the bell rings or `timeout` has passed; `None`: for ever.
pub fn wait(
    link: Option<&GuardedLink>,
    bell: Option<&Bell>,
    timeout: Option<Duration>,
) -> Result<Woken, Lost> {
    let mut descriptors: Vec<PollFd<'_>> = Vec::with_capacity(2);
    descriptors.extend(bell.map(|bell| PollFd::new(bell, PollFlags::IN)));
    descriptors.extend(link.map(|link| PollFd::new(link, PollFlags::IN)));
    match poll(&mut descriptors, timeout.map(timespec).as_ref()) {
        Ok(_) => {
            let mut called = descriptors.iter().map(|descriptor| !descriptor.revents().is_empty());
            let bell = bell.is_some() && called.next() == Some(true);
            Ok(Woken { bell, link: called.next() == Some(true) })
        }
        // It may be for anything.
        Err(rustix::io::Errno::INTR) => Ok(Woken { bell: true, link: true }),
        Err(error) => Err(Lost(error.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use std::os::fd::OwnedFd;

    use rustix::pty::{OpenptFlags, openpt, ptsname, unlockpt};

    use super::*;
    use crate::engine::address::{Span, Table};
    use crate::engine::modbus::crc::crc;
    use crate::engine::modbus::{Answer, Call};
    use crate::engine::settings::{self, Direction, Line, Parity, Rs485};

    const TIMEOUT: Duration = Duration::from_millis(300);

    /// The far end of a line, and the link to it.
    fn line() -> (OwnedFd, GuardedLink) {
        let far = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).expect("a pseudo-terminal");
        unlockpt(&far).expect("a pseudo-terminal");
        let path = ptsname(&far, Vec::new()).expect("its name").into_string().expect("plain letters");
        let line = Line { baud: 115_200, parity: Parity::None, stop_bits: 1 };
        let settings = settings::Link::Serial { path, line, rs485: Rs485::Auto };
        let link = Link::open(&settings).expect("the port opens");
        (far, GuardedLink::new(link, Guard::new(&settings, None), Clock::start()))
    }

    fn read_two() -> Request {
        Request::new(1, Call::Read(Span::with_count(Table::Holding, 0, 2).expect("a span")))
    }

    fn read_exactly(far: &OwnedFd, mut count: usize) {
        let mut buffer = [0; 64];
        while count > 0 {
            count -= rustix::io::read(far, &mut buffer[..count]).expect("the line is open");
        }
    }

    fn reply(words: [u8; 4]) -> Vec<u8> {
        let mut frame = [&[1, 3, 4][..], &words].concat();
        frame.extend(crc(&frame).to_le_bytes());
        frame
    }

    #[test]
    fn a_request_is_sent_and_its_reply_comes_back_in_whatever_pieces() {
        let (far, mut link) = line();
        let peer = std::thread::spawn(move || {
            for piece in [9, 1, 4] {
                read_exactly(&far, 8);
                for bytes in reply([0, 1, 0, 2]).chunks(piece) {
                    rustix::io::write(&far, bytes).expect("the line is open");
                }
            }
            far
        });
        for _ in 0..3 {
            let reply = link.ask(&read_two(), TIMEOUT).expect("the link stays");
            assert_eq!(reply.result, Ok(Answer::Words(vec![1, 2])));
            assert!(reply.sent_at <= reply.first_byte_at.expect("bytes came"));
        }
        peer.join().expect("the peer had its requests");
    }

    #[test]
    fn silence_is_a_timeout_and_a_gone_peer_a_lost_link() {
        let (far, mut link) = line();
        assert_eq!(link.ask(&read_two(), TIMEOUT).map(|reply| reply.result), Ok(Err(RequestError::Timeout)));
        drop(far);
        assert_eq!(link.ask(&read_two(), TIMEOUT), Err(Lost("unplugged".into())));
    }

    #[test]
    fn a_port_is_opened_by_one_program_only_and_says_what_is_wrong_with_it() {
        let far = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).expect("a pseudo-terminal");
        unlockpt(&far).expect("a pseudo-terminal");
        let path = ptsname(&far, Vec::new()).expect("its name").into_string().expect("plain letters");
        let line = Line { baud: 9600, parity: Parity::Even, stop_bits: 1 };
        let serial = |path: &str| settings::Link::Serial { path: path.into(), line, rs485: Rs485::Auto };
        let first = Link::open(&serial(&path)).expect("the port opens");
        let why = |path: &str| Link::open(&serial(path)).expect_err("it does not open").0;
        assert_eq!(why(&path), format!("`{path}` is in use by another program"));
        assert_eq!(why("/dev/null"), "`/dev/null` is no serial port");
        assert_eq!(why("/dev/no-such"), "`/dev/no-such` is not there; is the adapter plugged in?");
        drop(first);
        Link::open(&serial(&path)).expect("it is free again");

        // A port whose driver cannot switch a transceiver is not opened as if it could, and stays free.
        let rs485 = |rs485| settings::Link::Serial { path: path.clone(), line, rs485 };
        let refused = Link::open(&rs485(Rs485::Kernel(Direction::default()))).expect_err("no RTS").0;
        assert_eq!(
            refused,
            format!(
                "`{path}`: its driver cannot switch an RS485 transceiver; most adapters do it by \
                 themselves: leave `rs485` out"
            )
        );
        Link::open(&rs485(Rs485::None)).expect("nothing switches anyway");
    }

    #[test]
    fn the_silence_between_two_frames_is_kept() {
        let (far, mut link) = line();
        let peer = std::thread::spawn(move || {
            for _ in 0..20 {
                read_exactly(&far, 8);
                rustix::io::write(&far, &reply([0, 1, 0, 2])).expect("the line is open");
            }
            far
        });
        let mut last = None;
        for _ in 0..20 {
            let reply = link.ask(&read_two(), TIMEOUT).expect("the link stays");
            let heard_at = reply.last_byte_at.expect("it was answered");
            let gap = last.replace(heard_at).map(|before| reply.sent_at.since(before));
            assert!(gap.is_none_or(|gap| gap >= Duration::from_micros(1750)), "{gap:?}");
        }
        peer.join().expect("the peer had its requests");
    }
}
