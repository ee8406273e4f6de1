"""What is done, in this order: a step begins with what the one before has left."""

from steps.classes import every_class
from steps.changes import a_neighbour_stays, names, nobody_is_gone, nobody_listens, the_end
from steps.controls import devices_are_seen, devices_obey, eeprom_is_spared, every_button, every_control, every_service
from steps.edges import edge_values
from steps.first_sight import everything_is_enabled, everything_is_there, the_wire_is_seen
from steps.gone import points_change_slowly, points_go, points_go_unseen
from steps.identity import addresses, nothing_is_announced
from steps.many import thousands_of_points
from steps.modes import a_damper_moves, a_valve_moves, an_event_arrives, every_mode, every_thing
from steps.restarts import a_platform_is_loaded, other_topics, restarts, the_broker_returns_alone

STEPS = [
    everything_is_there, everything_is_enabled,
    devices_are_seen, devices_obey, eeprom_is_spared, every_control, edge_values, every_button,
    an_event_arrives, every_mode, every_thing, the_wire_is_seen, a_damper_moves, a_valve_moves,
    every_service,
    restarts, a_platform_is_loaded, the_broker_returns_alone, other_topics,
    nobody_listens, nobody_is_gone, a_neighbour_stays, points_go, points_go_unseen, points_change_slowly,
    addresses, names, the_end,
    nothing_is_announced,
    every_class, thousands_of_points,
]
