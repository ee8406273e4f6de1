//! Requests as bytes and bytes as answers, checked against the specification's own examples.

use super::*;

/// Bytes from text such as `03 00 6B`.
fn bytes(text: &str) -> Vec<u8> {
    let byte = |part| u8::from_str_radix(part, 16).expect("two hexadecimal digits");
    text.split_whitespace().map(byte).collect()
}

fn read(table: Table, first: u16, count: u16) -> Call {
    Call::Read(Span::with_count(table, first, count).expect("a span"))
}

fn check(call: &Call, request: &str, reply: &str, answer: Result<Answer, RequestError>) {
    assert_eq!(encode(call), Ok(bytes(request)), "{call}");
    let reply = bytes(reply);
    assert_eq!(decode(call, false, &reply), answer, "{call}");
    if answer.is_err() {
        return;
    }
    assert_eq!(reply_length(call, false, &reply), Length::Whole(reply.len()), "{call}");
    for end in 0..reply.len() {
        let beginning = &reply[..end];
        assert_eq!(decode(call, false, beginning), Err(RequestError::WrongFrame), "{call}, {end} bytes");
        let length = reply_length(call, false, beginning);
        let fits = length == Length::Unknown || length == Length::Whole(reply.len());
        assert!(fits, "{call}: {length:?} from {end} bytes");
    }
    let longer = [&reply[..], &[0]].concat();
    assert_eq!(decode(call, false, &longer), Err(RequestError::WrongFrame), "{call}, a byte more");
}

#[test]
fn the_examples_of_the_specification_are_sent_and_understood() {
    // Modbus application protocol V1.1b3, the tables of sections 6.1 to 6.21.
    let bits = |text: &str| Ok(Answer::Bits(text.chars().map(|bit| bit == '1').collect()));
    check(&read(Table::Coil, 0x13, 0x13), "01 00 13 00 13", "01 03 CD 6B 05", bits("1011001111010110101"));
    check(
        &read(Table::Discrete, 0xC4, 0x16),
        "02 00 C4 00 16",
        "02 03 AC DB 35",
        bits("0011010111011011101011"),
    );
    check(
        &read(Table::Holding, 0x6B, 3),
        "03 00 6B 00 03",
        "03 06 02 2B 00 00 00 64",
        Ok(Answer::Words(vec![0x022B, 0, 0x64])),
    );
    check(&read(Table::Input, 8, 1), "04 00 08 00 01", "04 02 00 0A", Ok(Answer::Words(vec![10])));
    check(
        &Call::WriteCoil { address: 0xAC, on: true },
        "05 00 AC FF 00",
        "05 00 AC FF 00",
        Ok(Answer::Written),
    );
    check(
        &Call::WriteRegister { address: 1, word: 3 },
        "06 00 01 00 03",
        "06 00 01 00 03",
        Ok(Answer::Written),
    );
    check(
        &Call::Diagnostics { function: 0, data: vec![0xA537] },
        "08 00 00 A5 37",
        "08 00 00 A5 37",
        Ok(Answer::Diagnostics(vec![0xA537])),
    );
    check(
        &Call::Diagnostics { function: 11, data: vec![0] },
        "08 00 0B 00 00",
        "08 00 0B 01 02",
        Ok(Answer::Diagnostics(vec![0x0102])),
    );
    let values = "1011001110".chars().map(|bit| bit == '1').collect();
    check(
        &Call::WriteCoils { address: 0x13, values },
        "0F 00 13 00 0A 02 CD 01",
        "0F 00 13 00 0A",
        Ok(Answer::Written),
    );
    check(
        &Call::WriteRegisters { address: 1, words: vec![0x0A, 0x0102] },
        "10 00 01 00 02 04 00 0A 01 02",
        "10 00 01 00 02",
        Ok(Answer::Written),
    );
    check(&Call::ReportServerId, "11", "11 03 41 42 FF", Ok(Answer::ServerId(vec![0x41, 0x42, 0xFF])));
    check(
        &Call::ReadIdentification { code: 1, object: 0 },
        "2B 0E 01 00",
        "2B 0E 01 01 FF 02 02 00 02 4D 43 01 03 44 4F 34",
        Ok(Answer::Identification(Identification {
            conformity: 1,
            next: Some(2),
            objects: vec![(0, "MC".into()), (1, "DO4".into())],
        })),
    );
}

