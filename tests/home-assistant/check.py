"""The Home Assistant test: what a user sees of a device of every profile, and what happens when he acts.

    .home-assistant/VERSION/venv/bin/python tests/home-assistant/check.py BUSKER VERSION [STEP …]

VERSION is that of Home Assistant; an old one is what the gateway's `minimum_version` asks for. With the names of steps (functions of `CHECKS`) only these are done, and no page is written.
Everything is real but the devices: mosquitto, Home Assistant, the built gateway on a serial line, a
serial server and Modbus TCP. What is expected of single devices stands here by hand (`EXPECTED`, and the
steps that name one); what is expected of all of them follows from what the broker holds, and effects are
looked up in the devices' registers.
"""

import contextlib
import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import time

from home import Announced, Home, announced
from plant import PATIENCE, Broker, Busker, Device, Fault, Gateway, large_plant, plant
from report import KINDS, Report

PAGE = pathlib.Path(__file__).parent.parent.parent / "docs" / "home-assistant.md"
# The version that the gateway's announcements are meant for unless the configuration asks for an older one.
NEWEST = "2026.11"
# With 3,000 points on a machine that has other things to do, too.
LONG_PATIENCE = 120
# Commands that one device is given at once.
AT_ONCE = 12

# The controller writes it itself, all the time (manual, page 70).
MOVES_ITSELF = re.compile(r"busker_metz_connect_mr_aio42_controller_\d_output")

# The device measures, and puts the offset that it found in the place of what was written (manual, RWreg 26):
# busker says of it that another value stands there.
IS_NOT_KEPT = {"busker_fuehlersysteme_sensor_pressure_zero_measure"}

# From the factory it holds what nobody may write (manual, RWreg 65): it is shown, and refused.
ONLY_SHOWN = {"busker_fuehlersysteme_sensor_display_turn": "0"}

# What Home Assistant and its MQTT client may say themselves when their broker goes, and while it is away.
BROKER_IS_AWAY = re.compile(
    r".*("
    r"mqtt\.client: Error returned from MQTT server: The connection was lost\."
    r"|paho\.mqtt\.client: failed to receive on socket: \[Errno \d+\] (Connection reset by peer|Broken pipe)"
    r"|mqtt\.client: Failed to connect to MQTT server due to exception: \[Errno 111\] Connection refused"
    r")"
)

# 2025.4 clears the topic of a removed device once more for each of its disabled entities, and then wonders itself.
CLEARS_TWICE = re.compile(r"WARNING homeassistant\.components\.mqtt\.discovery: No device components to cleanup for .*")

# On a machine with too much to do Home Assistant may complain of its own slowness.
IS_SLOW = re.compile(r".* took \d+\.\d+ seconds\. Please create a bug report .*|.* is taking over \d+ seconds\.")


def facts(platform: str, **more) -> dict:
    return {"platform": platform, "enabled": True, "category": None, "known": True, **more}


def every(unique_id: str, numbers: range, what: dict) -> dict:
    return {unique_id.format(number): what for number in numbers}


# What a user finds who has just connected these devices: all that is enabled of them.
DO4, AI8, SI4, RELAY8, DIO42, VALVE = (
    f"busker_{name}" for name in ("metz_connect_mr_do4", "metz_connect_mr_ai8", "metz_connect_mr_si4",
                                  "fuehlersysteme_relay8", "metz_connect_mr_dio42", "test_valve")
)
BUS = "busker_bus_cellar"


def counter(name: str) -> dict:
    return facts("sensor", name=name, category="diagnostic", state_class="total_increasing", precision=0)


def measured(name: str, unit: str, precision: int, device_class: str | None) -> dict:
    return facts("sensor", name=name, category="diagnostic", state_class="measurement", unit=unit,
                 precision=precision, device_class=device_class)


# What they show of the wire when they have been asked a few times; commands have come by then.
OF_WIRE = {
    DO4 + "_wire_turnaround_p95": measured("Turnaround, 95th percentile", "ms", 1, "duration"),
    DO4 + "_wire_fast_period": measured("Period of fast polls", "s", 2, "duration"),
    DO4 + "_wire_timeouts": counter("Timeouts"),
    BUS + "_link": facts("binary_sensor", name="Link", category="diagnostic", device_class="connectivity", state="on"),
    BUS + "_load": measured("Load", "%", 1, None),
    BUS + "_requests": counter("Requests"),
    BUS + "_timeouts": counter("Timeouts"),
    BUS + "_checksum_errors": counter("Checksum errors"),
    BUS + "_exceptions": counter("Exceptions"),
    BUS + "_late_replies": counter("Late replies"),
    BUS + "_turnaround_p95": measured("Turnaround, 95th percentile", "ms", 1, "duration"),
    BUS + "_command_wait_p95": measured("Wait of commands, 95th percentile", "ms", 1, "duration"),
    "busker_bridge_connection": facts(
        "binary_sensor", name="Connection", category="diagnostic", device_class="connectivity", state="on"
    ),
}
EXPECTED = {
    **every(DO4 + "_relay_{}", range(1, 5), facts("switch", state="off")),
    **every(DO4 + "_relay_{}_hand", range(1, 5), facts("binary_sensor", category="diagnostic", state="off")),
    DO4 + "_watchdog": facts(
        "number", category="config", unit="s", device_class="duration", min=0, max=655.35, state="0.0"
    ),
    AI8 + "_temperature_unit": facts("select", category="config", options=["°C", "°F"], state="°C"),
    **every(
        AI8 + "_channel_{}_value_v",
        range(1, 9),
        facts("sensor", unit="V", device_class="voltage", state_class="measurement"),
    ),
    **every(AI8 + "_channel_{}_code", range(1, 9), facts("select", category="config", state="voltage")),
    **every(SI4 + "_meter_{}_reading", range(1, 5), facts("sensor", state_class="total_increasing")),
    **every(RELAY8 + "_relay_{}_state", range(1, 9), facts("binary_sensor", state="off")),
    **every(
        RELAY8 + "_relay_{}_order",
        range(1, 9),
        facts("select", options=["OFF", "ON", "automatic"], state="automatic"),
    ),
    **{
        identity + "_eeprom_writes": facts("sensor", category="diagnostic", state_class="total_increasing")
        for identity in (DO4, AI8, SI4, RELAY8)
    },
    RELAY8 + "_software": facts("sensor", category="diagnostic"),
    VALVE + "_last_serviced": facts("sensor", device_class="timestamp", unit=None, state_class=None,
                                    state="2026-11-27T05:24:00+00:00"),
    # 0 in the register is no moment.
    VALVE + "_next_service": facts("sensor", device_class="timestamp") | {"known": False, "state": "unknown"},
    # A button has no state before it is pressed.
    RELAY8 + "_restart": facts("button", category="config", device_class="restart", known=False),
    # How long something takes is told after a minute, and only if it has happened.
    **{key: {fact: value for fact, value in wanted.items() if fact != "known"} for key, wanted in OF_WIRE.items()},
    **{
        f"{identity}_wire_{what}": {"category": "diagnostic"}
        for identity in (AI8, SI4, RELAY8) for what in ("turnaround_p95", "fast_period", "timeouts")
    },
}


