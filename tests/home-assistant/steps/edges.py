"""Values at the edge of what a control takes."""

import re
from decimal import ROUND_HALF_UP, Decimal

from announced import Announced
from calls import Call, as_it_was
from fault import Deadline, same
from house import House
from plant import Device
from steps.controls import MOVES_ITSELF, ONLY_SHOWN, is_refused
from steps.devices import VALVE
from steps.modes import now_of

# What Home Assistant sends as `1e-05`.
NEXT_TO_NOTHING = "0.00001"
# From here on a number has no limits of its own but that of a float, whose digits busker tells so.
NO_LIMIT = 1e15
FARTHEST = 3.4028235e38
# By the manual nobody may write it there, so that it is no edge: the number offers it only because the factory has set it.
FACTORY = set(ONLY_SHOWN)


def edge_values(house: House) -> None:
    """Every number at its limits, between two steps and next to nothing, every option, and texts from none to the longest."""
    kinds = {"the smallest": smallest, "the largest": largest, "between two steps": between_steps, "next to nothing": next_to_nothing}
    found = {key: one for key, one in house.settle().items() if is_free(house, one)}
    numbers = {key: one for key, one in found.items() if one.platform == "number"}
    before = {key: one.payload() for key, one in found.items()}
    counts = {}
    for name, kind in kinds.items():
        calls = []
        for one in numbers.values():
            form = form_of(house.device(one.identity), one)
            asked = kind(one, form)
            if asked is not None:
                wanted, comes_out = asked
                calls.append(Call(one, "number.set_value", {"value": float(wanted)}, {"number": float(comes_out)}))
        limited = house.act(calls)
        counts[name] = len(calls)
        others = [call for call in calls if call.one.unique_id not in limited and not is_in_registers(house, call, call.wanted["number"])]
        # What a controller of the device moves may be another value by now; then that is shown.
        deadline = Deadline(f"the registers hold what is shown after {name} of {others}")
        while others:
            seen = house.home.ask("entities")
            others = [call for call in others if not is_in_registers(house, call, seen[call.one.unique_id]["number"])]
            if others:
                deadline.pass_by()
    back = [as_it_was(one, before[key]) for key, one in numbers.items() if before[key] is not None and key not in FACTORY]
    house.act([call for call in back if call])
    for one in numbers.values():
        for value in (one.component["min"] - 1, one.component["max"] + 1):
            if abs(value) < NO_LIMIT:
                house.home.call_fails("number.set_value", one.unique_id, value=value)
    options = choose_every_option(house, {key: one for key, one in found.items() if one.platform == "select"})
    texts = write_texts(house, found)
    house.settle()
    house.log_is_empty()
    house.report.row(
        f"each of {len(numbers)} numbers at its smallest and largest value, between two steps, next to nothing (`1e-05`) where it may be "
        "that, and beyond its limits; each option of the selects; texts from none to the longest, also `Büro`",
        ", ".join(f"{count} times {name}" for name, count in counts.items()) + f", {options} options and {texts} texts: the state is the "
        "nearest value that the register can hold, and the register holds that; what is beyond the limits is refused",
    )


def is_free(house: House, one: Announced) -> bool:
    """Whether nothing else hangs on it, and it holds still."""
    device = house.by_identity.get(one.identity)
    return bool(device) and one.point() not in device.deciding() and not MOVES_ITSELF.fullmatch(one.unique_id)


def form_of(device: Device, one: Announced) -> dict:
    """How its register is to be read at present."""
    point = device.points[one.point()]
    if not point["cases"]:
        return point
    return point["cases"][now_of(device, point["by"], {"": one})]


def resolution(one: Announced, form: dict) -> Decimal | None:
    """The step between two values that can be written; `None` where it is a float, or where another register says it."""
    if not re.fullmatch(r"[iu]\d+", form["type"] or "") or form["decimals_by"]:
        return None
    scale, step = Decimal(str(form["scale"])), Decimal(str(one.component["step"]))
    # Home Assistant knows no finer one.
    return scale if step == Decimal("0.001") else max(scale, step)


def smallest(one: Announced, form: dict) -> tuple | None:
    low = max(one.component["min"], -FARTHEST)
    return None if one.unique_id in FACTORY else (low, low)


def largest(one: Announced, form: dict) -> tuple | None:
    high = min(one.component["max"], FARTHEST)
    return high, high


def between_steps(one: Announced, form: dict) -> tuple | None:
    step = resolution(one, form)
    if step is None:
        return None
    wanted = Decimal(str(one.component["min"])) + step * Decimal("10.4")
    if wanted + step > Decimal(str(one.component["max"])):
        return None
    return wanted, nearest(wanted, form, step)


def next_to_nothing(one: Announced, form: dict) -> tuple | None:
    if one.unique_id in FACTORY or not one.component["min"] <= 0 < one.component["max"] or form["decimals_by"]:
        return None
    step = resolution(one, form)
    wanted = Decimal(NEXT_TO_NOTHING)
    return wanted, wanted if step is None else nearest(wanted, form, step)


def nearest(wanted: Decimal, form: dict, step: Decimal) -> Decimal:
    offset = Decimal(str(form["offset"]))
    return ((wanted - offset) / step).quantize(Decimal(1), ROUND_HALF_UP) * step + offset


def is_in_registers(house: House, call: Call, shown: float | None) -> bool:
    """Whether the device's own registers hold what Home Assistant shows, where they are whole numbers."""
    if shown is None:
        return False
    device = house.device(call.one.identity)
    point, form = device.points[call.one.point()], form_of(device, call.one)
    is_whole = re.fullmatch(r"[iu]\d+", form["type"] or "") and not form["decimals_by"]
    if not is_whole or point["bits"] or point["order"] not in (None, "abcd") or point["table"] != "holding":
        return True
    words = device.raw(call.one.point())
    if form["type"] == "u16" or form["type"] == "i16":
        words = words[:1]
    raw = int.from_bytes(b"".join(word.to_bytes(2, "big") for word in words), "big", signed=form["type"].startswith("i"))
    held = Decimal(raw) * Decimal(str(form["scale"])) + Decimal(str(form["offset"]))
    # Where the largest value is no multiple of the resolution it is one less.
    return abs(held - Decimal(str(shown))) < Decimal(str(form["scale"]))


def choose_every_option(house: House, selects: dict[str, Announced]) -> int:
    """One after the other, and then what was there before."""
    most, count = max(len(one.component["options"]) for one in selects.values()), 0
    for number in range(most):
        calls = [as_it_was(one, one.name(one.component["options"][number])) for one in selects.values()
                 if number < len(one.component["options"])]
        house.act(calls)
        count += len(calls)
    house.act([as_it_was(one, one.payload()) for one in selects.values() if one.payload() is not None])
    return count


def write_texts(house: House, found: dict[str, Announced]) -> int:
    """A text of several registers, and those that are a letter and a number."""
    label = found[VALVE + "_label"]
    texts = ["sixteen letters.", "Büro", "x", "", "1e-05", "unknown", "Heating  valve"]
    for text in texts:
        house.act([Call(label, "text.set_value", {"value": text}, {"state": text})])
        words = house.device(VALVE).raw("label")
        held = b"".join(word.to_bytes(2, "big") for word in words).rstrip(b"\0").decode()
        same(held, text, "the registers of the label")
    house.home.call_fails("text.set_value", label.unique_id, value="seventeen letters")
    is_refused(house, Call(label, "text.set_value", {"value": "Löschwasserventil"[:16]}))
    return len(texts)
