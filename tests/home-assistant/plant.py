"""Simulated devices on their lines.

They are asked directly, too, by a few lines of Modbus written here, so that an effect is seen at the device
and not only believed.
"""

import contextlib
import pathlib
import re
import socket
import struct
import subprocess
import threading

from fault import PATIENCE, Fault
from gateway import Busker


class Device:
    """One device: its profile, where it is, and what its profile says of its points."""

    def __init__(self, about: dict, description: dict, line: "Line", unit: int) -> None:
        self.profile, self.unit, self.line = about["device"], unit, line
        self.manufacturer, self.model = about["manufacturer"], about["model"]
        self.name = re.sub("[^a-z0-9]", "_", self.profile)
        # What the configuration says of it beside profile, bus and unit.
        self.wishes: dict = {}
        self.title = f"{self.manufacturer} {self.model}"
        self.identity = f"busker_{self.name}"
        self.points = {point["name"]: point for point in description["points"]}
        self.things = {thing["name"]: thing for thing in description["things"]}

    def deciding(self) -> set[str]:
        """The points that say which entities there are, or how others are to be read."""
        deciding = set()
        for point in self.points.values():
            deciding |= {point[key] for key in ("by", "unit_by", "decimals_by") if point[key]}
            deciding |= set(point["when"] or {})
            for case in (point["cases"] or {}).values():
                deciding |= {case[key] for key in ("unit_by", "decimals_by") if case and case[key]}
        for thing in self.things.values():
            deciding |= set(thing["when"] or {})
        return deciding

    def raw(self, point: str) -> list[int]:
        """What the device itself says that this point's registers hold."""
        place = self.points[point]
        return self.read(place["table"], place["address"], place["count"])

    def read(self, table: str, first: int, count: int = 1) -> list[int]:
        function = {"coil": 1, "discrete": 2, "holding": 3, "input": 4}[table]
        data = self.line.ask(self.unit, function, struct.pack(">HH", first, count))[1:]
        if function in (1, 2):
            return [data[bit // 8] >> (bit % 8) & 1 for bit in range(count)]
        return list(struct.unpack(f">{count}H", data))

    def write(self, register: int, word: int) -> None:
        """As another program, or a person with a tool, sets a holding register."""
        self.line.ask(self.unit, 6, struct.pack(">HH", register, word))

    def do(self, command: str) -> None:
        """What happens to it; as `busker simulate --help` lists it."""
        self.line.do(f"unit {self.unit} {command}")


class Line:
    """A simulator with one way in for the gateway, and one for us."""

    def __init__(self, name: str, way_in: str, units: list[str], folder: pathlib.Path, busker: Busker, ending) -> None:
        door = f"{folder}/{name}" if way_in == "pty" else "127.0.0.1:0"
        self.simulator = subprocess.Popen(
            [busker.program, "simulate", *units, f"--{way_in.replace('_', '-')}", door, "--tcp", "127.0.0.1:0"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
        )
        ending.callback(self.simulator.kill)
        # It tells its doors first; both may be of one kind.
        doors = [tuple(self.simulator.stdout.readline().split()) for _ in range(2)]
        ours = next(door for door in doors if door[0] == "tcp")
        doors.remove(ours)
        self.bus = {"serial": door} if way_in == "pty" else {way_in: doors[0][1]}
        # What its outputs do is told on and on, and nobody listens.
        threading.Thread(target=self.simulator.stdout.read, daemon=True).start()
        address, port = ours[1].rsplit(":", 1)
        self.name = name
        self.door = socket.create_connection((address, int(port)), PATIENCE)
        self.answers = self.door.makefile("rb")

    def do(self, command: str) -> None:
        self.simulator.stdin.write(command + "\n")

    def ask(self, unit: int, function: int, body: bytes) -> bytes:
        self.door.sendall(struct.pack(">HHHBB", 1, 0, len(body) + 2, unit, function) + body)
        _, _, length, _, answered = struct.unpack(">HHHBB", self.answers.read(8))
        answer = self.answers.read(length - 2)
        if answered != function:
            raise Fault(f"unit {unit} on {self.name} answered {answered:#x} {answer.hex()} to {function} {body.hex()}")
        return answer


def plant(busker: Busker, folder: pathlib.Path, ending: contextlib.ExitStack) -> list[Device]:
    """A device of every profile that has a simulator, and of the test's own, dealt out to three lines."""
    simulated = set(busker.simulated())
    profiles = [about for about in busker.profiles() if about["device"] in simulated or is_own(busker, about)]
    ways_in = {"cellar": "pty", "attic": "rtu_over_tcp", "hall": "tcp"}
    devices = []
    for number, (name, way_in) in enumerate(ways_in.items()):
        devices += connected(profiles[number :: len(ways_in)], name, way_in, folder, busker, ending)
    return sorted(devices, key=lambda device: device.profile)


def large_plant(busker: Busker, folder: pathlib.Path, ending: contextlib.ExitStack) -> list[Device]:
    """Devices with 3,000 points and more, on four Modbus TCP connections."""
    simulated = set(busker.simulated())
    profiles = [about for about in busker.profiles() if about["device"] in simulated]
    kinds = [(about, len(busker.profile(about["device"])["points"])) for about in profiles]
    lines = {name: [] for name in ("north", "east", "south", "west")}
    points = 0
    while points < 3000:
        for about, count in kinds:
            min(lines.values(), key=len).append(about)
            points += count
    devices = []
    for name, abouts in lines.items():
        for device in connected(abouts, name, "tcp", folder, busker, ending):
            # There are several of each profile.
            device.name = f"{name}_{device.unit}_{device.name}"
            device.title = f"{device.title} {name} {device.unit}"
            device.identity = f"busker_{device.name}"
            devices.append(device)
    return devices


def connected(abouts: list[dict], name: str, way_in: str, folder: pathlib.Path, busker: Busker, ending) -> list[Device]:
    """Devices of these profiles on one line, with units from 1 on."""
    units = []
    for unit, about in enumerate(abouts, 1):
        path = busker.own_profiles / f"{about['device']}.yaml"
        units += ["--profile", f"{path}@{unit}"] if is_own(busker, about) else [f"{about['device']}@{unit}"]
    line = Line(name, way_in, units, folder, busker, ending)
    return [Device(about, busker.profile(about["device"]), line, unit) for unit, about in enumerate(abouts, 1)]


def is_own(busker: Busker, about: dict) -> bool:
    return (busker.own_profiles / f"{about['device']}.yaml").exists()
