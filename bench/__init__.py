"""Measurements: each prints its recipe with its figures."""
