//! The configuration file for the verbs that need one: reads it and the profiles that it names.

use std::env;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use anyhow::Context;

use super::Failure;
use crate::edge::link::adapter;
use crate::edge::{files, tls};
use crate::engine::configuration::{self, Warning};
use crate::engine::profile::Library;
use crate::engine::settings::{DeviceSettings, Link, Password, Settings};
use crate::engine::yaml::{Diagnostic, list_of_choices};

/// `--config FILE`, for a verb's own arguments by `#[command(flatten)]`.
#[derive(clap::Args, Debug)]
pub struct ConfigurationArgs {
    /// The configuration file
    #[arg(long, value_name = "FILE", default_value = "/etc/busker/busker.yaml")]
    pub config: PathBuf,
}

impl ConfigurationArgs {
    /// The settings; warnings are told on standard error.
    pub fn load(&self) -> Result<Settings, Failure> {
        load(&self.config)?.map(Loaded::told).map(|loaded| loaded.settings).map_err(faults)
    }

    /// The same for the verb that talks to the broker, with the profiles that were known: the files of
    /// the broker's section are there.
    pub fn load_with_broker(&self) -> Result<Loaded, Failure> {
        let loaded = load(&self.config)?.map_err(faults)?;
        let mut found = loaded.tls_faults();
        found.extend(loaded.secret_faults());
        if found.is_empty() { Ok(loaded.told()) } else { Err(faults(found)) }
    }
}

/// A configuration without a fault.
pub struct Loaded {
    pub settings: Settings,
    pub warnings: Vec<Warning>,
    /// The shipped profiles, and over them those of the folders that the configuration names.
    pub library: Library,
    /// What the file is called, and what is in it.
    file: (String, Vec<u8>),
}

impl Loaded {
    /// What is wrong with the files of TLS, which shall not wait for the start.
    pub fn tls_faults(&self) -> Vec<Diagnostic> {
        let faults = self.settings.mqtt.tls.as_ref().and_then(|tls| tls::client_config(tls).err());
        let place = |fault: tls::Fault| match fault.key {
            Some(key) => self.at(&["mqtt", "tls", key], fault.message),
            None => self.at(&["mqtt", "url"], fault.message),
        };
        faults.into_iter().flatten().map(place).collect()
    }

    /// Why the gateway could not read its secrets. Whoever checks a configuration may have no right to.
    pub fn secret_faults(&self) -> Vec<Diagnostic> {
        let Settings { mqtt, http, .. } = &self.settings;
        let mut found = Vec::new();
        if let Err(error) = files::read_secret("password", &mqtt.password) {
            found.push(self.at(&["mqtt", "password_file"], format!("{error:#}")));
        }
        if let Err(error) = files::read_token(&http.token) {
            found.push(self.at(&["http", "token_file"], format!("{error:#}")));
        }
        found
    }

    /// Secrets that everybody on this machine can read.
    pub fn open_secrets(&self) -> Vec<Diagnostic> {
        let Settings { mqtt, http, .. } = &self.settings;
        let of_password = |secret: &Password| match secret {
            Password::File(path) => Some(path.clone()),
            Password::None | Password::Given(_) => None,
        };
        let client = mqtt.tls.as_ref().and_then(|tls| tls.client.as_ref());
        let files: [(&[&str], Option<PathBuf>); 3] = [
            (&["mqtt", "password_file"], of_password(&mqtt.password)),
            (&["mqtt", "tls", "key_file"], client.map(|client| client.key_file.clone())),
            (&["http", "token_file"], of_password(&http.token)),
        ];
        let open = files.into_iter().filter_map(|(keys, path)| {
            let path = path?;
            let mode = fs::metadata(&path).ok()?.permissions().mode();
            let shown = path.display();
            let message = || {
                format!("everybody on this machine can read `{shown}`; `chmod o= {shown}` keeps them from it")
            };
            (mode & 0o004 != 0).then(|| self.at(keys, message()))
        });
        open.collect()
    }

