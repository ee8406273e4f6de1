//! Rules of points that live in some modes only, that act by being written, or that tell events.

use crate::engine::device::{Form, Kind, Names, Poll, Unit};
use crate::engine::profile::check::{Rules, Subject};

impl Rules<'_, '_> {
    pub fn living(&mut self) {
        self.what_decides_about_life_is_read();
        self.an_event_is_a_bit_that_is_read();
        self.an_array_is_one_of_numbers_that_are_only_read();
        self.what_settles_or_acts_on_change_is_written();
        self.a_heartbeat_repeats_what_is_read();
        self.what_refers_names_registers();
    }

    fn what_decides_about_life_is_read(&mut self) {
        for Subject { file, point, .. } in self.entries() {
            for ((path, _), condition) in file.when.iter().zip(&point.when) {
                let selector = &self.device.points[condition.point];
                let message = if selector.poll == Poll::Never {
                    format!("`{}` decides here but is never read; expected `poll: slow` there", selector.name)
                } else if selector.plain().is_none() {
                    format!(
                        "`{}` decides here and has cases itself; expected a point that needs no other",
                        selector.name
                    )
                } else {
                    continue;
                };
                self.faults.add(&path.place, message);
            }
        }
    }

    fn an_event_is_a_bit_that_is_read(&mut self) {
        for Subject { file, point, .. } in self.entries() {
            let Some(event) = &file.event else { continue };
            if point.plain().is_none_or(|form| form.kind != Kind::Bool) || !point.is_read() {
                self.faults.add(
                    &event.place,
                    "an event of what is no bit that is polled; expected a single bit with `poll: fast`",
                );
            } else if point.write.is_some() {
                self.faults.add(&event.place, "an event of what is written; remove one of the two");
            }
        }
    }

    fn an_array_is_one_of_numbers_that_are_only_read(&mut self) {
        for Subject { file, point, .. } in self.entries() {
            let Some(count) = &file.count else { continue };
            let is_number = |form: &Form| form.is_number() && form.names == Names::None;
            let message = if count.value < 2 {
                "an array of fewer than two values; expected more, or no `count`"
            } else if point.at.bits.is_some() || !point.encoding.forms().all(is_number) {
                "an array of what is no number; expected a type like `i16`, and no `values`"
            } else if point.write.is_some() {
                "an array that is written; expected one that is only read"
            } else {
                continue;
            };
            self.faults.add(&count.place, message);
        }
    }

    fn what_settles_or_acts_on_change_is_written(&mut self) {
        for Subject { file, point, .. } in self.entries() {
            if point.write.is_some() && !point.is_button() {
                continue;
            }
            let settle =
                file.settle.as_ref().filter(|_| point.write.is_none()).map(|key| ("settle", &key.place));
            let on_change = file.on_change.as_ref().map(|key| ("on_change", &key.place));
            for (key, place) in settle.into_iter().chain(on_change) {
                let message =
                    format!("`{key}` of a point that holds nothing written; remove it, or add `write`");
                self.faults.add(place, message);
            }
        }
    }

    fn a_heartbeat_repeats_what_is_read(&mut self) {
        for Subject { file, point, .. } in self.entries() {
            let (Some(path), Some(time)) = (&file.heartbeat, point.heartbeat) else { continue };
            let time = &self.device.points[time];
            let in_seconds = time.plain().is_some_and(|form| form.unit == Unit::Fixed("s".into()));
            let message = if point.write.is_none() || point.is_button() || !point.is_read() {
                "a heartbeat repeats what was read from the register; expected `poll` and `write` beside it"
                    .into()
            } else if point.persistent {
                "a heartbeat would wear out the EEPROM; remove `persistent` or `heartbeat`".into()
            } else if !in_seconds || !time.is_read() {
                format!(
                    "`{}` is no time that is read; expected a point with `unit: s` and a `poll`",
                    time.name
                )
            } else {
                continue;
            };
            self.faults.add(&path.place, message);
        }
    }

    fn what_refers_names_registers(&mut self) {
        for Subject { file, point, .. } in self.entries() {
            let Some(refers) = &file.refers else { continue };
            let named = point.plain().map_or(0, |form| form.names.list().len());
            let given = file.form.values.iter().len();
            if named <= given {
                let message = format!(
                    "no point has a whole register of `{}`; expected the span of points",
                    refers.value
                );
                self.faults.add(&refers.place, message);
            }
        }
    }
}
