//! YAML text to a tree of nodes; whatever YAML itself does not allow, and what this program does
//! not want of it, is refused here.

use std::collections::BTreeMap;
use std::sync::Arc;

use saphyr_parser::{Event, Parser, ScalarStyle, ScanError, Span};

use crate::engine::yaml::{Content, Entry, Faults, Node, Place, Source};

/// More values than this, after all `*aliases` are followed, are refused: a few hundred bytes of
/// nested aliases can otherwise stand for more values than there is memory.
const NODES_MAX: usize = 100_000;
/// Maps and lists inside one another.
const DEPTH_MAX: usize = 24;

/// The only document of `source`, or `None` and a fault. Duplicate keys are faults, too, but do not
/// stop the reading.
pub fn parse(source: &Arc<Source>, faults: &mut Faults) -> Option<Node> {
    if let Some((place, message)) = fault_of_characters(source) {
        faults.add(&place, message);
        return None;
    }
    let mut builder = Builder::new(source, faults);
    let mut parser = Parser::new_from_str(source.text());
    while let Some(event) = parser.next_event() {
        let result = match event {
            Ok((event, span)) => builder.take(event, span),
            Err(error) => Err(builder.fault_of_yaml(&error)),
        };
        if let Err((place, message)) = result {
            builder.faults.add(&place, message);
            return None;
        }
    }
    let root = builder.root.take();
    if root.as_ref().is_none_or(Node::is_null) {
        faults.add(&source.place(0, 0), "the file is empty; it must hold at least its required keys");
        return None;
    }
    root
}

type Fault = (Place, String);

/// Faults that are better told in our own words, or not seen by the parser at all.
fn fault_of_characters(source: &Arc<Source>) -> Option<Fault> {
    let text = source.text();
    let control =
        |character: char| character.is_control() && !['\t', '\n', '\r', '\u{85}'].contains(&character);
    if let Some((at, found)) = text.char_indices().find(|(_, character)| control(*character)) {
        let place = source.place(at, at + found.len_utf8());
        return Some((place, format!("control character U+{:04X}; remove it", found as u32)));
    }
    let mut line_start = 0;
    for line in text.split_inclusive('\n') {
        let indentation = &line[..line.len() - line.trim_start_matches([' ', '\t']).len()];
        let is_content = !line.trim().is_empty() && !line.trim_start().starts_with('#');
        if let (Some(tab), true) = (indentation.find('\t'), is_content) {
            let place = source.place(line_start + tab, line_start + tab + 1);
            return Some((place, "a tab indents this line; YAML is indented with spaces only".into()));
        }
        line_start += line.len();
    }
    None
}

/// Makes the tree from the parser's events.
struct Builder<'a> {
    source: &'a Arc<Source>,
    faults: &'a mut Faults,
    /// The byte at which each character begins, since the parser counts characters.
    bytes: Vec<usize>,
    open: Vec<Open>,
    anchors: BTreeMap<usize, Node>,
    nodes: usize,
    documents: usize,
    root: Option<Node>,
}

/// A list or map whose end has not come yet.
struct Open {
    place: Place,
    anchor: usize,
    collection: Collection,
}

enum Collection {
    List(Vec<Node>),
    Map { entries: Vec<Entry>, key: Option<Node> },
}

