"""A Modbus server made of pymodbus: unit 5, with a register bank of all types in four orders of bytes.

    server.py tcp
    server.py rtu

Prints where it listens (a port, or a path) as its first line. Each line on standard input is answered
with one line of JSON: what the holding registers and coils hold by then, as this program reads them.
Ends with its standard input.

Order number N (abcd, cdab, badc, dcba) begins at register 100 * N, in the holding and in the input
registers. Coils and discrete inputs 0 to 15: each third is on.
"""

import asyncio
import json
import os
import struct
import sys
import threading
import tty

from pymodbus.datastore import ModbusDeviceContext, ModbusSequentialDataBlock, ModbusServerContext
from pymodbus.server import ModbusSerialServer, ModbusTcpServer

UNIT = 5
ORDERS = ["abcd", "cdab", "badc", "dcba"]
# Where each type begins, how many registers it has, how struct names it, and what it holds at first.
BANK = {
    "u16": (0, 1, "H", 0xABCD),
    "i16": (1, 1, "h", -1234),
    "u32": (2, 2, "I", 0x89ABCDEF),
    "i32": (4, 2, "i", -123456789),
    "u48": (6, 3, None, 0x123456789ABC),
    "u64": (10, 4, "Q", 0xFEDCBA9876543210),
    "i64": (14, 4, "q", -1234567890123456789),
    "f32": (18, 2, "f", -12.375),
    "f64": (20, 4, "d", 2.718281828459045),
    "text": (24, 8, None, "Busker, Raum 12b"),
}
BITS = [number % 3 == 0 for number in range(16)]


def in_order(kind, order, words):
    """Puts words from most to least significant into the order, or takes them out of it."""
    if order in ("badc", "dcba"):
        words = [(word & 0xFF) << 8 | word >> 8 for word in words]
    # The letters of a text stand in the order in which they are read, whatever the numbers do.
    if order in ("cdab", "dcba") and kind != "text":
        words = words[::-1]
    return words


def to_words(kind, value):
    _, count, code, _ = BANK[kind]
    if kind == "text":
        data = value.encode().ljust(2 * count, b"\0")
    elif kind == "u48":
        data = value.to_bytes(6, "big")
    else:
        data = struct.pack(">" + code, value)
    return list(struct.unpack(f">{count}H", data))


def from_words(kind, words):
    data = struct.pack(f">{len(words)}H", *words)
    if kind == "text":
        return data.rstrip(b"\0 ").decode()
    if kind == "u48":
        return int.from_bytes(data, "big")
    return struct.unpack(">" + BANK[kind][2], data)[0]


def registers():
    words = [0] * 400
    for number, order in enumerate(ORDERS):
        for kind, (at, count, _, value) in BANK.items():
            first = 100 * number + at
            words[first : first + count] = in_order(kind, order, to_words(kind, value))
    return words


def shown(device):
    """What the device holds now. The numbers are texts, since JSON's own lose digits."""
    told = {}
    for number, order in enumerate(ORDERS):
        for kind, (at, count, _, _) in BANK.items():
            words = device.getValues(3, 100 * number + at, count)
            told[f"{order}_{kind}"] = str(from_words(kind, in_order(kind, order, words)))
    told["coils"] = "".join("1" if on else "0" for on in device.getValues(1, 0, 16))
    return json.dumps(told)


def bridge(one, other):
    """Carries bytes from one pseudo-terminal to another, as a cable does."""
    while True:
        os.write(other, os.read(one, 512))


def open_cable():
    """Two pseudo-terminals with a cable between them: the paths of their ends."""
    ends = [os.openpty() for _ in range(2)]
    for controller, terminal in ends:
        tty.setraw(terminal)
    for one, other in (ends, ends[::-1]):
        threading.Thread(target=bridge, args=(one[0], other[0]), daemon=True).start()
    return [os.ttyname(terminal) for _, terminal in ends]


async def main():
    # The first register of a block is number 1 to pymodbus, and 0 on the wire.
    def block(values):
        return ModbusSequentialDataBlock(1, list(values))

    device = ModbusDeviceContext(di=block(BITS), co=block(BITS), hr=block(registers()), ir=block(registers()))
    context = ModbusServerContext(devices={UNIT: device}, single=False)
    if sys.argv[1] == "tcp":
        server = ModbusTcpServer(context, address=("127.0.0.1", 0))
        await server.serve_forever(background=True)
        where = server.transport.sockets[0].getsockname()[1]
    else:
        ours, where = open_cable()
        server = ModbusSerialServer(context, port=ours, baudrate=19200, parity="N")
        await server.serve_forever(background=True)
    print(where, flush=True)
    loop = asyncio.get_running_loop()
    while await loop.run_in_executor(None, sys.stdin.readline):
        print(shown(device), flush=True)
    await server.shutdown()


asyncio.run(main())