class House:
    """All that runs, and what was seen of it."""

    def __init__(self, program: str, version: str, folder: pathlib.Path, ending: contextlib.ExitStack, planted=plant) -> None:
        self.program, self.version, self.folder = program, version, folder
        self.busker = Busker(program)
        self.devices = planted(self.busker, folder, ending)
        self.by_identity = {device.identity: device for device in self.devices}
        self.broker = Broker(folder, ending)
        # In minutes the test writes what a house writes in years.
        wishes = {"eeprom": {"interval": "0s", "daily": 10000}}
        if version != NEWEST:
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
        for one in all_announced.values():
            device = self.by_identity.get(one.identity)
            # A device that gets another key in the configuration is no other one here.
            self.report.saw(device and device.profile, one.kind, one.unique_id.removeprefix(one.identity if device else ""))
        return all_announced

    def facts(self, all_announced: dict[str, Announced], fresh: bool) -> dict[str, dict]:
        """What Home Assistant should have and show."""
        seen = self.home.ask("entities")
        wanted = {}
        for key, one in all_announced.items():
            is_enabled = one.enabled if fresh else seen.get(key, {}).get("enabled", one.enabled)
            wanted[key] = one.identity_facts() | {"enabled": is_enabled}
            if key in self.own_ids:
                wanted[key]["entity_id"] = self.own_ids[key]
            if is_enabled:
                wanted[key] |= one.state_facts()
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
        let_pass = [BROKER_IS_AWAY, IS_SLOW]
        if self.version != NEWEST:
            let_pass.append(CLEARS_TWICE)
        log = [line for line in self.home.ask("log") if not any(one.fullmatch(line) for one in let_pass)]
        same(log, [], "Home Assistant's log")

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


class Call:
    """A service called for an entity, and how that entity looks afterwards."""

    def __init__(self, one: Announced, service: str, data: dict | None = None, wanted: dict | None = None) -> None:
        self.one, self.service, self.data, self.wanted = one, service, data or {}, wanted or {}

    def __repr__(self) -> str:
        return f"{self.service} {self.data} for {self.one.unique_id}"


def in_turns(calls: list[Call]) -> list[list[Call]]:
    """A few of each device at a time."""
    by_device = {}
    for call in calls:
        by_device.setdefault(call.one.identity, []).append(call)
    longest = max(map(len, by_device.values()), default=0)
    return [
        [call for some in by_device.values() for call in some[first : first + AT_ONCE]]
        for first in range(0, longest, AT_ONCE)
    ]


def main() -> None:
    began = time.monotonic()
    program, version, *steps = sys.argv[1:]
    only = [check for check in CHECKS if check.__name__ in steps]
    # All ends before its folder goes; what was killed may still write a little.
    scratch = tempfile.TemporaryDirectory(prefix="busker-ha-", ignore_cleanup_errors=True)
    with scratch as folder, contextlib.ExitStack() as ending:
        house = House(program, version, pathlib.Path(folder), ending)
        print(f"Home Assistant {house.home.about['home_assistant']}, {len(house.devices)} devices", flush=True)
        try:
            for check in only or CHECKS:
                since = time.monotonic()
                print(f"- {check.__doc__.splitlines()[0]}", flush=True)
                check(house)
                print(f"  ({time.monotonic() - since:.0f} s)", flush=True)
        except Fault:
            # What the gateway itself says about it, for whoever has to find out.
            print(house.gateway.log(), file=sys.stderr)
            raise
    if only:
        return
    missing = set(KINDS) - house.report.kinds()
    print(f"all as it should be, after {time.monotonic() - began:.0f} s; of no profile: {', '.join(missing) or 'nothing'}")
    same(missing, set(), "the platforms that were not seen")
    if not house.report.compare(PAGE, version, in_short=version != NEWEST, bless=bool(os.environ.get("BLESS"))):
        print(f"{PAGE.name} says something else; with BLESS=1 this writes what was seen")


def everything_is_there(house: House) -> None:
    """Exactly what is announced is there, each as it should be, and nothing is logged."""
    found = house.settle(fresh=True)
    house.home.wait(EXPECTED)
    expected_of = {key: {other for other in EXPECTED if other.startswith(key)} for key in (DO4, AI8, SI4, RELAY8, BUS, "busker_bridge")}
    for identity, expected in expected_of.items():
        enabled = {key for key, one in found.items() if one.identity == identity and one.enabled}
        same(enabled, expected, f"the enabled entities of {identity}")
    devices = house.home.ask("devices")
    for device in house.devices:
        same(devices[device.identity], {
            "name": device.title, "manufacturer": device.manufacturer, "model": device.model,
            "via": f"busker_bus_{device.line.name}",
        }, f"the device {device.identity}")
    same(devices["busker_bus_cellar"]["via"], "busker_bridge", "what the bus hangs on")
    house.log_is_empty()
    enabled = sum(one.enabled for one in found.values())
    house.report.row(
        "a device of every simulated profile, on a serial line, behind a serial server and on Modbus TCP",
        f"{len(house.devices)} devices, {enabled} entities and {len(found) - enabled} disabled ones: ids, platforms, "
        "classes, units, categories and states as announced, and no others; the log is empty",
    )


