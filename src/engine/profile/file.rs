//! Exactly what a profile file may say. Nothing here is used after loading.

use serde_json::{Value as Json, json};

use crate::engine::address::{Address, Span};
use crate::engine::device::{Category, Kind, Order, OutOfRange, Platform, Poll, ThingKind, WriteFunction};
use crate::engine::profile::text::{Digits, Name, PointPath, Quirk, Range, Repeat, Step, Writable};
use crate::engine::time::{Date, Duration};
use crate::engine::value::Decimal;
use crate::engine::yaml::{At, Content, Definitions, Faults, Map, Node, Read};
use crate::record;

record! {
    /// One type of device, as its manual describes it.
    pub struct Profile {
        /// The profile's name: its path below the profiles' folder, without `.yaml`.
        device: At<String>,
        /// Who makes it.
        manufacturer: String,
        /// The model, as printed on it.
        model: String,
        /// The manual that this was written from: its revision or date, the pages, the firmware.
        source: String,
        /// How to be sure that the right device answers.
        identify: Option<Identify>,
        /// How the device behaves on the wire.
        wire: Option<Wire>,
        /// How the device is told its bit rate, parity and unit.
        line: Option<LineControl>,
        /// What can be read and written, by name.
        points: Map<Name, Point>,
        /// Things made of several points, by name or, in a repeated group, by path.
        things: Map<PointPath, Thing> = Map::default(),
        /// Spans of the manual that are no points, each with its reason.
        left_out: Map<Span, String> = Map::default(),
        /// How points look, by their paths; only what the facts above cannot tell.
        home_assistant: Map<PointPath, Presentation> = Map::default(),
    }
}

record! {
    /// Either `vendor` and `product` (Read Device Identification, both must be equal), or `at` and
    /// `equals` (a register).
    pub struct Identify {
        /// Object 0 of Read Device Identification (function code 43/14).
        vendor: Option<String>,
        /// Object 1 of Read Device Identification.
        product: Option<String>,
        /// A register that tells the device apart.
        at: Option<At<Span>>,
        /// What it holds.
        equals: Option<u16>,
        /// Only these of its bits count.
        mask: Option<u16>,
    }
}

record! {
    /// How the device is told its bit rate, parity and unit. Either `at`, `baud` and `parity` (a register), or
    /// `by_hand`.
    pub struct LineControl {
        /// The register that takes bit rate and parity, in one word and from its answer on.
        at: Option<At<Span>>,
        /// Bits without which the device takes no word there.
        add: Option<u16>,
        /// What stands for each bit rate.
        baud: Map<u32, u16> = Map::default(),
        /// What stands for each parity.
        parity: Option<ParityCodes>,
        /// The switches at the device that set bit rate and parity, in words for people.
        by_hand: Option<String>,
        /// The switches at the device that set its unit, in words for people.
        unit: String,
    }
}

record! {
    /// What stands for each parity.
    pub struct ParityCodes {
        even: Option<u16>,
        odd: Option<u16>,
        none: Option<u16>,
    }
}

record! {
    /// How the device behaves on the wire.
    pub struct Wire {
        /// The order of the bytes of long values; high word and high byte first where it is left out.
        order: Option<Order>,
        /// What one request may ask.
        limits: Option<Limits>,
        /// Each read lies within one of these spans; left out: anywhere.
        readable: Vec<At<Span>> = Vec::new(),
        /// Spans that are never in any request, each with its reason.
        forbidden: Map<Span, String> = Map::default(),
        /// The periods of the poll classes.
        poll: Option<Intervals>,
        /// How long to wait for a reply, if the device needs more than the bus is set to.
        response_timeout: Option<Duration>,
        /// Silence that the device needs behind a connect, before the first request.
        connect_delay: Option<Duration>,
        /// Where the device departs from the Modbus specification.
        quirks: Vec<Quirk> = Vec::new(),
        /// The point that holds the time after which outputs fall to their safe state unless a message comes.
        watchdog: Option<At<PointPath>>,
    }
}

record! {
    /// What one request may ask.
    pub struct Limits {
        /// Registers in one read, 125 where it is left out.
        read_registers: Option<At<u16>>,
        /// Coils or discrete inputs in one read, 2000 where it is left out.
        read_bits: Option<At<u16>>,
        /// Registers in one write, 123 where it is left out.
        write_registers: Option<At<u16>>,
        /// Unused addresses worth reading over; 0: never; left out: as many as are cheaper than a second request.
        gap: Option<u16>,
        /// Silence that the device needs before each request.
        delay: Option<Duration>,
    }
}

