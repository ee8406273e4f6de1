"""What a run has seen, as the tables of docs/home-assistant.md."""

import collections
import pathlib

KINDS = ("sensor", "enum", "timestamp", "duration", "binary_sensor", "switch", "number", "select", "button", "text",
         "event", "cover", "valve", "climate")
BEGIN = "<!-- What follows is written by `BLESS=1 make test-home-assistant VERSION={}`. -->\n"
END = "<!-- So far. -->\n"


class Report:
    def __init__(self) -> None:
        self.about = {}
        # By device (or `None` for the gateway and its lines) and kind: all that was ever made.
        self.made: dict = collections.defaultdict(set)
        self.services: dict = collections.Counter()
        self.rows: list[tuple[str, str]] = []
        # Why lines of Home Assistant's log were let pass, by the house that they are of.
        self.let_pass: dict[object, list[str]] = {}

    def saw(self, device: str | None, kind: str, unique_id: str) -> None:
        self.made[device, kind].add(unique_id)

    def row(self, what: str, seen: str) -> None:
        print(f"  {seen}", flush=True)
        self.rows.append((what, seen))

    def markdown(self, in_short: bool) -> str:
        about = self.about
        lines = [
            f"Seen with Home Assistant {about['home_assistant']} on Python {about['python']}, {about['broker']}. Lines of its log "
            f"that were let pass: {self.passed() or 'none'}.",
            "",
            *table(("what", "seen"), self.rows),
            "",
        ]
        return "\n".join(lines if in_short else lines + self.counts())

    def passed(self) -> str:
        counts = collections.Counter(reason for reasons in self.let_pass.values() for reason in reasons)
        return ", ".join(f"{count} about {reason}" for reason, count in sorted(counts.items()))

    def counts(self) -> list[str]:
        return [
            "Entities made of each profile in all of its modes that the run went through (a dash: none):",
            "",
            *self.entities(),
            "",
            "Services called, each of which came back as what the device holds then:",
            "",
            *table(("service", "calls"), [(f"`{service}`", str(count)) for service, count in sorted(self.services.items())]),
            "",
        ]

    def entities(self) -> list[str]:
        devices = sorted({device for device, _ in self.made if device}) + ["busker and its lines"]
        rows = []
        for device in devices:
            key = None if device == devices[-1] else device
            rows.append((device, *(self.count(key, kind) for kind in KINDS)))
        totals = [sum(len(ids) for (_, of), ids in self.made.items() if of == kind) for kind in KINDS]
        rows.append(("together", *(str(total or "-") for total in totals)))
        return table(("profile", *KINDS), rows)

    def count(self, device: str | None, kind: str) -> str:
        return str(len(self.made[device, kind]) or "-")

    def kinds(self) -> set[str]:
        return {kind for (_, kind), ids in self.made.items() if ids}

    def compare(self, page: pathlib.Path, version: str, in_short: bool, bless: bool) -> bool:
        """Whether the page says what was seen with this version; writes it there when it is blessed."""
        text = page.read_text()
        begin = BEGIN.format(version)
        before, rest = text.split(begin)
        _, after = rest.split(END, 1)
        now = before + begin + self.markdown(in_short) + END + after
        if bless:
            page.write_text(now)
        return now == text or bless


def table(head: tuple, rows: list[tuple]) -> list[str]:
    lines = [head, tuple("---" for _ in head), *rows]
    return ["| " + " | ".join(line) + " |" for line in lines]
