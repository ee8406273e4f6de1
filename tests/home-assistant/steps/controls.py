"""What a user does, and what the devices' own registers say then."""

import json
import re
import time

from announced import Announced
from calls import IS_NOT_KEPT, Call, as_it_was
from fault import same
from house import House
from steps.devices import AI8, DIO42, DO4, RELAY8, SI4, VALVE

# The controller writes it itself, all the time (manual, page 70).
MOVES_ITSELF = re.compile(r"busker_metz_connect_mr_aio42_controller_\d_output")

# From the factory it holds what nobody may write (manual, RWreg 65): it is shown, and refused.
ONLY_SHOWN = {"busker_fuehlersysteme_sensor_display_turn": "0"}


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


# What stands for more than busker's entities can do: positions, tilts, presets and ranges.
NOT_OFFERED = re.compile(
    r"cover\.(set_cover_position|\w*tilt\w*)|valve\.set_valve_position"
    r"|climate\.set_(aux_heat|fan_mode|humidity|preset_mode|swing_mode|swing_horizontal_mode)"
    r"|(sensor|binary_sensor|event)\.\w+|\w+\.reload"
)


def every_service(house: House) -> None:
    """Every service that Home Assistant has for these platforms, also those that few people know."""
    found = house.settle()
    order, valve, cover = RELAY8 + "_relay_6_order", VALVE + "_valve", DIO42 + "_channel_2_damper"
    options = found[order].component["options"]
    climate, text = (next(key for key, one in found.items() if one.platform == platform) for platform in ("climate", "text"))
    runs = next(mode for mode in found[climate].component["modes"] if mode != "off")
    texts = house.device(found[text].identity).points[found[text].point()]
    new_text = other_text(found[text], found[text].payload(), texts).data
    # A service with its data, and the state that it leads to; those of one entity stand one behind the other.
    calls = [
        (DO4 + "_relay_3", "switch.turn_on", {}, "on"),
        (DO4 + "_relay_3", "switch.toggle", {}, "off"),
        (DO4 + "_relay_3", "switch.toggle", {}, "on"),
        (DO4 + "_relay_3", "switch.turn_off", {}, "off"),
        (DO4 + "_watchdog", "number.set_value", {"value": 0.5}, "0.5"),
        (DO4 + "_watchdog", "number.set_value", {"value": 0}, "0.0"),
        (order, "select.select_first", {}, options[0]),
        (order, "select.select_next", {}, options[1]),
        (order, "select.select_last", {}, options[-1]),
        (order, "select.select_next", {}, options[0]),
        (order, "select.select_previous", {}, options[-1]),
        (order, "select.select_option", {"option": "automatic"}, "automatic"),
        (text, "text.set_value", new_text, new_text["value"]),
        (RELAY8 + "_restart", "button.press", {}, None),
        (climate, "climate.turn_off", {}, "off"),
        (climate, "climate.turn_on", {}, runs),
        (climate, "climate.toggle", {}, "off"),
        (climate, "climate.set_temperature", {"temperature": 22.5, "hvac_mode": runs}, runs),
        (climate, "climate.set_hvac_mode", {"hvac_mode": "off"}, "off"),
        (valve, "valve.toggle", {}, None),
        (valve, "valve.stop_valve", {}, None),
        (valve, "valve.open_valve", {}, None),
        (valve, "valve.close_valve", {}, None),
        (cover, "cover.toggle", {}, None),
        (cover, "cover.open_cover", {}, None),
        (cover, "cover.close_cover", {}, None),
    ]
    for key, service, data, state in calls:
        wanted = {} if state is None else {"state": state}
        if "temperature" in data:
            wanted["temperature"] = data["temperature"]
        house.act([Call(house.announced()[key], service, data, wanted)])
    offered = {f"{domain}.{name}" for domain, several in house.home.ask("services").items() for name in several}
    missing = {name for name in offered - {service for _, service, _, _ in calls} if not NOT_OFFERED.fullmatch(name)}
    same(missing - {"cover.stop_cover"}, set(), "the services that were not called")
    same(house.device(DO4).read("coil", 2), [0], "the coil of the relay")
    house.settle()
    house.log_is_empty()
    house.report.row(
        "every service of the platforms, such as `select.select_previous`, `climate.toggle` or a temperature together with a mode",
        f"{len({service for _, service, _, _ in calls})} services, {len(calls)} calls: each ends as `done`, and the state is what it should be",
    )


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