    /// What ports that may change their names are called for good, where the system tells it. `folder` is
    /// usually [`adapter::BY_ID`].
    pub fn stable_paths(&self, folder: &Path) -> Vec<Diagnostic> {
        let serial = self.settings.buses.iter().filter_map(|bus| match &bus.link {
            Link::Serial { path, .. } if !Path::new(path).starts_with(folder) => Some((&bus.name, path)),
            _ => None,
        });
        serial
            .filter_map(|(bus, path)| {
                let stable = adapter::stable_path(Path::new(path), folder)?;
                let message =
                    format!("`{path}` is `{}` now; that name stays with the adapter", stable.display());
                Some(self.at(&["buses", bus, "serial"], message))
            })
            .collect()
    }

    fn at(&self, keys: &[&str], message: String) -> Diagnostic {
        let (name, bytes) = &self.file;
        configuration::fault_at(name, bytes, keys, message)
    }

    /// Itself, with its warnings told.
    fn told(self) -> Loaded {
        for warning in &self.warnings {
            eprintln!("warning: {}: {}", warning.place, warning.message);
        }
        self
    }
}

/// Reads the file and the profiles. A file that cannot be read at all is a [`Failure`]; what is wrong
/// in it comes as diagnostics.
pub fn load(path: &Path) -> Result<Result<Loaded, Vec<Diagnostic>>, Failure> {
    let shown = path.display().to_string();
    let bytes = fs::read(path)
        .with_context(|| format!("cannot read the configuration `{shown}`"))
        .map_err(Failure::WrongInput)?;
    let mut library = Library::shipped();
    let mut unreadable = Vec::new();
    for folder in configuration::profile_folders(&shown, &bytes) {
        // A relative folder is meant from where the file lies, wherever the program was started.
        let place = path.parent().unwrap_or(Path::new("")).join(&folder.value);
        if let Err(error) = add_profiles(&mut library, &place, &place) {
            let message = format!("cannot read the profiles in `{}`: {error}", folder.value);
            unreadable.push(Diagnostic { place: folder.place, message });
        }
    }
    match configuration::load(&shown, &bytes, &library) {
        Ok((mut settings, warnings)) if unreadable.is_empty() => {
            settings.resolve_files(path.parent().unwrap_or(Path::new("")));
            let secret = |configured, variable, credential| {
                let folder = env::var_os("CREDENTIALS_DIRECTORY").map(PathBuf::from);
                nearest(configured, env::var(variable).ok(), folder.map(|folder| folder.join(credential)))
            };
            settings.mqtt.password = secret(settings.mqtt.password, "BUSKER_MQTT_PASSWORD", "mqtt-password");
            settings.http.token = secret(settings.http.token, "BUSKER_HTTP_TOKEN", "http-token");
            Ok(Ok(Loaded { settings, warnings, library, file: (shown, bytes) }))
        }
        Ok(_) => Ok(Err(unreadable)),
        Err(faults) => Ok(Err([unreadable, faults].concat())),
    }
}

/// The device of this name.
pub fn device_named<'s>(settings: &'s Settings, name: &str) -> Result<&'s DeviceSettings, Failure> {
    settings.devices.iter().find(|device| device.name == name).ok_or_else(|| {
        let names: Vec<&str> = settings.devices.iter().map(|device| device.name.as_str()).collect();
        Failure::wrong(format!("there is no device `{name}`; {}", list_of_choices(name, &names)))
    })
}

/// Faults as a verb returns them.
pub fn faults(faults: Vec<Diagnostic>) -> Failure {
    Failure::Faults { faults: faults.iter().map(ToString::to_string).collect(), so: None }
}