def everything_is_enabled(house: House) -> None:
    """Every disabled entity is enabled, and nothing is logged."""
    count = house.enable()
    found = house.settle()
    house.log_is_empty()
    states = [entity for entity in house.home.ask("entities").values() if entity["platform"] not in ("button", "event")]
    unknown = sum(entity["state"] == "unknown" for entity in states)
    house.report.row(
        "every disabled entity is enabled",
        f"{count} more; of {len(found)} none is unavailable, {unknown} are unknown since the device has no value for "
        "them; the log is empty",
    )


def the_wire_is_seen(house: House) -> None:
    """What bus and devices say of their wire: names, units, digits, and figures that can be."""
    house.home.wait(OF_WIRE, LONG_PATIENCE)
    found = house.home.ask("entities")
    of_wire = {key: one for key, one in found.items() if "_wire_" in key or key.startswith("busker_bus_")}
    # Commands may not have waited, and slow polls not have come round: a command for what they read begins their period anew.
    may_be_unknown = re.compile(r".*_(command_wait_\w+|slow_period)")
    unknown = {key for key, one in of_wire.items() if not one["known"] and not may_be_unknown.fullmatch(key)}
    same(unknown, set(), "the figures that are not known")
    slow = {key: one["state"] for key, one in of_wire.items()
            if one["unit"] == "ms" and one["known"] and not 0 <= one["number"] < (3000 if "command" in key else 200)}
    same(slow, {}, "what takes impossibly long")
    loads = {key: one["state"] for key, one in of_wire.items() if one["unit"] == "%" and not 0 < one["number"] <= 100}
    same(loads, {}, "the loads that cannot be")
    asked = {key: one["state"] for key, one in of_wire.items() if key.endswith("_requests") and not one["number"] > 0}
    same(asked, {}, "who was never asked")
    house.log_is_empty()
    figures = ", ".join(f"{found[key]['name']} {found[key]['state']} {found[key]['unit'] or ''}".strip()
                        for key in OF_WIRE if key.startswith(BUS))
    print(f"  {figures}", flush=True)
    house.report.row(
        "what a bus and a device say of their wire, with all of it enabled",
        f"{len(of_wire)} diagnostic entities with names, units and digits as wanted; each figure is known but waits of "
        "commands where there were none and slow polls that did not come round yet, and is one that can be; the log is empty",
    )


def devices_are_seen(house: House) -> None:
    """What happens at the devices is shown: a hand switch, a voltage, pulses."""
    house.device(DO4).do("relay 4 hand on")
    house.device(AI8).do("input 1 volts 2.5")
    house.device(SI4).do("input 1 counter 12345")
    house.home.wait({
        DO4 + "_relay_4": {"state": "on"},
        DO4 + "_relay_4_hand": {"state": "on"},
        AI8 + "_channel_1_value_v": {"state": "2.5"},
        # One pulse per unit and one decimal, as the device leaves the factory.
        SI4 + "_meter_1_reading": {"state": "12345.0"},
    })
    house.device(DO4).do("relay 4 hand automatic")
    house.home.wait({DO4 + "_relay_4": {"state": "off"}})
    house.report.row("a hand switch, a voltage and pulses at the devices", "the states follow")


def devices_obey(house: House) -> None:
    """A relay, a time, an order: each is in the device's own registers; what is out of range is not."""
    relays, board = house.device(DO4), house.device(RELAY8)
    house.home.call("switch.turn_on", DO4 + "_relay_2")
    house.home.wait({DO4 + "_relay_2": {"state": "on"}, DO4 + "_relay_1": {"state": "off"}})
    same(relays.read("coil", 0, 4), [0, 1, 0, 0], "the coils of the relays")
    house.home.call("switch.turn_off", DO4 + "_relay_2")
    house.home.wait({DO4 + "_relay_2": {"state": "off"}})
    same(relays.read("coil", 0, 4), [0, 0, 0, 0], "the coils of the relays")
    house.home.call("number.set_value", DO4 + "_watchdog", value=600.5)
    house.home.wait({DO4 + "_watchdog": {"state": "600.5"}})
    same(relays.read("holding", 66), [60050], "the watchdog's register")
    house.home.call_fails("number.set_value", DO4 + "_watchdog", value=700)
    same(relays.read("holding", 66), [60050], "the watchdog's register")
    house.home.call("select.select_option", RELAY8 + "_relay_5_order", option="ON")
    house.home.wait({RELAY8 + "_relay_5_order": {"state": "ON"}, RELAY8 + "_relay_5_state": {"state": "on"}})
    same(board.read("holding", 5), [1], "the board's order register")
    house.home.call("button.press", RELAY8 + "_restart")
    house.home.wait({RELAY8 + "_relay_5_order": {"state": "automatic"}, RELAY8 + "_restart": {"known": True}})
    same(board.read("holding", 5), [11111], "the board's order register")
    house.report.row(
        "a relay, a time, an order, a restart",
        "the coil, 60050 for 600.5 s, the order's 1, and 11111 again after the restart in the devices' registers; then the "
        "states; 700 s, which is out of range, is refused and reaches no device",
    )


