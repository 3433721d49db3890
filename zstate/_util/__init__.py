"""Utilities for all packages: bounded containers, callback threads, refusal counters, texts."""
