//! Properties that hold for every shipped profile, whatever the registers hold.
