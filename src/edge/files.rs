//! Small files: secrets to be read, and how a file is replaced.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use anyhow::{Context, bail};

use crate::engine::settings::{self, Password};

/// The secret that messages call `what`: a password or a token. One line end behind it in a file is no
/// part of it.
pub fn read_secret(what: &str, secret: &Password) -> anyhow::Result<Option<String>> {
    let path = match secret {
        Password::None => return Ok(None),
        Password::Given(secret) => return Ok(Some(secret.clone())),
        Password::File(path) => path,
    };
    let shown = path.display();
    let text = fs::read_to_string(path).with_context(|| format!("cannot read the {what} in `{shown}`"))?;
    let secret = text.strip_suffix('\n').unwrap_or(&text);
    let secret = secret.strip_suffix('\r').unwrap_or(secret);
    if secret.is_empty() {
        bail!("the {what} file `{shown}` is empty");
    }
    Ok(Some(secret.to_string()))
}

/// The token that readers of HTTP must know.
pub fn read_token(token: &Password) -> anyhow::Result<Option<String>> {
    let found = read_secret("token", token)?;
    if found.as_deref().is_some_and(|found| !settings::is_token(found)) {
        let place = match token {
            Password::File(path) => format!("the first line of `{}`", path.display()),
            _ => "the token".into(),
        };
        bail!("{place} cannot be a token; expected {}", settings::TOKEN_FORM);
    }
    Ok(found)
}

/// Puts `bytes` in the place of the file, by way of `temporary` beside it: whoever looks, and whenever the power
/// fails, it is there whole, old or new.
pub fn replace(path: &Path, temporary: &Path, mode: u32, bytes: &[u8]) -> io::Result<()> {
    let mut file = OpenOptions::new().write(true).create(true).truncate(true).mode(mode).open(temporary)?;
    let written =
        file.write_all(bytes).and_then(|()| file.sync_all()).and_then(|()| fs::rename(temporary, path));
    if written.is_err() {
        // On a full card what is half there would stay for ever.
        let _ = fs::remove_file(temporary);
    }
    written?;
    File::open(path.parent().unwrap_or(Path::new(".")))?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_password_is_the_first_line_of_its_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("password");
        for (text, expected) in [
            ("secret", Some("secret")),
            ("secret\n", Some("secret")),
            ("secret\r\n", Some("secret")),
            (" se cret ", Some(" se cret ")),
            ("\n", None),
            ("", None),
        ] {
            fs::write(&path, text).expect("the file is written");
            let found = read_secret("password", &Password::File(path.clone()));
            assert_eq!(found.ok().flatten().as_deref(), expected, "{text:?}");
        }
        fs::remove_file(&path).expect("the file is removed");
        let error = read_secret("password", &Password::File(path.clone())).expect_err("there is no file");
        assert!(error.to_string().contains(&path.display().to_string()), "{error}");
    }

    #[test]
    fn a_token_is_one_that_can_stand_in_a_header_and_is_not_repeated() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("token");
        for (text, good) in [
            ("s3cret-._~+/==\n", true),
            ("se cret\n", false),
            ("sécret", false),
            ("a\nb\n", false),
            ("==", false),
        ] {
            fs::write(&path, text).expect("the file is written");
            match read_token(&Password::File(path.clone())) {
                Ok(token) => assert!(good && token.as_deref() == Some(text.trim_end()), "{text:?}"),
                Err(error) => assert!(!good && !error.to_string().contains(text.trim_end()), "{error}"),
            }
        }
    }
}
