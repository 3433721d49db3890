"""Plugins: what a folder, or another package, adds to zstate; and all streams, by name.

The plugins of zstate are a table of strings, imported on use. Other packages have an entry point::

    [project.entry-points."zstate.plugins"]
    battery = "zstate_battery:PLUGIN"

which is read when a stream or a command is met that zstate does not bring, and by the tools that list all. A
plugin that cannot be used is reported once, in the log, with its distribution; all others work.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType
from typing import NamedTuple

from zstate._util.fork_safe import fork_safe
from zstate.errors import InvalidInput, printable
from zstate.streams import CLOCK, CORE, Stream, StreamName

GROUP = "zstate.plugins"
"""The group of entry points."""

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

_LOG = logging.getLogger("zstate")


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


class FoundPlugin(NamedTuple):
    """The plugin of an entry point; ``problem`` is why it, or a part of it, is not used, if so."""

    entry: str
    distribution: str
    version: str
    plugin: Plugin
    problem: str = ""


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


class _Registry:
    """The known rows by name, in the order of tokens: built-in ones, then those of other packages by name."""

    def __init__(self) -> None:
        self._lock = fork_safe(threading.RLock())
        self._built_in: dict[StreamName, Stream] = {}
        self._all: dict[StreamName, Stream] | None = None

    def forget(self) -> None:
        """Look for all rows again, as in a new process."""
        self._all = None

    def built_in(self) -> dict[StreamName, Stream]:
        if not self._built_in:
            rows = [*CORE, *(row for plugin in built_in_plugins() for row in plugin.streams), CLOCK]
            self._built_in = {row.name: row for row in rows}
        return self._built_in

    def all(self) -> dict[StreamName, Stream]:
        with self._lock:
            if self._all is None:
                self._all = self.built_in()  # a plugin may look for a stream while it is imported
                others = [row for plugin in other_plugins() for row in plugin.streams]
                self._all = self._all | {row.name: row for row in sorted(others, key=lambda row: row.name)}
            return self._all


_REGISTRY = _Registry()


def find_stream(name: StreamName) -> Stream | None:
    """The row of the stream ``name``; None if no plugin brings it."""
    return _REGISTRY.built_in().get(name) or _REGISTRY.all().get(name)


def stream_named(name: StreamName) -> Stream:
    """The row of the stream ``name``. Raises InvalidInput with the known ones if no plugin brings it."""
    found = find_stream(name)
    if found is None:
        raise InvalidInput(
            f"there is no stream {printable(name)!r}; known are {', '.join(_REGISTRY.all())}. "
            "`zstate plugins` lists the packages that bring others"
        )
    return found


def own_streams() -> tuple[Stream, ...]:
    """The rows that zstate itself brings, in the order of liveliness tokens."""
    return tuple(_REGISTRY.built_in().values())


def is_own(name: StreamName) -> bool:
    """Whether zstate itself brings the stream, so that all programs know it."""
    return name in _REGISTRY.built_in()


def all_streams() -> tuple[Stream, ...]:
    """All rows, those of other packages as well, in the order of liveliness tokens."""
    return tuple(_REGISTRY.all().values())


def streams_where(condition: Callable[[Stream], bool]) -> tuple[StreamName, ...]:
    """The names of the streams that meet ``condition``, those of other packages as well."""
    return tuple(row.name for row in all_streams() if condition(row))


@cache
def edge_streams() -> tuple[StreamName, ...]:
    """The streams of moving edges under the names of their writers."""
    return tuple(row.name for row in own_streams() if row.group == "edges")


@cache
def latched_streams() -> tuple[StreamName, ...]:
    """The streams of one current value, which late joiners receive as well."""
    return streams_where(lambda row: row.latched)


@cache
def measured_streams() -> tuple[StreamName, ...]:
    """The streams of what sensors and programs measure, sample by sample."""
    return streams_where(lambda row: row.is_measured)


def is_named(name: StreamName) -> bool:
    """Whether each writer of the stream has a key of its own."""
    found = find_stream(name)
    return found is not None and found.named


def is_latched(name: StreamName) -> bool:
    """Whether the stream has one current value, which late joiners receive as well."""
    found = find_stream(name)
    return found is not None and found.latched


def is_bulk(name: StreamName) -> bool:
    """Whether the samples of the stream are large, and give way to others."""
    found = find_stream(name)
    return found is not None and found.bulk


def is_measured(name: StreamName) -> bool:
    """Whether the stream is one of ``measured_streams``, without a search for other packages' otherwise."""
    found = find_stream(name)
    return found is not None and found.is_measured


def is_value(name: StreamName) -> bool:
    """Whether the stream has one current value of what was measured."""
    found = find_stream(name)
    return found is not None and found.is_value


def in_canonical_order(names: Iterable[StreamName]) -> tuple[StreamName, ...]:
    """``names``, each once, in the order of tokens, without those that no plugin brings."""
    given = set(names)
    rows = _REGISTRY.built_in()
    if not given <= rows.keys():
        rows = _REGISTRY.all()
    return tuple(name for name in rows if name in given)
