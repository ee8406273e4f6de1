//! Profiles as they load.

use super::*;

#[test]
fn every_shipped_profile_loads_without_a_fault() {
    let library = Library::shipped();
    for id in library.ids() {
        if let Err(faults) = library.load(id) {
            let shown: Vec<String> = faults.iter().map(Diagnostic::to_string).collect();
            panic!("{id}:\n{}", shown.join("\n"));
        }
    }
}
