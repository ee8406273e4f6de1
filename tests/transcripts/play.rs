//! Plays a transcript: reads what happens, lets the bus answer, writes everything down.

use std::collections::BTreeMap;
use std::fmt::Write;

use busker::engine::address::{Span, Table};
use busker::engine::arrivals::Errand;
use busker::engine::bus::{Action, Bus, Command, Event, Saved, Severity, Telling};
use busker::engine::memory::{Memories, Memory, Record};
use busker::engine::modbus::{Answer, Call, Discarded, Reply, Request, RequestError, RequestsOfOthers};
use busker::engine::profile::Library;
use busker::engine::recorder::Entry;
use busker::engine::request::{Decision, Desk};
use busker::engine::time::{Date, Duration, Time};

use crate::devices;

/// The transcript with everything that the bus does, anew.
pub fn replay(transcript: &str) -> String {
    let mut player: Option<Player> = None;
    let mut header = String::new();
    for line in transcript.lines() {
        let Some((time, text)) = timed(line) else {
            match &mut player {
                None => header.push_str(&format!("{line}\n")),
                Some(player) if line.starts_with('#') || line.is_empty() => player.remark(line),
                Some(_) => panic!("not a line of a transcript: `{line}`"),
            }
            continue;
        };
        let player = player.get_or_insert_with(|| Player::new(&header));
        if let Some(input) = text.strip_prefix("happens: ") {
            player.happens(time, input);
        }
    }
    player.expect("a transcript in which something happens").text
}

/// What somebody asks over MQTT.
pub fn request(verb: &str, payload: &str) -> Errand {
    Errand::Request { verb: verb.into(), payload: payload.into(), retained: false, stale: None }
}

/// `   9.5 ms  text`
fn timed(line: &str) -> Option<(Time, &str)> {
    let (time, text) = line.trim_start().split_once(" ms  ")?;
    let millis: f64 = time.parse().ok()?;
    Some((Time((millis * 1000.0).round() as u64), text))
}

struct Player {
    bus: Bus,
    desk: Desk,
    header: String,
    /// What has been stored.
    memories: Memories,
    text: String,
    now: Time,
    in_flight: Option<(Request, Time, Duration)>,
    /// Devices that answer by themselves: what they hold, by unit, table and address.
    registers: BTreeMap<(u8, Table, u16), u16>,
    answering: bool,
    silent: Vec<u8>,
    /// Holding register 0 is kept below holding register 1.
    clamps: bool,
    is_unsent: bool,
    /// Another master's requests that were heard since the last reply.
    others: RequestsOfOthers,
    /// While devices answer by themselves, requests are counted instead of written down.
    asked: BTreeMap<String, u32>,
}

const LATENCY: Duration = Duration::from_millis(9);

impl Player {
    fn new(header: &str) -> Player {
        let memories = Memories::default();
        let settings = devices::settings(header);
        let bus = Bus::new(Time::default(), &settings, 0, &memories);
        let desk = Desk::new(&settings, Library::shipped());
        let mut player = Player {
            bus,
            desk,
            header: header.to_string(),
            memories,
            text: header.to_string(),
            now: Time::default(),
            in_flight: None,
            registers: BTreeMap::new(),
            answering: false,
            silent: Vec::new(),
            clamps: false,
            is_unsent: false,
            others: RequestsOfOthers::default(),
            asked: BTreeMap::new(),
        };
        player.take_actions();
        player
    }

    fn remark(&mut self, line: &str) {
        self.text.push_str(line);
        self.text.push('\n');
    }

    fn write(&mut self, what: &str) {
        let _ = writeln!(self.text, "{:>12}  {what}", self.now.to_string());
    }

