"""The built program, and `busker run` with it."""

import json
import pathlib
import signal
import subprocess

from broker import Broker
from fault import PATIENCE, Deadline, Fault

# Profiles of the test's own, for what no shipped one has.
OWN_PROFILES = pathlib.Path(__file__).parent / "profiles"


class Busker:
    """The built program, and what it knows of profiles."""

    def __init__(self, program: str, own_profiles: pathlib.Path = OWN_PROFILES) -> None:
        self.program, self.own_profiles = program, own_profiles

    def tell(self, *arguments: str) -> str:
        return subprocess.run([self.program, *arguments], check=True, stdout=subprocess.PIPE, text=True).stdout

    def profiles(self) -> list[dict]:
        return json.loads(self.tell("profiles", "list", "--profiles", str(self.own_profiles), "--json"))

    def profile(self, profile: str) -> dict:
        return json.loads(self.tell("profiles", "show", "--profiles", str(self.own_profiles), profile, "--json"))

    def simulated(self) -> list[str]:
        """The models that there is a simulator for."""
        devices = self.tell("simulate", "--help").split("\nDevices:\n")[1].split("\n\n")[0]
        return devices.split()


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
            "profiles": [str(self.busker.own_profiles)],
            "state_dir": f"{self.folder}/state",
            **self.wishes,
            "mqtt": {"url": f"mqtt://127.0.0.1:{self.broker.port}", **self.wishes.get("mqtt", {})},
            "buses": buses,
            "devices": {
                device.name: {"profile": device.profile, "bus": device.line.name, "unit": device.unit,
                              "name": device.title, **device.wishes}
                for device in self.devices
            },
        }
        configuration = self.folder / "busker.yaml"
        configuration.write_text(json.dumps(settings))
        return configuration

    def reload(self) -> None:
        """Takes the configuration as it is now, and goes on."""
        self.configure()
        done = "what has changed is at work"
        before, deadline = self.log().count(done), Deadline(f"the gateway logs that {done}")
        self.process.send_signal(signal.SIGHUP)
        while self.log().count(done) == before:
            deadline.pass_by()

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
