"""All streams by name: the rows of the core, of the plugins of zstate, and of other packages.

Those of other packages are looked for when a stream is met that zstate does not bring, and by the tools that
list all.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from functools import cache

from zstate._util.fork_safe import fork_safe
from zstate.errors import InvalidInput, printable
from zstate.plugins import built_in_plugins
from zstate.streams import CLOCK, CORE, Stream, StreamName


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
        from zstate.other_plugins import other_plugins  # noqa: PLC0415 - most programs use zstate's own

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
