//! What a scan has found: as configuration that `busker check` takes, as JSON, and as advice.

use std::fmt::Write;

use serde_json::{Value as Json, json};

use crate::engine::identity::{Interview, name_for};
use crate::engine::modbus::RequestError;
use crate::engine::settings::{Line, Link};

use super::{Found, Garbled, Scan};

pub(super) const OTHER_MASTER: &str =
    "another master speaks on this line; a Modbus line has one: unplug the other, and scan again";
/// So many bytes without a frame are worth a word where nobody was found.
const NOISE_MIN: u32 = 20;
/// Fewer units that all say the same may well be so many devices.
const MANY_UNITS: usize = 32;

/// What a scan has found.
#[derive(Debug)]
pub struct Report {
    scan: Scan,
    is_whole: bool,
    /// One device answers, whatever unit is asked.
    answers_to_any: bool,
}

impl Report {
    pub(super) fn new(mut scan: Scan, is_whole: bool) -> Report {
        let line = scan.settled.flatten();
        if scan.settled.is_some() {
            scan.garbled.retain(|garbled| garbled.line == line);
        }
        let mut words = scan.found.values().map(|found| (found.interview.names(), found.profiles()));
        let first = words.next();
        let all_alike = words.all(|other| Some(&other) == first.as_ref());
        let is_everybody = scan.found.len() == scan.wanted.units.len() && scan.found.len() >= MANY_UNITS;
        let answers_to_any = scan.wanted.lines.is_empty() && is_everybody && all_alike;
        if answers_to_any {
            let first = scan.found.pop_first();
            scan.found = first.into_iter().collect();
        }
        Report { scan, is_whole, answers_to_any }
    }

    /// Whether nobody was found whom one could speak with.
    pub fn is_empty(&self) -> bool {
        self.scan.found.is_empty()
    }

    /// Who may have been found, of those that tell nobody who they are.
    fn nameless(&self) -> String {
        match &self.scan.wanted.nameless[..] {
            [] => "write one beside its manual".into(),
            ids => {
                format!("these tell nobody who they are: {}; or write one beside its manual", ids.join(", "))
            }
        }
    }

    /// `buses` and `devices` as they can stand in the configuration; `None` where nothing was found.
    pub fn configuration(&self, link: &Link) -> Option<String> {
        if self.is_empty() {
            return None;
        }
        let bus = bus_of(link);
        let mut text = format!("# Found by `busker scan`: {}.\n", self.asked());
        for note in self.notes() {
            let _ = writeln!(text, "# {note}");
        }
        let _ = write!(text, "buses:\n  {bus}:\n    {}\n", key_of(link));
        if let Some(Line { baud, parity, stop_bits }) = self.scan.settled.flatten() {
            let _ = writeln!(text, "    baud: {baud}\n    parity: {parity}");
            if stop_bits != 1 {
                let _ = writeln!(text, "    stop_bits: {stop_bits}");
            }
        }
        let known = self.scan.found.values().any(|found| found.only_profile().is_some());
        text.push_str(if known { "devices:\n" } else { "devices: {}\n" });
        for (unit, found) in &self.scan.found {
            let who = found.who();
            match found.only_profile() {
                Some(profile) => {
                    let name = name_for(profile, *unit);
                    let _ = write!(
                        text,
                        "  # {who}\n  {name}:\n    profile: {profile}\n    bus: {bus}\n    unit: {unit}\n"
                    );
                }
                None => {
                    let which = match &found.profiles()[..] {
                        [] => format!("no profile goes by that; {}", self.nameless()),
                        several => format!("these profiles go by that: {}", several.join(", ")),
                    };
                    let _ = write!(
                        text,
                        "  # Unit {unit} answers: {who}; {which}\n  # device_{unit}: {{profile: …, bus: {bus}, \
                         unit: {unit}}}\n"
                    );
                }
            }
        }
        Some(text)
    }

    /// The same for programs.
    pub fn json(&self, link: &Link) -> Json {
        let line = self.scan.settled.flatten().map(line_json);
        let found: Vec<Json> =
            self.scan.found.iter().map(|(unit, found)| found.json(*unit, bus_of(link))).collect();
        let garbled = self.scan.garbled.iter().map(|garbled| {
            json!({"unit": garbled.unit, "line": garbled.line.map(line_json), "error": garbled.what.to_string()})
        });
        json!({
            "line": line,
            "units": units(&self.scan.wanted.units),
            "complete": self.is_whole,
            "found": found,
            "garbled": garbled.collect::<Vec<_>>(),
            "other_master": self.scan.other_masters.is_some(),
            "answers_to_any_unit": self.answers_to_any,
            "configuration": self.configuration(link),
        })
    }

    /// What was asked of whom.
    fn asked(&self) -> String {
        let units = units(&self.scan.wanted.units);
        let at = self.scan.settled.flatten().map_or_else(String::new, |line| format!(" at {line}"));
        match self.is_whole {
            true => format!("units {units} were asked{at}"),
            false => format!("it was interrupted before all of the units {units} were asked{at}"),
        }
    }

    /// What a person should know of it besides.
    pub fn notes(&self) -> Vec<String> {
        let mut notes = Vec::new();
        if self.scan.other_masters.is_some() {
            notes.push(OTHER_MASTER.to_string());
        }
        if self.answers_to_any {
            notes.push(
                "every unit answers alike, so this is one device that does not look at the unit".into(),
            );
        }
        match self.scan.hung_up {
            0 => {}
            1 => notes.push("one question ended the connection; that counted as silence".into()),
            count => notes.push(format!("{count} questions ended the connection; that counted as silence")),
        }
        notes.extend(self.scan.garbled.iter().map(Garbled::told));
        notes
    }

