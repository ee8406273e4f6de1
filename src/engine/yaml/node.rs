//! The tree of a YAML file: scalars as they were written, lists and maps in their order.

use crate::engine::yaml::Place;

/// One value of a file.
#[derive(Clone, Debug)]
pub struct Node {
    /// Where the value stands. Of a list or a map: where it begins.
    pub place: Place,
    /// The key that it stands under, which is the better place for "something is missing here".
    pub key: Option<Place>,
    pub content: Content,
}

#[derive(Clone, Debug)]
pub enum Content {
    Scalar {
        text: String,
        /// Whether it stood in quotes (or in a block of text): `"null"` is a text.
        quoted: bool,
    },
    List(Vec<Node>),
    /// In the file's order; no two keys have the same text.
    Map(Vec<Entry>),
}

/// A key, which is always a scalar, and its value.
#[derive(Clone, Debug)]
pub struct Entry {
    pub key: Node,
    pub value: Node,
}

impl Node {
    /// The key's place, or the value's own.
    pub fn named_at(&self) -> &Place {
        self.key.as_ref().unwrap_or(&self.place)
    }

    /// Whether nothing stands here: empty, `null` or `~`, without quotes.
    pub fn is_null(&self) -> bool {
        matches!(&self.content, Content::Scalar { text, quoted: false } if ["", "null", "~"].contains(&text.as_str()))
    }

    /// The scalar's text; `None` for a list, a map and for nothing.
    pub fn text(&self) -> Option<&str> {
        match &self.content {
            Content::Scalar { text, .. } if !self.is_null() => Some(text),
            _ => None,
        }
    }

    /// The value under the key `name`, of a map.
    pub fn get(&self, name: &str) -> Option<&Node> {
        match &self.content {
            Content::Map(entries) => {
                entries.iter().find(|entry| entry.key.text() == Some(name)).map(|entry| &entry.value)
            }
            _ => None,
        }
    }

    /// What stands here, for messages: `a list`, `` `abc` ``, `nothing`.
    pub fn found(&self) -> String {
        match &self.content {
            Content::List(_) => "a list".into(),
            Content::Map(_) => "a map".into(),
            Content::Scalar { .. } if self.is_null() => "nothing".into(),
            Content::Scalar { text, .. } if text.is_empty() => "an empty text".into(),
            Content::Scalar { text, .. } => {
                let line = text.lines().next().unwrap_or("");
                if line.chars().count() > 40 || line.len() < text.trim_end().len() {
                    format!("`{}…`", line.chars().take(40).collect::<String>())
                } else {
                    format!("`{line}`")
                }
            }
        }
    }
}
