//! The gateway and the devices that transcripts speak of: a header line `device NAME UNIT KIND` each.

use busker::engine::address::{Address, Bits, Span, Table};
use busker::engine::device::{
    Case, Decimals, Device, Encoding, Form, Identify, Kind, Names, Point, Poll, Unit, Write, WriteRule,
};
use busker::engine::profile::Library;
use busker::engine::settings::{
    Bus, DeviceSettings, Eeprom, HomeAssistant, Http, Line, Link, Mqtt, OnBrokerLoss, Parity, Password,
    Recorder, Rs485, Settings, Wanted,
};
use busker::engine::time::Duration;
use busker::engine::units::Release;
use busker::engine::value::Decimal;
use busker::engine::yaml::Scalar;

/// Reads the header: `device …` lines, `setting DEVICE POINT VALUE` with `enforced` behind it perhaps,
/// `raw-write DEVICE SPAN`,
/// and `tcp`, `discovery`, `json`, `recorder` (which saves files on errors) or `stop feeding` by themselves.
pub fn settings(header: &str) -> Settings {
    let mut devices = Vec::new();
    for line in header.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        if let ["device", name, unit, kind] = words[..] {
            devices.push(DeviceSettings {
                name: name.into(),
                title: name.into(),
                bus: 0,
                unit: unit.parse().expect("a unit"),
                device: device(kind).into(),
                wanted: Vec::new(),
                raw_write: Vec::new(),
            });
        }
        if let ["setting", name, point, value, ref enforced @ ..] = words[..] {
            let device = devices.iter_mut().find(|device: &&mut DeviceSettings| device.name == name);
            let device = device.expect("a device of a line before");
            let point = device.device.points.iter().position(|known| known.name == point).expect("a point");
            let enforce = matches!(enforced, ["enforced"]);
            device.wanted.push(Wanted { point, value: value.into(), enforce });
        }
    }
    for line in header.lines() {
        if let Some((name, span)) = line.strip_prefix("raw-write ").and_then(|rest| rest.split_once(' ')) {
            let device = devices.iter_mut().find(|device: &&mut DeviceSettings| device.name == name);
            let span = <Span as Scalar>::parse(span).expect("a span");
            device.expect("a device of a line before").raw_write.push(span);
        }
    }
    let says = |wanted: &str| header.lines().any(|line| line == wanted);
    Settings {
        mqtt: Mqtt { json: says("json"), ..Mqtt::default() },
        home_assistant: HomeAssistant {
            discovery: says("discovery"),
            prefix: "homeassistant".into(),
            status_topic: "homeassistant/status".into(),
            minimum_version: Release::USUAL,
            expire_after: None,
        },
        http: Http { listen: None, token: Password::None },
        state_dir: "/nowhere".into(),
        republish: Duration::from_secs(if says("republish soon") { 35 } else { 600 }),
        on_broker_loss: if says("stop feeding") { OnBrokerLoss::StopFeeding } else { OnBrokerLoss::Keep },
        eeprom: Eeprom {
            interval: Duration::from_secs(60),
            daily: if says("small budget") { 4 } else { 500 },
        },
        recorder: Recorder {
            bytes: 32 * 1024,
            on_error: says("recorder").then_some(Duration::from_secs(900)),
            keep: 10,
        },
        buses: vec![Bus {
            name: "basement".into(),
            link: if says("tcp") {
                Link::Tcp { host: "localhost".into(), port: 502 }
            } else {
                let line = Line { baud: 19200, parity: Parity::Even, stop_bits: 1 };
                Link::Serial { path: "/dev/null".into(), line, rs485: Rs485::Auto }
            },
            response_timeout: Duration::from_millis(500),
            gap: None,
        }],
        devices,
    }
}

fn device(kind: &str) -> Device {
    match kind {
        file if file.ends_with(".yaml") => of_profile(file),
        "thermometer" => with(vec![
            formed(point("temperature", register(Table::Input, 0, 1), Poll::Fast), tenths("°C")),
            point("strokes", register(Table::Input, 1, 2), Poll::Slow),
        ]),
        "holes" => with(vec![
            point("first", register(Table::Input, 0, 1), Poll::Fast),
            point("third", register(Table::Input, 2, 1), Poll::Fast),
        ]),
        "row" => {
            let names = ["zero", "one", "two", "three"];
            let at = |index: usize| register(Table::Input, index as u16, 1);
            with(names.iter().enumerate().map(|(index, name)| point(name, at(index), Poll::Fast)).collect())
        }
        "relays" => relays(),
        "selectable" => selectable(),
        "thresholds" => thresholds(),
        "input" => input(),
        "awakening" => {
            let mut device = with(vec![point("level", register(Table::Input, 0, 1), Poll::Fast), order()]);
            device.wire.connect_delay = Duration::from_millis(800);
            device
        }
        "identified" => {
            let mut device = with(vec![point("level", register(Table::Input, 0, 1), Poll::Fast), order()]);
            device.identify = Some(Identify::Names { vendor: "ACME".into(), product: "L1".into() });
            device
        }
        "clamping" => {
            let mut device = with(vec![order(), master()]);
            device.wire.quirks.clamps_with_exception = true;
            device
        }
        other => panic!("no kind of device is called `{other}`"),
    }
}

/// A device whose profile stands beside the transcripts.
fn of_profile(file: &str) -> Device {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/transcripts").join(file);
    let text = std::fs::read(&path).expect("a profile beside the transcripts");
    Library::default().check(file, &text).unwrap_or_else(|faults| panic!("{faults:?}"))
}

