"""How it travels: Zenoh sessions, streams, latched values and presence."""
