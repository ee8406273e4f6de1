"""What is announced no more goes without a trace, whoever is there to notice, and whoever is not."""

import re
import signal
import time

from fault import Deadline, same
from house import House
from steps.devices import AI8, VALVE
from steps.modes import now_of

# Longer than values were held back once, and less than they are now.
BUSY_FOR = 3


def points_go(house: House) -> None:
    """Points are taken out of a profile, and become something else, whoever is there to notice."""
    profile = house.busker.own_profiles / "test" / "valve.yaml"
    whole = profile.read_text()
    less = with_less(whole)
    others = {"closes_after": "sensor", "last_serviced": "number"}
    went = {f"{VALVE}_{name}" for name in ("running_time", "next_service", "label")}
    everything, broker, gateway, home = house.settle(), house.broker, house.gateway, house.home
    same(went - set(everything), set(), "what is there and will go")
    ways = {
        "it reloads": [gateway.reload],
        "it starts anew": [gateway.stop, gateway.start],
        "it and Home Assistant start anew": [gateway.stop, home.stop, home.start, gateway.start],
        "it starts anew while Home Assistant is stopped": [home.stop, gateway.stop, gateway.start, house.is_told, home.start],
        "it starts anew with a broker that has forgotten everything": [gateway.stop, lambda: broker.stop(True), broker.start, gateway.start],
        "it starts anew with a broker that has forgotten everything, while Home Assistant is stopped":
            [home.stop, gateway.stop, lambda: broker.stop(True), broker.start, gateway.start, house.is_told, home.start],
        "it reloads while the broker is stopped, which forgets everything":
            [lambda: broker.stop(True), gateway.reload, broker.start],
    }
    for way, parts in ways.items():
        for text in (less, whole):
            is_changed = False
            for part in parts:
                # When the gateway looks at it next, it is another one.
                if not is_changed and part in (gateway.start, gateway.reload):
                    profile.write_text(text)
                    is_changed = True
                part()
            deadline = Deadline(f"what the profile says now is announced when {way}")
            while (went <= set(now := house.settle())) is not (text is whole):
                deadline.pass_by()
            wanted = {key: one.platform for key, one in everything.items() if one.identity == VALVE}
            if text is not whole:
                wanted = {key: platform for key, platform in wanted.items() if key not in went}
            if text is less:
                wanted |= {f"{VALVE}_{name}": platform for name, platform in others.items()}
                del wanted[f"{VALVE}_eeprom_writes"]
            same({key: one.platform for key, one in now.items() if one.identity == VALVE}, wanted, f"what is there when {way}")
            house.log_is_empty()
        print(f"  {way}", flush=True)
    house.report.row(
        "three points are taken out of a profile, a number becomes a sensor and a moment a number, and back: while busker reloads, while it is "
        "stopped, also with Home Assistant stopped or started anew meanwhile, and with a broker that forgets everything",
        f"in each of {len(ways)} ways all that went is gone from Home Assistant, what became something else is there once, and back "
        "again everything is as before",
    )


def without_some(profile: str) -> str:
    fewer, count = re.subn(r"  (running_time|next_service|label): .*\n", "", profile)
    same(count, 3, "the points that go")
    return fewer


def with_less(profile: str) -> str:
    """Also what was a number is a sensor from now on, and what was a sensor, a number; nothing is in EEPROM any more."""
    less = without_some(profile).replace("poll: slow, write: 0..600, persistent: true, default: 0}", "poll: slow}")
    less = less.replace("points:\n", "points:\n  last_serviced: {at: holding 4, type: u32, poll: slow, write: 0..9}\n", 1)
    return re.sub(r"  last_serviced: \{at: input.*\n", "", less)


