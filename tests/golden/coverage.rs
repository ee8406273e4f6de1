//! Every register of a device's chapter is a point or left out with a reason, and no point is anywhere
//! else. The registers stand here as the manuals list them, not as the profiles do.

use busker::engine::address::{Address, Span, Table};
use busker::engine::device::Device;

use crate::shipped;

const ALL: u16 = 0xFFFF;

/// Registers or bits from the first to the last, and which bits of each mean something.
type Registers = (Table, u16, u16, u16);

const MANUALS: &[(&str, &[Registers])] = &[
    // METZ CONNECT V2.1: 65 on page 3, the rest on pages 6 to 8.
    (
        "metz-connect/mr-do4",
        &[
            (Table::Coil, 0, 7, ALL),
            (Table::Holding, 0, 0, 0x00FF),
            (Table::Holding, 1, 1, 0x000F),
            (Table::Holding, 65, 66, ALL),
        ],
    ),
    // Pages 6 to 8, as the MR-DO4, with coils 4 to 7 always 0.
    (
        "metz-connect/mr-doa4",
        &[
            (Table::Coil, 0, 7, ALL),
            (Table::Holding, 0, 0, 0x00FF),
            (Table::Holding, 1, 1, 0x000F),
            (Table::Holding, 65, 66, ALL),
        ],
    ),
    // Pages 10 to 13.
    (
        "metz-connect/mr-to4",
        &[
            (Table::Coil, 0, 7, ALL),
            (Table::Holding, 0, 0, 0x00FF),
            (Table::Holding, 1, 1, 0x000F),
            (Table::Holding, 2, 17, ALL),
            (Table::Holding, 65, 66, ALL),
        ],
    ),
    // Page 14.
    (
        "metz-connect/mr-di4",
        &[(Table::Discrete, 0, 3, ALL), (Table::Input, 0, 0, 0x000F), (Table::Holding, 65, 65, ALL)],
    ),
    // Page 15.
    (
        "metz-connect/mr-di10",
        &[(Table::Discrete, 0, 9, ALL), (Table::Input, 0, 0, 0x03FF), (Table::Holding, 65, 65, ALL)],
    ),
    // Pages 16 and 17.
    (
        "metz-connect/mr-si4",
        &[
            (Table::Discrete, 0, 3, ALL),
            (Table::Input, 0, 19, ALL),
            (Table::Input, 20, 20, 0x000F),
            (Table::Holding, 0, 31, ALL),
            (Table::Holding, 32, 35, 0x0001),
            (Table::Holding, 36, 39, ALL),
            (Table::Holding, 40, 43, 0x0001),
            (Table::Holding, 65, 65, ALL),
        ],
    ),
    // 65 on page 24 too, the rest on pages 21 to 24.
    (
        "metz-connect/mr-dio42",
        &[
            (Table::Coil, 0, 5, ALL),
            (Table::Coil, 8, 9, ALL),
            (Table::Discrete, 0, 3, ALL),
            (Table::Discrete, 8, 15, ALL),
            (Table::Input, 0, 2, 0xFF0F),
            (Table::Holding, 0, 0, 0x033F),
            (Table::Holding, 1, 1, 0x0003),
            (Table::Holding, 2, 17, ALL),
            (Table::Holding, 18, 19, 0x0F0F),
            (Table::Holding, 65, 66, ALL),
        ],
    ),
    // 65 on page 3, the rest on pages 36 to 42.
    (
        "metz-connect/mr-tp",
        &[
            (Table::Coil, 0, 5, ALL),
            (Table::Discrete, 0, 15, ALL),
            (Table::Input, 0, 0, ALL),
            (Table::Holding, 0, 0, 0x003F),
            (Table::Holding, 1, 1, 0x00FF),
            (Table::Holding, 2, 2, 0xF7FF),
            (Table::Holding, 3, 3, 0x003F),
            (Table::Holding, 4, 7, ALL),
            (Table::Holding, 65, 66, ALL),
        ],
    ),
    // Page 44.
    ("metz-connect/mr-ao4", &[(Table::Holding, 0, 7, ALL), (Table::Holding, 65, 66, ALL)]),
    // Page 46.
    (
        "metz-connect/mr-aop4",
        &[
            (Table::Coil, 0, 3, ALL),
            (Table::Discrete, 0, 3, ALL),
            (Table::Input, 0, 3, ALL),
            (Table::Holding, 0, 7, ALL),
            (Table::Holding, 65, 66, ALL),
        ],
    ),
    // 65 on page 3, the rest on pages 48 to 57.
    (
        "metz-connect/mr-ai8",
        &[
            (Table::Coil, 0, 0, ALL),
            (Table::Discrete, 0, 7, ALL),
            (Table::Input, 0, 15, ALL),
            (Table::Input, 70, 70, 0x00FF),
            (Table::Holding, 0, 15, ALL),
            (Table::Holding, 16, 23, 0x01FF),
            (Table::Holding, 24, 63, ALL),
            (Table::Holding, 65, 65, ALL),
            (Table::Holding, 68, 68, 0x0001),
            (Table::Holding, 70, 101, ALL),
        ],
    ),
    // Page 59.
    (
        "metz-connect/mr-ci4",
        &[(Table::Input, 0, 3, ALL), (Table::Input, 4, 4, 0x0FFF), (Table::Holding, 65, 65, ALL)],
    ),
    // Pages 60 to 78.
    (
        "metz-connect/mr-aio42",
        &[
            (Table::Input, 0, 7, ALL),
            (Table::Holding, 0, 63, ALL),
            (Table::Holding, 65, 66, ALL),
            (Table::Holding, 68, 68, ALL),
            (Table::Holding, 100, 100, 0x00FF),
            (Table::Holding, 101, 101, 0x003F),
            (Table::Holding, 102, 123, ALL),
            (Table::Holding, 130, 143, ALL),
            (Table::Holding, 151, 151, 0x003F),
            (Table::Holding, 152, 173, ALL),
            (Table::Holding, 180, 193, ALL),
            (Table::Holding, 200, 239, ALL),
        ],
    ),
    // Pages 79 to 84; register 126 is cleared as a whole.
    (
        "metz-connect/mr-sm3",
        &[
            (Table::Input, 0, 62, ALL),
            (Table::Input, 65, 127, ALL),
            (Table::Input, 256, 383, ALL),
            (Table::Input, 512, 639, ALL),
            (Table::Input, 768, 895, ALL),
            (Table::Holding, 0, 62, ALL),
            (Table::Holding, 65, 123, ALL),
            (Table::Holding, 124, 125, 0xE1FF),
            (Table::Holding, 126, 126, ALL),
            (Table::Holding, 127, 127, 0x0003),
            (Table::Holding, 256, 383, ALL),
            (Table::Holding, 512, 639, ALL),
            (Table::Holding, 768, 895, ALL),
        ],
    ),
    // Pages 87 to 98.
    (
        "metz-connect/mr-multi-io",
        &[
            (Table::Coil, 0, 7, ALL),
            (Table::Coil, 16, 19, ALL),
            (Table::Coil, 32, 32, ALL),
            (Table::Discrete, 0, 11, ALL),
            (Table::Input, 0, 13, ALL),
            (Table::Input, 70, 70, 0x0FFF),
            (Table::Input, 82, 89, ALL),
            (Table::Holding, 0, 63, ALL),
            (Table::Holding, 65, 66, ALL),
            (Table::Holding, 68, 68, 0x0001),
            (Table::Holding, 70, 70, 0x0FFF),
            (Table::Holding, 71, 71, 0x00FF),
            (Table::Holding, 72, 72, 0x000F),
            (Table::Holding, 73, 73, 0x00FF),
            (Table::Holding, 74, 75, ALL),
            (Table::Holding, 78, 79, ALL),
            (Table::Holding, 82, 92, ALL),
            (Table::Holding, 93, 93, 0x0001),
            (Table::Holding, 94, 94, ALL),
            (Table::Holding, 95, 95, 0x0001),
        ],
    ),
    // 65 on page 3, the rest on pages 104 to 108.
    (
        "metz-connect/mr-ld6",
        &[
            (Table::Coil, 0, 1, ALL),
            (Table::Discrete, 0, 5, ALL),
            (Table::Discrete, 16, 21, ALL),
            (Table::Input, 0, 1, 0x003F),
            (Table::Input, 2, 13, ALL),
            (Table::Holding, 0, 1, 0x0003),
            (Table::Holding, 2, 15, ALL),
            (Table::Holding, 16, 20, 0x003F),
            (Table::Holding, 21, 36, ALL),
            (Table::Holding, 65, 66, ALL),
        ],
    ),
    // BTR, chapters 10.1 and 10.2.
    (
        "btr/mr-ai8",
        &[(Table::Input, 0, 15, ALL), (Table::Holding, 0, 63, ALL), (Table::Holding, 65, 65, ALL)],
    ),
    // FuehlerSysteme, chapters 6.1.1, 6.1.2 and 7: Rreg are input, RWreg and Wreg holding registers.
    (
        "fuehlersysteme/relay8",
        &[
            (Table::Input, 0, 8, ALL),
            (Table::Input, 9, 9, 0x00FF),
            (Table::Input, 79, 79, ALL),
            (Table::Input, 100, 227, ALL),
            (Table::Holding, 0, 9, ALL),
            (Table::Holding, 11, 18, ALL),
            (Table::Holding, 19, 19, 0x00FF),
            (Table::Holding, 21, 28, ALL),
            (Table::Holding, 31, 38, ALL),
            (Table::Holding, 40, 40, 0x00FF),
            (Table::Holding, 41, 49, ALL),
            (Table::Holding, 51, 58, ALL),
            (Table::Holding, 61, 68, ALL),
            (Table::Holding, 69, 69, 0x00FF),
            (Table::Holding, 71, 79, ALL),
            (Table::Holding, 90, 99, ALL),
            (Table::Holding, 200, 327, ALL),
            (Table::Holding, 500, 627, ALL),
        ],
    ),
    // Chapters 6.2.1, 6.2.2 and 7.
    (
        "fuehlersysteme/analog-out8",
        &[
            (Table::Input, 0, 8, ALL),
            (Table::Input, 79, 79, ALL),
            (Table::Input, 100, 227, ALL),
            (Table::Holding, 0, 8, ALL),
            (Table::Holding, 10, 10, 0x00FF),
            (Table::Holding, 11, 18, ALL),
            (Table::Holding, 21, 28, ALL),
            (Table::Holding, 31, 38, ALL),
            (Table::Holding, 40, 40, 0x00FF),
            (Table::Holding, 41, 48, ALL),
            (Table::Holding, 51, 58, ALL),
            (Table::Holding, 61, 68, ALL),
            (Table::Holding, 79, 79, ALL),
            (Table::Holding, 90, 99, ALL),
            (Table::Holding, 200, 327, ALL),
            (Table::Holding, 500, 627, ALL),
        ],
    ),
    // Chapters 6.3.1, 6.3.2 and 7.
    (
        "fuehlersysteme/analog-in8",
        &[
            (Table::Input, 0, 8, ALL),
            (Table::Input, 11, 18, ALL),
            (Table::Input, 79, 79, ALL),
            (Table::Input, 100, 227, ALL),
            (Table::Holding, 0, 8, ALL),
            (Table::Holding, 11, 18, ALL),
            (Table::Holding, 21, 28, ALL),
            (Table::Holding, 31, 38, ALL),
            (Table::Holding, 41, 48, ALL),
            (Table::Holding, 49, 50, 0x00FF),
            (Table::Holding, 51, 59, ALL),
            (Table::Holding, 79, 79, ALL),
            (Table::Holding, 200, 327, ALL),
            (Table::Holding, 500, 627, ALL),
        ],
    ),
    // Chapters 3 and 7.
    (
        "fuehlersysteme/sensor",
        &[
            (Table::Input, 0, 6, ALL),
            (Table::Input, 10, 15, ALL),
            (Table::Input, 19, 19, 0x0077),
            (Table::Input, 20, 23, ALL),
            (Table::Input, 30, 31, ALL),
            (Table::Input, 35, 38, ALL),
            (Table::Input, 40, 45, ALL),
            (Table::Input, 47, 47, ALL),
            (Table::Input, 50, 50, ALL),
            (Table::Input, 55, 58, ALL),
            (Table::Input, 79, 79, ALL),
            (Table::Input, 100, 139, ALL),
            (Table::Holding, 0, 6, ALL),
            (Table::Holding, 8, 15, ALL),
            (Table::Holding, 18, 18, ALL),
            (Table::Holding, 19, 19, 0x0077),
            (Table::Holding, 20, 38, ALL),
            (Table::Holding, 40, 45, ALL),
            (Table::Holding, 47, 48, ALL),
            (Table::Holding, 50, 55, ALL),
            (Table::Holding, 57, 75, ALL),
            (Table::Holding, 79, 80, ALL),
            (Table::Holding, 90, 99, ALL),
            (Table::Holding, 200, 239, ALL),
            (Table::Holding, 500, 539, ALL),
        ],
    ),
];

