"""Utilities that no package owns: bounded containers, callback threads, refusal counters."""