record! {
    /// The periods of the poll classes.
    pub struct Intervals {
        /// For what a person waits for; 1s where it is left out.
        fast: Option<At<Duration>>,
        /// For settings; 30s where it is left out.
        slow: Option<At<Duration>>,
    }
}

record! {
    /// One thing that can be read or written, or a group of them, or both.
    pub struct Point {
        /// Repeats the point, and the points of its group: `1..8`.
        r#for: Option<At<Repeat>>,
        /// The points of a repeated group.
        points: Option<At<Map<Name, Point>>>,
        /// Where it is read: `input 32`, `holding 16.8`, `holding 16.0..7`, `coil 0`. Counted from 0.
        at: Option<At<Address>>,
        /// From one repetition to the next: registers, or `1 bit`. Left out: the point's own width.
        step: Option<At<Step>>,
        /// The same value in another place; it is read from whichever costs less.
        also: Option<At<Address>>,
        /// As `step`, for `also`.
        also_step: Option<At<Step>>,
        /// Registers that belong to it, where that is more than the type of some case fills.
        width: Option<At<u16>>,
        /// A difference between two values, such as an offset: 5 K are not 41 °F.
        difference: bool = false,
        /// The point that decides how this one is understood.
        by: Option<At<PointPath>>,
        /// The cases, by the deciding point's named values; `null`: no reading then. Or a shared file.
        is: Option<At<Cases>>,
        /// It is understood as the point that this one, which `refers`, names now.
        like: Option<At<PointPath>>,
        /// It holds the number of a register of this span, and is shown as the name of the point there.
        refers: Option<At<Span>>,
        /// What it may mean as the device is set up, where the device itself does not say: the configuration
        /// names one of these.
        ranges: Map<Name, Form> = Map::default(),
        /// It lives only while each of these points has one of these values.
        when: Map<PointPath, Vec<At<String>>> = Map::default(),
        /// An array of so many values of the type.
        count: Option<At<u16>>,
        /// Each flip of this bit is an event of this type.
        event: Option<At<Name>>,
        /// Flags by their bits, 0 the lowest; each becomes a point.
        bits: Option<At<Map<u8, Name>>>,
        /// When it is read.
        poll: Option<At<Poll>>,
        /// What may be written: `any`, `0..3`, `4..20 step 0.5`, or some of the named values.
        write: Option<At<Writable>>,
        /// What becomes of a command with a number beyond the range; `refuse` where it is left out.
        out_of_range: Option<At<OutOfRange>>,
        /// Where it is written, if not where it is read.
        write_at: Option<At<Address>>,
        /// As `step`, for `write_at`.
        write_at_step: Option<At<Step>>,
        /// The only function code that writes it.
        write_with: Option<At<WriteFunction>>,
        /// So long the device needs until what was written can be read back.
        settle: Option<At<Duration>>,
        /// The device acts only when the content changes: this named value stands between two equal ones.
        on_change: Option<At<String>>,
        /// The point with the longest time between two writes; what the register holds is repeated in time.
        heartbeat: Option<At<PointPath>>,
        /// A button: the word that is written.
        press: Option<At<u16>>,
        /// The word pressed may read back as 0.
        self_clearing: Option<At<bool>>,
        /// Kept in EEPROM: written only when it differs.
        persistent: Option<At<bool>>,
        /// Reading it changes the device; it travels alone.
        read_clears: Option<At<bool>>,
        /// The factory setting, as the register holds it.
        default: Option<At<i128>>,
        /// Points that a write to this one changes.
        re_read: Vec<At<PointPath>> = Vec::new(),
    } and form: Form
}

record! {
    /// Several points that are one thing to a person.
    pub struct Thing {
        /// What it is.
        r#as: At<ThingKind>,
        /// It lives only while each of these points has one of these values.
        when: Map<PointPath, Vec<At<String>>> = Map::default(),
        /// Its states, each with the values of points that make it; the first that holds counts.
        state: Map<String, Map<PointPath, At<String>>> = Map::default(),
        /// Its commands, each with what is written, one after the other.
        r#do: Map<String, Vec<Map<PointPath, At<String>>>> = Map::default(),
        /// The point with the present temperature; of a climate only.
        temperature: Option<At<PointPath>>,
        /// The point that is the wanted temperature; of a climate only.
        target: Option<At<PointPath>>,
    }
}

