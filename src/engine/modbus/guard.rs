//! One door for all kinds of links, so that the edge has one loop.

use crate::engine::modbus::{Reply, Request, rtu, tcp};
use crate::engine::settings::Link;
use crate::engine::time::{Duration, Time};

/// What stands between a link and the bus: only the answer to the request in flight passes. The
/// edge moves bytes and tells the time:
///
/// 1. [`Guard::begin`]; a reply at once means that nothing is to be sent.
/// 2. Read the link until [`Guard::earliest_send`], which bytes that come may put off.
/// 3. Write [`Guard::frame`] and call [`Guard::sent`].
/// 4. Call [`Guard::received`] with what comes and [`Guard::wake`] when [`Guard::wake_at`] has
///    come, until one of them returns the reply.
///
/// Bytes that come between requests are handed to `received` as well. A reply with
/// [`crate::engine::modbus::RequestError::Link`] means that the link is of no use and must be
/// closed.
#[derive(Debug)]
pub enum Guard {
    Rtu(rtu::Guard),
    Tcp(tcp::Guard),
}

impl Guard {
    /// The guard for `link`. `gap`: silence before each RTU request, `None`: the line's own.
    pub fn new(link: &Link, gap: Option<Duration>) -> Guard {
        match link {
            Link::Serial { line, rs485, .. } => {
                let guard = rtu::Guard::new(*line, gap, None);
                Guard::Rtu(guard.with_delay_before_send(rs485.delay_before_send()))
            }
            Link::RtuOverTcp { line, .. } => Guard::Rtu(rtu::Guard::new(*line, gap, None)),
            Link::Tcp { .. } => Guard::Tcp(tcp::Guard::new()),
        }
    }

    pub fn begin(&mut self, now: Time, request: &Request, timeout: Duration) -> Option<Reply> {
        match self {
            Guard::Rtu(guard) => guard.begin(now, request, timeout),
            Guard::Tcp(guard) => guard.begin(now, request, timeout),
        }
    }

    pub fn earliest_send(&self, now: Time) -> Time {
        match self {
            Guard::Rtu(guard) => guard.earliest_send(now),
            Guard::Tcp(guard) => guard.earliest_send(now),
        }
    }

    pub fn frame(&self) -> &[u8] {
        match self {
            Guard::Rtu(guard) => guard.frame(),
            Guard::Tcp(guard) => guard.frame(),
        }
    }

    pub fn sent(&mut self, now: Time) {
        match self {
            Guard::Rtu(guard) => guard.sent(now),
            Guard::Tcp(guard) => guard.sent(now),
        }
    }

    pub fn received(&mut self, now: Time, bytes: &[u8]) -> Option<Reply> {
        match self {
            Guard::Rtu(guard) => guard.received(now, bytes),
            Guard::Tcp(guard) => guard.received(now, bytes),
        }
    }

    pub fn wake_at(&self) -> Option<Time> {
        match self {
            Guard::Rtu(guard) => guard.wake_at(),
            Guard::Tcp(guard) => guard.wake_at(),
        }
    }

    pub fn wake(&mut self, now: Time) -> Option<Reply> {
        match self {
            Guard::Rtu(guard) => guard.wake(now),
            Guard::Tcp(guard) => guard.wake(now),
        }
    }

    /// The link broke or is closed: the request on its way ends, the line is forgotten.
    pub fn link_lost(&mut self, now: Time, reason: &str) -> Option<Reply> {
        match self {
            Guard::Rtu(guard) => guard.link_lost(now, reason),
            Guard::Tcp(guard) => guard.link_lost(now, reason),
        }
    }
}
