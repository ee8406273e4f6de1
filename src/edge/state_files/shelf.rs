//! Where whoever stores something finds the files: a new configuration may put others in their place.

use std::sync::{Arc, Mutex};

use super::StateFiles;
use crate::edge::lock::lock;

/// The state files of now.
pub struct Shelf(Mutex<Arc<StateFiles>>);

impl Shelf {
    pub fn new(files: StateFiles) -> Shelf {
        Shelf(Mutex::new(Arc::new(files)))
    }

    pub fn now(&self) -> Arc<StateFiles> {
        lock(&self.0).clone()
    }

    /// These files go on from what is remembered now, and the others are finished.
    pub fn exchange(&self, files: StateFiles) {
        let before = {
            // Nobody stores anything meanwhile.
            let mut now = lock(&self.0);
            files.take_over(&now);
            std::mem::replace(&mut *now, Arc::new(files))
        };
        before.finish();
    }
}
