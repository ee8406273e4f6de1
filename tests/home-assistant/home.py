"""Home Assistant, driven through probe.py."""

import contextlib
import json
import pathlib
import subprocess
import sys

from fault import PATIENCE, Fault

HERE = pathlib.Path(__file__).parent


class Home:
    """A running Home Assistant that can be stopped and started; it keeps its registries."""

    def __init__(self, folder: pathlib.Path, broker_port: int, ending: contextlib.ExitStack) -> None:
        self.command = [sys.executable, str(HERE / "probe.py"), str(folder), str(broker_port)]
        self.warnings = folder / "warnings"
        self.start()
        ending.callback(lambda: self.process.kill())

    def start(self) -> None:
        self.process = subprocess.Popen(self.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1)
        self.about = self.answer()

    def stop(self) -> None:
        self.process.stdin.write('{"do": "quit"}\n')
        self.process.wait(PATIENCE)

    def answer(self):
        line = self.process.stdout.readline()
        if not line:
            raise Fault("Home Assistant ended; see above")
        answer = json.loads(line)
        if "failed" in answer:
            raise Fault(answer["failed"])
        return answer["is"]

    def ask(self, do: str, **more):
        self.process.stdin.write(json.dumps({"do": do, **more}) + "\n")
        return self.answer()

    def settled_entities(self) -> dict | None:
        """Its entities, or `None` for the moment in which one point is two: what it may have kept of earlier runs is announced
        once more before it is taken away, since it takes away only what it knows."""
        try:
            return self.ask("entities")
        except Fault as fault:
            if " share " not in str(fault):
                raise
            return None

    def log(self) -> list[tuple[float, str]]:
        """What it has logged as a warning or worse since the first start, and when, by the clock on the wall."""
        return [tuple(json.loads(line)) for line in self.warnings.read_text().splitlines()]

    def wait(self, wanted: dict, seconds: float = PATIENCE) -> None:
        self.ask("wait", **{"for": wanted}, seconds=seconds)

    def call(self, service: str, entity: str, **data) -> None:
        self.ask("call", service=service, entity=entity, data=data)

    def call_fails(self, service: str, entity: str, **data) -> None:
        try:
            self.call(service, entity, **data)
        except Fault:
            return
        raise Fault(f"{service} with {data} was accepted")
