"""A real mosquitto, and ears at it."""

import contextlib
import math
import pathlib
import signal
import socket
import subprocess
import threading
import time

import paho.mqtt.client as mqtt

from fault import PATIENCE, Fault


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
        # From when to when it was away, by the clock on the wall.
        self.absences: list[list[float]] = []
        self.start()

    def start(self) -> None:
        nowhere = subprocess.DEVNULL
        self.process = subprocess.Popen(["mosquitto", "-c", str(self.settings)], stdout=nowhere, stderr=nowhere)
        self.ending.callback(self.process.kill)
        wait_for_port(self.port)
        if self.absences:
            self.absences[-1][1] = time.time()

    def stop(self, forget: bool) -> None:
        self.absences.append([time.time(), math.inf])
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(PATIENCE)
        if forget:
            self.memory.unlink(missing_ok=True)

    def remember(self) -> None:
        """Writes down what it keeps, as it does now and then."""
        self.memory.unlink(missing_ok=True)
        self.process.send_signal(signal.SIGUSR1)
        deadline = time.monotonic() + PATIENCE
        while not self.memory.exists():
            if time.monotonic() > deadline:
                raise Fault("the broker does not write down what it keeps")
            time.sleep(0.02)

    def kill(self) -> None:
        self.absences.append([time.time(), math.inf])
        self.process.kill()
        self.process.wait(PATIENCE)

    def absence(self, at: float, behind: float) -> float | None:
        """Since when it was away at this time, or not long before it."""
        return max((since for since, until in self.absences if since <= at <= until + behind), default=None)

    def publish(self, messages: dict[str, str]) -> None:
        """As somebody else, retained; an empty text takes a message back."""
        with self.listening(["test/marker"]) as ears:
            for topic, payload in messages.items():
                ears.client.publish(topic, payload, 1, retain=True)
            ears.client.publish("test/marker", "published", 1)
            ears.wait_for(lambda _, payload: payload == "published", "the end of what was published")

    def retained(self, names: list[str]) -> dict[str, str]:
        """What the broker holds of discovery and of the devices of these names.

        Asked for in parts, as a mosquitto drops what it would have to queue beyond a thousand messages.
        """
        return self.retained_below("homeassistant/#", *(f"busker/{name}/#" for name in ["bridge", *names]))

    def retained_below(self, *parts: str) -> dict[str, str]:
        """What the broker holds that fits one of these filters."""
        found = {}

        def receive(message) -> None:
            if message.retain and message.payload:
                found[message.topic] = message.payload.decode()

        with self.listening(["test/marker"], receive) as ears:
            for part in parts:
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


def broker_version() -> str:
    told = subprocess.run(["mosquitto", "-h"], stdout=subprocess.PIPE, text=True).stdout
    return told.splitlines()[0].replace("version ", "")
