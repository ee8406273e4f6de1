//! The modes Motorized, Motor and LimitSwitch, as a master and the contacts of a damper see them.

use super::*;
use crate::simulator::device::Model;
use crate::simulator::testing::Bench;

const MOTORIZED_SAFETY_OPEN: u16 = 1;
const MOTORIZED_SAFETY_CLOSE: u16 = 2;
const LIMIT_SWITCH_OPEN_CLOSE: u16 = 3;
const LIMIT_SWITCH_OPEN: u16 = 4;
const LIMIT_SWITCH_CLOSE: u16 = 5;
const MOTOR_SAFETY_OPEN_2: u16 = 7;
const MOTOR_SAFETY_CLOSE_2: u16 = 8;

/// Both channels in one mode, which "sind gleich" (page 29): whatever is done is done to both.
struct Dampers {
    bench: Bench,
}

impl Dampers {
    /// Switched on with the contacts of `moved`, the mode from the EEPROM.
    fn new(mode: u16, moved: &str) -> Dampers {
        let mut dampers = Dampers { bench: Bench::new(Model::MrDio42) };
        dampers.write(2, mode);
        dampers.act(moved);
        dampers.bench.act("restart").expect("a restart");
        dampers
    }

    /// Writes the register of channel 1 and the next one, which is that of channel 2.
    fn write(&mut self, register: u16, word: u16) {
        let first = format!("10{register:04X}0002");
        self.bench.check(&[(&format!("{first}04{word:04X}{word:04X}"), &first)]);
    }

    /// `open`, `closed`, `between` and `both` are what the contacts AUF and ZU say; `drive open`,
    /// `acknowledge` and `write R W` are what the master writes.
    fn act(&mut self, action: &str) {
        let contacts = match action.split(' ').collect::<Vec<&str>>()[..] {
            ["open"] => ["closed", "open"],
            ["closed"] => ["open", "closed"],
            ["between"] => ["open", "open"],
            ["both"] => ["closed", "closed"],
            ["drive", "open"] => return self.write(10, 1),
            ["drive", "close"] => return self.write(10, 2),
            ["acknowledge"] => return self.write(16, 1),
            ["write", register, word] => {
                return self.write(register.parse().expect("a register"), word.parse().expect("a word"));
            }
            ["restart"] => return self.bench.act("restart").expect("a restart"),
            [""] => return,
            _ => panic!("`{action}` is nothing to do"),
        };
        for (input, state) in contacts.iter().chain(&contacts).enumerate() {
            self.bench.act(&format!("input {} contact {state}", input + 1)).expect("a contact");
        }
    }

    /// ActuDrive, ActuPos, AlarmCode and the relay, which is intended to be as it is.
    #[track_caller]
    fn see(&mut self) -> String {
        let told = self.bench.ask("03 0000 0012");
        let word = |register: usize| &told[4 + 4 * register..8 + 4 * register];
        for register in (2..18).step_by(2) {
            assert_eq!(word(register), word(register + 1), "channel 1 and 2, register {register}");
        }
        let position = |word: &str| match word {
            "0000" => "-",
            "0001" => "open",
            "0002" => "close",
            "0003" => "running",
            other => panic!("{other} is no position"),
        };
        let alarm = match word(16) {
            "0001" => "OK",
            "0003" => "Runtime_Error",
            "0004" => "Manipulation",
            "0005" => "Update_Error",
            "0006" => "Alarm",
            "0007" => "Alarm_a",
            other => panic!("{other} is no alarm code"),
        };
        let relay = match word(0) {
            "0000" => "off",
            "0033" => "on",
            other => panic!("coils {other} are not both relays"),
        };
        format!("{} {} {alarm} {relay}", position(word(10)), position(word(12)))
    }

    /// Does something, waits, and compares: the rows of a story.
    #[track_caller]
    fn play(&mut self, rows: &[(&str, u64, &str)]) {
        for (number, (action, millis, wanted)) in rows.iter().enumerate() {
            self.act(action);
            self.bench.wait(*millis);
            assert_eq!(self.see(), *wanted, "row {number}: {action}, {millis} ms");
        }
    }
}

