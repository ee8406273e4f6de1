//! What a serial port's driver is asked beyond the line settings: who switches an RS485 transceiver, and
//! not to keep bytes back. The only file with `unsafe`.
//!
//! The kernel answers both through `ioctl(2)` with a structure of its own, and no kept library has these
//! calls (see docs/decisions/serial-port-through-rustix.md). A call whose structure is too small would let
//! the kernel write past it, which no compiler can see: so each number stands here beside its structure, and
//! nothing outside passes either.

#![allow(unsafe_code, reason = "the kernel's structures are known here and to no library")]

use std::os::fd::AsFd;

use rustix::io::Errno;
use rustix::ioctl::{Getter, Opcode, Setter, Updater, ioctl};

use crate::engine::settings::Direction;
use crate::engine::time::Duration;

/// `struct serial_rs485` of linux/serial.h.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct SerialRs485 {
    flags: u32,
    delay_rts_before_send: u32,
    delay_rts_after_send: u32,
    /// Addresses that only some drivers know; kept as they are.
    others: [u32; 5],
}

const RS485_ENABLED: u32 = 1 << 0;
const RS485_RTS_ON_SEND: u32 = 1 << 1;
const RS485_RTS_AFTER_SEND: u32 = 1 << 2;

/// `struct serial_struct` of linux/serial.h, of which only the flags matter here.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
struct SerialStruct {
    kind: i32,
    line: i32,
    port: u32,
    irq: i32,
    flags: i32,
    xmit_fifo_size: i32,
    custom_divisor: i32,
    baud_base: i32,
    close_delay: u16,
    io_type: u8,
    reserved: u8,
    hub6: i32,
    closing_wait: u16,
    closing_wait2: u16,
    iomem_base: usize,
    iomem_reg_shift: u16,
    port_high: u32,
    iomap_base: usize,
}

const LOW_LATENCY: i32 = 1 << 13;

// The same on x86, ARM, RISC-V and PowerPC (asm-generic/ioctls.h).
const TIOCGSERIAL: Opcode = 0x541E;
const TIOCSSERIAL: Opcode = 0x541F;
const TIOCGRS485: Opcode = 0x542E;
const TIOCSRS485: Opcode = 0x542F;

const _: () = assert!(size_of::<SerialRs485>() == 32);
const _: () = assert!(size_of::<SerialStruct>() == if size_of::<usize>() == 8 { 72 } else { 60 });

/// How the kernel switches the transceiver; `None`: not at all. An error: the driver cannot.
pub fn direction(port: impl AsFd) -> Result<Option<Direction>, Errno> {
    let found = rs485(port)?;
    Ok((found.flags & RS485_ENABLED != 0).then(|| Direction {
        rts_on_send: found.flags & RS485_RTS_ON_SEND != 0,
        delay_before_send: Duration::from_millis(found.delay_rts_before_send.into()),
        delay_after_send: Duration::from_millis(found.delay_rts_after_send.into()),
    }))
}

/// Lets the kernel switch the transceiver, or `None`: no longer. What the driver made of it is returned: it
/// may know no delays.
pub fn set_direction(port: impl AsFd, wanted: Option<Direction>) -> Result<Option<Direction>, Errno> {
    let mut request = rs485(&port)?;
    request.flags &= !(RS485_ENABLED | RS485_RTS_ON_SEND | RS485_RTS_AFTER_SEND);
    if let Some(wanted) = wanted {
        request.flags |= RS485_ENABLED;
        request.flags |= if wanted.rts_on_send { RS485_RTS_ON_SEND } else { RS485_RTS_AFTER_SEND };
        request.delay_rts_before_send = wanted.delay_before_send.as_millis() as u32;
        request.delay_rts_after_send = wanted.delay_after_send.as_millis() as u32;
    }
    // SAFETY: TIOCSRS485 reads a `struct serial_rs485` and writes one back to the same place.
    unsafe { ioctl(&port, Updater::<TIOCSRS485, SerialRs485>::new(&mut request)) }?;
    direction(port)
}

/// Whether the driver can switch a transceiver: it is told once more what it holds.
pub fn can_switch(port: impl AsFd) -> bool {
    let Ok(mut held) = rs485(&port) else { return false };
    // SAFETY: as in `set_direction`.
    unsafe { ioctl(&port, Updater::<TIOCSRS485, SerialRs485>::new(&mut held)) }.is_ok()
}

/// Whether bytes are handed over as they come; an error: the driver knows no such flag.
pub fn low_latency(port: impl AsFd) -> Result<bool, Errno> {
    Ok(serial(port)?.flags & LOW_LATENCY != 0)
}

/// Asks for bytes to be handed over as they come. An FTDI adapter then waits 1 ms for more and not 16.
pub fn set_low_latency(port: impl AsFd) -> Result<(), Errno> {
    let mut settings = serial(&port)?;
    if settings.flags & LOW_LATENCY != 0 {
        return Ok(());
    }
    settings.flags |= LOW_LATENCY;
    // SAFETY: TIOCSSERIAL reads a `struct serial_struct`.
    unsafe { ioctl(&port, Setter::<TIOCSSERIAL, SerialStruct>::new(settings)) }
}

fn rs485(port: impl AsFd) -> Result<SerialRs485, Errno> {
    // SAFETY: TIOCGRS485 writes a `struct serial_rs485`; where it fails nothing is taken for one.
    unsafe { ioctl(port, Getter::<TIOCGRS485, SerialRs485>::new()) }
}

fn serial(port: impl AsFd) -> Result<SerialStruct, Errno> {
    // SAFETY: TIOCGSERIAL writes a `struct serial_struct`; where it fails nothing is taken for one.
    unsafe { ioctl(port, Getter::<TIOCGSERIAL, SerialStruct>::new()) }
}
