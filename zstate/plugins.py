"""Plugins: what a folder, or another package, adds to zstate.

The plugins of zstate are a table of strings, imported on use. Other packages have an entry point, see
``zstate.other_plugins``; ``zstate.stream_registry`` has the streams of all, by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from types import MappingProxyType
from typing import NamedTuple

from zstate.streams import Stream

_BUILT_IN = (
    "driving",
    "scans",
    "odometry",
    "clouds",
    "cameras",
    "fleet",
    "recording",
    "archive",
    "view",
    "foxglove",
    "bridges",
    "metrics",
)
"""The folders of zstate with a module ``plugin``, in the order of the liveliness tokens of their streams."""


class Command(NamedTuple):
    """A command of the command line.

    ``reference`` is the object reference, ``"module:attribute"``, of its click.Command, which is loaded when
    it is called. The help of zstate lists its own ones with their ``summary``, in a ``section``.
    """

    reference: str
    section: str = ""
    summary: str = ""


@dataclass(frozen=True)
class Plugin:
    """What one folder or package brings.

    - ``streams``
    - ``commands`` of the command line by name: a ``Command``, or only its ``reference``.
    - ``synonyms``: commands of other tools, in lower case with underscores, and the commands to call instead,
      separated by " | ": ``{"rosbag": "record | replay"}``. A hint shows them.
    - ``checks``: ``"module:class"`` of what `zstate doctor` checks, a subclass of
      ``zstate.cli.doctor.plugin_checks.PluginChecks``.
    - ``metrics``: of zstate itself, ``"module:class"`` of what `zstate monitor --metrics` serves of its
      streams, a subclass of ``zstate.cli.metrics.PluginMetrics``.
    - ``store``: of zstate itself, ``"module:class"`` of what keeps recordings other than as files, a
      ``zstate.recording.stores.RecordingStore``.
    - ``needs``: of zstate itself, the folders of other plugins without which it does not work.
    """

    name: str
    streams: tuple[Stream, ...] = ()
    commands: Mapping[str, str | Command] = field(default_factory=lambda: MappingProxyType({}))
    synonyms: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    checks: str = ""
    metrics: str = ""
    store: str = ""
    needs: tuple[str, ...] = ()

    def command(self, name: str) -> Command:
        """The command ``name``, which it brings."""
        found = self.commands[name]
        return Command(found) if isinstance(found, str) else found


@cache
def built_in_plugins() -> tuple[Plugin, ...]:
    """The plugins of zstate itself, without those whose folder, or another one that it needs, is removed."""
    found: dict[str, Plugin] = {}
    for folder in _BUILT_IN:
        try:
            plugin: Plugin = import_module(f"zstate.{folder}.plugin").PLUGIN
        except ModuleNotFoundError as error:
            if error.name not in (f"zstate.{folder}", f"zstate.{folder}.plugin"):
                raise
        else:
            if found.keys() >= set(plugin.needs):
                found[folder] = plugin
    return tuple(found.values())
