"""All that runs, and what a user sees of it compared with what is announced."""

import contextlib
import json
import pathlib
import re
import shutil
import time

import rules
from announced import Announced, announced
from broker import Broker, broker_version
from calls import IS_NOT_KEPT, Call, as_it_was, in_turns
from fault import PATIENCE, Fault, same
from gateway import OWN_PROFILES, Busker, Gateway
from home import Home
from plant import Device, plant
from report import Report

# The version that the gateway's announcements are meant for unless the configuration asks for an older one.
NEWEST = "2026.11"

# With 3,000 points on a machine that has other things to do, too.
LONG_PATIENCE = 120

# What Home Assistant and its MQTT client say themselves when their broker goes and while it is away, and only then.
# It gathers subscriptions for some tenths of a second; those that wait when the broker goes end in
# `mqtt_broker_error`, in plain words if it has its translations by then.
BROKER_IS_AWAY = re.compile(
    r".*("
    r"mqtt\.client: Error returned from MQTT server: The connection was lost\."
    r"|paho\.mqtt\.client: failed to receive on socket: \[Errno \d+\] (Connection reset by peer|Broken pipe)"
    r"|mqtt\.client: Failed to connect to MQTT server due to exception: \[Errno 111\] Connection refused"
    r"|ERROR homeassistant\.components\.mqtt\.util: (mqtt_broker_error|Error talking to MQTT: The client is not currently connected\.)"
    r"|ERROR homeassistant: Error doing job: Task exception was never retrieved \(None\) \(HomeAssistantError\('mqtt_broker_error'\)\)"
    r")"
)
# It may say so later, where it has other things to do; but each time that the broker goes it loses the connection once.
LATER = 10
LOST = re.compile(r".*mqtt\.client: Error returned from MQTT server: The connection was lost\.")
# What it had asked for when the broker went is not answered; it says so after ten seconds.
NEVER_ANSWERED = re.compile(r".*mqtt\.client: No ACK from MQTT server in 10 seconds .*")

# 2025.4 clears the topic of a removed device once more for each of its disabled entities, and then wonders itself.
CLEARS_TWICE = re.compile(r"WARNING homeassistant\.components\.mqtt\.discovery: No device components to cleanup for .*")

# On a machine with too much to do Home Assistant may complain of its own slowness.
IS_SLOW = re.compile(
    r".* took \d+\.\d+ seconds\. Please create a bug report .*|.* is taking over \d+ seconds\."
)


