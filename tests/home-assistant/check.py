"""The Home Assistant test: what a user sees of the four devices, and what happens when he acts.

    .home-assistant/venv/bin/python tests/home-assistant/check.py BUSKER

Everything is real but the devices: mosquitto, Home Assistant, the built gateway over Modbus TCP. The
devices are asked directly, too, by a few lines of Modbus written here, so that an effect is seen at the
device and not only believed.
"""

import contextlib
import json
import pathlib
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time

import paho.mqtt.client as mqtt

HERE = pathlib.Path(__file__).parent
BUSKER = sys.argv[1]
PATIENCE = 30  # seconds until something that must happen has failed

# What Home Assistant and its MQTT client may say themselves when their broker is stopped.
BROKER_WAS_LOST = (
    "mqtt.client: Error returned from MQTT server: The connection was lost.",
    "paho.mqtt.client: failed to receive on socket: [Errno 104] Connection reset by peer",
)

# name in the configuration, profile, unit
DEVICES = [
    ("relays", "metz-connect/mr-do4", 1),
    ("inputs", "metz-connect/mr-ai8", 2),
    ("meters", "metz-connect/mr-si4", 3),
    ("board", "fuehlersysteme/relay8", 4),
]


def facts(platform: str, **more) -> dict:
    return {"platform": platform, "enabled": True, "category": None, "known": True, **more}


def every(unique_id: str, numbers: range, what: dict) -> dict:
    return {unique_id.format(number): what for number in numbers}


# What a user finds who has just connected the four devices: all that is enabled.
EXPECTED = {
    **every("busker_relays_relay_{}", range(1, 5), facts("switch", state="off")),
    **every("busker_relays_relay_{}_hand", range(1, 5), facts("binary_sensor", category="diagnostic", state="off")),
    "busker_relays_watchdog": facts(
        "number", category="config", unit="s", device_class="duration", min=0, max=655.35, state="0.0"
    ),
    "busker_inputs_temperature_unit": facts("select", category="config", options=["°C", "°F"], state="°C"),
    **every(
        "busker_inputs_channel_{}_value_v",
        range(1, 9),
        facts("sensor", unit="V", device_class="voltage", state_class="measurement"),
    ),
    **every("busker_inputs_channel_{}_code", range(1, 9), facts("select", category="config", state="voltage")),
    **every("busker_meters_meter_{}_reading", range(1, 5), facts("sensor", state_class="total_increasing")),
    **every("busker_board_relay_{}_state", range(1, 9), facts("binary_sensor", state="off")),
    **every(
        "busker_board_relay_{}_order",
        range(1, 9),
        facts("select", options=["OFF", "ON", "automatic"], state="automatic"),
    ),
    "busker_board_software": facts("sensor", category="diagnostic"),
    # A button has no state before it is pressed.
    "busker_board_restart": facts("button", category="config", device_class="restart", known=False),
}


def main() -> None:
    with contextlib.ExitStack() as ending, tempfile.TemporaryDirectory(prefix="busker-ha-") as folder:
        folder = pathlib.Path(folder)
        broker = Broker(folder, ending)
        modbus_port = free_port()
        simulator = start(ending, BUSKER, "simulate", *(f"{profile}@{unit}" for _, profile, unit in DEVICES),
                          "--tcp", f"127.0.0.1:{modbus_port}")
        wait_for_port(modbus_port)
        configuration = folder / "busker.yaml"
        configuration.write_text(configuration_text(folder, broker.port, modbus_port))
        gateway = start(ending, BUSKER, "run", "--config", str(configuration))
        home = Home(folder / "home-assistant", broker.port, ending)
        print(f"Home Assistant {home.version}", flush=True)
        try:
            check_all(home, broker, gateway, Plant(simulator, modbus_port))
        except Fault:
            # What the gateway itself says about it, for whoever has to find out.
            for topic in ("busker/bridge/health", "busker/+/info"):
                print(json.dumps(broker.retained(topic), indent=1), file=sys.stderr)
            raise
    print("all as it should be")


