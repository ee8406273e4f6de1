//! What the configurable analog inputs measure, beside a second reading of the manuals: of every code
//! `tests/golden/shared/measuring.tsv` says the same as `device-profiles/shared/measuring.yaml`, which is
//! seen here as the MR-AI8 has it. Which devices have which codes is in their own tables (`manual.rs`).

use std::collections::BTreeSet;
use std::fs;

use busker::engine::device::{Device, Encoding};

use crate::manual::{scale, unit};
use crate::{place, shipped};

const HEADER: &str = "code\ttype\tscale\tunit\trange";

#[test]
fn every_code_measures_what_a_second_reader_found_in_the_manual() {
    let file = fs::read_to_string(place("shared", "measuring.tsv")).expect("the table is there");
    let mut lines = file.lines().filter(|line| !line.starts_with('#'));
    assert_eq!(lines.next(), Some(HEADER));
    let manual: BTreeSet<String> = lines.map(String::from).collect();
    let profile: BTreeSet<String> = codes("metz-connect/mr-ai8", "channel_1_value", "")
        .chain(codes("metz-connect/mr-multi-io", "current", "I "))
        .collect();
    let only = |these: &BTreeSet<String>, those| these.difference(those).cloned().collect::<Vec<_>>();
    let (manual, profile) = (only(&manual, &profile), only(&profile, &manual));
    assert!(
        manual.is_empty() && profile.is_empty(),
        "only in the manual:\n{}\nonly in the profile:\n{}\n",
        manual.join("\n"),
        profile.join("\n")
    );
}

/// A line of the table for each code that decides about this point, with `input ` before the code.
fn codes(id: &str, point: &str, input: &'static str) -> impl Iterator<Item = String> {
    let (_, device): &(String, Device) = shipped().iter().find(|(known, _)| known == id).expect(id);
    let point = device.points.iter().find(|known| known.name == point).expect(point);
    let Encoding::Cases { cases, .. } = &point.encoding else { panic!("{} has no cases", point.name) };
    cases.iter().map(move |case| {
        let code = format!("{input}{}", case.key);
        let Some(form) = &case.form else { return format!("{code}\t-\t-\t-\t-") };
        let range = match form.range {
            Some((min, max)) => format!("{min}..{max}"),
            None => "-".into(),
        };
        format!("{code}\t{}\t{}\t{}\t{range}", form.kind.name(), scale(device, form), unit(device, form))
    })
}
