//! A table in a document of the repository that a test makes of what it has seen.

use std::fs;
use std::path::Path;

const BEGINS: &str = "<!-- table: written by `make goldens` -->\n";
const ENDS: &str = "<!-- end of table -->";

/// Compares the table with the document's, or writes it there.
#[track_caller]
pub fn check_document(document: &str, table: &str) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(document);
    let text = fs::read_to_string(&path).expect("the document is readable");
    let (before, rest) = text.split_once(BEGINS).expect("the table's beginning is marked");
    let (found, after) = rest.split_once(ENDS).expect("the table's end is marked");
    if std::env::var_os("BLESS").is_some() {
        let text = format!("{before}{BEGINS}{table}{ENDS}{after}");
        fs::write(&path, text).expect("the document is written");
    } else {
        assert_eq!(found, table, "{document} is out of date; run `make goldens`");
    }
}
