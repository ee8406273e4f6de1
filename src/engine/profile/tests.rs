//! Profiles as they load.

use super::*;
use crate::engine::device::{Encoding, Kind, Names, Unit, WriteRule};

fn load(points: &str) -> Device {
    let head = "device: acme/ra8\nmanufacturer: Acme\nmodel: RA8\nsource: Map 2.1\n";
    let text = format!("{head}{points}");
    Library::shipped().check("ra8.yaml", text.as_bytes()).unwrap_or_else(|faults| {
        let shown: Vec<String> = faults.iter().map(Diagnostic::to_string).collect();
        panic!("{}", shown.join("\n"))
    })
}

/// Each point as `name at [also …] [write …]`.
fn check_points(points: &str, expected: &[&str]) {
    let shown: Vec<String> = load(&format!("points:\n{points}"))
        .points
        .iter()
        .map(|point| {
            let mut shown = format!("{} {}", point.name, point.at);
            if let Some(also) = point.also {
                shown += &format!(" also {also}");
            }
            if let Some(write) = &point.write {
                shown += &format!(" write {}", write.at);
            }
            shown
        })
        .collect();
    assert_eq!(shown, expected, "{points}");
}

#[test]
fn every_shipped_profile_loads_without_a_fault() {
    let library = Library::shipped();
    assert!(!library.ids().is_empty());
    for id in library.ids() {
        if let Err(faults) = library.load(id) {
            let shown: Vec<String> = faults.iter().map(Diagnostic::to_string).collect();
            panic!("{id}:\n{}", shown.join("\n"));
        }
    }
}

#[test]
fn repetitions_follow_on_by_their_own_width() {
    check_points(
        "  pulses: {for: 1..3, at: input 32, type: u48, poll: slow}\n",
        &["pulses_1 input 32..34", "pulses_2 input 35..37", "pulses_3 input 38..40"],
    );
    check_points(
        "  relay: {for: 1..2, at: coil 2..3, poll: fast, values: {1: open, 2: closed}}\n",
        &["relay_1 coil 2..3", "relay_2 coil 4..5"],
    );
    check_points(
        "  buffer: {for: 90..91, at: holding 90, poll: slow, write: 0..9}\n",
        &["buffer_90 holding 90 write holding 90", "buffer_91 holding 91 write holding 91"],
    );
}

#[test]
fn repetitions_step_as_they_are_told() {
    check_points(
        "  input: {for: 1..2, at: input 20.14, step: 1 bit, also: discrete 0, poll: fast}\n",
        &["input_1 input 20.14 also discrete 0", "input_2 input 20.15 also discrete 1"],
    );
    check_points(
        "  digits: {for: 1..2, at: holding 36.8..15, step: 1, poll: slow}\n",
        &["digits_1 holding 36.8..15", "digits_2 holding 37.8..15"],
    );
    check_points(
        "  on_above: {for: 1..2, at: holding 70, type: f32, step: 4, write_at: holding 100, write_at_step: 10, poll: slow, write: any}\n",
        &[
            "on_above_1 holding 70..71 write holding 100..101",
            "on_above_2 holding 74..75 write holding 110..111",
        ],
    );
}

#[test]
fn a_group_repeats_its_points_and_may_be_a_point_itself() {
    check_points(
        "  relay: {for: 1..2, at: coil 0, poll: fast, write: any, points: {hand: {at: coil 4, poll: fast}}}\n",
        &[
            "relay_1 coil 0 write coil 0",
            "relay_1_hand coil 4",
            "relay_2 coil 1 write coil 1",
            "relay_2_hand coil 5",
        ],
    );
}

#[test]
fn bits_become_flags_of_their_own() {
    check_points(
        "  status: {at: input 100, poll: fast, bits: {0: overheated, 4: supply_low}}\n",
        &["status_overheated input 100.0", "status_supply_low input 100.4"],
    );
    let device = load("points:\n  status: {at: input 100, poll: fast, bits: {0: overheated}}\n");
    assert_eq!(device.points[0].plain().map(|form| form.kind), Some(Kind::Bool));
}

#[test]
fn values_name_all_or_some_of_what_a_register_holds() {
    let names = |point: &str| {
        let device = load(&format!("points:\n  point: {{at: holding 0, poll: slow, {point}}}\n"));
        let form = device.points[0].plain().expect("a plain point").clone();
        (form.kind, form.names)
    };
    let automatic = vec![(11111, "automatic".to_string())];
    assert_eq!(names("values: {0: OFF, 1: ON}"), (Kind::Bool, Names::None));
    assert_eq!(names("values: {11111: automatic}"), (Kind::U16, Names::All(automatic.clone())));
    assert_eq!(
        names("values: {11111: automatic}, write: 0..255"),
        (Kind::U16, Names::Some(automatic.clone()))
    );
    assert_eq!(names("values: {11111: automatic}, type: i16"), (Kind::I16, Names::Some(automatic)));
}

