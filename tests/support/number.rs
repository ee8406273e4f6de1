//! Numbers that whoever runs a test may want of it: how much of it, or which chance.

use std::str::FromStr;

/// The value of this variable, if it is set. What is mistyped must not pass for what is usual.
#[track_caller]
pub fn number<T: FromStr>(name: &str) -> Option<T> {
    let value = std::env::var_os(name)?;
    let number = value.to_str().and_then(|text| text.parse().ok());
    if number.is_none() {
        panic!("{name} is no number that it may be: {value:?}");
    }
    number
}
