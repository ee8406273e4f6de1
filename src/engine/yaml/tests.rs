//! The YAML reader: values, faults, and their places.

use super::*;
use crate::engine::time::Duration;
use crate::engine::value::Decimal;

/// The faults of `text` as a file without any keys that would be wrong.
fn check_refused(text: &str, expected: &str) {
    let mut faults = Faults::default();
    parse(&Source::new("f.yaml", text), &mut faults);
    let shown = faults.to_string();
    let first = shown.lines().next().unwrap_or("no fault");
    assert_eq!(first, expected, "{}", &text[..text.len().min(500)]);
}

fn check_scalar<T: Read + std::fmt::Debug>(text: &str, expected: &str) {
    let mut faults = Faults::default();
    let node = parse(&Source::new("f", &format!("- {text}")), &mut faults).expect("a list");
    let value: Option<Vec<T>> = read(&node, &mut faults);
    let shown = match value {
        Some(mut values) => format!("{:?}", values.remove(0)),
        None => faults.into_sorted().remove(0).message,
    };
    assert_eq!(shown, expected, "{text}");
}

#[test]
fn what_yaml_does_not_allow_is_told_with_a_remedy() {
    check_refused("", "f.yaml:1:1: the file is empty; it must hold at least its required keys");
    check_refused(
        "# only a comment\n",
        "f.yaml:1:1: the file is empty; it must hold at least its required keys",
    );
    check_refused("a:\n\tb: 1\n", "f.yaml:2:1: a tab indents this line; YAML is indented with spaces only");
    check_refused(
        "ä: 1\nb: 2\nä: 3\n",
        "f.yaml:3:1: the key `ä` stands here twice (first in line 1); remove one of them",
    );
    check_refused(
        "a: 1\n---\nb: 2\n",
        "f.yaml:2:1: a second document begins here; a file holds one: remove `---` or what follows it",
    );
    check_refused(
        "a: &x {b: 1}\nc:\n  <<: *x\n",
        "f.yaml:3:3: merging with `<<` is not supported; give the whole value an anchor, or write the keys out",
    );
    check_refused(
        "a: *nobody\n",
        "f.yaml:1:4: this alias names an anchor that does not stand before it; write `&name` at the value it shall repeat",
    );
    check_refused(
        "a: &x [*x]\n",
        "f.yaml:1:8: this alias stands inside the very value it names; write the value out",
    );
    check_refused("a: !!int 3\n", "f.yaml:1:4: the tag `!!int` means nothing here; remove it");
    check_refused("a: b\u{0}c\n", "f.yaml:1:5: control character U+0000; remove it");
    check_refused("{a: 1}: 2\n", "f.yaml:1:1: a list or map cannot be a key; expected one word or number");
}

#[test]
fn a_file_cannot_grow_by_aliases_nor_by_nesting() {
    let mut bomb = String::from("a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n");
    for level in 1..9 {
        let before = level - 1;
        bomb += &format!("a{level}: &a{level} [{}]\n", vec![format!("*a{before}"); 10].join(", "));
    }
    check_refused(
        &bomb,
        "f.yaml:5:45: with its aliases the file holds more than 100000 values; no file here needs that many",
    );
    check_refused(
        &"[".repeat(100_000),
        // The parser's own limit comes first, since it looks ahead.
        "f.yaml:1:256: maps and lists are nested deeper than 24; no file here needs that",
    );
    check_refused(
        &"- ".repeat(5_000),
        "f.yaml:1:49: maps and lists are nested deeper than 24; no file here needs that",
    );
}

#[test]
fn aliases_repeat_a_value() {
    let mut faults = Faults::default();
    let source = Source::new("f", "a: &x [1, 2]\nb: *x\n");
    let node = parse(&source, &mut faults).expect("a map");
    let map: Map<String, Vec<u8>> = read(&node, &mut faults).expect("lists");
    assert_eq!(map.get(&"b".into()), Some(&vec![1, 2]));
    assert!(faults.is_empty());
}

#[test]
fn bytes_that_are_no_text_are_shown_where_they_are() {
    let mut faults = Faults::default();
    assert!(Source::from_bytes("f", b"a: 1\nb: caf\xE9!\n", &mut faults).is_none());
    assert_eq!(
        faults.to_string(),
        "f:2:7: the byte 0xE9 is not UTF-8; save the file as UTF-8\n  |\n2 | b: caf\u{FFFD}!\n  |       ^\n"
    );
}

#[test]
fn a_scalar_is_what_the_wanted_type_says() {
    check_scalar::<String>("off", "\"off\"");
    check_scalar::<String>("0x10", "\"0x10\"");
    check_scalar::<String>("\"null\"", "\"null\"");
    check_scalar::<String>("null", "nothing stands here; expected a text");
    check_scalar::<u8>("0x10", "16");
    check_scalar::<u8>("300", "300 is out of range; expected 0 to 255");
    check_scalar::<u8>("ten", "`ten` is not a whole number; expected one like `12` or `0x0C`");
    check_scalar::<i128>("-0x1", "`-0x1` is not a whole number; expected one like `12` or `0x0C`");
    check_scalar::<i64>("-12", "-12");
    check_scalar::<u8>("[1]", "a list stands here; expected a whole number");
    check_scalar::<bool>("yes", "`yes` is neither `true` nor `false`");
    check_scalar::<Option<u8>>("~", "None");
    check_scalar::<Decimal>("0.50", "Decimal { units: 50, decimals: 2 }");
    check_scalar::<Decimal>("1,5", "`1,5` is not a number; expected one like `20` or `0.5`");
}

