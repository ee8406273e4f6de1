//! TLS with an own authority and client certificates, websockets, and where a password comes from.

use std::fs;
use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::path::PathBuf;
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use rcgen::{
    BasicConstraints, Certificate, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, KeyPair,
    date_time_ymd,
};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{ServerConfig, ServerConnection, StreamOwned};
use tempfile::TempDir;
use tungstenite::Message;
use tungstenite::handshake::server::{Request, Response};

use super::{configuration, json, over_tcp, simulation};
use crate::support::{self, Broker, Gateway, Watcher};

/// An authority and what it vouches for, each as `<name>.pem` and `<name>.key` in a folder.
struct Authority {
    folder: TempDir,
    certificate: Certificate,
    key: KeyPair,
}

impl Authority {
    fn new(name: &str) -> Authority {
        let folder = tempfile::tempdir().expect("a folder");
        let key = KeyPair::generate().expect("a key");
        let mut params = CertificateParams::new(Vec::new()).expect("no names");
        params.distinguished_name.push(DnType::CommonName, name);
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let certificate = params.self_signed(&key).expect("a certificate");
        fs::write(folder.path().join("ca.pem"), certificate.pem()).expect("a file");
        Authority { folder, certificate, key }
    }

    fn vouch_for(&self, file: &str, name: &str) {
        self.issue(file, name, |_| ());
    }

    fn issue(&self, file: &str, name: &str, change: impl FnOnce(&mut CertificateParams)) {
        let key = KeyPair::generate().expect("a key");
        let mut params = CertificateParams::new(vec![name.to_string()]).expect("a name");
        params.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        params.distinguished_name.push(DnType::CommonName, name);
        change(&mut params);
        let certificate = params.signed_by(&key, &self.certificate, &self.key).expect("a certificate");
        fs::write(self.path(&format!("{file}.pem")), certificate.pem()).expect("a file");
        fs::write(self.path(&format!("{file}.key")), key.serialize_pem()).expect("a file");
    }

    fn path(&self, file: &str) -> PathBuf {
        self.folder.path().join(file)
    }

    /// Lines of a mosquitto that uses TLS on its only port, with more of them.
    fn broker(&self, server: &str, more: &str) -> String {
        format!(
            "allow_anonymous true\npersistence false\ncafile {}\ncertfile {}\nkeyfile {}\n{more}",
            self.path("ca.pem").display(),
            self.path(&format!("{server}.pem")).display(),
            self.path(&format!("{server}.key")).display()
        )
    }
}

/// A gateway on `url` with what else stands in its section `mqtt`.
fn gateway(url: &str, more: &str, port: &busker::simulator::TcpPort) -> Gateway {
    Gateway::start_with(&format!("mqtt: {{url: '{url}'{more}}}\n{}", configuration(port)))
}

#[test]
fn a_broker_proves_itself_to_an_own_authority_and_the_gateway_to_the_broker() {
    let authority = Authority::new("own");
    authority.vouch_for("server", "localhost");
    authority.vouch_for("gateway", "gateway");
    let mut broker = Broker::start_with(&authority.broker("server", "require_certificate true\n"));
    let simulation = simulation();
    let port = over_tcp(&simulation);
    let url = format!("mqtts://localhost:{}", broker.port);
    let (ca, own) = (authority.path("ca.pem"), authority.path("gateway"));
    let (ca, own) = (ca.display(), own.display());
    let all = format!(", tls: {{ca_file: {ca}, cert_file: {own}.pem, key_file: {own}.key}}");
    let with_all = gateway(&url, &all, &port);
    with_all.wait_for_health(200);
    // Also over a restart.
    broker.kill();
    with_all.wait_for_health(503);
    broker.start_again();
    with_all.wait_for_health(200);
    assert!(with_all.terminate().success());

    let without_certificate = gateway(&url, &format!(", tls: {{ca_file: {ca}}}"), &port);
    without_certificate.wait_for_log("it does not accept this gateway; does it want a certificate");
    without_certificate.wait_for_health(503);
    assert!(!without_certificate.log().join("\n").contains("PRIVATE"), "{:?}", without_certificate.log());
}