def every_control(house: House) -> None:
    """Every switch, number, select and text is set to another value and back."""
    counts, limited, refused = {}, set(), set()
    for platform, other in (("switch", other_flag), ("number", other_number), ("select", other_option), ("text", other_text)):
        there, back, not_again = [], [], []
        for one in house.settle().values():
            device = house.by_identity.get(one.identity)
            if one.platform != platform or not device or one.point() in device.deciding():
                continue
            if MOVES_ITSELF.fullmatch(one.unique_id):
                continue
            now = one.payload()
            there.append(other(one, now, device.points[one.point()]))
            if now is not None and (call := as_it_was(one, now)):
                (not_again if ONLY_SHOWN.get(one.unique_id) == now else back).append(call)
        counts[platform] = len(there)
        before = raw(house, there)
        at_limits = house.act(there)
        meanwhile = raw(house, there)
        stayed = {key for key, words in meanwhile.items() if words == before[key]}
        same(stayed - at_limits, set(), "the registers that stayed")
        at_limits |= house.act(back)
        after = raw(house, back)
        changed = {key for key, words in after.items() if words != before[key]}
        same(changed - at_limits, set(), "the registers that did not come back")
        limited |= at_limits
        for call in not_again:
            is_refused(house, call)
            refused.add(call.one.unique_id)
    same(refused, set(ONLY_SHOWN), "what may not be written again")
    house.settle()
    house.log_is_empty()
    house.report.row(
        "every control but those of modes is set to another value, and back",
        ", ".join(f"{count} of {platform}" for platform, count in counts.items())
        + f": the register changes, the state follows, the register is as before; of {len(limited)} the device takes only "
        f"part since another register limits them, and the state shows which; {len(refused)} shows a factory value that nobody "
        "may write: it is refused, and the state stays",
    )


def is_refused(house: House, call: Call) -> None:
    """What Home Assistant shows, and busker writes to no device."""
    device, point = house.device(call.one.identity), call.one.point()
    held, shown = device.raw(point), house.home.ask("entities")[call.one.unique_id]["state"]
    topic = call.one.outcome_topic()
    with house.broker.listening([topic]) as ears:
        house.home.call(call.service, call.one.unique_id, **call.data)
        ears.wait_for(lambda _, payload: bool(payload) and json.loads(payload)["outcome"] == "refused", f"that {call} was refused")
    same(device.raw(point), held, f"the register after {call}")
    house.home.wait({call.one.unique_id: {"state": shown}})


def raw(house: House, calls: list[Call]) -> dict[str, list[int]]:
    return {call.one.unique_id: house.device(call.one.identity).raw(call.one.point()) for call in calls}


def other_flag(one: Announced, now: str | None, point: dict) -> Call:
    return as_it_was(one, "OFF" if now == "ON" else "ON")


def other_number(one: Announced, now: str | None, point: dict) -> Call:
    """The largest value, or the smallest where it has that one; a step more where there are no limits."""
    low, high = one.component["min"], one.component["max"]
    try:
        held = float(now or "nan")
    except ValueError:
        held = float("nan")
    if high > 1e15:
        wished = held + 1 if held == held else 1
    else:
        wished = low if held == high else high
    return as_it_was(one, str(wished))


def other_option(one: Announced, now: str | None, point: dict) -> Call:
    options = one.component["options"]
    return as_it_was(one, options[0] if now and one.option(now) == options[-1] else options[-1])


def other_text(one: Announced, now: str | None, point: dict) -> Call:
    some = ("R017", "A255") if point["type"] == "letter_number" else ("12", "13")
    return as_it_was(one, some[now == some[0]])


def as_it_was(one: Announced, payload: str) -> Call | None:
    """The call that makes the broker hold this payload; `None` where Home Assistant cannot say it."""
    if one.platform == "switch":
        return Call(one, f"switch.turn_{payload.lower()}", wanted={"state": payload.lower()})
    if one.platform == "number":
        try:
            value = float(payload)
        except ValueError:
            return None
        if not one.component["min"] <= value <= one.component["max"]:
            return None
        return Call(one, "number.set_value", {"value": value}, {"number": value})
    if one.platform == "select":
        option = one.option(payload)
        return Call(one, "select.select_option", {"option": option}, {"state": option})
    return Call(one, "text.set_value", {"value": payload}, {"state": payload})


def every_button(house: House) -> None:
    """Every button is pressed."""
    calls = []
    for one in house.settle().values():
        if one.platform == "button" and one.identity in house.by_identity and "restart" not in one.unique_id:
            calls.append(Call(one, "button.press", wanted={"known": True}))
    house.act(calls)
    now = house.settle()
    names = 0
    for call in calls:
        name = call.one.component.get("payload_press")
        state = now[call.one.unique_id].retained.get(f"busker/{house.device(call.one.identity).name}/{call.one.point()}")
        if name != "PRESS" and call.one.unique_id not in IS_NOT_KEPT:
            names += 1
            same(state, name, f"what stands behind {call}")
    house.log_is_empty()
    house.report.row("every button is pressed", f"{len(calls)}; {names} of them put a number to a name, such as `automatic`")


def every_mode(house: House) -> None:
    """Every mode of every device: what it drops goes, what it brings comes."""
    # What repetitions have in common is gone through by all of them together.
    visited, rounds, came, went = set(), 0, set(), set()
    then = house.settle()
    while True:
        now = then
        calls = {}
        for one in now.values():
            device = house.by_identity.get(one.identity)
            if not device or one.point() not in device.deciding():
                continue
            path = re.sub(r"_\d+(?=_|$)", "", one.point())
            busy = calls.setdefault(one.identity, [])
            # What another mode decides about might be gone before it is set.
            if busy and device.points[one.point()]["when"]:
                continue
            for choice in choices(one):
                if (one.identity, path, choice) not in visited:
                    visited.add((one.identity, path, choice))
                    busy.append(as_it_was(one, choice))
                    break
        calls = [call for busy in calls.values() for call in busy]
        if not calls:
            break
        house.act(calls)
        then = house.settle()
        came |= set(then) - set(now)
        went |= set(now) - set(then)
        house.log_is_empty()
        rounds += 1
        print(f"  {len(calls)} modes; {len(set(then) - set(now))} come, {len(set(now) - set(then))} go", flush=True)
    house.report.row(
        "every mode of every device, with all that it brings enabled",
        f"{len(visited)} modes in {rounds} rounds; {len(came | went)} entities came or went; each has the id that it is "
        "announced with, never one that ends in `_2`, and nothing is left behind; the log is empty",
    )


