//! What lets the gateway in at the broker and the broker prove itself, read from its files: at the start,
//! and again before each attempt to connect, since passwords and certificates are renewed.

use std::sync::Arc;

use anyhow::anyhow;
use rumqttc::{MqttOptions, TlsConfiguration, Transport};
use rustls::ClientConfig;

use crate::edge::{files, tls};
use crate::engine::settings::Mqtt;

pub struct Secrets {
    password: Option<String>,
    tls: Option<Arc<ClientConfig>>,
}

impl Secrets {
    pub fn read(mqtt: &Mqtt) -> anyhow::Result<Secrets> {
        let password = files::read_secret("password", &mqtt.password)?;
        let tls = mqtt.tls.as_ref().map(tls::client_config).transpose().map_err(|faults| {
            let told: Vec<String> = faults.into_iter().map(|fault| fault.message).collect();
            anyhow!("{}", told.join("; "))
        })?;
        Ok(Secrets { password, tls })
    }

    /// Uses them for the connections that are made from now on.
    pub fn enter(self, options: &mut MqttOptions, mqtt: &Mqtt) {
        if let Some(username) = &mqtt.username {
            options.set_credentials(username.clone(), self.password.unwrap_or_default());
        }
        options.set_transport(match (&mqtt.websocket, self.tls) {
            (None, None) => Transport::Tcp,
            (None, Some(tls)) => Transport::Tls(TlsConfiguration::Rustls(tls)),
            (Some(_), None) => Transport::Ws,
            (Some(_), Some(tls)) => Transport::Wss(TlsConfiguration::Rustls(tls)),
        });
    }
}
