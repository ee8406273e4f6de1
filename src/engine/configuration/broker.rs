//! The section `mqtt`, from what was typed to what is true.

use std::path::PathBuf;

use super::{Resolver, file};
use crate::engine::settings::{ClientCertificate, Manner, Mqtt, Password, Tls};
use crate::engine::time::Duration;
use crate::engine::yaml::At;

impl Resolver<'_> {
    pub(super) fn mqtt(&mut self, file: &file::Mqtt) -> Mqtt {
        self.within(Some(&file.keep_alive), Duration::from_secs(1), Duration::from_secs(3600));
        let (password, password_file) = (file.password.as_ref(), file.password_file.as_ref());
        self.one_of_two("password", password.map(|at| &at.place), password_file.map(|at| &at.place));
        let secret = file.password.as_ref().or(file.password_file.as_ref());
        if let (Some(secret), None) = (secret, &file.username) {
            self.faults.add(&secret.place, "a password without `username`; a broker wants both or neither");
        }
        Mqtt {
            host: file.url.host.clone(),
            port: file.url.port,
            websocket: file.url.websocket.clone(),
            tls: self.tls(file),
            keep_alive: file.keep_alive.value,
            username: file.username.as_ref().map(|username| username.value.clone()),
            password: match (&file.password, &file.password_file) {
                (Some(password), _) => Password::Given(password.value.clone()),
                (None, Some(path)) => Password::File(PathBuf::from(&path.value)),
                (None, None) => Password::None,
            },
            base_topic: file.base_topic.0.clone(),
            topics: file.topics.value.clone(),
            values: Manner { confirmed: file.qos.value.0 == 1, retain: file.retain },
            json: file.json,
        }
    }

    fn tls(&mut self, file: &file::Mqtt) -> Option<Tls> {
        let given = file.tls.as_ref();
        if let Some(given) = given.filter(|_| !file.url.tls) {
            let message = "certificates, and a `url` that does not ask for TLS; write `mqtts://` or `wss://` \
                           there, or remove `tls`";
            self.faults.add(&given.place, message);
            return None;
        }
        if !file.url.tls {
            return None;
        }
        let Some(given) = given else { return Some(Tls::default()) };
        let path = |file: &At<String>| PathBuf::from(&file.value);
        let client = match (&given.cert_file, &given.key_file) {
            (Some(certificate), Some(key)) => {
                Some(ClientCertificate { cert_file: path(certificate), key_file: path(key) })
            }
            (None, None) => None,
            (Some(lonely), None) => {
                self.faults.add(&lonely.place, "a certificate without its `key_file`");
                None
            }
            (None, Some(lonely)) => {
                self.faults.add(&lonely.place, "a key without its `cert_file`");
                None
            }
        };
        Some(Tls { ca_file: given.ca_file.as_ref().map(path), client })
    }
}
