"""Soak test: a fleet through one router for a long time (``python -m bench.soak``)."""