    /// Lets time run to `time`, then plays one input line.
    fn happens(&mut self, time: Time, input: &str) {
        self.run_until(time);
        self.write(&format!("happens: {input}"));
        let (verb, rest) = input.split_once(' ').unwrap_or((input, ""));
        match verb {
            "link-up" => self.bus.handle(self.now, Event::LinkUp),
            "link-down" => {
                self.in_flight = None;
                self.bus.handle(self.now, Event::LinkDown(rest.to_string()));
            }
            "broker-up" => self.bus.handle(self.now, Event::BrokerUp),
            "broker-down" => self.bus.handle(self.now, Event::BrokerDown),
            "restart" => self.restart(),
            // From the next restart on.
            "setting" => self.change_setting(rest),
            "nothing-is-kept" if rest.is_empty() => self.memories.unkept = Some("the card is full".into()),
            // Of one device.
            "nothing-is-kept" => {
                drop(self.memories.damaged.insert(rest.into(), "its file is damaged".into()))
            }
            "clamps" => self.clamps = true,
            // `another-asks 7 3`: unit 7, three times.
            "another-asks" => {
                let (unit, count) = rest.split_once(' ').expect("another-asks UNIT COUNT");
                let (unit, count) = (unit.parse().expect("a unit"), count.parse().expect("a number"));
                self.others = RequestsOfOthers { count, unit };
            }
            "tell-health" => {
                let told = self.bus.summary(self.now);
                self.write(&format!(
                    "up {}, reason {:?}, collisions {}",
                    told.up, told.reason, told.counters.collisions
                ));
            }
            // The request in flight waits for the line to be silent.
            "line-is-busy" => self.is_unsent = true,
            "line-is-silent" => self.is_unsent = false,
            "shutdown" => self.bus.handle(self.now, Event::Shutdown),
            "set" | "retained-set" => {
                let (place, payload) = rest.split_once(' ').expect("set device/point value");
                let (device, point) = place.split_once('/').expect("device/point");
                self.bus.handle(
                    self.now,
                    Event::Command(Command {
                        device: device.into(),
                        point: point.into(),
                        payload: payload.into(),
                        retained: verb == "retained-set",
                    }),
                );
            }
            "get" => {
                let (device, point) = rest.split_once('/').expect("device/point");
                self.bus.handle(self.now, Event::Get { device: device.into(), point: point.into() });
            }
            "request" => {
                let (verb, payload) = rest.split_once(' ').unwrap_or((rest, ""));
                // 2026-01-01 00:00:00 UTC, and as long after it as the transcript runs.
                let today = Date(1_767_225_600 + self.now.0 / 1_000_000);
                match self.desk.decide(today, request(verb, payload)) {
                    Decision::Ask(_, request) => self.bus.handle(self.now, Event::Request(request)),
                    Decision::Answer(message) => self.write(&format!("answer {}", message.payload)),
                    other => panic!("{other:?}"),
                }
            }
            "retire" => self.bus.handle(self.now, Event::Retire(rest.into())),
            // A header line, `device NAME UNIT KIND`.
            "adopt" => {
                let devices = devices::settings(rest).devices;
                self.bus.handle(self.now, Event::Adopt(devices, self.memories.clone()));
            }
            // Header lines that are about no device: `small budget`.
            "rules" => {
                let rules = devices::settings(&rest.replace(", ", "\n")).rules();
                self.bus.handle(self.now, Event::Rules(rules));
            }
            // The same: `json`.
            "telling" => {
                let settings = devices::settings(&rest.replace(", ", "\n"));
                self.bus.handle(self.now, Event::Telling(Telling::of(&settings)));
            }
            "answer" => self.answer(rest),
            "devices-answer" => self.answering = true,
            "silent" => self.silent.push(rest.parse().expect("a unit")),
            "speaks" => self.silent.retain(|unit| unit.to_string() != rest),
            "holds" => self.hold(rest),
            "count" => self.write_counts(),
            "nothing" => {}
            _ => panic!("unknown input `{input}`"),
        }
        self.take_actions();
    }

    fn restart(&mut self) {
        self.in_flight = None;
        self.bus = Bus::new(self.now, &devices::settings(&self.header), 0, &self.memories);
        self.take_actions();
        self.bus.handle(self.now, Event::LinkUp);
    }

    /// `relays watchdog 30`, `relays watchdog 30 enforced`
    fn change_setting(&mut self, setting: &str) {
        let point: Vec<&str> = setting.split(' ').take(2).collect();
        let same = format!("setting {} ", point.join(" "));
        let mut lines: Vec<&str> = self.header.lines().filter(|line| !line.starts_with(&same)).collect();
        let line = format!("setting {setting}");
        lines.push(&line);
        self.header = lines.join("\n");
    }

    fn run_until(&mut self, time: Time) {
        loop {
            let reply_at =
                self.in_flight.as_ref().filter(|_| self.answering).map(|(request, sent_at, timeout)| {
                    *sent_at + if self.silent.contains(&request.unit) { *timeout } else { LATENCY }
                });
            let next = [reply_at, self.bus.wake_at()].into_iter().flatten().min();
            match next {
                Some(next) if next <= time => {
                    self.now = next.max(self.now);
                    if reply_at == Some(next) {
                        self.answer_by_itself()
                    } else {
                        self.bus.handle(self.now, Event::Wake)
                    }
                    self.take_actions();
                }
                _ => break,
            }
        }
        self.now = time;
    }

