//! What a device can be asked of itself and of its line, by the names that people and programs see.

/// The names of the objects of function 43/14 (Modbus application protocol V1.1b3, 6.21).
const OBJECTS: [&str; 7] =
    ["vendor", "product", "revision", "vendor_url", "product_name", "model_name", "application"];

/// The counters of function 8, by sub-function (Modbus application protocol V1.1b3, 6.8.1).
pub const COUNTERS: [(u16, &str); 8] = [
    (11, "bus_messages"),
    (12, "bus_checksum_errors"),
    (13, "bus_exceptions"),
    (14, "unit_messages"),
    (15, "unit_no_responses"),
    (16, "unit_negative_acknowledges"),
    (17, "unit_busy"),
    (18, "bus_overruns"),
];

/// What the query of function 8/0 holds, and must come back.
pub const QUERY: u16 = 0xA537;

/// The name of an object of function 43/14; the maker's own have only their number.
pub fn object_name(number: u8) -> String {
    OBJECTS.get(usize::from(number)).map_or_else(|| format!("object_{number}"), |name| name.to_string())
}

/// The server id of function 17: `0A FF`.
pub fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ")
}
