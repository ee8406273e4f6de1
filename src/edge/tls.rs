//! Certificates and keys from files, as the TLS library wants them, and what may be wrong with them.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{CertificateError, ClientConfig, RootCertStore};

use crate::engine::settings::{ClientCertificate, Tls};

/// Something that keeps TLS from being begun.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// The key below `tls` whose file it is; `None` if it is the system's.
    pub key: Option<&'static str>,
    pub message: String,
}

/// All faults at once.
pub fn client_config(tls: &Tls) -> Result<Arc<ClientConfig>, Vec<Fault>> {
    let mut faults = Vec::new();
    let mut take = |result: Result<_, Fault>| result.map_err(|fault| faults.push(fault)).ok();
    let roots = take(match &tls.ca_file {
        Some(path) => own_roots(path),
        None => system_roots(),
    });
    let mut own = None;
    if let Some(ClientCertificate { cert_file, key_file }) = &tls.client {
        let chain = certificates("cert_file", cert_file).map_err(|fault| faults.push(fault)).ok();
        let key = private_key(key_file).map_err(|fault| faults.push(fault)).ok();
        own = chain.zip(key);
    }
    let (Some(roots), true) = (roots, faults.is_empty()) else { return Err(faults) };
    // Said and not left to the library, which would panic if it had the choice between two.
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .map_err(|error| vec![Fault { key: None, message: format!("TLS cannot be begun: {error}") }])?
        .with_root_certificates(roots);
    let config = match own {
        None => builder.with_no_client_auth(),
        Some((chain, key)) => builder.with_client_auth_cert(chain, key).map_err(|error| {
            let message = match error {
                rustls::Error::InconsistentKeys(_) => "this key does not belong to `cert_file`".to_string(),
                error => format!("this key cannot be used: {error}"),
            };
            vec![Fault { key: Some("key_file"), message }]
        })?,
    };
    Ok(Arc::new(config))
}

/// What a failed handshake means, with what would help; `None` for anything else.
pub fn advice(error: &rustls::Error) -> Option<&'static str> {
    match error {
        rustls::Error::InvalidCertificate(error) => Some(match error {
            // A signature that does not fit: the authority was made anew under its old name.
            CertificateError::UnknownIssuer | CertificateError::BadSignature => {
                "no authority that is trusted vouches for its certificate; name the broker's own in `tls: ca_file`"
            }
            CertificateError::NotValidForName | CertificateError::NotValidForNameContext { .. } => {
                "its certificate is for another name than the one in `url`"
            }
            CertificateError::Expired | CertificateError::ExpiredContext { .. } => {
                "its certificate has expired, or the clock here is wrong"
            }
            CertificateError::NotValidYet | CertificateError::NotValidYetContext { .. } => {
                "its certificate is not valid yet, or the clock here is wrong"
            }
            _ => "its certificate is not accepted",
        }),
        rustls::Error::InvalidMessage(_) => Some("it does not speak TLS on this port"),
        rustls::Error::AlertReceived(_) => Some(
            "it does not accept this gateway; does it want a certificate, another one than `tls: cert_file`?",
        ),
        _ => None,
    }
}

fn own_roots(path: &Path) -> Result<RootCertStore, Fault> {
    let mut roots = RootCertStore::empty();
    for certificate in certificates("ca_file", path)? {
        roots.add(certificate).map_err(|error| Fault {
            key: Some("ca_file"),
            message: format!("a certificate in `{}` cannot be used: {error}", path.display()),
        })?;
    }
    Ok(roots)
}

fn system_roots() -> Result<RootCertStore, Fault> {
    let mut roots = RootCertStore::empty();
    let found = rustls_native_certs::load_native_certs();
    // Some system's store holds a few that nobody can use.
    roots.add_parsable_certificates(found.certs);
    if roots.is_empty() {
        let message = "this system trusts no authority; install `ca-certificates`, or name the broker's own in \
                       `tls: ca_file`";
        return Err(Fault { key: None, message: message.into() });
    }
    Ok(roots)
}

