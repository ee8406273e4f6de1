//! What a message on a `set` topic wishes: a value, and perhaps a transaction that comes back with the outcome.

use super::{Outcome, OutcomeKind};
use crate::engine::members::{Members, stands_twice};
use crate::engine::transaction::Transaction;

/// More bytes than any wish has: the longest text fills 125 registers. What is longer is no value, and is not
/// repeated in an outcome, which no broker would take.
pub(super) const BYTES_MAX: usize = 1024;

/// A wanted value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Wish {
    /// As it was said.
    pub text: String,
    /// What its sender knows the outcome again by.
    pub transaction: Option<Transaction>,
    /// Why it is not looked at.
    pub fault: Option<String>,
}

impl Wish {
    /// The payload is the value, unless it is an object of exactly `value` and `transaction`.
    pub fn parse(payload: &str) -> Wish {
        enclosed(payload).unwrap_or_else(|| Wish::from(payload.to_string()))
    }

    /// It has ended without anything being written.
    pub fn ended(&self, kind: OutcomeKind, reason: impl Into<String>) -> Outcome {
        let transaction = self.transaction.clone();
        Outcome { transaction, ..Outcome::new(kind, &self.text, reason) }
    }

    /// The outcome of what this wish came to.
    pub fn of(&self, outcome: Outcome) -> Outcome {
        Outcome { wanted: self.text.clone(), transaction: self.transaction.clone(), ..outcome }
    }
}

fn enclosed(payload: &str) -> Option<Wish> {
    // Nearly no value begins so, and a slider sends a thousand.
    if payload.len() > BYTES_MAX || !payload.trim_start().starts_with('{') {
        return None;
    }
    let members = Members::of(payload).ok()?;
    let is_one = |key: &str| key == "value" || key == "transaction";
    let (value, transaction) = (members.get("value")?, members.get("transaction")?);
    if !members.keys().all(is_one) {
        return None;
    }
    // As they stand in the payload: a value keeps its digits, too.
    let transaction = Some(Transaction::of(transaction));
    if let Some(key) = members.repeated() {
        let transaction = transaction.filter(|_| key != "transaction");
        return Some(Wish { text: payload.to_string(), transaction, fault: Some(stands_twice(key)) });
    }
    let text = match value.get() {
        "true" => "ON".to_string(),
        "false" => "OFF".to_string(),
        "null" => return None,
        text if text.starts_with('"') => serde_json::from_str(text).ok()?,
        several if several.starts_with(['[', '{']) => return None,
        number => number.to_string(),
    };
    Some(Wish { text, transaction, fault: None })
}

impl From<String> for Wish {
    /// Of what the gateway wishes itself, which waits for no outcome.
    fn from(text: String) -> Wish {
        Wish { text, transaction: None, fault: None }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_an_object_of_a_value_and_a_transaction_is_taken_apart() {
        for (payload, text, transaction) in [
            ("21.5", "21.5", None),
            ("", "", None),
            (r#"{"value": 21.5, "transaction": "x"}"#, "21.5", Some(r#""x""#)),
            (r#"{"value": 1e-05, "transaction": 7}"#, "1e-05", Some("7")),
            (r#"{"value": 18446744073709551615, "transaction": 7}"#, "18446744073709551615", Some("7")),
            // Neither loses a digit, and nothing is put in order.
            (
                r#"{"value": 0.10000000000000000000001, "transaction": 123456789012345678901234567890.50}"#,
                "0.10000000000000000000001",
                Some("123456789012345678901234567890.50"),
            ),
            (
                r#"{"value": 1, "transaction": {"b": 1E+400, "a" :[ ]}}"#,
                "1",
                Some(r#"{"b": 1E+400, "a" :[ ]}"#),
            ),
            (r#" {"transaction": {"a":[1]}, "value": "ON"}"#, "ON", Some(r#"{"a":[1]}"#)),
            (r#"{"value": true, "transaction": null}"#, "ON", Some("null")),
            (r#"{"value": false, "transaction": ""}"#, "OFF", Some(r#""""#)),
            // To write such a text to a text point, it is put into another one.
            (
                r#"{"value": "{\"value\": 1, \"transaction\": 2}", "transaction": 3}"#,
                r#"{"value": 1, "transaction": 2}"#,
                Some("3"),
            ),
            (r#"{"value": 21.5}"#, r#"{"value": 21.5}"#, None),
            (r#"{"value": [1], "transaction": 1}"#, r#"{"value": [1], "transaction": 1}"#, None),
            (
                r#"{"value": 1, "transaction": 1, "more": 1}"#,
                r#"{"value": 1, "transaction": 1, "more": 1}"#,
                None,
            ),
            (r#"{"value": 1, "transaction""#, r#"{"value": 1, "transaction""#, None),
            (r#"{}"#, "{}", None),
        ] {
            let wish = Wish::parse(payload);
            let found = wish.transaction.map(|transaction| transaction.to_string());
            assert_eq!((wish.text.as_str(), found.as_deref()), (text, transaction), "{payload}");
            assert_eq!(wish.fault, None);
        }
    }

    #[test]
    fn nobody_can_know_which_of_two_values_or_transactions_is_meant() {
        for (payload, key, transaction) in [
            (r#"{"value": 1, "value": 2, "transaction": 3}"#, "value", Some("3")),
            (r#"{"value": 1, "transaction": 3, "value": 1}"#, "value", Some("3")),
            (r#"{"value": 1, "transaction": 2, "transaction": 3}"#, "transaction", None),
        ] {
            let wish = Wish::parse(payload);
            let found = wish.transaction.map(|transaction| transaction.to_string());
            assert_eq!((wish.text.as_str(), found.as_deref()), (payload, transaction));
            assert_eq!(wish.fault, Some(stands_twice(key)), "{payload}");
        }
    }
}