    fn take_actions(&mut self) {
        while let Some(action) = self.bus.next_action() {
            match action {
                Action::Send { request, not_before, timeout } => {
                    assert!(self.in_flight.is_none(), "two requests in flight");
                    let text = format!("{} {}", request.unit, request.call);
                    if self.answering {
                        *self.asked.entry(text).or_default() += 1;
                    } else {
                        let later = match not_before > self.now {
                            true => format!(" at {not_before}"),
                            false => String::new(),
                        };
                        self.write(&format!("-> {text}   timeout {}{later}", timeout.as_millis()));
                    }
                    self.in_flight = Some((request, not_before.max(self.now), timeout));
                }
                // What is on the wire stays there.
                Action::Withdraw if !self.is_unsent => {}
                Action::Withdraw => {
                    if let Some((request, ..)) = self.in_flight.take() {
                        self.write(&format!("taken back: {} {}", request.unit, request.call));
                        self.bus.handle(self.now, Event::Withdrawn);
                    }
                }
                Action::Publish(message) => {
                    let retained = if message.retain { "" } else { " (not retained)" };
                    let payload = summary(&message.topic, &message.payload);
                    self.write(&format!("publish {} {payload}{retained}", message.topic));
                }
                Action::Store(Record { device, memory }) => {
                    let Memory { persistent_writes, section, settled, refused, .. } = &memory;
                    let pairs = |map: &BTreeMap<String, String>| {
                        map.iter().map(|(name, value)| format!(" {name}={value}")).collect::<String>()
                    };
                    self.write(&format!(
                        "store {device}: {persistent_writes} writes; section{}; settled{}; refused{}",
                        pairs(section),
                        pairs(settled),
                        refused.iter().map(|span| format!(" {span}")).collect::<String>(),
                    ));
                    self.memories.devices.insert(device, memory);
                }
                Action::Record { recording, request, .. } => {
                    self.write(&format!("record {}", recording.why));
                    // Nothing is sent here; of each request only its end is on the tape.
                    let frames =
                        recording.entries().filter(|(_, entry)| matches!(entry, Entry::Ended(_))).count();
                    let saved = Saved { path: "FILE".into(), frames, why: recording.why };
                    self.bus.handle(self.now, Event::Recorded(request, Ok(saved)));
                }
                Action::Reopen { after } => {
                    let wrong = if self.in_flight.is_some() { "WRONG, under a request: " } else { "" };
                    self.write(&format!("{wrong}reopen after {} ms", after.as_millis()));
                }
                Action::Say(severity, text) => {
                    let mark = if severity == Severity::Warning { "warn" } else { "say" };
                    self.write(&format!("{mark} {text}"));
                }
            }
        }
        if self.bus.is_finished() {
            self.write("finished");
        }
    }

    /// `0001 0002`, `silence`, `checksum`, `collision`, `wrong-frame`, `exception 2`, `written`, `names A, B`, `regular A, B`
    /// (of a device that has more than the basic names, of which these are the next), `echo A537`,
    /// `server-id 0102`
    fn answer(&mut self, text: &str) {
        let Some((request, sent_at, _)) = self.in_flight.take() else {
            return self.write("WRONG: nothing is in flight");
        };
        let result = match text.split_once(' ').unwrap_or((text, "")) {
            ("silence", _) => Err(RequestError::Timeout),
            ("checksum", _) => Err(RequestError::Checksum),
            ("collision", _) => Err(RequestError::Collision),
            ("wrong-frame", _) => Err(RequestError::WrongFrame),
            ("exception", code @ ("10" | "11")) => {
                Err(RequestError::Unreachable(code.parse().expect("a code")))
            }
            ("exception", code) => Err(RequestError::Exception(code.parse().expect("a code"))),
            ("written", _) => Ok(Answer::Written),
            (kind @ ("names" | "regular"), names) => {
                let Call::ReadIdentification { object, .. } = request.call else {
                    return self.write("WRONG: nobody asked for names");
                };
                let objects = names.split(", ").enumerate();
                Ok(Answer::Identification(busker::engine::modbus::Identification {
                    conformity: if kind == "names" { 1 } else { 0x82 },
                    next: None,
                    objects: objects.map(|(id, name)| (object + id as u8, name.to_string())).collect(),
                }))
            }
            ("echo", word) => Ok(Answer::Diagnostics(vec![u16::from_str_radix(word, 16).expect("a word")])),
            ("server-id", byte) => Ok(Answer::ServerId(vec![u8::from_str_radix(byte, 16).expect("a byte")])),
            _ => match words(&request, text) {
                Some(answer) => Ok(answer),
                None => return self.write(&format!("WRONG: not an answer to {}", request.call)),
            },
        };
        self.reply(sent_at, result);
    }

