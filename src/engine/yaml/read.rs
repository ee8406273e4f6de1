//! Nodes to typed values, strictly.

use std::ops::Deref;

use serde_json::{Map as JsonMap, Value as Json, json};

use crate::engine::yaml::{Content, Definitions, Faults, Node, Place, Scalar, list_of_choices};

/// A type that can stand in a file.
pub trait Read: Sized {
    /// Reads `node`. Every fault in it is noted; `None` if nothing can be made of it. A value may
    /// come back although there are faults (a [`Map`] without its bad entries): whoever reads a
    /// whole file asks [`Faults::is_empty`] at the end.
    fn read(node: &Node, faults: &mut Faults) -> Option<Self>;

    /// The value where the key is left out; `None` if it must be there.
    fn absent() -> Option<Self> {
        None
    }

    fn schema(definitions: &mut Definitions) -> Json;
}

/// Reads `node` as a `T`: [`Read::read`] where the type is known from what is done with it.
pub fn read<T: Read>(node: &Node, faults: &mut Faults) -> Option<T> {
    T::read(node, faults)
}

impl<T: Scalar> Read for T {
    fn read(node: &Node, faults: &mut Faults) -> Option<T> {
        let result = match (&node.content, node.is_null()) {
            (Content::Scalar { text, .. }, false) => T::parse(text),
            _ => Err(format!("{} stands here; expected {}", node.found(), T::EXPECTED)),
        };
        result.map_err(|message| faults.add(&node.place, message)).ok()
    }

    fn schema(_: &mut Definitions) -> Json {
        T::schema()
    }
}

/// May be left out; `null` says the same.
impl<T: Read> Read for Option<T> {
    fn read(node: &Node, faults: &mut Faults) -> Option<Option<T>> {
        if node.is_null() { Some(None) } else { T::read(node, faults).map(Some) }
    }

    fn absent() -> Option<Option<T>> {
        Some(None)
    }

    fn schema(definitions: &mut Definitions) -> Json {
        json!({"anyOf": [T::schema(definitions), {"type": "null"}]})
    }
}

impl<T: Read> Read for Vec<T> {
    fn read(node: &Node, faults: &mut Faults) -> Option<Vec<T>> {
        match &node.content {
            Content::List(items) => {
                let read: Vec<Option<T>> = items.iter().map(|item| T::read(item, faults)).collect();
                read.into_iter().collect()
            }
            _ => {
                faults
                    .add(&node.place, format!("{} stands here; expected a list like `[…, …]`", node.found()));
                None
            }
        }
    }

    fn schema(definitions: &mut Definitions) -> Json {
        json!({"type": "array", "items": T::schema(definitions)})
    }
}

/// A value that is read later, when more is known.
impl Read for Node {
    fn read(node: &Node, _: &mut Faults) -> Option<Node> {
        Some(node.clone())
    }

    fn schema(_: &mut Definitions) -> Json {
        json!({})
    }
}

/// A value together with its place, for checks that come after the reading.
#[derive(Clone, Debug)]
pub struct At<T> {
    pub value: T,
    pub place: Place,
}

impl<T> At<T> {
    /// A default, which stands in no file.
    pub fn nowhere(value: T) -> At<T> {
        At { value, place: Place::nowhere() }
    }
}

impl<T> Deref for At<T> {
    type Target = T;
    fn deref(&self) -> &T {
        &self.value
    }
}

impl<T: Read> Read for At<T> {
    fn read(node: &Node, faults: &mut Faults) -> Option<At<T>> {
        // Of a map or a list the key says better which one is meant.
        let place =
            if matches!(node.content, Content::Scalar { .. }) { &node.place } else { node.named_at() };
        Some(At { value: T::read(node, faults)?, place: place.clone() })
    }

    fn schema(definitions: &mut Definitions) -> Json {
        T::schema(definitions)
    }
}

/// Entries in the file's order, each read by itself.
#[derive(Clone, Debug)]
pub struct Map<K, V> {
    pub entries: Vec<(At<K>, V)>,
    /// Keys whose values had faults, so that nobody calls them unknown as well.
    pub unread: Vec<At<K>>,
}

impl<K, V> Default for Map<K, V> {
    fn default() -> Map<K, V> {
        Map { entries: Vec::new(), unread: Vec::new() }
    }
}

impl<K: PartialEq, V> Map<K, V> {
    pub fn get(&self, key: &K) -> Option<&V> {
        self.entries.iter().find(|(found, _)| found.value == *key).map(|(_, value)| value)
    }

