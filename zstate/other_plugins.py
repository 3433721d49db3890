"""Plugins of other packages, found by their entry points::

    [project.entry-points."zstate.plugins"]
    battery = "zstate_battery:PLUGIN"

They are read when a stream or a command is met that zstate does not bring, and by the tools that list all. A
plugin that cannot be used is reported once, in the log, with its distribution; all others work.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import NamedTuple

from zstate.errors import printable
from zstate.plugins import Plugin, built_in_plugins
from zstate.streams import CLOCK, CORE, Stream

GROUP = "zstate.plugins"
"""The group of entry points."""

_LOG = logging.getLogger("zstate")


class FoundPlugin(NamedTuple):
    """The plugin of an entry point; ``problem`` is why it, or a part of it, is not used, if so."""

    entry: str
    distribution: str
    version: str
    plugin: Plugin
    problem: str = ""


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
        streams = [
            row
            for row in one.plugin.streams
            if _is_usable(row, one, problems) and _is_free(row.name, "stream", one, taken, problems)
        ]
        own = {
            name: reference
            for name, reference in one.plugin.commands.items()
            if _is_free(name, "command", one, commands, problems)
        }
        plugin = replace(one.plugin, streams=tuple(streams), commands=own)
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
    except (Exception, SystemExit) as error:  # whatever another package's module does when it is imported
        text = printable(f"{type(error).__name__}: {error}")
        return nothing._replace(problem=f"{where} cannot be imported: {text}; all else works without it")
    if not isinstance(plugin, Plugin):
        kind = type(plugin).__name__
        return nothing._replace(problem=f"{where} is not a zstate.plugins.Plugin, but of type {kind}")
    return nothing._replace(plugin=plugin)


def _is_usable(row: Stream, one: FoundPlugin, problems: list[str]) -> bool:
    """Whether ``row`` is a stream that any package may bring; otherwise ``problems`` gets the reason."""
    from zstate.message import StampedMessage  # noqa: PLC0415 - msgspec is loaded for other packages alone

    reason = ""
    if row.group != "measurement" or row.latched:
        reason = "the streams of other packages are measurements, and not latched"
    else:
        try:
            if not issubclass(row.type, StampedMessage):
                reason = f"its messages are not StampedMessages, but of type {row.type.__name__}"
        except Exception as error:  # whatever another package's module does when it is imported
            reason = printable(
                f"its message {row.message!r} cannot be loaded: {type(error).__name__}: {error}"
            )
    if reason:
        problems.append(f"the stream {row.name!r} of {one.distribution} is not used: {reason}")
    return not reason


def _is_free(name: str, kind: str, one: FoundPlugin, taken: dict[str, str], problems: list[str]) -> bool:
    """Whether no other brings ``name``; from now on ``one`` does. Otherwise ``problems`` gets both."""
    owner = taken.get(name)
    if owner is None:
        taken[name] = one.distribution
    else:
        text = f"the {kind} {name!r} of {one.distribution} is not used: {owner} brings one of that name"
        problems.append(text)
    return owner is None


def _distribution(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else "an unknown distribution"
