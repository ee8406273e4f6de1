"""A real Home Assistant core without its web server, told what to do in JSON lines.

    .home-assistant/venv/bin/python tests/home-assistant/probe.py FOLDER BROKER_PORT

FOLDER is Home Assistant's configuration folder and keeps its registries over a restart. Each line on
standard input is a command with a `do`; each gets one line of answer on standard output, `{"is": …}` or
`{"failed": "…"}`. The first line out says that Home Assistant is up.

    {"do": "entities"}                    every MQTT entity, with what a user would see of it
    {"do": "devices"}                     every MQTT device
    {"do": "wait", "for": {ID: {…}, …}, "seconds": 20}
                                          until the entities with these unique ids look like this: any of
                                          what `entities` tells, and `exists` (false: not there at all) and
                                          `not_state`; numbers are compared as numbers
    {"do": "call", "service": "switch.turn_on", "entity": ID, "data": {…}}
    {"do": "enable"}                      as a user enables every entity that is disabled; says how many. What
                                          comes after that comes enabled, so that nothing has to be set up anew
    {"do": "set_up_anew"}                 sets up the MQTT integration anew
    {"do": "load", "begins": true}        from now on the platforms' schemas are as they are for a moment while a thread
                                          loads one more platform, until `begins` is false; says how many of their
                                          parts that touches
    {"do": "personalize", "entity": ID, "name": NAME, "entity_id": ENTITY_ID}
                                          as a user gives an entity his own name and id
    {"do": "services"}                    the services of each domain that the MQTT entities have
    {"do": "classes"}                     Home Assistant's own tables of device classes, units and state classes
    {"do": "issues"}                      the open repair issues
    {"do": "quit"}

What Home Assistant logs as a warning or worse stands in FOLDER/warnings, a line of JSON for each with the time: also
what it says while it starts and ends.
"""

import asyncio
import json
import logging
import math
import os
import pathlib
import sys

from homeassistant import bootstrap, config_entries, core, loader, runner
from homeassistant.components import binary_sensor, switch
from homeassistant.components.mqtt import client as mqtt_client, entity as mqtt_entity, schemas
from homeassistant.components.number import const as number_platform
from homeassistant.components.sensor import const as sensor
from homeassistant.const import EVENT_STATE_CHANGED, __version__
from homeassistant.helpers import device_registry, entity_registry, issue_registry
# Behind Home Assistant, which may have put something else in its place.
import voluptuous as vol

CORE = {
    "name": "busker's test", "latitude": 48, "longitude": 8, "elevation": 0, "unit_system": "metric",
    "time_zone": "UTC", "currency": "EUR", "country": "DE",
}


# A user waits so long; the test does not.
config_entries.RELOAD_AFTER_UPDATE_DELAY = 0.5
mqtt_client.RECONNECT_INTERVAL_SECONDS = 1


class Warnings(logging.Handler):
    """Keeps what Home Assistant would show a user in its log."""

    def __init__(self, folder: pathlib.Path) -> None:
        super().__init__(logging.WARNING)
        self.file = (folder / "warnings").open("a", buffering=1)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        fault = f" ({record.exc_info[1]!r})" if record.exc_info else ""
        self.lines.append(f"{record.levelname} {record.name}: {record.getMessage()}{fault}")
        self.file.write(json.dumps([record.created, self.lines[-1]]) + "\n")


