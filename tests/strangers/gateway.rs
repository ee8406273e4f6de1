//! The gateway reads and writes a server made of pymodbus: all types in all orders of bytes, over
//! Modbus TCP and over a serial line, from MQTT to the registers and back.

use std::fmt::Write as _;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use crate::peers;
use crate::support::{Broker, Gateway, Watcher};

const ORDERS: [&str; 4] = ["abcd", "cdab", "badc", "dcba"];

/// One type of the server's bank (`server.py`).
struct Type {
    name: &'static str,
    /// As a profile names it.
    kind: &'static str,
    register: u16,
    write: &'static str,
    at_first: &'static str,
    written: &'static str,
}

const TYPES: [Type; 10] = [
    Type { name: "u16", kind: "u16", register: 0, write: "0..65535", at_first: "43981", written: "258" },
    Type {
        name: "i16",
        kind: "i16",
        register: 1,
        write: "-32768..32767",
        at_first: "-1234",
        written: "-32768",
    },
    Type {
        name: "u32",
        kind: "u32",
        register: 2,
        write: "0..4294967295",
        at_first: "2309737967",
        written: "4294967294",
    },
    Type {
        name: "i32",
        kind: "i32",
        register: 4,
        write: "-2147483648..2147483647",
        at_first: "-123456789",
        written: "-2147483648",
    },
    Type {
        name: "u48",
        kind: "u48",
        register: 6,
        write: "0..281474976710655",
        at_first: "20015998343868",
        written: "1108152157446",
    },
    Type {
        name: "u64",
        kind: "u64",
        register: 10,
        write: "0..18446744073709551615",
        at_first: "18364758544493064720",
        written: "72623859790382856",
    },
    Type {
        name: "i64",
        kind: "i64",
        register: 14,
        write: "-9223372036854775808..9223372036854775807",
        at_first: "-1234567890123456789",
        written: "-9223372036854775808",
    },
    Type { name: "f32", kind: "f32", register: 18, write: "any", at_first: "-12.375", written: "1234.5" },
    Type {
        name: "f64",
        kind: "f64",
        register: 20,
        write: "any",
        at_first: "2.718281828459045",
        written: "-0.1",
    },
    Type {
        name: "text",
        kind: "text 8",
        register: 24,
        write: "any",
        at_first: "Busker, Raum 12b",
        written: "Keller",
    },
];

#[test]
fn the_gateway_reads_and_writes_all_types_and_orders_of_a_pymodbus_server_over_tcp() {
    check("tcp", |port| format!("{{tcp: \"127.0.0.1:{port}\"}}"));
}

#[test]
fn the_gateway_reads_and_writes_all_types_and_orders_of_a_pymodbus_server_over_a_serial_line() {
    check("rtu", |path| format!("{{serial: {path}, baud: 19200, parity: even}}"));
}

fn check(kind: &str, bus: impl Fn(&str) -> String) {
    let Some(python) = peers::pymodbus() else { return };
    let mut server = Server::start(&python, kind);
    let broker = Broker::start();
    let watcher = Watcher::start(&broker, "watcher");
    let gateway = Gateway::start(&broker, &configuration(&bus(&server.place)));

    let points = || ORDERS.iter().flat_map(|order| TYPES.iter().map(move |each| (*order, each)));
    for (order, each) in points() {
        for table in ["holding", "input"] {
            let topic = format!("busker/stranger/{table}_{order}_{}", each.name);
            watcher.shows(&topic, each.at_first);
        }
    }
    for bit in 0..16 {
        let state = if bit % 3 == 0 { "ON" } else { "OFF" };
        for table in ["coil", "discrete"] {
            watcher.shows(&format!("busker/stranger/{table}_{}", bit + 1), state);
        }
    }

    for (order, each) in points() {
        let topic = format!("busker/stranger/holding_{order}_{}", each.name);
        assert_eq!(write(&watcher, &topic, each.written), "done", "{topic}");
        watcher.shows(&topic, each.written);
    }
    assert_eq!(write(&watcher, "busker/stranger/coil_2", "ON"), "done");

    // What the server itself found in its registers is the proof; the gateway might agree with itself.
    let held = server.held();
    for (order, each) in points() {
        assert_eq!(held[format!("{order}_{}", each.name)], each.written, "{order} {}", each.name);
    }
    assert_eq!(held["coils"], "1101001001001001");
    assert!(gateway.terminate().success());
    watcher.shows("busker/bridge/state", "offline");
}

/// How a command ended.
fn write(watcher: &Watcher, topic: &str, value: &str) -> String {
    let from = watcher.count();
    watcher.publish(&format!("{topic}/set"), value);
    let outcome = watcher.wait_for_next(&format!("{topic}/outcome"), from);
    let outcome: serde_json::Value = serde_json::from_str(&outcome).expect("JSON");
    outcome["outcome"].as_str().expect("a word").to_owned()
}

fn configuration(bus: &str) -> String {
    let mut points = String::new();
    for (number, order) in ORDERS.iter().enumerate() {
        for Type { name, kind, register, write, .. } in &TYPES {
            let at = 100 * number + usize::from(*register);
            let form = format!("type: {kind}, order: {order}, poll: fast");
            let _ = writeln!(
                points,
                "      holding_{order}_{name}: {{at: holding {at}, {form}, write: {write}}}"
            );
            let _ = writeln!(points, "      input_{order}_{name}: {{at: input {at}, {form}}}");
        }
    }
    format!(
        "buses:
  line: {bus}
devices:
  stranger:
    bus: line
    unit: 5
    points:
      coil: {{for: 1..16, at: coil 0, poll: fast, write: any}}
      discrete: {{for: 1..16, at: discrete 0, poll: fast}}
{points}"
    )
}

/// The server of `server.py`; it ends with its standard input.
struct Server {
    child: Child,
    questions: Option<ChildStdin>,
    answers: BufReader<ChildStdout>,
    /// Its port, or the path of its serial line.
    place: String,
}

impl Server {
    fn start(python: &Path, kind: &str) -> Server {
        let mut child = Command::new(python)
            .arg(peers::file("server.py"))
            .arg(kind)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("Python starts");
        let questions = child.stdin.take();
        let mut answers = BufReader::new(child.stdout.take().expect("a pipe"));
        let mut place = String::new();
        answers.read_line(&mut place).expect("a line");
        let place = place.trim().to_string();
        assert!(!place.is_empty(), "the server has said nothing");
        Server { child, questions, answers, place }
    }

    /// What its registers and coils hold now.
    fn held(&mut self) -> serde_json::Value {
        let questions = self.questions.as_mut().expect("it runs");
        questions.write_all(b"\n").expect("asked");
        let mut answer = String::new();
        self.answers.read_line(&mut answer).expect("a line");
        serde_json::from_str(&answer).expect("JSON")
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        drop(self.questions.take());
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
