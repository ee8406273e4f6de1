//! Connections that cost little and do not last for ever: only so many at once, and one on which nothing
//! moves for a time is closed.

use std::io::{self, IoSlice};
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use axum::serve::Listener;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, Sleep, sleep};

use crate::engine::time::Duration;

/// More than the readers of events, so that they leave room for others.
const CONNECTIONS_MAX: usize = 64;

/// Longer than the silence between two heartbeats of the events.
const IDLE_MAX: Duration = Duration::from_secs(30);

pub struct PatientListener {
    listener: TcpListener,
    places: Arc<Semaphore>,
}

impl PatientListener {
    pub fn new(listener: TcpListener) -> PatientListener {
        PatientListener { listener, places: Arc::new(Semaphore::new(CONNECTIONS_MAX)) }
    }
}

impl Listener for PatientListener {
    type Io = Connection;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Connection, SocketAddr) {
        // It is never closed. Who comes while there is no place waits in the kernel.
        let place = self.places.clone().acquire_owned().await.ok();
        let (stream, address) = Listener::accept(&mut self.listener).await;
        (Connection::new(stream, IDLE_MAX, place), address)
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.listener.local_addr()
    }
}

pub struct Connection {
    stream: TcpStream,
    idle_max: Duration,
    until: Pin<Box<Sleep>>,
    _place: Option<OwnedSemaphorePermit>,
}

impl Connection {
    fn new(stream: TcpStream, idle_max: Duration, place: Option<OwnedSemaphorePermit>) -> Connection {
        Connection { stream, idle_max, until: Box::pin(sleep(idle_max)), _place: place }
    }

    /// What came of an attempt to read or write: something moved, or the waiting goes on, if not for ever.
    fn judge<T>(&mut self, context: &mut Context<'_>, attempt: Poll<io::Result<T>>) -> Poll<io::Result<T>> {
        if attempt.is_ready() {
            let until = Instant::now() + self.idle_max;
            self.until.as_mut().reset(until);
            return attempt;
        }
        self.until.as_mut().poll(context).map(|()| Err(io::ErrorKind::TimedOut.into()))
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let attempt = Pin::new(&mut self.stream).poll_read(context, buffer);
        self.judge(context, attempt)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let attempt = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.judge(context, attempt)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let attempt = Pin::new(&mut self.stream).poll_write_vectored(context, slices);
        self.judge(context, attempt)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    use super::*;

    fn run(test: impl Future<Output = ()>) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        runtime.expect("a runtime").block_on(test);
    }

    /// Both ends; ours loses patience soon.
    async fn pair() -> (Connection, TcpStream) {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
        let theirs = TcpStream::connect(listener.local_addr().expect("its address")).await;
        let (ours, _) = listener.accept().await.expect("somebody comes");
        (Connection::new(ours, Duration::from_millis(50), None), theirs.expect("we connect"))
    }

    #[test]
    fn who_neither_speaks_nor_reads_is_cut_off() {
        run(async {
            let (mut ours, theirs) = pair().await;
            let error = ours.read_u8().await.expect_err("nobody speaks");
            assert_eq!(error.kind(), io::ErrorKind::TimedOut);

            let (mut ours, _unread) = pair().await;
            let chunk = vec![0; 1 << 16];
            let error = loop {
                if let Err(error) = ours.write_all(&chunk).await {
                    break error;
                }
            };
            assert_eq!(error.kind(), io::ErrorKind::TimedOut);
            drop(theirs);
        });
    }

    #[test]
    fn what_moves_is_left_alone() {
        run(async {
            let (mut ours, mut theirs) = pair().await;
            for byte in 0..5 {
                theirs.write_u8(byte).await.expect("it is sent");
                assert_eq!(ours.read_u8().await.ok(), Some(byte));
                ours.write_u8(byte).await.expect("it is sent");
                assert_eq!(theirs.read_u8().await.ok(), Some(byte));
            }
        });
    }
}
