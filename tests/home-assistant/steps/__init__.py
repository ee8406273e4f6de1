"""What is done, in this order: a step begins with what the one before has left."""

from steps.changes import names, nobody_is_gone, nobody_listens, the_end
from steps.controls import devices_are_seen, devices_obey, eeprom_is_spared, every_button, every_control
from steps.first_sight import everything_is_enabled, everything_is_there, the_wire_is_seen
from steps.many import thousands_of_points
from steps.modes import a_damper_moves, a_valve_moves, an_event_arrives, every_mode, every_thing
from steps.restarts import other_topics, restarts

STEPS = [
    everything_is_there, everything_is_enabled,
    devices_are_seen, devices_obey, eeprom_is_spared, every_control, every_button,
    an_event_arrives, every_mode, every_thing, the_wire_is_seen, a_damper_moves, a_valve_moves,
    restarts, other_topics,
    nobody_listens, nobody_is_gone, names, the_end,
    thousands_of_points,
]
