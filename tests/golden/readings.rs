//! Registers and what they say. A file of scenes:
//!
//! ```text
//! # What this is, and where in the manual.
//! input 12   0000 30D5
//! holding 36 0701
//! ->
//! meter_1_reading  000030D5  1250.1
//! ```
//!
//! A scene is a device that holds these registers (bits, for coils and discrete inputs) and whose
//! others have not been read. Behind the arrow stand all points that lie in them, with their words; of
//! a point that is held in both its places, the reading ends with whether the second says the same.
//! What stands before the arrow is written by hand, the rest is rewritten by `BLESS=1`.

use std::collections::{BTreeMap, BTreeSet};

use busker::engine::address::{Address, Table};
use busker::engine::codec;
use busker::engine::device::{Device, Encoding, Kind};
use busker::engine::value::Reading;

/// The file with everything behind the arrows worked out.
pub fn answered(device: &Device, file: &str) -> String {
    let mut text = String::new();
    for scene in scenes(file) {
        text.push_str(&scene.written_by_hand);
        let readings = scene.readings(device);
        let width = |of: fn(&Told) -> &String| readings.iter().map(|told| of(told).len()).max().unwrap_or(0);
        let (name_width, words_width) = (width(|told| &told.name), width(|told| &told.words));
        for told in &readings {
            let Told { name, words, says, .. } = told;
            text.push_str(&format!("{name:name_width$}  {words:>words_width$}  {says}\n"));
        }
        text.push('\n');
    }
    text.truncate(text.trim_end().len());
    text.push('\n');
    text
}

/// The points that can be read, their cases and their named values, that no scene has a reading of.
pub fn without_a_reading(device: &Device, file: &str) -> Vec<String> {
    let mut wanted = BTreeSet::new();
    for point in device.points.iter().filter(|point| !point.is_button()) {
        wanted.insert(point.name.clone());
        match &point.encoding {
            // The forms of other points, each of which has a reading of its own.
            Encoding::Cases { by, .. } if device.points[*by].refers.is_some() => {}
            Encoding::Plain(_) if point.refers.is_some() => {}
            Encoding::Cases { cases, .. } => {
                let with_form = cases.iter().filter(|case| case.form.is_some());
                wanted.extend(with_form.map(|case| case_called(&case.name)));
            }
            Encoding::Plain(form) if form.kind == Kind::Bool => {}
            Encoding::Plain(form) => {
                wanted.extend(form.names.list().iter().map(|(_, name)| value_called(name)));
            }
        }
    }
    for scene in scenes(file) {
        for told in scene.readings(device).into_iter().filter(|told| told.is_reading) {
            if let Some(case) = &told.case {
                wanted.remove(&case_called(case));
            }
            wanted.remove(&value_called(&told.says));
            wanted.remove(&told.name);
        }
    }
    wanted.into_iter().collect()
}

/// One reading of each case will do for all points that have it.
fn case_called(name: &str) -> String {
    format!("the case {name}")
}

fn value_called(name: &str) -> String {
    format!("the value {name}")
}

struct Scene {
    /// All lines up to and with the arrow.
    written_by_hand: String,
    held: BTreeMap<(Table, u16), u16>,
}

struct Told {
    name: String,
    words: String,
    says: String,
    is_reading: bool,
    case: Option<String>,
}

fn scenes(file: &str) -> Vec<Scene> {
    let mut scenes = Vec::new();
    let mut scene = Scene { written_by_hand: String::new(), held: BTreeMap::new() };
    let mut behind_arrow = false;
    for line in file.lines() {
        if behind_arrow {
            behind_arrow = !line.is_empty();
            continue;
        }
        scene.written_by_hand.push_str(line);
        scene.written_by_hand.push('\n');
        if line == "->" {
            behind_arrow = true;
            scenes.push(scene);
            scene = Scene { written_by_hand: String::new(), held: BTreeMap::new() };
        } else if !line.starts_with('#') && !line.is_empty() {
            scene.hold(line);
        }
    }
    assert_eq!(scene.written_by_hand.trim(), "", "a scene without an arrow");
    scenes
}

impl Scene {
    /// `holding 16 0080 0081`
    fn hold(&mut self, line: &str) {
        let mut parts = line.split_whitespace();
        let table = parts.next().and_then(Table::from_name).unwrap_or_else(|| panic!("no table: {line}"));
        let first: u16 = parts.next().and_then(|text| text.parse().ok()).unwrap_or_else(|| panic!("{line}"));
        for (address, word) in (first..).zip(parts) {
            let word = u16::from_str_radix(word, 16).unwrap_or_else(|_| panic!("not a word: {word}"));
            self.held.insert((table, address), word);
        }
    }

    fn words(&self, address: Address) -> Option<Vec<u16>> {
        let span = address.span;
        let words: Option<Vec<u16>> =
            (span.first()..=span.last()).map(|at| self.held.get(&(span.table(), at)).copied()).collect();
        codec::words_at(address, span.first(), &words?)
    }

    /// What the points say that lie in the registers held.
    fn readings(&self, device: &Device) -> Vec<Told> {
        let known = self.known(device);
        let mut told = Vec::new();
        for (index, point) in device.points.iter().enumerate().filter(|(_, point)| !point.is_button()) {
            let mut places = [Some(point.at), point.also].into_iter().flatten();
            let found = |place: Address| Some((place, self.words(place)?));
            let Some((place, words)) = places.find_map(found) else { continue };
            let (mut says, is_reading, case) = match codec::resolve(device, index, &known) {
                Ok(resolved) => {
                    let reading = codec::read(&resolved, &words);
                    let is_reading = !matches!(reading, Reading::Missing(_));
                    let says = in_words(&reading, resolved.unit.as_deref());
                    (says, is_reading, resolved.case.map(str::to_string))
                }
                Err(missing) => (format!("None ({missing})"), false, None),
            };
            if let Some((second, other)) = places.find_map(found) {
                says.push_str(if other == words { " (same as " } else { " (BUT NOT " });
                says.push_str(&format!("{second})"));
            }
            let words = in_hex(place, &words);
            told.push(Told { name: point.name.clone(), words, says, is_reading, case });
        }
        told
    }

    fn known(&self, device: &Device) -> Vec<Option<i128>> {
        let raw = |point: &busker::engine::device::Point| {
            let form = point.plain()?;
            let words = self.words(point.at).or_else(|| self.words(point.also?))?;
            match codec::raw(form, &words) {
                codec::Raw::Integer(raw) => Some(raw),
                _ => None,
            }
        };
        device.points.iter().map(raw).collect()
    }
}

/// Registers of a text, or of the longest number twice.
const LONGEST: usize = 8;

fn in_words(reading: &Reading, unit: Option<&str>) -> String {
    match (reading, unit) {
        (Reading::Missing(missing), _) => format!("None ({missing})"),
        (Reading::Number(_) | Reading::Float(_), Some(unit)) => format!("{reading} {unit}"),
        _ => reading.to_string(),
    }
}

/// With as many digits as the place has bits. Of an array only the beginning.
fn in_hex(place: Address, words: &[u16]) -> String {
    let digits = match place.bits {
        Some(bits) => usize::from(bits.width()).div_ceil(4),
        None if place.span.table().is_bits() => 1,
        None => 4,
    };
    let end = if words.len() > LONGEST { "…" } else { "" };
    let begin: String = words.iter().take(LONGEST).map(|word| format!("{word:0digits$X}")).collect();
    format!("{begin}{end}")
}
