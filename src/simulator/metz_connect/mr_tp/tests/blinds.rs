//! MR-TP with blinds: commands, buttons, wind and door (pages 40 to 42).

use super::{bench, command, follow, press, press_for, relay, release, set_up};
use crate::simulator::device::Model;
use crate::simulator::testing::Bench;

#[test]
fn a_command_moves_both_blinds_for_the_long_time_and_locks_the_buttons_page_42() {
    let mut bench = bench("0003");
    command(&mut bench, 2);
    follow(&mut bench, &[(0, "open 1"), (59_999, "open 1")]);
    assert_eq!(relay(&mut bench, 2), "open 1");
    follow(&mut bench, &[(1, "off 1")]);
    assert_eq!(relay(&mut bench, 2), "off 1");
    press(&mut bench, 1);
    follow(&mut bench, &[(0, "off 1"), (5000, "off 1")]);
    // The button that is still held must be pressed anew when it may.
    command(&mut bench, 0);
    follow(&mut bench, &[(0, "off 0"), (5000, "off 0")]);
    release(&mut bench, 1);
    press(&mut bench, 1);
    follow(&mut bench, &[(0, "open 0")]);
    command(&mut bench, 1);
    follow(&mut bench, &[(0, "off 1"), (5000, "off 1")]);
    command(&mut bench, 3);
    follow(&mut bench, &[(0, "close 1"), (59_999, "close 1"), (1, "off 1")]);
}

#[test]
fn a_command_begins_only_when_the_register_changes_page_42() {
    let mut bench = bench("0003");
    command(&mut bench, 3);
    bench.wait(59_000);
    command(&mut bench, 3);
    follow(&mut bench, &[(999, "close 1"), (1, "off 1")]);
    command(&mut bench, 3);
    bench.check(&[("10 0000 0002 04 0000 0003", "10 0000 0002"), ("06 0001 0103", "06 0001 0103")]);
    follow(&mut bench, &[(0, "off 1")]);
    command(&mut bench, 0);
    command(&mut bench, 3);
    follow(&mut bench, &[(0, "close 1")]);
    // Another one begins anew, behind the pause where it goes the other way.
    bench.wait(30_000);
    command(&mut bench, 4);
    follow(&mut bench, &[(59_999, "close 1")]);
    command(&mut bench, 2);
    follow(&mut bench, &[(0, "off 1"), (500, "open 1"), (59_999, "open 1"), (1, "off 1")]);
    // Normal operation and the lock both stop a blind at once.
    for stop in [0, 1] {
        command(&mut bench, 3);
        bench.wait(1000);
        command(&mut bench, stop);
        follow(&mut bench, &[(0, &format!("off {stop}")), (70_000, &format!("off {stop}"))]);
    }
}

#[test]
fn command_4_closes_and_then_turns_the_slats_by_opening_a_little_page_42() {
    let mut bench = bench("0003");
    // 3 s and 0.8 s.
    bench.check(&[("10 0006 0002 04 012C 0050", "10 0006 0002")]);
    command(&mut bench, 4);
    let turn = [
        (0, "close 1"),
        (2999, "close 1"),
        (1, "off 1"),
        (499, "off 1"),
        (1, "open 1"),
        (799, "open 1"),
        (1, "off 1"),
        (70_000, "off 1"),
    ];
    follow(&mut bench, &turn);
    assert_eq!(relay(&mut bench, 2), "off 1");
    // Nobody need look meanwhile: one step of time gives the same as many.
    command(&mut bench, 0);
    command(&mut bench, 4);
    follow(&mut bench, &[(4299, "open 1"), (1, "off 1")]);
    // A command between them takes the turning with it.
    command(&mut bench, 3);
    follow(&mut bench, &[(3499, "close 1"), (1, "off 1"), (600, "off 1")]);
}

