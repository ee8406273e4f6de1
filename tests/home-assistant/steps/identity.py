"""What keeps its identity, and what goes without a trace."""

import re

from calls import Call
from fault import Deadline, same
from house import NEWEST, House
from plant import connected
from steps.devices import DO4


def ids(house: House, but: str = " ") -> dict[str, tuple]:
    """By what Home Assistant knows each entity and its device, histories too; without those that begin with `but`."""
    return {key: (entity["entry"], entity["device_entry"], entity["entity_id"])
            for key, entity in house.home.ask("entities").items() if not key.startswith(but)}


def addresses(house: House) -> None:
    """A device moves to other units and another line, the files are written in another order, and people change names."""
    relays, own = house.device(DO4), DO4 + "_relay_1"
    house.own_ids[own] = "switch.my_own_pump"
    house.home.ask("personalize", entity=own, name="Pump", entity_id=house.own_ids[own])
    before = ids(house)
    about = next(about for about in house.busker.profiles() if about["device"] == relays.profile)
    loft = connected([about, about], "loft", "tcp", house.folder, house.busker, house.ending)
    first = (relays.line, relays.unit)

    def moves(place: tuple, quietly: bool) -> None:
        left = relays.line
        if not quietly:
            house.gateway.stop()
        relays.line, relays.unit = place
        begin_again(house, quietly)
        house.settle()
        same(ids(house, "busker_bus_loft"), before, f"the ids at {place[0].name}, unit {place[1]}")
        same(house.home.ask("devices")[DO4]["via"], f"busker_bus_{place[0].name}", "what the device hangs on")
        # The one that stands there obeys, and no other.
        for service, coil in (("switch.turn_on", 1), ("switch.turn_off", 0)):
            house.act([Call(house.announced()[own], service, {}, {"state": service[12:]})])
            same(relays.read("coil", 0), [coil], "the coil where the device is now")
            others = {device.unit: device.read("coil", 0) for device in loft if (device.line, device.unit) != place}
            same(set(map(tuple, others.values())), {(0,)}, "the coils of the others")
        if left is not relays.line:
            same(f"busker_bus_{left.name}" in house.home.ask("devices"), left is first[0], "whether the line is there that it left")
        house.log_is_empty()

    moves((loft[1].line, 2), quietly=False)
    moves((loft[0].line, 1), quietly=True)
    moves(first, quietly=True)

    profile = house.busker.own_profiles / "test" / "valve.yaml"
    text = profile.read_text()
    for quietly in (True, False):
        if not quietly:
            house.gateway.stop()
        house.gateway.devices.reverse()
        profile.write_text(backwards(profile.read_text()))
        begin_again(house, quietly)
        house.settle()
        same(ids(house), before, "the ids when all stands in another order")
    same(profile.read_text() == text, True, "whether the profile is in its first order again")

    usual = relays.title
    relays.title = "Heizkreis Büro"
    relays.wishes = {"points": {
        "relay_1": {"name": "Umwälzpumpe"}, "relay_2": {"name": "Heizkreis Büro: Übergabe"},
        "relay_3": {"name": "Heizkreis Büro Vorlauf"}, "relay_4": {"name": "Heizkreis Büro"},
    }}
    rename(house)
    house.home.wait({
        own: {"name": "Pump"},
        DO4 + "_relay_2": {"friendly_name": "Heizkreis Büro Übergabe"},
        DO4 + "_relay_3": {"friendly_name": "Heizkreis Büro Vorlauf"},
        # The device's main thing, so to say.
        DO4 + "_relay_4": {"friendly_name": "Heizkreis Büro", "name": None},
        DO4 + "_watchdog": {"friendly_name": "Heizkreis Büro Watchdog time"},
    })
    same(ids(house), before, "the ids under other names")
    house.home.stop()
    house.home.start()
    house.settle()
    same(ids(house), before, "the ids after a restart of Home Assistant")
    relays.title, relays.wishes = usual, {}
    rename(house)
    same(ids(house), before, "the ids under the first names")
    house.log_is_empty()
    house.report.row(
        "a device moves to another unit on another line, to the next unit there, and back; configuration and profile are written in another "
        "order; the device and its relays are called `Heizkreis Büro`, `Umwälzpumpe` and the like; by restarts of busker, and by reloads",
        f"each of the {len(before)} entities and its device have their entries in Home Assistant's registries with the ids from before, "
        "also what the user has called as he likes; the relay obeys where the device is now, and nowhere else; no name has the device's in it twice",
    )


def rename(house: House) -> None:
    """By a reload."""
    begin_again(house, quietly=True)
    if house.version != NEWEST:
        # An older Home Assistant shows another name at once, but takes it into its registry only when it starts.
        house.is_told()
        house.home.stop()
        house.home.start()
    house.settle()


def begin_again(house: House, quietly: bool) -> None:
    if quietly:
        house.gateway.reload()
    else:
        house.gateway.start()


def backwards(profile: str) -> str:
    """The profile with its points in the other order."""
    before, points, after = re.fullmatch(r"(.*\npoints:\n)((?:  \w+: \{[^\n]*\n)+)(.*)", profile, re.DOTALL).groups()
    return before + "".join(reversed(points.splitlines(keepends=True))) + after


def nothing_is_announced(house: House) -> None:
    """Discovery is turned off, by a reload and while busker is stopped: nothing is left in Home Assistant."""
    house.gateway.start()
    before = house.settle()
    usual = house.gateway.wishes
    without = usual | {"home_assistant": usual.get("home_assistant", {}) | {"discovery": False}}
    for quietly in (True, False):
        if not quietly:
            house.gateway.stop()
        house.gateway.wishes = without
        begin_again(house, quietly)
        deadline = Deadline("Home Assistant lets go of everything")
        while house.home.settled_entities() != {} or house.home.ask("devices") or house.broker.retained_below("homeassistant/#"):
            deadline.pass_by()
        house.log_is_empty()
        house.gateway.wishes = usual
        begin_again(house, quietly=True)
        same(set(house.settle()), set(before), "the entities that are there again")
    house.gateway.stop()
    house.log_is_empty()
    house.report.row(
        "`home_assistant: {discovery: false}`, by a reload, and while busker is stopped",
        "Home Assistant has no entity and no device of busker any more, and the broker keeps no announcement; without it all are there again "
        "under the same ids",
    )
