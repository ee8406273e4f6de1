//! Small files that the running gateway needs.

use std::fs;

use anyhow::{Context, bail};

use crate::engine::settings::Password;

/// The broker's password. One line end behind it in a file is no part of it.
pub fn read_password(password: &Password) -> anyhow::Result<Option<String>> {
    let path = match password {
        Password::None => return Ok(None),
        Password::Given(password) => return Ok(Some(password.clone())),
        Password::File(path) => path,
    };
    let shown = path.display();
    let text = fs::read_to_string(path).with_context(|| format!("cannot read the password in `{shown}`"))?;
    let password = text.strip_suffix('\n').unwrap_or(&text);
    let password = password.strip_suffix('\r').unwrap_or(password);
    if password.is_empty() {
        bail!("the password file `{shown}` is empty");
    }
    Ok(Some(password.to_string()))
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
            let found = read_password(&Password::File(path.clone()));
            assert_eq!(found.ok().flatten().as_deref(), expected, "{text:?}");
        }
        fs::remove_file(&path).expect("the file is removed");
        let error = read_password(&Password::File(path.clone())).expect_err("there is no file");
        assert!(error.to_string().contains(&path.display().to_string()), "{error}");
    }
}
