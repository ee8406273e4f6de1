//! Configurations that are right, and what becomes of them. Faults have their home in
//! `tests/bad-configs`.

use proptest::prelude::*;

use super::*;
use crate::engine::codec;
use crate::engine::device::Poll;
use crate::engine::settings::{ClientCertificate, Direction, Line, Link, OnBrokerLoss, Parity, Rs485, Tls};
use crate::engine::value::Decimal;

/// A device without cases and one that decides how its reading is understood.
const PROFILE: &str = "
device: acme/ra2
manufacturer: Acme Controls
model: RA2
source: a test, revision 1
wire: {poll: {fast: 500ms, slow: 20s}}
points:
  relay: {for: 1..2, at: coil 0, poll: fast, write: any}
  flow: {at: input 0, poll: slow}
  mode: {at: holding 0, poll: slow, values: {0: voltage, 1: pt100}}
  level: {at: input 1, poll: fast, by: mode, is: {voltage: {unit: V}, pt100: {unit: °C}}}
left_out: {holding 9: line settings}
";

fn library() -> Library {
    let mut library = Library::default();
    library.add("acme/ra2.yaml", "acme/ra2.yaml", PROFILE.into());
    library
}

fn good(text: &str) -> (Settings, Vec<String>) {
    match load("f", text.as_bytes(), &library()) {
        Ok((settings, warnings)) => {
            (settings, warnings.iter().map(|warning| warning.message.clone()).collect())
        }
        Err(faults) => panic!("{}", faults.iter().map(ToString::to_string).collect::<String>()),
    }
}

/// A whole file with these lines under `devices.pump.points`.
fn with_wishes(wishes: &str) -> Device {
    let text = format!(
        "buses: {{plant: {{tcp: 'h:502'}}}}\n\
         devices:\n  pump:\n    profile: acme/ra2\n    bus: plant\n    unit: 0\n    points:\n{wishes}"
    );
    Device::clone(&good(&text).0.devices.remove(0).device)
}

#[test]
fn a_range_that_the_owner_states_holds_while_the_switches_stand_as_they_were() {
    let text = "
buses: {plant: {tcp: 'h:502'}}
devices:
  currents:
    profile: metz-connect/mr-ci4
    bus: plant
    unit: 18
    points:
      input_1: {range: current_from_4, when: {dip_switch_1: [ON], dip_switch_2: [OFF]}}
      input_2: {range: voltage}
";
    let (settings, _) = load("f", text.as_bytes(), &Library::shipped()).expect("a good file");
    let device = &settings.devices[0].device;
    let index = |name: &str| device.point_named(name).expect(name);
    let reading = |name: &str, switches: [i128; 2], word: u16| {
        let mut known = vec![None; device.points.len()];
        known[index("dip_switch_1")] = Some(switches[0]);
        known[index("dip_switch_2")] = Some(switches[1]);
        match codec::resolve(device, index(name), &known) {
            Ok(resolved) => {
                format!("{} {}", codec::read(&resolved, &[word]), resolved.unit.unwrap_or_default())
            }
            Err(missing) => missing.to_string(),
        }
    };
    // Page 59: 0 is 4 mA, 32767 is 20.38 mA.
    assert_eq!(reading("input_1", [1, 0], 0), "4.0000 mA");
    assert_eq!(reading("input_1", [1, 0], 32767), "20.3835 mA");
    assert_eq!(reading("input_1", [1, 1], 32767), "no reading in this mode");
    assert_eq!(reading("input_2", [0, 0], 32767), "10.2396875 V");
    assert_eq!(reading("input_3", [0, 0], 32767), "32767 ");
}

#[test]
fn the_kernel_switches_a_transceiver_only_where_it_is_told_to() {
    let usual = Direction::default();
    let slow = Direction { rts_on_send: false, delay_before_send: Duration::from_millis(2), ..usual };
    for (said, expected) in [
        ("", Rs485::Auto),
        (", rs485: auto", Rs485::Auto),
        (", rs485: none", Rs485::None),
        (", rs485: kernel", Rs485::Kernel(usual)),
        (", rs485: {}", Rs485::Kernel(usual)),
        (", rs485: {rts_on_send: false, delay_before_send: 2ms}", Rs485::Kernel(slow)),
    ] {
        let (settings, _) = good(&format!("buses: {{shed: {{serial: /dev/ttyAMA0{said}}}}}"));
        let Link::Serial { rs485, .. } = settings.buses[0].link else { panic!("a serial port") };
        assert_eq!(rs485, expected, "{said}");
    }
}