#[test]
fn whatever_is_not_exactly_the_answer_is_refused() {
    let input = read(Table::Input, 8, 1);
    let coil = Call::WriteCoil { address: 1, on: true };
    let words = Call::WriteRegisters { address: 1, words: vec![1, 2] };
    let echo = Call::Diagnostics { function: 0, data: vec![0xA537] };
    let names = Call::ReadIdentification { code: 1, object: 0 };
    for (call, what, reply) in [
        (&input, "nothing", ""),
        (&input, "another function", "03 02 00 0A"),
        (&input, "another count", "04 04 00 0A 00 0B"),
        (&input, "a byte count that lies", "04 02 00"),
        (&input, "an exception without a code", "84"),
        (&input, "an exception of another function", "83 02"),
        (&coil, "another coil", "05 00 02 FF 00"),
        (&coil, "off for on", "05 00 01 00 00"),
        (&words, "another quantity", "10 00 01 00 01"),
        (&words, "another address", "10 00 02 00 02"),
        (&echo, "another sub-function", "08 00 01 A5 37"),
        (&echo, "another echo", "08 00 00 A5 36"),
        (&names, "another code", "2B 0E 02 01 00 00 00"),
        (&names, "an object cut short", "2B 0E 01 01 00 00 01 00 04 4D"),
        (&names, "neither the last nor more", "2B 0E 01 01 07 00 00"),
        (&Call::ReportServerId, "a byte count that lies", "11 04 41 42 FF"),
    ] {
        assert_eq!(decode(call, false, &bytes(reply)), Err(RequestError::WrongFrame), "{call}: {what}");
    }
}

#[test]
fn an_exception_is_an_answer_and_another_functions_only_where_the_device_is_known_for_it() {
    let call = Call::WriteRegister { address: 0, word: 99 };
    assert_eq!(decode(&call, false, &[0x86, 3]), Err(RequestError::Exception(3)));
    assert_eq!(decode(&call, false, &[0x84, 3]), Err(RequestError::WrongFrame));
    assert_eq!(reply_length(&call, false, &[0x84]), Length::Never);
    assert_eq!(decode(&call, true, &[0x84, 3]), Err(RequestError::Exception(3)));
    assert_eq!(reply_length(&call, true, &[0x84]), Length::Whole(2));
}

#[test]
fn what_no_frame_can_hold_is_not_asked() {
    for (call, possible) in [
        (read(Table::Input, 0, 125), true),
        (read(Table::Input, 0, 126), false),
        (read(Table::Coil, 0, 2000), true),
        (read(Table::Coil, 0, 2001), false),
        (Call::WriteRegisters { address: 0, words: vec![0; 123] }, true),
        (Call::WriteRegisters { address: 0, words: vec![0; 124] }, false),
        (Call::WriteRegisters { address: 0, words: vec![] }, false),
        (Call::WriteRegisters { address: 65535, words: vec![0; 2] }, false),
        (Call::WriteCoils { address: 0, values: vec![true; 1968] }, true),
        (Call::WriteCoils { address: 0, values: vec![true; 1969] }, false),
        (Call::Diagnostics { function: 0, data: vec![0; 125] }, true),
        (Call::Diagnostics { function: 0, data: vec![0; 126] }, false),
    ] {
        assert_eq!(encode(&call).is_ok(), possible, "{call}");
        assert!(encode(&call).map_or(0, |pdu| pdu.len()) <= LENGTH_MAX, "{call}");
    }
}
