"""What Home Assistant meets: a mosquitto, the gateway, and simulated devices on three lines.

The devices are asked directly, too, by a few lines of Modbus written here, so that an effect is seen at
the device and not only believed.
"""

import contextlib
import json
import pathlib
import re
import signal
import socket
import struct
import subprocess
import threading
import time

import paho.mqtt.client as mqtt

PATIENCE = 30  # seconds until something that must happen has failed
# Profiles of the test's own, for what no shipped one has.
OWN_PROFILES = pathlib.Path(__file__).parent / "profiles"


class Fault(Exception):
    """Something is not as it should be."""


class Busker:
    """The built program, and what it knows of profiles."""

    def __init__(self, program: str) -> None:
        self.program = program

    def tell(self, *arguments: str) -> str:
        return subprocess.run([self.program, *arguments], check=True, stdout=subprocess.PIPE, text=True).stdout

    def profiles(self) -> list[dict]:
        return json.loads(self.tell("profiles", "list", "--profiles", str(OWN_PROFILES), "--json"))

    def profile(self, profile: str) -> dict:
        return json.loads(self.tell("profiles", "show", "--profiles", str(OWN_PROFILES), profile, "--json"))

    def simulated(self) -> list[str]:
        """The models that there is a simulator for."""
        devices = self.tell("simulate", "--help").split("\nDevices:\n")[1].split("\n\n")[0]
        return devices.split()


class Device:
    """One device: its profile, where it is, and what its profile says of its points."""

    def __init__(self, about: dict, description: dict, line: "Line", unit: int) -> None:
        self.profile, self.unit, self.line = about["device"], unit, line
        self.manufacturer, self.model = about["manufacturer"], about["model"]
        self.name = re.sub("[^a-z0-9]", "_", self.profile)
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
    profiles = [about for about in busker.profiles() if about["device"] in simulated or is_own(about)]
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
        path = f"{OWN_PROFILES}/{about['device']}.yaml"
        units += ["--profile", f"{path}@{unit}"] if is_own(about) else [f"{about['device']}@{unit}"]
    line = Line(name, way_in, units, folder, busker, ending)
    return [Device(about, busker.profile(about["device"]), line, unit) for unit, about in enumerate(abouts, 1)]


def is_own(about: dict) -> bool:
    return (OWN_PROFILES / f"{about['device']}.yaml").exists()


class Gateway:
    """`busker run`, with a configuration that can be changed while it is stopped."""

    def __init__(self, busker: Busker, folder: pathlib.Path, broker: "Broker", devices, ending, wishes: dict) -> None:
        self.busker, self.folder, self.broker, self.ending = busker, folder, broker, ending
        # What the configuration says beside devices and their lines.
        self.wishes = wishes
        self.devices = list(devices)
        self.start()

    def configure(self) -> pathlib.Path:
        buses = {device.line.name: device.line.bus for device in self.devices}
        settings = {
            "http": {"listen": None},
            "profiles": [str(OWN_PROFILES)],
            "state_dir": f"{self.folder}/state",
            **self.wishes,
            "mqtt": {"url": f"mqtt://127.0.0.1:{self.broker.port}", **self.wishes.get("mqtt", {})},
            "buses": buses,
            "devices": {
                device.name: {"profile": device.profile, "bus": device.line.name, "unit": device.unit,
                              "name": device.title}
                for device in self.devices
            },
        }
        configuration = self.folder / "busker.yaml"
        configuration.write_text(json.dumps(settings))
        return configuration

    def reload(self) -> None:
        """Takes the configuration as it is now, and goes on."""
        self.configure()
        self.process.send_signal(signal.SIGHUP)

    def start(self) -> None:
        configuration = self.configure()
        with (self.folder / "gateway.log").open("a") as log:
            self.process = subprocess.Popen(
                [self.busker.program, "run", "--config", str(configuration)], stdin=subprocess.DEVNULL,
                stdout=log, stderr=log,
            )
        self.ending.callback(self.process.kill)

    def stop(self) -> None:
        self.process.terminate()
        code = self.process.wait(PATIENCE)
        if code != 0:
            raise Fault(f"the gateway ended with the exit code {code}")

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(PATIENCE)

    def log(self) -> str:
        return (self.folder / "gateway.log").read_text()