#[test]
fn every_key_has_its_place() {
    let (settings, warnings) = good(
        "
mqtt: {url: 'mqtt://[fe80::1]:1884', username: busker, password_file: /p, base_topic: house/busker,
       keep_alive: 1m}
home_assistant: {discovery: false, prefix: ha, status_topic: ha/up, minimum_version: '2025.4', expire_after: 3h}
http: {listen: 'localhost:0', token: s3cret}
state_dir: /tmp/state
republish: 1h
on_broker_loss: stop_feeding
profiles: [/etc/busker/device-profiles]
buses:
  basement: {serial: /dev/ttyUSB0, baud: 9600, parity: odd, stop_bits: 2, response_timeout: 1s, gap: 5ms}
  attic: {rtu_over_tcp: 'serial-server:4196'}
devices:
  pump_2: {profile: acme/ra2, bus: attic, unit: 7, poll: {fast: 250ms}, raw_write: [holding 0..9, coil 1]}
",
    );
    assert_eq!((settings.mqtt.host.as_str(), settings.mqtt.port), ("fe80::1", 1884));
    assert_eq!(settings.mqtt.base_topic, "house/busker");
    assert_eq!(settings.mqtt.keep_alive, Duration::from_secs(60));
    assert!(settings.mqtt.password == Password::File("/p".into()));
    assert_eq!(
        settings.home_assistant,
        HomeAssistant {
            discovery: false,
            prefix: "ha".into(),
            status_topic: "ha/up".into(),
            minimum_version: Release::OLDEST,
            expire_after: Some(Duration::from_secs(10_800)),
        }
    );
    assert_eq!(settings.http.listen.as_deref(), Some("localhost:0"));
    assert!(settings.http.token == Password::Given("s3cret".into()));
    assert!(!format!("{settings:?}").contains("s3cret"));
    assert_eq!(settings.on_broker_loss, OnBrokerLoss::StopFeeding);
    assert_eq!(settings.republish, Duration::from_secs(3600));
    let line = Line { baud: 9600, parity: Parity::Odd, stop_bits: 2 };
    assert_eq!(
        settings.buses[0].link,
        Link::Serial { path: "/dev/ttyUSB0".into(), line, rs485: Rs485::Auto }
    );
    assert_eq!(settings.buses[0].gap, Some(Duration::from_millis(5)));
    let line = Line { baud: 19_200, parity: Parity::Even, stop_bits: 1 };
    assert_eq!(settings.buses[1].link, Link::RtuOverTcp { host: "serial-server".into(), port: 4196, line });
    let device = &settings.devices[0];
    assert_eq!((device.title.as_str(), device.bus, device.unit), ("Pump 2", 1, 7));
    assert_eq!(device.device.wire.intervals.fast, Duration::from_millis(250));
    assert_eq!(device.device.wire.intervals.slow, Duration::from_secs(20));
    let raw_write: Vec<String> = device.raw_write.iter().map(ToString::to_string).collect();
    assert_eq!(raw_write, ["holding 0..9", "coil 1"]);
    assert_eq!(
        warnings,
        [
            "no device is on the bus `basement`",
            "`/dev/ttyUSB0` may be another adapter after the next start; use its path under `/dev/serial/by-id/`",
            "`holding 0..9` touches `holding 9`, which the profile leaves out: line settings",
        ]
    );
}

