//! The members of a JSON object as they were written, in their order; none is lost because another has its key.

use std::fmt;

use serde::de::{Deserialize, Deserializer, MapAccess, Visitor};
use serde_json::value::RawValue;

/// Keys and what stands under them.
pub struct Members<'t>(Vec<(String, &'t RawValue)>);

impl<'t> Members<'t> {
    /// `Err` says what is wrong with the text, for a person.
    pub fn of(text: &'t str) -> Result<Members<'t>, String> {
        serde_json::from_str(text).map_err(|error: serde_json::Error| match error.classify() {
            _ if text.trim().is_empty() => "the message is empty".into(),
            // It begins well, but as something else.
            serde_json::error::Category::Data => "this is no JSON object".into(),
            serde_json::error::Category::Eof => "this is no JSON: it ends too early".into(),
            _ => format!("this is no JSON: it is wrong at line {}, column {}", error.line(), error.column()),
        })
    }

    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.0.iter().map(|(key, _)| key.as_str())
    }

    pub fn get(&self, key: &str) -> Option<&'t RawValue> {
        self.0.iter().find(|(other, _)| other == key).map(|(_, value)| *value)
    }

    /// A key that stands there more than once: nobody can know which of its values is meant.
    pub fn repeated(&self) -> Option<&str> {
        let is_repeated =
            |(index, key): &(usize, &str)| self.keys().skip(index + 1).any(|other| other == *key);
        self.keys().enumerate().find(is_repeated).map(|(_, key)| key)
    }
}

/// What is said where [`Members::repeated`] finds one.
pub fn stands_twice(key: &str) -> String {
    format!("`{key}` stands there more than once; remove all of them but one")
}

impl<'de> Deserialize<'de> for Members<'de> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Members<'de>, D::Error> {
        struct Reader;
        impl<'de> Visitor<'de> for Reader {
            type Value = Members<'de>;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an object")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Members<'de>, A::Error> {
                let mut members = Vec::new();
                while let Some(member) = map.next_entry()? {
                    members.push(member);
                }
                Ok(Members(members))
            }
        }
        deserializer.deserialize_map(Reader)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_object_is_told_in_words_for_people() {
        for (text, expected) in [
            ("", "the message is empty"),
            (" \n", "the message is empty"),
            ("7", "this is no JSON object"),
            ("[]", "this is no JSON object"),
            ("{\"a\":1", "this is no JSON: it ends too early"),
            ("nul", "this is no JSON: it ends too early"),
            ("nult", "this is no JSON: it is wrong at line 1, column 4"),
            ("{device}", "this is no JSON: it is wrong at line 1, column 2"),
            ("{\n \"a\" 1}", "this is no JSON: it is wrong at line 2, column 6"),
            ("{} {}", "this is no JSON: it is wrong at line 1, column 4"),
        ] {
            assert_eq!(Members::of(text).err().as_deref(), Some(expected), "{text}");
        }
    }

    #[test]
    fn a_key_that_stands_twice_is_found_whatever_its_letters() {
        for (text, expected) in [
            ("{}", None),
            (r#"{"a":1,"b":{"a":2,"a":3}}"#, None),
            (r#"{"a":1,"b":2,"b":2,"a":1}"#, Some("a")),
            (r#"{"x":0,"a":1,"\u0061":2}"#, Some("a")),
        ] {
            assert_eq!(Members::of(text).expect("an object").repeated(), expected, "{text}");
        }
    }
}
