"""Thousands of points."""

import contextlib
import time

from house import LONG_PATIENCE, House
from plant import large_plant


def thousands_of_points(house: House) -> None:
    """Another gateway with 3,000 points: all is announced and there, also after a restart."""
    with contextlib.ExitStack() as ending:
        folder = house.folder / "large"
        folder.mkdir()
        since = time.monotonic()
        large = House(house.program, house.version, folder, ending, large_plant)
        found = large.settle(fresh=True, patience=LONG_PATIENCE)
        first = time.monotonic() - since
        large.log_is_empty()
        points = sum(len(device.points) for device in large.devices)
        since = time.monotonic()
        large.enable()
        large.settle(patience=LONG_PATIENCE)
        enabled = time.monotonic() - since
        large.log_is_empty()
        relays = [one for one in found.values() if one.platform == "switch" and one.enabled]
        since = time.monotonic()
        for service, state in (("switch.turn_on", "on"), ("switch.turn_off", "off")):
            for one in relays:
                large.home.call(service, one.unique_id)
            large.home.wait({one.unique_id: {"state": state} for one in relays}, LONG_PATIENCE)
        switched = time.monotonic() - since
        since = time.monotonic()
        large.home.stop()
        large.home.start()
        large.settle(patience=LONG_PATIENCE)
        again = time.monotonic() - since
        large.log_is_empty()
        since = time.monotonic()
        large.broker.stop(forget=True)
        large.broker.start()
        large.settle(patience=LONG_PATIENCE)
        forgotten = time.monotonic() - since
        large.log_is_empty()
        house.report.let_pass |= large.report.let_pass
        large.gateway.stop()
        house.report.row(
            f"another gateway with {len(large.devices)} devices on four Modbus TCP connections, {points} points",
            f"{len(found)} entities, each as announced and with its state, {first:.0f} s after all was started; {enabled:.0f} s "
            f"after all are enabled; {again:.0f} s after a restart of Home Assistant with all enabled, {forgotten:.0f} s after "
            f"one of a broker that forgets everything; {len(relays)} switches are turned on and off in {switched:.0f} s; the "
            "log is empty",
        )