#[test]
fn certificates_and_passwords_that_are_renewed_are_used_without_a_restart() {
    let old = Authority::new("old");
    old.vouch_for("server", "localhost");
    let hashes = support::temporary_file(&old.folder, "hashes", super::HASH);
    let password = support::temporary_file(&old.folder, "password", "old sesame");
    let more = format!("allow_anonymous false\npassword_file {}\n", hashes.display());
    let lines = old.broker("server", "").replace("allow_anonymous true\n", &more);
    let mut broker = Broker::start_with(&lines);
    let simulation = simulation();
    let port = over_tcp(&simulation);
    let more = format!(
        ", username: busker, password_file: {}, tls: {{ca_file: {}}}",
        password.display(),
        old.path("ca.pem").display()
    );
    let gateway = gateway(&format!("mqtts://localhost:{}", broker.port), &more, &port);
    gateway.wait_for_log("refuses this user name and password");
    fs::write(&password, "open sesame").expect("a file");
    gateway.wait_for_health(200);

    broker.kill();
    gateway.wait_for_health(503);
    let new = Authority::new("new");
    new.vouch_for("server", "localhost");
    for file in ["ca.pem", "server.pem", "server.key"] {
        fs::copy(new.path(file), old.path(file)).expect("a file");
    }
    broker.start_again();
    gateway.wait_for_health(200);
}

#[test]
fn a_broker_that_does_not_prove_itself_is_not_talked_to() {
    let authority = Authority::new("own");
    authority.vouch_for("elsewhere", "elsewhere.example");
    authority.issue("old", "localhost", |params| {
        (params.not_before, params.not_after) = (date_time_ymd(2020, 1, 1), date_time_ymd(2021, 1, 1));
    });
    authority.vouch_for("server", "localhost");
    let simulation = simulation();
    let port = over_tcp(&simulation);
    let (stranger, made_anew) = (Authority::new("stranger"), Authority::new("own"));
    for (server, trusted, expected) in [
        ("server", &stranger, "no authority that is trusted vouches for its certificate"),
        ("server", &made_anew, "no authority that is trusted vouches for its certificate"),
        ("elsewhere", &authority, "its certificate is for another name than the one in `url`"),
        ("old", &authority, "its certificate has expired"),
    ] {
        let log = authority.path("log");
        let log = log.display();
        let broker = Broker::start_with(&authority.broker(server, &format!("log_dest file {log}\n")));
        let ca = trusted.path("ca.pem");
        let more = format!(", username: joe, password: sesame, tls: {{ca_file: {}}}", ca.display());
        let gateway = gateway(&format!("mqtts://localhost:{}", broker.port), &more, &port);
        gateway.wait_for_log(expected);
        gateway.wait_for_health(503);
        assert!(!gateway.log().join("\n").contains("sesame"), "{:?}", gateway.log());
        let log = fs::read_to_string(authority.path("log")).expect("mosquitto writes it");
        assert!(!log.contains("joe") && !log.contains("busker_gateway"), "{log}");
    }
    // And one that does not speak TLS at all.
    let broker = Broker::start();
    let ca = authority.path("ca.pem");
    let gateway = gateway(
        &format!("mqtts://localhost:{}", broker.port),
        &format!(", tls: {{ca_file: {}}}", ca.display()),
        &port,
    );
    gateway.wait_for_log("does it speak TLS on this port?");
}

#[test]
fn files_of_tls_are_read_when_the_configuration_is_checked() {
    let authority = Authority::new("own");
    authority.vouch_for("gateway", "gateway");
    authority.vouch_for("other", "other");
    let config = authority.path("busker.yaml");
    let check = |tls: &str, verb: &str| {
        let text =
            format!("mqtt:\n  url: mqtts://localhost\n  tls: {{{tls}}}\nbuses: {{b: {{tcp: 'h:1'}}}}\n");
        fs::write(&config, text).expect("a file");
        support::busker(&[verb, "--config", config.to_str().expect("text")], &[])
    };
    // Relative to the configuration.
    let (code, said) = check("ca_file: ca.pem, cert_file: gateway.pem, key_file: gateway.key", "check");
    assert_eq!(code, Some(0), "{said}");
    for verb in ["check", "run"] {
        for (tls, place, expected) in [
            ("ca_file: nowhere.pem", "3:18", "cannot read"),
            ("ca_file: gateway.key", "3:18", "there is no certificate in"),
            (
                "cert_file: gateway.pem, key_file: other.key",
                "3:43",
                "this key does not belong to `cert_file`",
            ),
        ] {
            let (code, said) = check(tls, verb);
            assert_eq!(code, Some(2), "{said}");
            assert!(said.contains(&format!("busker.yaml:{place}: ")) && said.contains(expected), "{said}");
        }
    }
}

/// What a websocket may run over.
trait Stream: Read + Write + Send {}
impl<T: Read + Write + Send> Stream for T {}

/// A way through a websocket: takes one, encrypted or not, and passes on what is in it.
fn websocket_to(broker: u16, tls: Option<Arc<ServerConfig>>) -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let port = listener.local_addr().expect("its address").port();
    thread::spawn(move || {
        for client in listener.incoming().map_while(Result::ok) {
            let Ok(broker) = TcpStream::connect(("127.0.0.1", broker)) else { continue };
            let socket = client.try_clone().expect("a descriptor");
            let client: Box<dyn Stream> = match tls.clone() {
                None => Box::new(client),
                Some(tls) => {
                    let connection = ServerConnection::new(tls).expect("a good configuration");
                    Box::new(StreamOwned::new(connection, client))
                }
            };
            thread::spawn(move || {
                pass_on(client, &socket, broker);
                // The client may have gone already.
                let _ = socket.shutdown(Shutdown::Both);
            });
        }
    });
    port
}

