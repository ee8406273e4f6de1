"""Reads and writes the simulated devices with pymodbus, and compares every value.

    client.py tcp HOST PORT
    client.py rtu PATH

The devices are mr-do4 at 18, mr-ai8 at 19, mr-si4 at 20 and relay8 at 7, with these signals: mr-do4
relay 2 switched on by hand; mr-ai8 input 1 107.794 ohms, input 2 2.5 volts; mr-si4 counter 1 at
0x00123456789A and input 4 closed. Prints each difference, and ends with 1 if there was one.
"""

import sys
import time

from pymodbus.client import ModbusSerialClient, ModbusTcpClient

DO4, AI8, SI4, RELAY8 = 18, 19, 20, 7

checks = 0
differences = 0


def same(what, got, wanted):
    global checks, differences
    checks += 1
    if got != wanted:
        differences += 1
        print(f"{what}: got {got}, wanted {wanted}")


class Device:
    """One unit, whose answers are plain lists, or `exception N`."""

    def __init__(self, client, unit):
        self.client = client
        self.unit = {"device_id": unit}

    def answer(self, response, values):
        if response.isError():
            return f"exception {response.exception_code}"
        return values(response)

    def coils(self, first, count):
        response = self.client.read_coils(first, count=count, **self.unit)
        return self.answer(response, lambda r: r.bits[:count])

    def discrete(self, first, count):
        response = self.client.read_discrete_inputs(first, count=count, **self.unit)
        return self.answer(response, lambda r: r.bits[:count])

    def holding(self, first, count=1):
        response = self.client.read_holding_registers(first, count=count, **self.unit)
        return self.answer(response, lambda r: r.registers)

    def input(self, first, count=1):
        response = self.client.read_input_registers(first, count=count, **self.unit)
        return self.answer(response, lambda r: r.registers)

    def set_coil(self, at, on):
        return self.answer(self.client.write_coil(at, on, **self.unit), lambda r: "written")

    def set_coils(self, first, values):
        return self.answer(self.client.write_coils(first, values, **self.unit), lambda r: r.count)

    def set_one(self, at, word):
        return self.answer(self.client.write_register(at, word, **self.unit), lambda r: r.registers)

    def set(self, first, words):
        return self.answer(self.client.write_registers(first, words, **self.unit), lambda r: r.count)

    def written(self, first, words):
        """Writes with function 16 and reads back."""
        same(f"{self.unit} write {first} {words}", self.set(first, words), len(words))
        same(f"{self.unit} read back {first}", self.holding(first, len(words)), words)

    def refuses(self, code, *answers):
        for number, answer in enumerate(answers):
            same(f"{self.unit} refusal {number} with {code}", answer, f"exception {code}")


def identity(device, product, version):
    response = device.client.read_device_information(read_code=1, object_id=0, **device.unit)
    information = device.answer(response, lambda r: dict(r.information))
    same(product, information, {0: b"METZ CONNECT GmbH", 1: product.encode(), 2: version.encode()})
    same(f"{product} conformity", device.answer(response, lambda r: (r.conformity, r.more_follows)), (1, 0))


def diagnostics(device):
    client, unit = device.client, device.unit
    echo = client.diag_query_data(b"\x12\x34", **unit)
    same("echo", device.answer(echo, lambda r: r.message), b"\x12\x34")
    same("cleared", client.diag_clear_counters(**unit).isError(), False)
    device.refuses(1, device.answer(client.read_exception_status(**unit), lambda r: r.status))
    counters = [
        ("device messages", client.diag_read_device_message_count, 2),
        ("exceptions", client.diag_read_bus_exception_error_count, 1),
        ("damaged frames", client.diag_read_bus_comm_error_count, 0),
        ("unanswered", client.diag_read_device_no_response_count, 0),
        ("bus messages", client.diag_read_bus_message_count, 6),
    ]
    for name, count, wanted in counters:
        same(name, device.answer(count(**unit), lambda r: r.message), wanted)


