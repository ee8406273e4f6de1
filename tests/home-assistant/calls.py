"""Services that a user calls."""

from announced import Announced

# Commands that one device is given at once.
AT_ONCE = 12

# The device measures, and puts the offset that it found in the place of what was written (manual, RWreg 26):
# busker says of it that another value stands there.
IS_NOT_KEPT = {"busker_fuehlersysteme_sensor_pressure_zero_measure"}


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