#[test]
fn what_is_left_out_has_the_documented_default() {
    let (settings, warnings) = good("buses: {}\n");
    assert_eq!(warnings, ["no device is configured; devices stand under `devices`"]);
    assert_eq!((settings.mqtt.host.as_str(), settings.mqtt.port), ("localhost", 1883));
    assert_eq!((settings.mqtt.base_topic.as_str(), settings.mqtt.username), ("busker", None));
    assert!(settings.home_assistant.discovery);
    assert_eq!(settings.home_assistant.status_topic, "homeassistant/status");
    assert_eq!(settings.home_assistant.expire_after, None);
    assert_eq!(settings.http.listen.as_deref(), Some("127.0.0.1:8485"));
    assert_eq!(settings.state_dir, PathBuf::from("/var/lib/busker"));
    assert_eq!(settings.republish, Duration::from_secs(600));
    assert_eq!(settings.on_broker_loss, OnBrokerLoss::Keep);
    assert!(settings.http.token == Password::None);
    let http = good("buses: {}\nhttp: {listen: null, token_file: /t}\n").0.http;
    assert!(http.listen.is_none() && http.token == Password::File("/t".into()));
    assert_eq!(good("buses: {}\nhttp: null\n").0.http.listen, None);
}

#[test]
fn the_url_says_how_the_broker_is_reached() {
    for (url, host, port, tls, websocket) in [
        ("mqtt://h", "h", 1883, false, None),
        ("mqtt://h/", "h", 1883, false, None),
        ("mqtts://h", "h", 8883, true, None),
        ("mqtts://[fe80::1]:1", "fe80::1", 1, true, None),
        ("ws://h", "h", 80, false, Some("/mqtt")),
        ("ws://h:9001/", "h", 9001, false, Some("/")),
        ("wss://h/a/b", "h", 443, true, Some("/a/b")),
    ] {
        let mqtt = good(&format!("mqtt: {{url: '{url}'}}\nbuses: {{}}\n")).0.mqtt;
        let found = (mqtt.host.as_str(), mqtt.port, mqtt.tls.is_some(), mqtt.websocket.as_deref());
        assert_eq!(found, (host, port, tls, websocket), "{url}");
    }
}

#[test]
fn files_are_meant_from_where_the_configuration_lies() {
    let (mut settings, _) = good(
        "
mqtt:
  url: mqtts://h
  username: u
  password_file: password
  tls: {ca_file: /ca.pem, cert_file: own/cert.pem, key_file: own/key.pem}
http: {token_file: token}
buses: {}
",
    );
    settings.resolve_files(std::path::Path::new("/etc/busker"));
    assert!(settings.mqtt.password == Password::File("/etc/busker/password".into()));
    assert!(settings.http.token == Password::File("/etc/busker/token".into()));
    let client = ClientCertificate {
        cert_file: "/etc/busker/own/cert.pem".into(),
        key_file: "/etc/busker/own/key.pem".into(),
    };
    assert_eq!(settings.mqtt.tls, Some(Tls { ca_file: Some("/ca.pem".into()), client: Some(client) }));
}

#[test]
fn a_fault_in_a_named_file_is_told_where_it_is_named_and_without_the_password() {
    let text = b"mqtt: {url: mqtts://h, tls: {ca_file: nowhere}, username: u, password: s3cret}\n";
    let fault = fault_at("f", text, &["mqtt", "tls", "ca_file"], "cannot read `nowhere`".into()).to_string();
    assert!(fault.starts_with("f:1:39: cannot read `nowhere`\n"), "{fault}");
    assert!(!fault.contains("s3cret"), "{fault}");
    let fault = fault_at("f", b"buses: {}\n", &["mqtt", "url"], "no".into()).to_string();
    assert!(fault.starts_with("f:1:1: no\n"), "{fault}");
}

#[test]
fn a_wish_changes_its_point_and_no_other() {
    let device = with_wishes(
        "      relay_1: {name: Circulation pump, device_class: outlet, icon: 'mdi:fan'}
      relay_2: {enabled: false, as: binary_sensor}
      flow: {unit: m³/h, device_class: volume_flow_rate, deadband: 0.5, poll: fast}\n",
    );
    let point = |name: &str| device.points.iter().find(|point| point.name == name).expect("a point");
    assert_eq!(point("relay_1").presentation.name.as_deref(), Some("Circulation pump"));
    assert_eq!(point("relay_1").presentation.device_class.as_deref(), Some("outlet"));
    assert_eq!(point("relay_2").presentation.name, None);
    assert_eq!(point("relay_2").presentation.enabled, Some(false));
    let flow = point("flow");
    assert_eq!(flow.poll, Poll::Fast);
    assert_eq!(flow.deadband, Decimal::parse("0.5"));
    assert_eq!(
        flow.plain().map(|form| form.unit.clone()),
        Some(crate::engine::device::Unit::Fixed("m³/h".into()))
    );
}

