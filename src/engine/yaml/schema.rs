//! JSON Schema of what can be read, for editors.

use std::collections::BTreeMap;

use serde_json::{Value as Json, json};

use crate::engine::yaml::Read;

/// The named parts of a schema; each is described once.
#[derive(Default)]
pub struct Definitions(BTreeMap<String, Json>);

impl Definitions {
    /// A reference to the definition `name`, which `describe` makes when it is not there yet.
    pub fn refer(&mut self, name: &str, describe: impl FnOnce(&mut Definitions) -> Json) -> Json {
        if !self.0.contains_key(name) {
            // Noted before it is made, so that a type may hold itself.
            self.0.insert(name.into(), Json::Null);
            let described = describe(self);
            self.0.insert(name.into(), described);
        }
        json!({"$ref": format!("#/$defs/{name}")})
    }
}

/// The whole schema of a file that holds a `T`.
pub fn schema_of<T: Read>(title: &str) -> Json {
    let mut definitions = Definitions::default();
    let root = T::schema(&mut definitions);
    let mut schema = json!({"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title});
    if let (Json::Object(schema), Json::Object(root)) = (&mut schema, root) {
        schema.extend(root);
        schema.insert("$defs".into(), definitions.0.into_iter().collect());
    }
    schema
}

/// One of these words; a word that looks like a number is one to editors.
pub fn schema_of_choices(words: &[&str]) -> Json {
    let choices: Vec<Json> =
        words.iter().map(|word| word.parse::<i64>().map_or_else(|_| Json::from(*word), Json::from)).collect();
    json!({"enum": choices})
}
