"""Metrics for Prometheus: what publishers, listeners and routers count, read when it is asked for."""
