"""When something is not as it should be."""

PATIENCE = 30  # seconds until something that must happen has failed


class Fault(Exception):
    """Something is not as it should be."""


def same(found, wanted, what: str) -> None:
    if found == wanted:
        return
    if isinstance(found, set) and isinstance(wanted, set):
        raise Fault(f"{what}: too many {sorted(found - wanted)}, missing {sorted(wanted - found)}")
    raise Fault(f"{what}: {found!r} instead of {wanted!r}")