def check_all(home, broker, gateway, plant) -> None:
    step("the expected entities are there, each as it should be")
    home.wait(EXPECTED)
    entities = home.ask("entities")
    of_devices = {key for key, entity in entities.items() if entity["device"] in {f"busker_{n}" for n, _, _ in DEVICES}}
    enabled = {key for key in of_devices if entities[key]["enabled"]}
    same(enabled, set(EXPECTED), "the enabled entities")

    step("nothing that was announced was refused")
    announced = broker.announced()
    same(set(entities), announced, "the entities in the registry")

    step("the devices say who made them and hang on their bus")
    devices = home.ask("devices")
    same(devices["busker_relays"], {"name": "Relays", "manufacturer": "METZ CONNECT", "model": "MR-DO4",
                                    "via": "busker_bus_plant"}, "the relays' device")
    same(devices["busker_bus_plant"]["via"], "busker_bridge", "what the bus hangs on")

    step("a switch switches the relay, and shows what the device says")
    home.call("switch.turn_on", "busker_relays_relay_2")
    home.wait({"busker_relays_relay_2": {"state": "on"}, "busker_relays_relay_1": {"state": "off"}})
    same(plant.unit(1).read(1, 0, 4), [0, 1, 0, 0], "the coils of the relays")
    home.call("switch.turn_off", "busker_relays_relay_2")
    home.wait({"busker_relays_relay_2": {"state": "off"}})
    same(plant.unit(1).read(1, 0, 4), [0, 0, 0, 0], "the coils of the relays")

    step("what happens at the devices is shown: a hand switch, a voltage, pulses")
    plant.do("unit 1 relay 4 hand on")
    plant.do("unit 2 input 1 volts 2.5")
    plant.do("unit 3 input 1 counter 12345")
    home.wait({
        "busker_relays_relay_4": {"state": "on"},
        "busker_relays_relay_4_hand": {"state": "on"},
        "busker_inputs_channel_1_value_v": {"state": "2.5"},
        # One pulse per unit and one decimal, as the device leaves the factory.
        "busker_meters_meter_1_reading": {"state": "12345.0"},
    })

    step("a number is set")
    home.call("number.set_value", "busker_relays_watchdog", value=600.5)
    home.wait({"busker_relays_watchdog": {"state": "600.5"}})
    same(plant.unit(1).read(3, 66, 1), [60050], "the watchdog's register")

    step("a value outside the limits is refused by Home Assistant and reaches no device")
    home.call_fails("number.set_value", "busker_relays_watchdog", value=700)
    same(plant.unit(1).read(3, 66, 1), [60050], "the watchdog's register")

    step("a selected order switches the relay, and a pressed button restarts the board")
    home.call("select.select_option", "busker_board_relay_5_order", option="ON")
    home.wait({"busker_board_relay_5_order": {"state": "ON"}, "busker_board_relay_5_state": {"state": "on"}})
    same(plant.unit(4).read(3, 5, 1), [1], "the board's order register")
    home.call("button.press", "busker_board_restart")
    home.wait({"busker_board_relay_5_order": {"state": "automatic"}, "busker_board_restart": {"known": True}})
    same(plant.unit(4).read(3, 5, 1), [11111], "the board's order register")

    step("another sensor makes another entity of the input")
    plant.do("unit 2 input 3 ohms 1077.9")
    home.call("select.select_option", "busker_inputs_channel_3_code", option="pt1000_integer")
    # A PT1000 of 1077.9 ohms is at 20 °C (IEC 60751).
    celsius = facts("sensor", unit="°C", device_class="temperature", state_class="measurement", state="20.0")
    home.wait({
        "busker_inputs_channel_3_code": {"state": "pt1000_integer"},
        "busker_inputs_channel_3_value_c": celsius,
        "busker_inputs_channel_3_value_v": {"exists": False},
        "busker_inputs_channel_4_value_v": facts("sensor", unit="V"),
    })
    same(plant.unit(2).read(3, 18, 1), [0x85], "the input's configuration register")
    home.call("select.select_option", "busker_inputs_temperature_unit", option="°F")
    home.wait({
        "busker_inputs_temperature_unit": {"state": "°F"},
        "busker_inputs_channel_3_value_f": {"exists": True, "unit": "°C", "state": "20.0"},
        "busker_inputs_channel_3_value_c": {"exists": False},
    })
    home.call("select.select_option", "busker_inputs_temperature_unit", option="°C")
    home.wait({"busker_inputs_channel_3_value_c": celsius, "busker_inputs_channel_3_value_f": {"exists": False}})

    now = {key: {"state": entity["state"]} for key, entity in home.ask("entities").items()
           if entity["enabled"] and entity["platform"] in ("switch", "select", "number")}
    still = {**now, "busker_inputs_channel_3_value_c": celsius, "busker_board_relay_1_state": {"known": True}}

    step("so far Home Assistant has logged nothing")
    same(home.ask("log"), [], "the log")

    step("Home Assistant is started anew: all is as before")
    with broker.hearing("homeassistant/status", "online") as birth:
        home.restart()
        home.wait(still)
        # Only now has it settled; a broker lost before would be a fault of its own in its log.
        birth()
    same(home.ask("log"), [], "the log")

    step("the broker is started anew and has forgotten everything: all is as before")
    broker.stop()
    home.wait({key: {"state": "unavailable"} for key in still})
    broker.start()
    home.wait(still)
    of_volts = {f"busker_inputs_channel_3_{point}_v" for point in ("value", "offset", "on_above", "off_below")}
    of_degrees = {unique_id.removesuffix("_v") + "_c" for unique_id in of_volts}
    same(broker.announced(), announced - of_volts | of_degrees, "what is announced")

    step("the gateway is stopped: nothing pretends to be there")
    gateway.terminate()
    same(gateway.wait(PATIENCE), 0, "the gateway's exit code")
    home.wait({key: {"state": "unavailable"} for key in still})

    step("Home Assistant has logged nothing to the end but that its broker was gone")
    same([line for line in home.ask("log") if not line.endswith(BROKER_WAS_LOST)], [], "the log")