    fn answer_by_itself(&mut self) {
        let (request, sent_at, _) = self.in_flight.take().expect("a request in flight");
        if self.silent.contains(&request.unit) {
            return self.reply(sent_at, Err(RequestError::Timeout));
        }
        let unit = request.unit;
        let answer = match request.call {
            Call::Read(span) => {
                let held =
                    (span.first()..=span.last()).map(|at| self.registers.get(&(unit, span.table(), at)));
                answer_of(span, held.map(|word| word.copied().unwrap_or(0)).collect())
            }
            Call::WriteCoil { address, on } => {
                self.registers.insert((unit, Table::Coil, address), u16::from(on));
                Answer::Written
            }
            // As FuehlerSysteme's boards limit a threshold to the other one, chapter 9.
            Call::WriteRegister { address, word } if self.clamps && address < 2 => {
                let at = |address| (unit, Table::Holding, address);
                let other = self.registers.get(&at(1 - address)).copied().unwrap_or(0);
                let used = if address == 0 { word.min(other.saturating_sub(1)) } else { word.max(other + 1) };
                self.registers.insert(at(address), used);
                if used != word {
                    return self.reply(sent_at, Err(RequestError::Exception(3)));
                }
                Answer::Written
            }
            Call::WriteRegister { address, word } => {
                self.registers.insert((unit, Table::Holding, address), word);
                Answer::Written
            }
            Call::WriteCoils { address, values } => {
                for (at, on) in (address..).zip(values) {
                    self.registers.insert((unit, Table::Coil, at), u16::from(on));
                }
                Answer::Written
            }
            Call::WriteRegisters { address, words } => {
                for (at, word) in (address..).zip(words) {
                    self.registers.insert((unit, Table::Holding, at), word);
                }
                Answer::Written
            }
            // They know no other function.
            Call::ReadIdentification { .. } | Call::ReportServerId | Call::Diagnostics { .. } => {
                return self.reply(sent_at, Err(RequestError::Exception(1)));
            }
        };
        self.reply(sent_at, Ok(answer));
    }

    fn reply(&mut self, sent_at: Time, result: Result<Answer, RequestError>) {
        let heard = if result == Err(RequestError::Timeout) { None } else { Some(self.now) };
        let requests_of_others = std::mem::take(&mut self.others);
        let discarded = Discarded { requests_of_others, ..Discarded::default() };
        let reply = Reply { result, sent_at, first_byte_at: heard, last_byte_at: heard, discarded };
        self.bus.handle(self.now, Event::Reply(reply));
    }

    /// `1 input 0: 0001 0002`
    fn hold(&mut self, text: &str) {
        let (place, words) = text.split_once(": ").expect("unit table address: words");
        let place: Vec<&str> = place.split(' ').collect();
        let unit = place[0].parse().expect("a unit");
        let table = Table::from_name(place[1]).expect("a table");
        let first: u16 = place[2].parse().expect("an address");
        for (offset, word) in words.split(' ').enumerate() {
            let word = u16::from_str_radix(word, 16).expect("a word in hexadecimal");
            self.registers.insert((unit, table, first + offset as u16), word);
        }
    }

    fn write_counts(&mut self) {
        for (text, count) in std::mem::take(&mut self.asked) {
            self.write(&format!("asked {count} times: {text}"));
        }
    }
}

fn words(request: &Request, text: &str) -> Option<Answer> {
    let words: Vec<u16> =
        text.split_whitespace().map(|word| u16::from_str_radix(word, 16)).collect::<Result<_, _>>().ok()?;
    match request.call {
        Call::Read(span) if words.len() as u32 == span.count() => Some(answer_of(span, words)),
        _ => None,
    }
}

fn answer_of(span: Span, words: Vec<u16>) -> Answer {
    if span.table().is_bits() {
        return Answer::Bits(words.into_iter().map(|word| word != 0).collect());
    }
    Answer::Words(words)
}

/// Discovery and info are too long to read here; what changes in them is what matters.
fn summary(topic: &str, payload: &str) -> String {
    let parse = || -> serde_json::Value { serde_json::from_str(payload).expect("a JSON payload") };
    if topic.ends_with("/info") {
        let info = parse();
        let drift = match info["drift"].as_array().map(Vec::len) {
            Some(0) => String::new(),
            _ => format!(", drift {}", info["drift"]),
        };
        let eeprom = &info["eeprom"];
        let is_held_back =
            eeprom["spent"] == true || eeprom["waiting"].as_object().is_some_and(|all| !all.is_empty());
        let eeprom = if is_held_back { format!(", eeprom {eeprom}") } else { String::new() };
        return format!(
            "online {}, reason {}, missing {}{drift}{eeprom}",
            info["online"], info["reason"], info["missing"]
        );
    }
    if !topic.starts_with("homeassistant/") {
        return payload.to_string();
    }
    let payload = parse();
    let components = payload["components"].as_object().expect("components");
    let keys: Vec<String> = components
        .iter()
        .map(|(key, component)| {
            // A component with nothing but its platform is a tombstone.
            let gone = component.as_object().is_some_and(|component| component.len() == 1);
            format!("{key}{}", if gone { " (gone)" } else { "" })
        })
        .collect();
    format!("announces {}", keys.join(", "))
}