def mr_do4(device):
    identity(device, "MR-DO4", "V1.4")
    diagnostics(device)
    off, on = False, True
    same("coils", device.set_coils(0, [on, off, off, on]), 4)
    same("coils", device.coils(0, 8), [on, on, off, on, off, on, off, off])
    same("coil 3", device.set_coil(3, off), "written")
    same("coil 2", device.set_coil(2, on), "written")
    same("coils", device.coils(0, 4), [on, on, on, off])
    same("coils from 5", device.coils(5, 3), [on, off, off])
    same("register 0", device.holding(0, 1), [0x27])
    device.written(1, [0b1010])
    same("registers 0 and 1", device.set(0, [0b1000, 0b0101]), 2)
    same("registers 0 and 1", device.holding(0, 2), [0x2A, 0b0101])
    same("register 66", device.set_one(66, 3000), [3000])
    same("register 66", device.holding(66), [3000])
    same("register 66", device.set_one(66, 0), [0])
    same("register 65", device.set_one(65, 0x5315), [0x5315])
    device.refuses(1, device.discrete(0, 1), device.input(0))
    device.refuses(2, device.coils(7, 2), device.holding(2), device.holding(1, 2), device.holding(65))
    device.refuses(2, device.set_coil(4, on), device.set_one(2, 0), device.set(66, [0, 0]))
    device.refuses(3, device.coils(0, 9), device.holding(0, 3), device.set_coils(0, [on] * 5))
    device.refuses(3, device.set_one(65, 0x0015))


def mr_si4(device):
    identity(device, "MR-SI4", "V2.1")
    same("discrete inputs", device.discrete(0, 4), [False, False, False, True])
    # BZ of input 1: 0x00123456789A pulses, one decimal, cut to seven digits.
    reading = 0x00123456789A * 10 % 10**7
    counters = [0x0012, 0x3456, 0x789A] + [0] * 6 + [0, 0, 1]
    readings = [reading >> 16, reading & 0xFFFF] + [0] * 4 + [0, 10]
    same("input registers", device.input(0, 21), counters + readings + [8])
    same("counter 1", device.input(0, 3), [0x0012, 0x3456, 0x789A])
    same("INPUT", device.input(20), [8])
    factory = [0] * 20 + [1] * 12 + [0] * 4 + [0x0701] * 4 + [1] * 4
    same("factory settings", device.holding(0, 44), factory)
    other = list(range(0x100, 0x114)) + list(range(1, 13)) + [0, 1, 0, 1]
    other += [0x0903, 0x0802, 0x0701, 0x0000] + [0, 1, 0, 1]
    device.written(0, other)
    for at in range(20, 44):
        same(f"register {at}", device.set_one(at, factory[at]), [factory[at]])
    device.written(0, factory)
    same("limits", device.set_one(36, 0xFF09), [0xFF09])
    same("limits", device.holding(36), [0x0903])
    device.written(36, [0x0701])
    same("register 65", device.set(65, [0x5315]), 1)
    device.refuses(1, device.coils(0, 1), device.set_coil(0, True))
    device.refuses(2, device.input(0, 2), device.input(1, 3), device.input(12, 1), device.input(20, 2))
    device.refuses(2, device.holding(43, 2), device.holding(65), device.discrete(3, 2))
    device.refuses(2, device.set_one(19, 0), device.set(0, [0, 0]))
    device.refuses(3, device.discrete(0, 5))


def measured(device, first, count):
    """The value after the next measurement: after a new code it is 0 until then."""
    deadline = time.monotonic() + 10
    got = device.input(first, count)
    while not any(got) and time.monotonic() < deadline:
        got = device.input(first, count)
    return got


def mr_ai8(device):
    identity(device, "MR-AI8", "V1.8")
    # PT100 and voltage as floats; then as integers; then in °F, which the voltage does not mind.
    device.written(16, [0x80, 0x00])
    same("2.5 V", measured(device, 2, 2), [0x4020, 0x0000])
    float_type = device.client.DATATYPE.FLOAT32
    celsius = device.client.convert_from_registers(measured(device, 0, 2), float_type)
    same("20 °C", round(celsius, 2), 20.0)
    device.written(16, [0x81, 0x01])
    same("20 °C and 2.5 V", measured(device, 0, 2) + measured(device, 2, 2), [200, 0, 8000, 0])
    same("coil 0", device.set_coil(0, True), "written")
    same("register 68", device.holding(68), [1])
    same("input 0", device.input(0, 4), [680, 0, 8000, 0])
    same("register 68", device.set_one(68, 0), [0])
    same("coil 0", device.coils(0, 1), [False])
    device.written(0, [0xFFF6, 0, 5, 0])
    same("offsets", device.input(0, 4), [190, 0, 8005, 0])
    # Every register is its own: 0 to 15, 24 to 63 and 70 to 101 take anything, 16 to 23 their codes.
    device.written(0, list(range(1, 17)))
    device.written(16, [0x80, 0x83, 0x100, 0x21, 0x44, 0xF3, 0x9B, 0xFB])
    device.written(24, list(range(0x200, 0x228)))
    device.written(70, list(range(0x300, 0x320)))
    same("float 5 at 25, register by register", device.set_one(25, 0x4321), [0x4321])
    same("registers 24 and 25", device.holding(24, 2), [0x200, 0x4321])
    # Thresholds of input 1: on above 15.0 °C, off below 10.0; of input 2, turned over, the same volts.
    device.written(0, [0] * 16)
    device.written(16, [0x81, 0x101] + [0] * 6)
    device.written(70, [150, 0, 100, 0, 8001, 0, 7000, 0] + [0] * 24)
    same("20 °C and 2.5 V", measured(device, 0, 2) + measured(device, 2, 2), [200, 0, 8000, 0])
    same("threshold states", device.discrete(0, 8), [True, True] + [False] * 6)
    same("threshold states", device.input(70), [3])
    same("register 65", device.set_one(65, 0x5315), [0x5315])
    device.refuses(1, device.set_coils(0, [True]))
    device.refuses(2, device.input(15, 2), device.input(16), device.holding(64), device.holding(60, 5))
    device.refuses(2, device.holding(67), device.holding(69), device.holding(102), device.discrete(8, 1))
    device.refuses(2, device.set_coil(1, True), device.set_one(66, 0), device.set(63, [0, 0]))
    device.refuses(3, device.input(0, 17), device.set_one(16, 0x02), device.discrete(0, 9))


