"""Prints what Home Assistant's MQTT integration, and what that imports, needs from PyPI.

Each integration's manifest says it; Home Assistant itself reads them when it sets the integration up.
"""

import json
import pathlib

import homeassistant

COMPONENTS = pathlib.Path(homeassistant.__file__).parent / "components"


def requirements(integration: str, seen: set[str]) -> set[str]:
    if integration in seen:
        return set()
    seen.add(integration)
    manifest = COMPONENTS / integration / "manifest.json"
    if not manifest.exists():
        return set()
    facts = json.loads(manifest.read_text())
    wanted = set(facts.get("requirements", []))
    for other in facts.get("dependencies", []) + facts.get("after_dependencies", []):
        wanted |= requirements(other, seen)
    return wanted


print("\n".join(sorted(requirements("mqtt", set()))))