class House:
    """All that runs, and what was seen of it. `knows_all`: busker is told how new Home Assistant is."""

    def __init__(
        self, program: str, version: str, folder: pathlib.Path, ending: contextlib.ExitStack, planted=plant,
        own_profiles: pathlib.Path = OWN_PROFILES, knows_all: bool = False,
    ) -> None:
        self.program, self.version, self.folder, self.ending = program, version, folder, ending
        # A copy, which steps may change.
        self.busker = Busker(program, shutil.copytree(own_profiles, folder / "profiles"))
        self.devices = planted(self.busker, folder, ending)
        self.by_identity = {device.identity: device for device in self.devices}
        self.broker = Broker(folder, ending)
        # In minutes the test writes what a house writes in years.
        wishes = {"eeprom": {"interval": "0s", "daily": 10000}}
        if version != NEWEST or knows_all:
            wishes["home_assistant"] = {"minimum_version": version}
        self.gateway = Gateway(self.busker, folder, self.broker, self.devices, ending, wishes)
        self.home = Home(folder / "home-assistant", self.broker.port, ending)
        self.report = Report()
        self.report.about = {**self.home.about, "broker": broker_version()}
        # What was heard by somebody who was there from the beginning, where the broker keeps no values.
        self.witness: dict[str, str] | None = None
        # What is not as announced because the user wished so.
        self.own_ids: dict[str, str] = {}

    def device(self, identity: str) -> Device:
        return self.by_identity[identity]

    def announced(self) -> dict[str, Announced]:
        if self.witness is not None:
            return announced(dict(self.witness))
        return announced(self.broker.retained([device.name for device in self.devices]))

    def announced_in_the_end(self, identity: str) -> dict[str, Announced]:
        """All that is announced when this device is, and is available."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            now = self.announced()
            of_device = [one for one in now.values() if one.identity == identity]
            if of_device and all(one.is_available and one.is_told() for one in of_device):
                return now
            time.sleep(0.1)
        raise Fault(f"{identity} was not announced with all its states")

    def settle(self, fresh: bool = False, patience: float = PATIENCE) -> dict[str, Announced]:
        """Waits until Home Assistant has exactly what is announced, and shows what the broker holds;
        `fresh`: enabled is what is announced so."""
        deadline = time.monotonic() + patience
        while True:
            try:
                return self.look(fresh, 0.5)
            except Fault:
                if time.monotonic() > deadline:
                    raise

    def look(self, fresh: bool, seconds: float) -> dict[str, Announced]:
        all_announced = self.announced()
        silent = {device.identity for device in self.gateway.devices}
        silent -= {one.identity for one in all_announced.values()}
        same(silent, set(), "the devices that are not announced")
        same({one.identity for one in all_announced.values() if not one.is_available}, set(), "the unavailable devices")
        untold = {key for key, one in all_announced.items() if not one.is_told() and not self.is_asked_for(one)}
        same(untold, set(), "the entities without a state")
        wanted = self.facts(all_announced, fresh)
        try:
            self.home.wait(wanted, seconds)
        except Fault:
            # What moves all the time is never what it was a moment ago; of that it is enough to be known.
            later = self.facts(self.announced(), fresh)
            moving = {key: {"known": True} for key in wanted if wanted[key] != later.get(key)}
            self.home.wait(wanted | moving, 0)
        registered = self.home.ask("entities")
        if self.version != NEWEST:
            # An older Home Assistant never lets go of a disabled entity but with its device.
            registered = {key: one for key, one in registered.items() if one["enabled"] or key in all_announced}
        same(set(registered), set(all_announced), "the entities in the registry")
        rules.are_kept(all_announced, registered, self.home.ask("devices"), set(self.own_ids))
        for one in all_announced.values():
            device = self.by_identity.get(one.identity)
            # A device that gets another key in the configuration is no other one here.
            self.report.saw(device and device.profile, one.kind, one.unique_id.removeprefix(one.identity if device else ""))
        return all_announced

    def is_told(self) -> None:
        """Waits until the broker holds all that busker has to say to it of its devices, whoever listens."""
        for device in self.gateway.devices:
            self.announced_in_the_end(device.identity)

    def facts(self, all_announced: dict[str, Announced], fresh: bool) -> dict[str, dict]:
        """What Home Assistant should have and show."""
        seen = self.home.ask("entities")
        wanted = {}
        for key, one in all_announced.items():
            is_enabled = one.enabled if fresh else seen.get(key, {}).get("enabled", one.enabled)
            wanted[key] = one.identity_facts() | {"enabled": is_enabled}
            if key in self.own_ids:
                wanted[key]["entity_id"] = self.own_ids[key]
                del wanted[key]["name"]
            if is_enabled:
                wanted[key] |= one.kept_facts(fresh) | one.state_facts()
        return wanted

    def is_asked_for(self, one: Announced) -> bool:
        """Whether its point is only read on request."""
        device = self.by_identity.get(one.identity)
        point = device and device.points.get(one.point())
        return bool(point) and point["poll"] == "never"

    def enable(self) -> int:
        """Enables whatever is disabled; Home Assistant then sets up its MQTT integration anew."""
        with self.broker.listening(["homeassistant/status"]) as ears:
            count = self.home.ask("enable")
            if count:
                ears.wait_for(lambda _, payload: payload == "online", "that Home Assistant is there again")
        return count

    def log_is_empty(self) -> None:
        """But for what Home Assistant says of its broker and its machine, and of itself."""
        lines = self.home.log()
        losses = [self.broker.absence(at, LATER) for at, line in lines if LOST.fullmatch(line)]
        same([since for since in losses if losses.count(since) > 1], [], "when the broker went once, and more than one loss was logged")
        reasons = [(self.reason(at, line), line) for at, line in lines]
        log = [line for reason, line in reasons if reason is None] + self.home.ask("issues")
        same(log, [], "Home Assistant's log")
        same([line for line in self.gateway.log().splitlines() if " ERROR " in line or "panicked" in line], [], "busker's own log")
        self.report.let_pass[self.folder] = [reason for reason, _ in reasons]

    def reason(self, at: float, line: str) -> str | None:
        """Why this line of Home Assistant's log is nothing that busker has to do with; `None`: it may be."""
        if BROKER_IS_AWAY.fullmatch(line) and self.broker.absence(at, LATER):
            return "the broker that is away"
        if NEVER_ANSWERED.fullmatch(line) and self.broker.absence(at, 10 + LATER):
            return "the broker that is away"
        if IS_SLOW.fullmatch(line) or NEVER_ANSWERED.fullmatch(line):
            return "a slow machine"
        if self.version != NEWEST and CLEARS_TWICE.fullmatch(line):
            return "its own second clearing"
        return None

    def act(self, calls: list["Call"]) -> set[str]:
        """Calls services, waits until busker says how each ended, and until Home Assistant shows what it
        found. Gives the unique ids of those that the device limited for the sake of another register."""
        limited = set()
        for some in in_turns(calls):
            with self.broker.listening(["busker/+/+/outcome"]) as ears:
                for call in some:
                    self.home.call(call.service, call.one.unique_id, **call.data)
                    self.report.services[call.service] += 1
                for call in some:
                    topic = call.one.outcome_topic()
                    ears.wait_for(lambda heard, _: heard == topic, f"the outcome of {call}")
                outcomes = {topic: json.loads(payload) for topic, payload in ears.heard if payload}
            failed, wanted = [], {}
            for call in some:
                outcome = outcomes[call.one.outcome_topic()]
                wanted[call.one.unique_id] = call.wanted
                if outcome["outcome"] == "not_taken" and call.one.platform == "number":
                    limited.add(call.one.unique_id)
                    shown = as_it_was(call.one, outcome["found"])
                    wanted[call.one.unique_id] = shown.wanted if shown else {"state": "unknown"}
                elif call.one.unique_id in IS_NOT_KEPT and outcome["outcome"] == "not_taken":
                    pass
                elif outcome["outcome"] not in ("done", "unchanged"):
                    failed.append(f"{call}: {outcome}")
            same(failed, [], "what was not done")
            self.home.wait(wanted)
        return limited
