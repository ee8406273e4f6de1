"""What a user finds who has just connected his devices.

What is expected of single devices stands here by hand; what is expected of all of them follows from what
the broker holds.
"""

import re

import rules
from announced import Announced
from fault import same
from house import LONG_PATIENCE, House
from steps.devices import AI8, BUS, DO4, RELAY8, SI4, VALVE


def facts(platform: str, **more) -> dict:
    return {"platform": platform, "enabled": True, "category": None, "known": True, **more}


def every(unique_id: str, numbers: range, what: dict) -> dict:
    return {unique_id.format(number): what for number in numbers}


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
    digits = digits_of_scales(house, found)
    states = [entity for entity in house.home.ask("entities").values() if entity["platform"] not in ("button", "event")]
    unknown = sum(entity["state"] == "unknown" for entity in states)
    house.report.row(
        "every disabled entity is enabled",
        f"{count} more; of {len(found)} none is unavailable, {unknown} are unknown since the device has no value for "
        f"them; the {digits} sensors of whole numbers have the digits behind the dot that their scales give; the log is empty",
    )


def digits_of_scales(house: House, found: dict[str, Announced]) -> int:
    """What a profile says of a register decides how many digits Home Assistant shows, without a word about that in it."""
    seen, wanted = house.home.ask("entities"), {}
    for key, one in found.items():
        device = house.by_identity.get(one.identity)
        point = device and device.points.get(one.point())
        if point and one.platform == "sensor" and (digits := rules.decimals(point)) is not None:
            wanted[key] = digits
    same({key: seen[key]["precision"] for key in wanted}, wanted, "the digits behind the dot")
    return len(wanted)


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