#[test]
fn a_command_waits_for_no_mode_it_begins_when_it_is_written_in_one_with_blinds_page_42() {
    let mut bench = bench("0002");
    command(&mut bench, 2);
    follow(&mut bench, &[(0, "off 0")]);
    bench.check(&[("06 0002 0003", "06 0002 0003")]);
    follow(&mut bench, &[(0, "off 1")]);
    // Both in one request.
    bench.check(&[("06 0002 0002", "06 0002 0002"), ("10 0001 0002 04 0003 0003", "10 0001 0002")]);
    follow(&mut bench, &[(0, "close 1")]);
    // Another mode ends what goes on.
    bench.check(&[("06 0002 0004", "06 0002 0004")]);
    follow(&mut bench, &[(0, "off 1")]);
}

#[test]
fn one_motor_hangs_between_both_relays_in_sunblind_2_page_41() {
    let both = |bench: &mut Bench| (relay(bench, 1), relay(bench, 2));
    let mut bench = bench("0004");
    command(&mut bench, 2);
    assert_eq!(both(&mut bench), ("open 1".into(), "open 1".into()));
    command(&mut bench, 3);
    bench.wait(500);
    assert_eq!(both(&mut bench), ("close 1".into(), "close 1".into()));
    bench.act("toggle 1 up").expect("a switch");
    bench.wait(500);
    assert_eq!(both(&mut bench), ("open 3".into(), "open 3".into()));
    bench.act("toggle 1 middle").expect("a switch");
    bench.act("toggle 2 up").expect("a switch");
    bench.wait(500);
    assert_eq!(both(&mut bench), ("close 1".into(), "close 1".into()));
    command(&mut bench, 0);
    press(&mut bench, 2);
    assert_eq!(both(&mut bench), ("close 0".into(), "close 0".into()));
    bench.wait(1000);
    release(&mut bench, 2);
    // Inputs 4 and 5 are free.
    press(&mut bench, 4);
    press(&mut bench, 5);
    bench.check(&[("02 0000 0006", "02 01 18")]);
    assert_eq!(both(&mut bench), ("off 0".into(), "off 0".into()));
}

#[test]
fn each_blind_of_sunblind_1_has_its_two_buttons_and_its_switch_page_40() {
    for (input, moved, state) in [(1, 1, "open 0"), (2, 1, "close 0"), (4, 2, "open 0"), (5, 2, "close 0")] {
        let mut bench = bench("0003");
        press(&mut bench, input);
        assert_eq!(relay(&mut bench, moved), state, "{input}");
        assert_eq!(relay(&mut bench, 3 - moved), "off 0", "{input}");
        bench.act(&format!("toggle {moved} up")).expect("a switch");
        bench.wait(500);
        assert_eq!(relay(&mut bench, moved), "open 3");
        assert_eq!(relay(&mut bench, 3 - moved), "off 0");
    }
    for input in [3, 6] {
        let mut bench = bench("0003");
        press(&mut bench, input);
        assert_eq!((relay(&mut bench, 1), relay(&mut bench, 2)), ("off 0".into(), "off 0".into()));
    }
    // In the other modes they are inputs like any other.
    let mut bench = bench("0002");
    press(&mut bench, 1);
    follow(&mut bench, &[(0, "off 0"), (3000, "off 0")]);
}

#[test]
fn a_short_press_gives_the_pulse_of_its_kind_page_42() {
    // The time is 0.5 s. For each kind, how long the relay is on after presses of 0.2 s and of 1 s.
    for (kind, after_short, after_long) in
        [("0", 500, 500), ("1", 200, 500), ("2", 500, 1000), ("3", 200, 1000), ("7", 200, 1000)]
    {
        for (pressed, on) in [(200, after_short), (1000, after_long)] {
            let mut bench = bench(&format!("0{kind}03"));
            press(&mut bench, 1);
            for elapsed in (0..1500).step_by(50) {
                if elapsed == pressed {
                    release(&mut bench, 1);
                }
                let state = if elapsed < on { "open 0" } else { "off 0" };
                assert_eq!(relay(&mut bench, 1), state, "kind {kind}, {pressed} ms, after {elapsed} ms");
                bench.wait(50);
            }
        }
    }
    for pressed in [200, 1000, 1999] {
        let mut bench = bench("0403");
        press(&mut bench, 2);
        follow(&mut bench, &[(0, "off 0"), (pressed, "off 0")]);
        release(&mut bench, 2);
        follow(&mut bench, &[(0, "close 0"), (499, "close 0"), (1, "off 0"), (9999, "off 0")]);
    }
}