#[test]
fn a_device_may_bring_its_own_points() {
    let (settings, _) = good(
        "
buses: {plant: {tcp: 'h:502'}}
devices:
  boiler:
    bus: plant
    unit: 255
    points: {flow: {at: input 0, type: i16, decimals: 1, unit: °C, poll: fast}}
    wire: {limits: {read_registers: 8}}
    home_assistant: {flow: {name: Flow}}
",
    );
    let device = &settings.devices[0].device;
    assert_eq!(device.profile, "inline");
    assert_eq!(device.points[0].name, "flow");
    assert_eq!(device.points[0].presentation.name.as_deref(), Some("Flow"));
    assert_eq!(device.wire.limits.read_registers, 8);
}

#[test]
fn settings_are_taken_as_they_stand_with_and_without_enforcement() {
    let (settings, _) = good(
        "
buses: {plant: {tcp: 'h:502'}}
devices:
  relays:
    bus: plant
    unit: 1
    points:
      delay: {at: holding 1, unit: s, poll: slow, write: 0..60, persistent: true}
      inverted: {at: holding 2.0, poll: slow, write: any}
    home_assistant: {inverted: {category: config}}
    settings:
      inverted: ON
      delay: {value: 0.5m, enforce: true}
",
    );
    let wanted = |point, value: &str, enforce| Wanted { point, value: value.into(), enforce };
    assert_eq!(settings.devices[0].wanted, [wanted(1, "ON", false), wanted(0, "0.5m", true)]);
}

#[test]
fn a_faulty_profile_is_told_with_its_own_place() {
    let mut library = library();
    library.add("acme/bad.yaml", "/etc/p/acme/bad.yaml", b"device: acme/bad\nmodel: [\n".to_vec());
    let text = "buses: {b: {tcp: 'h:1'}}\ndevices: {d: {profile: acme/bad, bus: b, unit: 1}}\n";
    let faults = load("f", text.as_bytes(), &library).expect_err("a fault");
    assert!(faults.iter().all(|fault| fault.place.file() == "/etc/p/acme/bad.yaml"), "{faults:?}");
}

#[test]
fn the_profile_folders_are_known_before_the_rest_is_right() {
    let folders = profile_folders("f", b"profiles: [/a, b]\nbuses: 3\n");
    let told: Vec<String> = folders.iter().map(|at| format!("{} {}", at.place, at.value)).collect();
    assert_eq!(told, ["f:1:12 /a", "f:1:16 b"]);
    assert!(profile_folders("f", b"\tx").is_empty());
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..Default::default() })]

    /// A file that is damaged in one place is refused or accepted, and nothing else.
    #[test]
    fn no_damage_makes_the_reader_panic(at in 0usize..600, byte in any::<u8>(), cut in any::<bool>()) {
        let whole = "mqtt: {url: 'mqtt://h', username: u, password: p}\nhttp: {listen: 'h:0'}\n\
            buses: {b: {serial: /dev/x, baud: 9600, gap: 2ms}, c: {tcp: '[::1]:502'}}\n\
            devices:\n  d: {profile: acme/ra2, bus: b, unit: 3, points: {flow: {unit: m, deadband: 1}}}\n  \
            e: {bus: c, unit: 0, points: {x: {at: holding 0, poll: slow, write: 0..9, persistent: true}}, \
            settings: {x: {value: 3, enforce: true}}}\n";
        let mut bytes = whole.as_bytes().to_vec();
        let at = at % bytes.len();
        if cut { bytes.truncate(at) } else { bytes[at] = byte }
        // Rendered as well: a place in the middle of a character would panic there.
        if let Err(faults) = load("f", &bytes, &library()) {
            prop_assert!(!faults.is_empty());
            for fault in faults { prop_assert!(fault.to_string().starts_with("f:")); }
        }
    }
}
