"""Plugins: what a folder, or a package of somebody else, adds to zstate, and how it is found.

Those of zstate are a table of strings, imported on use. Other packages have an entry point::

    [project.entry-points."zstate.plugins"]
    battery = "zstate_battery:PLUGIN"

which is read when a stream or a command is met that zstate does not bring, and by the tools that list all. A
plugin that cannot be used is reported once, in the log, with its distribution; all others work.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType
from typing import NamedTuple

from zstate.errors import printable
from zstate.streams import CLOCK, CORE, Stream

GROUP = "zstate.plugins"
"""The group of entry points."""

_BUILT_IN = ("zstate.driving.plugin", "zstate.scans.plugin", "zstate.odometry.plugin")

_LOG = logging.getLogger("zstate")


@dataclass(frozen=True)
class Plugin:
    """What one folder or package brings: ``streams``, and ``commands`` of the command line.

    ``commands`` maps the name of a command to ``"module:attribute"`` of a click.Command, which is loaded when
    it is called.
    """

    name: str
    streams: tuple[Stream, ...] = ()
    commands: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))


class FoundPlugin(NamedTuple):
    """The plugin of an entry point; ``problem`` is why it, or a part of it, is not used, if so."""

    entry: str
    distribution: str
    version: str
    plugin: Plugin
    problem: str = ""


@cache
def built_in_plugins() -> tuple[Plugin, ...]:
    """The plugins of zstate itself that bring streams."""
    return tuple(import_module(name).PLUGIN for name in _BUILT_IN)


@cache
def found_plugins() -> tuple[FoundPlugin, ...]:
    """The plugins of other packages, by distribution, without what another one brings already.

    Those with a problem are in the log, too.
    """
    taken = {row.name: "zstate" for row in (*CORE, CLOCK)}
    taken |= {row.name: "zstate" for plugin in built_in_plugins() for row in plugin.streams}
    commands: dict[str, str] = {}
    found: list[FoundPlugin] = []
    for entry in sorted(entry_points(group=GROUP), key=lambda one: (_distribution(one), one.name)):
        one = _loaded(entry)
        problems = [one.problem] if one.problem else []
        streams = [row for row in one.plugin.streams if _is_free(row.name, "stream", one, taken, problems)]
        own = {
            name: place
            for name, place in one.plugin.commands.items()
            if _is_free(name, "command", one, commands, problems)
        }
        plugin = Plugin(one.plugin.name, tuple(streams), own)
        found.append(one._replace(plugin=plugin, problem="; ".join(problems)))
        for problem in problems:
            _LOG.warning("%s", problem, extra={"event": "plugin"})
    return tuple(found)


def other_plugins() -> tuple[Plugin, ...]:
    """The usable plugins of other packages."""
    return tuple(one.plugin for one in found_plugins())


def _loaded(entry: EntryPoint) -> FoundPlugin:
    """The plugin of ``entry``; an empty one with its problem if it is none."""
    where = f"the plugin {entry.name!r} of {_distribution(entry)} ({entry.value})"
    version = entry.dist.version if entry.dist is not None else ""
    nothing = FoundPlugin(entry.name, _distribution(entry), version, Plugin(entry.name))
    try:
        plugin = entry.load()
    except (Exception, SystemExit) as error:  # whatever somebody else's module does when it is imported
        text = printable(f"{type(error).__name__}: {error}")
        return nothing._replace(problem=f"{where} cannot be imported: {text}; all else works without it")
    if not isinstance(plugin, Plugin):
        kind = type(plugin).__name__
        return nothing._replace(problem=f"{where} is not a zstate.plugins.Plugin, but of type {kind}")
    return nothing._replace(plugin=plugin)


def _is_free(name: str, kind: str, one: FoundPlugin, taken: dict[str, str], problems: list[str]) -> bool:
    """Whether no other brings ``name``; from now on ``one`` does. Otherwise ``problems`` gets both."""
    owner = taken.setdefault(name, one.distribution)
    if owner is not one.distribution:
        problems.append(
            f"the {kind} {name!r} of {one.distribution} is not used: {owner} brings one of that name"
        )
    return owner is one.distribution


def _distribution(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else "an unknown distribution"