def choices(one: Announced) -> list[str]:
    """What a control that decides about others is set to, one after the other."""
    if one.platform == "select":
        return [one.name(option) for option in one.component["options"]]
    if one.platform == "switch":
        return ["ON", "OFF"]
    if one.platform == "number":
        return [str(one.component["max"]), str(one.component["min"])]
    return []


def every_thing(house: House) -> None:
    """Every cover, climate and button that stands for several points is brought to life and used."""
    counts = {}
    # The dampers stand where an alarm can be acknowledged.
    for number, contact in enumerate(("closed", "open", "closed", "open"), 1):
        house.device(DIO42).do(f"input {number} contact {contact}")
    for device in house.devices:
        for thing in device.things.values():
            since = time.monotonic()
            one = bring_to_life(house, device, thing)
            counts[thing["as"]] = counts.get(thing["as"], 0) + 1
            use(house, device, thing, one)
            house.log_is_empty()
            print(f"  {one.unique_id} ({time.monotonic() - since:.0f} s)", flush=True)
    house.settle()
    house.report.row(
        "every thing made of several points is brought to life by its modes, and used",
        ", ".join(f"{count} of {kind}" for kind, count in sorted(counts.items()))
        + ": what each command writes stands in the broker as read back, and the states follow",
    )


def bring_to_life(house: House, device: Device, thing: dict) -> Announced:
    key = f"{device.identity}_{thing['name']}"
    wishes = dict(thing["when"] or {})
    if thing["as"] == "climate":
        wishes |= degrees(device, thing["temperature"]) | degrees(device, thing["target"])
    for point, values in wishes.items():
        now = house.announced()
        if now_of(device, point, now) in values:
            continue
        value = values[0]
        # A deciding point may have an ending in its key, if another one decides about it.
        found = [one for one in now.values() if one.identity == device.identity and one.point() == point
                 and one.platform in ("select", "switch")]
        if not found:
            raise Fault(f"{key} lives when {point} is {value}, which Home Assistant cannot set")
        house.act([as_it_was(found[0], value)])
        # What this one brings may be what the next wish needs.
        house.settle()
    now = house.settle()
    if key not in now:
        raise Fault(f"{key} does not live with {wishes}")
    return now[key]


def degrees(device: Device, point: str) -> dict:
    """What makes a temperature of this point."""
    by, cases = device.points[point]["by"], device.points[point]["cases"] or {}
    for name, case in cases.items():
        if case and (case["unit"] == "°C" or case["unit_by"]):
            return {by: [name]}
    return {}


def now_of(device: Device, point: str, now: dict[str, Announced]) -> str | None:
    return next(iter(now.values())).retained.get(f"busker/{device.name}/{point}")


def use(house: House, device: Device, thing: dict, one: Announced) -> None:
    """Gives every command, and looks up what it writes."""
    services = {"cover": ("cover", "{}_cover"), "valve": ("valve", "{}_valve"), "button": ("button", "{}"),
                "climate": ("climate", "set_hvac_mode")}
    domain, verb = services[thing["as"]]
    for command, writes in thing["do"].items():
        data = {"hvac_mode": command} if domain == "climate" else {}
        wanted = {"state": command} if domain == "climate" else {}
        house.act([Call(one, f"{domain}.{verb.format(command)}", data, wanted)])
        now = house.announced()
        # A later write of the same command may undo an earlier one, and a device may go on from there.
        last = writes[-1]
        for point, value in last.items():
            if device.points[point]["write_at"] is None:
                same(now_of(device, point, now), value, f"{point} after {command} of {one.unique_id}")
    if domain == "climate":
        for target in (one.component["min_temp"], one.component["max_temp"], 21.5):
            house.home.call("climate.set_temperature", one.unique_id, temperature=target)
            house.report.services["climate.set_temperature"] += 1
            house.home.wait({one.unique_id: {"temperature": target}})
        held = now_of(device, thing["target"], house.announced())
        same(float(held), 21.5, f"the target of {one.unique_id}")


def an_event_arrives(house: House) -> None:
    """A contact closes and opens, slowly and between two reads: events arrive."""
    contacts = house.device(DIO42)
    closed, opened = (f"{DIO42}_input_4_{what}" for what in ("closed", "opened"))
    before = house.home.ask("entities")
    for what in ("closed", "open", "closed"):
        contacts.do(f"input 4 contact {what}")
        house.home.wait({f"{DIO42}_input_4": {"state": "on" if what == "closed" else "off"}})
    after = house.home.ask("entities")
    for key, kind in ((closed, "closed"), (opened, "opened")):
        same(after[key]["event_type"], kind, f"the event of {key}")
        same(after[key]["state"] != before[key]["state"], True, f"whether {key} has a new time")
    # A press that is over before busker looks again: only the bit that flips tells of it.
    contacts.do("input 4 contact open")
    house.home.wait({f"{DIO42}_input_4": {"state": "off"}})
    before = house.home.ask("entities")
    contacts.do("input 4 contact closed")
    contacts.do("input 4 contact open")
    house.home.wait({key: {"known": True, "not_state": before[key]["state"]} for key in (closed, opened)})
    house.log_is_empty()
    house.report.row(
        "a contact of the MR-DIO4/2 closes and opens, also in less time than between two reads",
        "an event for each closing and each opening",
    )


