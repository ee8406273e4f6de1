//! Builds the program anew when a shipped profile is added, and lets it be linked so that less of it is resident.

use std::env;
use std::process::Command;

fn main() {
    println!("cargo::rerun-if-changed=device-profiles");
    println!("cargo::rerun-if-changed=build.rs");
    if loads_packed_relocations() {
        // The list of addresses to be put right at the start is 150 kB long, and 2 kB as a bitmap. A linker
        // that does not know the word says so, and goes on.
        println!("cargo::rustc-link-arg-bins=-Wl,-z,pack-relative-relocs");
    }
}

/// Whether the program is built for this machine, and its C library can load such a list: glibc can from
/// 2.36 on.
fn loads_packed_relocations() -> bool {
    let is_for_this_machine = env::var("HOST").is_ok_and(|host| env::var("TARGET") == Ok(host));
    let is_glibc = env::var("CARGO_CFG_TARGET_ENV").is_ok_and(|library| library == "gnu");
    if !is_for_this_machine || !is_glibc {
        return false;
    }
    let Ok(output) = Command::new("getconf").arg("GNU_LIBC_VERSION").output() else { return false };
    let told = String::from_utf8_lossy(&output.stdout);
    let version = told.trim().strip_prefix("glibc 2.").and_then(|minor| minor.parse::<u32>().ok());
    version.is_some_and(|minor| minor >= 36)
}
