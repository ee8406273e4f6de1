"""Modes that decide which entities there are, and things made of several points."""

import re
import time

from announced import Announced
from calls import Call, as_it_was
from fault import Fault, same
from house import House
from plant import Device
from steps.devices import DIO42, VALVE


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
