"""Micro benchmarks: one operation each."""
