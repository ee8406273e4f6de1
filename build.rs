//! Builds the program anew when a shipped profile is added, and lets it be linked so that less of it is resident.

use std::env;
use std::path::Path;
use std::process::Command;

fn main() {
    println!("cargo::rerun-if-changed=device-profiles");
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed={SELDOM}");
    if !is_for_this_machine() || has_chosen_a_linker() {
        return;
    }
    // What most installations never run lies together, where none of it is read into memory beside what runs.
    let folder = env::var("CARGO_MANIFEST_DIR").unwrap_or_default();
    println!("cargo::rustc-link-arg-bins=-Wl,-T,{folder}/{SELDOM}");
    if loads_packed_relocations() {
        // The list of addresses to be put right at the start is 150 kB long, and 2 kB as a bitmap. A linker
        // that does not know the word says so, and goes on.
        println!("cargo::rustc-link-arg-bins=-Wl,-z,pack-relative-relocs");
    }
    let is_release = env::var("PROFILE").is_ok_and(|profile| profile == "release");
    if is_release && has_library_for_backtraces() {
        // As a library of its own it is 100 kB, whether anything panics or not.
        println!("cargo::rustc-link-lib=static:-bundle=gcc_eh");
    }
}

/// Where it lies, for linkers.
const SELDOM: &str = "scripts/seldom.ld";

/// Whether the program is built for this machine, with GNU's C library; for others nothing is known of the
/// linker.
fn is_for_this_machine() -> bool {
    let is_native = env::var("HOST").is_ok_and(|host| env::var("TARGET") == Ok(host));
    is_native && env::var("CARGO_CFG_TARGET_ENV").is_ok_and(|library| library == "gnu")
}

/// Whether the linker is another than the compiler's usual one; it may not know what is asked for here.
fn has_chosen_a_linker() -> bool {
    let flags = env::var("CARGO_ENCODED_RUSTFLAGS").unwrap_or_default();
    env::var_os("RUSTC_LINKER").is_some() || flags.contains("-fuse-ld") || flags.contains("linker=")
}

/// Whether its C library can load such a list: glibc can from 2.36 on.
fn loads_packed_relocations() -> bool {
    let Ok(output) = Command::new("getconf").arg("GNU_LIBC_VERSION").output() else { return false };
    let told = String::from_utf8_lossy(&output.stdout);
    let version = told.trim().strip_prefix("glibc 2.").and_then(|minor| minor.parse::<u32>().ok());
    version.is_some_and(|minor| minor >= 36)
}

/// Whether the C compiler, which links, has libgcc's part for exceptions as an archive, too.
fn has_library_for_backtraces() -> bool {
    let Ok(output) = Command::new("cc").arg("-print-file-name=libgcc_eh.a").output() else { return false };
    // Where it has none, it repeats the name.
    Path::new(String::from_utf8_lossy(&output.stdout).trim()).is_absolute()
}
