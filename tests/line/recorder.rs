//! The flight recorder of the whole program: a line misbehaves, and the file says what was on it. What
//! Wireshark makes of such files is `make test-wireshark`.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::{Value, json};

use crate::pcapng::{self, Packet, Pcapng};
use crate::peer::{Framing, Peer, Step, lie, read_pdu, reply, rtu};
use crate::support::wait_for;
use crate::{MIXED, Stage, changed};

/// Units 1 and 2 have given their first values, a command was obeyed, and then unit 1 has sent a damaged
/// answer and been silent once.
fn trouble(peer: &Peer) -> Stage {
    let stage = Stage::start(peer, MIXED);
    stage.watcher.shows("busker/one/a", "100");
    stage.watcher.shows("busker/two/a", "700");
    stage.watcher.shows("busker/one/relay", "OFF");
    assert_eq!(stage.set_relay("ON")["outcome"], "done");
    if peer.link().contains("tcp: ") && !peer.link().contains("rtu") {
        peer.misbehave_once(1, 4, 0, |asked, _| {
            vec![Step::Say(reply(asked, Framing::Tcp, &read_pdu(4, &[9999, 9999])))]
        });
    } else {
        peer.misbehave_once(1, 4, 0, |asked, _| {
            vec![
                Step::Say(vec![0xFF, 0x00]),
                Step::Pause(5),
                Step::Say(changed(lie(asked), |frame| frame[6] ^= 0x10)),
            ]
        });
    }
    wait_for("the misbehaviour", || peer.has_misbehaved().then_some(()));
    peer.hold(1, 4, 0, 101);
    stage.watcher.shows("busker/one/a", "101");
    peer.misbehave_once(1, 4, 100, |_, _| vec![]);
    wait_for("the silence", || peer.has_misbehaved().then_some(()));
    peer.hold(1, 4, 100, 501);
    stage.watcher.shows("busker/one/b", "501");
    stage
}

fn record(stage: &Stage, request: &Value) -> Value {
    let from = stage.watcher.count();
    stage.watcher.publish("busker/bridge/request/record", &request.to_string());
    let answer = stage.watcher.wait_for_next("busker/bridge/response/record", from);
    serde_json::from_str(&answer).expect("an answer is JSON")
}

/// The file of a request, and where it is.
fn recorded(stage: &Stage) -> (Pcapng, PathBuf) {
    let answer = record(stage, &json!({"bus": "line", "transaction": 7}));
    assert_eq!((&answer["status"], &answer["transaction"]), (&json!("ok"), &json!(7)), "{answer}");
    let path = PathBuf::from(answer["data"]["file"].as_str().expect("a path"));
    assert!(path.starts_with(stage.gateway.state().join("recordings")), "{}", path.display());
    let file = pcapng::read(&fs::read(&path).expect("the file is there"));
    assert_eq!(answer["data"]["frames"], file.packets.len(), "{answer}");
    (file, path)
}

/// The first packet with this note.
fn noted<'p>(file: &'p Pcapng, note: &str) -> &'p Packet {
    let mut packets = file.packets.iter();
    let found = packets.find(|packet| packet.comments.iter().any(|comment| comment == note));
    found.unwrap_or_else(|| {
        let comments: Vec<&String> = file.packets.iter().flat_map(|packet| &packet.comments).collect();
        panic!("no packet says `{note}`, but {comments:?}")
    })
}

/// The first packet that ends in these bytes, and the one behind it.
fn asked<'p>(file: &'p Pcapng, question: &[u8]) -> (&'p Packet, &'p Packet) {
    let first = file.packets.windows(2).find(|pair| pair[0].bytes.ends_with(question));
    first.map(|pair| (&pair[0], &pair[1])).unwrap_or_else(|| panic!("no packet is {question:?}"))
}

fn check_order(file: &Pcapng) {
    assert!(file.packets.len() > 12, "{} packets", file.packets.len());
    assert!(file.packets.windows(2).all(|pair| pair[0].time <= pair[1].time), "in the order of their times");
    let in_2020 = 1_577_836_800_000_000;
    assert!(file.packets[0].time > in_2020, "the time of day");
}

