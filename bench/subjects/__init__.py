"""The systems under test: each module has its ``SUBJECTS``, and their roles are imported in the workers."""

from __future__ import annotations

from importlib import import_module

from bench.subjects.subject import Subject

MODULES = ("zstate_chain", "ros1", "ros2", "cyclone", "raw_zenoh")
"""In the order of the tables."""


def all_subjects() -> dict[str, Subject]:
    """Every subject by its name."""
    modules = (import_module(f"bench.subjects.{name}") for name in MODULES)
    return {one.name: one for module in modules for one in module.SUBJECTS}
