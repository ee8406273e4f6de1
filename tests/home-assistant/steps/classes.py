"""Every device class with every unit and state class that Home Assistant has for it, and with those that it has not.

What busker takes, and what it refuses when a profile is read, is held against Home Assistant's own tables.
"""

import contextlib
import pathlib
import re
import subprocess

from fault import same
from gateway import Busker
from house import LONG_PATIENCE, NEWEST, House
from plant import Device, connected

# What 2025.4 does not know yet: it is announced without its class.
NEWER = [("temperature_delta", "K"), ("reactive_energy", "kvarh"), ("pm4", "μg/m³"), ("volume_flow_rate", "m³/min")]
# These are for values that are no numbers.
NO_NUMBERS = {"date", "enum", "timestamp", "uptime"}
# Points of a profile that is only checked.
AT_ONCE = 1000
# busker announces a unit as it is written; Home Assistant has both letters for micro, and takes any of them.
MICRO = str.maketrans({"µ": "μ"})


def every_class(house: House) -> None:
    """Device classes, units and state classes, as Home Assistant's own tables have them."""
    tables = house.home.ask("classes")
    numeric = {name: [unit.translate(MICRO) for unit in units] for name, units in tables["sensor"].items()
               if name not in NO_NUMBERS}
    units = {unit for several in numeric.values() for unit in several}
    wanted = [(name, unit) for name, several in numeric.items() for unit in several]
    taken = house.folder / "classes"
    others = [(name, unit) for name in numeric for unit in sorted(units - set(numeric[name])) if numeric[name]]
    if house.version == NEWEST:
        # An older one has fewer units for some.
        is_refused = refused(house, taken / "others", [(name, unit, None) for name, unit in others])
        same({pair for pair in others if (*pair, None) not in is_refused}, set(), "the units that Home Assistant would refuse")
    kinds = ["measurement", "measurement_angle", "total", "total_increasing"]
    states = [(name, unit_for(name, state, several), state) for name, several in numeric.items() for state in kinds]
    has_state = {one for one in states if one[2] in tables["states"].get(one[0], [])}
    # Home Assistant says of a state class of angles by itself that it is for degrees only.
    has_state = {one for one in has_state if one[2] != "measurement_angle" or one[1] == "°"}
    is_refused = refused(house, taken / "states", states)
    if house.version == NEWEST:
        same(set(states) - is_refused, has_state, "the state classes that busker takes")
    good = [(name, unit, None) for name, unit in wanted] + sorted(has_state - is_refused, key=str)
    good = [one for one in good if one not in refused(house, taken / "good", good)]
    if house.version == NEWEST:
        same(set(wanted) - {one[:2] for one in good}, set(), "what busker refuses and Home Assistant has")
    else:
        good += [(name, unit, None) for name, unit in NEWER if (name, unit) not in wanted]
    count = are_there(house, good, tables)
    house.report.row(
        "every device class with every unit and state class that Home Assistant's own tables have for it, of a profile made "
        "from them",
        f"{count} sensors, numbers, binary sensors and switches, each with its class and a state; {len(others)} units and "
        f"{len(states) - len(has_state)} state classes that do not go with their class are refused when the profile is "
        "read; the log is empty" if house.version == NEWEST else
        f"{count} sensors, numbers, binary sensors and switches, each with a state, and with its class where this version has "
        "it; the log is empty",
    )


def unit_for(name: str, state: str, units: list[str]) -> str | None:
    if state == "measurement_angle" and "°" in units:
        return "°"
    return units[0] if units else None


def profile(points: list[tuple], tables: dict | None = None) -> str:
    """A profile with a sensor for each class, unit and state class; with `tables`, also the other platforms."""
    lines, looks = [], []
    for number, (name, unit, state) in enumerate(points):
        says = f", unit: '{unit}'" if unit else ""
        lines.append(f"  p{number}: {{at: input {number}, poll: slow{says}}}")
        looks.append(f"  p{number}: {{device_class: {name}{f', state_class: {state}' if state else ''}}}")
        if tables and state is None and name in tables["number"]:
            lines.append(f"  n{number}: {{at: holding {number}, poll: slow, write: 0..100{says}}}")
            looks.append(f"  n{number}: {{device_class: {name}}}")
    for number, name in enumerate(tables["binary_sensor"] if tables else []):
        lines.append(f"  b{number}: {{at: discrete {number}, poll: slow}}")
        looks.append(f"  b{number}: {{device_class: {name}}}")
    for number, name in enumerate(tables["switch"] if tables else []):
        lines.append(f"  s{number}: {{at: coil {number}, poll: slow, write: any}}")
        looks.append(f"  s{number}: {{device_class: {name}}}")
    head = ["device: test/classes", "manufacturer: Test", "model: Classes", "source: Home Assistant's tables", "points:"]
    return "\n".join([*head, *lines, "home_assistant:", *looks, ""])


def refused(house: House, folder: pathlib.Path, points: list[tuple]) -> set[tuple]:
    """Those of them that `busker profiles check` has something against."""
    folder.mkdir(parents=True, exist_ok=True)
    file, found = folder / "classes.yaml", set()
    for first in range(0, len(points), AT_ONCE):
        some = points[first : first + AT_ONCE]
        file.write_text(profile(some))
        lines = file.read_text().splitlines()
        check = [house.program, "profiles", "check", str(file)]
        told = subprocess.run(check, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True).stdout
        # Each of them has a line of its own.
        for line in re.findall(r"classes\.yaml:(\d+):", told):
            found.add(some[int(re.match(r"  p(\d+):", lines[int(line) - 1])[1])])
    return found


def are_there(house: House, points: list[tuple], tables: dict) -> int:
    """Another gateway with a device of all these, and what Home Assistant makes of it."""
    own = house.folder / "classes" / "profiles"
    (own / "test").mkdir(parents=True)
    (own / "test" / "classes.yaml").write_text(profile(points, tables))

    def planted(busker: Busker, folder: pathlib.Path, ending: contextlib.ExitStack) -> list[Device]:
        abouts = [about for about in busker.profiles() if about["device"] == "test/classes"]
        return connected(abouts, "tables", "tcp", folder, busker, ending)

    with contextlib.ExitStack() as ending:
        folder = house.folder / "classes" / "house"
        folder.mkdir()
        other = House(house.program, house.version, folder, ending, planted, own, knows_all=True)
        wanted = {}
        for key, one in other.announced_in_the_end("busker_test_classes").items():
            if not re.search(r"_classes_[pnbs]\d+$", key):
                continue
            wanted[key] = {"platform": one.platform, "device_class": one.component.get("device_class"), "known": True,
                           "state_class": one.component.get("state_class")}
        other.home.wait(wanted, LONG_PATIENCE)
        expected = len(points) + sum(name in tables["number"] and state is None for name, _, state in points)
        expected += len(tables["binary_sensor"]) + len(tables["switch"])
        same(len(wanted), expected, "how many there are")
        if house.version == NEWEST:
            found = {(one["device_class"], one["state_class"]) for key, one in wanted.items() if "_classes_p" in key}
            same({(name, state) for name, _, state in points if state} - found, set(), "classes that were left out")
        other.log_is_empty()
        house.report.let_pass |= other.report.let_pass
        other.gateway.stop()
    return expected
