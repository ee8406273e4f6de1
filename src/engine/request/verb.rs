//! What can be asked for over MQTT, by name: what its object may say, and an example of it.

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verb {
    Read,
    Write,
    Identify,
    Diagnostics,
    Scan,
    Refresh,
    Pause,
    Record,
}

impl Verb {
    pub(super) const ALL: [Verb; 8] = [
        Verb::Read,
        Verb::Write,
        Verb::Identify,
        Verb::Diagnostics,
        Verb::Scan,
        Verb::Refresh,
        Verb::Pause,
        Verb::Record,
    ];

    pub const fn name(self) -> &'static str {
        match self {
            Verb::Read => "read",
            Verb::Write => "write",
            Verb::Identify => "identify",
            Verb::Diagnostics => "diagnostics",
            Verb::Scan => "scan",
            Verb::Refresh => "refresh",
            Verb::Pause => "pause",
            Verb::Record => "record",
        }
    }

    /// What its object may say beside `transaction`.
    pub(super) const fn keys(self) -> &'static [&'static str] {
        match self {
            Verb::Read => &["device", "at", "clears", "transaction"],
            Verb::Write => &["device", "at", "value", "transaction"],
            Verb::Identify | Verb::Diagnostics => &["device", "transaction"],
            Verb::Scan => &["bus", "units", "transaction"],
            Verb::Refresh => &["device", "point", "transaction"],
            Verb::Pause => &["bus", "device", "for", "transaction"],
            Verb::Record => &["bus", "device", "transaction"],
        }
    }

    pub(super) const fn example(self) -> &'static str {
        match self {
            Verb::Read => r#"{"device":"heating_relays","at":"holding 0..3","transaction":"1"}"#,
            Verb::Write => r#"{"device":"heating_relays","at":"holding 10","value":7,"transaction":"1"}"#,
            Verb::Identify | Verb::Diagnostics => r#"{"device":"heating_relays","transaction":"1"}"#,
            Verb::Scan => r#"{"bus":"basement","units":"1..247","transaction":"1"}"#,
            Verb::Refresh => r#"{"device":"heating_relays","point":"relay_1","transaction":"1"}"#,
            Verb::Pause => r#"{"bus":"basement","for":"10m","transaction":"1"}"#,
            Verb::Record => r#"{"bus":"basement","transaction":"1"}"#,
        }
    }
}
