//! Whether a serial line returns what we send: some adapters do, and it is learnt from what is heard.

/// After so many requests in a row that did not come back the adapter may be another one, on which noise
/// before a reply is not a damaged echo.
pub(super) const MISSED_MAX: u32 = 3;

#[derive(Debug, Default)]
pub(super) struct Echo {
    known: Option<bool>,
    /// Requests in a row that did not come back although the line returns what we send.
    missed: u32,
}

impl Echo {
    /// The line may return what we send, as far as is known.
    pub(super) fn is_possible(&self) -> bool {
        self.known != Some(false)
    }

    /// The line is known to return what we send.
    pub(super) fn is_certain(&self) -> bool {
        self.known == Some(true)
    }

    /// A request came back.
    pub(super) fn came(&mut self) {
        *self = Echo { known: Some(true), missed: 0 };
    }

    /// The line returns nothing.
    pub(super) fn never_comes(&mut self) {
        *self = Echo { known: Some(false), missed: 0 };
    }

    /// A request did not come back, although the line returns what we send.
    pub(super) fn missed(&mut self) {
        self.missed += 1;
        if self.missed >= MISSED_MAX {
            self.forget();
        }
    }

    /// It may be another line.
    pub(super) fn forget(&mut self) {
        *self = Echo::default();
    }
}
