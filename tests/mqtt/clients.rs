//! Clients that do what a well-behaved one does not.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::thread::JoinHandle;

use rumqttc::{Client, Event, MqttOptions, Packet, QoS};

use crate::support::Broker;

/// Connects as `client_id` with a session that the broker shall keep, subscribes, and goes.
pub fn leave_a_session(broker: &Broker, client_id: &str, filter: &str) {
    let mut options = MqttOptions::new(client_id, broker.address, broker.port);
    options.set_clean_session(false);
    let (client, mut connection) = Client::new(options, 10);
    client.subscribe(filter, QoS::AtLeastOnce).expect("there is room");
    for event in connection.iter() {
        match event.expect("the broker is there") {
            Event::Incoming(Packet::SubAck(_)) => client.disconnect().expect("there is room"),
            Event::Outgoing(rumqttc::Outgoing::Disconnect) => return,
            _ => {}
        }
    }
}

/// Comes to a broker that does not answer yet, and publishes as soon as it is let in. By hand, since a
/// client library would not wait here until it stands in the broker's queue.
pub fn queue_up(broker: &Broker, topic: &str, payload: &str) -> JoinHandle<()> {
    let mut stream = TcpStream::connect((broker.address, broker.port)).expect("the system takes it");
    // CONNECT: MQTT 3.1.1, a clean session, a minute's keep-alive, the identifier `late`.
    let connect = [b"\x10\x10\0\x04MQTT\x04\x02\0\x3c\0\x04late".as_slice()].concat();
    stream.write_all(&connect).expect("the system takes it");
    let length = u8::try_from(2 + topic.len() + payload.len()).expect("a short message");
    let publish = [&[0x30, length, 0, topic.len() as u8], topic.as_bytes(), payload.as_bytes()].concat();
    std::thread::spawn(move || {
        let mut let_in = [0; 4];
        stream.read_exact(&mut let_in).expect("the broker lets it in");
        stream.write_all(&publish).expect("it is published");
    })
}
