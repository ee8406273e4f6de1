//! Builds the program anew when a shipped profile is added, and lets it be linked so that less of it is resident.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

fn main() {
    println!("cargo::rerun-if-changed=device-profiles");
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed={SELDOM}");
    // Also where it is not used: a test reads it.
    let script = PathBuf::from(env::var_os("OUT_DIR").expect("cargo names a folder")).join("seldom.ld");
    let written = fs::read_to_string(SELDOM).expect("it lies in the repository");
    fs::write(&script, with_newer_names(&written)).expect("cargo's folder can be written to");
    if !is_for_this_machine() || has_chosen_a_linker() {
        return;
    }
    // What most installations never run lies together, where none of it is read into memory beside what runs.
    println!("cargo::rustc-link-arg-bins=-Wl,-T,{}", script.display());
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

/// Says for linkers which functions lie together, by the names that older compilers write.
const SELDOM: &str = "scripts/seldom.ld";

/// The script, each of its lines also for the names that newer compilers write (rustc 1.99 does, 1.95 does not):
/// `_ZN5hyper4body…` is `_RNvNtCs1Az9…_5hyper4body…` there, so from the crate on both are alike.
fn with_newer_names(script: &str) -> String {
    let lines = script.lines().map(|line| {
        let inside = line.trim().strip_prefix("*(").and_then(|line| line.strip_suffix(')'));
        // Where a line names newer ones itself, they are those of the standard library, which has had them longer.
        let Some(patterns) = inside.filter(|patterns| !patterns.contains("._R")) else {
            return format!("{line}\n");
        };
        let paths = patterns.split(' ').filter_map(|pattern| pattern.strip_prefix(".text._ZN"));
        // An implementation for a type (`*_$LT$`) begins with its module there.
        let paths = paths.filter(|path| !path.starts_with('*'));
        let newer = paths.flat_map(|path| {
            BEFORE_THE_CRATE.map(move |letters| format!(" .text._R{}_{path}", "?".repeat(letters)))
        });
        format!("        *({patterns}{})\n", newer.collect::<String>())
    });
    lines.collect()
}

/// How many letters a newer name may have before that of its crate: what kind of thing it is, how deep it lies,
/// and a number for the crate. As many as there may be, and not any (`*`): behind more of them stands no longer
/// where the function is, but for which types it was made, and what is made for those may run all the time.
const BEFORE_THE_CRATE: std::ops::RangeInclusive<usize> = 12..=34;

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
