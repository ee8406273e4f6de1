//! A small MQTT client that stamps what it hears at the `read`, so that no library's queue stands between
//! the wire and the clock.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use anyhow::{Context, bail};

use crate::clock::now;

/// A message and when it came.
#[derive(Clone, Debug)]
pub struct Message {
    pub topic: String,
    pub payload: String,
    pub at: i64,
}

/// Hears what is published, and publishes.
pub struct Observer {
    stream: TcpStream,
    heard: Arc<Mutex<Vec<Message>>>,
    thread: Option<JoinHandle<()>>,
}

impl Observer {
    /// Returns when the subscription stands.
    pub fn start(port: u16, filter: &str) -> anyhow::Result<Observer> {
        let mut stream = TcpStream::connect(("127.0.0.1", port)).context("the broker is not there")?;
        stream.set_nodelay(true)?;
        let name = format!("bench{}", now());
        // Protocol 3.1.1, a clean session, no keep-alive.
        let mut connect = text("MQTT");
        connect.extend([4, 2, 0, 0]);
        connect.extend(text(&name));
        let mut subscribe = vec![0, 1];
        subscribe.extend(text(filter));
        subscribe.push(0);
        stream.write_all(&[packet(0x10, &connect), packet(0x82, &subscribe)].concat())?;
        // CONNACK has four bytes, SUBACK five.
        let mut answers = [0; 9];
        stream.read_exact(&mut answers)?;
        if answers[3] != 0 || answers[8] == 0x80 {
            bail!("the broker refuses the observer");
        }
        let heard = Arc::new(Mutex::new(Vec::new()));
        let (of_thread, reader) = (heard.clone(), stream.try_clone()?);
        let thread = std::thread::Builder::new().name("observer".into()).spawn(move || {
            crate::clock::prefer_this_thread();
            listen(reader, &of_thread);
        })?;
        Ok(Observer { stream, heard, thread: Some(thread) })
    }

    /// Publishes, and returns when that was.
    pub fn publish(&mut self, topic: &str, payload: &str) -> anyhow::Result<i64> {
        let mut content = text(topic);
        content.extend(payload.bytes());
        let packet = packet(0x30, &content);
        let at = now();
        self.stream.write_all(&packet)?;
        Ok(at)
    }

    /// Takes what was heard since this was last called.
    pub fn take(&self) -> Vec<Message> {
        std::mem::take(&mut *self.heard.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Drop for Observer {
    fn drop(&mut self) {
        // The broker may be gone already.
        let _ = self.stream.shutdown(Shutdown::Both);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn listen(mut stream: TcpStream, heard: &Mutex<Vec<Message>>) {
    let mut bytes = Vec::new();
    let mut buffer = vec![0; 1 << 16];
    loop {
        let count = match stream.read(&mut buffer) {
            Ok(0) | Err(_) => return,
            Ok(count) => count,
        };
        let at = now();
        bytes.extend_from_slice(&buffer[..count]);
        let mut used = 0;
        let mut messages = Vec::new();
        while let Some((kind, content, length)) = first_packet(&bytes[used..]) {
            if kind >> 4 == 3 && content.len() >= 2 {
                let topic_end = 2 + usize::from(u16::from_be_bytes([content[0], content[1]]));
                let (topic, payload) = content.split_at(topic_end.min(content.len()));
                let words = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
                messages.push(Message { topic: words(&topic[2..]), payload: words(payload), at });
            }
            used += length;
        }
        bytes.drain(..used);
        heard.lock().unwrap_or_else(PoisonError::into_inner).append(&mut messages);
    }
}

/// The first whole packet: its first byte, its content, and its length with everything.
fn first_packet(bytes: &[u8]) -> Option<(u8, &[u8], usize)> {
    let mut length = 0;
    for (at, byte) in bytes.iter().skip(1).take(4).enumerate() {
        length |= usize::from(byte & 0x7F) << (7 * at);
        if byte & 0x80 == 0 {
            let begin = at + 2;
            return Some((bytes[0], bytes.get(begin..begin + length)?, begin + length));
        }
    }
    None
}

fn packet(kind: u8, content: &[u8]) -> Vec<u8> {
    let mut packet = vec![kind];
    let mut length = content.len();
    loop {
        let more = if length > 127 { 0x80 } else { 0 };
        packet.push(length as u8 & 0x7F | more);
        length >>= 7;
        if length == 0 {
            break;
        }
    }
    packet.extend(content);
    packet
}

fn text(text: &str) -> Vec<u8> {
    let mut bytes = (text.len() as u16).to_be_bytes().to_vec();
    bytes.extend(text.bytes());
    bytes
}