/// Four relays as coils, what they do after a reset as bits in EEPROM, a watchdog, a reset button.
fn relays() -> Device {
    let mut points: Vec<Point> = (0..2)
        .map(|index| {
            let at = register(Table::Coil, index, 1);
            writable(flag(&format!("relay_{}", index + 1), at, Poll::Fast), WriteRule::Any)
        })
        .collect();
    for bit in 0..2 {
        let at = Address { span: Span::single(Table::Holding, 1), bits: Bits::new(bit, bit) };
        let mut default =
            writable(flag(&format!("relay_{}_default", bit + 1), at, Poll::Slow), WriteRule::Any);
        default.persistent = true;
        points.push(default);
    }
    let mut watchdog = point("watchdog", register(Table::Holding, 66, 1), Poll::Slow);
    let mut seconds = Form::new(Kind::U16);
    seconds.scale = Decimal { units: 1, decimals: 2 };
    watchdog = writable(formed(watchdog, seconds), range("0", "655.35"));
    watchdog.persistent = true;
    points.push(watchdog);
    let reset = point("reset", register(Table::Holding, 79, 1), Poll::Never);
    points.push(writable(reset, WriteRule::Press { word: 10, self_clearing: false }));
    let mut device = with(points);
    device.wire.watchdog = Some(4);
    device
}

/// A reading that is a current or a voltage, as a code in EEPROM says.
fn selectable() -> Device {
    let names = vec![(0, "current".to_string()), (1, "voltage".to_string()), (2, "off".to_string())];
    let mut mode_form = Form::new(Kind::U16);
    mode_form.names = Names::All(names);
    let mode = formed(point("mode", register(Table::Holding, 16, 1), Poll::Slow), mode_form);
    let mut mode = writable(mode, WriteRule::Any);
    mode.persistent = true;
    let mut value = point("value", register(Table::Input, 0, 1), Poll::Fast);
    let case = |key, name: &str, unit: Option<&str>| Case { key, name: name.into(), form: unit.map(tenths) };
    value.encoding = Encoding::Cases {
        by: 0,
        cases: vec![case(0, "current", Some("mA")), case(1, "voltage", Some("V")), case(2, "off", None)],
    };
    with(vec![mode, value])
}

/// Two settings of which one has to be the smaller; the device sees to that (FuehlerSysteme, chapter 6.1.2).
fn thresholds() -> Device {
    let setting = |name: &str, address: u16, other: usize| {
        let at = register(Table::Holding, address, 1);
        let mut setting = writable(point(name, at, Poll::Slow), range("0", "9999"));
        setting.persistent = true;
        setting.re_read = vec![other];
        setting
    };
    let mut device = with(vec![setting("off_below", 0, 1), setting("on_above", 1, 0)]);
    device.wire.quirks.clamps_with_exception = true;
    device
}

/// What is measured, and a threshold in its unit; both in EEPROM.
fn input() -> Device {
    let mut device = selectable();
    let mut threshold = point("threshold", register(Table::Holding, 20, 1), Poll::Slow);
    let case = |key, name: &str, unit: &str, most: i128| {
        let mut form = tenths(unit);
        form.range = Some((Decimal::ZERO, Decimal::integer(most)));
        Case { key, name: name.into(), form: Some(form) }
    };
    let mut cases = vec![case(0, "current", "mA", 20), case(1, "voltage", "V", 10)];
    cases.push(Case { key: 2, name: "off".into(), form: None });
    threshold.encoding = Encoding::Cases { by: 0, cases };
    let mut threshold = writable(threshold, WriteRule::Any);
    threshold.persistent = true;
    device.points.push(threshold);
    device
}

/// 0 or 1, or 11111 for "automatic".
fn order() -> Point {
    let mut form = Form::new(Kind::U16);
    form.names = Names::All(vec![(0, "OFF".into()), (1, "ON".into()), (11111, "automatic".into())]);
    writable(formed(point("order", register(Table::Holding, 1, 1), Poll::Fast), form), WriteRule::Any)
}

/// A number that the device limits to 100 whatever the profile says.
fn master() -> Point {
    writable(point("level", register(Table::Holding, 2, 1), Poll::Fast), range("0", "255"))
}

fn range(min: &str, max: &str) -> WriteRule {
    let decimal = |text: &str| Decimal::parse(text).expect("a decimal");
    WriteRule::Range { min: decimal(min), max: decimal(max), step: None }
}

fn tenths(unit: &str) -> Form {
    let mut form = Form::new(Kind::I16);
    form.decimals = Some(Decimals::Fixed(1));
    form.unit = Unit::Fixed(unit.into());
    form
}

fn register(table: Table, first: u16, count: u16) -> Address {
    Address { span: Span::with_count(table, first, count).expect("a span"), bits: None }
}

fn formed(mut point: Point, form: Form) -> Point {
    point.encoding = Encoding::Plain(form);
    point
}

fn writable(mut point: Point, rule: WriteRule) -> Point {
    point.write = Some(Write::new(point.at, rule));
    point
}

fn flag(name: &str, at: Address, poll: Poll) -> Point {
    formed(point(name, at, poll), Form::new(Kind::Bool))
}

/// A number, of 32 bits where it has two registers.
fn point(name: &str, at: Address, poll: Poll) -> Point {
    let point = Point::new(name, at, poll);
    if at.span.count() == 2 { formed(point, Form::new(Kind::U32)) } else { point }
}

fn with(points: Vec<Point>) -> Device {
    Device {
        profile: "test/device".into(),
        manufacturer: "Test".into(),
        model: "T1".into(),
        source: "a transcript".into(),
        points,
        ..Device::default()
    }
}
