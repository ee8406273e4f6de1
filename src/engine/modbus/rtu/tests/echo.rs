//! The guard of an RTU line that returns what we send, or seems to.

use super::super::echo::MISSED_MAX;
use super::*;

#[test]
fn an_echo_is_skipped_and_no_write_is_confirmed_by_it() {
    let echo = |request: &Request| {
        frame(request.unit, &pdu::encode(&request.call).expect("a request that can be asked"))
    };
    let read_echo = echo(&two_inputs());
    let relay = echo(&set_relay());
    let good = framed("01 04 04 00 01 00 02");

    let mut scene = Scene::new();
    scene.ask(&two_inputs()).hears(read_echo.clone()).wait(9).hears(good.clone());
    assert_eq!(scene.expect("a read with an echo", words(&[1, 2])), counts([0, 0, 0, 1, 0]));
    scene.ask(&set_relay()).wait(4).hears(relay.clone());
    assert_eq!(scene.expect("only the echo", Err(RequestError::Timeout)), counts([0, 0, 0, 1, 0]));
    scene.ask(&set_relay()).wait(4).hears(relay.clone()).wait(9).hears(relay.clone());
    assert_eq!(scene.expect("echo and confirmation", Ok(Answer::Written)), counts([0, 0, 0, 1, 0]));
    scene.ask(&set_relay()).wait(4).hears([relay.clone(), relay.clone()].concat());
    assert_eq!(scene.expect("both at once", Ok(Answer::Written)), counts([0, 0, 0, 1, 0]));
    scene.ask(&set_relay()).wait(4).hears(relay.clone()).wait(9).hears(framed("01 85 02"));
    assert_eq!(scene.expect("refused", Err(RequestError::Exception(2))), counts([0, 0, 0, 1, 0]));
    scene.ask(&two_inputs()).hears(read_echo);
    assert_eq!(scene.expect("a dead unit", Err(RequestError::Timeout)), counts([0, 0, 0, 1, 0]));

    // Where nothing is known of the line, one early copy confirms nothing, a second does.
    let mut scene = Scene::new();
    scene.ask(&set_relay()).wait(2).hears(relay.clone());
    scene.expect("unknown line", Err(RequestError::Timeout));
    scene.ask(&set_relay()).wait(2).hears(relay.clone()).wait(9).hears(relay.clone());
    scene.expect("unknown line, two copies", Ok(Answer::Written));
    let mut scene = Scene::new();
    scene.ask(&set_relay()).wait(60).hears(relay.clone());
    scene.expect("unknown line, too late for an echo", Ok(Answer::Written));

    // Where the line is known to return nothing, the first copy is the confirmation.
    let mut scene = Scene::without_echo();
    scene.ask(&set_relay()).wait(2).hears(relay);
    assert_eq!(scene.expect("no echo", Ok(Answer::Written)), counts([0; 5]));
}

/// A line that is known to return what we send.
fn with_echo() -> Scene {
    let mut scene = Scene::new();
    let echo = frame(1, &pdu::encode(&two_inputs().call).expect("a request that can be asked"));
    scene.ask(&two_inputs()).hears(echo).wait(9).hears(framed("01 04 04 00 07 00 08"));
    scene.expect("the first reading", words(&[7, 8]));
    scene
}

#[test]
fn where_the_line_returns_what_we_send_something_else_is_a_collision_and_nobody_is_believed() {
    let echo = frame(1, &pdu::encode(&two_inputs().call).expect("a request that can be asked"));
    let mut damaged = echo.clone();
    damaged[3] ^= 0x41;
    let reply = framed("01 04 04 00 63 00 63");
    let other = framed("01 04 00 64 00 02");
    for (what, request, bytes) in [
        ("a damaged echo", two_inputs(), damaged.clone()),
        ("half an echo", two_inputs(), echo[..5].to_vec()),
        ("a damaged echo and a reply that fits", two_inputs(), [damaged.clone(), reply.clone()].concat()),
        ("another's request instead", two_inputs(), other.clone()),
        ("another's request and its reply", two_inputs(), [other, reply.clone()].concat()),
        ("a damaged echo of a write", set_relay(), damaged),
        ("a broadcast", Request::new(0, Call::WriteRegister { address: 5, word: 1 }), raw("00 06 00")),
    ] {
        let mut scene = with_echo();
        scene.ask(&request).wait(4).hears(bytes);
        let counted = scene.expect(what, Err(RequestError::Collision));
        let (noise, damaged) = (counted.noise_bytes, counted.checksum_errors);
        assert_eq!((noise, damaged), (0, 0), "{what}: it is counted as a collision");
        assert!(scene.now - scene.sent_at <= Duration::from_millis(150), "{what}: told at once");
        // A reply that still comes is late.
        scene.wait(60).hears(reply.clone());
        scene.ask(&two_inputs()).hears(echo.clone()).wait(9).hears(framed("01 04 04 00 2A 00 2B"));
        scene.expect(what, words(&[42, 43]));
    }

    // Noise beside a whole echo is only noise.
    for bytes in [[vec![0], echo.clone()].concat(), [echo.clone(), vec![0]].concat()] {
        let mut scene = with_echo();
        scene.ask(&two_inputs()).wait(4).hears([bytes, framed("01 04 04 00 01 00 02")].concat());
        assert_eq!(scene.expect("noise", words(&[1, 2])), counts([1, 0, 0, 1, 0]));
    }
}

#[test]
fn a_line_that_no_longer_returns_what_we_send_is_learnt_anew() {
    // The reply stands alone: so the echo is gone.
    let mut scene = with_echo();
    scene.expect_the_next_reading_right("another adapter");
    assert!(!scene.guard.echo.is_possible());

    // Noise before each reply looks like a damaged echo, but not for ever.
    let mut scene = with_echo();
    for _ in 0..MISSED_MAX {
        scene.ask(&two_inputs()).wait(4).hears(vec![0]).wait(4).hears(framed("01 04 04 00 01 00 02"));
        scene.expect("noise first", Err(RequestError::Collision));
        scene.wait(500);
    }
    scene.ask(&two_inputs()).wait(4).hears(vec![0]).wait(4).hears(framed("01 04 04 00 01 00 02"));
    scene.expect("noise first", words(&[1, 2]));
    assert!(!scene.guard.echo.is_possible());

    // An echo now and then is enough to keep it known.
    let mut scene = with_echo();
    let echo = scene.guard.frame().to_vec();
    for round in 0..9 {
        scene.ask(&two_inputs()).wait(4).hears(if round % 2 == 0 { vec![0] } else { echo.clone() });
        let _ = scene.reply();
    }
    assert!(scene.guard.echo.is_certain());
}