#[test]
fn a_long_press_gives_the_long_pulse_but_for_kind_7_page_42() {
    for (kind, before) in
        [("0", "off 0"), ("1", "off 0"), ("2", "open 0"), ("3", "open 0"), ("4", "off 0"), ("7", "open 0")]
    {
        let mut bench = bench(&format!("0{kind}03"));
        press(&mut bench, 1);
        follow(&mut bench, &[(1999, before), (1, "open 0")]);
        if kind == "7" {
            follow(&mut bench, &[(100_000, "open 0")]);
            release(&mut bench, 1);
            follow(&mut bench, &[(0, "off 0")]);
            continue;
        }
        // Let go or not, it is as long as it is.
        if kind != "3" {
            release(&mut bench, 1);
        }
        follow(&mut bench, &[(0, "open 0"), (59_999, "open 0"), (1, "off 0"), (70_000, "off 0")]);
        release(&mut bench, 1);
        follow(&mut bench, &[(0, "off 0")]);
    }
}

#[test]
fn a_short_press_ends_the_long_pulse_and_a_long_one_makes_another_page_42() {
    for kind in ["0", "1", "2", "3", "4"] {
        for input in [1, 2] {
            let mut bench = bench(&format!("0{kind}03"));
            press_for(&mut bench, 1, 2500);
            follow(&mut bench, &[(5000, "open 0")]);
            press_for(&mut bench, input, 200);
            follow(&mut bench, &[(0, "off 0"), (70_000, "off 0")]);
            press_for(&mut bench, 1, 2500);
            follow(&mut bench, &[(5000, "open 0")]);
            press_for(&mut bench, input, 2000);
            let state = if input == 1 { "open 0" } else { "close 0" };
            follow(&mut bench, &[(0, state), (59_999, state), (1, "off 0")]);
        }
    }
}

#[test]
fn a_pulse_keeps_its_length_behind_a_pause_and_the_button_pressed_last_counts_pages_40_and_42() {
    let mut bench = bench("0003");
    press(&mut bench, 1);
    bench.wait(300);
    press(&mut bench, 2);
    follow(&mut bench, &[(0, "off 0"), (499, "off 0"), (1, "close 0"), (499, "close 0"), (1, "off 0")]);
    // Letting the other go ends nothing: this one has been held for two seconds now.
    release(&mut bench, 1);
    follow(&mut bench, &[(999, "off 0"), (1, "close 0")]);
}

#[test]
fn the_times_are_those_of_registers_4_to_7_page_39() {
    let mut bench = bench("0003");
    // 1 s, 0.2 s, 5 s, 0.3 s.
    bench.check(&[("10 0004 0004 08 0064 0014 01F4 001E", "10 0004 0004")]);
    press(&mut bench, 1);
    follow(&mut bench, &[(199, "open 0"), (1, "off 0"), (799, "off 0"), (1, "open 0"), (4999, "open 0")]);
    follow(&mut bench, &[(1, "off 0")]);
    bench.wait(1000);
    command(&mut bench, 4);
    follow(&mut bench, &[(4999, "close 1"), (1, "off 1"), (500, "open 1"), (299, "open 1"), (1, "off 1")]);
    // Times of 0 are pulses that are over before they begin.
    command(&mut bench, 0);
    bench.check(&[("10 0004 0004 08 0000 0000 0000 0000", "10 0004 0004")]);
    release(&mut bench, 1);
    press(&mut bench, 1);
    follow(&mut bench, &[(0, "off 0"), (5000, "off 0")]);
    command(&mut bench, 4);
    follow(&mut bench, &[(0, "off 1"), (5000, "off 1")]);
}

