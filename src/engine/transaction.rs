//! What a program knows the answer to its message again by: any JSON, which comes back letter for letter.

use std::fmt;

use serde::Serialize;
use serde_json::value::RawValue;

/// One JSON value as it was written: a number keeps its digits, however many those are.
#[derive(Clone, Debug, Serialize)]
#[serde(transparent)]
pub struct Transaction(Box<RawValue>);

impl Transaction {
    pub fn of(value: &RawValue) -> Transaction {
        Transaction(value.to_owned())
    }
}

impl Default for Transaction {
    /// Of a message that has none.
    fn default() -> Transaction {
        Transaction(RawValue::NULL.to_owned())
    }
}

impl fmt::Display for Transaction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.0.get())
    }
}

impl PartialEq for Transaction {
    fn eq(&self, other: &Transaction) -> bool {
        self.0.get() == other.0.get()
    }
}

impl Eq for Transaction {}
