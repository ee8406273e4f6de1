//! Why a connection was not made or is lost, in words for people; and of which kind it is.

use rumqttc::mqttbytes::Error as PacketError;
use rumqttc::{ConnectReturnCode, ConnectionError, StateError, TlsError};

use super::PACKET_BYTES_MAX;
use crate::edge::tls;
use crate::engine::connection::Loss;

/// Whose connection it is, as a log names it.
pub(super) struct Ends {
    pub address: String,
    pub client_id: String,
    pub base_topic: String,
    /// Whether it goes through one.
    pub websocket: bool,
}

impl Ends {
    /// Somebody else takes this gateway's place again and again.
    pub fn contested(&self) -> String {
        let Ends { address, client_id, base_topic, .. } = self;
        format!(
            "the broker at {address} lets this gateway in and closes the connection, again and again: most likely \
             another client has the identifier `{client_id}` too, as a second gateway with `base_topic: {base_topic}` \
             has, or with one that differs from it only where an identifier has `_`. Each needs a base topic of its \
             own; this one tries again after growing pauses"
        )
    }

    /// Why it could not be made, or is lost. Without credentials, since the library's errors hold none.
    pub fn reason(&self, error: &ConnectionError, was_made: bool) -> String {
        let Ends { address, client_id, .. } = self;
        if let Some(advice) = rustls_error(error).and_then(tls::advice) {
            return format!("no TLS with the broker at {address}: {advice} ({})", told(error));
        }
        match error {
            ConnectionError::ConnectionRefused(
                ConnectReturnCode::BadUserNamePassword | ConnectReturnCode::NotAuthorized,
            ) => format!("the broker at {address} refuses this user name and password"),
            ConnectionError::ConnectionRefused(code) => format!("the broker at {address} refuses: {code:?}"),
            ConnectionError::Io(error) => format!("no connection to the broker at {address}: {error}"),
            ConnectionError::NetworkTimeout => format!("the broker at {address} does not answer"),
            ConnectionError::MqttState(StateError::AwaitPingResp) | ConnectionError::FlushTimeout => {
                format!("the broker at {address} is silent")
            }
            ConnectionError::Tls(_) => format!(
                "no TLS with the broker at {address}: {}; does it speak TLS on this port?",
                told(error)
            ),
            ConnectionError::MqttState(StateError::Deserialization(
                PacketError::PayloadSizeLimitExceeded(bytes),
            )) => format!(
                "the broker at {address} hands on a message of {bytes} bytes, and this gateway takes none that is longer \
                 than {PACKET_BYTES_MAX}: the connection ends. Somebody has published it on a topic that the gateway \
                 listens to, a `…/set` perhaps; if it is a retained one it comes again and again, until it is emptied \
                 (`mosquitto_pub -r -n -t TOPIC`)"
            ),
            error if loss(error) == Loss::Closed && !was_made && self.websocket => format!(
                "the broker at {address} closes the connection before it lets this gateway in; does it listen for \
                 websockets on this port, and on this path?"
            ),
            error if loss(error) == Loss::Closed && !was_made => format!(
                "the broker at {address} closes the connection before it lets this gateway in; does it want \
             TLS (`mqtts://`)?"
            ),
            error if loss(error) == Loss::Closed => format!(
                "the broker at {address} has closed the connection: it ends, or another client has come with \
             the identifier `{client_id}`"
            ),
            error if told(error) == "bytes remaining on stream" => {
                format!("the connection to the broker at {address} is cut off in the middle of a message")
            }
            error => format!("the connection to the broker at {address} is lost: {}", told(error)),
        }
    }
}

pub(super) fn loss(error: &ConnectionError) -> Loss {
    use std::io::ErrorKind;
    match error {
        ConnectionError::MqttState(StateError::ConnectionAborted) => Loss::Closed,
        ConnectionError::NetworkTimeout
        | ConnectionError::FlushTimeout
        | ConnectionError::MqttState(StateError::AwaitPingResp | StateError::CollisionTimeout) => {
            Loss::Silent
        }
        error => match io_error(error).map(std::io::Error::kind) {
            Some(ErrorKind::ConnectionReset | ErrorKind::UnexpectedEof | ErrorKind::BrokenPipe) => {
                Loss::Closed
            }
            Some(ErrorKind::TimedOut) => Loss::Silent,
            _ => Loss::Failed,
        },
    }
}

/// The error of the connection below MQTT, if it was one.
fn io_error(error: &ConnectionError) -> Option<&std::io::Error> {
    let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(error);
    while let Some(error) = cause {
        if let Some(error) = error.downcast_ref() {
            return Some(error);
        }
        cause = error.source();
    }
    None
}

fn rustls_error(error: &ConnectionError) -> Option<&rustls::Error> {
    if let ConnectionError::Tls(TlsError::TLS(error)) = error {
        return Some(error);
    }
    io_error(error)?.get_ref()?.downcast_ref()
}

/// The innermost error, which says it without the library's own words.
fn told(error: &ConnectionError) -> String {
    let mut cause: &dyn std::error::Error = error;
    while let Some(source) = cause.source() {
        cause = source;
    }
    cause.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_can_be_mended_is_told_with_its_remedy() {
        let too_long = || {
            ConnectionError::MqttState(StateError::Deserialization(PacketError::PayloadSizeLimitExceeded(20)))
        };
        let closed = || ConnectionError::MqttState(StateError::ConnectionAborted);
        for (error, was_made, websocket, remedy) in [
            (too_long(), true, false, "mosquitto_pub -r -n"),
            (closed(), false, false, "does it want TLS"),
            (closed(), false, true, "listen for websockets"),
            (closed(), true, true, "another client has come"),
        ] {
            let ends = Ends {
                address: "host:1".into(),
                client_id: "busker_gateway".into(),
                base_topic: "busker".into(),
                websocket,
            };
            let reason = ends.reason(&error, was_made);
            assert!(reason.contains("host:1") && reason.contains(remedy), "{reason}");
        }
    }
}