def relay8(device):
    same("input registers", device.input(0, 10), [0x5000] + [0] * 9)
    same("software", device.input(79), [1018])
    for first in range(100, 228, 8):
        same(f"Wreg_{first + 400}", device.set(first + 400, list(range(first, first + 8))), 8)
        same(f"Rreg_{first}", device.input(first, 8), list(range(first, first + 8)))
    device.written(0, [0x4102] + [0, 1] * 4 + [11111])
    same("fixed states", device.input(1, 9), [0, 1] * 4 + [0xAA])
    device.written(1, [11111] * 8 + [0x0F])
    same("fixed bits", device.input(1, 9), [1] * 4 + [0] * 4 + [0x0F])
    device.written(9, [11111])
    for first, values in [
        (31, [100, 200, 300, 400, 500, 600, 700, 9999]),
        (21, [0xD8F1, 0, 10, 20, 30, 40, 50, 9998]),
        (51, [1, 2, 3, 4, 5, 6, 7, 1800]),
        (61, [1, 2, 3, 4, 5, 6, 7, 1800]),
        (71, [1, 2, 3, 4, 5, 6, 7, 60]),
        (90, list(range(1, 11))),
        (40, [0x81]),
        (69, [0x42]),
        (79, [0]),
    ]:
        device.written(first, values)
        for at, value in enumerate(values, first):
            same(f"RWreg_{at}", device.set_one(at, value), [value])
    for first in range(200, 328, 8):
        device.written(first, [0x0100 + first] * 8)
    for first in (21, 51, 61, 71):
        device.written(first, [0] * 8)
    device.written(40, [0])
    device.written(69, [0])
    # Measured values and the bits of 19 displace each other; on at 100, off at 0.
    device.written(11, [100, 11111])
    device.written(19, [2])
    same("relays 1 and 2", device.input(9), [3])
    device.written(11, [0])
    same("relay 2", device.input(9), [2])
    same("reset", device.set(41, [1] * 8 + [0xFF]), 9)
    same("resets are 0 again", device.holding(41, 9), [0] * 9)
    # Limited, used, and refused all the same; function 6 answers with function 4's exception.
    device.refuses(3, device.set_one(51, 1801), device.set(52, [1801, 5]))
    same("limited", device.holding(51, 3), [1800, 1800, 5])
    device.refuses(1, device.coils(0, 1), device.set_coil(0, True))
    device.refuses(2, device.input(10), device.holding(9, 2), device.holding(500), device.set_one(30, 0))
    device.refuses(3, device.input(0, 11), device.holding(200, 11), device.set(200, [0] * 11))
    same("factory settings", device.set_one(79, 20), [20])
    same("factory settings", device.holding(0, 2), [0x5300, 11111])


def main():
    kind, *where = sys.argv[1:]
    if kind == "tcp":
        client = ModbusTcpClient(where[0], port=int(where[1]), timeout=5, retries=0)
    else:
        # A pseudo-terminal has no parity, and the C library takes asking for it as an error.
        client = ModbusSerialClient(where[0], baudrate=19200, parity="N", timeout=5, retries=0)
    if not client.connect():
        print(f"no connection: {where}")
        return 1
    for unit, check in [(DO4, mr_do4), (SI4, mr_si4), (AI8, mr_ai8), (RELAY8, relay8)]:
        check(Device(client, unit))
    client.close()
    print(f"{checks} checks, {differences} differences")
    return 1 if differences else 0


sys.exit(main())