class Probe:
    def __init__(self, hass: core.HomeAssistant) -> None:
        self.hass = hass
        self.changed = asyncio.Event()
        # What was taken from the schemas.
        self.checks: list[tuple] = []
        hass.bus.async_listen(EVENT_STATE_CHANGED, self.notice)
        hass.bus.async_listen(entity_registry.EVENT_ENTITY_REGISTRY_UPDATED, self.notice)

    @core.callback
    def notice(self, _: core.Event) -> None:
        self.changed.set()

    def registered(self) -> dict:
        entries = entity_registry.async_get(self.hass).entities.values()
        found = {}
        for entry in entries:
            if entry.platform != "mqtt":
                continue
            if entry.unique_id in found:
                raise ValueError(f"{entry.entity_id} and {found[entry.unique_id].entity_id} share {entry.unique_id}")
            found[entry.unique_id] = entry
        return found

    def entity(self, entry) -> dict:
        state = self.hass.states.get(entry.entity_id)
        attributes = state.attributes if state else {}
        device = device_registry.async_get(self.hass).async_get(entry.device_id)
        return {
            "entity_id": entry.entity_id,
            # By which Home Assistant keeps all that it knows of them, histories too.
            "entry": entry.id,
            "device_entry": entry.device_id,
            "friendly_name": attributes.get("friendly_name"),
            "platform": entry.domain,
            "name": entry.name or entry.original_name,
            "device": next(iter(device.identifiers))[1] if device else None,
            "device_class": entry.original_device_class,
            "state_class": attributes.get("state_class"),
            "unit": attributes.get("unit_of_measurement"),
            "precision": entry.options.get("sensor", {}).get("suggested_display_precision"),
            "category": entry.entity_category.value if entry.entity_category else None,
            "enabled": entry.disabled_by is None,
            "options": attributes.get("options"),
            "min": attributes.get("min"),
            "max": attributes.get("max"),
            "event_type": attributes.get("event_type"),
            "temperature": attributes.get("temperature"),
            "current_temperature": attributes.get("current_temperature"),
            "hvac_modes": attributes.get("hvac_modes"),
            "min_temp": attributes.get("min_temp"),
            "max_temp": attributes.get("max_temp"),
            "state": state.state if state else None,
            "number": number(state.state) if state else None,
            "known": state is not None and state.state not in ("unavailable", "unknown"),
        }

    async def entities(self, _: dict) -> dict:
        return {unique_id: self.entity(entry) for unique_id, entry in self.registered().items()}

    async def devices(self, _: dict) -> dict:
        registry = device_registry.async_get(self.hass)
        entry = self.hass.config_entries.async_entries("mqtt")[0]
        found = {}
        for device in device_registry.async_entries_for_config_entry(registry, entry.entry_id):
            via = registry.async_get(device.via_device_id) if device.via_device_id else None
            found[next(iter(device.identifiers))[1]] = {
                "name": device.name,
                "manufacturer": device.manufacturer,
                "model": device.model,
                "via": next(iter(via.identifiers))[1] if via else None,
            }
        return found

    def missing(self, wanted: dict) -> dict:
        """Those of the wanted entities that do not look as they should, and how they look."""
        registered = self.registered()
        missing = {}
        for unique_id, facts in wanted.items():
            entry = registered.get(unique_id)
            seen = self.entity(entry) if entry else {}
            wants = {key: value for key, value in facts.items() if key not in ("exists", "not_state")}
            if facts.get("exists", True) != (entry is not None) or not all(
                same(seen.get(key), value) for key, value in wants.items()
            ) or ("not_state" in facts and seen.get("state") == facts["not_state"]):
                missing[unique_id] = {key: seen.get(key) for key in ["state", *facts]} if entry else "no such entity"
        return missing

    async def wait(self, command: dict) -> None:
        deadline = asyncio.get_running_loop().time() + command["seconds"]
        while missing := self.missing(command["for"]):
            self.changed.clear()
            left = deadline - asyncio.get_running_loop().time()
            try:
                await asyncio.wait_for(self.changed.wait(), left)
            except TimeoutError:
                shown = {unique_id: [seen, "instead of", command["for"][unique_id]]
                         for unique_id, seen in list(missing.items())[:12]}
                raise TimeoutError(
                    f"after {command['seconds']} s {len(missing)} entities are not as they should be: {shown}"
                ) from None

    async def call(self, command: dict) -> None:
        domain, service = command["service"].split(".")
        target = {"entity_id": self.registered()[command["entity"]].entity_id}
        await self.hass.services.async_call(domain, service, {**target, **command.get("data", {})}, blocking=True)

    async def enable(self, _: dict) -> int:
        mqtt_entity.MqttEntity.entity_registry_enabled_default = True
        registry = entity_registry.async_get(self.hass)
        disabled = [entry.entity_id for entry in self.registered().values() if entry.disabled_by]
        for entity_id in disabled:
            registry.async_update_entity(entity_id, disabled_by=None)
        return len(disabled)

    async def set_up_anew(self, _: dict) -> None:
        await self.hass.config_entries.async_reload("mqtt")

    async def load(self, command: dict) -> int:
        """A platform's schema takes in what all have in common. Voluptuous then compiles those parts anew, in their place and
        from nothing, whoever uses them meanwhile; what took its place in newer versions does not."""
        for part, checks in self.checks:
            part._compiled = checks
        self.checks = []
        if command["begins"] and vol.__name__ == "voluptuous":
            self.checks = [(part, part._compiled) for part in shared_parts(schemas.MQTT_ENTITY_COMMON_SCHEMA.schema)]
            for part, _ in self.checks:
                part._compiled = []
        return len(self.checks)

    async def personalize(self, command: dict) -> None:
        entry = self.registered()[command["entity"]]
        entity_registry.async_get(self.hass).async_update_entity(
            entry.entity_id, name=command["name"], new_entity_id=command["entity_id"]
        )

    async def services(self, _: dict) -> dict:
        known = self.hass.services.async_services()
        return {domain: sorted(known.get(domain, {})) for domain in {entry.domain for entry in self.registered().values()}}

    async def classes(self, _: dict) -> dict:
        def texts(table) -> dict:
            return {str(key): sorted(str(one) for one in several if one is not None) for key, several in table.items()}

        return {
            "sensor": texts(sensor.DEVICE_CLASS_UNITS),
            "number": texts(number_platform.DEVICE_CLASS_UNITS),
            "states": texts(sensor.DEVICE_CLASS_STATE_CLASSES),
            "binary_sensor": [str(one) for one in binary_sensor.BinarySensorDeviceClass],
            "switch": [str(one) for one in switch.SwitchDeviceClass],
        }

    async def issues(self, _: dict) -> list[str]:
        issues = issue_registry.async_get(self.hass).issues.values()
        return [f"issue {issue.issue_id}" for issue in issues if issue.active]

    async def serve(self, commands: asyncio.StreamReader) -> None:
        while line := await commands.readline():
            command = json.loads(line)
            if command["do"] == "quit":
                return
            try:
                tell({"is": await getattr(self, command["do"])(command)})
            except Exception as fault:  # noqa: BLE001: whatever it is, the test is to say it
                tell({"failed": f"{type(fault).__name__}: {fault}"})


