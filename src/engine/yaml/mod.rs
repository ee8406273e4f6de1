//! Files that people write: YAML text to typed values, every fault with its place.
//!
//! The way: bytes → [`Source`] → [`parse`] → a tree of [`Node`]s with places → [`Read`] → the
//! file's own types. Faults are collected in [`Faults`]; nothing stops at the first one.
//!
//! A file's shape is said once, as a struct in [`record!`]: it becomes the struct, its strict
//! reader and its JSON Schema, in which the doc comments are the descriptions.
//!
//! ```
//! use busker::engine::yaml::{At, Faults, Map, Source, choices, parse, read, record};
//! use busker::engine::time::Duration;
//!
//! #[derive(Clone, Copy, Debug, PartialEq)]
//! enum Parity { None, Even }
//!
//! choices! { "a parity", Parity { "none" => Parity::None, "even" => Parity::Even } }
//!
//! record! {
//!     /// One serial line.
//!     pub struct Line {
//!         /// The port's path.
//!         serial: String,                                   // required
//!         /// Bits a second.
//!         baud: At<u32> = At::nowhere(9600),                // with a default
//!         /// How long a reply may take.
//!         timeout: Option<Duration>,                        // may be left out
//!         /// The parity bit.
//!         parity: Parity = Parity::Even,
//!         /// Free text for each unit.
//!         notes: Map<u8, String> = Map::default(),
//!     }
//! }
//!
//! let mut faults = Faults::default();
//! let source = Source::new("line.yaml", "serial: /dev/ttyUSB0\nbaudd: 19200\nparity: odd\n");
//! let line: Option<Line> = parse(&source, &mut faults).and_then(|node| read(&node, &mut faults));
//! assert!(line.is_none());
//! assert_eq!(faults.to_string(), "\
//! line.yaml:2:1: unknown key `baudd`; did you mean `baud`?
//!   |
//! 2 | baudd: 19200
//!   | ^^^^^
//!
//! line.yaml:3:9: `odd` is not a parity; expected `none` or `even`
//!   |
//! 3 | parity: odd
//!   |         ^^^
//! ");
//! ```
//!
//! What a value is, its type says: `off` where a text is wanted is the text `off`, and `0x10` where
//! a number is wanted is 16. There is no guessing by YAML's own rules.

mod choices;
mod diagnostic;
mod node;
mod parse;
mod read;
mod record;
mod scalar;
mod schema;

pub use choices::{list_of_choices, nearest};
pub use diagnostic::{Diagnostic, Faults, Place, Source};
pub use node::{Content, Entry, Node};
pub use parse::parse;
pub use read::{At, KeySchema, Keys, Map, Read, Record, read};
pub use record::{choices, record};
pub use scalar::Scalar;
pub use schema::{Definitions, schema_of, schema_of_choices};
pub use serde_json::Value as Json;

#[cfg(test)]
mod tests;