#[test]
fn wind_opens_like_command_2_and_rules_over_commands_and_buttons_page_41() {
    // A contact that closes, and one that opens.
    for (flags, calm, blows) in [("80", "open", "closed"), ("C0", "closed", "open")] {
        let mut bench = Bench::new(Model::MrTp);
        bench.act(&format!("input 3 contact {calm}")).expect("a contact");
        set_up(&mut bench, &format!("{flags}03"));
        command(&mut bench, 3);
        follow(&mut bench, &[(1000, "close 1")]);
        bench.act(&format!("input 3 contact {blows}")).expect("a contact");
        follow(&mut bench, &[(499, "off 2"), (1, "open 2")]);
        assert_eq!(relay(&mut bench, 2), "open 2");
        // Neither a command nor a button does anything, the switch does.
        command(&mut bench, 0);
        press_for(&mut bench, 2, 100);
        follow(&mut bench, &[(0, "open 2")]);
        bench.act("toggle 1 down").expect("a switch");
        follow(&mut bench, &[(500, "close 3")]);
        bench.act("toggle 1 middle").expect("a switch");
        follow(&mut bench, &[(500, "open 2"), (58_899, "open 2"), (1, "off 2"), (70_000, "off 2")]);
        // When it drops, the levels below rule again.
        bench.act(&format!("input 3 contact {calm}")).expect("a contact");
        follow(&mut bench, &[(0, "off 0")]);
        press_for(&mut bench, 2, 100);
        follow(&mut bench, &[(0, "close 0"), (1000, "off 0")]);
        // A gust opens the blind whole.
        bench.act(&format!("input 3 contact {blows}")).expect("a contact");
        bench.wait(100);
        bench.act(&format!("input 3 contact {calm}")).expect("a contact");
        follow(&mut bench, &[(59_899, "open 2"), (1, "off 0")]);
    }
}

#[test]
fn wind_that_blows_already_when_the_flag_comes_or_the_device_starts_opens_too_page_41() {
    let mut bench = bench("0003");
    press(&mut bench, 3);
    follow(&mut bench, &[(0, "off 0")]);
    bench.check(&[("06 0002 8003", "06 0002 8003")]);
    follow(&mut bench, &[(0, "open 2"), (60_000, "off 2")]);
    bench.check(&[("08 0001 0000", "08 0001 0000")]);
    follow(&mut bench, &[(0, "open 2"), (60_000, "off 2")]);
    // No such contact in the other modes.
    bench.check(&[("06 0002 8002", "06 0002 8002")]);
    follow(&mut bench, &[(0, "off 0")]);
}

#[test]
fn an_open_door_prevents_closing_by_commands_and_buttons_and_nothing_else_page_41() {
    for (flags, shut, open) in [("20", "open", "closed"), ("30", "closed", "open")] {
        let mut bench = Bench::new(Model::MrTp);
        bench.act(&format!("input 6 contact {shut}")).expect("a contact");
        set_up(&mut bench, &format!("{flags}03"));
        command(&mut bench, 3);
        follow(&mut bench, &[(1000, "close 1")]);
        bench.act(&format!("input 6 contact {open}")).expect("a contact");
        follow(&mut bench, &[(0, "off 2"), (30_000, "off 2")]);
        assert_eq!(relay(&mut bench, 2), "off 2");
        // The pulse's time has passed meanwhile.
        bench.act(&format!("input 6 contact {shut}")).expect("a contact");
        follow(&mut bench, &[(0, "close 1"), (28_999, "close 1"), (1, "off 1")]);
        bench.act(&format!("input 6 contact {open}")).expect("a contact");
        follow(&mut bench, &[(0, "off 1")]);
        command(&mut bench, 2);
        follow(&mut bench, &[(0, "off 1"), (500, "open 1")]);
        command(&mut bench, 0);
        press(&mut bench, 2);
        follow(&mut bench, &[(0, "off 2"), (499, "off 2"), (501, "off 0")]);
        release(&mut bench, 2);
        press_for(&mut bench, 1, 100);
        follow(&mut bench, &[(0, "open 0"), (1000, "off 0")]);
        bench.act("toggle 1 down").expect("a switch");
        follow(&mut bench, &[(0, "close 3")]);
    }
}

#[test]
fn the_switch_lets_a_command_s_time_pass_page_41() {
    let mut bench = bench("0003");
    command(&mut bench, 2);
    bench.wait(10_000);
    bench.act("toggle 1 up").expect("a switch");
    follow(&mut bench, &[(20_000, "open 3")]);
    bench.act("toggle 1 middle").expect("a switch");
    follow(&mut bench, &[(0, "open 1"), (29_999, "open 1"), (1, "off 1")]);
}