record! {
    /// How the words of a value are understood.
    pub struct Form {
        /// `u16` where it is left out; coils, discrete inputs and single bits are flags.
        r#type: Option<At<Kind>>,
        /// The order of its bytes, if not the device's.
        order: Option<Order>,
        /// Multiplies what the register holds.
        scale: Option<At<Decimal>>,
        /// Is added, after scale and decimals.
        offset: Option<At<Decimal>>,
        /// Digits behind the dot of what the register holds, or the point that says how many.
        decimals: Option<At<Digits>>,
        /// The register counts seconds since this day began (UTC), `1970-01-01` or `2000-01-01`, and stands for a
        /// moment.
        since: Option<At<Date>>,
        /// The unit, as Home Assistant spells it. Beside a shared `is`: instead of each `unit_by` there.
        unit: Option<At<String>>,
        /// The point whose named value is the unit.
        unit_by: Option<At<PointPath>>,
        /// Names of register values, or a shared file.
        values: Option<At<Values>>,
        /// The name, one of `values`, for every register value that has none.
        others: Option<At<String>>,
        /// Names of the shared file that this device does not have.
        without: Vec<At<String>> = Vec::new(),
        /// Register values that mean "no reading", with the reason.
        invalid: Map<i128, String> = Map::default(),
        /// The measuring range, in the unit (temperatures in °C).
        range: Option<At<Range>>,
    }
}

record! {
    /// One line of a shared file: a name for a register value, and what that value makes of others.
    pub struct SharedCase {
        /// The name of the register value.
        name: At<String>,
    } and form: Form
}

record! {
    /// How a point looks.
    pub struct Presentation {
        /// The platform, where another than the derived one is meant.
        r#as: Option<At<Platform>>,
        /// What people call it. The number of a repetition is put behind it.
        name: Option<String>,
        /// Home Assistant's device class.
        device_class: Option<At<String>>,
        /// Home Assistant's state class.
        state_class: Option<At<String>>,
        /// Main values have none.
        category: Option<Category>,
        /// `mdi:…`
        icon: Option<At<String>>,
        /// Whether Home Assistant shows it without being asked.
        enabled: Option<bool>,
    }
}

/// Names of register values.
#[derive(Clone, Debug)]
pub enum Values {
    Listed(Map<i128, String>),
    /// `shared/measuring`
    Shared(String),
}

/// What the deciding point's named values make of this one.
#[derive(Clone, Debug)]
pub enum Cases {
    Listed(Map<String, Option<Form>>),
    /// `shared/measuring`
    Shared(String),
}

impl Read for Values {
    fn read(node: &Node, faults: &mut Faults) -> Option<Values> {
        match shared(node, "a map of register values to names", faults)? {
            Some(file) => Some(Values::Shared(file)),
            None => Map::read(node, faults).map(Values::Listed),
        }
    }

    fn schema(definitions: &mut Definitions) -> Json {
        shared_or(<Map<i128, String> as Read>::schema(definitions))
    }
}

impl Read for Cases {
    fn read(node: &Node, faults: &mut Faults) -> Option<Cases> {
        match shared(node, "a map with a case for each name", faults)? {
            Some(file) => Some(Cases::Shared(file)),
            None => Map::read(node, faults).map(Cases::Listed),
        }
    }

    fn schema(definitions: &mut Definitions) -> Json {
        shared_or(<Map<String, Option<Form>> as Read>::schema(definitions))
    }
}

/// `Some(None)` for a map; a list and any other text are faults.
fn shared(node: &Node, expected: &str, faults: &mut Faults) -> Option<Option<String>> {
    match (&node.content, node.text()) {
        (Content::Map(_), _) => return Some(None),
        (_, Some(text)) if text.starts_with("shared/") => return Some(Some(text.into())),
        _ => {}
    }
    faults.add(
        &node.place,
        format!("{} stands here; expected {expected}, or a file like `shared/measuring`", node.found()),
    );
    None
}

fn shared_or(schema: Json) -> Json {
    json!({"anyOf": [{"type": "string", "pattern": "^shared/[a-z0-9_-]+$"}, schema]})
}
