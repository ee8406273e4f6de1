"""Devices that steps call by their identity."""

DO4, AI8, SI4, RELAY8, DIO42, VALVE = (
    f"busker_{name}" for name in ("metz_connect_mr_do4", "metz_connect_mr_ai8", "metz_connect_mr_si4",
                                  "fuehlersysteme_relay8", "metz_connect_mr_dio42", "test_valve")
)
BUS = "busker_bus_cellar"
