"""The configuration or a device changes, whoever is there to notice."""

import json
import time

from fault import PATIENCE, same
from house import House
from steps.devices import AI8, DIO42, DO4
from steps.modes import now_of


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


def a_neighbour_stays(house: House) -> None:
    """What others have announced, some of it much like ours, is left alone, whatever happens to busker."""
    about = {"device": {"identifiers": ["busker_old_relays"], "name": "Neighbour"}, "origin": {"name": "zigbee2mqtt"}}
    sensor = {"platform": "sensor", "unique_id": "busker_old_relays_sum", "state_topic": "homeassistant/neighbour"}
    single = {"unique_id": "neighbour_single", "name": "Single", "state_topic": "homeassistant/neighbour", "platform": "mqtt"}
    other = {"device": {"identifiers": ["busker_2_relays"], "name": "Another busker"}, "origin": {"name": "busker"},
             "availability": [{"topic": "busker_2/bridge/state"}],
             "components": {"sum": sensor | {"unique_id": "busker_2_relays_sum", "state_topic": "busker_2/relays/sum"}}}
    theirs = {
        "homeassistant/device/busker_old_relays/config": json.dumps(about | {"components": {"sum": sensor}}),
        "homeassistant/sensor/busker_test_valve/config": json.dumps(single),
        "homeassistant/device/busker_2_relays/config": json.dumps(other),
        "homeassistant/neighbour": "42",
        "busker_2/bridge/state": "online",
        "busker_2/relays/sum": "43",
    }
    shown = {"busker_old_relays_sum": {"state": "42"}, "neighbour_single": {"state": "42"}, "busker_2_relays_sum": {"state": "43"}}

    def is_left_alone(when: str) -> None:
        kept = house.broker.retained([]) | house.broker.retained_below("busker_2/#")
        same({topic: kept.get(topic) for topic in theirs}, theirs, f"what the neighbours have at the broker {when}")
        house.home.wait(shown)
        house.log_is_empty()

    relays = house.device(DO4)
    house.broker.publish(theirs)
    is_left_alone("at first")
    for when in ("after a restart", "after the removal of a device", "after a restart without it", "with it again"):
        house.gateway.stop()
        house.home.wait({AI8 + "_channel_1_code": {"state": "unavailable"}})
        if when == "after the removal of a device":
            house.gateway.devices.remove(relays)
        if when == "with it again":
            house.gateway.devices.append(relays)
        house.gateway.start()
        house.home.wait({DO4 + "_relay_1": {"exists": relays in house.gateway.devices},
                         AI8 + "_channel_1_code": {"known": True}})
        is_left_alone(when)
    house.home.stop()
    house.home.start()
    is_left_alone("after a restart of Home Assistant")
    house.broker.publish({topic: "" for topic in theirs})
    house.home.wait({key: {"exists": False} for key in shown})
    house.settle()
    house.log_is_empty()
    house.report.row(
        "others announce devices: one of another origin with a name as ours have, a single entity, and another busker's; busker is "
        "restarted, with a device less, and with it again, and Home Assistant is",
        "what the others have at the broker is byte for byte as it was, and their entities show their states",
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