#[test]
fn what_was_on_a_serial_line_is_saved_on_request_with_what_was_wrong_with_it() {
    let peer = Peer::on_a_pseudo_terminal();
    let stage = trouble(&peer);
    let (file, _) = recorded(&stage);
    let link = format!("serial {} 115200 8N1", peer.path().display());
    assert_eq!((file.link_type, file.interface.as_str(), &file.description), (252, "line", &link));
    assert_eq!(file.comment, format!("bus line, {link}: on request"));
    check_order(&file);

    assert_eq!(file.packets[0].comments, ["the link is up"]);
    let (first, second) = asked(&file, &rtu(1, &[4, 0, 0, 0, 1]));
    assert_eq!((first.is_outbound, second.is_outbound), (true, false));
    assert_eq!((&second.bytes, &second.comments), (&rtu(1, &[4, 2, 0, 100]), &vec![]));
    let (us, unit) = ([127, 0, 0, 1], [0, 0, 0, 1]);
    assert_eq!([12, 20, 21].map(|tag| first.tag(tag)), [&b"mbrtu\0\0\0"[..], &us, &unit]);
    assert_eq!([12, 20, 21].map(|tag| second.tag(tag)), [&b"mbrtu\0\0\0"[..], &unit, &us]);

    assert_eq!(noted(&file, "noise").bytes, [0xFF, 0x00]);
    let damaged = noted(&file, "damaged: wrong checksum");
    assert_eq!((damaged.bytes.len(), &damaged.bytes[..2], damaged.is_outbound), (7, &[1, 4][..], false));
    assert_eq!(noted(&file, "no answer but a damaged one").bytes, rtu(1, &[4, 0, 0, 0, 1]));
    assert_eq!(noted(&file, "no answer in time").bytes, rtu(1, &[4, 0, 100, 0, 1]));
}

#[test]
fn what_was_on_a_connection_is_saved_on_request_with_what_was_wrong_with_it() {
    let peer = Peer::on_tcp(Framing::Tcp);
    let stage = trouble(&peer);
    let (file, _) = recorded(&stage);
    assert_eq!((file.link_type, file.interface.as_str()), (252, "line"));
    check_order(&file);
    let (first, second) = asked(&file, &[1, 4, 0, 0, 0, 1]);
    assert_eq!(second.bytes, [&first.bytes[..4], &[0, 5, 1, 4, 2, 0, 100]].concat());
    assert_eq!((first.tag(12), first.is_outbound, second.is_outbound), (&b"mbtcp\0\0\0"[..], true, false));
    assert_eq!(noted(&file, "no answer in time").bytes[6..], [1, 4, 0, 100, 0, 1]);
    let wrong = noted(&file, "no answer that fits");
    assert_eq!((&wrong.bytes[6..], wrong.is_outbound), (&[1, 4, 0, 0, 0, 1][..], true));
}

#[test]
fn over_http_there_is_the_same_without_a_file() {
    let peer = Peer::on_tcp(Framing::Rtu);
    let stage = trouble(&peer);
    let path = "/api/buses/line/frames.pcapng";
    let (bytes, name) = stage.gateway.download(path, "content-disposition").expect("a download");
    assert!(name.starts_with("attachment; filename=\"line-20") && name.ends_with("Z.pcapng\""), "{name}");
    let file = pcapng::read(&bytes);
    assert!(file.comment.ends_with(": on request over HTTP"), "{}", file.comment);
    check_order(&file);
    noted(&file, "no answer in time");
    noted(&file, "damaged: wrong checksum");
    assert_eq!(file.packets[0].tag(12), b"mbrtu\0\0\0");
    assert!(stage.gateway.get("/api/buses/roof/frames.pcapng").1.contains("no such bus"));
}

#[test]
fn something_that_goes_wrong_leaves_a_file_by_itself_and_not_one_for_each() {
    let peer = Peer::on_a_pseudo_terminal();
    let stage = trouble(&peer);
    let folder = stage.gateway.state().join("recordings");
    let files = || names(&folder).into_iter().filter(|name| name.ends_with(".pcapng")).collect::<Vec<_>>();
    let name = wait_for("a recording", || files().pop());
    let line = stage.gateway.wait_for_log(&name);
    assert!(line.contains("bus line: a damaged answer, while one was asked; the last "), "{line}");
    let file = pcapng::read(&fs::read(folder.join(&name)).expect("the file is there"));
    assert!(file.comment.ends_with(": a damaged answer, while one was asked"), "{}", file.comment);
    let damaged = file.packets.iter().position(|packet| packet.comments == ["damaged: wrong checksum"]);
    let behind = file.packets.len() - damaged.expect("the damaged frame");
    assert!(behind > 10, "what followed is in it too, and not only {behind} frames");
    // The silence that came after it is too soon for another.
    recorded(&stage);
    assert_eq!(files().len(), 2, "{:?}", files());
}

