//! The profiles there are: those shipped in the program, and files that the owner put over them.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::sync::Arc;

use include_dir::{Dir, include_dir};

use crate::engine::yaml::{Faults, Source, nearest};

static SHIPPED: Dir<'static> = include_dir!("$CARGO_MANIFEST_DIR/device-profiles");

/// Files by their identifier: the path below the profiles' folder, without `.yaml`.
#[derive(Clone, Default)]
pub struct Library {
    files: BTreeMap<String, File>,
}

#[derive(Clone)]
struct File {
    /// The name in messages.
    shown: String,
    bytes: Cow<'static, [u8]>,
}

impl Library {
    /// The profiles in the program.
    pub fn shipped() -> Library {
        let mut library = Library::default();
        library.add_shipped(&SHIPPED);
        library
    }

    fn add_shipped(&mut self, folder: &Dir<'static>) {
        for file in folder.files() {
            let path = file.path().to_string_lossy();
            if let Some(id) = path.strip_suffix(".yaml") {
                let shown = format!("device-profiles/{path}");
                self.files.insert(id.into(), File { shown, bytes: file.contents().into() });
            }
        }
        folder.dirs().for_each(|folder| self.add_shipped(folder));
    }

    /// Puts a file over the shipped ones. `path` is the one below its profiles' folder
    /// (`acme/ra8.yaml`), `shown` the one that messages begin with.
    pub fn add(&mut self, path: &str, shown: &str, bytes: Vec<u8>) {
        let id = path.strip_suffix(".yaml").unwrap_or(path);
        self.files.insert(id.into(), File { shown: shown.into(), bytes: bytes.into() });
    }

    /// The identifiers of all devices, sorted.
    pub fn ids(&self) -> Vec<&str> {
        self.files.keys().map(String::as_str).filter(|id| !id.starts_with("shared/")).collect()
    }

    /// The identifiers of all shared files, sorted.
    pub fn shared_ids(&self) -> Vec<&str> {
        self.files.keys().map(String::as_str).filter(|id| id.starts_with("shared/")).collect()
    }

    pub fn contains(&self, id: &str) -> bool {
        self.files.contains_key(id)
    }

    /// What to say of an `id` that it does not contain.
    pub fn unknown(&self, id: &str) -> String {
        match nearest(id, &self.ids()) {
            Some(meant) => format!("unknown profile `{id}`; did you mean `{meant}`?"),
            None => format!("unknown profile `{id}`; `busker profiles list` lists them"),
        }
    }

    /// The text of the file `id`; `None` if there is no such file, or (with a fault) no text in it.
    pub fn source(&self, id: &str, faults: &mut Faults) -> Option<Arc<Source>> {
        let file = self.files.get(id)?;
        Source::from_bytes(&file.shown, &file.bytes, faults)
    }
}