def configuration_text(folder: pathlib.Path, broker_port: int, modbus_port: int) -> str:
    devices = "".join(
        f"  {name}: {{profile: {profile}, bus: plant, unit: {unit}, name: {name.capitalize()}}}\n"
        for name, profile, unit in DEVICES
    )
    return (
        f'mqtt: {{url: "mqtt://127.0.0.1:{broker_port}"}}\n'
        f'http: {{listen: "127.0.0.1:0"}}\n'
        f"state_dir: {folder}/state\n"
        f'buses:\n  plant: {{tcp: "127.0.0.1:{modbus_port}"}}\n'
        f"devices:\n{devices}"
    )


class Home:
    """Home Assistant, driven through probe.py."""

    def __init__(self, folder: pathlib.Path, broker_port: int, ending: contextlib.ExitStack) -> None:
        self.command = [sys.executable, str(HERE / "probe.py"), str(folder), str(broker_port)]
        self.start()
        ending.callback(lambda: self.process.kill())

    def start(self) -> None:
        self.process = subprocess.Popen(self.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1)
        self.version = self.answer()["home_assistant"]

    def restart(self) -> None:
        self.process.stdin.write('{"do": "quit"}\n')
        self.process.wait(PATIENCE)
        self.start()

    def answer(self):
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit("Home Assistant ended; see above")
        answer = json.loads(line)
        if "failed" in answer:
            raise Fault(answer["failed"])
        return answer["is"]

    def ask(self, do: str, **more):
        self.process.stdin.write(json.dumps({"do": do, **more}) + "\n")
        return self.answer()

    def wait(self, wanted: dict) -> None:
        self.ask("wait", **{"for": wanted}, seconds=PATIENCE)

    def call(self, service: str, entity: str, **data) -> None:
        self.ask("call", service=service, entity=entity, data=data)

    def call_fails(self, service: str, entity: str, **data) -> None:
        try:
            self.call(service, entity, **data)
        except Fault:
            return
        raise Fault(f"{service} with {data} was accepted")