/// Until one of the two ends. `socket` is what `client` runs over.
fn pass_on(client: Box<dyn Stream>, socket: &TcpStream, mut broker: TcpStream) {
    #[allow(clippy::result_large_err, reason = "the library wants it so")]
    let agree = |request: &Request, mut response: Response| {
        assert_eq!(request.uri().path(), "/way");
        response.headers_mut().insert("Sec-WebSocket-Protocol", "mqtt".parse().expect("a header"));
        Ok(response)
    };
    let Ok(mut client) = tungstenite::accept_hdr(client, agree) else { return };
    // Each in turn, since one thread has both sides of the encryption.
    for side in [socket, &broker] {
        side.set_read_timeout(Some(Duration::from_millis(5))).expect("the time is positive");
    }
    let nothing_yet =
        |error: &std::io::Error| matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut);
    let mut bytes = [0; 4096];
    loop {
        match client.read() {
            Ok(message) => {
                if broker.write_all(&message.into_data()).is_err() {
                    return;
                }
            }
            Err(tungstenite::Error::Io(error)) if nothing_yet(&error) => {}
            Err(_) => return,
        }
        match broker.read(&mut bytes) {
            Ok(length @ 1..) => {
                let message = Message::binary(bytes[..length].to_vec());
                if client.send(message).is_err() {
                    return;
                }
            }
            Err(error) if nothing_yet(&error) => {}
            _ => return,
        }
    }
}

#[test]
fn a_websocket_leads_to_the_broker_again_and_again_with_and_without_tls() {
    let authority = Authority::new("own");
    authority.vouch_for("server", "localhost");
    let chain = CertificateDer::from_pem_file(authority.path("server.pem")).expect("a certificate");
    let key = PrivateKeyDer::from_pem_file(authority.path("server.key")).expect("a key");
    let server = ServerConfig::builder().with_no_client_auth().with_single_cert(vec![chain], key);
    let server = Arc::new(server.expect("they belong together"));
    let ca = format!(", tls: {{ca_file: {}}}", authority.path("ca.pem").display());
    for (scheme, more, tls) in [("ws", "", None), ("wss", ca.as_str(), Some(server))] {
        let (mut broker, simulation) = (Broker::start(), simulation());
        let port = over_tcp(&simulation);
        let way = websocket_to(broker.port, tls);
        let gateway = gateway(&format!("{scheme}://localhost:{way}/way"), more, &port);
        gateway.wait_for_health(200);
        broker.kill();
        gateway.wait_for_health(503);
        broker.start_again();
        gateway.wait_for_health(200);
        let watcher = Watcher::start(&broker, "watcher");
        super::wait_until_all_is_online(&watcher);
        watcher.publish("busker/relays/relay_2/set", "ON");
        let outcome = watcher.wait_until("an outcome", |got| got.topic == "busker/relays/relay_2/outcome");
        assert_eq!(json(&outcome.payload)["outcome"], "done", "{scheme}");
    }
}

#[test]
fn a_password_may_come_from_the_environment_or_from_systemd() {
    let folder = tempfile::tempdir().expect("a folder");
    let hashes = support::temporary_file(&folder, "hashes", super::HASH);
    let broker = Broker::start_with(&format!("allow_anonymous false\npassword_file {}\n", hashes.display()));
    let simulation = simulation();
    let port = over_tcp(&simulation);
    support::temporary_file(&folder, "mqtt-password", "open sesame\n");
    let credentials = ("CREDENTIALS_DIRECTORY", folder.path().to_str().expect("text"));
    let variable = |password| ("BUSKER_MQTT_PASSWORD", password);
    // Also the libraries say all that they can, and no password.
    let chatty = ("RUST_LOG", "trace");
    for (environment, let_in) in [
        (&[chatty, credentials][..], true),
        (&[chatty, variable("open sesame")], true),
        // The environment comes first.
        (&[credentials, variable("wrong sesame")], false),
    ] {
        let gateway = Gateway::start_in(
            environment,
            &format!(
                "mqtt: {{url: 'mqtt://127.0.0.1:{}', username: busker}}\n{}",
                broker.port,
                configuration(&port)
            ),
        );
        match let_in {
            true => gateway.wait_for_health(200),
            false => drop(gateway.wait_for_log("refuses this user name and password")),
        }
        assert!(!gateway.log().join("\n").contains("sesame"), "{:?}", gateway.log());
    }
}
