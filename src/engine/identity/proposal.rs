//! How a device that was found would stand in the configuration.

/// The device's entry, on one line.
pub fn entry(profile: &str, bus: &str, unit: u8) -> String {
    format!("{{profile: {profile}, bus: {bus}, unit: {unit}}}")
}

/// `metz-connect/mr-do4` on unit 18 → `mr_do4_18`.
pub fn name_for(profile: &str, unit: u8) -> String {
    let model = profile.rsplit('/').next().unwrap_or(profile);
    let plain = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '_' };
    let name: String = model.chars().map(plain).collect();
    let begins_well = name.starts_with(|c: char| c.is_ascii_lowercase());
    if begins_well { format!("{name}_{unit}") } else { format!("device_{name}_{unit}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_is_named_by_its_model_and_its_unit() {
        assert_eq!(name_for("metz-connect/mr-do4", 18), "mr_do4_18");
        assert_eq!(name_for("acme/4x", 1), "device_4x_1");
    }
}