class Broker:
    """A mosquitto on a free port that forgets everything when it is stopped."""

    def __init__(self, folder: pathlib.Path, ending: contextlib.ExitStack) -> None:
        self.port = free_port()
        self.settings = folder / "mosquitto.conf"
        self.settings.write_text(f"listener {self.port} 127.0.0.1\nallow_anonymous true\npersistence false\n")
        self.ending = ending
        self.start()

    def start(self) -> None:
        self.process = start(self.ending, "mosquitto", "-c", str(self.settings), quiet=True)
        wait_for_port(self.port)

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait(PATIENCE)

    def announced(self) -> set:
        """The unique ids in the retained discovery messages."""
        messages = self.retained("homeassistant/device/+/config").values()
        return {component["unique_id"] for message in messages for component in message["components"].values()}

    def retained(self, topic: str) -> dict:
        """What the broker holds. It has all been sent when a message of our own comes back."""
        found, marker = {}, f"test/{time.monotonic_ns()}"

        def receive(message) -> None:
            if message.retain and message.payload:
                found[message.topic] = json.loads(message.payload)

        with self.listening([topic, marker], receive) as (client, wait_for):
            client.publish(marker, "", 1)
            wait_for(marker, "")
        return found

    @contextlib.contextmanager
    def hearing(self, topic: str, payload: str):
        """Gives a function that waits for this message, should it come from now on."""
        with self.listening([topic], lambda _: None) as (_, wait_for):
            yield lambda: wait_for(topic, payload)

    @contextlib.contextmanager
    def listening(self, topics: list[str], receive):
        """A subscribed client, and a function that waits for a message, which may have come already."""
        client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        heard, news = [], threading.Condition()

        def notice(what) -> None:
            with news:
                heard.append(what)
                news.notify()

        def on_message(_client, _userdata, message) -> None:
            receive(message)
            notice((message.topic, message.payload.decode()))

        def wait_for(*what) -> None:
            with news:
                if not news.wait_for(lambda: what in heard, PATIENCE):
                    raise Fault(f"{what} was not heard")

        client.on_message = on_message
        client.on_connect = lambda *_: client.subscribe([(topic, 1) for topic in topics])
        client.on_subscribe = lambda *_: notice(("subscribed",))
        client.connect("127.0.0.1", self.port)
        client.loop_start()
        try:
            wait_for("subscribed")
            yield client, wait_for
        finally:
            client.disconnect()
            client.loop_stop()


class Plant:
    """The simulated devices: what happens to them, and what they hold."""

    def __init__(self, simulator: subprocess.Popen, port: int) -> None:
        self.simulator, self.port = simulator, port

    def do(self, command: str) -> None:
        """As `busker simulate --help` lists them."""
        self.simulator.stdin.write(command + "\n")
        self.simulator.stdin.flush()

    def unit(self, unit: int) -> "Unit":
        return Unit(self.port, unit)


class Unit:
    """One device behind the simulator's Modbus TCP port."""

    def __init__(self, port: int, unit: int) -> None:
        self.port, self.unit = port, unit

    def ask(self, function: int, body: bytes) -> bytes:
        with socket.create_connection(("127.0.0.1", self.port), PATIENCE) as line:
            line.sendall(struct.pack(">HHHBB", 1, 0, len(body) + 2, self.unit, function) + body)
            answer = line.makefile("rb")
            _, _, length, _, answered = struct.unpack(">HHHBB", answer.read(8))
            body = answer.read(length - 2)
        same(answered, function, f"the function answered by unit {self.unit} (then {body.hex()})")
        return body

    def read(self, function: int, first: int, count: int) -> list[int]:
        data = self.ask(function, struct.pack(">HH", first, count))[1:]
        if function in (1, 2):
            return [data[bit // 8] >> (bit % 8) & 1 for bit in range(count)]
        return list(struct.unpack(f">{count}H", data))


class Fault(Exception):
    """Something is not as it should be."""


def step(sentence: str) -> None:
    print(f"- {sentence}", flush=True)


def same(found, wanted, what: str) -> None:
    if found == wanted:
        return
    if isinstance(found, set) and isinstance(wanted, set):
        raise Fault(f"{what}: too many {sorted(found - wanted)}, missing {sorted(wanted - found)}")
    raise Fault(f"{what}: {found!r} instead of {wanted!r}")


def start(ending: contextlib.ExitStack, *command: str, quiet: bool = False) -> subprocess.Popen:
    nowhere = subprocess.DEVNULL
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=nowhere, stderr=nowhere if quiet else None, text=True)
    ending.callback(process.kill)
    return process


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


if __name__ == "__main__":
    try:
        main()
    except Fault as fault:
        sys.exit(f"FAILED: {fault}")