def a_damper_moves(house: House) -> None:
    """A damper takes the place of a relay, and moves as its limit switches say."""
    device = house.device(DIO42)
    relay, cover, mode = (f"{DIO42}_channel_2_{name}" for name in ("relay", "damper", "mode"))
    contacts = {"open": ("closed", "open"), "closed": ("open", "closed"), "between": ("open", "open")}

    def switches(where: str) -> None:
        for number, contact in zip((3, 4), contacts[where]):
            device.do(f"input {number} contact {contact}")

    house.act([Call(house.announced()[mode], "select.select_option", {"option": "direct_control"}, {})])
    house.settle()
    house.home.wait({relay: {"platform": "switch"}, cover: {"exists": False}})
    switches("closed")
    house.act([Call(house.announced()[mode], "select.select_option", {"option": "motorized_safety_close"}, {})])
    found = house.settle()
    house.home.wait({relay: {"exists": False}, cover: {"platform": "cover", "device_class": "damper", "state": "closed"}})
    house.act([Call(found[cover], "cover.open_cover")])
    switches("between")
    house.home.wait({cover: {"state": "opening"}})
    same(device.read("coil", 1), [1], "the relay of the damper")
    switches("open")
    house.home.wait({cover: {"state": "open"}})
    house.act([Call(found[cover], "cover.close_cover")])
    switches("between")
    house.home.wait({cover: {"state": "closing"}})
    same(device.read("coil", 1), [0], "the relay of the damper")
    switches("closed")
    house.home.wait({cover: {"state": "closed"}})
    house.settle()
    house.log_is_empty()
    house.report.row(
        "channel 2 of the MR-DIO4/2 becomes a damper, is opened and closed",
        "the relay's switch goes, a cover comes; opening, open, closing, closed as relay and limit switches say",
    )


def a_valve_moves(house: House) -> None:
    """A valve opens, is stopped and closes, as its drive and limit switches say."""
    device = house.device(VALVE)
    valve = f"{VALVE}_valve"
    device.do("set 'discrete 1' 1")
    house.home.wait({valve: {"platform": "valve", "device_class": "water", "state": "closed"}})
    found = house.settle()
    house.act([Call(found[valve], "valve.open_valve")])
    same(device.read("holding", 0), [1], "the drive of the valve")
    device.do("set 'discrete 1' 0")
    house.home.wait({valve: {"state": "opening"}})
    device.do("set 'discrete 0' 1")
    house.home.wait({valve: {"state": "open"}})
    house.act([Call(found[valve], "valve.close_valve")])
    device.do("set 'discrete 0' 0")
    house.home.wait({valve: {"state": "closing"}})
    house.act([Call(found[valve], "valve.stop_valve")])
    same(device.read("holding", 0), [0], "the drive of the valve")
    house.home.wait({valve: {"state": "unknown"}})
    device.do("set 'discrete 1' 1")
    house.settle()
    house.log_is_empty()
    house.report.row(
        "a valve of a profile that exists only for this test is opened, stopped half-way and closed",
        "closed, opening, open, closing, unknown as drive and limit switches say",
    )


def eeprom_is_spared(house: House) -> None:
    """A setting in EEPROM is set three times in a row, with a pause between two writes as it is usual."""
    relays = house.device(DO4)
    watchdog = DO4 + "_watchdog"
    pause = 8
    house.gateway.stop()
    usual, house.gateway.wishes = house.gateway.wishes, house.gateway.wishes | {"eeprom": {"interval": f"{pause}s"}}
    house.gateway.start()
    one = house.settle()[watchdog]
    with house.broker.listening([one.outcome_topic()]) as ears:
        house.home.call("number.set_value", watchdog, value=100)
        house.home.wait({watchdog: {"number": 100}})
        since = time.monotonic()
        for value in (200, 300):
            house.home.call("number.set_value", watchdog, value=value)
        ears.wait_for(lambda _, payload: "a newer value took its place" in payload, "that 200 was replaced")
        # Meanwhile it shows what the device holds.
        house.home.wait({watchdog: {"number": 100}}, 0)
        same(relays.read("holding", 66), [10000], "the watchdog's register before its time")
        house.home.wait({watchdog: {"number": 300}})
        same(time.monotonic() - since > pause - 2, True, "whether the second write waited")
        ears.wait_for(lambda _, payload: bool(payload) and json.loads(payload)["wanted"] == "300", "the outcome of 300")
        outcomes = [json.loads(payload)["outcome"] for topic, payload in ears.heard if topic == one.outcome_topic()]
    same(outcomes, ["done", "expired", "done"], "how the three commands ended")
    same(relays.read("holding", 66), [30000], "the watchdog's register")
    house.gateway.stop()
    house.gateway.wishes = usual
    house.gateway.start()
    house.settle()
    house.log_is_empty()
    house.report.row(
        f"a time that is kept in EEPROM is set to 100, 200 and 300 s in a row, with `eeprom: {{interval: {pause}s}}`",
        "100 at once; then it goes on showing 100, which is what the device holds, and after the interval 300; 200 is never "
        "written; the outcomes are done, expired (a newer value took its place), done",
    )


def thousands_of_points(house: House) -> None:
    """Another gateway with 3,000 points: all is announced and there, also after a restart."""
    with contextlib.ExitStack() as ending:
        folder = house.folder / "large"
        folder.mkdir()
        since = time.monotonic()
        large = House(house.program, house.version, folder, ending, large_plant)
        found = large.settle(fresh=True, patience=LONG_PATIENCE)
        first = time.monotonic() - since
        large.log_is_empty()
        points = sum(len(device.points) for device in large.devices)
        since = time.monotonic()
        large.enable()
        large.settle(patience=LONG_PATIENCE)
        enabled = time.monotonic() - since
        large.log_is_empty()
        relays = [one for one in found.values() if one.platform == "switch" and one.enabled]
        since = time.monotonic()
        for service, state in (("switch.turn_on", "on"), ("switch.turn_off", "off")):
            for one in relays:
                large.home.call(service, one.unique_id)
            large.home.wait({one.unique_id: {"state": state} for one in relays}, LONG_PATIENCE)
        switched = time.monotonic() - since
        since = time.monotonic()
        large.home.stop()
        large.home.start()
        large.settle(patience=LONG_PATIENCE)
        again = time.monotonic() - since
        large.log_is_empty()
        since = time.monotonic()
        large.broker.stop(forget=True)
        large.broker.start()
        large.settle(patience=LONG_PATIENCE)
        forgotten = time.monotonic() - since
        large.log_is_empty()
        large.gateway.stop()
        house.report.row(
            f"another gateway with {len(large.devices)} devices on four Modbus TCP connections, {points} points",
            f"{len(found)} entities, each as announced and with its state, {first:.0f} s after all was started; {enabled:.0f} s "
            f"after all are enabled; {again:.0f} s after a restart of Home Assistant with all enabled, {forgotten:.0f} s after "
            f"one of a broker that forgets everything; {len(relays)} switches are turned on and off in {switched:.0f} s; the "
            "log is empty",
        )