#[test]
fn relays_follow_the_tables_of_pages_32_to_34_from_the_top_to_the_bottom() {
    use Alarm::{Fire, Manipulation, Ok, Runtime, Update};
    use Position::{Close, Open};
    // "sonstiges", ActuDrive, AlarmCode, Relais; `None` is "beliebig". The rows as they are printed.
    type Row = (&'static str, Option<Position>, Option<Alarm>, bool);
    let tables: [(Mode, &[Row]); 4] = [
        (
            Mode::MotorizedSafetyClose,
            &[
                ("Alarm-Reset", Some(Open), Some(Ok), true),
                ("Fire-Position", None, None, false),
                ("-", None, Some(Runtime), false),
                ("-", None, Some(Update), false),
                ("-", None, Some(Manipulation), false),
                ("-", Some(Open), Some(Ok), true),
                ("-", Some(Close), Some(Ok), false),
            ],
        ),
        (
            Mode::MotorizedSafetyOpen,
            &[
                ("Alarm-Reset", Some(Close), Some(Ok), false),
                ("Fire-Position", None, None, true),
                ("-", None, Some(Runtime), true),
                ("-", None, Some(Update), true),
                ("-", None, Some(Manipulation), false),
                ("-", Some(Open), Some(Ok), true),
                ("-", Some(Close), Some(Ok), false),
            ],
        ),
        (
            Mode::MotorSafetyClose2,
            &[
                ("Alarm-Reset", Some(Open), Some(Ok), true),
                ("Fire-Position", Some(Open), None, false),
                ("-", None, Some(Runtime), false),
                ("-", None, Some(Update), false),
                ("-", None, Some(Manipulation), false),
                ("-", Some(Open), Some(Ok), true),
                ("-", Some(Close), Some(Ok), false),
            ],
        ),
        (
            Mode::MotorSafetyOpen2,
            &[
                ("Alarm-Reset", Some(Close), Some(Ok), false),
                ("Fire-Position", Some(Close), None, true),
                ("-", None, Some(Runtime), true),
                ("-", None, Some(Update), true),
                ("-", None, Some(Manipulation), false),
                ("-", Some(Close), Some(Ok), false),
                ("-", Some(Open), Some(Ok), true),
            ],
        ),
    ];
    for (mode, rows) in tables {
        let motor = mode.motor().expect("a mode with a motor");
        for (resetting, is_fire) in [(false, false), (false, true), (true, false), (true, true)] {
            for (drive, alarm) in [Open, Close]
                .into_iter()
                .flat_map(|drive| [Ok, Runtime, Manipulation, Update, Fire].map(|alarm| (drive, alarm)))
            {
                let row = rows.iter().find(|(other, row_drive, row_alarm, _)| {
                    let applies = match *other {
                        "Alarm-Reset" => resetting,
                        "Fire-Position" => is_fire,
                        _ => true,
                    };
                    applies
                        && row_drive.is_none_or(|row_drive| row_drive == drive)
                        && row_alarm.is_none_or(|row_alarm| row_alarm == alarm)
                });
                let damper = Damper { drive, alarm, resetting, ..Damper::new(Time(0), mode) };
                for before in [false, true] {
                    let wanted = row.map_or(before, |(.., relay)| *relay);
                    assert_eq!(
                        damper.relay(motor, is_fire, before),
                        wanted,
                        "{mode:?}: reset {resetting}, fire {is_fire}, {drive:?}, {alarm:?}, was {before}"
                    );
                }
            }
        }
    }
}

#[test]
fn a_closed_damper_is_opened_after_a_start_where_closed_is_safe_pages_32_and_33() {
    for mode in [MOTORIZED_SAFETY_CLOSE, MOTOR_SAFETY_CLOSE_2] {
        Dampers::new(mode, "closed").play(&[
            ("", 0, "open close OK off"),
            ("", 99, "open close OK off"),
            ("", 1, "open close OK on"),
            ("between", 100, "open running OK on"),
            ("open", 100, "open open OK on"),
            ("", 10_000, "open open OK on"),
        ]);
    }
}

#[test]
fn an_open_damper_is_closed_after_a_start_where_open_is_safe_pages_33_and_34() {
    for mode in [MOTORIZED_SAFETY_OPEN, MOTOR_SAFETY_OPEN_2] {
        Dampers::new(mode, "open").play(&[
            ("", 100, "close open OK off"),
            ("between", 100, "close running OK off"),
            ("closed", 100, "close close OK off"),
            ("", 10_000, "close close OK off"),
        ]);
    }
}

#[test]
fn registers_are_read_and_updated_every_100_ms_page_21() {
    Dampers::new(MOTOR_SAFETY_CLOSE_2, "open").play(&[
        ("", 100, "open open OK on"),
        ("", 30, "open open OK on"),
        ("drive close", 69, "close open OK on"),
        ("", 1, "close open OK off"),
        ("between", 99, "close open OK off"),
        ("", 1, "close running OK off"),
        // What comes and goes between two looks is not seen.
        ("both", 50, "close running OK off"),
        ("closed", 50, "close close OK off"),
    ]);
}

#[test]
fn a_fire_position_holds_itself_until_drive_and_then_alarm_are_written_page_30() {
    Dampers::new(MOTORIZED_SAFETY_CLOSE, "open").play(&[
        ("", 100, "open open OK on"),
        // The thermal link has let the damper go.
        ("between", 100, "open running Alarm off"),
        ("closed", 100, "open close Alarm off"),
        ("drive open", 100, "open close Alarm off"),
        ("acknowledge", 0, "open close OK off"),
        ("", 100, "open close OK on"),
        // The alarm reset lasts until the normal position, and then the fire position counts again.
        ("between", 20_000, "open running OK on"),
        ("open", 100, "open open OK on"),
        ("between", 100, "open running Alarm off"),
        // The alarm stays when the damper is open again by itself.
        ("open", 100, "open open Alarm off"),
        ("acknowledge", 100, "open open OK on"),
    ]);
}

#[test]
fn an_alarm_that_is_acknowledged_before_the_drive_comes_back_page_30() {
    for (mode, safe, normal, alarmed, moving) in [
        (MOTORIZED_SAFETY_CLOSE, "close", "open", "close Alarm off", "close OK on"),
        (MOTORIZED_SAFETY_OPEN, "open", "close", "open Alarm on", "open OK off"),
    ] {
        let at = |position: &str| if position == "close" { "closed" } else { "open" };
        let mut dampers = Dampers::new(mode, at(normal));
        dampers.bench.wait(100);
        dampers.act(&format!("drive {safe}"));
        dampers.bench.wait(100);
        dampers.play(&[
            (at(safe), 100, &format!("{safe} {alarmed}")),
            ("acknowledge", 0, &format!("{safe} {}", alarmed.replace("Alarm", "OK"))),
            ("", 100, &format!("{safe} {alarmed}")),
            // Neither does it help to hurry.
            ("acknowledge", 0, &format!("{safe} {}", alarmed.replace("Alarm", "OK"))),
            (&format!("drive {normal}"), 100, &format!("{normal} {alarmed}")),
            // Now the order is right.
            ("acknowledge", 100, &format!("{normal} {moving}")),
        ]);
        // Both in one request are in that order as well.
        dampers.act(&format!("drive {safe}"));
        dampers.bench.wait(100);
        dampers.play(&[("", 0, &format!("{safe} {alarmed}"))]);
        let drive = if normal == "open" { "0001" } else { "0002" };
        let words = format!("{drive}{drive} 0000 0000 0000 0000 0001 0001");
        dampers.bench.check(&[(&format!("10 000A 0008 10 {words}"), "10 000A 0008")]);
        dampers.play(&[("", 100, &format!("{normal} {moving}"))]);
    }
}

#[test]
fn driving_to_the_safe_position_is_an_alarm_in_the_modes_motorized_page_31() {
    Dampers::new(MOTORIZED_SAFETY_CLOSE, "open").play(&[
        ("", 100, "open open OK on"),
        ("drive close", 100, "close open OK off"),
        ("between", 100, "close running Alarm off"),
        ("closed", 100, "close close Alarm off"),
    ]);
    Dampers::new(MOTORIZED_SAFETY_OPEN, "closed").play(&[
        ("", 100, "close close OK off"),
        ("drive open", 100, "open close OK on"),
        ("between", 100, "open running Alarm on"),
        ("open", 100, "open open Alarm on"),
        ("drive close", 100, "close open Alarm on"),
        ("acknowledge", 100, "close open OK off"),
        ("between", 100, "close running OK off"),
        ("closed", 100, "close close OK off"),
    ]);
    // Back before the damper has moved: nothing was the matter.
    Dampers::new(MOTORIZED_SAFETY_CLOSE, "open").play(&[
        ("", 100, "open open OK on"),
        ("drive close", 100, "close open OK off"),
        ("drive open", 100, "open open OK on"),
    ]);
}

#[test]
fn driving_to_the_safe_position_and_back_is_no_alarm_in_the_modes_2_pages_31_33_and_34() {
    Dampers::new(MOTOR_SAFETY_CLOSE_2, "open").play(&[
        ("", 100, "open open OK on"),
        ("drive close", 100, "close open OK off"),
        ("between", 100, "close running OK off"),
        ("closed", 1000, "close close OK off"),
        ("drive open", 100, "open close OK on"),
        ("between", 1000, "open running OK on"),
        // Turned round on the way, and once more.
        ("drive close", 100, "close running OK off"),
        ("drive open", 100, "open running OK on"),
        ("open", 100, "open open OK on"),
        // But by itself it is an alarm, and the order of acknowledgement the same.
        ("between", 100, "open running Alarm off"),
        ("drive close", 100, "close running Alarm off"),
        ("drive open", 100, "open running Alarm off"),
        ("acknowledge", 100, "open running OK on"),
    ]);
    Dampers::new(MOTOR_SAFETY_OPEN_2, "closed").play(&[
        ("", 100, "close close OK off"),
        ("drive open", 100, "open close OK on"),
        ("open", 1000, "open open OK on"),
        ("drive close", 100, "close open OK off"),
        ("closed", 100, "close close OK off"),
        ("between", 100, "close running Alarm on"),
        // Acknowledged in the safe position it does not move, and from there it is driven back.
        ("drive open", 100, "open running Alarm on"),
        ("acknowledge", 100, "open running OK on"),
        ("drive close", 100, "close running OK off"),
    ]);
}

#[test]
fn a_damper_that_opens_or_closes_too_long_is_a_runtime_error_page_31() {
    // From the factory: 240 s to open, 35 s to close. Each row begins 100 ms after the switching.
    Dampers::new(MOTOR_SAFETY_CLOSE_2, "closed").play(&[
        ("", 100, "open close OK on"),
        ("between", 239_900, "open running OK on"),
        ("", 100, "open running Runtime_Error off"),
        ("closed", 100, "open close Runtime_Error off"),
        ("open", 1000, "open open Runtime_Error off"),
        ("acknowledge", 100, "open open OK on"),
        ("drive close", 100, "close open OK off"),
        ("between", 34_900, "close running OK off"),
        ("", 100, "close running Runtime_Error off"),
        ("acknowledge", 100, "close running Runtime_Error off"),
        ("closed", 100, "close close Runtime_Error off"),
        ("acknowledge", 100, "close close OK off"),
        ("", 1_000_000, "close close OK off"),
    ]);
    // Where open is safe, that is where the error sends the damper.
    Dampers::new(MOTORIZED_SAFETY_OPEN, "open").play(&[
        ("write 6 20", 100, "close open OK off"),
        ("between", 1900, "close running OK off"),
        ("", 100, "close running Runtime_Error on"),
        ("open", 1000, "close open Runtime_Error on"),
        ("acknowledge", 100, "close open OK off"),
        ("closed", 1900, "close close OK off"),
    ]);
}

#[test]
fn a_time_of_0_is_not_measured_pages_28_and_31() {
    let mut dampers = Dampers::new(MOTOR_SAFETY_CLOSE_2, "closed");
    dampers.write(4, 0);
    dampers.play(&[
        ("", 6_600_000, "open close OK on"),
        // The two are switched off one by one.
        ("drive close", 100, "close close OK off"),
        ("between", 35_000, "close running Runtime_Error off"),
        ("write 6 0", 0, "close running Runtime_Error off"),
        ("acknowledge", 6_600_000, "close running OK off"),
    ]);
}

#[test]
fn both_contacts_at_once_are_manipulation_and_switch_the_relay_off_page_31() {
    for (mode, normal, moved) in [
        (MOTORIZED_SAFETY_CLOSE, "open", "open"),
        (MOTOR_SAFETY_CLOSE_2, "open", "open"),
        (MOTORIZED_SAFETY_OPEN, "close", "closed"),
        (MOTOR_SAFETY_OPEN_2, "close", "closed"),
    ] {
        let lasting = format!("{normal} running Manipulation off");
        Dampers::new(mode, moved).play(&[
            ("", 100, &format!("{normal} {normal} OK {}", if normal == "open" { "on" } else { "off" })),
            ("both", 100, &lasting),
            // It stays, whatever comes, until it is acknowledged; and comes back if it lasts.
            (moved, 200, &format!("{normal} {normal} Manipulation off")),
            ("both", 100, &lasting),
            ("acknowledge", 100, &lasting),
        ]);
    }
    // Only the fire position is before it in the table: page 33.
    Dampers::new(MOTORIZED_SAFETY_OPEN, "both").play(&[
        ("", 100, "close running Manipulation off"),
        ("between", 100, "close running Manipulation on"),
        ("both", 100, "close running Manipulation off"),
    ]);
}

#[test]
fn only_writing_the_drive_feeds_the_heartbeat_pages_23_and_31() {
    for (mode, at, normal, relay) in [
        (MOTORIZED_SAFETY_CLOSE, "open", "open", "on"),
        (MOTOR_SAFETY_CLOSE_2, "open", "open", "on"),
        (MOTORIZED_SAFETY_OPEN, "closed", "close", "off"),
        (MOTOR_SAFETY_OPEN_2, "closed", "close", "off"),
    ] {
        let safe_relay = if relay == "on" { "off" } else { "on" };
        let fine = format!("{normal} {normal} OK {relay}");
        let late = format!("{normal} {normal} Update_Error {safe_relay}");
        let drive = format!("drive {normal}");
        Dampers::new(mode, at).play(&[
            // Off from the factory.
            ("", 1_000_000, &fine),
            // 1.5 s; it counts from when it is set, and the reads of this test do not feed it.
            ("write 8 15", 1400, &fine),
            (&drive, 700, &fine),
            ("", 700, &fine),
            (&drive, 1400, &fine),
            ("", 100, &late),
            // Written too late, it stays; and it counts anew when it is acknowledged.
            (&drive, 100, &late),
            ("acknowledge", 1400, &fine),
            ("", 100, &late),
            ("write 8 0", 0, &late),
            ("acknowledge", 1_000_000, &fine),
        ]);
    }
}

#[test]
fn the_heartbeat_counts_from_a_start_and_from_being_set_again_page_32() {
    let mut dampers = Dampers::new(MOTOR_SAFETY_CLOSE_2, "open");
    dampers.play(&[
        ("write 8 10", 900, "open open OK on"),
        ("write 8 10", 900, "open open OK on"),
        ("restart", 900, "open open OK on"),
        ("", 100, "open open Update_Error off"),
    ]);
}

#[test]
fn the_first_error_stays_until_it_is_acknowledged_and_only_then_another_is_found_page_32() {
    Dampers::new(MOTOR_SAFETY_CLOSE_2, "closed").play(&[
        ("write 4 20", 100, "open close OK on"),
        ("write 8 50", 2000, "open close Runtime_Error off"),
        ("both", 5000, "open running Runtime_Error off"),
        // Three things are wrong by now; the next to be found is the first of page 29.
        ("acknowledge", 100, "open running Manipulation off"),
        ("open", 100, "open open Manipulation off"),
        ("acknowledge", 100, "open open Update_Error off"),
        ("acknowledge", 100, "open open OK on"),
    ]);
}

#[test]
fn a_restart_forgets_alarm_and_drive_and_begins_an_alarm_reset_page_32() {
    Dampers::new(MOTORIZED_SAFETY_CLOSE, "open").play(&[
        ("", 100, "open open OK on"),
        ("drive close", 100, "close open OK off"),
        ("closed", 100, "close close Alarm off"),
        ("restart", 0, "open close OK off"),
        ("", 100, "open close OK on"),
    ]);
}

#[test]
fn a_damper_without_a_motor_reports_and_switches_nothing_pages_30_and_34() {
    Dampers::new(LIMIT_SWITCH_OPEN_CLOSE, "open").play(&[
        ("", 100, "- open OK off"),
        ("between", 100, "- running Alarm off"),
        ("open", 100, "- open Alarm off"),
        ("acknowledge", 100, "- open OK off"),
        ("both", 100, "- running Manipulation off"),
        ("closed", 100, "- close Manipulation off"),
        ("acknowledge", 0, "- close OK off"),
        ("", 100, "- close Alarm off"),
        ("acknowledge", 100, "- close Alarm off"),
        // Neither drive nor times have a function.
        ("drive open", 1_000_000, "- close Alarm off"),
        ("open", 100, "- open Alarm off"),
        ("acknowledge", 100, "- open OK off"),
        ("write 8 1", 1000, "- open OK off"),
    ]);
}

#[test]
fn two_dampers_share_a_channel_each_with_one_contact_pages_28_and_30() {
    for mode in [LIMIT_SWITCH_OPEN, LIMIT_SWITCH_CLOSE] {
        let mut dampers = Dampers::new(mode, "both");
        for (action, position, second, alarm) in [
            ("", 1, 1, 1),
            // The second damper alone, then the first as well: the first report stays.
            ("open", 1, 2, 7),
            ("between", 2, 2, 7),
            // Acknowledged, the first damper goes before the second.
            ("acknowledge", 2, 2, 6),
            ("both", 1, 1, 6),
            ("acknowledge", 1, 1, 1),
            ("closed", 2, 1, 6),
            ("open", 1, 2, 6),
            ("acknowledge", 1, 2, 7),
            ("drive close", 1, 2, 7),
        ] {
            dampers.act(action);
            dampers.bench.wait(100);
            let words = [0, position, second, alarm].map(|word| format!("{word:04X}").repeat(2)).concat();
            dampers.bench.check(&[("03 000A 0008", &format!("0310{words}")), ("01 0000 0010", "01 02 0000")]);
        }
    }
}

#[test]
fn there_are_no_hand_switches_in_these_modes_page_22() {
    for mode in [1, 2, 3, 4, 5, 7, 8] {
        let mut dampers = Dampers::new(mode, "both");
        for position in ["on", "off"] {
            for relay in [1, 2] {
                dampers.bench.act(&format!("relay {relay} hand {position}")).expect("a hand switch");
            }
            dampers.bench.wait(100);
            dampers.bench.check(&[("01 0000 0010", "01 02 0000")]);
            // Neither does the bus switch relays or reset faults here.
            dampers.bench.check(&[("0F 0000 0010 02 FFFF", "0F 0000 0010"), ("01 0000 0010", "01 02 0000")]);
        }
    }
}