    /// Why nothing was found, and where to look.
    pub fn why_empty(&self) -> String {
        let scan = &self.scan;
        let settings = scan.wanted.lines.len();
        let with = match &scan.wanted.lines[..] {
            [] => String::new(),
            [one] => format!(" at {one}"),
            _ => format!(" with any of {settings} settings"),
        };
        let rest = if self.is_whole { "" } else { ", as far as was asked" };
        if !scan.garbled.is_empty() {
            return format!("nobody answers so that it can be understood{with}{rest}");
        }
        if scan.hung_up > 0 && scan.quickest.is_none() {
            return format!(
                "none of the units {} answers{with}{rest}; the other side ends the connection when it is asked: it may be no \
                 Modbus server, speak the other of `--tcp` and `--rtu-over-tcp`, or serve others only",
                units(&scan.wanted.units)
            );
        }
        let look = match (scan.noise >= NOISE_MIN, scan.wanted.lines.is_empty()) {
            (true, _) => {
                "bytes were heard that belong to no frame: look at the termination at both ends and the bias, \
                 and for another master (`busker doctor --serial PORT` listens)"
            }
            (false, false) => {
                "look at the devices' power and units, exchange A and B, and let `busker doctor --serial PORT \
                 --send` look at the adapter"
            }
            (false, true) => {
                "look at the gateway's own settings for its line, and at the devices' power and units"
            }
        };
        format!("none of the units {} answers{with}{rest}; {look}", units(&scan.wanted.units))
    }
}

impl Found {
    fn profiles(&self) -> Vec<&str> {
        self.interview.fitting().into_iter().map(|(id, _)| id).collect()
    }

    fn only_profile(&self) -> Option<&str> {
        self.interview.only_fitting().map(|(id, _)| id)
    }

    /// `METZ CONNECT GmbH MR-DO4 V1.4`, and what is to be said of its answers. On one line, whatever it says.
    fn who(&self) -> String {
        let named = who(&self.interview);
        match self.damaged {
            0 => named,
            1 => format!("{named}; one of its answers was damaged: {DAMAGED}"),
            count => format!("{named}; {count} of its answers were damaged: {DAMAGED}"),
        }
    }

    pub(super) fn told(&self, unit: u8) -> String {
        let fits = match &self.profiles()[..] {
            [] => String::new(),
            ids => format!(" ({})", ids.join(", ")),
        };
        format!("unit {unit}: {}{fits}", self.who())
    }

    fn json(&self, unit: u8, bus: &str) -> Json {
        let profile = self.only_profile();
        json!({
            "unit": unit,
            "objects": self.interview.objects_json(),
            "server_id": self.interview.server_id_json(),
            "profiles": self.profiles(),
            "damaged_answers": self.damaged,
            "device": profile.map(|profile| {
                json!({"name": name_for(profile, unit), "profile": profile, "bus": bus, "unit": unit})
            }),
        })
    }
}

const DAMAGED: &str = "two devices may have this unit, or the wire is noisy";

impl Garbled {
    /// Whom it is about, what it may be, and what to do.
    pub(super) fn told(&self) -> String {
        let Garbled { line, unit, what } = self;
        let at = line.map_or_else(String::new, |line| format!(" at {line}"));
        let cause = match what {
            RequestError::Timeout => "its wiring may be loose, or it restarts again and again",
            RequestError::Collision => "another speaks at the same time",
            _ => {
                "two devices may have this unit (connect one alone, and give it another), its parity may be \
                 another, or the wire is noisy"
            }
        };
        format!("unit {unit} answers{at}, but not so that it can be understood: {what}; {cause}")
    }
}

/// What the device calls itself, without what would break a line.
fn who(interview: &Interview) -> String {
    let plain = |text: String| text.chars().filter(|c| !c.is_control()).collect::<String>();
    let names = interview.names().map(plain).filter(|names| !names.trim().is_empty());
    match (names, interview.fitting().first()) {
        (Some(names), _) => names,
        (None, Some((_, told))) => format!("no names, but {told}"),
        (None, None) => "it does not tell who it is".into(),
    }
}

/// What its bus is called.
const fn bus_of(link: &Link) -> &'static str {
    match link {
        Link::Serial { .. } | Link::RtuOverTcp { .. } => "line",
        Link::Tcp { .. } => "network",
    }
}

/// The link as a configuration says it.
fn key_of(link: &Link) -> String {
    let key = match link {
        Link::Serial { .. } => "serial",
        Link::Tcp { .. } => "tcp",
        Link::RtuOverTcp { .. } => "rtu_over_tcp",
    };
    format!("{key}: {}", Json::from(link.address()))
}

fn line_json(line: Line) -> Json {
    json!({"baud": line.baud, "parity": line.parity.to_string(), "stop_bits": line.stop_bits})
}

/// `1..247`, `1..247 and 255`.
fn units(units: &[u8]) -> String {
    let mut parts: Vec<(u8, u8)> = Vec::new();
    for unit in units {
        match parts.last_mut() {
            Some((_, last)) if last.checked_add(1) == Some(*unit) => *last = *unit,
            _ => parts.push((*unit, *unit)),
        }
    }
    let text = |(first, last): &(u8, u8)| match first == last {
        true => first.to_string(),
        false => format!("{first}..{last}"),
    };
    parts.iter().map(text).collect::<Vec<_>>().join(" and ")
}
