//! Set points, linear maps and controllers of MR-AIO4/2 between its inputs and outputs, pages 69 to 78.

use super::*;

#[test]
fn the_set_point_is_input_2_or_4_or_its_linear_map_or_the_bus_s_page_77() {
    let mut bench = bench();
    // 2 to 10 V are 10 to 30 °C for the first, and 30 to 10 °C for the second.
    write(&mut bench, LCL[0], &[10.0, 30.0, 2.0, 10.0]);
    write(&mut bench, LCL[1], &[30.0, 10.0, 2.0, 10.0]);
    for (switch, first, second) in [(0x0, 4.0, 6.0), (0x1, 15.0, 6.0), (0x4, 4.0, 20.0), (0x5, 15.0, 20.0)] {
        write_word(&mut bench, SWITCH, switch);
        connect(&mut bench, [0.0, 4.0, 0.0, 6.0]);
        assert_eq!([read(&mut bench, W), read(&mut bench, 50 + W)], [first, second], "{switch:X}");
        // The bus has no say.
        write(&mut bench, W, &[1.0]);
        write(&mut bench, 50 + W, &[1.0]);
        assert_eq!([read(&mut bench, W), read(&mut bench, 50 + W)], [first, second], "{switch:X}");
    }
    // Its set point begins with the last one, and the inputs have no say.
    write_word(&mut bench, SWITCH, 0xA);
    assert_eq!([read(&mut bench, W), read(&mut bench, 50 + W)], [15.0, 20.0]);
    write(&mut bench, W, &[21.5]);
    write(&mut bench, 50 + W, &[22.5]);
    connect(&mut bench, [0.0, 5.0, 0.0, 7.0]);
    assert_eq!([read(&mut bench, W), read(&mut bench, 50 + W)], [21.5, 22.5]);
}

#[test]
fn lcl1_and_lcl2_map_between_two_points_and_end_there_page_74() {
    for (map, side, input) in [(0, 0, 2), (1, 50, 4)] {
        for (points, rows) in [
            ([10.0, 30.0, 2.0, 10.0], [(0.0, 10.0), (2.0, 10.0), (4.0, 15.0), (10.0, 30.0), (10.2, 30.0)]),
            ([30.0, 10.0, 2.0, 10.0], [(0.0, 30.0), (2.0, 30.0), (4.0, 25.0), (10.0, 10.0), (10.2, 10.0)]),
            // The points in the other order.
            ([30.0, 10.0, 10.0, 2.0], [(0.0, 10.0), (2.0, 10.0), (4.0, 15.0), (10.0, 30.0), (10.2, 30.0)]),
            // Above each other.
            ([10.0, 30.0, 5.0, 5.0], [(0.0, 10.0), (5.0, 10.0), (5.5, 30.0), (6.0, 30.0), (10.0, 30.0)]),
        ] {
            let mut bench = bench();
            write_word(&mut bench, SWITCH, 0x5);
            write(&mut bench, LCL[map], &points);
            for (volts, wanted) in rows {
                bench.act(&format!("input {input} volts {volts}")).expect("a signal");
                bench.wait(ROUND);
                assert_eq!(read(&mut bench, side + W), wanted, "{points:?} at {volts} V");
            }
        }
    }
}

#[test]
fn lcl3_and_lcl4_map_through_two_points_and_end_at_y3_and_y4_page_75() {
    for (map, side, input) in [(2, 0, 2), (3, 50, 4)] {
        for (numbers, rows) in [
            // The line goes on beyond its points.
            (
                [20.0, 40.0, 4.0, 6.0, 5.0, 75.0],
                [(0.0, 5.0), (3.0, 10.0), (5.0, 30.0), (8.0, 60.0), (10.0, 75.0)],
            ),
            // A frost protection: 5 V and less are 100 %.
            (
                [100.0, 0.0, 5.0, 10.0, 0.0, 100.0],
                [(0.0, 100.0), (5.0, 100.0), (7.5, 50.0), (9.0, 20.0), (10.2, 0.0)],
            ),
            // Limits within the points.
            (
                [0.0, 100.0, 0.0, 10.0, 20.0, 60.0],
                [(0.0, 20.0), (1.0, 20.0), (5.0, 50.0), (6.0, 60.0), (10.0, 60.0)],
            ),
        ] {
            let mut bench = bench();
            write(&mut bench, LCL[map], &numbers);
            for (volts, wanted) in rows {
                bench.act(&format!("input {input} volts {volts}")).expect("a signal");
                bench.wait(ROUND);
                near(&mut bench, side + LIMIT, wanted);
            }
        }
    }
}