/// Puts every `.yaml` file below `folder` into the library, by its path below `root`.
pub fn add_profiles(library: &mut Library, root: &Path, folder: &Path) -> std::io::Result<()> {
    let mut paths: Vec<PathBuf> =
        fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<std::io::Result<_>>()?;
    paths.sort();
    for path in paths {
        if path.is_dir() {
            add_profiles(library, root, &path)?;
        } else if path.extension().is_some_and(|extension| extension == "yaml") {
            let below = path.strip_prefix(root).unwrap_or(&path).to_string_lossy();
            library.add(&below, &path.display().to_string(), fs::read(&path)?);
        }
    }
    Ok(())
}

/// The configuration's secret, else that of the environment, else systemd's credential, if it is there.
fn nearest(configured: Password, environment: Option<String>, credential: Option<PathBuf>) -> Password {
    match (configured, environment, credential.filter(|path| path.exists())) {
        (Password::None, Some(password), _) => Password::Given(password),
        (Password::None, None, Some(path)) => Password::File(path),
        (configured, _, _) => configured,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_that_has_a_stable_name_is_told_with_it() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let (port, by_id) = (folder.path().join("ttyUSB0"), folder.path().join("by-id"));
        fs::write(&port, "").expect("a temporary file");
        fs::create_dir(&by_id).expect("a temporary folder");
        let stable = by_id.join("usb-FTDI_A1-if00-port0");
        std::os::unix::fs::symlink("../ttyUSB0", &stable).expect("a temporary link");
        let check = |serial: &Path| {
            let config = folder.path().join("busker.yaml");
            let text = format!("buses:\n  shed: {{serial: {}}}\n", serial.display());
            fs::write(&config, text).expect("a temporary file");
            let Ok(Ok(loaded)) = load(&config) else { panic!("a good configuration") };
            loaded.stable_paths(&by_id).iter().map(ToString::to_string).collect::<Vec<_>>()
        };
        let told = check(&port);
        assert_eq!(told.len(), 1);
        assert!(told[0].contains(":2:18: "), "{told:?}");
        let expected = format!("`{}` is `{}` now; that name stays", port.display(), stable.display());
        assert!(told[0].contains(&expected), "{told:?}");
        assert_eq!(check(&stable), Vec::<String>::new());
        assert_eq!(check(Path::new("/dev/no-such")), Vec::<String>::new());
    }

    #[test]
    fn a_secret_that_everybody_can_read_is_told_with_what_mends_it() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let (file, secret) = (folder.path().join("busker.yaml"), folder.path().join("password"));
        fs::write(&secret, "s3cret\n").expect("a password");
        let text = format!("mqtt: {{username: busker, password_file: {}}}\nbuses: {{}}\n", secret.display());
        fs::write(&file, text).expect("a configuration");
        for (mode, expected) in [(0o600, 0), (0o640, 0), (0o644, 1)] {
            fs::set_permissions(&secret, fs::Permissions::from_mode(mode)).expect("it is ours");
            let Ok(Ok(loaded)) = load(&file) else { panic!("the configuration is good") };
            let told: Vec<String> = loaded.open_secrets().iter().map(ToString::to_string).collect();
            assert_eq!(told.len(), expected, "{told:?}");
            assert!(
                told.iter().all(|told| told.contains("chmod o= ") && !told.contains("s3cret")),
                "{told:?}"
            );
        }
    }

    #[test]
    fn the_password_comes_from_the_nearest_place_that_has_one() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let credential = || Some(folder.path().join("mqtt-password"));
        let given = |password: &str| Password::Given(password.into());
        assert!(nearest(Password::None, None, None) == Password::None);
        assert!(nearest(Password::None, None, credential()) == Password::None);
        fs::write(folder.path().join("mqtt-password"), "c").expect("a credential");
        let file = Password::File(folder.path().join("mqtt-password"));
        assert!(nearest(Password::None, None, credential()) == file);
        assert!(nearest(Password::None, Some("e".into()), credential()) == given("e"));
        assert!(nearest(given("f"), Some("e".into()), credential()) == given("f"));
    }
}
