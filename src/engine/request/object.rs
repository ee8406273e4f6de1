//! The JSON object of one request: its keys, and what stands under them.

use serde_json::{Map, Value as Json};

use super::Verb;
use crate::engine::address::Span;
use crate::engine::members::{Members, stands_twice};
use crate::engine::transaction::Transaction;
use crate::engine::yaml::{Scalar, list_of_choices};

/// A longer payload asks for nothing that one request could do.
const PAYLOAD_BYTES_MAX: usize = 16 * 1024;

/// What an answer shall carry even if the rest of the payload is wrong.
pub(super) fn transaction_of(payload: &str) -> Transaction {
    if payload.len() > PAYLOAD_BYTES_MAX {
        return Transaction::default();
    }
    let members = Members::of(payload).ok();
    // Of two of them, neither is it.
    let members = members.filter(|members| members.keys().filter(|key| *key == "transaction").count() == 1);
    members.and_then(|members| members.get("transaction").map(Transaction::of)).unwrap_or_default()
}

/// The payload of one request.
pub(super) struct Object {
    verb: Verb,
    entries: Map<String, Json>,
}

impl Object {
    pub(super) fn parse(verb: Verb, payload: &str) -> Result<Object, String> {
        let expected = format!("expected an object like `{}`", verb.example());
        if payload.len() > PAYLOAD_BYTES_MAX {
            return Err(format!("{} bytes are no request; {expected}", payload.len()));
        }
        let members = Members::of(payload).map_err(|fault| format!("{fault}; {expected}"))?;
        if let Some(key) = members.repeated() {
            return Err(stands_twice(key));
        }
        let entry = |key: &str| {
            let text = members.get(key)?.get();
            // A number that no computer can hold is shown as it stands there.
            Some((key.to_string(), serde_json::from_str(text).unwrap_or_else(|_| Json::from(text))))
        };
        let entries: Map<String, Json> = members.keys().filter_map(entry).collect();
        if let Some(unknown) = entries.keys().find(|key| !verb.keys().contains(&key.as_str())) {
            let remedy = list_of_choices(unknown, verb.keys());
            return Err(format!("`{}` knows no `{unknown}`; {remedy}", verb.name()));
        }
        Ok(Object { verb, entries })
    }

    pub(super) fn missing(&self, key: &str) -> String {
        format!("`{key}` is missing; expected an object like `{}`", self.verb.example())
    }

    pub(super) fn required(&self, key: &str) -> Result<&Json, String> {
        self.entries.get(key).ok_or_else(|| self.missing(key))
    }

    pub(super) fn text(&self, key: &str) -> Result<Option<&str>, String> {
        match self.entries.get(key) {
            None => Ok(None),
            Some(Json::String(text)) => Ok(Some(text)),
            Some(other) => {
                Err(format!("`{key}` is `{other}`; expected a text, as in `{}`", self.verb.example()))
            }
        }
    }

    pub(super) fn flag(&self, key: &str) -> Result<bool, String> {
        match self.entries.get(key) {
            None => Ok(false),
            Some(Json::Bool(flag)) => Ok(*flag),
            Some(other) => Err(format!("`{key}` is `{other}`; expected true or false")),
        }
    }

    pub(super) fn span(&self) -> Result<Span, String> {
        let text = self.text("at")?.ok_or_else(|| self.missing("at"))?;
        <Span as Scalar>::parse(text)
    }
}

/// One word for each address, from a value or a list of values.
pub(super) fn words(span: Span, value: &Json) -> Result<Vec<u16>, String> {
    let is_bits = span.table().is_bits();
    let word = |value: &Json| match (is_bits, value) {
        (true, Json::Bool(on)) => Ok(u16::from(*on)),
        (true, Json::String(text)) if text == "ON" || text == "OFF" => Ok(u16::from(text == "ON")),
        (true, value) if matches!(value.as_u64(), Some(0 | 1)) => Ok(u16::from(value.as_u64() == Some(1))),
        (true, _) => {
            Err(format!("`{value}` is no coil's value; expected true, false, 0, 1, \"ON\" or \"OFF\""))
        }
        (false, value) => match value.as_i64() {
            // -1 and 65535 are the same word.
            Some(number) if (-32_768..=65_535).contains(&number) => Ok(number as u16),
            _ => {
                Err(format!("`{value}` is no register's value; expected a whole number from -32768 to 65535"))
            }
        },
    };
    let words: Vec<u16> = match value {
        Json::Array(values) => values.iter().map(word).collect::<Result<_, _>>()?,
        value => vec![word(value)?],
    };
    if words.len() as u32 != span.count() {
        let wanted = match span.count() {
            1 => "one value".into(),
            count => format!("{count} values, one for each address"),
        };
        return Err(format!("`{span}` takes {wanted}; found {}", words.len()));
    }
    Ok(words)
}