#[test]
fn an_invalid_word_is_kept_as_the_type_decodes_it() {
    let device =
        load("points:\n  t: {at: input 0, type: i16, poll: fast, invalid: {0x8000: open, 0x7FFF: short}}\n");
    let invalid = device.points[0].plain().map(|form| form.invalid.clone());
    assert_eq!(invalid, Some(vec![(-32768, "open".into()), (32767, "short".into())]));
}

#[test]
fn names_are_looked_up_in_the_same_repetition_and_then_at_the_top() {
    let device = load(
        "points:
  unit: {at: holding 9.0, poll: slow, values: {0: °C, 1: °F}}
  channel:
    for: 1..2
    points:
      mode: {at: holding 0, poll: slow, values: {0: off, 1: volts, 2: degrees}, write: any, re_read: [input]}
      decimals: {at: holding 4, poll: slow}
      input:
        at: input 0
        poll: fast
        by: mode
        is: {off: null, volts: {decimals: decimals, unit: V}, degrees: {type: i16, unit_by: unit}}
  all: {at: holding 20, press: 1, re_read: [channel.input]}
",
    );
    let names = |indices: &[usize]| {
        indices.iter().map(|index| device.points[*index].name.as_str()).collect::<Vec<_>>()
    };
    let second = device.points.iter().find(|point| point.name == "channel_2_input").expect("it");
    assert_eq!(names(&second.selectors()), ["unit", "channel_2_mode", "channel_2_decimals"]);
    assert_eq!(names(&device.points[4].re_read), ["channel_2_input"]);
    assert_eq!(names(&device.points[7].re_read), ["channel_1_input", "channel_2_input"]);
    let Encoding::Cases { cases, .. } = &second.encoding else { panic!("no cases") };
    assert_eq!(
        cases.iter().map(|case| (case.key, case.form.is_some())).collect::<Vec<_>>(),
        [(0, false), (1, true), (2, true)]
    );
    assert_eq!(cases[2].form.as_ref().map(|form| form.unit.clone()), Some(Unit::By(0)));
}

#[test]
fn a_repetition_is_named_by_its_number() {
    let device = load(
        "points:\n  relay: {for: 3..4, at: coil 0, poll: fast}\nhome_assistant:\n  relay: {name: Relay, enabled: false}\n",
    );
    let looks = &device.points[1].presentation;
    assert_eq!((looks.name.as_deref(), looks.enabled), (Some("Relay 4"), Some(false)));
}

#[test]
fn a_profile_stands_at_its_path_and_an_owners_file_wins() {
    let mut library = Library::shipped();
    let text = b"device: metz-connect/mr-do4\nmanufacturer: M\nmodel: Mine\nsource: S 1\npoints:\n  a: {at: coil 0, poll: fast}\n";
    library.add("metz-connect/mr-do4.yaml", "/etc/busker/mr-do4.yaml", text.to_vec());
    assert_eq!(library.load("metz-connect/mr-do4").map(|device| device.model), Ok("Mine".into()));
    library.add("acme/other.yaml", "/etc/busker/acme/other.yaml", text.to_vec());
    let message = library.load("acme/other").expect_err("another place").remove(0);
    assert_eq!(
        message.to_string().lines().next(),
        Some(
            "/etc/busker/acme/other.yaml:1:9: `metz-connect/mr-do4` is not where the file is; expected `acme/other`, its path without `.yaml`"
        )
    );
}

#[test]
fn points_may_stand_in_the_configuration() {
    let mut faults = Faults::default();
    let source = Source::new(
        "busker.yaml",
        "points: {flow: {at: holding 0, type: i16, decimals: 1, unit: °C, poll: fast, write: 5..30}}\n",
    );
    let node = parse(&source, &mut faults).expect("a map");
    let points = node.get("points").expect("the key");
    let inline = Inline { points, things: None, wire: None, home_assistant: None };
    let device = load_inline(&inline, &Library::shipped(), &mut faults).expect("a device");
    assert!(faults.is_empty(), "{faults}");
    assert_eq!(device.profile, "inline");
    assert!(matches!(
        device.points[0].write.as_ref().map(|write| &write.rule),
        Some(WriteRule::Range { .. })
    ));
}