class Broker:
    """A mosquitto on a free port."""

    def __init__(self, folder: pathlib.Path, ending: contextlib.ExitStack) -> None:
        self.port = free_port()
        self.memory = folder / "mosquitto.db"
        self.settings = folder / "mosquitto.conf"
        self.settings.write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous true\npersistence true\n"
            f"persistence_file mosquitto.db\npersistence_location {folder}/\nuser root\n"
            # Else each answer waits 40 ms for the next one.
            "set_tcp_nodelay true\n"
        )
        self.ending = ending
        self.start()

    def start(self) -> None:
        nowhere = subprocess.DEVNULL
        self.process = subprocess.Popen(["mosquitto", "-c", str(self.settings)], stdout=nowhere, stderr=nowhere)
        self.ending.callback(self.process.kill)
        wait_for_port(self.port)

    def stop(self, forget: bool) -> None:
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(PATIENCE)
        if forget:
            self.memory.unlink(missing_ok=True)

    def retained(self, names: list[str]) -> dict[str, str]:
        """What the broker holds of discovery and of the devices of these names.

        Asked for in parts, as a mosquitto drops what it would have to queue beyond a thousand messages.
        """
        found = {}

        def receive(message) -> None:
            if message.retain and message.payload:
                found[message.topic] = message.payload.decode()

        with self.listening(["test/marker"], receive) as ears:
            for part in ["homeassistant/#", *(f"busker/{name}/#" for name in ["bridge", *names])]:
                ears.client.subscribe(part, 1)
                # It has all been sent when a message of our own comes back.
                ears.client.publish("test/marker", part, 1)
                ears.wait_for(lambda _, payload: payload == part, "the end of what the broker holds")
        return found

    @contextlib.contextmanager
    def witness(self, topics: list[str], heard: dict[str, str]):
        """Keeps in `heard` what was last said on each topic, be it retained or not."""

        def receive(message) -> None:
            if message.payload:
                heard[message.topic] = message.payload.decode()
            else:
                heard.pop(message.topic, None)

        with self.listening(topics, receive):
            yield

    @contextlib.contextmanager
    def listening(self, topics: list[str], receive=lambda _: None):
        client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        ears = Ears(client)

        def on_message(_client, _userdata, message) -> None:
            receive(message)
            ears.notice(message.topic, message.payload.decode())

        client.on_message = on_message
        client.on_connect = lambda *_: client.subscribe([(topic, 1) for topic in topics])
        client.on_socket_open = lambda _client, _userdata, link: link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.on_subscribe = lambda *_: ears.notice("subscribed", "")
        client.connect("127.0.0.1", self.port)
        client.loop_start()
        try:
            ears.wait_for(lambda topic, _: topic == "subscribed", "the broker's confirmation")
            yield ears
        finally:
            client.disconnect()
            client.loop_stop()


class Ears:
    """What was heard since they were opened."""

    def __init__(self, client: mqtt.Client) -> None:
        self.client, self.heard, self.news = client, [], threading.Condition()

    def notice(self, topic: str, payload: str) -> None:
        with self.news:
            self.heard.append((topic, payload))
            self.news.notify()

    def wait_for(self, fits, what: str) -> None:
        """Waits for a message that fits, which may have come already."""
        looked_at = 0

        def is_there() -> bool:
            nonlocal looked_at
            new, looked_at = self.heard[looked_at:], len(self.heard)
            return any(fits(topic, payload) for topic, payload in new)

        with self.news:
            if not self.news.wait_for(is_there, PATIENCE):
                raise Fault(f"{what} was not heard")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_for_port(port: int) -> None:
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), 1).close()
            return
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.02)