def restarts(house: House) -> None:
    """Home Assistant, the broker and busker are started anew, each alone and all in every order."""
    parts = {
        "Home Assistant": (house.home.stop, house.home.start),
        "the broker": (None, house.broker.start),
        "busker": (house.gateway.kill, house.gateway.start),
    }
    orders = [(name,) for name in parts]
    orders += [(a, b, c) for a in parts for b in parts for c in parts if len({a, b, c}) == 3]
    for number, order in enumerate(orders):
        before = states(house)
        since = time.monotonic()
        for name in order:
            stop = parts[name][0] or (lambda: house.broker.stop(forget=number % 2 == 0))
            stop()
        for name in order:
            parts[name][1]()
        found = house.settle()
        house.log_is_empty()
        after = states(house)
        changed = {key: (before[key], after.get(key)) for key in before if before[key] != after.get(key)}
        same(changed, {}, f"the states that changed over the restart of {order}")
        print(f"  {', '.join(order)}: {time.monotonic() - since:.0f} s", flush=True)
    house.report.row(
        "Home Assistant, the broker (with and without a memory) and busker (killed) are started anew, each alone, and all "
        "three in each of the six orders",
        f"each time {len(found)} entities, none unavailable, with the states from before; no others; the log says only "
        "that the broker was away",
    )


def other_topics(house: House) -> None:
    """Values stand elsewhere, are not kept by the broker, and come in one message for each device, too."""
    relays = house.device(DO4)
    lines = sorted({device.line.name for device in house.devices})
    place = f"busker/{relays.line.name}/modbus/{relays.name}"
    before = set(house.settle())
    usual, house.gateway.wishes = house.gateway.wishes, house.gateway.wishes | {
        "mqtt": {"topics": "{base}/{bus}/modbus/{device}/{point}", "qos": 0, "retain": False, "json": True}
    }
    house.witness = {}
    with house.broker.witness(["homeassistant/#", *(f"busker/{name}/#" for name in ["bridge", *lines])], house.witness):
        house.gateway.reload()
        same(set(house.settle()), before, "the entities")
        house.log_is_empty()
        told_always = {f"busker/{device.line.name}/modbus/{device.name}/{what}" for device in house.devices
                       for what in ("availability", "info", "health")}
        is_kept(house, [*lines, *(device.name for device in house.devices)], told_always)
        obeys(house, relays, place)
        starts = {
            "Home Assistant": (house.home.stop, house.home.start),
            "the broker": (lambda: house.broker.stop(forget=True), house.broker.start),
            "busker": (house.gateway.kill, house.gateway.start),
        }
        for names in (["Home Assistant"], ["the broker"], ["busker"], list(starts)):
            since = time.monotonic()
            held = states(house)
            for name in names:
                starts[name][0]()
            for name in names:
                starts[name][1]()
            house.settle()
            house.log_is_empty()
            same(states(house), held, f"the states after the restart of {names}")
            print(f"  {', '.join(names)}: {time.monotonic() - since:.0f} s", flush=True)
        obeys(house, relays, place)
    house.witness = None
    house.gateway.wishes = usual
    house.gateway.reload()
    is_kept(house, lines, set())
    same(set(house.settle()), before, "the entities")
    house.log_is_empty()
    house.report.row(
        "`mqtt: {topics: \"{base}/{bus}/modbus/{device}/{point}\", qos: 0, retain: false, json: true}`",
        "the same entities with the same ids and their states; the broker keeps no value; a relay obeys and stands in its "
        "device's JSON message; so it is after Home Assistant, the broker, which forgets everything, and busker were "
        "started anew, each alone and all three; reloaded with the usual topics, nothing stays at the others; the log is empty",
    )


def is_kept(house: House, levels: list[str], wanted: set[str]) -> None:
    """The broker keeps these topics below these levels, and no others, after a while."""
    deadline = time.monotonic() + PATIENCE
    while True:
        kept = {topic for topic in house.broker.retained(levels) if topic.startswith("busker/")}
        kept -= {topic for topic in kept if topic.startswith("busker/bridge/")}
        if kept == wanted or time.monotonic() > deadline:
            break
    same(kept, wanted, "what the broker keeps")


def obeys(house: House, relays: Device, place: str) -> None:
    """A relay goes on and off: the coil, the entity, and the device's JSON message."""
    for service, payload, coil in (("switch.turn_on", "ON", 1), ("switch.turn_off", "OFF", 0)):
        with house.broker.listening([place, f"{place}/relay_3/outcome"]) as ears:
            house.home.call(service, DO4 + "_relay_3")
            house.home.wait({DO4 + "_relay_3": {"state": payload.lower()}})
            ears.wait_for(lambda topic, text: topic.endswith("/outcome") and json.loads(text)["outcome"] == "done",
                          "that the relay obeyed")
            ears.wait_for(lambda topic, text: topic == place and json.loads(text)["relay_3"] == payload,
                          f"the relay's {payload} in the JSON message")
        same(relays.read("coil", 2), [coil], "the coil of the relay")


def states(house: House) -> dict[str, str]:
    """The states of what holds still."""
    return {
        key: entity["state"] for key, entity in house.home.ask("entities").items()
        if entity["enabled"] and entity["platform"] in ("switch", "select", "number", "text", "cover", "climate")
    }