/// Both controllers with Fp = 2 alone and not negated, InitY = 20 %, set points by the bus, and both
/// outputs by the controllers.
fn controlled() -> Bench {
    let mut bench = bench();
    for side in [0, 50] {
        write(&mut bench, side + FP_XP, &[2.0, 0.0, 0.0, 0.0, 0.0, 100.0, 0.0, 7.0, 20.0]);
        write_word(&mut bench, side + MODE, 0x01);
    }
    write_word(&mut bench, SWITCH, 0xAA);
    bench
}

#[test]
fn a_controller_has_inputs_1_and_2_or_3_and_4_and_its_own_output_page_77() {
    let mut bench = controlled();
    write(&mut bench, W, &[1.0]);
    write(&mut bench, 50 + W, &[2.0]);
    // Nothing is calculated before all inputs are measured.
    assert_eq!(bench.output("output_1"), "0.000 V");
    connect(&mut bench, [3.0, 9.0, 5.0, 9.0]);
    // The first value is InitY: Yp = 4 and 6, Yi = 16 and 14.
    for (side, yp, yi) in [(0, 4.0, 16.0), (50, 6.0, 14.0)] {
        assert_eq!([YP, YI, YDT, MANUAL_Y].map(|at| read(&mut bench, side + at)), [yp, yi, 0.0, 20.0]);
    }
    connect(&mut bench, [4.0, 9.0, 8.0, 9.0]);
    for (number, side, percent, steps) in [(1, 0, 22.0, 7040), (2, 50, 26.0, 8320)] {
        assert_eq!(read(&mut bench, side + OUT_F), percent);
        assert_eq!(read_word(&mut bench, 19 + number), steps);
        assert_eq!(bench.output(&format!("output_{number}")), format!("{:.3} V", percent / 10.0));
    }
    // They are told, and cannot be written.
    bench.check(&[("06 0014 0001", "06 0014 0001")]);
    write(&mut bench, YP, &[1.0, 1.0, 1.0]);
    write(&mut bench, OUT_F, &[1.0, 1.0]);
    assert_eq!([YP, YI, YDT, OUT_F].map(|at| read(&mut bench, at)), [6.0, 16.0, 0.0, 22.0]);
    assert_eq!(read(&mut bench, LIMIT), 9.0);
    assert_eq!(read_word(&mut bench, 20), 7040);
}

#[test]
fn all_of_a_controller_s_settings_reach_it_page_73() {
    for side in [0, 50] {
        let mut bench = controlled();
        write(&mut bench, side + W, &[1.0]);
        // Fp 2, Ti 4, Td 3, T1 4, 0 to 40 %, DeadR 0, DeactY 7 %, InitY 20 %.
        write(&mut bench, side + FP_XP, &[2.0, 4.0, 3.0, 4.0, 0.0, 40.0, 0.0, 7.0, 20.0]);
        let values = |bench: &mut Bench| [YP, YI, YDT, OUT_F].map(|at| read(bench, side + at));
        let step = |bench: &mut Bench, x: f64| {
            connect(bench, [x, 0.0, x, 0.0]);
            values(bench)
        };
        assert_eq!(step(&mut bench, 3.0), [4.0, 17.0, 0.0, 21.0]);
        assert_eq!(step(&mut bench, 4.0), [6.0, 18.5, 1.5, 26.0]);
        assert_eq!(step(&mut bench, 9.0), [16.0, 22.5, 8.625, 40.0]);
        // The derivative of X alone does not see the set point.
        write_word(&mut bench, side + MODE, 0x09);
        step(&mut bench, 9.0);
        let before = values(&mut bench)[2];
        write(&mut bench, side + W, &[5.0]);
        assert_eq!(step(&mut bench, 9.0)[2], before * 0.75);
        // Negated, with a range Xp of 8: Fp = 5.
        write_word(&mut bench, side + MODE, 0x07);
        write(&mut bench, side + FP_XP, &[8.0]);
        assert_eq!(step(&mut bench, 4.0)[0], 5.0);
        // Ymin and the dead range: 25 % is too near to 22 %, 27 % is not.
        let mut bench = controlled();
        write(&mut bench, side + Y_MIN, &[22.0, 100.0, 4.0]);
        assert_eq!(step(&mut bench, 0.0)[3], 22.0);
        assert_eq!(step(&mut bench, 1.5)[3], 22.0);
        assert_eq!(step(&mut bench, 2.5)[3], 27.0);
    }
}

