//! Parses the arguments, runs one verb, prints what went wrong, sets the exit code.

fn main() {}