def nobody_listens(house: House) -> None:
    """Modes change and devices are removed while Home Assistant is stopped and busker runs."""
    inputs, contacts = house.device(AI8), house.device(DIO42)
    before = house.settle()
    house.home.stop()
    was = now_of(inputs, "channel_1_code", before)
    # 0 is a voltage, 0x81 a PT100 (manual, page 16).
    for channel in range(8):
        inputs.write(16 + channel, 0x81 if was.startswith("voltage") else 0)
    house.gateway.stop()
    house.gateway.devices.remove(contacts)
    house.gateway.start()
    deadline = time.monotonic() + PATIENCE
    key = AI8 + "_channel_8_value_" + ("c" if was.startswith("voltage") else "v")
    while key not in house.announced() and time.monotonic() < deadline:
        time.sleep(0.1)
    house.home.start()
    found = house.settle()
    same(key in found, True, "whether the new mode is announced")
    gone = {key for key, one in before.items() if key not in found and one.identity == AI8}
    house.log_is_empty()
    house.gateway.stop()
    house.gateway.devices.append(contacts)
    house.gateway.start()
    house.settle()
    house.report.row(
        "eight modes change at a device, and another device is taken out of the configuration, while Home Assistant is stopped",
        f"when it starts, the {len(gone)} entities of the old modes, the removed device and its entities are gone",
    )


def nobody_is_gone(house: House) -> None:
    """A mode changes and a device is removed while busker is stopped and Home Assistant starts anew."""
    inputs, relays = house.device(AI8), house.device(DO4)
    was = now_of(inputs, "channel_1_code", house.settle())
    house.gateway.stop()
    house.home.wait({DO4 + "_relay_1": {"state": "unavailable"}, AI8 + "_channel_1_code": {"state": "unavailable"}})
    # 0 is a voltage, 0x81 a PT100 (manual, page 16).
    inputs.write(16, 0x81 if was.startswith("voltage") else 0)
    house.home.stop()
    house.home.start()
    house.gateway.devices.remove(relays)
    house.gateway.start()
    found = house.settle()
    house.log_is_empty()
    same({key for key in found if key.startswith(DO4 + "_")}, set(), "what is announced of the removed device")
    same(relays.identity in house.home.ask("devices"), False, "whether the removed device is still there")
    house.gateway.stop()
    house.gateway.devices.append(relays)
    house.gateway.start()
    house.settle()
    house.report.row(
        "a mode changes at the device, and another device is taken out of the configuration, while busker is stopped and "
        "Home Assistant starts anew",
        "entities of the old mode, the removed device and its entities are gone; put back, it has its ids again",
    )


def names(house: House) -> None:
    """A device is renamed in the configuration; a user's own name and id stay; a line without devices goes."""
    relays = house.device(DO4)
    own = DO4 + "_relay_1"
    house.own_ids[own] = "switch.my_own_pump"
    house.home.ask("personalize", entity=own, name="Pump", entity_id=house.own_ids[own])
    house.gateway.stop()
    relays.title = "Heating"
    house.gateway.start()
    house.settle()
    same(house.home.ask("devices")[DO4]["name"], "Heating", "the device's new name")
    house.home.wait({own: {"name": "Pump"}, DO4 + "_relay_2": {"entity_id": f"switch.{relays.name}_relay_2"}})
    house.gateway.stop()
    # Another key in the configuration is another device.
    before = relays.name
    relays.name, relays.identity = "heating", "busker_heating"
    house.by_identity = {device.identity: device for device in house.devices}
    del house.own_ids[own]
    house.gateway.start()
    found = house.settle()
    same({key for key in found if key.startswith(f"busker_{before}_")}, set(), "what is left under the old key")
    devices = house.home.ask("devices")
    same((DO4 in devices, "busker_heating" in devices), (False, True), "the old and the new device")
    house.gateway.stop()
    line, everyone = relays.line.name, house.gateway.devices
    house.gateway.devices = [device for device in house.gateway.devices if device.line.name != line]
    house.gateway.start()
    house.settle()
    house.log_is_empty()
    left = {key for key, device in house.home.ask("devices").items() if line in (device["via"] or "") or line in key}
    same(left, set(), "what is left of the removed line")
    # Back while all goes on: what the broker keeps of the gateway's health is older than the line.
    house.gateway.devices = everyone
    house.gateway.reload()
    house.settle()
    house.log_is_empty()
    house.report.row(
        "a device gets another name, another key, and its line is removed",
        "the name changes and ids stay, also a user's own ones; under another key it is another device, of the old one "
        "nothing is left; nothing is left of the line and its devices; put back by a reload, they are there; the log is empty",
    )


def the_end(house: House) -> None:
    """The gateway is stopped: nothing pretends to be there."""
    entities = house.home.ask("entities")
    house.gateway.stop()
    of_devices = {key: {"state": "unavailable"} for key, entity in entities.items()
                  if entity["device"] in house.by_identity and entity["enabled"]}
    house.home.wait(of_devices)
    house.log_is_empty()
    house.report.row("busker is stopped", f"all {len(of_devices)} entities of its devices are unavailable; the exit code is 0")


CHECKS = [
    everything_is_there, everything_is_enabled, devices_are_seen, devices_obey, eeprom_is_spared, every_control, every_button,
    an_event_arrives, every_mode, every_thing,
    the_wire_is_seen, a_damper_moves, a_valve_moves, restarts, other_topics, nobody_listens, nobody_is_gone, names, the_end,
    thousands_of_points,
]


def broker_version() -> str:
    told = subprocess.run(["mosquitto", "-h"], stdout=subprocess.PIPE, text=True).stdout
    return told.splitlines()[0].replace("version ", "")


def same(found, wanted, what: str) -> None:
    if found == wanted:
        return
    if isinstance(found, set) and isinstance(wanted, set):
        raise Fault(f"{what}: too many {sorted(found - wanted)}, missing {sorted(wanted - found)}")
    raise Fault(f"{what}: {found!r} instead of {wanted!r}")


if __name__ == "__main__":
    try:
        main()
    except Fault as fault:
        sys.exit(f"FAILED: {fault}")