#[test]
fn amin_lifts_pid1_and_bmax_lowers_pid2_where_they_are_released_pages_70_and_73() {
    let mut bench = controlled();
    // Amin and Bmax are ten times the volts of inputs 2 and 4.
    for map in [LCL[2], LCL[3]] {
        write(&mut bench, map, &[0.0, 100.0, 0.0, 10.0]);
    }
    let outputs = |bench: &mut Bench| [bench.output("output_1"), bench.output("output_2")];
    connect(&mut bench, [0.0, 5.0, 0.0, 1.0]);
    assert_eq!([read(&mut bench, LIMIT), read(&mut bench, 50 + LIMIT)], [50.0, 10.0]);
    assert_eq!(outputs(&mut bench), ["2.000 V", "2.000 V"]);
    write_word(&mut bench, MODE, 0x11);
    write_word(&mut bench, 50 + MODE, 0x11);
    bench.wait(ROUND);
    assert_eq!(outputs(&mut bench), ["5.000 V", "1.000 V"]);
    // The other way round they do not matter.
    connect(&mut bench, [0.0, 1.0, 0.0, 5.0]);
    assert_eq!(outputs(&mut bench), ["2.000 V", "2.000 V"]);
}

#[test]
fn many_follows_the_output_and_leads_it_by_hand_page_70() {
    for (number, side) in [(1, 0), (2, 50)] {
        let mut bench = controlled();
        let output = format!("output_{number}");
        connect(&mut bench, [5.0, 0.0, 5.0, 0.0]);
        connect(&mut bench, [6.0, 0.0, 6.0, 0.0]);
        assert_eq!([read(&mut bench, side + MANUAL_Y), read(&mut bench, side + OUT_F)], [22.0, 22.0]);
        // In automatic operation ManY is soon overwritten.
        write(&mut bench, side + MANUAL_Y, &[50.0]);
        bench.wait(ROUND);
        assert_eq!(read(&mut bench, side + MANUAL_Y), 22.0);
        write_word(&mut bench, side + MODE, 0x21);
        connect(&mut bench, [9.0, 0.0, 9.0, 0.0]);
        assert_eq!(bench.output(&output), "2.200 V");
        write(&mut bench, side + MANUAL_Y, &[64.0]);
        bench.wait(ROUND);
        assert_eq!(bench.output(&output), "6.400 V");
        // It goes on from there.
        write_word(&mut bench, side + MODE, 0x01);
        bench.wait(ROUND);
        assert_eq!(bench.output(&output), "6.400 V");
        connect(&mut bench, [10.0, 0.0, 10.0, 0.0]);
        assert_eq!(bench.output(&output), "6.600 V");
    }
}

#[test]
fn an_inactive_controller_gives_deact_y_and_begins_anew_with_init_y_page_70() {
    for (number, side) in [(1, 0), (2, 50)] {
        let mut bench = controlled();
        let output = format!("output_{number}");
        connect(&mut bench, [5.0, 0.0, 5.0, 0.0]);
        write_word(&mut bench, side + MODE, 0x00);
        bench.wait(ROUND);
        assert_eq!(bench.output(&output), "0.700 V");
        connect(&mut bench, [9.0, 0.0, 9.0, 0.0]);
        assert_eq!(bench.output(&output), "0.700 V");
        write_word(&mut bench, side + MODE, 0x01);
        bench.wait(ROUND);
        assert_eq!(bench.output(&output), "2.000 V");
        // The same after a restart, with an output of nothing until then.
        connect(&mut bench, [10.0, 0.0, 10.0, 0.0]);
        assert_eq!(bench.output(&output), "2.200 V");
        bench.act("restart").expect("it restarts");
        assert_eq!(bench.output(&output), "0.000 V");
        bench.wait(ROUND);
        assert_eq!(bench.output(&output), "2.000 V");
    }
}