def points_change_slowly(house: House) -> None:
    """Points become something else while Home Assistant has other things to do for some seconds."""
    profile = house.busker.own_profiles / "test" / "valve.yaml"
    whole = profile.read_text()
    everything = house.settle()
    # It says that it is there; from now on busker knows it.
    house.home.stop()
    house.home.start()
    house.settle()
    topic = everything[f"{VALVE}_last_serviced"].component["state_topic"]
    for text, platform in ((with_less(whole), "number"), (whole, "sensor")):
        profile.write_text(text)
        house.home.process.send_signal(signal.SIGSTOP)
        try:
            house.gateway.reload()
            deadline = Deadline("what the profile says now is announced")
            while house.announced()[f"{VALVE}_last_serviced"].platform != platform:
                deadline.pass_by()
            time.sleep(BUSY_FOR)
        finally:
            house.home.process.send_signal(signal.SIGCONT)
        deadline = Deadline("the value of the point that became something else is told")
        while house.broker.retained_below(topic).get(topic) == "None":
            deadline.pass_by()
        house.settle()
        house.log_is_empty()
    same(set(house.announced()), set(everything), "what is announced again")
    house.report.row(
        f"a number becomes a sensor, and a moment a number, while Home Assistant does nothing at all for {BUSY_FOR} s, and back",
        "the new values are told when it has followed; the log is empty",
    )


def points_go_unseen(house: House) -> None:
    """Points go when they were announced a moment ago, or when nobody hears of it before busker is started once more."""
    profile = house.busker.own_profiles / "test" / "valve.yaml"
    whole = profile.read_text()
    fewer = without_some(whole)
    everything, broker, gateway, home = house.settle(), house.broker, house.gateway, house.home

    def is_as_before(when: str) -> None:
        deadline = Deadline(f"what the profile says now is announced when {when}")
        while set(house.settle()) != set(everything):
            deadline.pass_by()
        house.log_is_empty()
        print(f"  {when}", flush=True)

    for number, end in enumerate((gateway.kill, gateway.stop)):
        gateway.stop()
        profile.write_text(whole.replace("running_time:", f"short_{number}:"))
        gateway.start()
        came = f"{VALVE}_short_{number}"
        deadline = Deadline("Home Assistant has a point that stays a moment")
        while came not in (home.settled_entities() or {}):
            deadline.pass_by()
        end()
        broker.stop(True)
        broker.start()
        profile.write_text(whole)
        gateway.start()
        is_as_before(f"a point was there until busker was {'stopped' if number else 'killed'}, and the broker forgot everything")

    # Taken out while Home Assistant is stopped, and once more started before it is there again.
    home.stop()
    for text in (fewer, fewer):
        gateway.stop()
        profile.write_text(text)
        gateway.start()
        house.is_told()
    home.start()
    went = {f"{VALVE}_{name}" for name in ("running_time", "next_service", "label")}
    deadline = Deadline("what has gone is announced no more")
    while went & set(house.settle()):
        deadline.pass_by()
    gateway.stop()
    profile.write_text(whole)
    gateway.start()
    is_as_before("it is started twice while Home Assistant is stopped")

    # Eight modes change at a device while Home Assistant is stopped, and busker goes on.
    inputs = house.device(AI8)
    was = now_of(inputs, "channel_1_code", everything)
    usual = inputs.read("holding", 16, 8)
    home.stop()
    # 0 is a voltage, 0x81 a PT100 (manual, page 16).
    for channel in range(8):
        inputs.write(16 + channel, 0x81 if was.startswith("voltage") else 0)
    key = AI8 + "_channel_8_value_" + ("c" if was.startswith("voltage") else "v")
    deadline = Deadline("the new mode is announced")
    while key not in house.announced():
        deadline.pass_by()
    home.start()
    house.settle()
    house.log_is_empty()
    for channel, code in enumerate(usual):
        inputs.write(16 + channel, code)
    is_as_before("modes change while Home Assistant is stopped")
    house.report.row(
        "a point is there for a moment, then busker is stopped, or killed, and the broker forgets everything; points are taken out of a profile, and "
        "busker is started once more, while Home Assistant is stopped; eight modes change while only Home Assistant is stopped",
        "each time all that went is gone from Home Assistant; the log is empty",
    )
