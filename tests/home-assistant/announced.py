"""What the broker holds, as Home Assistant should show it."""

import json
import re

from fault import Fault


class Announced:
    """One component of a retained discovery message, with the messages that it stands on."""

    def __init__(self, message: dict, component: dict, retained: dict[str, str]) -> None:
        self.component, self.retained = component, retained
        self.platform = component["platform"]
        self.unique_id = component["unique_id"]
        self.identity = message["device"]["identifiers"][0]
        ways = [entry["topic"] for entry in message.get("availability", [])]
        self.is_available = all(retained.get(topic) == "online" for topic in ways)
        self.enabled = component.get("enabled_by_default", True)

    @property
    def kind(self) -> str:
        """As the tables call it: a sensor of named values is an `enum`, one of a moment a `timestamp`."""
        device_class = self.component.get("device_class")
        is_special = self.platform == "sensor" and device_class in ("enum", "timestamp", "duration")
        return device_class if is_special else self.platform

    def payload(self, topic: str = "state_topic") -> str | None:
        """The retained message; `None` also where it says so."""
        payload = self.retained.get(self.component.get(topic))
        return None if payload == "None" else payload

    def is_told(self) -> bool:
        """Whether the broker holds its state, be it that there is none."""
        topics = [self.component[key] for key in self.component if key.endswith("state_topic")]
        return self.platform == "event" or all(topic in self.retained for topic in topics)

    def outcome_topic(self) -> str:
        topic = self.component.get("command_topic") or self.component["mode_command_topic"]
        return topic.removesuffix("/set") + "/outcome"

    def point(self) -> str | None:
        """The name of the point or thing that it commands or shows."""
        topic = self.component.get("command_topic") or self.component.get("state_topic")
        found = re.fullmatch(r"busker/[\w/]+?/(\w+)(/set)?", topic or "")
        return found and found[1]

    def identity_facts(self) -> dict:
        """What the registry should say of it."""
        facts = {
            "platform": self.platform,
            "device": self.identity,
            "entity_id": self.component.get("default_entity_id"),
            "device_class": self.component.get("device_class"),
            "category": self.component.get("entity_category"),
            # One that is called as its device has no name of its own.
            "name": self.component["name"],
        }
        return {key: value for key, value in facts.items() if value is not None or key != "entity_id"}

    def kept_facts(self, fresh: bool) -> dict:
        """What it is once it is enabled, be it available or not. When the digits of one that is there change, Home
        Assistant takes notice only at its next start."""
        facts = {key: self.component[key] for key in ("state_class", "options") if key in self.component}
        if fresh and "suggested_display_precision" in self.component:
            facts["precision"] = self.component["suggested_display_precision"]
        if self.platform == "number" and not self.is_converted():
            facts |= {"min": self.component["min"], "max": self.component["max"]}
        return facts

    def state_facts(self) -> dict:
        """What a user should see of it."""
        if not self.is_available:
            return {"state": "unavailable"}
        if "value_json" in self.component.get("value_template", ""):
            value = self.figure()
            return {"state": "unknown"} if value is None else {"known": True}
        if self.platform in ("button", "event"):
            # Their state is when something last happened.
            return {}
        if self.platform == "climate":
            return {
                "state": self.payload("mode_state_topic") or "unknown",
                "temperature": as_number(self.payload("temperature_state_topic")),
                "current_temperature": as_number(self.payload("current_temperature_topic")),
                "hvac_modes": self.component["modes"],
                "min_temp": self.component["min_temp"],
                "max_temp": self.component["max_temp"],
            }
        payload = self.payload()
        if payload is None:
            return {"state": "" if self.platform == "text" else "unknown"}
        if self.platform in ("switch", "binary_sensor"):
            return {"state": "on" if payload == self.component.get("payload_on", "ON") else "off"}
        if self.platform in ("cover", "valve"):
            return {"state": "unknown" if payload == "stopped" else payload}
        if self.platform == "number":
            value = as_number(payload)
            fits = value is not None and self.component["min"] <= value <= self.component["max"]
            if not fits:
                return {"state": "unknown"}
            return {"known": True} if self.is_converted() else self.unit_facts() | {"number": value}
        if self.platform == "sensor" and self.is_of_numbers():
            value = as_number(payload)
            if value is None:
                return {"state": "unknown"}
            return {"known": True} if self.is_converted() else self.unit_facts() | {"number": value}
        return {"state": self.option(payload)}

    def figure(self):
        """What the gateway says of itself, a bus or a device: what the template takes out of a JSON message."""
        found = json.loads(self.payload())
        path = re.search(r"value_json((?:\.\w+|\['\w+'\])+)", self.component["value_template"])
        for step in re.findall(r"\w+", path[1]):
            # What is not in it at all is a mistake in the template.
            found = found[step]
        return found

    def option(self, name: str) -> str:
        """What a select shows for the value of this name: Home Assistant takes `none` for unknown."""
        return "nothing" if self.platform == "select" and name == "none" else name

    def name(self, option: str) -> str:
        return "none" if self.platform == "select" and option == "nothing" else option

    def is_converted(self) -> bool:
        """A metric Home Assistant shows it in °C, somehow rounded."""
        return self.component.get("unit_of_measurement") == "°F"

    def unit_facts(self) -> dict:
        unit = self.component.get("unit_of_measurement")
        if unit == "mbar" and self.platform == "sensor":
            # What a metric Home Assistant calls the pressure of the air.
            unit = "hPa"
        # The same letter in two places of Unicode.
        return {"unit": unit and unit.replace("µ", "μ")}

    def is_of_numbers(self) -> bool:
        keys = ("unit_of_measurement", "state_class", "suggested_display_precision")
        return any(key in self.component for key in keys)


def announced(retained: dict[str, str]) -> dict[str, Announced]:
    """All that is announced, by unique id."""
    found = {}
    for topic, payload in retained.items():
        if not topic.startswith("homeassistant/device/"):
            continue
        message = json.loads(payload)
        for component in message["components"].values():
            if "unique_id" not in component:
                # A tombstone, heard by who was there; what is announced follows at once.
                continue
            one = Announced(message, component, retained)
            if one.unique_id in found:
                raise Fault(f"{one.unique_id} is announced twice")
            found[one.unique_id] = one
    return found


def as_number(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return None
