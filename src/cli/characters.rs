//! How characters go over a serial line that no configuration describes.

use crate::engine::settings::{Line, Parity};
use crate::engine::yaml::Scalar;

#[derive(Debug, clap::Args)]
pub struct Characters {
    /// The line's bit rate
    #[arg(long, value_name = "RATE", default_value_t = 19200, value_parser = clap::value_parser!(u32).range(300..=1_000_000), conflicts_with = "config")]
    baud: u32,
    /// The line's parity: even, odd or none
    #[arg(long, default_value = "even", value_parser = <Parity as Scalar>::parse, conflicts_with = "config")]
    parity: Parity,
    /// The line's stop bits: 1 or 2
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=2), conflicts_with = "config")]
    stop_bits: u8,
}

impl Characters {
    pub fn line(&self) -> Line {
        Line { baud: self.baud, parity: self.parity, stop_bits: self.stop_bits }
    }
}