#[test]
fn every_register_of_the_manual_is_a_point_or_left_out_and_nothing_else_is() {
    for (id, device) in shipped() {
        let (_, chapter) =
            MANUALS.iter().find(|(profile, _)| profile == id).unwrap_or_else(|| panic!("{id}: no registers"));
        for table in Table::ALL {
            for at in 0..=1000 {
                let place = Span::single(table, at);
                let in_manual = chapter
                    .iter()
                    .filter(|(of, first, last, _)| *of == table && (*first..=*last).contains(&at))
                    .fold(0, |bits, (_, _, _, more)| bits | more);
                let in_profile = bits_of_points(device, place);
                let is_left_out = device.left_out.iter().any(|left_out| left_out.span.contains(place));
                assert_eq!(in_profile & !in_manual, 0, "{id}: {place} has points that the manual has not");
                assert!(
                    is_left_out || in_manual & !in_profile == 0,
                    "{id}: {place} has bits {:04X} without a point",
                    in_manual & !in_profile
                );
                assert!(!is_left_out || in_manual != 0, "{id}: {place} is left out of nothing");
            }
        }
    }
}

/// Which bits of `place` some point reads or writes.
fn bits_of_points(device: &Device, place: Span) -> u16 {
    let of_address = |address: Address| {
        if !address.span.contains(place) {
            return 0;
        }
        address.bits.map_or(ALL, |bits| bits.mask())
    };
    device
        .points
        .iter()
        .flat_map(|point| [Some(point.at), point.also, point.write.as_ref().map(|write| write.at)])
        .flatten()
        .fold(0, |bits, address| bits | of_address(address))
}