impl Builder<'_> {
    fn new<'a>(source: &'a Arc<Source>, faults: &'a mut Faults) -> Builder<'a> {
        let text = source.text();
        let bytes = text.char_indices().map(|(at, _)| at).chain([text.len()]).collect();
        Builder {
            source,
            faults,
            bytes,
            open: Vec::new(),
            anchors: BTreeMap::new(),
            nodes: 0,
            documents: 0,
            root: None,
        }
    }

    fn take(&mut self, event: Event<'_>, span: Span) -> Result<(), Fault> {
        let place = self.place(span);
        match event {
            Event::Nothing | Event::StreamStart | Event::StreamEnd | Event::DocumentEnd => Ok(()),
            Event::DocumentStart(_) => {
                self.documents += 1;
                if self.documents > 1 {
                    let message =
                        "a second document begins here; a file holds one: remove `---` or what follows it";
                    return Err((place, message.into()));
                }
                Ok(())
            }
            Event::Scalar(_, _, _, Some(tag))
            | Event::SequenceStart(_, Some(tag))
            | Event::MappingStart(_, Some(tag)) => {
                let handle = match tag.handle.as_str() {
                    _ if tag.is_yaml_core_schema() => "!!",
                    handle => handle,
                };
                Err((place, format!("the tag `{handle}{}` means nothing here; remove it", tag.suffix)))
            }
            Event::Scalar(text, style, anchor, None) => {
                let quoted = style != ScalarStyle::Plain;
                let content = Content::Scalar { text: text.into_owned(), quoted };
                self.finish(Node { place, key: None, content }, anchor)
            }
            Event::SequenceStart(anchor, None) => self.begin(place, anchor, Collection::List(Vec::new())),
            Event::MappingStart(anchor, None) => {
                self.begin(place, anchor, Collection::Map { entries: Vec::new(), key: None })
            }
            Event::SequenceEnd | Event::MappingEnd => match self.open.pop() {
                Some(Open { place, anchor, collection }) => {
                    let content = match collection {
                        Collection::List(items) => Content::List(items),
                        Collection::Map { entries, .. } => Content::Map(entries),
                    };
                    self.finish(Node { place, key: None, content }, anchor)
                }
                None => Ok(()),
            },
            Event::Alias(anchor) => match self.anchors.get(&anchor) {
                Some(node) => {
                    let node = node.clone();
                    self.nodes += count(&node);
                    if self.nodes > NODES_MAX {
                        return Err((place, too_many()));
                    }
                    self.put(node)
                }
                None => Err((
                    place,
                    "this alias stands inside the very value it names; write the value out".into(),
                )),
            },
        }
    }

    fn begin(&mut self, place: Place, anchor: usize, collection: Collection) -> Result<(), Fault> {
        if self.open.len() >= DEPTH_MAX {
            return Err((
                place,
                format!("maps and lists are nested deeper than {DEPTH_MAX}; no file here needs that"),
            ));
        }
        self.key_must_be_scalar(&place)?;
        self.open.push(Open { place, anchor, collection });
        Ok(())
    }

    fn finish(&mut self, node: Node, anchor: usize) -> Result<(), Fault> {
        self.nodes += match &node.content {
            Content::Scalar { text, .. } => weight(text),
            Content::List(_) | Content::Map(_) => 1,
        };
        if self.nodes > NODES_MAX {
            return Err((node.place, too_many()));
        }
        if anchor != 0 {
            self.anchors.insert(anchor, node.clone());
        }
        self.put(node)
    }

    /// Puts a finished node where the innermost open collection wants it.
    fn put(&mut self, mut node: Node) -> Result<(), Fault> {
        let Some(open) = self.open.last_mut() else {
            self.root = Some(node);
            return Ok(());
        };
        match &mut open.collection {
            Collection::List(items) => {
                node.key = None;
                items.push(node);
            }
            Collection::Map { entries, key: key @ None } => {
                let Content::Scalar { text, quoted } = &node.content else {
                    return Err((
                        node.place,
                        "a list or map cannot be a key; expected one word or number".into(),
                    ));
                };
                if text == "<<" && !quoted {
                    let message = "merging with `<<` is not supported; give the whole value an anchor, or write the keys out";
                    return Err((node.place, message.into()));
                }
                let same = |entry: &&Entry| matches!(&entry.key.content, Content::Scalar { text: other, .. } if other == text);
                if let Some(first) = entries.iter().find(same) {
                    let line = first.key.place.line();
                    self.faults.add(
                        &node.place,
                        format!(
                            "the key `{text}` stands here twice (first in line {line}); remove one of them"
                        ),
                    );
                }
                *key = Some(node);
            }
            Collection::Map { entries, key } => {
                if let Some(key) = key.take() {
                    node.key = Some(key.place.clone());
                    // A second value under the same key is a fault already; the first one stays.
                    if !entries.iter().any(|entry| entry.key.text() == key.text()) {
                        entries.push(Entry { key, value: node });
                    }
                }
            }
        }
        Ok(())
    }

    /// Tells of `{a: 1}: 2` and `[a]: 1` where the key begins, not where it ends.
    fn key_must_be_scalar(&self, place: &Place) -> Result<(), Fault> {
        match self.open.last() {
            Some(Open { collection: Collection::Map { key: None, .. }, .. }) => {
                Err((place.clone(), "a list or map cannot be a key; expected one word or number".into()))
            }
            _ => Ok(()),
        }
    }

    fn place(&self, span: Span) -> Place {
        let byte = |character: usize| self.bytes[character.min(self.bytes.len() - 1)];
        self.source.place(byte(span.start.index()), byte(span.end.index()))
    }

    /// Where the innermost list or map began.
    fn begun(&self) -> String {
        self.open.last().map_or(String::new(), |open| format!(" that begins in line {}", open.place.line()))
    }

    /// The parser's own errors, with what to do about the common ones.
    fn fault_of_yaml(&self, error: &ScanError) -> Fault {
        let place = self.place(Span::empty(*error.marker()));
        let info = error.info();
        let says = |part: &str| info.contains(part);
        let message = if says("unknown anchor") {
            "this alias names an anchor that does not stand before it; write `&name` at the value it shall repeat".into()
        } else if says("recursion limit") {
            format!("maps and lists are nested deeper than {DEPTH_MAX}; no file here needs that")
        } else if says("mapping values are not allowed") || says("illegal placement of ':'") {
            "a `:` where no key can stand; indent the line like its neighbours, or put a text with `: ` in quotes".into()
        } else if says("expected ',' or ']'") {
            format!("the list{} is not closed; expected `,` or `]`", self.begun())
        } else if says("expected ',' or '}'") {
            format!("the map{} is not closed; expected `,` or `}}`", self.begun())
        } else if says("quoted scalar") && says("end of stream") {
            "a quote is not closed; expected it before the end of the file".into()
        } else if says("simple key expect") {
            "the line before this one is no `key: value`; expected a `:` in it".into()
        } else if says("did not find expected key") {
            "this line is indented unlike its neighbours; expected the same spaces before each key of a map"
                .into()
        } else if says("must be followed by a valid YAML whitespace") {
            "no space stands before this; expected one behind `:` or `-`, and no tab".into()
        } else if says("invalid indentation") {
            "wrong indentation; expected the line indented further than the key that it belongs to".into()
        } else if let Some(character) = info.strip_prefix("unexpected character: `") {
            format!("a text cannot begin with `{}`; put it in quotes", character.trim_end_matches('\''))
        } else {
            format!("this is not YAML ({info}); look at the indentation, quotes and brackets here and above")
        };
        (place, message)
    }
}

fn too_many() -> String {
    format!("with its aliases the file holds more than {NODES_MAX} values; no file here needs that many")
}

fn count(node: &Node) -> usize {
    match &node.content {
        Content::Scalar { text, .. } => weight(text),
        Content::List(items) => 1 + items.iter().map(count).sum::<usize>(),
        Content::Map(entries) => {
            1 + entries.iter().map(|entry| count(&entry.key) + count(&entry.value)).sum::<usize>()
        }
    }
}

/// A long text counts as several values, since repeating it takes as much memory.
fn weight(text: &str) -> usize {
    1 + text.len() / 100
}