    /// Whether `key` stands in the file, read or not.
    pub fn names(&self, key: &K) -> bool {
        self.get(key).is_some() || self.unread.iter().any(|found| found.value == *key)
    }
}

impl<K, V> Map<K, V> {
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    pub fn iter(&self) -> impl Iterator<Item = (&At<K>, &V)> {
        self.entries.iter().map(|(key, value)| (key, value))
    }
}

impl<K: Read + PartialEq, V: Read> Read for Map<K, V> {
    fn read(node: &Node, faults: &mut Faults) -> Option<Map<K, V>> {
        let Content::Map(nodes) = &node.content else {
            faults.add(
                &node.place,
                format!("{} stands here; expected a map like `{{key: value}}`", node.found()),
            );
            return None;
        };
        let mut map = Map::default();
        for entry in nodes {
            let value = V::read(&entry.value, faults);
            let Some(key) = At::<K>::read(&entry.key, faults) else { continue };
            // `0x10` and `16` are two texts and one key.
            if map.names(&key.value) {
                faults.add(
                    &key.place,
                    format!("{} is the same as a key above it; remove one of them", entry.key.found()),
                );
                continue;
            }
            match value {
                Some(value) => map.entries.push((key, value)),
                None => map.unread.push(key),
            }
        }
        Some(map)
    }

    fn schema(definitions: &mut Definitions) -> Json {
        json!({"type": "object", "additionalProperties": V::schema(definitions)})
    }
}

/// What `record!` makes of a struct.
pub trait Record: Sized {
    fn keys() -> Vec<&'static str>;
    fn of(keys: &Keys<'_>, faults: &mut Faults) -> Option<Self>;
    fn schemas(definitions: &mut Definitions) -> Vec<KeySchema>;
}

/// The keys of a map that shall become a record.
pub struct Keys<'n> {
    node: &'n Node,
}

impl<'n> Keys<'n> {
    /// Notes every key of `node` that is not `known`; `None` if it is no map at all.
    pub fn of(node: &'n Node, known: &[&str], faults: &mut Faults) -> Option<Keys<'n>> {
        let known: Vec<&str> = known.iter().map(|name| plain(name)).collect();
        let Content::Map(entries) = &node.content else {
            let some: Vec<String> = known.iter().take(3).map(|name| format!("`{name}`")).collect();
            let keys =
                if known.len() > 3 { format!("{} and others", some.join(", ")) } else { some.join(", ") };
            faults.add(
                &node.place,
                format!("{} stands here; expected a map with the keys {keys}", node.found()),
            );
            return None;
        };
        for entry in entries {
            let Some(key) = entry.key.text() else {
                faults.add(&entry.key.place, format!("an empty key; {}", list_of_choices("", &known)));
                continue;
            };
            if !known.contains(&key) {
                faults
                    .add(&entry.key.place, format!("unknown key `{key}`; {}", list_of_choices(key, &known)));
            }
        }
        Some(Keys { node })
    }

    /// The key that the map stands under, or its beginning.
    pub fn place(&self) -> &Place {
        self.node.named_at()
    }

    /// The value of the key `name`, or `default`; a missing key without one is a fault.
    pub fn value<T: Read>(&self, name: &str, default: Option<T>, faults: &mut Faults) -> Option<T> {
        match (self.node.get(plain(name)), default) {
            (Some(node), _) => T::read(node, faults),
            (None, Some(default)) => Some(default),
            (None, None) => {
                faults.add(self.place(), format!("the key `{}` is missing here", plain(name)));
                None
            }
        }
    }

    /// The JSON Schema of a record.
    pub fn schema(description: &str, keys: Vec<KeySchema>) -> Json {
        let mut properties = JsonMap::new();
        let mut required = Vec::new();
        for key in keys {
            let mut schema = key.schema;
            if let (Json::Object(schema), false) = (&mut schema, key.description.is_empty()) {
                schema.insert("description".into(), one_line(key.description).into());
            }
            properties.insert(plain(key.name).into(), schema);
            if key.required {
                required.push(plain(key.name));
            }
        }
        json!({
            "type": "object",
            "description": one_line(description),
            "properties": properties,
            "required": required,
            "additionalProperties": false,
        })
    }
}

/// One key of a record, for its schema.
#[derive(Clone)]
pub struct KeySchema {
    pub name: &'static str,
    pub description: &'static str,
    pub required: bool,
    pub schema: Json,
}

/// The key of a field whose name is a Rust word.
fn plain(field: &str) -> &str {
    field.strip_prefix("r#").unwrap_or(field)
}

fn one_line(documentation: &str) -> String {
    documentation.split_whitespace().collect::<Vec<_>>().join(" ")
}
