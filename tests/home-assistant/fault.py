"""When something is not as it should be."""

import time

PATIENCE = 30  # seconds until something that must happen has failed


class Fault(Exception):
    """Something is not as it should be."""


def same(found, wanted, what: str) -> None:
    if found == wanted:
        return
    if isinstance(found, set) and isinstance(wanted, set):
        raise Fault(f"{what}: too many {sorted(found - wanted)}, missing {sorted(wanted - found)}")
    raise Fault(f"{what}: {found!r} instead of {wanted!r}")


class Deadline:
    """For what must come about, and of which nobody tells."""

    def __init__(self, what: str) -> None:
        self.what, self.until = what, time.monotonic() + PATIENCE

    def pass_by(self) -> None:
        if time.monotonic() > self.until:
            raise Fault(f"{self.what}: it did not come about")
        time.sleep(0.1)