fn certificates(key: &'static str, path: &Path) -> Result<Vec<CertificateDer<'static>>, Fault> {
    let fault = |message| Fault { key: Some(key), message };
    let (shown, text) = (path.display(), read(key, path)?);
    let found: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&text).collect();
    match found {
        Ok(found) if found.is_empty() => Err(fault(format!(
            "there is no certificate in `{shown}`; expected PEM, which begins with `-----BEGIN CERTIFICATE-----`"
        ))),
        Ok(found) => Ok(found),
        Err(error) => Err(fault(format!("`{shown}` cannot be understood: {error}"))),
    }
}

fn private_key(path: &Path) -> Result<PrivateKeyDer<'static>, Fault> {
    let fault = |message| Fault { key: Some("key_file"), message };
    let (shown, text) = (path.display(), read("key_file", path)?);
    PrivateKeyDer::from_pem_slice(&text).map_err(|_| {
        let is_encrypted = text.windows(9).any(|part| part == b"ENCRYPTED");
        fault(match is_encrypted {
            true => format!("the key in `{shown}` is encrypted; expected one without a passphrase"),
            false => format!(
                "there is no key in `{shown}`; expected PEM, which begins with `-----BEGIN PRIVATE KEY-----`"
            ),
        })
    })
}

fn read(key: &'static str, path: &Path) -> Result<Vec<u8>, Fault> {
    fs::read(path).map_err(|error| Fault {
        key: Some(key),
        message: format!("cannot read `{}`: {error}", path.display()),
    })
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    /// A certificate that vouches for itself, and its key.
    fn pair() -> (String, String) {
        let made = rcgen::generate_simple_self_signed(["broker".to_string()]).expect("a certificate");
        (made.cert.pem(), made.key_pair.serialize_pem())
    }

    /// The files that a row names, in a folder that has all of them; what is wrong with each key.
    #[track_caller]
    fn check_faults(ca: Option<&str>, own: Option<(&str, &str)>, expected: &[(&str, &str)]) {
        let folder = tempfile::tempdir().expect("a folder");
        let ((certificate, key), (_, other_key)) = (pair(), pair());
        let broken = "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n";
        let encrypted = key.replace("PRIVATE KEY", "ENCRYPTED PRIVATE KEY");
        for (name, text) in [
            ("cert", certificate.as_str()),
            ("key", &key),
            ("other_key", &other_key),
            ("encrypted", &encrypted),
            ("broken", broken),
            ("cut", &certificate[..certificate.len() / 2]),
            ("empty", ""),
        ] {
            fs::write(folder.path().join(name), text).expect("a file");
        }
        let path = |name: &str| -> PathBuf { folder.path().join(name) };
        let client = own.map(|(cert, key)| ClientCertificate { cert_file: path(cert), key_file: path(key) });
        let found = client_config(&Tls { ca_file: ca.map(path), client }).err().unwrap_or_default();
        let matches = found.len() == expected.len()
            && found.iter().zip(expected).all(|(fault, (key, part))| {
                fault.key.unwrap_or_default() == *key && fault.message.contains(part)
            });
        assert!(matches, "{ca:?} {own:?}: {found:?}");
    }

    #[test]
    fn each_file_is_read_and_each_fault_is_told_at_its_key() {
        check_faults(Some("cert"), None, &[]);
        check_faults(Some("cert"), Some(("cert", "key")), &[]);
        check_faults(Some("missing"), None, &[("ca_file", "cannot read")]);
        check_faults(Some("empty"), None, &[("ca_file", "there is no certificate in")]);
        check_faults(Some("key"), None, &[("ca_file", "there is no certificate in")]);
        check_faults(Some("cut"), None, &[("ca_file", "cannot be understood")]);
        check_faults(Some("broken"), None, &[("ca_file", "cannot be used")]);
        let own = |cert, key| Some((cert, key));
        check_faults(
            Some("cert"),
            own("cert", "other_key"),
            &[("key_file", "does not belong to `cert_file`")],
        );
        check_faults(Some("cert"), own("cert", "encrypted"), &[("key_file", "is encrypted")]);
        check_faults(Some("cert"), own("cert", "cert"), &[("key_file", "there is no key in")]);
        let both = [("cert_file", "cannot read"), ("key_file", "there is no key in")];
        check_faults(Some("cert"), own("missing", "empty"), &both);
        let all =
            [("ca_file", "no certificate"), ("cert_file", "no certificate"), ("key_file", "cannot read")];
        check_faults(Some("empty"), own("empty", "missing"), &all);
    }
}
