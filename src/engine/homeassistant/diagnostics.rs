//! What a bus and a device say of their wire, as diagnostic entities: few that everybody looks for, and
//! more that can be enabled.

use serde_json::{Map, Value, json};

/// Whose entities they are, and where what they tell stands.
pub(super) struct Place<'p> {
    /// The beginning of each unique id.
    pub identity: &'p str,
    /// The beginning of each entity id, behind the platform's dot.
    pub entity: &'p str,
    /// The beginning of each key.
    pub key: &'p str,
    pub topic: &'p str,
    /// The expression of the object in it: `value_json`.
    pub object: &'p str,
    /// The message may come without the object: what the broker keeps may be older than what it tells of.
    pub may_lack: bool,
    /// The seconds after which they are unavailable if nothing is told.
    pub expiry: Option<u64>,
}

/// Entities of this device, in their order.
pub(super) type Components = Vec<(String, Map<String, Value>)>;

/// How an entity looks, beside what all have.
enum Looks {
    /// Counts since the start.
    Counter,
    /// How long something on the wire takes: told in seconds, of which it is thousandths, and shown in
    /// milliseconds.
    Milliseconds,
    /// How often polls come round.
    Period,
    /// Of a whole, in percent.
    Share,
}

impl Place<'_> {
    /// One entity. `value` is an expression of what stands in the object.
    pub(super) fn entity(
        &self,
        platform: &str,
        key: &str,
        name: &str,
        value: &str,
        more: Value,
    ) -> (String, Map<String, Value>) {
        let key = format!("{}{key}", self.key);
        let mut component = object(json!({
            "platform": platform,
            "name": name,
            "entity_category": "diagnostic",
            "unique_id": format!("{}_{key}", self.identity),
            "default_entity_id": format!("{platform}.{}_{key}", self.entity),
            "state_topic": self.topic,
            "value_template": self.template(value, "none"),
        }));
        component.extend(object(more));
        component.extend(self.expiry.map(|seconds| ("expire_after".into(), seconds.into())));
        (key, component)
    }

    /// What the expression says of the object, or `else`: Home Assistant logs an error for what is not there.
    fn template(&self, value: &str, otherwise: &str) -> String {
        let value = value.replace("OBJECT", self.object);
        match self.may_lack {
            true => format!("{{{{ ({value}) if {} is defined else {otherwise} }}}}", self.object),
            false => format!("{{{{ {value} }}}}"),
        }
    }

    fn of_wire(
        &self,
        key: &str,
        name: &str,
        value: &str,
        looks: Looks,
        enabled: bool,
    ) -> (String, Map<String, Value>) {
        let more = match looks {
            Looks::Counter => json!({"state_class": "total_increasing", "suggested_display_precision": 0}),
            Looks::Milliseconds => duration("ms", 1),
            Looks::Period => duration("s", 2),
            Looks::Share => json!({
                "unit_of_measurement": "%",
                "state_class": "measurement",
                "suggested_display_precision": 1,
            }),
        };
        let (key, mut component) = self.entity("sensor", key, name, value, more);
        if !enabled {
            component.insert("enabled_by_default".into(), false.into());
        }
        (key, component)
    }

    /// What is counted. `often`: those that a person looks at are enabled.
    pub(super) fn counters(&self, often: &[&str]) -> Components {
        let names = [
            ("requests", "Requests"),
            ("timeouts", "Timeouts"),
            ("checksum_errors", "Checksum errors"),
            ("exceptions", "Exceptions"),
            ("late_replies", "Late replies"),
            ("wrong_frames", "Wrong frames"),
            ("noise_bytes", "Discarded bytes"),
        ];
        let entity = |(key, name): (&str, &str)| {
            let value = format!("OBJECT.{key}");
            let (key, mut component) = self.of_wire(key, name, &value, Looks::Counter, often.contains(&key));
            if name == "Exceptions" {
                // Which they were: as attributes, since nobody knows beforehand which there will be.
                component.insert("json_attributes_topic".into(), self.topic.into());
                let codes = self.template("OBJECT.exceptions_by_code | tojson", "'{}'");
                component.insert("json_attributes_template".into(), codes.into());
            }
            (key, component)
        };
        names.into_iter().map(entity).collect()
    }

    /// How long things take: of those that a person looks at one percentile is enabled.
    pub(super) fn times(&self, often: &[&str]) -> Components {
        let names = [
            ("turnaround", "Turnaround"),
            ("gap_wait", "Wait for the line"),
            ("command_wait", "Wait of commands"),
        ];
        let mut components = Components::new();
        let percentiles = [("p50", "median"), ("p95", "95th percentile"), ("p99", "99th percentile")];
        for (key, name) in names {
            for (percentile, spoken) in percentiles {
                let whole = format!("{key}_{percentile}");
                let title = format!("{name}, {spoken}");
                let told = format!("OBJECT.{key}_seconds.{percentile}");
                // Null, where there was nothing lately, stays what Home Assistant calls unknown.
                let value = format!("({told} * 1000) | round(2) if {told} is not none else none");
                let enabled = often.contains(&whole.as_str());
                if enabled || key == "turnaround" || percentile == "p95" {
                    components.push(self.of_wire(&whole, &title, &value, Looks::Milliseconds, enabled));
                }
            }
        }
        components
    }

    /// How busy the wire is, or is with it. What an earlier version has left at the broker may lack it.
    pub(super) fn load(&self, name: &str, enabled: bool) -> (String, Map<String, Value>) {
        let value = "((OBJECT.load * 100) | round(2)) if OBJECT.load is defined else none";
        self.of_wire("load", name, value, Looks::Share, enabled)
    }

    /// The real period of a poll class. A bus may have no device with such polls, and what an earlier version
    /// has told of it no periods at all.
    pub(super) fn period(&self, class: &str, name: &str, enabled: bool) -> (String, Map<String, Value>) {
        let periods = "OBJECT.periods";
        let mut value = format!("{periods}.{class}.seconds");
        if self.may_lack {
            value += &format!(" if {periods} is defined and {periods}.{class} is defined else none");
        }
        self.of_wire(&format!("{class}_period"), name, &value, Looks::Period, enabled)
    }
}

fn duration(unit: &str, digits: u8) -> Value {
    json!({
        "device_class": "duration",
        "unit_of_measurement": unit,
        "state_class": "measurement",
        "suggested_display_precision": digits,
    })
}

pub(super) fn object(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}