#[test]
fn an_output_gives_no_more_than_it_can_of_what_a_controller_asks_page_61() {
    let mut bench = controlled();
    write_word(&mut bench, MODE, 0x21);
    for (manual_y, percent, steps) in [(120.0, 102.4, 32_767), (-5.0, 0.0, 0), (102.0, 102.0, 32_640)] {
        write(&mut bench, MANUAL_Y, &[manual_y]);
        bench.wait(ROUND);
        assert_eq!((read(&mut bench, OUT_F), read_word(&mut bench, 20)), (percent, steps));
    }
}

#[test]
fn a_controller_has_the_initial_set_point_from_the_moment_the_watchdog_expires_page_62() {
    let prepared = || {
        let mut bench = controlled();
        write(&mut bench, TI, &[100.0]);
        write(&mut bench, INIT_W, &[4.0]);
        bench.act("input 1 volts 5").expect("a signal");
        bench.check(&[("06 0042 00FA", "06 0042 00FA")]);
        bench
    };
    // Looking at an output feeds nothing.
    let (mut looked_at, mut left_alone) = (prepared(), prepared());
    for _ in 0..200 {
        looked_at.wait(100);
        looked_at.output("output_1");
    }
    left_alone.wait(20_000);
    assert_eq!(looked_at.output("output_1"), left_alone.output("output_1"));
    // Yi begins with 20 - 10 %. Two steps with W = 0 add 0.1 % each, eighteen with W = 4 0.02 % each.
    assert_eq!(left_alone.output("red_light"), "ON");
    near(&mut left_alone, W, 4.0);
    let told = read(&mut left_alone, YI);
    assert!((told - 10.56).abs() < 0.001, "{told}");
}

#[test]
fn a_controller_goes_on_whether_or_not_it_is_asked_page_72() {
    // Fp = 1, Ti = 100 s, Xw = 5: 0.05 % in each second, so 30 % in ten minutes.
    let prepared = || {
        let mut bench = controlled();
        write(&mut bench, FP_XP, &[1.0, 100.0]);
        bench.act("input 1 volts 5").expect("a signal");
        bench
    };
    let (mut asked, mut left_alone) = (prepared(), prepared());
    for _ in 0..6000 {
        asked.wait(100);
        asked.ask("03 0082 000E");
    }
    left_alone.wait(600_000);
    let values = "03 0082 000E";
    assert_eq!(asked.ask(values), left_alone.ask(values));
    let told = read(&mut left_alone, OUT_F);
    assert!((told - 50.0).abs() < 0.01, "{told}");
}

#[test]
fn a_negated_controller_heats_a_room_to_its_set_point_page_73() {
    let mut bench = bench();
    // PT1000 in degrees, the factory's controller but for a short Ti, and a set point by the bus.
    bench.check(&[("06 0010 0084", "06 0010 0084"), ("10 0064 0001 02 0022", "10 0064 0001")]);
    write(&mut bench, TI, &[60.0]);
    write(&mut bench, W, &[21.0]);
    // A room that full heating would take from 10 to 40 °C, and half of the way in about a minute.
    let mut room = 10.0;
    for _ in 0..1800 {
        bench.act(&format!("input 1 celsius {room}")).expect("a signal");
        bench.wait(ROUND);
        let percent = f64::from(read(&mut bench, OUT_F));
        assert!((0.0..=100.0).contains(&percent), "{percent}");
        room += (10.0 + 0.3 * percent - room) / 90.0;
    }
    assert!((room - 21.0).abs() < 0.05, "{room} °C");
}
