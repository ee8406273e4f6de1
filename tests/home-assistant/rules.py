"""What must be so of every entity, whatever it was announced as: what a person reads, and what ids are made of."""

import re
from decimal import Decimal

from announced import Announced
from fault import same


def are_kept(all_announced: dict[str, Announced], seen: dict[str, dict], devices: dict[str, dict], own: set[str]) -> None:
    """`own`: what a user has called as he likes."""
    faults = []
    called: dict[tuple, str] = {}
    for key, one in all_announced.items():
        entity, device = seen[key], devices[one.identity]
        name = entity["name"]
        if "default_entity_id" not in one.component:
            faults.append(f"{key}: no default_entity_id")
        if key in own:
            continue
        if name is None:
            # It is called as its device.
            if entity["friendly_name"] != device["name"] or one.component["name"] is not None:
                faults.append(f"{key}: no name")
            continue
        if entity["friendly_name"] not in (None, f"{device['name']} {name}"):
            faults.append(f"{key}: {entity['friendly_name']!r} for {name!r} of {device['name']!r}")
        if name.lower().startswith(device["name"].lower()) or "busker" in name.lower():
            faults.append(f"{key}: the device's name stands twice in {name!r}")
        if not is_readable(name):
            faults.append(f"{key}: {name!r} is no name for people")
        other = called.setdefault((one.identity, name), key)
        if other != key:
            faults.append(f"{key}: is called as {other}, {name!r}")
    same(faults, [], "what is against the rules")


def is_readable(name: str) -> bool:
    """In sentence case, without what only identifiers have."""
    return name == name.strip() and not name[:1].islower() and "_" not in name and "  " not in name


def decimals(about: dict) -> int | None:
    """The digits behind the dot that the scale of a whole number gives, where that alone decides."""
    if not re.fullmatch(r"[iu]\d+", about["type"] or "") or about["decimals_by"] or about["since"] or about["values"]:
        return None
    return max(0, -Decimal(str(about["scale"])).normalize().as_tuple().exponent)