#[test]
fn every_duration_has_its_unit() {
    check_scalar::<Duration>("250ms", "250ms");
    check_scalar::<Duration>("1.5s", "1.5s");
    check_scalar::<Duration>("10m", "600s");
    check_scalar::<Duration>("30", "the duration `30` has no unit; expected one like `30s` or `30ms`");
    check_scalar::<Duration>(
        "3 weeks",
        "`weeks` is not a unit of time; expected us, ms, s, m, h or d, as in `30s`",
    );
    check_scalar::<Duration>("soon", "`soon` is not a duration; expected one like `250ms`, `30s` or `10m`");
    check_scalar::<Duration>(
        "99999999d",
        "`99999999d` is out of range; expected whole microseconds up to 100 years",
    );
}

record! {
    /// A test.
    struct Sample {
        /// Must be there.
        name: String,
        /// Has a default.
        count: u8 = 7,
        /// May be left out.
        r#type: Option<String>,
        more: Map<i128, Option<u8>> = Map::default(),
    }
}

fn read_sample(text: &str) -> (Option<Sample>, Faults) {
    let mut faults = Faults::default();
    let node = parse(&Source::new("f", text), &mut faults).expect("YAML");
    (read(&node, &mut faults), faults)
}

#[test]
fn a_record_takes_defaults_and_names_in_rust_words() {
    let (sample, faults) = read_sample("name: on\ntype: u16\nmore: {0x10: 1, 17: null}\n");
    let sample = sample.expect("a sample");
    assert!(faults.is_empty());
    assert_eq!((sample.name.as_str(), sample.count, sample.r#type.as_deref()), ("on", 7, Some("u16")));
    assert_eq!(sample.more.get(&16), Some(&Some(1)));
    assert_eq!(sample.more.get(&17), Some(&None));
    assert_eq!(sample.place.to_string(), "f:1:1");
}

#[test]
fn all_faults_of_a_record_are_told_at_once_and_in_order() {
    let (sample, faults) = read_sample("tpye: 1\nmore: {16: 1, 0x10: 2, 3: 400, x: 1}\nzzz: 1\ncount: -1\n");
    assert!(sample.is_none());
    let messages: Vec<String> =
        faults.into_sorted().iter().map(|fault| format!("{} {}", fault.place, fault.message)).collect();
    assert_eq!(
        messages,
        [
            "f:1:1 the key `name` is missing here",
            "f:1:1 unknown key `tpye`; did you mean `type`?",
            "f:2:15 `0x10` is the same as a key above it; remove one of them",
            "f:2:27 400 is out of range; expected 0 to 255",
            "f:2:32 `x` is not a whole number; expected one like `12` or `0x0C`",
            "f:3:1 unknown key `zzz`; expected `name`, `count`, `type` or `more`",
            "f:4:8 -1 is out of range; expected 0 to 255",
        ]
    );
}

#[test]
fn a_record_is_its_own_schema() {
    let schema = schema_of::<Sample>("Sample file");
    let sample = &schema["$defs"]["Sample"];
    assert_eq!(sample["required"], serde_json::json!(["name"]));
    assert_eq!(sample["additionalProperties"], false);
    assert_eq!(sample["properties"]["count"]["description"], "Has a default.");
    assert_eq!(schema["$ref"], "#/$defs/Sample");
}

#[test]
fn a_long_line_is_cut_around_the_fault() {
    let (_, faults) = read_sample(&format!(
        "name: x # {}\nmore: {{{}, 1: 400}}\n",
        "y".repeat(300),
        ["2: 3"; 60].join(", ")
    ));
    let shown = faults.to_string();
    assert!(shown.lines().all(|line| line.chars().count() < 150), "{shown}");
    let lines: Vec<&str> = shown.lines().skip_while(|line| !line.contains("400 is")).collect();
    let caret = lines[3].chars().position(|character| character == '^').expect("a caret");
    assert!(lines[2].chars().skip(caret).collect::<String>().starts_with("400"), "{shown}");
}

#[test]
fn places_are_right_whatever_ends_the_lines() {
    let text = "# Größe\r\nname: ä\r\nmore: {1: 2,\r\n  °: 400}\r\n";
    let (_, faults) = read_sample(text);
    let places: Vec<String> = faults.into_sorted().iter().map(|fault| fault.to_string()).collect();
    assert_eq!(
        places,
        [
            "f:4:3: `°` is not a whole number; expected one like `12` or `0x0C`\n  |\n4 |   °: 400}\n  |   ^\n",
            "f:4:6: 400 is out of range; expected 0 to 255\n  |\n4 |   °: 400}\n  |      ^^^\n",
        ]
    );
}
