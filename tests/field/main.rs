//! The faults that break gateways in the field, each done to the wire of the whole program: nothing
//! false is published, and nothing is lost. The table of `docs/field-problems.md` is made from the rows.

mod devices;
mod figures;
mod lines;
#[path = "../support/peer.rs"]
mod peer;
mod replies;
mod stage;
#[path = "../support/mod.rs"]
mod support;
#[path = "../support/table.rs"]
mod table;
mod values;

use std::sync::Mutex;
use std::thread;

const DOCUMENT: &str = "docs/field-problems.md";

/// Rows that run at the same time; most of each is waiting.
const AT_ONCE: usize = 6;

/// One line of the table.
#[derive(Clone, Copy)]
pub struct Row {
    /// Its place in the table.
    pub number: u8,
    /// What breaks gateways.
    pub fault: &'static str,
    /// What this test does to the wire.
    pub done: &'static str,
    /// What the program does about it, as the test has seen, and what could not be tried.
    pub seen: &'static str,
    /// The test.
    pub run: fn(),
}

/// In the order of the table.
fn rows() -> Vec<Row> {
    let mut rows = [replies::ROWS, lines::ROWS, devices::ROWS, values::ROWS].concat();
    rows.sort_by_key(|row| row.number);
    let numbers: Vec<u8> = rows.iter().map(|row| row.number).collect();
    assert_eq!(numbers, (1..=rows.len() as u8).collect::<Vec<u8>>(), "each row has a place of its own");
    rows
}

#[test]
fn whatever_happens_on_the_wire_nothing_false_is_published_and_nothing_is_lost() {
    let rows = rows();
    let failed: Mutex<Vec<&str>> = Mutex::default();
    let next = Mutex::new(rows.iter());
    thread::scope(|scope| {
        for _ in 0..AT_ONCE {
            scope.spawn(|| {
                loop {
                    let Some(row) = next.lock().expect("nobody panics with it").next() else { return };
                    // A row that fails says itself why; the others go on.
                    let thread = thread::Builder::new().name(row.fault.into()).spawn(row.run);
                    if thread.expect("a thread").join().is_err() {
                        failed.lock().expect("nobody panics with it").push(row.fault);
                    }
                }
            });
        }
    });
    let failed = failed.into_inner().expect("nobody panicked with it");
    assert!(failed.is_empty(), "these failed, and said above why: {failed:#?}");
    let mut table =
        "| | what breaks gateways | what is done to the wire | what busker does |\n|---|---|---|---|\n"
            .to_string();
    for row in &rows {
        table += &format!("| {} | {} | {} | {} |\n", row.number, row.fault, row.done, row.seen);
    }
    table::check_document(DOCUMENT, &table);
}