def shared_parts(schema) -> list:
    """The parts of a schema that are made of others, such as `vol.All`."""
    if isinstance(schema, vol.Schema):
        return shared_parts(schema.schema)
    if isinstance(schema, (dict, list, tuple)):
        within = schema.values() if isinstance(schema, dict) else schema
        return [part for one in within for part in shared_parts(one)]
    if isinstance(schema, (vol.All, vol.Any)):
        return [schema, *shared_parts(schema.validators)]
    return []


def number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def same(seen, wanted) -> bool:
    if isinstance(seen, (int, float)) and isinstance(wanted, (int, float)):
        return math.isclose(seen, wanted, rel_tol=1e-6, abs_tol=1e-9)
    return seen == wanted


answers = os.fdopen(os.dup(1), "w", buffering=1)


def tell(answer: dict) -> None:
    answers.write(json.dumps(answer) + "\n")


def prepare(folder: pathlib.Path, broker_port: int) -> None:
    """What a user has done who has set up the MQTT integration."""
    storage = folder / ".storage"
    if storage.exists():
        return
    storage.mkdir(parents=True)
    (folder / "configuration.yaml").write_text("homeassistant:\n")
    entry = {
        "entry_id": "mqtt", "domain": "mqtt", "title": "broker", "version": 1, "minor_version": 2,
        "data": {"broker": "127.0.0.1", "port": broker_port}, "options": {}, "source": "user", "unique_id": None,
        "disabled_by": None, "pref_disable_new_entities": False, "pref_disable_polling": False,
    }
    entries = {"version": 1, "minor_version": 1, "key": "core.config_entries", "data": {"entries": [entry]}}
    (storage / "core.config_entries").write_text(json.dumps(entries))


async def main(folder: pathlib.Path, broker_port: int) -> None:
    prepare(folder, broker_port)
    warnings = Warnings(folder)
    logging.getLogger().addHandler(warnings)

    hass = core.HomeAssistant(str(folder))
    loader.async_setup(hass)
    hass.config.skip_pip = True
    # The MQTT integration asks for the web server and what stands on it; nobody here opens a page.
    for part in ("http", "file_upload", "websocket_api", "auth", "api", "network"):
        hass.config.components.add(part)
    bootstrap.DEFAULT_INTEGRATIONS = set()
    bootstrap.CRITICAL_INTEGRATIONS = set()
    if await bootstrap.async_from_config_dict({"homeassistant": CORE}, hass) is None:
        tell({"failed": "; ".join(warnings.lines) or "Home Assistant did not start"})
        return
    probe = Probe(hass)
    await hass.async_start()
    tell({"is": {"home_assistant": __version__, "python": sys.version.split()[0]}})

    commands = asyncio.StreamReader(limit=1 << 24)
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(commands), sys.stdin)
    await probe.serve(commands)
    await hass.async_stop()


if __name__ == "__main__":
    os.dup2(2, 1)  # whatever else is printed must not look like an answer
    if hasattr(runner, "create_event_loop"):
        loop = runner.create_event_loop(False)
    else:
        # As it was before 2026.
        loop = runner.HassEventLoopPolicy(False).new_event_loop()
    asyncio.set_event_loop(loop)
    loop.run_until_complete(main(pathlib.Path(sys.argv[1]), int(sys.argv[2])))
    answers.flush()
    os._exit(0)  # threads of Home Assistant would only delay the end
