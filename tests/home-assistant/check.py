"""The Home Assistant test: what a user sees of a device of every profile, and what happens when he acts.

    .home-assistant/VERSION/venv/bin/python tests/home-assistant/check.py BUSKER VERSION [STEP …]

VERSION is that of Home Assistant; an old one is what the gateway's `minimum_version` asks for. With the names of
steps (`STEPS`) only these are done, and no page is written.
Everything is real but the devices: mosquitto, Home Assistant, the built gateway on a serial line, a serial server
and Modbus TCP. What runs stands in `house`, what is done with it below `steps`, and what was seen in `report`.
"""

import contextlib
import os
import pathlib
import sys
import tempfile
import time

from fault import Fault, same
from house import NEWEST, House
from report import KINDS
from steps import STEPS

PAGE = pathlib.Path(__file__).parent.parent.parent / "docs" / "home-assistant.md"


def main() -> None:
    began = time.monotonic()
    program, version, *steps = sys.argv[1:]
    only = [step for step in STEPS if step.__name__ in steps]
    same({step.__name__ for step in only}, set(steps), "the steps that there are")
    # All ends before its folder goes; what was killed may still write a little.
    scratch = tempfile.TemporaryDirectory(prefix="busker-ha-", ignore_cleanup_errors=True)
    with scratch as folder, contextlib.ExitStack() as ending:
        house = House(program, version, pathlib.Path(folder), ending)
        print(f"Home Assistant {house.home.about['home_assistant']}, {len(house.devices)} devices", flush=True)
        try:
            for step in only or STEPS:
                since = time.monotonic()
                print(f"- {step.__doc__.splitlines()[0]}", flush=True)
                step(house)
                print(f"  ({time.monotonic() - since:.0f} s)", flush=True)
        except Fault:
            # What both themselves say about it, for whoever has to find out.
            print(house.gateway.log(), *(line for _, line in house.home.log()[-20:]), sep="\n", file=sys.stderr)
            raise
    if only:
        return
    missing = set(KINDS) - house.report.kinds()
    print(f"all as it should be, after {time.monotonic() - began:.0f} s; of no profile: {', '.join(missing) or 'nothing'}")
    same(missing, set(), "the platforms that were not seen")
    if not house.report.compare(PAGE, version, in_short=version != NEWEST, bless=bool(os.environ.get("BLESS"))):
        print(f"{PAGE.name} says something else; with BLESS=1 this writes what was seen")


if __name__ == "__main__":
    try:
        main()
    except Fault as fault:
        sys.exit(f"FAILED: {fault}")
