//! What is wrong, where it stands, and how it is shown.

use std::fmt;
use std::sync::Arc;

/// The text of one file, with the name by which messages call it.
#[derive(PartialEq, Eq)]
pub struct Source {
    name: String,
    text: String,
}

impl Source {
    pub fn new(name: &str, text: &str) -> Arc<Source> {
        // A byte order mark is no part of the text; editors on Windows write one.
        let text = text.strip_prefix('\u{FEFF}').unwrap_or(text);
        Arc::new(Source { name: name.into(), text: text.into() })
    }

    /// Takes a file as it was read; bytes that are no UTF-8 are a fault.
    pub fn from_bytes(name: &str, bytes: &[u8], faults: &mut Faults) -> Option<Arc<Source>> {
        let error = match std::str::from_utf8(bytes) {
            Ok(text) => return Some(Source::new(name, text)),
            Err(error) => error,
        };
        let readable = Source::new(name, &String::from_utf8_lossy(bytes));
        let start = error.valid_up_to();
        let place = Place { source: readable, start, end: start + '\u{FFFD}'.len_utf8() };
        faults.add(&place, format!("the byte 0x{:02X} is not UTF-8; save the file as UTF-8", bytes[start]));
        None
    }

    pub fn name(&self) -> &str {
        &self.name
    }

    pub fn text(&self) -> &str {
        &self.text
    }

    /// The place of the bytes `start..end`; both must lie on character boundaries.
    pub fn place(self: &Arc<Source>, start: usize, end: usize) -> Place {
        Place { source: self.clone(), start, end: end.max(start) }
    }
}

/// Some bytes of a file.
#[derive(Clone, PartialEq, Eq)]
pub struct Place {
    source: Arc<Source>,
    start: usize,
    end: usize,
}

impl Place {
    /// The place of a value that stands in no file: a default.
    pub fn nowhere() -> Place {
        Source::new("(default)", "").place(0, 0)
    }

    pub fn file(&self) -> &str {
        &self.source.name
    }

    /// Line and column, both from 1; the column counts characters.
    pub fn line_and_column(&self) -> (usize, usize) {
        let before = &self.source.text[..self.start];
        let line_start = before.rfind('\n').map_or(0, |at| at + 1);
        (before.matches('\n').count() + 1, before[line_start..].chars().count() + 1)
    }

    pub fn line(&self) -> usize {
        self.line_and_column().0
    }

    /// The place of the bytes `from..to` of this place, for a fault inside a scalar.
    pub fn part(&self, from: usize, to: usize) -> Place {
        let (start, end) = (self.start + from, self.start + to);
        let text = &self.source.text;
        if end <= self.end && text.is_char_boundary(start) && text.is_char_boundary(end) && start <= end {
            Place { source: self.source.clone(), start, end }
        } else {
            self.clone()
        }
    }

    /// The whole line of this place, and which of its characters are meant.
    fn excerpt(&self) -> (String, usize, usize) {
        let text = &self.source.text;
        let line_start = text[..self.start].rfind('\n').map_or(0, |at| at + 1);
        let line_end = text[self.start..].find('\n').map_or(text.len(), |at| self.start + at);
        let line: Vec<char> = text[line_start..line_end]
            .trim_end_matches('\r')
            .chars()
            .map(|character| match character {
                '\t' => ' ',
                other if other.is_control() => '\u{FFFD}',
                other => other,
            })
            .collect();
        let before = text[line_start..self.start].chars().count();
        let marked = text[self.start..self.end.clamp(self.start, line_end)].trim_end().chars().count().max(1);

        const SHOWN_MAX: usize = 130;
        let window = before.saturating_sub(SHOWN_MAX / 2);
        if line.len() <= SHOWN_MAX {
            return (line.into_iter().collect(), before, marked);
        }
        let shown: String = line.iter().skip(window).take(SHOWN_MAX).collect();
        let cut_before = if window > 0 { "…" } else { "" };
        let cut_after = if window + SHOWN_MAX < line.len() { "…" } else { "" };
        let before = before - window + cut_before.chars().count();
        (format!("{cut_before}{shown}{cut_after}"), before, marked.min(SHOWN_MAX + 1 - before))
    }
}

impl fmt::Display for Place {
    /// `FILE:LINE:COLUMN`
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (line, column) = self.line_and_column();
        write!(f, "{}:{line}:{column}", self.source.name)
    }
}

impl fmt::Debug for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self}")
    }
}

/// One fault: where, what was found, and what would be right.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Diagnostic {
    pub place: Place,
    /// Found and right in one line, without a full stop at its end.
    pub message: String,
}

impl fmt::Display for Diagnostic {
    /// The message behind its place, then the line with a caret. Ends in a line break.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}: {}", self.place, self.message)?;
        let (line, before, marked) = self.place.excerpt();
        let number = self.place.line().to_string();
        let gutter = " ".repeat(number.len());
        writeln!(f, "{gutter} |")?;
        writeln!(f, "{}", format!("{number} | {line}").trim_end())?;
        writeln!(f, "{gutter} | {}{}", " ".repeat(before), "^".repeat(marked))
    }
}

/// All faults found so far, to be told at once.
#[derive(Clone, Debug, Default)]
pub struct Faults {
    list: Vec<Diagnostic>,
}

impl Faults {
    /// Notes a fault; the same one at the same place is noted once.
    pub fn add(&mut self, place: &Place, message: impl Into<String>) {
        let diagnostic = Diagnostic { place: place.clone(), message: one_line(message.into()) };
        if !self.list.contains(&diagnostic) {
            self.list.push(diagnostic);
        }
    }

    /// Shows the places in a file of the same name by `shown`, which has as many bytes: the file
    /// without its secrets.
    pub fn show_by(&mut self, shown: &Arc<Source>) {
        for diagnostic in &mut self.list {
            let source = &mut diagnostic.place.source;
            if source.name == shown.name && source.text.len() == shown.text.len() {
                *source = shown.clone();
            }
        }
    }

    pub fn is_empty(&self) -> bool {
        self.list.is_empty()
    }

    pub fn len(&self) -> usize {
        self.list.len()
    }

    pub fn extend(&mut self, others: Vec<Diagnostic>) {
        for other in others {
            self.add(&other.place, other.message);
        }
    }

    /// The faults in the order of their files and places.
    pub fn into_sorted(mut self) -> Vec<Diagnostic> {
        self.list.sort_by(|a, b| {
            (a.place.file(), a.place.start, &a.message).cmp(&(b.place.file(), b.place.start, &b.message))
        });
        self.list
    }

    /// `value` if there is one and no fault at all, else the faults, sorted.
    pub fn into_result<T>(self, value: Option<T>) -> Result<T, Vec<Diagnostic>> {
        match value {
            Some(value) if self.is_empty() => Ok(value),
            _ => Err(self.into_sorted()),
        }
    }
}

impl fmt::Display for Faults {
    /// All of them, sorted, an empty line between two.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let shown: Vec<String> = self.clone().into_sorted().iter().map(Diagnostic::to_string).collect();
        write!(f, "{}", shown.join("\n"))
    }
}

/// A message that quotes a text of several lines is one line all the same.
fn one_line(message: String) -> String {
    if !message.contains(char::is_control) {
        return message;
    }
    let visible = |character: char| match character.is_control() {
        true => character.escape_default().to_string(),
        false => character.to_string(),
    };
    message.chars().map(visible).collect()
}
