//! Contacts at digital inputs, which several devices have and all take alike.

use crate::simulator::device::Signal;

/// Connects something to an input; `product` names the device in the error.
pub fn connect(contacts: &mut [bool], input: u8, signal: Signal, product: &str) -> Result<(), String> {
    let inputs = contacts.len();
    let Some(closed) = usize::from(input).checked_sub(1).and_then(|number| contacts.get_mut(number)) else {
        return Err(format!("input {input} is not there; {product} has 1 to {inputs}"));
    };
    *closed = signal.contact().ok_or_else(|| format!("an input of {product} takes a contact"))?;
    Ok(())
}
