//! The guard of an RTU line and units that answer late, or not while they are waited for.

use super::*;

#[test]
fn after_a_probe_the_line_waits_only_as_long_as_that_unit_has_come_late_before() {
    let probe = || Request { is_probe: true, ..two_inputs() };
    let mut scene = Scene::without_echo();
    scene.ask(&probe());
    scene.expect("no answer", Err(RequestError::Timeout));
    // Another unit is asked at once; the late reply meets its request and is told apart.
    let other = read(2, Table::Input, 0, 2);
    let given_up_at = scene.now;
    scene.ask(&other);
    assert!(scene.now - given_up_at <= whole_micros(LINE.frame_gap()), "{:?}", scene.now - given_up_at);
    scene.wait(5).hears(framed("01 04 04 00 63 00 63")).wait(20).hears(framed("02 04 04 00 01 00 02"));
    assert_eq!(scene.expect("the other", words(&[1, 2])), counts([0, 1, 0, 0, 0]));

    // One that is heard between two requests says how late that unit is.
    scene.ask(&probe());
    scene.expect("no answer", Err(RequestError::Timeout));
    scene.wait(30).hears(framed("01 04 04 00 63 00 63"));
    scene.ask(&probe());
    let due = scene.now + LINE.characters(8) + TIMEOUT;
    scene.expect("no answer again", Err(RequestError::Timeout));
    assert_eq!(scene.guard.begin(scene.now, &other, TIMEOUT), None);
    assert_eq!(scene.guard.earliest_send(scene.now), due + Duration::from_millis(60));
}

#[test]
fn a_unit_that_has_answered_late_is_waited_for_longer() {
    // By how much it is late, and how long it is waited for then.
    for (late, expected) in [(40, 260), (120, 380), (190, 400)] {
        let mut scene = Scene::without_echo();
        scene.ask(&two_inputs());
        scene.expect("no answer", Err(RequestError::Timeout));
        scene.wait(late).hears(framed("01 04 04 00 63 00 63"));
        // Another unit is not.
        for (request, wait) in [(two_inputs(), expected), (read(2, Table::Input, 0, 2), 200)] {
            scene.ask(&request);
            let sent_at = scene.now + LINE.characters(8);
            scene.expect("no answer", Err(RequestError::Timeout));
            assert_eq!(
                scene.now - sent_at,
                Duration::from_millis(wait),
                "{late} ms late, unit {}",
                request.unit
            );
            scene.wait(1000);
        }
        scene.ask(&two_inputs()).wait(150 + late).hears(framed("01 04 04 00 01 00 02"));
        scene.expect("in time, since it is known", words(&[1, 2]));
    }
}

#[test]
fn a_quick_unit_that_does_not_answer_is_left_alone_while_others_are_asked() {
    let full = Duration::from_millis(500);
    let hurried = || Request { may_take: Some(full), ..two_inputs() };
    let other = read(2, Table::Input, 0, 2);
    let stale = framed("01 04 04 00 63 00 63");
    let unanswered = || {
        let mut scene = Scene::without_echo();
        scene.ask(&hurried());
        let transmitted_at = scene.now + LINE.characters(8);
        scene.expect("no answer", Err(RequestError::Timeout));
        assert_eq!(scene.now, transmitted_at + TIMEOUT);
        // Another unit is asked at once, and a late reply told apart from its answer.
        assert_eq!(scene.guard.begin(scene.now, &other, TIMEOUT), None);
        assert!(scene.guard.earliest_send(scene.now) <= scene.now + whole_micros(LINE.frame_gap()));
        (scene, transmitted_at)
    };
    let (mut scene, transmitted_at) = unanswered();
    scene.ask(&other).wait(5).hears(stale.clone()).wait(20).hears(framed("02 04 04 00 01 00 02"));
    let (reply, _) = scene.reply();
    assert_eq!(reply.result, words(&[1, 2]));
    let late = reply.discarded.late.expect("whose reply was late");
    assert_eq!(late.unit, 1);
    assert!(late.after > TIMEOUT && late.after < TIMEOUT + Duration::from_millis(20), "{late:?}");
    // Nothing else is known of it then, so it is left alone for as long as ever.
    assert_eq!(scene.guard.begin(scene.now, &two_inputs(), TIMEOUT), None);
    assert_eq!(scene.guard.earliest_send(scene.now), transmitted_at + full * 2);

    // A late reply that is heard between two requests ends its rest.
    let (mut scene, _) = unanswered();
    scene.wait(60).hears(stale);
    assert_eq!(scene.guard.begin(scene.now, &two_inputs(), TIMEOUT), None);
    assert_eq!(scene.guard.earliest_send(scene.now), scene.now + whole_micros(LINE.frame_gap()));
    // It came within the time that it may take, so that it is waited for no longer than that.
    assert_eq!(scene.guard.overdue.more_time(1, full), Duration::ZERO);
}
