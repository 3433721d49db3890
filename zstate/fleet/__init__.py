"""Routers of a fleet: their configuration, access control, and certificates."""
