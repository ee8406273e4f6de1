//! What the gateway remembers of a device over restarts: settings, writes to EEPROM, refused reads.
//!
//! A [`Memory`] is one small file for each device; the edge keeps the files, and here is what stands
//! in them. Nothing in it is needed to run: without it, everything is as at the first start.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::engine::address::Span;
use crate::engine::device::Device;
use crate::engine::plan::{Read, Table};
use crate::engine::yaml::Scalar;

/// The form of the file; another one is not guessed at.
const VERSION: u32 = 1;

/// What is remembered of one device.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Memory {
    /// By which profile it was read, and with which plan: [`fingerprint`].
    pub plan: String,
    /// What the device has refused to give in one answer to that plan.
    pub refused: Vec<Span>,
    /// Writes to points in EEPROM since the installation.
    pub persistent_writes: u64,
    /// How many of them still lessen the day's budget.
    pub writes_spent: Option<u32>,
    /// The points that had been written so lately that they were to be spared.
    pub written_lately: BTreeSet<String>,
    /// The section `settings` as it was last seen: points and what they shall hold.
    pub section: BTreeMap<String, String>,
    /// The settings of that section for which all has been done, and how that ended: `done`,
    /// `unchanged`, `not_taken`, `refused`, `no_reply`.
    pub settled: BTreeMap<String, String>,
}

/// A memory to be kept: the newest one of a device replaces those before it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Record {
    pub device: String,
    pub memory: Memory,
}

/// What was remembered of all devices when the gateway started.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Memories {
    pub devices: BTreeMap<String, Memory>,
    /// Why nothing can be kept for the next start, if so.
    pub unkept: Option<String>,
    /// Devices of which alone nothing can be kept, and why: what is kept of them already must not be overwritten.
    pub damaged: BTreeMap<String, String>,
}

impl Memories {
    /// Why nothing can be kept of this device, if so.
    pub fn unkept_of(&self, device: &str) -> Option<&str> {
        self.unkept.as_ref().or_else(|| self.damaged.get(device)).map(String::as_str)
    }
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    version: u32,
    plan: String,
    refused: Vec<String>,
    persistent_writes: u64,
    #[serde(default)]
    writes_spent: Option<u32>,
    #[serde(default, skip_serializing_if = "BTreeSet::is_empty")]
    written_lately: BTreeSet<String>,
    /// Kept before `writes_spent` was: what is left says nothing where the budget has changed since.
    #[serde(default, skip_serializing, rename = "writes_left")]
    _writes_left: Option<u32>,
    settings: BTreeMap<String, String>,
    settled: BTreeMap<String, String>,
}

impl Memory {
    /// Reads what [`Memory::to_text`] has written; `Err` says what is wrong with it.
    pub fn parse(text: &str) -> Result<Memory, String> {
        let file: serde_json::Value = serde_json::from_str(text).map_err(|error| error.to_string())?;
        let version = file.get("version").and_then(serde_json::Value::as_u64);
        if version != Some(u64::from(VERSION)) {
            let found = version.map_or("none".into(), |version| version.to_string());
            return Err(format!("its version is {found}, and this program knows {VERSION}"));
        }
        let file: File = serde_json::from_value(file).map_err(|error| error.to_string())?;
        let refused = file.refused.iter().map(|span| <Span as Scalar>::parse(span));
        Ok(Memory {
            plan: file.plan,
            refused: refused.collect::<Result<_, _>>()?,
            persistent_writes: file.persistent_writes,
            writes_spent: file.writes_spent,
            written_lately: file.written_lately,
            section: file.settings,
            settled: file.settled,
        })
    }

    /// JSON, a key a line, so that a person can read it as well.
    pub fn to_text(&self) -> String {
        let file = File {
            version: VERSION,
            plan: self.plan.clone(),
            refused: self.refused.iter().map(Span::to_string).collect(),
            persistent_writes: self.persistent_writes,
            writes_spent: self.writes_spent,
            written_lately: self.written_lately.clone(),
            _writes_left: None,
            settings: self.section.clone(),
            settled: self.settled.clone(),
        };
        let text = serde_json::to_string_pretty(&file).unwrap_or_default();
        format!("{text}\n")
    }
}

/// What a refusal was an answer to: the profile and its plan as they are without any refusal. The
/// number is the same in each run and on each machine (FNV-1a).
pub fn fingerprint(device: &Device, reads: &[Read]) -> String {
    let text = format!("{}\n{}", device.profile, Table { device, reads });
    let hash = text.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    });
    format!("{hash:016x}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn memory() -> Memory {
        let map = |pairs: &[(&str, &str)]| {
            pairs.iter().map(|(key, value)| (key.to_string(), value.to_string())).collect()
        };
        Memory {
            plan: "0123456789abcdef".into(),
            refused: vec![<Span as Scalar>::parse("holding 3..7").expect("a span")],
            persistent_writes: 12,
            writes_spent: Some(12),
            written_lately: BTreeSet::from(["watchdog".to_string()]),
            section: map(&[("mode", "pt1000"), ("watchdog", "30s")]),
            settled: map(&[("watchdog", "done")]),
        }
    }

    #[test]
    fn what_is_kept_is_read_again() {
        assert_eq!(Memory::parse(&memory().to_text()), Ok(memory()));
        assert_eq!(Memory::parse(&Memory::default().to_text()), Ok(Memory::default()));
    }

    #[test]
    fn what_an_earlier_version_has_kept_is_not_lost() {
        let text = memory().to_text().replace("\"writes_spent\": 12", "\"writes_left\": 488");
        assert_eq!(Memory::parse(&text), Ok(Memory { writes_spent: None, ..memory() }));
    }

    #[test]
    fn what_is_damaged_is_told_and_never_half_believed() {
        let whole = memory().to_text();
        for (text, expected) in [
            ("", "EOF while parsing a value"),
            (&whole[..whole.len() / 2], "EOF while parsing"),
            (
                &whole.replace("\"version\": 1", "\"version\": 2"),
                "its version is 2, and this program knows 1",
            ),
            ("{}", "its version is none"),
            (&whole.replace("persistent_writes", "writes"), "unknown field `writes`"),
            (&whole.replace("holding 3..7", "holding 7..3"), "`7..3` runs backwards"),
            (&whole.replace("12,", "-12,"), "invalid value: integer `-12`"),
        ] {
            let refused = Memory::parse(text).expect_err(text);
            assert!(refused.contains(expected), "{refused} for {text}");
        }
    }
}