#[test]
fn what_is_turned_off_is_not_recorded() {
    let peer = Peer::on_a_pseudo_terminal();
    let stage = Stage::start_with(&peer, "recorder: {kilobytes: 0}\n", MIXED);
    stage.watcher.shows("busker/one/a", "100");
    let answer = record(&stage, &json!({"device": "one"}));
    let reason = "nothing is recorded; the configuration says `kilobytes: 0` under `recorder`";
    assert_eq!((&answer["status"], &answer["error"]), (&json!("error"), &json!(reason)), "{answer}");
    let told = stage.gateway.get("/api/buses/line/frames.pcapng");
    assert_eq!(told.1.trim(), reason);
    assert!(!stage.gateway.state().join("recordings").exists());
}

fn names(folder: &Path) -> Vec<String> {
    let Ok(entries) = fs::read_dir(folder) else { return Vec::new() };
    entries.flatten().map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
}

/// What tshark tells of these fields, a line for each packet and a tab between two fields.
fn tshark(file: &Path, options: &[&str], fields: &[&str]) -> Vec<Vec<String>> {
    let mut command = Command::new("tshark");
    command.arg("-r").arg(file).args(options).args(["-T", "fields", "-E", "occurrence=a"]);
    for field in fields {
        command.args(["-e", field]);
    }
    let output = command.output().expect("tshark is installed; `make test-wireshark` installs it");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).expect("a text");
    text.lines().map(|line| line.split('\t').map(str::to_owned).collect()).collect()
}

/// How many packets tell exactly this.
fn count(packets: &[Vec<String>], expected: &[&str]) -> usize {
    packets.iter().filter(|packet| *packet == expected).count()
}

#[test]
#[ignore = "needs tshark, 128 MB: `make test-wireshark`"]
fn wireshark_reads_a_serial_line_and_its_checksums() {
    let peer = Peer::on_a_pseudo_terminal();
    let stage = trouble(&peer);
    let (file, path) = recorded(&stage);
    // As it opens: everything but the checksums, and which way a write of one coil goes.
    let fields = [
        "ip.src",
        "ip.dst",
        "modbus.func_code",
        "modbus.reference_num",
        "modbus.word_cnt",
        "modbus.regval_uint16",
        "_ws.col.Protocol",
    ];
    let packets = tshark(&path, &[], &fields);
    assert_eq!(packets.len(), file.packets.len());
    let question = ["127.0.0.1", "0.0.0.1", "4", "0", "1", "", "Modbus RTU"];
    assert!(count(&packets, &question) > 2, "{packets:?}");
    assert!(count(&packets, &["0.0.0.1", "127.0.0.1", "4", "", "", "100", "Modbus RTU"]) > 0, "{packets:?}");
    assert!(count(&packets, &["0.0.0.2", "127.0.0.1", "4", "", "", "700", "Modbus RTU"]) > 0, "{packets:?}");
    // With its one setting.
    let fields = ["mbrtu.crc16.status", "frame.comment", "mbrtu.unit_id"];
    let packets = tshark(&path, &["-o", "mbrtu.crc_verification:TRUE"], &fields);
    assert_eq!(count(&packets, &["0", "damaged: wrong checksum", "1"]), 1, "{packets:?}");
    let bad: Vec<_> = packets.iter().filter(|packet| packet[0] == "0").collect();
    assert_eq!(bad.len(), 1, "{bad:?}");
    assert_eq!(count(&packets, &["", "noise", ""]), 1, "{packets:?}");
    assert!(count(&packets, &["1", "", "2"]) > 2, "{packets:?}");
    assert_eq!(count(&packets, &["1", "no answer in time", "1"]), 1, "{packets:?}");
}

#[test]
#[ignore = "needs tshark, 128 MB: `make test-wireshark`"]
fn wireshark_reads_modbus_tcp() {
    let peer = Peer::on_tcp(Framing::Tcp);
    let stage = trouble(&peer);
    let (file, path) = recorded(&stage);
    let fields = [
        "_ws.col.Protocol",
        "mbtcp.trans_id",
        "mbtcp.unit_id",
        "modbus.func_code",
        "modbus.regval_uint16",
        "frame.comment",
    ];
    let packets = tshark(&path, &[], &fields);
    assert_eq!(packets.len(), file.packets.len());
    assert_eq!(packets[0][5], "the link is up");
    let answer = packets.iter().find(|packet| packet[4] == "100").expect("the first value");
    assert_eq!((answer[0].as_str(), answer[2].as_str(), answer[3].as_str()), ("Modbus/TCP", "1", "4"));
    let silent = packets.iter().filter(|packet| packet[5] == "no answer in time" && packet[3] == "4").count();
    assert_eq!(silent, 1, "{packets:?}");
    let info = tshark(&path, &["-Y", "modbus.func_code == 5"], &["_ws.col.Info"]);
    let ways: Vec<&str> =
        info.iter().map(|line| line[0].trim().split(':').next().unwrap_or_default()).collect();
    assert_eq!(ways, ["Query", "Response"], "{info:?}");
}
