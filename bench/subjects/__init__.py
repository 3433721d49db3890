"""The systems under test, one module each, found by name."""

from __future__ import annotations

from importlib import import_module

from bench.subjects.subject import Subject

NAMES = (
    "zstate_peer",
    "zstate_router",
    "zstate_ros2",
    "zstate_mtls",
    "ros1",
    "ros1_cpp",
    "ros1_default",
    "ros2",
    "cyclone",
    "raw_zenoh",
    "raw_zenoh_router",
)
"""Every subject, in the order of the reports."""


def subject_named(name: str) -> Subject:
    """The subject of ``bench/subjects/<name>.py``."""
    subject: Subject = import_module(f"bench.subjects.{name}").SUBJECT
    return subject
