//! Builds the program anew when a shipped profile is added.

fn main() {
    println!("cargo::rerun-if-changed=device-profiles");
}
