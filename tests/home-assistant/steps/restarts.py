"""Home Assistant, the broker and busker are started anew."""

import json
import time

from fault import PATIENCE, same
from house import House
from plant import Device
from steps.controls import MOVES_ITSELF
from steps.devices import DO4


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
        for name in reversed(order):
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
        "three in each of the six orders, stopped the other way round",
        f"each time {len(found)} entities, none unavailable, with the states from before; no others; the log says only "
        "that the broker was away",
    )


def a_platform_is_loaded(house: House) -> None:
    """All is announced while Home Assistant loads one more platform, and forgets for a moment what goes without saying."""
    before = set(house.settle())
    parts = house.home.ask("load", begins=True)
    with house.broker.listening(["homeassistant/status"]) as ears:
        house.home.ask("set_up_anew")
        ears.wait_for(lambda _, payload: payload == "online", "that Home Assistant is there again")
    same(set(house.settle()), before, "the entities")
    house.log_is_empty()
    house.home.ask("load", begins=False)
    if parts:
        house.report.row(
            "all is announced while a thread of Home Assistant compiles anew what the schemas of its platforms share, "
            f"{parts} parts, as it does when it loads one more platform",
            f"the {len(before)} entities with their states; the log is empty",
        )


def the_broker_returns_alone(house: House) -> None:
    """Broker and gateway end in the same moment, and only the broker comes back, with all that it kept."""
    usual, house.gateway.wishes = house.gateway.wishes, house.gateway.wishes | {
        "republish": "2s", "home_assistant": house.gateway.wishes.get("home_assistant", {}) | {"expire_after": "6s"}
    }
    house.gateway.reload()
    # Nothing expires that is polled, and told again in time.
    time.sleep(8)
    found = house.settle()
    before = states(house)
    house.broker.remember()
    # Who would tell the last will is the first to end.
    house.broker.kill()
    house.gateway.kill()
    house.broker.start()
    same(house.broker.retained([])["busker/bridge/state"], "online", "what the broker goes on telling")
    seen = house.home.ask("entities")
    expires = {key: one.component.get("expire_after") for key, one in found.items() if seen[key]["enabled"]}
    soon = {key for key, seconds in expires.items() if seconds and seconds <= 6}
    # Home Assistant finds the broker again, and believes it.
    house.home.wait({key: {"state" if isinstance(state, str) else "number": state} for key, state in before.items()})
    house.home.wait({key: {"state": "unavailable"} for key in soon})
    same(states(house), before, "the controls, which do not expire")
    house.gateway.start()
    house.settle()
    house.log_is_empty()
    house.gateway.wishes = usual
    house.gateway.reload()
    house.settle()
    house.log_is_empty()
    house.report.row(
        "`republish: 2s, home_assistant: {expire_after: 6s}`; the broker and busker are killed in the same moment, and only the "
        "broker comes back, which goes on telling `online`",
        f"before, nothing expires; then {len(soon)} sensors and binary sensors of quick polls become unavailable within seconds, "
        f"{sum(bool(seconds) for seconds in expires.values()) - len(soon)} of slower ones would later; when busker is "
        "there again all have their states",
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


def states(house: House) -> dict[str, str | float]:
    """The states of what holds still. Home Assistant goes on showing 0.0 where 0 is told, until its next start."""
    return {
        key: entity["state"] if entity["number"] is None else entity["number"] for key, entity in house.home.ask("entities").items()
        if entity["enabled"] and entity["platform"] in ("switch", "select", "number", "text", "cover", "climate")
        and not MOVES_ITSELF.fullmatch(key)
    }
